"""What planners over finitely many actions share: the table of actions, and steps of states on tensors."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_vjepa.actions import ActionCodec
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.planners.base import Planner
from torchrl_vjepa.planners.expansion import Expansion, expansion_from
from torchrl_vjepa.planners.proposal import Proposal

__all__ = ["DiscretePlanner", "joint_choices"]

#: Joint choices of one step, at most: each is a branch of a tree.
MAX_ACTIONS = 4096


def joint_choices(codec: ActionCodec) -> Tensor:
    """Codes of all actions of a step: every choice of one part with every choice of the others.

    Args:
        codec: of actions without a continuous part.

    Returns:
        Of shape ``(n, A)``, in lexical order; without what masks forbid.

    Raises:
        TypeError: if a part is continuous.
        ValueError: if there are more than 4096.

    Examples:
        >>> from torchrl.data import Binary, Categorical, Composite
        >>> joint_choices(ActionCodec(Composite(light=Binary(1), gear=Categorical(2))))
        tensor([[0., 1., 0.],
                [0., 0., 1.],
                [1., 1., 0.],
                [1., 0., 1.]])
    """
    if not bool((codec.is_choice | codec.is_bit).all()):
        raise TypeError(
            f"the action of env must be discrete in all its parts to be enumerated, got {codec.describe()}; "
            "use a sampling planner (CEM)"
        )
    unit = torch.eye(codec.size, dtype=codec.dtype, device=codec.low.device)
    parts = []
    for position in range(codec.size):
        if codec.is_bit[position]:
            parts.append(torch.stack([torch.zeros_like(unit[0]), unit[position]]))
        elif codec.choice[position] == 0:
            block = codec.block[position]
            parts.append(unit[codec.members[block][~codec.forbidden[block]]])
    num = math.prod(part.shape[0] for part in parts)
    if num > MAX_ACTIONS:
        raise ValueError(
            f"the action of env must have at most {MAX_ACTIONS} joint choices to be enumerated, got {num} of "
            f"{codec.describe()}; use a sampling planner (CEM)"
        )
    joint = torch.zeros_like(unit[:1])
    for part in parts:
        joint = (joint.unsqueeze(1) + part).flatten(0, 1)
    return joint


class DiscretePlanner(Planner):
    """Planners that number the ``n`` actions of a step and search sequences of numbers.

    Attributes:
        choices: codes of the actions, of shape ``(n, A)``: of ``OneHot`` and ``Categorical`` one for each
            choice that no mask forbids, of several parts (``MultiCategorical``, ``Binary``, ``Composite``)
            one for each combination (:func:`joint_choices`).

    Args:
        env: see :class:`Planner`; its actions are finitely many.
        planning_horizon: see :class:`Planner`.
        optim_steps: see :class:`Planner`.
        **kwargs: see :class:`Planner`.

    Raises:
        TypeError: if an action is continuous.
        ValueError: if there are more than 4096 joint actions in a step; else see :class:`Planner`.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import OneHot
        >>> from torchrl_vjepa.costs import quadratic_cost
        >>> from torchrl_vjepa.distributions import Delta
        >>> from torchrl_vjepa.planners import Plan
        >>> class Lazy(DiscretePlanner):  # always the first action
        ...     def plan(self, state, proposal):
        ...         plan = self.choices[torch.zeros(proposal.mean.shape[:-1], dtype=torch.long)]
        ...         cost = self.env.objective(state, plan.unsqueeze(-3)).squeeze(-1)
        ...         return Plan(plan, torch.zeros_like(plan), plan, cost)
        >>> env = LatentEnv(
        ...     lambda latent, action: Delta(latent + action),
        ...     action_spec=OneHot(2),
        ...     cost=quadratic_cost(torch.ones(2)),
        ...     latent_dim=2,
        ... )
        >>> Lazy(env, planning_horizon=3)(TensorDict(latent=torch.zeros(2)))["action"]
        tensor([ True, False])
    """

    choices: Tensor
    #: Of the costs of single steps.
    discount: float = 1.0

    def __init__(self, env: EnvBase, planning_horizon: int, optim_steps: int = 1, **kwargs: Any) -> None:
        super().__init__(env, planning_horizon, optim_steps, **kwargs)
        self.register_buffer("choices", joint_choices(self.codec), persistent=False)

    @property
    def num_actions(self) -> int:
        """Actions ``n`` of a step."""
        return self.choices.shape[0]

    def _coded(self, index: Tensor) -> Tensor:
        """Codes ``(*B, A)`` of numbers ``(*B)``."""
        return self.choices[index]

    def _numbered(self, proposal: Proposal) -> tuple[Tensor, Tensor]:
        """The nearest plan of a proposal as numbers ``(R, H)``, and which rows know any, ``(R)``."""
        mean = proposal.mean.reshape(-1, *proposal.mean.shape[-2:])
        distance = torch.cdist(mean, self.choices.expand(mean.shape[0], -1, -1))
        return distance.argmin(dim=-1), (mean != self.centre).flatten(1).any(dim=-1)

    def _is_deterministic(self) -> bool:
        """Whether a plan costs the sum of what its steps cost, each of one state."""
        asked = {"num_samples": self.num_samples, "risk": self.risk, "constraints": self.constraints}
        asked = {name: value for name, value in asked.items() if value is not None}
        source = self._source
        if isinstance(source, LatentEnv) and any(
            getattr(type(source), name) is not getattr(LatentEnv, name)
            for name in ("objective", "objective_from")
        ):
            return False
        if self._env_objective is None and not isinstance(source, LatentEnv):
            return False
        return source.sampling(**asked).num_samples is None

    def _expansion(self, state: Any) -> Expansion:
        """Decisions in the environment from a state of planning."""
        return expansion_from(self._source, state, self.planning_horizon, self.action_repeat, self.discount)
