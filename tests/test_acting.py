"""The policy ``TensorDictSequential(encoder, planner)`` in TorchRL's machinery, partial resets too."""

from __future__ import annotations

import functools
import pickle
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import (
    Compose,
    EnvBase,
    GymEnv,
    ParallelEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs
from torchrl.modules import get_env_transforms_from_module

from torchrl_vjepa.costs import QuadraticReward
from torchrl_vjepa.encoders import linear_encoder
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.models import VJEPA
from torchrl_vjepa.planners import CEM, MPPI, GradientMPC, Planner, RandomShooting
from torchrl_vjepa.predictor import Predictor

HORIZON = 3


def make_world() -> tuple[VJEPA, LatentEnv]:
    """A model of Pendulum-v1 as it is before any training."""
    torch.manual_seed(0)
    model = VJEPA(linear_encoder(3, 4), Predictor(4, action_dim=1))
    reward = QuadraticReward(4, 1)
    for parameter in reward.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    env = LatentEnv(
        model,
        action_spec=GymEnv("Pendulum-v1").action_spec,
        reward_model=TensorDictModule(reward, ["latent", "action"], ["reward"]),
    )
    return model, env


def make_policy(cls: type[Planner] = MPPI, **kwargs: Any) -> TensorDictSequential:
    model, world = make_world()
    sizes = (2,) if cls is GradientMPC else (2, 32, 8)
    planner = cls(world, HORIZON, *sizes, seed=0, **kwargs)
    policy = TensorDictSequential(model.encoder, planner)
    return policy.select_out_keys("action", ("next", "plan"))


def make_env(max_steps: int = 4) -> EnvBase:
    return TransformedEnv(GymEnv("Pendulum-v1"), StepCounter(max_steps))


def prepared(env: EnvBase, policy: TensorDictSequential) -> TransformedEnv:
    return TransformedEnv(env, get_env_transforms_from_module(policy), auto_unwrap=True)


def check_memory(data: TensorDictBase) -> None:
    """Time last. Plans travel from step to step, and begin at zero where an episode begins."""
    is_init = data["is_init"].squeeze(-1)
    assert not data["plan"][is_init].any()
    carried = ~is_init[..., 1:]
    before = data["next", "plan"][..., :-1, :, :]
    assert torch.equal(data["plan"][..., 1:, :, :][carried], before[carried])
    assert data["plan"][~is_init].any()
    assert data["action"].isfinite().all()
    assert (data["action"].abs() <= 2).all()
    assert "latent" not in data.keys(True)


@pytest.mark.parametrize("cls", [RandomShooting, CEM, MPPI, GradientMPC])
def test_rollout(cls: type[Planner]) -> None:
    policy = make_policy(cls)
    env = prepared(make_env(6), policy)
    check_env_specs(env)
    data = env.rollout(9, policy, break_when_any_done=False)
    check_memory(data)
    assert data["is_init"].squeeze(-1).nonzero().flatten().tolist() == [0, 6]


def test_rollout_without_the_transforms_starts_cold_every_time() -> None:
    policy = make_policy()
    data = make_env().rollout(3, policy)
    assert "plan" not in data
    assert data["action"].isfinite().all()


def test_policy_equals_planning_step_by_step() -> None:
    policy = make_policy()
    env = prepared(make_env(6), policy)
    data = env.rollout(6, policy)
    other = make_policy()
    for step in data.unbind(-1):
        again = other(step.select("observation", "plan", "is_init"))
        torch.testing.assert_close(again["action"], step["action"])
        torch.testing.assert_close(again["next", "plan"], step["next", "plan"])


def test_statistics_in_a_rollout() -> None:
    model, world = make_world()
    planner = CEM(world, HORIZON, 2, 32, 8, seed=0, return_stats=True)
    policy = TensorDictSequential(model.encoder, planner)
    data = prepared(make_env(), policy).rollout(3, policy)
    assert data["plan_stats", "cost"].shape == (3, 1)
    assert torch.equal(data["plan_stats", "actions"][:, 0], data["action"])


def test_serial_env_with_partial_resets() -> None:
    policy = make_policy()
    workers = [functools.partial(make_env, 3), functools.partial(make_env, 5)]
    env = prepared(SerialEnv(2, workers), policy)
    data = env.rollout(8, policy, break_when_any_done=False)
    check_memory(data)
    starts = data["is_init"].squeeze(-1)
    assert [row.nonzero().flatten().tolist() for row in starts] == [[0, 3, 6], [0, 5]]


def test_primer_inside_the_workers_of_a_serial_env() -> None:
    policy = make_policy()
    workers = [functools.partial(_prepared_env, steps) for steps in (3, 5)]
    data = SerialEnv(2, workers).rollout(8, policy, break_when_any_done=False)
    check_memory(data)


def _prepared_env(max_steps: int) -> EnvBase:
    return prepared(make_env(max_steps), make_policy())


def test_collector() -> None:
    policy = make_policy()
    collector = Collector(
        functools.partial(make_env, 4),
        policy,
        frames_per_batch=10,
        total_frames=20,
        auto_register_policy_transforms=True,
    )
    try:
        for data in collector:
            check_memory(data)
    finally:
        collector.shutdown()


def test_parallel_env() -> None:
    policy = make_policy()
    workers = [functools.partial(make_env, 3), functools.partial(make_env, 5)]
    env = prepared(ParallelEnv(2, workers, mp_start_method="fork"), policy)
    try:
        check_memory(env.rollout(8, policy, break_when_any_done=False))
    finally:
        env.close(raise_if_closed=False)


def test_multi_sync_collector() -> None:
    policy = make_policy()
    collector = MultiSyncCollector(
        [functools.partial(make_env, 4)],
        policy,
        frames_per_batch=10,
        total_frames=10,
        auto_register_policy_transforms=True,
    )
    try:
        batches = [data.clone() for data in collector]
    finally:
        collector.shutdown()
    assert len(batches) == 1
    check_memory(batches[0].reshape(-1))


def test_policy_pickles_and_follows_training() -> None:
    policy = make_policy()
    td = TensorDict(observation=torch.randn(5, 3), batch_size=5)
    other = pickle.loads(pickle.dumps(policy))
    assert torch.equal(policy(td.clone())["action"], other(td.clone())["action"])
    # Encoder, predictor and reward head are all parameters of the policy, shared with the model.
    names = {name.split(".")[-1] for name, _ in policy.named_parameters()}
    assert {"weight", "triangle"} <= names
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.zero_()
    flat = policy(td.clone())
    assert flat["action"].isfinite().all()
    assert not torch.equal(flat["action"], other(td.clone())["action"])


def test_transforms_compose_with_others() -> None:
    policy = make_policy()
    transforms = get_env_transforms_from_module(policy)
    env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(StepCounter(4), *transforms))
    check_memory(env.rollout(6, policy, break_when_any_done=False))


def test_transformed_latent_env_is_stepped_with_its_transforms() -> None:
    _, world = make_world()
    planner = CEM(TransformedEnv(world, StepCounter()), HORIZON, 2, 32, 8, seed=0)
    latent = torch.randn(2, 4)
    td = TensorDict(latent=latent, step_count=torch.zeros(2, 1, dtype=torch.int64), batch_size=2)
    plain = CEM(world, HORIZON, 2, 32, 8, seed=0)(TensorDict(latent=latent, batch_size=2))
    torch.testing.assert_close(planner(td)["action"], plain["action"], atol=1e-4, rtol=1e-4)
