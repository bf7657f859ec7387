"""Stay in a set, or keep out of it: a smooth barrier."""

from __future__ import annotations

import math
from typing import Any, Literal

import torch.nn.functional as F
from tensordict import NestedKey
from torch import Tensor

from torchrl_vjepa.distributions import Density
from torchrl_vjepa.priors.arguments import affine_map
from torchrl_vjepa.priors.base import Prior, Task
from torchrl_vjepa.priors.regions import Region

__all__ = ["RegionPrior"]


class RegionPrior(Prior):
    r"""Smooth barrier of a set, :math:`p(Z \mid \eta) \propto \mathrm{sigmoid}(-k\, d(Z; \eta))`.

    The paper's logical constraints and safety regions (section "Inference with Task-Specific Priors") as
    an energy :math:`E = \mathrm{softplus}(k d)`, where :math:`d` is the signed distance to violation,
    positive where the constraint is violated. :math:`\log 2` on the boundary; outside it grows by
    :math:`k` nats for each unit of distance, so gradients lead back from anywhere; at :math:`d \ll -1/k`
    nothing is felt. :math:`k \to \infty` is the hard constraint: zero inside and infinite outside.

    Contradictory regions have no empty product: the barriers add up to a finite compromise, the place of
    the least violation. In the middle of a forbidden ball the gradient is zero: a gradient planner needs
    several starts there.

    Args:
        region: a :class:`~torchrl_vjepa.priors.regions.Region`: :class:`Ball`, :class:`HalfSpace`, ...
        keep: ``"in"`` or ``"out"``.
        sharpness: :math:`k`, in nats per unit of distance.
        probe: where the region lies in a physical coordinate :math:`y = W Z + b`: an object with
            ``weight`` and ``bias`` (:func:`~torchrl_vjepa.diagnostics.linear_probe`), or a pair
            ``(matrix (P, D), offset (P,))``. ``None``: the region is one of latents.
        task_key: entry of the displacement :math:`\eta`, ``(*B, P)``, by which the region has moved (from
            where it was given): a moving obstacle. ``None``: it stands still.

    Raises:
        ValueError: if ``keep`` is unknown, ``sharpness`` not positive and finite, or the probe does not
            give the region's coordinates.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import Ball, ChanceConstraint
        >>> prior = RegionPrior(Ball(torch.zeros(2), 1.0), "out", sharpness=10.0)
        >>> prior.energy(torch.tensor([[0.5, 0.0], [1.0, 0.0], [3.0, 0.0]])).round(decimals=2)
        tensor([5.0100, 0.6900, 0.0000])
        >>> constraint = ChanceConstraint(prior.violated, delta=0.05)
        >>> constraint(torch.zeros(4, 3, 2), torch.zeros(4, 3, 1))  # 4 samples, 3 steps, all inside
        tensor(1.)
    """

    matrix: Tensor | None
    offset: Tensor | None

    def __init__(
        self,
        region: Region,
        keep: Literal["in", "out"],
        *,
        sharpness: float,
        probe: Any = None,
        task_key: NestedKey | None = None,
    ) -> None:
        if keep not in ("in", "out"):
            raise ValueError(f"keep must be 'in' or 'out', got {keep!r}")
        if not 0 < sharpness < math.inf:
            raise ValueError(f"sharpness must be positive and finite, got {sharpness}")
        matrix, offset = (None, None) if probe is None else affine_map(probe)
        if matrix is not None and len(matrix) != region.dim:
            raise ValueError(
                f"probe must give the {region.dim} coordinates of the region, got matrix "
                f"{tuple(matrix.shape)}"
            )
        super().__init__(task_key=task_key, latent_dim=region.dim if matrix is None else matrix.shape[1])
        self.region, self.keep, self.sharpness = region, keep, float(sharpness)
        self.register_buffer("matrix", matrix)
        self.register_buffer("offset", offset)

    def forward(self, task: Task = None) -> Density:
        """The barrier.

        Args:
            task: the displacement, where there is a ``task_key``.

        Returns:
            Unnormalised density.

        Raises:
            ValueError: if the displacement has another size than the region.
        """
        shift = self._shift(task)
        return Density(lambda latent: -F.logsigmoid(-self.sharpness * self._distance(latent, shift)))

    def distance(self, latent: Tensor, task: Task = None) -> Tensor:
        """Signed distance :math:`d` to violation, positive where the constraint is violated.

        Args:
            latent: of shape ``(*B, D)``.
            task: the displacement.

        Returns:
            ``(*B)``, in units of the region.
        """
        return self._distance(latent, self._shift(task))

    def violated(self, latent: Tensor, action: Tensor | None = None, task: Task = None) -> Tensor:
        """Whether latents break the constraint; what :class:`~torchrl_vjepa.risk.ChanceConstraint` takes.

        With a displacement, ``functools.partial(prior.violated, task=displacement)``; along a horizon it
        is ``(*B, H, P)``.

        Args:
            latent: of shape ``(*B, D)``.
            action: not used.
            task: the displacement.

        Returns:
            Booleans ``(*B)``. The boundary belongs to the region; a latent that is not a number violates.
        """
        inside = self.distance(latent, task)
        return ~(inside <= 0) if self.keep == "in" else ~(inside < 0)

    def _shift(self, task: Task) -> Tensor | None:
        if self.task_key is None:
            return None
        shift = self.own_task(task)
        if shift.ndim == 0 or shift.shape[-1] != self.region.dim:
            raise ValueError(
                f"task must be a displacement of shape (*B, {self.region.dim}), got {tuple(shift.shape)}"
            )
        return shift

    def _distance(self, latent: Tensor, shift: Tensor | None) -> Tensor:
        if latent.ndim == 0 or latent.shape[-1] != self.latent_dim:
            raise ValueError(
                f"latent must have last dimension {self.latent_dim}, got shape {tuple(latent.shape)}"
            )
        if self.matrix is not None and self.offset is not None:
            dtype = self.matrix.dtype
            latent = (latent.to(dtype) if latent.dtype != dtype else latent) @ self.matrix.mT + self.offset
        distance = self.region.signed_distance(latent if shift is None else latent - shift)
        return distance if self.keep == "in" else -distance
