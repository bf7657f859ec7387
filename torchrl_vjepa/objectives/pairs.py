"""Pairs of context and target for one skip, and means over those that count."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import Distribution

__all__ = ["Pairs"]


@dataclass
class Pairs:
    r"""All pairs :math:`(t, t + \Delta)` of a batch of windows for one skip.

    Attributes:
        skip: :math:`\Delta`.
        dist: predictive distribution with batch ``(B, T - skip)``.
        target: target latents, of shape ``(B, T - skip, D)``.
        context: context latents, of the same shape.
        action: action chunks ``(B, T - skip, skip, A)``, or ``None``.
        side_info: side information ``(B, T - skip, S)``, or ``None``.
        mask: pairs that count, ``(B, T - skip)``, or ``None`` for all.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import Delta
        >>> latent = torch.zeros(1, 2, 3)
        >>> mask = torch.tensor([[True, False]])
        >>> Pairs(1, Delta(latent), latent, latent, None, None, mask).mean(torch.tensor([[1.0, 9.0]]))
        tensor(1.)
    """

    skip: int
    dist: Distribution
    target: Tensor
    context: Tensor
    action: Tensor | None
    side_info: Tensor | None
    mask: Tensor | None

    def __post_init__(self) -> None:
        """Weights that sum to one over the pairs that count."""
        if self.mask is not None:
            weight = self.mask.to(self.target.dtype)
            self._weight = weight / weight.sum().clamp_min(1)

    def mean(self, value: Tensor) -> Tensor:
        """Mean over the pairs that count.

        Args:
            value: one finite number per pair, ``(B, T - skip)``, or more in trailing dimensions.

        Returns:
            The mean over the first two dimensions; zero if no pair counts.
        """
        if self.mask is None:
            return value.mean((0, 1))
        return torch.tensordot(self._weight, value, dims=2)

    def second_moment(self, value: Tensor) -> Tensor:
        """Mean of the outer products over the pairs that count.

        Args:
            value: one finite vector per pair, ``(B, T - skip, D)``.

        Returns:
            A matrix of shape ``(D, D)``; zero if no pair counts.
        """
        rows = value.reshape(-1, value.shape[-1])
        if self.mask is None:
            return rows.mT @ rows / rows.shape[0]
        return rows.mT @ (rows * self._weight.reshape(-1, 1))
