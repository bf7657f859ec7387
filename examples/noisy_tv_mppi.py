"""Steer the noisy TV: train VJEPA from a replay buffer, plan with MPPI in its latent space.

A camera sees a small signal that can be controlled, buried under a distractor of up to 64 times its
variance. Three world models of the same size learn from the same 20,000 random steps: VJEPA and JEPA
predict representations, PixelAR predicts pixels. Each plans with the same MPPI. The table says what
they pay, next to the LQG controller that knows the true system.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

import matplotlib as mpl
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.modules import get_env_transforms_from_module
from tqdm import tqdm

from _noisy_tv import (
    Recipe,
    System,
    jepa_loss,
    make_jepa,
    make_vjepa,
    objective,
    train_restarts,
    train_reward,
    vjepa_loss,
)
from _settings import command_line, option, prepare, read_settings, write_report
from torchrl_vjepa import (
    MPPI,
    LatentEnv,
    LatentModel,
    LinearGaussianSystem,
    LQGController,
    PixelAR,
    PixelARLoss,
    PixelDecoder,
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
class Settings(Recipe):
    """What the run does; every field is a command-line option."""

    noise_scales: list[float] = option([0.0, 4.0, 8.0], "scales of the distractor")
    pixel_lr: float = option(0.03, "peak learning rate of PixelAR (one cycle)")
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
        models = {"vjepa_mppi": vjepa.model, "jepa_mppi": jepa.model, "pixel_ar_mppi": pixel_ar}
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
    prepare(args)
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
    write_report(args, settings, wall_s=wall, rows=rows)


if __name__ == "__main__":
    main()
