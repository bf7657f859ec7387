"""What a planning call found, what is remembered of it, and counts that arguments must be."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_vjepa.risk import REJECTED_COST

__all__ = ["Plan", "check_counts", "remembered", "warn_of_costs"]


class Plan(NamedTuple):
    """What a planning call found.

    Attributes:
        actions: the plan, in code, of shape ``(*B, H, A)``; its first step is executed.
        std: spread of the last proposal, of shape ``(*B, H, A)``.
        best: the candidate of lowest cost that was seen, of shape ``(*B, H, A)``.
        best_cost: its cost, of shape ``(*B)``; infinite where no cost was finite, at least
            :data:`~torchrl_vjepa.risk.REJECTED_COST` where no plan satisfied the chance constraints.
        statistics: what else a search has to tell, one entry with batch ``*B`` for each name in
            ``own_statistics`` of its planner.
        elites: plans beside it that the next search begins with, of shape ``(*B, E, H, A)``, or ``None``.

    Examples:
        >>> import torch
        >>> plan = torch.zeros(5, 2)
        >>> Plan(plan, torch.ones(5, 2), plan, torch.tensor(0.5)).best_cost
        tensor(0.5000)
    """

    actions: Tensor
    std: Tensor
    best: Tensor
    best_cost: Tensor
    statistics: Mapping[str, Tensor] = MappingProxyType({})
    elites: Tensor | None = None

    def held(self, repeat: int) -> Plan:
        """The plan with each of its actions held for some steps.

        Args:
            repeat: steps.

        Returns:
            A plan of ``repeat`` times as many steps.
        """
        if repeat == 1:
            return self
        elites = None if self.elites is None else self.elites.repeat_interleave(repeat, dim=-2)
        return self._replace(
            actions=self.actions.repeat_interleave(repeat, dim=-2),
            std=self.std.repeat_interleave(repeat, dim=-2),
            best=self.best.repeat_interleave(repeat, dim=-2),
            elites=elites,
        )

    def where(self, rows: Tensor, other: Plan) -> Plan:
        """The plan in some rows, another in the rest.

        Args:
            rows: flags of shape ``(*B)``.
            other: of the same shapes; its statistics are taken, and its elites where this plan has none.

        Returns:
            The plan.
        """
        elites = other.elites
        if elites is not None and self.elites is not None:
            elites = torch.where(rows[..., None, None, None], self.elites, elites)
        wide = rows[..., None, None]
        return other._replace(
            actions=torch.where(wide, self.actions, other.actions),
            std=torch.where(wide, self.std, other.std),
            best=torch.where(wide, self.best, other.best),
            best_cost=torch.where(rows, self.best_cost, other.best_cost),
            elites=elites,
        )


def check_counts(**counts: int) -> None:
    """Refuse what does not count anything.

    Args:
        **counts: arguments by name.

    Raises:
        ValueError: if one is no integer of at least 1.

    Examples:
        >>> check_counts(optim_steps=4)
    """
    for name, value in counts.items():
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise ValueError(f"{name} must be an integer of at least 1, got {value!r}")


def remembered(plan: Tensor, is_init: Tensor | None, *, zero_is_cold: bool) -> tuple[Tensor, Tensor]:
    """The rows of a plan from the step before that are one.

    Args:
        plan: of shape ``(*B, H, A)``; not finite, or all zeros (what a primer gives), where there is none.
        is_init: where an episode begins, ``(*B)`` or ``(*B, 1)``: there is none either.
        zero_is_cold: whether a plan of zeros is none although ``is_init`` is known.

    Returns:
        The plan, zero in rows without one, and whether a row has one, ``(*B)``.

    Examples:
        >>> plan = torch.tensor([[[1.0]], [[float("nan")]], [[2.0]]])
        >>> remembered(plan, torch.tensor([False, False, True]), zero_is_cold=True)[1]
        tensor([ True, False, False])
    """
    rows = plan.flatten(-2)
    warm = rows.isfinite().all(dim=-1)
    if is_init is not None:
        warm = warm & ~is_init.reshape(warm.shape).bool()
    if is_init is None or zero_is_cold:
        warm = warm & (rows != 0).any(dim=-1)  # bits may all be zero in a plan
    return torch.where(warm[..., None, None], plan, 0.0), warm


def warn_of_costs(best_cost: Tensor, constrained: bool) -> None:
    """One warning where a row has no plan of finite cost, or none that satisfies the constraints.

    Args:
        best_cost: of shape ``(*B)``.
        constrained: whether there are constraints.

    Examples:
        >>> warn_of_costs(torch.zeros(3), True)
    """
    if not bool(best_cost.isfinite().all()):
        warnings.warn(
            "no candidate plan has a finite cost in at least one row: its action is the mean "
            "of the proposal; check the model, the cost and the input for nan and inf",
            RuntimeWarning,
            stacklevel=5,
        )
    elif constrained and bool((best_cost >= REJECTED_COST).any()):
        warnings.warn(
            "no candidate plan satisfies the chance constraints in at least one row: its plan is the "
            "one of least violation; widen the search, or loosen delta",
            RuntimeWarning,
            stacklevel=5,
        )
