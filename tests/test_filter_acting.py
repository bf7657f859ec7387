"""The particle filter between encoder and planner: memory, executed actions, resets, planning."""

from __future__ import annotations

import math
import pickle
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torch.distributions import Distribution, Independent, LogNormal
from torchrl.collectors import Collector
from torchrl.data import Bounded, Categorical, Composite, MultiCategorical, OneHot, TensorSpec
from torchrl.envs import (
    ActionScaling,
    EnvBase,
    GymEnv,
    InitTracker,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type
from torchrl.modules import AdditiveGaussianModule, CEMPlanner, get_env_transforms_from_module

from torchrl_vjepa.actions import ActionCodec
from torchrl_vjepa.belief import LinearObservation, ParticleBelief, ParticleFilter, PseudoLikelihood
from torchrl_vjepa.costs import quadratic_cost
from torchrl_vjepa.distributions import Delta, diag_gaussian
from torchrl_vjepa.encoders import linear_encoder
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.heads import DiagGaussianHead
from torchrl_vjepa.models import VJEPA
from torchrl_vjepa.noisy_tv import BatchedNoisyTVEnv, KalmanFilter, LQGController
from torchrl_vjepa.planners import CEM, MPPI
from torchrl_vjepa.predictor import Predictor

K, D, HORIZON = 6, 4, 3
BELIEF = ("next", "belief")


class Target:
    """q(z | latent): wide, so that no belief degenerates."""

    def __call__(self, latent: Tensor) -> Distribution:
        return diag_gaussian(latent, torch.full_like(latent[..., :1], 3.0))


def make_filter(model: VJEPA, **kwargs: Any) -> ParticleFilter:
    return ParticleFilter(
        model,
        PseudoLikelihood(Target()),
        num_particles=K,
        observation_key="latent",
        latent_key="belief_mean",
        **kwargs,
    )


def make_policy(**kwargs: Any) -> TensorDictSequential:
    """Encoder, filter and planner for Pendulum-v1, as they are before any training."""
    torch.manual_seed(0)
    model = VJEPA(linear_encoder(3, D), Predictor(D, action_dim=1))
    world = LatentEnv(
        model,
        action_spec=Bounded(-2, 2, (1,)),
        cost=quadratic_cost(torch.ones(D)),
        how="sample",
        num_samples=3,
        belief_key=BELIEF,
    )
    planner = MPPI(world, HORIZON, 2, 32, 8, seed=0)
    return TensorDictSequential(model.encoder, make_filter(model, **kwargs), planner)


def make_env(max_steps: int = 4) -> EnvBase:
    return TransformedEnv(GymEnv("Pendulum-v1"), StepCounter(max_steps))


def prepared(env: EnvBase, policy: Any) -> TransformedEnv:
    return TransformedEnv(env, get_env_transforms_from_module(policy), auto_unwrap=True)


def check_memory(data: TensorDictBase) -> None:
    """Time last: beliefs and executed actions travel, and begin anew where an episode begins."""
    is_init = data["is_init"].squeeze(-1)
    for name in ("particles", "log_weights", "action"):
        here = data["belief", name]
        assert not here[is_init].any(), name
        before = data["next", "belief", name].unbind(is_init.ndim - 1)[:-1]
        following = here.unbind(is_init.ndim - 1)[1:]
        for t, (old, new) in enumerate(zip(before, following, strict=True)):
            carried = ~is_init[..., t + 1]
            assert torch.equal(old[carried], new[carried]), name
    torch.testing.assert_close(data["next", "belief", "action"], data["action"])
    weights = data["next", "belief", "log_weights"].exp()
    torch.testing.assert_close(weights.sum(-1), torch.ones(data.shape))


def check_against_tensors(data: TensorDictBase, policy: TensorDictSequential, seed: int) -> None:
    """What the module did equals :meth:`start` and :meth:`step`, one row, from the same random state."""
    run = policy[1]
    torch.manual_seed(seed)
    belief, action = None, None
    for step in data.unbind(-1):
        if bool(step["is_init"]):
            belief, _ = run.start(step["latent"])
        else:
            belief, _ = run.step(belief, action, step["latent"])
        torch.testing.assert_close(step["next", "belief", "particles"], belief.particles)
        torch.testing.assert_close(step["belief_mean"], belief.mean)
        action = step["action"]


def test_rollout_with_resets() -> None:
    policy = make_policy()
    env = prepared(make_env(4), policy)
    check_env_specs(env)
    td = env.reset()
    torch.manual_seed(3)
    data = env.rollout(10, policy, tensordict=td, auto_reset=False, break_when_any_done=False)
    check_memory(data)
    assert data["is_init"].squeeze(-1).nonzero().flatten().tolist() == [0, 4, 8]
    with torch.no_grad():
        check_against_tensors(data, policy, 3)


class Uneven(BatchedNoisyTVEnv):
    """A noisy TV whose rows end one after the other."""

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = super()._step(tensordict)
        ends = (self._time % (3 + self._rows) == 0).unsqueeze(-1)
        return out.set("truncated", ends).set("done", ends.clone())


def test_partial_resets_in_a_collector() -> None:
    torch.manual_seed(0)
    model = VJEPA(linear_encoder(20, D), Predictor(D, action_dim=2))
    world = LatentEnv(
        model,
        action_spec=Bounded(-2, 2, (2,)),
        cost=quadratic_cost(torch.ones(D)),
        how="sample",
        num_samples=2,
        belief_key=BELIEF,
    )
    policy = TensorDictSequential(model.encoder, make_filter(model), MPPI(world, HORIZON, 1, 8, 2, seed=0))
    env = prepared(Uneven(4, noise_scale=1.0, seed=0), policy)
    collector = Collector(env, policy, frames_per_batch=40, total_frames=80)
    for data in collector:
        assert data.shape == (4, 10)
        check_memory(data)
        starts = data["is_init"].squeeze(-1).sum(-1)
        assert len(set(starts.tolist())) > 1  # rows were reset at different times
        fresh = data["is_init"].squeeze(-1)
        # A first belief is drawn around the prior, not moved from the zeros of the primer.
        assert (data["next", "belief", "particles"][fresh].std(-2) > 0.05).all()
    collector.shutdown()


def test_batched_environments() -> None:
    policy = make_policy()
    env = prepared(SerialEnv(2, make_env), policy)
    check_memory(env.rollout(6, policy, break_when_any_done=False))
    env.close(raise_if_closed=False)


def test_the_executed_action_is_carried_not_the_planned_one() -> None:
    """Exploration noise comes after the planner, scaling of actions below it."""
    policy = make_policy()
    noisy = TensorDictSequential(
        *policy, AdditiveGaussianModule(spec=Bounded(-2, 2, (1,)), sigma_init=1.0, sigma_end=1.0)
    )
    env = make_env(9)
    env.append_transform(ActionScaling(loc=torch.zeros(1), scale=torch.full((1,), 0.5)))
    env = prepared(env, policy)
    with set_exploration_type(ExplorationType.RANDOM):
        data = env.rollout(4, noisy)
    check_memory(data)
    planned = data["next", "plan"]
    assert planned.shape == (4, HORIZON, 1)


def test_a_policy_pickles_with_its_transforms() -> None:
    policy = make_policy(generator=torch.Generator().manual_seed(1))
    transforms = get_env_transforms_from_module(policy)
    again, others = pickle.loads(pickle.dumps((policy, transforms)))
    td = TensorDict(observation=torch.randn(2, 3), batch_size=[2])
    one, other = policy(td.clone()), again(td.clone())
    torch.testing.assert_close(one["action"], other["action"])
    primer = make_policy()[1].make_tensordict_primer()
    again = pickle.loads(pickle.dumps(primer))
    assert again.executed_keys == ["action"]
    assert len(list(others)) == len(list(transforms))


def test_without_the_transforms_every_step_starts_anew() -> None:
    policy = make_policy()
    data = make_env().rollout(3, policy)
    assert "belief" not in data
    assert data["action"].isfinite().all()


def test_missing_entries_are_named() -> None:
    run = make_policy()[1]
    with pytest.raises(KeyError, match="ParticleFilter needs the entry 'latent'"):
        run(TensorDict(observation=torch.zeros(3)))
    belief = TensorDict(particles=torch.zeros(K, D), log_weights=torch.zeros(K))
    with pytest.raises(KeyError, match="is_init.*get_env_transforms_from_module"):
        run(TensorDict(latent=torch.zeros(D), belief=belief))


def test_keys_can_be_renamed() -> None:
    model = VJEPA(linear_encoder(3, D), Predictor(D, action_dim=1))
    run = ParticleFilter(
        model,
        PseudoLikelihood(Target()),
        num_particles=K,
        observation_key=("agent", "z"),
        latent_key=("agent", "mean"),
        action_key=("agent", "u"),
        belief_key=("agent", "b"),
        init_key="first",
        return_stats=True,
    )
    assert run.in_keys[1:] == [*(("agent", "b", n) for n in ("particles", "log_weights", "action")), "first"]
    out = run(TensorDict(agent=TensorDict(z=torch.zeros(2, D), batch_size=[2]), batch_size=[2]))
    assert out["agent", "mean"].shape == (2, D)
    assert out["next", "agent", "b", "particles"].shape == (2, K, D)
    assert out["belief_stats", "log_evidence"].shape == (2,)
    assert (out["belief_stats", "effective_sample_size"] > 1).all()
    assert run.make_tensordict_primer().executed_keys == [("agent", "u")]


def test_rows_start_by_themselves() -> None:
    """Where ``is_init`` is set the memory is not read; elsewhere it is."""
    predictor = Predictor(D, action_dim=1, head=DiagGaussianHead("constant"))
    run = make_filter(VJEPA(linear_encoder(3, D), predictor))
    memory = TensorDict(
        particles=torch.full((3, K, D), 50.0), log_weights=torch.zeros(3, K), action=torch.zeros(3, 1)
    )
    memory["particles"][1] = math.nan  # what an ended episode left behind does not matter
    td = TensorDict(
        latent=torch.zeros(3, D),
        belief=memory,
        is_init=torch.tensor([[False], [True], [True]]),
        batch_size=[3],
    )
    with torch.no_grad():
        expected = predictor.dist(torch.full((1, D), 50.0), torch.zeros(1, 1)).mean
    out = run(td)["next", "belief", "particles"]
    assert (out[0] - expected).abs().max() < 6
    assert out[1:].abs().max() < 6
    assert out[1:].std(1).min() > 0.1


def test_weights_are_carried_past_the_reset_of_another_row() -> None:
    predictor = Predictor(D, action_dim=1, head=DiagGaussianHead("constant"))
    run = make_filter(VJEPA(linear_encoder(3, D), predictor), resample_threshold=0.0)
    log_weights = torch.full((2, K), -math.inf)
    log_weights[:, 2] = 0.0
    memory = TensorDict(particles=torch.zeros(2, K, D), log_weights=log_weights, action=torch.zeros(2, 1))
    is_init = torch.tensor([[True], [False]])
    td = TensorDict(latent=torch.zeros(2, D), belief=memory, is_init=is_init, batch_size=[2])
    out = run(td)["next", "belief", "log_weights"]
    assert out[0].isfinite().all()
    assert torch.equal(out[1], log_weights[1])


def test_the_filter_steers_the_noisy_tv() -> None:
    """Kalman filter against particles with the true model: the same controller, nearly the same cost."""
    noise_scale = 1.0
    env = BatchedNoisyTVEnv(8, noise_scale, seed=0, episode_length=40)
    system = env.system
    kalman = KalmanFilter(system, noise_scale)
    std = kalman.process_covariance.diagonal().sqrt()
    sensor = LinearObservation(kalman.H, system.sensor_std)

    def transition(latent: Tensor, action: Tensor) -> Distribution:
        return diag_gaussian(latent @ kalman.F.mT + action @ kalman.G.mT, std)

    run = ParticleFilter(
        transition,
        sensor,
        num_particles=500,
        proposal=sensor.condition,
        latent_dim=8,
        action_dim=2,
        dtype=torch.float64,
    )
    solution = LQGController(system, noise_scale).solution

    def control(td: TensorDictBase) -> TensorDictBase:
        action = solution.feedforward - td["latent"][..., :4] @ solution.gain.mT
        return td.set("action", action.float().clamp(-2, 2))

    policy = TensorDictSequential(run)
    env = prepared(env, policy)
    data = env.rollout(40, lambda td: control(policy(td)))
    signal_error = (data["latent"][..., :4] - data["signal"]).square().mean()
    exact = kalman.filter(data["observation"], data["action"])["signal_mean"]
    kalman_error = (exact - data["signal"]).square().mean()
    assert signal_error < 1.05 * kalman_error
    again = TransformedEnv(BatchedNoisyTVEnv(8, noise_scale, seed=0, episode_length=40), InitTracker())
    controller = LQGController(system, noise_scale)
    for transform in get_env_transforms_from_module(controller):
        again.append_transform(transform)
    best = -again.rollout(40, controller)["next", "reward"].mean()
    assert -data["next", "reward"].mean() < 1.02 * best


# --- planning from a belief


def push(latent: Tensor, action: Tensor) -> Delta:
    return Delta(latent + action)


def world(**kwargs: Any) -> LatentEnv:
    return LatentEnv(
        push,
        action_spec=Bounded(-1, 1, (1,)),
        cost=lambda z, u: z.squeeze(-1).square(),
        latent_dim=1,
        belief_key="belief",
        **kwargs,
    )


def test_cost_of_a_belief_is_the_mean_over_its_particles() -> None:
    env = world(num_samples=4)
    particles = torch.tensor([[-1.0], [0.0], [1.0], [3.0]])
    belief = ParticleBelief(particles, torch.tensor([0.25, 0.5, 0.0, 0.25]).log())
    td = TensorDict(belief=TensorDict(particles=particles, log_weights=belief.log_weights))
    state = env.planning_state(td)
    plans = torch.tensor([[[0.0]], [[-0.5]], [[1.0]]])
    expected = (0.25 * (-1 + plans) ** 2 + 0.5 * plans**2 + 0.25 * (3 + plans) ** 2).flatten()
    torch.testing.assert_close(env.objective(state, plans), expected)
    worst = world(num_samples=4, how="sample", risk=lambda costs: costs.amax(0))
    torch.testing.assert_close(worst.objective(state, plans), torch.tensor([9.0, 6.25, 16.0]))
    with pytest.raises(ValueError, match="how must be 'sample' for a risk or a constraint"):
        world(num_samples=4, risk=lambda costs: costs.amax(0))
    for weights in (torch.full((4,), math.nan), torch.full((4,), -math.inf)):
        bad = TensorDict(belief=TensorDict(particles=particles, log_weights=weights))
        with pytest.raises(ValueError, match="some weight in every row"):
            env.planning_state(bad)


def test_what_follows_a_particle_is_the_point_that_was_asked_for() -> None:
    def skewed(latent: Tensor, action: Tensor) -> Distribution:
        return Independent(LogNormal(latent + action, torch.ones_like(latent)), 1)

    state = TensorDict(particles=torch.tensor([[0.0]]), log_weights=torch.zeros(1))
    for how, expected in (("mean", 1.0), ("mode", -2.0)):  # squared: exp(2 mean), exp(2 mode)
        env = LatentEnv(
            skewed,
            action_spec=Bounded(-1, 1, (1,)),
            cost=lambda z, u: z.squeeze(-1).square(),
            latent_dim=1,
            how=how,
            belief_key="belief",
        )
        cost = env.objective(state, torch.zeros(1, 1, 1))
        torch.testing.assert_close(cost, torch.tensor([expected]).exp())


def test_candidates_and_rows_share_their_particles() -> None:
    env = world(num_samples=3)
    particles, log_weights = torch.randn(2, 50, 1), torch.randn(2, 50)
    state = TensorDict(particles=particles, log_weights=log_weights, batch_size=[2])
    plans = torch.zeros(2, 5, 2, 1)
    generator = torch.Generator()
    costs = env.objective(state, plans, generator=generator.manual_seed(0))
    assert (costs == costs[:, :1]).all()
    for row in range(2):
        alone = env.objective(state[row], plans[row], generator=generator.manual_seed(0))
        torch.testing.assert_close(alone, costs[row])
    assert not torch.equal(env.objective(state, plans, generator=generator), costs)


@pytest.mark.parametrize("how", ["mean", "sample"])
def test_planning_sees_that_the_belief_is_wide(how: Any) -> None:
    """Two particles, a wall between: the mean is told to stay, the belief is told to move."""

    def cost(latent: Tensor, action: Tensor) -> Tensor:
        return ((latent.squeeze(-1) - 1.0).abs() < 0.2).float() * 10 + action.squeeze(-1).square()

    env = LatentEnv(
        push,
        action_spec=Bounded(-1, 1, (1,)),
        cost=cost,
        how=how,
        num_samples=8,
        latent_dim=1,
        belief_key="belief",
    )
    assert env.planning_keys == [("belief", "particles"), ("belief", "log_weights")]
    belief = TensorDict(particles=torch.tensor([[-1.0], [1.0]]), log_weights=torch.zeros(2))
    planner = CEM(env, 1, 6, 256, 32, seed=0, output="best")
    assert ("belief", "particles") in planner.in_keys
    action = planner(TensorDict(latent=torch.zeros(1), belief=belief))["action"]
    assert 0.2 <= abs(float(action)) < 0.4
    point = LatentEnv(push, action_spec=Bounded(-1, 1, (1,)), cost=cost, latent_dim=1)
    action = CEM(point, 1, 6, 256, 32, seed=0, output="best")(TensorDict(latent=torch.zeros(1)))["action"]
    assert abs(float(action)) < 0.05


def test_torchrl_planners_start_from_the_mean() -> None:
    """A planner that knows no beliefs reads the latent, which the filter writes."""
    torch.manual_seed(0)
    model = VJEPA(linear_encoder(3, D), Predictor(D, action_dim=1))
    env = LatentEnv(model, action_spec=Bounded(-2, 2, (1,)), cost=quadratic_cost(torch.ones(D)))
    run = ParticleFilter(model, PseudoLikelihood(Target()), num_particles=K, observation_key="latent")
    policy = TensorDictSequential(model.encoder, run, CEMPlanner(env, HORIZON, 2, 16, 4))
    out = policy(TensorDict(observation=torch.randn(2, 3), batch_size=[2]))
    weights = out["next", "belief", "log_weights"].exp().unsqueeze(-1)
    torch.testing.assert_close(out["latent"], (weights * out["next", "belief", "particles"]).sum(-2))
    assert out["action"].shape == (2, 1)


def test_bad_beliefs_are_refused() -> None:
    env = world()
    with pytest.raises(KeyError, match="planning needs the entries .*particles.*put the particle filter in"):
        env.planning_state(TensorDict(latent=torch.zeros(1)))
    belief = TensorDict(particles=torch.zeros(4, 2), log_weights=torch.zeros(4))
    with pytest.raises(ValueError, match=r"must have shape \(\*B, K, 1\), got \(4, 2\)"):
        env.planning_state(TensorDict(belief=belief))
    state = TensorDict(particles=torch.zeros(3, 4, 1), log_weights=torch.zeros(3, 4), batch_size=[3])
    with pytest.raises(ValueError, match="state and actions must have shapes"):
        env.objective(state, torch.zeros(2, 5, 1, 1))


@pytest.mark.parametrize(
    "spec",
    [
        OneHot(3),
        Categorical(3),
        MultiCategorical([2, 3]),
        Composite(gear=Categorical(2), deep=Composite(wheel=Bounded(-1, 1, (2,)))),
    ],
)
def test_actions_of_any_kind_are_carried_in_code(spec: TensorSpec) -> None:
    codec = ActionCodec(spec)
    model = VJEPA(linear_encoder(3, D), Predictor(D, action_dim=codec.size))
    run = make_filter(model, action_spec=spec)
    primer = run.make_tensordict_primer()
    actions = codec.decode(torch.randn(2, codec.size))
    td = actions.clone()
    td["belief"] = TensorDict(action=torch.zeros(2, codec.size), batch_size=[2])
    td["belief", "particles"], td["belief", "log_weights"] = torch.zeros(2, K, D), torch.zeros(2, K)
    executed = primer._inv_call(td)["belief", "action"]
    torch.testing.assert_close(executed, codec.encode(actions))
    belief = TensorDict(td["belief"], batch_size=[2])
    init = torch.zeros(2, 1).bool()
    after = run(TensorDict(latent=torch.zeros(2, D), belief=belief, is_init=init, batch_size=[2]))
    assert after["belief_mean"].isfinite().all()


def test_a_discrete_environment_is_filtered_and_planned_in() -> None:
    spec = Categorical(2)
    model = VJEPA(linear_encoder(4, D), Predictor(D, action_dim=2))
    run = make_filter(model, action_spec=spec)
    cost = quadratic_cost(torch.zeros(D))
    world = LatentEnv(model, action_spec=spec, cost=cost, belief_key=BELIEF)
    policy = TensorDictSequential(model.encoder, run, CEM(world, 3, 2, 16))
    env = GymEnv("CartPole-v1", categorical_action_encoding=True)
    env = TransformedEnv(env, get_env_transforms_from_module(policy))
    data = env.rollout(4, policy, break_when_any_done=False)
    codec = ActionCodec(spec)
    torch.testing.assert_close(data["belief", "action"][1:], codec.encode(data["action"])[:-1])


def test_a_specification_of_another_size_is_refused() -> None:
    model = VJEPA(linear_encoder(3, D), Predictor(D, action_dim=1))
    with pytest.raises(ValueError, match="action_spec must be of action_dim=1 numbers, got 3 of index"):
        make_filter(model, action_spec=Categorical(3))
