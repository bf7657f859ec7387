"""Reconstruction baselines of the noisy-TV experiment: models that must predict every pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams, dispatch
from torch import Tensor, nn
from torchrl.modules import MLP
from torchrl.objectives.common import LossModule

from torchrl_vjepa.distributions import Delta
from torchrl_vjepa.models import LatentModel
from torchrl_vjepa.windows import check_finite, pair_mask, read, step_mask

__all__ = ["PixelAR", "PixelARLoss", "PixelDecoder"]


class PixelDecoder(TensorDictModuleBase):
    r"""Next-observation decoder :math:`\hat x_{t+1} = g(z_t, u_t)`, and the latent transition that it makes.

    :meth:`decode` predicts the observation; :meth:`dist` encodes that prediction again,
    :math:`\hat z_{t+1} = f(g(z_t, u_t))`: the autoregression in pixels (``eq:autoregressive_factorization``)
    seen from the latent space.

    Args:
        encoder: the encoder of the model; it reads one key, the observation.
        latent_dim: size ``D`` of the latent.
        observation_dim: size ``O`` of the observation.
        action_dim: size ``A`` of the action; 0 for a system without control.
        trunk: ``"linear"`` (no bias, as in the paper) or ``"mlp"``.
        num_cells: widths of the hidden layers of ``trunk="mlp"``.
        latent_key: where the latent is read.
        action_key: where the action is read.
        out_key: where ``forward`` writes the next latent.

    Raises:
        ValueError: if a size is not valid, ``trunk`` is unknown, or the encoder reads more than one key.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import linear_encoder
        >>> decoder = PixelDecoder(linear_encoder(20, 4), 4, 20, action_dim=2)
        >>> decoder.decode(torch.zeros(3, 4), torch.zeros(3, 2)).shape
        torch.Size([3, 20])
        >>> decoder.dist(torch.zeros(3, 4), torch.zeros(3, 2)).mean.shape
        torch.Size([3, 4])
    """

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        latent_dim: int,
        observation_dim: int,
        action_dim: int = 0,
        *,
        trunk: Literal["linear", "mlp"] = "linear",
        num_cells: Sequence[int] = (256, 256),
        latent_key: NestedKey = "latent",
        action_key: NestedKey = "action",
        out_key: NestedKey = ("next", "latent"),
    ) -> None:
        super().__init__()
        if latent_dim < 1 or observation_dim < 1 or action_dim < 0:
            raise ValueError(
                "latent_dim and observation_dim must be positive and action_dim at least 0, got "
                f"{latent_dim}, {observation_dim} and {action_dim}"
            )
        if trunk not in ("linear", "mlp"):
            raise ValueError(f"trunk must be 'linear' or 'mlp', got {trunk!r}")
        if len(encoder.in_keys) != 1:
            raise ValueError(
                "encoder must read one key, the observation: it encodes predicted observations again; "
                f"its in_keys are {list(encoder.in_keys)}"
            )
        self.encoder = encoder
        self.latent_dim, self.observation_dim = latent_dim, observation_dim
        self.action_dim = action_dim
        self.decoder = (
            nn.Linear(latent_dim + action_dim, observation_dim, bias=False)
            if trunk == "linear"
            else MLP(latent_dim + action_dim, observation_dim, num_cells=list(num_cells))
        )
        self.latent_key, self.action_key = latent_key, action_key
        self.in_keys = [latent_key, action_key] if action_dim else [latent_key]
        self.out_keys = [out_key]

    def decode(self, latent: Tensor, action: Tensor | None = None) -> Tensor:
        """Predict the next observation.

        Args:
            latent: of shape ``(*B, D)``.
            action: of shape ``(*B, A)``; ``None`` or empty (``A = 0``) if ``action_dim`` is 0.

        Returns:
            Observations of shape ``(*B, O)``.

        Raises:
            ValueError: if a shape does not fit.
        """
        if not latent.ndim or latent.shape[-1] != self.latent_dim:
            raise ValueError(f"latent must have shape (*B, {self.latent_dim}), got {tuple(latent.shape)}")
        expected = (*latent.shape[:-1], self.action_dim)
        if (action is None and self.action_dim) or (action is not None and tuple(action.shape) != expected):
            raise ValueError(
                f"action must have shape {expected} (None for action_dim=0), got "
                f"{None if action is None else tuple(action.shape)}"
            )
        return self.decoder(latent if action is None else torch.cat([latent, action], dim=-1))

    def dist(self, latent: Tensor, action: Tensor | None = None) -> Delta:
        """The latent transition: decode, then encode.

        Args:
            latent: of shape ``(*B, D)``.
            action: of shape ``(*B, A)``; ``None`` if ``action_dim`` is 0.

        Returns:
            Point mass with batch ``*B`` and event ``(D,)``.
        """
        observation = self.decode(latent, action)
        data = TensorDict({self.encoder.in_keys[0]: observation}, batch_size=observation.shape[:-1])
        return Delta(self.encoder(data).get(self.latent_key))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the next latent.

        Args:
            tensordict: holds the latent and the action.

        Returns:
            The same tensordict with the entry ``out_keys[0]``.

        Raises:
            KeyError: if an entry is missing.
        """
        inputs = [read(tensordict, key, reader=type(self).__name__) for key in self.in_keys]
        return tensordict.set(self.out_keys[0], self.dist(*inputs).mean)


class PixelAR(LatentModel):
    r"""Pixel-autoregressive world model: :math:`z_t = f(x_t)`, :math:`\hat x_{t+1} = g(z_t, u_t)`.

    The paper's "Linear Pixel-Autoregressive (AR)" baseline with actions: a bottleneck that must predict
    the next observation, distractor included.

    Args:
        encoder: TensorDictModule that writes the latent, without memory.
        decoder: its :class:`PixelDecoder`.

    Raises:
        ValueError: if the decoder was made for another encoder or another key of the latent.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_vjepa import linear_encoder
        >>> encoder = linear_encoder(20, 4)
        >>> model = PixelAR(encoder, PixelDecoder(encoder, 4, 20, action_dim=2))
        >>> out = model(TensorDict(observation=torch.zeros(3, 20), action=torch.zeros(3, 2), batch_size=3))
        >>> out["next", "latent"].shape
        torch.Size([3, 4])
    """

    predictor: PixelDecoder

    def __init__(self, encoder: TensorDictModuleBase, decoder: PixelDecoder) -> None:
        if decoder.encoder is not encoder:
            raise ValueError("decoder must have been made with this very encoder: PixelDecoder(encoder, ...)")
        super().__init__(encoder, decoder)


class PixelARLoss(LossModule):
    r"""Squared error of the next observation, :math:`\|x_{t+1} - \hat x_{t+1}\|^2`.

    The objective of the paper's AR baseline. Pairs across the end of an episode and padded steps do not
    count.

    Entries: ``loss_reconstruction``.

    Args:
        model: the model.
        reduction: ``"mean"`` over pairs, ``"sum"``, or ``"none"`` (``(B, T - 1)``, zero where a pair
            does not count).

    Raises:
        ValueError: if ``reduction`` is unknown.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_vjepa import linear_encoder
        >>> encoder = linear_encoder(20, 4)
        >>> loss = PixelARLoss(PixelAR(encoder, PixelDecoder(encoder, 4, 20)))
        >>> loss(TensorDict(observation=torch.zeros(8, 5, 20), batch_size=(8, 5)))["loss_reconstruction"]
        tensor(0., grad_fn=...)
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that the loss itself reads.

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
    decoder: PixelDecoder
    decoder_params: TensorDictParams
    target_decoder_params: TensorDictParams
    out_keys = ["loss_reconstruction"]

    def __init__(self, model: PixelAR, *, reduction: Literal["mean", "sum", "none"] = "mean") -> None:
        super().__init__()
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"reduction must be 'mean', 'sum' or 'none', got {reduction!r}")
        self.reduction = reduction
        self.convert_to_functional(model.encoder, "encoder")
        self.convert_to_functional(model.predictor, "decoder")
        self._set_in_keys()

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        self._in_keys = [
            *self.encoder.in_keys,
            *self.decoder.in_keys[1:],
            keys.done,
            keys.is_init,
        ]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        self._set_in_keys()

    @property
    def in_keys(self) -> list[NestedKey]:
        """What ``forward`` reads; ``done`` and ``is_init`` may be missing."""
        return self._in_keys

    @in_keys.setter
    def in_keys(self, keys: list[NestedKey]) -> None:
        self._in_keys = keys

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss of a batch of windows.

        Args:
            tensordict: the windows, ``(*B, T)``; not changed.

        Returns:
            A tensordict with ``loss_reconstruction``.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if the windows have fewer than two steps, a shape does not fit them, or a value that
                counts is not finite (not looked for under ``torch.compile``).
        """
        name = type(self).__name__
        observation_key = self.encoder.in_keys[0]
        observation = read(tensordict, observation_key, reader=name)
        batch = observation.shape[:-1]
        if not batch or batch[-1] < 2:
            raise ValueError(f"the windows must have at least 2 steps, got a batch {tuple(batch)}")
        mask = step_mask(tensordict, self._loss_mask_keys(), batch)
        # Looking at values would break the graph.
        checking = not torch.compiler.is_compiling()
        if checking:
            check_finite(observation, mask, observation_key)
        action = None
        if self.decoder.action_dim:
            action = read(tensordict, self.decoder.action_key, reader=name)
            if action.shape[:-1] != batch:
                raise ValueError(
                    f"{self.decoder.action_key!r} must have shape {(*batch, self.decoder.action_dim)}, got "
                    f"{tuple(action.shape)}"
                )
            if checking:
                check_finite(action, mask, self.decoder.action_key)
        if mask is not None:
            observation = torch.where(mask.unsqueeze(-1), observation, 0)
            action = None if action is None else torch.where(mask.unsqueeze(-1), action, 0)
        keys = self.tensor_keys
        done, is_init = (step_mask(tensordict, [key], batch) for key in (keys.done, keys.is_init))
        pairs = pair_mask(done, is_init, mask, 1)
        context = TensorDict({observation_key: observation[..., :-1, :]}, (*batch[:-1], batch[-1] - 1))
        with self.encoder_params.to_module(self.encoder):
            latent = self.encoder(context).get(self.decoder.latent_key)
        with self.decoder_params.to_module(self.decoder):
            predicted = self.decoder.decode(latent, None if action is None else action[..., :-1, :])
        error = (predicted - observation[..., 1:, :]).pow(2).sum(-1)
        if pairs is not None and self.reduction == "none":
            error, pairs = torch.where(pairs, error, 0), None
        out = TensorDict({"loss_reconstruction": self._reduce_loss(error, mask=pairs)}, batch_size=[])
        self._clear_weakrefs(tensordict, out, "encoder_params", "decoder_params")
        return out
