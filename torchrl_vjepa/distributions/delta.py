"""The point mass: the predictive distribution of a deterministic model."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints
from torchrl.modules import Delta as _TorchRLDelta

__all__ = ["Delta"]


class Delta(_TorchRLDelta):
    r"""Point mass on a latent, :math:`\delta(Z - \mu)`: the predictive model of a deterministic JEPA.

    TorchRL's ``Delta`` with what a latent transition needs besides: a zero ``variance`` and
    ``stddev``, and gradients through ``rsample`` only.

    Args:
        loc: the point, of shape ``(*B, D)``.

    Examples:
        >>> import torch
        >>> p = Delta(torch.tensor([[1.0, 2.0]]))
        >>> p.batch_shape, p.event_shape
        (torch.Size([1]), torch.Size([2]))
        >>> p.variance
        tensor([[0., 0.]])
    """

    has_rsample = True

    def __init__(self, loc: Tensor) -> None:
        super().__init__(loc, batch_shape=loc.shape[:-1], event_shape=loc.shape[-1:])

    @property
    def support(self) -> constraints.Constraint:
        """The whole space: any vector can be the point."""
        return constraints.real_vector

    @property
    def variance(self) -> Tensor:
        """Zeros of shape ``(*B, D)``."""
        return torch.zeros_like(self.param)

    def sample(self, sample_shape: Sequence[int] | None = None) -> Tensor:
        """The point, repeated, without gradient.

        Args:
            sample_shape: leading dimensions; none by default.

        Returns:
            A view of shape ``(*sample_shape, *B, D)``.
        """
        # TorchRL expands under no_grad, and a view made there still requires a gradient.
        return self.rsample(sample_shape).detach()

    def expand(self, batch_shape: Sequence[int], _instance: Distribution | None = None) -> Delta:
        """The same point, broadcast to ``batch_shape``.

        Args:
            batch_shape: the new batch shape.

        Returns:
            The expanded distribution.
        """
        return type(self)(self.param.expand(*batch_shape, *self.event_shape))
