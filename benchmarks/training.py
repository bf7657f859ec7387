"""Training speed: the library's loss against a bare PyTorch loop of the same arithmetic.

Both train the same stacked linear VJEPAs on the same batches, in one process, in turn; the losses of the
first steps (and so the gradients between them) are compared before anything is timed. Rows: processor
seconds per 1000 steps of each, medians of interleaved rounds, and the median ratio.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import VJEPA, DiagGaussianHead, Predictor, TargetScale, VJEPALoss, linear_encoder

OBSERVATION, LATENT = 20, 4
SIZES = {
    # name: (models, windows, steps of a window, skips): the paper's model and objective on one long
    # window, and the first round of the robust preset of examples/noisy_tv_table.py
    "paper": (9, 1, 6000, (1,)),
    "robust": (72, 24, 20, (1, 8, 16)),
}
WEIGHTS = (0.04, 0.48, 0.48)
BETA, STD, DECAY, LR = 0.01, 0.01, 0.99, 1e-3


def make_loss(size: str) -> VJEPALoss:
    """The library's stack of models."""
    num_models, _, _, skips = SIZES[size]
    paper = size == "paper"
    models = [
        VJEPA(
            linear_encoder(OBSERVATION, LATENT),
            Predictor(
                LATENT,
                skips=skips,
                head=DiagGaussianHead("state" if paper else "constant", log_var_range=None),
            ),
            target_scale=TargetScale(LATENT, OBSERVATION, kind="linear", log_var_range=None)
            if paper
            else TargetScale(LATENT, kind="constant", init_std=STD),
        )
        for _ in range(num_models)
    ]
    if paper:
        return VJEPALoss(models, stacked_data=True, target_kl_coeff=BETA, collapse_rank=0.0)
    return VJEPALoss(
        models,
        skip_weights=WEIGHTS,
        stacked_data=True,
        target_kl_coeff=0.0,
        residual_variance="batch",
        marginal_entropy_coeff=1.0,
        collapse_rank=0.0,
    )


def library_step(loss: VJEPALoss, windows: TensorDict) -> Callable[[], Tensor]:
    """One step as a user writes it."""
    updater = SoftUpdate(loss, eps=DECAY)
    optimizer = torch.optim.Adam(loss.parameters(), lr=LR, fused=True)
    loss.select_out_keys(*[key for key in loss.out_keys if key.startswith("loss_")])

    def step() -> Tensor:
        losses = loss(windows)
        value = sum(v for k, v in losses.items() if k.startswith("loss_"))
        value.sum().backward()
        optimizer.step()
        optimizer.zero_grad()
        updater.step()
        return value.detach()

    return step


def bare_step(loss: VJEPALoss, size: str, windows: TensorDict) -> Callable[[], Tensor]:
    """The same arithmetic on stacked tensors, by hand."""
    skips = SIZES[size][3]
    copies = {
        key: value.detach().clone().requires_grad_()
        for key, value in loss.named_parameters()
        if value.numel()
    }
    encoder = next(v for k, v in copies.items() if k.startswith("encoder"))
    trunks = [v for k, v in copies.items() if "trunks" in k]
    target = encoder.detach().clone()
    optimizer = torch.optim.Adam(copies.values(), lr=LR, fused=True)
    x = windows["observation"]
    num, rows, length, _ = x.shape
    flat = x.reshape(num, rows * length, OBSERVATION)

    def noise() -> Tensor:
        return torch.randn(LATENT, rows, length).movedim(0, -1).contiguous()

    def likelihood(error: Tensor, log_var: Tensor) -> Tensor:
        return 0.5 * (error.square() * (-log_var).exp() + log_var + math.log(2 * math.pi)).sum(-1).mean(-1)

    def paper_objective() -> Tensor:
        scale = next(v for k, v in copies.items() if k.startswith("scale"))
        latent = torch.bmm(flat, encoder.mT)
        with torch.no_grad():
            mean = torch.bmm(flat, target.mT)
        log_var = torch.bmm(flat, scale.mT)
        aim = mean + (0.5 * log_var.detach()).exp() * noise().reshape(-1, LATENT)
        features = torch.bmm(latent[:, :-1], trunks[0].mT)
        prediction, spread = features.chunk(2, dim=-1)
        kl = 0.5 * (mean.square() + log_var.exp() - 1 - log_var).sum(-1).mean(-1)
        return likelihood(prediction - aim[:, 1:], spread) + BETA * kl

    def robust_objective() -> Tensor:
        constants = next(v for k, v in copies.items() if "constants" in k)
        eye = torch.eye(LATENT)
        latent = torch.bmm(flat, encoder.mT)
        z = latent.reshape(num, rows, length, LATENT)
        with torch.no_grad():
            aim = torch.bmm(flat, target.mT).reshape_as(z)
            aim = aim + STD * noise()
        terms = []
        for i, skip in enumerate(skips):
            context = z[:, :, :-skip].reshape(num, -1, LATENT)
            goal = aim[:, :, skip:].reshape(num, -1, LATENT)
            error = torch.bmm(context, trunks[i].mT) - goal
            moment = torch.bmm(error.mT, error) / error.shape[1]
            with torch.no_grad():
                scale = 1e-6 * moment.diagonal(dim1=-2, dim2=-1).mean(-1) + 1e-12
                covariance = moment + scale[:, None, None] * eye
                precision = torch.linalg.inv(covariance)
                constant = torch.logdet(covariance) + LATENT * math.log(2 * math.pi)
            head = torch.bmm(context.detach(), trunks[i].mT) - goal
            profile = 0.5 * ((precision * moment).sum((-1, -2)) + constant)
            terms.append(profile + likelihood(head, constants[:, i, None]))
        mean = latent.mean(1, keepdim=True)
        centred = latent - mean
        covariance = torch.bmm(centred.mT, centred) / latent.shape[1]
        trace = covariance.diagonal(dim1=-2, dim2=-1).sum(-1) + mean.square().sum((-1, -2))
        entropy = 0.5 * (trace - LATENT - torch.logdet(covariance))
        return sum(w * term for w, term in zip(WEIGHTS, terms, strict=True)) + entropy

    objective = paper_objective if size == "paper" else robust_objective

    def step() -> Tensor:
        value = objective()
        value.sum().backward()
        optimizer.step()
        optimizer.zero_grad()
        with torch.no_grad():
            target.lerp_(encoder, 1 - DECAY)
        return value.detach()

    return step


def measure(size: str, rounds: int, steps: int) -> dict[str, float | str]:
    """Interleaved rounds; medians."""
    torch.manual_seed(0)
    num_models, rows, length, _ = SIZES[size]
    windows = TensorDict(
        observation=torch.randn(num_models, rows, length, OBSERVATION), batch_size=(num_models, rows, length)
    )
    loss = make_loss(size)
    contenders = {"bare": bare_step(loss, size, windows), "library": library_step(loss, windows)}
    values = {}
    for name, step in contenders.items():
        torch.manual_seed(1)
        values[name] = torch.stack([step() for _ in range(5)])
    torch.testing.assert_close(values["library"], values["bare"], rtol=1e-3, atol=1e-3)
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, step in contenders.items():
            start = time.process_time()
            for _ in range(steps):
                step()
            times[name].append((time.process_time() - start) / steps * 1000)
    medians = {name: statistics.median(values) for name, values in times.items()}
    ratios = [a / b for a, b in zip(times["library"], times["bare"], strict=True)]
    return {
        "size": size,
        "library_s_per_1000": medians["library"],
        "bare_s_per_1000": medians["bare"],
        "ratio": statistics.median(ratios),
    }


def main() -> None:
    """Measure every size, print the table, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=7, help="interleaved rounds (default: 7)")
    parser.add_argument("--steps", type=int, default=20, help="steps in a round (default: 20)")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch (default: 1)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows as JSON")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    rows = [measure(size, args.rounds, args.steps) for size in SIZES]
    print(f"{'size':10s}{'library':>10s}{'bare':>10s}{'ratio':>8s}   (seconds per 1000 steps)")
    for row in rows:
        print(
            f"{row['size']:10s}{row['library_s_per_1000']:10.1f}{row['bare_s_per_1000']:10.1f}"
            f"{row['ratio']:8.2f}"
        )
    if args.json:
        settings = {"rounds": args.rounds, "steps": args.steps, "threads": args.threads}
        args.json.write_text(json.dumps({"settings": settings, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
