"""Proper scoring rules: one number for a belief and what came true, smallest for the true belief."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_vjepa.diagnostics.beliefs import Belief, checked_target, draws, gaussian_marginals
from torchrl_vjepa.distributions import Delta

__all__ = ["crps", "energy_score"]

# Elements of the pairwise differences that energy_score holds at a time.
_CHUNK = 2**24


def crps(
    p: Belief,
    target: Tensor,
    *,
    mask: Tensor | None = None,
    num_samples: int = 256,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Continuous ranked probability score of every dimension; lower is better, in units of the latent.

    .. math::
        \mathrm{CRPS}(F, z) = \int \big(F(y) - 1[y \ge z]\big)^2 dy
        = \mathbb E|Z - z| - \tfrac{1}{2} \mathbb E|Z - Z'|

    A strictly proper score: its expectation is smallest for the true distribution. For a point it is the
    absolute error. Gaussians have the closed form

    .. math::
        \sigma \big[ w (2 \Phi(w) - 1) + 2 \varphi(w) - \pi^{-1/2} \big], \qquad w = (z - \mu) / \sigma

    Otherwise :math:`M` samples give its unbiased ("fair") estimate, with
    :math:`\tfrac{1}{2 M (M - 1)} \sum_{ij} |Z_i - Z_j|` for the second term, in
    :math:`O(M \log M)`. Only the closed form is differentiable in the belief.

    Args:
        p: belief with batch ``*B`` and event ``(D,)``, or samples of it, ``(M, *B, D)``.
        target: what came true, shape ``(*B, D)``.
        mask: boolean, ``(*B)`` or ``(*B, 1)``; ``False`` gives NaN.
        num_samples: :math:`M`, at least 2, for distributions that are not Gaussian.
        generator: source of randomness for them.

    Returns:
        Scores of shape ``(*B, D)``.

    Raises:
        TypeError: if the target is not floating point or the mask not boolean.
        ValueError: if a shape does not fit or a value that counts is NaN.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import Delta, diag_gaussian
        >>> target = torch.tensor([0.0, 2.0])
        >>> crps(diag_gaussian(torch.zeros(2), torch.ones(2)), target)
        tensor([0.2337, 1.4528])
        >>> crps(Delta(torch.zeros(2)), target)
        tensor([0., 2.])
    """
    target, mask = checked_target(p, target, mask)
    marginals = gaussian_marginals(p)
    if marginals is not None:
        mean, std = marginals
        w = (target - mean) / std
        density = torch.exp(-0.5 * w.square()) * math.sqrt(2 / math.pi)
        scores = std * (w * torch.erf(w / math.sqrt(2)) + density - 1 / math.sqrt(math.pi))
    elif isinstance(p, Delta):
        scores = (target - p.mean).abs()
    else:
        samples = draws(p, num_samples, generator).sort(0).values
        count = len(samples)
        # Sum over pairs of |Z_i - Z_j|: the k-th smallest is added k - 1 times, subtracted M - k times.
        weight = 2 * torch.arange(1, count + 1, dtype=samples.dtype, device=samples.device) - count - 1
        spread = torch.tensordot(weight, samples, dims=1) / (count * (count - 1))
        scores = (samples - target).abs().mean(0) - spread
    return scores if mask is None else torch.where(mask.unsqueeze(-1), scores, torch.nan)


def energy_score(
    p: Belief,
    target: Tensor,
    *,
    mask: Tensor | None = None,
    num_samples: int = 64,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Energy score of the whole vector; lower is better, in units of the latent.

    .. math::
        \mathrm{ES}(p, z) = \mathbb E \|Z - z\|_2 - \tfrac{1}{2} \mathbb E \|Z - Z'\|_2

    The CRPS in one dimension. A strictly proper score that sees correlations, which the CRPS of each
    dimension does not. Estimated without bias from :math:`M` samples, in :math:`O(M^2)`; a point mass
    has the distance in closed form.

    Args:
        p: belief with batch ``*B`` and event ``(D,)``, or samples of it, ``(M, *B, D)``.
        target: what came true, shape ``(*B, D)``.
        mask: boolean, ``(*B)`` or ``(*B, 1)``; ``False`` gives NaN.
        num_samples: :math:`M`, at least 2.
        generator: source of randomness.

    Returns:
        Scores of shape ``(*B)``.

    Raises:
        TypeError: if the target is not floating point or the mask not boolean.
        ValueError: if a shape does not fit or a value that counts is NaN.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import Delta
        >>> energy_score(Delta(torch.zeros(2)), torch.tensor([3.0, 4.0]))
        tensor(5.)
        >>> samples = torch.tensor([[-1.0], [1.0]])
        >>> energy_score(samples, torch.zeros(1)), crps(samples, torch.zeros(1))
        (tensor(0.), tensor([0.]))
    """
    target, mask = checked_target(p, target, mask)
    if isinstance(p, Delta):
        scores = (target - p.mean).norm(dim=-1)
    else:
        samples = draws(p, num_samples, generator)
        count = len(samples)
        distance = (samples - target).norm(dim=-1).mean(0)
        rows = samples.reshape(count, -1, samples.shape[-1]).transpose(0, 1)
        # Differences themselves, not by matrix products, which cancel for samples close to each other.
        spreads = [
            torch.cdist(part, part, compute_mode="donot_use_mm_for_euclid_dist").sum((1, 2))
            for part in rows.split(max(1, _CHUNK // count**2))
        ]
        spread = torch.cat(spreads) if spreads else rows.new_zeros(0)
        scores = distance - spread.reshape(distance.shape) / (2 * count * (count - 1))
    return scores if mask is None else torch.where(mask, scores, torch.nan)
