"""What ``torch.distributions`` lacks for latent world models.

A predictive model returns a :class:`torch.distributions.Distribution` with batch shape ``*B`` and
event shape ``(D,)``; the functions here read it in the ways the paper names (mean, mode, sample).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.distributions import (
    Distribution,
    Independent,
    MultivariateNormal,
    Normal,
    constraints,
    register_kl,
)
from torchrl.modules import Delta as _TorchRLDelta

from torchrl_vjepa.stacking import columns

__all__ = ["Delta", "diag_gaussian", "point_estimate", "product_of_experts", "sample", "soft_clamp"]


class Delta(_TorchRLDelta):
    r"""Point mass on a latent, :math:`\delta(Z - \mu)`: the predictive model of a deterministic JEPA.

    TorchRL's ``Delta`` with what a latent transition needs besides: a zero ``variance`` and
    ``stddev``, and gradients through ``rsample`` only.

    Args:
        loc: the point, of shape ``(*B, D)``.

    Examples:
        >>> import torch
        >>> p = Delta(torch.tensor([[1.0, 2.0]]))
        >>> p.batch_shape, p.event_shape
        (torch.Size([1]), torch.Size([2]))
        >>> p.variance
        tensor([[0., 0.]])
    """

    has_rsample = True

    def __init__(self, loc: Tensor) -> None:
        super().__init__(loc, batch_shape=loc.shape[:-1], event_shape=loc.shape[-1:])

    @property
    def support(self) -> constraints.Constraint:
        """The whole space: any vector can be the point."""
        return constraints.real_vector

    @property
    def variance(self) -> Tensor:
        """Zeros of shape ``(*B, D)``."""
        return torch.zeros_like(self.param)

    def sample(self, sample_shape: Sequence[int] | None = None) -> Tensor:
        """The point, repeated, without gradient.

        Args:
            sample_shape: leading dimensions; none by default.

        Returns:
            A view of shape ``(*sample_shape, *B, D)``.
        """
        # TorchRL expands under no_grad, and a view made there still requires a gradient.
        return self.rsample(sample_shape).detach()

    def expand(self, batch_shape: Sequence[int], _instance: Distribution | None = None) -> Delta:
        """The same point, broadcast to ``batch_shape``.

        Args:
            batch_shape: the new batch shape.

        Returns:
            The expanded distribution.
        """
        return type(self)(self.param.expand(*batch_shape, *self.event_shape))


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
    return _DiagGaussian(loc, spread, scale is None, log_var_range)


class _DiagGaussian(Independent):
    """``Independent(Normal)`` that computes what is asked for and keeps a shared spread small."""

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
        self.reinterpreted_batch_ndims = 1
        Distribution.__init__(self, batch, loc.shape[-1:], validate_args=False)

    @property
    def _spread(self) -> Tensor:
        """Scale or bounded log-variance: a loss that needs the mean alone does not pay for it."""
        if self._log_var_range is not None:
            self._given, self._log_var_range = soft_clamp(self._given, *self._log_var_range), None
        return self._given

    @property
    def base_dist(self) -> Normal:
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
        return self.loc

    @property
    def mode(self) -> Tensor:
        return self.loc

    @property
    def variance(self) -> Tensor:
        variance = self._spread.exp() if self._is_log_var else self._spread.square()
        return variance.expand_as(self.loc)

    @property
    def stddev(self) -> Tensor:
        return self.scale.expand_as(self.loc)

    def log_prob(self, value: Tensor) -> Tensor:
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
        shape = (*sample_shape, *self.loc.shape)
        noise = torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device)
        return torch.addcmul(self.loc, self.scale, noise)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        with torch.no_grad():
            return self.rsample(sample_shape)

    def entropy(self) -> Tensor:
        constant = 0.5 * self.loc.shape[-1] * (1 + math.log(2 * math.pi))
        return (constant + 0.5 * self.log_var.sum(-1)).expand(self.batch_shape)

    def expand(self, batch_shape: Sequence[int], _instance: Distribution | None = None) -> _DiagGaussian:
        loc = self.loc.expand(*batch_shape, *self.event_shape)
        return _DiagGaussian(loc, self._given, self._is_log_var, self._log_var_range)


@register_kl(_DiagGaussian, _DiagGaussian)
def _kl_diagonal(p: _DiagGaussian, q: _DiagGaussian) -> Tensor:
    log_ratio = p.log_var - q.log_var
    mahalanobis = (p.loc - q.loc).square() * q.precision
    return 0.5 * (log_ratio.exp() - 1 - log_ratio + mahalanobis).sum(-1)


def sample(
    p: Distribution,
    sample_shape: Sequence[int] = (),
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Draw :math:`Z^{(m)} \sim p` (``eq:vjepa_predictive_model``) from a generator of one's own.

    ``torch.distributions`` can only read the global random state; with a ``generator`` this function
    leaves it untouched.

    Args:
        p: the distribution, batch ``*B`` and event ``(D,)``.
        sample_shape: leading dimensions of independent samples.
        generator: source of randomness, on the device of ``p``; the global one if ``None``.

    Returns:
        Samples of shape ``(*sample_shape, *B, D)``, without gradient.

    Raises:
        ValueError: if ``generator`` is on another device than ``p``.

    Examples:
        >>> import torch
        >>> p = diag_gaussian(torch.zeros(2), torch.ones(2))
        >>> a = sample(p, (3,), generator=torch.Generator().manual_seed(0))
        >>> b = sample(p, (3,), generator=torch.Generator().manual_seed(0))
        >>> a.shape, torch.equal(a, b)
        (torch.Size([3, 2]), True)
    """
    shape = torch.Size(sample_shape)
    if generator is None or isinstance(p, Delta):
        return p.sample(shape)
    with torch.no_grad():
        if isinstance(p, Independent) and isinstance(p.base_dist, Normal):
            loc, scale = p.base_dist.loc, p.base_dist.scale
            _check_device(generator, loc)
            noise = torch.randn(shape + loc.shape, generator=generator, device=loc.device, dtype=loc.dtype)
            return loc + scale * noise
        device = generator.device
        seed = int(torch.randint(2**62, (), generator=generator, device=device))
        # torch.manual_seed would seed every device, also those that are not restored.
        if device.type == "cpu":
            with torch.random.fork_rng(devices=[]):
                torch.default_generator.manual_seed(seed)
                draw = p.sample(shape)
        else:
            module = torch.get_device_module(device)
            with (
                torch.random.fork_rng(devices=[device], device_type=device.type),
                module.device(device),
            ):
                module.manual_seed(seed)
                draw = p.sample(shape)
        _check_device(generator, draw)
        return draw


def _check_device(generator: torch.Generator, value: Tensor) -> None:
    if generator.device.type != value.device.type:
        raise ValueError(
            f"generator must be on the device of the distribution, {value.device}, got "
            f"{generator.device}; make it with torch.Generator({value.device.type!r})"
        )


def point_estimate(
    p: Distribution,
    how: Literal["mean", "mode", "sample"] = "mean",
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""One representative latent :math:`\hat Z_T` of a predictive distribution.

    The mean :math:`\mathbb E_p[Z_T]`, the mode (MAP) :math:`\arg\max p(Z_T)`, or one draw, as in the
    paper's section "Prediction and Uncertainty Propagation".

    Args:
        p: the distribution, batch ``*B`` and event ``(D,)``.
        how: which point.
        generator: source of randomness for ``"sample"``.

    Returns:
        A latent of shape ``(*B, D)``.

    Raises:
        ValueError: if ``how`` is none of the three.

    Examples:
        >>> import torch
        >>> point_estimate(diag_gaussian(torch.ones(2), torch.ones(2)), "mode")
        tensor([1., 1.])
    """
    if how == "mean":
        return p.mean
    if how == "mode":
        return p.mode
    if how == "sample":
        return sample(p, generator=generator)
    raise ValueError(f"how must be 'mean', 'mode' or 'sample', got {how!r}")


def product_of_experts(*experts: Distribution) -> Distribution:
    r"""Normalised product of Gaussian densities (``eq:bjepa_posterior``), in precision space.

    .. math::
        \Lambda = \sum_i \Lambda_i, \qquad \mu = \Lambda^{-1} \sum_i \Lambda_i \mu_i

    Diagonal experts alone give a diagonal product; with a full one among them it is full. For two of
    them it is the Kalman update of one by the other as a measurement.

    Args:
        *experts: diagonal (:func:`diag_gaussian`) or full (``MultivariateNormal``) Gaussians with the
            same event ``(D,)`` and batch shapes that broadcast.

    Returns:
        The product, with the broadcast batch shape.

    Raises:
        ValueError: if there is no expert, or event shapes differ or are not ``(D,)``.
        TypeError: if an expert is not Gaussian.

    Examples:
        >>> import torch
        >>> likelihood = diag_gaussian(torch.zeros(5, 2), torch.ones(2))
        >>> prior = diag_gaussian(torch.ones(2), torch.ones(2))
        >>> product_of_experts(likelihood, prior).mean[0], product_of_experts(likelihood, prior).variance[0]
        (tensor([0.5000, 0.5000]), tensor([0.5000, 0.5000]))
    """
    if not experts:
        raise ValueError("experts must be at least one Gaussian, got none")
    shapes = [tuple(p.event_shape) for p in experts]
    if len(set(shapes)) != 1 or len(shapes[0]) != 1:
        raise ValueError(f"experts must have the same event shape (D,), got {shapes}")
    diagonal = [p for p in experts if isinstance(p, Independent) and isinstance(p.base_dist, Normal)]
    full = [p for p in experts if isinstance(p, MultivariateNormal)]
    if len(diagonal) + len(full) != len(experts):
        names = [type(p).__name__ for p in experts]
        raise TypeError(f"experts must be diagonal or multivariate Gaussians, got {names}")
    precision: Tensor | float = 0.0
    weighted: Tensor | float = 0.0
    for p in diagonal:
        weight = p.base_dist.scale.pow(-2)
        precision, weighted = precision + weight, weighted + weight * p.base_dist.loc
    if not full:
        precision, weighted = torch.as_tensor(precision), torch.as_tensor(weighted)
        return diag_gaussian(weighted / precision, precision.rsqrt())
    matrix = torch.diag_embed(precision) if isinstance(precision, Tensor) else 0.0
    for gaussian in full:
        matrix = matrix + gaussian.precision_matrix
        weighted = weighted + (gaussian.precision_matrix @ gaussian.loc.unsqueeze(-1)).squeeze(-1)
    matrix, weighted = torch.as_tensor(matrix), torch.as_tensor(weighted)
    factor = torch.linalg.cholesky(matrix)
    loc = torch.cholesky_solve(weighted.unsqueeze(-1), factor).squeeze(-1)
    return MultivariateNormal(loc, precision_matrix=matrix, validate_args=False)
