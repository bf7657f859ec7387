"""Product of experts."""

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

from torchrl_vjepa.distributions.gaussians import LowRankGaussian, diag_gaussian, full_gaussian
from torchrl_vjepa.distributions.mixtures import Mixture

__all__ = ["product_of_experts"]


def product_of_experts(*experts: Distribution) -> Distribution:
    r"""Normalised product of densities (``eq:bjepa_posterior``), in precision space.

    .. math::
        \Lambda = \sum_i \Lambda_i, \qquad \mu = \Lambda^{-1} \sum_i \Lambda_i \mu_i

    Diagonal experts alone give a diagonal product; with a full one among them it is full. For two of
    them it is the Kalman update of one by the other as a measurement. A mixture of Gaussians among the
    experts gives a mixture: every component is multiplied by the others, and its weight by
    :math:`\int p_k(Z) \prod_i p_i(Z)\, dZ`, how well it agrees with them.

    Args:
        *experts: Gaussians, diagonal, full or of low rank, and at most one :class:`Mixture` of them, with
            the same event ``(D,)`` and batch shapes that broadcast.

    Returns:
        The product, with the broadcast batch shape.

    Raises:
        ValueError: if there is no expert, or event shapes differ or are not ``(D,)``.
        TypeError: if an expert is neither, or there are two mixtures.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
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
    mixtures = [p for p in experts if isinstance(p, Mixture)]
    if len(mixtures) == 1:
        return _product_of_mixture(mixtures[0], [p for p in experts if p is not mixtures[0]])
    low_rank = [p for p in experts if isinstance(p, (LowRankGaussian, LowRankMultivariateNormal))]
    diagonal = [p for p in experts if isinstance(p, Independent) and isinstance(p.base_dist, Normal)]
    full = [p for p in experts if isinstance(p, MultivariateNormal)]
    if len(diagonal) + len(full) + len(low_rank) != len(experts):
        names = [type(p).__name__ for p in experts]
        raise TypeError(
            f"experts must be diagonal or multivariate Gaussians, got {names}; one Mixture of them may be"
        )
    full += [full_gaussian(p.mean, torch.linalg.cholesky(p.covariance_matrix)) for p in low_rank]
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


def _product_of_mixture(mixture: Mixture, experts: list[Distribution]) -> Distribution:
    if not experts:
        return mixture
    rest = product_of_experts(*experts)
    if isinstance(rest, MultivariateNormal):
        lifted: Distribution = full_gaussian(rest.mean.unsqueeze(-2), rest.scale_tril.unsqueeze(-3))
    else:
        lifted = diag_gaussian(rest.mean.unsqueeze(-2), rest.stddev.unsqueeze(-2))
    components = product_of_experts(mixture.components, lifted)
    # p_k(Z) r(Z) / product_k(Z) is the same everywhere: the integral of p_k r. Best read at the mean.
    mean = components.mean
    agreement = mixture.components.log_prob(mean) + lifted.log_prob(mean) - components.log_prob(mean)
    return Mixture(mixture.log_weights + agreement, components)
