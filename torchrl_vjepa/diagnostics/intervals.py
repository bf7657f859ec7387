"""Intervals and quantiles of beliefs: how often the truth falls where it was said to fall."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from torchrl_vjepa.diagnostics.beliefs import Belief, checked_target, draws, gaussian_marginals, masked_mean
from torchrl_vjepa.distributions import Delta

__all__ = [
    "LEVELS",
    "CredibleInterval",
    "PITHistogram",
    "ReliabilityCurve",
    "check_level",
    "coverage",
    "credible_interval",
    "pit_histogram",
    "probability_integral_transform",
    "reliability_curve",
    "reliability_of",
    "squared_mahalanobis",
]

#: The levels of a reliability plot: 5 %, 10 %, ..., 95 %.
LEVELS = tuple(level / 20 for level in range(1, 20))


class CredibleInterval(NamedTuple):
    """Lower and upper ends, one pair for each dimension of each latent.

    Attributes:
        lower: shape ``(*B, D)``.
        upper: shape ``(*B, D)``.

    Examples:
        >>> import torch
        >>> CredibleInterval(torch.zeros(2), torch.ones(2)).contains(torch.tensor([0.5, 2.0]))
        tensor([ True, False])
    """

    lower: Tensor
    upper: Tensor

    def contains(self, value: Tensor) -> Tensor:
        """Where a value lies inside, the ends included.

        Args:
            value: shape ``(*B, D)``.

        Returns:
            Boolean, shape ``(*B, D)``.
        """
        return (self.lower <= value) & (value <= self.upper)


def check_level(level: float) -> float:
    """Refuse a level that is no probability of an interval.

    Args:
        level: the probability.

    Returns:
        The level as a float.

    Raises:
        ValueError: if it is not inside of (0, 1).

    Examples:
        >>> check_level(0.9)
        0.9
    """
    if not 0 < float(level) < 1:
        raise ValueError(f"level must be in (0, 1), for instance 0.9 for 90 %, got {level}")
    return float(level)


def credible_interval(
    p: Belief,
    level: float = 0.9,
    *,
    num_samples: int = 1000,
    generator: torch.Generator | None = None,
) -> CredibleInterval:
    r"""Central credible interval of every dimension of a belief.

    .. math::
        \big[ F_d^{-1}(\tfrac{1 - \ell}{2}),\ F_d^{-1}(\tfrac{1 + \ell}{2}) \big]

    with :math:`F_d` the marginal distribution function and :math:`\ell` the level. Gaussians have it in
    closed form. Otherwise it is read off :math:`M` samples, by interpolation of their order statistics
    at :math:`k = q (M + 1)`, which covers with probability :math:`\ell` on average whatever the
    distribution (not only for large :math:`M`). A point mass has an interval of length zero.

    Args:
        p: belief with batch ``*B`` and event ``(D,)``, or samples of it, ``(M, *B, D)``.
        level: :math:`\ell`, in (0, 1).
        num_samples: :math:`M`, for distributions that are not Gaussian.
        generator: source of randomness for the samples.

    Returns:
        The interval, two tensors of shape ``(*B, D)``.

    Raises:
        ValueError: if ``level`` is not in (0, 1), there are too few samples for it, or one is NaN.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import diag_gaussian
        >>> p = diag_gaussian(torch.zeros(2), torch.tensor([1.0, 2.0]))
        >>> credible_interval(p, 0.9).upper
        tensor([1.6449, 3.2897])
    """
    level = check_level(level)
    if isinstance(p, Delta):
        return CredibleInterval(p.mean, p.mean)
    marginals = gaussian_marginals(p)
    if marginals is not None:
        mean, std = marginals
        half = std * (math.sqrt(2) * _erfinv(level))
        return CredibleInterval(mean - half, mean + half)
    samples = draws(p, num_samples, generator).sort(0).values
    count = len(samples)
    # Rounding, or a level of 0.9 with the 19 samples that it needs would be refused.
    position = round((1 - level) / 2 * (count + 1), 9) - 1
    if position < 0:
        need = math.ceil(round(2 / (1 - level), 9)) - 1
        raise ValueError(
            f"num_samples must be at least {need} for an interval of level {level:g}, got {count}"
        )
    below = int(position)
    lower = torch.lerp(samples[below], samples[below + 1], position - below)
    upper = torch.lerp(samples[count - 1 - below], samples[count - 2 - below], position - below)
    return CredibleInterval(lower, upper)


def coverage(
    p: Belief,
    target: Tensor,
    level: float = 0.9,
    *,
    mask: Tensor | None = None,
    joint: bool = False,
    num_samples: int = 1000,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Fraction of the targets that fall into the credible region of the given level.

    A calibrated belief covers the fraction :math:`\ell`; an overconfident one less.

    Args:
        p: belief with batch ``*B`` and event ``(D,)``, or samples of it, ``(M, *B, D)``.
        target: what came true, shape ``(*B, D)``.
        level: :math:`\ell`, in (0, 1).
        mask: boolean, ``(*B)`` or ``(*B, 1)``; ``False`` marks a target that does not count.
        joint: ``False``: the intervals of :func:`credible_interval`, counted over all dimensions;
            ``True``: the region of highest density of the whole vector, an ellipsoid for a Gaussian.
        num_samples: samples, for distributions that are not Gaussian.
        generator: source of randomness for them.

    Returns:
        A scalar in [0, 1]; NaN if the mask leaves nothing.

    Raises:
        TypeError: if the target is not floating point or the mask not boolean.
        ValueError: if the level or a shape does not fit, a value that counts is NaN, or samples alone
            are given with ``joint=True``.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import diag_gaussian
        >>> generator = torch.Generator().manual_seed(0)
        >>> target = torch.randn(10_000, 2, generator=generator)
        >>> for scale in (1.0, 0.5):
        ...     p = diag_gaussian(torch.zeros(10_000, 2), torch.full((2,), scale))
        ...     print(round(coverage(p, target, 0.9).item(), 2))
        0.9
        0.59
    """
    level = check_level(level)
    target, mask = checked_target(p, target, mask)
    if joint:
        ranks = _joint_rank(p, target, num_samples, generator)
        return masked_mean((ranks <= level).to(target.dtype), mask)
    inside = credible_interval(p, level, num_samples=num_samples, generator=generator).contains(target)
    return masked_mean(inside.to(target.dtype).mean(-1), mask)


def probability_integral_transform(
    p: Belief,
    target: Tensor,
    *,
    mask: Tensor | None = None,
    joint: bool = False,
    num_samples: int = 1000,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Where in the belief the target fell: :math:`u_d = F_d(z_d)`, uniform on [0, 1] for the true belief.

    Of :math:`M` samples it is the randomised rank :math:`(k + v (1 + t)) / (M + 1)`, with :math:`k`
    samples below the target, :math:`t` equal to it and :math:`v` uniform: exactly uniform when target
    and samples come from one distribution.

    Args:
        p: belief with batch ``*B`` and event ``(D,)``, or samples of it, ``(M, *B, D)``.
        target: what came true, shape ``(*B, D)``.
        mask: boolean, ``(*B)`` or ``(*B, 1)``; ``False`` gives NaN.
        joint: the probability of the region of higher density than the target's instead, one number for
            the whole vector: :math:`F_{\chi^2_D}` of the squared Mahalanobis distance for a Gaussian.
            Close to 1 is a target in the tails.
        num_samples: :math:`M`, for distributions that are not Gaussian.
        generator: source of randomness for samples and ranks.

    Returns:
        Values in [0, 1], of shape ``(*B, D)``, or ``(*B)`` for ``joint=True``.

    Raises:
        TypeError: if the target is not floating point or the mask not boolean.
        ValueError: if a shape does not fit, a value that counts is NaN, or samples alone are given with
            ``joint=True``.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import diag_gaussian
        >>> p = diag_gaussian(torch.zeros(3), torch.ones(3))
        >>> probability_integral_transform(p, torch.tensor([0.0, 1.0, -1.0]))
        tensor([0.5000, 0.8413, 0.1587])
    """
    target, mask = checked_target(p, target, mask)
    if joint:
        values = _joint_rank(p, target, num_samples, generator)
        return values if mask is None else torch.where(mask, values, torch.nan)
    marginals = gaussian_marginals(p)
    if marginals is not None:
        mean, std = marginals
        values = torch.special.ndtr((target - mean) / std)
    elif isinstance(p, Delta):
        values = (p.mean < target).to(target.dtype)
        values = torch.where(p.mean == target, _uniform(target, generator), values)
    else:
        samples = draws(p, num_samples, generator)
        below, ties = (samples < target).sum(0), (samples == target).sum(0)
        values = (below + _uniform(target, generator) * (1 + ties)) / (len(samples) + 1)
    return values if mask is None else torch.where(mask.unsqueeze(-1), values, torch.nan)


class PITHistogram(NamedTuple):
    """A density on [0, 1] by bins of equal width.

    Attributes:
        density: shape ``(num_bins,)``; 1 everywhere for uniform values.
        edges: shape ``(num_bins + 1,)``.

    Examples:
        >>> import torch
        >>> pit_histogram(torch.tensor([0.1, 0.2, 0.9]), 2).edges
        tensor([0.0000, 0.5000, 1.0000])
    """

    density: Tensor
    edges: Tensor


def pit_histogram(values: Tensor, num_bins: int = 10) -> PITHistogram:
    r"""PITHistogram of probability integral transforms: flat if calibrated.

    A valley says that the belief is too narrow, a hill that it is too wide, a slope that it is biased.

    Args:
        values: of :func:`probability_integral_transform`, any shape; NaN (masked) values do not count.
        num_bins: number of bins, at least 1.

    Returns:
        The density over [0, 1].

    Raises:
        ValueError: if ``num_bins`` is not positive, no value counts, or a value is outside of [0, 1].

    Examples:
        >>> import torch
        >>> pit_histogram(torch.tensor([0.1, 0.2, 0.9, float("nan")]), 2).density
        tensor([1.3333, 0.6667])
    """
    if num_bins < 1:
        raise ValueError(f"num_bins must be at least 1, got {num_bins}")
    values = values[~values.isnan()]
    if not values.numel():
        raise ValueError("values must hold at least one that is not NaN, got none")
    if values.min() < 0 or values.max() > 1:
        raise ValueError(
            f"values must be in [0, 1], got values from {values.min():.4g} to {values.max():.4g}; they are "
            "those of probability_integral_transform"
        )
    index = (values * num_bins).long().clamp_max(num_bins - 1)
    counts = torch.bincount(index.reshape(-1), minlength=num_bins).to(values.dtype)
    edges = torch.linspace(0, 1, num_bins + 1, dtype=values.dtype, device=values.device)
    return PITHistogram(counts * (num_bins / values.numel()), edges)


class ReliabilityCurve(NamedTuple):
    """Coverage against level: on the diagonal if calibrated, under it if overconfident.

    Attributes:
        levels: shape ``(L,)``.
        coverage: shape ``(L,)``.

    Examples:
        >>> import torch
        >>> ReliabilityCurve(torch.tensor([0.5, 0.9]), torch.tensor([0.4, 0.8])).error
        tensor(0.1000)
    """

    levels: Tensor
    coverage: Tensor

    @property
    def error(self) -> Tensor:
        """Mean absolute distance to the diagonal, a scalar."""
        return (self.coverage - self.levels).abs().mean()


def reliability_curve(
    p: Belief,
    target: Tensor,
    levels: Sequence[float] | Tensor = LEVELS,
    *,
    mask: Tensor | None = None,
    joint: bool = False,
    num_samples: int = 1000,
    generator: torch.Generator | None = None,
) -> ReliabilityCurve:
    r"""Coverage at many levels: what a reliability plot shows.

    By the probability integral transform :math:`u`: the central interval of level :math:`\ell` holds the
    targets with :math:`|2 u - 1| \le \ell`, the region of highest density those with a joint
    :math:`u \le \ell`.

    Args:
        p: belief with batch ``*B`` and event ``(D,)``, or samples of it, ``(M, *B, D)``.
        target: what came true, shape ``(*B, D)``.
        levels: each in (0, 1).
        mask: boolean, ``(*B)`` or ``(*B, 1)``; ``False`` marks a target that does not count.
        joint: regions of the whole vector instead of intervals of its dimensions.
        num_samples: samples, for distributions that are not Gaussian.
        generator: source of randomness for them.

    Returns:
        Levels and coverage, both of shape ``(L,)``.

    Raises:
        TypeError: if the target is not floating point or the mask not boolean.
        ValueError: as :func:`coverage`.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import diag_gaussian
        >>> target = torch.randn(10_000, 1, generator=torch.Generator().manual_seed(0))
        >>> p = diag_gaussian(torch.zeros(10_000, 1), torch.ones(1))
        >>> reliability_curve(p, target, [0.5, 0.9]).coverage.round(decimals=2)
        tensor([0.5000, 0.9000])
    """
    values = probability_integral_transform(
        p, target, mask=mask, joint=joint, num_samples=num_samples, generator=generator
    )
    checked = torch.as_tensor(
        [check_level(float(v)) for v in levels], dtype=values.dtype, device=values.device
    )
    return ReliabilityCurve(checked, reliability_of(values, checked, joint=joint))


def reliability_of(values: Tensor, levels: Tensor, *, joint: bool = False) -> Tensor:
    """Coverage at many levels from probability integral transforms.

    Args:
        values: of :func:`probability_integral_transform`, any shape; NaN (masked) values do not count.
        levels: shape ``(L,)``.
        joint: whether the values are joint ones.

    Returns:
        Shape ``(L,)``; NaN if no value counts.

    Examples:
        >>> import torch
        >>> reliability_of(torch.tensor([0.4, 0.5, 0.9]), torch.tensor([0.5]))
        tensor([0.6667])
    """
    values = values[~values.isnan()]
    distance = values if joint else (2 * values - 1).abs()
    return torch.stack([(distance <= level).to(values.dtype).mean() for level in levels])


def _joint_rank(p: Belief, target: Tensor, num_samples: int, generator: torch.Generator | None) -> Tensor:
    """Probability of the region of higher density than the target's, ``(*B)``."""
    if not isinstance(p, Distribution):
        raise ValueError("p must be a distribution for joint=True: samples alone have no density")
    if isinstance(p, Delta):
        return (p.mean != target).any(-1).to(target.dtype)
    if gaussian_marginals(p) is not None:
        half_dim = torch.as_tensor(target.shape[-1] / 2, dtype=target.dtype, device=target.device)
        return torch.special.gammainc(half_dim, squared_mahalanobis(p, target) / 2)
    own, log_prob = p.log_prob(draws(p, num_samples, generator)), p.log_prob(target)
    above, ties = (own > log_prob).sum(0), (own == log_prob).sum(0)
    return (above + _uniform(log_prob, generator) * (1 + ties)) / (len(own) + 1)


def squared_mahalanobis(p: Distribution, target: Tensor) -> Tensor:
    """Squared distance of a target from the mean of a Gaussian, in units of its covariance.

    Args:
        p: Gaussian with batch ``*B`` and event ``(D,)``.
        target: shape ``(*B, D)``.

    Returns:
        Shape ``(*B)``.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import diag_gaussian
        >>> squared_mahalanobis(diag_gaussian(torch.zeros(2), torch.ones(2)), torch.tensor([3.0, 4.0]))
        tensor(25.)
    """
    # log N(z) = log N(mean) - m^2 / 2, whatever the form of the covariance.
    return 2 * (p.log_prob(p.mean) - p.log_prob(target)).clamp_min(0)


def _uniform(like: Tensor, generator: torch.Generator | None) -> Tensor:
    return torch.rand(like.shape, dtype=like.dtype, device=like.device, generator=generator)


def _erfinv(level: float) -> float:
    return torch.special.erfinv(torch.tensor(level, dtype=torch.float64)).item()
