"""Free numbers as actions inside bounds, smoothly and back."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["squash", "unsquash"]

#: How far from a bound the search begins, as a fraction: on the bound itself the slope is zero.
MARGIN = 0.01


def squash(x: Tensor, low: Tensor, high: Tensor, unit: Tensor) -> Tensor:
    r"""Map free numbers onto :math:`[\text{low}, \text{high}]`.

    :math:`\text{mid} + \text{half} \tanh(x\, \text{unit} / \text{half})` between two bounds, where ``half``
    is half the range; :math:`\text{low} + \text{unit}\, \text{softplus}(x)` above one and
    :math:`\text{high} - \text{unit}\, \text{softplus}(-x)` below one; :math:`\text{unit}\, x` without
    any. A step of one in ``x`` moves the action by about ``unit`` in the middle of the range.

    Args:
        x: of shape ``(*B, A)``.
        low: lower bounds ``(A)``; infinite, or the largest number, where there is none.
        high: upper bounds ``(A)``, likewise.
        unit: positive, ``(A)``, in units of the action.

    Returns:
        Actions of shape ``(*B, A)``, inside the bounds up to rounding.

    Examples:
        >>> x = torch.tensor([0.0, -50.0, 3.0])
        >>> low, high = torch.tensor([2.0, 1.0, -torch.inf]), torch.tensor([4.0, torch.inf, torch.inf])
        >>> squash(x, low, high, torch.tensor([1.0, 1.0, 2.0]))
        tensor([3., 1., 6.])
    """
    has_low, has_high = _has_bounds(low, high)
    low, high, middle, half = _finite(low, high, has_low, has_high)
    one_sided = torch.where(has_low, low + unit * F.softplus(x), high - unit * F.softplus(-x))
    between = middle + half * torch.tanh(x * (unit / half))
    bounded = torch.where(has_low & has_high, between, one_sided)
    return torch.where(has_low | has_high, bounded, unit * x)


def unsquash(action: Tensor, low: Tensor, high: Tensor, unit: Tensor) -> Tensor:
    """The inverse of :func:`squash`, of actions moved a little away from the bounds.

    Args:
        action: inside the bounds, of shape ``(*B, A)``.
        low: as in :func:`squash`.
        high: as in :func:`squash`.
        unit: as in :func:`squash`.

    Returns:
        Finite numbers of shape ``(*B, A)``. What lies closer to a bound than a hundredth of half the range
        (of ``unit`` where there is one bound) is put at that distance.

    Examples:
        >>> low, high, unit = torch.tensor([0.0]), torch.tensor([4.0]), torch.tensor([1.0])
        >>> squash(unsquash(torch.tensor([[1.0], [4.0]]), low, high, unit), low, high, unit).flatten()
        tensor([1.0000, 3.9800])
    """
    has_low, has_high = _has_bounds(low, high)
    low, high, middle, half = _finite(low, high, has_low, has_high)
    ratio = ((action - middle) / half).clamp(MARGIN - 1, 1 - MARGIN)
    between = torch.atanh(ratio) * (half / unit)
    distance = torch.where(has_low, action - low, high - action) / unit
    # The inverse of softplus, without overflow where it is the identity.
    distance = distance.clamp_min(MARGIN)
    inverse = distance + torch.log(-torch.expm1(-distance))
    one_sided = torch.where(has_low, inverse, -inverse)
    bounded = torch.where(has_low & has_high, between, one_sided)
    return torch.where(has_low | has_high, bounded, action / unit)


def _has_bounds(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    limit = 0.5 * torch.finfo(low.dtype).max  # Unbounded has the largest number as its bound
    return low > -limit, high < limit


def _finite(
    low: Tensor, high: Tensor, has_low: Tensor, has_high: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Bounds, middle and half range, with harmless numbers for what does not exist.

    An infinity in a branch that is not taken would still turn the gradient into nan.
    """
    both = has_low & has_high
    half = torch.where(both, 0.5 * high - 0.5 * low, 1.0)
    middle = torch.where(both, 0.5 * high + 0.5 * low, 0.0)
    return torch.where(has_low, low, 0.0), torch.where(has_high, high, 0.0), middle, half
