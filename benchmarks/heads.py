"""Heads: what each costs, and what each can say about a fork.

Cost: milliseconds of processor time for a likelihood with its gradients, for a draw, for the mean and
for the mode of a batch of predictions, and their ratio to the diagonal Gaussian, interleaved in one
process. Quality: the test log-likelihood and the mass in the wall on a fork (right or left of a wall,
0.5 forward or back by the side), where the truth's own log-likelihood is known.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import torch
from torch import Tensor

from torchrl_vjepa import (
    DeltaHead,
    DiagGaussianHead,
    EnsembleHead,
    FlowHead,
    FullGaussianHead,
    Head,
    LowRankGaussianHead,
    MixtureHead,
    Predictor,
    point_estimate,
    sample,
)
from torchrl_vjepa.distributions import log_score

HEADS: dict[str, Callable[[], Head]] = {
    "DeltaHead": DeltaHead,
    "DiagGaussianHead": DiagGaussianHead,
    "FullGaussianHead": FullGaussianHead,
    "LowRankGaussianHead": lambda: LowRankGaussianHead(2),
    "MixtureHead": lambda: MixtureHead(5),
    "FlowHead": FlowHead,
    "EnsembleHead": lambda: EnsembleHead(num_members=5),
}
CALLS = ["train", "sample", "mean", "mode"]
BASELINE = "DiagGaussianHead"


def option(default: Any, help: str) -> Any:
    """A setting with its sentence for ``--help``."""
    return field(default=default, metadata={"help": help})


@dataclass
class Settings:
    """What is measured."""

    seed: int = option(0, "first random seed")
    num_seeds: int = option(3, "seeds of the fork")
    latent_dim: int = option(8, "size of the latent for the cost")
    batch: int = option(256, "predictions in a call")
    rounds: int = option(7, "interleaved rounds of the timing")
    samples: int = option(4096, "training samples of the fork")
    steps: int = option(600, "training steps of the fork")
    threads: int = option(1, "threads of PyTorch")


def make_calls(head: Head, settings: Settings) -> dict[str, Callable[[], object]]:
    """The calls of one head that are timed."""
    predictor = Predictor(settings.latent_dim, head=head)
    latent = torch.randn(settings.batch, settings.latent_dim)
    target = torch.randn(settings.batch, settings.latent_dim)
    generator = torch.Generator().manual_seed(0)

    def train() -> None:
        predictor.zero_grad(set_to_none=True)
        p = predictor.dist(latent)
        if isinstance(head, DeltaHead):
            (p.mean - target).square().sum(-1).mean().backward()
        else:
            (-log_score(p, target).mean()).backward()

    def without_gradients(read: Callable[[Any], Tensor]) -> Callable[[], Tensor]:
        def call() -> Tensor:
            with torch.no_grad():
                return read(predictor.dist(latent))

        return call

    return {
        "train": train,
        "sample": without_gradients(lambda p: sample(p, generator=generator)),
        "mean": without_gradients(lambda p: p.mean),
        "mode": without_gradients(lambda p: point_estimate(p, "mode")),
    }


def measure_cost(settings: Settings) -> list[dict[str, Any]]:
    """Medians over interleaved rounds; ratios within a round."""
    torch.manual_seed(settings.seed)
    calls = {name: make_calls(make(), settings) for name, make in HEADS.items()}
    times: dict[tuple[str, str], list[float]] = {}
    for i in range(settings.rounds + 1):
        for what in CALLS:
            if what == "mode" and i > 1:
                continue  # that of a flow takes a hundred gradients: measured once
            for name in HEADS:
                repeats = 1 if what == "mode" else 5
                start = time.process_time()
                for _ in range(repeats):
                    calls[name][what]()
                if i:  # the first round warms up
                    times.setdefault((name, what), []).append((time.process_time() - start) / repeats * 1e3)
    rows = []
    for name in HEADS:
        row: dict[str, Any] = {"head": name}
        for what in CALLS:
            row[f"{what}_ms"] = statistics.median(times[name, what])
            ratios = [a / b for a, b in zip(times[name, what], times[BASELINE, what], strict=True)]
            row[f"{what}_ratio"] = statistics.median(ratios)
        rows.append(row)
    return rows


def fork(num: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Where one stands, and where one is after passing the wall on one of its sides."""
    x = torch.randn(num, 2, generator=generator)
    side = (torch.rand(num, 1, generator=generator) < 0.5).float() * 2 - 1
    noise = 0.2 * torch.randn(num, 2, generator=generator)
    return x, x + torch.cat([2 * side, 0.5 * side], dim=-1) + noise


def measure_fork(settings: Settings) -> list[dict[str, Any]]:
    """Test log-likelihood and mass in the wall, for every head and seed."""
    rows = []
    for seed in range(settings.seed, settings.seed + settings.num_seeds):
        generator = torch.Generator().manual_seed(seed)
        x, y = fork(settings.samples, generator)
        test_x, test_y = fork(10_000, generator)
        for name, make in HEADS.items():
            if name == "DeltaHead":
                continue
            torch.manual_seed(seed)
            predictor = Predictor(2, head=make(), bias=True)
            optimizer = torch.optim.Adam(predictor.parameters(), lr=1e-2)
            schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.steps)
            for _ in range(settings.steps):
                index = torch.randint(len(x), (512,), generator=generator)
                optimizer.zero_grad()
                (-log_score(predictor.dist(x[index]), y[index]).mean()).backward()
                optimizer.step()
                schedule.step()
            with torch.no_grad():
                p = predictor.dist(test_x)
                drawn = sample(p, (10,), generator=generator) - test_x
                rows.append(
                    {
                        "head": name,
                        "seed": seed,
                        "test_log_prob": float(p.log_prob(test_y).mean()),
                        "wall_mass": float((drawn[..., 0].abs() < 1).float().mean()),
                    }
                )
    return rows


def truth() -> float:
    """Expected log-likelihood of the fork's own distribution."""
    return -(2 * (0.5 * math.log(2 * math.pi * math.e) + math.log(0.2)) + math.log(2))


def draw(rows: list[dict[str, Any]], folder: Path) -> None:
    """Likelihood and mass in the wall of every head, a point for each seed."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    fig, axes = plt.subplots(1, 2, figsize=(9, 3.2), sharey=True, layout="constrained")
    for ax, key in zip(axes, ("test_log_prob", "wall_mass"), strict=True):
        ax.plot([row[key] for row in rows], [row["head"] for row in rows], "o", color="#0072B2", alpha=0.7)
        ax.grid(axis="x", lw=0.3)
    axes[0].axvline(truth(), color="black", ls="--", lw=1, label="true density")
    axes[0].set_xlabel("held-out log-likelihood (nats)")
    axes[0].legend(frameon=False)
    axes[1].set_xlabel("predicted mass in the wall (share)")
    folder.mkdir(parents=True, exist_ok=True)
    fig.savefig(folder / "heads.png", dpi=150)
    plt.close(fig)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print the tables, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    for item in fields(Settings):
        flag = "--" + item.name.replace("_", "-")
        text = f"{item.metadata['help']} (default: {item.default})"
        parser.add_argument(flag, type=int, default=item.default, help=text)
    parser.add_argument("--quick", action="store_true", help="a small version that only shows that it runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows as JSON")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw heads.png there")
    args = parser.parse_args(arguments)
    settings = Settings(**{item.name: getattr(args, item.name) for item in fields(Settings)})
    if args.quick:
        settings = replace(settings, num_seeds=1, batch=16, rounds=1, samples=512, steps=3)
    torch.set_num_threads(settings.threads)
    cost = measure_cost(settings)
    print(
        f"CPU milliseconds, {settings.batch} predictions of {settings.latent_dim} numbers (times {BASELINE})"
    )
    print(f"{'head':22s}" + "".join(f"{what:>18s}" for what in CALLS))
    for row in cost:
        cells = [f"{row[f'{what}_ms']:.2f} ({row[f'{what}_ratio']:.1f})" for what in CALLS]
        print(f"{row['head']:22s}" + "".join(f"{cell:>18s}" for cell in cells))
    quality = measure_fork(settings)
    print(f"\nfork, mean over {settings.num_seeds} seeds; the truth reaches {truth():.3f}")
    print(f"{'head':22s}{'test log-likelihood':>22s}{'mass in the wall':>18s}")
    for name in HEADS:
        mine = [row for row in quality if row["head"] == name]
        if mine:
            score, wall = (
                statistics.fmean(row[key] for row in mine) for key in ("test_log_prob", "wall_mass")
            )
            print(f"{name:22s}{score:22.3f}{wall:18.3f}")
    if args.out:
        draw(quality, args.out)
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(
            json.dumps(
                {"settings": asdict(settings), "truth": truth(), "cost": cost, "rows": quality}, indent=1
            )
        )


if __name__ == "__main__":
    main()
