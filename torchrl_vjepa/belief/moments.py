"""Mean and covariance of the predicted belief: what a Kalman filter propagates."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.distributions import (
    Distribution,
    Independent,
)

from torchrl_vjepa.belief.rollouts import Transition, check_plan
from torchrl_vjepa.distributions import Delta, moments

__all__ = ["propagate_moments"]


def propagate_moments(
    transition: Transition,
    latent: Tensor,
    actions: Tensor,
    method: Literal["sigma_points", "linearize"] = "sigma_points",
    *,
    covariance: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    r"""Mean and covariance of the belief along a plan (section "Uncertainty Propagation").

    .. math::
        \mu_{t+1} = \mathbb E[\mu_\phi(Z_t, u_t)], \qquad
        P_{t+1} = \mathbb E[\Sigma_\phi(Z_t, u_t)] + \mathrm{Var}[\mu_\phi(Z_t, u_t)]

    over :math:`Z_t \sim \mathcal N(\mu_t, P_t)`. Both methods are exact for a linear-Gaussian
    transition, where this is the Kalman prediction ``eq:kf_mean_update``, ``eq:kf_cov_update``:

    - ``"sigma_points"`` averages over the :math:`2 D` points
      :math:`\mu_t \pm \sqrt D\, L_i`, :math:`L L^\top = P_t`, with equal weights (the spherical cubature
      rule): the mean and :math:`\mathbb E[\Sigma_\phi]` are exact for polynomials of third degree; no
      derivative is needed, and no weight is negative, so :math:`P` stays a covariance.
    - ``"linearize"`` expands around the mean: :math:`\mu_\phi(\mu_t)` and
      :math:`\Sigma_\phi(\mu_t) + J P_t J^\top` with :math:`J = \partial \mu_\phi / \partial Z` (the
      extended Kalman prediction). The mean has to be differentiable in the latent; a Jacobian costs about
      as much as the sigma points.

    Neither sees that a belief becomes multi-modal or skewed; :func:`rollout` with ``how="sample"``
    does, for any distribution.

    Args:
        transition: ``(latent (*B, D), action (*B, A)) -> Distribution``, for instance ``Predictor.dist``,
            whose moments :func:`~torchrl_vjepa.distributions.moments` gives.
        latent: the mean to start from, of shape ``(*B, D)``.
        actions: the plan, of shape ``(*B, H, A)``.
        method: how the integral over the belief is taken.
        covariance: the covariance to start from, of shape ``(*B, D, D)`` or one that broadcasts to it;
            it may be singular. ``None`` is a point.

    Returns:
        Means ``(*B, H, D)`` and covariances ``(*B, H, D, D)`` of :math:`Z_{t+1}, \dots, Z_{t+H}`.

    Raises:
        ValueError: if shapes disagree, the plan is empty, ``method`` is unknown, or ``covariance`` is
            not finite, symmetric and positive semi-definite, or the transition's events are no vectors.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> def walk(latent, action):
        ...     return diag_gaussian(0.5 * latent + action, torch.ones(1))
        >>> means, covariances = propagate_moments(walk, torch.zeros(1), torch.ones(3, 1))
        >>> means.flatten(), covariances.flatten()
        (tensor([1.0000, 1.5000, 1.7500]), tensor([1.0000, 1.2500, 1.3125]))
    """
    if method not in ("linearize", "sigma_points"):
        raise ValueError(f"method must be 'linearize' or 'sigma_points', got {method!r}")
    check_plan(latent, actions)
    if covariance is not None:
        covariance = _checked_covariance(covariance, latent)
    step = _linearized if method == "linearize" else _cubature
    mean, means, covariances = latent, [], []
    for action in actions.unbind(-2):
        if covariance is None:
            mean, covariance = moments(transition(mean, action))
        else:
            mean, covariance = step(transition, mean, covariance, action)
        means.append(mean)
        covariances.append(covariance)
    return torch.stack(means, dim=-2), torch.stack(covariances, dim=-3)


def _diagonal(p: Distribution) -> Tensor | None:
    """Variances ``(*B, D)`` of a distribution with independent dimensions."""
    if isinstance(p, Delta):
        return p.variance
    if isinstance(p, Independent) and p.reinterpreted_batch_ndims == 1 and not p.base_dist.event_shape:
        return p.variance
    return None


def _linearized(
    transition: Transition, mean: Tensor, covariance: Tensor, action: Tensor
) -> tuple[Tensor, Tensor]:
    def predict(latent: Tensor) -> tuple[Tensor, Tensor]:
        return moments(transition(latent, action))

    dim = mean.shape[-1]
    following, pullback, noise = torch.func.vjp(predict, mean, has_aux=True)  # type: ignore[misc]
    basis = torch.eye(dim, dtype=following.dtype, device=following.device)
    basis = basis.reshape(dim, *[1] * (mean.ndim - 1), dim).expand(dim, *mean.shape)
    # One forward pass; only the backward pass, which has no control flow, runs once per dimension.
    (rows,) = torch.func.vmap(pullback)(basis)
    jacobian = rows.movedim(0, -2)
    return following, noise + jacobian @ covariance @ jacobian.mT


def _cubature(
    transition: Transition, mean: Tensor, covariance: Tensor, action: Tensor
) -> tuple[Tensor, Tensor]:
    dim = mean.shape[-1]
    offsets = dim**0.5 * _factor(covariance).movedim(-1, 0)
    points = torch.cat([mean + offsets, mean - offsets])
    p = transition(points, action.expand(2 * dim, *action.shape))
    variance = _diagonal(p)
    if variance is None:
        means, covariances = moments(p)
        noise = covariances.mean(0)
    else:  # not embedded in 2 D matrices first
        means, noise = p.mean, torch.diag_embed(variance.mean(0))
    following = means.mean(0)
    spread = (means - following).movedim(0, -1)
    return following, noise + spread @ spread.mT / (2 * dim)


def _factor(covariance: Tensor) -> Tensor:
    """Lower factor of a covariance that may be singular: each variance grows by a rounding error."""
    finfo = torch.finfo(covariance.dtype)
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    jitter = 4 * covariance.shape[-1] * finfo.eps * variance + finfo.tiny
    factor, failed = torch.linalg.cholesky_ex(covariance + torch.diag_embed(jitter))
    # A transition's covariance that is none must not pass for one.
    return torch.where((failed == 0)[..., None, None], factor, torch.nan)


def _checked_covariance(covariance: Tensor, latent: Tensor) -> Tensor:
    dim = latent.shape[-1]
    expected = (*latent.shape, dim)
    try:
        full = covariance.expand(expected)
    except RuntimeError:
        raise ValueError(
            f"covariance must have shape {expected}, or one that broadcasts to it, got "
            f"{tuple(covariance.shape)}"
        ) from None
    if not covariance.isfinite().all():
        raise ValueError("covariance must be finite, got NaN or infinite entries")
    scale = covariance.abs().amax((-2, -1))
    tolerance = 100 * dim * torch.finfo(covariance.dtype).eps * scale
    if ((covariance - covariance.mT).abs().amax((-2, -1)) > tolerance).any():
        raise ValueError("covariance must be symmetric, got an asymmetric matrix")
    lowest = torch.linalg.eigvalsh(covariance).amin(-1)
    if (lowest < -tolerance).any():
        worst = float(lowest[lowest < -tolerance].min())
        raise ValueError(f"covariance must be positive semi-definite, got the eigenvalue {worst:.3g}")
    return full
