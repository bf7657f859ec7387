"""Sets with an exact signed distance: ball, half-space, box."""

from __future__ import annotations

import abc

import torch
from torch import Tensor, nn

from torchrl_vjepa.priors.arguments import as_constant, finite_vector

__all__ = ["Ball", "Box", "HalfSpace", "Region"]


class Region(nn.Module, abc.ABC):
    r"""Closed set :math:`\mathcal S \subset \mathbb R^P`, by its signed distance.

    Args:
        dim: :math:`P`.

    Examples:
        >>> all(issubclass(region, Region) for region in (Ball, Box, HalfSpace))
        True
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.dim = dim

    def signed_distance(self, x: Tensor) -> Tensor:
        r"""Euclidean distance to the boundary, negative inside.

        Args:
            x: of shape ``(*B, P)``.

        Returns:
            ``(*B)``, in the units of ``x``. Its gradient has norm 1 where it exists; where several points
            of the boundary are equally near (the centre of a ball) it is a mean of theirs, or zero.

        Raises:
            ValueError: if ``x`` has another size.
        """
        if x.ndim == 0 or x.shape[-1] != self.dim:
            raise ValueError(
                f"x must have last dimension {self.dim}, that of the {type(self).__name__}, "
                f"got shape {tuple(x.shape)}"
            )
        return self._signed_distance(x)

    @abc.abstractmethod
    def _signed_distance(self, x: Tensor) -> Tensor: ...

    def contains(self, x: Tensor) -> Tensor:
        """Whether points lie in the set, its boundary included.

        Args:
            x: of shape ``(*B, P)``.

        Returns:
            Booleans ``(*B)``; not a number is nowhere.
        """
        return self.signed_distance(x) <= 0


class Ball(Region):
    r""":math:`\{x : \|x - c\| \le r\}`.

    Args:
        centre: :math:`c`, of shape ``(P,)``.
        radius: :math:`r`, positive.

    Raises:
        ValueError: if a value is not finite, or the radius not positive.

    Examples:
        >>> import torch
        >>> Ball(torch.zeros(2), 1.0).signed_distance(torch.tensor([[3.0, 4.0], [0.0, 0.5]]))
        tensor([ 4.0000, -0.5000])
    """

    centre: Tensor
    radius: Tensor

    def __init__(self, centre: Tensor, radius: float) -> None:
        centre = _point("centre", centre)
        super().__init__(len(centre))
        self.register_buffer("centre", centre)
        self.register_buffer("radius", as_constant(radius))
        if self.radius.ndim or not (self.radius > 0 and self.radius.isfinite()):
            raise ValueError(f"radius must be positive and finite, got {radius}")

    def _signed_distance(self, x: Tensor) -> Tensor:
        return torch.linalg.vector_norm(x - self.centre, dim=-1) - self.radius


class HalfSpace(Region):
    r""":math:`\{x : n^\top x \le o\}`.

    Args:
        normal: :math:`n`, of shape ``(P,)``, of any length but zero: it points out of the set.
        offset: :math:`o`, in units of :math:`n^\top x`.

    Raises:
        ValueError: if a value is not finite, or the normal is zero.

    Examples:
        >>> import torch
        >>> HalfSpace(torch.tensor([0.0, 2.0]), 2.0).signed_distance(torch.tensor([[7.0, 3.0], [7.0, 0.0]]))
        tensor([ 2., -1.])
    """

    normal: Tensor
    offset: Tensor

    def __init__(self, normal: Tensor, offset: float) -> None:
        normal = _point("normal", normal)
        super().__init__(len(normal))
        length = torch.linalg.vector_norm(normal)
        shift = finite_vector("offset", offset)
        if not length > 0 or not length.isfinite() or shift.ndim:
            raise ValueError(
                f"normal must be no zero vector and offset one number, got {normal.tolist()} and {offset}"
            )
        self.register_buffer("normal", normal / length)
        self.register_buffer("offset", shift / length)

    def _signed_distance(self, x: Tensor) -> Tensor:
        return (x * self.normal).sum(-1) - self.offset


class Box(Region):
    r""":math:`\{x : \texttt{low} \le x \le \texttt{high}\}`.

    Args:
        low: of shape ``(P,)``; :math:`-\infty` where a side is open.
        high: of shape ``(P,)``, greater than ``low``; :math:`\infty` where a side is open.

    Raises:
        ValueError: if shapes differ, a bound is not a number, ``low`` is not under ``high``, or all sides
            are open.

    Examples:
        >>> import torch
        >>> box = Box(torch.zeros(2), torch.tensor([2.0, 4.0]))
        >>> box.signed_distance(torch.tensor([[5.0, 8.0], [1.0, 3.5], [3.0, 1.0]]))
        tensor([ 5.0000, -0.5000,  1.0000])
    """

    low: Tensor
    high: Tensor

    def __init__(self, low: Tensor, high: Tensor) -> None:
        low, high = as_constant(low), as_constant(high)
        if low.ndim != 1 or low.shape != high.shape or not len(low):
            raise ValueError(
                f"low and high must have the same shape (P,), got {tuple(low.shape)} and {tuple(high.shape)}"
            )
        bounded = (low.isfinite() | high.isfinite()).any()
        if not (low < high).all() or not bounded:
            raise ValueError(
                "low must be under high, and one of them finite, "
                f"got low={low.tolist()}, high={high.tolist()}"
            )
        super().__init__(len(low))
        self.register_buffer("low", low)
        self.register_buffer("high", high)

    def _signed_distance(self, x: Tensor) -> Tensor:
        beyond = torch.maximum(self.low - x, x - self.high)
        return torch.linalg.vector_norm(beyond.clamp_min(0.0), dim=-1) + beyond.amax(-1).clamp_max(0.0)


def _point(name: str, value: Tensor) -> Tensor:
    point = finite_vector(name, value)
    if point.ndim != 1 or not len(point):
        raise ValueError(f"{name} must have shape (P,), got {tuple(point.shape)}")
    return point
