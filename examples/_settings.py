"""What the scripts share: a dataclass of settings whose fields are the options of a command line."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import torch
from torchrl import logger

S = TypeVar("S")


def option(default: Any, help: str, **more: Any) -> Any:
    """A field with what --help says about it, and what else argparse is told."""
    metadata = {"help": help, **more}
    if isinstance(default, list):
        return field(default_factory=lambda: list(default), metadata=metadata)
    return field(default=default, metadata=metadata)


def command_line(settings: type, description: str | None) -> argparse.ArgumentParser:
    """A parser with one option for each field, and those for where the results go."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    defaults = settings()
    for entry in fields(settings):
        default = getattr(defaults, entry.name)
        many = isinstance(default, list)
        shown = " ".join(map(str, default)) if many else default
        more = {key: value for key, value in entry.metadata.items() if key != "help"}
        parser.add_argument(
            "--" + entry.name.replace("_", "-"),
            type=type(default[0] if many else default),
            help=f"{entry.metadata['help']} (default: {shown})",
            **{"nargs": "+" if many else None, **more},
        )
    parser.add_argument("--quick", action="store_true", help="tiny sizes: a test, not a result")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write settings and rows as JSON")
    parser.add_argument(
        "--out", type=Path, default=Path("outputs"), metavar="FOLDER", help="where the figures go"
    )
    return parser


def read_settings(
    parser: argparse.ArgumentParser,
    settings: type[S],
    quick: Mapping[str, Any],
    arguments: Sequence[str] | None = None,
) -> tuple[S, argparse.Namespace]:
    """The settings, and all arguments; what is given wins over --quick."""
    args = parser.parse_args(arguments)
    if args.quick:
        print("--quick: tiny sizes, to see that it runs; the numbers are no results")
    given = {entry.name: getattr(args, entry.name) for entry in fields(settings)}
    given = {name: value for name, value in given.items() if value is not None}
    return replace(settings(), **{**(quick if args.quick else {}), **given}), args


def prepare(args: argparse.Namespace) -> None:
    """Folders for the results, and what every script tells torch."""
    for path in (args.out, args.json.parent if args.json else args.out):
        path.mkdir(parents=True, exist_ok=True)
    logger.setLevel("WARNING")  # TorchRL tells of every storage that it makes
    # The tensors are small: a second process may help, more threads would only wait for each other.
    torch.set_num_threads(1)


def write_report(args: argparse.Namespace, settings: Any, **entries: Any) -> None:
    """The settings and the results as JSON, if that was asked for."""
    if args.json:
        args.json.write_text(json.dumps({"settings": asdict(settings), **entries}, indent=1))
