"""Is the uncertainty of a VJEPA right? Beliefs about the noisy TV against the exact predictive distribution.

A VJEPA is trained by the robust recipe of noisy_tv_table.py. On its frozen latents a Gaussian belief is
fitted for each horizon: direct prediction, one skip for each horizon, and one temperature for each skip on
trajectories that training did not see. On fresh ones the script measures how often 90 % intervals hold the
latent that came true, and the CRPS of the signal (through a linear probe) beside that of the Kalman filter,
which knows the system.

Why direct prediction: the latent is a linear function of the observation, z = M s + n, and carries the
sensor noise n. So the latents of a Markov signal are not Markov (VARMA(1, 1), not VAR(1)). The error of a
one-step prediction holds n twice, once from its start and once from its end, and iterating it counts both
anew at every step: intervals come out too wide (route "iterated"). The error of a direct prediction over h
steps holds n twice for every h, and its spread is fitted as it is.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

import matplotlib as mpl
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from _settings import command_line, option, prepare, read_settings, write_report
from torchrl_vjepa import (
    VJEPA,
    DiagGaussianHead,
    FullGaussianHead,
    KalmanFilter,
    LinearGaussianSystem,
    LinearProbe,
    Predictor,
    TargetScale,
    VJEPALoss,
    Whitening,
    coverage,
    credible_interval,
    crps,
    diag_gaussian,
    full_gaussian,
    linear_encoder,
    linear_probe,
    pit_histogram,
    probability_integral_transform,
    recalibrate,
    reliability_curve,
)

mpl.use("Agg")
from matplotlib import pyplot as plt

ROUTES = ["direct, recalibrated", "direct", "iterated"]
COLORS = {"direct, recalibrated": "#0072B2", "direct": "#56B4E9", "iterated": "#D55E00"}
STYLES = {"direct, recalibrated": "-", "direct": "--", "iterated": ":"}
HORIZON_COLORS = ["#000000", "#0072B2", "#E69F00"]
LEVEL = 0.9
# The filter's covariance has converged and every horizon is compared on the same starts.
BURN_IN = 10
Row = dict[str, Any]


@dataclass
class Settings:
    """What the run does; every field is a command-line option."""

    seeds: list[int] = option([0], "each makes the matrices, the trajectories and the starts")
    noise_scales: list[float] = option([0.0, 4.0, 8.0], "scales of the distractor")
    horizon: int = option(16, "largest number of steps ahead")
    sizes: list[int] = option(
        [4, 4, 20], "of the system", nargs=3, metavar=("SIGNAL", "DISTRACTOR", "OBSERVATION")
    )
    length: int = option(500, "steps of a trajectory")
    train_trajectories: int = option(24, "trajectories that encoder and beliefs learn from")
    held_out_trajectories: int = option(16, "trajectories for the temperatures")
    test_trajectories: int = option(100, "trajectories to measure on")
    steps: int = option(800, "optimiser steps")
    restarts: int = option(6, "starts trained side by side; the objective chooses one")
    skips: list[int] = option([1, 4, 16], "prediction steps that the encoder learns from")
    skip_weights: list[float] = option([0.1, 0.3, 0.6], "their weights")
    window: int = option(20, "steps in a training window, more than the largest skip")
    windows: int = option(24, "windows in a batch")
    lr: float = option(0.2, "peak learning rate")
    workers: int = option(2, "processes; each works with one thread")


QUICK = {
    "noise_scales": [0.0, 8.0],
    "horizon": 4,
    "length": 100,
    "test_trajectories": 20,
    "steps": 100,
    "restarts": 2,
    "workers": 1,
}


class Data(NamedTuple):
    """Trajectories of one system at one noise scale, with whitened observations."""

    system: LinearGaussianSystem
    noise_scale: float
    train: TensorDict
    held_out: TensorDict
    test: TensorDict

    @classmethod
    def simulate(cls, seed: int, noise_scale: float, settings: Settings) -> Data:
        """Every noise scale of a seed has the same signal, distractor and sensor noise."""
        system = LinearGaussianSystem(*settings.sizes, seed=seed)
        generator = torch.Generator().manual_seed(seed)
        sizes = [settings.train_trajectories, settings.held_out_trajectories, settings.test_trajectories]
        everything = system.simulate(
            settings.length, noise_scale, batch_size=(sum(sizes),), generator=generator
        )
        whitening = Whitening(system.observation_dim)
        whitening.update(everything["observation"][: sizes[0]])
        everything["raw"] = everything["observation"]
        everything["observation"] = whitening(everything["raw"])
        return cls(system, noise_scale, *everything.split(sizes))


# Training: the robust recipe, all noise scales and starts of a seed as one batch


def make_model(settings: Settings) -> VJEPA:
    """A fresh start, far from the identity: that is a local minimum."""
    latent_dim, _, observation_dim = settings.sizes
    encoder = linear_encoder(observation_dim, latent_dim)
    predictor = Predictor(latent_dim, head=DiagGaussianHead("constant"), skips=settings.skips)
    nn.init.normal_(encoder.module.network.weight, std=observation_dim**-0.5)
    for trunk in predictor.trunks:
        nn.init.normal_(trunk.weight, std=0.1)
    return VJEPA(encoder, predictor, target_scale=TargetScale(latent_dim, kind="constant", init_std=0.01))


def objective(losses: TensorDict) -> Tensor:
    """What is minimised: the sum of the ``loss_*`` entries, one number for each model."""
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def train(runs: Sequence[Data], seed: int, settings: Settings) -> list[VJEPA]:
    """One model for each noise scale: of several starts the one with the highest information bound."""
    models = []
    for run in runs:
        for restart in range(settings.restarts):
            torch.manual_seed(100_000 * seed + 100 * round(100 * run.noise_scale) + restart)
            models.append(make_model(settings))
    loss = VJEPALoss(
        models,
        stacked_data=True,
        skip_weights=settings.skip_weights,
        marginal_entropy_coeff=1.0,
        target_kl_coeff=0.0,
        residual_variance="batch",
        collapse_rank=0.0,
    )
    updater = SoftUpdate(loss, eps=0.9)
    optimizer = torch.optim.Adam(loss.parameters(), lr=settings.lr, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, settings.lr, total_steps=settings.steps, pct_start=0.2, cycle_momentum=False
    )
    observations = torch.stack([run.train["observation"] for run in runs])

    # Every window of every trajectory: (scale, window, step, feature).
    observations = observations.unfold(2, settings.window, 1).mT.flatten(1, 2)

    def batch(index: Tensor) -> TensorDict:
        windows = observations[:, index]
        windows = windows.repeat_interleave(settings.restarts, dim=0)
        return TensorDict(observation=windows, batch_size=windows.shape[:-1])

    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    for _ in range(settings.steps):
        index = torch.randint(observations.shape[1], (settings.windows,), generator=generator)
        objective(loss(batch(index))).sum().backward()
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
        updater.step()
    with torch.no_grad():
        every = torch.arange(0, observations.shape[1], settings.window)
        score = loss(batch(every))["mutual_information"]
    best = score.reshape(len(runs), settings.restarts).argmax(1).tolist()
    return [loss.get_model(i * settings.restarts + restart) for i, restart in enumerate(best)]


# Beliefs on the frozen latents


def fit_belief(model: VJEPA, data: TensorDict, horizon: int) -> VJEPA:
    """The same encoder with one skip for each horizon, at the highest likelihood of the training latents.

    The means are least squares. Given them the likelihood of a constant covariance depends on the errors
    through their second moments alone, so a few points with these moments stand for all of them.
    """
    latent = model.encoder(data.select("observation"))["latent"].detach().double()
    dim = latent.shape[-1]
    # With a bias, because whitening moves the origin.
    belief = Predictor(dim, head=FullGaussianHead("constant"), skips=range(1, horizon + 1), bias=True)
    belief = belief.double()
    points = []
    with torch.no_grad():
        for skip, trunk in zip(belief.skips, belief.trunks, strict=True):
            context, target = latent[:, :-skip].flatten(0, 1), latent[:, skip:].flatten(0, 1)
            solution = torch.linalg.lstsq(context - context.mean(0), target - target.mean(0)).solution
            trunk.weight.copy_(solution.mT)
            trunk.bias.copy_(target.mean(0) - context.mean(0) @ solution)
            error = target - trunk(context)
            root = torch.linalg.cholesky(error.mT @ error / len(error)).mT * dim**0.5
            points.append(torch.cat([root, -root]))
    constants = belief.constants
    # From the right marginal variances, so that few iterations are left for the correlations.
    with torch.no_grad():
        constants[:, :dim] = torch.stack(points).square().mean(1).log()
    optimizer = torch.optim.LBFGS([constants], max_iter=200, line_search_fn="strong_wolfe")

    def negative_log_likelihood() -> Tensor:
        optimizer.zero_grad()
        nll = -sum(
            belief.head(torch.zeros_like(errors), row).log_prob(errors).mean()
            for row, errors in zip(constants, points, strict=True)
        )
        nll.backward()
        return nll

    optimizer.step(negative_log_likelihood)
    return VJEPA(model.encoder.double(), belief.requires_grad_(False), target_scale=nn.Identity())


@torch.no_grad()
def direct(belief: VJEPA, latent: Tensor) -> tuple[Tensor, Tensor]:
    """Means ``(*B, H, D)`` and covariances ``(H, D, D)`` of one prediction for each horizon."""
    beliefs = [belief.predictor.dist(latent, skip=skip) for skip in belief.predictor.skips]
    means = torch.stack([p.mean for p in beliefs], dim=-2)
    # They do not depend on the latent.
    return means, torch.stack([p.covariance_matrix.flatten(0, -3)[0] for p in beliefs])


@torch.no_grad()
def iterated(belief: VJEPA, latent: Tensor) -> tuple[Tensor, Tensor]:
    """The same by the one-step belief, iterated: ``m' = A m + b``, ``P' = A P A^T + S``."""
    one_step = belief.predictor.trunks[0]
    matrix = one_step.weight
    noise = belief.predictor.dist(latent, skip=1).covariance_matrix.flatten(0, -3)[0]
    mean, covariance = latent, torch.zeros_like(noise)
    means, covariances = [], []
    for _ in belief.predictor.skips:
        mean, covariance = one_step(mean), matrix @ covariance @ matrix.mT + noise
        means.append(mean)
        covariances.append(covariance)
    return torch.stack(means, dim=-2), torch.stack(covariances)


def kalman(data: Data, horizon: int) -> Distribution:
    """The exact predictive distribution of the signal's components, batch ``(N, T, H)``."""
    system = data.system
    filtered = KalmanFilter(system, data.noise_scale).filter(data.test["raw"].double())
    mean, covariance = filtered["signal_mean"], filtered["signal_cov"]
    noise = system.signal_std**2 * torch.eye(system.signal_dim).double()
    means, stds = [], []
    for _ in range(horizon):
        mean, covariance = mean @ system.A.mT, system.A @ covariance @ system.A.mT + noise
        means.append(mean)
        stds.append(covariance.diagonal(dim1=-2, dim2=-1).sqrt())
    return diag_gaussian(torch.stack(means, dim=-2), torch.stack(stds, dim=-2))


def through(probe: LinearProbe, means: Tensor, covariances: Tensor) -> Distribution:
    """The belief about the latent as one about the signal's components."""
    variances = (probe.weight @ covariances @ probe.weight.mT).diagonal(dim1=-2, dim2=-1)
    return diag_gaussian(probe.predict(means), variances.sqrt())


def ahead(series: Tensor, horizon: int) -> Tensor:
    """What came true ``1, ..., H`` steps later: ``(N, T, D)`` to ``(N, T - H - BURN_IN, H, D)``."""
    return series[:, BURN_IN + 1 :].unfold(1, horizon, 1).mT


class Shown(NamedTuple):
    """What the figures show of one run."""

    levels: Tensor
    reliability: dict[int, Tensor]
    pit: dict[int, Tensor]
    truth: Tensor
    fan: dict[str, tuple[Tensor, Tensor]]


def measure(model: VJEPA, data: Data, seed: int, settings: Settings) -> tuple[list[Row], list[Row], Shown]:
    """Rows of the main route with the oracle, rows of all routes, and what is drawn."""
    horizon = settings.horizon
    belief = fit_belief(model, data.train, horizon)

    def encode(part: TensorDict) -> Tensor:
        return belief.encoder(part.select("observation").double())["latent"].detach()

    latents = [encode(part) for part in (data.train, data.test)]
    probe = linear_probe(latents[0], data.train["signal"].double(), latents[1], data.test["signal"].double())
    starts = latents[1][:, BURN_IN:-horizon]
    target, signal = ahead(latents[1], horizon), ahead(data.test["signal"].double(), horizon)
    predictions = {"iterated": iterated(belief, starts), "direct": direct(belief, starts)}
    recalibrate(belief, data.held_out.select("observation").double())
    predictions["direct, recalibrated"] = direct(belief, starts)

    exact = kalman(data, horizon)
    oracle = diag_gaussian(exact.mean[:, BURN_IN:-horizon], exact.stddev[:, BURN_IN:-horizon])
    oracle_crps = crps(oracle, signal).mean((0, 1, 3)).tolist()
    cell = {"noise_scale": data.noise_scale, "seed": seed}
    rows, routes = [], []
    for route in ROUTES:
        means, covariances = predictions[route]
        roots = torch.linalg.cholesky(covariances)
        scores = crps(through(probe, means, covariances), signal).mean((0, 1, 3)).tolist()
        for h in range(horizon):
            p = full_gaussian(means[..., h, :], roots[h])
            row = {
                **cell,
                "horizon": h + 1,
                "coverage_90": coverage(p, target[..., h, :], LEVEL).item(),
                "crps": scores[h],
            }
            routes.append({"route": route, **row, "crps_ratio": scores[h] / oracle_crps[h]})
            if route == ROUTES[0]:
                rows.append({**row, "oracle_crps": oracle_crps[h]})
    return rows, routes, show(predictions[ROUTES[0]], target, signal, probe, oracle)


def show(
    prediction: tuple[Tensor, Tensor],
    target: Tensor,
    signal: Tensor,
    probe: LinearProbe,
    oracle: Distribution,
) -> Shown:
    """Reliability and transforms of a few horizons, and the fan from one start."""
    means, covariances = prediction
    horizon = means.shape[-2]
    reliability, pit, levels = {}, {}, torch.empty(0)
    for h in sorted({1, min(4, horizon), horizon}):
        p = full_gaussian(means[..., h - 1, :], torch.linalg.cholesky(covariances[h - 1]))
        levels, reliability[h] = reliability_curve(p, target[..., h - 1, :])
        pit[h] = pit_histogram(probability_integral_transform(p, target[..., h - 1, :]), 20).density
    # The first component of the signal of the first test trajectory, from its first start.
    seen = through(probe, means[:1, :1], covariances)
    first = diag_gaussian(oracle.mean[:1, :1], oracle.stddev[:1, :1])
    fan = {
        f"{name} {level:.0%}": tuple(end[0, 0, :, 0] for end in credible_interval(p, level))
        for name, p in (("VJEPA", seen), ("Kalman", first))
        for level in (0.5, LEVEL)
    }
    return Shown(levels, reliability, pit, signal[0, 0, :, 0], fan)


def run_seed(seed: int, settings: Settings) -> tuple[list[Row], list[Row], dict[float, Shown]]:
    """All noise scales of one seed."""
    torch.set_num_threads(1)
    runs = [Data.simulate(seed, scale, settings) for scale in settings.noise_scales]
    rows, routes, shown = [], [], {}
    for run, model in zip(runs, train(runs, seed, settings), strict=True):
        measured = measure(model, run, seed, settings)
        rows += measured[0]
        routes += measured[1]
        shown[run.noise_scale] = measured[2]
    return rows, routes, shown


# Results


def extremes(routes: Sequence[Row], **cell: Any) -> tuple[float, float, float, float]:
    """Lowest, mean and highest coverage, highest ratio to the oracle's CRPS, over what matches."""
    here = [row for row in routes if all(row[key] == value for key, value in cell.items())]
    covered = [row["coverage_90"] for row in here]
    return min(covered), mean(covered), max(covered), max(row["crps_ratio"] for row in here)


def table(routes: Sequence[Row], settings: Settings) -> str:
    """Coverage over seeds and CRPS against the oracle's, for some horizons and for all."""
    shown = sorted({h for h in (1, 2, 4, 8, 16) if h <= settings.horizon} | {settings.horizon})
    lines = [
        f"{'':29s}{'coverage of 90 % intervals':^27s}{'CRPS / oracle':>15s}",
        f"{'scale':>5s} {'horizon':>7s} {'lowest':>21s}{'mean':>9s}{'highest':>10s}{'highest':>15s}",
    ]
    for scale in settings.noise_scales:
        for h in shown:
            low, middle, high, ratio = extremes(routes, route=ROUTES[0], noise_scale=scale, horizon=h)
            lines.append(f"{scale:5g} {h:7d} {low:21.2%}{middle:9.2%}{high:10.2%}{ratio:15.4f}")
    lines.append("")
    for route in ROUTES:
        low, middle, high, ratio = extremes(routes, route=route)
        lines.append(f"{'all: ' + route:29s}{low:6.2%}{middle:9.2%}{high:10.2%}{ratio:15.4f}")
    return "\n".join(lines)


def figure_horizons(routes: Sequence[Row], settings: Settings, path: Path) -> None:
    """Coverage and CRPS ratio against the horizon."""
    scales = settings.noise_scales
    fig, axes = plt.subplots(
        2, len(scales), figsize=(3.4 * len(scales) + 1, 6), squeeze=False, sharex=True, sharey="row",
        layout="constrained",
    )  # fmt: skip
    horizons = list(range(1, settings.horizon + 1))
    for scale, (above, below) in zip(scales, axes.T, strict=True):
        above.axhspan(88, 92, color="0.9", lw=0, label="88 to 92 %; within 5 %")
        above.axhline(90, color="0.5", lw=0.8)
        below.axhspan(1, 1.05, color="0.9", lw=0)
        below.axhline(1, color="0.5", lw=0.8)
        for route in ROUTES:
            here = [row for row in routes if row["route"] == route and row["noise_scale"] == scale]
            style = {"color": COLORS[route], "linestyle": STYLES[route]}
            for ax, key, unit in ((above, "coverage_90", 100), (below, "crps_ratio", 1)):
                values = [[unit * row[key] for row in here if row["horizon"] == h] for h in horizons]
                ax.plot(horizons, [mean(v) for v in values], **style, label=route)
                low, high = [min(v) for v in values], [max(v) for v in values]
                ax.fill_between(horizons, low, high, color=COLORS[route], alpha=0.15, lw=0)
        above.set(title=f"noise scale {scale:g}")
        below.set(xlabel="horizon (steps)", xticks=[h for h in horizons if h == 1 or h % 4 == 0])
    axes[0, 0].set_ylabel("coverage of 90 % intervals (%)")
    axes[1, 0].set_ylabel("CRPS of the signal / Kalman filter's")
    several = len(settings.seeds) > 1
    fig.suptitle(
        "Latents in their intervals, and the cost of uncertainty" + several * ": mean and range of seeds"
    )
    handles = axes[0, 0].get_legend_handles_labels()
    fig.legend(*handles, loc="outside lower center", ncols=4, frameon=False)
    fig.savefig(path, dpi=150)
    plt.close(fig)


def figure_calibration(shown: Shown, scale: float, seed: int, path: Path) -> None:
    """Reliability curve and transform histogram of one run."""
    fig, (left, right) = plt.subplots(1, 2, figsize=(8.4, 3.9), layout="constrained")
    left.plot([0, 100], [0, 100], color="0.6", lw=0.8, label="calibrated")
    right.axhline(1, color="0.6", lw=0.8, label="calibrated")
    for (h, covered), color, marker in zip(shown.reliability.items(), HORIZON_COLORS, "os^", strict=False):
        label = f"{h} step{'s' * (h > 1)} ahead"
        left.plot(100 * shown.levels, 100 * covered, marker, color=color, ms=3.5, label=label, mfc="none")
        density = shown.pit[h]
        edges = torch.linspace(0, 1, len(density) + 1)
        right.stairs(density, edges, baseline=None, color=color, label=label)
    left.set(xlabel="level of the interval (%)", ylabel="latents inside (%)", aspect="equal")
    right.set(
        xlabel="probability integral transform", ylabel="density", xlim=(0, 1), ylim=(0, 1.6),
        xticks=[0, 0.5, 1],
    )  # fmt: skip
    left.legend(frameon=False)
    right.legend(frameon=False, loc="lower center", ncols=2)
    fig.suptitle(f"Reliability and transforms of held-out latents (noise scale {scale:g}, seed {seed})")
    fig.savefig(path, dpi=150)
    plt.close(fig)


def figure_fan(shown: dict[float, Shown], seed: int, path: Path) -> None:
    """What is expected of the first component of the signal, and what came true."""
    fig, axes = plt.subplots(
        1, len(shown), figsize=(3.4 * len(shown) + 1, 3.6), squeeze=False, sharey=True, layout="constrained"
    )
    for ax, (scale, one) in zip(axes[0], shown.items(), strict=True):
        steps = torch.arange(1, len(one.truth) + 1)
        for name, alpha in (("VJEPA 90%", 0.2), ("VJEPA 50%", 0.35)):
            ax.fill_between(steps, *one.fan[name], color="#0072B2", alpha=alpha, lw=0, label=name)
        for i, end in enumerate(one.fan["Kalman 90%"]):
            ax.plot(steps, end, "--", color="#D55E00", lw=1.2, label=None if i else "Kalman 90%")
        ax.plot(steps, one.truth, color="black", marker="o", ms=3, lw=1, label="came true")
        ax.set(title=f"noise scale {scale:g}", xlabel="horizon (steps)")
    axes[0, 0].set_ylabel("first component of the signal")
    fig.suptitle(f"What is expected from one moment on (seed {seed})")
    handles = axes[0, 0].get_legend_handles_labels()
    fig.legend(*handles, loc="outside lower center", ncols=4, frameon=False)
    fig.savefig(path, dpi=150)
    plt.close(fig)


def draw(routes: Sequence[Row], shown: dict[float, Shown], settings: Settings, out: Path) -> list[Path]:
    """All figures."""
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    paths = [out / f"uncertainty_{name}.png" for name in ("horizons", "calibration", "fan")]
    scale, seed = settings.noise_scales[-1], settings.seeds[0]
    figure_horizons(routes, settings, paths[0])
    figure_calibration(shown[scale], scale, seed, paths[1])
    figure_fan(shown, seed, paths[2])
    return paths


# Command line


def parse(arguments: Sequence[str] | None = None) -> tuple[Settings, argparse.Namespace]:
    """The settings, and where the results go."""
    parser = command_line(Settings, __doc__)
    settings, args = read_settings(parser, Settings, QUICK, arguments)
    if settings.horizon < 1 or settings.length <= settings.horizon + BURN_IN:
        parser.error(f"--length must be more than --horizon + {BURN_IN}, and --horizon at least 1")
    if settings.window <= max(settings.skips) or settings.length < settings.window:
        parser.error("--window must be more than the largest of --skips, and at most --length")
    return settings, args


def execute(settings: Settings) -> Iterator[tuple[list[Row], list[Row], dict[float, Shown]]]:
    """Results of the seeds in their order."""
    if settings.workers <= 1 or len(settings.seeds) == 1:
        yield from (run_seed(seed, settings) for seed in settings.seeds)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(settings.workers, mp_context=context) as pool:
        yield from pool.map(run_seed, settings.seeds, [settings] * len(settings.seeds))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print the table, draw the figures, write the JSON."""
    settings, args = parse(arguments)
    prepare(args)
    start = time.perf_counter()
    results = list(tqdm(execute(settings), total=len(settings.seeds), desc="seeds", leave=False))
    wall = time.perf_counter() - start
    rows, routes = (sum((result[i] for result in results), []) for i in (0, 1))
    print(table(routes, settings))
    print("\nfigures:", *draw(routes, results[0][2], settings, args.out))
    print(f"{len(settings.seeds)} seed(s) in {wall:.0f} s")
    write_report(args, settings, wall_s=wall, rows=rows, routes=routes)


if __name__ == "__main__":
    main()
