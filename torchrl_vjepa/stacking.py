"""Several models at once by stacked weights, where mapping over the models would cost more."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["StackableLinear", "features_first", "linear", "products", "shared_noise"]


class StackableLinear(nn.Linear):
    """``nn.Linear`` that also takes the stacked weights of several models; see :func:`linear`.

    Examples:
        >>> import torch
        >>> StackableLinear(3, 2, bias=False)(torch.ones(5, 3)).shape
        torch.Size([5, 2])
    """

    stackable = True

    def forward(self, input: Tensor) -> Tensor:
        """The affine map.

        Args:
            input: see :func:`linear`.

        Returns:
            See :func:`linear`.
        """
        return linear(input, self.weight, self.bias)


def shared_noise(like: Tensor, event_dims: int) -> Tensor:
    r"""Standard normal numbers, the same for all models: adding or removing one changes no other.

    Args:
        like: of shape ``(*N, *event)``.
        event_dims: how many of its last dimensions are drawn independently.

    Returns:
        Of shape ``(*event)``, with the last dimension slowest in memory (:func:`features_first`).

    Examples:
        >>> import torch
        >>> shared_noise(torch.zeros(9, 6, 5, 4), 3).shape
        torch.Size([6, 5, 4])
    """
    *rest, dim = like.shape[-event_dims:]
    return torch.randn(dim, *rest, dtype=like.dtype, device=like.device).movedim(0, -1)


def features_first(x: Tensor) -> Tensor:
    """Windows as rows, with the values of one feature side by side in memory.

    Latents are short vectors in long columns. Sums over features and products with small matrices run
    along the columns then, several times faster than along the rows.

    Args:
        x: of shape ``(*N, B, T, D)``.

    Returns:
        Of shape ``(*N, B T, D)``; a view where the memory is so already.

    Examples:
        >>> import torch
        >>> features_first(torch.zeros(2, 3, 4)).stride()
        (1, 6)
    """
    return x.movedim(-1, -3).flatten(-2).mT


def products(x: Tensor) -> Tensor:
    r"""Sums of outer products of rows, :math:`X^\top X`.

    Args:
        x: of shape ``(*N, R, D)``.

    Returns:
        Of shape ``(*N, D, D)``.

    Examples:
        >>> import torch
        >>> products(torch.ones(5, 2))
        tensor([[5., 5.],
                [5., 5.]])
    """
    # torch.matmul reshapes on the way, which small matrices feel.
    return torch.bmm(x.mT, x) if x.ndim == 3 else x.mT @ x


def linear(x: Tensor, weight: Any, bias: Any = None) -> Tensor:
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
    if weight.ndim == 2 and (x.ndim != 2 or x.stride(0) != 1):
        return F.linear(x, weight, bias)
    # Features first, whatever the input was: see features_first.
    out = (torch.bmm(weight, x.mT) if x.ndim == 3 else weight @ x.mT).mT
    return out if bias is None else out + bias.unsqueeze(-2)
