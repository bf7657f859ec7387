"""Documentation is executed: every docstring example, every README block, both commands."""

from __future__ import annotations

import ast
import doctest
import importlib
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "torchrl_vjepa"
README = (ROOT / "README.md").read_text(encoding="utf-8")

Definition = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


class Documented(NamedTuple):
    """A definition in the source; read from the syntax tree, so that no decorator hides it."""

    module: str
    name: str
    node: Definition
    public: bool

    @property
    def label(self) -> str:
        return f"{self.module}:{self.name}" if self.name else self.module

    @property
    def docstring(self) -> str:
        return ast.get_docstring(self.node, clean=True) or ""

    @property
    def line(self) -> int:
        first = self.node.body[0] if self.docstring else self.node
        return first.lineno


def public_names(tree: ast.Module) -> set[str] | None:
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else []
        if any(isinstance(target, ast.Name) and target.id == "__all__" for target in targets):
            return set(ast.literal_eval(node.value))
    return None


def definitions(path: Path) -> Iterator[Documented]:
    parts = path.relative_to(ROOT).with_suffix("").parts
    module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = public_names(tree) or set()

    def visit(parent: Definition, prefix: str, public: bool) -> Iterator[Documented]:
        for node in parent.body:
            if isinstance(node, (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
                shown = node.name in names if not prefix else not node.name.startswith("_")
                name = f"{prefix}{node.name}"
                yield Documented(module, name, node, public and shown)
                if isinstance(node, ast.ClassDef):
                    yield from visit(node, f"{name}.", public and shown)

    yield Documented(module, "", tree, True)
    yield from visit(tree, "", True)


def decorators(node: Definition) -> set[str]:
    """Names of the decorators, without their arguments."""
    expressions = getattr(node, "decorator_list", [])
    return {ast.unparse(item.func if isinstance(item, ast.Call) else item) for item in expressions}


def documented_elsewhere(node: Definition) -> bool:
    """True for overloads and setters: the implementation and the getter carry the text."""
    return any(name.endswith(("overload", ".setter", ".deleter")) for name in decorators(node))


DEFINITIONS = [item for path in sorted(PACKAGE.rglob("*.py")) for item in definitions(path)]
EXAMPLES = [item for item in DEFINITIONS if ">>>" in item.docstring]
PUBLIC = [item for item in DEFINITIONS if item.public and not documented_elsewhere(item.node)]


def takes_arguments(node: Definition) -> bool:
    """True if a caller passes something: a bound first argument does not count."""
    if isinstance(node, ast.ClassDef):
        for child in node.body:
            if isinstance(child, ast.FunctionDef) and child.name == "__init__":
                return takes_arguments(child)
        generated = any("dataclass" in name for name in decorators(node)) or any(
            ast.unparse(base).endswith("NamedTuple") for base in node.bases
        )
        return generated and any(isinstance(child, ast.AnnAssign) for child in node.body)
    assert isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
    arguments = node.args
    names = [argument.arg for argument in arguments.posonlyargs + arguments.args]
    if names and names[0] in {"self", "cls"}:
        names = names[1:]
    return bool(names or arguments.kwonlyargs or arguments.vararg or arguments.kwarg)


def missing_sections(item: Documented) -> list[str]:
    """The sections of the house style that a public definition lacks."""
    if not item.docstring:
        return ["docstring"]
    if isinstance(item.node, ast.Module):
        return []
    # Google's headings, or those of Gymnasium for an environment.
    headings = set(re.findall(r"^(?:(?=.*:$)|## )(\w+):?$", item.docstring, flags=re.MULTILINE))
    missing = []
    if takes_arguments(item.node) and not headings & {"Args", "Arguments", "Attributes"}:
        missing.append("Args")
    method = "." in item.name
    if not method and not ("Examples" in headings and ">>>" in item.docstring):
        missing.append("Examples")
    return missing


@pytest.mark.parametrize("item", EXAMPLES, ids=[item.label for item in EXAMPLES])
def test_docstring_example(item: Documented, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    namespace = dict(vars(importlib.import_module(item.module)))
    example = doctest.DocTestParser().get_doctest(
        item.docstring, namespace, item.label, item.label, item.line
    )
    report: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    result = runner.run(example, out=report.append)
    assert result.failed == 0, "".join(report)
    assert result.attempted > 0


def test_every_module_lists_its_public_names() -> None:
    for path in sorted(PACKAGE.rglob("*.py")):
        names = public_names(ast.parse(path.read_text(encoding="utf-8")))
        assert names is not None, f"{path.relative_to(ROOT)} has no __all__"


@pytest.mark.parametrize("item", PUBLIC, ids=[item.label for item in PUBLIC])
def test_public_definition_is_documented(item: Documented) -> None:
    assert missing_sections(item) == []


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("def f():\n    pass", ["docstring"]),
        ("def f():\n    '''F.'''", ["Examples"]),
        ("def f():\n    '''F.\n\n    Examples:\n        Text.\n    '''", ["Examples"]),
        ("def f():\n    '''F.\n\n    Examples:\n        >>> 1\n        1\n    '''", []),
        ("def f(*, x):\n    '''F.'''", ["Args", "Examples"]),
        ("class C:\n    '''C.'''\n    def __init__(self, x): ...", ["Args", "Examples"]),
        ("class C:\n    '''C.'''\n    def __init__(self): ...", ["Examples"]),
        (
            "def f(x):\n    '''F.\n\n    ## Arguments\n    ## Examples\n    >>> 1\n    1\n    '''",
            [],
        ),
        (
            "def f(x):\n    '''F.\n\n    Args\n    Examples\n    >>> 1\n    1\n    '''",
            ["Args", "Examples"],
        ),
        ("@dataclass(frozen=True)\nclass C:\n    '''C.'''\n    x: int", ["Args", "Examples"]),
    ],
)
def test_the_documentation_check_sees(source: str, expected: list[str]) -> None:
    node = ast.parse(source).body[0]
    assert isinstance(node, (ast.ClassDef, ast.FunctionDef))
    assert missing_sections(Documented("m", node.name, node, True)) == expected


# README and docs ----------------------------------------------------------------------------------

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def python_blocks() -> list[tuple[str, int, str]]:
    """Page, line number and text of every Python block."""
    found = []
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        for block in re.finditer(r"^```python\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL):
            found.append((path.name, text.count("\n", 0, block.start()) + 1, block[1]))
    return found


def command(label: str) -> str:
    """The command under ``<!-- command: label -->``, as ``.ci/run`` reads it."""
    found = re.findall(
        rf"^<!-- command: {label} -->\n```bash\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL
    )
    assert len(found) == 1, f"README.md must mark exactly one command '{label}'"
    return found[0]


def test_readme_has_python_blocks() -> None:
    assert "README.md" in {page for page, _, _ in python_blocks()}


@pytest.mark.parametrize(
    ("page", "line", "block"),
    python_blocks(),
    ids=[f"{page}:{line}" for page, line, _ in python_blocks()],
)
def test_block_runs(
    page: str, line: int, block: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile("\n" * line + block, page, "exec"), {"__name__": "documentation"})


@pytest.mark.parametrize("label", ["main job", "tests"])
def test_readme_command_is_one_line_about_existing_things(label: str) -> None:
    text = command(label)
    assert text.count("\n") == 1
    assert text.endswith("\n")
    lexer = shlex.shlex(text, posix=True, punctuation_chars=True)
    lexer.whitespace_split = True
    words = list(lexer)
    steps = " ".join(words).split(" && ")
    assert steps[0].split()[0] == "python3", "the first step may rely on python3 only"
    assert all(step.split()[0].startswith(".venv/bin/") for step in steps[1:])
    files = [word for word in words if word.endswith((".py", ".txt"))]
    assert "constraints.txt" in files
    for name in files:
        assert (ROOT / name).is_file(), f"{name} does not exist"
    extras = re.findall(r"\.\[([\w,]+)\]", text)
    assert len(extras) == 1
    pyproject = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for extra in extras[0].split(","):
        assert re.search(rf"^{extra} = \[", pyproject, flags=re.MULTILINE), extra


def test_readme_commands_do_the_main_job_and_the_tests() -> None:
    assert command("main job").endswith("examples/noisy_tv_mppi.py\n")
    assert command("tests").endswith("-m pytest\n")


def test_ci_runs_the_readme_command() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "<!-- command: tests -->" in script
    assert "-m pytest" not in script, "the test command belongs to README.md alone"


def test_links_and_images_exist() -> None:
    missing, pictures = [], 0
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        targets = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'src="([^"]+)"', text)
        relative = [target.split("#")[0] for target in targets if not re.match(r"https?:|#", target)]
        missing += [f"{path.name}: {target}" for target in relative if not (path.parent / target).exists()]
        pictures += path.name == "README.md" and any(target.endswith(".png") for target in relative)
    assert missing == []
    assert pictures, "the README shows a picture"


def test_readme_names_exist() -> None:
    """The table from the paper to the code names only what is there."""
    package = importlib.import_module("torchrl_vjepa")
    section = README.split("## From the paper to the code")[1].split("\n## ")[0]
    rows = [row for row in section.splitlines() if row.startswith("| ")][2:]
    assert len(rows) > 8
    for row in rows:
        code = re.findall(r"`([^`]+)`", row.split("|")[2])
        assert code, row
        for name in code:
            if name.endswith(".py"):
                assert (ROOT / name).is_file() or (PACKAGE / name).is_file(), name
                continue
            value = package
            for part in name.removesuffix("()").split("."):
                assert hasattr(value, part), f"{name} (README) is not in torchrl_vjepa"
                value = getattr(value, part)
