"""Mixtures over latents, and ensembles as mixtures that tell their two kinds of uncertainty apart."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal

from torchrl_vjepa.distributions.modes import maximize_log_prob
from torchrl_vjepa.distributions.moments import mixture_moments, moments
from torchrl_vjepa.distributions.noise import NoiseDistribution, SearchSpace, full_precision
from torchrl_vjepa.distributions.sampling import from_noise, noise_dim

__all__ = ["Ensemble", "Mixture", "log_score"]

#: Mean-shift steps of the mode. The rate is linear; it is slow only where two modes are about to merge.
MODE_STEPS = 50


class Mixture(NoiseDistribution):
    r"""Mixture :math:`\sum_k \pi_k\, p_k(Z)` of distributions of one family.

    What torch's ``MixtureSameFamily`` lacks: a :attr:`mode`, gradients of draws, draws from a generator,
    covariance, and ``vmap``.

    **Gradients of draws** (:meth:`rsample`), for diagonal Gaussian components: implicit
    reparameterisation (Figurnov et al., 2018). The distributional transform
    :math:`S_d(Z) = F(Z_d \mid Z_{<d})` maps a draw to uniform numbers that do not depend on the
    parameters, hence :math:`\partial_\vartheta Z = -(\partial_Z S)^{-1}\, \partial_\vartheta S`. It is
    unbiased, also for the weights; its variance is large where modes are far apart, because moving mass
    then takes draws through the gap. Draws of other components carry no gradient.

    Args:
        logits: unnormalised :math:`\log \pi_k`, broadcastable to ``(*B, K)``.
        components: :math:`p_k`, batch ``(*B, K)`` and event ``(D,)``.

    Raises:
        ValueError: if the shapes do not fit.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> p = Mixture(torch.tensor([0.0, 1.0]), diag_gaussian(torch.tensor([[-3.0], [3.0]]), torch.ones(1)))
        >>> p.batch_shape, p.event_shape, p.mode
        (torch.Size([]), torch.Size([1]), tensor([3.]))
        >>> p.mean
        tensor([1.3864])
    """

    def __init__(self, logits: Tensor, components: Distribution) -> None:
        if not components.batch_shape or len(components.event_shape) != 1:
            raise ValueError(
                "components must have batch shape (*B, K) and event shape (D,), got "
                f"{tuple(components.batch_shape)} and {tuple(components.event_shape)}"
            )
        if logits.shape[-1:] != components.batch_shape[-1:]:
            raise ValueError(
                f"logits must have shape (*B, K) with K={components.batch_shape[-1]} components, "
                f"got {tuple(logits.shape)}"
            )
        self.components = components
        self.log_weights = logits.log_softmax(-1).expand(components.batch_shape)
        self._diagonal = _diagonal(components)
        size = noise_dim(components)
        self.has_rsample = self._diagonal is not None
        super().__init__(
            components.batch_shape[:-1],
            components.event_shape[0],
            # One more number chooses the component.
            1 + (size or 0),
            components if isinstance(components, NoiseDistribution) else components.mean,
        )
        if size is None:
            raise ValueError(
                f"components must be transforms of normal noise, got {type(components).__name__}; "
                "use Gaussians, mixtures or flows of this package"
            )

    @property
    def weights(self) -> Tensor:
        r"""Weights :math:`\pi_k`, of shape ``(*B, K)``."""
        return self.log_weights.exp()

    @property
    def mean(self) -> Tensor:
        """Mean of the components' means, ``(*B, D)``."""
        return self._average(self.components.mean)

    @property
    def within_variance(self) -> Tensor:
        r"""Mean of the components' variances, :math:`\mathbb E_k[\sigma_k^2]`, ``(*B, D)``."""
        return self._average(self.components.variance)

    @property
    def between_variance(self) -> Tensor:
        r"""Variance of the components' means, :math:`\mathrm{Var}_k[\mu_k]`, ``(*B, D)``."""
        means = self.components.mean
        return self._average((means - self._average(means).unsqueeze(-2)).square())

    @property
    def variance(self) -> Tensor:
        """The sum of both (law of total variance), ``(*B, D)``."""
        return self.within_variance + self.between_variance

    @property
    def covariance_matrix(self) -> Tensor:
        """The covariance, ``(*B, D, D)``."""
        return mixture_moments(self.weights, *moments(self.components))[1]

    @property
    def mode(self) -> Tensor:
        r"""The most probable point (MAP), ``(*B, D)``.

        For diagonal Gaussian components by mean shift from every component's mean,
        :math:`Z \leftarrow (\sum_k r_k \Lambda_k)^{-1} \sum_k r_k \Lambda_k \mu_k` with responsibilities
        :math:`r_k`, which never descends; for others by
        :func:`~torchrl_vjepa.distributions.maximize_log_prob`. The first keeps gradients.
        """
        if self._diagonal is None:
            return maximize_log_prob(self)[0]
        loc, scale = full_precision(*self._diagonal)
        # In units of the widest component, so that no precision overflows.
        unit = scale.amax(-2, keepdim=True)
        precision = (unit / scale).square()
        point = loc.movedim(-2, 0)
        for _ in range(MODE_STEPS):
            weight = self._log_joint(point, loc, scale).softmax(-1).unsqueeze(-1) * precision
            point = (weight * loc).sum(-2) / weight.sum(-2)
        value = self._log_joint(point, loc, scale).logsumexp(-1)
        best = value.argmax(0, keepdim=True).unsqueeze(-1)
        return torch.take_along_dim(point, best, 0).squeeze(0).to(self.dtype)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density, in nats.

        Args:
            value: of shape ``(*S, *B, D)``.

        Returns:
            ``(*S, *B)``.
        """
        return self.log_joint(value).logsumexp(-1)

    def log_joint(self, value: Tensor) -> Tensor:
        r"""Log-density of the point and each component, :math:`\log \pi_k + \log p_k(Z)`.

        Its softmax over the last dimension is the responsibility of the components for the point.

        Args:
            value: of shape ``(*S, *B, D)``.

        Returns:
            ``(*S, *B, K)``.
        """
        return self.log_weights + self.components.log_prob(value.unsqueeze(-2))

    def from_noise(self, noise: Tensor) -> Tensor:
        """Draws: the last number chooses the component, the others are that component's.

        Args:
            noise: of shape ``(*S, *B, noise_dim)``.

        Returns:
            Latents of shape ``(*S, *B, D)``; gradients as the class says.
        """
        with torch.no_grad():
            index = self._choose(noise[..., -1])
            if self._diagonal is None:
                drawn = from_noise(self.components, noise[..., None, :-1])
                return _pick(drawn, index)
            loc, scale = self._diagonal
            shape = (*index.shape, *loc.shape[-2:])
            drawn = _pick(loc.expand(shape), index) + _pick(scale.expand(shape), index) * noise[..., :-1]
        return self._implicit(drawn) if torch.is_grad_enabled() else drawn

    def search_space(self) -> SearchSpace:
        """Starts where the components' own searches start, in their coordinates: the means of Gaussians.

        Returns:
            Starts ``(S, *B, n)``, the map from there to latents, and the scale of the starts.
        """
        p = self.components
        if isinstance(p, NoiseDistribution):
            inner, inner_map, unit = p.search_space()
        else:
            inner, inner_map, unit = p.mean.unsqueeze(0), torch.clone, p.stddev
        num = inner.shape[0]

        def to_point(variables: Tensor) -> Tensor:
            variables = variables.unflatten(0, (num, -1)).movedim(1, -2)
            return inner_map(variables).movedim(-2, 1).flatten(0, 1)

        unit = unit.expand_as(inner)
        return inner.movedim(-2, 1).flatten(0, 1), to_point, unit.movedim(-2, 1).flatten(0, 1)

    def expand(self, batch_shape: Sequence[int], _instance: Distribution | None = None) -> Mixture:
        """The same mixture, broadcast to ``batch_shape``.

        Args:
            batch_shape: the new batch shape.

        Returns:
            The expanded distribution.
        """
        shape = (*batch_shape, self.log_weights.shape[-1])
        return type(self)(self.log_weights.expand(shape), self.components.expand(shape))

    def _average(self, value: Tensor) -> Tensor:
        return (self.weights.unsqueeze(-1) * value).sum(-2)

    def _choose(self, noise: Tensor) -> Tensor:
        """Components ``(*S, *B)`` by their cumulative weights."""
        log_weights, noise = full_precision(self.log_weights, noise)
        cumulative = log_weights.exp().cumsum(-1)[..., :-1]
        return (torch.special.ndtr(noise).unsqueeze(-1) > cumulative).sum(-1)

    def _log_joint(self, point: Tensor, loc: Tensor, scale: Tensor) -> Tensor:
        normed = (point.unsqueeze(-2) - loc) / scale
        return self.log_weights - (0.5 * normed.square() + scale.log()).sum(-1)

    def _implicit(self, drawn: Tensor) -> Tensor:
        """The draws, with the gradient of the distributional transform's inverse."""
        if self._diagonal is None:  # narrows the type
            return drawn
        loc, scale, log_weights, point = full_precision(*self._diagonal, self.log_weights, drawn)
        normed = (point.unsqueeze(-2) - loc) / scale  # (*S, *B, K, D), as all below
        log_density = -0.5 * normed.square() - scale.log()
        before = log_weights.unsqueeze(-1) + log_density.cumsum(-1) - log_density
        weights = before.softmax(-2)  # of the components given the dimensions before d
        with torch.no_grad():
            # The tail that the point lies in has all its digits; the other one is 1 minus it.
            upper = (weights * torch.special.ndtr(normed)).sum(-2, keepdim=True) > 0.5
            sign = 1.0 - 2.0 * upper.to(normed.dtype)
        tail = torch.special.ndtr(sign * normed)
        transform = (sign * weights * tail).sum(-2)
        with torch.no_grad():
            density = (weights.log() + log_density).logsumexp(-2) - 0.5 * _LOG_2_PI
            # Where nothing can be drawn the density underflows: its inverse must not be infinite.
            inverse = (-density.maximum(-30.0 - scale.amax(-2).log())).exp()
            excess = sign * weights * (tail - (weights * tail).sum(-2, keepdim=True))
            # Row d, column i < d: how the weights that S_d uses change with Z_i.
            jacobian = (excess.mT @ (-normed / scale)) * inverse.unsqueeze(-1)
        change = ((transform - transform.detach()) * inverse).unsqueeze(-1)
        change = torch.linalg.solve_triangular(jacobian, change, upper=False, unitriangular=True)
        return drawn - change.squeeze(-1).to(drawn.dtype)


_LOG_2_PI = 1.8378770664093453


class Ensemble(Mixture):
    r"""Equally weighted mixture of the members of an ensemble.

    .. math::
        \mathrm{Var}[Z] = \underbrace{\tfrac1M \sum_m \sigma_m^2}_{\text{aleatoric}}
        + \underbrace{\mathrm{Var}_m[\mu_m]}_{\text{epistemic}}

    The first is noise that every member expects; the second is their disagreement, which more data
    removes (the paper's remark "Connection to ensemble world models"). Members are trained by their own
    likelihoods: :func:`log_score`.

    Draws carry gradients for members of any kind: a member is chosen by a number that does not depend on
    the parameters, and reparameterised by itself.

    Args:
        components: the members, batch ``(*B, M)`` and event ``(D,)``.

    Raises:
        ValueError: if the shapes do not fit.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> p = Ensemble(diag_gaussian(torch.tensor([[-1.0], [1.0]]), torch.full((1,), 0.5)))
        >>> p.aleatoric_variance, p.epistemic_variance, p.variance
        (tensor([0.2500]), tensor([1.]), tensor([1.2500]))
    """

    def __init__(self, components: Distribution) -> None:
        like = components if isinstance(components, NoiseDistribution) else components.mean
        num = components.batch_shape[-1:]
        super().__init__(torch.zeros(num, dtype=like.dtype, device=like.device), components)
        self.has_rsample = components.has_rsample

    @property
    def aleatoric_variance(self) -> Tensor:
        """Mean of the members' variances, ``(*B, D)``."""
        return self.within_variance

    @property
    def epistemic_variance(self) -> Tensor:
        """Variance of the members' means, ``(*B, D)``."""
        return self.between_variance

    def member_log_prob(self, value: Tensor) -> Tensor:
        """Log-density of every member, in nats.

        Args:
            value: of shape ``(*S, *B, D)``.

        Returns:
            ``(*S, *B, M)``.
        """
        return self.components.log_prob(value.unsqueeze(-2))

    def from_noise(self, noise: Tensor) -> Tensor:
        """Draws: the last number chooses the member, the others are that member's.

        Args:
            noise: of shape ``(*S, *B, noise_dim)``.

        Returns:
            Latents of shape ``(*S, *B, D)``.
        """
        return _pick(from_noise(self.components, noise[..., None, :-1]), self._choose(noise[..., -1]))

    def expand(self, batch_shape: Sequence[int], _instance: Distribution | None = None) -> Ensemble:
        """The same ensemble, broadcast to ``batch_shape``.

        Args:
            batch_shape: the new batch shape.

        Returns:
            The expanded distribution.
        """
        return Ensemble(self.components.expand((*batch_shape, self.log_weights.shape[-1])))


def log_score(p: Distribution, value: Tensor) -> Tensor:
    r"""The log-likelihood that a predictive distribution is trained by.

    :math:`\log p(Z)`; for an :class:`Ensemble` the mean of its members',
    :math:`\frac1M \sum_m \log p_m(Z)`. Trained by the likelihood of their mixture instead, members would
    share the data out among themselves, and their disagreement would be noise that they explain together.
    By Jensen's inequality it is at most the mixture's.

    Args:
        p: the distribution, batch ``*B`` and event ``(D,)``.
        value: of shape ``(*S, *B, D)``.

    Returns:
        ``(*S, *B)``, in nats.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> p = Ensemble(diag_gaussian(torch.tensor([[-1.0], [1.0]]), torch.ones(1)))
        >>> value = torch.tensor([1.0])
        >>> log_score(p, value) < p.log_prob(value)
        tensor(True)
    """
    return p.member_log_prob(value).mean(-1) if isinstance(p, Ensemble) else p.log_prob(value)


def _diagonal(components: Distribution) -> tuple[Tensor, Tensor] | None:
    if isinstance(components, Independent) and isinstance(components.base_dist, Normal):
        return components.base_dist.loc, components.base_dist.scale
    return None


def _pick(value: Tensor, index: Tensor) -> Tensor:
    """Rows ``(*S, *B, D)`` of ``(*S, *B, K, D)`` at components ``(*S, *B)``."""
    return torch.take_along_dim(value, index[..., None, None], -2).squeeze(-2)
