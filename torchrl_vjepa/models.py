"""The models of the paper as TensorDictModules: an encoder and a predictive distribution."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Independent
from torchrl.modules import WorldModelWrapper

from torchrl_vjepa.distributions import diag_gaussian, point_estimate
from torchrl_vjepa.heads import TargetScale
from torchrl_vjepa.predictor import FusedPredictor, Predictor
from torchrl_vjepa.priors import GaussianPrior, LatentDensity, Prior

__all__ = ["BJEPA", "JEPA", "LatentModel", "VJEPA"]


class _PointTransition(nn.Module):
    """``(latent, action) -> next latent``: what a TorchRL transition model is."""

    def __init__(self, predictor: TensorDictModuleBase, how: Literal["mean", "mode", "sample"]) -> None:
        super().__init__()
        self.predictor = predictor
        self.how = how

    def forward(self, latent: Tensor, action: Tensor | None = None) -> Tensor:
        return point_estimate(self.predictor.dist(latent, action), self.how)


class LatentModel(TensorDictModuleBase):
    r"""An encoder and a one-step transition in its latent space: what planners and reward heads need.

    Reads the keys of the encoder and writes ``latent``; where the input holds an action too (or the
    system has none), it also writes the prediction ``("next", "latent")``.

    Args:
        encoder: TensorDictModule that writes the latent.
        predictor: the transition: a TensorDictModule with ``dist(latent, action)``, ``latent_dim``,
            ``action_dim``, ``latent_key`` and ``action_key``; its ``latent_key`` must be what the
            encoder writes.

    Raises:
        ValueError: if encoder and predictor do not agree on the key of the latent.

    Examples:
        >>> from torchrl_vjepa import JEPA, PixelAR, VJEPA
        >>> all(issubclass(model, LatentModel) for model in (JEPA, VJEPA, PixelAR))
        True
    """

    def __init__(self, encoder: TensorDictModuleBase, predictor: TensorDictModuleBase) -> None:
        super().__init__()
        written = [unravel_key(key) for key in encoder.out_keys]
        if unravel_key(predictor.latent_key) not in written:
            raise ValueError(
                f"encoder must write the predictor's latent_key={predictor.latent_key!r}, "
                f"but its out_keys are {list(encoder.out_keys)}"
            )
        self.encoder = encoder
        self.predictor = predictor
        known = {*written, *(unravel_key(key) for key in encoder.in_keys)}
        self.in_keys = [
            *encoder.in_keys,
            *(key for key in predictor.in_keys if unravel_key(key) not in known),
        ]
        self.out_keys = [*encoder.out_keys, *self._predicted_keys()]

    @property
    def latent_key(self) -> NestedKey:
        """Where the latent is written."""
        return self.predictor.latent_key

    @property
    def action_key(self) -> NestedKey:
        """Where the action is read."""
        return self.predictor.action_key

    def _predicted_keys(self) -> list[NestedKey]:
        return list(self.predictor.out_keys)

    def _predict(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.predictor(tensordict)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Encode and, where there is an action, predict.

        Args:
            tensordict: observations (and what else the encoder reads), optionally actions.

        Returns:
            The same tensordict with the entries of ``out_keys``.
        """
        tensordict = self.encoder(tensordict)
        if all(tensordict.get(key, None) is not None for key in self.predictor.in_keys):
            tensordict = self._predict(tensordict)
        return tensordict

    def as_world_model(
        self,
        reward_model: TensorDictModuleBase,
        *,
        how: Literal["mean", "mode", "sample"] = "mean",
    ) -> WorldModelWrapper:
        """The model as TorchRL's ``WorldModelWrapper``: ``latent, action -> latent -> reward``.

        Parameters are shared, not copied: what the loss trains is what the wrapper predicts with.

        Args:
            reward_model: TensorDictModule that reads the *next* latent (and the action) and writes the
                reward.
            how: which point of the predictive distribution is the next latent.

        Returns:
            The wrapper, with root keys, as ``ModelBasedEnvBase`` expects.

        Raises:
            ValueError: if ``how`` is unknown, or the predictor needs side information.
        """
        if how not in ("mean", "mode", "sample"):
            raise ValueError(f"how must be 'mean', 'mode' or 'sample', got {how!r}")
        if getattr(self.predictor, "side_info_dim", 0):
            raise ValueError(
                "a world model has no side information: the predictor must have side_info_dim=0, got "
                f"{self.predictor.side_info_dim}"
            )
        in_keys = [self.latent_key]
        if self.predictor.action_dim:
            in_keys.append(self.action_key)
        transition = TensorDictModule(
            _PointTransition(self.predictor, how), in_keys=in_keys, out_keys=[self.latent_key]
        )
        return WorldModelWrapper(transition, reward_model)


class JEPA(LatentModel):
    r"""Joint-embedding predictive model: an encoder and a deterministic transition.

    :math:`Z_t = f_\theta(x_{\le t})` and :math:`\hat Z_{t+1} = g_\phi(Z_t, u_t)`, as in the paper's section
    "JEPA: Background and Deterministic Formulation" (``eq:context_encoder``, ``eq:context_predictor``).
    The target encoder is no part of it: the loss makes one.

    Args:
        encoder: TensorDictModule that writes the latent; its first out key is the latent's.
        predictor: the predictive model; its ``latent_key`` must be what the encoder writes.

    Raises:
        ValueError: if encoder and predictor do not agree on the key of the latent.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_vjepa import DeltaHead, Predictor, linear_encoder
        >>> model = JEPA(linear_encoder(20, 4), Predictor(4, action_dim=2, head=DeltaHead()))
        >>> out = model(TensorDict(observation=torch.zeros(3, 20), action=torch.zeros(3, 2), batch_size=3))
        >>> out["latent"].shape, out["next", "latent"].shape
        (torch.Size([3, 4]), torch.Size([3, 4]))
    """

    predictor: Predictor

    def __init__(self, encoder: TensorDictModuleBase, predictor: Predictor) -> None:
        super().__init__(encoder, predictor)


class VJEPA(JEPA):
    r"""Variational JEPA: a predictive *distribution* and a target distribution.

    :math:`p_\phi(Z_{t+\Delta} \mid Z_t, \xi, u)` (``eq:vjepa_predictive_model``) is the predictor's;
    :math:`q_{\theta'}(Z_T \mid x_T) = \mathcal N(f_{\theta'}(x_T), \mathrm{diag}(\sigma^2_{\theta'}))`
    (``eq:vjepa_inference_target``) takes its mean from the target encoder that the loss keeps, and its
    scale from ``target_scale``.

    Besides what :class:`JEPA` writes, the prediction's mean and standard deviation are written to
    ``loc`` and ``scale``.

    Args:
        encoder: TensorDictModule that writes the latent.
        predictor: the predictive model.
        target_scale: standard deviation of the target distribution, of the observation: a module
            ``(*B, O) -> (*B, D)``, for instance :class:`TargetScale`, which is the default (one learned
            number per dimension, starting at 1).
        observation_key: what ``target_scale`` reads; the encoder's first in key by default.

    Raises:
        ValueError: if encoder and predictor do not agree on the key of the latent.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_vjepa import Predictor, linear_encoder
        >>> model = VJEPA(linear_encoder(20, 4), Predictor(4, action_dim=2))
        >>> out = model(TensorDict(observation=torch.zeros(3, 20), action=torch.zeros(3, 2), batch_size=3))
        >>> out["loc"].shape, out["scale"].shape
        (torch.Size([3, 4]), torch.Size([3, 4]))
    """

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        predictor: Predictor,
        *,
        target_scale: nn.Module | None = None,
        observation_key: NestedKey | None = None,
    ) -> None:
        super().__init__(encoder, predictor)
        if target_scale is None:
            target_scale = TargetScale(predictor.latent_dim)
        self.observation_key: NestedKey = encoder.in_keys[0] if observation_key is None else observation_key
        self.target_scale = TensorDictModule(
            target_scale, in_keys=[self.observation_key], out_keys=["target_scale"]
        )

    def _predicted_keys(self) -> list[NestedKey]:
        return ["loc", "scale", *self.predictor.out_keys]

    def _predict(self, tensordict: TensorDictBase) -> TensorDictBase:
        p = self.predictor.dist_of(tensordict)
        tensordict.set("loc", p.mean)
        tensordict.set("scale", p.stddev)
        return tensordict.set(self.predictor.out_keys[0], point_estimate(p, self.predictor.how))

    def target_dist(self, latent: Tensor, observation: Tensor) -> Independent:
        r"""Target distribution :math:`q_{\theta'}(Z_T \mid x_T)` around a target latent.

        Args:
            latent: :math:`f_{\theta'}(x_T)`, of shape ``(*B, D)``.
            observation: :math:`x_T`, of shape ``(*B, O)``.

        Returns:
            Diagonal Gaussian with batch ``*B`` and event ``(D,)``.
        """
        return diag_gaussian(latent, self.target_scale.module(observation))


class BJEPA(VJEPA):
    r"""Bayesian JEPA: the dynamics of a :class:`VJEPA` and a structural prior, fused by product of experts.

    Trained by :class:`~torchrl_vjepa.objectives.BJEPALoss`; :meth:`fuse` gives the transition
    :math:`p(Z_T \mid Z_C, \eta) \propto p_{\text{like}}(Z_T \mid Z_C)\, p_{\text{prior}}(Z_T \mid \eta)`
    (``eq:bjepa_posterior``). As a module it writes what a VJEPA writes: the unfused prediction.

    Args:
        encoder: TensorDictModule that writes the latent.
        predictor: the likelihood expert.
        structural_prior: :math:`p_{\text{struct}}`; a learned static Gaussian that starts at
            :math:`\mathcal N(0, I)` by default, as in the paper's experiment.
        target_scale: see :class:`VJEPA`.
        observation_key: see :class:`VJEPA`.

    Raises:
        ValueError: if encoder and predictor do not agree on the key of the latent.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import GaussianPrior, Predictor, linear_encoder
        >>> model = BJEPA(linear_encoder(20, 4), Predictor(4))
        >>> model.fuse().dist(torch.ones(1, 4)).variance.max() < 1
        tensor(True)
        >>> goal = GaussianPrior(4, mean=torch.arange(4.0), std=1e-3)
        >>> model.fuse(goal).dist(torch.zeros(1, 4)).mean.round()
        tensor([[0., 1., 2., 3.]], grad_fn=...)
    """

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        predictor: Predictor,
        *,
        structural_prior: nn.Module | None = None,
        target_scale: nn.Module | None = None,
        observation_key: NestedKey | None = None,
    ) -> None:
        super().__init__(encoder, predictor, target_scale=target_scale, observation_key=observation_key)
        if structural_prior is None:
            structural_prior = GaussianPrior(predictor.latent_dim, learnable=True)
        # A TensorDictModule, so that the loss can reset and stack its parameters like all others.
        self.structural_prior_module = TensorDictModule(
            structural_prior, in_keys=[], out_keys=["structural_prior"]
        )

    @property
    def structural_prior(self) -> nn.Module:
        """The prior that shapes the dynamics in training."""
        return self.structural_prior_module.module

    def fuse(
        self,
        prior: Prior | LatentDensity | Callable[[], LatentDensity] | None = None,
        *,
        num_particles: int = 128,
        generator: torch.Generator | None = None,
        return_stats: bool = False,
    ) -> FusedPredictor:
        """The dynamics, fused with a prior.

        Args:
            prior: the prior expert; the structural prior by default.
            num_particles: see :class:`~torchrl_vjepa.predictor.FusedPredictor`, as the rest.
            generator: source of randomness of importance weights.
            return_stats: whether the module writes its statistics.

        Returns:
            A transition that shares its parameters with the model.
        """
        return FusedPredictor(
            self.predictor,
            self.structural_prior if prior is None else prior,
            num_particles=num_particles,
            generator=generator,
            return_stats=return_stats,
        )
