"""Steer the noisy TV: train VJEPA from a replay buffer, plan with MPPI in its latent space.

A camera sees a small signal that can be controlled, buried under a distractor of up to 64 times its
variance. Three world models of the same size learn from the same 20,000 random steps: VJEPA and JEPA
predict representations, PixelAR predicts pixels. Each plans with the same MPPI. The table says what
they pay, next to the LQG controller that knows the true system.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import mean
from typing import Any

import matplotlib as mpl
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl import logger
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.modules import get_env_transforms_from_module
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from _settings import command_line, option, read_settings
from torchrl_vjepa import (
    JEPA,
    MPPI,
    VJEPA,
    BatchedNoisyTVEnv,
    DeltaHead,
    DiagGaussianHead,
    JEPALoss,
    LatentEnv,
    LatentModel,
    LinearGaussianSystem,
    LQGController,
    PixelAR,
    PixelARLoss,
    PixelDecoder,
    Predictor,
    QuadraticReward,
    RewardLoss,
    TargetScale,
    VJEPALoss,
    Whitening,
    linear_encoder,
    linear_probe,
)

mpl.use("Agg")
from matplotlib import pyplot as plt

CONTROLLERS = {
    "lqg": "LQG (knows the system)",
    "vjepa_mppi": "VJEPA + MPPI",
    "jepa_mppi": "JEPA + MPPI",
    "pixel_ar_mppi": "PixelAR + MPPI",
    "no_control": "no control",
    "random": "random actions",
}


STYLES = {
    "lqg": {"color": "black", "ls": "-", "lw": 2.5},
    "vjepa_mppi": {"color": "#0072B2", "ls": "-"},
    "jepa_mppi": {"color": "#56B4E9", "ls": "--"},
    "pixel_ar_mppi": {"color": "#D55E00", "ls": "-"},
    "no_control": {"color": "0.5", "ls": ":"},
    "random": {"color": "#CC79A7", "ls": "-."},
}
Row = dict[str, Any]
Episodes = dict[tuple[str, float], TensorDict]


@dataclass
class Settings:
    """What the run does; every field is a command-line option."""

    seeds: list[int] = option([0], "systems: each seed makes the matrices, the data and the training")
    noise_scales: list[float] = option([0.0, 4.0, 8.0], "scales of the distractor")
    frames: int = option(20_000, "random steps collected from each system")
    latent_dim: int = option(4, "size of the latent, no larger than the signal's")
    skips: list[int] = option([1, 4, 16], "prediction steps that are learned together")
    skip_weights: list[float] = option([0.1, 0.3, 0.6], "their weights: long skips tell the distractor apart")
    restarts: int = option(8, "VJEPAs and JEPAs trained side by side; the objective chooses one")
    train_steps: int = option(600, "optimiser steps")
    windows: int = option(32, "windows in a batch")
    window: int = option(20, "steps in a window, more than the largest skip")
    lr: float = option(0.1, "peak learning rate of VJEPA and JEPA (one cycle)")
    pixel_lr: float = option(0.03, "peak learning rate of PixelAR (one cycle)")
    ema_decay: float = option(0.9, "tau of the target encoder")
    planning_horizon: int = option(6, "steps that MPPI imagines")
    optim_steps: int = option(5, "MPPI rounds for each action")
    num_candidates: int = option(256, "plans in an MPPI round")
    top_k: int = option(32, "elites of an MPPI round")
    temperature: float = option(1.0, "MPPI temperature, in standard deviations of the elites' costs")
    episodes: int = option(32, "evaluation episodes of 200 steps, the same noise for every controller")


QUICK = {
    "noise_scales": [0.0, 8.0],
    "frames": 4_000,
    "restarts": 2,
    "train_steps": 150,
    "episodes": 4,
    "optim_steps": 2,
}


@dataclass
class System:
    """One noisy TV and what was collected from it."""

    seed: int
    noise_scale: float
    buffer: TensorDictReplayBuffer
    data: TensorDict
    whitening: Whitening

    @classmethod
    def collect(cls, seed: int, noise_scale: float, settings: Settings) -> System:
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


def make_vjepa(system: System, settings: Settings) -> VJEPA:
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


def make_jepa(system: System, settings: Settings) -> JEPA:
    """Linear deterministic JEPA on whitened observations."""
    return JEPA(
        linear_encoder(20, settings.latent_dim, whitening=system.whitening),
        Predictor(settings.latent_dim, action_dim=2, head=DeltaHead(), skips=settings.skips),
    )


def vjepa_loss(models: Sequence[VJEPA], settings: Settings) -> VJEPALoss:
    """The mutual information bound: likelihood at the optimal residual covariance, and entropy."""
    return VJEPALoss(
        models,
        skip_weights=settings.skip_weights,
        stacked_data=True,
        target_kl_coeff=0.0,
        residual_variance="batch",
        marginal_entropy_coeff=1.0,
    )


def jepa_loss(models: Sequence[JEPA], settings: Settings) -> JEPALoss:
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
    make_model: Callable[[System, Settings], Any],
    make_loss: Callable[[Sequence[Any], Settings], Any],
    score: Callable[[TensorDict], Tensor],
    systems: Sequence[System],
    settings: Settings,
) -> list[LatentModel]:
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
    return [loss.get_model(i * settings.restarts + int(restart)) for i, restart in enumerate(best)]


def train_pixel_ar(system: System, settings: Settings) -> PixelAR:
    """The reconstruction baseline: the same latent size, trained to predict the next observation."""
    torch.manual_seed(system.seed)
    encoder = linear_encoder(20, settings.latent_dim)
    model = PixelAR(encoder, PixelDecoder(encoder, settings.latent_dim, 20, action_dim=2))
    loss = PixelARLoss(model)
    optimizer = torch.optim.Adam(loss.parameters(), lr=settings.pixel_lr)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, settings.pixel_lr, total_steps=settings.train_steps
    )
    for _ in range(settings.train_steps):
        loss(system.buffer.sample().reshape(-1, settings.window))["loss_reconstruction"].backward()
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
    return model


def train_reward(model: LatentModel, system: System) -> TensorDictModule:
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
        value = loss(system.data)["loss_reward"]
        value.backward()
        return value

    optimizer.step(closure)
    return reward_model


def make_policy(
    model: LatentModel, reward_model: TensorDictModule, system: System, settings: Settings
) -> TensorDictSequential:
    """Encoder and MPPI as one TorchRL policy."""
    world = LatentEnv(
        model,
        action_spec=system.make_env(1, 0).action_spec_unbatched,
        reward_model=reward_model,
    )
    planner = MPPI(
        world,
        planning_horizon=settings.planning_horizon,
        optim_steps=settings.optim_steps,
        num_candidates=settings.num_candidates,
        top_k=settings.top_k,
        temperature=settings.temperature,
        seed=system.seed,
    )
    return TensorDictSequential(model.encoder, planner)


def evaluate(policy: Any, system: System, settings: Settings) -> TensorDict:
    """Episodes of 200 steps, all at once; the noise does not depend on the controller."""
    env = system.make_env(settings.episodes, seed=100_000 + 1_000 * system.seed)
    torch.manual_seed(system.seed)
    if isinstance(policy, TensorDictSequential | LQGController):
        env = TransformedEnv(env, InitTracker())
        for transform in get_env_transforms_from_module(policy):
            env.append_transform(transform)
    with torch.no_grad():
        return env.rollout(200, policy)


def no_control(tensordict: TensorDict) -> TensorDict:
    """Do nothing."""
    return tensordict.set("action", torch.zeros(*tensordict.batch_size, 2))


def probe(model: LatentModel, system: System) -> tuple[float, float | None]:
    """Test R2 of a linear probe from the predicted latent to the next signal and distractor."""
    torch.manual_seed(system.seed + 1)
    test = system.make_env(20, seed=200_000 + 1_000 * system.seed).rollout(200)
    latents, signals, distractors = [], [], []
    for data in (system.data, test):
        with torch.no_grad():
            out = model(data.select("observation", "action"))
        latents.append(out["next", "latent"].flatten(0, 1))
        signals.append(data["next", "signal"].flatten(0, 1))
        distractors.append(data["next", "distractor"].flatten(0, 1))
    signal = linear_probe(latents[0], signals[0], latents[1], signals[1]).r2_test
    noise = linear_probe(latents[0], distractors[0], latents[1], distractors[1]).r2_test
    return signal, noise if system.noise_scale else None


def run_seed(seed: int, settings: Settings) -> tuple[list[Row], Episodes]:
    """One seed at all noise scales: collect, train, plan."""
    systems = [
        System.collect(seed, scale, settings)
        for scale in tqdm(settings.noise_scales, desc=f"seed {seed}: collect", leave=False)
    ]
    vjepas = train_restarts(
        f"seed {seed}: train {{}} VJEPA",
        make_vjepa,
        vjepa_loss,
        lambda losses: losses["mutual_information"],
        systems,
        settings,
    )
    jepas = train_restarts(
        f"seed {seed}: train {{}} JEPA",
        make_jepa,
        jepa_loss,
        lambda losses: -objective(losses),
        systems,
        settings,
    )
    rows: list[Row] = []
    episodes: Episodes = {}
    progress = tqdm(total=len(systems) * len(CONTROLLERS), leave=False)
    for system, vjepa, jepa in zip(systems, vjepas, jepas, strict=True):
        progress.set_description(f"seed {seed}, noise scale {system.noise_scale:g}: train PixelAR")
        pixel_ar = train_pixel_ar(system, settings)
        models = {"vjepa_mppi": vjepa, "jepa_mppi": jepa, "pixel_ar_mppi": pixel_ar}
        for name, label in CONTROLLERS.items():
            progress.set_description(f"seed {seed}, noise scale {system.noise_scale:g}: {label}")
            signal_r2 = noise_r2 = None
            if name in models:
                model = models[name]
                signal_r2, noise_r2 = probe(model, system)
                policy = make_policy(model, train_reward(model, system), system, settings)
            elif name == "lqg":
                policy = LQGController(system.make_env(1, 0).system, system.noise_scale)
            else:
                policy = no_control if name == "no_control" else None
            episode = evaluate(policy, system, settings)
            cost = -episode["next", "reward"].mean().item()
            lqg_cost = cost if name == "lqg" else rows[-1]["lqg_cost"]
            rows.append(
                {
                    "controller": name,
                    "noise_scale": system.noise_scale,
                    "seed": seed,
                    "cost": cost,
                    "lqg_cost": lqg_cost,
                    "ratio_to_lqg": cost / lqg_cost,
                    "signal_r2": signal_r2,
                    "noise_r2": noise_r2,
                }
            )
            episodes[name, system.noise_scale] = episode
            progress.update()
    progress.close()
    return rows, episodes


def table(rows: Sequence[Row]) -> str:
    """Mean over seeds, and the worst seed."""
    lines = [
        f"{'controller':24s}{'noise':>6s}{'cost/step':>11s}{'x LQG':>9s}{'worst':>9s}"
        f"{'signal R2':>11s}{'worst':>8s}{'noise R2':>10s}"
    ]
    for scale in sorted({row["noise_scale"] for row in rows}):
        for name, label in CONTROLLERS.items():
            here = [r for r in rows if r["controller"] == name and r["noise_scale"] == scale]
            ratios = [r["ratio_to_lqg"] for r in here]
            line = (
                f"{label:24s}{scale:6g}{mean(r['cost'] for r in here):11.3f}"
                f"{mean(ratios):9.3f}{max(ratios):9.3f}"
            )
            if here[0]["signal_r2"] is not None:
                signal = [r["signal_r2"] for r in here]
                noise = [r["noise_r2"] for r in here if r["noise_r2"] is not None]
                line += f"{mean(signal):11.4f}{min(signal):8.4f}"
                line += f"{mean(noise):10.3f}" if noise else f"{'-':>10s}"
            lines.append(line)
        lines.append("")
    return "\n".join(lines).rstrip()


def figure(rows: Sequence[Row], episodes: Episodes, path: Path) -> None:
    """What the camera sees, what the controllers do, and what they pay."""
    scales = sorted({row["noise_scale"] for row in rows})
    scale = scales[-1]
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    fig, (seen, acted, paid) = plt.subplots(1, 3, figsize=(13.5, 3.9), layout="constrained")

    episode = episodes["lqg", scale][0]
    system = LinearGaussianSystem(control_dim=2, seed=rows[0]["seed"])
    controllable = (episode["signal"].double() @ system.C.T)[:, 0]
    seen.plot(episode["observation"][:, 0], color="0.6", lw=1, label="what the camera sees")
    seen.plot(controllable, color="black", lw=1.5, label="the part that can be controlled")
    seen.set(xlabel="time (steps)", ylabel="first pixel", title=f"The noisy TV, noise scale {scale:g}")
    seen.margins(y=0.25)
    seen.legend(loc="upper right", frameon=False)

    for name, label in CONTROLLERS.items():
        style = STYLES[name]
        data = episodes[name, scale]["next"]
        distance = (data["signal"] - data["goal"]).norm(dim=-1)
        acted.plot(distance.median(0).values, label=label, **style)
        here = [r for r in rows if r["controller"] == name]
        costs = [[r["cost"] for r in here if r["noise_scale"] == s] for s in scales]
        paid.plot(scales, [mean(c) for c in costs], label=label, marker="o", ms=4, **style)
        low, high = [min(c) for c in costs], [max(c) for c in costs]
        paid.fill_between(scales, low, high, color=style["color"], alpha=0.15, lw=0)
    acted.set(
        xlabel="time (steps)",
        ylabel="distance of the signal to the goal\n(median over episodes, log scale)",
        yscale="log",
        title=f"Steering at noise scale {scale:g}",
    )
    several = len({row["seed"] for row in rows}) > 1
    paid.set(
        xlabel="noise scale of the distractor",
        ylabel="cost per step (log scale)",
        yscale="log",
        title="What it costs" + (" (band: best to worst seed)" if several else ""),
        xticks=scales,
    )
    handles = paid.get_legend_handles_labels()
    fig.legend(*handles, loc="outside lower center", ncols=len(CONTROLLERS), frameon=False)
    fig.savefig(path, dpi=150)
    plt.close(fig)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print the table, draw the figure, write the JSON."""
    settings, args = read_settings(command_line(Settings, __doc__), Settings, QUICK, arguments)
    for path in (args.out, args.json.parent if args.json else args.out):
        path.mkdir(parents=True, exist_ok=True)
    logger.setLevel("WARNING")  # TorchRL tells of every storage that it makes
    # The tensors are small: more threads would only wait for each other.
    torch.set_num_threads(1)
    start = time.perf_counter()
    rows: list[Row] = []
    shown: Episodes = {}
    for seed in settings.seeds:
        new_rows, episodes = run_seed(seed, settings)
        rows += new_rows
        shown = shown or episodes
    wall = time.perf_counter() - start
    print(table(rows))
    path = args.out / "noisy_tv_mppi.png"
    figure(rows, shown, path)
    print(f"\n{wall:.0f} s; figure: {path}")
    if args.json:
        result = {"settings": asdict(settings), "wall_s": wall, "rows": rows}
        args.json.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
