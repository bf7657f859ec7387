"""Every script in examples/ runs with its smallest budget and keeps its command line."""

from __future__ import annotations

import copy
import importlib
import importlib.util
import json
import math
import os
import re
import runpy
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from sklearn.metrics import r2_score
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import diag_gaussian

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = sorted((ROOT / "examples").glob("[!_]*.py"))
ROW_KEYS = {
    "controller",
    "noise_scale",
    "seed",
    "cost",
    "lqg_cost",
    "ratio_to_lqg",
    "signal_r2",
    "noise_r2",
}
TABLE_KEYS = {
    "preset",
    "model",
    "encoder",
    "noise_scale",
    "seed",
    "signal_r2_train",
    "signal_r2",
    "noise_r2_train",
    "noise_r2",
    "train_s",
}
CLIFF_KEYS = {
    "model",
    "planner",
    "seed",
    "mean_cost",
    "worst_5_percent",
    "fall_rate",
    "success_rate",
}
UNCERTAINTY_KEYS = {"noise_scale", "seed", "horizon", "coverage_90", "crps", "oracle_crps"}
GOAL_SWAP_KEYS = {"task", "method", "seed", "cost", "oracle_cost", "ratio", "violations"}
FORK_KEYS = {"head", "planner", "seed", "test_log_prob", "wall_mass", "success"}
# "path:line: Category: message", raised at a line of this repository
WARNING = re.compile(r"\S*(?:torchrl_vjepa|examples)/\S*\.py:\d+: \w*Warning: .*")


class Run(NamedTuple):
    returncode: int
    stdout: str
    stderr: str
    folder: Path
    report: Path


def start(script: Path, arguments: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    # This checkout, whatever is installed: the tests import it from here too.
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {
        **os.environ,
        "MPLBACKEND": "Agg",
        "PYTHONPATH": os.pathsep.join(paths),
        "PYTHONWARNINGS": "always",
    }
    return subprocess.run(
        [sys.executable, str(script), *arguments],
        capture_output=True,
        text=True,
        cwd=folder,
        env=environment,
        check=False,
        timeout=300,
    )


@pytest.fixture(scope="module", params=SCRIPTS, ids=[script.stem for script in SCRIPTS])
def script(request: pytest.FixtureRequest) -> Path:
    return request.param


@pytest.fixture(scope="module")
def run(script: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """One run of a script, shared by the tests that look at what it left."""
    folder = tmp_path_factory.mktemp(script.stem)
    report = folder / "report.json"
    done = start(script, ["--quick", "--out", "figures", "--json", str(report)], folder)
    return Run(done.returncode, done.stdout, done.stderr, folder, report)


def load(name: str, folder: str = "examples") -> Iterator[Any]:
    """A script as a module, for as long as a fixture lives."""
    spec = importlib.util.spec_from_file_location(name, ROOT / folder / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def reject_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")


def load_report(path: Path) -> dict[str, Any]:
    """Reads a report; NaN and infinities, which are not JSON, are refused."""
    return json.loads(path.read_text(encoding="utf-8"), parse_constant=reject_constant)


def check_report(report: dict[str, Any]) -> None:
    """Checks the report of ``noisy_tv_mppi.py``: its keys, its types, and that it adds up."""
    assert set(report) == {"settings", "wall_s", "rows"}
    assert isinstance(report["settings"], dict)
    assert report["settings"]
    assert report["wall_s"] > 0
    rows = report["rows"]
    assert rows
    cells = [(row["controller"], row["noise_scale"], row["seed"]) for row in rows]
    assert len(cells) == len(set(cells)), "one row for each controller, noise scale and seed"
    groups = {cell[1:] for cell in cells}
    controllers = {cell[0] for cell in cells}
    assert len(cells) == len(groups) * len(controllers), "every controller in every setting"
    assert "vjepa_mppi" in controllers
    for row in rows:
        assert set(row) == ROW_KEYS
        assert isinstance(row["seed"], int)
        assert row["noise_scale"] >= 0.0
        assert row["cost"] > 0.0
        assert row["lqg_cost"] > 0.0
        assert math.isclose(row["ratio_to_lqg"], row["cost"] / row["lqg_cost"], rel_tol=1e-3)
        for key in ("signal_r2", "noise_r2"):
            assert row[key] is None or row[key] <= 1.0
    assert all(row["signal_r2"] is not None for row in rows if row["controller"] == "vjepa_mppi")
    for setting in groups:
        costs = {row["lqg_cost"] for row in rows if (row["noise_scale"], row["seed"]) == setting}
        assert len(costs) == 1, "one oracle for each noise scale and seed"


def check_table_report(report: dict[str, Any]) -> None:
    """Checks the report of ``noisy_tv_table.py``: its keys, its types, and one row for each run."""
    assert set(report) == {"settings", "wall_s", "rows", "fusion"}
    settings, rows = report["settings"], report["rows"]
    assert report["wall_s"] > 0
    fused = [row for row in rows if row["model"] == "BJEPA"]
    signal_r2 = {(r["preset"], r["noise_scale"], r["seed"]): r["signal_r2"] for r in fused}
    assert len(report["fusion"]) == len(signal_r2)
    for row in report["fusion"]:
        assert row["fused"] == signal_r2[row["preset"], row["noise_scale"], row["seed"]]
        # With constant variances fusion moves the mean by an affine map, which the probe undoes.
        assert row["preset"] == "paper" or row["fused"] > row["unfused"] - 0.005
    cells = [(row["preset"], row["model"], row["noise_scale"], row["seed"]) for row in rows]
    latent = [name for name in settings["models"] if "JEPA" in name]
    expected = {
        (preset, name, scale, seed)
        for preset in settings["preset"]
        for name in (settings["models"] if preset == "paper" else latent)
        for scale in settings["noise_scales"]
        for seed in settings["seeds"]
    }
    assert len(cells) == len(expected)
    assert set(cells) == expected
    for row in rows:
        assert set(row) == TABLE_KEYS
        assert row["encoder"] == settings["encoder"]
        assert isinstance(row["seed"], int)
        assert row["train_s"] > 0.0
        for key in ("signal_r2_train", "signal_r2"):
            assert row[key] <= 1.0
        for key in ("noise_r2_train", "noise_r2"):
            assert (row[key] is None) == (row["noise_scale"] == 0), "without a distractor no R2 of it"
            assert row[key] is None or row[key] <= 1.0


def check_surprise_report(report: dict[str, Any]) -> None:
    """Checks the report of ``surprise.py``: one row for each detector, change and seed, in range."""
    assert set(report) == {"settings", "wall_s", "rows"}
    rows = report["rows"]
    cells = {(row["detector"], row["change"], row["seed"]) for row in rows}
    assert len(cells) == len(rows) == 2 * 7 * len(report["settings"]["seeds"])
    for row in rows:
        assert 0 <= row["alarms_before"] <= 1
        assert 0 <= row["alarms_after"] <= 1
        assert (row["median_delay"] is None) == (row["alarms_after"] == 0)
        if row["detector"] == "vjepa" and row["change"] in ("nothing", "switched on"):
            assert row["alarms_after"] <= 0.1
        if row["change"] == "pixel":
            assert row["surprise_after"] > row["surprise_before"]


def check_cliff_report(report: dict[str, Any]) -> None:
    """Checks the report of ``cliff.py``: its keys, its ranges, and one row for each planner and model."""
    assert set(report) == {"settings", "wall_s", "rows"}
    assert report["wall_s"] > 0
    rows = report["rows"]
    cells = [(row["model"], row["planner"], row["seed"]) for row in rows]
    expected = {
        (model, planner, seed)
        for model in ("VJEPA", "true")
        for planner in ("mean", "expectation", "cvar", "chance")
        for seed in report["settings"]["seeds"]
    }
    assert len(cells) == len(expected)
    assert set(cells) == expected
    for row in rows:
        assert set(row) == CLIFF_KEYS
        assert 0 < row["mean_cost"] <= row["worst_5_percent"] * (1 + 1e-6)
        assert 0 <= row["fall_rate"] <= 1
        assert 0 <= row["success_rate"] <= 1 - row["fall_rate"] + 1e-6


def check_uncertainty_report(report: dict[str, Any]) -> None:
    """Checks the report of ``uncertainty.py``: one row for each scale, seed and horizon, per route too."""
    assert set(report) == {"settings", "wall_s", "rows", "routes"}
    settings, rows, routes = report["settings"], report["rows"], report["routes"]
    assert report["wall_s"] > 0
    cells = [(row["noise_scale"], row["seed"], row["horizon"]) for row in rows]
    horizons = range(1, settings["horizon"] + 1)
    expected = {(x, s, h) for x in settings["noise_scales"] for s in settings["seeds"] for h in horizons}
    assert len(cells) == len(expected)
    assert set(cells) == expected
    for row in rows:
        assert set(row) == UNCERTAINTY_KEYS
        assert isinstance(row["seed"], int)
        assert 0 <= row["coverage_90"] <= 1
        assert row["crps"] > 0
        assert row["oracle_crps"] > 0
        assert row["crps"] > 0.98 * row["oracle_crps"], "nothing beats the truth by more than chance"
    assert len(routes) == 3 * len(rows)
    main = {(r["noise_scale"], r["seed"], r["horizon"]): r for r in routes if "recalibrated" in r["route"]}
    for cell, row in zip(cells, rows, strict=True):
        assert main[cell]["coverage_90"] == row["coverage_90"]
        assert math.isclose(main[cell]["crps_ratio"], row["crps"] / row["oracle_crps"], rel_tol=1e-9)


def check_fork_report(report: dict[str, Any]) -> None:
    """Checks the report of ``fork.py``: its keys, its ranges, and one row for each head and planner."""
    assert set(report) == {"settings", "wall_s", "rows", "oracle", "mean_in_wall"}
    settings, rows = report["settings"], report["rows"]
    assert report["wall_s"] > 0
    expected = {
        (head, planner, seed)
        for head in settings["heads"]
        for planner in ("sample", "mean")
        for seed in settings["seeds"]
    }
    assert len(rows) == len(expected)
    assert {(row["head"], row["planner"], row["seed"]) for row in rows} == expected
    for row in [*rows, *report["oracle"]]:
        assert set(row) == FORK_KEYS
        assert math.isfinite(row["test_log_prob"])
        assert 0.0 <= row["wall_mass"] <= 1.0
        assert 0.0 <= row["success"] <= 1.0
    for head, _, seed in expected:
        beliefs = {
            (row["test_log_prob"], row["wall_mass"])
            for row in rows
            if (row["head"], row["seed"]) == (head, seed)
        }
        assert len(beliefs) == 1, "both planners have the same model"
    assert {(row["planner"], row["seed"]) for row in report["oracle"]} == {cell[1:] for cell in expected}
    assert {(row["head"], row["seed"]) for row in report["mean_in_wall"]} == {
        (head, seed) for head, _, seed in expected
    }
    assert all(0.0 <= row["mean_in_wall"] <= 1.0 for row in report["mean_in_wall"])


def check_pendulum_report(report: dict[str, Any]) -> None:
    """Checks the report of ``pendulum.py``: one row for each evaluation, in order, and the references."""
    assert set(report) == {"settings", "wall_s", "rows", "references"}
    settings, rows = report["settings"], report["rows"]
    assert report["wall_s"] > 0
    step = 200 * settings["collect_episodes"]
    assert [(row["seed"], row["env_steps"]) for row in rows] == [
        (seed, steps) for seed in settings["seeds"] for steps in range(step, settings["env_steps"] + 1, step)
    ]
    assert all(set(row) == {"seed", "env_steps", "return_mean", "return_min"} for row in rows)
    assert [row["policy"] for row in report["references"]] == ["true_model", "random"]
    for row in [*rows, *report["references"]]:
        # No step pays less than -(pi^2 + 0.1 * 8^2 + 0.001 * 2^2).
        assert -200 * 16.28 < row["return_min"] <= row["return_mean"] <= 0


def check_goal_swap_report(report: dict[str, Any]) -> None:
    """Checks the report of ``goal_swap.py``: its keys, its ranges, and that the first task stays the same."""
    assert set(report) == {"settings", "wall_s", "swap_ms", "rows", "diagnostics"}
    settings, rows = report["settings"], report["rows"]
    assert report["wall_s"] > 0
    assert report["swap_ms"] > 0
    numbered = {f"{family}-{k}" for family in FAMILIES for k in range(settings["goals"])}
    last = settings["continual_tasks"] - 1
    continual = {"continual-0-after-0", f"continual-0-after-{last}"}
    cells = {(row["task"], row["method"], row["seed"]): row for row in rows}
    assert len(cells) == len(rows)
    for row in rows:
        assert set(row) == GOAL_SWAP_KEYS
        assert row["cost"] > 0
        assert math.isclose(row["ratio"], row["cost"] / row["oracle_cost"], rel_tol=1e-9)
        assert 0 <= row["violations"] <= 1
    for seed in settings["seeds"]:
        for method in ("lqg", "bjepa", "bjepa-gradient", "jepa"):
            done = {task for task, name, s in cells if (name, s) == (method, seed)}
            assert done - continual == {*numbered, "circle"}, method
        assert all(cells[task, "lqg", seed]["ratio"] == 1 for task in numbered)
        before, after = (cells[task, "bjepa", seed] for task in sorted(continual))
        assert before["cost"] == after["cost"], "the first task costs what it cost"


FAMILIES = ("goal", "keep-out", "two-regions")


CARTPOLE_KEYS = {"planner", "seed", "env_steps", "return_mean", "return_min", "balanced"}
CARTPOLE_KEYS |= {"learning_cpu_s", "evaluation_cpu_s"}


def check_cartpole_report(report: dict[str, Any]) -> None:
    """Checks the report of ``cartpole.py``: one row for each planner and seed."""
    assert set(report) == {"settings", "wall_s", "rows", "curves"}
    settings, rows = report["settings"], report["rows"]
    planners = settings["planners"]
    assert [(row["seed"], row["planner"]) for row in rows] == [
        (seed, planner) for seed in settings["seeds"] for planner in planners
    ]
    steps = settings["random_steps"] + settings["rounds"] * settings["collect_steps"]
    for row in rows:
        assert set(row) == CARTPOLE_KEYS
        assert row["env_steps"] == steps <= 20_000
        assert row["learning_cpu_s"] > 0
        assert row["evaluation_cpu_s"] > 0
        assert 1 <= row["return_min"] <= row["return_mean"] <= 500
        assert 0 <= row["balanced"] <= 1
    for curve in report["curves"].values():
        assert len(curve) == settings["rounds"] + 1
        assert curve[-1][0] == steps


CHECKS = {
    "goal_swap": check_goal_swap_report,
    "cartpole": check_cartpole_report,
    "fork": check_fork_report,
    "noisy_tv_mppi": check_report,
    "noisy_tv_table": check_table_report,
    "pendulum": check_pendulum_report,
    "surprise": check_surprise_report,
    "cliff": check_cliff_report,
    "uncertainty": check_uncertainty_report,
}


def test_there_are_examples() -> None:
    assert {path.stem for path in SCRIPTS} >= set(CHECKS)


def test_help_lists_the_common_options(
    script: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # In this process: a new one would only import everything again.
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    with pytest.raises(SystemExit) as stopped:
        runpy.run_path(str(script), run_name="__main__")
    assert stopped.value.code == 0
    shown = capsys.readouterr().out
    for option in ("--json", "--out", "--quick"):
        assert re.search(rf"{option}\b", shown), option
    assert re.search(r"--seeds?\b", shown)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda path: path.stem)
def test_benchmarks_find_what_they_import(path: Path) -> None:
    runpy.run_path(str(path), run_name="benchmark")


def test_script_succeeds_without_warnings(run: Run) -> None:
    assert run.returncode == 0, run.stderr[-4000:]
    assert run.stdout.strip(), "a result is printed"
    assert WARNING.findall(run.stderr) == []


def test_script_writes_a_figure_and_nothing_outside_its_folder(run: Run) -> None:
    figures = [path for path in run.folder.rglob("*.png") if path.stat().st_size > 1000]
    assert figures
    assert {path.name.split(".")[0] for path in run.folder.iterdir()} <= {"figures", "report"}


def test_script_writes_a_report(script: Path, run: Run) -> None:
    report = load_report(run.report)
    assert {"settings", "wall_s", "rows"} <= set(report)
    if script.stem in CHECKS:
        CHECKS[script.stem](report)


def valid_report() -> dict[str, Any]:
    row = {
        "controller": "vjepa_mppi",
        "noise_scale": 8.0,
        "seed": 0,
        "cost": 1.5,
        "lqg_cost": 1.0,
        "ratio_to_lqg": 1.5,
        "signal_r2": 0.9,
        "noise_r2": -0.1,
    }
    blind = {**row, "controller": "random", "signal_r2": None, "noise_r2": None}
    return {"settings": {"seeds": [0]}, "wall_s": 1.0, "rows": [row, blind]}


def test_the_report_check_accepts_a_valid_report() -> None:
    check_report(valid_report())


@pytest.mark.parametrize(
    "change",
    [
        {"cost": 2.0},
        {"signal_r2": 1.1},
        {"signal_r2": None},
        {"controller": "random"},
        {"seed": 1},
        {"lqg_cost": 3.0, "ratio_to_lqg": 0.5},
        {"extra": 1},
        {"noise_scale": -1.0},
    ],
)
def test_the_report_check_sees(change: dict[str, Any]) -> None:
    report = valid_report()
    report["rows"][0].update(change)
    with pytest.raises(AssertionError):
        check_report(report)


def valid_table() -> dict[str, Any]:
    settings = {
        "preset": ["paper", "robust"],
        "models": ["VAE", "VJEPA"],
        "encoder": "linear",
        "noise_scales": [0.0, 8.0],
        "seeds": [3],
    }
    rows = []
    for preset, name in (("paper", "VAE"), ("paper", "VJEPA"), ("robust", "VJEPA")):
        for scale in (0.0, 8.0):
            rows.append(
                {
                    "preset": preset,
                    "model": name,
                    "encoder": "linear",
                    "noise_scale": scale,
                    "seed": 3,
                    "signal_r2_train": 0.9,
                    "signal_r2": 0.8,
                    "noise_r2_train": 0.1 if scale else None,
                    "noise_r2": -0.1 if scale else None,
                    "train_s": 1.0,
                }
            )
    return {"settings": settings, "wall_s": 1.0, "rows": rows, "fusion": []}


def test_the_table_check_accepts_a_valid_report() -> None:
    check_table_report(valid_table())


@pytest.mark.parametrize(
    "change",
    [
        {"signal_r2": 1.1},
        {"noise_r2": None},
        {"noise_scale": 0.0},
        {"seed": 4},
        {"model": "VAE"},
        {"encoder": "mlp"},
        {"train_s": 0.0},
        {"extra": 1},
    ],
)
def test_the_table_check_sees(change: dict[str, Any]) -> None:
    report = valid_table()
    report["rows"][-1].update(change)
    with pytest.raises(AssertionError):
        check_table_report(report)


def valid_fork() -> dict[str, Any]:
    settings = {"heads": ["DiagGaussianHead", "MixtureHead"], "seeds": [3]}
    numbers = {"seed": 3, "test_log_prob": -1.5, "wall_mass": 0.25, "success": 0.5}
    planners = ("sample", "mean")
    return {
        "settings": settings,
        "wall_s": 1.0,
        "rows": [{"head": head, "planner": how, **numbers} for head in settings["heads"] for how in planners],
        "oracle": [{"head": "true density", "planner": how, **numbers} for how in planners],
        "mean_in_wall": [{"head": head, "seed": 3, "mean_in_wall": 1.0} for head in settings["heads"]],
    }


def test_the_fork_check_accepts_a_valid_report() -> None:
    check_fork_report(valid_fork())


@pytest.mark.parametrize(
    "change",
    [
        {"head": "DiagGaussianHead"},
        {"planner": "sample"},
        {"seed": 4},
        {"test_log_prob": math.nan},
        {"test_log_prob": -2.0},
        {"wall_mass": 1.5},
        {"success": -0.5},
        {"extra": 1},
    ],
)
def test_the_fork_check_sees(change: dict[str, Any]) -> None:
    report = valid_fork()
    report["rows"][-1].update(change)
    with pytest.raises(AssertionError):
        check_fork_report(report)


# What the fork computes


@pytest.fixture(scope="module")
def fork() -> Any:
    """The script as a module."""
    return importlib.import_module("fork")


def test_the_fork_learns_from_crashes_too(fork: Any) -> None:
    """A crash is only ever a next observation; each step of an episode is there once."""
    data = fork.collect(200, seed=0)
    system = fork.ForkSystem()
    before, after = data["observation"].unbind(1)
    assert not system.in_wall(before).any()
    crashed = system.in_wall(after)
    assert crashed.sum() > 10
    starts = (before[:, 0] == system.start_along).nonzero().squeeze(-1)
    assert len(starts) == 200
    ends = torch.cat([starts[1:], torch.tensor([len(before)])])
    assert (crashed[ends - 1] | (ends - starts == system.episode_length)).all()
    assert crashed.sum() == crashed[ends - 1].sum()
    density = system.dist(before, data["action"][:, 0]).log_prob(after)
    assert density.min() > -20, "the action is that of the step"


def test_the_forks_densities_are_those_of_positions(fork: Any) -> None:
    """A Gaussian in the latent, by hand in the coordinates of the road."""
    torch.manual_seed(0)
    matrix, offset = torch.randn(2, 2), torch.randn(2)
    belief = fork.Belief(
        lambda latent, action: diag_gaussian(latent + action, torch.tensor([0.3, 0.7])), matrix, offset
    )
    position, action = torch.randn(5, 2), torch.randn(5, 1)
    inverse = torch.linalg.inv(matrix)
    loc = position + action @ torch.ones(1, 2) @ inverse.mT
    covariance = inverse @ torch.diag(torch.tensor([0.09, 0.49])) @ inverse.mT
    expected = torch.distributions.MultivariateNormal(loc, covariance)
    after = torch.randn(5, 2)
    torch.testing.assert_close(
        belief.log_prob(position, action, after), expected.log_prob(after), rtol=1e-3, atol=1e-3
    )
    torch.testing.assert_close(belief.mean(position, action), loc, rtol=1e-4, atol=1e-4)
    samples = belief.sample(position, action, 20_000)
    torch.testing.assert_close(samples.mean(0), loc, rtol=0, atol=5 * covariance.max().sqrt().item() / 140)


def test_the_forks_belief_reads_the_encoder_off(fork: Any) -> None:
    settings = fork.Settings(train_steps=2, batch_size=16, num_cells=8)
    data = fork.collect(20, seed=0)
    model = fork.train("FullGaussianHead", data, 0, settings)
    belief = fork.Belief.of(model)
    position = data["observation"][:, 0]
    latent = model.encoder(TensorDict(observation=position, batch_size=[len(position)]))["latent"]
    torch.testing.assert_close(belief.encode(position), latent, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(belief.decode(latent), position, rtol=1e-3, atol=1e-3)


def test_the_forks_aims_are_safe_though_the_mean_is_not(fork: Any) -> None:
    system = fork.ForkSystem()
    position, action = fork.safe_aims(fork.collect(300, seed=1), system)
    assert len(position) > 50
    assert system.wall_mass(position, action).max() < 1e-3
    assert system.in_wall(system.dist(position, action).mean).all()


# What the table computes


def table_settings(module: Any, **changes: Any) -> Any:
    """A robust run of seconds, from data of a few hundred steps."""
    small = {"seeds": [0], "noise_scales": [8.0], "train_length": 400, "test_length": 100}
    race = {"restarts": 3, "finalists": 2, "heat_steps": 6, "steps": 12}
    return module.Settings(**{**small, **race, "sizes": [2, 2, 6], **changes})


@pytest.fixture(scope="module")
def table() -> Any:
    """The script as a module: pytest knows the folder."""
    return importlib.import_module("noisy_tv_table")


@pytest.mark.parametrize("encoder", ["linear", "mlp"])
@pytest.mark.parametrize(
    ("preset", "name"),
    [("paper", "VAE"), ("paper", "AR"), ("paper", "VJEPA"), ("robust", "JEPA"), ("robust", "BJEPA")],
)
def test_a_run_does_not_depend_on_the_others(table: Any, preset: str, name: str, encoder: str) -> None:
    alone, *_ = table.run_task((preset, name, (0,)), table_settings(table, encoder=encoder))
    settings = table_settings(table, encoder=encoder, noise_scales=[0.0, 2.0, 8.0])
    together, *_ = table.run_task((preset, name, (1, 0)), settings)
    assert [(row["seed"], row["noise_scale"]) for row in together] == [
        (seed, scale) for seed in (1, 0) for scale in (0.0, 2.0, 8.0)
    ]
    for key in ("signal_r2_train", "signal_r2", "noise_r2_train", "noise_r2"):
        assert together[-1][key] == pytest.approx(alone[0][key], abs=1e-3)


@pytest.mark.parametrize(
    ("restarts", "finalists", "rounds"), [(4, 2, [(8, 6), (4, 12)]), (1, 2, [(2, 6), (2, 12)])]
)
def test_the_race_keeps_the_best_starts_of_each_run(
    table: Any,
    monkeypatch: pytest.MonkeyPatch,
    restarts: int,
    finalists: int,
    rounds: list[tuple[int, int]],
) -> None:
    settings = table_settings(table, restarts=restarts, finalists=finalists, noise_scales=[0.0, 8.0])
    runs = table.Run.simulate(0, settings)
    starts = table.make_models(table.robust_model, "VJEPA", runs, restarts, settings)
    weights = torch.stack([model.encoder.module.network.weight.detach() for model in starts])
    # Of the first run start 1 wins the heat and start 3 the race; of the second 2 and 0.
    scores = [
        torch.tensor([[0.0, 3.0, 1.0, 2.0], [1.0, 0.0, 2.0, -1.0]])[:, :restarts],
        torch.tensor([[1.0, 2.0], [0.0, 5.0]])[:, : min(restarts, finalists)],
    ]
    seen = []

    def fit(loss: Any, observations: Tensor, steps: int, settings: Any) -> Tensor:
        seen.append((loss.num_models, steps))
        return scores[len(seen) - 1]

    monkeypatch.setattr(table, "fit_robust", fit)
    chosen = [model.encoder.module.network.weight for model in table.train_robust("VJEPA", runs, settings)]
    assert seen == rounds
    expected = weights[[3, restarts]] if restarts > 1 else weights
    torch.testing.assert_close(torch.stack(chosen).detach(), expected)


@pytest.mark.parametrize("encoder", ["linear", "mlp"])
def test_every_start_of_a_race_trains(table: Any, encoder: str) -> None:
    settings = table_settings(table, encoder=encoder)
    (run,) = table.Run.simulate(0, settings)
    before = table.make_models(table.robust_model, "VJEPA", [run], 2, settings)
    models = table.make_models(table.robust_model, "VJEPA", [run], 2, settings)
    observations = run.normalise("whitening")[0].unsqueeze(0)
    for _ in range(2):
        loss = table.robust_loss("VJEPA", models, settings)
        scores = table.fit_robust(loss, observations, 4, settings)
        assert scores.shape == (1, 2)
        models = [loss.get_model(i) for i in range(2)]
        for model, old in zip(models, before, strict=True):
            for value, other in zip(model.encoder.parameters(), old.encoder.parameters(), strict=True):
                assert (value != other).any()
        before = copy.deepcopy(models)


@pytest.mark.parametrize("name", ["AR", "JEPA"])
def test_few_pairs_give_the_losses_and_gradients_of_all(table: Any, name: str) -> None:
    settings = table_settings(table, noise_scales=[0.0, 8.0])
    runs = table.Run.simulate(0, settings)
    observations = torch.stack([run.normalise("standard")[0] for run in runs]).double()
    few = table.same_moments(observations)
    everything = torch.stack([observations[:, :-1], observations[:, 1:]], dim=2)
    assert few.shape == (2, 13, 2, 6)
    assert everything.shape == (2, 400, 2, 6)
    results = []
    for windows in (few, everything):
        models = table.make_models(table.paper_model, name, runs, 1, settings)
        loss = table.paper_loss(name, models, settings).double()
        if name == "JEPA":
            SoftUpdate(loss, eps=0.99)  # TorchRL warns without one
        losses = loss(TensorDict(observation=windows, batch_size=windows.shape[:-1]))
        table.objective(losses).sum().backward()
        gradients = [p.grad for p in loss.parameters() if p.grad is not None]
        results.append([table.objective(losses).detach(), *gradients])
    assert len(results[0]) > 2
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)


def test_the_trajectory_is_the_papers(table: Any) -> None:
    settings = table.Settings(noise_scales=[0.0, 8.0], train_length=20, test_length=10)
    quiet, loud = table.Run.simulate(111, settings)
    torch.testing.assert_close(
        quiet.train["signal"][1], torch.tensor([0.81259, 0.34068, 0.64831, -0.91999]), atol=1e-4, rtol=0
    )
    assert torch.equal(quiet.test["signal"], loud.test["signal"])
    shift = 8.0 * loud.train["distractor"] @ loud.system.D.float().mT
    torch.testing.assert_close(
        loud.train["observation"] - quiet.train["observation"], shift, atol=1e-4, rtol=0
    )


@pytest.mark.parametrize(
    ("average", "name"), [("uniform", "uniform_average"), ("weighted", "variance_weighted")]
)
def test_r2_is_that_of_scikit_learn(table: Any, average: str, name: str) -> None:
    generator = torch.Generator().manual_seed(0)
    target = torch.randn(50, 3, generator=generator) * torch.tensor([1.0, 2.0, 5.0])
    prediction = target + torch.randn(50, 3, generator=generator)
    expected = r2_score(target.numpy(), prediction.numpy(), multioutput=name)
    assert table.r2_score(target, prediction, average) == pytest.approx(expected, abs=1e-6)


def test_cca_finds_the_signal_without_labels(table: Any) -> None:
    settings = table.Settings(noise_scales=[8.0], train_length=2000, test_length=500)
    scores = {row["model"]: row["signal_r2"] for row in table.oracles(0, settings)}
    assert set(scores) == set(table.ORACLES)
    assert min(scores.values()) > 0.98


@pytest.fixture(scope="module")
def full_recipe(table: Any) -> dict[str, Any]:
    """A row of the robust preset."""
    (row,), *_ = table.run_task(("robust", "VJEPA", (0,)), table_settings(table))
    return row


@pytest.mark.parametrize(
    "change",
    [
        {"normalisation": "standard"},
        {"entropy": "none"},
        {"entropy": "sliced"},
        {"entropy_coeff": 0.5},
        {"residual_variance": "head"},
        {"target_scale": "learned"},
        {"schedule": "constant"},
        {"ema_decay": 0.99},
        {"skip_weights": [1.0, 1.0, 1.0]},
        {"finalists": 1, "restarts": 1},
        {"lr": 0.1},
    ],
    ids=str,
)
def test_every_ingredient_of_the_robust_recipe_can_be_changed(
    table: Any, full_recipe: dict[str, Any], change: dict[str, Any]
) -> None:
    (changed,), *_ = table.run_task(("robust", "VJEPA", (0,)), table_settings(table, **change))
    assert math.isfinite(changed["signal_r2"])
    assert changed["signal_r2"] != full_recipe["signal_r2"]


@pytest.fixture(scope="module")
def ablations() -> Any:
    """The benchmark as a module."""
    yield from load("ablations", "benchmarks")


def test_the_ablations_change_one_recipe(ablations: Any) -> None:
    script = ablations.load_script()
    full = script.Settings()
    for variant, changes in ablations.VARIANTS.items():
        assert (vars(replace(full, **changes)) == vars(full)) == (variant == "full recipe")
    row = {"model": "VJEPA", "variant": "full recipe", "signal_r2": 1.0, "noise_r2": None, "train_s": 1.0}
    other = {**row, "signal_r2": 0.5, "noise_r2": 0.25}
    cells = ablations.table([row, other]).splitlines()[-1].split()
    assert cells == ["VJEPA", "full", "recipe", "0.7500", "0.5000", "50%", "0.2500", "1.00"]
    assert ablations.applies("VJEPA", "variance of the head")
    assert not ablations.applies("JEPA", "variance of the head")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (["--models", "PCA"], "VAE"),
        (["--preset", "robust", "--models", "VAE"], "VAE"),
        (["--entropy", "none", "--entropy-coeff", "1"], "no weight"),
        (["--heat-steps", "5"], "at least 6"),
    ],
)
def test_the_table_refuses(
    table: Any, wrong: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        table.parse(wrong)
    assert message in capsys.readouterr().err


def test_a_report_with_nan_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text(json.dumps({"wall_s": float("nan")}), encoding="utf-8")
    with pytest.raises(ValueError, match="NaN is not JSON"):
        load_report(path)


def test_the_warning_pattern_sees_ours_only() -> None:
    ours = "50%|##   | 1/2/venv/x/torchrl_vjepa/models.py:12: UserWarning: collapse"
    theirs = "/venv/site-packages/torchrl/envs/common.py:3: DeprecationWarning: old"
    assert WARNING.search(ours)
    assert not WARNING.search(theirs)
