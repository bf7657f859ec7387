"""A likelihood for the particle filter where there is no decoder."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from torch import Tensor, nn
from torch.distributions import Distribution

__all__ = ["PseudoLikelihood"]


class PseudoLikelihood(nn.Module):
    r"""Option B of the particle filter: a likelihood from the target distribution, without a decoder.

    .. math::
        \log \tilde p(x \mid Z) = \log q_{\theta'}(Z \mid x) - \log p_{\text{ref}}(Z)

    Bayes' rule, with the target encoder in place of the posterior :math:`p(Z \mid x)` and the reference
    prior in place of :math:`p(Z)` (section "Option B: Latent-Space Update").

    Args:
        target: :math:`q_{\theta'}`: ``observation (*B, 1, O) -> Distribution``, batch ``(*B, 1)`` and
            event ``(D,)``.
        reference_prior: :math:`p_{\text{ref}}`: anything with ``log_prob(latent)``; by default
            :math:`\mathcal N(0, I)`, as in the KL term of ``eq:vjepa_objective``.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> likelihood = PseudoLikelihood(lambda x: diag_gaussian(x, torch.full_like(x, 0.5)))
        >>> likelihood(torch.zeros(1, 2), torch.zeros(3, 2))  # log of N(0; 0, 0.25 I) / N(0; 0, I)
        tensor([1.3863, 1.3863, 1.3863])
    """

    def __init__(self, target: Callable[[Tensor], Distribution], reference_prior: Any = None) -> None:
        super().__init__()
        self.target = target
        self.reference_prior = reference_prior

    def forward(self, observation: Tensor, latent: Tensor) -> Tensor:
        """The log-ratio.

        Args:
            observation: of shape ``(*B, 1, *O)``.
            latent: particles, of shape ``(*B, K, D)``.

        Returns:
            ``(*B, K)``, in nats.
        """
        value = self.target(observation).log_prob(latent)
        if self.reference_prior is not None:
            return value - self.reference_prior.log_prob(latent)
        return value + 0.5 * (latent.square().sum(-1) + latent.shape[-1] * math.log(2 * math.pi))
