"""Several futures: a mixture of diagonal Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_vjepa.distributions import Mixture, diag_gaussian
from torchrl_vjepa.heads.base import Head, checked_range, checked_size, soft_clamp

__all__ = ["MixtureHead"]


class MixtureHead(Head):
    r"""Mixture of diagonal Gaussians: several futures, each with its own uncertainty.

    .. math::
        p_\phi(Z_T \mid Z_C, \xi) = \sum_k \pi_k\,
        \mathcal N\big(\mu + \delta_k, \mathrm{diag}(\sigma_k^2)\big)

    Logits, offsets :math:`\delta_k` and log-variances are the sum of a feature and a learned constant.
    The constants' offsets start apart, so that components find modes of their own.

    Args:
        num_components: number of components ``K``.
        init_spread: standard deviation of the offsets at the start, in units of the latent.
        log_var_range: ``(low, high)`` of the components' log-variance, in nats.

    Raises:
        ValueError: if ``num_components`` is not positive, ``init_spread`` is negative, or the range is
            empty or infinite.

    Examples:
        >>> import torch
        >>> head = MixtureHead(num_components=4)
        >>> p = head(torch.zeros(5, head.num_features(3)), head.init_constants(3))
        >>> p.batch_shape, p.event_shape, p.weights[0]
        (torch.Size([5]), torch.Size([3]), tensor([0.2500, 0.2500, 0.2500, 0.2500]))
    """

    def __init__(
        self,
        num_components: int = 5,
        *,
        init_spread: float = 1.0,
        log_var_range: tuple[float, float] = (-16.0, 16.0),
    ) -> None:
        super().__init__()
        if not 0 <= init_spread < float("inf"):
            raise ValueError(f"init_spread must be finite and at least 0, got {init_spread}")
        self.num_components = checked_size("num_components", num_components)
        self.init_spread = float(init_spread)
        self.log_var_range = checked_range(log_var_range)

    def num_features(self, latent_dim: int) -> int:
        """Location, and what the constants hold too.

        Args:
            latent_dim: size of the latent.

        Returns:
            ``D + K (1 + 2 D)``.
        """
        return latent_dim + self.num_constants(latent_dim)

    def num_constants(self, latent_dim: int) -> int:
        """A logit, ``D`` offsets and ``D`` log-variances per component.

        Args:
            latent_dim: size of the latent.

        Returns:
            ``K (1 + 2 D)``.
        """
        return self.num_components * (1 + 2 * latent_dim)

    def init_constants(self, latent_dim: int) -> Tensor:
        """Equal weights, unit variances, random offsets.

        Args:
            latent_dim: size of the latent.

        Returns:
            A row of shape ``(C,)``.
        """
        size = self.num_components * latent_dim
        return torch.cat(
            [torch.zeros(self.num_components), self.init_spread * torch.randn(size), torch.zeros(size)]
        )

    def forward(self, features: Tensor, constants: Tensor) -> Mixture:
        """The mixture.

        Args:
            features: location, logits, offsets and log-variances, of shape ``(*B, F)``.
            constants: logits, offsets and log-variances, of shape ``(C,)``.

        Returns:
            Mixture with batch ``*B`` and event ``(D,)``.
        """
        num = constants.shape[-1]
        loc, own = features.split([features.shape[-1] - num, num], dim=-1)
        size = self.num_components * loc.shape[-1]
        logits, offsets, log_var = (own + constants).split([self.num_components, size, size], dim=-1)
        offsets, log_var = (
            value.unflatten(-1, (self.num_components, loc.shape[-1])) for value in (offsets, log_var)
        )
        scale = (0.5 * soft_clamp(log_var, *self.log_var_range)).exp()
        return Mixture(logits, diag_gaussian(loc.unsqueeze(-2) + offsets, scale))
