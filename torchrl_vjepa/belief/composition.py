"""Two routes to the same future: one long skip, or many short ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor
from torch.distributions import Distribution

from torchrl_vjepa.belief.moments import propagate_moments
from torchrl_vjepa.belief.rollouts import check_plan
from torchrl_vjepa.distributions import moments

__all__ = ["composition_gap"]


def composition_gap(
    dist: Callable[..., Distribution],
    latent: Tensor,
    actions: Tensor,
    *,
    step: int = 1,
    divergence: Literal["wasserstein", "kl"] = "wasserstein",
    method: Literal["sigma_points", "linearize"] = "sigma_points",
) -> Tensor:
    r"""How far a direct skip prediction is from iterated short predictions.

    A predictor with several skips has two routes to :math:`Z_{t+\Delta}`:

    - *direct*: :math:`p_\phi(Z_{t+\Delta} \mid Z_t, \xi_{t+\Delta}, u_{t:t+\Delta-1})`, one evaluation, as
      it was trained (``eq:vjepa_controlled_dynamics``);
    - *iterated*: the prediction of ``step`` steps, pushed through itself :math:`\Delta / \texttt{step}`
      times (``eq:latent_belief_propagation``), here by :func:`propagate_moments`.

    They agree if the model is *compositional*: a latent transition rather than a set of one-shot
    predictions (section "Clip-Level Prediction vs. Sequential Dynamics"). The gap is zero for an exactly
    compositional linear-Gaussian model; it is not zero for a good model whose predictive family cannot
    hold the truth (diagonal covariances, say, where the true one is full).

    Args:
        dist: ``(latent (*B, D), actions (*B, skip, A), skip=...) -> Distribution``, for instance
            ``Predictor.dist``; both ``step`` and :math:`\Delta` must be among its skips.
        latent: where to start, of shape ``(*B, D)``.
        actions: the plan, of shape ``(*B, Δ, A)``; its length is the skip of the direct route.
        step: the skip that is iterated; it divides :math:`\Delta` and is smaller.
        divergence: ``"wasserstein"``: 2-Wasserstein distance of the Gaussians with the two routes'
            moments, in units of the latent, also for point masses; ``"kl"``: their KL divergence, of the
            iterated from the direct one, in nats, infinite where a covariance is singular.
        method: see :func:`propagate_moments`.

    Returns:
        The gap of each row, ``(*B)``, at least 0.

    Raises:
        ValueError: if shapes disagree, ``step`` does not divide the length of the plan or is no smaller,
            a skip was not learned, or an option is unknown.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.predictor import Predictor
        >>> predictor = Predictor(latent_dim=4, action_dim=2, skips=(1, 4))
        >>> gap = composition_gap(predictor.dist, torch.zeros(7, 4), torch.ones(7, 4, 2))
        >>> gap.shape, bool((gap > 0).all())  # not trained: nothing makes the routes agree
        (torch.Size([7]), True)
    """
    if divergence not in ("wasserstein", "kl"):
        raise ValueError(f"divergence must be 'wasserstein' or 'kl', got {divergence!r}")
    check_plan(latent, actions)
    skip, action_dim = actions.shape[-2:]
    if step < 1 or step >= skip or skip % step:
        raise ValueError(f"step must divide the length {skip} of the plan and be smaller, got {step}")

    def iterated(state: Tensor, chunk: Tensor) -> Distribution:
        return dist(state, chunk.reshape(*chunk.shape[:-1], step, action_dim), skip=step)

    chunks = actions.reshape(*actions.shape[:-2], skip // step, step * action_dim)
    means, covariances = propagate_moments(iterated, latent, chunks, method)
    arrival = means[..., -1, :], covariances[..., -1, :, :]
    direct = moments(dist(latent, actions, skip=skip))
    return (_wasserstein if divergence == "wasserstein" else _kl)(*arrival, *direct)


def _wasserstein(mean: Tensor, covariance: Tensor, other_mean: Tensor, other: Tensor) -> Tensor:
    """2-Wasserstein distance of two Gaussians, which may be singular."""
    values, vectors = torch.linalg.eigh(covariance)
    root = (vectors * values.clamp_min(0).sqrt().unsqueeze(-2)) @ vectors.mT
    cross = torch.linalg.eigvalsh(root @ other @ root).clamp_min(0).sqrt().sum(-1)
    traces = sum(matrix.diagonal(dim1=-2, dim2=-1).sum(-1) for matrix in (covariance, other))
    return ((mean - other_mean).square().sum(-1) + traces - 2 * cross).clamp_min(0).sqrt()


def _kl(mean: Tensor, covariance: Tensor, other_mean: Tensor, other: Tensor) -> Tensor:
    """KL divergence of the first Gaussian from the second."""
    factor, failed = torch.linalg.cholesky_ex(covariance)
    other_factor, other_failed = torch.linalg.cholesky_ex(other)
    singular = (failed != 0) | (other_failed != 0)
    # Rows without a density get an identity to compute with, and infinity in the end.
    eye = torch.eye(mean.shape[-1], dtype=mean.dtype, device=mean.device)
    factor, other_factor = (
        torch.where(singular[..., None, None], eye, value) for value in (factor, other_factor)
    )
    ratio = torch.linalg.solve_triangular(other_factor, factor, upper=False)
    offset = torch.linalg.solve_triangular(other_factor, (other_mean - mean).unsqueeze(-1), upper=False)
    log_det = ratio.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    value = 0.5 * (ratio.square().sum((-2, -1)) + offset.square().sum((-2, -1)) - mean.shape[-1]) - log_det
    return torch.where(singular, math.inf, value.clamp_min(0))
