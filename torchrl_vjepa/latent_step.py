"""One imagined step: the transition and what it costs, on tensors and on tensordicts."""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Distribution

from torchrl_vjepa.belief import Transition
from torchrl_vjepa.costs import StageCost
from torchrl_vjepa.distributions import Density, point_estimate
from torchrl_vjepa.priors import LatentDensity, Prior, Task
from torchrl_vjepa.state_heads import Head, in_evaluation, state_value, while_alive

__all__ = ["NO_GRADIENT", "LatentStep"]

NO_GRADIENT = (
    "prior must have a gradient for actions that require one, got an energy without: is it detached, rounded "
    "or a comparison? A sampling planner (CEM, MPPI) needs none"
)


def _survival(probability: Tensor) -> Tensor:
    """Probability of being alive behind each step ``(*B, H)``: zero from the first certain end on."""
    survival = 1 - probability
    ended = survival == 0
    after = ended.cumsum(dim=-1) > ended.long()
    return torch.where(after, 1.0, survival).cumprod(dim=-1)


class LatentStep(TensorDictModuleBase):
    """``latent, action -> next latent -> reward``, on tensors and on tensordicts.

    Args:
        predictor: owns the parameters of ``transition``.
        transition: ``(latent (*B, D), action (*B, A)) -> Distribution``.
        reward_model: reads next latent and action, writes the reward; or ``None``.
        cost: ``(next latent (*B, D), action (*B, A)) -> (*B)``; or ``None``.
        how: which latent of the distribution comes next.
        action_shape: shape of one action.
        latent_key: where the latent is.
        action_key: where the action is.
        reward_key: where the reward is written.
        prior: its energy of the next latent is a cost; its tasks are read from the input.
        termination_model: reads next latent and action, writes the logit of an end; or ``None``.
        termination_key: the logit's entry.
        termination_cost: what an end costs.

    Raises:
        TypeError: if the reward model is no TensorDictModule or the prior no Prior.
        KeyError: if the reward model reads or writes other keys.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_vjepa.costs import quadratic_cost
        >>> from torchrl_vjepa.distributions import Delta
        >>> def move(latent, action):
        ...     return Delta(latent + action)
        >>> step = LatentStep(
        ...     None, move, None, quadratic_cost(torch.zeros(2)), "mean", torch.Size([2]),
        ...     latent_key="latent", action_key="action", reward_key="reward",
        ... )
        >>> step(TensorDict(latent=torch.ones(2), action=torch.ones(2)))["reward"]
        tensor([-8.])
    """

    def __init__(
        self,
        predictor: Any,
        transition: Transition,
        reward_model: TensorDictModuleBase | None,
        cost: StageCost | None,
        how: Literal["mean", "mode", "sample"],
        action_shape: torch.Size,
        *,
        latent_key: NestedKey,
        action_key: NestedKey,
        reward_key: NestedKey,
        prior: Prior | None = None,
        termination_model: TensorDictModuleBase | None = None,
        termination_key: NestedKey = "termination_logit",
        termination_cost: float = 0.0,
    ) -> None:
        super().__init__()
        self.predictor = predictor  # registered: its parameters move and synchronise with the env
        self.transition = transition
        self.reward_model: Any = reward_model
        self.cost = cost
        if prior is not None and not isinstance(prior, Prior):
            raise TypeError(
                "prior must be a Prior, for instance EnergyPrior(energy) of a plain function, got "
                f"{type(prior).__name__}"
            )
        self.prior = prior
        self.how = how
        self.action_shape = tuple(action_shape)
        self.action_dim = math.prod(action_shape)
        self.latent_key, self.action_key = unravel_key(latent_key), unravel_key(action_key)
        self.reward_key = reward_key
        self.in_keys = [self.latent_key, self.action_key]
        self.out_keys = [self.latent_key, self.reward_key]
        self.reward_calls_tensors = False
        self.termination_model: Any = termination_model
        self.termination_key, self.termination_cost = unravel_key(termination_key), termination_cost
        example = "TensorDictModule(QuadraticReward(D, A), ['latent', 'action'], ['reward'])"
        self._check_head("reward_model", reward_model, self.reward_key, example)
        example = "TensorDictModule(nn.Linear(D, 1), ['latent'], ['termination_logit'])"
        self._check_head("termination_model", termination_model, self.termination_key, example)

    def _check_head(self, name: str, head: Any, written: NestedKey, example: str) -> None:
        if head is None:
            return
        if not isinstance(head, TensorDictModuleBase):
            raise TypeError(
                f"{name} must be a TensorDictModule, for instance {example}, got {type(head).__name__}"
            )
        reads = [unravel_key(key) for key in head.in_keys]
        if not set(reads) <= set(self.in_keys):
            raise KeyError(
                f"{name} must read only latent_key={self.latent_key!r} and "
                f"action_key={self.action_key!r}, got in_keys={reads}; rename its in_keys"
            )
        if written not in [unravel_key(key) for key in head.out_keys]:
            raise KeyError(f"{name} must write {written!r}, got out_keys={list(head.out_keys)}")

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the next latent and the reward.

        Args:
            tensordict: holds latent and action.

        Returns:
            The same tensordict.
        """
        return tensordict.update(self.step(tensordict, None))

    def step(self, tensordict: TensorDictBase, generator: torch.Generator | None) -> TensorDictBase:
        """Next latent and reward, and nothing else of the input.

        Args:
            tensordict: holds latent and action.
            generator: source of randomness for ``how="sample"``.

        Returns:
            A new tensordict of the same batch size.
        """
        # A new tensordict: no stale done or reward of the input passes through.
        latent = tensordict.get(self.latent_key)
        action = tensordict.get(self.action_key)
        action = action.reshape((*latent.shape[:-1], self.action_dim)).to(latent.dtype)
        p = self.transition(latent, action)
        latent = point_estimate(p, self.how, generator=generator)
        out = TensorDict({}, batch_size=tensordict.batch_size, device=tensordict.device)
        task: Task = None
        if self.prior is not None:
            ndim = tensordict.batch_dims
            task = {k: v.squeeze(ndim) for k, v in self.prior.along(tensordict, ndim, 1).items()}
            out.update(self.prior.advanced(tensordict, ndim))
        cost = self.stage_cost(latent, action, task)
        if self.termination_model is not None:
            probability = self.termination_probability(latent, action)
            draw = torch.full_like(probability, 0.5)
            if self.how == "sample":
                draw.uniform_(generator=generator)
            end = probability > draw
            cost = cost + self.termination_cost * end
            out.set("terminated", end.unsqueeze(-1)).set("done", end.unsqueeze(-1))
        return out.set(self.latent_key, latent).set(self.reward_key, -cost.unsqueeze(-1))

    def stage_cost(
        self,
        latent: Tensor,
        action: Tensor,
        task: Task = None,
        *,
        density: LatentDensity | None = None,
        needs_gradient: bool = False,
    ) -> Tensor:
        """Costs of next latents and the actions that led there, all at once.

        Args:
            latent: of shape ``(*B, D)``.
            action: flat, of shape ``(*B, A)``.
            task: of the prior, with batch dimensions that broadcast against ``*B``.
            density: what the prior gives for the task, where that is known already.
            needs_gradient: whether an energy without a gradient is refused: in a sum with other costs its
                absence would not be noticed.

        Returns:
            Of shape ``(*B)``: the cost, minus the reward, plus the energy of the prior.

        Raises:
            ValueError: if one of them returns another shape, or the energy has no gradient.
        """
        total = self.own_cost(latent, action)
        if self.prior is None:
            return total
        if density is None:
            density = self.prior.density(latent.shape[-1], task)
        energy = _checked_shape(-density.log_prob(latent), latent.shape[:-1], "prior")
        lacks_gradient = needs_gradient and not energy.requires_grad and torch.is_grad_enabled()
        if lacks_gradient and not (isinstance(density, Density) and density.is_flat):
            raise ValueError(NO_GRADIENT)
        return energy if total is None else total + energy

    def own_cost(self, latent: Tensor, action: Tensor) -> Any:
        """The cost without the energy of the prior.

        Args:
            latent: of shape ``(*B, D)``.
            action: flat, of shape ``(*B, A)``.

        Returns:
            Of shape ``(*B)``; ``None`` where there is only a prior.

        Raises:
            ValueError: if the cost or the reward model returns another shape.
        """
        total = None
        cost = self.cost
        if cost is not None:
            total = _checked_shape(cost(latent, action), latent.shape[:-1], "cost")
        if self.reward_model is None:
            return total
        reward = self._reward(latent, action)
        return -reward if total is None else total - reward

    def termination_probability(self, latent: Tensor, action: Tensor) -> Tensor:
        """Probability that the episode ends with a step.

        Args:
            latent: next latents, of shape ``(*B, D)``.
            action: flat, of shape ``(*B, A)``.

        Returns:
            Of shape ``(*B)``.

        Raises:
            ValueError: if the termination model returns another shape.
        """
        batch = latent.shape[:-1]
        shaped = action.reshape((*batch, *self.action_shape))
        logit = self._of_tensordict(self.termination_model, latent, shaped, self.termination_key)
        return _checked_shape(logit, (*batch, 1), "termination_model").squeeze(-1).sigmoid()

    def until_end(self, costs: Tensor, latent: Tensor, action: Tensor) -> Tensor:
        r"""Costs as far as an episode lives, :math:`\prod_{j<k} (1 - p_j) \, (c_k + p_k c_{\text{end}})`.

        Args:
            costs: :math:`c_k`, of shape ``(*B, H)``.
            latent: next latents, of shape ``(*B, H, D)``.
            action: flat, of shape ``(*B, H, A)``.

        Returns:
            Of shape ``(*B, H)``; the costs themselves where there is no termination model.
        """
        if self.termination_model is None:
            return costs
        probability = self.termination_probability(latent, action)
        alive = _survival(probability)
        alive = torch.cat([torch.ones_like(alive[..., :1]), alive[..., :-1]], dim=-1)
        return while_alive(alive, costs + probability * self.termination_cost)

    def value_behind(self, head: Head, latent: Tensor, action: Tensor) -> Tensor:
        r"""What trajectories are worth behind their horizon, :math:`\prod_{k=1}^{H} (1 - p_k) \, V(Z_{t+H})`.

        Args:
            head: :math:`V`, see :func:`~torchrl_vjepa.state_heads.state_value`.
            latent: next latents, of shape ``(*B, H, D)``.
            action: flat, of shape ``(*B, H, A)``; the head must have a gradient where they require one.

        Returns:
            Of shape ``(*B)``.

        Raises:
            ValueError: if the head gives another shape, or no gradient.
        """
        last = latent[..., -1, :]
        value = state_value(
            head,
            {self.latent_key: last},
            last.shape[:-1],
            self.latent_key,
            needs_gradient=action.requires_grad,
        )
        if self.termination_model is None:
            return value
        return while_alive(_survival(self.termination_probability(latent, action))[..., -1], value)

    def fused_cost(
        self, latent: Tensor, action: Tensor, log_evidence: Tensor, density: LatentDensity | None = None
    ) -> Tensor:
        """Costs of trajectories that were drawn from the fused transition, as far as an episode lives.

        Args:
            latent: next latents, of shape ``(*B, H, D)``.
            action: flat, of shape ``(*B, H, A)``.
            log_evidence: of every step's fusion, of shape ``(*B, H)``.
            density: what the prior gives for its tasks; needed where there is a termination model.

        Returns:
            Of shape ``(*B, H)``.
        """
        if self.termination_model is None:
            own = self.own_cost(latent, action)
            return -log_evidence if own is None else own - log_evidence
        # The draws have met the prior at every step; what is wanted counts it until the end alone.
        counted = self.until_end(self.stage_cost(latent, action, density=density), latent, action)
        return counted + density.log_prob(latent) - log_evidence  # type: ignore[union-attr]

    def _reward(self, latent: Tensor, action: Tensor) -> Tensor:
        batch = latent.shape[:-1]
        shaped = action.reshape((*batch, *self.action_shape))
        if self.reward_calls_tensors:
            reward = self._reward_of_tensors(latent, shaped)
        else:
            reward = self._of_tensordict(self.reward_model, latent, shaped, self.reward_key)
        return _checked_shape(reward, (*batch, 1), "reward_model").squeeze(-1)

    def probe(
        self, latent_dim: int, action_dim: int, device: torch.device | None, dtype: torch.dtype
    ) -> None:
        """Call every part on a small block, in evaluation mode, so that errors come early.

        Args:
            latent_dim: size of the latent.
            action_dim: numbers in an action.
            device: of the block.
            dtype: of the block.

        Raises:
            ValueError: if a part returns a wrong shape.
            TypeError: if the transition returns no distribution.
        """
        batch = (2, 3)
        latent = torch.linspace(-1.0, 1.0, 6 * latent_dim, device=device, dtype=dtype)
        latent = latent.reshape(*batch, latent_dim)
        action = torch.linspace(-0.9, 1.1, 6 * action_dim, device=device, dtype=dtype)
        action = action.reshape(*batch, action_dim)
        with in_evaluation(self):
            self._probe(latent, action)

    def _probe(self, latent: Tensor, action: Tensor) -> None:
        batch = latent.shape[:-1]
        p = self.transition(latent, action)
        if not isinstance(p, Distribution):
            raise TypeError(
                "model must return a torch Distribution over the next latent, got "
                f"{type(p).__name__}; wrap a point prediction in Delta"
            )
        if tuple(p.batch_shape) != batch or tuple(p.event_shape) != latent.shape[-1:]:
            raise ValueError(
                f"model must return a distribution with batch shape {tuple(batch)} and event shape "
                f"{tuple(latent.shape[-1:])} for latent {tuple(latent.shape)} and action "
                f"{tuple(action.shape)}, got {tuple(p.batch_shape)} and {tuple(p.event_shape)}"
            )
        if self.prior is not None and not self.prior.in_keys:  # else there is no task to try it with
            self.stage_cost(latent, action)
            shape = tuple(self.prior.energy(latent[:1, 0]).shape)
            if shape != (1,):
                raise ValueError(
                    "prior without a task must be one for all latents, got one with batch dimensions: an "
                    f"energy of shape {shape} for a single latent; tasks of rows or steps are entries of the "
                    "tensordict"
                )
        self.own_cost(latent, action)
        if self.termination_model is not None:
            self.termination_probability(latent, action)
        model = self.reward_model
        first = torch.empty(0) if model is None else self._reward(latent, action)
        if (
            type(model) is TensorDictModule
            and isinstance(model.module, nn.Module)
            and list(map(unravel_key, model.out_keys)) == [self.reward_key]
        ):
            # A plain network needs no tensordict per call, provided that it says the same.
            try:
                second = self._reward_of_tensors(latent, action.reshape((*batch, *self.action_shape)))
                self.reward_calls_tensors = torch.equal(second.squeeze(-1), first)
            except (TypeError, RuntimeError, ValueError):  # keyword inputs, for instance
                self.reward_calls_tensors = False

    def _reward_of_tensors(self, latent: Tensor, action: Tensor) -> Tensor:
        model = self.reward_model
        inputs = {self.latent_key: latent, self.action_key: action}
        return model.module(*(inputs[unravel_key(key)] for key in model.in_keys))

    def _of_tensordict(self, head: Any, latent: Tensor, action: Tensor, key: NestedKey) -> Any:
        inputs = TensorDict({}, batch_size=latent.shape[:-1], device=latent.device)
        inputs.set(self.latent_key, latent).set(self.action_key, action)
        return head(inputs).get(key)


def _checked_shape(value: Tensor, expected: tuple[int, ...], name: str) -> Tensor:
    if not isinstance(value, Tensor) or tuple(value.shape) != tuple(expected):
        got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise ValueError(
            f"{name} must return a tensor of shape {tuple(expected)} for the batch "
            f"{tuple(expected)[: -1 if name.endswith('model') else None]}, got {got}"
        )
    return value
