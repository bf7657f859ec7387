"""The reward head, trained on what the planner will show it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams, dispatch
from torch import Tensor
from torchrl.objectives.common import LossModule

from torchrl_vjepa.belief import rollout
from torchrl_vjepa.models import LatentModel
from torchrl_vjepa.windows import check_finite, pair_mask, read, step_mask

__all__ = ["RewardLoss"]


class RewardLoss(LossModule):
    r"""Squared error of a reward head on *predicted* latents.

    The head is asked what the planner will ask it: the reward of :math:`(\hat Z_{t+k}, u_{t+k-1})`
    where :math:`\hat Z_{t+k}` is the latent rolled out from :math:`Z_t` by the model's mean for
    :math:`k = 1, \dots,` ``num_steps`` (``eq:latent_mpc_objective`` with :math:`c = -r`). Rollouts that
    leave an episode or meet padding do not count.

    Entries: ``loss_reward``; diagnostic ``reward_error`` (mean absolute error).

    Args:
        model: the trained (or training) model; parameters stay its own.
        reward_model: TensorDictModule that reads the next latent and the action and writes the reward;
            its out key must be the key under which ``("next", ...)`` holds the true reward.
        num_steps: length of the imagined rollouts.
        train_model: whether the gradient flows into encoder and predictor too.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` (``(B, T - num_steps + 1)``).

    Raises:
        ValueError: if ``num_steps`` is not positive or ``reduction`` is unknown.

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
    class _AcceptedKeys:
        """Keys that the loss itself reads.

        Attributes:
            reward: the true reward. Defaults to ``("next", "reward")``.
            done: end of an episode after this step. Defaults to ``("next", "done")``.
            is_init: beginning of an episode at this step. Defaults to ``"is_init"``.
        """

        reward: NestedKey = ("next", "reward")
        done: NestedKey = ("next", "done")
        is_init: NestedKey = "is_init"

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

    def __init__(
        self,
        model: LatentModel,
        reward_model: TensorDictModuleBase,
        *,
        num_steps: int = 1,
        train_model: bool = False,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        super().__init__()
        if num_steps < 1:
            raise ValueError(f"num_steps must be positive, got {num_steps}")
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"reduction must be 'mean', 'sum' or 'none', got {reduction!r}")
        self.num_steps = num_steps
        self.train_model = train_model
        self.reduction = reduction
        self.convert_to_functional(reward_model, "reward_model")
        if train_model:
            self.convert_to_functional(model.encoder, "encoder")
            self.convert_to_functional(model.predictor, "predictor")
        # Not registered: without train_model its parameters are not the loss's to list or to save.
        self.__dict__["model"] = model
        self._set_in_keys()
        self._out_keys: list[NestedKey] | None = None

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        model: LatentModel = self.__dict__["model"]
        self._in_keys = [*model.in_keys, keys.reward, keys.done, keys.is_init]

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
        """``loss_reward`` and, unless ``reduction="none"``, ``reward_error``."""
        if self._out_keys is not None:
            return self._out_keys
        return ["loss_reward"] if self.reduction == "none" else ["loss_reward", "reward_error"]

    @out_keys.setter
    def out_keys(self, keys: list[NestedKey]) -> None:
        self._out_keys = keys

    def _imagine(self, data: TensorDictBase, action: Tensor) -> Tensor:
        model: LatentModel = self.__dict__["model"]
        with torch.set_grad_enabled(self.train_model and torch.is_grad_enabled()):
            latent = model.encoder(data.copy()).get(model.latent_key)
            starts = latent[:, : latent.shape[1] - self.num_steps + 1]
            return rollout(model.predictor.dist, starts, action)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss of a batch of windows.

        Args:
            tensordict: the windows, ``(*B, T)``; not changed.

        Returns:
            A tensordict with ``loss_reward`` and the diagnostic ``reward_error``.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if the window is shorter than ``num_steps``, the head writes another shape than
                the reward's, or a value that counts is not finite.
        """
        model: LatentModel = self.__dict__["model"]
        keys = self.tensor_keys
        name = type(self).__name__
        reward = read(tensordict, keys.reward, reader=name)
        action = read(tensordict, model.action_key, reader=name)
        batch = reward.shape[:-1]
        if not batch or batch[-1] < self.num_steps:
            raise ValueError(
                f"the windows must have at least num_steps={self.num_steps} steps, got a batch of shape "
                f"{tuple(batch)}"
            )
        mask = step_mask(tensordict, self._loss_mask_keys(), batch)
        entries = {
            key: value
            for key in (*model.encoder.in_keys, keys.done)
            if (value := tensordict.get(key, None)) is not None
        }
        observation_key = model.encoder.in_keys[0]
        read(tensordict, observation_key, reader=name)
        if not torch.compiler.is_compiling():
            for key, value in (
                (observation_key, entries[observation_key]),
                (model.action_key, action),
            ):
                check_finite(value, mask, key)
            check_finite(reward, mask, keys.reward)
        if mask is not None:
            keep = mask.unsqueeze(-1)
            entries[observation_key] = torch.where(keep, entries[observation_key], 0)
            action, reward = torch.where(keep, action, 0), torch.where(keep, reward, 0)
            mask = mask.reshape(-1, batch[-1])
        data = TensorDict(entries, batch_size=batch).reshape(-1, batch[-1])
        steps = self.num_steps
        action = action.reshape(-1, batch[-1], action.shape[-1]).unfold(1, steps, 1).transpose(-1, -2)
        reward = reward.reshape(-1, batch[-1], 1).unfold(1, steps, 1).transpose(-1, -2)

        latents = self._imagine(data, action)
        imagined = TensorDict(
            {model.latent_key: latents, model.action_key: action}, batch_size=latents.shape[:-1]
        )
        with self.reward_model_params.to_module(self.reward_model):
            predicted = self.reward_model(imagined).get(self.reward_model.out_keys[0])
        if predicted.shape != reward.shape:
            raise ValueError(
                f"reward_model must write rewards of shape {tuple(reward.shape)}, "
                f"got {tuple(predicted.shape)}"
            )
        error = (predicted - reward).squeeze(-1)
        counts: Tensor | None = self._rollout_mask(tensordict, mask, batch)
        squared = error.pow(2).mean(-1)
        if self.reduction == "none" and counts is not None:
            squared, counts = torch.where(counts, squared, 0), None
        out = TensorDict({"loss_reward": self._reduce_loss(squared, mask=counts)}, batch_size=[])
        if self.reduction != "none":
            out["reward_error"] = self._reduce_loss(
                error.detach().abs().mean(-1), mask=counts, reduction="mean"
            )
        self._clear_weakrefs(tensordict, out, "reward_model_params")
        return out

    def _rollout_mask(
        self, tensordict: TensorDictBase, mask: Tensor | None, batch: torch.Size
    ) -> Tensor | None:
        """Rollouts that stay in one episode: steps ``t .. t + num_steps - 1`` are joined."""
        flags = [tensordict.get(key, None) for key in (self.tensor_keys.done, self.tensor_keys.is_init)]
        flags = [None if flag is None else flag.reshape(-1, batch[-1]) for flag in flags]
        if self.num_steps == 1:
            return mask
        return pair_mask(flags[0], flags[1], mask, self.num_steps - 1)
