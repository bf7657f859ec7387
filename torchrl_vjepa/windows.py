"""Windows of a replay buffer: which pairs of steps belong together, and what may not count."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

__all__ = [
    "action_chunks",
    "check_finite",
    "code_of_windows",
    "pair_mask",
    "read",
    "step_mask",
    "with_action_code",
]


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


def code_of_windows(action: Tensor, batch: torch.Size, size: int, dtype: torch.dtype) -> Tensor:
    """Discrete actions of a replay buffer as floats: one-hots and bits are cast, indices one-hot encoded.

    Args:
        action: of shape ``(*B, T, A)``, boolean or integer, or indices of shape ``(*B, T)``,
            ``(*B, T, 1)``.
        batch: ``(*B, T)``.
        size: ``A``.
        dtype: of the result.

    Returns:
        Of shape ``(*B, T, A)``; what has another shape is returned as it is, for the caller to refuse.

    Raises:
        ValueError: if an index is not in ``[0, A)``.

    Examples:
        >>> code_of_windows(torch.tensor([0, 2]), torch.Size([2]), 3, torch.float32)
        tensor([[1., 0., 0.],
                [0., 0., 1.]])
    """
    if action.shape == (*batch, size):
        return action.to(dtype)
    if action.shape not in (batch, (*batch, 1)) or action.dtype == torch.bool:
        return action
    index = action.reshape(*batch, 1)
    if not torch.compiler.is_compiling() and bool(((index < 0) | (index >= size)).any()):
        raise ValueError(
            f"indices of actions must be in [0, {size}), the predictor's action_dim, got "
            f"{int(index.min())} to {int(index.max())}"
        )
    return (index == torch.arange(size, device=action.device)).to(dtype)


def with_action_code(
    tensordict: TensorDictBase, entry: tuple[NestedKey, int] | None, observation_key: NestedKey
) -> TensorDictBase:
    """Windows in which discrete actions are floats.

    Args:
        tensordict: the windows; not changed.
        entry: where the action is, and how many numbers a model reads; ``None`` if it reads none.
        observation_key: an entry that tells the batch dimensions, and the dtype of the code.

    Returns:
        The same windows, or a shallow copy with the code in the place of the action.

    Raises:
        ValueError: if an index is not in ``[0, A)``.

    Examples:
        >>> from tensordict import TensorDict
        >>> observation = torch.zeros(1, 2, 5)
        >>> windows = TensorDict(action=torch.tensor([[0, 1]]), observation=observation, batch_size=(1, 2))
        >>> with_action_code(windows, ("action", 3), "observation")["action"].shape
        torch.Size([1, 2, 3])
    """
    if entry is None or not entry[1]:
        return tensordict
    key, size = entry
    action, observation = tensordict.get(key, None), tensordict.get(observation_key, None)
    if action is None or observation is None or action.is_floating_point():
        return tensordict
    batch = observation.shape[: -max(1, observation.ndim - tensordict.ndim)]
    return tensordict.copy().set(key, code_of_windows(action, batch, size, observation.dtype))
