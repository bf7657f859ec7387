"""The parts of ``examples/cartpole.py``: what counts as a return, episodes in the buffer, and its world."""

from __future__ import annotations

import importlib
import itertools
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import GymEnv

from torchrl_vjepa import Delta, LatentEnv, TreeSearch

pytestmark = pytest.mark.filterwarnings("ignore::torchrl_vjepa.CollapseWarning")


@pytest.fixture(scope="module")
def cartpole() -> Any:
    """The script as a module (pytest knows the folder)."""
    return importlib.import_module("cartpole")


@pytest.fixture(scope="module")
def run(cartpole: Any) -> Any:
    """A small run, not trained."""
    settings = cartpole.Settings(
        random_steps=200,
        rounds=1,
        collect_steps=40,
        train_steps=3,
        planning_horizon=4,
        num_candidates=8,
        value_sweeps=2,
        value_steps=2,
    )
    return cartpole.Run(3, settings)


def steps_with_ends(done: list[list[int]]) -> TensorDict:
    flags = torch.tensor(done).bool().unsqueeze(-1)
    following = TensorDict(done=flags, reward=torch.ones(flags.shape), batch_size=flags.shape[:2])
    return TensorDict(next=following, batch_size=flags.shape[:2])


def test_returns_stop_at_the_first_end(cartpole: Any) -> None:
    data = steps_with_ends([[0, 0, 1, 1, 1], [0, 1, 0, 0, 1], [0, 0, 0, 0, 0]])
    assert cartpole.first_returns(data).tolist() == [3, 2, 5]


def test_every_episode_has_a_number_of_its_own(cartpole: Any) -> None:
    data = steps_with_ends([[0, 1, 0, 0], [0, 0, 0, 1], [1, 0, 1, 0]])
    assert cartpole.with_episodes(data, 7)["episode"].tolist() == [7, 7, 8, 8, 9, 9, 9, 9, 10, 11, 11, 12]


def test_actions_are_those_of_gymnasium(cartpole: Any) -> None:
    spec = GymEnv("CartPole-v1").action_spec
    assert spec == cartpole.ACTIONS


def test_windows_hold_consecutive_steps_of_one_episode(run: Any) -> None:
    windows = run.buffer.sample().reshape(-1, run.settings.window)
    assert (windows["episode"] == windows["episode"][:, :1]).all()
    position, speed = windows["observation"][..., 0], windows["observation"][..., 1]
    torch.testing.assert_close(position[:, 1:], position[:, :-1] + 0.02 * speed[:, :-1])


def test_the_world_is_cheapest_where_episodes_begin(run: Any) -> None:
    world = run.world().world_model
    data = run.buffer[:]
    episode = data["episode"]
    first = torch.cat([torch.ones(1, dtype=torch.bool), episode[1:] != episode[:-1]])
    with torch.no_grad():
        latent = run.model.encoder(data.select("observation"))["latent"]
        starts = latent[first]
        costs = world.stage_cost(latent, torch.zeros(len(latent), 2))
        least = world.stage_cost(starts.mean(0, keepdim=True), torch.zeros(1, 2))
    assert (costs >= 0).all()
    torch.testing.assert_close(least, torch.zeros(1), atol=1e-4, rtol=0)
    assert costs[first].mean() < 0.1 * costs.mean()
    # Squared Mahalanobis distances of the sample itself have this mean.
    count, std = len(starts), run.settings.prior_std
    expected = 0.5 * 4 * (count - 1) / count / std**2
    torch.testing.assert_close(costs[first].mean(), torch.tensor(expected), rtol=1e-2, atol=1e-4)


def corridor(cartpole: Any, end_cost: float) -> LatentEnv:
    """Places 0 to 6, left or right; far from 2 costs more; an episode may end at 4, and does behind it."""
    ends = nn.Linear(1, 1)
    nn.init.constant_(ends.weight, 40.0)
    nn.init.constant_(ends.bias, -160.0)
    return LatentEnv(
        lambda latent, action: Delta((latent + action[..., 1:] - action[..., :1]).clamp(0, 6)),
        action_spec=cartpole.ACTIONS,
        cost=lambda latent, action: (latent - 2).square().sum(-1),
        latent_dim=1,
        termination_model=TensorDictModule(ends, ["latent"], ["termination_logit"]),
        termination_cost=end_cost,
    )


@pytest.mark.parametrize("end_cost", [0.0, 50.0])
def test_the_value_is_that_of_the_best_plan(cartpole: Any, end_cost: float) -> None:
    discount, horizon = 0.5, 11
    env = corridor(cartpole, end_cost)
    places = torch.arange(7.0).unsqueeze(1)
    value = cartpole.Value(1, 32)
    cartpole.value_iteration(value, env, places, discount=discount, sweeps=60, steps=20, lr=1e-2)
    # Of all plans in numbers: what comes behind the horizon weighs less than 0.001.
    ends = [0, 0, 0, 0, 0.5, 1, 1]
    expected = []
    for place in range(7):
        best = float("inf")
        for plan in itertools.product((-1, 1), repeat=horizon):
            now, weight, cost = place, 1.0, 0.0
            for move in plan:
                now = min(6, max(0, now + move))
                cost += weight * ((now - 2) ** 2 + ends[now] * end_cost)
                weight *= discount * (1 - ends[now])
            best = min(best, cost)
        expected.append(-best)
    torch.testing.assert_close(value(places), torch.tensor(expected), rtol=0.03, atol=0.05)


def test_the_leaves_of_tree_search_have_the_value(cartpole: Any, run: Any) -> None:
    planner = run.planner("tree-search")
    assert isinstance(planner, TreeSearch)
    assert planner.leaf_value is run.value
    assert planner.discount == run.settings.discount


def test_rounding_below_zero_does_not_spoil_the_value(cartpole: Any) -> None:
    env = corridor(cartpole, 0.0)
    env.world_model.cost = lambda latent, action: torch.full_like(latent[..., 0], -1e-6)
    value = cartpole.Value(1, 8)
    cartpole.value_iteration(value, env, torch.ones(3, 1), discount=0.1, sweeps=40, steps=5, lr=0.1)
    assert value(torch.ones(3, 1)).isfinite().all()


def test_a_round_collects_and_learns(cartpole: Any, run: Any) -> None:
    before = [parameter.clone() for parameter in run.value.parameters()]
    run.learn()
    assert len(run.buffer) == 240
    assert not any(map(torch.equal, before, run.value.parameters()))
    assert [steps for steps, _ in run.lengths] == [200, 240]
    assert run.buffer[:]["action"].sum(-1).eq(1).all()
    rows = run.buffer[:]["episode"]
    assert (rows.diff() >= 0).all()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (["--seeds", "1", "1"], "distinct"),
        (["--random-steps", "401"], "--random-steps must be a positive multiple of --collect-envs=4"),
        (["--collect-steps", "0"], "--collect-steps must be a positive multiple"),
    ],
)
def test_the_command_line_refuses(
    cartpole: Any, wrong: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        cartpole.main(wrong)
    assert message in capsys.readouterr().err
