"""Monotone rational-quadratic splines (Durkan et al., 2019): a bijection of the line in closed form."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_vjepa.distributions.noise import full_precision

__all__ = ["BOUND", "spline", "spline_size"]

#: The spline bends inside of ``[-BOUND, BOUND]``, in units of the noise; outside it is the identity.
BOUND = 4.0
#: A bin takes at least this part of the interval, so slopes and log-determinants are bounded.
MIN_BIN = 0.01
#: Slopes at the knots lie between its inverse and it.
MAX_SLOPE = 50.0


def spline_size(num_bins: int) -> int:
    """Parameters of one spline: widths, heights, and slopes at the inner knots.

    Args:
        num_bins: number of bins ``K``.

    Returns:
        ``3 K - 1``.

    Examples:
        >>> spline_size(8)
        23
    """
    return 3 * num_bins - 1


def spline(value: Tensor, parameters: Tensor, *, inverse: bool = False) -> tuple[Tensor, Tensor]:
    """Monotone rational-quadratic spline of every dimension, or its inverse.

    Zero parameters are the identity. Computed in float32 at least.

    Args:
        value: of shape ``(*S, *B, D)``.
        parameters: unconstrained, of shape ``(*B, D, 3 K - 1)``, broadcastable.
        inverse: whether to invert.

    Returns:
        The image ``(*S, *B, D)`` and the logarithm of the slope there, ``(*S, *B, D)``.

    Examples:
        >>> import torch
        >>> x, parameters = torch.tensor([-9.0, 0.5]), torch.ones(2, 23) * torch.arange(23)
        >>> y, log_slope = spline(x, parameters)
        >>> back, negative = spline(y, parameters, inverse=True)
        >>> torch.allclose(back, x), torch.allclose(negative, -log_slope, atol=1e-5)
        (True, True)
    """
    dtype = value.dtype
    value, parameters = full_precision(value, parameters)
    num_bins = (parameters.shape[-1] + 1) // 3
    widths, heights, slopes = parameters.split([num_bins, num_bins, num_bins - 1], dim=-1)
    x_knots, y_knots = _knots(widths), _knots(heights)
    # Smoothly bounded, one for zero.
    limit = math.log(MAX_SLOPE)
    slopes = (limit * torch.tanh(slopes / limit)).exp()
    one = torch.ones_like(slopes[..., :1])
    slopes = torch.cat([one, slopes, one], dim=-1)

    searched = y_knots if inverse else x_knots
    index = (value.unsqueeze(-1) >= searched[..., 1:-1]).sum(-1, keepdim=True)
    corners = torch.stack(
        [end for knots in (x_knots, y_knots, slopes) for end in (knots[..., :-1], knots[..., 1:])], dim=-2
    ).expand(*index.shape[:-1], 6, num_bins)
    chosen = torch.take_along_dim(corners, index.unsqueeze(-2), -1).squeeze(-1)
    left, right, low, high, first, last = chosen.unbind(-1)
    width, height = right - left, high - low
    secant = height / width
    bend = first + last - 2 * secant
    inside = value.abs() < BOUND
    clipped = value.clamp(-BOUND, BOUND)
    if inverse:
        rise = clipped - low
        a = height * (secant - first) + rise * bend
        b = height * first - rise * bend
        c = -secant * rise
        root = (b.square() - 4 * a * c).clamp_min(torch.finfo(b.dtype).tiny).sqrt()
        part = (2 * c / (-b - root)).clamp(0, 1)
    else:
        part = (clipped - left) / width
    mixed = part * (1 - part)
    denominator = secant + bend * mixed
    numerator = last * part.square() + 2 * secant * mixed + first * (1 - part).square()
    log_slope = 2 * (secant.log() - denominator.log()) + numerator.log()
    if inverse:
        image, log_slope = left + width * part, -log_slope
    else:
        image = low + height * (secant * part.square() + first * mixed) / denominator
    image = torch.where(inside, image, value)
    return image.to(dtype), torch.where(inside, log_slope, 0.0).to(dtype)


def _knots(sizes: Tensor) -> Tensor:
    """Knots ``(..., K + 1)`` from ``-BOUND`` to ``BOUND``."""
    num_bins = sizes.shape[-1]
    parts = MIN_BIN + (1 - MIN_BIN * num_bins) * sizes.softmax(-1)
    inner = 2 * BOUND * parts[..., :-1].cumsum(-1) - BOUND
    end = torch.full_like(inner[..., :1], BOUND)
    return torch.cat([-end, inner, end], dim=-1)
