"""What is noise and what is ignorance: an ensemble of heads."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrl_vjepa.distributions import Ensemble
from torchrl_vjepa.heads.base import Head, checked_size
from torchrl_vjepa.heads.gaussian import DeltaHead, DiagGaussianHead

__all__ = ["EnsembleHead"]


class EnsembleHead(Head):
    r"""Ensemble of heads on one trunk, as one stacked computation (:class:`Ensemble`).

    Member :math:`m` is a network of one hidden layer, whose pre-activations are the trunk's features and
    whose output weights are constants; it ends in ``head``. With a linear trunk the members are
    independent networks, with an MLP they share its body. They start at random and are trained by their
    own likelihoods (:func:`~torchrl_vjepa.distributions.log_score`): training moves a member only in the
    directions that the data see, so away from the data they keep the disagreement that they began with.

    ``p.epistemic_variance`` is that disagreement, ``p.aleatoric_variance`` the noise that members expect
    on average.

    Args:
        head: what a member ends in; :class:`DiagGaussianHead` by default.
        num_members: number of members ``M``, at least 2.
        num_cells: width of a member's hidden layer.
        init_gain: scale of a member's output at the start, in units of the latent: how much members
            disagree where there is no data.

    Raises:
        TypeError: if ``head`` has no density: a point has no likelihood of its own.
        ValueError: if ``num_members`` is below 2, or a size or gain is not positive.

    Examples:
        >>> import torch
        >>> head = EnsembleHead(num_members=3)
        >>> p = head(torch.randn(5, head.num_features(2)), head.init_constants(2))
        >>> p.batch_shape, p.epistemic_variance.shape, p.components.batch_shape
        (torch.Size([5]), torch.Size([5, 2]), torch.Size([5, 3]))
    """

    def __init__(
        self,
        head: Head | None = None,
        num_members: int = 5,
        num_cells: int = 32,
        *,
        init_gain: float = 1.0,
    ) -> None:
        super().__init__()
        head = DiagGaussianHead() if head is None else head
        if isinstance(head, DeltaHead):
            raise TypeError("head must have a density, got DeltaHead; use DiagGaussianHead")
        if num_members < 2:
            raise ValueError(f"num_members must be at least 2, got {num_members}")
        if not 0 < init_gain < float("inf"):
            raise ValueError(f"init_gain must be positive and finite, got {init_gain}")
        self.head = head
        self.num_members = int(num_members)
        self.num_cells = checked_size("num_cells", num_cells)
        self.init_gain = float(init_gain)

    def num_features(self, latent_dim: int) -> int:
        """Location, and a hidden layer for every member.

        Args:
            latent_dim: size of the latent.

        Returns:
            ``D + M W``.
        """
        return latent_dim + self.num_members * self.num_cells

    def num_constants(self, latent_dim: int) -> int:
        """For every member: hidden biases, output weights and biases, and the constants of its head.

        Args:
            latent_dim: size of the latent.

        Returns:
            The size of each skip's row of constants.
        """
        return self.num_members * sum(self._sizes(latent_dim))

    def init_constants(self, latent_dim: int) -> Tensor:
        """Random members.

        Args:
            latent_dim: size of the latent.

        Returns:
            A row of shape ``(C,)``.
        """
        bias, weight, out, _ = self._sizes(latent_dim)
        rows = [
            torch.cat(
                [
                    torch.randn(bias),
                    self.init_gain * self.num_cells**-0.5 * torch.randn(weight),
                    torch.zeros(out),
                    self.head.init_constants(latent_dim),
                ]
            )
            for _ in range(self.num_members)
        ]
        return torch.cat(rows)

    def forward(self, features: Tensor, constants: Tensor) -> Ensemble:
        """The ensemble.

        Args:
            features: location and hidden layers, of shape ``(*B, F)``.
            constants: of shape ``(C,)``.

        Returns:
            Mixture of the members with batch ``*B`` and event ``(D,)``.
        """
        dtype = torch.promote_types(features.dtype, constants.dtype)
        features, constants = features.to(dtype), constants.to(dtype)
        hidden_size = self.num_members * self.num_cells
        loc, hidden = features.split([features.shape[-1] - hidden_size, hidden_size], dim=-1)
        latent_dim = loc.shape[-1]
        bias, weight, out, own = constants.unflatten(-1, (self.num_members, -1)).split(
            self._sizes(latent_dim), dim=-1
        )
        hidden = F.silu(hidden.unflatten(-1, (self.num_members, self.num_cells)) + bias)
        weight = weight.unflatten(-1, (self.num_cells, -1))
        member = torch.einsum("...mw,...mwf->...mf", hidden, weight) + out
        shift = F.pad(loc, (0, member.shape[-1] - latent_dim)).unsqueeze(-2)
        return Ensemble(self.head(member + shift, own))

    def _sizes(self, latent_dim: int) -> list[int]:
        """Numbers of one member: hidden bias, output weights and biases, constants of the head."""
        out = self.head.num_features(latent_dim)
        return [self.num_cells, self.num_cells * out, out, self.head.num_constants(latent_dim)]
