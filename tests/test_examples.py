"""Every script in examples/ runs with its smallest budget and keeps its command line."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest

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
# "path:line: Category: message", raised at a line of this repository
WARNING = re.compile(r"\S*(?:torchrl_vjepa|examples)/\S*\.py:\d+: \w*Warning: .*")


class Run(NamedTuple):
    returncode: int
    stdout: str
    stderr: str
    folder: Path
    report: Path


def start(script: Path, arguments: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "MPLBACKEND": "Agg", "PYTHONWARNINGS": "always"}
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


def test_there_are_examples() -> None:
    assert (ROOT / "examples" / "noisy_tv_mppi.py") in SCRIPTS


def test_help_lists_the_common_options(script: Path, tmp_path: Path) -> None:
    done = start(script, ["--help"], tmp_path)
    assert done.returncode == 0, done.stderr
    for option in ("--json", "--out", "--quick"):
        assert re.search(rf"{option}\b", done.stdout), option
    assert re.search(r"--seeds?\b", done.stdout)
    assert list(tmp_path.iterdir()) == []


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
    if script.stem == "noisy_tv_mppi":
        check_report(report)


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
