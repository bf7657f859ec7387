"""What scripts on the noisy TV share: data, the training recipe, and the reward head."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from _settings import option
from torchrl_vjepa import (
    JEPA,
    VJEPA,
    BatchedNoisyTVEnv,
    DeltaHead,
    DiagGaussianHead,
    JEPALoss,
    LatentModel,
    Predictor,
    QuadraticReward,
    RewardLoss,
    TargetScale,
    VJEPALoss,
    Whitening,
    linear_encoder,
)


@dataclass
class Recipe:
    """How world models are trained; every field is a command-line option."""

    seeds: list[int] = option([0], "systems: each seed makes the matrices, the data and the training")
    frames: int = option(20_000, "random steps collected from each system")
    latent_dim: int = option(4, "size of the latent, no larger than the signal's")
    skips: list[int] = option([1, 4, 16], "prediction steps that are learned together")
    skip_weights: list[float] = option([0.1, 0.3, 0.6], "their weights: long skips tell the distractor apart")
    restarts: int = option(8, "VJEPAs and JEPAs trained side by side; the objective chooses one")
    train_steps: int = option(600, "optimiser steps")
    windows: int = option(32, "windows in a batch")
    window: int = option(20, "steps in a window, more than the largest skip")
    lr: float = option(0.1, "peak learning rate of VJEPA and JEPA (one cycle)")
    ema_decay: float = option(0.9, "tau of the target encoder")


class Trained(NamedTuple):
    """A model, and the averaged encoder that made its targets."""

    model: LatentModel
    target_encoder: TensorDictModuleBase


@dataclass
class System:
    """One noisy TV and what was collected from it."""

    seed: int
    noise_scale: float
    buffer: TensorDictReplayBuffer
    data: TensorDict
    whitening: Whitening

    @classmethod
    def collect(cls, seed: int, noise_scale: float, settings: Recipe) -> System:
        """Random actions through a TorchRL collector into a replay buffer of 200-step episodes."""
        torch.manual_seed(seed)
        num_envs = 20
        env = BatchedNoisyTVEnv(num_envs, noise_scale, system_seed=seed, seed=seed)
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(settings.frames),
            sampler=SliceSampler(
                slice_len=settings.window, traj_key=("collector", "traj_ids"), cache_values=True
            ),
            batch_size=settings.windows * settings.window,
        )
        buffer.set_rng(torch.Generator().manual_seed(seed))
        collector = Collector(env, frames_per_batch=num_envs * 200, total_frames=settings.frames)
        for batch in collector:
            buffer.extend(batch.reshape(-1))
        collector.shutdown()
        data = buffer[:].reshape(-1, 200)
        whitening = Whitening(env.system.observation_dim)
        whitening.update(data["observation"])
        return cls(seed, noise_scale, buffer, data, whitening)

    def make_env(self, num_envs: int, seed: int) -> BatchedNoisyTVEnv:
        """The same system with fresh noise."""
        return BatchedNoisyTVEnv(num_envs, self.noise_scale, system_seed=self.seed, seed=seed)


def make_vjepa(system: System, settings: Recipe) -> VJEPA:
    """Linear VJEPA on whitened observations."""
    return VJEPA(
        linear_encoder(20, settings.latent_dim, whitening=system.whitening),
        Predictor(
            settings.latent_dim,
            action_dim=2,
            head=DiagGaussianHead("constant"),
            skips=settings.skips,
        ),
        target_scale=TargetScale(settings.latent_dim, kind="constant", init_std=0.01),
    )


def make_jepa(system: System, settings: Recipe) -> JEPA:
    """Linear deterministic JEPA on whitened observations."""
    return JEPA(
        linear_encoder(20, settings.latent_dim, whitening=system.whitening),
        Predictor(settings.latent_dim, action_dim=2, head=DeltaHead(), skips=settings.skips),
    )


def vjepa_loss(models: Sequence[VJEPA], settings: Recipe) -> VJEPALoss:
    """The mutual information bound: likelihood at the optimal residual covariance, and entropy."""
    return VJEPALoss(
        models,
        skip_weights=settings.skip_weights,
        stacked_data=True,
        target_kl_coeff=0.0,
        residual_variance="batch",
        marginal_entropy_coeff=1.0,
    )


def jepa_loss(models: Sequence[JEPA], settings: Recipe) -> JEPALoss:
    """Squared error, with the same entropy term against collapse."""
    return JEPALoss(
        models,
        skip_weights=settings.skip_weights,
        stacked_data=True,
        prediction_coeff=0.5,
        marginal_entropy_coeff=1.0,
    )


def objective(losses: TensorDict) -> Tensor:
    """What is minimised: the sum of the ``loss_*`` entries, one number for each model."""
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def train_restarts(
    name: str,
    make_model: Callable[[System, Recipe], Any],
    make_loss: Callable[[Sequence[Any], Recipe], Any],
    score: Callable[[TensorDict], Tensor],
    systems: Sequence[System],
    settings: Recipe,
) -> list[Trained]:
    """Train all restarts on all systems as one batch; for each system keep the best by its objective."""
    models = []
    for system in systems:
        torch.manual_seed(system.seed)
        models += [make_model(system, settings) for _ in range(settings.restarts)]
    loss = make_loss(models, settings)
    updater = SoftUpdate(loss, eps=settings.ema_decay)
    optimizer = torch.optim.Adam(loss.parameters(), lr=settings.lr, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, settings.lr, total_steps=settings.train_steps, pct_start=0.2
    )

    def windows(keys: Sequence[Any] = ("observation", "action", ("next", "done"))) -> TensorDict:
        batches = [system.buffer.sample().select(*keys) for system in systems]
        stacked = torch.stack([batch.reshape(-1, settings.window) for batch in batches])
        return stacked.repeat_interleave(settings.restarts, dim=0)

    torch.manual_seed(0)
    progress = tqdm(range(settings.train_steps), desc=name.format(len(models)), leave=False)
    for _ in progress:
        losses = loss(windows())
        objective(losses).sum().backward()
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
        updater.step()
    loss.eval()
    with torch.no_grad():
        scores = torch.stack([score(loss(windows())) for _ in range(20)]).mean(0)
    # argmax takes the NaN of a start that diverged for the largest number.
    best = scores.nan_to_num(-torch.inf).reshape(len(systems), settings.restarts).argmax(1)
    chosen = [i * settings.restarts + int(restart) for i, restart in enumerate(best)]
    return [Trained(loss.get_model(index), loss.target_encoder(index)) for index in chosen]


def train_reward(model: LatentModel, system: System, data: TensorDict | None = None) -> TensorDictModule:
    """A quadratic reward head on predicted latents; the problem is convex, so LBFGS solves it."""
    torch.manual_seed(system.seed)
    head = QuadraticReward(model.predictor.latent_dim, model.predictor.action_dim)
    reward_model = TensorDictModule(head, in_keys=["latent", "action"], out_keys=["reward"])
    loss = RewardLoss(model, reward_model)
    optimizer = torch.optim.LBFGS(
        loss.parameters(), max_iter=200, history_size=50, line_search_fn="strong_wolfe"
    )

    def closure() -> Tensor:
        optimizer.zero_grad()
        value = loss(system.data if data is None else data)["loss_reward"]
        value.backward()
        return value

    optimizer.step(closure)
    return reward_model
