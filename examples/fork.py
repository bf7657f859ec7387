"""Left or right: predict a future with two branches, and plan so that both are safe.

A vehicle drives towards a wall; just before it a reflex swerves to the left or to the right, by chance.
Aiming at the middle of the wall is safe, aiming beside it is not: one of the two swerves ends in it. Four
VJEPAs that differ in their head alone learn from the same random steps. Each plans twice with the same
planner and the same cost: on samples of its prediction, and on the mean. The table says how likely they
find held-out steps, how much of their mass is in the wall where the truth has none, and how often the
vehicle gets past it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
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
Row = dict[str, Any]


def option(default: Any, help: str) -> Any:
    """A setting with the sentence that --help says about it."""
    if isinstance(default, list):
        return field(default_factory=lambda: list(default), metadata={"help": help})
    return field(default=default, metadata={"help": help})


@dataclass
class Settings:
    """What the run does; every field is a command-line option."""

    seeds: list[int] = option([0], "each seed makes the data, the training and the planner's noise")
    heads: list[str] = option(list(HEADS), "heads to compare")
    train_episodes: int = option(4_000, "episodes of random steering to learn from")
    test_episodes: int = option(1_000, "held-out episodes of random steering")
    train_steps: int = option(1_500, "optimiser steps")
    batch_size: int = option(512, "transitions in a batch")
    lr: float = option(5e-3, "peak learning rate (one cycle)")
    num_cells: int = option(64, "width of the two hidden layers of the predictor")
    ema_decay: float = option(0.99, "tau of the target encoder")
    target_std: float = option(0.003, "standard deviation of the target distribution, in latent units")
    mass_samples: int = option(1_000, "samples of each prediction for its mass in the wall")
    planning_horizon: int = option(3, "steps that the planner imagines")
    num_candidates: int = option(64, "plans that it compares")
    num_samples: int = option(64, "imagined trajectories for each plan")
    episodes: int = option(200, "evaluation episodes, the same luck for every planner")


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
    model = VJEPA(
        linear_encoder(2, 2, whitening=whitening),
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
    optimizer = torch.optim.Adam(loss.parameters(), lr=settings.lr, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, settings.lr, total_steps=settings.train_steps, pct_start=0.1
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
    matrix: Tensor
    offset: Tensor

    @classmethod
    def of(cls, model: VJEPA) -> Belief:
        """The encoder's matrix and offset, read off four points."""
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
class LatentCost:
    """The cost of the road, of latents."""

    system: ForkSystem
    belief: Belief

    def __call__(self, latent: Tensor, action: Tensor) -> Tensor:
        """Costs of shape ``(*B)``."""
        return self.system.cost(self.belief.decode(latent), action)


def safe_contexts(data: TensorDict, system: ForkSystem) -> tuple[Tensor, Tensor]:
    """Held-out steps in the fork of which both futures are safe."""
    position, action = data["observation"][:, 0], data["action"][:, 0]
    chosen = system.in_fork(position) & (system.wall_mass(position, action) < 1e-3)
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


def run_seed(seed: int, settings: Settings) -> tuple[list[Row], list[Row], dict[str, Any]]:
    """One seed: collect, train every head, judge its prediction, plan with it."""
    system = ForkSystem()
    data = collect(settings.train_episodes, seed)
    test = collect(settings.test_episodes, 50_000 + seed)
    before, after, action = test["observation"][:, 0], test["observation"][:, 1], test["action"][:, 0]
    position, steering = safe_contexts(test, system)

    drawn: dict[str, Any] = {TRUTH: {"log_prob": lambda x, u, y: system.dist(x, u).log_prob(y)}}
    truth = {
        "seed": seed,
        "test_log_prob": system.dist(before, action).log_prob(after).mean().item(),
        "wall_mass": system.wall_mass(position, steering).mean().item(),
        "mean_in_wall": system.in_wall(system.dist(position, steering).mean).float().mean().item(),
    }
    oracle: list[Row] = []
    for how in PLANNERS:
        planner = make_planner(
            system.dist, system.cost, how, seed, settings, latent_dim=2, latent_key="observation"
        )
        drawn[TRUTH][how] = drive(planner, system, seed, settings)
        oracle.append({**truth, "planner": how, "success": success(drawn[TRUTH][how])})

    rows: list[Row] = []
    for head in settings.heads:
        model = train(head, data, seed, settings)
        belief = Belief.of(model)
        torch.manual_seed(seed)
        with torch.no_grad():
            log_prob = belief.log_prob(before, action, after).mean().item()
            inside = system.in_wall(belief.sample(position, steering, settings.mass_samples))
            mean_inside = system.in_wall(belief.mean(position, steering))
        drawn[head] = {"log_prob": belief.log_prob, "mean": belief.mean}
        for how in PLANNERS:
            planner = make_planner(model, LatentCost(system, belief), how, seed, settings)
            episodes = drive(TensorDictSequential(model.encoder, planner), system, seed, settings)
            drawn[head][how] = episodes
            rows.append(
                {
                    "head": head,
                    "planner": how,
                    "seed": seed,
                    "test_log_prob": log_prob,
                    "wall_mass": inside.float().mean().item(),
                    "mean_in_wall": mean_inside.float().mean().item(),
                    "success": success(episodes),
                }
            )
    return rows, oracle, drawn
