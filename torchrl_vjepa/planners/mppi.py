"""Model predictive path integral control: plans weighted by the exponential of their cost."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_vjepa.planners.cem import uniform_weights, weighted_gaussian
from torchrl_vjepa.planners.proposal import Proposal
from torchrl_vjepa.planners.sampling import SamplingPlanner

__all__ = ["MPPI"]


class MPPI(SamplingPlanner):
    r"""Model predictive path integral control.

    The next proposal has the weighted mean of the elites and their weighted root mean square
    distance from the mean before (see :func:`~torchrl_vjepa.planners.cem.weighted_gaussian`), with
    weights

    .. math:: w_i \propto \exp\!\left(-\frac{J_i - \min_j J_j}{\lambda\, s}\right),

    where :math:`\lambda` is ``temperature`` and :math:`s` the standard deviation of the elites'
    costs (``normalize_costs``; else :math:`s = 1`). The temperature **divides**: small means
    greedy, large means the uniform weights of :class:`CEM`. TorchRL's ``MPPIPlanner`` multiplies by
    its temperature. With ``normalize_costs`` scale and origin of the cost do not matter.

    Args:
        env: see :class:`SamplingPlanner`.
        planning_horizon: see :class:`SamplingPlanner`.
        optim_steps: see :class:`SamplingPlanner`.
        num_candidates: see :class:`SamplingPlanner`.
        top_k: see :class:`SamplingPlanner`; the classic algorithm has no elites: ``num_candidates``.
        temperature: :math:`\lambda`, positive; the default is chosen by what it reaches on the noisy TV
            (``docs/planners.md``).
        normalize_costs: divide costs by their standard deviation among the elites.
        **kwargs: see :class:`SamplingPlanner`.

    Raises:
        ValueError: if ``temperature`` is not positive and finite; else see :class:`SamplingPlanner`.

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
        >>> planner = MPPI(env, planning_horizon=1, optim_steps=8, num_candidates=256, seed=0)
        >>> planner(TensorDict(latent=torch.tensor([0.5])))["action"].round(decimals=2)
        tensor([0.5000])
    """

    def __init__(
        self,
        env: EnvBase,
        planning_horizon: int,
        optim_steps: int = 4,
        num_candidates: int = 512,
        top_k: int | None = None,
        *,
        temperature: float = 1.0,
        normalize_costs: bool = True,
        **kwargs: Any,
    ) -> None:
        if not 0 < temperature < math.inf:
            raise ValueError(f"temperature must be positive and finite, got {temperature}")
        super().__init__(env, planning_horizon, optim_steps, num_candidates, top_k, **kwargs)
        self.temperature = float(temperature)
        self.normalize_costs = normalize_costs

    def update(self, proposal: Proposal, elites: Tensor, costs: Tensor) -> Proposal:
        """Mean and spread of the elites, weighted by their costs.

        Args:
            proposal: what the candidates were drawn from.
            elites: best first, of shape ``(*B, K, H, A)``.
            costs: ascending, of shape ``(*B, K)``.

        Returns:
            The next proposal.
        """
        # The lowest cost is subtracted first, so the largest exponent is 0 at any magnitude.
        if not self.normalize_costs:
            excess = (costs - costs.narrow(-1, 0, 1)) / -self.temperature
            return weighted_gaussian(elites, excess.softmax(dim=-1), proposal.mean)
        # Of halves, whose difference cannot overflow: the scale of costs does not matter.
        costs = 0.5 * costs
        excess = costs - costs.narrow(-1, 0, 1)
        limits, uniform = torch.finfo(costs.dtype), uniform_weights(costs)
        # In units of the largest excess, so that the square below cannot overflow.
        finite = excess.nan_to_num(0.0, 0.0)
        largest = finite.amax(dim=-1, keepdim=True).clamp_min(limits.tiny)
        finite = finite / largest
        deviation = finite - (uniform * finite).sum(dim=-1, keepdim=True)
        variance = (uniform * deviation.square_()).sum(dim=-1, keepdim=True)
        scale = (variance.sqrt_() * largest).mul_(-self.temperature).clamp_(-limits.max, -limits.tiny)
        return weighted_gaussian(elites, (excess / scale).softmax(dim=-1), proposal.mean)
