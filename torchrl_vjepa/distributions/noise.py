"""Parent of the distributions that are a transform of standard normal noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

__all__ = ["NoiseDistribution", "SearchSpace", "full_precision"]

#: Starts of a search ``(S, *B, n)``, the map from there to latents, and the step size of the search.
SearchSpace = tuple[Tensor, Callable[[Tensor], Tensor], Tensor]


def full_precision(*values: Tensor) -> tuple[Tensor, ...]:
    """Half-precision tensors in float32, others as they are: LAPACK and tails need the digits.

    Args:
        *values: floating-point tensors.

    Returns:
        The same tensors, converted where needed.

    Examples:
        >>> import torch
        >>> full_precision(torch.zeros(1, dtype=torch.bfloat16))[0].dtype
        torch.float32
    """
    low = (torch.float16, torch.bfloat16)
    return tuple(value.float() if value.dtype in low else value for value in values)


class NoiseDistribution(Distribution):
    r"""A distribution whose draws are :math:`Z = T(\epsilon)`, :math:`\epsilon \sim \mathcal N(0, I)`.

    A member says how many normal numbers a draw takes (``noise_dim``) and what becomes of them
    (:meth:`from_noise`). That is all that sampling needs: from a generator of one's own, with random
    numbers shared by several distributions (common random numbers), or under ``torch.vmap``.

    Arguments are not validated: checks read values, which stalls a GPU and breaks ``vmap``.

    Args:
        batch_shape: ``*B``.
        latent_dim: size ``D`` of the event.
        noise_dim: normal numbers per draw.
        like: what has the dtype and the device of the draws: a parameter or another member.

    Examples:
        >>> from torchrl_vjepa.distributions import CouplingFlow, LowRankGaussian, Mixture
        >>> all(issubclass(p, NoiseDistribution) for p in (CouplingFlow, LowRankGaussian, Mixture))
        True
    """

    arg_constraints: dict[str, constraints.Constraint] = {}
    support = constraints.real_vector
    has_rsample = True
    dtype: torch.dtype
    device: torch.device

    def __init__(
        self, batch_shape: Sequence[int], latent_dim: int, noise_dim: int, like: Tensor | NoiseDistribution
    ) -> None:
        self.noise_dim = noise_dim
        self.dtype, self.device = like.dtype, like.device
        super().__init__(torch.Size(batch_shape), torch.Size([latent_dim]), validate_args=False)

    def from_noise(self, noise: Tensor) -> Tensor:
        """The draws that standard normal noise becomes, with gradients of the parameters.

        Args:
            noise: of shape ``(*S, *B, noise_dim)``, or broadcastable to it.

        Returns:
            Latents of shape ``(*S, *B, D)``.
        """
        raise NotImplementedError

    def search_space(self) -> SearchSpace:
        """Where :func:`~torchrl_vjepa.distributions.maximize_log_prob` looks for the mode.

        Returns:
            Starts ``(S, *B, n)``, the map from there to latents, and the scale of the starts.
        """
        return self.mean.unsqueeze(0), _identity, self.stddev

    def rsample(self, sample_shape: Sequence[int] | None = None) -> Tensor:
        """Draws with gradients.

        Args:
            sample_shape: leading dimensions; none by default.

        Returns:
            Latents of shape ``(*sample_shape, *B, D)``.
        """
        # torch.randn and not torch.normal, which refuses under vmap.
        shape = (*(sample_shape or ()), *self.batch_shape, self.noise_dim)
        return self.from_noise(torch.randn(shape, dtype=self.dtype, device=self.device))

    def sample(self, sample_shape: Sequence[int] | None = None) -> Tensor:
        """Draws without gradients.

        Args:
            sample_shape: leading dimensions; none by default.

        Returns:
            Latents of shape ``(*sample_shape, *B, D)``.
        """
        with torch.no_grad():
            return self.rsample(sample_shape)


def _identity(value: Tensor) -> Tensor:
    return value
