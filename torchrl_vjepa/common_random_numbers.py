r"""Common random numbers: the same noise for every plan that is compared.

The ranking of plans by sampled costs should not depend on which of them was lucky. A distribution that is
a transformation of noise, :math:`Z = T_p(\varepsilon)`, can be drawn with one :math:`\varepsilon` for all
rows: differences between plans then come from the plans.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch
from tensordict.nn.distributions import Delta as _TensorDictDelta
from tensordict.nn.distributions import OneHotCategorical as _TensorDictOneHot
from tensordict.nn.distributions.truncated_normal import TruncatedStandardNormal as _TensorDictTruncated
from torch import Tensor
from torch.distributions import (
    Bernoulli,
    Categorical,
    Cauchy,
    Distribution,
    Independent,
    Laplace,
    LowRankMultivariateNormal,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
    OneHotCategorical,
    TransformedDistribution,
    Uniform,
)
from torchrl.modules import Delta as _TorchRLDelta
from torchrl.modules import MaskedCategorical, MaskedOneHotCategorical
from torchrl.modules import OneHotCategorical as _TorchRLOneHot
from torchrl.modules.distributions.truncated_normal import TruncatedStandardNormal as _TorchRLTruncated

from torchrl_vjepa.belief import ParticleBelief
from torchrl_vjepa.distributions import Delta, NoiseDistribution, sample

__all__ = ["CommonNoise", "common_particle", "has_common_noise", "sample_common"]


@functools.singledispatch
def sample_common(p: Distribution, *, generator: torch.Generator | None = None, own_dims: int = 0) -> Tensor:
    r"""One draw per distribution, :math:`Z^{(m,i)} = T_{p_{m,i}}(\varepsilon^{(m)})`.

    The first batch dimension of ``p`` counts samples, which get noise of their own; the rest are rows, which
    share it. Gaussians (diagonal, full, low-rank, truncated) and the other location-scale families, their
    mixtures, their transformations (flows, ``TanhNormal``), particles, choices (categorical, one-hot, masked)
    and bits are drawn so; what else there is, independently (:func:`has_common_noise` tells). Two equal
    distributions give equal draws, and draws move with the parameters. Of a mixture, a common uniform number
    picks the component, in the order in which the components are kept; of particles, the particle; a choice
    is the quantile of its distribution at a common uniform number.

    Gradients flow to the parameters; for a mixture to those of the component that was picked, not to the
    weights. A family of one's own joins by ``@sample_common.register``.

    Args:
        p: batch shape ``(M, *B)``.
        generator: source of randomness; the global one if ``None``.
        own_dims: trailing batch dimensions that are no rows: each entry has noise of its own.

    Returns:
        Draws of shape ``(M, *B, *event_shape)``.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> p = diag_gaussian(torch.zeros(2, 3, 1), torch.tensor([1.0, 1.0, 2.0]).unsqueeze(-1))
        >>> z = sample_common(p, generator=torch.Generator().manual_seed(0)).squeeze(-1)
        >>> z[:, 0] == z[:, 1], z[:, 2] == 2 * z[:, 1], z[0] == z[1]
        (tensor([True, True]), tensor([True, True]), tensor([False, False, False]))
    """
    return sample(p, generator=generator)


def _noise_shape(batch: torch.Size, own_dims: int) -> tuple[int, ...]:
    """``(M, 1, ..., 1, *own)``: broadcasts against the batch."""
    rows = max(len(batch) - own_dims - 1, 0)
    return (*batch[: len(batch) - own_dims - rows], *[1] * rows, *batch[len(batch) - own_dims :])


def _normal(shape: tuple[int, ...], like: Tensor, generator: torch.Generator | None) -> Tensor:
    return torch.randn(shape, generator=generator, device=like.device, dtype=like.dtype)


def _uniform(shape: tuple[int, ...], like: Tensor, generator: torch.Generator | None) -> Tensor:
    noise = torch.rand(shape, generator=generator, device=like.device, dtype=like.dtype)
    limits = torch.finfo(like.dtype)
    return noise.clamp(limits.tiny, 1 - limits.eps)


@sample_common.register(_TensorDictDelta)
@sample_common.register(_TorchRLDelta)
def _(
    p: _TensorDictDelta | _TorchRLDelta, *, generator: torch.Generator | None = None, own_dims: int = 0
) -> Tensor:
    return p.rsample()


@sample_common.register
def _(p: Independent, *, generator: torch.Generator | None = None, own_dims: int = 0) -> Tensor:
    own = own_dims + p.reinterpreted_batch_ndims
    return sample_common(p.base_dist, generator=generator, own_dims=own)


@sample_common.register
def _(p: Normal, *, generator: torch.Generator | None = None, own_dims: int = 0) -> Tensor:
    noise = _normal(_noise_shape(p.batch_shape, own_dims), p.loc, generator)
    return p.loc + p.scale * noise


@sample_common.register(Cauchy)
@sample_common.register(Laplace)
@sample_common.register(Uniform)
def _(
    p: Cauchy | Laplace | Uniform, *, generator: torch.Generator | None = None, own_dims: int = 0
) -> Tensor:
    like = p.low if isinstance(p, Uniform) else p.loc
    return p.icdf(_uniform(_noise_shape(p.batch_shape, own_dims), like, generator))


@sample_common.register(_TensorDictTruncated)
@sample_common.register(_TorchRLTruncated)
def _(
    p: _TensorDictTruncated | _TorchRLTruncated,
    *,
    generator: torch.Generator | None = None,
    own_dims: int = 0,
) -> Tensor:
    return p.icdf(_uniform(_noise_shape(p.batch_shape, own_dims), p.a, generator))


@sample_common.register
def _(p: Bernoulli, *, generator: torch.Generator | None = None, own_dims: int = 0) -> Tensor:
    noise = _uniform(_noise_shape(p.batch_shape, own_dims), p.probs, generator)
    return (noise < p.probs).to(p.probs.dtype)


@sample_common.register
def _(p: Categorical, *, generator: torch.Generator | None = None, own_dims: int = 0) -> Tensor:
    return _choice(p.probs, own_dims, generator)


@sample_common.register(_TensorDictOneHot)
@sample_common.register(_TorchRLOneHot)
@sample_common.register(OneHotCategorical)
def _(
    p: OneHotCategorical | _TorchRLOneHot | _TensorDictOneHot,
    *,
    generator: torch.Generator | None = None,
    own_dims: int = 0,
) -> Tensor:
    choice = _choice(p.probs, own_dims, generator)
    dtype = p.probs.dtype if isinstance(p, OneHotCategorical) else torch.long
    return torch.nn.functional.one_hot(choice, p.probs.shape[-1]).to(dtype)


@sample_common.register(MaskedCategorical)
@sample_common.register(MaskedOneHotCategorical)
def _(
    p: MaskedCategorical | MaskedOneHotCategorical,
    *,
    generator: torch.Generator | None = None,
    own_dims: int = 0,
) -> Tensor:
    choice = _choice(p.probs, own_dims, generator)
    if p._sparse_mask:  # probabilities are those of the choices that the mask lists
        listed = p._mask.expand(*choice.shape, p._mask.shape[-1])
        choice = listed.gather(-1, choice.unsqueeze(-1)).squeeze(-1)
    if not isinstance(p, MaskedOneHotCategorical):
        return choice
    return torch.nn.functional.one_hot(choice, p.num_samples)


def _choice(probs: Tensor, own_dims: int, generator: torch.Generator | None) -> Tensor:
    """The quantile of categorical distributions ``(M, *B, K)`` at uniform numbers."""
    noise = _uniform((*_noise_shape(probs.shape[:-1], own_dims), 1), probs, generator)
    cumulative = probs.cumsum(dim=-1)
    # Divided by the sum as it is rounded, so that what has no probability at the end is never drawn.
    return (noise >= cumulative[..., :-1] / cumulative[..., -1:]).sum(dim=-1)


@sample_common.register
def _(p: MultivariateNormal, *, generator: torch.Generator | None = None, own_dims: int = 0) -> Tensor:
    shape = (*_noise_shape(p.batch_shape, own_dims), *p.event_shape)
    noise = _normal(shape, p.loc, generator)
    return p.loc + (p.scale_tril @ noise.unsqueeze(-1)).squeeze(-1)


@sample_common.register
def _(p: LowRankMultivariateNormal, *, generator: torch.Generator | None = None, own_dims: int = 0) -> Tensor:
    shape = _noise_shape(p.batch_shape, own_dims)
    factors = _normal((*shape, p.cov_factor.shape[-1]), p.loc, generator)
    noise = _normal((*shape, *p.event_shape), p.loc, generator)
    # The constructor keeps the factor unexpanded, so it broadcasts here.
    return p.loc + (p.cov_factor @ factors.unsqueeze(-1)).squeeze(-1) + p.cov_diag.sqrt() * noise


@sample_common.register
def _(p: NoiseDistribution, *, generator: torch.Generator | None = None, own_dims: int = 0) -> Tensor:
    shape = (*_noise_shape(p.batch_shape, own_dims), p.noise_dim)
    noise = torch.randn(shape, generator=generator, device=p.device, dtype=p.dtype)
    return p.from_noise(noise)


@sample_common.register
def _(p: MixtureSameFamily, *, generator: torch.Generator | None = None, own_dims: int = 0) -> Tensor:
    probs = p.mixture_distribution.probs
    parts = sample_common(p.component_distribution, generator=generator, own_dims=own_dims + 1)
    u = _uniform((*_noise_shape(p.batch_shape, own_dims), 1), probs, generator)
    # Counting up to K - 1 of the K bounds: the sum of all may be rounded below one.
    index = (u >= probs.cumsum(dim=-1)[..., :-1]).sum(dim=-1)
    index = index.reshape(*index.shape, 1, *[1] * len(p.event_shape))
    index = index.expand(*p.batch_shape, 1, *p.event_shape)
    return parts.gather(len(p.batch_shape), index).squeeze(len(p.batch_shape))


@sample_common.register
def _(p: ParticleBelief, *, generator: torch.Generator | None = None, own_dims: int = 0) -> Tensor:
    index = common_particle(p, generator=generator, own_dims=own_dims)
    return torch.take_along_dim(p.particles, index[..., None, None], -2).squeeze(-2)


@sample_common.register
def _(p: TransformedDistribution, *, generator: torch.Generator | None = None, own_dims: int = 0) -> Tensor:
    # Event dimensions that only the transforms make are batch dimensions of the base.
    extra = len(p.base_dist.batch_shape) - len(p.batch_shape)
    value = sample_common(p.base_dist, generator=generator, own_dims=own_dims + max(extra, 0))
    for transform in p.transforms:
        value = transform(value)
    return value


def has_common_noise(p: Distribution) -> bool:
    """Whether :func:`sample_common` draws with common noise, or independently for want of a rule.

    Args:
        p: any distribution.

    Returns:
        Whether it does.

    Examples:
        >>> from torch.distributions import Beta
        >>> has_common_noise(Independent(Normal(torch.zeros(2), 1.0), 1))
        True
        >>> has_common_noise(Independent(Beta(torch.ones(2), 1.0), 1))
        False
    """
    if isinstance(p, MixtureSameFamily):
        return has_common_noise(p.component_distribution)
    if isinstance(p, (Independent, TransformedDistribution)) and not isinstance(p, NoiseDistribution):
        return has_common_noise(p.base_dist)
    return sample_common.dispatch(type(p)) is not sample_common.dispatch(object)


def common_particle(
    p: ParticleBelief, *, generator: torch.Generator | None = None, own_dims: int = 0
) -> Tensor:
    """Which particles :func:`sample_common` takes.

    Args:
        p: batch shape ``(M, *B)``.
        generator: source of randomness; the global one if ``None``.
        own_dims: as for :func:`sample_common`.

    Returns:
        Their index, of shape ``(M, *B)``.

    Examples:
        >>> import torch
        >>> heavy = torch.tensor([0.0, -100.0]).expand(3, 2)
        >>> common_particle(ParticleBelief(torch.zeros(3, 2, 1), heavy))
        tensor([0, 0, 0])
    """
    # Particles are taken in their order, which means the same in all rows if their noise was shared.
    u = _uniform((*_noise_shape(p.batch_shape, own_dims), 1), p.particles, generator)
    return (u >= p.weights.cumsum(-1)[..., :-1]).sum(-1).expand(p.batch_shape)


class CommonNoise:
    r"""A transition that moves to one draw, with the same noise for every row.

    Iterated, it samples trajectories: the first batch dimension counts them, and the noise of each is common
    to all rows (candidate plans, environments) at every step.

    Args:
        transition: ``(latent (M, *B, D), action (M, *B, A)) -> Distribution``.
        generator: source of randomness; the global one if ``None``.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.belief import rollout
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> def walk(latent, action):
        ...     return diag_gaussian(latent + action, torch.ones_like(latent))
        >>> sampled = CommonNoise(walk, torch.Generator().manual_seed(0))
        >>> latents = rollout(sampled, torch.zeros(64, 5, 1), torch.zeros(64, 5, 3, 1))
        >>> latents.shape, bool((latents == latents[:, :1]).all())  # M = 64 trajectories of 5 equal plans
        (torch.Size([64, 5, 3, 1]), True)
    """

    def __init__(
        self, transition: Callable[[Tensor, Tensor], Distribution], generator: torch.Generator | None = None
    ) -> None:
        self.transition = transition
        self.generator = generator

    def __call__(self, latent: Tensor, action: Tensor) -> Delta:
        """One draw of the next latent.

        Args:
            latent: of shape ``(M, *B, D)``.
            action: of shape ``(M, *B, A)``.

        Returns:
            The point mass on it.
        """
        return Delta(sample_common(self.transition(latent, action), generator=self.generator))
