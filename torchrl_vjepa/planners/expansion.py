"""One step of many imagined states at once: what searches expand, and policies act in."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from torchrl_vjepa.belief import ParticleBelief, PreparedTransition, rollout
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.planners.env_objective import EnvObjective
from torchrl_vjepa.priors import LatentDensity
from torchrl_vjepa.state_heads import while_alive

__all__ = [
    "ALIVE",
    "EnvExpansion",
    "Expansion",
    "HeldExpansion",
    "LatentExpansion",
    "State",
    "entries",
    "expansion_from",
]

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
        ...         state = self.move(state, action)
        ...         return state, state["latent"].square().sum(-1)
        ...
        ...     def move(self, state, action):
        ...         return {**state, "latent": state["latent"] + action}
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

    def move(self, state: State, action: Tensor) -> State:
        """One step without its cost.

        Args:
            state: entries with any batch ``*B``.
            action: codes, of shape ``(*B, A)``.

        Returns:
            Next state; what its episode has lived through may be left out of :data:`ALIVE`.
        """


class LatentExpansion:
    r"""Steps of a :class:`~torchrl_vjepa.envs.LatentEnv` by its point prediction.

    :math:`\hat Z_{t+1} = \mu_\phi(\hat Z_t, u_t)` (or the mode), at the cost
    :math:`a_t\,(c(\hat Z_{t+1}, u_t) + p_{t+1} c_{\text{end}})` with :math:`a_{t+1} = a_t (1 - p_{t+1})`,
    where :math:`p` is the predicted probability of an end, if there is a termination model. Sums over a plan
    are those of :meth:`~torchrl_vjepa.envs.LatentEnv.objective`.

    Args:
        env: the environment; where it samples the next latent, the mean is taken.
        state: what its ``planning_state`` gives, with batch ``*B``; of a belief the mean is taken.
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
        if isinstance(state, Tensor):
            latent = state
        elif state.get("latent", None) is not None:
            latent = state.get("latent")
        else:
            latent = ParticleBelief(state.get("particles"), state.get("log_weights")).mean
        batch = latent.shape[:-1]
        latent = latent.reshape(-1, latent.shape[-1])
        self.root: State = {env.latent_key: latent, ALIVE: torch.ones_like(latent[:, 0])}
        self.tasks: State = {}
        self._densities: dict[int, LatentDensity] = {}  # by dimensions behind the rows
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
        model, alive = self.env.world_model, state[ALIVE]
        moved = self.move(state, action)
        latent = moved[self.env.latent_key]
        action = action.to(latent.dtype)
        density = None if model.prior is None else self._density(step, latent)
        cost = model.stage_cost(latent, action, density=density)
        if model.termination_model is not None:
            end = model.termination_probability(latent, action)
            cost = while_alive(alive, cost + end * model.termination_cost)
            alive = while_alive(alive, 1 - end)
        return {**moved, ALIVE: alive}, cost

    def move(self, state: State, action: Tensor) -> State:
        """One step of the point prediction, without its cost.

        Args:
            state: holds latents of shape ``(*B, D)``.
            action: codes, of shape ``(*B, A)``.

        Returns:
            Next state, as alive as before.
        """
        env, latent = self.env, state[self.env.latent_key]
        # A plan of one step: the short way to the point, in the environment's dtype.
        plan = action.to(latent.dtype).unsqueeze(-2)
        moved = rollout(self.transition, latent, plan, "mode" if env.how == "mode" else "mean")
        return {**state, env.latent_key: moved.squeeze(-2).to(latent.dtype)}

    def _density(self, step: int | Tensor, latent: Tensor) -> LatentDensity:
        """What the prior gives for the tasks of a step; once, where they are the same in all steps."""
        extra = latent.ndim - 2
        if extra in self._densities:
            return self._densities[extra]
        task = self._tasks_at(step, extra) if self.tasks else None
        density = self.env.world_model.prior.density(latent.shape[-1], task)
        if all(task.shape[1] == 1 for task in self.tasks.values()):
            self._densities[extra] = density
        return density

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

    def move(self, state: State, action: Tensor) -> State:
        """One step of the environment, without its cost.

        Args:
            state: what the environment reads, with batch ``*B``.
            action: codes, of shape ``(*B, A)``.

        Returns:
            Next state.
        """
        return self.expand(state, action, 0)[0]


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

    def move(self, state: State, action: Tensor) -> State:
        """All steps for which the action is held, without their costs.

        Args:
            state: entries with any batch ``*B``.
            action: codes, of shape ``(*B, A)``.

        Returns:
            Next state.
        """
        for _ in range(self.repeat):
            state = self.expansion.move(state, action)
        return state


def entries(state: State) -> State:
    """What heads read of a state: all but :data:`ALIVE`.

    Args:
        state: the state.

    Returns:
        Its other entries.

    Examples:
        >>> entries({"latent": torch.zeros(2), ALIVE: torch.ones(())})
        {'latent': tensor([0., 0.])}
    """
    return {key: value for key, value in state.items() if key != ALIVE}


def expansion_from(
    source: LatentEnv | EnvObjective, state: Any, horizon: int, repeat: int = 1, discount: float = 1.0
) -> Expansion:
    """Decisions in a source of plans.

    Args:
        source: a latent environment, or one that is stepped as an objective.
        state: what its ``planning_state`` gives.
        horizon: steps ``H`` that are looked ahead.
        repeat: steps for which each action is held.
        discount: of the costs while it is held.

    Returns:
        The steps that a decision takes, as one.

    Examples:
        >>> from torchrl.envs import PendulumEnv
        >>> env = PendulumEnv()
        >>> source = EnvObjective(env)
        >>> expansion_from(source, source.planning_state(env.reset()), 3).root["th"].shape
        torch.Size([1])
    """
    expansion: Expansion
    if isinstance(source, EnvObjective):
        expansion = EnvExpansion(source, state)
    else:
        expansion = LatentExpansion(source, state, horizon)
    return expansion if repeat == 1 else HeldExpansion(expansion, repeat, discount)
