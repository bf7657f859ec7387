"""Temperature of a belief: the same distribution, wider or narrower around its mean."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.distributions import (
    AffineTransform,
    Distribution,
    Independent,
    LowRankMultivariateNormal,
    MultivariateNormal,
    Normal,
    TransformedDistribution,
)

from torchrl_vjepa.distributions import (
    CouplingFlow,
    Delta,
    Ensemble,
    LowRankGaussian,
    Mixture,
    diag_gaussian,
    full_gaussian,
)

__all__ = ["temper"]


def temper(p: Distribution, temperature: Tensor | float) -> Distribution:
    r"""The distribution of :math:`\mu + \tau (Z - \mu)`, with :math:`Z \sim p` of mean :math:`\mu`.

    Every deviation from the mean is multiplied by the temperature :math:`\tau`; the mean stays. A
    Gaussian stays one, with :math:`\tau` times its standard deviation, and is the tempered density
    :math:`\propto p^{1/\tau^2}`. Mixtures, ensembles and flows stay what they are too, and a point mass
    stays as it is; a distribution that the library does not know becomes an affine transform of itself.

    Args:
        p: distribution with batch ``*B`` and event ``(D,)``; its mean must be known.
        temperature: :math:`\tau`, positive: a number, or a scalar tensor.

    Returns:
        Distribution with the same shapes.

    Raises:
        ValueError: if the event is not ``(D,)``, or the temperature is no scalar or a number that is not
            positive (the value of a tensor is not looked at).
        TypeError: if ``p`` has no mean.

    Examples:
        >>> import torch
        >>> p = temper(diag_gaussian(torch.ones(2), torch.ones(2)), 3.0)
        >>> p.mean, p.stddev
        (tensor([1., 1.]), tensor([3., 3.]))
    """
    if len(p.event_shape) != 1:
        raise ValueError(f"p must have event shape (D,), got {tuple(p.event_shape)}")
    if isinstance(temperature, Tensor) and temperature.ndim:
        raise ValueError(f"temperature must be a scalar, got shape {tuple(temperature.shape)}")
    if not isinstance(temperature, Tensor) and not 0 < temperature < math.inf:
        raise ValueError(f"temperature must be positive and finite, got {temperature}")
    if isinstance(p, Delta):
        return p
    try:
        mean = p.mean
    except NotImplementedError as error:
        raise TypeError(
            f"p must have a mean, around which it is scaled, but {type(p).__name__} does not know its own"
        ) from error
    return _scale_around(p, mean, temperature)


def _scale_around(p: Distribution, center: Tensor, factor: Tensor | float) -> Distribution:
    if isinstance(p, Independent) and isinstance(p.base_dist, Normal):
        loc, scale = p.base_dist.loc, p.base_dist.scale
        return diag_gaussian(center + factor * (loc - center), factor * scale)
    if isinstance(p, (MultivariateNormal, LowRankMultivariateNormal, LowRankGaussian, CouplingFlow)):
        loc = center + factor * (p.loc - center)
        if isinstance(p, MultivariateNormal):
            return full_gaussian(loc, factor * p.scale_tril)
        if isinstance(p, LowRankMultivariateNormal):
            return LowRankGaussian(loc, factor * p.cov_factor, factor * p.cov_diag.sqrt())
        if isinstance(p, LowRankGaussian):
            return LowRankGaussian(loc, factor * p.factor, factor * p.scale)
        return CouplingFlow(loc, factor * p.scale, p.elementwise, p.couplings, num_points=p.num_points)
    if isinstance(p, Mixture):
        components = _scale_around(p.components, center.unsqueeze(-2), factor)
        return Ensemble(components) if isinstance(p, Ensemble) else Mixture(p.log_weights, components)
    return _Tempered(p, center, factor)


class _Tempered(TransformedDistribution):
    """An affine image that knows its mean and variance."""

    def __init__(self, base: Distribution, center: Tensor, factor: Tensor | float) -> None:
        self._center, self._factor = center, factor
        # Of a scalar tensor AffineTransform would count the logarithm once, not D times.
        scale = torch.as_tensor(factor, dtype=center.dtype, device=center.device).expand_as(center)
        affine = AffineTransform(center - scale * center, scale, event_dim=1)
        super().__init__(base, [affine], validate_args=False)

    def _image(self, value: Tensor) -> Tensor:
        return self._center + self._factor * (value - self._center)

    @property
    def mean(self) -> Tensor:
        """The image of the mean, ``(*B, D)``."""
        return self._image(self.base_dist.mean)

    @property
    def mode(self) -> Tensor:
        """The image of the mode, ``(*B, D)``: an affine map moves every density alike."""
        return self._image(self.base_dist.mode)

    @property
    def variance(self) -> Tensor:
        """The scaled variance, ``(*B, D)``."""
        return self._factor * self._factor * self.base_dist.variance

    def expand(self, batch_shape: Sequence[int], _instance: Distribution | None = None) -> _Tempered:
        base = self.base_dist.expand(torch.Size(batch_shape))
        return _Tempered(base, self._center.expand(*batch_shape, *self.event_shape), self._factor)
