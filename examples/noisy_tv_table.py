"""The paper's noisy-TV table: what five models keep of a small signal under a large distractor.

Preset "paper" trains VAE, AR, JEPA, VJEPA and BJEPA as the paper describes them; preset "robust" trains
the joint-embedding models with what the library offers against local minima. No labels enter training
or the choice of a restart. A linear probe (fitted on the training trajectory, scored on another one)
tells how much of the signal and of the distractor a representation holds. The oracle rows know the
system (Kalman filter), the labels (least squares), or neither (CCA of successive observations).
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import matplotlib as mpl
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from _settings import command_line, option, prepare, read_settings, write_report
from torchrl_vjepa import (
    BJEPA,
    JEPA,
    VAE,
    VJEPA,
    BJEPALoss,
    DeltaHead,
    DiagGaussianHead,
    JEPALoss,
    KalmanFilter,
    LinearGaussianSystem,
    PixelAR,
    PixelARLoss,
    PixelDecoder,
    Predictor,
    TargetScale,
    VAELoss,
    VJEPALoss,
    Whitening,
    WindowLoss,
    linear_encoder,
    linear_probe,
    mlp_encoder,
)

mpl.use("Agg")
from matplotlib import pyplot as plt

MODELS = ["VAE", "AR", "JEPA", "VJEPA", "BJEPA"]
LATENT_MODELS = ["JEPA", "VJEPA", "BJEPA"]
ORACLES = ["Kalman filter", "least squares", "CCA"]
COLORS = {
    "VAE": "#D55E00",
    "AR": "#E69F00",
    "JEPA": "#56B4E9",
    "VJEPA": "#0072B2",
    "BJEPA": "#CC79A7",
    "Kalman filter": "black",
}
# Nested where the curves of the models coincide.
MARKERS: dict[str, dict[str, Any]] = {
    "VAE": {"marker": "^", "ms": 5},
    "AR": {"marker": "v", "ms": 5},
    "JEPA": {"marker": "o", "ms": 10, "mfc": "none"},
    "VJEPA": {"marker": "s", "ms": 6, "mfc": "none"},
    "BJEPA": {"marker": "D", "ms": 2.5},
    "Kalman filter": {},
}
# The paper's table (seed 111): test R2 of signal and noise at the scales 0, 1, ..., 8.
PAPER_SIGNAL = {
    "VAE": [1.000, 0.973, 0.853, 0.770, 0.730, 0.681, 0.627, 0.566, 0.499],
    "AR": [0.999, 0.980, 0.889, 0.801, 0.756, 0.717, 0.677, 0.631, 0.578],
    "JEPA": [0.930, 0.930, 0.930, 0.841, 0.999, 0.930, 0.999, 0.929, 0.930],
    "VJEPA": [0.999, 0.998, 0.995, 0.930, 0.993, 0.928, 0.930, 0.918, 0.870],
    "BJEPA": [0.981, 0.976, 0.967, 0.919, 0.899, 0.841, 0.914, 0.851, 0.841],
}
PAPER_NOISE = {
    "VAE": [None, 0.002, 0.194, 0.393, 0.458, 0.492, 0.531, 0.574, 0.620],
    "AR": [None, -0.007, 0.094, 0.256, 0.338, 0.364, 0.386, 0.416, 0.449],
    "JEPA": [None, 0.178, 0.172, -0.003, -0.010, 0.183, -0.011, 0.191, 0.183],
    "VJEPA": [None, -0.012, -0.012, 0.176, -0.007, 0.190, 0.202, 0.182, 0.251],
    "BJEPA": [None, -0.003, -0.023, 0.078, 0.156, 0.240, 0.171, 0.237, 0.238],
}
# The paper's "Optimization settings"; VICReg averages the squared error over the dimensions.
EMA_DECAY, BETA, GAMMA = 0.99, 0.01, 0.1
INVARIANCE, VARIANCE, COVARIANCE = 25.0, 25.0, 1.0
SHOWN_STEPS = 60
Row = dict[str, Any]
Task = tuple[str, str, tuple[int, ...]]  # preset, model, seeds that train as one batch
# By the time that they take, so that the processes end together.
SLOWEST_FIRST = ["BJEPA", "VJEPA", "VAE", "JEPA", "AR"]


@dataclass
class Settings:
    """What the run does; every field is a command-line option."""

    preset: list[str] = option(["paper", "robust"], "how the models are trained", choices=["paper", "robust"])
    seeds: list[int] = option([111], "each makes the matrices, the trajectories and the starts")
    noise_scales: list[float] = option([float(s) for s in range(9)], "scales of the distractor")
    models: list[str] = option(
        MODELS, "VAE and AR have the preset paper only", choices=MODELS, metavar="MODEL"
    )
    encoder: str = option("linear", "linear as in the paper, or mlp", choices=["linear", "mlp"])
    sizes: list[int] = option(
        [4, 4, 20], "of the system", nargs=3, metavar=("SIGNAL", "DISTRACTOR", "OBSERVATION")
    )
    train_length: int = option(6000, "steps of the training trajectory")
    test_length: int = option(2000, "steps of the test trajectory")
    steps: int = option(0, "optimiser steps; 0 is 6000 (paper) or 100 (robust: of the last round)")
    r2: str = option(
        "uniform",
        "average over components: uniform (the paper's numbers) or weighted by variance (its formula)",
        choices=["uniform", "weighted"],
    )
    restarts: int = option(8, "robust: starts of each run; the objective chooses among them")
    finalists: int = option(2, "robust: starts that the objective lets into the last round")
    heat_steps: int = option(75, "robust: optimiser steps of the first round, which all starts train")
    skips: list[int] = option([1, 8, 16], "robust: prediction steps that are learned together")
    skip_weights: list[float] = option([0.04, 0.48, 0.48], "robust: their weights")
    normalisation: str = option(
        "whitening",
        "robust: whitening, or standard scores of each component as in the paper",
        choices=["whitening", "standard"],
    )
    entropy: str = option(
        "moments",
        "robust: the entropy term of the bound: of the moments, of random projections (SIGReg), or none",
        choices=["moments", "sliced", "none"],
    )
    entropy_coeff: float = option(0.0, "robust: its weight; 0 is 1 (moments) or 10 (sliced)")
    residual_variance: str = option(
        "batch",
        "robust, VJEPA and BJEPA: the closed form of the batch, or what the head has learned",
        choices=["batch", "head"],
    )
    target_scale: str = option(
        "constant",
        "robust, VJEPA and BJEPA: constant (0.01), or learned by the KL term as in the paper",
        choices=["constant", "learned"],
    )
    schedule: str = option(
        "one-cycle", "robust: of the learning rate, in each round", choices=["one-cycle", "constant"]
    )
    ema_decay: float = option(0.9, "robust: decay of the EMA target encoder")
    window: int = option(20, "robust: steps in a window, more than the largest skip")
    windows: int = option(24, "robust: windows in a batch")
    lr: float = option(0.0, "peak learning rate; 0 is 0.001 (paper) or 0.3 (robust)")
    seeds_per_batch: int = option(
        1, "seeds that train as one batch, with all their scales and restarts; 0 for all: same numbers"
    )
    workers: int = option(2, "processes; each trains with one thread")


QUICK = {
    "noise_scales": [0.0, 8.0],
    "train_length": 1000,
    "test_length": 300,
    "steps": 60,
    "restarts": 3,
    "heat_steps": 15,
    "workers": 1,
}


@dataclass
class Run:
    """One system at one noise scale: a trajectory to train on and one to test on."""

    seed: int
    noise_scale: float
    system: LinearGaussianSystem
    train: TensorDict
    test: TensorDict

    @classmethod
    def simulate(cls, seed: int, settings: Settings) -> list[Run]:
        """All noise scales of one seed, with the random numbers in the order of the paper's program."""
        system = LinearGaussianSystem(*settings.sizes, seed=seed)
        generator = torch.Generator().manual_seed(seed)
        state_sizes = (system.signal_dim, system.distractor_dim)
        lengths = (settings.train_length + 1, settings.test_length + 1)
        # One call for each vector: a single large one would give other numbers.
        states = [
            torch.stack(
                [
                    torch.cat([torch.randn(size, generator=generator) for size in state_sizes])
                    for _ in range(length)
                ]
            )
            for length in lengths
        ]
        noise = [
            torch.cat([state, torch.randn(len(state), system.observation_dim, generator=generator)], -1)
            for state in states
        ]
        return [
            cls(seed, scale, system, *(system.unroll(part, scale) for part in noise))
            for scale in settings.noise_scales
        ]

    def normalise(self, normalisation: str) -> tuple[Tensor, Tensor]:
        """Training and test observations, centred and scaled by statistics of the training ones."""
        train, test = self.train["observation"], self.test["observation"]
        if normalisation == "standard":
            mean, std = train.mean(0), train.std(0)
            return (train - mean) / std, (test - mean) / std
        whitening = Whitening(self.system.observation_dim)
        whitening.update(train)
        return whitening(train), whitening(test)


# The models and losses of the two presets


def paper_model(name: str, settings: Settings) -> Any:
    """One of the paper's five models with a fresh start."""
    latent_dim, _, observation_dim = settings.sizes
    trunk = settings.encoder
    if name == "VAE":
        return VAE(observation_dim, latent_dim, trunk=trunk, num_cells=(64, 64))
    if trunk == "linear":
        encoder = linear_encoder(observation_dim, latent_dim)
    else:
        encoder = mlp_encoder(observation_dim, latent_dim, num_cells=(64, 64))
    if name == "AR":
        return PixelAR(encoder, PixelDecoder(encoder, latent_dim, observation_dim))
    if name == "JEPA":
        return JEPA(encoder, Predictor(latent_dim, head=DeltaHead()))
    model = {"VJEPA": VJEPA, "BJEPA": BJEPA}[name]
    # Log-variances without bounds, as printed.
    target_scale = TargetScale(latent_dim, observation_dim, kind="linear", log_var_range=None)
    head = DiagGaussianHead(log_var_range=None)
    return model(encoder, Predictor(latent_dim, head=head), target_scale=target_scale)


def paper_loss(name: str, models: Sequence[Any], settings: Settings) -> WindowLoss:
    """Its objective as printed."""
    if name == "VAE":
        return VAELoss(models, stacked_data=True)
    if name == "AR":
        return PixelARLoss(models, stacked_data=True)
    if name == "JEPA":
        return JEPALoss(
            models,
            stacked_data=True,
            prediction_coeff=INVARIANCE / settings.sizes[0],
            variance_coeff=VARIANCE,
            covariance_coeff=COVARIANCE,
            collapse_rank=0.0,
        )
    common = {"stacked_data": True, "target_kl_coeff": BETA, "collapse_rank": 0.0}
    if name == "VJEPA":
        return VJEPALoss(models, **common)
    return BJEPALoss(models, structural_kl_coeff=GAMMA, **common)


def robust_model(name: str, settings: Settings) -> Any:
    """A joint-embedding model with a fresh start, far from the identity: that is a local minimum."""
    latent_dim, _, observation_dim = settings.sizes
    if settings.encoder == "linear":
        encoder = linear_encoder(observation_dim, latent_dim)
        linear = encoder.module.network
    else:
        encoder = mlp_encoder(observation_dim, latent_dim, num_cells=(32,), residual=True)
        linear = encoder.module.network.linear
        output = encoder.module.network.mlp[-1]
        nn.init.normal_(output.weight, std=0.1 / output.in_features**0.5)
    head = DeltaHead() if name == "JEPA" else DiagGaussianHead("constant")
    predictor = Predictor(latent_dim, head=head, skips=settings.skips)
    nn.init.normal_(linear.weight, std=observation_dim**-0.5)
    for trunk in predictor.trunks:
        nn.init.normal_(trunk.weight, std=0.1)
    if name == "JEPA":
        return JEPA(encoder, predictor)
    model = {"VJEPA": VJEPA, "BJEPA": BJEPA}[name]
    target_scale = TargetScale(latent_dim, kind=settings.target_scale, init_std=0.01)
    return model(encoder, predictor, target_scale=target_scale)


def robust_loss(name: str, models: Sequence[Any], settings: Settings) -> WindowLoss:
    """The mutual information bound: predict well, keep the entropy."""
    common = {"stacked_data": True, "skip_weights": settings.skip_weights, "collapse_rank": 0.0}
    if settings.entropy == "moments":
        common["marginal_entropy_coeff"] = settings.entropy_coeff or 1.0
    elif settings.entropy == "sliced":
        # A few directions are enough for a small latent: each step draws others.
        common |= {"sliced_entropy_coeff": settings.entropy_coeff or 10.0, "num_slices": 16}
    if name == "JEPA":
        # The likelihood of a residual variance of 1/8. That of 1 tells a predictable direction from another
        # so weakly that the noise of the batches stays in the encoder.
        return JEPALoss(models, prediction_coeff=4.0, **common)
    # A constant scale has nothing to learn from the KL term.
    common["target_kl_coeff"] = BETA if settings.target_scale == "learned" else 0.0
    common["residual_variance"] = settings.residual_variance
    if name == "VJEPA":
        return VJEPALoss(models, **common)
    return BJEPALoss(models, structural_kl_coeff=GAMMA, **common)


# Training: all runs of a model kind as one batch


def select_objective(loss: WindowLoss) -> None:
    """Training needs no diagnostics."""
    loss.select_out_keys(*[key for key in loss.out_keys if key.startswith("loss_")])


def objective(losses: TensorDict) -> Tensor:
    """What is minimised: the sum of the ``loss_*`` entries, one number for each model."""
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def make_models(
    make: Callable[[str, Settings], Any], name: str, runs: Sequence[Run], restarts: int, settings: Settings
) -> list[Any]:
    """``restarts`` models for each run; a start depends on nothing but the run and its number."""
    models = []
    for run in runs:
        for restart in range(restarts):
            torch.manual_seed(100_000 * run.seed + 100 * round(100 * run.noise_scale) + restart)
            models.append(make(name, settings))
    return models


def same_moments(observations: Tensor) -> Tensor:
    """A few pairs ``(x_t, x_{t+1})`` with the mean and covariance of all: ``(N, T, O)`` to ``(N, M, 2, O)``.

    A linear model sees the data through these moments alone where its loss is a function of the first
    two moments of its outputs: squared errors and VICReg are. Their gradients are those of the full batch.
    """
    pairs = torch.cat([observations[:, :-1], observations[:, 1:]], dim=-1).double()
    num, _, size = pairs.shape
    mean = pairs.mean(1, keepdim=True)
    covariance = (pairs - mean).mT @ (pairs - mean) / pairs.shape[1]
    values, vectors = torch.linalg.eigh(covariance)
    root = vectors * values.clamp_min(0).sqrt().unsqueeze(1)
    # Orthonormal columns that sum to zero, as many as there are dimensions.
    contrasts = torch.cat([torch.ones(size + 1, 1), torch.eye(size + 1, size)], dim=1).double()
    basis = torch.linalg.qr(contrasts).Q[:, 1:]
    points = mean + (size + 1) ** 0.5 * basis @ root.mT
    return points.reshape(num, size + 1, 2, size // 2).to(observations)


def train_paper(name: str, runs: Sequence[Run], settings: Settings) -> Iterator[Any]:
    """Full-batch Adam at a constant learning rate; one model for each run."""
    observations = torch.stack([run.normalise("standard")[0] for run in runs])
    if settings.encoder == "linear" and name in ("AR", "JEPA"):
        windows = same_moments(observations)
    else:
        # Each feature side by side in memory: the layout in which the losses of linear models compute.
        windows = observations.mT.contiguous().mT.unsqueeze(1)
    batch = TensorDict(observation=windows, batch_size=windows.shape[:-1])
    loss = paper_loss(name, make_models(paper_model, name, runs, 1, settings), settings)
    updater = SoftUpdate(loss, eps=EMA_DECAY) if name in LATENT_MODELS else None
    optimizer = torch.optim.Adam(loss.parameters(), lr=settings.lr or 1e-3, fused=True)
    select_objective(loss)
    torch.manual_seed(0)
    for _ in range(settings.steps or 6000):
        objective(loss(batch)).sum().backward()
        optimizer.step()
        optimizer.zero_grad()
        if updater is not None:
            updater.step()
    for i in range(len(runs)):
        yield loss.get_model(i)


def train_robust(name: str, runs: Sequence[Run], settings: Settings) -> Iterator[Any]:
    """Two rounds: all starts of a run train a little, the best few train on; the objective chooses."""
    observations = torch.stack([run.normalise(settings.normalisation)[0] for run in runs])
    models = make_models(robust_model, name, runs, settings.restarts, settings)
    rounds = [(settings.heat_steps, settings.finalists), (settings.steps or 100, 1)]
    for steps, keep in rounds:
        loss = robust_loss(name, models, settings)
        starts = len(models) // len(runs)
        best = fit_robust(loss, observations, steps, settings).topk(min(keep, starts)).indices
        models = [loss.get_model(i * starts + int(k)) for i, row in enumerate(best) for k in row]
    yield from models


def fit_robust(loss: WindowLoss, observations: Tensor, steps: int, settings: Settings) -> Tensor:
    """One cycle of a large learning rate on minibatches; the score of each start, a row for each run."""
    updater = SoftUpdate(loss, eps=settings.ema_decay)
    lr = settings.lr or 0.3
    mlp = [param for key, param in loss.named_parameters() if "mlp" in key]
    rest = [param for key, param in loss.named_parameters() if "mlp" not in key]
    groups = [{"params": rest, "lr": lr, "weight_decay": 0.0}]
    if mlp:
        groups.append({"params": mlp, "lr": 0.1 * lr, "weight_decay": 1.0})
    optimizer = torch.optim.AdamW(groups, betas=(0.8, 0.99), fused=True)
    if settings.schedule == "constant":
        schedule = torch.optim.lr_scheduler.ConstantLR(optimizer, factor=1.0)
    else:
        peaks = [group["lr"] for group in groups]
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, peaks, total_steps=steps, pct_start=0.2, cycle_momentum=False
        )
    starts_of_a_run = loss.num_models // len(observations)
    select_objective(loss)

    def batch(starts: Tensor) -> TensorDict:
        windows = observations[:, starts.unsqueeze(1) + torch.arange(settings.window)]
        windows = windows.repeat_interleave(starts_of_a_run, dim=0)
        return TensorDict(observation=windows, batch_size=windows.shape[:-1])

    torch.manual_seed(0)
    # The same windows for all: what a run sees does not depend on the others.
    generator = torch.Generator().manual_seed(0)
    last = observations.shape[1] - settings.window
    slots = torch.arange(settings.windows)
    for _ in range(steps):
        # One window in each part of the trajectory: the variance of the signal grows with time.
        offsets = slots + torch.rand(settings.windows, generator=generator)
        starts = (offsets * (last / settings.windows)).long()
        objective(loss(batch(starts))).sum().backward()
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
        updater.step()
    loss.reset_out_keys()
    with torch.no_grad():
        losses = loss(batch(torch.arange(0, last + 1, settings.window)))
    # The head's likelihood is that of a diagonal Gaussian, which depends on the basis of the latents.
    score = losses.get("mutual_information", -objective(losses))
    # topk takes NaN for the largest number.
    return score.nan_to_num(-torch.inf).reshape(len(observations), starts_of_a_run)


# Evaluation


@torch.no_grad()
def represent(name: str, model: Any, observations: Tensor) -> tuple[Tensor, Tensor | None]:
    """What the probe reads, and the predictive variances, of each observation."""
    data = TensorDict(observation=observations, batch_size=observations.shape[:-1])
    if name == "VAE":
        return model(data)["latent"], None
    latent = model.encoder(data)["latent"]
    if name == "AR":
        return latent, None
    p = (model.fuse() if name == "BJEPA" else model.predictor).dist(latent)
    return p.mean, None if name == "JEPA" else p.variance


def r2_score(target: Tensor, prediction: Tensor, average: str) -> float:
    """Coefficient of determination of several components.

    The paper prints the formula that weighs components by their variance, but its numbers are those of
    scikit-learn's default, the plain mean over components.
    """
    error = (target - prediction).square().sum(0)
    total = (target - target.mean(0)).square().sum(0)
    if average == "weighted":
        return (1 - error.sum() / total.sum()).item()
    return (1 - error / total).mean().item()


def probe(latents: Sequence[Tensor], run: Run, ahead: int, average: str) -> tuple[Row, Tensor]:
    """R2 of signal and noise, and the signal that the probe reads off the test latents."""
    data = (run.train, run.test)
    used = [latent[: len(d) - 1] for latent, d in zip(latents, data, strict=True)]
    scores: Row = {}
    curve = used[1]
    for key, entry in (("distractor", "noise_r2"), ("signal", "signal_r2")):
        targets = [d[key][ahead : len(d) - 1 + ahead].double() for d in data]
        fitted = linear_probe(used[0], targets[0], used[1], targets[1])
        outputs = [fitted.predict(latent) for latent in used]
        for suffix, target, output in zip(("_train", ""), targets, outputs, strict=True):
            # Without a distractor there is nothing to find.
            known = key == "signal" or run.noise_scale > 0
            scores[entry + suffix] = r2_score(target, output, average) if known else None
        curve = outputs[1]
    return scores, curve[:SHOWN_STEPS]


def run_task(task: Task, settings: Settings) -> tuple[list[Row], dict[Any, Any], list[Row]]:
    """One model kind on all noise scales of some seeds: rows, what the figures show, what fusion changes."""
    preset, name, seeds = task
    torch.set_num_threads(1)
    runs = [run for seed in seeds for run in Run.simulate(seed, settings)]
    normalisation = "standard" if preset == "paper" else settings.normalisation
    start = time.perf_counter()
    train = train_paper if preset == "paper" else train_robust
    models = list(train(name, runs, settings))
    seconds = (time.perf_counter() - start) / len(runs)
    rows, shown, fusion = [], {}, []
    for run, model in zip(runs, models, strict=True):
        data = run.normalise(normalisation)
        outputs = [represent(name, model, observations) for observations in data]
        ahead = 0 if name == "VAE" else 1
        scores, predicted = probe([latent for latent, _ in outputs], run, ahead, settings.r2)
        which = {"preset": preset, "noise_scale": run.noise_scale, "seed": run.seed}
        rows.append(
            {**which, "model": name, "encoder": settings.encoder, **scores, "train_s": seconds},
        )
        if name == "BJEPA":
            # A VJEPA is a BJEPA without its prior.
            unfused = [represent("VJEPA", model, observations)[0] for observations in data]
            alone = probe(unfused, run, ahead, settings.r2)[0]["signal_r2"]
            fusion.append({**which, "fused": scores["signal_r2"], "unfused": alone})
        latents, variances = outputs[1]
        relative = None if variances is None else variances.mean(0) / latents.var(0)
        if run.seed == settings.seeds[0]:
            shown[preset, name, run.noise_scale] = (predicted[:, 0], relative)
    return rows, shown, fusion


def oracles(seed: int, settings: Settings) -> list[Row]:
    """What knowledge of the system, labels, or second moments alone would reach."""
    rows = []
    for run in Run.simulate(seed, settings):
        train, test = (data["observation"].double() for data in (run.train, run.test))
        filtered = KalmanFilter(run.system, run.noise_scale).filter(test)["next_signal_mean"][:-1]
        target = run.test["signal"][1:].double()
        scores = {
            "Kalman filter": {"signal_r2": r2_score(target, filtered, settings.r2), "noise_r2": None},
            "least squares": {**probe([train, test], run, 1, settings.r2)[0], "noise_r2": None},
            "CCA": probe(cca(train, test, settings.sizes[0]), run, 1, settings.r2)[0],
        }
        for name, values in scores.items():
            rows.append({"model": name, "noise_scale": run.noise_scale, "seed": seed, **values})
    return rows


def cca(train: Tensor, test: Tensor, num: int) -> list[Tensor]:
    """Projections on the directions of ``x_t`` that correlate most with ``x_{t+1}``."""
    whitening = Whitening(train.shape[-1]).double()
    whitening.update(train)
    white = whitening(train)
    directions = torch.linalg.svd(white[:-1].mT @ white[1:]).U[:, :num]
    return [white @ directions, whitening(test) @ directions]


# Results


def spread(values: Sequence[float]) -> float:
    """Standard deviation over seeds."""
    return stdev(values) if len(values) > 1 else 0.0


def reference(values: dict[str, list[Any]], row: Row, settings: Settings) -> float | None:
    """The paper's number, where it has one."""
    scale = row["noise_scale"]
    if settings.sizes != [4, 4, 20] or settings.encoder != "linear" or scale not in range(9):
        return None
    return values[row["model"]][int(scale)] if row["model"] in values else None


def table(rows: Sequence[Row], settings: Settings) -> str:
    """Test R2 over seeds: mean, standard deviation and worst; the paper's single seed beside them."""

    def cell(value: float | None, width: int = 8) -> str:
        return f"{'-' if value is None else format(value, '.3f'):>{width}s}"

    lines = [
        f"{'':23s}{'signal R2, test':^32s}{'train':>8s}{'noise R2, test':^24s}",
        f"{'scale':>5s} {'model':17s}{'mean':>8s}{'sd':>8s}{'worst':>8s}{'paper':>8s}{'mean':>8s}"
        f"{'mean':>8s}{'worst':>8s}{'paper':>8s}",
    ]
    for scale in sorted({row["noise_scale"] for row in rows}):
        for name in [*MODELS, *ORACLES]:
            here = [r for r in rows if r["model"] == name and r["noise_scale"] == scale]
            if not here:
                continue
            signal = [r["signal_r2"] for r in here]
            train = [r["signal_r2_train"] for r in here if "signal_r2_train" in r]
            noise = [r["noise_r2"] for r in here if r["noise_r2"] is not None]
            lines.append(
                f"{scale:5g} {name:17s}{mean(signal):8.4f}{spread(signal):8.4f}{min(signal):8.4f}"
                + cell(reference(PAPER_SIGNAL, here[0], settings))
                + (f"{mean(train):8.4f}" if train else f"{'-':>8s}")
                + cell(mean(noise) if noise else None)
                + cell(max(noise) if noise else None)
                + cell(reference(PAPER_NOISE, here[0], settings))
            )
        lines.append("")
    return "\n".join(lines).rstrip()


def figure_scores(preset: str, rows: Sequence[Row], settings: Settings, path: Path) -> None:
    """What is lost of the signal and kept of the distractor, against noise scale."""
    keys = ["signal_r2_train", "noise_r2_train", "signal_r2", "noise_r2"]
    fig, axes = plt.subplots(2, 2, figsize=(9, 6.2), sharex=True, sharey="col", layout="constrained")
    for ax, key in zip(axes.flat, keys, strict=True):
        signal = "signal" in key
        printed = {"signal_r2": PAPER_SIGNAL, "noise_r2": PAPER_NOISE}.get(key, {})
        for name, color in COLORS.items():
            here = [r for r in rows if r["model"] == name and r.get(key) is not None]
            scales = sorted({r["noise_scale"] for r in here})
            groups = [[r for r in here if r["noise_scale"] == scale] for scale in scales]
            values = [[1 - r[key] if signal else r[key] for r in group] for group in groups]
            if not values:
                continue
            style = "--" if name in ORACLES else "-"
            ax.plot(scales, [mean(v) for v in values], style, color=color, label=name, **MARKERS[name])
            if name not in ORACLES:
                low, high = [min(v) for v in values], [max(v) for v in values]
                ax.fill_between(scales, low, high, color=color, alpha=0.15, lw=0)
            paper = [reference(printed, group[0], settings) for group in groups]
            known = [(x, y) for x, y in zip(scales, paper, strict=True) if y is not None]
            if known:
                # The printed numbers have three digits: 1.000 may be 0.9995.
                lost = [max(1 - y, 5e-4) if signal else y for _, y in known]
                ax.plot([x for x, _ in known], lost, ":", color=color, lw=1.2)
        part = "training" if "train" in key else "test"
        ax.set_title(f"{part}: signal that is lost" if signal else f"{part}: distractor that is kept")
        if signal:
            ax.set(yscale="log", ylabel="1 - R2 of a linear probe")
        else:
            ax.set(ylim=(-0.1, 1.03), ylabel="R2 of a linear probe")
    for ax in axes[1]:
        ax.set_xlabel("noise scale of the distractor")
    several = len({row["seed"] for row in rows}) > 1
    what = "mean, best and worst over seeds; lower is better" if several else "lower is better"
    fig.suptitle(f"Preset {preset}: {what}")
    axes[1, 0].plot([], [], ":", color="gray", lw=1.2, label="printed in the paper")
    handles = axes[1, 0].get_legend_handles_labels()
    fig.legend(*handles, loc="outside lower center", ncols=len(COLORS) + 1, frameon=False)
    fig.savefig(path, dpi=150)
    plt.close(fig)


def figure_signals(preset: str, shown: dict[Any, Any], runs: Sequence[Run], path: Path) -> None:
    """The signal that the probe reads off each representation, and the predictive variances."""
    names = [name for name in MODELS if any(key[:2] == (preset, name) for key in shown)]
    uncertain = any(shown[preset, name, runs[0].noise_scale][1] is not None for name in names)
    num = len(names) + int(uncertain)
    size = (4 * len(runs), 1.5 * num + 1)
    fig, axes = plt.subplots(num, len(runs), figsize=size, squeeze=False, sharey="row", layout="constrained")
    latent_dim = runs[0].system.signal_dim
    for run, column in zip(runs, axes.T, strict=True):
        scale = run.noise_scale
        column[0].set_title(f"noise scale {scale:g}")
        signal = run.test["signal"][1 : SHOWN_STEPS + 1, 0]
        for ax, name in zip(column, names, strict=False):
            predicted, relative = shown[preset, name, scale]
            # A VAE speaks of the present: its curve begins one step earlier.
            times = torch.arange(len(predicted)) - int(name == "VAE")
            ax.plot(signal, color="0.75", lw=3, label="true signal")
            ax.plot(times, predicted, color=COLORS[name], lw=1, label=name)
            ax.tick_params(labelbottom=name == names[-1])
            if relative is not None:
                values = relative.sort(descending=True).values
                column[-1].semilogy(values, color=COLORS[name], lw=1, **MARKERS[name])
        column[len(names) - 1].set_xlabel("time (steps)")
        if uncertain:
            column[-1].set(xlabel="latent dimension, most uncertain first", xticks=range(latent_dim))
            column[-1].margins(y=0.2)
    for ax, name in zip(axes[:, 0], names, strict=False):
        ax.set_ylabel(name)
    if uncertain:
        axes[-1, 0].set_ylabel("variance / var. of mean")
    entries = [ax.get_legend_handles_labels() for ax in axes[:, 0]]
    lines = {label: line for entry in entries for line, label in zip(*entry, strict=True)}
    fig.suptitle(
        f"Preset {preset}: first component of the signal, as a linear probe reads it (test)"
        + (", and predictive variance" if uncertain else "")
    )
    fig.legend(lines.values(), lines, loc="outside lower center", ncols=len(lines), frameon=False)
    fig.savefig(path, dpi=150)
    plt.close(fig)


def draw(
    preset: str,
    rows: Sequence[Row],
    ideal: Sequence[Row],
    shown: dict[Any, Any],
    settings: Settings,
    out: Path,
) -> list[Path]:
    """The figures of a preset."""
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    scores = out / f"noisy_tv_table_{preset}.png"
    figure_scores(preset, [*rows, *ideal], settings, scores)
    scales = [s for s in settings.noise_scales if s in (0, 4, 8)] or settings.noise_scales[-1:]
    runs = Run.simulate(settings.seeds[0], replace(settings, noise_scales=scales))
    signals = out / f"noisy_tv_signals_{preset}.png"
    figure_signals(preset, shown, runs, signals)
    return [scores, signals]


# Command line


def parse(arguments: Sequence[str] | None = None) -> tuple[Settings, argparse.Namespace]:
    """The settings, and where the results go."""
    parser = command_line(Settings, __doc__)
    settings, args = read_settings(parser, Settings, QUICK, arguments)
    if settings.preset == ["robust"] and not set(settings.models) & set(LATENT_MODELS):
        parser.error("VAE and AR have the preset paper only")
    if settings.entropy == "none" and settings.entropy_coeff:
        parser.error(f"--entropy none has no weight, got --entropy-coeff {settings.entropy_coeff:g}")
    if "robust" in settings.preset and min(settings.heat_steps, settings.steps or 100) < 6:
        parser.error("--heat-steps and --steps must be at least 6 with the preset robust: a cycle needs them")
    return settings, args


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print the tables, draw the figures, write the JSON."""
    settings, args = parse(arguments)
    prepare(args)
    start = time.perf_counter()
    size = settings.seeds_per_batch or len(settings.seeds)
    batches = [tuple(settings.seeds[i : i + size]) for i in range(0, len(settings.seeds), size)]
    tasks: list[Task] = [
        (preset, name, seeds)
        for preset in settings.preset
        for name in SLOWEST_FIRST
        if name in settings.models and (preset == "paper" or name in LATENT_MODELS)
        for seeds in batches
    ]
    work = [
        *((run_task, task, settings) for task in tasks),
        *((oracles, s, settings) for s in settings.seeds),
    ]
    results = list(tqdm(execute(work, settings.workers), total=len(work), desc="tasks", leave=False))
    wall = time.perf_counter() - start
    ideal = sum(results[len(tasks) :], [])
    order = {name: i for i, name in enumerate(MODELS)}
    rows = sum((result[0] for result in results[: len(tasks)]), [])
    rows.sort(key=lambda r: (r["preset"], r["seed"], r["noise_scale"], order[r["model"]]))
    fusion = sum((result[2] for result in results[: len(tasks)]), [])
    for preset in settings.preset:
        mine = [row for row in rows if row["preset"] == preset]
        if not mine:
            print(f"Preset {preset} has none of the models {settings.models}\n")
            continue
        shown = {}
        for (kind, _, _), (_, curves, _) in zip(tasks, results, strict=False):
            if kind == preset:
                shown |= curves
        print(f"Preset {preset}, {settings.encoder} encoder, {len(settings.seeds)} seed(s)\n")
        print(table([*mine, *ideal], settings))
        gains = [row["fused"] - row["unfused"] for row in fusion if row["preset"] == preset]
        if gains:
            print(f"\nBJEPA, signal R2 fused minus unfused: {min(gains):+.4f} to {max(gains):+.4f}")
        print("\nfigures:", *draw(preset, mine, ideal, shown, settings, args.out), end="\n\n")
    print(f"{len(rows)} runs in {wall:.0f} s")
    write_report(args, settings, wall_s=wall, rows=rows, fusion=fusion)


def execute(work: Sequence[tuple[Any, ...]], workers: int) -> Iterator[Any]:
    """Results of the calls in their order."""
    if workers <= 1 or len(work) == 1:
        for function, *arguments in work:
            yield function(*arguments)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        futures = [pool.submit(*call) for call in work]
        for future in futures:
            yield future.result()


if __name__ == "__main__":
    main()
