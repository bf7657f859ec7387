"""Know that the world has changed: surprise as an alarm that a noisy TV does not set off.

A VJEPA learns a small controllable signal under a distractor, from random steps. Its surprise is the
negative log-density of the latent that it then observes. Half-way through test episodes something
changes: the actuator weakens, the dynamics turn, a pixel dies, the sensor gets noisy; or only the
distractor gets louder, up to a volume that was never heard before, which is no concern of the model's. A
CUSUM of the surprise, with a threshold from held-out episodes, says when. The same alarm on the
prediction of pixels is shown for comparison.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

import matplotlib as mpl
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from _settings import command_line, option, prepare, read_settings, write_report
from torchrl_vjepa import (
    VJEPA,
    DiagGaussianHead,
    LinearGaussianSystem,
    Predictor,
    TargetScale,
    VJEPALoss,
    Whitening,
    diag_gaussian,
    linear_encoder,
    surprise,
)

mpl.use("Agg")
from matplotlib import pyplot as plt

CHANGES = {
    "nothing": "nothing changes",
    "switched on": "the TV is switched on",
    "louder": "the TV gets twice as loud",
    "actuator": "the actuator weakens",
    "dynamics": "the dynamics turn",
    "pixel": "a pixel dies",
    "sensor": "the sensor gets noisy",
}
DETECTORS = {"vjepa": "VJEPA, latents", "pixels": "autoregression, pixels"}
STYLES = {
    "vjepa": {"color": "#0072B2", "ls": "-"},
    "pixels": {"color": "#D55E00", "ls": "--"},
}
Row = dict[str, Any]
Density = Callable[[Tensor, Tensor], Tensor]


@dataclass
class Settings:
    """What the run does; every field is a command-line option."""

    seeds: list[int] = option([0, 1, 2, 3, 4], "systems: each seed makes the matrices, data and training")
    noise_scale: float = option(8.0, "scale of the distractor while the model learns")
    quiet_scale: float = option(1.0, "scale of the distractor before the TV is switched on")
    loud_scale: float = option(16.0, "scale of the distractor when the TV gets louder")
    weak_actuator: float = option(0.8, "what is left of the control's effect when the actuator weakens")
    turn: float = option(2.0, "degrees by which the dynamics turn")
    sensor_factor: float = option(10.0, "factor on the sensor noise when it gets noisy")
    episodes: int = option(100, "training episodes of 200 random steps")
    restarts: int = option(4, "VJEPAs trained side by side for each seed; the objective chooses one")
    train_steps: int = option(600, "optimiser steps")
    windows: int = option(32, "windows of 20 steps in a batch")
    lr: float = option(0.1, "peak learning rate (one cycle)")
    calibration: int = option(400, "held-out episodes that set the threshold")
    test: int = option(200, "test episodes for each change")
    false_alarms: float = option(0.01, "fraction of unchanged episodes that may raise an alarm")


QUICK = {"seeds": [0], "episodes": 20, "restarts": 2, "train_steps": 120, "calibration": 100, "test": 40}
LENGTH, CHANGE = 200, 100


def simulate(
    system: LinearGaussianSystem, settings: Settings, num: int, seed: int, change: str = "nothing"
) -> TensorDict:
    """Episodes of random actions, shape (num, 200); after step 100 one thing is different."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(num, LENGTH, system.noise_dim, generator=generator)
    actions = 4 * torch.rand(num, LENGTH, 2, generator=generator) - 2
    after, scales = system, [settings.noise_scale, settings.noise_scale]
    if change == "switched on":
        scales[0] = settings.quiet_scale
    if change == "louder":
        scales[1] = settings.loud_scale
    if change in ("actuator", "dynamics"):
        skew = torch.zeros(4, 4, dtype=torch.float64)
        skew[0, 1], skew[1, 0] = math.radians(settings.turn), -math.radians(settings.turn)
        turned = system.A @ torch.matrix_exp(skew) if change == "dynamics" else system.A
        weak = system.B * (settings.weak_actuator if change == "actuator" else 1.0)
        after = LinearGaussianSystem(
            control_dim=2, seed=system.seed, A=turned, B=weak, C=system.C, D=system.D
        )
    if change == "sensor":
        noise[:, CHANGE:, -system.observation_dim :] *= settings.sensor_factor
    s, d, x = system.start(noise[:, 0], scales[0])
    observations = [x]
    for t in range(1, LENGTH):
        changed = t >= CHANGE
        world = after if changed else system
        s, d, x = world.step(s, d, actions[:, t - 1], noise[:, t], scales[changed])
        observations.append(x)
    observation = torch.stack(observations, 1)
    if change == "pixel":
        observation[:, CHANGE:, 0] = 0.0
    return TensorDict(observation=observation, action=actions, batch_size=[num, LENGTH])


def train(systems: Sequence[LinearGaussianSystem], settings: Settings) -> list[VJEPA]:
    """The robust recipe of the main job: all restarts of all systems as one batch, the best kept."""
    data, models = [], []
    for system in systems:
        data.append(simulate(system, settings, settings.episodes, seed=1000 * system.seed + 1))
        whitening = Whitening(system.observation_dim)
        whitening.update(data[-1]["observation"])
        torch.manual_seed(system.seed)
        for _ in range(settings.restarts):
            models.append(
                VJEPA(
                    linear_encoder(20, 4, whitening=whitening),
                    Predictor(4, action_dim=2, head=DiagGaussianHead("constant"), skips=(1, 4, 16)),
                    target_scale=TargetScale(4, kind="constant", init_std=0.01),
                )
            )
    loss = VJEPALoss(
        models,
        skip_weights=(0.1, 0.3, 0.6),
        stacked_data=True,
        target_kl_coeff=0.0,
        residual_variance="batch",
        marginal_entropy_coeff=1.0,
    )
    updater = SoftUpdate(loss, eps=0.9)
    optimizer = torch.optim.Adam(loss.parameters(), lr=settings.lr, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, settings.lr, total_steps=settings.train_steps, pct_start=0.2
    )
    episodes = torch.stack(data)  # (systems, episodes, steps)
    generator = torch.Generator().manual_seed(0)

    def windows() -> TensorDict:
        row = torch.randint(settings.episodes, (settings.windows, 1), generator=generator)
        start = torch.randint(LENGTH - 20, (settings.windows, 1), generator=generator)
        batch = episodes[:, row, start + torch.arange(20)]
        return batch.repeat_interleave(settings.restarts, dim=0)

    torch.manual_seed(0)
    for _ in tqdm(range(settings.train_steps), f"train {len(models)} VJEPA", leave=False, mininterval=1):
        losses = loss(windows())
        sum(value.sum() for key, value in losses.items() if key.startswith("loss_")).backward()
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
        updater.step()
    loss.eval()
    with torch.no_grad():
        scores = torch.stack([loss(windows())["mutual_information"] for _ in range(20)]).mean(0)
    best = scores.reshape(len(systems), settings.restarts).argmax(1)
    return [loss.get_model(i * settings.restarts + int(restart)) for i, restart in enumerate(best)]


def pixel_surprise(data: TensorDict) -> Density:
    """The best linear prediction of the next observation, with its residual variances."""
    x, u = data["observation"], data["action"]
    inputs = torch.cat([x[:, :-1], u[:, :-1]], -1).flatten(0, 1)
    weight = torch.linalg.lstsq(inputs, x[:, 1:].flatten(0, 1)).solution
    std = (x[:, 1:].flatten(0, 1) - inputs @ weight).std(0)

    def transition(observation: Tensor, action: Tensor) -> Any:
        return diag_gaussian(torch.cat([observation, action], -1) @ weight, std)

    return lambda observations, actions: surprise(transition, observations, actions)


def latent_surprise(model: VJEPA) -> Density:
    """Encode, and ask the predictor how likely that was."""

    def density(observations: Tensor, actions: Tensor) -> Tensor:
        return surprise(model.predictor.dist, model.encoder.module(observations), actions)

    return density


def cusum(surprises: Tensor, usual: Tensor, spread: Tensor) -> Tensor:
    """Page's test: g_t = max(0, g_{t-1} + (s_t - usual) / spread - 1/2), shape (*B, T)."""
    level, levels = torch.zeros_like(surprises[..., 0]), []
    for value in ((surprises - usual) / spread - 0.5).unbind(-1):
        level = (level + value).clamp_min(0)
        levels.append(level)
    return torch.stack(levels, -1)


def run_seed(
    system: LinearGaussianSystem, model: VJEPA, settings: Settings
) -> tuple[list[Row], dict[tuple[str, str], Tensor]]:
    """Calibrate both detectors on held-out episodes, and let everything change once."""
    base = 1000 * system.seed
    training = simulate(system, settings, settings.episodes, seed=base + 1)
    held_out = simulate(system, settings, settings.calibration, seed=base + 2)
    detectors = {"vjepa": latent_surprise(model), "pixels": pixel_surprise(training)}
    rows: list[Row] = []
    curves: dict[tuple[str, str], Tensor] = {}
    for name, density in detectors.items():
        with torch.no_grad():
            usual = density(held_out["observation"], held_out["action"])
        moments = usual.mean(), usual.std()
        peaks = cusum(usual, *moments).amax(-1)
        threshold = peaks.quantile(1 - settings.false_alarms)
        for index, change in enumerate(CHANGES):
            data = simulate(system, settings, settings.test, base + 10 + index, change)
            with torch.no_grad():
                value = density(data["observation"], data["action"])
            level = cusum(value, *moments) / threshold  # entry t is known at step t + 1
            fired = level > 1
            before, after = fired[:, : CHANGE - 1].any(-1), fired[:, CHANGE - 1 :]
            clean = ~before
            found = after.any(-1) & clean
            delays = after.float().argmax(-1)[found].float()
            rows.append(
                {
                    "detector": name,
                    "change": change,
                    "seed": system.seed,
                    "alarms_before": before.float().mean().item(),
                    "alarms_after": (found.sum() / clean.sum()).item(),
                    "median_delay": delays.median().item() if len(delays) else None,
                    "surprise_before": value[:, : CHANGE - 1].mean().item(),
                    "surprise_after": value[:, CHANGE - 1 :].mean().item(),
                }
            )
            curves[name, change] = level
    return rows, curves


def table(rows: Sequence[Row]) -> str:
    """Mean over seeds, and the worst seed."""
    lines = [
        f"{'detector':24s}{'after step 100':28s}{'false alarms':>13s}{'alarms after':>14s}"
        f"{'(seeds)':>14s}{'delay (steps)':>15s}"
    ]
    for name, label in DETECTORS.items():
        for change, what in CHANGES.items():
            here = [r for r in rows if r["detector"] == name and r["change"] == change]
            after = [r["alarms_after"] for r in here]
            delays = [r["median_delay"] for r in here if r["median_delay"] is not None]
            delay = f"{mean(delays):.1f}" if delays else "-"
            lines.append(
                f"{label:24s}{what:28s}{mean(r['alarms_before'] for r in here):13.3f}{mean(after):14.3f}"
                f"{f'{min(after):.2f}-{max(after):.2f}':>14s}{delay:>15s}"
            )
        lines.append("")
    return "\n".join(lines).rstrip()


def figure(rows: Sequence[Row], curves: dict[tuple[str, str], Tensor], path: Path) -> None:
    """The alarm level around the change, one panel for each change."""
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    fig, panels = plt.subplots(2, 4, figsize=(13, 5.2), sharex=True, sharey=True, layout="constrained")
    steps = torch.arange(1, LENGTH)
    for panel in panels.flat[len(CHANGES) :]:
        panel.set_axis_off()
    for panel, (change, what) in zip(panels.flat, CHANGES.items(), strict=False):
        panel.axhline(1, color="0.3", lw=1, ls=":", label="threshold")
        panel.axvline(CHANGE, color="0.7", lw=1)
        for name, label in DETECTORS.items():
            low, middle, high = curves[name, change].quantile(torch.tensor([0.05, 0.5, 0.95]), dim=0)
            style = STYLES[name]
            panel.plot(steps, middle, label=label, **style)
            panel.fill_between(steps, low, high, color=style["color"], alpha=0.2, lw=0)
        panel.set_title(what)
        panel.set_yscale("symlog", linthresh=1)
        panel.set_ylim(0, 1e4)
        panel.margins(x=0)
    for panel in (*panels[1, :-1], panels[0, -1]):
        panel.set_xlabel("time (steps)")
    panels[0, -1].tick_params(labelbottom=True)
    for panel in panels[:, 0]:
        panel.set_ylabel("CUSUM of the surprise\n(in thresholds)")
    handles = panels[0, 0].get_legend_handles_labels()
    fig.legend(*handles, loc="outside lower center", ncols=3, frameon=False)
    fig.suptitle(f"What changes at step {CHANGE} (median and 90 % of the episodes, seed {rows[0]['seed']})")
    fig.savefig(path, dpi=150)
    plt.close(fig)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print the table, draw the figure, write the JSON."""
    settings, args = read_settings(command_line(Settings, __doc__), Settings, QUICK, arguments)
    prepare(args)
    start = time.perf_counter()
    systems = [LinearGaussianSystem(control_dim=2, seed=seed) for seed in settings.seeds]
    models = train(systems, settings)
    rows: list[Row] = []
    shown: dict[tuple[str, str], Tensor] = {}
    for system, model in zip(systems, tqdm(models, desc="test", leave=False), strict=True):
        new_rows, curves = run_seed(system, model, settings)
        rows += new_rows
        shown = shown or curves
    wall = time.perf_counter() - start
    print(table(rows))
    path = args.out / "surprise.png"
    figure(rows, shown, path)
    print(f"\n{wall:.0f} s; figure: {path}")
    write_report(args, settings, wall_s=wall, rows=rows)


if __name__ == "__main__":
    main()
