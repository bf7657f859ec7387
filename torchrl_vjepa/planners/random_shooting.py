"""Random shooting: the best of many sampled plans."""

from __future__ import annotations

from typing import Any

from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_vjepa.planners.proposal import Proposal
from torchrl_vjepa.planners.sampling import SamplingPlanner

__all__ = ["RandomShooting"]


class RandomShooting(SamplingPlanner):
    r"""Algorithm VJEPA-MPC of the paper: the first action of the cheapest sampled plan.

    :math:`i^\star = \arg\min_i \sum_{k=0}^{H-1} c(Z^{(i)}_{t+k+1}, u^{(i)}_{t+k})`, executing
    :math:`u_t^{(i^\star)}`. The candidates' distribution :math:`p(u)` is the starting proposal and
    is never refined; more ``optim_steps`` only draw more candidates, in portions of
    ``num_candidates``.

    Args:
        env: see :class:`SamplingPlanner`.
        planning_horizon: see :class:`SamplingPlanner`.
        optim_steps: portions of candidates.
        num_candidates: the paper's number of samples ``M``, per portion.
        top_k: without effect; there for the sake of swapping planners.
        **kwargs: see :class:`SamplingPlanner`; ``output`` is always ``"best"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_vjepa.costs import quadratic_cost
        >>> from torchrl_vjepa.distributions import Delta
        >>> from torchrl_vjepa.envs import LatentEnv
        >>> def move(latent, action):
        ...     return Delta(latent + action)
        >>> env = LatentEnv(
        ...     move,
        ...     action_spec=Bounded(-1, 1, (1,)),
        ...     cost=quadratic_cost(torch.ones(1)),
        ...     latent_dim=1,
        ... )
        >>> planner = RandomShooting(env, planning_horizon=1, num_candidates=4096, seed=0)
        >>> planner(TensorDict(latent=torch.tensor([0.5])))["action"].round(decimals=2)
        tensor([0.5000])
    """

    def __init__(
        self,
        env: EnvBase,
        planning_horizon: int,
        optim_steps: int = 1,
        num_candidates: int = 512,
        top_k: int = 1,
        **kwargs: Any,
    ) -> None:
        super().__init__(env, planning_horizon, optim_steps, num_candidates, top_k, output="best", **kwargs)

    def update(self, proposal: Proposal, elites: Tensor, costs: Tensor) -> Proposal:
        """Keep the proposal.

        Args:
            proposal: what the candidates were drawn from.
            elites: not used.
            costs: not used.

        Returns:
            The same proposal.
        """
        return proposal
