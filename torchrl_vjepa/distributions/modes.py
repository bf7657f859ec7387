"""The most probable latent, by gradient ascent from several starts."""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch
from torch import Tensor
from torch.distributions import Distribution, MixtureSameFamily

from torchrl_vjepa.distributions.noise import NoiseDistribution
from torchrl_vjepa.distributions.sampling import sample

__all__ = ["maximize_log_prob"]

LogDensity = Callable[[Tensor], Tensor]
MakeOptimizer = Callable[[list[Tensor]], torch.optim.Optimizer]


def maximize_log_prob(
    target: Distribution | LogDensity,
    starts: Tensor | None = None,
    *,
    scale: Tensor | float | None = None,
    num_steps: int = 100,
    optimizer: MakeOptimizer | None = None,
) -> tuple[Tensor, Tensor]:
    r"""Maximum a posteriori latent :math:`\arg\max_Z \log p(Z)`, by gradient ascent from several starts.

    The paper's MAP prediction (section "Prediction and Uncertainty Propagation"), and its latent MAP
    under a prior: ``target`` may be any log-density up to a constant, for instance that of a likelihood
    times an energy prior. All starts of all batch rows ascend together; the best point that was ever
    visited wins, so the result is never worse than a start. The step is in units of ``scale``.

    Args:
        target: a distribution with batch ``*B`` and event ``(D,)``, or a log-density
            ``(S, *B, D) -> (S, *B)``, differentiable and row by row.
        starts: where to start, ``(S, *B, D)``; for a distribution by default the means of a mixture's
            components, a few points of a flow, the mean of others.
        scale: the natural unit of a step, broadcastable to ``starts``; by default the standard deviation
            of a distribution, and 1 for a callable.
        num_steps: gradient steps.
        optimizer: makes an optimiser of the list of variables, which are in units of ``scale``, for
            instance ``lambda variables: torch.optim.LBFGS(variables)``; Adam with a step of 0.1 by
            default.

    Returns:
        The point ``(*B, D)`` and its log-density ``(*B)``, without gradient.

    Raises:
        ValueError: if a callable comes without starts, a shape does not fit, ``num_steps`` is negative,
            the log-density has no gradient, or no start of a row has a finite log-density.

    Examples:
        >>> import torch
        >>> energy = lambda z: -(z - 3.0).square().sum(-1)
        >>> point, value = maximize_log_prob(energy, torch.zeros(1, 5, 2))
        >>> point[0].round(decimals=2), value.shape
        (tensor([3., 3.]), torch.Size([5]))
    """
    if num_steps < 0:
        raise ValueError(f"num_steps must be at least 0, got {num_steps}")
    # Gradients are needed whatever the caller's mode; what inference mode made cannot have any.
    inference = torch.is_inference_mode_enabled()
    with torch.inference_mode(False), torch.enable_grad():
        if inference:
            target, starts, scale = copy.deepcopy((target, starts, scale))
        log_prob = target.log_prob if isinstance(target, Distribution) else target
        to_point: Callable[[Tensor], Tensor] | None = None
        if isinstance(target, Distribution) and starts is None:
            starts, to_point, unit = _search_space(target)
            scale = unit if scale is None else scale
        elif isinstance(target, Distribution) and scale is None:
            scale = _spread(target)
        if starts is None or starts.ndim < 2:
            shape = None if starts is None else tuple(starts.shape)
            raise ValueError(f"starts must have shape (S, *B, D), got {shape}")
        best_value, best = _ascend(
            log_prob, starts.detach(), to_point, 1.0 if scale is None else scale, num_steps, optimizer
        )
    index = best_value.nan_to_num(-torch.inf).argmax(0, keepdim=True)
    value = best_value.gather(0, index).squeeze(0)
    if not bool(value.isfinite().all()):
        rows = int((~value.isfinite()).sum())
        raise ValueError(
            f"starts must have a finite log-density in every row, got none in {rows} rows; start elsewhere"
        )
    point = torch.take_along_dim(best, index.unsqueeze(-1), 0).squeeze(0)
    return point, value


def _ascend(
    log_prob: LogDensity,
    starts: Tensor,
    to_point: Callable[[Tensor], Tensor] | None,
    scale: Tensor | float,
    num_steps: int,
    make_optimizer: MakeOptimizer | None,
) -> tuple[Tensor, Tensor]:
    """Best values ``(S, *B)`` and points ``(S, *B, D)`` along the way from every start."""
    scale = torch.as_tensor(scale, dtype=starts.dtype, device=starts.device).detach()
    steps = torch.zeros_like(starts, requires_grad=True)
    record: dict[str, Tensor] = {}

    def closure() -> Tensor:
        point = starts + scale * steps
        point = point if to_point is None else to_point(point)
        value = log_prob(point)
        if value.shape != point.shape[:-1]:
            raise ValueError(
                f"target must return a tensor of shape {tuple(point.shape[:-1])} for latents of shape "
                f"{tuple(point.shape)}, got {tuple(value.shape)}"
            )
        _keep_best(record, value.detach(), point.detach())
        if not value.requires_grad:
            raise ValueError(
                "target must be differentiable in the latents, got a log-density without gradient: is it "
                "detached, rounded or a comparison?"
            )
        objective = torch.where(value.isfinite(), value, 0.0).sum()
        (gradient,) = torch.autograd.grad(-objective, steps)
        # A row that went astray must not stop the others. LBFGS wants its gradients contiguous.
        steps.grad = gradient.nan_to_num(0.0, 0.0, 0.0).contiguous()
        return -objective.detach()

    optimizer = torch.optim.Adam([steps], lr=0.1) if make_optimizer is None else make_optimizer([steps])
    for _ in range(num_steps):
        # LBFGS's types want floats where tensors do.
        optimizer.step(closure)  # type: ignore[arg-type]
    closure()
    return record["value"], record["point"]


def _keep_best(record: dict[str, Tensor], value: Tensor, point: Tensor) -> None:
    if record:
        better = (value > record["value"]) | record["value"].isnan()
        value = torch.where(better, value, record["value"])
        point = torch.where(better.unsqueeze(-1), point, record["point"])
    record.update(value=value, point=point)


def _search_space(p: Distribution) -> tuple[Tensor, Callable[[Tensor], Tensor] | None, Tensor]:
    if isinstance(p, NoiseDistribution):
        return p.search_space()
    if isinstance(p, MixtureSameFamily):
        return p.component_distribution.mean.movedim(-2, 0), None, p.stddev
    draws = sample(p, (8,), generator=torch.Generator(p.sample().device).manual_seed(0))
    return draws, None, draws.std(0)


def _spread(p: Distribution) -> Tensor:
    try:
        return p.stddev
    except NotImplementedError:
        return _search_space(p)[2]
