"""The fused posterior: a predictive distribution times a prior, whatever the two are."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from torchrl_vjepa.belief import ParticleBelief
from torchrl_vjepa.distributions import (
    Delta,
    Density,
    GaussianFactor,
    Mixture,
    NoiseDistribution,
    from_noise,
    maximize_log_prob,
    noise_dim,
    product_of_experts,
    sample,
)
from torchrl_vjepa.distributions.products import has_closed_form
from torchrl_vjepa.priors import LatentDensity

__all__ = ["FusedBelief", "Fusion", "fuse", "known_product"]

#: Particles from which the search for the mode of an importance-weighted posterior starts.
MODE_STARTS = 8

LogFactor = Callable[[Tensor], Tensor]


class Fusion(NamedTuple):
    r"""What :func:`fuse` gives.

    Args:
        posterior: :math:`p(Z \mid Z_C, \eta)`, batch ``*B`` and event ``(D,)``.
        log_evidence: :math:`\log \int p(Z)\, p_{\text{prior}}(Z)\, dZ` of shape ``(*B)``: how well the
            prediction agrees with the task; with an unnormalised prior up to its constant. Zero for a
            flat prior, minus infinity where no particle has any weight.
        effective_sample_size: of the importance weights, ``(*B)`` in ``[1, num_particles]``; ``None``
            where the product is exact.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> p = diag_gaussian(torch.zeros(1), torch.ones(1))
        >>> fuse(p, p).log_evidence.round(decimals=3)  # the density of N(0, 2) at 0
        tensor(-1.2660)
    """

    posterior: Distribution
    log_evidence: Tensor
    effective_sample_size: Tensor | None


class FusedBelief(ParticleBelief):
    r"""Importance-weighted posterior :math:`q(Z)\, f(Z) / \mathcal Z` that knows its density.

    What :func:`fuse` gives where the product has no closed form: :math:`q` is the part of it that has one
    (the prediction, times the base of the prior), and :math:`f` the rest. Moments, samples and the
    effective sample size are those of the particles; the density is that of the experts, with the
    particles' estimate of :math:`\mathcal Z`; the mode is the latent MAP. Rows in which no particle has
    any weight are :math:`q`.

    Args:
        particles: :math:`Z^{(k)} \sim q`, ``(*B, K, D)``.
        log_weights: :math:`\log f(Z^{(k)})`, ``(*B, K)``.
        proposal: :math:`q`, batch broadcastable to ``*B``.
        log_factor: :math:`\log f`: ``(*S, *B, D) -> (*S, *B)``.
        log_normaliser: :math:`\log \mathcal Z`, ``(*B)``.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> wall = Density(lambda z: 100.0 * (z[..., 0] < 0))
        >>> p = diag_gaussian(torch.zeros(1), torch.ones(1))
        >>> posterior = fuse(p, wall, generator=torch.Generator().manual_seed(0)).posterior
        >>> bool(posterior.mean > 0.5), bool(posterior.log_prob(torch.ones(1)) > p.log_prob(torch.ones(1)))
        (True, True)
    """

    def __init__(
        self,
        particles: Tensor,
        log_weights: Tensor,
        proposal: Distribution,
        log_factor: LogFactor,
        log_normaliser: Tensor,
    ) -> None:
        super().__init__(particles, log_weights, validate_args=False)
        self.proposal, self.log_factor, self.log_normaliser = proposal, log_factor, log_normaliser

    def log_prob(self, value: Tensor) -> Tensor:
        r"""Log-density :math:`\log q(Z) + \log f(Z) - \log \mathcal Z`, in nats.

        Its shape is exact; :math:`\mathcal Z` is the particles' estimate.

        Args:
            value: of shape ``(*S, *B, D)``.

        Returns:
            ``(*S, *B)``.
        """
        relative = self.log_factor(value) - self.log_normaliser
        return self.proposal.log_prob(value) + torch.where(self.log_normaliser == -math.inf, 0.0, relative)

    @property
    def mode(self) -> Tensor:
        """The latent MAP, ``(*B, D)``: gradient ascent from the heaviest particles; without gradient."""
        with torch.no_grad():
            best = self.log_weights.topk(min(MODE_STARTS, self.num_particles), -1).indices
            starts = torch.take_along_dim(self.particles, best.unsqueeze(-1), -2).movedim(-2, 0)
            scale = self.proposal_scale
        return maximize_log_prob(self.log_prob, starts, scale=scale)[0]

    @property
    def proposal_scale(self) -> Tensor:
        """Standard deviation of the unweighted particles, ``(*B, D)``: not zero where one has all weight."""
        return self.particles.std(-2, correction=0)

    def expand(self, batch_shape: Sequence[int], _instance: Distribution | None = None) -> FusedBelief:
        """The same belief, broadcast to ``batch_shape``.

        Args:
            batch_shape: the new batch shape.

        Returns:
            The expanded belief.
        """
        wide = super().expand(batch_shape)
        return FusedBelief(
            wide.particles,
            wide.log_weights,
            self.proposal,
            self.log_factor,
            self.log_normaliser.expand(*batch_shape),
        )


def fuse(
    p: Distribution,
    prior: LatentDensity,
    *,
    num_particles: int = 128,
    generator: torch.Generator | None = None,
    shared_noise: bool = False,
    quiet: bool = False,
) -> Fusion:
    r"""Posterior :math:`p(Z)\, p_{\text{prior}}(Z) / \mathcal Z` and evidence :math:`\mathcal Z`.

    Hard fusion (``eq:bjepa_posterior``) of any prediction with any prior:

    - a flat prior gives ``p`` itself;
    - Gaussians, one mixture of them and a :class:`GaussianFactor` are multiplied in closed form;
    - a :class:`Density` with a base is multiplied with the base in closed form, if there is one, and its
      energy weighs particles :math:`Z^{(k)}` of that product :math:`q`:
      :math:`w_k \propto e^{-E(Z^{(k)})}`, :math:`\mathcal Z = \mathcal Z_q \frac1K \sum_k e^{-E(Z^{(k)})}`;
    - whatever else there is weighs particles of ``p`` itself, also those that a particle belief has.

    Weights are self-normalised in log space. The evidence is unbiased; means are biased by
    :math:`O(1/K)`. Particles are reparameterised where ``p`` is a transform of normal noise, so gradients
    flow through them and their weights to what ``p`` was computed from.

    Draws that carry no gradient (others' distributions with a ``generator``, mixtures of full Gaussians)
    give their weights the gradient of their likelihood instead.

    A weight that is ``nan`` or plus infinity counts as zero. A row in which all are zero falls back to
    the proposal (equal weights), with ``log_evidence`` minus infinity. Either comes with a
    ``RuntimeWarning``. (The check is one look at the device a call, for importance weights alone.)

    Args:
        p: the likelihood expert, batch ``*B`` and event ``(D,)``.
        prior: the prior expert; its batch broadcasts against ``*B``, and its energy is called with latents
            ``(K, *B, D)``.
        num_particles: :math:`K`.
        generator: source of randomness of the particles; the global one if ``None``.
        shared_noise: common random numbers: the noise of a particle is the same for all rows but those of
            the first batch dimension
            (:func:`~torchrl_vjepa.common_random_numbers.sample_common`), so that rows differ by what is
            compared and not by luck. Distributions that are no transform of normal noise are drawn
            independently.
        quiet: no warnings: the caller looks at the evidence, which tells.

    Returns:
        Posterior, log evidence and effective sample size.

    Raises:
        ValueError: if ``num_particles`` is not positive, latent sizes or devices differ, the energy has a
            wrong shape, the particles are not finite, or a Gaussian product does not exist.
        TypeError: if ``p`` is a point mass, which no prior can move.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> p = diag_gaussian(torch.zeros(5, 2), torch.ones(2))
        >>> fuse(p, Density()).posterior is p
        True
        >>> fuse(p, diag_gaussian(torch.ones(2), torch.ones(2))).posterior.mean[0]
        tensor([0.5000, 0.5000])
        >>> ring = Density(lambda z: 8 * (z.norm(dim=-1) - 1).square())
        >>> fusion = fuse(p, ring, num_particles=256)
        >>> fusion.log_evidence.shape, bool((fusion.effective_sample_size > 20).all())
        (torch.Size([5]), True)
    """
    if num_particles < 1:
        raise ValueError(f"num_particles must be at least 1, got {num_particles}")
    if isinstance(prior, Density) and prior.is_flat:
        like = _like(p)
        return Fusion(p, torch.zeros(p.batch_shape, dtype=like.dtype, device=like.device), None)
    proposal, base, log_factor = known_product(p, prior)
    # The integral of what is known in closed form.
    log_scale = 0.0 if base is None else _log_integral(p, base, proposal)
    if log_factor is None:
        return Fusion(proposal, torch.as_tensor(log_scale), None)
    if isinstance(proposal, ParticleBelief):
        particles, before = proposal.particles.movedim(-2, 0), proposal.log_weights
    else:
        particles, before = _draw(proposal, num_particles, generator, shared_noise)
    value = log_factor(particles)
    if not isinstance(value, Tensor) or not _broadcasts(value.shape, particles.shape[:-1]):
        got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise ValueError(
            f"prior must give log-densities that broadcast to {tuple(particles.shape[:-1])} for latents "
            f"{tuple(particles.shape)}, got {got}"
        )
    value = value.expand(particles.shape[:-1]).movedim(0, -1)
    particles = particles.movedim(0, -2)
    log_weights, log_normaliser = _weigh(particles, before, value, quiet)
    posterior: ParticleBelief
    if isinstance(proposal, ParticleBelief) and not isinstance(proposal, FusedBelief):
        posterior = ParticleBelief(particles, log_weights, validate_args=False)
    else:
        posterior = FusedBelief(particles, log_weights, proposal, log_factor, log_normaliser)
    return Fusion(posterior, log_normaliser + log_scale, posterior.effective_sample_size)


def known_product(
    p: Distribution, prior: LatentDensity
) -> tuple[Distribution, Distribution | GaussianFactor | None, LogFactor | None]:
    """The part of ``p`` times ``prior`` that has a closed form, and what is left of the prior.

    Args:
        p: the likelihood expert, batch ``*B`` and event ``(D,)``.
        prior: the prior expert.

    Returns:
        The known product (``p``, broadcast, if nothing is known), the factor that ``p`` was multiplied
        with there, and the log of the rest, ``(*S, *B, D) -> (*S, *B)``: ``None`` if there is none.

    Raises:
        TypeError: if ``p`` is a point mass.
        ValueError: if latent sizes or devices differ.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> p = diag_gaussian(torch.zeros(2), torch.ones(2))
        >>> product, _, rest = known_product(p, Density(lambda z: z.square().sum(-1), base=p))
        >>> product.variance, rest(torch.ones(2))
        (tensor([0.5000, 0.5000]), tensor(-2.))
    """
    if isinstance(prior, Density) and prior.is_flat:
        return p, None, None
    _check_experts(p, prior)
    base = prior.base if isinstance(prior, Density) else prior
    if base is not None and has_closed_form(p, base):
        return product_of_experts(p, base), base, _negative_energy(prior)
    if base is None:
        return p, None, _negative_energy(prior)
    batch = torch.broadcast_shapes(p.batch_shape, base.batch_shape)
    return p if batch == p.batch_shape else p.expand(batch), None, prior.log_prob


def _negative_energy(prior: LatentDensity) -> LogFactor | None:
    if not isinstance(prior, Density) or prior.energy is None:
        return None
    return lambda latent: -prior.checked_energy(latent)


def _check_experts(p: Distribution, prior: LatentDensity) -> None:
    if isinstance(p, Delta):
        raise TypeError(
            "p must have a width for the prior to act on, got a point mass (Delta); use a head that "
            "predicts a distribution, or give the prior to the planner as a cost"
        )
    base = prior.base if isinstance(prior, Density) else prior
    if base is None:
        return
    if base.event_shape != p.event_shape:
        raise ValueError(
            f"prior must have the latent size of p, {tuple(p.event_shape)}, got {tuple(base.event_shape)}"
        )
    ours, theirs = _like(p).device, _like(base).device
    if ours != theirs:
        raise ValueError(f"prior must be on the device of p, {ours}, got {theirs}; move it there")


def _log_integral(p: Distribution, prior: Distribution | GaussianFactor, product: Distribution) -> Tensor:
    r"""Log of the integral of p times prior: it is p(Z) prior(Z) / product(Z) at any Z."""
    point = product.mean
    if isinstance(product, Mixture):
        # The mean may lie in a gap; where the heaviest component is, digits are not lost.
        best = product.log_weights.argmax(-1)[..., None, None]
        point = torch.take_along_dim(product.components.mean, best, -2).squeeze(-2)
    return p.log_prob(point) + prior.log_prob(point) - product.log_prob(point)


def _draw(
    p: Distribution, num_particles: int, generator: torch.Generator | None, shared_noise: bool
) -> tuple[Tensor, Tensor]:
    """Particles ``(K, *B, D)`` and the log of their equal weights, with gradients one way or the other."""
    size = noise_dim(p)
    if size is not None:
        rows = [1] * (len(p.batch_shape) - 1) if shared_noise else p.batch_shape[1:]
        shape = (num_particles, *p.batch_shape[:1], *rows, size)
        like = _like(p)
        noise = torch.randn(shape, generator=generator, dtype=like.dtype, device=like.device)
        particles = from_noise(p, noise)
    elif generator is None and p.has_rsample:
        particles = p.rsample((num_particles,))
    else:
        particles = sample(p, (num_particles,), generator=generator)
    weight = particles.new_full((), -math.log(num_particles))
    if torch.is_grad_enabled() and (not p.has_rsample or (size is None and generator is not None)):
        # The draws cannot move: their probability does (the likelihood ratio, whose value is 1).
        log_prob = p.log_prob(particles).movedim(0, -1)
        weight = weight + log_prob - log_prob.detach()
    return particles, weight


def _weigh(particles: Tensor, before: Tensor, log_factor: Tensor, quiet: bool) -> tuple[Tensor, Tensor]:
    """Log weights ``(*B, K)`` and log evidence ``(*B)``; faults as :func:`fuse` says."""
    log_weights = before + log_factor
    log_evidence = log_weights.logsumexp(-1)
    # One look at one number a row finds nan, infinity and rows without any weight.
    if bool(log_evidence.isfinite().all()):
        return log_weights, log_evidence
    if not bool(particles.isfinite().all()):
        raise ValueError("p must give finite latents, got NaN or infinite particles")
    log_weights = torch.where(log_weights.isnan() | log_weights.isposinf(), -math.inf, log_weights)
    dead = (log_weights == -math.inf).all(-1)
    if not quiet:
        _warn(dead)
    # Replaced before the sum: its gradient at minus infinity alone would be nan.
    log_weights = torch.where(dead.unsqueeze(-1), before, log_weights)
    return log_weights, torch.where(dead, -math.inf, log_weights.logsumexp(-1))


def _warn(dead: Tensor) -> None:
    warnings.warn(
        f"the prior gives {int(dead.sum())} of {dead.numel()} rows no weight at all (they fall back to the "
        "unweighted particles), or a weight is nan or inf (it counts as zero): more particles or a smoother "
        "prior help where the prediction hardly reaches the prior; check the task",
        RuntimeWarning,
        stacklevel=4,
    )


def _like(p: Distribution | GaussianFactor) -> Tensor | NoiseDistribution:
    """Something with the dtype and device of the latents."""
    if isinstance(p, NoiseDistribution):
        return p
    if isinstance(p, GaussianFactor):
        return p.information
    if isinstance(p, ParticleBelief):
        return p.particles
    try:
        return p.mean
    except NotImplementedError:  # a distribution of the user's own
        return p.sample()


def _broadcasts(shape: torch.Size, target: torch.Size) -> bool:
    if len(shape) > len(target):
        return False
    return all(got in (1, want) for got, want in zip(shape[::-1], target[::-1], strict=False))
