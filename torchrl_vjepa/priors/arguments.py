"""What the constructors of priors check: vectors, scales and affine maps."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

__all__ = ["affine_map", "as_constant", "finite_vector", "std_vector"]


def as_constant(value: Tensor | float) -> Tensor:
    """A tensor of the default dtype, as parameters have it; ``.double()`` of the module changes both.

    Args:
        value: a number, or a tensor on any device.

    Returns:
        A copy without a graph.

    Examples:
        >>> as_constant(2).dtype
        torch.float32
    """
    return torch.as_tensor(value).detach().clone().to(torch.get_default_dtype())


def finite_vector(name: str, value: Tensor | float, size: int | None = None) -> Tensor:
    """A vector of finite numbers, in the default dtype.

    Args:
        name: what errors call it.
        value: a number, which is repeated, or ``(size,)``.
        size: how many; ``None``: as many as there are.

    Returns:
        Of shape ``(size,)``; a number without a ``size`` has shape ``()``.

    Raises:
        ValueError: if the shape is wrong, or an entry is not finite.

    Examples:
        >>> finite_vector("mean", 1.0, 2)
        tensor([1., 1.])
    """
    vector = as_constant(value)
    if vector.ndim == 0 and size is not None:
        vector = vector.expand(size).clone()
    fits = vector.ndim < 2 if size is None else tuple(vector.shape) == (size,)
    if not fits or not vector.isfinite().all():
        shape = "(D,)" if size is None else (size,)
        raise ValueError(f"{name} must be a finite number or a tensor of shape {shape}, got {value!r}")
    return vector


def std_vector(name: str, value: Tensor | float, size: int | None = None) -> Tensor:
    """Standard deviations whose variances and precisions are finite numbers of the default dtype.

    Args:
        name: what errors call it.
        value: a number, which is repeated, or ``(size,)``.
        size: how many; ``None``: as many as there are.

    Returns:
        Of shape ``(size,)``; a number without a ``size`` has shape ``()``.

    Raises:
        ValueError: if the shape is wrong, an entry is not positive, or so small (or large) that its
            precision overflows (or vanishes).

    Examples:
        >>> std_vector("std", 1e-30)
        Traceback (most recent call last):
        ...
        ValueError: std must be in [1.1e-19, 9.2e+18], else its precision overflows in torch.float32, got ...
    """
    std = finite_vector(name, value, size)
    if not (std > 0).all():
        raise ValueError(f"{name} must be positive, got {std.tolist()}")
    # Of variance and precision both must be normal numbers.
    low, high = torch.finfo(std.dtype).tiny ** 0.5, torch.finfo(std.dtype).tiny ** -0.5
    if not ((std >= low) & (std <= high)).all():
        raise ValueError(
            f"{name} must be in [{low:.1e}, {high:.1e}], else its precision overflows in {std.dtype}, "
            f"got {std.tolist()}"
        )
    return std


def affine_map(matrix: Any, offset: Tensor | float | None = None) -> tuple[Tensor, Tensor]:
    r"""The map :math:`y = W z + b` of a probe.

    Args:
        matrix: :math:`W`, of shape ``(P, D)``; or an object with ``weight`` and ``bias``, such as a
            :class:`~torchrl_vjepa.diagnostics.LinearProbe`; or a pair ``(W, b)``.
        offset: :math:`b`, ``(P,)`` or a number; zero by default. Not with an object or a pair.

    Returns:
        :math:`W` and :math:`b`, in the default dtype.

    Raises:
        ValueError: if shapes do not fit, a value is not finite, or the offset is given twice.

    Examples:
        >>> import torch
        >>> [x.shape for x in affine_map(torch.nn.Linear(3, 2))]
        [torch.Size([2, 3]), torch.Size([2])]
    """
    given: Any = None
    if hasattr(matrix, "weight") and hasattr(matrix, "bias"):
        matrix, given = matrix.weight, 0.0 if matrix.bias is None else matrix.bias
    elif isinstance(matrix, tuple) and len(matrix) == 2:
        matrix, given = matrix
    if given is not None and offset is not None:
        raise ValueError("offset must be None for a probe that has its own, got both")
    offset = given if offset is None else offset
    if not isinstance(matrix, Tensor) or matrix.ndim != 2 or not matrix.isfinite().all():
        got = tuple(matrix.shape) if isinstance(matrix, Tensor) else type(matrix).__name__
        raise ValueError(f"matrix must be a finite tensor of shape (P, D), or a probe, got {got}")
    return as_constant(matrix), finite_vector("offset", 0.0 if offset is None else offset, len(matrix))
