"""The Gaussian over action sequences that planners refine, and where it starts."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Bounded, TensorSpec, Unbounded

__all__ = ["Proposal", "continuous_action", "gaussian_of_bounds"]


class Proposal(NamedTuple):
    """Diagonal Gaussian over action sequences, in the units of the actions.

    Attributes:
        mean: of shape ``(*B, H, A)``, inside the bounds.
        std: of shape ``(*B, H, A)``, positive.

    Examples:
        >>> import torch
        >>> Proposal(torch.zeros(5, 2), torch.ones(5, 2)).mean.shape
        torch.Size([5, 2])
    """

    mean: Tensor
    std: Tensor


def continuous_action(spec: TensorSpec | None, keys: list[NestedKey]) -> TensorSpec:
    """The specification, if a Gaussian can propose such actions.

    Args:
        spec: of the action; ``None`` where it is not one tensor.
        keys: of the actions, for the message.

    Returns:
        The same specification.

    Raises:
        TypeError: if it is not one continuous tensor.

    Examples:
        >>> continuous_action(Bounded(-1, 1, (2,)), ["action"]).shape
        torch.Size([2])
    """
    supported = "one continuous tensor (Bounded or Unbounded, floating point)"
    if spec is None:
        raise TypeError(f"the action of env must be {supported}, got the keys {keys}")
    if not isinstance(spec, (Bounded, Unbounded)) or not spec.dtype.is_floating_point:
        raise TypeError(f"the action of env must be {supported}, got {type(spec).__name__} of {spec.dtype}")
    return spec


def gaussian_of_bounds(spec: TensorSpec, init_std: float | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Bounds, and mean and standard deviation of a proposal that knows nothing yet.

    Args:
        spec: of a continuous action.
        init_std: a fraction of half the range where the action is bounded (0.5 by default), in units of
            the action where it is not (no default).

    Returns:
        Lower and upper bound, mean and standard deviation, each of the shape of the action.

    Raises:
        ValueError: if bounds are degenerate, or ``init_std`` is missing.

    Examples:
        >>> gaussian_of_bounds(Bounded(0, 4, (1,)), None)
        (tensor([0.]), tensor([4.]), tensor([2.]), tensor([1.]))
    """
    low, high = spec.space.low.clone(), spec.space.high.clone()
    limit = 0.5 * torch.finfo(low.dtype).max  # Unbounded has the largest number as its bound
    bounded = (low > -limit) & (high < limit)
    if bool((~(low < high)).any()):
        raise ValueError(
            "action bounds must satisfy low < high, got "
            f"low={low.flatten().tolist()} and high={high.flatten().tolist()}"
        )
    if init_std is None and not bool(bounded.all()):
        raise ValueError(
            "init_std must be given, in units of the action, for an action without finite bounds, "
            f"got None with low={low.flatten().tolist()} and high={high.flatten().tolist()}"
        )
    half_range = torch.where(bounded, 0.5 * high - 0.5 * low, 1.0)
    middle = torch.where(bounded, 0.5 * high + 0.5 * low, torch.zeros_like(low).clamp(low, high))
    return low, high, middle, half_range * (0.5 if init_std is None else init_std)
