"""Metropolis-adjusted Langevin chains: samples of any differentiable log-density."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["langevin"]


def langevin(
    log_prob: Callable[[Tensor], Tensor],
    starts: Tensor,
    scale: Tensor | float = 1.0,
    *,
    step_size: float = 0.5,
    num_steps: int = 50,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Where Metropolis-adjusted Langevin chains (MALA) are after some steps.

    Every chain proposes :math:`Z' = Z + \tfrac{\epsilon^2}{2} s^2 \nabla \log \pi(Z) + \epsilon s \xi`,
    :math:`\xi \sim \mathcal N(0, I)`, and accepts with probability
    :math:`\min\{1, \pi(Z')\, r(Z \mid Z') / (\pi(Z)\, r(Z' \mid Z))\}`: :math:`\pi` stays what it was,
    whatever the step size. A proposal of density zero or ``nan`` is rejected.

    Args:
        log_prob: :math:`\log \pi`, up to a constant: ``(*S, *B, D) -> (*S, *B)``, row by row and
            differentiable.
        starts: where the chains start, ``(*S, *B, D)``.
        scale: :math:`s`, the natural unit of a step, broadcastable to ``starts``.
        step_size: :math:`\epsilon`.
        num_steps: steps of every chain.
        generator: source of randomness; the global one if ``None``.

    Returns:
        ``(*S, *B, D)``, without gradient.

    Raises:
        ValueError: if ``step_size`` is not positive, ``num_steps`` negative, or the log-density has another
            shape or no gradient.

    Examples:
        >>> import torch
        >>> chains = langevin(
        ...     lambda z: -0.5 * (z - 3).square().sum(-1),
        ...     torch.zeros(500, 1),
        ...     step_size=1.0,
        ...     generator=torch.Generator().manual_seed(0),
        ... )
        >>> bool((chains.mean() - 3).abs() < 0.2)
        True
    """
    if not step_size > 0:
        raise ValueError(f"step_size must be positive, got {step_size}")
    if num_steps < 0:
        raise ValueError(f"num_steps must be at least 0, got {num_steps}")
    step = step_size * torch.as_tensor(scale, dtype=starts.dtype, device=starts.device).detach()
    points = starts.detach()
    value, drift = _value_and_drift(log_prob, points, step)
    for _ in range(num_steps):
        noise = torch.randn(points.shape, generator=generator, dtype=points.dtype, device=points.device)
        # In units of the step: the drift is half the gradient, and proposals have variance 1.
        moved = points + step * (drift + noise)
        new_value, new_drift = _value_and_drift(log_prob, moved, step)
        back = drift + noise + new_drift
        log_ratio = new_value - value + 0.5 * (noise.square() - back.square()).sum(-1)
        uniform = torch.rand(value.shape, generator=generator, dtype=points.dtype, device=points.device)
        accepted = (uniform.log() < log_ratio) & new_value.isfinite()
        # A chain that starts where there is no density leaves as soon as it can.
        accepted = accepted | (new_value.isfinite() & ~value.isfinite())
        value = torch.where(accepted, new_value, value)
        rows = accepted.unsqueeze(-1)
        points, drift = torch.where(rows, moved, points), torch.where(rows, new_drift, drift)
    return points


def _value_and_drift(
    log_prob: Callable[[Tensor], Tensor], points: Tensor, step: Tensor
) -> tuple[Tensor, Tensor]:
    with torch.inference_mode(False), torch.enable_grad():
        points = points.clone().requires_grad_()
        value = log_prob(points)
        if value.shape != points.shape[:-1]:
            raise ValueError(
                f"log_prob must return a tensor of shape {tuple(points.shape[:-1])} for latents "
                f"{tuple(points.shape)}, got {tuple(value.shape)}"
            )
        if not value.requires_grad:
            raise ValueError("log_prob must be differentiable in the latents, got a value without gradient")
        (gradient,) = torch.autograd.grad(torch.where(value.isfinite(), value, 0.0).sum(), points)
    # The same function of the point in both directions: a cut gradient leaves the chain valid.
    return value.detach(), 0.5 * step * gradient.nan_to_num(0.0, 0.0, 0.0)
