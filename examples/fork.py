"""Left or right: predict a future with two branches, and plan so that both are safe.

A vehicle drives towards a wall; just before it a reflex swerves to the left or to the right, by chance.
Aiming at the middle of the wall is safe, aiming beside it is not: one of the two swerves ends in it. Four
VJEPAs that differ in their head alone learn from the same random steps. Each plans twice with the same
planner and the same cost: on samples of its prediction, and on the mean. The table says how likely they
find held-out steps, how much of their mass is in the wall where the truth has none, and how often the
vehicle gets past it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean
from typing import Any

import matplotlib as mpl
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torch.distributions import Distribution
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from _settings import command_line, option, prepare, read_settings, write_report
from torchrl_vjepa import (
    VJEPA,
    BatchedForkEnv,
    DiagGaussianHead,
    FlowHead,
    ForkSystem,
    FullGaussianHead,
    Head,
    LatentEnv,
    MixtureHead,
    Predictor,
    RandomShooting,
    TargetScale,
    VJEPALoss,
    Whitening,
    linear_encoder,
)

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.patches import Rectangle

HEADS: dict[str, Callable[[], Head]] = {
    "DiagGaussianHead": DiagGaussianHead,
    "FullGaussianHead": FullGaussianHead,
    "MixtureHead": MixtureHead,
    "FlowHead": FlowHead,
}
PLANNERS = ("sample", "mean")
TRUTH = "true density"
STYLES = {
    "sample": {"color": "#0072B2", "ls": "-", "label": "planned on samples"},
    "mean": {"color": "#D55E00", "ls": "--", "label": "planned on the mean"},
}
NUM_DRAWN = 40
Row = dict[str, Any]


@dataclass
class Settings:
    """What the run does; every field is a command-line option."""

    seeds: list[int] = option([0], "each seed makes the data, the training and the planner's noise")
    heads: list[str] = option(list(HEADS), "heads to compare", choices=list(HEADS))
    train_episodes: int = option(4_000, "episodes of random steering to learn from")
    test_episodes: int = option(1_000, "held-out episodes of random steering")
    train_steps: int = option(1_000, "optimiser steps")
    batch_size: int = option(256, "transitions in a batch")
    lr: float = option(0.01, "peak learning rate (one cycle)")
    encoder_lr: float = option(0.001, "the same of the encoder, slower: all predictions rest on it")
    num_cells: int = option(128, "width of the two hidden layers of the predictor")
    ema_decay: float = option(0.99, "tau of the target encoder")
    target_std: float = option(0.003, "standard deviation of the target distribution, in latent units")
    mass_samples: int = option(1_000, "samples of each prediction for its mass in the wall")
    planning_horizon: int = option(3, "steps that the planner imagines")
    num_candidates: int = option(32, "plans that it compares")
    num_samples: int = option(32, "imagined trajectories for each plan")
    episodes: int = option(100, "evaluation episodes, the same luck for every planner")


QUICK = {
    "train_episodes": 400,
    "test_episodes": 100,
    "train_steps": 60,
    "batch_size": 128,
    "mass_samples": 100,
    "num_candidates": 16,
    "num_samples": 16,
    "episodes": 20,
}


def collect(num_episodes: int, seed: int) -> TensorDict:
    """Steps of random steering as windows of two: where the vehicle is, and where it is next.

    A crash ends an episode, so the position in the wall is only ever a *next* observation: windows cut
    from an episode would leave it out, and the model would never hear of a crash.
    """
    torch.manual_seed(seed)
    env = BatchedForkEnv(num_episodes, seed=seed)
    data = env.rollout(env.system.episode_length, break_when_any_done=False, break_when_all_done=True)
    over = data["next", "done"].squeeze(-1)
    data = data[over.int().cumsum(-1) - over.int() == 0]  # rows that are over wait for the others
    return TensorDict(
        observation=torch.stack([data["observation"], data["next", "observation"]], dim=1),
        action=torch.stack([data["action"], torch.zeros_like(data["action"])], dim=1),
        batch_size=[len(data), 2],
    )


def train(head: str, data: TensorDict, seed: int, settings: Settings) -> VJEPA:
    """A VJEPA with a linear encoder, by the likelihood and the entropy term against collapse."""
    torch.manual_seed(seed)
    whitening = Whitening(2)
    whitening.update(data["observation"])
    encoder = linear_encoder(2, 2, whitening=whitening)
    # Latents of unit covariance from the start: where a steep step of the dynamics is easiest to learn.
    torch.nn.init.orthogonal_(encoder.module.network.weight)
    model = VJEPA(
        encoder,
        Predictor(
            2,
            action_dim=1,
            head=HEADS[head](),
            trunk="mlp",
            num_cells=[settings.num_cells] * 2,
            residual=True,
        ),
        target_scale=TargetScale(2, kind="constant", init_std=settings.target_std),
    )
    loss = VJEPALoss(model, target_kl_coeff=0.0, marginal_entropy_coeff=1.0)
    updater = SoftUpdate(loss, eps=settings.ema_decay)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(data)), batch_size=settings.batch_size)
    buffer.set_rng(torch.Generator().manual_seed(seed))
    buffer.extend(data)
    slow = list(loss.encoder_params.parameters())
    others = [p for p in loss.parameters() if all(p is not q for q in slow)]
    rates = [settings.encoder_lr, settings.lr]
    optimizer = torch.optim.Adam(
        [{"params": group, "lr": rate} for group, rate in zip((slow, others), rates, strict=True)],
        fused=True,
    )
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, rates, total_steps=settings.train_steps, pct_start=0.1
    )
    for _ in tqdm(range(settings.train_steps), desc=f"seed {seed}: train {head}", leave=False):
        losses = loss(buffer.sample().select("observation", "action"))
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        torch.nn.utils.clip_grad_norm_(loss.parameters(), 10.0)
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
        updater.step()
    return model.eval()


@dataclass
class Belief:
    """A model's predictions in the coordinates of the road: the linear encoder, undone."""

    dist: Callable[[Tensor, Tensor], Distribution]
    matrix: Tensor = field(default_factory=lambda: torch.eye(2))
    offset: Tensor = field(default_factory=lambda: torch.zeros(2))

    @classmethod
    def of(cls, model: VJEPA) -> Belief:
        """The encoder's matrix and offset, read off three points."""
        points = torch.cat([torch.zeros(1, 2), torch.eye(2)])
        with torch.no_grad():
            images = model.encoder(TensorDict(observation=points, batch_size=[3]))["latent"]
        return cls(model.predictor.dist, (images[1:] - images[0]).mT, images[0])

    def encode(self, position: Tensor) -> Tensor:
        """Latent of a position."""
        return position @ self.matrix.mT + self.offset

    def decode(self, latent: Tensor) -> Tensor:
        """Position of a latent."""
        return (latent - self.offset) @ torch.linalg.inv(self.matrix).mT

    def log_prob(self, position: Tensor, action: Tensor, after: Tensor) -> Tensor:
        """Log-density of the next position, in nats: comparable between models."""
        log_prob = self.dist(self.encode(position), action).log_prob(self.encode(after))
        return log_prob + torch.linalg.slogdet(self.matrix).logabsdet

    def sample(self, position: Tensor, action: Tensor, num_samples: int) -> Tensor:
        """Next positions, samples first."""
        return self.decode(self.dist(self.encode(position), action).sample((num_samples,)))

    def mean(self, position: Tensor, action: Tensor) -> Tensor:
        """Mean of the next position."""
        return self.decode(self.dist(self.encode(position), action).mean)


@dataclass
class Shown:
    """What the figure draws of a head."""

    belief: Belief
    episodes: dict[str, TensorDict] = field(default_factory=dict)


@dataclass
class LatentCost:
    """The cost of the road, of latents."""

    system: ForkSystem
    belief: Belief

    def __call__(self, latent: Tensor, action: Tensor) -> Tensor:
        """Costs of shape ``(*B)``."""
        return self.system.cost(self.belief.decode(latent), action)


def safe_aims(data: TensorDict, system: ForkSystem) -> tuple[Tensor, Tensor]:
    """Held-out steps that aim at the wall and are safe: the true mean is in it, the true mass is not."""
    position, action = data["observation"][:, 0], data["action"][:, 0]
    mean = system.dist(position, action).mean
    chosen = system.in_wall(mean) & (system.wall_mass(position, action) < 1e-3)
    return position[chosen], action[chosen]


def drive(policy: Any, system: ForkSystem, seed: int, settings: Settings) -> TensorDict:
    """One episode in each row; rows that are over wait."""
    torch.manual_seed(seed)
    env = BatchedForkEnv(settings.episodes, system, seed=100_000 + 1_000 * seed)
    with torch.no_grad():
        return env.rollout(system.episode_length, policy, break_when_any_done=False, break_when_all_done=True)


def success(episodes: TensorDict) -> float:
    """Share of episodes without a crash."""
    return 1 - episodes["next", "terminated"].any(dim=1).float().mean().item()


def make_planner(model: Any, cost: Any, how: str, seed: int, settings: Settings, **kwargs: Any) -> Any:
    """Algorithm VJEPA-MPC on samples, or on the mean."""
    world = LatentEnv(
        model,
        action_spec=BatchedForkEnv(1).action_spec_unbatched,
        cost=cost,
        how=how,
        num_samples=settings.num_samples if how == "sample" else 1,
        **kwargs,
    )
    return RandomShooting(
        world,
        planning_horizon=settings.planning_horizon,
        num_candidates=settings.num_candidates,
        warm_start=False,
        seed=seed,
    )


def run_seed(seed: int, settings: Settings) -> tuple[list[Row], list[Row], list[Row], dict[str, Shown]]:
    """One seed: collect, train every head, judge its prediction, plan with it."""
    system = ForkSystem()
    data = collect(settings.train_episodes, seed)
    test = collect(settings.test_episodes, 50_000 + seed)
    before, after, action = test["observation"][:, 0], test["observation"][:, 1], test["action"][:, 0]
    position, steering = safe_aims(test, system)
    rows: list[Row] = []
    means: list[Row] = []

    truth = Shown(Belief(system.dist))
    oracle = {
        "head": TRUTH,
        "seed": seed,
        "test_log_prob": system.dist(before, action).log_prob(after).mean().item(),
        "wall_mass": system.wall_mass(position, steering).mean().item(),
    }
    oracles: list[Row] = []
    drawn = {TRUTH: truth}
    for how in PLANNERS:
        planner = make_planner(
            system.dist, system.cost, how, seed, settings, latent_dim=2, latent_key="observation"
        )
        truth.episodes[how] = drive(planner, system, seed, settings)
        oracles.append({**oracle, "planner": how, "success": success(truth.episodes[how])})

    for head in settings.heads:
        model = train(head, data, seed, settings)
        belief = Belief.of(model)
        torch.manual_seed(seed)
        with torch.no_grad():
            log_prob = belief.log_prob(before, action, after).mean().item()
            samples = belief.sample(position, steering, settings.mass_samples)
            wall_mass = system.in_wall(samples).float().mean().item()
            mean_in_wall = system.in_wall(belief.mean(position, steering)).float().mean().item()
        means.append({"head": head, "seed": seed, "mean_in_wall": mean_in_wall})
        drawn[head] = shown = Shown(belief)
        for how in PLANNERS:
            planner = make_planner(model, LatentCost(system, belief), how, seed, settings)
            policy = TensorDictSequential(model.encoder, planner)
            shown.episodes[how] = drive(policy, system, seed, settings)
            rows.append(
                {
                    "head": head,
                    "planner": how,
                    "seed": seed,
                    "test_log_prob": log_prob,
                    "wall_mass": wall_mass,
                    "success": success(shown.episodes[how]),
                }
            )
    return rows, oracles, means, drawn


def table(rows: Sequence[Row], oracles: Sequence[Row], means: Sequence[Row]) -> str:
    """Mean over seeds; of what must not be missed, the worst seed too."""
    lines = [
        f"{'head':18s}{'log-lik.':>9s}{'mean in wall':>14s}{'wall mass':>11s}{'worst':>8s}"
        f"{'past the wall, by samples':>27s}{'worst':>8s}{'by the mean':>13s}{'best':>8s}"
    ]
    for head in dict.fromkeys(row["head"] for row in [*oracles, *rows]):
        here = [row for row in [*oracles, *rows] if row["head"] == head]
        sampled, meant = ([r for r in here if r["planner"] == how] for how in PLANNERS)
        inside = [row["mean_in_wall"] for row in means if row["head"] == head] or [1.0]
        by_samples, by_mean = ([r["success"] for r in part] for part in (sampled, meant))
        mass = [r["wall_mass"] for r in sampled]
        lines.append(
            f"{head:18s}{mean(r['test_log_prob'] for r in sampled):9.3f}{mean(inside):14.1%}"
            f"{mean(mass):11.2%}{max(mass):8.2%}{mean(by_samples):27.1%}{min(by_samples):8.1%}"
            f"{mean(by_mean):13.1%}{max(by_mean):8.1%}"
        )
    return "\n".join(lines)


def draw_wall(axes: plt.Axes, system: ForkSystem) -> None:
    """The wall on the road."""
    length, width = system.wall_half_length, system.wall_half_width
    corner = (-length, -width)
    axes.add_patch(
        Rectangle(corner, 2 * length, 2 * width, fc="none", ec="0.3", lw=0.8, hatch="////", zorder=3)
    )


def figure(drawn: dict[str, Shown], path: Path) -> None:
    """What each model expects just before the wall, and where its planners drive."""
    system = ForkSystem()
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    fig, axes = plt.subplots(
        2, len(drawn), figsize=(2.6 * len(drawn), 5.0), sharex=True, sharey=True, layout="constrained"
    )
    position, action = torch.tensor([-2.0, 0.4]), torch.tensor([-0.3])
    along, across = torch.meshgrid(
        torch.linspace(-5.2, 3.8, 451), torch.linspace(-2.6, 2.6, 261), indexing="ij"
    )
    points = torch.stack([along, across], dim=-1)
    for (head, shown), density, roads in zip(drawn.items(), axes[0], axes[1], strict=True):
        with torch.no_grad():
            p = shown.belief.log_prob(position, action, points).exp()
            middle = shown.belief.mean(position, action)
        density.pcolormesh(along, across, p.sqrt(), cmap="Blues", shading="nearest", rasterized=True, vmin=0)
        density.plot(*position, "o", color="black", ms=4, label="vehicle")
        density.plot(*middle, "X", color="#D55E00", ms=7, mec="white", zorder=4, label="predicted mean")
        density.set_title(head)
        for how, style in STYLES.items():
            episodes = shown.episodes[how][:NUM_DRAWN]
            for episode in episodes:
                path_ = torch.cat([episode["observation"][:1], episode["next", "observation"]])
                roads.plot(*path_.mT, color=style["color"], ls=style["ls"], lw=0.7, alpha=0.6)
            crashed = episodes["next", "observation"][episodes["next", "terminated"].squeeze(-1)]
            roads.plot(*crashed.mT, "x", color=style["color"], ms=5, mew=1.5, zorder=4)
            roads.plot([], [], color=style["color"], ls=style["ls"], label=style["label"])
        roads.plot([], [], "x", color="0.3", label="crash")
        roads.set_xlabel("along the road (units)")
        for ax in (density, roads):
            draw_wall(ax, system)
    axes[0, 0].set(xlim=(-5.2, 3.8), ylim=(-2.6, 2.6), ylabel="across (units)\n\npredicted density")
    axes[1, 0].set_ylabel(f"across (units)\n\n{NUM_DRAWN} episodes")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    more_handles, more_labels = axes[1, 0].get_legend_handles_labels()
    wall = Rectangle((0, 0), 1, 1, fc="none", ec="0.3", lw=0.8, hatch="////")
    fig.legend(
        [*handles, wall, *more_handles],
        [*labels, "wall", *more_labels],
        loc="outside lower center",
        ncols=6,
        frameon=False,
    )
    fig.savefig(path, dpi=150)
    plt.close(fig)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print the table, draw the figure, write the JSON."""
    settings, args = read_settings(command_line(Settings, __doc__), Settings, QUICK, arguments)
    prepare(args)
    start = time.perf_counter()
    rows: list[Row] = []
    oracles: list[Row] = []
    means: list[Row] = []
    shown: dict[str, Shown] = {}
    for seed in settings.seeds:
        new_rows, new_oracles, new_means, drawn = run_seed(seed, settings)
        rows, oracles, means = rows + new_rows, oracles + new_oracles, means + new_means
        shown = shown or drawn
    wall = time.perf_counter() - start
    print(table(rows, oracles, means))
    path = args.out / "fork.png"
    figure(shown, path)
    print(f"\n{wall:.0f} s; figure: {path}")
    write_report(args, settings, wall_s=wall, rows=rows, oracle=oracles, mean_in_wall=means)


if __name__ == "__main__":
    main()
