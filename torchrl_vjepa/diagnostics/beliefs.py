"""What a measure of calibration reads of a belief: Gaussian marginals where it has them, else samples."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import (
    Distribution,
    Independent,
    LowRankMultivariateNormal,
    MultivariateNormal,
    Normal,
)

from torchrl_vjepa.distributions import Delta, LowRankGaussian, sample

__all__ = ["Belief", "checked_target", "draws", "gaussian_marginals", "masked_mean"]

#: A predictive distribution with batch ``*B`` and event ``(D,)``, or samples ``(M, *B, D)`` of one.
Belief = Distribution | Tensor


def gaussian_marginals(p: Belief) -> tuple[Tensor, Tensor] | None:
    """Mean and standard deviation of every dimension, if ``p`` is Gaussian.

    Args:
        p: distribution with batch ``*B`` and event ``(D,)``, or samples.

    Returns:
        Two tensors of shape ``(*B, D)``, or ``None`` if ``p`` is not a Gaussian of a known class.

    Examples:
        >>> import torch
        >>> p = MultivariateNormal(torch.zeros(2), covariance_matrix=4 * torch.eye(2))
        >>> gaussian_marginals(p)
        (tensor([0., 0.]), tensor([2., 2.]))
        >>> gaussian_marginals(torch.zeros(10, 2)) is None
        True
    """
    known = (MultivariateNormal, LowRankMultivariateNormal, LowRankGaussian)
    if isinstance(p, Tensor):
        return None
    if isinstance(p, known) or (isinstance(p, Independent) and isinstance(p.base_dist, Normal)):
        return p.mean, p.variance.sqrt()
    return None


def draws(p: Belief, num_samples: int, generator: torch.Generator | None = None) -> Tensor:
    """Samples of a belief.

    Args:
        p: distribution with batch ``*B`` and event ``(D,)``, or samples ``(M, *B, D)``, which are
            returned as they are.
        num_samples: how many to draw of a distribution, at least 2.
        generator: source of randomness.

    Returns:
        Shape ``(M, *B, D)``.

    Raises:
        ValueError: if there are fewer than 2 samples, or one is NaN.

    Examples:
        >>> import torch
        >>> draws(torch.distributions.MultivariateNormal(torch.zeros(3), torch.eye(3)), 5).shape
        torch.Size([5, 3])
    """
    if isinstance(p, Tensor):
        samples = p
    elif num_samples < 2:
        raise ValueError(f"num_samples must be at least 2, got {num_samples}")
    else:
        samples = sample(p, (num_samples,), generator=generator)
    if len(samples) < 2:
        raise ValueError(f"p must hold at least 2 samples in its first dimension, got {len(samples)}")
    if samples.isnan().any():
        raise ValueError("p must not be NaN, but its samples are; look at the model or its input")
    return samples


def checked_target(p: Belief, target: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
    """Refuse targets that do not fit the belief or are not finite where they count.

    Args:
        p: the belief.
        target: what came true, shape ``(*B, D)``.
        mask: boolean, ``(*B)`` or ``(*B, 1)``; ``False`` marks a target that does not count and may hold
            anything.

    Returns:
        The target with zeros where it does not count, and the mask of shape ``(*B)``.

    Raises:
        TypeError: if the target is not floating point or the mask not boolean.
        ValueError: if shapes do not fit, or where it counts a value of the target or of the belief's mean
            is NaN or infinite, or a Gaussian has no width.

    Examples:
        >>> import torch
        >>> target = torch.tensor([[1.0], [float("nan")]])
        >>> checked_target(torch.zeros(5, 2, 1), target, torch.tensor([True, False]))[0].squeeze(-1)
        tensor([1., 0.])
    """
    if isinstance(p, Tensor):
        shape = tuple(p.shape[1:])
        described = f"samples of shape (M, *B, D) = {tuple(p.shape)}"
    else:
        shape = (*p.batch_shape, *p.event_shape)
        described = f"batch shape {tuple(p.batch_shape)} and event shape {tuple(p.event_shape)}"
    if (isinstance(p, Tensor) and p.ndim < 2) or (isinstance(p, Distribution) and len(p.event_shape) != 1):
        raise ValueError(f"p must have event shape (D,), got {described}")
    if not target.is_floating_point():
        raise TypeError(f"target must be floating point, got {target.dtype}; cast it first")
    if tuple(target.shape) != shape:
        raise ValueError(
            f"target must have shape {shape} to fit p with {described}, got {tuple(target.shape)}"
        )
    if mask is not None:
        if mask.dtype != torch.bool:
            raise TypeError(f"mask must be boolean, got {mask.dtype}")
        if tuple(mask.shape) not in (shape[:-1], (*shape[:-1], 1)):
            raise ValueError(
                f"mask must have shape {shape[:-1]} or {(*shape[:-1], 1)}, got {tuple(mask.shape)}"
            )
        mask = mask.reshape(shape[:-1])
        target = torch.where(mask.unsqueeze(-1), target, 0)
    if not target.isfinite().all():
        raise ValueError(
            f"target must be finite where it counts, got NaN or infinite values in "
            f"{int((~target.isfinite()).sum())} of {target.numel()} entries; drop them or mask them out"
        )
    # Samples are checked where they are drawn.
    mean, std = (p.mean, None) if isinstance(p, Delta) else gaussian_marginals(p) or (None, None)
    if mean is not None:
        good = mean.isfinite() if std is None else mean.isfinite() & std.isfinite() & (std > 0)
        if not (good if mask is None else good | ~mask.unsqueeze(-1)).all():
            raise ValueError(
                "p must have a finite mean and a positive, finite standard deviation where the target counts"
            )
    return target, mask


def masked_mean(value: Tensor, mask: Tensor | None) -> Tensor:
    """Mean over everything that counts.

    Args:
        value: shape ``(*B)``.
        mask: boolean, ``(*B)``, or ``None``.

    Returns:
        A scalar; NaN where nothing counts.

    Examples:
        >>> import torch
        >>> masked_mean(torch.tensor([1.0, 2.0, 9.0]), torch.tensor([True, True, False]))
        tensor(1.5000)
    """
    if mask is None:
        return value.mean()
    return torch.where(mask, value, 0).sum() / mask.sum()
