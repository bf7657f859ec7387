"""One latent, or samples, of a fused posterior."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor
from torch.distributions import Distribution

from torchrl_vjepa.belief import ParticleBelief
from torchrl_vjepa.distributions import langevin, maximize_log_prob, point_estimate, sample
from torchrl_vjepa.fusion.posterior import FusedBelief, fuse, known_product
from torchrl_vjepa.priors import LatentDensity

__all__ = ["map_estimate", "sample_posterior"]

MakeOptimizer = Callable[[list[Tensor]], torch.optim.Optimizer]


def map_estimate(
    p: Distribution,
    prior: LatentDensity,
    *,
    num_restarts: int = 8,
    num_steps: int = 100,
    optimizer: MakeOptimizer | None = None,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    r"""Latent MAP :math:`\arg\max_Z \log p(Z) + \log p_{\text{prior}}(Z)`.

    The paper's latent-space energy minimisation, dynamics consistency plus task constraint (section
    "Energy-Based Priors and Latent Optimization"). A product that is known and has a mode (Gaussians and
    their mixtures) is not searched; else gradients ascend from the mean and draws of the part of the
    product that is known (:func:`~torchrl_vjepa.distributions.maximize_log_prob`).

    Args:
        p: the likelihood expert, batch ``*B`` and event ``(D,)``.
        prior: the prior expert, differentiable.
        num_restarts: how many starts, the mean included: for energies that are not convex.
        num_steps: steps of the optimiser.
        optimizer: makes one of a list of variables, in units of the standard deviation of the starts'
            distribution; Adam by default.
        generator: source of randomness of the starts; the global one if ``None``.

    Returns:
        The point ``(*B, D)`` and :math:`\log p + \log p_{\text{prior}}` there, ``(*B)``; without gradient
        where it was searched for.

    Raises:
        ValueError: if ``num_restarts`` is not positive, the prior has no gradient, or no start of a row
            has a finite log-density.
        TypeError: if ``p`` is a point mass or a belief of particles, which have no density.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import Density, diag_gaussian
        >>> p = diag_gaussian(torch.zeros(2), torch.ones(2))
        >>> goal = Density(lambda z: 0.5 * (z - 1.0).square().sum(-1))
        >>> map_estimate(p, goal)[0].round(decimals=2)
        tensor([0.5000, 0.5000])
    """
    if num_restarts < 1:
        raise ValueError(f"num_restarts must be at least 1, got {num_restarts}")
    if isinstance(p, ParticleBelief) and not isinstance(p, FusedBelief):
        raise TypeError(
            "p must have a density, got a ParticleBelief; take the mode of fuse(p, prior).posterior"
        )
    proposal, _, log_factor = known_product(p, prior)
    if log_factor is None:
        point = point_estimate(proposal, "mode")
        return point, p.log_prob(point) + prior.log_prob(point)

    def log_prob(z: Tensor) -> Tensor:
        constraint = prior.log_prob(z)
        if z.requires_grad and not constraint.requires_grad:
            raise ValueError(
                "prior must be differentiable in the latent, got a log-density without gradient; fuse() "
                "and sample_posterior(how='importance') need none"
            )
        return p.log_prob(z) + constraint

    # A few more than may be needed: they also say how wide it is.
    starts = sample(proposal, (max(num_restarts, 8),), generator=generator)
    scale = starts.std(0)
    with contextlib.suppress(NotImplementedError):  # a distribution of the user's own
        starts = torch.cat([proposal.mean.detach().unsqueeze(0), starts])
    return maximize_log_prob(
        log_prob, starts[:num_restarts], scale=scale, num_steps=num_steps, optimizer=optimizer
    )


def sample_posterior(
    p: Distribution,
    prior: LatentDensity,
    sample_shape: Sequence[int] = (),
    how: Literal["exact", "importance", "langevin"] = "importance",
    *,
    num_particles: int = 1024,
    step_size: float = 0.5,
    num_steps: int = 50,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Draw :math:`Z^{(m)} \sim p(Z \mid Z_C, \eta)`, the fused posterior (section "MAP vs. Sampling").

    ``"exact"`` where the product is known: Gaussians, mixtures of them, flat priors. ``"importance"``
    draws from the weighted particles of :func:`fuse`, for any prior, also one without gradient: right
    while the effective sample size is large, but it repeats particles, and never leaves where ``p``
    put them. ``"langevin"`` moves such draws along the gradient of the posterior: for priors that are
    sharp or away from ``p``; it does not cross between modes, whose masses stay what the particles said.

    The chains are Metropolis-adjusted (MALA), so the step size changes how fast they mix and not what
    they converge to; the proposal is
    :math:`Z + \tfrac{\epsilon^2}{2} S \nabla \log p(Z \mid \cdot) + \epsilon S^{1/2} \xi` with the
    variances :math:`S` of what the particles were drawn from.

    Args:
        p: the likelihood expert, batch ``*B`` and event ``(D,)``.
        prior: the prior expert.
        sample_shape: leading dimensions of samples: of independent chains for ``"langevin"``.
        how: as above.
        num_particles: of the importance weights.
        step_size: :math:`\epsilon` of Langevin, in units of the standard deviation; smaller where the
            posterior is sharper than ``p``.
        num_steps: Langevin steps of every chain.
        generator: source of randomness; the global one if ``None``.

    Returns:
        ``(*sample_shape, *B, D)``, without gradient.

    Raises:
        ValueError: if ``how`` is unknown, ``"exact"`` is asked for and not known, ``step_size`` is not
            positive or ``num_steps`` negative.
        TypeError: if ``"langevin"`` is asked for a belief of particles, which has no density.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> p = diag_gaussian(torch.zeros(3, 2), torch.ones(2))
        >>> sample_posterior(p, diag_gaussian(torch.ones(2), torch.ones(2)), (10,), "exact").shape
        torch.Size([10, 3, 2])
    """
    if how not in ("exact", "importance", "langevin"):
        raise ValueError(f"how must be 'exact', 'importance' or 'langevin', got {how!r}")
    if how == "exact" and known_product(p, prior)[2] is not None:
        raise ValueError(
            "how='exact' needs Gaussians, at most one mixture of them, or a flat prior, got "
            f"{type(p).__name__} and {type(prior).__name__}; use 'importance' or 'langevin'"
        )
    with torch.no_grad():
        posterior = fuse(p, prior, num_particles=num_particles, generator=generator).posterior
    if not isinstance(posterior, ParticleBelief):
        return sample(posterior, sample_shape, generator=generator)
    draws = posterior.sample(sample_shape, generator)
    if how == "importance":
        return draws
    if not isinstance(posterior, FusedBelief):
        raise TypeError("how='langevin' needs the density of p, got a ParticleBelief; use 'importance'")
    return langevin(
        posterior.log_prob,
        draws,
        posterior.proposal_scale,
        step_size=step_size,
        num_steps=num_steps,
        generator=generator,
    )
