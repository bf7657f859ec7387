"""Heads of states: values and policies that read a latent, or the entries of an environment's state."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import torch
from tensordict import NestedKey, TensorDict, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

__all__ = ["Head", "call_head", "check_head", "in_evaluation", "state_value", "while_alive"]

Head: TypeAlias = "Callable[[Tensor], Tensor] | TensorDictModuleBase"


def check_head(
    name: str,
    head: Any,
    readable: Sequence[NestedKey],
    *,
    env: str,
    has_latent: bool,
    writes: Sequence[NestedKey] = (),
) -> list[NestedKey]:
    """Refuse a head that states of an environment cannot be given to.

    Args:
        name: of the argument, for messages.
        head: latents to a tensor, or a TensorDictModule.
        readable: entries of a state that a TensorDictModule may read.
        env: name of the environment's class, for messages.
        has_latent: whether its states are latents, so that a function of them can be called.
        writes: entries that a TensorDictModule must write.

    Returns:
        Entries of a state that a TensorDictModule reads; none of a function.

    Raises:
        TypeError: if the head cannot be called, or is a function of latents where there are none.
        KeyError: if a TensorDictModule reads other entries, or does not write what it must.

    Examples:
        >>> from torchrl.modules import ValueOperator
        >>> value = ValueOperator(nn.Linear(2, 1), in_keys=["latent"])
        >>> check_head("terminal_value", value, ["latent"], env="LatentEnv", has_latent=True)
        ['latent']
    """
    if not callable(head):
        raise TypeError(f"{name} must be callable, latents to a tensor, got {type(head).__name__}")
    if not isinstance(head, TensorDictModuleBase):
        if not has_latent:
            raise TypeError(
                f"{name} must be a TensorDictModule for {env}, which has no latent, got {type(head).__name__}"
            )
        return []
    written = [unravel_key(key) for key in head.out_keys]
    # TorchRL's composite actors also list the group of parameters that they have just written.
    own = {path[:length] for path in map(_path, written) for length in range(1, len(path))}
    reads = [key for key in map(unravel_key, head.in_keys) if _path(key) not in own]
    if not set(reads) <= set(readable):
        raise KeyError(
            f"{name} must read only {list(readable)} of {env}, got in_keys={reads}; rename its in_keys"
        )
    missing = [key for key in writes if key not in written]
    if missing:
        raise KeyError(f"{name} must write {missing}, got out_keys={written}")
    return reads


def _path(key: NestedKey) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else tuple(key)


def call_head(
    head: Head,
    state: Mapping[NestedKey, Tensor],
    batch: Sequence[int],
    latent_key: NestedKey | None,
    written: NestedKey,
) -> Tensor:
    """What a head says about states.

    Args:
        head: latents to a tensor, or a TensorDictModule.
        state: entries of the states, each with batch ``*B``.
        batch: ``*B``.
        latent_key: which of them a function of latents is given.
        written: the entry that a TensorDictModule writes.

    Returns:
        The tensor.

    Examples:
        >>> call_head(lambda latent: latent.sum(-1), {"latent": torch.ones(5, 2)}, (5,), "latent", "x")
        tensor([2., 2., 2., 2., 2.])
    """
    if isinstance(head, TensorDictModuleBase):
        return head(TensorDict(dict(state), batch_size=torch.Size(batch))).get(written)
    return head(state[latent_key])


def state_value(
    head: Head,
    state: Mapping[NestedKey, Tensor],
    batch: Sequence[int],
    latent_key: NestedKey | None,
    *,
    name: str = "terminal_value",
    needs_gradient: bool = False,
) -> Tensor:
    r"""The value :math:`V(Z)` of states: the expected sum of rewards from there on, higher is better.

    Args:
        head: latents ``(*B, D)`` to values ``(*B)``; or a TensorDictModule that writes ``state_value`` of
            shape ``(*B, 1)``, as TorchRL's :class:`~torchrl.modules.ValueOperator` does.
        state: entries of the states, each with batch ``*B``.
        batch: ``*B``.
        latent_key: which of them a function of latents is given.
        name: of the argument, for messages.
        needs_gradient: refuse a value without gradient.

    Returns:
        Of shape ``(*B)``.

    Raises:
        ValueError: if the head gives another shape, or no gradient where one is needed.

    Examples:
        >>> from torchrl.modules import ValueOperator
        >>> value = ValueOperator(nn.Linear(2, 1), in_keys=["latent"])
        >>> state_value(value, {"latent": torch.ones(5, 2)}, (5,), "latent").shape
        torch.Size([5])
    """
    value = call_head(head, state, batch, latent_key, "state_value")
    expected = tuple(batch)
    if isinstance(head, TensorDictModuleBase) and tuple(value.shape) == (*expected, 1):
        value = value.squeeze(-1)
    if not isinstance(value, Tensor) or tuple(value.shape) != expected:
        got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        advice = "; drop its last dimension by squeeze(-1)" if got == (*expected, 1) else ""
        raise ValueError(f"{name} must give one number for each row, of shape {expected}, got {got}{advice}")
    if needs_gradient and torch.is_grad_enabled() and not value.requires_grad:
        raise ValueError(
            f"{name} must have a gradient for actions that require one, got a value without: is it detached, "
            "rounded or a comparison? A sampling planner (CEM, MPPI) needs none"
        )
    return value


def while_alive(alive: Tensor, amount: Tensor) -> Tensor:
    """What counts as far as an episode lives; behind its certain end nothing does, not even ``nan``.

    Args:
        alive: probability of being alive, of shape ``(*B)``.
        amount: what is weighted by it, of shape ``(*B)``.

    Returns:
        Of shape ``(*B)``.

    Examples:
        >>> while_alive(torch.tensor([0.5, 0.0]), torch.tensor([2.0, torch.inf]))
        tensor([1., 0.])
    """
    return alive * torch.where(alive > 0, amount, 0.0)


@contextlib.contextmanager
def in_evaluation(module: Any) -> Iterator[None]:
    """Evaluation mode and no gradients for a trial call; then every part is in its own mode again.

    Args:
        module: any module; what is none has no mode.

    Examples:
        >>> dropout = nn.Dropout(0.5)
        >>> with in_evaluation(dropout):
        ...     kept = dropout(torch.ones(2))
        >>> kept, dropout.training
        (tensor([1., 1.]), True)
    """
    parts = module.modules() if isinstance(module, nn.Module) else ()
    training = [part for part in parts if part.training]
    for part in training:
        part.training = False
    try:
        with torch.no_grad():
            yield
    finally:
        for part in training:
            part.training = True
