"""The parts of ``examples/cartpole.py``: what counts as a return, episodes in the buffer, and its world."""

from __future__ import annotations

import importlib
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv

pytestmark = pytest.mark.filterwarnings("ignore::torchrl_vjepa.CollapseWarning")


@pytest.fixture(scope="module")
def cartpole() -> Any:
    """The script as a module (pytest knows the folder)."""
    return importlib.import_module("cartpole")


@pytest.fixture(scope="module")
def run(cartpole: Any) -> Any:
    """A small run, not trained."""
    settings = cartpole.Settings(
        random_steps=200, rounds=1, collect_steps=40, train_steps=3, planning_horizon=4, num_candidates=8
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


def test_a_round_collects_and_learns(cartpole: Any, run: Any) -> None:
    run.learn()
    assert len(run.buffer) == 240
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
