"""The predictor, fused with a prior."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.distributions import Distribution

from torchrl_vjepa.distributions import Density, GaussianFactor, point_estimate
from torchrl_vjepa.fusion import Fusion, fuse, known_product
from torchrl_vjepa.generators import pack_generator, unpack_generator
from torchrl_vjepa.predictor.model import PredictiveModel
from torchrl_vjepa.predictor.predictor import Predictor
from torchrl_vjepa.priors import LatentDensity, Prior, Task

__all__ = ["FusedPredictor"]


class FusedPredictor(PredictiveModel):
    r"""Hard fusion of the dynamics with a prior by product of experts (``eq:bjepa_posterior``).

    :math:`p(Z_T \mid Z_C, \eta) \propto p_{\text{like}}(Z_T \mid Z_C)\, p_{\text{prior}}(Z_T \mid \eta)`,
    in closed form for Gaussians, also of mixtures of them, and by importance weights for any other head or
    prior (:func:`~torchrl_vjepa.fusion.fuse`). It is again a transition, with the attributes of the
    predictor. Soft fusion, in training, is :class:`~torchrl_vjepa.objectives.BJEPALoss`.

    As a TensorDictModule it also reads the task, where the prior takes one: the entry of the next step,
    if it is time-indexed.

    Args:
        predictor: the likelihood expert :math:`p_{\text{like}}`, with a head that has a width (not a
            :class:`~torchrl_vjepa.heads.DeltaHead`).
        prior: the prior expert: a :class:`~torchrl_vjepa.priors.Prior`, a density over latents, or a
            callable without arguments that returns one. ``None`` is the flat prior: the predictor's own
            distribution.
        num_particles: of importance weights.
        generator: source of randomness of importance weights, on the device of the latents; the global
            one if ``None``.
        return_stats: whether :meth:`forward` also writes ``("fusion_stats", "log_evidence")`` and
            ``("fusion_stats", "effective_sample_size")``, of shape ``(*B)``; the latter is
            ``num_particles`` where the product is exact.

    Raises:
        ValueError: if the prior has another latent size, or ``num_particles`` is not positive.
        TypeError: if the prior is none of the above.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import Density, GaussianPrior, Predictor
        >>> fused = FusedPredictor(Predictor(4), GaussianPrior(4))
        >>> fused.dist(torch.zeros(7, 4)).mean.shape
        torch.Size([7, 4])
        >>> keep_out = Density(lambda z: 50.0 * (1.0 - z.norm(dim=-1)).clamp_min(0.0))
        >>> fused = FusedPredictor(Predictor(4), keep_out)
        >>> fused.fuse(torch.zeros(7, 4)).effective_sample_size.shape
        torch.Size([7])
    """

    def __init__(
        self,
        predictor: Predictor,
        prior: Prior | LatentDensity | Callable[[], LatentDensity] | None = None,
        *,
        num_particles: int = 128,
        generator: torch.Generator | None = None,
        return_stats: bool = False,
    ) -> None:
        super().__init__()
        if num_particles < 1:
            raise ValueError(f"num_particles must be at least 1, got {num_particles}")
        if not (prior is None or callable(prior) or isinstance(prior, LatentDensity)):
            raise TypeError(
                "prior must be a Prior, a density over latents, a callable that returns one, or None, got "
                f"{type(prior).__name__}"
            )
        size = _latent_dim(prior)
        if size is not None and size != predictor.latent_dim:
            raise ValueError(
                f"prior must have the latent size of the predictor, {predictor.latent_dim}, got {size}"
            )
        self.predictor = predictor
        self.prior = prior
        self.num_particles, self.generator = num_particles, generator
        for name in ("latent_dim", "action_dim", "side_info_dim", "skips", "how"):
            setattr(self, name, getattr(predictor, name))
        for name in ("latent_key", "action_key", "side_info_key"):
            setattr(self, name, getattr(predictor, name))
        self.in_keys, self.out_keys = list(predictor.in_keys), list(predictor.out_keys)
        if isinstance(prior, Prior):
            self.in_keys += [key for key in prior.in_keys if key not in self.in_keys]
        self.return_stats = return_stats
        if return_stats:
            self.out_keys += [("fusion_stats", "log_evidence"), ("fusion_stats", "effective_sample_size")]

    def dist(
        self,
        latent: Tensor,
        action: Tensor | None = None,
        *,
        skip: int = 1,
        side_info: Tensor | None = None,
        task: Task = None,
    ) -> Distribution:
        """The fused distribution of the latent ``skip`` steps ahead.

        Args:
            latent: of shape ``(*B, D)``.
            action: as for :meth:`Predictor.dist`.
            skip: as for :meth:`Predictor.dist`.
            side_info: as for :meth:`Predictor.dist`.
            task: what the prior is called with; its batch broadcasts against ``*B``.

        Returns:
            Distribution with batch ``*B`` and event ``(D,)``.
        """
        p = self.predictor.dist(latent, action, skip=skip, side_info=side_info)
        density = self._density(task)
        # Planners call this at every step: the evidence, which costs three densities, is not needed.
        product, _, rest = known_product(p, density)
        return product if rest is None else self._fuse(p, density, self.generator, False).posterior

    def fuse(
        self,
        latent: Tensor,
        action: Tensor | None = None,
        *,
        skip: int = 1,
        side_info: Tensor | None = None,
        task: Task = None,
        generator: torch.Generator | None = None,
        shared_noise: bool = False,
    ) -> Fusion:
        """The fused distribution, with its evidence and effective sample size.

        Args:
            latent: of shape ``(*B, D)``.
            action: as for :meth:`Predictor.dist`.
            skip: as for :meth:`Predictor.dist`.
            side_info: as for :meth:`Predictor.dist`.
            task: what the prior is called with; its batch broadcasts against ``*B``.
            generator: source of randomness of importance weights; the module's by default.
            shared_noise: common random numbers, see :func:`~torchrl_vjepa.fusion.fuse`.

        Returns:
            What :func:`~torchrl_vjepa.fusion.fuse` gives.

        Raises:
            ValueError: if a task is given to a prior that takes none.
        """
        p = self.predictor.dist(latent, action, skip=skip, side_info=side_info)
        generator = self.generator if generator is None else generator
        return self._fuse(p, self._density(task), generator, shared_noise)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the one-step point prediction, and what ``return_stats`` adds.

        Args:
            tensordict: holds what ``in_keys`` names; a task as ``(*B, *task)``, or ``(*B, H, *task)`` of
                which the first is taken.

        Returns:
            The same tensordict with the entries of ``out_keys``.

        Raises:
            KeyError: if an entry is missing.
        """
        fusion = self.fuse(**self._inputs(tensordict))
        point = point_estimate(fusion.posterior, self.how, generator=self.generator)
        tensordict.set(self.out_keys[0], point)
        if self.return_stats:
            size = fusion.effective_sample_size
            if size is None:
                size = torch.full_like(fusion.log_evidence, self.num_particles)
            for key, value in zip(self.out_keys[1:], (fusion.log_evidence, size), strict=True):
                tensordict.set(key, value)
        return tensordict

    def _inputs(self, tensordict: TensorDictBase) -> dict[str, Any]:
        inputs = super()._inputs(tensordict)
        if isinstance(self.prior, Prior) and self.prior.in_keys:
            batch_ndim = inputs["latent"].ndim - 1
            tasks = self.prior.along(tensordict, batch_ndim, horizon=1)
            inputs["task"] = {key: value.select(batch_ndim, 0) for key, value in tasks.items()}
        return inputs

    def _fuse(
        self, p: Distribution, prior: LatentDensity, generator: torch.Generator | None, shared_noise: bool
    ) -> Fusion:
        return fuse(
            p, prior, num_particles=self.num_particles, generator=generator, shared_noise=shared_noise
        )

    def _density(self, task: Task) -> LatentDensity:
        if isinstance(self.prior, Prior):
            return self.prior(task)
        if task is not None:
            raise ValueError(
                f"task must be None for a prior that takes none, {type(self.prior).__name__}; give a Prior"
            )
        if self.prior is None:
            return Density()
        return self.prior if isinstance(self.prior, LatentDensity) else self.prior()

    def __getstate__(self) -> dict[str, Any]:
        generator = None if self.generator is None else pack_generator(self.generator)
        return {**super().__getstate__(), "generator": generator}

    def __setstate__(self, state: dict[str, Any]) -> None:
        packed = state["generator"]
        generator = None if packed is None else unpack_generator(packed)
        super().__setstate__({**state, "generator": generator})


def _latent_dim(prior: object) -> int | None:
    """The latent size of a prior, where it tells."""
    if isinstance(prior, Density):
        prior = prior.base
    if isinstance(prior, (Distribution, GaussianFactor)):
        return prior.event_shape[-1] if prior.event_shape else 0
    return getattr(prior, "latent_dim", None)
