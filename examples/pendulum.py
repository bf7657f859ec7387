"""Swing up Gymnasium's Pendulum-v1: collect with the planner, train VJEPA, repeat.

The first five episodes are random. In each round VJEPA learns from a replay buffer how latents move, a reward
head learns what a step pays, and MPPI plans in the model: twenty evaluation episodes, the same in every round
and for every seed, and five more episodes for the buffer. The table and the figure say what the evaluation
episodes return after each round, next to the same planner with the true model, and to random actions.

With --checkpoint FILE every round is saved. The same command, started again, continues after the last saved
round and ends with the same numbers as if it had never stopped.
"""

from __future__ import annotations

import hashlib
import io
import math
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib as mpl
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.data import Bounded, LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import EnvBase, GymEnv, SerialEnv, TransformedEnv
from torchrl.modules import MLP, get_env_transforms_from_module
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from _settings import command_line, option, prepare, read_settings, write_report
from torchrl_vjepa import (
    MPPI,
    VJEPA,
    Delta,
    LatentEnv,
    Predictor,
    RewardLoss,
    TargetScale,
    VJEPALoss,
    Whitening,
    linear_encoder,
)

mpl.use("Agg")
from matplotlib import pyplot as plt

EPISODE = 200  # steps, as Gymnasium has it
GOAL = -170.0  # mean return
ACTIONS = Bounded(-2.0, 2.0, (1,))
WARM_UP = 20  # optimiser steps of a round in which the learning rate rises
PARTS = ("loss", "reward_loss", "optimizer")  # of a Run: what has a state
REFERENCES = {"true_model": "true model + MPPI", "random": "random actions"}
STYLES = {"true_model": {"color": "black", "ls": "--"}, "random": {"color": "#CC79A7", "ls": "-."}}
COLORS = ("#0072B2", "#D55E00", "#009E73", "#56B4E9", "#E69F00")
Row = dict[str, Any]


@dataclass
class Settings:
    """What the run does; every field is a command-line option."""

    seeds: list[int] = option([0], "each seed makes the networks, the data and the training")
    env_steps: int = option(10_000, "environment steps in all, random ones and those of the planner")
    collect_episodes: int = option(5, "episodes of 200 steps collected in a round, at once")
    latent_dim: int = option(3, "size of the latent")
    num_cells: int = option(64, "width of the two hidden layers of the predictor and of the reward head")
    train_steps: int = option(1_000, "optimiser steps in a round")
    windows: int = option(64, "windows in a batch")
    window: int = option(6, "steps in a window")
    lr: float = option(3e-3, "learning rate at the start of a round; it falls to zero along a cosine")
    ema_decay: float = option(0.99, "tau of the target encoder")
    planning_horizon: int = option(20, "steps of 0.05 s that MPPI imagines")
    optim_steps: int = option(3, "MPPI rounds for each action")
    num_candidates: int = option(64, "plans in an MPPI round")
    temperature: float = option(0.5, "MPPI temperature, in standard deviations of the elites' costs")
    episodes: int = option(20, "evaluation episodes, the same in every round and for every seed")
    eval_seed: int = option(0, "of the evaluation episodes' starts")


QUICK = {
    "env_steps": 800,
    "collect_episodes": 2,
    "num_cells": 16,
    "train_steps": 30,
    "windows": 16,
    "planning_horizon": 8,
    "optim_steps": 1,
    "num_candidates": 16,
    "episodes": 2,
}


def rollout(num_episodes: int, seed: int, policy: Any = None) -> TensorDict:
    """Whole episodes of Gymnasium's pendulum, at once; without a policy actions are random."""
    env: EnvBase = SerialEnv(num_episodes, partial(GymEnv, "Pendulum-v1"))
    if policy is not None:
        env = TransformedEnv(env)
        for transform in get_env_transforms_from_module(policy):
            env.append_transform(transform)
    env.set_seed(seed)
    torch.manual_seed(seed)  # of random actions
    with torch.no_grad():
        data = env.rollout(EPISODE, policy)
    env.close()
    return data.select("observation", "action", ("next", "reward"), ("next", "done"))


class Run:
    """One seed: networks, their optimisers, and what was collected.

    Every round draws its random numbers from ``seed`` and the number of the round: between rounds there is
    no state but what :meth:`state_dict` holds.

    Args:
        seed: of the networks, the data and the training.
        settings: of the whole script.
        data: steps ``(T)`` collected so far; by default the random episodes of the first round.
    """

    def __init__(self, seed: int, settings: Settings, data: TensorDict | None = None) -> None:
        self.seed, self.settings = seed, settings
        size, cells = settings.latent_dim, [settings.num_cells] * 2
        self.buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(settings.env_steps),
            sampler=SliceSampler(slice_len=settings.window, traj_key="episode"),
            batch_size=settings.windows * settings.window,
        )
        self.rounds = 0
        if data is None:
            data = self.collect()
        self.buffer.extend(data)
        whitening = Whitening(3)
        whitening.update(data["observation"][: EPISODE * settings.collect_episodes])
        torch.manual_seed(seed)
        self.model = VJEPA(
            linear_encoder(3, size, whitening=whitening),
            Predictor(size, action_dim=1, trunk="mlp", num_cells=cells, residual=True),
            target_scale=TargetScale(size, kind="constant", init_std=0.01),
        )
        self.reward_model = TensorDictModule(
            MLP(in_features=size + 1, out_features=1, num_cells=cells, activation_class=torch.nn.SiLU),
            in_keys=["latent", "action"],
            out_keys=["reward"],
        )
        self.loss = VJEPALoss(self.model, target_kl_coeff=0.0, marginal_entropy_coeff=1.0)
        self.updater = SoftUpdate(self.loss, eps=settings.ema_decay)
        self.reward_loss = RewardLoss(self.model, self.reward_model)
        self.optimizer = torch.optim.Adam(
            [*self.loss.parameters(), *self.reward_loss.parameters()], lr=settings.lr, fused=True
        )

    def collect(self) -> TensorDict:
        """The episodes of a round, step after step: random ones first, then the planner's."""
        count = self.settings.collect_episodes
        data = rollout(count, self.round_seed, self.policy() if self.rounds else None)
        episode = count * self.rounds + torch.arange(count).unsqueeze(1).expand(count, EPISODE)
        return data.set("episode", episode.clone()).reshape(-1)

    def train(self) -> None:
        """The model and the reward head, from all that was collected; each round has its own schedule."""
        steps = self.settings.train_steps
        torch.manual_seed(self.round_seed)
        self.buffer.set_rng(torch.Generator().manual_seed(self.round_seed))
        for step in tqdm(range(steps), desc=f"seed {self.seed}, round {self.rounds + 1}", leave=False):
            lr = self.settings.lr * 0.5 * (1.0 + math.cos(math.pi * step / steps))
            for group in self.optimizer.param_groups:
                group["lr"] = lr * min(1.0, (step + 1) / WARM_UP)
            windows = self.buffer.sample().reshape(-1, self.settings.window)
            losses = [*self.loss(windows).items(), *self.reward_loss(windows).items()]
            sum(value for key, value in losses if key.startswith("loss_")).backward()
            self.optimizer.step()
            self.optimizer.zero_grad()
            self.updater.step()

    def policy(self) -> TensorDictSequential:
        """Encoder and planner."""
        world = LatentEnv(self.model, action_spec=ACTIONS, reward_model=self.reward_model)
        return TensorDictSequential(self.model.encoder, make_planner(world, self.settings))

    def advance(self) -> Row:
        """One round: collect (the first is there from the start), train, evaluate."""
        if self.rounds:
            self.buffer.extend(self.collect())
        self.train()
        self.rounds += 1
        returns = evaluate(self.policy(), self.settings)
        return {"seed": self.seed, "env_steps": len(self.buffer), **returns}

    @property
    def round_seed(self) -> int:
        """Where the random numbers of the next round come from."""
        return 1_000 * (self.seed + 1) + self.rounds

    def state_dict(self) -> dict[str, Any]:
        """All that a later process needs to continue."""
        return {
            "seed": self.seed,
            "rounds": self.rounds,
            "data": self.buffer[:].to_dict(),
            **{name: getattr(self, name).state_dict() for name in PARTS},
        }

    @classmethod
    def from_state_dict(cls, state: dict[str, Any], settings: Settings) -> Run:
        """Continue where another process stopped."""
        data = TensorDict.from_dict(state["data"], auto_batch_size=True, batch_dims=1)
        run = cls(state["seed"], settings, data)
        for name in PARTS:
            getattr(run, name).load_state_dict(state[name])
        run.rounds = state["rounds"]
        return run


def make_planner(world: LatentEnv, settings: Settings) -> MPPI:
    """The same planner for the learned and for the true model."""
    return MPPI(
        world,
        planning_horizon=settings.planning_horizon,
        optim_steps=settings.optim_steps,
        num_candidates=settings.num_candidates,
        temperature=settings.temperature,
        warm_std=1.0,  # a swing that has become wrong must be dropped, not refined
        seed=0,
    )


def evaluate(policy: Any, settings: Settings) -> dict[str, float]:
    """Returns of the evaluation episodes: their mean, and the worst."""
    data = rollout(settings.episodes, settings.eval_seed, policy)
    returns = data["next", "reward"].sum(dim=(1, 2))
    return {"return_mean": returns.mean().item(), "return_min": returns.min().item()}


def true_state(observation: Tensor) -> Tensor:
    """Angle from the top, speed, and room for the reward of the last step."""
    angle = torch.atan2(observation[..., 1], observation[..., 0])
    return torch.stack([angle, observation[..., 2], torch.zeros_like(angle)], dim=-1)


def physics(state: Tensor, action: Tensor) -> Delta:
    """The equations of Gymnasium's pendulum; the reward of a step is part of the state behind it."""
    angle, speed = state[..., 0], state[..., 1]
    torque = action[..., 0].clamp(-2.0, 2.0)
    from_top = torch.remainder(angle + math.pi, 2.0 * math.pi) - math.pi
    reward = -(from_top.square() + 0.1 * speed.square() + 0.001 * torque.square())
    speed = (speed + 0.05 * (15.0 * angle.sin() + 3.0 * torque)).clamp(-8.0, 8.0)
    return Delta(torch.stack([angle + 0.05 * speed, speed, reward], dim=-1))


def true_cost(state: Tensor, action: Tensor) -> Tensor:
    """Minus the reward of the step that led to a state."""
    return -state[..., 2]


def references(settings: Settings) -> list[Row]:
    """What the same planner returns that knows the true system, and what random actions return."""
    world = LatentEnv(physics, action_spec=ACTIONS, cost=true_cost, latent_dim=3)
    encoder = TensorDictModule(true_state, in_keys=["observation"], out_keys=["latent"])
    policies = {"true_model": TensorDictSequential(encoder, make_planner(world, settings)), "random": None}
    return [{"policy": name, **evaluate(policy, settings)} for name, policy in policies.items()]


def save(path: Path, progress: dict[str, Any]) -> None:
    """Write a checkpoint; a process that is killed here leaves the one before."""
    payload = io.BytesIO()
    torch.save(progress, payload)
    content = payload.getvalue()
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_bytes(hashlib.sha256(content).digest() + content)
    os.replace(temporary, path)


def load(path: Path, settings: Settings) -> dict[str, Any]:
    """Read a checkpoint.

    Raises:
        ValueError: if the file is damaged, no checkpoint, or one of other settings.
    """
    content = path.read_bytes()
    digest, content = content[:32], content[32:]
    if hashlib.sha256(content).digest() != digest:
        raise ValueError(f"{path} is damaged, or no checkpoint of this script; move it away to start anew")
    progress: dict[str, Any] = torch.load(io.BytesIO(content), weights_only=True)
    asked, kept = asdict(settings), progress["settings"]
    if asked != kept:
        other = [name for name in {**asked, **kept} if asked.get(name) != kept.get(name)]
        changes = ", ".join(f"{name} was {kept.get(name)}, now {asked.get(name)}" for name in other)
        raise ValueError(
            f"{path} is of a run with other settings ({changes}); give the same, or another file"
        )
    return progress


def run_seeds(settings: Settings, checkpoint: Path | None = None) -> dict[str, Any]:
    """All rounds of all seeds, or those that the checkpoint lacks.

    Args:
        settings: of the script.
        checkpoint: read where it exists, written after every round.

    Returns:
        The rows, in order, the references, and the seconds that it took in all processes.

    Raises:
        ValueError: if the checkpoint is damaged or of other settings.
    """
    start = time.perf_counter()
    if checkpoint is not None and checkpoint.exists():
        progress = load(checkpoint, settings)
    else:
        progress = {"settings": asdict(settings), "rows": [], "references": references(settings)}
        progress.update(wall_s=0.0, run=None)
    before, kept = progress["wall_s"], progress["run"]
    rounds = settings.env_steps // (EPISODE * settings.collect_episodes)
    first = settings.seeds.index(kept["seed"]) if kept else 0
    for seed in settings.seeds[first:]:
        resumed = kept is not None and kept["seed"] == seed
        run = Run.from_state_dict(kept, settings) if resumed else Run(seed, settings)
        while run.rounds < rounds:
            row = run.advance()
            tqdm.write(f"seed {seed}, {row['env_steps']} steps: mean return {row['return_mean']:.1f}")
            progress["rows"].append(row)
            progress["wall_s"] = before + time.perf_counter() - start
            if checkpoint is not None:
                save(checkpoint, {**progress, "run": run.state_dict()})
    return {key: progress[key] for key in ("wall_s", "rows", "references")}


def table(rows: Sequence[Row], known: Sequence[Row]) -> str:
    """Mean and worst return of the evaluation episodes, by steps and seed."""
    seeds = list(dict.fromkeys(row["seed"] for row in rows))
    lines = [f"{'':18s}" + "".join(f"{f'seed {seed}':>20s}" for seed in seeds)]
    lines.append(f"{'environment steps':18s}" + f"{'mean (worst)':>20s}" * len(seeds))
    for steps in dict.fromkeys(row["env_steps"] for row in rows):
        here = {row["seed"]: shown(row) for row in rows if row["env_steps"] == steps}
        lines.append(f"{steps:<18d}" + "".join(f"{here[seed]:>20s}" for seed in seeds))
    lines.append("")
    lines += [f"{REFERENCES[row['policy']]:30s}{shown(row):>20s}" for row in known]
    for seed in seeds:
        good = [r["env_steps"] for r in rows if r["seed"] == seed and r["return_mean"] >= GOAL]
        reached = f"first after {good[0]} steps" if good else "never"
        lines.append(f"{f'{GOAL:g} or more, seed {seed}':30s}{reached:>26s}")
    return "\n".join(lines)


def shown(row: Row) -> str:
    """Mean and worst return."""
    return f"{row['return_mean']:.1f} ({row['return_min']:.1f})"


def figure(rows: Sequence[Row], known: Sequence[Row], path: Path) -> None:
    """Learning curves: all of them, and what lies near the true model."""
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    fig, axes = plt.subplots(1, 2, figsize=(9.5, 3.6), layout="constrained")
    seeds = list(dict.fromkeys(row["seed"] for row in rows))
    for ax in axes:
        for seed, color, marker in zip(seeds, cycle(COLORS), cycle("osD^v"), strict=False):
            here = [row for row in rows if row["seed"] == seed]
            steps = [row["env_steps"] for row in here]
            means = [row["return_mean"] for row in here]
            ax.plot(steps, means, color=color, marker=marker, ms=4, label=f"VJEPA + MPPI, seed {seed}")
        for row in known:
            ax.axhline(row["return_mean"], label=REFERENCES[row["policy"]], lw=1.5, **STYLES[row["policy"]])
        ax.axhline(GOAL, color="0.5", ls=":", lw=1.2, label=f"goal: {GOAL:g}")
        ax.set_xlabel("environment steps")
    axes[0].set(ylabel="mean return\n(sum of 200 rewards)", title="All evaluations")
    true = known[0]["return_mean"]
    axes[1].set(title="Near the true model", ylim=(true - 100.0, true + 15.0))
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    fig.savefig(path, dpi=110)
    plt.close(fig)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print the table, draw the figure, write the JSON."""
    parser = command_line(Settings, __doc__)
    parser.add_argument(
        "--checkpoint",
        type=Path,
        metavar="FILE",
        help="continue from this file where it exists, and save there",
    )
    settings, args = read_settings(parser, Settings, QUICK, arguments)
    if settings.env_steps < 1 or settings.env_steps % (EPISODE * settings.collect_episodes):
        parser.error(
            f"--env-steps must be a multiple of a round, {EPISODE} times --collect-episodes="
            f"{settings.collect_episodes}, got {settings.env_steps}"
        )
    if len(set(settings.seeds)) < len(settings.seeds):
        parser.error(f"--seeds must be distinct, got {settings.seeds}")
    prepare(args)
    if args.checkpoint is not None and args.checkpoint.exists():
        try:
            load(args.checkpoint, settings)  # refused before anything runs
        except ValueError as error:
            parser.error(f"--checkpoint: {error}")
    result = run_seeds(settings, args.checkpoint)
    print(table(result["rows"], result["references"]))
    path = args.out / "pendulum.png"
    figure(result["rows"], result["references"], path)
    print(f"\n{result['wall_s']:.0f} s; figure: {path}")
    write_report(args, settings, **result)


if __name__ == "__main__":
    main()
