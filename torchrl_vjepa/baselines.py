"""Reconstruction baselines of the noisy-TV experiment: models that must predict every pixel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictParams
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_vjepa.distributions import Delta
from torchrl_vjepa.models import LatentModel
from torchrl_vjepa.objectives import WindowLoss
from torchrl_vjepa.stacking import StackableLinear, columns, halves, shared_noise, squared_distance
from torchrl_vjepa.windows import read

__all__ = ["VAE", "PixelAR", "PixelARLoss", "PixelDecoder", "VAELoss"]


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
        if len(encoder.in_keys) != 1:
            raise ValueError(
                "encoder must read one key, the observation: it encodes predicted observations again; "
                f"its in_keys are {list(encoder.in_keys)}"
            )
        self.encoder = encoder
        self.latent_dim, self.observation_dim = latent_dim, observation_dim
        self.action_dim = action_dim
        self.decoder = _trunk(trunk, latent_dim + action_dim, observation_dim, num_cells)
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
        return self.decoder(_joined(latent, action, self.latent_dim, self.action_dim))

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

    @property
    def decoder_module(self) -> TensorDictModule:
        """The decoder alone, without the encoder that its transition needs: what a loss trains."""
        decoder = self.predictor
        trunk = _Decode(decoder.decoder, decoder.latent_dim, decoder.action_dim)
        return TensorDictModule(trunk, in_keys=decoder.in_keys, out_keys=["prediction"])


class VAE(TensorDictModuleBase):
    r"""Variational autoencoder of single observations: the static baseline of the noisy TV.

    :math:`q(z_t \mid x_t) = \mathcal N(\mu(x_t), \mathrm{diag}(\sigma^2(x_t)))` and
    :math:`\hat x_t = g(z_t)` (the paper's "Linear Variational Autoencoder"). Writes the mean to
    ``latent``.

    Args:
        observation_dim: size ``O`` of the observation.
        latent_dim: size ``D`` of the latent.
        trunk: ``"linear"`` (no bias, as in the paper) or ``"mlp"``.
        num_cells: widths of the hidden layers of ``trunk="mlp"``.
        observation_key: where the observation is read.
        latent_key: where the latent is written.

    Raises:
        ValueError: if a size is not positive or ``trunk`` is unknown.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> vae = VAE(20, 4)
        >>> vae(TensorDict(observation=torch.zeros(3, 20), batch_size=3))["latent"].shape
        torch.Size([3, 4])
    """

    def __init__(
        self,
        observation_dim: int,
        latent_dim: int,
        *,
        trunk: Literal["linear", "mlp"] = "linear",
        num_cells: Sequence[int] = (256, 256),
        observation_key: NestedKey = "observation",
        latent_key: NestedKey = "latent",
    ) -> None:
        super().__init__()
        if min(observation_dim, latent_dim) < 1:
            raise ValueError(
                f"observation_dim and latent_dim must be positive, got {observation_dim} and {latent_dim}"
            )
        self.encoder = TensorDictModule(
            _trunk(trunk, observation_dim, 2 * latent_dim, num_cells),
            in_keys=[observation_key],
            out_keys=["posterior"],
        )
        self.decoder = TensorDictModule(
            _trunk(trunk, latent_dim, observation_dim, num_cells),
            in_keys=[latent_key],
            out_keys=["reconstruction"],
        )
        self.latent_dim = latent_dim
        self.latent_key = latent_key
        self.in_keys = [observation_key]
        self.out_keys = [latent_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the mean of the posterior.

        Args:
            tensordict: holds the observation.

        Returns:
            The same tensordict with the latent.

        Raises:
            KeyError: if there is no observation.
        """
        observation = read(tensordict, self.in_keys[0], reader=type(self).__name__)
        posterior = self.encoder.module(observation)
        return tensordict.set(self.latent_key, posterior[..., : self.latent_dim])


class VAELoss(WindowLoss):
    r"""Negative evidence lower bound of a :class:`VAE`.

    .. math::
        \mathcal L_{\text{VAE}} = \|x_t - \hat x_t\|^2
        + \beta\, \mathrm{KL}\big(q(z_t \mid x_t) \,\|\, \mathcal N(0, I)\big)

    with one reparameterised sample, summed over dimensions, mean over steps.

    Entries: ``loss_reconstruction``, ``loss_kl``.

    Args:
        model: the model, or a list of models that train as one batch.
        kl_coeff: :math:`\beta`.
        stacked_data: whether the windows come with a leading dimension of models.
        reduction: ``"mean"`` over steps, ``"sum"``, or ``"none"`` (``(B, T)``).

    Raises:
        ValueError: if ``kl_coeff`` is negative or not finite, or ``reduction`` is unknown.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> loss = VAELoss(VAE(20, 4))
        >>> sorted(loss(TensorDict(observation=torch.zeros(8, 5, 20), batch_size=(8, 5))).keys())
        ['loss_kl', 'loss_reconstruction']
    """

    encoder: TensorDictModule
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams
    decoder: TensorDictModule
    decoder_params: TensorDictParams
    target_decoder_params: TensorDictParams

    _schedulable_buffers = frozenset({"kl_coeff"})
    _model_type = VAE

    def __init__(
        self,
        model: VAE | Sequence[VAE],
        *,
        kl_coeff: float = 1.0,
        stacked_data: bool = False,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        super().__init__(
            model,
            {"encoder": "encoder", "decoder": "decoder"},
            skips=(),
            stacked_data=stacked_data,
            reduction=reduction,
        )
        self._register_coeff("kl_coeff", kl_coeff)

    def _loss_keys(self) -> Iterator[str]:
        yield from ("loss_reconstruction", "loss_kl")

    def _networks(self, data: TensorDictBase, *params: TensorDictBase) -> dict[str, Tensor]:
        encoder_params, decoder_params = params
        observation = self._flat(data.get(self.encoder.in_keys[0]))
        with encoder_params.to_module(self.encoder):
            posterior = self.encoder.module(observation)
        if posterior.dtype in (torch.float16, torch.bfloat16):
            posterior = posterior.float()
        mean, log_var = halves(posterior)
        latent = torch.addcmul(mean, (0.5 * log_var).exp(), shared_noise(mean, 2))
        with decoder_params.to_module(self.decoder):
            decoded = self.decoder.module(latent)
        return {
            "error": squared_distance(decoded, observation),
            "kl": 0.5 * (columns(mean).square() + columns(log_var).exp() - columns(log_var) - 1).sum(-2),
        }

    def _terms(
        self, data: TensorDictBase, masks: dict[str, Tensor], outputs: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        length, mask = data.shape[-1], masks.get("steps")
        error, kl = (outputs[name].unflatten(-1, (-1, length)) for name in ("error", "kl"))
        return {
            "loss_reconstruction": self._reduce([error], [mask], length),
            "loss_kl": self.kl_coeff * self._reduce([kl], [mask], length),
        }


class PixelARLoss(WindowLoss):
    r"""Squared error of the next observation, :math:`\|x_{t+1} - \hat x_{t+1}\|^2`.

    The objective of the paper's AR baseline: summed over dimensions, mean over pairs.

    Entries: ``loss_reconstruction``.

    Args:
        model: the model, or a list of models that train as one batch.
        stacked_data: whether the windows come with a leading dimension of models.
        reduction: ``"mean"`` over pairs, ``"sum"``, or ``"none"`` (``(B, T)``, zero where a pair does
            not count).

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

    encoder: TensorDictModuleBase
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams
    decoder: TensorDictModule
    decoder_params: TensorDictParams
    target_decoder_params: TensorDictParams

    _model_type = PixelAR

    def __init__(
        self,
        model: PixelAR | Sequence[PixelAR],
        *,
        stacked_data: bool = False,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        super().__init__(
            model,
            {"encoder": "encoder", "decoder": "decoder_module"},
            skips=(1,),
            stacked_data=stacked_data,
            reduction=reduction,
        )

    def _action_entry(self) -> tuple[NestedKey, int] | None:
        keys = self.decoder.in_keys[1:]
        return (keys[0], self.decoder.module.action_dim) if keys else None

    def _required_keys(self) -> list[NestedKey]:
        return [self.encoder.in_keys[0], *self.decoder.in_keys[1:]]

    def _loss_keys(self) -> Iterator[str]:
        yield "loss_reconstruction"

    def _networks(self, data: TensorDictBase, *params: TensorDictBase) -> dict[str, Tensor]:
        encoder_params, decoder_params = params
        observation = data.get(self.encoder.in_keys[0])
        latent_key, *action_keys = self.decoder.in_keys
        latent = self._flat(self._encode(data, encoder_params, latent_key), slice(-1))
        actions = [self._flat(data.get(key), slice(-1)) for key in action_keys]
        actions = [action.expand(*latent.shape[:-1], -1) for action in actions]
        with decoder_params.to_module(self.decoder):
            predicted = self.decoder.module(latent, *actions)
        target = self._flat(observation, slice(1, None))
        return {"error": squared_distance(predicted, target)}

    def _terms(
        self, data: TensorDictBase, masks: dict[str, Tensor], outputs: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        length = data.shape[-1]
        error = outputs["error"].unflatten(-1, (-1, length - 1))
        return {"loss_reconstruction": self._reduce([error], [masks.get("1")], length)}


class _Decode(nn.Module):
    """Latent and action, checked and joined, through the trunk of a decoder."""

    def __init__(self, trunk: nn.Module, latent_dim: int, action_dim: int) -> None:
        super().__init__()
        self.trunk = trunk
        self.latent_dim, self.action_dim = latent_dim, action_dim

    @property
    def stackable(self) -> bool:
        return getattr(self.trunk, "stackable", False)

    def forward(self, latent: Tensor, action: Tensor | None = None) -> Tensor:
        return self.trunk(_joined(latent, action, self.latent_dim, self.action_dim))


def _joined(latent: Tensor, action: Tensor | None, latent_dim: int, action_dim: int) -> Tensor:
    if not latent.ndim or latent.shape[-1] != latent_dim:
        raise ValueError(f"latent must have shape (*B, {latent_dim}), got {tuple(latent.shape)}")
    expected = (*latent.shape[:-1], action_dim)
    if (action is None and action_dim) or (action is not None and tuple(action.shape) != expected):
        raise ValueError(
            f"action must have shape {expected} (None for action_dim=0), got "
            f"{None if action is None else tuple(action.shape)}"
        )
    return latent if action is None else torch.cat([latent, action], dim=-1)


def _trunk(
    trunk: Literal["linear", "mlp"], in_features: int, out_features: int, num_cells: Sequence[int]
) -> nn.Module:
    if trunk == "linear":
        return StackableLinear(in_features, out_features, bias=False)
    if trunk == "mlp":
        return MLP(in_features, out_features, num_cells=list(num_cells))
    raise ValueError(f"trunk must be 'linear' or 'mlp', got {trunk!r}")
