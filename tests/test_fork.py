"""The fork: environments against the equations and each other, the oracle against Monte Carlo."""

from __future__ import annotations

import math
import pickle

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import dblquad
from scipy.stats import multivariate_normal, norm
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import Bounded
from torchrl.envs import GymEnv, SerialEnv
from torchrl.envs.utils import check_env_specs

from torchrl_vjepa import BatchedForkEnv, ForkEnv, ForkSystem, LatentEnv, RandomShooting, sample

ENV_ID = "torchrl_vjepa/Fork-v0"

positions = st.tuples(st.floats(-5, 4), st.floats(-2.5, 2.5))
in_the_fork = st.tuples(st.floats(-2.74, -1.26), st.floats(-2.5, 2.5))


def numpy_step(x, u, kappa, eps, p=0.5, b=1.2, sigma=0.08):
    """The documented equations, written again."""
    after = x + np.array([1.5, u]) + sigma * eps
    if -2.75 <= x[0] < -1.25:
        side = 1.0 if norm.cdf(kappa) < p else -1.0
        return after + side * b * np.array([x[1], -x[0]]) / np.linalg.norm(x), side
    return after, 0.0


def simulate(system: ForkSystem, position: Tensor, action: Tensor, num: int, seed: int = 0) -> Tensor:
    """Next positions by the environment's own equations."""
    noise = torch.randn((num, 3), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    state = {"observation": position.double().expand(num, 2)}
    return system.step(state, action.double().expand(num, 1), noise)[0]["observation"]


# ---------------------------------------------------------------- oracle


@given(positions, st.floats(-0.6, 0.6), st.floats(0.05, 0.95), st.integers(0, 1000))
@settings(max_examples=25)
def test_density_is_that_of_the_equations(position, action, p, seed):
    """Moments of simulated steps, within four standard errors; the log-density against SciPy."""
    system = ForkSystem(left_probability=p)
    x, u = torch.tensor(position, dtype=torch.float64), torch.tensor([action], dtype=torch.float64)
    draws, density = simulate(system, x, u, 20_000, seed), system.dist(x, u)
    assert (draws.mean(0) - density.mean).abs().le(5 * draws.std(0) / len(draws) ** 0.5).all()
    squares = (draws - density.mean).square()
    assert (squares.mean(0) - density.variance).abs().le(5 * squares.std(0) / len(draws) ** 0.5).all()
    points = draws[:5]
    loc = np.array(position) + np.array([1.5, action])
    jump = np.zeros(2)
    if -2.75 <= position[0] < -1.25:
        jump = 1.2 * np.array([position[1], -position[0]]) / np.linalg.norm(position)
    left, right = (multivariate_normal(loc + s * jump, 0.08**2 * np.eye(2)) for s in (1, -1))
    expected = np.log(p * left.pdf(points) + (1 - p) * right.pdf(points))
    np.testing.assert_allclose(density.log_prob(points), expected, atol=1e-6)


@pytest.mark.parametrize("p", [0.5, 0.2])
def test_sides_and_places_come_together(p):
    """Not the marginals only: each branch has its own weight and place."""
    system = ForkSystem(left_probability=p)
    x, u = torch.tensor([-2.0, 0.4]), torch.tensor([0.1])
    draws = simulate(system, x, u, 50_000)
    left = draws[:, 1] > 0.5
    assert left.double().mean().item() == pytest.approx(p, abs=4 * math.sqrt(p * (1 - p) / 50_000))
    branches = system.dist(x, u).component_distribution.mean.double()
    for branch, rows in zip(branches, (left, ~left), strict=True):
        torch.testing.assert_close(draws[rows].mean(0), branch, atol=4 * 0.08 / (p * 50_000) ** 0.5, rtol=0)


def test_density_integrates_to_the_wall_mass():
    system = ForkSystem(left_probability=0.3, noise_std=0.2, wall_half_width=0.8)
    x, u = torch.tensor([-1.9, 0.5], dtype=torch.float64), torch.tensor([-0.3], dtype=torch.float64)
    p = system.dist(x, u)

    def density(across, along):
        return p.log_prob(torch.tensor([along, across], dtype=torch.float64)).exp().item()

    mass = dblquad(density, -1.25, 1.25, -0.8, 0.8, epsabs=1e-5)[0]
    assert system.wall_mass(x, u).item() == pytest.approx(mass, abs=1e-5)
    assert 0.1 < mass < 0.9


@given(in_the_fork, st.floats(-0.6, 0.6), st.floats(0.1, 0.9), st.floats(0.05, 0.4))
@settings(max_examples=25)
def test_wall_mass_is_the_share_of_simulated_crashes(position, action, p, std):
    system = ForkSystem(left_probability=p, noise_std=std)
    x, u = torch.tensor(position), torch.tensor([action])
    share = system.in_wall(simulate(system, x, u, 20_000)).double().mean().item()
    mass = system.wall_mass(x, u).item()
    assert share == pytest.approx(mass, abs=5 * math.sqrt(mass * (1 - mass) / 20_000) + 2e-4)


def test_safe_aims_have_their_mean_in_the_wall_and_others_not():
    """What the environment is for; the story of the docstring in numbers."""
    system = ForkSystem()
    aims = torch.linspace(-1.0, 1.0, 81)
    position = torch.stack([torch.full_like(aims, -2.0), aims], dim=-1)
    mass = system.wall_mass(position, torch.zeros(81, 1))
    mean_in_wall = system.in_wall(system.dist(position, torch.zeros(81, 1)).mean)
    safe = mass < 0.01
    assert safe.sum() > 10
    assert mean_in_wall[safe].all()
    beside = ~mean_in_wall & (aims.abs() < 0.8)
    assert beside.any()
    torch.testing.assert_close(mass[beside], torch.full_like(mass[beside], 0.5), atol=0.02, rtol=0)


def test_no_linear_map_removes_the_correlation_everywhere():
    """Generalised eigenvectors of two covariances diagonalise both; a third stays correlated."""
    system = ForkSystem()
    position = torch.tensor([[-2.0, -1.0], [-2.0, 0.0], [-2.0, 1.0]], dtype=torch.float64)
    draws = system.dist(position, torch.zeros(3, 1, dtype=torch.float64))
    centred = draws.component_distribution.mean - draws.mean.unsqueeze(-2)
    covariance = 0.5 * centred.mT @ centred + 0.08**2 * torch.eye(2, dtype=torch.float64)
    first = torch.linalg.cholesky(covariance[0])
    white = torch.linalg.solve(first, torch.linalg.solve(first, covariance).mT)
    _, axes = torch.linalg.eigh(white[1])
    last = axes.mT @ white[2] @ axes
    assert abs(last[0, 1]) / (last[0, 0] * last[1, 1]).sqrt() > 0.5


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_oracle_takes_any_batch_and_dtype(batch, dtype):
    system = ForkSystem()
    x, u = torch.full((*batch, 2), -2.0, dtype=dtype), torch.zeros((*batch, 1), dtype=dtype)
    p = system.dist(x, u)
    assert (p.batch_shape, p.event_shape) == (batch, (2,))
    assert p.log_prob(x).dtype == system.wall_mass(x, u).dtype == system.cost(x, u).dtype == dtype
    assert system.wall_mass(x, u).shape == system.cost(x, u).shape == batch
    assert sample(p, (5,), generator=torch.Generator().manual_seed(0)).shape == (5, *batch, 2)
    many = torch.randn(6, 2, dtype=dtype)
    mapped = torch.func.vmap(system.wall_mass)(many, torch.zeros(6, 1, dtype=dtype))
    torch.testing.assert_close(mapped, system.wall_mass(many, torch.zeros(6, 1, dtype=dtype)))


def test_gradients_of_the_oracle_are_finite_everywhere():
    x = torch.tensor([[0.0, 0.0], [-2.0, 0.0], [-2.0, 1.0]], requires_grad=True)
    u = torch.zeros(3, 1, requires_grad=True)
    system = ForkSystem()
    (system.dist(x, u).log_prob(torch.zeros(3, 2)) + system.wall_mass(x, u)).sum().backward()
    assert x.grad.isfinite().all()
    assert u.grad.isfinite().all()


@pytest.mark.parametrize(("along", "swerves"), [(-2.76, False), (-2.75, True), (-1.26, True), (-1.25, False)])
def test_the_fork_has_the_documented_ends(along, swerves):
    x, u = torch.tensor([along, 0.0], dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    left, right = ForkSystem().dist(x, u).component_distribution.mean
    assert (left - right).norm().item() == pytest.approx(2.4 if swerves else 0.0)


def test_the_wall_has_the_documented_ends():
    inside = torch.tensor([[1.25, 0.7], [-1.25, -0.7]], dtype=torch.float64)
    outside = torch.tensor([[1.26, 0.0], [-1.26, 0.0], [0.0, 0.71], [0.0, -0.71]], dtype=torch.float64)
    assert ForkSystem().in_wall(inside).all()
    assert not ForkSystem().in_wall(outside).any()


def test_cost_adds_up():
    x = torch.tensor([[0.0, 0.5], [0.0, -2.0]])
    cost = ForkSystem(crash_cost=7.0, action_cost=0.5).cost(x, torch.tensor([[0.2], [-0.4]]))
    torch.testing.assert_close(cost, torch.tensor([0.25 + 0.02 + 7.0, 4.0 + 0.08]))


def test_planning_on_the_truth_is_safe_by_samples_and_fails_by_the_mean():
    """The oracle is a transition like any model: the claim holds before anything is learned."""
    system = ForkSystem()
    success = {}
    for how, num_samples in (("sample", 32), ("mean", 1)):
        world = LatentEnv(
            system.dist,
            action_spec=Bounded(-0.6, 0.6, (1,)),
            cost=system.cost,
            how=how,
            num_samples=num_samples,
            latent_dim=2,
            latent_key="observation",
        )
        planner = RandomShooting(world, planning_horizon=3, num_candidates=48, warm_start=False, seed=0)
        env = BatchedForkEnv(100, system, seed=0)
        episodes = env.rollout(6, planner, break_when_any_done=False, break_when_all_done=True)
        success[how] = 1 - episodes["next", "terminated"].any(1).float().mean().item()
    assert success["sample"] >= 0.95
    assert success["mean"] < 0.7


# ---------------------------------------------------------------- Gymnasium environment


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space.*:UserWarning")
@pytest.mark.filterwarnings("ignore:.*Box observation space m.* value is -?infinity.*:UserWarning")
def test_gymnasium_checker_passes():
    check_env(gymnasium.make(ENV_ID).unwrapped, skip_render_check=True)


def test_make_passes_the_system_on():
    system = ForkSystem(action_bound=0.3, episode_length=2)
    env = gymnasium.make(ENV_ID, system=system).unwrapped
    assert env.system is system
    assert env.action_space == gymnasium.spaces.Box(-0.3, 0.3, (1,), np.float32)
    env.reset(seed=0)
    assert [env.step(np.zeros(1))[3] for _ in range(2)] == [False, True]


@pytest.mark.parametrize("p", [0.5, 0.1])
def test_episode_follows_the_equations_and_the_documented_stream(p):
    env = ForkEnv(ForkSystem(left_probability=p))
    sides, ends = [], []
    for seed in range(20):
        observation, info = env.reset(seed=seed)
        rng = np.random.default_rng(int(np.random.default_rng(seed).integers(2**63 - 1)))
        x = np.array([-5.0, 0.6 * rng.standard_normal(3)[2]])
        assert info["side"] == 0
        actions = np.random.default_rng(0).uniform(-0.8, 0.8, 6)
        for step, action in enumerate(actions):
            np.testing.assert_allclose(observation, x, rtol=1e-5, atol=1e-6)
            assert observation.dtype == np.float32
            u = np.clip(action, -0.6, 0.6)
            kappa, *eps = rng.standard_normal(3)
            x, side = numpy_step(x, u, kappa, np.array(eps), p)
            observation, reward, terminated, truncated, info = env.step(np.array([action]))
            crash = abs(x[0]) <= 1.25 and abs(x[1]) <= 0.7
            assert info["side"] == side
            assert (terminated, truncated) == (crash, step == 5)
            assert reward == pytest.approx(-(x[1] ** 2 + 0.1 * u**2 + 100 * crash))
            if side:
                sides.append(side)
            if terminated or truncated:
                ends.append(terminated)
                break
        with pytest.raises(RuntimeError, match="reset"):
            env.step(np.zeros(1))
    assert len(sides) >= 20
    assert len(set(ends)) == 2
    assert set(sides) == ({-1.0, 1.0} if p == 0.5 else set(sides))


@pytest.mark.parametrize("action", [[math.nan], [math.inf], [0.0, 0.0], [[0.0]], 0.0])
def test_gym_step_refuses_and_keeps_its_state(action):
    env, twin = ForkEnv(), ForkEnv()
    env.reset(seed=0)
    twin.reset(seed=0)
    with pytest.raises(ValueError, match=r"action must be finite with shape \(1,\)"):
        env.step(np.array(action))
    np.testing.assert_array_equal(env.step(np.ones(1))[0], twin.step(np.ones(1))[0])


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"left_probability": 0.0}, ValueError, r"left_probability must be inside \(0, 1\), got 0.0"),
        ({"left_probability": 1.0}, ValueError, "left_probability"),
        ({"left_probability": math.nan}, ValueError, "left_probability"),
        ({"swerve": 0.0}, ValueError, "swerve must be positive"),
        ({"wall_half_width": -1.0}, ValueError, "wall_half_width must be positive"),
        ({"noise_std": 0.0}, ValueError, "noise_std must be positive"),
        ({"noise_std": math.inf}, ValueError, "noise_std"),
        ({"start_std": -0.1}, ValueError, "start_std"),
        ({"crash_cost": math.nan}, ValueError, "crash_cost"),
        ({"action_cost": -1.0}, ValueError, "action_cost"),
        ({"action_bound": 0.0}, ValueError, "action_bound must be positive"),
        ({"episode_length": 0}, ValueError, "episode_length must be at least 1"),
        ({"episode_length": 2.5}, TypeError, "episode_length must be an integer"),
    ],
)
def test_system_refuses(kwargs, error, message):
    with pytest.raises(error, match=message):
        ForkSystem(**kwargs)


@pytest.mark.parametrize(("position", "action"), [((3,), (1,)), ((4, 2), (1,)), ((2,), (2,)), ((), (1,))])
def test_oracle_refuses_wrong_shapes(position, action):
    for method in (ForkSystem().dist, ForkSystem().wall_mass):
        with pytest.raises(ValueError, match="position and action must have shapes"):
            method(torch.zeros(position), torch.zeros(action))


def test_torchrl_gym_env_reads_the_side():
    env = GymEnv(ENV_ID).auto_register_info_dict()
    check_env_specs(env)
    rollout = env.rollout(3)
    assert rollout["next", "side"].shape == (3, 1)
    assert rollout["next", "side"][:, 0].tolist()[:2] == [0, 0]
    assert rollout["next", "side"][2].abs() == 1


# ---------------------------------------------------------------- batched environment


def steer_back(tensordict):
    return tensordict.set("action", -tensordict["observation"][..., 1:])


def test_batched_env_passes_the_spec_checker():
    env = BatchedForkEnv(3, seed=0)
    check_env_specs(env)
    assert set(env.observation_spec.keys()) == {"observation", "side"}
    assert env.action_spec_unbatched.shape == (1,)


def test_batched_env_makes_the_numbers_of_the_gym_env_over_episodes():
    """Crashes end rows at different times; each goes on with its own next episode."""
    num_steps, seed, system = 20, 40, ForkSystem(wall_half_width=1.1)
    batched = BatchedForkEnv(4, system, seed=seed)
    data = batched.rollout(num_steps, steer_back, break_when_any_done=False)
    crashes = 0
    for row in range(4):
        env = ForkEnv(system)
        observation, info = env.reset(seed=seed + row)
        for step in range(num_steps):
            now = data[row, step]
            np.testing.assert_allclose(now["observation"], observation, rtol=1e-4, atol=1e-5)
            assert now["side"].item() == info["side"].item()
            observation, reward, terminated, truncated, info = env.step(now["action"].numpy())
            after = now["next"]
            np.testing.assert_allclose(after["observation"], observation, rtol=1e-4, atol=1e-5)
            assert after["reward"].item() == pytest.approx(reward, rel=1e-4, abs=1e-5)
            assert after["terminated"].item() == terminated
            assert after["truncated"].item() == truncated
            assert after["done"].item() == (terminated or truncated)
            crashes += terminated
            if terminated or truncated:
                observation, info = env.reset()
    assert crashes > 0
    assert data["action"].abs().max() > 0.6


def test_rows_that_are_over_wait():
    env = BatchedForkEnv(64, seed=0)
    data = env.rollout(9, steer_back, break_when_any_done=False, break_when_all_done=True)
    assert data.batch_size == (64, 6)
    crashed = data["next", "terminated"].squeeze(-1)
    assert 0 < crashed.any(1).sum() < 64
    # Once in the wall, a row stays there.
    assert torch.equal(crashed, crashed.cummax(1).values)
    later = crashed[:, :-1]
    assert torch.equal(data["next", "observation"][:, 1:][later], data["next", "observation"][:, :-1][later])
    assert ForkSystem().in_wall(data["next", "observation"][crashed]).all()
    with pytest.raises(RuntimeError, match="done"):
        env.step(steer_back(data[:, -1]["next"].exclude("reward")))


def test_neither_side_nor_noise_depends_on_the_actions():
    env = BatchedForkEnv(16, ForkSystem(wall_half_width=1e-9), seed=3)

    def straight(tensordict):
        return tensordict.set("action", torch.zeros(16, 1))

    first = env.rollout(6, straight)
    env.set_seed(3)
    second = env.rollout(6, steer_back)
    assert torch.equal(first["next", "side"], second["next", "side"])
    before = slice(None, 2)  # the same noise: positions differ by what the actions did
    moved = second["action"].clamp(-0.6, 0.6)[:, before, 0].cumsum(1)
    difference = second["next", "observation"][:, before, 1] - first["next", "observation"][:, before, 1]
    torch.testing.assert_close(difference, moved, atol=1e-5, rtol=0)


def test_seeds():
    def fresh(seed):
        return BatchedForkEnv(3, seed=seed).reset()["observation"]

    assert torch.equal(fresh(0), fresh(0))
    assert torch.equal(fresh(0)[1:], fresh(1)[:2])
    assert not torch.equal(fresh(None), fresh(None))
    state = torch.get_rng_state()
    env = BatchedForkEnv(3, seed=0)
    first, second = env.reset()["observation"], env.reset()["observation"]
    assert not torch.equal(first, second)
    assert torch.equal(state, torch.get_rng_state())
    with pytest.raises(ValueError, match="seed must be at least 0"):
        env.set_seed(-1)
    with pytest.raises(ValueError, match="num_envs must be at least 1"):
        BatchedForkEnv(0)


def make_env() -> BatchedForkEnv:
    return BatchedForkEnv(1, seed=0)


def test_runs_in_a_collector_and_in_a_serial_env_and_pickles():
    collector = Collector(BatchedForkEnv(8, seed=0), steer_back, frames_per_batch=160, total_frames=160)
    batch = next(iter(collector)).clone()
    collector.shutdown()
    assert batch.batch_size == (8, 20)
    assert batch["next", "done"].any(1).all()
    serial = SerialEnv(2, make_env)
    assert serial.rollout(3)["observation"].shape == (2, 1, 3, 2)
    serial.close()
    assert (pickle.loads(pickle.dumps(make_env())).reset() == make_env().reset()).all()
