"""Tasks as observations: a prior where a filter expects a likelihood."""

from __future__ import annotations

from torch import Tensor, nn
from torch.distributions import Distribution

from torchrl_vjepa.fusion.posterior import known_product
from torchrl_vjepa.priors import Prior

__all__ = ["VirtualObservation"]


class VirtualObservation(nn.Module):
    r"""A prior as the likelihood of a particle filter, its task as the observation (``eq:bjepa_filter``).

    The constraint update of the BJEPA filter: :math:`p_{\text{prior}}(Z_{t+1} \mid \eta_{t+1})` weighs
    the particles as :math:`p(x_{t+1} \mid Z_{t+1})` does in a filter of observations. :meth:`condition` is
    the proposal that looks at the task: for a Gaussian prediction and prior it is the fused transition
    itself, and the weights, which are then its evidence, do not depend on the draw.

    Args:
        prior: reads the task that the filter calls observation.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import ParticleFilter, diag_gaussian
        >>> class At(Prior):
        ...     def forward(self, task=None):
        ...         return diag_gaussian(self.own_task(task), 0.1 * torch.ones(1))
        >>> constraint = VirtualObservation(At(task_key="goal"))
        >>> def walk(latent, action):
        ...     return diag_gaussian(latent + action, torch.ones(1))
        >>> filter = ParticleFilter(
        ...     walk, constraint, proposal=constraint.condition, latent_dim=1, action_dim=1
        ... )
        >>> belief, log_evidence = filter.start(torch.tensor([[2.0]]))
        >>> belief.mean.round(decimals=1)
        tensor([[2.]])
    """

    def __init__(self, prior: Prior) -> None:
        super().__init__()
        self.prior = prior

    def forward(self, task: Tensor, latent: Tensor) -> Tensor:
        r"""Log-density :math:`\log p_{\text{prior}}(Z \mid \eta)`.

        Args:
            task: :math:`\eta`, of shape ``(*B, 1, *task)``.
            latent: of shape ``(*B, K, D)``.

        Returns:
            ``(*B, K)``, in nats.
        """
        return self.prior.log_prob(latent, task)

    def condition(self, p: Distribution, task: Tensor) -> Distribution:
        """The prediction times what is known in closed form of the prior; the weights do the rest.

        Args:
            p: prediction with batch ``(*B, K)``.
            task: of shape ``(*B, 1, *task)``.

        Returns:
            Distribution with batch ``(*B, K)``: ``p`` itself where nothing is known.
        """
        return known_product(p, self.prior(task))[0]
