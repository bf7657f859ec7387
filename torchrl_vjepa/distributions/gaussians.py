"""Gaussians over latents: diagonal, full, and diagonal plus low rank."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.distributions import Distribution, Independent, MultivariateNormal, Normal

from torchrl_vjepa.distributions.noise import NoiseDistribution, full_precision
from torchrl_vjepa.stacking import columns

__all__ = ["DiagGaussian", "LowRankGaussian", "diag_gaussian", "full_gaussian", "soft_clamp"]


def soft_clamp(value: Tensor, low: float, high: float) -> Tensor:
    r"""Clamp with a gradient everywhere.

    The identity up to a margin :math:`m` from the bounds (1, or a quarter of a narrow range); beyond it,
    the excess :math:`e` becomes :math:`m e / (m + |e|)`, which approaches the bound. (Softplus would do
    the same at several times the cost.)

    Args:
        value: any tensor.
        low: lower bound, approached and never passed.
        high: upper bound, approached and never passed.

    Returns:
        A tensor of the same shape with values in ``[low, high]``.

    Examples:
        >>> import torch
        >>> soft_clamp(torch.tensor([-1000.0, 1.5, 1000.0]), -10.0, 10.0).round(decimals=2)
        tensor([-10.0000,   1.5000,  10.0000])
    """
    margin = min(1.0, (high - low) / 4)
    middle, half = 0.5 * (low + high), 0.5 * (high - low) - margin
    # Each line is one fused pass; what lies beyond the margin is zero almost everywhere.
    inside = F.hardtanh(value, low + margin, high - margin)
    excess = F.softshrink(value - middle if middle else value, half)
    excess = F.hardtanh(excess, -1e6, 1e6)  # infinity over infinity
    return inside + excess / (1 + excess.abs() / margin)


def diag_gaussian(
    loc: Tensor,
    scale: Tensor | None = None,
    *,
    log_var: Tensor | None = None,
    log_var_range: tuple[float, float] | None = None,
) -> Independent:
    r"""Diagonal Gaussian :math:`\mathcal N(\mu, \mathrm{diag}(\sigma^2))` over the last dimension.

    Arguments are not validated: the check reads values, which stalls a GPU and breaks ``vmap``.

    Args:
        loc: mean, of shape ``(*B, D)``.
        scale: standard deviation, positive, broadcastable to ``(*B, D)``.
        log_var: :math:`\log \sigma^2` instead of ``scale``; what a network gives, and the likelihood then
            needs neither a root nor a logarithm.
        log_var_range: ``log_var`` is softly clamped to it (:func:`soft_clamp`), once it is needed.

    Returns:
        A distribution with batch ``*B`` and event ``(D,)``.

    Raises:
        ValueError: if not exactly one of ``scale`` and ``log_var`` is given.

    Examples:
        >>> import torch
        >>> diag_gaussian(torch.zeros(5, 3), torch.ones(3)).event_shape
        torch.Size([3])
        >>> diag_gaussian(torch.zeros(5, 3), log_var=torch.zeros(3)).variance[0]
        tensor([1., 1., 1.])
    """
    spread = log_var if scale is None else scale
    if spread is None or (scale is not None and log_var is not None):
        raise ValueError(
            f"exactly one of scale and log_var must be given, got {'neither' if spread is None else 'both'}"
        )
    # Under autocast a learned scale keeps its dtype, and torch.normal refuses two.
    if loc.dtype != spread.dtype:
        dtype = torch.promote_types(loc.dtype, spread.dtype)
        loc, spread = loc.to(dtype), spread.to(dtype)
    return DiagGaussian(loc, spread, scale is None, log_var_range)


class DiagGaussian(Independent):
    """``Independent(Normal)`` that computes what is asked for and keeps a shared spread small.

    Made by :func:`diag_gaussian`.

    Args:
        loc: mean, of shape ``(*B, D)``.
        spread: standard deviation or log-variance, broadcastable to ``(*B, D)``.
        is_log_var: which of the two.
        log_var_range: the log-variance is softly clamped to it, once it is needed.

    Examples:
        >>> import torch
        >>> DiagGaussian(torch.zeros(5, 3), torch.ones(3), False).batch_shape
        torch.Size([5])
    """

    def __init__(
        self,
        loc: Tensor,
        spread: Tensor,
        is_log_var: bool,
        log_var_range: tuple[float, float] | None = None,
    ) -> None:
        # Not Independent's constructor: a training step needs no base distribution.
        size = loc.shape[-1]
        batch = loc.shape[:-1]
        if spread.ndim > 1 and spread.shape[:-1] != batch:
            batch = torch.broadcast_shapes(batch, spread.shape[:-1])
            loc = loc.expand(*batch, size)
        if spread.shape[-1:] != (size,):
            spread = spread.expand(*spread.shape[:-1], size)
        self.loc = loc
        self._given = spread
        self._is_log_var, self._log_var_range = is_log_var, log_var_range
        self._bounded: Tensor | None = None
        self._grad_enabled = torch.is_grad_enabled()
        self.reinterpreted_batch_ndims = 1
        Distribution.__init__(self, batch, loc.shape[-1:], validate_args=False)

    @property
    def _spread(self) -> Tensor:
        """Scale or bounded log-variance: a loss that needs the mean alone does not pay for it."""
        if self._log_var_range is None:
            return self._given
        if self._bounded is not None:
            return self._bounded
        # As if it had been computed at once: a reading under no_grad takes no gradients away.
        with torch.set_grad_enabled(self._grad_enabled):
            bounded = soft_clamp(self._given, *self._log_var_range)
        # What inference mode makes can never have gradients.
        if torch.compiler.is_compiling() or not torch.is_inference_mode_enabled():
            self._bounded = bounded
        return bounded

    @property
    def base_dist(self) -> Normal:
        """The normal distributions of the dimensions, broadcast to ``(*B, D)``."""
        loc, scale = torch.broadcast_tensors(self.loc, self.scale)
        return Normal(loc, scale, validate_args=False)

    @property
    def scale(self) -> Tensor:
        """Standard deviation, broadcastable to the mean."""
        return (0.5 * self._spread).exp() if self._is_log_var else self._spread

    @property
    def log_var(self) -> Tensor:
        """Logarithm of the variance, broadcastable to the mean."""
        return self._spread if self._is_log_var else 2 * self._spread.log()

    @property
    def precision(self) -> Tensor:
        """Inverse variance, broadcastable to the mean."""
        return (-self._spread).exp() if self._is_log_var else self._spread.pow(-2)

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
        """Variances, ``(*B, D)``."""
        variance = self._spread.exp() if self._is_log_var else self._spread.square()
        return variance.expand_as(self.loc)

    @property
    def stddev(self) -> Tensor:
        """Standard deviations, ``(*B, D)``."""
        return self.scale.expand_as(self.loc)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density, in nats.

        Args:
            value: of shape ``(*S, *B, D)``.

        Returns:
            ``(*S, *B)``.
        """
        constant = 0.5 * value.shape[-1] * math.log(2 * math.pi)
        shared = self._given.ndim == 1 or (self._given.shape[-2] == 1 and self.loc.ndim > 1)
        # Columns: gradients keep the layout of the latents of a loss (``features_first``).
        squares = columns(value - self.loc).square()
        log_var, precision = columns(self.log_var), columns(self.precision)
        if shared:
            # One constant for all rows.
            quadratic = (squares * precision).sum(-2)
            log_prob = torch.sub(-(constant + 0.5 * log_var.sum(-2)), quadratic, alpha=0.5)
        else:
            log_prob = torch.addcmul(log_var, squares, precision).sum(-2).mul(-0.5).sub(constant)
        return log_prob if value.ndim > 1 or self.loc.ndim > 1 else log_prob.squeeze(-1)

    def rsample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Draws with gradients.

        Args:
            sample_shape: leading dimensions; none by default.

        Returns:
            Latents of shape ``(*sample_shape, *B, D)``.
        """
        shape = (*sample_shape, *self.loc.shape)
        noise = torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device)
        return torch.addcmul(self.loc, self.scale, noise)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Draws without gradients.

        Args:
            sample_shape: leading dimensions; none by default.

        Returns:
            Latents of shape ``(*sample_shape, *B, D)``.
        """
        with torch.no_grad():
            return self.rsample(sample_shape)

    def entropy(self) -> Tensor:
        """Differential entropy, in nats.

        Returns:
            ``(*B)``.
        """
        constant = 0.5 * self.loc.shape[-1] * (1 + math.log(2 * math.pi))
        return (constant + 0.5 * self.log_var.sum(-1)).expand(self.batch_shape)

    def expand(self, batch_shape: Sequence[int], _instance: Distribution | None = None) -> DiagGaussian:
        """The same Gaussian, broadcast to ``batch_shape``.

        Args:
            batch_shape: the new batch shape.

        Returns:
            The expanded distribution.
        """
        loc = self.loc.expand(*batch_shape, *self.event_shape)
        return DiagGaussian(loc, self._given, self._is_log_var, self._log_var_range)


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
