"""Several experts at once: a logical AND."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torch.distributions import (
    Distribution,
    Independent,
    LowRankMultivariateNormal,
    MultivariateNormal,
    Normal,
)

from torchrl_vjepa.distributions import (
    Density,
    GaussianFactor,
    LowRankGaussian,
    Mixture,
    diag_gaussian,
    full_gaussian,
    product_of_experts,
)
from torchrl_vjepa.priors.base import LatentDensity, Prior, Task, check_density

__all__ = ["ProductPrior"]

Energy = Callable[[Tensor], Tensor]


class ProductPrior(Prior):
    r"""Product of experts, :math:`p(Z \mid \eta) \propto \prod_i p_i(Z \mid \eta_i)^{w_i}`.

    All experts must agree: a logical AND. Gaussians of any kind and weight become one Gaussian in
    precision space, factors that are flat in some directions included; the rest becomes an energy on top
    of it. The density is that of the product up to a constant (which may depend on the task).

    A task is handed on: every expert takes its own entry of a mapping; a tensor goes to all of them. Where
    Gaussian experts contradict each other the product is the precise compromise, never empty; experts so
    sharp that the precision overflows are refused where the task is known (here, or in :meth:`bind`).

    Args:
        *priors: the experts; none is the flat prior.
        weights: :math:`w_i`, finite and at least 0: how much each counts; 1 by default, and 0 drops the
            expert exactly.

    Raises:
        ValueError: if a weight is negative or not finite, their number is wrong, the experts' latents
            differ in size, or the product of experts without tasks overflows.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import Ball, GaussianPrior, GoalPrior, RegionPrior
        >>> both = ProductPrior(GaussianPrior(2), GoalPrior(std=1.0), weights=(1.0, 3.0))
        >>> both(torch.ones(2)).mean, both(torch.ones(2)).variance
        (tensor([0.7500, 0.7500]), tensor([0.2500, 0.2500]))
        >>> wall = RegionPrior(Ball(torch.zeros(2), 1.0), "out", sharpness=10.0, task_key="obstacle")
        >>> ProductPrior(both, wall).in_keys
        ['task', 'obstacle']
    """

    priors: nn.ModuleList

    def __init__(self, *priors: Prior, weights: Sequence[float] | None = None) -> None:
        weights = (1.0,) * len(priors) if weights is None else tuple(float(w) for w in weights)
        if len(weights) != len(priors) or not all(0 <= w < math.inf for w in weights):
            raise ValueError(
                f"weights must be {len(priors)} finite numbers of at least 0, one for each prior, "
                f"got {weights}"
            )
        sizes = {prior.latent_dim for prior in priors} - {None}
        if len(sizes) > 1:
            raise ValueError(f"priors must be of the same latent, got latent_dim {sorted(map(str, sizes))}")
        active = [prior for prior, weight in zip(priors, weights, strict=True) if weight]
        keys = list(dict.fromkeys(key for prior in active for key in prior.in_keys))
        dims = {prior.task_ndim for prior in active if prior.in_keys}
        # With one kind of task it is a prior of this task; with several there is no single key.
        single = len(keys) == len(dims) == 1
        super().__init__(
            task_key=keys[0] if single else None,
            task_ndim=dims.pop() if single else 1,
            latent_dim=sizes.pop() if sizes else None,
        )
        self.priors, self.weights = nn.ModuleList(priors), weights
        self._keys = keys
        self.differentiable = all(prior.differentiable for prior in active)
        if not keys:
            check_density(self())

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries that the experts read, each once."""
        return list(self._keys)

    def _active(self) -> list[tuple[Prior, float]]:
        pairs = zip(self.priors, self.weights, strict=True)
        return [(prior, weight) for prior, weight in pairs if weight]  # type: ignore[misc]

    def along(
        self, tasks: Mapping[NestedKey, Tensor] | TensorDictBase, batch_ndim: int, horizon: int
    ) -> dict[NestedKey, Tensor]:
        """See :meth:`Prior.along`: the entries of all experts.

        Args:
            tasks: holds the entries of ``in_keys``, with batch ``*B``.
            batch_ndim: how many dimensions ``*B`` has.
            horizon: how many steps.

        Returns:
            The entries with a time dimension behind ``*B``.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if it has too few dimensions, or two experts mean different things by it.
        """
        merged: dict[NestedKey, Tensor] = {}
        for prior, _ in self._active():
            for key, value in prior.along(tasks, batch_ndim, horizon).items():
                if key in merged and merged[key].shape != value.shape:
                    raise ValueError(
                        f"the experts read the entry {key!r} in different ways, as {tuple(value.shape)} and "
                        f"{tuple(merged[key].shape)}; give them different task keys"
                    )
                merged[key] = value
        return merged

    def advanced(
        self, tasks: Mapping[NestedKey, Tensor] | TensorDictBase, batch_ndim: int
    ) -> dict[NestedKey, Tensor]:
        """What changes for any expert one step later.

        Args:
            tasks: holds the entries of ``in_keys``, with batch ``*B``.
            batch_ndim: how many dimensions ``*B`` has.

        Returns:
            The entries that change.
        """
        merged: dict[NestedKey, Tensor] = {}
        for prior, _ in self._active():
            merged.update(prior.advanced(tasks, batch_ndim))
        return merged

    def forward(self, task: Task = None) -> LatentDensity:
        """The product.

        Args:
            task: what the experts read.

        Returns:
            A distribution if all experts are Gaussian (and at most one of them, of weight 1, is a mixture
            of Gaussians), a :class:`GaussianFactor` if they are flat in some directions, else a
            :class:`Density`; flat without experts.
        """
        active = self._active()
        densities = [(prior(task), weight) for prior, weight in active]
        if len(densities) == 1 and densities[0][1] == 1.0:
            return densities[0][0]
        return _product(densities)


def _product(densities: list[tuple[LatentDensity, float]]) -> LatentDensity:
    gaussians: list[Distribution] = []
    factors: list[GaussianFactor] = []
    mixtures: list[tuple[Distribution, float]] = []
    energies: list[tuple[Energy, float]] = []
    queue = list(densities)
    while queue:
        p, weight = queue.pop(0)
        if isinstance(p, Density):
            if p.energy is not None:
                energies.append((p.checked_energy, weight))
            if p.base is not None:
                queue.append((p.base, weight))
        elif isinstance(p, GaussianFactor):
            factors.append(GaussianFactor(weight * p.precision, weight * p.information, weight * p.log_scale))
        elif isinstance(p, Mixture):
            mixtures.append((p, weight))
        else:
            gaussian = _power(p, weight)
            if gaussian is None:
                energies.append((_Negative(p), weight))
            else:
                gaussians.append(gaussian)
    base: Distribution | GaussianFactor | None = _merge(gaussians, factors)
    for mixture, weight in mixtures:
        # The power of a mixture is none, and two of them multiply to K^2 components.
        exact = weight == 1.0 and len(mixtures) == 1 and not isinstance(base, GaussianFactor)
        if exact and isinstance(mixture, Mixture) and _power(mixture.components, 1.0) is not None:
            base = mixture if base is None else product_of_experts(mixture, base)
        else:
            energies.append((_Negative(mixture), weight))
    if not energies:
        return Density() if base is None else base
    return Density(_Sum(energies), base)


def _power(p: Distribution, weight: float) -> Distribution | None:
    """A Gaussian to a power, normalised: its covariance divided by the weight; ``None`` for others."""
    shrink = weight**-0.5
    if isinstance(p, Independent) and isinstance(p.base_dist, Normal) and len(p.event_shape) == 1:
        return p if weight == 1.0 else diag_gaussian(p.mean, p.stddev * shrink)
    if isinstance(p, MultivariateNormal):
        return p if weight == 1.0 else full_gaussian(p.mean, p.scale_tril * shrink)
    if isinstance(p, LowRankGaussian):
        return p if weight == 1.0 else LowRankGaussian(p.mean, p.factor * shrink, p.scale * shrink)
    if isinstance(p, LowRankMultivariateNormal):
        return LowRankGaussian(p.loc, p.cov_factor * shrink, p.cov_diag.sqrt() * shrink)
    return None


def _merge(
    gaussians: list[Distribution], factors: list[GaussianFactor]
) -> Distribution | GaussianFactor | None:
    """Gaussians and factors as one: proper if one of them is."""
    proper = product_of_experts(*gaussians) if len(gaussians) > 1 else next(iter(gaussians), None)
    if not factors:
        return proper
    precision = functools.reduce(operator.add, [f.precision for f in factors])
    information = functools.reduce(operator.add, [f.information for f in factors])
    if proper is None:
        if len(factors) == 1:
            return factors[0]
        scale = functools.reduce(operator.add, [f.log_scale for f in factors])
        return GaussianFactor(precision, information, scale)
    # Around the mean of the proper part: what is near it loses no digits, sharp or far away as it may be.
    mean = proper.mean
    own = _precision(proper)
    total = own + precision
    pull = information - (precision @ mean.unsqueeze(-1)).squeeze(-1)
    root = torch.linalg.cholesky(total)
    shift = torch.cholesky_solve(pull.unsqueeze(-1), root).squeeze(-1)
    return MultivariateNormal(mean + shift, precision_matrix=total, validate_args=False)


def _precision(p: Distribution) -> Tensor:
    if isinstance(p, Independent):
        return torch.diag_embed(p.stddev.pow(-2))
    if isinstance(p, MultivariateNormal):
        return p.precision_matrix
    return torch.cholesky_inverse(torch.linalg.cholesky(p.covariance_matrix))  # type: ignore[attr-defined]


class _Negative:
    """The energy of a density: a class, and no lambda, which would see the loop's last variable."""

    def __init__(self, density: Distribution) -> None:
        self.density = density

    def __call__(self, latent: Tensor) -> Tensor:
        return -self.density.log_prob(latent)


class _Sum:
    """Weighted sum of energies."""

    def __init__(self, energies: list[tuple[Energy, float]]) -> None:
        self.energies = energies

    def __call__(self, latent: Tensor) -> Tensor:
        terms = [weight * energy(latent) for energy, weight in self.energies]
        return functools.reduce(operator.add, terms)
