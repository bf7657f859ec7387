"""Any energy as a prior."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from torchrl_vjepa.distributions import Density
from torchrl_vjepa.priors.base import BoundPrior, Prior, Task

__all__ = ["EnergyPrior"]


class EnergyPrior(Prior):
    r"""Energy-based prior, :math:`p(Z_T \mid \eta) \propto e^{-w E(Z_T; \eta)}`.

    The paper's analytic prior (section "Inference with Task-Specific Priors").

    Args:
        energy: :math:`E`: ``(latent (*B, D)) -> (*B)`` in nats, or ``(latent, task) -> (*B)`` with a
            ``task_key``; row by row, for any batch. A module's parameters are the prior's.
        task_key: entry of the task; ``None`` for an energy that takes none.
        task_ndim: dimensions of one task.
        latent_dim: ``D``. If it is given, the energy is tried on a few latents: at once, or in
            :meth:`bind` where it takes a task.
        weight: :math:`w`, finite and at least 0; 0 is the flat prior.
        differentiable: whether the energy has a gradient; without one only planners that sample can
            use it.

    Raises:
        TypeError: if the energy is not callable.
        ValueError: if ``weight`` is negative or not finite, or the trial finds a wrong shape, a value or
            gradient that is not finite, or no gradient where there should be one.

    Examples:
        >>> import torch
        >>> prior = EnergyPrior(lambda z: z.abs().sum(-1), latent_dim=2)
        >>> prior.energy(torch.tensor([[1.0, -2.0], [0.0, 0.5]]))
        tensor([3.0000, 0.5000])
        >>> follow = EnergyPrior(lambda z, leader: (z - leader).square().sum(-1), task_key="leader")
        >>> follow.energy(torch.ones(5, 2), torch.zeros(5, 2))
        tensor([2., 2., 2., 2., 2.])
        >>> EnergyPrior(lambda z: (z > 0).all(-1).float(), latent_dim=2)
        Traceback (most recent call last):
        ...
        ValueError: energy must have a gradient with respect to the latent, got none; ...
    """

    def __init__(
        self,
        energy: Callable[..., Tensor],
        *,
        task_key: NestedKey | None = None,
        task_ndim: int = 1,
        latent_dim: int | None = None,
        weight: float = 1.0,
        differentiable: bool = True,
    ) -> None:
        super().__init__(task_key=task_key, task_ndim=task_ndim, latent_dim=latent_dim)
        if not callable(energy):
            raise TypeError(f"energy must be callable, got {type(energy).__name__}")
        if not 0 <= weight < math.inf:
            raise ValueError(f"weight must be finite and at least 0, got {weight}")
        self.energy_function = energy
        self.weight, self.differentiable = float(weight), differentiable
        if latent_dim is not None and self.task_key is None:
            self.check()

    def forward(self, task: Task = None) -> Density:
        """The density.

        Args:
            task: for an energy that takes one.

        Returns:
            Unnormalised; flat if the weight is 0.
        """
        if not self.weight:
            return Density()
        if self.task_key is None:
            return Density(lambda latent: self._weighted(self.energy_function(latent)))
        own = self.own_task(task)
        return Density(lambda latent: self._weighted(self.energy_function(latent, own)))

    def _weighted(self, value: Tensor) -> Tensor:
        # What is no tensor is refused with the shape, by the density.
        return value if self.weight == 1.0 or not isinstance(value, Tensor) else self.weight * value

    def bind(self, task: Task) -> BoundPrior:
        """See :meth:`Prior.bind`; tries the energy too if ``latent_dim`` is known.

        Args:
            task: what :meth:`forward` is called with from now on.

        Returns:
            A prior that shares its parameters with this one.
        """
        bound = super().bind(task)
        if self.latent_dim is not None:
            self.check(task)
        return bound

    def check(self, task: Task = None) -> None:
        """Try the energy on a few latents of moderate size.

        Args:
            task: for an energy that takes one.

        Raises:
            ValueError: if the shape is wrong, a value or gradient is not finite, there is no gradient
                where there should be one, or ``latent_dim`` is not known.
        """
        if self.latent_dim is None:
            raise ValueError("latent_dim must be given to check the energy, got None")
        batch: tuple[int, ...] = (3,)
        like = torch.zeros(())
        if self.task_key is not None:
            own = self.own_task(task)
            batch = tuple(own.shape[: own.ndim - self.task_ndim])
            like = own if own.is_floating_point() else like.to(own.device)
        if isinstance(self.energy_function, nn.Module):
            tensors = (*self.energy_function.parameters(), *self.energy_function.buffers())
            like = next((x for x in tensors if x.is_floating_point()), like)
        generator = torch.Generator().manual_seed(0)
        with torch.inference_mode(False), torch.enable_grad():
            latent = torch.randn(2, *batch, self.latent_dim, generator=generator).to(like)
            latent.requires_grad_(self.differentiable)
            value = Density(
                self.energy_function if self.task_key is None else lambda z: self.energy_function(z, own)
            ).checked_energy(latent)
            if value.shape != latent.shape[:-1]:
                raise ValueError(
                    f"energy must return a tensor of shape {tuple(latent.shape[:-1])} for latents "
                    f"{tuple(latent.shape)}, got {tuple(value.shape)}"
                )
            if not value.isfinite().all():
                raise ValueError("energy must be finite, got NaN or infinity on a standard normal latent")
            if not self.differentiable:
                return
            slope = None
            if value.requires_grad:
                (slope,) = torch.autograd.grad(value.sum(), latent, allow_unused=True)
            if slope is None:
                raise ValueError(
                    "energy must have a gradient with respect to the latent, got none; write it with "
                    "torch operations, or pass differentiable=False for planners that sample"
                )
            if not slope.isfinite().all():
                raise ValueError(
                    "energy must have a finite gradient, got NaN or infinity on a standard normal latent"
                )
