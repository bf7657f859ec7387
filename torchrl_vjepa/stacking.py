"""Several models at once by stacked weights, where mapping over the models would cost more."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = [
    "StackableLinear",
    "columns",
    "features_first",
    "halves",
    "is_plain_linear",
    "linear",
    "products",
    "shared_noise",
    "squared_distance",
]


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


def features_first(x: Tensor, steps: slice = slice(None)) -> Tensor:
    """Windows as rows; where they are copied, the values of one feature lie side by side in memory.

    Latents are short vectors in long columns. Sums over features and products with small matrices run
    along the columns then, several times faster than along the rows.

    Args:
        x: of shape ``(*N, B, T, D)``.
        steps: which of the ``T`` steps.

    Returns:
        Of shape ``(*N, B T, D)``; a view where the rows are evenly spaced in memory already.

    Examples:
        >>> import torch
        >>> features_first(torch.zeros(2, 3, 4), slice(1, None)).stride()
        (1, 4)
    """
    # Steps are taken after the move: the gradient of a slice has the layout of what was sliced.
    return x.movedim(-1, -3)[..., steps].flatten(-2).mT


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


def columns(x: Tensor) -> Tensor:
    """Features before rows; a single row becomes a column.

    Args:
        x: of shape ``(*N, R, D)``, or ``(D,)``.

    Returns:
        A view of shape ``(*N, D, R)``, or ``(D, 1)``.

    Examples:
        >>> import torch
        >>> columns(torch.zeros(5, 3)).shape, columns(torch.zeros(3)).shape
        (torch.Size([3, 5]), torch.Size([3, 1]))
    """
    return x.mT if x.ndim > 1 else x.unsqueeze(-1)


def halves(x: Tensor) -> tuple[Tensor, Tensor]:
    """The two halves of the features, in the layout of the whole, gradients included.

    Args:
        x: of shape ``(*B, 2 D)``.

    Returns:
        Two views of shape ``(*B, D)``.

    Examples:
        >>> import torch
        >>> halves(torch.arange(4.0))
        (tensor([0., 1.]), tensor([2., 3.]))
    """
    if x.ndim < 2 or x.stride(-1) == 1:
        first, second = x.chunk(2, dim=-1)
        return first, second
    # The gradient of a chunk is a concatenation, which would put the features last again.
    first, second = x.mT.chunk(2, dim=-2)
    return first.mT, second.mT


def is_plain_linear(module: nn.Module) -> bool:
    """Whether a module is an affine map and nothing else: no subclass, no hook, no parametrisation.

    Args:
        module: any module.

    Returns:
        Whether :func:`linear` may be used with its weights in place of calling it.

    Examples:
        >>> from torch.nn.utils.parametrizations import weight_norm
        >>> is_plain_linear(nn.Linear(3, 2)), is_plain_linear(weight_norm(nn.Linear(3, 2)))
        (True, False)
    """
    return type(module) is nn.Linear and not (module._forward_hooks or module._forward_pre_hooks)


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


def squared_distance(x: Tensor, y: Tensor) -> Tensor:
    r"""Squared Euclidean distance of rows, :math:`\|x - y\|^2`, in two passes over memory.

    Args:
        x: of shape ``(*N, R, D)``.
        y: of the same shape, or ``(R, D)``.

    Returns:
        Of shape ``(*N, R)``.

    Examples:
        >>> import torch
        >>> squared_distance(torch.ones(2, 5, 3), torch.zeros(5, 3))[0]
        tensor([3., 3., 3., 3., 3.])
    """
    return F.mse_loss(columns(x), columns(y.expand_as(x)), reduction="none").sum(-2)
