"""What planners reach for their arithmetic: the cost on the noisy TV, relative to the optimal controller.

The model is the true one and the latent the exact Kalman estimate, so what is lost is lost by the search and
by the finite horizon. All controllers meet the same systems and the same noise. Arithmetic is counted in
steps of the model for one action: candidates x horizon x rounds, and three times the forward steps for
gradients. Planners start warm from their plan of the step before.
"""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

import matplotlib as mpl
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from tqdm import tqdm

from torchrl_vjepa import (
    CEM,
    MPPI,
    DeltaHead,
    GradientMPC,
    LatentEnv,
    LinearGaussianSystem,
    LQGController,
    Predictor,
    RandomShooting,
)
from torchrl_vjepa.costs import action_cost, quadratic_cost
from torchrl_vjepa.planners import Planner, Proposal

sys.path.append(str(Path(__file__).resolve().parents[1] / "examples"))
_settings = importlib.import_module("_settings")
option = _settings.option

#: The bar: 1.02 times LQG at no more than this.
ARITHMETIC, GOAL = 512 * 15 * 4, 1.02


@dataclass
class Settings:
    """What is measured."""

    seeds: list[int] = option([0, 1, 2], "systems")
    noise_scale: float = option(8.0, "scale of the distractor")
    episodes: int = option(8, "episodes of each system, side by side")
    steps: int = option(60, "steps of an episode")


QUICK = {"seeds": [0], "episodes": 2, "steps": 6}


class Contender(NamedTuple):
    """One planner at one size."""

    name: str
    horizon: int
    candidates: int
    rounds: int
    make: Callable[[LatentEnv], Planner]
    arithmetic: int
    dtype: torch.dtype | None = None


class Hybrid(MPPI):
    """Gradient descent from the best plan that sampling found."""

    def __init__(self, env: LatentEnv, horizon: int, steps: int, *args: Any, **kwargs: Any) -> None:
        super().__init__(env, horizon, *args, **kwargs)
        self.refine = GradientMPC(env, horizon, steps, num_starts=1, seed=0)

    def plan(self, state: Any, proposal: Proposal) -> Any:
        """Sample, then descend."""
        found = super().plan(state, proposal)
        return self.refine.plan(state, Proposal(found.best, found.std))


#: Everything of Pinneri et al. (2020) at once.
ICEM = {
    "noise_beta": 2.0, "keep_elites": 0.3, "carry_elites": 0.3, "population_decay": 0.8, "output": "best",
}  # fmt: skip
VARIANTS: dict[str, tuple[type, dict[str, Any]]] = {
    "predictive sampling": (RandomShooting, {}),  # one draw around the shifted plan, its best executed
    "CEM": (CEM, {}),
    "CEM, pink noise": (CEM, {"noise_beta": 1.0}),
    "CEM, brown noise": (CEM, {"noise_beta": 2.0}),
    "CEM, kept elites": (CEM, {"keep_elites": 0.3}),
    "CEM, carried elites": (CEM, {"carry_elites": 0.3}),
    "CEM, decaying": (CEM, {"population_decay": 0.8}),
    "iCEM": (CEM, ICEM),
    "iCEM, white noise": (CEM, {**ICEM, "noise_beta": 0.0}),
    "MPPI": (MPPI, {}),
    "MPPI, pink noise": (MPPI, {"noise_beta": 1.0}),
    "MPPI, carried elites": (MPPI, {"carry_elites": 0.3}),
    "MPPI, temperature 0.5": (MPPI, {"temperature": 0.5}),
    "MPPI, warm_std 0.6": (MPPI, {"warm_std": 0.6}),
    "MPPI, warm_std 0.15": (MPPI, {"warm_std": 0.15}),
    "MPPI, not antithetic": (MPPI, {"antithetic": False}),
    "MPPI, best": (MPPI, {"output": "best"}),
    "MPPI, cold": (MPPI, {"warm_start": False}),
}
GRID = (
    *((8, 64, rounds) for rounds in (1, 2, 4)),
    *((8, 256, rounds) for rounds in (1, 2, 3, 4)),
    *((8, 512, rounds) for rounds in (2, 3, 4, 7)),
    (15, 512, 4),
)


def contenders() -> Iterator[Contender]:
    """Everything that is compared."""
    for name, (cls, kwargs) in VARIANTS.items():
        for horizon, candidates, rounds in GRID:

            def make(
                env: LatentEnv, cls: type = cls, kwargs: dict[str, Any] = kwargs,
                size: tuple[int, int, int] = (horizon, rounds, candidates),
            ) -> Planner:  # fmt: skip
                return cls(env, *size, seed=0, **kwargs)

            decay = kwargs.get("population_decay", 1.0)
            least = min(candidates, 2 * (candidates // 8))  # twice the elites
            drawn = [max(round(candidates * decay**k), least) for k in range(rounds)]
            arithmetic = horizon * sum(drawn)
            yield Contender(name, horizon, candidates, rounds, make, arithmetic)
            if name == "MPPI":
                yield Contender("MPPI, bf16", horizon, candidates, rounds, make, arithmetic, torch.bfloat16)
    for horizon in (8, 15):
        for steps in (5, 10, 20, 40):
            yield Contender(
                "gradient", horizon, 1, steps,
                lambda env, h=horizon, n=steps: GradientMPC(env, h, n, num_starts=1, seed=0),
                3 * horizon * steps,
            )  # fmt: skip
        for candidates, steps in ((64, 5), (64, 10), (256, 5)):
            yield Contender(
                "hybrid", horizon, candidates, 1,
                lambda env, h=horizon, c=candidates, n=steps: Hybrid(env, h, n, 1, c, seed=0),
                horizon * (candidates + 3 * steps),
            )  # fmt: skip


class System:
    """A noisy TV with its optimal filter, and the true model as a latent environment."""

    def __init__(self, seed: int, settings: Settings) -> None:
        self.system = LinearGaussianSystem(control_dim=2, seed=seed)
        self.scale = settings.noise_scale
        self.lqg = LQGController(self.system, self.scale)
        generator = torch.Generator().manual_seed(1000 + seed)
        shape = (settings.steps + 1, settings.episodes, self.system.noise_dim)
        self.noise = torch.randn(shape, generator=generator)

    def env(self, dtype: torch.dtype | None = None) -> LatentEnv:
        """The true dynamics of the signal's mean, and the cost that is paid."""
        predictor = Predictor(4, action_dim=2, head=DeltaHead())
        with torch.no_grad():
            predictor.trunks[0].weight.copy_(torch.cat([self.system.A, self.system.B], 1))
        return LatentEnv(
            predictor,
            action_spec=Bounded(-2.0, 2.0, (2,)),
            cost=quadratic_cost(self.system.goal.float()) + 0.1 * action_cost(),
            rollout_dtype=dtype,
        )

    def cost(self, policy: Callable[[TensorDict], Any]) -> float:
        """Mean cost of a step under a policy that reads the estimate as its latent."""
        kalman, size = self.lqg.kalman, self.system.signal_dim
        signal, distractor, observation = self.system.start(self.noise[0], self.scale)
        belief = torch.zeros(len(signal), kalman.predict(self.lqg.gain.new_zeros(8)).shape[-1]).double()
        td, total = TensorDict(batch_size=len(signal)), 0.0
        for step, noise in enumerate(self.noise[1:]):
            estimate = kalman.update(belief, observation, torch.full((len(signal),), step))
            td.set("latent", estimate[:, :size].float())
            policy(td)
            action = td["action"].clamp(-2.0, 2.0)
            belief = kalman.predict(estimate, action)
            signal, distractor, observation = self.system.step(signal, distractor, action, noise, self.scale)
            error = (signal - self.system.goal.to(signal)).square().sum(-1)
            total += float((error + 0.1 * action.square().sum(-1)).mean())
            td = td.get("next", td)
        return total / (len(self.noise) - 1)

    def optimal(self, td: TensorDict) -> None:
        """LQG on the same estimate."""
        td.set("action", (self.lqg.feedforward - td["latent"].double() @ self.lqg.gain.mT).float())


def run(settings: Settings) -> list[dict[str, Any]]:
    """One row for each contender and system."""
    rows = []
    everything = list(contenders())
    progress = tqdm(total=len(everything) * len(settings.seeds), leave=False)
    for seed in settings.seeds:
        system = System(seed, settings)
        lqg = system.cost(system.optimal)
        for contender in everything:
            cost = system.cost(contender.make(system.env(contender.dtype)))
            rows.append(
                {
                    "planner": contender.name,
                    "horizon": contender.horizon,
                    "candidates": contender.candidates,
                    "rounds": contender.rounds,
                    "arithmetic": contender.arithmetic,
                    "seed": seed,
                    "cost": cost,
                    "ratio_to_lqg": cost / lqg,
                }
            )
            progress.update()
    progress.close()
    return rows


def summary(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean and worst over systems."""
    keys = ("planner", "horizon", "candidates", "rounds", "arithmetic")
    out = []
    for group in dict.fromkeys(tuple(row[key] for key in keys) for row in rows):
        ratios = [row["ratio_to_lqg"] for row in rows if tuple(row[key] for key in keys) == group]
        out.append({**dict(zip(keys, group, strict=True)), "mean": mean(ratios), "worst": max(ratios)})
    return out


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One line for each contender."""
    lines = [
        f"{'planner':22s}{'horizon':>8s}{'cands':>7s}{'rounds':>7s}{'steps':>8s}{'x LQG':>9s}{'worst':>9s}"
    ]
    for row in summary(rows):
        lines.append(
            f"{row['planner']:22s}{row['horizon']:8d}{row['candidates']:7d}{row['rounds']:7d}"
            f"{row['arithmetic']:8d}{row['mean']:9.3f}{row['worst']:9.3f}"
        )
    return "\n".join(lines)


def draw(rows: Sequence[dict[str, Any]], folder: Path) -> None:
    """Cost against arithmetic; for each planner what its best size up to there reaches."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    fig, ax = plt.subplots(figsize=(7.2, 4.2), layout="constrained")
    shown = ("predictive sampling", "CEM", "iCEM", "MPPI", "MPPI, cold", "gradient", "hybrid")
    colors = ("#999999", "#E69F00", "#CC79A7", "#0072B2", "#56B4E9", "#009E73", "#D55E00")
    marks = "osPD^vX"
    for name, color, mark in zip(shown, colors, marks, strict=True):
        here = sorted((r for r in summary(rows) if r["planner"] == name), key=lambda r: r["arithmetic"])
        excess = [max(r["mean"] - 1, 1e-3) for r in here]
        ax.scatter([r["arithmetic"] for r in here], excess, s=28, color=color, marker=mark, label=name)
        best = [min(excess[: i + 1]) for i in range(len(here))]
        ax.plot([r["arithmetic"] for r in here], best, color=color, lw=1)
    ax.axhline(GOAL - 1, color="black", ls="--", lw=1, label="1.02 x LQG")
    ax.axvline(ARITHMETIC, color="black", ls=":", lw=1, label="512 x 15 x 4")
    ax.set(xscale="log", yscale="log", xlabel="steps of the model for one action", ylabel="cost / LQG - 1")
    ax.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    fig.savefig(folder / "planner_quality.png", dpi=150)
    plt.close(fig)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run all contenders, print the table, write JSON and figure."""
    parser = _settings.command_line(Settings, __doc__)
    settings, args = _settings.read_settings(parser, Settings, QUICK, arguments)
    _settings.prepare(args)
    start = time.perf_counter()
    with torch.no_grad():
        rows = run(settings)
    print(table(rows))
    draw(rows, args.out)
    _settings.write_report(args, settings, wall_s=time.perf_counter() - start, rows=rows)


if __name__ == "__main__":
    main()
