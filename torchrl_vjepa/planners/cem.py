"""Cross-entropy method: the proposal becomes the Gaussian of the best plans."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_vjepa.planners.proposal import Proposal
from torchrl_vjepa.planners.sampling import SamplingPlanner

__all__ = ["CEM"]


class CEM(SamplingPlanner):
    r"""Cross-entropy method.

    The next proposal has the mean of the elites, all counting the same, and their root mean square
    distance from the mean *before* (see :func:`weighted_gaussian`). Only the ranking of costs
    matters: any increasing function of the cost gives the same plan. Where actions are discrete this is
    the categorical cross-entropy method: the next proposal has the frequencies of the elites' choices.
    Takes the arguments of :class:`SamplingPlanner`, positional ones in the order of TorchRL's
    ``CEMPlanner``.

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
        >>> planner = CEM(env, planning_horizon=1, optim_steps=8, num_candidates=256, seed=0)
        >>> planner(TensorDict(latent=torch.tensor([0.5])))["action"].round(decimals=2)
        tensor([0.5000])
    """

    def update(self, proposal: Proposal, elites: Tensor, costs: Tensor) -> Proposal:
        """Mean and spread of the elites whose cost is finite.

        Args:
            proposal: what the candidates were drawn from.
            elites: best first, of shape ``(*B, K, H, A)``.
            costs: of shape ``(*B, K)``.

        Returns:
            The next proposal.
        """
        return weighted_gaussian(elites, uniform_weights(costs), proposal.mean)


def uniform_weights(costs: Tensor) -> Tensor:
    """The same weight for all elites of finite cost.

    Args:
        costs: finite or plus infinity, of shape ``(*B, K)``.

    Returns:
        Weights of shape ``(*B, K)`` with sum one, ``nan`` where no cost is finite.

    Examples:
        >>> uniform_weights(torch.tensor([1.0, 7.0, torch.inf]))
        tensor([0.5000, 0.5000, 0.0000])
    """
    return (costs - costs).nan_to_num(-torch.inf).softmax(dim=-1)


def weighted_gaussian(elites: Tensor, weights: Tensor, previous_mean: Tensor) -> Proposal:
    r"""Weighted mean of candidates, and their spread around the mean before.

    :math:`\mu' = \sum_i w_i u_i`, :math:`\sigma'^2 = \sum_i w_i (u_i - \mu)^2` with
    :math:`\sum_i w_i = 1`. Deviations are taken from :math:`\mu`, as CMA-ES does: around
    :math:`\mu'` few elites shrink the spread before the mean has arrived.

    Args:
        elites: of shape ``(*B, K, H, A)``.
        weights: of shape ``(*B, K)``, with sum one.
        previous_mean: :math:`\mu`, of shape ``(*B, H, A)``.

    Returns:
        The proposal.

    Examples:
        >>> import torch
        >>> elites = torch.tensor([1.0, 7.0]).reshape(2, 1, 1)
        >>> weighted_gaussian(elites, torch.tensor([0.5, 0.5]), torch.zeros(1, 1))
        Proposal(mean=tensor([[4.]]), std=tensor([[5.]]))
    """
    batch, num, shape = weights.shape[:-1].numel(), weights.shape[-1], previous_mean.shape
    size = shape[-2:].numel()
    w = weights.reshape(batch, 1, num).to(elites.dtype)
    squares = (elites - previous_mean.unsqueeze(-3)).square_()
    # Products of matrices: a third of the time of sums over the third dimension from the end.
    mean = torch.bmm(w, elites.reshape(batch, num, size)).reshape(shape)
    variance = torch.bmm(w, squares.reshape(batch, num, size)).reshape(shape)
    return Proposal(mean, variance.sqrt_())
