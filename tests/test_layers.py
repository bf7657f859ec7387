"""The architecture as a test: imports go downward, and the package stays light to import."""

from __future__ import annotations

import ast
import graphlib
import importlib
import inspect
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "torchrl_vjepa"

# Files and folders directly under the package; a folder's leaves share its layer.
LAYERS = {
    "actions": 0,
    "distributions": 0,
    "generators": 0,
    "stacking": 0,
    "fork": 0,
    "noisy_tv": 0,
    "signatures": 0,
    "simulation": 0,
    "statistics": 0,
    "windows": 0,
    "belief": 1,
    "common_random_numbers": 1,
    "encoders": 1,
    "heads": 1,
    "priors": 1,
    "temperature": 1,
    "whitening": 1,
    "costs": 2,
    "fusion": 2,
    "predictor": 2,
    "risk": 2,
    "state_heads": 2,
    "baselines": 3,
    "diagnostics": 3,
    "envs": 3,
    "imagination": 3,
    "latent_step": 3,
    "models": 3,
    "objectives": 3,
    "planners": 3,
}
# Who may import whom within one layer.
SIDEWAYS = {
    ("distributions", "stacking"),
    ("statistics", "stacking"),
    ("fork", "simulation"),
    ("noisy_tv", "simulation"),
    ("simulation", "signatures"),
    ("common_random_numbers", "belief"),
    ("encoders", "whitening"),
    ("baselines", "models"),
    ("baselines", "objectives"),
    ("predictor", "fusion"),
    ("common_random_numbers", "belief"),
    ("diagnostics", "models"),
    ("objectives", "models"),
    ("envs", "imagination"),
    ("envs", "latent_step"),
    ("predictor", "fusion"),
    ("envs", "models"),
    ("planners", "envs"),
}
DEPENDENCIES = {"gymnasium", "numpy", "tensordict", "torch", "torchrl"}
OPTIONAL = {"scipy"}  # an extra: imported where it is used


class Import(NamedTuple):
    target: str
    line: int
    inside_function: bool


def module_names(package: Path) -> dict[str, Path]:
    """Dotted name of every module of a package, the root included."""
    names = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package.parent).with_suffix("").parts
        names[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return names


def imports_of(name: str, path: Path, modules: dict[str, Path]) -> Iterator[Import]:
    """Every module that a file imports, relative imports and submodules resolved."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]

    def visit(node: ast.AST, inside: bool) -> Iterator[Import]:
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(alias.name, node.lineno, inside)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                anchor = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*anchor, base] if base else anchor)
            for alias in node.names:
                submodule = f"{base}.{alias.name}"
                yield Import(submodule if submodule in modules else base, node.lineno, inside)
        nested = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
        for child in ast.iter_child_nodes(node):
            yield from visit(child, inside or nested)

    yield from visit(ast.parse(path.read_text(encoding="utf-8")), False)


def violations(package: Path, layers: dict[str, int], sideways: set[tuple[str, str]]) -> list[str]:
    """One sentence for each import (or module) that breaks the architecture."""
    root = package.name
    modules = module_names(package)
    found = []
    graph: dict[str, set[str]] = {name: set() for name in modules}
    for name, path in modules.items():
        unit = name.split(".")[1] if name != root else ""
        if unit and unit not in layers:
            found.append(f"{name} has no layer")
            continue
        for item in imports_of(name, path, modules):
            where = f"{name}:{item.line}"
            top = item.target.split(".")[0]
            if top != root:
                if top in sys.stdlib_module_names or top in DEPENDENCIES:
                    continue
                if top not in OPTIONAL:
                    found.append(f"{where} imports {top}, which is no core dependency")
                elif not item.inside_function:
                    found.append(f"{where} imports the extra {top} outside a function")
                continue
            if item.target not in modules:
                found.append(f"{where} imports {item.target}, which does not exist")
                continue
            graph[name].add(item.target)
            if not unit:
                continue
            if item.target == root:
                found.append(f"{where} imports from the package root")
                continue
            other = item.target.split(".")[1]
            if other == unit:
                if item.target == f"{root}.{unit}":
                    found.append(f"{where} imports its own folder instead of a leaf")
            elif other not in layers:
                found.append(f"{where} imports {other}, which has no layer")
            elif layers[other] >= layers[unit] and (unit, other) not in sideways:
                found.append(f"{where} (layer {layers[unit]}) imports {other} (layer {layers[other]})")
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        found.append(f"import cycle: {' -> '.join(error.args[1])}")
    return found


def test_imports_go_downward() -> None:
    assert violations(PACKAGE, LAYERS, SIDEWAYS) == []


def test_every_layer_entry_exists() -> None:
    names = {name.split(".")[1] for name in module_names(PACKAGE) if "." in name}
    assert set(LAYERS) <= names


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"low.py": "", "high.py": "from pkg.low import x"}, None),
        ({"low.py": "import math, torch.nn\nfrom numpy import array"}, None),
        ({"low.py": "def f():\n    import scipy.linalg"}, None),
        ({"high.py": "from pkg.side import x", "side.py": ""}, None),
        ({"box/__init__.py": "from pkg.box.leaf import x", "box/leaf.py": ""}, None),
        ({"box/a.py": "from pkg.box.b import x", "box/b.py": ""}, None),
        ({"low.py": "from pkg.high import x", "high.py": ""}, "pkg.low:1 (layer 0)"),
        ({"low.py": "import pkg.high", "high.py": ""}, "pkg.low:1 (layer 0)"),
        ({"low.py": "from .high import x", "high.py": ""}, "pkg.low:1 (layer 0)"),
        ({"low.py": "def f():\n    import pkg.high", "high.py": ""}, "pkg.low:2 (layer 0)"),
        ({"box/leaf.py": "from ..high import x", "high.py": ""}, "pkg.box.leaf:1 (layer 0)"),
        ({"low.py": "from pkg.box.leaf import x", "box/leaf.py": ""}, "pkg.low:1 (layer 0)"),
        ({"side.py": "from pkg.high import x", "high.py": ""}, "pkg.side:1 (layer 1)"),
        ({"low.py": "from pkg import x"}, "pkg.low:1 imports from the package root"),
        ({"high.py": "from . import x"}, "pkg.high:1 imports from the package root"),
        ({"box/leaf.py": "from pkg.box import x", "box/__init__.py": ""}, "its own folder"),
        ({"box/a.py": "import pkg.box.b", "box/b.py": "import pkg.box.a"}, "import cycle"),
        ({"low.py": "import matplotlib.pyplot"}, "pkg.low:1 imports matplotlib"),
        ({"low.py": "def f():\n    from sklearn import svm"}, "pkg.low:2 imports sklearn"),
        ({"low.py": "import scipy"}, "imports the extra scipy outside a function"),
        ({"low.py": "class A:\n    from scipy import linalg"}, "outside a function"),
        ({"low.py": "from pkg.gone import x"}, "pkg.gone, which does not exist"),
        ({"new.py": ""}, "pkg.new has no layer"),
    ],
)
def test_the_checker_sees(files: dict[str, str], expected: str | None, tmp_path: Path) -> None:
    package = tmp_path / "pkg"
    for name, text in {"__init__.py": "", **files}.items():
        path = package / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    found = violations(package, {"low": 0, "box": 0, "high": 1, "side": 1}, sideways={("high", "side")})
    if expected is None:
        assert found == []
    else:
        assert [line for line in found if expected in line], found


def test_root_module_has_no_logic() -> None:
    body = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8")).body
    for node in body:
        docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        constant = isinstance(node, ast.Assign) and all(
            isinstance(target, ast.Name) and target.id in {"__all__", "__version__"}
            for target in node.targets
        )
        assert docstring or constant or isinstance(node, ast.ImportFrom), ast.unparse(node)


def test_public_names_are_explicit_sorted_and_documented() -> None:
    package = importlib.import_module("torchrl_vjepa")
    names = [name for name in package.__all__ if name != "__version__"]
    assert len(names) > 10
    assert names == sorted(names)
    assert len(names) == len(set(names))
    for name in names:
        value = getattr(package, name)
        assert not inspect.ismodule(value), name
        heading = re.search(r"^(## Examples|Examples:)$", inspect.getdoc(value) or "", re.MULTILINE)
        assert heading, f"{name} has no Examples section"
    imported = {
        alias.asname or alias.name
        for node in ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom) and node.module != "__future__"
        for alias in node.names
    }
    assert imported == set(names)


def test_import_is_quiet_light_and_without_side_effects() -> None:
    script = (
        "import sys, torch\n"
        "state, dtype = torch.get_rng_state(), torch.get_default_dtype()\n"
        "threads, grad = torch.get_num_threads(), torch.is_grad_enabled()\n"
        "import torchrl_vjepa\n"
        "assert torch.equal(state, torch.get_rng_state()), 'the global generator moved'\n"
        "assert dtype == torch.get_default_dtype()\n"
        "assert threads == torch.get_num_threads()\n"
        "assert grad == torch.is_grad_enabled()\n"
        "heavy = {'matplotlib', 'scipy', 'sklearn'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-W", "ignore:Creating:DeprecationWarning", "-c", script],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_library_code_neither_prints_nor_asserts() -> None:
    for name, path in module_names(PACKAGE).items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            printing = (
                isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
            )
            assert not printing, f"{name}:{node.lineno} prints"
            assert not isinstance(node, ast.Assert), f"{name}:{node.lineno} asserts"
