"""Gaussians over latents: diagonal, full, and diagonal plus low rank."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, MultivariateNormal, Normal

from torchrl_vjepa.distributions.noise import NoiseDistribution, full_precision

__all__ = ["LowRankGaussian", "diag_gaussian", "full_gaussian"]


def diag_gaussian(loc: Tensor, scale: Tensor) -> Independent:
    r"""Diagonal Gaussian :math:`\mathcal N(\mu, \mathrm{diag}(\sigma^2))` over the last dimension.

    Arguments are not validated: the check reads values, which stalls a GPU and breaks ``vmap``.

    Args:
        loc: mean, of shape ``(*B, D)``.
        scale: standard deviation, positive, broadcastable to ``(*B, D)``.

    Returns:
        A distribution with batch ``*B`` and event ``(D,)``.

    Examples:
        >>> import torch
        >>> diag_gaussian(torch.zeros(5, 3), torch.ones(3)).event_shape
        torch.Size([3])
    """
    # Under autocast a learned scale keeps its dtype, and torch.normal refuses two.
    dtype = torch.promote_types(loc.dtype, scale.dtype)
    return _DiagGaussian(loc.to(dtype), scale.to(dtype))


class _DiagGaussian(Independent):
    """``Independent(Normal)`` that keeps a scale shared by the batch small: one logarithm, not B."""

    def __init__(self, loc: Tensor, scale: Tensor) -> None:
        self._scale = scale.expand(*scale.shape[:-1], loc.shape[-1])
        loc, scale = torch.broadcast_tensors(loc, scale)
        super().__init__(Normal(loc, scale, validate_args=False), 1, validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        normed = (value - self.base_dist.loc) / self._scale
        constant = self._scale.log().sum(-1) + 0.5 * value.shape[-1] * math.log(2 * math.pi)
        return -0.5 * normed.square().sum(-1) - constant

    def expand(self, batch_shape: Sequence[int], _instance: Distribution | None = None) -> _DiagGaussian:
        return _DiagGaussian(self.base_dist.loc.expand(*batch_shape, *self.event_shape), self._scale)


def full_gaussian(loc: Tensor, scale_tril: Tensor) -> MultivariateNormal:
    r"""Gaussian with a full covariance, :math:`\mathcal N(\mu, L L^\top)`.

    torch's ``MultivariateNormal`` without validation, whose draws and densities also work under
    ``torch.vmap`` and in half precision.

    Args:
        loc: mean :math:`\mu`, of shape ``(*B, D)``.
        scale_tril: :math:`L`, lower triangular with a positive diagonal, broadcastable to
            ``(*B, D, D)``.

    Returns:
        A distribution with batch ``*B`` and event ``(D,)``.

    Examples:
        >>> import torch
        >>> p = full_gaussian(torch.zeros(5, 2), torch.tensor([[1.0, 0.0], [1.0, 1.0]]))
        >>> p.batch_shape, p.covariance_matrix[0]
        (torch.Size([5]), tensor([[1., 1.],
                [1., 2.]]))
    """
    dtype = torch.promote_types(loc.dtype, scale_tril.dtype)
    return _FullGaussian(loc.to(dtype), scale_tril=scale_tril.to(dtype), validate_args=False)


class _FullGaussian(MultivariateNormal):
    """The constructor is torch's own, because its ``expand`` asks for that."""

    def rsample(self, sample_shape: Sequence[int] | None = None) -> Tensor:
        # torch's own normal() refuses under vmap.
        shape = (*(sample_shape or ()), *self.batch_shape, *self.event_shape)
        noise = torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device)
        return self.loc + (self._unbroadcasted_scale_tril @ noise.unsqueeze(-1)).squeeze(-1)

    def log_prob(self, value: Tensor) -> Tensor:
        loc, scale_tril = full_precision(self.loc, self._unbroadcasted_scale_tril)
        if loc is self.loc:
            return super().log_prob(value)
        p = MultivariateNormal(loc, scale_tril=scale_tril, validate_args=False)
        return p.log_prob(value.to(loc.dtype)).to(self.loc.dtype)


class LowRankGaussian(NoiseDistribution):
    r"""Gaussian with covariance :math:`W W^\top + \mathrm{diag}(\sigma^2)`.

    What torch's ``LowRankMultivariateNormal`` is, without factorising in the constructor: a planner that
    draws or reads the mean pays :math:`O(D R)`; a density costs :math:`O(D R^2)`, by the Woodbury
    identity and the matrix determinant lemma.

    Args:
        loc: mean, of shape ``(*B, D)``.
        factor: :math:`W`, of shape ``(*B, D, R)``.
        scale: :math:`\sigma`, positive, of shape ``(*B, D)``.

    Raises:
        ValueError: if the shapes do not fit.

    Examples:
        >>> import torch
        >>> p = LowRankGaussian(torch.zeros(2), torch.tensor([[1.0], [2.0]]), torch.ones(2))
        >>> p.covariance_matrix
        tensor([[2., 2.],
                [2., 5.]])
    """

    def __init__(self, loc: Tensor, factor: Tensor, scale: Tensor) -> None:
        if factor.ndim < 2 or factor.shape[-2] != loc.shape[-1] or scale.shape[-1] != loc.shape[-1]:
            raise ValueError(
                "loc, factor and scale must have shapes (*B, D), (*B, D, R) and (*B, D), got "
                f"{tuple(loc.shape)}, {tuple(factor.shape)} and {tuple(scale.shape)}"
            )
        dtype = torch.promote_types(torch.promote_types(loc.dtype, factor.dtype), scale.dtype)
        loc, factor, scale = loc.to(dtype), factor.to(dtype), scale.to(dtype)
        batch = torch.broadcast_shapes(loc.shape[:-1], factor.shape[:-2], scale.shape[:-1])
        self.loc = loc.expand(*batch, -1)
        self.factor = factor.expand(*batch, -1, -1)
        self.scale = scale.expand(*batch, -1)
        super().__init__(batch, loc.shape[-1], loc.shape[-1] + factor.shape[-1], loc)

    @property
    def mean(self) -> Tensor:
        """The location, ``(*B, D)``."""
        return self.loc

    @property
    def mode(self) -> Tensor:
        """The location, ``(*B, D)``."""
        return self.loc

    @property
    def variance(self) -> Tensor:
        """The diagonal of the covariance, ``(*B, D)``."""
        return self.factor.square().sum(-1) + self.scale.square()

    @property
    def covariance_matrix(self) -> Tensor:
        """The covariance, ``(*B, D, D)``."""
        return self.factor @ self.factor.mT + torch.diag_embed(self.scale.square())

    def from_noise(self, noise: Tensor) -> Tensor:
        """Draws: the location, the factor times ``R`` numbers, the scale times ``D`` numbers.

        Args:
            noise: of shape ``(*S, *B, D + R)``.

        Returns:
            Latents of shape ``(*S, *B, D)``.
        """
        own, shared = noise.split([self.event_shape[0], self.factor.shape[-1]], dim=-1)
        return self.loc + self.scale * own + (self.factor @ shared.unsqueeze(-1)).squeeze(-1)

    def whitened(self) -> tuple[Tensor, Tensor]:
        r"""What densities and divergences need of :math:`\Sigma`, in full precision.

        Returns:
            :math:`V = \sigma^{-1} W` and the Cholesky factor of :math:`I + V^\top V`, whose determinant
            is that of the covariance divided by :math:`\prod_d \sigma_d^2`.
        """
        factor, scale = full_precision(self.factor, self.scale)
        whitened = factor / scale.unsqueeze(-1)
        eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
        # It cannot fail but by NaN, which stays NaN: the error of cholesky() would stop every other model
        # that trains in the same batch, and makes a GPU wait.
        return whitened, torch.linalg.cholesky_ex(eye + whitened.mT @ whitened).L

    def log_det(self) -> Tensor:
        """Logarithm of the covariance's determinant.

        Returns:
            ``(*B)``.
        """
        _, capacitance = self.whitened()
        return 2 * (_log_diagonal(capacitance) + self.scale.to(capacitance.dtype).log().sum(-1))

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density, in nats.

        Args:
            value: of shape ``(*S, *B, D)``.

        Returns:
            ``(*S, *B)``.
        """
        whitened, capacitance = self.whitened()
        normed = ((value - self.loc) / self.scale).to(whitened.dtype)
        shared = (whitened.mT @ normed.unsqueeze(-1)).expand(*normed.shape[:-1], -1, 1)
        explained = torch.linalg.solve_triangular(capacitance, shared, upper=False).square().sum((-1, -2))
        log_scale = self.scale.to(whitened.dtype).log().sum(-1) + _log_diagonal(capacitance)
        constant = log_scale + 0.5 * self.event_shape[0] * math.log(2 * math.pi)
        return (-0.5 * (normed.square().sum(-1) - explained) - constant).to(self.loc.dtype)

    def entropy(self) -> Tensor:
        """Differential entropy, in nats.

        Returns:
            ``(*B)``.
        """
        constant = self.event_shape[0] * (1 + math.log(2 * math.pi))
        return (0.5 * (self.log_det() + constant)).to(self.loc.dtype)

    def expand(self, batch_shape: Sequence[int], _instance: Distribution | None = None) -> LowRankGaussian:
        """The same Gaussian, broadcast to ``batch_shape``.

        Args:
            batch_shape: the new batch shape.

        Returns:
            The expanded distribution.
        """
        return LowRankGaussian(
            self.loc.expand(*batch_shape, -1),
            self.factor.expand(*batch_shape, -1, -1),
            self.scale.expand(*batch_shape, -1),
        )


def _log_diagonal(triangular: Tensor) -> Tensor:
    return triangular.diagonal(dim1=-2, dim2=-1).log().sum(-1)
