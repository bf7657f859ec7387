"""Balance Gymnasium's CartPole-v1: VJEPA and a termination head from replay, discrete plans in latent space.

The first steps are random. In each round VJEPA learns from a replay buffer how latents move, a termination
head learns where episodes end, and categorical CEM plans in the model and collects the next steps, some at
random. Nobody tells a reward: a plan costs what a predicted end costs, and the energy of a Gaussian prior
around the latents in which episodes begin. When all is learned, value iteration in the model gives tree
search a value for its leaves, and every one of ``--planners`` plans in the same model for the same 100
evaluation episodes; the table says how long the pole stands.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib as mpl
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, OneHot, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import GymEnv, InitTracker, SerialEnv, TransformedEnv
from torchrl.modules import MLP, EGreedyModule, get_env_transforms_from_module
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from _settings import command_line, option, prepare, read_settings, write_report
from torchrl_vjepa import (
    CEM,
    VJEPA,
    GaussianPrior,
    LatentEnv,
    Planner,
    Predictor,
    TargetScale,
    TerminationLoss,
    TreeSearch,
    VJEPALoss,
    Whitening,
    linear_encoder,
)

mpl.use("Agg")
from matplotlib import pyplot as plt

EPISODE = 500  # steps, as Gymnasium has it
GOAL = 0.95  # share of episodes that must stand to the end
VALUE_BATCH = 512  # latents
WARM_UP = 50  # optimiser steps of a round in which the learning rate rises
ACTIONS = OneHot(2, dtype=torch.int64)  # as GymEnv has it
EVAL_SEED = 1_000_000  # of the evaluation episodes: no training seed comes here
LABELS = {
    "categorical-cem": "categorical CEM",
    "tree-search": "tree search",
    "random": "random actions",
}
STYLES = {"categorical-cem": "-", "tree-search": "--", "random": ":"}
COLORS = {"categorical-cem": "#0072B2", "tree-search": "#D55E00", "random": "0.45"}
PARTS = ("observation", "action", ("next", "reward"), ("next", "terminated"), ("next", "done"))
Row = dict[str, Any]


@dataclass
class Settings:
    """What the run does; every field is a command-line option."""

    seeds: list[int] = option([0], "each seed makes the networks, the data and the training")
    random_steps: int = option(2_000, "random environment steps at the beginning")
    rounds: int = option(3, "times that the planner collects")
    collect_steps: int = option(2_000, "environment steps that it collects each time")
    collect_envs: int = option(4, "environments that collect at once")
    epsilon: float = option(0.1, "share of random actions while it collects")
    latent_dim: int = option(4, "size of the latent")
    num_cells: int = option(32, "width of the two hidden layers of the predictor and of the termination head")
    train_steps: int = option(600, "optimiser steps in a round")
    windows: int = option(64, "windows in a batch")
    window: int = option(6, "steps in a window")
    lr: float = option(5e-3, "learning rate at the start of a round; it falls to zero along a cosine")
    ema_decay: float = option(0.9, "tau of the target encoder")
    end_cost: float = option(1000.0, "cost of a predicted end, in nats of the prior")
    prior_std: float = option(10.0, "spread of the prior, in standard deviations of the latents at a start")
    planning_horizon: int = option(50, "steps of 0.02 s that CEM imagines")
    optim_steps: int = option(2, "CEM rounds for each action")
    num_candidates: int = option(32, "plans in a CEM round")
    value_sweeps: int = option(200, "sweeps of value iteration over the latents of the buffer")
    value_steps: int = option(20, "optimiser steps in a sweep")
    value_cells: int = option(64, "width of the two hidden layers of the value")
    value_lr: float = option(3e-3, "its learning rate at the start; it falls to zero along a cosine")
    discount: float = option(0.98, "of tree search and its value; CEM has none")
    search_horizon: int = option(10, "steps that tree search looks ahead")
    num_simulations: int = option(16, "simulations of tree search for each action")
    planners: list[str] = option(list(LABELS), "who is evaluated", choices=list(LABELS))
    episodes: int = option(100, "evaluation episodes, the same for every planner and seed")


QUICK = {
    "random_steps": 400,
    "rounds": 1,
    "collect_steps": 80,
    "train_steps": 40,
    "planning_horizon": 8,
    "num_candidates": 16,
    "value_sweeps": 10,
    "search_horizon": 4,
    "num_simulations": 4,
    "episodes": 4,
}


def rollout(
    num_envs: int, seed: int, policy: Any = None, steps: int = EPISODE, *, once: bool = True
) -> TensorDict:
    """Steps of several cart-poles at once; without a policy actions are random.

    Args:
        num_envs: cart-poles ``B``.
        seed: of the starts.
        policy: what acts.
        steps: of each, ``T`` at most.
        once: stop when all have fallen; else who has fallen starts again.

    Returns:
        Of batch size ``(B, T)``.
    """
    env = TransformedEnv(SerialEnv(num_envs, partial(GymEnv, "CartPole-v1")), InitTracker())
    for transform in get_env_transforms_from_module(policy) if policy is not None else ():
        env.append_transform(transform)
    env.set_seed(seed)
    with torch.no_grad():
        data = env.rollout(steps, policy, break_when_any_done=False, break_when_all_done=once)
    env.close()
    return data.select(*PARTS)


def first_returns(data: TensorDict) -> Tensor:
    """Return of the first episode of each row ``(B, T)``; what comes behind its end does not count."""
    done = data["next", "done"].squeeze(-1).long()
    alive = done.cumsum(1) - done == 0
    return (data["next", "reward"].squeeze(-1) * alive).sum(1)


def with_episodes(data: TensorDict, first: int) -> TensorDict:
    """Rows ``(B, T)`` as steps ``(B T)``, each with the number of its episode, from ``first`` on."""
    done = data["next", "done"].squeeze(-1).long()
    starts = torch.cat([torch.ones_like(done[:, :1]), done[:, :-1]], dim=1)
    numbers = first - 1 + starts.flatten().cumsum(0)
    return data.reshape(-1).set("episode", numbers)


class Value(nn.Module):
    """Minus the square of a network: what costs is never negative, and spans decades.

    Where dynamics are linear and costs quadratic, the root is a norm of the latent.

    Args:
        size: of the latent.
        num_cells: width of the two hidden layers.
    """

    def __init__(self, size: int, num_cells: int) -> None:
        super().__init__()
        layers = MLP(in_features=size, out_features=1, num_cells=[num_cells] * 2, activation_class=nn.SiLU)
        self.root = nn.Sequential(layers, nn.Flatten(-2))

    def forward(self, latent: Tensor) -> Tensor:
        """Values ``(*B)`` of latents ``(*B, D)``."""
        return -self.root(latent).square()


def value_iteration(
    value: Value, world: LatentEnv, latents: Tensor, *, discount: float, sweeps: int, steps: int, lr: float
) -> None:
    r"""Fit :math:`V(z) = \max_a -c(z_a) - p(z_a) c_{end} + \gamma (1 - p(z_a)) V(z_a)`.

    :math:`z_a` is what the model predicts behind an action. It does for all of them, so that the value is
    that of the best actions, whoever collected the latents.

    Args:
        value: is trained.
        world: the model; its costs are not negative.
        latents: where the equation shall hold, ``(N, D)``.
        discount: :math:`\gamma`.
        sweeps: how often the right-hand side is evaluated anew, at all latents.
        steps: of the optimiser in between.
        lr: at the start.
    """
    optimizer = torch.optim.Adam(value.parameters(), lr=lr, fused=True)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, sweeps * steps)
    model, n = world.world_model, ACTIONS.n
    actions = torch.eye(n).unsqueeze(1).expand(n, len(latents), n)
    with torch.no_grad():
        following = model.transition(latents.expand(n, *latents.shape), actions).mean
        end = model.termination_probability(following, actions)
        cost = model.stage_cost(following, actions) + end * model.termination_cost
    for _ in range(sweeps):
        with torch.no_grad():
            target = (cost - discount * (1 - end) * value(following)).amin(0).clamp_min(0).sqrt()
        for _ in range(steps):
            index = torch.randint(len(latents), (VALUE_BATCH,))
            nn.functional.smooth_l1_loss(value.root(latents[index]), target[index]).backward()
            optimizer.step()
            optimizer.zero_grad()
            scheduler.step()


class Run:
    """One seed: what was collected, and what is learned from it.

    Args:
        seed: of the networks, the data and the training.
        settings: of the whole script.
    """

    def __init__(self, seed: int, settings: Settings) -> None:
        self.seed, self.settings, self.rounds = seed, settings, 0
        self.lengths: list[tuple[int, float]] = []
        capacity = settings.random_steps + settings.rounds * settings.collect_steps
        self.buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(capacity),
            sampler=SliceSampler(slice_len=settings.window, traj_key="episode"),
            batch_size=settings.windows * settings.window,
        )
        size, cells = settings.latent_dim, [settings.num_cells] * 2
        whitening = Whitening(4)
        torch.manual_seed(self.round_seed)
        self.collect(None, settings.random_steps)
        whitening.update(self.buffer[:]["observation"])
        self.model = VJEPA(
            linear_encoder(4, size, whitening=whitening),
            Predictor(size, action_dim=2, trunk="mlp", num_cells=cells, residual=True),
            # Fine, or errors of centimetres would drown in the target's own noise.
            target_scale=TargetScale(size, kind="constant", init_std=0.001),
        )
        self.termination_model = TensorDictModule(
            MLP(in_features=size, out_features=1, num_cells=cells, activation_class=nn.SiLU),
            in_keys=["latent"],
            out_keys=["termination_logit"],
        )
        self.value = Value(size, settings.value_cells)
        self.loss = VJEPALoss(
            self.model, target_kl_coeff=0.0, residual_variance="batch", marginal_entropy_coeff=1.0
        )
        self.updater = SoftUpdate(self.loss, eps=settings.ema_decay)
        self.termination_loss = TerminationLoss(self.model, self.termination_model)
        self.optimizer = torch.optim.Adam(
            [*self.loss.parameters(), *self.termination_loss.parameters()], lr=settings.lr, fused=True
        )

    @property
    def round_seed(self) -> int:
        """Where the random numbers of a round come from."""
        return 1_000 * (self.seed + 1) + self.rounds

    def collect(self, policy: Any, steps: int) -> None:
        """Put steps into the buffer; episodes begin anew and go on within a round."""
        count = self.settings.collect_envs
        data = rollout(count, self.round_seed, policy, steps // count, once=False)
        first = int(self.buffer[:]["episode"].max()) + 1 if len(self.buffer) else 0
        data = with_episodes(data, first)
        self.buffer.extend(data)
        ended = max(1, int(data["next", "terminated"].sum()))
        self.lengths.append((len(self.buffer), len(data) / ended))

    def train(self) -> None:
        """Model and termination head, from all that was collected."""
        steps = self.settings.train_steps
        torch.manual_seed(self.round_seed)
        self.buffer.set_rng(torch.Generator().manual_seed(self.round_seed))
        for step in tqdm(range(steps), desc=f"seed {self.seed}, round {self.rounds}", leave=False):
            lr = self.settings.lr * 0.5 * (1.0 + math.cos(math.pi * step / steps))
            for group in self.optimizer.param_groups:
                group["lr"] = lr * min(1.0, (step + 1) / WARM_UP)
            windows = self.buffer.sample().reshape(-1, self.settings.window)
            losses = [*self.loss(windows).items(), *self.termination_loss(windows).items()]
            sum(value for key, value in losses if key.startswith("loss_")).backward()
            self.optimizer.step()
            self.optimizer.zero_grad()
            self.updater.step()

    def world(self) -> LatentEnv:
        """The learned model as an environment: ends cost, and so does leaving the latents of starts."""
        data = self.buffer[:]
        episode = data["episode"]
        is_start = torch.cat([torch.ones(1, dtype=torch.bool), episode[1:] != episode[:-1]])
        with torch.no_grad():
            starts = self.model.encoder(data.select("observation")[is_start])["latent"]
        spread = self.settings.prior_std**2 * torch.cov(starts.mT)
        prior = GaussianPrior(self.settings.latent_dim, mean=starts.mean(0), covariance=spread)
        normaliser = prior(None).log_prob(starts.mean(0))
        return LatentEnv(
            self.model,
            action_spec=ACTIONS,
            prior=prior,
            # The energy of the prior's mode is zero then: an end saves nothing.
            cost=lambda latent, action: normaliser.expand(latent.shape[:-1]),
            termination_model=self.termination_model,
            termination_cost=self.settings.end_cost,
        )

    def planner(self, name: str) -> Planner:
        """Categorical CEM or tree search."""
        world, settings = self.world(), self.settings
        if name == "tree-search":
            return TreeSearch(
                world,
                settings.search_horizon,
                settings.num_simulations,
                discount=settings.discount,
                leaf_value=self.value,
                output="best",
                seed=self.seed,
            )
        return CEM(
            world,
            planning_horizon=settings.planning_horizon,
            optim_steps=settings.optim_steps,
            num_candidates=settings.num_candidates,
            output="best",
            seed=self.seed,
        )

    def learn_value(self) -> None:
        """What the leaves of tree search are worth, from the model at the latents of the buffer."""
        settings = self.settings
        torch.manual_seed(self.round_seed)
        with torch.no_grad():
            latents = self.model.encoder(self.buffer[:].select("observation"))["latent"]
        value_iteration(
            self.value,
            self.world(),
            latents,
            discount=settings.discount,
            sweeps=settings.value_sweeps,
            steps=settings.value_steps,
            lr=settings.value_lr,
        )

    def learn(self) -> None:
        """All rounds: train, collect with the planner, train; then the value, if somebody asks for it."""
        settings = self.settings
        self.train()
        for _ in range(settings.rounds):
            self.rounds += 1
            torch.manual_seed(self.round_seed)
            explore = EGreedyModule(ACTIONS, eps_init=settings.epsilon, eps_end=settings.epsilon)
            policy = TensorDictSequential(self.model.encoder, self.planner("categorical-cem"), explore)
            self.collect(policy, settings.collect_steps)
            self.train()
        if "tree-search" in settings.planners:
            self.learn_value()

    def evaluate(self, name: str) -> tuple[Row, Tensor]:
        """One planner on the evaluation episodes: the row, and the returns."""
        policy = None
        if name != "random":
            policy = TensorDictSequential(self.model.encoder, self.planner(name))
        start = time.process_time()
        torch.manual_seed(self.seed)
        returns = first_returns(rollout(self.settings.episodes, EVAL_SEED, policy))
        return {
            "planner": name,
            "seed": self.seed,
            "env_steps": len(self.buffer),
            "return_mean": returns.mean().item(),
            "return_min": returns.min().item(),
            "balanced": (returns >= EPISODE).float().mean().item(),
            "evaluation_cpu_s": time.process_time() - start,
        }, returns


def run_seed(seed: int, settings: Settings) -> tuple[list[Row], list[tuple[int, float]], dict[str, Tensor]]:
    """Learn once, plan with every planner.

    Returns:
        Rows; the steps at the end of each round of collecting, with the steps of that round for each fall;
        and the returns of each planner.
    """
    start = time.process_time()
    run = Run(seed, settings)
    run.learn()
    learning = time.process_time() - start
    rows, returns = [], {}
    for name in tqdm(settings.planners, desc=f"seed {seed}: evaluate", leave=False):
        row, returns[name] = run.evaluate(name)
        rows.append({**row, "learning_cpu_s": learning})
    return rows, run.lengths, returns


def table(rows: Sequence[Row]) -> str:
    """One line for each planner and seed."""
    lines = [
        f"{'planner':18s}{'seed':>6s}{'env steps':>11s}{'mean return':>13s}{'worst':>7s}{'balanced':>10s}"
    ]
    for name in dict.fromkeys(row["planner"] for row in rows):
        here = [row for row in rows if row["planner"] == name]
        lines += [
            f"{LABELS[name]:18s}{row['seed']:6d}{row['env_steps']:11d}{row['return_mean']:13.1f}"
            f"{row['return_min']:7.0f}{row['balanced']:10.0%}"
            for row in here
        ]
    return "\n".join(lines)


def figure(
    curves: dict[int, list[tuple[int, float]]], returns: dict[int, dict[str, Tensor]], path: Path
) -> None:
    """How long the pole stood while steps were collected, and in the evaluation."""
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    fig, (learned, stood) = plt.subplots(1, 2, figsize=(9.5, 3.4), layout="constrained")
    for (seed, curve), marker in zip(curves.items(), cycle("osD^v"), strict=False):
        steps, lengths = zip(*curve, strict=True)
        learned.plot(steps, lengths, color="0.3", marker=marker, ms=4, lw=1, label=f"seed {seed}")
    learned.set(
        xlabel="environment steps",
        ylabel="steps for each fall (at most all of a round)",
        title="While collecting, with random actions in between",
        yscale="log",
        xlim=(0, None),
    )
    learned.yaxis.set_major_formatter("{x:,.0f}")
    learned.legend(frameon=False, loc="lower right")
    for name, style in STYLES.items():
        if name not in next(iter(returns.values())):
            continue
        values = torch.cat([here[name] for here in returns.values()])
        length = torch.arange(1, EPISODE + 1)
        share = (values >= length.unsqueeze(1)).float().mean(1)
        stood.plot(length, share, color=COLORS[name], ls=style, lw=2, label=LABELS[name])
    stood.axhline(GOAL, color="0.6", lw=0.8)
    stood.annotate(f"{GOAL:.0%}", (EPISODE, GOAL), (0, -10), textcoords="offset points", color="0.4")
    stood.set(
        xlabel="environment steps of an episode",
        ylabel="share of evaluation episodes that stand",
        title="Evaluation, all seeds",
        ylim=(0, 1.04),
    )
    stood.legend(frameon=False, loc="center right")
    fig.savefig(path, dpi=110)
    plt.close(fig)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print the table, draw the figure, write the JSON."""
    parser = command_line(Settings, __doc__)
    settings, args = read_settings(parser, Settings, QUICK, arguments)
    if len(set(settings.seeds)) < len(settings.seeds):
        parser.error(f"--seeds must be distinct, got {settings.seeds}")
    for name in ("random_steps", "collect_steps"):
        steps = getattr(settings, name)
        if steps < settings.collect_envs or steps % settings.collect_envs:
            parser.error(
                f"--{name.replace('_', '-')} must be a positive multiple of "
                f"--collect-envs={settings.collect_envs}, got {steps}"
            )
    prepare(args)
    start = time.perf_counter()
    rows: list[Row] = []
    curves: dict[int, list[tuple[int, float]]] = {}
    returns: dict[int, dict[str, Tensor]] = {}
    for seed in settings.seeds:
        new, curves[seed], returns[seed] = run_seed(seed, settings)
        rows += new
        tqdm.write(table(new))
    wall = time.perf_counter() - start
    print(table(rows))
    path = args.out / "cartpole.png"
    figure(curves, returns, path)
    print(f"\n{wall:.0f} s; figure: {path}")
    write_report(args, settings, wall_s=wall, rows=rows, curves=curves)


if __name__ == "__main__":
    main()
