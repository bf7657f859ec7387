"""Heads on imagined latents, trained on what the planner will show them: reward and termination."""

from __future__ import annotations

import abc
import math
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from torch import Tensor

from torchrl_vjepa.belief import rollout
from torchrl_vjepa.models import LatentModel
from torchrl_vjepa.objectives.pairs import mean_over
from torchrl_vjepa.objectives.window_loss import WindowLoss

__all__ = ["ImaginedLoss", "RewardLoss", "TerminationLoss"]


class ImaginedLoss(WindowLoss, abc.ABC):
    r"""Loss of a head on *predicted* latents: what :class:`RewardLoss` and :class:`TerminationLoss` share.

    The head is asked what the planner will ask it: about :math:`(\hat Z_{t+k}, u_{t+k-1})`, where
    :math:`\hat Z_{t+k}` is the latent rolled out from :math:`Z_t` by the model's mean for
    :math:`k = 1, \dots,` ``num_steps``. Rollouts that leave an episode or meet padding do not count.

    Args:
        model: the trained (or training) model; parameters stay its own.
        head: TensorDictModule that reads the next latent and the action.
        num_steps: length of the imagined rollouts.
        train_model: whether the gradient flows into encoder and predictor too; then ``parameters()``
            holds theirs as well: give each to one optimizer only.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` (``(B, T)``, zero where no rollout starts).

    Raises:
        ValueError: if ``num_steps`` is not positive or ``reduction`` is unknown.
        TypeError: if ``model`` is no :class:`LatentModel` or ``head`` no TensorDictModule.

    Examples:
        >>> issubclass(RewardLoss, ImaginedLoss) and issubclass(TerminationLoss, ImaginedLoss)
        True
    """

    encoder: TensorDictModuleBase
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams
    predictor: TensorDictModuleBase
    predictor_params: TensorDictParams
    target_predictor_params: TensorDictParams

    _model_type = SimpleNamespace  # what the constructor makes of the model and the head
    _head_name: ClassVar[str]
    _target_name: ClassVar[str]
    _head_example: ClassVar[str]

    def __init__(
        self,
        model: LatentModel,
        head: TensorDictModuleBase,
        *,
        num_steps: int = 1,
        train_model: bool = False,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        if num_steps < 1:
            raise ValueError(f"num_steps must be positive, got {num_steps}")
        if not isinstance(model, LatentModel):
            raise TypeError(
                f"model must be one LatentModel (of several, give each a {type(self).__name__} of its own), "
                f"got {type(model).__name__}"
            )
        if not isinstance(head, TensorDictModuleBase):
            raise TypeError(
                f"{self._head_name} must be a TensorDictModule, for instance {self._head_example}, got "
                f"{type(head).__name__}"
            )
        parts = SimpleNamespace(encoder=model.encoder, predictor=model.predictor, **{self._head_name: head})
        names = [self._head_name, *(["encoder", "predictor"] if train_model else [])]
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

    @property
    def _target_key(self) -> NestedKey:
        return getattr(self.tensor_keys, self._target_name)

    @abc.abstractmethod
    def _errors(self, predicted: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
        """Losses and what is reported beside them, each of the shape ``(B, N, num_steps)``."""

    def _action_entry(self) -> tuple[NestedKey, int]:
        return self.predictor.action_key, self.predictor.action_dim

    def _required_keys(self) -> list[NestedKey]:
        if "encoder" not in self.__dict__:  # while the parent is being built
            return []
        predictor = self.predictor
        observation_key, target_key = self.encoder.in_keys[0], self._target_key
        if predictor.action_dim:
            return [observation_key, target_key, predictor.action_key]
        return [target_key, observation_key]

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
        head = getattr(self, self._head_name)
        with params[0].to_module(head):
            return {"predicted": head(imagined).get(head.out_keys[0])}

    def _terms(
        self, data: TensorDictBase, masks: dict[str, Tensor], outputs: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        steps, length = self.num_steps, data.shape[1]
        true = data.get(self._target_key)
        if true.ndim != 3 or true.shape[-1] != 1:
            raise ValueError(
                f"{self._target_key!r} must have shape {(*data.shape, 1)}, got {tuple(true.shape)}"
            )
        target = true.unfold(1, steps, 1).transpose(-1, -2)
        predicted = outputs["predicted"]
        if predicted.shape != target.shape:
            raise ValueError(
                f"{self._head_name} must write {self._target_name} of shape {tuple(target.shape)}, "
                f"got {tuple(predicted.shape)}"
            )
        losses, reported = self._errors(predicted.squeeze(-1), target.squeeze(-1).to(predicted.dtype))
        mask = masks.get(str(steps - 1) if steps > 1 else "steps")
        (loss_key,), (diagnostic_key,) = self._loss_keys(), self._diagnostic_keys()
        terms = {loss_key: self._reduce([losses.mean(-1)], [mask], length)}
        if self.reduction != "none":
            mean = reported.detach().mean(-1)
            terms[diagnostic_key] = mean_over(mean.flatten(), None if mask is None else mask.flatten())
        return terms


class RewardLoss(ImaginedLoss):
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

    _head_name = "reward_model"
    _target_name = "reward"
    _head_example = "TensorDictModule(QuadraticReward(D, A), ['latent', 'action'], ['reward'])"

    def __init__(
        self,
        model: LatentModel,
        reward_model: TensorDictModuleBase,
        *,
        num_steps: int = 1,
        train_model: bool = False,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        super().__init__(
            model, reward_model, num_steps=num_steps, train_model=train_model, reduction=reduction
        )

    def _loss_keys(self) -> Iterator[str]:
        yield "loss_reward"

    def _diagnostic_keys(self) -> Iterator[str]:
        yield "reward_error"

    def _errors(self, predicted: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
        error = predicted - true
        return error.square(), error.abs()


class TerminationLoss(ImaginedLoss):
    r"""Cross-entropy of a termination head on *predicted* latents.

    .. math:: -\log p(d_{t+k} \mid \hat Z_{t+k}, u_{t+k-1}), \qquad
        p(d = 1) = \mathrm{sigmoid}(\text{logit})

    with :math:`d` the true ``terminated`` flag and :math:`\hat Z_{t+k}` the latent rolled out by the model's
    mean, as in :class:`RewardLoss`. A truncated episode did not end by itself: its flag is zero.

    Entries: ``loss_termination`` in nats; diagnostic ``termination_error`` (share of wrong decisions).

    Args:
        model: the trained (or training) model; parameters stay its own.
        termination_model: TensorDictModule that reads the next latent (and the action) and writes the
            logit of an end, of shape ``(*B, 1)``.
        num_steps: length of the imagined rollouts.
        positive_weight: how many times an end counts: ends are rare.
        train_model: whether the gradient flows into encoder and predictor too; then ``parameters()``
            holds theirs as well: give each to one optimizer only.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` (``(B, T)``, zero where no rollout starts).

    Raises:
        ValueError: if ``num_steps`` or ``positive_weight`` is not positive or ``reduction`` is unknown.
        TypeError: if ``model`` is no :class:`LatentModel` or ``termination_model`` no TensorDictModule.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl_vjepa import VJEPA, Predictor, linear_encoder
        >>> model = VJEPA(linear_encoder(20, 4), Predictor(4, action_dim=2))
        >>> head = TensorDictModule(torch.nn.Linear(4, 1), ["latent"], ["termination_logit"])
        >>> loss = TerminationLoss(model, head)
        >>> windows = TensorDict(
        ...     observation=torch.randn(8, 5, 20),
        ...     action=torch.randn(8, 5, 2),
        ...     next=TensorDict(terminated=torch.zeros(8, 5, 1, dtype=torch.bool), batch_size=(8, 5)),
        ...     batch_size=(8, 5),
        ... )
        >>> loss(windows)["loss_termination"].shape
        torch.Size([])
    """

    @dataclass
    class _AcceptedKeys(WindowLoss._AcceptedKeys):
        """Keys that the loss itself reads.

        Attributes:
            terminated: whether the episode ended by itself. Defaults to ``("next", "terminated")``.
            done: end of an episode after this step. Defaults to ``("next", "done")``.
            is_init: beginning of an episode at this step. Defaults to ``"is_init"``.
        """

        terminated: NestedKey = ("next", "terminated")

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys

    termination_model: TensorDictModuleBase
    termination_model_params: TensorDictParams
    target_termination_model_params: TensorDictParams

    _head_name = "termination_model"
    _target_name = "terminated"
    _head_example = "TensorDictModule(nn.Linear(D, 1), ['latent'], ['termination_logit'])"

    def __init__(
        self,
        model: LatentModel,
        termination_model: TensorDictModuleBase,
        *,
        num_steps: int = 1,
        positive_weight: float = 1.0,
        train_model: bool = False,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        if not 0 < positive_weight < math.inf:
            raise ValueError(f"positive_weight must be positive and finite, got {positive_weight}")
        super().__init__(
            model, termination_model, num_steps=num_steps, train_model=train_model, reduction=reduction
        )
        self.positive_weight = float(positive_weight)

    def _loss_keys(self) -> Iterator[str]:
        yield "loss_termination"

    def _diagnostic_keys(self) -> Iterator[str]:
        yield "termination_error"

    def _errors(self, predicted: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
        weight = predicted.new_tensor(self.positive_weight)
        losses = F.binary_cross_entropy_with_logits(predicted, true, reduction="none", pos_weight=weight)
        return losses, ((predicted > 0) != (true > 0.5)).to(predicted.dtype)
