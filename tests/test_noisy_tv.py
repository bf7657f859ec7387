"""Noisy TV: data against naive loops, environments against each other, oracles against algebra."""

from __future__ import annotations

import math
import pickle
import sys

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_lyapunov
from tensordict import TensorDict
from torch.distributions import MultivariateNormal
from torchrl.collectors import Collector
from torchrl.data import Unbounded
from torchrl.envs import (
    GymEnv,
    InitTracker,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    default_info_dict_reader,
)
from torchrl.envs.utils import check_env_specs
from torchrl.modules import get_env_transforms_from_module

from torchrl_vjepa.noisy_tv import (
    BatchedNoisyTVEnv,
    KalmanFilter,
    LinearGaussianSystem,
    LQGController,
    NoisyTVEnv,
    solve_lqr,
)
from torchrl_vjepa.noisy_tv.system import linear_recurrence

ENV_ID = "torchrl_vjepa/NoisyTV-v0"


def small_system(**kwargs: object) -> LinearGaussianSystem:
    """Sizes all different, so that a mixed-up one cannot pass."""
    defaults = {"signal_dim": 3, "distractor_dim": 2, "observation_dim": 7, "control_dim": 1}
    return LinearGaussianSystem(**{**defaults, "seed": 5, **kwargs})


@pytest.fixture
def rng_states_untouched():
    """The global generators of torch and NumPy are as they were."""
    torch_state = torch.get_rng_state()
    numpy_state = np.random.get_state()[1].copy()  # noqa: NPY002 (the global one is meant)
    yield
    assert torch.equal(torch.get_rng_state(), torch_state)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_state)  # noqa: NPY002 (the same)


# ---------------------------------------------------------------- system: matrices


def test_matrices_are_those_of_the_papers_program():
    system = LinearGaussianSystem(seed=111)
    first_row = torch.tensor([-0.53319, 0.1993, 0.82165, -0.02961], dtype=torch.float64)
    torch.testing.assert_close(system.A[0], first_row, atol=6e-6, rtol=0)


def test_matrices_come_in_the_documented_order():
    system = small_system(control_dim=2)
    rng = np.random.RandomState(5)
    expected = {"A": np.linalg.qr(rng.randn(3, 3))[0]}
    for name, shape in {"C": (7, 3), "D": (7, 2), "B": (3, 2), "goal": (3,)}.items():
        draw = rng.randn(*shape)
        expected[name] = draw / np.sqrt((draw**2).sum(0))
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(system, name).numpy(), value, atol=1e-15)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_matrices_are_orthogonal_and_unit_norm(seed):
    system = LinearGaussianSystem(control_dim=2, seed=seed)
    torch.testing.assert_close(system.A @ system.A.mT, torch.eye(4, dtype=torch.float64))
    for matrix in (system.B, system.C, system.D, system.goal.unsqueeze(-1)):
        torch.testing.assert_close(matrix.norm(dim=0), torch.ones(matrix.shape[1]).double())


def test_an_explicit_matrix_replaces_only_itself():
    drawn, goal = small_system(), [1.0, 2.0, 3.0]
    system = small_system(goal=goal, A=0.5 * np.eye(3))
    assert system.goal.tolist() == goal
    assert torch.equal(system.A, 0.5 * torch.eye(3).double())
    for name in "BCD":
        assert torch.equal(getattr(system, name), getattr(drawn, name))


def test_trajectory_is_that_of_the_papers_program():
    system = LinearGaussianSystem(seed=111)
    generator = torch.Generator().manual_seed(111)

    def draw(num_steps: int) -> TensorDict:
        rows = [
            torch.cat([torch.randn(4, generator=generator) for _ in range(2)] + [torch.zeros(20)])
            for _ in range(num_steps + 1)
        ]
        return system.unroll(torch.stack(rows), noise_scale=1.0)

    train, test = draw(6000), draw(2000)
    for data, key, t, expected in (
        (train, "signal", 0, (-0.12224, -0.75725, 1.0416, 0.33028)),
        (train, "signal", 1, (0.81259, 0.34068, 0.64831, -0.91999)),
        (train, "distractor", 1, (0.42264, -0.65275, 1.06746, 0.69824)),
        (train, "signal", 6000, (6.6132, 4.1044, 7.13942, 6.96206)),
        (test, "signal", 0, (-1.09573, 1.93779, -1.08595, 0.14575)),
        (test, "signal", 2000, (5.13591, 2.75354, -9.54521, -2.09041)),
    ):
        # Their loop runs in float32, which is off by 4e-4 after 6000 steps.
        torch.testing.assert_close(data[key][t], torch.tensor(expected), atol=1e-3, rtol=0)


# ---------------------------------------------------------------- system: trajectories


@given(
    num_steps=st.integers(1, 40),
    radius=st.floats(0.0, 1.2),
    batch=st.sampled_from([(), (3,), (2, 2)]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=40, deadline=None)
def test_linear_recurrence_equals_the_loop(num_steps, radius, batch, seed):
    generator = torch.Generator().manual_seed(seed)
    matrix = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    matrix = radius * matrix / torch.linalg.eigvals(matrix).abs().max()
    inputs = torch.randn(*batch, num_steps, 3, generator=generator, dtype=torch.float64)
    state, states = torch.zeros(*batch, 3, dtype=torch.float64), []
    for t in range(num_steps):
        state = state @ matrix.T + inputs[..., t, :]
        states.append(state)
    before = inputs.clone()
    scanned = linear_recurrence(matrix, inputs)
    torch.testing.assert_close(scanned, torch.stack(states, -2), atol=1e-9, rtol=1e-9)
    assert torch.equal(inputs, before)


@pytest.mark.parametrize("batch", [(), (4,)])
@pytest.mark.parametrize("same_actions", [True, False])
def test_unroll_equals_the_equations_step_by_step(batch, same_actions):
    A = 0.7 * torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).double()
    system = small_system(A=A, signal_std=0.2, distractor_decay=0.8, distractor_std=0.5, sensor_std=0.03)
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(*batch, 11, 12, generator=generator, dtype=torch.float64)
    shape = (11, 1) if same_actions else (*batch, 11, 1)
    actions = torch.randn(shape, generator=generator, dtype=torch.float64)
    data = system.unroll(noise, 3.0, actions)
    assert data.batch_size == (*batch, 11)
    assert torch.equal(data["action"], actions.expand(*batch, 11, 1))
    assert torch.equal(data["time"], torch.arange(11).expand(*batch, 11))

    s, d = noise[..., 0, :3], noise[..., 0, 3:5]
    for t in range(11):
        x = s @ system.C.T + 3.0 * d @ system.D.T + 0.03 * noise[..., t, 5:]
        for key, value in (("signal", s), ("distractor", d), ("observation", x)):
            torch.testing.assert_close(data[key][..., t, :], value)
        if t < 10:
            u = actions[..., t, :]
            s = s @ A.T + u @ system.B.T + 0.2 * noise[..., t + 1, :3]
            d = 0.8 * d + 0.5 * noise[..., t + 1, 3:5]


def test_start_and_step_equal_unroll():
    system = small_system()
    generator = torch.Generator().manual_seed(2)
    noise, actions = torch.randn(6, 12, generator=generator), torch.randn(6, 1, generator=generator)
    data = system.unroll(noise, 8.0, actions)
    s, d, x = system.start(noise[0], 8.0)
    for t in range(6):
        for key, value in (("signal", s), ("distractor", d), ("observation", x)):
            torch.testing.assert_close(data[key][t], value, atol=1e-5, rtol=1e-5)
        if t < 5:
            s, d, x = system.step(s, d, actions[t], noise[t + 1], 8.0)


def test_initial_state_overrides_only_the_first_row():
    system = small_system(signal_std=0.0, distractor_std=0.0)
    s0, d0 = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([[1.0, -1.0], [0.5, 4.0]])
    data = system.simulate(5, 1.0, batch_size=(2,), signal=s0, distractor=d0, seed=0)
    assert torch.equal(data["signal"][:, 0], s0.expand(2, 3))
    assert torch.equal(data["distractor"][:, 0], d0)
    torch.testing.assert_close(data["distractor"][:, 4], 0.9**4 * d0)
    torch.testing.assert_close(data["signal"][:, 2], (system.A @ system.A @ s0.double()).float().expand(2, 3))


def test_moments_agree_with_the_closed_forms():
    system, num, noise_scale = LinearGaussianSystem(seed=3), 20_000, 2.0
    data = system.simulate(12, noise_scale, batch_size=(num,), seed=7, dtype=torch.float64)
    for t in (0, 1, 11):
        # Var[s_t] = 1 + t * 0.01; Var[d_t] = 0.81^t + 0.09 (1 - 0.81^t) / 0.19
        signal_var = 1 + t * 0.01
        distractor_var = 0.81**t + 0.09 * (1 - 0.81**t) / 0.19
        expected = (
            signal_var * system.C @ system.C.T
            + noise_scale**2 * distractor_var * system.D @ system.D.T
            + 1e-4 * torch.eye(20)
        )
        # A sample covariance of Gaussians has standard error below sqrt(2 v_i v_j / num).
        for value, cov in (
            (data["signal"][:, t], signal_var * torch.eye(4)),
            (data["distractor"][:, t], distractor_var * torch.eye(4)),
            (data["observation"][:, t], expected),
        ):
            scale = cov.diagonal().sqrt()
            error = (value.T.cov() - cov).abs() / (scale[:, None] * scale)
            assert error.max() < 6 * math.sqrt(2 / num)
            assert (value.mean(0).abs() / scale).max() < 6 / math.sqrt(num)
    residual = (
        data["observation"] - data["signal"] @ system.C.T - noise_scale * data["distractor"] @ system.D.T
    )
    # Two times apart are independent; each has the sensor's standard deviation.
    assert abs(residual.std() / 0.01 - 1) < 1e-2
    assert (residual[:, 0] * residual[:, 1]).mean().abs() < 6 * 1e-4 / math.sqrt(20 * num)


def test_long_trajectory_keeps_the_rotation_exact():
    """Without noise the norm of the signal is conserved over 300,000 steps."""
    system = LinearGaussianSystem(signal_std=0.0, distractor_std=0.0)
    data = system.simulate(300_000, 0.0, signal=torch.ones(4), seed=0)
    torch.testing.assert_close(data["signal"].norm(dim=-1), torch.full((300_000,), 2.0))


@pytest.mark.usefixtures("rng_states_untouched")
def test_randomness_is_the_systems_own():
    first, second = LinearGaussianSystem(seed=4), LinearGaussianSystem(seed=4)
    a, b = first.simulate(9, 1.0), second.simulate(9, 1.0)
    assert (a == b).all()
    assert not torch.equal(first.simulate(9, 1.0)["signal"], a["signal"])
    copy = pickle.loads(pickle.dumps(first))
    assert (copy.simulate(9, 1.0) == first.simulate(9, 1.0)).all()
    by_seed = first.simulate(9, 1.0, seed=3)
    by_generator = first.simulate(9, 1.0, generator=torch.Generator().manual_seed(3))
    assert (by_seed == by_generator).all()
    # The noise scale changes the observation only: paired comparisons across scales.
    other = first.simulate(9, 8.0, seed=3)
    assert torch.equal(other["signal"], by_seed["signal"])
    assert not torch.equal(other["observation"], by_seed["observation"])


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"signal_dim": 0}, ValueError, "signal_dim must be at least 1, got 0"),
        ({"distractor_dim": 0}, ValueError, "distractor_dim"),
        ({"observation_dim": -1}, ValueError, "observation_dim"),
        ({"control_dim": -1}, ValueError, "control_dim must be at least 0"),
        ({"control_dim": 1.5}, TypeError, "control_dim must be an integer"),
        ({"signal_std": -0.1}, ValueError, "signal_std"),
        ({"distractor_std": math.nan}, ValueError, "distractor_std"),
        ({"sensor_std": math.inf}, ValueError, "sensor_std"),
        ({"distractor_decay": math.nan}, ValueError, "distractor_decay"),
        ({"seed": -1}, ValueError, "seed"),
        ({"seed": 2**32}, ValueError, "seed must be in"),
        ({"A": np.eye(3)}, ValueError, r"A must have shape \(4, 4\), got \(3, 3\)"),
        ({"B": np.eye(4)}, ValueError, "B must have shape"),
        ({"C": np.full((20, 4), np.nan)}, ValueError, "C must be finite"),
        ({"D": np.eye(4)}, ValueError, "D must have shape"),
        ({"goal": [1.0]}, ValueError, "goal must have shape"),
    ],
)
def test_system_refuses(kwargs, error, message):
    with pytest.raises(error, match=message):
        LinearGaussianSystem(**kwargs)


@pytest.mark.parametrize(
    ("args", "kwargs", "error", "message"),
    [
        ((0, 1.0), {}, ValueError, "num_steps must be at least 1, got 0"),
        ((-3, 1.0), {}, ValueError, "num_steps"),
        ((2.5, 1.0), {}, TypeError, "num_steps"),
        ((4, -1.0), {}, ValueError, "noise_scale must be a finite number of at least 0, got -1"),
        ((4, math.nan), {}, ValueError, "noise_scale"),
        ((4, math.inf), {}, ValueError, "noise_scale"),
        ((4, 1.0, torch.zeros(3, 1)), {}, ValueError, r"actions must have shape \(4, 1\), got"),
        ((4, 1.0, torch.zeros(4, 2)), {}, ValueError, "actions must have shape"),
        ((4, 1.0, torch.full((4, 1), math.nan)), {}, ValueError, "actions must be finite"),
        ((4, 1.0, torch.zeros(5, 4, 1)), {"batch_size": (2,)}, ValueError, r"or \(2, 4, 1\)"),
        ((4, 1.0), {"signal": torch.zeros(2)}, ValueError, "signal must have shape"),
        ((4, 1.0), {"distractor": torch.tensor([math.inf, 0])}, ValueError, "distractor must be"),
        ((4, 1.0), {"batch_size": (-1,)}, ValueError, "batch_size"),
        ((4, 1.0), {"seed": 1, "generator": torch.Generator()}, ValueError, "seed and generator"),
    ],
)
def test_simulate_refuses_and_draws_nothing(args, kwargs, error, message):
    system = small_system()
    state = system.generator.get_state()
    with pytest.raises(error, match=message):
        system.simulate(*args, **kwargs)
    assert torch.equal(system.generator.get_state(), state)


def test_unroll_refuses():
    with pytest.raises(ValueError, match=r"noise must have shape .*noise_dim=12.*got \(5, 11\)"):
        small_system().unroll(torch.zeros(5, 11), 1.0)
    with pytest.raises(ValueError, match="spectral radius 10"):
        small_system(A=10 * torch.eye(3)).simulate(500, 1.0, seed=0)


# ---------------------------------------------------------------- Gymnasium environment


# The checker would rather have actions in [-1, 1] and bounded observations, which the task has not.
@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space.*:UserWarning")
@pytest.mark.filterwarnings("ignore:.*Box observation space m.* value is -?infinity.*:UserWarning")
def test_gymnasium_checker_passes():
    check_env(gymnasium.make(ENV_ID, noise_scale=4.0).unwrapped, skip_render_check=True)


def test_episode_truncates_at_200_steps_and_no_further():
    env = gymnasium.make(ENV_ID)
    env.reset(seed=0)
    flags = [env.step(np.zeros(2, dtype=np.float32))[2:4] for _ in range(200)]
    assert flags == [(False, False)] * 199 + [(False, True)]
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros(2, dtype=np.float32))
    env.reset()
    env.step(np.zeros(2, dtype=np.float32))


def test_make_passes_arguments_on():
    system = LinearGaussianSystem(control_dim=3, seed=9)
    env = gymnasium.make(ENV_ID, system=system, noise_scale=2.0, episode_length=3, action_bound=0.5).unwrapped
    assert env.action_space == gymnasium.spaces.Box(-0.5, 0.5, (3,), np.float32)
    assert torch.equal(env.system.A, system.A)
    assert env.noise_scale == 2.0
    env.reset(seed=0)
    assert [env.step(np.zeros(3))[3] for _ in range(3)] == [False, False, True]
    by_seed = gymnasium.make(ENV_ID, system_seed=3).unwrapped.system
    assert torch.equal(by_seed.A, LinearGaussianSystem(seed=3).A)


def test_episode_follows_the_equations_and_the_documented_stream():
    env = NoisyTVEnv(3.0, system_seed=2, action_cost=0.7)
    A, B, C, D, goal = (getattr(env.system, name).numpy() for name in ("A", "B", "C", "D", "goal"))
    observation, info = env.reset(seed=11)
    rng = np.random.default_rng(int(np.random.default_rng(11).integers(2**63 - 1)))
    s, d, eps = rng.standard_normal(4), rng.standard_normal(4), rng.standard_normal(20)
    actions = np.random.default_rng(0).uniform(-3, 3, (5, 2))
    for action in actions:
        np.testing.assert_allclose(observation, C @ s + 3 * D @ d + 0.01 * eps, rtol=1e-5)
        np.testing.assert_allclose(info["signal"], s, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(info["distractor"], d, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(info["goal"], goal, rtol=1e-6)
        assert observation.dtype == np.float32
        observation, reward, _, _, info = env.step(action)
        u = np.clip(action, -2, 2)
        s = A @ s + B @ u + 0.1 * rng.standard_normal(4)
        d = 0.9 * d + 0.3 * rng.standard_normal(4)
        eps = rng.standard_normal(20)
        assert reward == pytest.approx(-(((s - goal) ** 2).sum() + 0.7 * (u**2).sum()))


@pytest.mark.parametrize(
    "action",
    [[math.nan, 0.0], [math.inf, 0.0], [0.0], [[0.0, 0.0]], 0.0],
    ids=["nan", "inf", "short", "matrix", "scalar"],
)
def test_gym_step_refuses_and_keeps_its_state(action):
    env, twin = NoisyTVEnv(), NoisyTVEnv()
    env.reset(seed=0)
    twin.reset(seed=0)
    with pytest.raises(ValueError, match=r"action must be finite with shape \(2,\)"):
        env.step(np.array(action))
    after, expected = env.step(np.ones(2)), twin.step(np.ones(2))
    np.testing.assert_array_equal(after[0], expected[0])
    assert after[1] == expected[1]


def test_step_before_reset_is_refused():
    with pytest.raises(RuntimeError, match="reset"):
        NoisyTVEnv().step(np.zeros(2))
    env = BatchedNoisyTVEnv(2)
    with pytest.raises(RuntimeError, match="reset"):
        env.step(env.rand_action(TensorDict(batch_size=[2])))


@pytest.mark.parametrize("make", [NoisyTVEnv, lambda *a, **k: BatchedNoisyTVEnv(2, *a, **k)])
@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"noise_scale": -1.0}, "noise_scale"),
        ({"noise_scale": math.nan}, "noise_scale"),
        ({"action_cost": -0.1}, "action_cost"),
        ({"action_bound": 0.0}, "action_bound must be positive"),
        ({"action_bound": math.inf}, "action_bound"),
        ({"episode_length": 0}, "episode_length must be at least 1"),
        ({"system": LinearGaussianSystem()}, "control_dim must be at least 1, got 0"),
        ({"system": LinearGaussianSystem(control_dim=2), "system_seed": 0}, "system_seed"),
    ],
)
def test_env_refuses(make, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


def test_torchrl_gym_env_reads_signal_distractor_and_goal():
    check_env_specs(GymEnv(ENV_ID, noise_scale=4.0))
    env = GymEnv(ENV_ID).auto_register_info_dict()
    check_env_specs(env)
    rollout = env.rollout(3)
    assert rollout["next", "signal"].shape == (3, 4)
    reader = default_info_dict_reader(
        ["signal", "distractor", "goal"], spec=[Unbounded((4,)) for _ in range(3)]
    )
    env = GymEnv(ENV_ID)
    env.set_info_dict_reader(reader)
    check_env_specs(env)
    data = env.rollout(3)
    error = data["next", "signal"] - data["next", "goal"]
    cost = error.square().sum(-1) + 0.1 * data["action"].square().sum(-1)
    torch.testing.assert_close(-data["next", "reward"].squeeze(-1), cost)


# ---------------------------------------------------------------- batched environment


def zero_policy(tensordict):
    zeros = torch.zeros(*tensordict.batch_size, 2, device=tensordict.device)
    return tensordict.set("action", zeros)


def proportional_policy(tensordict):
    return tensordict.set("action", -tensordict["observation"][..., :2])


def test_batched_env_passes_the_spec_checker():
    env = BatchedNoisyTVEnv(3, noise_scale=4.0, seed=0)
    check_env_specs(env)
    assert env.batch_size == (3,)
    assert set(env.observation_spec.keys()) == {"observation", "signal", "distractor", "goal"}
    assert env.action_spec.space.low.min() == -2
    assert env.action_spec.space.high.max() == 2
    assert set(env.done_spec.keys()) == {"done", "terminated", "truncated"}
    assert env.reward_spec.shape == (3, 1)


def test_batched_env_makes_the_numbers_of_the_gym_env_over_two_episodes():
    system = LinearGaussianSystem(control_dim=2, seed=6)
    batched = BatchedNoisyTVEnv(3, 8.0, system=system, episode_length=5, seed=40)
    data = batched.rollout(10, proportional_policy, break_when_any_done=False)
    for row in range(3):
        env = NoisyTVEnv(8.0, system=system, episode_length=5)
        for episode in range(2):
            observation, info = env.reset(seed=40 + row if episode == 0 else None)
            for step in range(5):
                now = data[row, 5 * episode + step]
                np.testing.assert_allclose(now["observation"], observation, rtol=1e-4, atol=1e-4)
                for key in ("signal", "distractor", "goal"):
                    np.testing.assert_allclose(now[key], info[key], rtol=1e-4, atol=1e-4)
                # Out of bounds at times: both clip.
                action = now["action"].numpy()
                observation, reward, terminated, truncated, info = env.step(action)
                after = now["next"]
                np.testing.assert_allclose(after["observation"], observation, rtol=1e-4, atol=1e-4)
                assert after["reward"].item() == pytest.approx(reward, rel=1e-4)
                assert after["truncated"].item() == truncated == after["done"].item()
                assert after["terminated"].item() == terminated
    assert data["action"].abs().max() > 2


@pytest.mark.usefixtures("rng_states_untouched")
def test_noise_of_an_episode_does_not_depend_on_the_actions():
    env = BatchedNoisyTVEnv(4, 2.0, system_seed=1, seed=3)
    B, A = env.system.B.float(), env.system.A.float()
    first = env.rollout(20, zero_policy)
    env.set_seed(3)
    second = env.rollout(20, proportional_policy)
    assert torch.equal(first["distractor"], second["distractor"])
    # The signals differ by exactly what the actions did.
    difference = torch.zeros(4, 4)
    for t in range(20):
        action = second["action"][:, t].clamp(-2, 2)
        difference = difference @ A.T + action @ B.T
        actual = second["next", "signal"][:, t] - first["next", "signal"][:, t]
        torch.testing.assert_close(actual, difference, atol=1e-4, rtol=1e-4)


def test_seeds():
    env = BatchedNoisyTVEnv(3, seed=0)
    first, second = env.rollout(4, zero_policy), env.rollout(4, zero_policy)
    assert not torch.equal(first["signal"], second["signal"])
    assert not torch.equal(first["signal"][0], first["signal"][1])
    env.set_seed(0)
    assert (env.rollout(4, zero_policy) == first).all()
    # Row 1 of seed 0 is row 0 of seed 1.
    shifted = BatchedNoisyTVEnv(1, seed=1).rollout(4, zero_policy)
    torch.testing.assert_close(shifted["signal"][0], first["signal"][1])
    unseeded = [BatchedNoisyTVEnv(1).reset()["signal"] for _ in range(2)]
    assert not torch.equal(*unseeded)


def test_partial_reset_starts_only_the_masked_rows_anew():
    env, twin = BatchedNoisyTVEnv(4, seed=0), BatchedNoisyTVEnv(4, seed=0)
    td, expected = env.rollout(5, zero_policy)[:, -1], twin.rollout(8, zero_policy)
    td = td["next"].select("observation", "signal", "distractor", "goal", "done", "terminated")
    mask = torch.tensor([False, True, False, True])
    td = env.reset(td.set("_reset", mask.unsqueeze(-1)))
    second_episode = twin.reset()
    for key in ("observation", "signal", "distractor"):
        assert torch.equal(td[key][~mask], expected["next", key][~mask, 4])
        # Observations are products of matrices, whose last digits may depend on the number of rows.
        torch.testing.assert_close(td[key][mask], second_episode[key][mask])
    after = env.rollout(3, zero_policy, auto_reset=False, tensordict=td)
    assert torch.equal(after["next", "signal"][~mask], expected["next", "signal"][~mask, 5:])
    continued = twin.rollout(3, zero_policy, auto_reset=False, tensordict=second_episode)
    assert torch.equal(after["next", "signal"][mask], continued["next", "signal"][mask])


def test_rows_of_different_length_end_where_they_should():
    """Rows out of phase, run until all are done: finished rows wait and do not move."""
    env = BatchedNoisyTVEnv(2, episode_length=6, seed=0)
    td = env.rollout(2, zero_policy)[:, -1]["next"].exclude("reward")
    td = env.reset(td.set("_reset", torch.tensor([[True], [False]])))
    data = env.rollout(
        20,
        zero_policy,
        auto_reset=False,
        tensordict=td,
        break_when_any_done=False,
        break_when_all_done=True,
    )
    assert data.batch_size == (2, 6)
    done = data["next", "done"].squeeze(-1)
    assert done[0].tolist() == [False] * 5 + [True]
    assert done[1].tolist() == [False] * 3 + [True] * 3
    frozen = data["next", "signal"][1, 3:]
    assert torch.equal(frozen, frozen[:1].expand(3, 4))
    counted = TransformedEnv(BatchedNoisyTVEnv(2, episode_length=6), StepCounter(4))
    assert counted.rollout(9, break_when_any_done=False)["next", "done"].sum() == 4


def test_rows_masked_out_of_a_step_resume_where_they_were():
    env, twin = BatchedNoisyTVEnv(2, seed=0), BatchedNoisyTVEnv(2, seed=0)
    expected = twin.rollout(2, zero_policy)["next", "signal"]
    td = zero_policy(env.reset()).set("_step", torch.tensor([True, False]))
    env.step(td)
    after = env.step(zero_policy(td.select("action")))["next"]
    torch.testing.assert_close(after["signal"][0], expected[0, 1])
    torch.testing.assert_close(after["signal"][1], expected[1, 0])
    ends = BatchedNoisyTVEnv(2, episode_length=2, seed=0)
    td = zero_policy(ends.reset()).set("_step", torch.tensor([True, False]))
    ends.step(td)
    done = ends.step(zero_policy(td.select("action")))["next", "done"]
    assert done.squeeze(-1).tolist() == [True, False]


def test_batched_step_refuses_and_keeps_its_state():
    env, twin = BatchedNoisyTVEnv(2, seed=0), BatchedNoisyTVEnv(2, seed=0)
    td, expected = env.reset(), twin.step(zero_policy(twin.reset()))
    bad = td.clone().set("action", torch.tensor([[0.0, 0.0], [math.nan, 0.0]]))
    with pytest.raises(ValueError, match="action must be finite"):
        env.step(bad)
    with pytest.raises(ValueError, match=r"action must have shape \(2, 2\), got \(2, 1\)"):
        env.step(td.clone().set("action", torch.zeros(2, 1)))
    assert torch.equal(env.step(zero_policy(td))["next", "signal"], expected["next", "signal"])
    short = BatchedNoisyTVEnv(2, episode_length=1, seed=0)
    last = short.step(zero_policy(short.reset()))
    with pytest.raises(RuntimeError, match="done"):
        short.step(zero_policy(last["next"].exclude("reward")))
    with pytest.raises(ValueError, match="num_envs must be at least 1"):
        BatchedNoisyTVEnv(0)
    with pytest.raises(ValueError, match="seed must be at least 0"):
        env.set_seed(-1)


@pytest.mark.parametrize(
    "device",
    [
        "cpu",
        pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")),
    ],
)
def test_moving_takes_the_running_episodes_along(device):
    env, twin = BatchedNoisyTVEnv(2, seed=0), BatchedNoisyTVEnv(2, seed=0)
    td, expected = env.reset(), twin.step(zero_policy(twin.reset()))
    assert td.device is None
    assert env.to(device) is env
    assert env._reset(td.to(device).set("_reset", torch.zeros(2, 1).bool())).device.type == device
    after = env.step(zero_policy(td).to(device))
    assert after["next"].device.type == device
    torch.testing.assert_close(after["next", "signal"].cpu(), expected["next", "signal"])
    created = BatchedNoisyTVEnv(2, seed=0, device=device).rollout(1, zero_policy)
    assert created.device.type == device


def test_a_callers_edit_of_an_output_does_not_reach_the_state():
    env, twin = BatchedNoisyTVEnv(2, seed=0), BatchedNoisyTVEnv(2, seed=0)
    td = env.reset()
    td["signal"].fill_(100.0)
    expected = twin.step(zero_policy(twin.reset()))
    assert torch.equal(env.step(zero_policy(td))["next", "signal"], expected["next", "signal"])


def make_single_env() -> BatchedNoisyTVEnv:
    return BatchedNoisyTVEnv(1, seed=0)


def test_runs_in_a_collector_and_in_a_serial_env():
    env = BatchedNoisyTVEnv(8, episode_length=10, seed=0)
    collector = Collector(env, zero_policy, frames_per_batch=160, total_frames=320)
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    assert [batch.batch_size for batch in batches] == [(8, 20)] * 2
    assert batches[0]["next", "truncated"].sum() == 16
    assert torch.isfinite(batches[1]["next", "reward"]).all()
    serial = SerialEnv(2, make_single_env)
    assert serial.rollout(3)["observation"].shape == (2, 1, 3, 20)
    serial.close()
    assert (pickle.loads(pickle.dumps(make_single_env())).reset() == make_single_env().reset()).all()


# ---------------------------------------------------------------- Kalman filter


def brute_force(system, noise_scale, actions):
    """Mean and covariance of all signals and observations, ``s_0, x_0, s_1, ...``, stacked.

    A trajectory is affine in its noise: column j of the map is the response to unit noise j.
    """
    num_steps = len(actions) + 1
    size = num_steps * system.noise_dim
    basis = torch.eye(size, dtype=torch.float64).view(size, num_steps, system.noise_dim)
    padded = torch.cat([actions, torch.zeros(1, system.control_dim)]).double()

    def stacked(noise, u):
        data = system.unroll(noise, noise_scale, u)
        return torch.cat([data["signal"], data["observation"]], -1)

    response = stacked(basis, None).reshape(size, -1)
    mean = stacked(torch.zeros(num_steps, system.noise_dim).double(), padded).reshape(-1)
    return mean, response.T @ response


@pytest.mark.parametrize("noise_scale", [0.0, 8.0])
def test_kalman_filter_equals_conditioning_the_joint_gaussian(noise_scale):
    system = small_system(sensor_std=0.3)
    generator = torch.Generator().manual_seed(0)
    actions = torch.randn(2, 5, 1, generator=generator, dtype=torch.float64)
    data = system.simulate(5, noise_scale, actions, batch_size=(2,), seed=1, dtype=torch.float64)
    belief = KalmanFilter(system, noise_scale).filter(data["observation"], actions)
    assert belief.batch_size == (2, 5)
    for row in range(2):
        # Six steps: one more than observed, for the prediction.
        mean, cov = brute_force(system, noise_scale, actions[row])
        place = torch.arange(6 * 10).view(6, 10)
        x_all = data["observation"][row]
        for t in range(5):
            seen = place[: t + 1, 3:].reshape(-1)
            x = x_all[: t + 1].reshape(-1)
            for key, hidden in (("signal", place[t, :3]), ("next_signal", place[t + 1, :3])):
                gain = torch.linalg.solve(cov[seen][:, seen], cov[seen][:, hidden]).T
                expected = mean[hidden] + gain @ (x - mean[seen])
                expected_cov = cov[hidden][:, hidden] - gain @ cov[seen][:, hidden]
                torch.testing.assert_close(belief[f"{key}_mean"][row, t], expected)
                torch.testing.assert_close(belief[f"{key}_cov"][row, t], expected_cov)
            evidence = MultivariateNormal(mean[seen], cov[seen][:, seen]).log_prob(x)
            torch.testing.assert_close(belief["log_evidence"][row, : t + 1].sum(), evidence)


def test_kalman_covariance_is_the_error_that_is_made():
    system, num = LinearGaussianSystem(sensor_std=0.5), 4000
    data = system.simulate(15, 4.0, batch_size=(num,), seed=0, dtype=torch.float64)
    belief = KalmanFilter(system, 4.0).filter(data["observation"])
    for t in (0, 3, 14):
        error = data["signal"][:, t] - belief["signal_mean"][:, t]
        whitened = torch.linalg.solve(belief["signal_cov"][0, t], error.T).T
        # Chi-squared with 4 degrees of freedom: mean 4, variance 8.
        assert abs((error * whitened).sum(-1).mean() - 4) < 5 * math.sqrt(8 / num)
    ahead = data["signal"][:, 1:] - belief["next_signal_mean"][:, :-1]
    expected = belief["next_signal_cov"][0, :-1].diagonal(dim1=-2, dim2=-1).sum(-1)
    squared = ahead.square().sum(-1)
    assert ((squared.mean(0) - expected).abs() < 5 * squared.std(0) / math.sqrt(num)).all()


def test_kalman_half_steps_equal_the_filter_beyond_convergence():
    system = small_system(sensor_std=0.2)
    kalman = KalmanFilter(system, 2.0)
    num_steps = len(kalman.gain) + 20
    actions = torch.ones(num_steps, 1, dtype=torch.float64)
    data = system.simulate(num_steps, 2.0, actions, seed=0, dtype=torch.float64)
    belief = kalman.filter(data["observation"], actions)
    # A plain filter that never stops its covariance.
    F, H, P, m = kalman.F, kalman.H, torch.eye(5).double(), torch.zeros(5).double()
    for t in range(num_steps):
        K = P @ H.T @ torch.linalg.inv(H @ P @ H.T + 0.04 * torch.eye(7).double())
        m = m + K @ (data["observation"][t] - H @ m)
        torch.testing.assert_close(belief["signal_mean"][t], m[:3], atol=1e-9, rtol=1e-9)
        torch.testing.assert_close(belief["distractor_mean"][t], m[3:], atol=1e-9, rtol=1e-9)
        P = F @ (P - K @ H @ P) @ F.T + kalman.process_covariance
        m = F @ m + kalman.G[:, 0]
    mean = torch.zeros(5).double()
    for t in range(num_steps):
        mean = kalman.update(mean, data["observation"][t], torch.tensor(t))
        torch.testing.assert_close(mean[:3], belief["signal_mean"][t])
        mean = kalman.predict(mean, actions[t])
    torch.testing.assert_close(mean[:3], belief["next_signal_mean"][-1])


def test_kalman_filter_refuses(monkeypatch):
    monkeypatch.setattr("torchrl_vjepa.noisy_tv.oracle._MAX_SCHEDULE", 500)
    with pytest.raises(ValueError, match="sensor_std must be positive"):
        KalmanFilter(small_system(sensor_std=0.0), 1.0)
    with pytest.raises(ValueError, match="noise_scale"):
        KalmanFilter(small_system(), -1.0)
    # Nothing is seen of a distractor at scale 0: a random walk of it grows for ever.
    with pytest.raises(ValueError, match="neither decays nor shows"):
        KalmanFilter(LinearGaussianSystem(1, 1, 1, distractor_decay=1.0), 0.0)
    kalman = KalmanFilter(small_system(), 1.0)
    for observations, actions, message in (
        (torch.zeros(4, 6), None, "observations must have shape"),
        (torch.zeros(7), None, "observations must have shape"),
        (torch.zeros(0, 7), None, "observations must have shape"),
        (torch.full((4, 7), math.nan), None, "observations must be finite"),
        (torch.zeros(4, 7), torch.zeros(3, 1), "actions must have shape"),
        (torch.zeros(4, 7), torch.full((4, 1), math.inf), "actions must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            kalman.filter(observations, actions)


# ---------------------------------------------------------------- LQR and LQG


@pytest.mark.parametrize(("seed", "action_cost"), [(0, 0.1), (3, 0.1), (1, 2.0)])
def test_lqr_equals_a_long_quadratic_programme(seed, action_cost):
    """All actions of a long horizon at once, by least squares: the first is the regulator's."""
    system, horizon = LinearGaussianSystem(control_dim=2, seed=seed), 120
    A, B, g = system.A, system.B, system.goal
    powers = [torch.eye(4).double()]
    for _ in range(horizon):
        powers.append(A @ powers[-1])
    response = torch.zeros(horizon, 4, horizon, 2).double()
    for t in range(horizon):
        for j in range(t + 1):
            response[t, :, j] = powers[t - j] @ B
    response = response.reshape(4 * horizon, 2 * horizon)
    design = torch.cat([response, math.sqrt(action_cost) * torch.eye(2 * horizon)])
    solution = solve_lqr(system, action_cost)
    for s in torch.cat([torch.zeros(1, 4), torch.eye(4)]).double():
        free = torch.cat([powers[t + 1] @ s - g for t in range(horizon)])
        target = torch.cat([-free, torch.zeros(2 * horizon)])
        actions = torch.linalg.lstsq(design, target.unsqueeze(-1)).solution.view(horizon, 2)
        expected = solution.feedforward - solution.gain @ s
        torch.testing.assert_close(actions[0], expected, atol=1e-8, rtol=1e-8)


def average_cost(system, gain, feedforward, action_cost, noise_covariance):
    """Long-run cost of ``u = k - K s`` by Lyapunov's equation: no Riccati equation in it."""
    closed = system.A - system.B @ gain
    cov = torch.from_numpy(solve_discrete_lyapunov(closed.numpy(), noise_covariance.numpy()))
    mean = torch.linalg.solve(torch.eye(4) - closed, system.B @ feedforward)
    control = feedforward - gain @ mean
    return (
        (mean - system.goal).square().sum()
        + cov.trace()
        + action_cost * (control.square().sum() + (gain @ cov @ gain.T).trace())
    ).item()


def test_no_other_gain_is_cheaper():
    system = LinearGaussianSystem(control_dim=2, seed=1)
    solution = solve_lqr(system)
    W = 0.01 * torch.eye(4).double()

    def cost(gain, feedforward):
        return average_cost(system, gain, feedforward, 0.1, W)

    best = cost(solution.gain, solution.feedforward)
    assert best == pytest.approx(solution.cost, rel=1e-10)
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        dK = torch.randn(2, 4, generator=generator, dtype=torch.float64)
        dk = torch.randn(2, generator=generator, dtype=torch.float64)
        up = cost(solution.gain + 1e-4 * dK, solution.feedforward + 1e-4 * dk)
        down = cost(solution.gain - 1e-4 * dK, solution.feedforward - 1e-4 * dk)
        # A minimum: both sides dearer, by the curvature alone, so the slope vanishes.
        assert up > best
        assert down > best
        assert abs(up - down) < 1e-2 * (up + down - 2 * best) + 1e-12


def test_value_function_solves_bellmans_equation():
    """V(s) + J = |s - g|^2 + min_u (lambda |u|^2 + E V(A s + B u + w)), up to a constant in V."""
    system = LinearGaussianSystem(control_dim=2, seed=4)
    K, k, P, p, cost = solve_lqr(system, 0.3)

    def value(s):
        return s @ P @ s - 2 * p @ s

    for s in torch.randn(5, 4, generator=torch.Generator().manual_seed(0)).double():
        u = k - K @ s
        after = value(system.A @ s + system.B @ u) + 0.01 * P.trace()
        right = (s - system.goal).square().sum() + 0.3 * u.square().sum() + after
        torch.testing.assert_close(value(s) + cost, right)


@pytest.mark.parametrize("noise_scale", [0.0, 8.0])
def test_expected_cost_is_the_simulated_average(noise_scale):
    """Blurred sensors, so that the estimation error is a visible part of the cost."""
    system = LinearGaussianSystem(control_dim=2, seed=2, sensor_std=0.5)
    env = BatchedNoisyTVEnv(2000, noise_scale, system=system, action_bound=1e3, episode_length=60, seed=0)
    controller = LQGController(system, noise_scale, action_bound=math.inf)
    env = TransformedEnv(env, get_env_transforms_from_module(controller))
    cost = -env.rollout(60, controller)["next", "reward"].mean(1)
    expected = controller.expected_cost(60)
    assert abs(cost.mean() - expected) < 4 * cost.std() / math.sqrt(2000)
    # The estimation error must matter, else the test shows nothing about it.
    assert expected - controller.solution.cost > 20 * cost.std() / math.sqrt(2000)
    assert controller.expected_cost(3000) == pytest.approx(controller.expected_cost(), rel=2e-3)


def test_expected_cost_limit_is_that_of_the_joint_lyapunov_equation():
    """State and estimate as one linear system: another way to the same number."""
    system = LinearGaussianSystem(control_dim=2, seed=2, sensor_std=0.5)
    controller = LQGController(system, 3.0)
    kalman, K, k = controller.kalman, controller.gain, controller.feedforward
    F, G, H, L = kalman.F, kalman.G, kalman.H, kalman.gain[-1]
    K_z = torch.cat([K, torch.zeros(2, 4)], dim=1)
    # (z, m) with m the filtered mean: z' = F z + G u + n, m' = F m + G u + L (x' - H (F m + G u))
    top = torch.cat([F, -G @ K_z], dim=1)
    bottom = torch.cat([L @ H @ F, F - G @ K_z - L @ H @ F], dim=1)
    closed = torch.cat([top, bottom])
    n, eps = torch.cat([torch.eye(8), L @ H]), torch.cat([torch.zeros(8, 20), L])
    Q = n @ kalman.process_covariance @ n.T + 0.25 * eps @ eps.T
    cov = torch.from_numpy(solve_discrete_lyapunov(closed.numpy(), Q.numpy()))
    drive = torch.cat([G, G]) @ k
    mean = torch.linalg.solve(torch.eye(16) - closed, drive)
    K_m = torch.cat([torch.zeros(2, 8), K_z], dim=1)
    expected = (
        (mean[:4] - system.goal).square().sum()
        + cov[:4, :4].trace()
        + 0.1 * ((k - K_m @ mean).square().sum() + (K_m @ cov @ K_m.T).trace())
    )
    assert controller.expected_cost() == pytest.approx(expected.item(), rel=1e-9)


def test_lqg_ignores_the_distractor_and_other_gains_cost_more():
    """Same episodes: scale 0 and 8 cost the same to 1 %; gains off by 30 % are dearer in each."""

    def cost(noise_scale, factor=1.0):
        env = BatchedNoisyTVEnv(64, noise_scale, system_seed=0, seed=0)
        controller = LQGController(env.system, noise_scale)
        controller.gain.mul_(factor)
        env = TransformedEnv(env, get_env_transforms_from_module(controller))
        data = env.rollout(200, controller)
        assert (data["action"].abs() >= 2).float().mean() < 0.005
        return -data["next", "reward"].mean(1)

    exact = cost(8.0)
    torch.testing.assert_close(cost(0.0).mean(), exact.mean(), rtol=0.01, atol=0)
    for factor in (0.7, 1.3):
        difference = cost(8.0, factor) - exact
        assert difference.mean() > 5 * difference.std() / 8


def test_controller_is_the_filter_and_the_regulator_step_by_step():
    env = BatchedNoisyTVEnv(3, 8.0, episode_length=7, seed=0)
    controller = pickle.loads(pickle.dumps(LQGController(env.system, 8.0)))
    env = TransformedEnv(env, get_env_transforms_from_module(controller))
    check_env_specs(env)
    # Two episodes: the memory must start anew at the eighth step.
    data = env.rollout(14, controller, break_when_any_done=False)
    assert data["lqg_time"].squeeze(-1).tolist() == [[*range(7), *range(7)]] * 3
    for episode in (data[:, :7], data[:, 7:]):
        belief = controller.kalman.filter(episode["observation"], episode["action"])
        solution = controller.solution
        action = solution.feedforward - belief["signal_mean"] @ solution.gain.T
        torch.testing.assert_close(episode["action"], action.clamp(-2, 2).float(), atol=1e-4, rtol=1e-4)


def test_controller_restarts_only_the_rows_that_are_reset():
    base = BatchedNoisyTVEnv(2, 8.0, seed=0)
    controller = LQGController(base.system, 8.0)
    env = TransformedEnv(base, get_env_transforms_from_module(controller))
    td = env.rollout(4, controller)[:, -1]
    td = env.step_mdp(td)
    td = env.reset(td.set("_reset", torch.tensor([[False], [True]])))
    assert td["is_init"].squeeze(-1).tolist() == [False, True]
    out = controller(td.clone())
    assert out["next", "lqg_time"].squeeze(-1).tolist() == [5, 1]
    # is_init alone restarts too, whatever the memory holds.
    stale = td.clone()
    stale["lqg_belief"][1] = 7.0
    stale["lqg_time"][1] = 9
    fresh = controller(stale)
    assert torch.equal(fresh["action"], out["action"])
    assert torch.equal(fresh["next", "lqg_time"], out["next", "lqg_time"])


def test_controller_acts_in_a_collector_and_in_a_gym_env():
    env = BatchedNoisyTVEnv(4, 8.0, seed=0)
    controller = LQGController(env.system, 8.0)
    collector = Collector(
        TransformedEnv(env, get_env_transforms_from_module(controller)),
        controller,
        frames_per_batch=400,
        total_frames=400,
    )
    (batch,) = list(collector)
    collector.shutdown()
    expected = controller.expected_cost(100)
    assert -batch["next", "reward"].mean() == pytest.approx(expected, rel=0.3)
    gym_env = TransformedEnv(GymEnv(ENV_ID), get_env_transforms_from_module(controller))
    gym_env.set_seed(0)
    data = gym_env.rollout(200, controller)
    assert data["lqg_time"][-1].item() == 199
    assert -data["next", "reward"].mean() == pytest.approx(controller.expected_cost(200), rel=0.3)


def test_controller_keys_can_be_renamed():
    system = small_system()
    keys = {
        "observation_key": ("agent", "x"),
        "action_key": ("agent", "u"),
        "belief_key": ("agent", "m"),
        "time_key": ("agent", "t"),
        "is_init_key": ("agent", "first"),
    }
    controller = LQGController(system, 1.0, **keys)
    td = TensorDict(
        {
            "agent": {
                "x": torch.ones(2, 7),
                "m": torch.zeros(2, 5).double(),
                "t": torch.zeros(2, 1, dtype=torch.int64),
                "first": torch.ones(2, 1, dtype=torch.bool),
            }
        },
        batch_size=[2],
    )
    out = controller(td)
    assert out["agent", "u"].shape == (2, 1)
    assert out["next", "agent", "m"].shape == (2, 5)
    assert controller.out_keys == [("agent", "u"), ("next", "agent", "m"), ("next", "agent", "t")]


def test_lqg_refuses(monkeypatch):
    system = LinearGaussianSystem(control_dim=2)
    with pytest.raises(ValueError, match="control_dim must be at least 1"):
        solve_lqr(LinearGaussianSystem())
    for action_cost in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="action_cost must be"):
            solve_lqr(system, action_cost)
    with pytest.raises(ValueError, match="stabilis"):
        solve_lqr(LinearGaussianSystem(control_dim=1, A=2 * np.eye(4), B=np.eye(4)[:, :1]))
    for bound in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="action_bound must be positive"):
            LQGController(system, 1.0, action_bound=bound)
    with pytest.raises(ValueError, match="noise_scale"):
        LQGController(system, -1.0)
    controller = LQGController(system, 1.0)
    with pytest.raises(ValueError, match="num_steps"):
        controller.expected_cost(0)
    with pytest.raises(KeyError, match="get_env_transforms_from_module"):
        controller(TensorDict({"observation": torch.zeros(2, 20)}, batch_size=[2]))
    env = BatchedNoisyTVEnv(2, seed=0)
    td = TransformedEnv(env, InitTracker(), auto_unwrap=False).reset()
    with pytest.raises(KeyError, match="lqg_belief"):
        controller(td)
    td = TransformedEnv(env, get_env_transforms_from_module(controller)).reset()
    for bad in (torch.full((2, 20), math.nan), torch.zeros(2, 19)):
        with pytest.raises(ValueError, match="observation must be finite with last size 20"):
            controller(td.clone().set("observation", bad))
    monkeypatch.setitem(sys.modules, "scipy.linalg", None)
    with pytest.raises(ImportError, match=r"torchrl-vjepa\[examples\]"):
        solve_lqr(system)
