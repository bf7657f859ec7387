"""A belief as weighted particles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

__all__ = ["ParticleBelief", "effective_sample_size", "systematic_resampling"]


def effective_sample_size(log_weights: Tensor) -> Tensor:
    r"""How many equally weighted particles the weighted ones are worth, :math:`1 / \sum_k w_k^2`.

    Between 1 (one particle has all the weight) and :math:`K` (equal weights). Computed in log space.

    Args:
        log_weights: of shape ``(*B, K)``; they need not be normalised. Minus infinity is weight zero.

    Returns:
        ``(*B)``; ``nan`` where all weights are zero or one is ``nan``.

    Raises:
        ValueError: if there is no particle.

    Examples:
        >>> import torch
        >>> effective_sample_size(torch.tensor([[0.0, 0.0, 0.0], [5.0, -torch.inf, -torch.inf]]))
        tensor([3., 1.])
    """
    _check_particles(log_weights, "log_weights")
    return (2 * log_weights.logsumexp(-1) - (2 * log_weights).logsumexp(-1)).exp()


def systematic_resampling(
    log_weights: Tensor,
    num_samples: int | None = None,
    *,
    shared: bool = False,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Indices of particles, drawn in proportion to their weights with one random number a row.

    The cumulative weights are read at :math:`(m + U) / M`, :math:`m = 0, \dots, M - 1`,
    :math:`U \sim \mathcal U[0, 1)`. Particle :math:`k` is drawn :math:`\lfloor M w_k \rfloor` or
    :math:`\lceil M w_k \rceil` times, :math:`M w_k` times on average: unbiased, and of less variance than
    independent draws. A particle of weight zero is never drawn. Nothing is differentiated.

    Args:
        log_weights: of shape ``(*B, K)``; they need not be normalised.
        num_samples: :math:`M`; ``K`` by default.
        shared: one random number for all rows (common random numbers) instead of one for each.
        generator: source of randomness, on the device of the weights; the global one if ``None``.

    Returns:
        Indices in ``[0, K)``, ascending, int64 of shape ``(*B, M)``. Where all weights are zero or one
        is ``nan`` they mean nothing.

    Raises:
        ValueError: if there is no particle or ``num_samples`` is not positive.

    Examples:
        >>> import torch
        >>> systematic_resampling(torch.tensor([0.5, 0.0, 0.25, 0.25]).log())
        tensor([0, 0, 2, 3])
    """
    _check_particles(log_weights, "log_weights")
    if num_samples is not None and num_samples < 1:
        raise ValueError(f"num_samples must be positive, got {num_samples}")
    if not bool(log_weights.logsumexp(-1).isfinite().all()):
        raise ValueError("log_weights must hold some weight in every row, got rows that are all zero or nan")
    return resampling_index(log_weights, num_samples, shared=shared, generator=generator)


def resampling_index(
    log_weights: Tensor,
    num_samples: int | None = None,
    *,
    shared: bool = False,
    generator: torch.Generator | None = None,
) -> Tensor:
    """:func:`systematic_resampling` without its checks, which look at values: for weights that were checked.

    Args:
        log_weights: see :func:`systematic_resampling`.
        num_samples: see :func:`systematic_resampling`.
        shared: see :func:`systematic_resampling`.
        generator: see :func:`systematic_resampling`.

    Returns:
        See :func:`systematic_resampling`.

    Examples:
        >>> import torch
        >>> resampling_index(torch.tensor([0.5, 0.0, 0.25, 0.25]).log())
        tensor([0, 0, 2, 3])
    """
    num = log_weights.shape[-1] if num_samples is None else num_samples
    with torch.no_grad():
        dtype, device = log_weights.dtype, log_weights.device
        cumulative = log_weights.softmax(-1).cumsum(-1)
        cumulative = cumulative / cumulative[..., -1:]
        rows = () if shared else (*log_weights.shape[:-1], 1)
        start = torch.rand(rows, generator=generator, dtype=dtype, device=device)
        # Rounding must not reach 1, beyond the last particle of positive weight.
        below_one = 1 - torch.finfo(dtype).eps / 2
        positions = ((torch.arange(num, dtype=dtype, device=device) + start) / num).clamp_max(below_one)
        positions = positions.expand(*log_weights.shape[:-1], num).contiguous()
        index = torch.searchsorted(cumulative, positions, right=True)
        return index.clamp_max(log_weights.shape[-1] - 1)


class ParticleBelief(Distribution):
    r"""Weighted particles as a distribution, :math:`b(Z) = \sum_k w^{(k)}\, \delta(Z - Z^{(k)})`.

    The belief of section "A Particle-Filter Interpretation of VJEPA": batch ``*B``, event ``(D,)``. It
    has moments, a mode and samples, but no density.

    Args:
        particles: :math:`Z^{(k)}`, of shape ``(*B, K, D)``, ``K`` of at least 1.
        log_weights: :math:`\log w^{(k)}`, of shape ``(*B, K)``, normalised here; equal by default.
        validate_args: whether values are looked at.

    Raises:
        ValueError: if a shape is wrong, there is no particle, or (validated) a particle is not finite,
            a weight is ``nan`` or infinite, or all weights of a row are zero.

    Examples:
        >>> import torch
        >>> belief = ParticleBelief(torch.tensor([[0.0], [4.0]]), torch.tensor([0.75, 0.25]).log())
        >>> belief.mean, belief.variance, belief.effective_sample_size
        (tensor([1.]), tensor([3.]), tensor(1.6000))
        >>> belief.sample((5,)).shape
        torch.Size([5, 1])
    """

    arg_constraints: dict[str, constraints.Constraint] = {}

    def __init__(
        self, particles: Tensor, log_weights: Tensor | None = None, validate_args: bool = True
    ) -> None:
        if particles.ndim < 2 or not particles.shape[-2]:
            raise ValueError(
                f"particles must have shape (*B, K, D) with K of at least 1, got {tuple(particles.shape)}"
            )
        if log_weights is None:
            log_weights = particles.new_zeros(particles.shape[:-1])
        if log_weights.shape != particles.shape[:-1]:
            raise ValueError(
                f"log_weights must have shape {tuple(particles.shape[:-1])} for particles "
                f"{tuple(particles.shape)}, got {tuple(log_weights.shape)}"
            )
        super().__init__(particles.shape[:-2], particles.shape[-1:], validate_args=validate_args)
        if validate_args:  # TorchRL turns the default of torch.distributions off
            _check_values(particles, log_weights)
        self.particles = particles
        self.log_weights = log_weights.log_softmax(-1)

    @property
    def support(self) -> constraints.Constraint:
        """The whole space."""
        return constraints.real_vector

    @property
    def num_particles(self) -> int:
        """Number of particles :math:`K`."""
        return self.particles.shape[-2]

    @property
    def weights(self) -> Tensor:
        """Normalised weights, ``(*B, K)``."""
        return self.log_weights.exp()

    @property
    def mean(self) -> Tensor:
        r""":math:`\sum_k w_k Z^{(k)}`, ``(*B, D)``."""
        return self.expectation(self.particles)

    @property
    def mode(self) -> Tensor:
        """The particle of largest weight, ``(*B, D)``."""
        return _take(self.particles, self.log_weights.argmax(-1, keepdim=True)).squeeze(-2)

    @property
    def variance(self) -> Tensor:
        """Variance of each dimension, ``(*B, D)``."""
        return self.expectation((self.particles - self.mean.unsqueeze(-2)).square())

    @property
    def covariance_matrix(self) -> Tensor:
        r""":math:`\sum_k w_k (Z^{(k)} - \mu)(Z^{(k)} - \mu)^\top`, ``(*B, D, D)``."""
        offset = self.particles - self.mean.unsqueeze(-2)
        return (self.weights.unsqueeze(-1) * offset).mT @ offset

    @property
    def effective_sample_size(self) -> Tensor:
        """See :func:`effective_sample_size`; ``(*B)``."""
        return effective_sample_size(self.log_weights)

    def expectation(self, values: Tensor) -> Tensor:
        r""":math:`\mathbb E[f(Z)] = \sum_k w_k f(Z^{(k)})`.

        Args:
            values: a function of the particles, of shape ``(*B, K, F)``.

        Returns:
            ``(*B, F)``.
        """
        return (self.weights.unsqueeze(-2) @ values).squeeze(-2)

    def entropy(self) -> Tensor:
        r"""Entropy of the weights, :math:`-\sum_k w_k \log w_k`, in nats, from 0 to :math:`\log K`.

        Its exponential is another count of effective particles. (The entropy of a sum of point masses
        has no density to speak of.)

        Returns:
            ``(*B)``.
        """
        return torch.special.entr(self.weights).sum(-1)

    def sample(self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None) -> Tensor:
        """Independent draws from the particles.

        Args:
            sample_shape: leading dimensions.
            generator: source of randomness; the global one if ``None``.

        Returns:
            ``(*sample_shape, *B, D)``, without gradient.
        """
        shape = torch.Size(sample_shape)
        with torch.no_grad():
            weights = self.weights.reshape(-1, self.num_particles)
            if not shape.numel() or not len(weights):
                return self.particles.new_empty((*shape, *self.batch_shape, *self.event_shape))
            index = torch.multinomial(weights, shape.numel(), replacement=True, generator=generator)
            draws = _take(self.particles, index.reshape(*self.batch_shape, -1))
            return draws.movedim(-2, 0).reshape(*shape, *self.batch_shape, *self.event_shape)

    def resample(
        self, num_particles: int | None = None, *, generator: torch.Generator | None = None
    ) -> ParticleBelief:
        """Equally weighted particles of the same belief, by :func:`systematic_resampling`.

        Args:
            num_particles: how many; as many as there are by default.
            generator: source of randomness; the global one if ``None``.

        Returns:
            The new belief.
        """
        index = systematic_resampling(self.log_weights, num_particles, generator=generator)
        return ParticleBelief(_take(self.particles, index), validate_args=False)

    def expand(self, batch_shape: Sequence[int], _instance: Distribution | None = None) -> ParticleBelief:
        """The same belief, broadcast to ``batch_shape``.

        Args:
            batch_shape: the new batch shape.

        Returns:
            The expanded belief.
        """
        num = self.num_particles
        return ParticleBelief(
            self.particles.expand(*batch_shape, num, *self.event_shape),
            self.log_weights.expand(*batch_shape, num),
            validate_args=False,
        )


def _take(particles: Tensor, index: Tensor) -> Tensor:
    """Particles ``(*B, M, D)`` at indices ``(*B, M)``."""
    index = index.unsqueeze(-1)
    return particles.gather(-2, index.expand(*index.shape[:-1], particles.shape[-1]))


def _check_particles(log_weights: Tensor, name: str) -> None:
    if not log_weights.ndim or not log_weights.shape[-1]:
        raise ValueError(
            f"{name} must have shape (*B, K) with K of at least 1, got {tuple(log_weights.shape)}"
        )


def _check_values(particles: Tensor, log_weights: Tensor) -> None:
    if not particles.isfinite().all():
        raise ValueError("particles must be finite, got NaN or infinite entries")
    if log_weights.isnan().any() or (log_weights == math.inf).any():
        raise ValueError("log_weights must be numbers below infinity, got nan or inf")
    if (log_weights == -math.inf).all(-1).any():
        raise ValueError("log_weights must leave every row a positive weight, got a row of zero weights")
