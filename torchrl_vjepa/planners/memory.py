"""What a planner remembers from step to step, all of it in the tensordict."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import TensorDictPrimer

from torchrl_vjepa.actions import ActionCodec
from torchrl_vjepa.planners.plan import Plan, remembered

__all__ = ["PlanMemory", "Recalled"]


class Recalled(NamedTuple):
    """What was found of the step before.

    Attributes:
        plan: in code, of shape ``(*B, H, A)``, zero in rows without one; ``None`` where no row has one.
        warm: which rows have one, of shape ``(*B)``.
        age: how many steps of it were executed, ``(*B)``, zero where a search is due; ``None`` if every step
            searches.
        elites: plans beside it, ``(*B, E, H, A)``, ``nan`` in rows without; ``None`` where there are none.

    Examples:
        >>> import torch
        >>> Recalled(None, torch.zeros(5, dtype=torch.bool), None, None).warm.any()
        tensor(False)
    """

    plan: Tensor | None
    warm: Tensor
    age: Tensor | None
    elites: Tensor | None


class PlanMemory:
    """The entries of the tensordict that carry plans from step to step.

    Beside the plan under ``plan_key`` there are, under ``plan_key`` with ``_age`` appended, how many steps of
    it were executed (if not every step searches), and, with ``_elites``, the best plans beside it (if some
    are carried on). Plans are shifted by one step when they are written, their last action repeated.

    Args:
        codec: of the actions.
        horizon: steps ``H`` of a plan.
        interval: steps of a plan that are executed before the next search.
        num_elites: plans ``E`` that are carried on beside the plan.
        plan_key: the plan's entry; ``None`` to remember nothing.
        init_key: set where an episode begins.

    Attributes:
        shape: of one action in the entries.
        keys: the entries by name, those in use of ``"plan"``, ``"age"``, ``"elites"``.
        in_keys: what :meth:`recall` reads.
        out_keys: where what :meth:`entries` returns belongs.

    Examples:
        >>> from torchrl.data import Bounded
        >>> memory = PlanMemory(ActionCodec(Bounded(-1, 1, (2,))), horizon=5, interval=2)
        >>> memory.in_keys
        ['plan', 'plan_age', 'is_init']
    """

    def __init__(
        self,
        codec: ActionCodec,
        horizon: int,
        interval: int = 1,
        num_elites: int = 0,
        *,
        plan_key: NestedKey | None = "plan",
        init_key: NestedKey = "is_init",
    ) -> None:
        self.horizon, self.interval, self.num_elites = horizon, interval, num_elites
        self.shape, self.size = tuple(codec.shape), codec.size
        self._init_key = unravel_key(init_key)
        self.keys: dict[str, NestedKey] = {}
        if plan_key is not None:
            *group, name = [plan_key] if isinstance(plan_key, str) else unravel_key(plan_key)
            used = {"plan": True, "age": interval > 1, "elites": num_elites > 0}
            ends = {"plan": name, "age": f"{name}_age", "elites": f"{name}_elites"}
            self.keys = {part: unravel_key((*group, ends[part])) for part in used if used[part]}
        self.in_keys = [*self.keys.values(), self._init_key] if self.keys else []
        self.out_keys = [unravel_key(("next", key)) for key in self.keys.values()]

    def primer(self, like: Tensor) -> TensorDictPrimer:
        """The transform that carries the entries from step to step, zero at every reset.

        Args:
            like: tells device and dtype.

        Returns:
            A primer of :attr:`keys`; of nothing without any.
        """
        plan = (self.horizon, *self.shape)
        specs: dict[str, TensorSpec] = {
            "plan": Unbounded(plan, device=like.device, dtype=like.dtype),
            "age": Unbounded((1,), device=like.device, dtype=torch.int64),
            "elites": Unbounded((self.num_elites, *plan), device=like.device, dtype=like.dtype),
        }
        primers = {key: specs[part] for part, key in self.keys.items()}
        return TensorDictPrimer(Composite(primers), expand_specs=True)

    def recall(self, tensordict: TensorDictBase, batch: torch.Size, like: Tensor) -> Recalled:
        """What was written in the step before.

        Args:
            tensordict: with batch dimensions ``*B`` in front of its entries.
            batch: ``*B``.
            like: tells device and dtype.

        Returns:
            It, in code.

        Raises:
            ValueError: if an entry has another shape.
        """
        plan = self._plans(tensordict, "plan", batch, like)
        if plan is None:
            warm = torch.zeros(batch, dtype=torch.bool, device=like.device)
            age = warm.long() if self.interval > 1 else None
            return Recalled(None, warm, age, None)
        is_init = tensordict.get(self._init_key, None)
        plan, warm = remembered(plan, is_init)
        age = elites = None
        if self.interval > 1:
            age = tensordict.get(self.keys["age"], None)
            if age is None:
                age = torch.zeros_like(warm, dtype=torch.int64)
            elif tuple(age.shape) not in ((*batch, 1), tuple(batch)):
                raise ValueError(
                    f"{self.keys['age']!r} must have shape {(*batch, 1)}, got {tuple(age.shape)}"
                )
            age = torch.where(warm, age.reshape(batch), 0)
        if self.num_elites:
            elites = self._plans(tensordict, "elites", (*batch, self.num_elites), like)
            if elites is not None:
                elites = torch.where(warm[..., None, None, None], elites, torch.nan)
        return Recalled(plan, warm, age, elites)

    def entries(self, plan: Plan, age: Tensor | None) -> list[Tensor]:
        """What is remembered after a step.

        Args:
            plan: of all ``H`` steps, whose first is executed now.
            age: how many were executed before; ``None`` if every step searches.

        Returns:
            One tensor for each of :attr:`out_keys`.
        """
        values: list[Tensor] = []
        if "plan" in self.keys:
            values.append(self.shaped(_shifted(plan.actions)))
        if "age" in self.keys and age is not None:
            values.append(((age + 1) % self.interval).unsqueeze(-1))
        if "elites" in self.keys:
            elites = plan.actions.unsqueeze(-3) if plan.elites is None else plan.elites
            shape = (*elites.shape[:-3], self.num_elites, *elites.shape[-2:])
            values.append(self.shaped(_shifted(elites.expand(shape))))
        return values

    def shaped(self, actions: Tensor) -> Tensor:
        """Actions as they are in the entries.

        Args:
            actions: in code, of shape ``(*B, A)``.

        Returns:
            Of shape ``(*B, *shape)``.
        """
        return actions.reshape((*actions.shape[:-1], *self.shape))

    def _plans(
        self, tensordict: TensorDictBase, part: str, lead: tuple[int, ...], like: Tensor
    ) -> Tensor | None:
        key = self.keys.get(part)
        plans = None if key is None else tensordict.get(key, None)
        if plans is None:
            return None
        shape = (*lead, self.horizon, *self.shape)
        if tuple(plans.shape) != shape:
            raise ValueError(f"{key!r} must have shape {shape}, got {tuple(plans.shape)}")
        return plans.to(like.dtype).reshape((*lead, self.horizon, self.size))


def _shifted(plans: Tensor) -> Tensor:
    """Plans ``(*B, H, A)`` one step later, the last action repeated."""
    return torch.cat([plans[..., 1:, :], plans[..., -1:, :]], dim=-2)
