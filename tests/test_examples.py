"""Every script in examples/ runs with its smallest budget and keeps its command line."""

from __future__ import annotations

import copy
import importlib
import json
import math
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from sklearn.metrics import r2_score
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives import SoftUpdate

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
    assert set(report) == {"settings", "wall_s", "rows"}
    settings, rows = report["settings"], report["rows"]
    assert report["wall_s"] > 0
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


CHECKS = {
    "noisy_tv_mppi": check_report,
    "noisy_tv_table": check_table_report,
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
    return {"settings": settings, "wall_s": 1.0, "rows": rows}


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
    alone, _ = table.run_task((preset, name, 0), table_settings(table, encoder=encoder))
    settings = table_settings(table, encoder=encoder, noise_scales=[0.0, 2.0, 8.0])
    together, _ = table.run_task((preset, name, 0), settings)
    assert [row["noise_scale"] for row in together] == [0.0, 2.0, 8.0]
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
    observations = run.normalise("robust")[0].unsqueeze(0)
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
    observations = torch.stack([run.normalise("paper")[0] for run in runs]).double()
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


@pytest.mark.parametrize("wrong", [["--models", "PCA"], ["--preset", "robust", "--models", "VAE"]])
def test_the_table_refuses(table: Any, wrong: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        table.parse(wrong)
    assert "VAE" in capsys.readouterr().err


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
