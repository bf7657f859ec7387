"""Weights of several models, stacked: what the losses use where ``torch.vmap`` would cost more than it does."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

__all__ = ["linear"]


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    r"""The affine map :math:`x W^\top + b`, of one model or of several whose weights are stacked.

    A module that computes with this function and otherwise with broadcasting element by element has the
    attribute ``stackable``: a loss then gives it stacked weights, instead of mapping over the models.

    Args:
        x: inputs, of shape ``(*B, F)``; with stacked weights ``(R, F)`` (the same for all models) or
            ``(N, R, F)``.
        weight: of shape ``(D, F)``, or ``(N, D, F)`` for ``N`` models.
        bias: of shape ``(D,)`` or ``(N, D)``; ``None`` for none.

    Returns:
        Of shape ``(*B, D)`` or ``(N, R, D)``.

    Examples:
        >>> import torch
        >>> linear(torch.ones(5, 3), torch.ones(2, 4, 3)).shape
        torch.Size([2, 5, 4])
    """
    if weight.ndim == 2:
        return F.linear(x, weight, bias)
    out = x @ weight.mT
    return out if bias is None else out + bias.unsqueeze(-2)
