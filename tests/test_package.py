"""The files around the code agree with each other: versions, pins, package contents."""

from __future__ import annotations

import importlib.metadata
import re
import sys
from pathlib import Path
from typing import Any

import pytest
import setuptools

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PIN = re.compile(r"^([a-z0-9][a-z0-9-]*)==([0-9][\w.]*)(; python_version >= \"3\.\d+\")?$")


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.fixture(scope="module")
def pyproject() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    matches = [PIN.match(line) for line in lines]
    assert all(matches), "constraints.txt holds exact versions only"
    return {match[1]: match[2] for match in matches if match}


def test_torch_is_pinned_first(pins: dict[str, str]) -> None:
    assert next(iter(pins.items())) == ("torch", "2.13.0")


def test_every_dependency_is_pinned(pyproject: dict[str, Any], pins: dict[str, str]) -> None:
    project = pyproject["project"]
    extras = project["optional-dependencies"]
    for requirement in [*project["dependencies"], *(name for extra in extras.values() for name in extra)]:
        name = canonical(re.split(r"[<>=!~; \[]", requirement)[0])
        assert name in pins, f"{name} has no version in constraints.txt"


def test_pins_are_sorted_after_torch(pins: dict[str, str]) -> None:
    rest = list(pins)[1:]
    assert rest == sorted(rest)


def test_building_does_not_need_torch(pyproject: dict[str, Any]) -> None:
    assert not [name for name in pyproject["build-system"]["requires"] if "torch" in name]


def test_every_subpackage_is_shipped(pyproject: dict[str, Any]) -> None:
    found = setuptools.find_packages(
        str(ROOT), include=pyproject["tool"]["setuptools"]["packages"]["find"]["include"]
    )
    folders = {path.parent.relative_to(ROOT) for path in (ROOT / "torchrl_vjepa").rglob("*.py")}
    assert set(found) == {".".join(folder.parts) for folder in folders}
    assert (ROOT / "torchrl_vjepa" / "py.typed").is_file()


def test_installed_version_is_the_declared_one(pyproject: dict[str, Any]) -> None:
    try:
        installed = importlib.metadata.version("torchrl-vjepa")
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("running from the source tree, not from an installation")
    assert installed == pyproject["project"]["version"]


def test_changelog_has_an_unreleased_section() -> None:
    assert "## [Unreleased]\n" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_no_file_is_too_long() -> None:
    """A file that outgrows a reader's head becomes a folder of leaves."""
    for path in sorted((ROOT / "torchrl_vjepa").rglob("*.py")):
        lines = len(path.read_text(encoding="utf-8").splitlines())
        assert lines <= 520, f"{path.relative_to(ROOT)} has {lines} lines"
