"""The online loop of ``examples/pendulum.py``: its physics, its rounds, and that it continues exactly."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor

LENGTH = 30  # of the episodes here
pytestmark = pytest.mark.filterwarnings("ignore::torchrl_vjepa.CollapseWarning")


@pytest.fixture(scope="module")
def pendulum() -> Iterator[Any]:
    """The script as a module (pytest knows the folder), with short episodes."""
    module = importlib.import_module("pendulum")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "EPISODE", LENGTH)
        yield module


def tiny(pendulum: Any, **changes: Any) -> Any:
    """Rounds of one episode each, in tenths of a second."""
    sizes = {"env_steps": 90, "collect_episodes": 1, "num_cells": 8, "train_steps": 10, "windows": 4}
    planner = {"planning_horizon": 4, "optim_steps": 1, "num_candidates": 32, "lr": 0.03}
    return pendulum.Settings(**{**sizes, **planner, "episodes": 1, "seeds": [3, 4], **changes})


@pytest.fixture(scope="module")
def uninterrupted(pendulum: Any) -> dict[str, Any]:
    return pendulum.run_seeds(tiny(pendulum))


def test_the_true_model_is_gymnasiums(pendulum: Any) -> None:
    env = gymnasium.make("Pendulum-v1").unwrapped
    generator = torch.Generator().manual_seed(0)
    scale = torch.tensor([3.1, 8.0])
    states = (2.0 * torch.rand(200, 2, generator=generator) - 1.0) * scale
    actions = 6.0 * torch.rand(200, 1, generator=generator) - 3.0
    observations, rewards = [], []
    for state, action in zip(states.double().numpy(), actions.numpy(), strict=True):
        env.reset()
        env.state = state
        observation, reward, *_ = env.step(action)
        observations.append(observation)
        rewards.append(float(np.asarray(reward).item()))
    seen = torch.stack([states[:, 0].cos(), states[:, 0].sin(), states[:, 1]], dim=-1)
    after = pendulum.physics(pendulum.true_state(seen), actions).mean
    expected = torch.as_tensor(np.stack(observations))
    predicted = torch.stack([after[:, 0].cos(), after[:, 0].sin(), after[:, 1]], dim=-1)
    torch.testing.assert_close(predicted, expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(
        -pendulum.true_cost(after, actions), torch.tensor(rewards), rtol=1e-4, atol=1e-4
    )


def test_actions_are_gymnasiums(pendulum: Any) -> None:
    space = gymnasium.make("Pendulum-v1").action_space
    assert space.low == pendulum.ACTIONS.space.low.numpy()
    assert space.high == pendulum.ACTIONS.space.high.numpy()


def test_a_rollout_depends_on_its_seed_alone(pendulum: Any) -> None:
    one, again, other = (pendulum.rollout(2, seed) for seed in (0, 0, 1))
    for key in ("observation", "action", ("next", "reward")):
        assert torch.equal(one[key], again[key])
        assert not torch.equal(one[key], other[key])


def test_one_row_for_each_round_in_order(pendulum: Any, uninterrupted: dict[str, Any]) -> None:
    cells = [(row["seed"], row["env_steps"]) for row in uninterrupted["rows"]]
    assert cells == [(seed, steps) for seed in (3, 4) for steps in (30, 60, 90)]
    assert len({row["return_mean"] for row in uninterrupted["rows"]}) == 6
    assert [row["policy"] for row in uninterrupted["references"]] == ["true_model", "random"]


@pytest.mark.parametrize("stop", [1, 3, 4, 6])
def test_a_run_that_was_killed_ends_with_the_same_rows(
    pendulum: Any,
    uninterrupted: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    stop: int,
) -> None:
    path, save, saved = tmp_path / "new" / "run.pt", pendulum.save, []

    def killed(*arguments: Any) -> None:
        save(*arguments)
        saved.append(arguments)
        if len(saved) == stop:
            raise KeyboardInterrupt

    monkeypatch.setattr(pendulum, "save", killed)
    with pytest.raises(KeyboardInterrupt):
        pendulum.run_seeds(tiny(pendulum), path)
    torch.rand(7)  # whatever else the next process draws
    monkeypatch.setattr(pendulum, "save", lambda *arguments: (save(*arguments), saved.append(arguments)))
    result = pendulum.run_seeds(tiny(pendulum), path)
    assert len(saved) == 6
    assert result["rows"] == uninterrupted["rows"]
    assert result["references"] == uninterrupted["references"]
    assert result["wall_s"] > 0
    assert [file.name for file in path.parent.iterdir()] == ["run.pt"]


def same(one: Any, other: Any) -> bool:
    """Equal, tensors bit for bit."""
    if isinstance(one, Tensor):
        return torch.equal(one, other)
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other)


def test_all_of_a_run_comes_back(pendulum: Any, tmp_path: Path) -> None:
    settings = tiny(pendulum)
    run = pendulum.Run(3, settings)
    run.advance()
    pendulum.save(tmp_path / "run.pt", {"settings": vars(settings), "run": run.state_dict()})
    kept = pendulum.load(tmp_path / "run.pt", settings)["run"]
    other = pendulum.Run.from_state_dict(kept, settings)
    assert same(kept, run.state_dict())
    assert same(other.state_dict(), run.state_dict())
    assert run.advance() == other.advance()
    assert same(other.state_dict(), run.state_dict())


def test_a_process_killed_while_saving_leaves_the_checkpoint_before(
    pendulum: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path, settings = tmp_path / "run.pt", tiny(pendulum)
    pendulum.save(path, {"settings": vars(settings), "rows": [1]})

    def killed(*arguments: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_bytes", killed)
    with pytest.raises(KeyboardInterrupt):
        pendulum.save(path, {"settings": vars(settings), "rows": [1, 2]})
    monkeypatch.undo()
    monkeypatch.setattr(pendulum.os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        pendulum.save(path, {"settings": vars(settings), "rows": [1, 2]})
    assert pendulum.load(path, settings)["rows"] == [1]


@pytest.mark.parametrize("fault", ["empty", "cut", "one bit", "text"])
def test_a_damaged_checkpoint_is_refused(
    pendulum: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], fault: str
) -> None:
    path, settings = tmp_path / "run.pt", tiny(pendulum)
    pendulum.save(path, {"settings": vars(settings), "run": {"weights": torch.zeros(1000)}})
    content = path.read_bytes()
    middle = len(content) // 2
    path.write_bytes(
        {
            "empty": b"",
            "cut": content[:-10],
            "one bit": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
            "text": b"a letter to somebody else" * 10,
        }[fault]
    )
    before = path.read_bytes()
    with pytest.raises(SystemExit):
        pendulum.main(
            ["--quick", "--env-steps", "300", "--out", str(tmp_path / "figures"), "--checkpoint", str(path)]
        )
    assert "damaged" in capsys.readouterr().err
    assert path.read_bytes() == before, "what is refused is not overwritten"


def test_a_checkpoint_of_other_settings_is_refused(pendulum: Any, tmp_path: Path) -> None:
    path = tmp_path / "run.pt"
    pendulum.save(path, {"settings": vars(tiny(pendulum))})
    with pytest.raises(ValueError, match="train_steps was 10, now 4"):
        pendulum.run_seeds(tiny(pendulum, train_steps=4), path)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (["--env-steps", "500"], "multiple"),
        (["--env-steps", "0"], "multiple"),
        (["--env-steps", "300", "--seeds", "1", "1"], "distinct"),
    ],
)
def test_the_command_line_refuses(
    pendulum: Any, wrong: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        pendulum.main(wrong)
    assert message in capsys.readouterr().err


def test_windows_lie_in_one_episode(pendulum: Any) -> None:
    settings = tiny(pendulum, windows=200, collect_episodes=2, env_steps=120)
    run = pendulum.Run(3, settings)
    run.rounds = 1
    run.buffer.extend(run.collect())
    everything = run.buffer[:]
    assert everything["episode"].unique(return_counts=True)[1].tolist() == [LENGTH] * 4
    assert torch.equal(everything["episode"], torch.arange(4).repeat_interleave(LENGTH))
    windows = run.buffer.sample().reshape(-1, settings.window)
    assert (windows["episode"] == windows["episode"][:, :1]).all()
    row = {tuple(observation): i for i, observation in enumerate(everything["observation"].tolist())}
    place = torch.tensor(
        [[row[tuple(step)] for step in window] for window in windows["observation"].tolist()]
    )
    assert (place.diff(dim=1) == 1).all()


def test_the_target_starts_where_the_encoder_does(pendulum: Any) -> None:
    run = pendulum.Run(3, tiny(pendulum))
    target = run.loss.target_encoder_params
    observed = run.buffer[:].select("observation")
    latent = run.model.encoder(observed.copy())["latent"]
    with target.to_module(run.model.encoder):
        assert torch.equal(run.model.encoder(observed.copy())["latent"], latent)
    whitened = run.model.encoder.module.whitening(observed["observation"])
    torch.testing.assert_close(torch.cov(whitened.mT, correction=0), torch.eye(3), atol=1e-3, rtol=0)


def test_the_learning_rate_falls_to_zero_in_every_round(pendulum: Any) -> None:
    run = pendulum.Run(3, tiny(pendulum, train_steps=100))
    for _ in range(2):
        rates = []
        run.optimizer.step = lambda rates=rates: rates.append(run.optimizer.param_groups[0]["lr"])
        run.train()
        assert len(rates) == 100
        assert rates[0] < 0.1 * max(rates) <= 0.1 * run.settings.lr
        assert rates[-1] < 0.01 * run.settings.lr
