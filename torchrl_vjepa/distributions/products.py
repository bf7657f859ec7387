"""Product of experts."""

from __future__ import annotations

import functools

import torch
from torch import Tensor
from torch.distributions import (
    Distribution,
    Independent,
    LowRankMultivariateNormal,
    MultivariateNormal,
    Normal,
)

from torchrl_vjepa.distributions.densities import GaussianFactor
from torchrl_vjepa.distributions.gaussians import DiagGaussian, LowRankGaussian, diag_gaussian, full_gaussian
from torchrl_vjepa.distributions.mixtures import Mixture
from torchrl_vjepa.distributions.moments import moments
from torchrl_vjepa.distributions.noise import full_precision

__all__ = ["has_closed_form", "product_of_experts"]

Expert = Distribution | GaussianFactor


def product_of_experts(*experts: Distribution | GaussianFactor) -> Distribution:
    r"""Normalised product of densities (``eq:bjepa_posterior``), in precision space.

    .. math::
        \Lambda = \sum_i \Lambda_i, \qquad \mu = \Lambda^{-1} \sum_i \Lambda_i \mu_i

    Diagonal experts alone give a diagonal product; with a full one or a :class:`GaussianFactor` among
    them it is full. For two of them it is the Kalman update of one by the other as a measurement. A
    mixture of Gaussians among the experts gives a mixture: every component is multiplied by the others,
    and its weight by :math:`\int p_k(Z) \prod_i p_i(Z)\, dZ`, how well it agrees with them. One expert
    alone is returned as it is, a factor normalised.

    Experts that contradict each other still have a product, between them and sharper than each. The
    diagonal one is computed relative to the sharpest expert, so it is finite for any positive scales; a
    full one is refused where the fused precision is not finite and positive definite.

    Args:
        *experts: Gaussians, diagonal, full, of low rank or factors that may be flat in some directions,
            and at most one :class:`Mixture` of Gaussians, with the same event ``(D,)`` and batch shapes
            that broadcast.

    Returns:
        The product, with the broadcast batch shape.

    Raises:
        ValueError: if there is no expert, event shapes differ or are not ``(D,)``, or the fused
            precision is not finite and positive definite.
        TypeError: if an expert is neither, or there are two mixtures.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> likelihood = diag_gaussian(torch.zeros(5, 2), torch.ones(2))
        >>> prior = diag_gaussian(torch.ones(2), torch.ones(2))
        >>> product_of_experts(likelihood, prior).mean[0], product_of_experts(likelihood, prior).variance[0]
        (tensor([0.5000, 0.5000]), tensor([0.5000, 0.5000]))
        >>> first_is_two = GaussianFactor(torch.diag(torch.tensor([1.0, 0.0])), torch.tensor([2.0, 0.0]))
        >>> product_of_experts(likelihood, first_is_two).mean[0].round(decimals=3)
        tensor([1., 0.])
    """
    if not experts:
        raise ValueError("experts must be at least one Gaussian, got none")
    shapes = [tuple(p.event_shape) for p in experts]
    if len(set(shapes)) != 1 or len(shapes[0]) != 1:
        raise ValueError(f"experts must have the same event shape (D,), got {shapes}")
    mixtures = [p for p in experts if isinstance(p, Mixture)]
    if len(mixtures) > 1 or not all(isinstance(p, Mixture) or _is_gaussian(p) for p in experts):
        names = [type(p).__name__ for p in experts]
        raise TypeError(
            f"experts must be diagonal or multivariate Gaussians, got {names}; one Mixture of them may be"
        )
    if len(experts) == 1 and isinstance(experts[0], Distribution):
        return experts[0]
    if mixtures:
        return _product_of_mixture(mixtures[0], [p for p in experts if p is not mixtures[0]])
    if all(_is_diagonal(p) for p in experts):
        return _diagonal_product([_loc_scale(p) for p in experts if isinstance(p, Distribution)])
    forms = [_information_form(p) for p in experts]
    precision, information = full_precision(
        functools.reduce(torch.add, [form[0] for form in forms]),
        functools.reduce(torch.add, [form[1] for form in forms]),
    )
    scale_tril = _scale_of(precision)
    loc = (scale_tril @ (scale_tril.mT @ information.unsqueeze(-1))).squeeze(-1)
    return full_gaussian(loc, scale_tril)


def has_closed_form(*experts: object) -> bool:
    """Whether :func:`product_of_experts` knows the product: Gaussians and at most one mixture of them.

    Args:
        *experts: anything.

    Returns:
        The answer.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import Delta, diag_gaussian
        >>> normal = diag_gaussian(torch.zeros(2), torch.ones(2))
        >>> has_closed_form(normal, normal), has_closed_form(normal, Delta(torch.zeros(2)))
        (True, False)
    """
    mixtures = [p for p in experts if isinstance(p, Mixture)]
    if len(mixtures) > 1 or not all(_is_gaussian(p.components) for p in mixtures):
        return False
    return all(isinstance(p, Mixture) or _is_gaussian(p) for p in experts)


def _is_diagonal(p: object) -> bool:
    return isinstance(p, Independent) and isinstance(p.base_dist, Normal)


def _is_gaussian(p: object) -> bool:
    kinds = (MultivariateNormal, LowRankGaussian, LowRankMultivariateNormal, GaussianFactor)
    return isinstance(p, kinds) or _is_diagonal(p)


def _loc_scale(p: Distribution) -> tuple[Tensor, Tensor]:
    return (p.loc, p.scale) if isinstance(p, DiagGaussian) else (p.mean, p.stddev)


def _diagonal_product(experts: list[tuple[Tensor, Tensor]]) -> Distribution:
    # In units of the sharpest expert: no precision overflows. The unit cancels, so it needs no gradient.
    unit = functools.reduce(torch.minimum, [scale for _, scale in experts]).detach()
    weights = [(unit / scale).square() for _, scale in experts]
    total = functools.reduce(torch.add, weights)
    weighted = functools.reduce(torch.add, [w * loc for w, (loc, _) in zip(weights, experts, strict=True)])
    return diag_gaussian(weighted / total, unit * total.rsqrt())


def _information_form(p: Expert) -> tuple[Tensor, Tensor]:
    """Precision ``(*B, D, D)`` and precision times mean ``(*B, D)``."""
    if isinstance(p, GaussianFactor):
        return p.precision, p.information
    if _is_diagonal(p):
        loc, scale = _loc_scale(p)
        precision = scale.pow(-2)
        return torch.diag_embed(precision), precision * loc
    matrix = _full(p).precision_matrix
    return matrix, (matrix @ p.mean.unsqueeze(-1)).squeeze(-1)


def _full(p: Distribution) -> MultivariateNormal:
    if isinstance(p, MultivariateNormal):
        return p
    return full_gaussian(p.mean, torch.linalg.cholesky(moments(p)[1]))


def _scale_of(precision: Tensor) -> Tensor:
    """The lower factor of the covariance, by one factorisation of the precision."""
    # Infinity would pass through the factorisation as a factor of zero.
    finite = torch.where(precision.isinf(), torch.nan, precision)
    try:
        flipped = torch.linalg.cholesky(finite.flip(-2, -1))
    except torch.linalg.LinAlgError as error:
        raise ValueError(
            "experts must have a fused precision that is finite and positive definite: one of them is "
            "sharper than the dtype can hold, or all of them are flat in some direction"
        ) from error
    inverse = flipped.flip(-2, -1).mT
    eye = torch.eye(precision.shape[-1], dtype=precision.dtype, device=precision.device)
    return torch.linalg.solve_triangular(inverse, eye.expand_as(inverse), upper=False)


def _product_of_mixture(mixture: Mixture, experts: list[Expert]) -> Distribution:
    lifted = [_lift(p) for p in experts]
    components = product_of_experts(mixture.components, *lifted)
    # p_k(Z) r(Z) / product_k(Z) is the same everywhere: the integral of p_k r. Best read at the mean.
    mean = components.mean
    agreement = mixture.components.log_prob(mean) - components.log_prob(mean)
    for p in lifted:
        agreement = agreement + p.log_prob(mean)
    return Mixture(mixture.log_weights + agreement, components)


def _lift(p: Expert) -> Expert:
    """The expert with a batch dimension for the components of a mixture."""
    if isinstance(p, GaussianFactor):
        information, log_scale = p.information.unsqueeze(-2), p.log_scale.unsqueeze(-1)
        return GaussianFactor(p.precision.unsqueeze(-3), information, log_scale)
    if _is_diagonal(p):
        return diag_gaussian(p.mean.unsqueeze(-2), p.stddev.unsqueeze(-2))
    full = _full(p)
    return full_gaussian(full.mean.unsqueeze(-2), full.scale_tril.unsqueeze(-3))
