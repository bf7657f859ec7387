"""One step of many imagined states at once: what searches over discrete actions expand."""

from __future__ import annotations

from typing import Protocol

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from torchrl_vjepa.belief import PreparedTransition, rollout
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.planners.env_objective import EnvObjective

__all__ = ["ALIVE", "EnvExpansion", "Expansion", "HeldExpansion", "LatentExpansion", "State"]

State = dict[NestedKey, Tensor]

#: Entry of a state: the probability, or the fact, that the episode has not ended; no key of an environment.
ALIVE = "_alive"


class Expansion(Protocol):
    """A deterministic model that is searched: where it starts, and one step of it.

    Attributes:
        root: entries of the states that are planned from, each with batch ``(R)``, the rows: all batch
            dimensions flattened into one. Under :data:`ALIVE` the weight of what is still to come.

    Examples:
        >>> class Walk:
        ...     def __init__(self, latent):
        ...         self.root = {"latent": latent, ALIVE: torch.ones(latent.shape[:-1])}
        ...
        ...     def expand(self, state, action, step):
        ...         latent = state["latent"] + action
        ...         return {**state, "latent": latent}, latent.square().sum(-1)
        >>> walk: Expansion = Walk(torch.zeros(5, 2))
        >>> walk.expand(walk.root, torch.ones(5, 2), 0)[1]
        tensor([2., 2., 2., 2., 2.])
    """

    root: State

    def expand(self, state: State, action: Tensor, step: int | Tensor) -> tuple[State, Tensor]:
        """One step.

        Args:
            state: entries with batch ``(R, *X)``.
            action: codes, of shape ``(R, *X, A)``.
            step: how many steps from the root: one number, or one for each row, ``(R)``.

        Returns:
            Next state, and the costs of the step, of shape ``(R, *X)``, weighted by what is alive.
        """


class LatentExpansion:
    r"""Steps of a :class:`~torchrl_vjepa.envs.LatentEnv` by its point prediction.

    :math:`\hat Z_{t+1} = \mu_\phi(\hat Z_t, u_t)` (or the mode), at the cost
    :math:`a_t\,(c(\hat Z_{t+1}, u_t) + p_{t+1} c_{\text{end}})` with :math:`a_{t+1} = a_t (1 - p_{t+1})`,
    where :math:`p` is the predicted probability of an end, if there is a termination model. Sums over a plan
    are those of :meth:`~torchrl_vjepa.envs.LatentEnv.objective`.

    Args:
        env: the environment, whose next latent is the mean or the mode.
        state: what its ``planning_state`` gives, with batch ``*B``.
        horizon: steps ``H`` that are looked ahead.

    Examples:
        >>> from torchrl.data import OneHot
        >>> from torchrl_vjepa.costs import quadratic_cost
        >>> from torchrl_vjepa.distributions import Delta
        >>> env = LatentEnv(
        ...     lambda latent, action: Delta(latent + action),
        ...     action_spec=OneHot(2),
        ...     cost=quadratic_cost(torch.ones(2)),
        ...     latent_dim=2,
        ... )
        >>> walk = LatentExpansion(env, torch.zeros(5, 2), 3)
        >>> walk.expand(walk.root, torch.tensor([1.0, 0.0]).expand(5, 2), 0)[1]
        tensor([1., 1., 1., 1., 1.])
    """

    def __init__(self, env: LatentEnv, state: Tensor | TensorDictBase, horizon: int) -> None:
        self.env = env
        self.transition = PreparedTransition(env.world_model.transition, env.rollout_dtype)
        latent = state if isinstance(state, Tensor) else state.get("latent")
        batch = latent.shape[:-1]
        latent = latent.reshape(-1, latent.shape[-1])
        self.root: State = {env.latent_key: latent, ALIVE: torch.ones_like(latent[:, 0])}
        self.tasks: State = {}
        if not isinstance(state, Tensor) and env.task_keys:
            tasks = env.world_model.prior.along(state.get("tasks"), len(batch), horizon)
            self.tasks = {
                key: task.reshape(latent.shape[0], *task.shape[len(batch) :]) for key, task in tasks.items()
            }

    def expand(self, state: State, action: Tensor, step: int | Tensor) -> tuple[State, Tensor]:
        """One step of the point prediction.

        Args:
            state: holds latents of shape ``(R, *X, D)``.
            action: codes, of shape ``(R, *X, A)``.
            step: how many steps from the root: one number, or one for each row, ``(R)``.

        Returns:
            Next state, and the costs, of shape ``(R, *X)``.
        """
        env, model, alive = self.env, self.env.world_model, state[ALIVE]
        latent = state[env.latent_key]
        action = action.to(latent.dtype)
        # A plan of one step: the short way to the point, in the environment's dtype.
        latent = rollout(self.transition, latent, action.unsqueeze(-2), env.how).squeeze(-2)
        latent = latent.to(alive.dtype)
        task = self._tasks_at(step, latent.ndim - 2) if self.tasks else None
        cost = model.stage_cost(latent, action, task)
        if model.termination_model is not None:
            end = model.termination_probability(latent, action)
            cost = alive * (cost + end * model.termination_cost)
            alive = alive * (1 - end)
        return {env.latent_key: latent, ALIVE: alive}, cost

    def _tasks_at(self, step: int | Tensor, extra: int) -> State:
        """Tasks of a step, ``(R, *1, *task)``: they broadcast against ``(R, *X)``."""
        chosen = {}
        for key, task in self.tasks.items():
            last = task.shape[1] - 1
            if isinstance(step, Tensor):
                task = task[torch.arange(task.shape[0], device=task.device), step.clamp_max(last)]
            else:
                task = task[:, min(step, last)]
            chosen[key] = task.reshape(task.shape[0], *(1,) * extra, *task.shape[1:])
        return chosen


class EnvExpansion:
    """Steps of any TorchRL environment that is not batch-locked, taken as deterministic.

    The cost is minus the reward. What has ended costs nothing more.

    Args:
        source: the environment as an objective.
        state: what its ``planning_state`` gives, with batch ``*B``.

    Examples:
        >>> from torchrl.envs import PendulumEnv
        >>> env = PendulumEnv()
        >>> source = EnvObjective(env)
        >>> swing = EnvExpansion(source, source.planning_state(env.reset()))
        >>> swing.expand(swing.root, torch.zeros(1, 1), 0)[1].shape
        torch.Size([1])
    """

    def __init__(self, source: EnvObjective, state: TensorDictBase) -> None:
        self.source = source
        rows = state.reshape(state.numel())
        self.root: State = {key: rows.get(key) for key in source.in_keys}
        device = next(iter(self.root.values())).device
        self.root[ALIVE] = torch.ones(rows.batch_size, device=device)

    def expand(self, state: State, action: Tensor, step: int | Tensor) -> tuple[State, Tensor]:
        """One step of the environment.

        Args:
            state: what the environment reads, with batch ``(R, *X)``.
            action: codes, of shape ``(R, *X, A)``.
            step: not used.

        Returns:
            Next state, and the costs, of shape ``(R, *X)``.
        """
        source, batch = self.source, action.shape[:-1]
        current = TensorDict({key: state[key] for key in source.in_keys}, batch_size=batch)
        following = source.stepped(current, action)
        reward = following.get(source.reward_key).reshape(*batch, -1).sum(dim=-1)
        alive = state[ALIVE]
        cost = torch.where(alive > 0, -reward, 0.0)
        for key in source.done_keys:
            alive = torch.where(following.get(key).reshape(*batch, -1).any(dim=-1), 0.0, alive)
        after: State = {ALIVE: alive}
        for key in source.in_keys:
            value = following.get(key, None)
            after[key] = state[key] if value is None else value
        return after, cost


class HeldExpansion:
    r"""Steps of a model that each hold their action for ``repeat`` steps of another.

    They cost :math:`\sum_{j=0}^{r-1} \gamma^j c_j`.

    Args:
        expansion: of single steps.
        repeat: steps ``r`` in one.
        discount: :math:`\gamma`.

    Examples:
        >>> from torchrl.data import OneHot
        >>> from torchrl_vjepa.costs import quadratic_cost
        >>> from torchrl_vjepa.distributions import Delta
        >>> env = LatentEnv(
        ...     lambda latent, action: Delta(latent + action),
        ...     action_spec=OneHot(2),
        ...     cost=quadratic_cost(torch.zeros(2)),
        ...     latent_dim=2,
        ... )
        >>> leap = HeldExpansion(LatentExpansion(env, torch.zeros(5, 2), 6), repeat=2)
        >>> leap.expand(leap.root, torch.tensor([1.0, 0.0]).expand(5, 2), 0)[1]  # 1 + 4
        tensor([5., 5., 5., 5., 5.])
    """

    def __init__(self, expansion: Expansion, repeat: int, discount: float = 1.0) -> None:
        self.expansion, self.repeat, self.discount = expansion, repeat, discount
        self.root = expansion.root

    def expand(self, state: State, action: Tensor, step: int | Tensor) -> tuple[State, Tensor]:
        """All steps for which the action is held.

        Args:
            state: entries with batch ``(R, *X)``.
            action: codes, of shape ``(R, *X, A)``.
            step: how many times an action was held before: one number, or one for each row, ``(R)``.

        Returns:
            Next state, and the costs, of shape ``(R, *X)``.
        """
        first = step * self.repeat
        state, total = self.expansion.expand(state, action, first)
        for j in range(1, self.repeat):
            state, cost = self.expansion.expand(state, action, first + j)
            total = total + self.discount**j * cost
        return state, total
