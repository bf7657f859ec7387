"""Walk past a cliff: the same planner with different risks, in the latent space of a learned VJEPA.

A robot walks from left to right. The short way leads along the edge of a pit, where gusts push it about:
mostly it gets past, sometimes it falls. VJEPA learns from random steps where the gusts are, as the scale of
its predictive distribution. Planning on its mean does not see them. Planning for the expected cost accepts
a rare fall, planning for CVaR (the mean of the worst trajectories) or under a chance constraint walks round.
The table says what each pays on average and in its worst episodes, and what the same planner pays that
knows the true system.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

import matplotlib as mpl
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torch.distributions import Distribution
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, InitTracker, TransformedEnv
from torchrl.modules import get_env_transforms_from_module
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from _settings import command_line, option, prepare, read_settings, write_report
from torchrl_vjepa import (
    CEM,
    VJEPA,
    ChanceConstraint,
    LatentEnv,
    LinearProbe,
    Predictor,
    TargetScale,
    VJEPALoss,
    cvar,
    diag_gaussian,
    expectation,
    linear_encoder,
    linear_probe,
)

mpl.use("Agg")
from matplotlib import pyplot as plt

PLANNERS = {
    "mean": "mean prediction",
    "expectation": "expected cost",
    "cvar": "CVaR",
    "chance": "chance constraint",
}
COLORS = {"mean": "0.45", "expectation": "#D55E00", "cvar": "#0072B2", "chance": "#009E73"}
MODELS = ("VJEPA", "true")
START, GOAL, PIT = (-1.75, 0.0), (1.75, 0.0), (0.0, -0.45)
RADIUS = 0.5  # of the pit
STRIDE = 0.4  # distance of a step at full speed
CALM, GUST, REACH = 0.02, 0.3, 0.35  # standard deviations of the push, and how far from the pit gusts reach
OBSERVED = 6  # numbers in an observation
Row = dict[str, Any]


@dataclass
class Settings:
    """What the run does; every field is a command-line option."""

    seeds: list[int] = option([0], "each seed makes the camera, the data, the training and the gusts")
    frames: int = option(40_000, "random steps, from starts anywhere, that VJEPA learns from")
    train_steps: int = option(1500, "optimiser steps")
    batch: int = option(512, "windows of 4 steps in a batch")
    lr: float = option(0.03, "peak learning rate (one cycle)")
    fall_cost: float = option(3.0, "cost of a step in the pit; other steps cost the distance to the goal")
    level: float = option(0.05, "tail of CVaR, and bound on the probability of a fall within the horizon")
    planning_horizon: int = option(6, "steps that are imagined")
    optim_steps: int = option(3, "CEM rounds for each action")
    num_candidates: int = option(64, "plans in a round")
    num_samples: int = option(60, "imagined trajectories of each plan")
    episodes: int = option(60, "evaluation episodes, the same gusts for every planner")
    steps: int = option(16, "steps in an episode")


QUICK = {
    "frames": 4_000,
    "train_steps": 100,
    "num_candidates": 16,
    "num_samples": 20,
    "episodes": 10,
    "optim_steps": 2,
}


def push(position: Tensor) -> Tensor:
    """Standard deviation of the gusts at a position."""
    distance = (position - torch.tensor(PIT)).norm(dim=-1, keepdim=True) - RADIUS
    return CALM + GUST * torch.exp(-0.5 * (distance.clamp_min(0) / REACH).square())


def walk(position: Tensor, action: Tensor) -> Distribution:
    """The true transition: a step, and a push."""
    step = STRIDE * action / action.norm(dim=-1, keepdim=True).clamp_min(1)
    return diag_gaussian(position + step, push(position).expand_as(position))


def in_pit(position: Tensor) -> Tensor:
    """Who has fallen."""
    return (position - torch.tensor(PIT)).norm(dim=-1) < RADIUS


class CliffEnv(EnvBase):
    """The robot and the pit: a position, seen by a camera of six noisy numbers.

    Args:
        num_envs: robots at once.
        seed: of the camera and the gusts.
        fall_cost: cost of a step in the pit.
        anywhere: start anywhere, to collect data; else at the start.
    """

    def __init__(self, num_envs: int, *, seed: int, fall_cost: float = 0.0, anywhere: bool = False) -> None:
        super().__init__(batch_size=(num_envs,))
        generator = torch.Generator().manual_seed(seed)
        self.camera = torch.randn(2, OBSERVED, generator=generator)
        self.fall_cost, self.anywhere = fall_cost, anywhere
        self.observation_spec = Composite(
            observation=Unbounded((num_envs, OBSERVED)),
            position=Unbounded((num_envs, 2)),
            shape=(num_envs,),
        )
        self.action_spec = Bounded(-1, 1, (num_envs, 2))
        self.reward_spec = Unbounded((num_envs, 1))
        self.rng = generator

    def _set_seed(self, seed: int | None) -> None:
        self.rng = torch.Generator().manual_seed(0 if seed is None else seed)

    def _normal(self, size: int) -> Tensor:
        return torch.randn(*self.batch_size, size, generator=self.rng)

    def _seen(self, position: Tensor) -> TensorDict:
        observation = position @ self.camera + 0.01 * self._normal(OBSERVED)
        return TensorDict(observation=observation, position=position, batch_size=self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        position = torch.tensor(START).expand(*self.batch_size, 2).clone()
        if self.anywhere:
            # A square: unit latents are then a rotation of it, and gusts are round in every rotation.
            position = 4.0 * torch.rand(*self.batch_size, 2, generator=self.rng) - 2.0
        return self._seen(position)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        p = walk(tensordict["position"], tensordict["action"])
        position = p.mean + p.stddev * self._normal(2)
        reward = -stage_cost(position, self.fall_cost).unsqueeze(-1)
        done = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return self._seen(position).update({"reward": reward, "done": done, "terminated": done.clone()})


def stage_cost(position: Tensor, fall_cost: float) -> Tensor:
    """Distance to the goal, and the price of a fall."""
    distance = (position - torch.tensor(GOAL)).norm(dim=-1)
    return distance + fall_cost * in_pit(position)


def train(seed: int, settings: Settings) -> tuple[VJEPA, LinearProbe]:
    """VJEPA from random steps; and the linear probe that reads positions from its latents."""
    env = CliffEnv(settings.frames // 4, seed=seed, anywhere=True)
    env.set_seed(1_000 + seed)
    torch.manual_seed(seed)
    data = env.rollout(4)
    model = VJEPA(
        linear_encoder(OBSERVED, 2),
        Predictor(2, action_dim=2, trunk="mlp", num_cells=(32, 32), residual=True),
        target_scale=TargetScale(2, kind="constant", init_std=0.01),
    )
    loss = VJEPALoss(model, target_kl_coeff=0.0, marginal_entropy_coeff=1.0)
    updater = SoftUpdate(loss, eps=0.9)
    optimizer = torch.optim.Adam(loss.parameters(), lr=settings.lr)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, settings.lr, settings.train_steps)
    windows = data.select("observation", "action", ("next", "done"))
    for _ in tqdm(range(settings.train_steps), desc=f"seed {seed}: train VJEPA", leave=False):
        index = torch.randint(len(windows), (settings.batch,))
        losses = loss(windows[index])
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
        updater.step()
    with torch.no_grad():
        latent = model.encoder(data.select("observation"))["latent"]
    half = len(latent) // 2
    probe = linear_probe(latent[:half], data["position"][:half], latent[half:], data["position"][half:])
    return model, probe


class Map:
    """Costs and falls of latents: the probe says where they are."""

    def __init__(self, fall_cost: float, probe: LinearProbe | None = None) -> None:
        self.fall_cost = fall_cost
        self.weight = torch.eye(2) if probe is None else probe.weight.float()
        self.bias = torch.zeros(2) if probe is None else probe.bias.float()

    def position(self, latent: Tensor) -> Tensor:
        """Where the robot is."""
        return latent @ self.weight.mT + self.bias

    def cost(self, latent: Tensor, action: Tensor) -> Tensor:
        """The cost of a step."""
        return stage_cost(self.position(latent), self.fall_cost)

    def fallen(self, latent: Tensor, action: Tensor) -> Tensor:
        """What the chance constraint forbids."""
        return in_pit(self.position(latent))


def make_planner(name: str, world: LatentEnv, ground: Map, seed: int, settings: Settings) -> CEM:
    """One planner; they differ in their risk alone."""
    sampled = {"num_samples": settings.num_samples}
    risk: dict[str, Any] = {
        "mean": {},
        "expectation": {**sampled, "risk": expectation},
        "cvar": {**sampled, "risk": cvar(settings.level)},
        "chance": {**sampled, "constraints": [ChanceConstraint(ground.fallen, settings.level)]},
    }[name]
    return CEM(
        world,
        planning_horizon=settings.planning_horizon,
        optim_steps=settings.optim_steps,
        num_candidates=settings.num_candidates,
        seed=seed,
        **risk,
    )


def evaluate(policy: Any, seed: int, settings: Settings) -> TensorDict:
    """All episodes at once, the same gusts for every planner."""
    env = CliffEnv(settings.episodes, seed=seed, fall_cost=settings.fall_cost)
    env.set_seed(2_000 + seed)
    env = TransformedEnv(env, InitTracker())
    for transform in get_env_transforms_from_module(policy):
        env.append_transform(transform)
    with torch.no_grad():
        return env.rollout(settings.steps, policy)


def judge(episode: TensorDict) -> dict[str, float]:
    """What the episodes cost, who fell, and who arrived without a fall."""
    costs = -episode["next", "reward"].sum(dim=(1, 2))
    positions = episode["next", "position"]
    fell = in_pit(positions).any(dim=1)
    arrived = (positions[:, -1] - torch.tensor(GOAL)).norm(dim=-1) < 0.25
    return {
        "mean_cost": costs.mean().item(),
        "worst_5_percent": cvar(0.05)(costs).item(),
        "fall_rate": fell.float().mean().item(),
        "success_rate": (arrived & ~fell).float().mean().item(),
    }


def run_seed(seed: int, settings: Settings) -> tuple[list[Row], dict[tuple[str, str], Tensor]]:
    """Train once, plan with every risk in the learned and in the true model."""
    model, probe = train(seed, settings)
    spec = Bounded(-1, 1, (2,))
    rows: list[Row] = []
    walked: dict[tuple[str, str], Tensor] = {}
    progress = tqdm(total=len(MODELS) * len(PLANNERS), leave=False)
    for kind in MODELS:
        learned = kind == "VJEPA"
        ground = Map(settings.fall_cost, probe if learned else None)
        if learned:
            world = LatentEnv(model, action_spec=spec, cost=ground.cost)
        else:
            world = LatentEnv(walk, action_spec=spec, cost=ground.cost, latent_dim=2, latent_key="position")
        for name, label in PLANNERS.items():
            progress.set_description(f"seed {seed}: {label}, {kind} model")
            planner = make_planner(name, world, ground, seed, settings)
            policy = TensorDictSequential(model.encoder, planner) if learned else planner
            episode = evaluate(policy, seed, settings)
            rows.append({"model": kind, "planner": name, "seed": seed, **judge(episode)})
            walked[kind, name] = episode["next", "position"]
            progress.update()
    progress.close()
    return rows, walked


def table(rows: Sequence[Row]) -> str:
    """Mean over seeds."""
    lines = [
        f"{'model':8s}{'planner':20s}{'mean cost':>11s}{'worst 5 %':>11s}{'falls':>9s}{'arrives':>9s}",
    ]
    for kind in MODELS:
        for name, label in PLANNERS.items():
            here = [row for row in rows if (row["model"], row["planner"]) == (kind, name)]
            cost, worst, falls, success = (
                mean(row[key] for row in here)
                for key in ("mean_cost", "worst_5_percent", "fall_rate", "success_rate")
            )
            lines.append(f"{kind:8s}{label:20s}{cost:11.2f}{worst:11.2f}{falls:9.1%}{success:9.1%}")
        lines.append("")
    return "\n".join(lines).rstrip()


def figure(rows: Sequence[Row], walked: dict[tuple[str, str], Tensor], path: Path) -> None:
    """Where the planners walk, and what they pay."""
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    fig, axes = plt.subplots(1, 4, figsize=(15, 3.9), layout="constrained")
    grid = torch.stack(
        torch.meshgrid(torch.linspace(-2.1, 2.1, 141), torch.linspace(-1.1, 1.5, 88), indexing="xy"), dim=-1
    )
    shown = {"expectation": "Expected cost", "cvar": "CVaR", "chance": "Chance constraint"}
    for ax, (name, title) in zip(axes, shown.items(), strict=False):
        gusts = ax.contourf(
            grid[..., 0], grid[..., 1], push(grid)[..., 0], levels=12, cmap="Greys", alpha=0.7
        )
        ax.add_patch(plt.Circle(PIT, RADIUS, facecolor="white", edgecolor="black", hatch="///"))
        positions = walked["VJEPA", name]
        start = torch.tensor(START).expand(len(positions), 1, 2)
        paths = torch.cat([start, positions], dim=1)
        fell = in_pit(positions).any(dim=1)
        for one, down in zip(paths[:100], fell[:100].tolist(), strict=True):
            color = "#D55E00" if down else "#0072B2"
            ax.plot(one[:, 0], one[:, 1], color=color, lw=1.2 if down else 0.5, zorder=3 if down else 2)
        for point, text in ((START, "start"), (GOAL, "goal")):
            ax.plot(*point, marker="o", color="black", ms=5, zorder=4)
            ax.annotate(text, point, (0, -14), textcoords="offset points", ha="center", zorder=5)
        ax.set(
            xlabel="x (m)", title=f"{title}: {int(fell.sum())} of {len(fell)} fall", aspect="equal",
            xlim=(-2.1, 2.1), ylim=(-1.1, 1.5),
        )  # fmt: skip
    axes[0].set_ylabel("y (m)")
    axes[0].text(PIT[0], PIT[1], "pit", ha="center", va="center", backgroundcolor="white")
    fig.colorbar(gusts, ax=axes[2], label="standard deviation of a gust (m)", shrink=0.8)

    paid = axes[3]
    names = list(PLANNERS)
    for offset, (kind, hatch) in zip((-0.2, 0.2), (("VJEPA", ""), ("true", "///")), strict=True):
        for key, alpha in (("worst_5_percent", 0.35), ("mean_cost", 1.0)):
            heights = [
                mean(row[key] for row in rows if (row["model"], row["planner"]) == (kind, name))
                for name in names
            ]
            colors = [COLORS[name] for name in names]
            places = [i + offset for i in range(len(names))]
            paid.bar(places, heights, 0.36, color=colors, alpha=alpha, hatch=hatch, edgecolor="white")
    paid.set(
        xticks=range(len(names)),
        xticklabels=[label.replace(" ", "\n") for label in PLANNERS.values()],
        ylabel="cost of an episode",
        title="Mean (dark) and worst 5 % (light);\nplain: VJEPA, hatched: true model",
    )
    fig.savefig(path, dpi=150)
    plt.close(fig)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print the table, draw the figure, write the JSON."""
    settings, args = read_settings(command_line(Settings, __doc__), Settings, QUICK, arguments)
    prepare(args)
    # A gust can throw the robot to where no plan is safe enough; the table counts what comes of it.
    warnings.filterwarnings("ignore", "no candidate plan satisfies", RuntimeWarning)
    start = time.perf_counter()
    rows: list[Row] = []
    shown: dict[tuple[str, str], Tensor] = {}
    for seed in settings.seeds:
        new_rows, walked = run_seed(seed, settings)
        rows += new_rows
        shown = shown or walked
    wall = time.perf_counter() - start
    print(table(rows))
    path = args.out / "cliff.png"
    figure(rows, shown, path)
    print(f"\n{wall:.0f} s; figure: {path}")
    write_report(args, settings, wall_s=wall, rows=rows)


if __name__ == "__main__":
    main()
