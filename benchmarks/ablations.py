"""Ablations: what each ingredient of the robust recipe is worth on the noisy TV.

Every variant changes one thing in the preset "robust" of examples/noisy_tv_table.py and trains the same
systems with the same steps. Score: the test R2 of a linear probe from the predicted latent to the signal
and to the distractor, over all seeds and noise scales. One process, one thread.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from statistics import mean
from types import ModuleType
from typing import Any

import torch
from tqdm import tqdm

SCRIPT = Path(__file__).resolve().parents[1] / "examples" / "noisy_tv_table.py"
SUCCESS = 0.99
# What each variant changes in the settings of the script.
VARIANTS: dict[str, dict[str, Any]] = {
    "full recipe": {},
    "standard scores, no whitening": {"normalisation": "standard"},
    "skip 1 alone": {"skips": [1], "skip_weights": [1.0]},
    "equal skip weights": {"skip_weights": [1.0, 1.0, 1.0]},
    "no entropy term": {"entropy": "none"},
    "sliced entropy term (SIGReg)": {"entropy": "sliced"},
    "variance of the head": {"residual_variance": "head"},
    "variance of the head, no entropy term": {"residual_variance": "head", "entropy": "none"},
    "scale of the target by the KL term": {"target_scale": "learned"},
    "one start": {"restarts": 1, "finalists": 1},
    "one finalist": {"finalists": 1},
    "every start a finalist": {"finalists": 1000},
    "constant learning rate 0.3": {"schedule": "constant"},
    "constant learning rate 0.03": {"schedule": "constant", "lr": 0.03},
    "EMA decay 0.5": {"ema_decay": 0.5},
    "EMA decay 0.99": {"ema_decay": 0.99},
}
# A JEPA has neither a variance nor a target distribution.
PROBABILISTIC = {"residual_variance", "target_scale"}


def option(default: Any, help: str, **more: Any) -> Any:
    """A setting with what --help says about it."""
    metadata = {"help": help, **more}
    if isinstance(default, list):
        return field(default_factory=lambda: list(default), metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass
class Settings:
    """What is measured."""

    models: list[str] = option(["VJEPA"], "models", choices=["JEPA", "VJEPA", "BJEPA"])
    variants: list[str] = option(
        list(VARIANTS), "recipes, each a change of the full one", choices=list(VARIANTS), metavar="VARIANT"
    )
    seeds: list[int] = option(list(range(10)), "each makes the matrices, the trajectories and the starts")
    noise_scales: list[float] = option([0.0, 4.0, 8.0], "scales of the distractor")
    restarts: int = option(8, "starts of each run; 1 shows how often a single start succeeds")


QUICK = {"seeds": [0], "noise_scales": [8.0], "variants": ["full recipe", "one start"], "restarts": 2}
QUICK_RECIPE = {"train_length": 600, "test_length": 200, "heat_steps": 6, "steps": 12}


def load_script() -> ModuleType:
    """The example as a module, which finds what the scripts share beside it."""
    if str(SCRIPT.parent) not in sys.path:
        sys.path.insert(0, str(SCRIPT.parent))
    return importlib.import_module(SCRIPT.stem)


def applies(name: str, variant: str) -> bool:
    """Whether the variant differs from the full recipe for this model."""
    return name != "JEPA" or not PROBABILISTIC & set(VARIANTS[variant])


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One line for each model and variant: signal, distractor and cost, over seeds and scales."""
    lines = [
        f"{'':45s}{'signal R2':^27s}{'noise R2':>10s}{'train':>9s}",
        f"{'model':6s} {'recipe':38s}{'mean':>9s}{'worst':>9s}{f'>= {SUCCESS}':>9s}"
        f"{'worst':>10s}{'s/run':>9s}",
    ]
    for name, variant in dict.fromkeys((row["model"], row["variant"]) for row in rows):
        here = [row for row in rows if (row["model"], row["variant"]) == (name, variant)]
        signal = [row["signal_r2"] for row in here]
        noise = [row["noise_r2"] for row in here if row["noise_r2"] is not None]
        share = mean(value >= SUCCESS for value in signal)
        lines.append(
            f"{name:6s} {variant:38s}{mean(signal):9.4f}{min(signal):9.4f}{share:9.0%}"
            + (f"{max(noise):10.4f}" if noise else f"{'-':>10s}")
            + f"{mean(row['train_s'] for row in here):9.2f}"
        )
    return "\n".join(lines)


def parse(arguments: Sequence[str] | None = None) -> tuple[Settings, argparse.Namespace]:
    """The settings, and where the results go."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.epilog = "variants: " + "; ".join(VARIANTS)
    for entry in fields(Settings):
        default = getattr(Settings(), entry.name)
        many = isinstance(default, list)
        shown = " ".join(map(str, default)) if many else default
        shown = "all" if entry.name == "variants" else shown
        more = {key: value for key, value in entry.metadata.items() if key != "help"}
        parser.add_argument(
            "--" + entry.name.replace("_", "-"),
            type=type(default[0] if many else default),
            nargs="+" if many else None,
            help=f"{entry.metadata['help']} (default: {shown})",
            **more,
        )
    parser.add_argument("--quick", action="store_true", help="tiny sizes: a test, not a result")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write settings and rows as JSON")
    args = parser.parse_args(arguments)
    given = {entry.name: getattr(args, entry.name) for entry in fields(Settings)}
    given = {name: value for name, value in given.items() if value is not None}
    return replace(Settings(), **{**(QUICK if args.quick else {}), **given}), args


def main(arguments: Sequence[str] | None = None) -> None:
    """Train every variant, print the table, write the JSON."""
    settings, args = parse(arguments)
    torch.set_num_threads(1)
    script = load_script()
    recipe = script.Settings(noise_scales=settings.noise_scales, restarts=settings.restarts)
    recipe = replace(recipe, **(QUICK_RECIPE if args.quick else {}))
    start = time.perf_counter()
    work = [
        (name, variant, seed)
        for name in settings.models
        for variant in settings.variants
        if applies(name, variant)
        for seed in settings.seeds
    ]
    rows = []
    for name, variant, seed in tqdm(work, leave=False):
        changed = replace(recipe, **VARIANTS[variant])
        results, *_ = script.run_task(("robust", name, (seed,)), changed)
        rows += [{"variant": variant, **row} for row in results]
    wall = time.perf_counter() - start
    print(table(rows))
    print(f"\n{len(rows)} runs in {wall:.0f} s")
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        result = {"settings": asdict(settings), "recipe": asdict(recipe), "wall_s": wall, "rows": rows}
        args.json.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
