"""Exhaustive search: every plan of finitely many actions."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_vjepa.planners.discrete import DiscretePlanner
from torchrl_vjepa.planners.expansion import ALIVE, Expansion, State, entries
from torchrl_vjepa.planners.plan import Plan, check_counts
from torchrl_vjepa.planners.proposal import Proposal
from torchrl_vjepa.planners.source import latent_key_of
from torchrl_vjepa.state_heads import state_value, while_alive

__all__ = ["ExhaustiveSearch"]


class ExhaustiveSearch(DiscretePlanner):
    r"""The best of all :math:`n^H` plans, exactly.

    .. math:: u^\star = \arg\min_{u \in \{1, \dots, n\}^H} \sum_{k=0}^{H-1} c(Z_{t+k+1}, u_{t+k}) - V(Z_{t+H})

    with the ``terminal_value`` :math:`V`, if there is one.
    Of equal plans it is the first in lexical order. Where a plan costs the sum of what its steps cost (the
    point prediction of a :class:`~torchrl_vjepa.envs.LatentEnv`, or an environment that is stepped) the tree
    of plans is expanded breadth first: what plans have in common is imagined once,
    :math:`n + n^2 + \dots + n^H` steps instead of :math:`H n^H`. Else, with sampled trajectories, a risk or
    constraints, all plans go through the environment's objective, with the same noise.

    **Nothing is carried from step to step** by default (``warm_start=False``): an optimum needs no start.

    Args:
        env: see :class:`DiscretePlanner`.
        planning_horizon: see :class:`Planner`.
        chunk_size: states (or plans, where they go through the objective) of each row that are imagined at
            once, about; bounds the memory. All by default. The plan does not depend on it.
        max_plans: more plans than this are refused.
        **kwargs: see :class:`Planner`.

    Raises:
        ValueError: if there are more than ``max_plans`` plans, or an argument is out of its range.
        TypeError: see :class:`DiscretePlanner`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import OneHot
        >>> from torchrl_vjepa.costs import quadratic_cost
        >>> from torchrl_vjepa.distributions import Delta
        >>> from torchrl_vjepa.envs import LatentEnv
        >>> def move(latent, action):  # left, stay, right
        ...     return Delta(latent + action[..., 2:] - action[..., :1])
        >>> env = LatentEnv(
        ...     move,
        ...     action_spec=OneHot(3),
        ...     cost=quadratic_cost(torch.tensor([2.0])),
        ...     latent_dim=1,
        ... )
        >>> planner = ExhaustiveSearch(env, planning_horizon=3, return_stats=True)
        >>> planner(TensorDict(latent=torch.tensor([0.0])))["plan_stats", "actions"].argmax(-1)
        tensor([2, 2, 1])
    """

    def __init__(
        self,
        env: EnvBase,
        planning_horizon: int,
        *,
        chunk_size: int | None = None,
        max_plans: int = 100_000,
        warm_start: bool = False,
        **kwargs: Any,
    ) -> None:
        check_counts(max_plans=max_plans)
        if chunk_size is not None:
            check_counts(chunk_size=chunk_size)
        super().__init__(env, planning_horizon, warm_start=warm_start, **kwargs)
        self.chunk_size, self.max_plans = chunk_size, max_plans
        if self.num_plans > max_plans:
            raise ValueError(
                f"planning_horizon={planning_horizon} with {self.num_actions} actions makes {self.num_plans} "
                f"plans, more than max_plans={max_plans}; shorten it, raise max_plans (and bound the memory "
                "by chunk_size), or use TreeSearch"
            )

    @property
    def num_plans(self) -> int:
        """All of them, :math:`n^H` (of ``H / action_repeat`` decisions)."""
        return self.num_actions**self.num_decisions

    def plan(self, state: Any, proposal: Proposal) -> Plan:
        """Evaluate every plan.

        Args:
            state: what ``planning_state`` of the environment gives, with batch ``*B``.
            proposal: tells ``*B``; else not used.

        Returns:
            The best plan, as ``actions`` and as ``best``; the first of all plans where no cost is finite.
        """
        batch = proposal.mean.shape[:-2]
        if not batch.numel():
            cost, number = proposal.mean.new_zeros(batch), torch.zeros(batch, dtype=torch.long)
        elif self._is_deterministic():
            expansion = self._expansion(state)
            root = {key: value.unsqueeze(1) for key, value in expansion.root.items()}
            start = proposal.mean.new_zeros(batch.numel(), 1)
            cost, number = (found.reshape(batch) for found in self._below(expansion, root, start, 0))
        else:
            cost, number = self._by_objective(state, batch)
        plan = self._coded(self._digits(number.to(self.choices.device)))
        return Plan(plan, torch.zeros_like(plan), plan, cost)

    def _digits(self, number: Tensor) -> Tensor:
        """Actions ``(*B, H)`` of plans ``(*B)`` in lexical order."""
        place = torch.arange(self.num_decisions - 1, -1, -1, device=number.device)
        return number.unsqueeze(-1) // self.num_actions**place % self.num_actions

    def _below(self, expansion: Expansion, state: State, cost: Tensor, step: int) -> tuple[Tensor, Tensor]:
        """Lowest cost ``(R)`` of plans that begin as ``W`` states ``(R, W)`` did, and its number."""
        rows, width = cost.shape
        if step == self.num_decisions:
            if self.terminal_value is not None:
                value = state_value(
                    self.terminal_value, entries(state), cost.shape, latent_key_of(self._source)
                )
                cost = cost - while_alive(state[ALIVE], value).to(cost.dtype)
            return torch.where(cost.isfinite(), cost, torch.inf).min(dim=1)
        n = self.num_actions
        size = width if self.chunk_size is None else max(1, self.chunk_size // n)
        if size < width:
            return self._in_parts(expansion, state, cost, step, size)
        repeated = {key: value.repeat_interleave(n, dim=1) for key, value in state.items()}
        action = self.choices.repeat(width, 1).expand(rows, -1, -1)
        following, stage = expansion.expand(repeated, action, step)
        return self._below(expansion, following, cost.repeat_interleave(n, dim=1) + stage, step + 1)

    def _in_parts(
        self, expansion: Expansion, state: State, cost: Tensor, step: int, size: int
    ) -> tuple[Tensor, Tensor]:
        below = self.num_actions ** (self.num_decisions - step)
        costs, numbers = [], []
        for first in range(0, cost.shape[1], size):
            part = {key: value[:, first : first + size] for key, value in state.items()}
            lowest, number = self._below(expansion, part, cost[:, first : first + size], step)
            costs.append(lowest)
            numbers.append(number + first * below)
        cost, part_number = torch.stack(costs, dim=-1).min(dim=-1)
        return cost, torch.stack(numbers, dim=-1).gather(-1, part_number.unsqueeze(-1)).squeeze(-1)

    def _by_objective(self, state: Any, batch: torch.Size) -> tuple[Tensor, Tensor]:
        size = self.num_plans if self.chunk_size is None else self.chunk_size
        noise = self._model_generator.get_state()
        costs, numbers = [], []
        for first in range(0, self.num_plans, size):
            number = torch.arange(first, min(first + size, self.num_plans), device=self.choices.device)
            plans = self._coded(self._digits(number))
            # The model's noise is the same in every chunk: their costs compare.
            self._model_generator.set_state(noise)
            cost, index = self._evaluator(state)(plans.expand(*batch, *plans.shape)).min(dim=-1)
            costs.append(cost)
            numbers.append(number[index])
        cost, part = torch.stack(costs, dim=-1).min(dim=-1)
        return cost, torch.stack(numbers, dim=-1).gather(-1, part.unsqueeze(-1)).squeeze(-1)
