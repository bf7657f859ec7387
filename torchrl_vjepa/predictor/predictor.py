"""The predictor: latent, actions, skip and side information -> distribution over a future latent."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, Literal

import torch
import torch.nn.functional as F
from tensordict import NestedKey
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.modules import MLP

from torchrl_vjepa.heads import DiagGaussianHead, Head
from torchrl_vjepa.predictor.model import PredictiveModel
from torchrl_vjepa.predictor.points import PointRollout
from torchrl_vjepa.predictor.trunks import linear_and_others
from torchrl_vjepa.stacking import is_plain_linear, linear
from torchrl_vjepa.temperature import temper

__all__ = ["Predictor"]


class Predictor(PredictiveModel):
    r"""Predictive model :math:`p_\phi(Z_{t+\Delta} \mid Z_t, \xi_{t+\Delta}, u_{t:t+\Delta-1})`.

    The controlled latent transition of ``eq:vjepa_controlled_dynamics``. :math:`\Delta` is one of
    ``skips``; the action chunk :math:`u_{t:t+\Delta-1}` and an optional side information tensor
    :math:`\xi` are concatenated to the latent. With ``trunk="linear"`` every skip has its own matrix
    (a linear map cannot be conditioned otherwise); with ``trunk="mlp"`` one network is shared by all
    skips, reads the chunk padded with zeros, and is told the skip as a one-hot vector.

    As a TensorDictModule it reads ``latent`` (and ``action``, ``side_info``) and writes the one-step
    point prediction to ``("next", "latent")``. :meth:`dist` is the distribution, on plain tensors: it
    is a *transition* wherever the library asks for one.

    Args:
        latent_dim: size ``D`` of the latent.
        action_dim: size ``A`` of the action; 0 for a system without control.
        head: features -> distribution; :class:`DiagGaussianHead` by default.
        skips: the prediction steps :math:`\Delta` that are learned; positive and distinct.
        trunk: ``"linear"`` or ``"mlp"``.
        num_cells: widths of the hidden layers of ``trunk="mlp"``.
        activation_class: nonlinearity of ``trunk="mlp"``.
        side_info_dim: size ``S`` of :math:`\xi`; 0 for none.
        bias: whether the linear trunk has a bias (the paper's has none; the MLP always has).
        residual: whether the mean is :math:`Z_t` plus the output of the trunk.
        how: which point of the distribution ``forward`` writes.
        latent_key: where the latent is read.
        action_key: where the action is read.
        side_info_key: where the side information is read.
        out_key: where the prediction is written.

    Attributes:
        temperature: what every skip's deviations from its mean are multiplied with
            (:func:`~torchrl_vjepa.temperature.temper`), of shape ``(len(skips),)``: a buffer, set by
            :meth:`set_temperature` or :func:`~torchrl_vjepa.diagnostics.recalibrate`. ``None``, with
            nothing computed and nothing in the state dict, is 1.

    Raises:
        ValueError: if a size, a skip, ``trunk`` or ``how`` is not valid.

    Examples:
        >>> import torch
        >>> predictor = Predictor(latent_dim=4, action_dim=2, skips=(1, 3))
        >>> predictor.dist(torch.zeros(7, 4), torch.zeros(7, 2)).mean.shape
        torch.Size([7, 4])
        >>> predictor.dist(torch.zeros(7, 4), torch.zeros(7, 3, 2), skip=3).variance.shape
        torch.Size([7, 4])
    """

    temperature: Tensor | None

    def __init__(
        self,
        latent_dim: int,
        action_dim: int = 0,
        *,
        head: Head | None = None,
        skips: Sequence[int] = (1,),
        trunk: Literal["linear", "mlp"] = "linear",
        num_cells: Sequence[int] = (256, 256),
        activation_class: type[nn.Module] = nn.SiLU,
        side_info_dim: int = 0,
        bias: bool = False,
        residual: bool = False,
        how: Literal["mean", "mode", "sample"] = "mean",
        latent_key: NestedKey = "latent",
        action_key: NestedKey = "action",
        side_info_key: NestedKey = "side_info",
        out_key: NestedKey = ("next", "latent"),
    ) -> None:
        super().__init__()
        if latent_dim < 1:
            raise ValueError(f"latent_dim must be positive, got {latent_dim}")
        if action_dim < 0 or side_info_dim < 0:
            raise ValueError(
                f"action_dim and side_info_dim must be at least 0, got {action_dim} and {side_info_dim}"
            )
        if any(int(skip) != skip for skip in skips):
            raise ValueError(f"skips must be integers, got {tuple(skips)}")
        skips = tuple(int(skip) for skip in skips)
        if not skips or min(skips) < 1 or len(set(skips)) != len(skips):
            raise ValueError(f"skips must be distinct positive integers, at least one, got {skips}")
        if trunk not in ("linear", "mlp"):
            raise ValueError(f"trunk must be 'linear' or 'mlp', got {trunk!r}")
        if how not in ("mean", "mode", "sample"):
            raise ValueError(f"how must be 'mean', 'mode' or 'sample', got {how!r}")
        self.latent_dim = latent_dim
        self.action_dim = action_dim
        self.side_info_dim = side_info_dim
        self.skips = skips
        self.trunk = trunk
        self.residual = residual
        self.how = how
        self.head = DiagGaussianHead() if head is None else head
        num_features = self.head.num_features(latent_dim)
        if trunk == "linear":
            self.trunks = nn.ModuleList(
                nn.Linear(latent_dim + skip * action_dim + side_info_dim, num_features, bias=bias)
                for skip in skips
            )
        else:
            in_features = latent_dim + max(skips) * action_dim + len(skips) + side_info_dim
            self.trunks = nn.ModuleList(
                [
                    MLP(
                        in_features=in_features,
                        out_features=num_features,
                        num_cells=list(num_cells),
                        activation_class=activation_class,
                    )
                ]
            )
        self.constants = nn.Parameter(self._init_constants())
        self.register_buffer("temperature", None)
        self.latent_key, self.action_key, self.side_info_key = latent_key, action_key, side_info_key
        self.in_keys = [latent_key]
        if action_dim:
            self.in_keys.append(action_key)
        if side_info_dim:
            self.in_keys.append(side_info_key)
        self.out_keys = [out_key]

    def reset_parameters(self) -> None:
        """New constants of the head, temperatures of 1 (the trunks reset themselves)."""
        with torch.no_grad():
            self.constants.copy_(self._init_constants())
            if self.temperature is not None:
                self.temperature.fill_(1.0)

    def _init_constants(self) -> Tensor:
        return torch.stack([self.head.init_constants(self.latent_dim) for _ in self.skips])

    def _reset_parameters(self, module: nn.Module) -> bool:
        # reset_parameters_recursive visits the children only, not the module that it is called on.
        any_reset = super()._reset_parameters(module)
        if module is self:
            self.reset_parameters()
        return any_reset

    def set_temperature(self, temperature: Tensor | Sequence[float] | None) -> None:
        """Widen or narrow the predictive distribution of every skip around its mean.

        Args:
            temperature: one positive number for each of ``skips``, in their order; ``None`` for 1, as
                the head says.

        Raises:
            ValueError: if it has another shape or is not positive and finite.
        """
        if temperature is None:
            self.temperature = None
            return
        value = torch.as_tensor(temperature).detach().to(self.constants).clone()
        if value.shape != (len(self.skips),):
            raise ValueError(
                f"temperature must have shape ({len(self.skips)},), one number for each of "
                f"skips={self.skips}, got {tuple(value.shape)}"
            )
        if not bool((value.isfinite() & (value > 0)).all()):
            raise ValueError(f"temperature must be positive and finite, got {value.tolist()}")
        self.temperature = value

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        # A buffer that is None is not in the state dict, so whether there is one is part of the state.
        if prefix + "temperature" not in state_dict:
            self.temperature = None
        elif self.temperature is None:
            self.temperature = self.constants.new_ones(len(self.skips))
        super()._load_from_state_dict(state_dict, prefix, *args)

    def dist(
        self,
        latent: Tensor,
        action: Tensor | None = None,
        *,
        skip: int = 1,
        side_info: Tensor | None = None,
    ) -> Distribution:
        r"""The predictive distribution of the latent ``skip`` steps ahead.

        Args:
            latent: :math:`Z_t`, of shape ``(*B, D)``.
            action: :math:`u_{t:t+\Delta-1}`, of shape ``(*B, skip, A)``, or ``(*B, A)`` for ``skip=1``;
                ``None`` or empty (``A = 0``) if ``action_dim`` is 0.
            skip: :math:`\Delta`, one of ``skips``.
            side_info: :math:`\xi`, of shape ``(*B, S)``; ``None`` if ``side_info_dim`` is 0.

        Returns:
            Distribution with batch ``*B`` and event ``(D,)``.

        Raises:
            ValueError: if a shape does not fit or ``skip`` was not learned.
            TypeError: if the inputs have another dtype than the weights, outside of autocast.
        """
        index = self._index(latent, skip)
        inputs = [latent]
        if self.action_dim or action is not None:
            inputs.append(self._chunk(latent, action, skip))
        if self.trunk == "mlp":
            if self.action_dim:
                inputs[-1] = F.pad(inputs[-1], (0, (max(self.skips) - skip) * self.action_dim))
            one_hot = F.one_hot(torch.tensor(index, device=latent.device), len(self.skips))
            inputs.append(one_hot.to(latent.dtype).expand(*latent.shape[:-1], -1))
        if self.side_info_dim or side_info is not None:
            inputs.append(self._side_info(latent, side_info))
        trunk = self.trunks[index if self.trunk == "linear" else 0]
        joined = torch.cat(inputs, dim=-1) if len(inputs) > 1 else latent
        self._check_dtype(latent, action, side_info)
        plain = is_plain_linear(trunk)
        features = linear(joined, trunk.weight, trunk.bias) if plain else trunk(joined)
        if self.residual:
            features = torch.cat(
                [features[..., : self.latent_dim] + latent, features[..., self.latent_dim :]],
                dim=-1,
            )
        constants = self.constants[index] if self.constants.ndim == 2 else self.constants[:, index, None]
        p = self.head(features, constants)
        return p if self.temperature is None else temper(p, self.temperature[index])

    @property
    def stackable(self) -> bool:
        """Whether :meth:`dist` takes the stacked weights of several models (``linear``)."""
        plain = all(map(is_plain_linear, self.trunks))
        return plain and self.head.stackable and self.temperature is None

    def point_rollout(
        self, latent: Tensor, action: Tensor, dtype: torch.dtype | None = None
    ) -> PointRollout | None:
        r"""The mean of :meth:`dist` one step ahead, prepared to be iterated along plans of one shape.

        What does not change from call to call is done once: inputs are checked, weights are read, the
        one-hot skip becomes a bias; and of the head's features only the mean is computed. Where gradients
        are off, steps and activations work in place. :func:`~torchrl_vjepa.belief.rollout` uses it.

        Args:
            latent: an example of where plans start, of shape ``(R, D)``.
            action: an example of one of their steps, of shape ``(R, A)``.
            dtype: what the network computes in, for instance ``torch.bfloat16``; latents come and go in
                theirs. ``None``: the dtype of the weights.

        Returns:
            ``(latent (R, D), actions (R, H, A)) -> latents (R, H, D)``, of means, which are modes; ``None``
            where there is no such short way: a head that computes its mean from all features
            (:class:`~torchrl_vjepa.heads.base.Head`), hooks, a trunk or a ``dist`` of a subclass.

        Raises:
            ValueError: if a shape does not fit, or ``skips`` has no 1.
            TypeError: if the inputs have another dtype than the weights, outside of autocast.

        Examples:
            >>> import torch
            >>> predictor = Predictor(4, action_dim=2, trunk="mlp")
            >>> latent, actions = torch.ones(7, 4), torch.ones(7, 3, 2)
            >>> move = predictor.point_rollout(latent, actions[:, 0])
            >>> first = predictor.dist(latent, actions[:, 0]).mean
            >>> torch.allclose(move(latent, actions)[:, 0], first, atol=1e-6)
            True
        """
        index = self._index(latent, 1)
        if self.action_dim or action is not None:
            self._chunk(latent, action, 1)
        if self.side_info_dim:
            self._side_info(latent, None)
        self._check_dtype(latent, action, None)
        head = self.head
        hooked = head._forward_hooks or head._forward_pre_hooks
        if type(self).dist is not Predictor.dist or not head.point_features or hooked:
            return None
        trunk = self.trunks[index if self.trunk == "linear" else 0]
        layers = linear_and_others(trunk)
        if layers is None or layers[0].weight.ndim != 2:
            return None
        size, last = self.latent_dim, len(layers) - 1
        joined = size + self.action_dim
        for place, layer in enumerate(layers):
            if not isinstance(layer, nn.Linear):
                continue
            weight: Tensor = layer.weight
            bias: Tensor | None = layer.bias
            if place == 0 and self.trunk == "mlp":
                constant = weight.select(1, size + max(self.skips) * self.action_dim + index)
                bias = constant if bias is None else bias + constant
                weight = weight.narrow(1, 0, joined)
            if place == last and len(weight) > size:
                weight = weight.narrow(0, 0, size)
                bias = None if bias is None else bias.narrow(0, 0, size)
            layers[place] = (weight, weight.new_zeros(()) if bias is None else bias)
        return PointRollout(layers, self.residual, dtype)

    def _index(self, latent: Tensor, skip: int) -> int:
        """Place of a skip, where it was learned and the latent fits."""
        if skip not in self.skips:
            raise ValueError(f"skip must be one of skips={self.skips}, got {skip}")
        if not latent.ndim or latent.shape[-1] != self.latent_dim:
            raise ValueError(f"latent must have shape (*B, {self.latent_dim}), got {tuple(latent.shape)}")
        return self.skips.index(skip)

    def _check_dtype(self, *inputs: Tensor | None) -> None:
        constants = self.constants
        dtype = constants.dtype
        given = [item.dtype for item in inputs if item is not None]
        fits = all(item == dtype for item in given) or functools.reduce(torch.promote_types, given) == dtype
        if not fits and not torch.is_autocast_enabled(constants.device.type):
            raise TypeError(
                f"latent, action and side_info must have the dtype of the predictor's weights, {dtype}, "
                f"got {given}; cast them"
            )

    def _chunk(self, latent: Tensor, action: Tensor | None, skip: int) -> Tensor:
        batch = latent.shape[:-1]
        shapes = [(*batch, skip, self.action_dim)]
        if skip == 1:
            shapes.append((*batch, self.action_dim))
        if action is None or tuple(action.shape) not in shapes:
            raise ValueError(
                f"action must have shape {' or '.join(map(str, shapes))} for skip={skip} and "
                f"action_dim={self.action_dim}, got {None if action is None else tuple(action.shape)}"
            )
        return action.reshape(*batch, skip * self.action_dim)

    def _side_info(self, latent: Tensor, side_info: Tensor | None) -> Tensor:
        shape = (*latent.shape[:-1], self.side_info_dim)
        if side_info is None or tuple(side_info.shape) != shape:
            raise ValueError(
                f"side_info must have shape {shape} for side_info_dim={self.side_info_dim}, "
                f"got {None if side_info is None else tuple(side_info.shape)}"
            )
        return side_info
