"""The reward head, trained on what the planner will show it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from torch import Tensor

from torchrl_vjepa.belief import rollout
from torchrl_vjepa.models import LatentModel
from torchrl_vjepa.objectives.pairs import mean_over
from torchrl_vjepa.objectives.window_loss import WindowLoss

__all__ = ["RewardLoss"]


class RewardLoss(WindowLoss):
    r"""Squared error of a reward head on *predicted* latents.

    The head is asked what the planner will ask it: the reward of :math:`(\hat Z_{t+k}, u_{t+k-1})`
    where :math:`\hat Z_{t+k}` is the latent rolled out from :math:`Z_t` by the model's mean for
    :math:`k = 1, \dots,` ``num_steps`` (``eq:latent_mpc_objective`` with :math:`c = -r`). Rollouts that
    leave an episode or meet padding do not count. Train it after the representation, or beside it with
    an optimizer of its own: rewards are not normalised, so the head often wants a larger learning rate.

    Entries: ``loss_reward``; diagnostic ``reward_error`` (mean absolute error).

    Args:
        model: the trained (or training) model; parameters stay its own.
        reward_model: TensorDictModule that reads the next latent and the action and writes the reward.
        num_steps: length of the imagined rollouts.
        train_model: whether the gradient flows into encoder and predictor too; then ``parameters()``
            holds theirs as well: give each to one optimizer only.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` (``(B, T)``, zero where no rollout starts).

    Raises:
        ValueError: if ``num_steps`` is not positive or ``reduction`` is unknown.
        TypeError: if ``model`` is no :class:`LatentModel` or ``reward_model`` no TensorDictModule.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl_vjepa import VJEPA, Predictor, QuadraticReward, linear_encoder
        >>> model = VJEPA(linear_encoder(20, 4), Predictor(4, action_dim=2))
        >>> head = TensorDictModule(
        ...     QuadraticReward(4, 2), in_keys=["latent", "action"], out_keys=["reward"]
        ... )
        >>> loss = RewardLoss(model, head)
        >>> windows = TensorDict(
        ...     observation=torch.randn(8, 5, 20),
        ...     action=torch.randn(8, 5, 2),
        ...     next=TensorDict(reward=torch.randn(8, 5, 1), batch_size=(8, 5)),
        ...     batch_size=(8, 5),
        ... )
        >>> loss(windows)["loss_reward"].shape
        torch.Size([])
    """

    @dataclass
    class _AcceptedKeys(WindowLoss._AcceptedKeys):
        """Keys that the loss itself reads.

        Attributes:
            reward: the true reward. Defaults to ``("next", "reward")``.
            done: end of an episode after this step. Defaults to ``("next", "done")``.
            is_init: beginning of an episode at this step. Defaults to ``"is_init"``.
        """

        reward: NestedKey = ("next", "reward")

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys

    reward_model: TensorDictModuleBase
    reward_model_params: TensorDictParams
    target_reward_model_params: TensorDictParams
    encoder: TensorDictModuleBase
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams
    predictor: TensorDictModuleBase
    predictor_params: TensorDictParams
    target_predictor_params: TensorDictParams

    _model_type = SimpleNamespace  # what the constructor makes of the model and the head

    def __init__(
        self,
        model: LatentModel,
        reward_model: TensorDictModuleBase,
        *,
        num_steps: int = 1,
        train_model: bool = False,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        if num_steps < 1:
            raise ValueError(f"num_steps must be positive, got {num_steps}")
        if not isinstance(model, LatentModel):
            raise TypeError(
                f"model must be one LatentModel (of several, give each a RewardLoss of its own), got "
                f"{type(model).__name__}"
            )
        if not isinstance(reward_model, TensorDictModuleBase):
            raise TypeError(
                "reward_model must be a TensorDictModule, for instance TensorDictModule("
                "QuadraticReward(D, A), ['latent', 'action'], ['reward']), got "
                f"{type(reward_model).__name__}"
            )
        parts = SimpleNamespace(reward_model=reward_model, encoder=model.encoder, predictor=model.predictor)
        names = ["reward_model", *(["encoder", "predictor"] if train_model else [])]
        super().__init__(
            parts,
            {name: name for name in names},
            skips=(num_steps - 1,) if num_steps > 1 else (),
            reduction=reduction,
        )
        self.num_steps = num_steps
        self.train_model = train_model
        if not train_model:
            # Not registered: the model's parameters are not the loss's to list or to save.
            self.__dict__["encoder"] = model.encoder
            self.__dict__["predictor"] = model.predictor
        self._set_in_keys()

    def _action_entry(self) -> tuple[NestedKey, int]:
        return self.predictor.action_key, self.predictor.action_dim

    def _required_keys(self) -> list[NestedKey]:
        if "encoder" not in self.__dict__:  # while the parent is being built
            return []
        predictor = self.predictor
        observation_key, reward_key = self.encoder.in_keys[0], self.tensor_keys.reward
        if predictor.action_dim:
            return [observation_key, reward_key, predictor.action_key]
        return [reward_key, observation_key]

    def _optional_keys(self) -> list[NestedKey]:
        return super()._optional_keys() if "encoder" in self.__dict__ else []

    def _batch_shape(self, tensordict: TensorDictBase) -> torch.Size:
        batch = super()._batch_shape(tensordict)
        if batch and batch[-1] < self.num_steps:
            raise ValueError(
                f"num_steps={self.num_steps} needs windows of at least {self.num_steps} steps, got "
                f"T={batch[-1]}; sample longer slices (slice_len)"
            )
        return batch

    def _loss_keys(self) -> Iterator[str]:
        yield "loss_reward"

    def _diagnostic_keys(self) -> Iterator[str]:
        yield "reward_error"

    def _imagine(self, data: TensorDictBase, chunks: Tensor | None) -> Tensor:
        """Latents ``(B, N, num_steps, D)`` rolled out from each of the N first steps."""
        steps = self.num_steps
        with torch.set_grad_enabled(self.train_model and torch.is_grad_enabled()):
            latent = self.encoder(data.copy()).get(self.predictor.latent_key)
            starts = latent[:, : latent.shape[1] - steps + 1]
            if chunks is None:
                chunks = starts.new_zeros(*starts.shape[:-1], steps, 0)
            return rollout(self.predictor.dist, starts, chunks)

    def _networks(self, data: TensorDictBase, *params: TensorDictBase) -> dict[str, Tensor]:
        chunks = None
        if self.predictor.action_dim:
            action = data.get(self.predictor.action_key)
            chunks = action.unfold(1, self.num_steps, 1).transpose(-1, -2)
        latents = self._imagine(data, chunks)
        imagined = TensorDict({self.predictor.latent_key: latents}, batch_size=latents.shape[:-1])
        if chunks is not None:
            imagined.set(self.predictor.action_key, chunks)
        with params[0].to_module(self.reward_model):
            return {"reward": self.reward_model(imagined).get(self.reward_model.out_keys[0])}

    def _terms(
        self, data: TensorDictBase, masks: dict[str, Tensor], outputs: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        steps, length = self.num_steps, data.shape[1]
        true = data.get(self.tensor_keys.reward)
        if true.ndim != 3 or true.shape[-1] != 1:
            raise ValueError(
                f"{self.tensor_keys.reward!r} must have shape {(*data.shape, 1)}, got {tuple(true.shape)}"
            )
        reward = true.unfold(1, steps, 1).transpose(-1, -2)
        predicted = outputs["reward"]
        if predicted.shape != reward.shape:
            raise ValueError(
                f"reward_model must write rewards of shape {tuple(reward.shape)}, "
                f"got {tuple(predicted.shape)}"
            )
        error = (predicted - reward).squeeze(-1)
        mask = masks.get(str(steps - 1) if steps > 1 else "steps")
        terms = {"loss_reward": self._reduce([error.square().mean(-1)], [mask], length)}
        if self.reduction != "none":
            absolute = error.detach().abs().mean(-1)
            terms["reward_error"] = mean_over(absolute.flatten(), None if mask is None else mask.flatten())
        return terms
