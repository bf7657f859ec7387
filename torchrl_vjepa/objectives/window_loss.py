"""Losses over windows of a replay buffer, for one model or for several as one batch."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams, dispatch
from torch import Tensor
from torchrl.objectives.common import LossModule

from torchrl_vjepa.objectives.blueprint import blueprint
from torchrl_vjepa.objectives.pairs import mean_over, normalised_weights
from torchrl_vjepa.stacking import features_first
from torchrl_vjepa.windows import check_finite, pair_mask, read, step_mask, with_action_code

__all__ = ["WindowLoss"]


class WindowLoss(LossModule):
    r"""Parent of the losses that read windows ``(*B, T)``, time last.

    Windows are what :class:`~torchrl.data.SliceSampler` gives after ``batch.reshape(-1, T)``; a flat
    batch whose slices end with ``done`` works too. Pairs of steps across the end of an episode
    (``("next", "done")`` or ``is_init``) and padded steps (``loss_mask_key``) count nowhere.

    **Several models as one batch.** Given a list of models of the same architecture, the loss trains all
    of them at once (stacked parameters, with ``torch.vmap`` where a module needs it): its entries get a
    leading dimension, one number for each model, and their sum gives every model exactly the gradient that
    it has alone; with Adam, and with ``SoftUpdate``, the models train as if they were alone. The random
    numbers of a step are shared by the models, so adding or removing one changes no other.
    :meth:`get_model` hands a trained one back. This is how restarts and ensembles are trained. A new loss
    over the best few trains them on: many starts a little, few of them longer (successive halving), chosen
    by the objective. The models share the coefficients of the loss, unless a coefficient's buffer has
    shape ``(num_models,)``: one number for each model.

    Args:
        model: the model, or a list of models.
        modules: names of the parts of a model whose parameters the loss takes, and the attribute of the
            model that holds each.
        targets: the names that get target parameters.
        skips: the distances of the pairs that the loss forms.
        skip_weights: one non-negative weight for each skip, normalised to sum to one; equal by default.
        stacked_data: whether the windows come with a leading dimension of models, ``(N, *B, T)``, one
            batch for each model of the list; otherwise all models see the same batch.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.

    Raises:
        ValueError: if the list is empty, its models differ in architecture or share parameters,
            ``stacked_data`` is set for a single model, or ``reduction`` is
            unknown.

    Examples:
        >>> from torchrl_vjepa import PixelARLoss, VJEPALoss
        >>> issubclass(VJEPALoss, WindowLoss), issubclass(PixelARLoss, WindowLoss)
        (True, True)
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
    _vmap_randomness = "same"
    #: Whether the modules take the stacked parameters of several models: then nothing is mapped.
    _stackable = False
    _model_type: type = torch.nn.Module

    def __init__(
        self,
        model: Any,
        modules: dict[str, str],
        *,
        targets: Sequence[str] = (),
        skips: Sequence[int] = (1,),
        skip_weights: Sequence[float] | None = None,
        stacked_data: bool = False,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        super().__init__()
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"reduction must be 'mean', 'sum' or 'none', got {reduction!r}")
        several = isinstance(model, Sequence)
        models = self._checked(model)
        if stacked_data and not several:
            raise ValueError("stacked_data=True needs a list of models, got a single model")
        self.num_models = len(models) if several else None
        self.stacked_data = stacked_data
        self.reduction = reduction
        self.skips = tuple(skips)
        self.skip_weights = normalised_weights(skip_weights, self.skips)
        self.__dict__["_models"] = models
        self._modules_of_model = dict(modules)
        for name, attribute in modules.items():
            parts = [getattr(m, attribute) for m in models]
            stacked = len(parts) > 1
            self.convert_to_functional(
                parts if stacked else parts[0],
                name,
                expand_dim=len(parts) if stacked else None,
                create_target_params=name in targets,
            )
            if several and not stacked:
                self._stack_one(name, parts[0], name in targets)
        self._stackable = self._can_stack()
        self._set_in_keys()
        self._out_keys: list[NestedKey] | None = None

    def _can_stack(self) -> bool:
        """Whether every part of the model takes the stacked parameters of several models."""
        parts = (getattr(self, name) for name in self._modules_of_model)
        plain = (part.module if type(part) is TensorDictModule else part for part in parts)
        return all(getattr(module, "stackable", False) for module in plain)

    def _stack_one(self, name: str, part: torch.nn.Module, has_target: bool) -> None:
        # Of a list of one TorchRL makes tensors that are no parameters: it takes them for shared ones.
        params = TensorDict.from_modules(part, as_module=True, expand_identical=False)
        setattr(self, f"{name}_params", params)
        if has_target:
            target = TensorDictParams(params.data.clone(), no_convert=True)
            setattr(self, f"target_{name}_params", target)

    @classmethod
    def _checked(cls, model: Any) -> list[Any]:
        """The models as a list: of the right type, distinct, and of the same architecture."""
        models = list(model) if isinstance(model, Sequence) else [model]
        if not models or not all(isinstance(m, cls._model_type) for m in models):
            raise ValueError(
                f"model must be a {cls._model_type.__name__} or a non-empty list of them for {cls.__name__}, "
                f"got {[type(m).__name__ for m in models]}"
            )
        if len({id(m) for m in models}) != len(models):
            raise ValueError("model must be a list of distinct models, got the same one twice; build each")
        blueprints = [blueprint(m) for m in models if len(models) > 1]
        for i, other in enumerate(blueprints):
            different = sorted(
                key for key in blueprints[0] | other if blueprints[0].get(key) != other.get(key)
            )
            if different:
                key = different[0]
                raise ValueError(
                    f"model must be a list of models of one architecture, but {key!r} is {other.get(key)} in "
                    f"model {i} and {blueprints[0].get(key)} in model 0; train such models separately"
                )
        owner: dict[int, int] = {}
        for i, m in enumerate(models if len(models) > 1 else ()):
            for name, parameter in m.named_parameters():
                if owner.setdefault(id(parameter), i) != i:
                    raise ValueError(
                        f"model must be a list of models that share no parameters, but {name!r} of model {i} "
                        f"is that of model {owner[id(parameter)]}; build one for each"
                    )
        return models

    def _register_coeff(self, name: str, value: float) -> None:
        if not (math.isfinite(value) and value >= 0):
            raise ValueError(f"{name} must be finite and at least 0, got {value}")
        self.register_coeff_buffer(name, value)

    # TorchRL's conventions

    def _set_in_keys(self) -> None:
        keys = [*self._required_keys(), *self._optional_keys()]
        self._in_keys = list(dict.fromkeys(keys))

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
        diagnostics = () if self.reduction == "none" else self._diagnostic_keys()
        return [*self._loss_keys(), *diagnostics]

    @out_keys.setter
    def out_keys(self, keys: list[NestedKey]) -> None:
        self._out_keys = keys

    def select_out_keys(self, *out_keys: NestedKey) -> WindowLoss:
        """Compute and return these entries only; diagnostics that nobody asks for cost nothing.

        Without diagnostics no :class:`CollapseWarning` is given.

        TorchRL's own takes a batch without the optional ``done`` for positional arguments and fails.

        Args:
            *out_keys: a subset of ``out_keys``.

        Returns:
            The loss itself.

        Raises:
            ValueError: if a key is not among ``out_keys``.
        """
        before, self._out_keys = self._out_keys, None
        known = self.out_keys
        if not out_keys or any(key not in known for key in out_keys):
            self._out_keys = before
            raise ValueError(f"out_keys must be some of {known}, got {list(out_keys)}")
        self._out_keys = list(out_keys)
        return self

    def reset_out_keys(self) -> WindowLoss:
        """Return all entries again.

        Returns:
            The loss itself.
        """
        self._out_keys = None
        return self

    @property
    def _wants_diagnostics(self) -> bool:
        """Whether any is asked for: ``select_out_keys`` can leave out what a training step does not need."""
        if self.reduction == "none":
            return False
        return self._out_keys is None or any(key in self._out_keys for key in self._diagnostic_keys())

    # What a member adds

    def _action_entry(self) -> tuple[NestedKey, int] | None:
        """Where the model reads the action, and how many numbers it has."""
        return None

    def _required_keys(self) -> list[NestedKey]:
        """Floating-point entries that ``forward`` needs; the last tells the shape of the batch."""
        return [self.encoder.in_keys[0]]

    def _optional_keys(self) -> list[NestedKey]:
        keys = self.tensor_keys
        return [*self.encoder.in_keys[1:], keys.done, keys.is_init]

    def _loss_keys(self) -> Iterator[str]:
        yield from ()

    def _diagnostic_keys(self) -> Iterator[str]:
        yield from ()

    def _params(self) -> tuple[TensorDictBase, ...]:
        """The parameters that ``_terms`` takes, stacked if there are several models."""
        return tuple(getattr(self, f"{name}_params") for name in self._modules_of_model)

    def _networks(self, data: TensorDictBase, *params: TensorDictBase) -> dict[str, Tensor]:
        """What the modules make of windows ``(B, T)``: of one model, mapped over, or of all if stackable."""
        raise TypeError(f"{type(self).__name__} is not a loss by itself: use one of its members")

    def _terms(
        self, data: TensorDictBase, masks: dict[str, Tensor], outputs: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """The ``loss_*`` entries and diagnostics, from the outputs of all models at once."""
        raise TypeError(f"{type(self).__name__} is not a loss by itself: use one of its members")

    # The computation

    def get_model(self, index: int | None = None) -> Any:
        """The model with its trained parameters.

        Args:
            index: which one, if the loss was given a list: its parameters are copied from the stack
                into the model that stood at this place.

        Returns:
            The model that was given to the constructor.

        Raises:
            ValueError: if ``index`` is missing for a list, given for a single model, or out of range.
        """
        model = self._model_at(index)
        for name, attribute in self._modules_of_model.items():
            params = getattr(self, f"{name}_params")
            own = TensorDict.from_module(getattr(model, attribute))
            # Of a single model these are its own, unless the loss was copied or unpickled.
            own.data.update_(params.data if index is None else params.data[index])
            # The first model of a list lends the loss its modules: their parameters come back frozen.
            for key, value in own.items(True, True):
                value.requires_grad_(params.get(key).requires_grad)
        return model

    def _model_at(self, index: int | None) -> Any:
        """The model that was given, with whatever parameters it has now."""
        models: list[Any] = self.__dict__["_models"]
        if self.num_models is None and index is not None:
            raise ValueError(f"index must be None for a single model, got {index}")
        if self.num_models is not None and (index is None or not 0 <= index < self.num_models):
            raise ValueError(f"index must be in [0, {self.num_models - 1}], got {index}")
        return models[index or 0]

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
        self._check_coeffs()
        tensordict = with_action_code(tensordict, self._action_entry(), self.encoder.in_keys[0])
        data, masks = self._read(tensordict)
        params = self._params()
        if self.num_models is None or self._stackable:
            outputs = self._networks(data, *params)
        else:
            # Only what depends on modules is mapped: the rest is arithmetic on larger tensors.
            outputs = torch.vmap(
                self._networks,
                in_dims=(0 if self.stacked_data else None, *[0] * len(params)),
                randomness=self._vmap_randomness,
            )(data, *params)
        terms = self._terms(data, masks, outputs)
        terms = {key: terms[key] for key in self.out_keys}
        if self.reduction == "none":
            lead = () if self.num_models is None else (self.num_models,)
            batch = self._batch_shape(tensordict)
            batch = batch[1:] if self.stacked_data else batch
            terms = {key: value.reshape(*lead, *batch) for key, value in terms.items()}
        self._watch(terms)
        out = TensorDict(terms, batch_size=[])
        self._clear_weakrefs(tensordict, out, *[f"{name}_params" for name in self._modules_of_model])
        return out

    def _check_coeffs(self) -> None:
        """A coefficient that is not shared has one entry for each model, and weighs scalars."""
        own = (self.num_models,) if self.reduction != "none" else ()
        for name in sorted(self._all_schedulable_buffers):
            value = getattr(self, name)
            if value is not None and value.ndim and value.shape != own:
                raise ValueError(
                    f"{name} must be a scalar or, for a list of models and reduction='mean' or 'sum', have "
                    f"one entry for each model, got shape {tuple(value.shape)} for "
                    f"num_models={self.num_models} and reduction={self.reduction!r}"
                )

    def _watch(self, terms: dict[str, Tensor]) -> None:
        """Called with the terms of all models."""

    def _batch_shape(self, tensordict: TensorDictBase) -> torch.Size:
        """``(*B, T)``, read off the data: dispatch() guesses it wrongly where sizes agree by chance."""
        name = type(self).__name__
        *_, anchor = [read(tensordict, key, reader=name) for key in self._required_keys()]
        images = self._required_keys()[-1] == self.encoder.in_keys[0]
        event_dims = max(1, anchor.ndim - tensordict.ndim) if images else 1
        return anchor.shape[:-event_dims]

    def _read(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, dict[str, Tensor]]:
        """Checked windows ``(B, T)`` and the masks of steps (``"steps"``) and pairs (``"<skip>"``)."""
        required = self._required_keys()
        batch = self._batch_shape(tensordict)
        entries = {key: tensordict.get(key) for key in required}
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
        dtypes = (value.dtype for value in entries.values() if value.is_floating_point())
        floating = next(dtypes, torch.get_default_dtype())
        for key, value in entries.items():
            if value.shape[: len(batch)] != batch or value.ndim == len(batch):
                raise ValueError(
                    f"{key!r} must have shape {(*batch, '...')} like {required[-1]!r}, "
                    f"got {tuple(value.shape)}"
                )
            if value.dtype == torch.bool:  # flags and one-hot actions
                entries[key] = value.to(floating)
            elif not value.is_floating_point():
                raise ValueError(
                    f"{key!r} must be floating point, got {value.dtype}; convert it first "
                    "(ToTensorImage, DoubleToFloat; actions of n choices need action_dim=n, several of them "
                    "an ActionEncoder)"
                )
        longest = max(self.skips, default=0)
        if batch[-1] <= longest:
            raise ValueError(
                f"the windows must be longer than the largest skip {longest}, got T={batch[-1]}; sample "
                "longer slices (slice_len)"
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
        masks = {str(skip): pair_mask(flags[0], flags[1], mask, skip) for skip in self.skips}
        masks["steps"] = mask
        data = TensorDict(entries, batch_size=batch).reshape(shape)
        return data, {key: value for key, value in masks.items() if value is not None}

    def _encode(self, data: TensorDictBase, params: TensorDictBase, latent_key: NestedKey) -> Tensor:
        """Latents ``(*N, B, T, D)``, in float32 under autocast."""
        encoder = self.encoder
        with params.to_module(encoder):
            if type(encoder) is TensorDictModule and encoder.out_keys == [latent_key]:
                # A plain network needs no tensordict.
                inputs = [data.get(key) for key in encoder.in_keys]
                if getattr(encoder.module, "row_wise", False):
                    # A matrix, and not a stack of them, stays one product when models are mapped over.
                    latent = encoder.module(inputs[0].flatten(-3, -2)).unflatten(-2, data.shape[-2:])
                else:
                    latent = encoder.module(*inputs)
            else:
                latent = encoder(data.copy()).get(latent_key)
        return latent.float() if latent.dtype in (torch.float16, torch.bfloat16) else latent

    def _flat(self, windows: Tensor, steps: slice = slice(None)) -> Tensor:
        """Windows ``(*N, B, T, D)``, or some of their steps, as rows ``(*N, B T, D)``."""
        if self._stackable:
            return features_first(windows, steps)
        return windows[..., steps, :].flatten(-3, -2)

    def _reduce(self, values: list[Tensor], masks: list[Tensor | None], length: int) -> Tensor:
        """Reduce one number for each pair (or step), over pairs and skips, as ``reduction`` says.

        Args:
            values: for each skip ``(*N, B, T - skip)``.
            masks: those that count, ``(B, T - skip)`` or ``(*N, B, T - skip)``, or ``None`` for all.
            length: ``T``.

        Returns:
            ``(*N)``, or ``(*N, B, T)`` for ``"none"``, zero where nothing counts. Several entries are
            averaged with ``skip_weights``.
        """
        rows = []
        for value, mask in zip(values, masks, strict=True):
            if self.reduction == "none":
                kept = value if mask is None else torch.where(mask, value, 0)
                rows.append(torch.nn.functional.pad(kept, (0, length - value.shape[-1])))
                continue
            mask = None if mask is None else mask.flatten(-2)
            mean = mean_over(value.flatten(-2), mask)
            rows.append(mean * self._count(value, mask) if self.reduction == "sum" else mean)
        return self._over_skips(rows)

    @staticmethod
    def _count(value: Tensor, mask: Tensor | None) -> Tensor | int:
        return value.shape[-1] * value.shape[-2] if mask is None else mask.sum(-1)

    def _over_skips(self, values: list[Tensor]) -> Tensor:
        """Mean over skips with ``skip_weights``; a single entry stays as it is."""
        if len(values) == 1:
            return values[0]
        first, *rest = (w * value for w, value in zip(self.skip_weights, values, strict=True))
        return sum(rest, first)
