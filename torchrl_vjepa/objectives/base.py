"""What the losses of the joint-embedding models share: windows, target encoder, regularisers."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams, dispatch
from torch import Tensor
from torchrl.objectives.common import LossModule

from torchrl_vjepa.models import JEPA
from torchrl_vjepa.objectives.pairs import Pairs
from torchrl_vjepa.predictor import Predictor
from torchrl_vjepa.statistics import covariance_entropy, covariance_rank, masked_moments
from torchrl_vjepa.windows import (
    action_chunks,
    check_finite,
    pair_mask,
    read,
    step_mask,
)

__all__ = ["CollapseWarning", "LatentPredictionLoss"]


class CollapseWarning(UserWarning):
    """The latents of a model in training use fewer directions than they should.

    Examples:
        >>> issubclass(CollapseWarning, UserWarning)
        True
    """


class LatentPredictionLoss(LossModule):
    r"""Parent of :class:`JEPALoss` and :class:`VJEPALoss`.

    A batch of windows ``(B, T)`` (time last, as :class:`~torchrl.data.SliceSampler` gives them after
    ``batch.reshape(-1, T)``; a flat batch whose slices end with ``done`` works too) is encoded once by
    the context encoder :math:`f_\theta` and once by the target encoder :math:`f_{\theta'}`; for every
    skip :math:`\Delta` of the predictor the prediction from :math:`Z_t` and :math:`u_{t:t+\Delta-1}`
    meets the target at :math:`t + \Delta`. Pairs across the end of an episode (``("next", "done")`` or
    ``is_init``) and padded steps (``loss_mask_key``) count nowhere, batch statistics included.

    :math:`\theta'` follows :math:`\theta` by ``SoftUpdate(loss, eps=tau)``
    (``eq:target_encoder_weights_EMA``). Buffers of the encoder (whitening statistics) are not averaged:
    the target encoder reads the context encoder's own.

    **Several models as one batch.** Given a list of models of the same architecture, the loss trains
    all of them at once on the same data (stacked parameters, ``torch.func.vmap``): its entries get a
    leading dimension, one number per model, and their sum gives every model exactly the gradient that
    it has alone. :meth:`get_model` hands a trained one back. This is how restarts and ensembles are
    trained.

    Args:
        model: the model, or a list of models.
        stacked_data: whether the windows come with a leading dimension of models, ``(N, *B, T)``, one
            batch for each model of the list; otherwise all models see the same batch.
        variance_coeff: weight of VICReg's variance term,
            :math:`\frac1D\sum_d \max(0, 1 - \sqrt{\mathrm{Var}[Z_d] + 10^{-4}})`.
        covariance_coeff: weight of VICReg's covariance term, :math:`\frac1D \sum_{i \ne j} C_{ij}^2`.
        marginal_entropy_coeff: weight of the entropy term of the mutual information bound
            (``thm:mi_bound``) in its moment form,
            :math:`\mathrm{KL}(\mathcal N(m, S) \,\|\, \mathcal N(0, I))` of the aggregate latent
            moments: it maximises the Gaussian entropy :math:`\frac12 \log\det S` and keeps the scale.
        collapse_rank: a :class:`CollapseWarning` is given once when the effective rank of the latents
            falls under it; 0 for never.
        reduction: ``"mean"`` over pairs and skips, ``"sum"`` over pairs (mean over skips), or
            ``"none"``: losses of shape ``(B, T)``, without scalar diagnostics.

    Raises:
        ValueError: if a coefficient is negative or not finite, or ``reduction`` is unknown.

    Examples:
        >>> from torchrl_vjepa import JEPALoss
        >>> issubclass(JEPALoss, LatentPredictionLoss)
        True
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that the loss itself reads; those of the model are renamed in its modules.

        Attributes:
            done: end of an episode after this step. Defaults to ``("next", "done")``.
            is_init: beginning of an episode at this step. Defaults to ``"is_init"``.
        """

        done: NestedKey = ("next", "done")
        is_init: NestedKey = "is_init"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys

    encoder: TensorDictModuleBase
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams
    predictor: Predictor
    predictor_params: TensorDictParams
    target_predictor_params: TensorDictParams

    _schedulable_buffers = frozenset({"variance_coeff", "covariance_coeff", "marginal_entropy_coeff"})
    _vmap_randomness = "same"
    #: The effective rank is compared with ``collapse_rank`` in every so many calls: it makes a GPU wait.
    collapse_interval: int = 20

    def __init__(
        self,
        model: JEPA | Sequence[JEPA],
        *,
        stacked_data: bool = False,
        variance_coeff: float = 0.0,
        covariance_coeff: float = 0.0,
        marginal_entropy_coeff: float = 0.0,
        collapse_rank: float = 1.2,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        super().__init__()
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"reduction must be 'mean', 'sum' or 'none', got {reduction!r}")
        self.num_models = None if isinstance(model, JEPA) else len(model)
        models = [model] if isinstance(model, JEPA) else list(model)
        if not models or not all(isinstance(m, JEPA) for m in models):
            raise ValueError("model must be a JEPA or VJEPA, or a non-empty list of them")
        if stacked_data and self.num_models is None:
            raise ValueError("stacked_data=True needs a list of models, got a single model")
        self.stacked_data = stacked_data
        self.__dict__["_models"] = models
        self._functional("encoder", [m.encoder for m in models], create_target_params=True)
        self._functional("predictor", [m.predictor for m in models])
        self._shared_keys = [
            key
            for key, value in self.encoder_params.items(True, True)
            if not isinstance(value, torch.nn.Parameter)
        ]
        self._register_coeff("variance_coeff", variance_coeff)
        self._register_coeff("covariance_coeff", covariance_coeff)
        self._register_coeff("marginal_entropy_coeff", marginal_entropy_coeff)
        self.collapse_rank = float(collapse_rank)
        self.reduction = reduction
        self._calls = 0
        self._warned = False
        self._set_in_keys()
        self._out_keys: list[NestedKey] | None = None

    def _functional(
        self, name: str, modules: list[TensorDictModuleBase], create_target_params: bool = False
    ) -> None:
        several = self.num_models is not None
        self.convert_to_functional(
            modules if several else modules[0],
            name,
            expand_dim=len(modules) if several else None,
            create_target_params=create_target_params,
        )

    def _register_coeff(self, name: str, value: float) -> None:
        if not (math.isfinite(value) and value >= 0):
            raise ValueError(f"{name} must be finite and at least 0, got {value}")
        self.register_coeff_buffer(name, value)

    # TorchRL's conventions

    def _set_in_keys(self) -> None:
        model_keys = [*self.encoder.in_keys, *self.predictor.in_keys[1:]]
        self._in_keys = [*model_keys, self.tensor_keys.done, self.tensor_keys.is_init]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        self._set_in_keys()

    @property
    def in_keys(self) -> list[NestedKey]:
        """What ``forward`` reads; ``done`` and ``is_init`` may be missing."""
        return self._in_keys

    @in_keys.setter
    def in_keys(self, keys: list[NestedKey]) -> None:
        self._in_keys = keys

    @property
    def out_keys(self) -> list[NestedKey]:
        """What ``forward`` writes: ``loss_*``, then diagnostics."""
        if self._out_keys is not None:
            return self._out_keys
        keys: list[NestedKey] = list(self._loss_keys())
        if self.reduction != "none":
            keys += ["effective_rank", "latent_std", *self._diagnostic_keys()]
        return keys

    @out_keys.setter
    def out_keys(self, keys: list[NestedKey]) -> None:
        self._out_keys = keys

    # What a member adds

    def _loss_keys(self) -> Iterator[str]:
        yield from ("loss_variance", "loss_covariance", "loss_entropy")

    def _diagnostic_keys(self) -> Iterator[str]:
        yield from ()

    def _target(self, latent: Tensor, data: TensorDictBase, params: TensorDictBase) -> Tensor:
        """What is predicted, given the latents of the target encoder; ``(B, T, D)`` both."""
        return latent

    def _member_terms(
        self,
        pairs: list[Pairs],
        target_latent: Tensor,
        data: TensorDictBase,
        mask: Tensor | None,
        params: TensorDictBase,
    ) -> dict[str, Tensor]:
        """The member's own ``loss_*`` entries and diagnostics."""
        raise TypeError(f"{type(self).__name__} is not a loss by itself: use JEPALoss or VJEPALoss")

    def _member_params(self) -> TensorDictBase:
        return TensorDict({}, [] if self.num_models is None else [self.num_models])

    # The computation

    def get_model(self, index: int | None = None) -> JEPA:
        """The model with its trained parameters.

        Args:
            index: which one, if the loss was given a list: its parameters are copied from the stack
                into the model that stood at this place.

        Returns:
            The model that was given to the constructor.

        Raises:
            ValueError: if ``index`` is missing for a list, given for a single model, or out of range.
        """
        models: list[JEPA] = self.__dict__["_models"]
        if self.num_models is None:
            if index is not None:
                raise ValueError(f"index must be None for a single model, got {index}")
            return models[0]
        if index is None or not 0 <= index < self.num_models:
            raise ValueError(f"index must be in [0, {self.num_models - 1}], got {index}")
        for name, module in self._stacked_modules(models[index]):
            stacked = getattr(self, f"{name}_params").data[index]
            TensorDict.from_module(module).data.update_(stacked)
        return models[index]

    def _stacked_modules(self, model: JEPA) -> list[tuple[str, TensorDictModuleBase]]:
        return [("encoder", model.encoder), ("predictor", model.predictor)]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and diagnostics of a batch of windows.

        Args:
            tensordict: the windows, ``(*B, T)``, with the entries of ``in_keys``; not changed.

        Returns:
            A tensordict with entries ``loss_*`` (their sum is the objective) and detached diagnostics;
            scalars, or of shape ``(num_models,)``.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if a window is too short, shapes disagree, or a value that counts is not finite.
        """
        data, masks = self._read(tensordict)
        params = (
            self.encoder_params,
            self._target_params(),
            self.predictor_params,
            self._member_params(),
        )
        if self.num_models is None:
            terms = self._terms(data, masks, *params)
        else:
            in_dim = 0 if self.stacked_data else None
            terms = torch.vmap(
                self._terms,
                in_dims=(in_dim, in_dim, 0, 0, 0, 0),
                randomness=self._vmap_randomness,
            )(data, masks, *params)
        terms = {key: terms[key] for key in self.out_keys if key in terms}
        if "effective_rank" in terms:
            self._watch(terms["effective_rank"])
        out = TensorDict(terms, batch_size=[])
        self._clear_weakrefs(tensordict, out, "encoder_params", "target_encoder_params", "predictor_params")
        return out

    def _read(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, dict[str, Tensor]]:
        """Checked windows ``(B, T)`` and the masks of steps (``"steps"``) and pairs (``"<skip>"``)."""
        name = type(self).__name__
        required = [self.encoder.in_keys[0], *self.predictor.in_keys[1:]]
        entries = {key: read(tensordict, key, reader=name) for key in required}
        observation = entries[self.encoder.in_keys[0]]
        # dispatch() guesses the batch size wrongly where sizes agree by chance: read it off the data.
        event_dims = 1 if len(required) > 1 else observation.ndim - tensordict.ndim
        batch = entries[required[-1]].shape[: -event_dims or None]
        if not batch:
            raise ValueError(
                f"the input must be windows of shape (*B, T), got a batch of shape {tuple(batch)}"
            )
        if self.stacked_data and (len(batch) < 2 or batch[0] != self.num_models):
            raise ValueError(
                f"stacked_data=True needs windows of shape ({self.num_models}, *B, T), one batch for each "
                f"model, got {tuple(batch)}"
            )
        lead = (batch[0],) if self.stacked_data else ()
        shape = (*lead, -1, batch[-1])
        for key, value in entries.items():
            if value.shape[: len(batch)] != batch or value.ndim == len(batch):
                raise ValueError(
                    f"{key!r} must have shape {(*batch, '...')} like {required[-1]!r}, "
                    f"got {tuple(value.shape)}"
                )
            if not value.is_floating_point():
                raise ValueError(
                    f"{key!r} must be floating point, got {value.dtype}; convert it first "
                    "(ToTensorImage, DoubleToFloat or one-hot actions)"
                )
        longest = max(self.predictor.skips)
        if batch[-1] <= longest:
            raise ValueError(
                f"the windows must be longer than the largest skip {longest}, got T={batch[-1]}; "
                "sample longer slices (slice_len) or drop that skip"
            )
        # What an encoder with memory may read besides: state and beginnings of episodes.
        for key in (*self.encoder.in_keys[1:], self.tensor_keys.done):
            value = tensordict.get(key, None)
            if value is not None:
                entries[key] = value.reshape(*batch, *value.shape[len(batch) :])
        mask = step_mask(tensordict, self._loss_mask_keys(), batch)
        flags = [tensordict.get(key, None) for key in (self.tensor_keys.done, self.tensor_keys.is_init)]
        for i, flag in enumerate(flags):
            if flag is not None:
                if flag.shape not in (batch, (*batch, 1)):
                    raise ValueError(
                        f"{('done', 'is_init')[i]} must have shape {tuple(batch)} or {(*batch, 1)}, "
                        f"got {tuple(flag.shape)}"
                    )
                flags[i] = flag.reshape(shape)
        if not torch.compiler.is_compiling():
            for key in required:
                check_finite(entries[key], mask, key)
        if mask is not None:
            # Padding may hold anything: NaN times zero would still be NaN.
            for key in required:
                value = entries[key]
                keep = mask.reshape(mask.shape + (1,) * (value.ndim - mask.ndim))
                entries[key] = torch.where(keep, value, 0)
            mask = mask.reshape(shape)
        masks = {str(skip): pair_mask(flags[0], flags[1], mask, skip) for skip in self.predictor.skips}
        masks["steps"] = mask
        data = TensorDict(entries, batch_size=batch).reshape(shape)
        return data, {key: value for key, value in masks.items() if value is not None}

    def _target_params(self) -> TensorDictBase:
        if not self._shared_keys:
            return self.target_encoder_params
        target = TensorDict(
            dict(self.target_encoder_params.items()), self.target_encoder_params.batch_size
        ).clone(recurse=False)
        for key in self._shared_keys:
            target.set(key, self.encoder_params.get(key))
        return target

    def _encode(self, data: TensorDictBase, params: TensorDictBase) -> Tensor:
        with params.to_module(self.encoder):
            encoded = self.encoder(data.copy())
        latent = encoded.get(self.predictor.latent_key)
        return latent.float() if latent.dtype in (torch.float16, torch.bfloat16) else latent

    def _terms(
        self,
        data: TensorDictBase,
        masks: dict[str, Tensor],
        encoder_params: TensorDictBase,
        target_encoder_params: TensorDictBase,
        predictor_params: TensorDictBase,
        member_params: TensorDictBase,
    ) -> dict[str, Tensor]:
        mask = masks.get("steps")
        latent = self._encode(data, encoder_params)
        with torch.no_grad():
            target_latent = self._encode(data, target_encoder_params)
        target = self._target(target_latent, data, member_params)
        predictor = self.predictor
        action = data.get(predictor.action_key) if predictor.action_dim else None
        side_info = data.get(predictor.side_info_key) if predictor.side_info_dim else None
        pairs = []
        with predictor_params.to_module(predictor):
            for skip in predictor.skips:
                context = latent[:, :-skip]
                chunks = None if action is None else action_chunks(action, skip)
                info = None if side_info is None else side_info[:, skip:]
                p = predictor.dist(context, chunks, skip=skip, side_info=info)
                pair_target = target[:, skip:]
                pairs.append(Pairs(skip, p, pair_target, context, chunks, info, masks.get(str(skip))))
            with torch.autocast(latent.device.type, enabled=False):
                terms = self._member_terms(pairs, target_latent, data, mask, member_params)
        with torch.autocast(latent.device.type, enabled=False):
            mean, covariance = masked_moments(latent, mask)
            terms.update(self._regularisers(mean, covariance))
            if self.reduction != "none":
                covariance = covariance.detach()
                terms["effective_rank"] = covariance_rank(covariance)
                terms["latent_std"] = covariance.diagonal().clamp_min(0).sqrt().mean()
        if self.reduction == "none":
            terms = {
                key: value.expand(latent.shape[:2]) if value.ndim == 0 else value
                for key, value in terms.items()
                if key.startswith("loss_")
            }
        return terms

    def _regularisers(self, mean: Tensor, covariance: Tensor) -> dict[str, Tensor]:
        variance = covariance.diagonal()
        dim = mean.shape[-1]
        off_diagonal = covariance.pow(2).sum() - variance.pow(2).sum()
        # KL(N(m, S) || N(0, I)) = (tr S + |m|^2 - D - log det S) / 2; the entropy is the log det's half.
        trace = variance.sum() + mean.pow(2).sum()
        gaussian_constant = 0.5 * dim * math.log(2 * math.pi)
        entropy = covariance_entropy(covariance)
        return {
            "loss_variance": self.variance_coeff * (1 - (variance + 1e-4).sqrt()).relu().mean(),
            "loss_covariance": self.covariance_coeff * off_diagonal / dim,
            "loss_entropy": self.marginal_entropy_coeff * (0.5 * trace + gaussian_constant - entropy),
        }

    def _reduce(self, per_skip: list[Tensor], pairs: list[Pairs]) -> Tensor:
        """Reduce one number per pair, over pairs and skips, as ``reduction`` says."""
        if self.reduction == "none":
            length = per_skip[0].shape[1] + pairs[0].skip
            rows = []
            for value, pair in zip(per_skip, pairs, strict=True):
                if pair.mask is not None:
                    value = torch.where(pair.mask, value, 0)
                rows.append(torch.nn.functional.pad(value, (0, length - value.shape[1])))
            return torch.stack(rows).mean(0)
        means = torch.stack([pair.mean(value) for value, pair in zip(per_skip, pairs, strict=True)])
        if self.reduction == "sum":
            counts = [
                torch.ones_like(value) if pair.mask is None else pair.mask
                for value, pair in zip(per_skip, pairs, strict=True)
            ]
            means = means * torch.stack([count.sum() for count in counts])
        return means.mean()

    def _watch(self, rank: Tensor) -> None:
        if torch.compiler.is_compiling() or not self.training or self._warned:
            return
        self._calls += 1
        if (self._calls - 1) % self.collapse_interval or not self.collapse_rank:
            return
        low = rank.detach().min().item()
        if low < self.collapse_rank:
            self._warned = True
            which = "" if self.num_models is None else f" (model {int(rank.argmin())})"
            warnings.warn(
                f"the latents have collapsed: effective rank {low:.2f} of {self.predictor.latent_dim}{which} "
                f"is under collapse_rank={self.collapse_rank}; raise marginal_entropy_coeff or the VICReg "
                "coefficients, or lower the learning rate",
                CollapseWarning,
                stacklevel=3,
            )
