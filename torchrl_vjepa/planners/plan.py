"""What a planning call found, what is remembered of it, and counts that arguments must be."""

from __future__ import annotations

import math
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

    def replaced(self, rows: Tensor, found: Plan) -> Plan:
        """The plan with other plans in some rows.

        Args:
            rows: flags of shape ``(*B)``, ``R`` of them set.
            found: of those rows, with batch ``(R)``; its statistics are zero in the others, and where this
                plan has no elites they are the plan itself there.

        Returns:
            The plan, with batch ``*B``.
        """
        elites = found.elites
        if elites is not None:
            own = self.actions.unsqueeze(-3) if self.elites is None else self.elites
            elites = _scattered(own.expand(*rows.shape, *elites.shape[1:]), rows, elites)
        statistics = {
            name: _scattered(value.new_zeros(*rows.shape, *value.shape[1:]), rows, value)
            for name, value in found.statistics.items()
        }
        return Plan(
            _scattered(self.actions, rows, found.actions),
            _scattered(self.std, rows, found.std),
            _scattered(self.best, rows, found.best),
            _scattered(self.best_cost.to(found.best_cost.dtype), rows, found.best_cost),
            statistics,
            elites,
        )


def _scattered(whole: Tensor, rows: Tensor, part: Tensor) -> Tensor:
    whole = whole.clone()
    whole[rows] = part
    return whole


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


def remembered(plan: Tensor, is_init: Tensor | None) -> tuple[Tensor, Tensor]:
    """The rows of a plan from the step before that are one.

    Args:
        plan: of shape ``(*B, H, A)``; not finite where there is none.
        is_init: where an episode begins, ``(*B)`` or ``(*B, 1)``: there is none either. If that is not known,
            there is none where the plan is all zeros, which is what a primer gives.

    Returns:
        The plan, zero in rows without one, and whether a row has one, ``(*B)``.

    Examples:
        >>> plan = torch.tensor([[[1.0]], [[float("nan")]], [[2.0]]])
        >>> remembered(plan, torch.tensor([False, False, True]))[1]
        tensor([ True, False, False])
    """
    rows = plan.flatten(-2)
    warm = rows.isfinite().all(dim=-1)
    if is_init is not None:
        warm = warm & ~is_init.reshape(warm.shape).bool()
    else:
        warm = warm & (rows != 0).any(dim=-1)
    return torch.where(warm[..., None, None], plan, 0.0), warm


def warn_of_costs(best_cost: Tensor, constrained: bool) -> None:
    """One warning where a row has no plan of finite cost, or none that satisfies the constraints.

    Args:
        best_cost: of shape ``(*B)``; not minus infinity.
        constrained: whether there are constraints.

    Examples:
        >>> warn_of_costs(torch.zeros(3), True)
    """
    if not best_cost.numel():
        return
    worst = float(best_cost.max())  # nan where there is one
    if not math.isfinite(worst):
        warnings.warn(
            "no candidate plan has a finite cost in at least one row: its action is the mean "
            "of the proposal; check the model, the cost and the input for nan and inf",
            RuntimeWarning,
            stacklevel=5,
        )
    elif constrained and worst >= REJECTED_COST:
        warnings.warn(
            "no candidate plan satisfies the chance constraints in at least one row: its plan is the "
            "one of least violation; widen the search, or loosen delta",
            RuntimeWarning,
            stacklevel=5,
        )
