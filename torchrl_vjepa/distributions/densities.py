"""Densities that are no distributions: unnormalised ones, and Gaussians that are flat in some directions."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.distributions import Distribution

__all__ = ["Density", "GaussianFactor"]


class GaussianFactor:
    r"""A Gaussian in information form, :math:`f(Z) = \exp(c + h^\top Z - \frac12 Z^\top \Lambda Z)`.

    :math:`\Lambda` is positive semi-definite, so the factor may be flat along some directions: what a
    measurement of fewer coordinates than the latent has says. In a product of experts the rest is filled
    in by the others.

    Args:
        precision: :math:`\Lambda`, of shape ``(*B, D, D)``, symmetric.
        information: :math:`h`, of shape ``(*B, D)``.
        log_scale: :math:`c`, of shape ``(*B)`` or a number.

    Raises:
        ValueError: if the shapes do not fit.

    Examples:
        >>> import torch
        >>> sees_first = GaussianFactor(torch.diag(torch.tensor([1.0, 0.0])), torch.tensor([2.0, 0.0]))
        >>> sees_first.log_prob(torch.tensor([[2.0, 7.0], [2.0, -7.0]]))
        tensor([2., 2.])
    """

    def __init__(self, precision: Tensor, information: Tensor, log_scale: Tensor | float = 0.0) -> None:
        if precision.ndim < 2 or precision.shape[-2:] != (information.shape[-1],) * 2:
            raise ValueError(
                "precision and information must have shapes (*B, D, D) and (*B, D), got "
                f"{tuple(precision.shape)} and {tuple(information.shape)}"
            )
        self.precision, self.information = precision, information
        self.log_scale = torch.as_tensor(log_scale, dtype=information.dtype, device=information.device)

    @property
    def batch_shape(self) -> torch.Size:
        """``*B``."""
        shapes = self.precision.shape[:-2], self.information.shape[:-1], self.log_scale.shape
        return torch.broadcast_shapes(*shapes)

    @property
    def event_shape(self) -> torch.Size:
        """``(D,)``."""
        return self.information.shape[-1:]

    def log_prob(self, latent: Tensor) -> Tensor:
        r""":math:`\log f(Z)`.

        Args:
            latent: of shape ``(*B, D)``.

        Returns:
            ``(*B)``, in nats.
        """
        pulled = self.information - 0.5 * (self.precision @ latent.unsqueeze(-1)).squeeze(-1)
        return self.log_scale + (pulled * latent).sum(-1)


class Density:
    r"""Unnormalised density :math:`b(Z) \exp(-E(Z))`, for instance an energy-based prior.

    Args:
        energy: :math:`E`: ``(*B, D) -> (*B)``, in nats; ``None`` is zero.
        base: :math:`b`: a distribution or :class:`GaussianFactor`, of which products with other experts
            may be known in closed form; ``None`` is flat.

    Examples:
        >>> import torch
        >>> wall = Density(lambda z: 10.0 * (z[..., 0] - 1.0).clamp_min(0.0))
        >>> wall.log_prob(torch.tensor([[0.0, 5.0], [2.0, 5.0]]))
        tensor([  0., -10.])
        >>> Density().is_flat
        True
    """

    def __init__(
        self,
        energy: Callable[[Tensor], Tensor] | None = None,
        base: Distribution | GaussianFactor | None = None,
    ) -> None:
        self.energy, self.base = energy, base

    @property
    def is_flat(self) -> bool:
        """Whether it is known to be the same everywhere."""
        return self.energy is None and self.base is None

    def log_prob(self, latent: Tensor) -> Tensor:
        r""":math:`\log b(Z) - E(Z)`, up to a constant.

        Args:
            latent: of shape ``(*B, D)``.

        Returns:
            ``(*B)``, in nats.

        Raises:
            ValueError: if the energy has another shape.
        """
        value = latent.new_zeros(latent.shape[:-1])
        if self.base is not None:
            value = self.base.log_prob(latent)
        return value if self.energy is None else value - self.checked_energy(latent)

    def checked_energy(self, latent: Tensor) -> Tensor:
        """The energy alone.

        Args:
            latent: of shape ``(*B, D)``.

        Returns:
            ``(*B)``, in nats; zero if there is none.

        Raises:
            ValueError: if it is no tensor with one number for each latent.
        """
        if self.energy is None:
            return latent.new_zeros(latent.shape[:-1])
        value = self.energy(latent)
        batch = latent.shape[:-1]
        if isinstance(value, Tensor) and value.ndim >= len(batch):
            lead = value.ndim - len(batch)  # a task with more batch dimensions than the latent
            if all(got == want or want == 1 for got, want in zip(value.shape[lead:], batch, strict=True)):
                return value
        got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise ValueError(
            f"energy must return a tensor of shape {tuple(batch)} for latents {tuple(latent.shape)}, "
            f"got {got}"
        )
