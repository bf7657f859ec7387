"""Windows of a replay buffer: which pairs of steps belong together, and what may not count."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

__all__ = ["action_chunks", "check_finite", "read", "step_mask", "pair_mask"]


def read(tensordict: TensorDictBase, key: NestedKey, *, reader: str) -> Tensor:
    """The entry ``key``, or an error that says who needs it.

    Args:
        tensordict: where to look.
        key: what to look for.
        reader: who asks, for the message.

    Returns:
        The entry.

    Raises:
        KeyError: if there is no such entry.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> read(TensorDict(a=torch.zeros(2), batch_size=2), "a", reader="a test")
        tensor([0., 0.])
    """
    value = tensordict.get(key, None)
    if value is None:
        present = sorted(map(str, tensordict.keys(True, True)))
        raise KeyError(f"{reader} reads the entry {key!r}, which the input lacks; it has {present}")
    return value


def step_mask(tensordict: TensorDictBase, keys: Sequence[NestedKey], batch: torch.Size) -> Tensor | None:
    """Steps that count: all masks that are present, joined.

    Args:
        tensordict: the windows.
        keys: where masks may be, each ``(*B, T)`` or ``(*B, T, 1)``, ``False`` for padding.
        batch: the shape ``(*B, T)``.

    Returns:
        A boolean tensor of shape ``(*B, T)``, or ``None`` if no mask is present.

    Raises:
        ValueError: if a mask has another shape.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> batch = TensorDict(mask=torch.tensor([[True, False]]), batch_size=(1, 2))
        >>> step_mask(batch, ["mask"], torch.Size((1, 2)))
        tensor([[ True, False]])
    """
    mask = None
    for key in keys:
        entry = tensordict.get(key, None)
        if entry is None:
            continue
        if entry.shape not in (batch, (*batch, 1)):
            raise ValueError(
                f"mask {key!r} must have shape {tuple(batch)} or {(*batch, 1)}, got {tuple(entry.shape)}"
            )
        entry = entry.reshape(batch).bool()
        mask = entry if mask is None else mask & entry
    return mask


def pair_mask(done: Tensor | None, is_init: Tensor | None, mask: Tensor | None, skip: int) -> Tensor | None:
    r"""Pairs :math:`(t, t + \Delta)` that lie in one episode and hold no padded step.

    Args:
        done: ``("next", "done")``, of shape ``(*B, T)``: the transition from ``t`` ends an episode.
        is_init: ``(*B, T)``: step ``t`` begins an episode.
        mask: ``(*B, T)``: steps that count.
        skip: :math:`\Delta`.

    Returns:
        A boolean tensor of shape ``(*B, T - skip)``, or ``None`` if every pair counts.

    Examples:
        >>> import torch
        >>> pair_mask(torch.tensor([False, True, False, False]), None, None, 1)
        tensor([ True, False,  True])
        >>> pair_mask(None, None, torch.tensor([True, True, True, False]), 2)
        tensor([ True, False])
    """
    parts = []
    if done is not None:
        ends = done.long().cumsum(-1) - done.long()
        parts.append(ends[..., skip:] == ends[..., :-skip])
    if is_init is not None:
        starts = is_init.long().cumsum(-1)
        parts.append(starts[..., skip:] == starts[..., :-skip])
    if mask is not None:
        gaps = (~mask).long().cumsum(-1)
        parts.append((gaps[..., skip:] == gaps[..., :-skip]) & mask[..., :-skip])
    if not parts:
        return None
    return torch.stack(parts).all(0)


def action_chunks(action: Tensor, skip: int) -> Tensor:
    r"""The chunks :math:`u_{t:t+\Delta-1}` of every pair (``eq:vjepa_controlled_dynamics``).

    Args:
        action: actions of shape ``(*B, T, A)``.
        skip: :math:`\Delta`, smaller than ``T``.

    Returns:
        Chunks of shape ``(*B, T - skip, skip, A)``.

    Examples:
        >>> import torch
        >>> action_chunks(torch.arange(4.0).reshape(4, 1), 2).squeeze(-1)
        tensor([[0., 1.],
                [1., 2.]])
    """
    return action[..., :-1, :].unfold(-2, skip, 1).transpose(-1, -2)


def check_finite(value: Tensor, mask: Tensor | None, key: NestedKey) -> None:
    """Refuse NaN and infinities in steps that count.

    Args:
        value: an entry of shape ``(*B, T, *event)``.
        mask: ``(*B, T)``, or ``None``.
        key: its name, for the message.

    Raises:
        ValueError: if a value that counts is not finite.

    Examples:
        >>> import torch
        >>> check_finite(torch.tensor([[1.0], [float("nan")]]), torch.tensor([True, False]), "x")
    """
    if value.sum().isfinite():  # one pass; only an unlucky sum needs the exact answer
        return
    finite = value.isfinite()
    if mask is not None:
        finite = finite | ~mask.reshape(mask.shape + (1,) * (value.ndim - mask.ndim))
    if not finite.all():
        raise ValueError(
            f"{key!r} must be finite at every step that counts, got {int((~finite).sum())} NaN or infinite "
            "values; drop these steps or mark them False in ('collector', 'mask')"
        )
