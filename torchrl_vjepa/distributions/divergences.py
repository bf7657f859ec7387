"""Kullback-Leibler divergences and entropies: closed forms, and estimators with their standard error."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import (
    Distribution,
    Independent,
    LowRankMultivariateNormal,
    MultivariateNormal,
    Normal,
)
from torch.distributions import kl_divergence as _torch_kl

from torchrl_vjepa.distributions.delta import Delta
from torchrl_vjepa.distributions.densities import Density, GaussianFactor
from torchrl_vjepa.distributions.gaussians import DiagGaussian, LowRankGaussian
from torchrl_vjepa.distributions.mixtures import Mixture
from torchrl_vjepa.distributions.noise import NoiseDistribution, full_precision
from torchrl_vjepa.distributions.sampling import from_noise, noise_dim
from torchrl_vjepa.stacking import columns

__all__ = ["Estimate", "entropy_bounds", "kl_divergence", "monte_carlo_entropy", "monte_carlo_kl"]


class Estimate(NamedTuple):
    """A Monte Carlo estimate.

    Attributes:
        value: the estimate, ``(*B)``, in nats; differentiable.
        standard_error: of the value, ``(*B)``, without gradient.

    Examples:
        >>> import torch
        >>> Estimate(torch.tensor(1.0), torch.tensor(0.1)).standard_error
        tensor(0.1000)
    """

    value: Tensor
    standard_error: Tensor


def kl_divergence(
    p: Distribution,
    q: Distribution | GaussianFactor | Density,
    *,
    num_samples: int | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    r""":math:`\mathrm{KL}(p \,\|\, q) = \mathbb E_p[\log p(Z) - \log q(Z)]`.

    In closed form for every pair of Gaussians, diagonal, full or of low rank, and for the pairs that
    torch knows; where there is none (mixtures, flows) and ``num_samples`` says so, by
    :func:`monte_carlo_kl`.

    Of a ``q`` that is not normalised it is the divergence up to the constant :math:`\log \int q`, which
    moves no gradient of ``p``: :math:`-H(p) - \mathbb E_p[\log q(Z)]`. For a Gaussian ``p`` and a
    :class:`GaussianFactor` that has a closed form too, and of a :class:`Density` the energy alone is
    sampled.

    .. math::
        \mathrm{KL} = \tfrac12 \big[\mathrm{tr}(\Sigma_q^{-1} \Sigma_p)
        + (\mu_q - \mu_p)^\top \Sigma_q^{-1} (\mu_q - \mu_p) - D
        + \log\det\Sigma_q - \log\det\Sigma_p\big]

    Args:
        p: batch ``*B`` and event ``(D,)``.
        q: the same event; its batch broadcasts with ``*B``. Normalised or not.
        num_samples: draws of the estimator where there is no closed form; ``None`` refuses instead.
        generator: source of randomness of the estimator.

    Returns:
        ``(*B)``, in nats, with gradients.

    Raises:
        ValueError: if the events differ.
        TypeError: if there is no closed form and ``num_samples`` is ``None``, or one has no density.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian, full_gaussian
        >>> p = diag_gaussian(torch.ones(5, 2), torch.ones(2))
        >>> kl_divergence(p, full_gaussian(torch.zeros(2), torch.eye(2))).shape
        torch.Size([5])
    """
    _check_pair(p, q)
    if isinstance(q, Density) and _is_gaussian(p):
        rest = (
            -p.entropy()
            if q.base is None
            else kl_divergence(p, q.base, num_samples=num_samples, generator=generator)
        )
        if q.energy is None:
            return rest
        if num_samples is not None:
            return rest + _expectation(p, q.checked_energy, num_samples, generator).value
    elif isinstance(q, GaussianFactor) and _is_gaussian(p):
        root = _root(p)
        trace = (root * (q.precision.to(root.dtype) @ root)).sum((-1, -2))
        return 0.5 * trace.to(p.mean.dtype) - q.log_prob(p.mean) - p.entropy()
    elif isinstance(q, Distribution):
        if _is_gaussian(p) and _is_gaussian(q):
            return _gaussian_kl(p, q)
        try:
            return _torch_kl(p, q)
        except NotImplementedError:
            pass
    if num_samples is None:
        raise TypeError(
            f"p and q must be a pair with a closed form, got {type(p).__name__} and {type(q).__name__}; "
            "give num_samples to estimate it, or use monte_carlo_kl for the standard error as well"
        )
    return monte_carlo_kl(p, q, num_samples, generator=generator).value


def monte_carlo_kl(
    p: Distribution,
    q: Distribution | GaussianFactor | Density,
    num_samples: int = 64,
    *,
    generator: torch.Generator | None = None,
) -> Estimate:
    r"""Unbiased estimate of :math:`\mathrm{KL}(p \,\|\, q)` and its standard error.

    (Of a ``q`` that is not normalised, up to the logarithm of its integral.)

    :math:`\frac1M \sum_m \log p(Z^{(m)}) - \log q(Z^{(m)})`. Draws of a mixture are stratified, each
    component has :math:`M` of its own: less variance, and gradients of the weights are exact sums.

    Args:
        p: batch ``*B`` and event ``(D,)``.
        q: the same event; its batch broadcasts with ``*B``.
        num_samples: :math:`M`, at least 2.
        generator: source of randomness; the global one if ``None``.

    Returns:
        Value and standard error, ``(*B)``. The value has the gradients of reparameterised draws where
        ``p`` has them.

    Raises:
        ValueError: if ``num_samples`` is below 2 or the events differ.
        TypeError: if one has no density, or a generator is given for a ``p`` that is no transform of
            normal noise.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import Mixture, diag_gaussian
        >>> p = Mixture(torch.zeros(2), diag_gaussian(torch.zeros(2, 1), torch.ones(1)))
        >>> monte_carlo_kl(p, diag_gaussian(torch.zeros(1), torch.ones(1))).value.abs() < 1e-6
        tensor(True)
    """
    _check_pair(p, q)
    return _expectation(p, lambda z: p.log_prob(z) - q.log_prob(z), num_samples, generator)


def monte_carlo_entropy(
    p: Distribution, num_samples: int = 64, *, generator: torch.Generator | None = None
) -> Estimate:
    r"""Unbiased estimate of the differential entropy :math:`-\mathbb E_p[\log p(Z)]`.

    Args:
        p: batch ``*B`` and event ``(D,)``.
        num_samples: draws, per component of a mixture; at least 2.
        generator: source of randomness; the global one if ``None``.

    Returns:
        Value and standard error, ``(*B)``, in nats.

    Raises:
        ValueError: if ``num_samples`` is below 2.
        TypeError: as for :func:`monte_carlo_kl`.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> value, error = monte_carlo_entropy(diag_gaussian(torch.zeros(1), torch.ones(1)), 1000)
        >>> (value - 1.4189).abs() < 5 * error
        tensor(True)
    """
    _check_density(p, "p")
    return _expectation(p, lambda z: -p.log_prob(z), num_samples, generator)


def entropy_bounds(p: Mixture) -> tuple[Tensor, Tensor]:
    r"""Lower and upper bound of a Gaussian mixture's entropy (Kolchinsky and Tracey, 2017).

    .. math::
        \sum_k \pi_k H(p_k) - \sum_k \pi_k \log \sum_j \pi_j e^{-d(p_k, p_j)}

    with the Bhattacharyya distance for the lower and the Kullback-Leibler divergence for the upper
    bound. Both are exact where components coincide, and where they are far apart.

    Args:
        p: mixture of diagonal Gaussians, batch ``*B``.

    Returns:
        The bounds, ``(*B)`` each, in nats.

    Raises:
        TypeError: if ``p`` is no mixture of diagonal Gaussians.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import Mixture, diag_gaussian
        >>> far = Mixture(torch.zeros(2), diag_gaussian(torch.tensor([[-99.0], [99.0]]), torch.ones(1)))
        >>> [round(float(bound), 3) for bound in entropy_bounds(far)]  # 1.419 + log 2
        [2.112, 2.112]
    """
    if not (isinstance(p, Mixture) and _is_diagonal(p.components)):
        raise TypeError(f"p must be a mixture of diagonal Gaussians, got {type(p).__name__}")
    loc, scale = p.components.mean, p.components.stddev
    # For every pair of components (k, j): (*B, K, K, D).
    squared = (loc.unsqueeze(-2) - loc.unsqueeze(-3)).square()
    first, second = scale.square().unsqueeze(-2), scale.square().unsqueeze(-3)
    total, ratio = first + second, first / second
    bhattacharyya = 0.25 * squared / total + 0.5 * (total / 2).log() - 0.25 * (first * second).log()
    kl = 0.5 * (ratio + squared / second - 1 - ratio.log())
    own = p.components.entropy()
    bounds = []
    for distance in (bhattacharyya.sum(-1), kl.sum(-1)):
        overlap = (p.log_weights.unsqueeze(-2) - distance).logsumexp(-1)
        bounds.append((p.weights * (own - overlap)).sum(-1))
    return bounds[0], bounds[1]


def _expectation(
    p: Distribution,
    function: Callable[[Tensor], Tensor],
    num_samples: int,
    generator: torch.Generator | None,
) -> Estimate:
    """Mean of a function of draws ``(*S, *B, D) -> (*S, *B)``."""
    if num_samples < 2:
        raise ValueError(f"num_samples must be at least 2, got {num_samples}")
    if isinstance(p, Mixture):
        # Every component has draws of its own: (M, *B, K, D), with K moved in front of the batch.
        draws = _draw(p.components, num_samples, generator).movedim(-2, 1)
        weights = p.weights.movedim(-1, 0)
        values = (weights * function(draws)).sum(1)
    else:
        values = function(_draw(p, num_samples, generator))
    error = values.detach().std(0) / num_samples**0.5
    return Estimate(values.mean(0), error)


def _draw(p: Distribution, num_samples: int, generator: torch.Generator | None) -> Tensor:
    size = noise_dim(p)
    if size is not None:
        like: Any = p if isinstance(p, NoiseDistribution) else p.mean
        shape = (num_samples, *p.batch_shape, size)
        return from_noise(p, torch.randn(shape, generator=generator, dtype=like.dtype, device=like.device))
    if generator is not None:
        raise TypeError(
            f"generator must be None for a {type(p).__name__}, which is no known transform of normal noise"
        )
    return p.rsample((num_samples,)) if p.has_rsample else p.sample((num_samples,))


def _gaussian_kl(p: Distribution, q: Distribution) -> Tensor:
    if isinstance(p, DiagGaussian) and isinstance(q, DiagGaussian):
        return _diagonal_kl(p, q)
    dtype = torch.promote_types(p.mean.dtype, q.mean.dtype)
    (shift,) = full_precision(p.mean - q.mean)
    quadratic = _inverse_norm(q, shift.unsqueeze(-1))
    if _is_diagonal(q):
        (variance, scale) = full_precision(p.variance, q.stddev)
        trace = (variance / scale.square()).sum(-1)
    else:
        trace = _inverse_norm(q, _root(p))
    log_dets = _log_det(q) - _log_det(p)
    return (0.5 * (trace + quadratic - p.event_shape[0] + log_dets)).to(dtype)


def _diagonal_kl(p: DiagGaussian, q: DiagGaussian) -> Tensor:
    """From the log-variances: what the heads give, without a root or a logarithm."""
    deviation, log_var = columns(p.loc - q.loc), columns(p.log_var)
    second_moment = torch.addcmul(log_var.exp(), deviation, deviation)
    terms = torch.addcmul(-log_var, second_moment, columns(q.precision))
    constant = columns(q.log_var).sum(-2) - p.event_shape[0]
    kl = 0.5 * (terms.sum(-2) + constant)
    return kl if p.loc.ndim > 1 or q.loc.ndim > 1 else kl.squeeze(-1)


def _root(p: Distribution) -> Tensor:
    """A matrix ``(*B, D, n)`` whose square is the covariance."""
    if _is_diagonal(p):
        return torch.diag_embed(full_precision(p.stddev)[0])
    if isinstance(p, MultivariateNormal):
        return full_precision(p._unbroadcasted_scale_tril)[0]
    factor, scale = full_precision(_low_rank(p).factor, _low_rank(p).scale)
    return torch.cat([factor, torch.diag_embed(scale).expand(*factor.shape[:-1], -1)], dim=-1)


def _inverse_norm(q: Distribution, columns: Tensor) -> Tensor:
    r"""Sum over columns ``(*B, D, n)`` of :math:`x^\top \Sigma_q^{-1} x`."""
    if _is_diagonal(q):
        return (columns / full_precision(q.stddev)[0].unsqueeze(-1)).square().sum((-1, -2))
    if isinstance(q, MultivariateNormal):
        # One inverse for all columns: a prior without batch dimensions meets many predictions.
        (factor,) = full_precision(q._unbroadcasted_scale_tril)
        eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
        inverse = torch.linalg.solve_triangular(factor, eye, upper=False)
        return (inverse @ columns).square().sum((-1, -2))
    low_rank = _low_rank(q)
    whitened, capacitance = low_rank.whitened()
    columns = columns / full_precision(low_rank.scale)[0].unsqueeze(-1)
    eye = torch.eye(capacitance.shape[-1], dtype=capacitance.dtype, device=capacitance.device)
    inverse = torch.linalg.solve_triangular(capacitance, eye, upper=False)
    explained = (inverse @ (whitened.mT @ columns)).square().sum((-1, -2))
    return columns.square().sum((-1, -2)) - explained


def _log_det(p: Distribution) -> Tensor:
    if _is_diagonal(p):
        return 2 * full_precision(p.stddev)[0].log().sum(-1)
    if isinstance(p, MultivariateNormal):
        return 2 * full_precision(p._unbroadcasted_scale_tril)[0].diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return _low_rank(p).log_det()


def _low_rank(p: Any) -> LowRankGaussian:
    """What is neither diagonal nor full: of this package's class, or torch's."""
    if isinstance(p, LowRankGaussian):
        return p
    return LowRankGaussian(p.loc, p._unbroadcasted_cov_factor, p._unbroadcasted_cov_diag.sqrt())


def _is_diagonal(p: Distribution) -> bool:
    return isinstance(p, Independent) and isinstance(p.base_dist, Normal)


def _is_gaussian(p: Distribution) -> bool:
    return _is_diagonal(p) or isinstance(p, (MultivariateNormal, LowRankMultivariateNormal, LowRankGaussian))


def _check_pair(p: Distribution, q: Distribution | GaussianFactor | Density) -> None:
    _check_density(p, "p")
    _check_density(q, "q")
    if isinstance(q, Density):
        return
    if p.event_shape != q.event_shape:
        raise ValueError(
            f"p and q must have the same event shape, got {tuple(p.event_shape)} and {tuple(q.event_shape)}"
        )


def _check_density(p: Distribution | GaussianFactor | Density, name: str) -> None:
    if isinstance(p, Delta):
        raise TypeError(f"{name} must have a density, got a point mass (Delta)")
