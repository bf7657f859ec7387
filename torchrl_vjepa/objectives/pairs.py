"""Pairs of context and target for one skip, and means over those that count."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from torchrl_vjepa.stacking import products

__all__ = ["Pairs", "mean_over", "normalised_weights", "rows_of", "second_moment"]


class Pairs(NamedTuple):
    r"""All pairs :math:`(t, t + \Delta)` of windows for one skip, as rows; of ``*N`` models.

    Rows instead of windows: a network that is applied to a matrix, and not to a stack of them, stays one
    product when there are several models.

    Attributes:
        skip: :math:`\Delta`.
        dist: predictive distribution with batch ``(*N, R)``, where ``R = B (T - skip)``.
        target: target latents, of shape ``(*N, R, D)``.
        context: context latents, of the same shape.
        action: action chunks ``(*N, R, skip, A)``, or ``None``.
        side_info: side information ``(*N, R, S)``, or ``None``.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import Delta
        >>> latent = torch.zeros(2, 3)
        >>> Pairs(1, Delta(latent), latent, latent, None, None).dist.batch_shape
        torch.Size([2])
    """

    skip: int
    dist: Distribution
    target: Tensor
    context: Tensor
    action: Tensor | None
    side_info: Tensor | None


def mean_over(value: Tensor, mask: Tensor | None) -> Tensor:
    """Mean over the rows that count.

    Args:
        value: one number per row, ``(*N, R)``; finite where it counts.
        mask: rows that count, ``(R,)`` or ``(*N, R)``; ``None`` for all.

    Returns:
        Of shape ``(*N)``; zero where no row counts.

    Examples:
        >>> import torch
        >>> mean_over(torch.tensor([1.0, 9.0]), torch.tensor([True, False]))
        tensor(1.)
    """
    if mask is None:
        return value.mean(-1)
    return torch.where(mask, value, 0).sum(-1) / mask.sum(-1).clamp_min(1)


def rows_of(mask: Tensor | None) -> Tensor | None:
    """The mask of windows as one of rows.

    Args:
        mask: ``(*N, B, T)``, or ``None``.

    Returns:
        ``(*N, B T)``, or ``None``.

    Examples:
        >>> import torch
        >>> rows_of(torch.ones(2, 3, dtype=torch.bool)).shape
        torch.Size([6])
    """
    return None if mask is None else mask.flatten(-2)


def second_moment(value: Tensor, mask: Tensor | None) -> Tensor:
    """Mean of the outer products over the rows that count.

    Args:
        value: one finite vector per row, ``(*N, R, D)``.
        mask: rows that count, ``(R,)`` or ``(*N, R)``; ``None`` for all.

    Returns:
        Of shape ``(*N, D, D)``; zero where no row counts.

    Examples:
        >>> import torch
        >>> second_moment(torch.tensor([[1.0], [3.0]]), None)
        tensor([[5.]])
    """
    if mask is None:
        return products(value) / value.shape[-2]
    count = mask.sum(-1).clamp_min(1)[..., None, None]
    return products(torch.where(mask.unsqueeze(-1), value, 0)) / count


def normalised_weights(weights: Sequence[float] | None, skips: tuple[int, ...]) -> tuple[float, ...]:
    """Weights of the skips that sum to one.

    Args:
        weights: one for each skip; equal by default.
        skips: the skips.

    Returns:
        The weights.

    Raises:
        ValueError: if they are not one non-negative finite number for each skip, or all zero.

    Examples:
        >>> normalised_weights([1.0, 3.0], (1, 2))
        (0.25, 0.75)
    """
    if weights is None:
        return tuple(1.0 / len(skips) for _ in skips)
    if (
        len(weights) != len(skips)
        or not all(math.isfinite(w) and w >= 0 for w in weights)
        or not sum(weights)
    ):
        raise ValueError(
            f"skip_weights must be one finite weight of at least 0 for each of skips={skips}, not all zero, "
            f"got {tuple(weights)}"
        )
    return tuple(float(w) / sum(weights) for w in weights)
