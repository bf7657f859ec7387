"""What planners ask of the source of their costs, early and in one place."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, unravel_key
from torchrl.envs import EnvBase

from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.planners.env_objective import EnvObjective
from torchrl_vjepa.planners.expansion import State
from torchrl_vjepa.risk import Sampling
from torchrl_vjepa.state_heads import Head, check_head, in_evaluation, state_value

__all__ = ["admit_head", "checked_sampling", "example_state", "latent_key_of", "probe_value"]


def checked_sampling(source: Any, env: EnvBase, asked: Mapping[str, Any]) -> Sampling | None:
    """Refuse early what a source of costs cannot evaluate.

    Args:
        source: has a method ``objective``.
        env: what the user gave, for messages.
        asked: settings by name, in place of the source's own.

    Returns:
        All settings together; ``None`` if the source has none.

    Raises:
        TypeError: if its objective does not take what is asked for.

    Examples:
        >>> from torchrl.envs import PendulumEnv
        >>> env = PendulumEnv()
        >>> checked_sampling(EnvObjective(env), env, {"num_samples": 3}).num_samples
        3
    """
    sampling = getattr(type(source), "sampling", None)
    offered = callable(sampling)
    refused = [name for name in asked if not (offered and _takes(sampling, name))]
    reason = "has no method sampling beside it" if not offered else "was written without"
    settings = source.sampling(**asked) if offered and not refused else None
    if not refused:
        refused = [name for name in asked if not _takes(type(source).objective, name)]
    if refused:
        raise TypeError(
            f"{' and '.join(refused)} need an environment whose objective takes them, as LatentEnv "
            f"does, got {type(env).__name__}, whose own objective {reason}"
        )
    return settings


def _takes(function: Any, name: str) -> bool:
    parameters = inspect.signature(function).parameters.values()
    return any(p.name == name or p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters)


def latent_key_of(source: Any) -> NestedKey | None:
    """Where the states of a source have their latent.

    Args:
        source: of costs.

    Returns:
        The key; ``None`` for an environment that is stepped.

    Examples:
        >>> from torchrl.envs import PendulumEnv
        >>> latent_key_of(EnvObjective(PendulumEnv())) is None
        True
    """
    return source.latent_key if isinstance(source, LatentEnv) else None


def admit_head(
    source: Any, env: EnvBase, name: str, head: Any, writes: Sequence[NestedKey] = ()
) -> list[NestedKey]:
    """Refuse early a value or a policy that a source's states cannot be given to; carry what it reads.

    Args:
        source: of costs.
        env: what the user gave, for messages.
        name: of the argument, for messages.
        head: latents to a tensor, or a TensorDictModule.
        writes: entries that a TensorDictModule must write.

    Returns:
        Entries that are read of the input for its sake.

    Raises:
        TypeError: if the head cannot be called on states of the source.
        KeyError: if it reads or writes other entries.

    Examples:
        >>> from torchrl.envs import PendulumEnv
        >>> from torchrl.modules import ValueOperator
        >>> env = PendulumEnv()
        >>> value = ValueOperator(torch.nn.Linear(2, 1), in_keys=["th", "thdot"])
        >>> admit_head(EnvObjective(env), env, "terminal_value", value)
        []
    """
    latent_key = latent_key_of(source)
    if latent_key is None and not isinstance(source, EnvObjective):
        raise TypeError(
            f"{name} needs an environment that imagines step by step, as LatentEnv or one that is stepped, "
            f"got {type(env).__name__}, of which only its own objective is known"
        )
    readable = source.head_keys if latent_key is None else [latent_key]
    has_latent = latent_key is not None
    reads = check_head(name, head, readable, env=type(env).__name__, has_latent=has_latent, writes=writes)
    return source.keep(reads) if isinstance(source, EnvObjective) else []


def example_state(source: Any, batch: tuple[int, ...]) -> State | None:
    """States to try a head with.

    Args:
        source: of costs.
        batch: ``*B``.

    Returns:
        Its entries; ``None`` where no specification tells their shapes.

    Examples:
        >>> from torchrl.envs import PendulumEnv
        >>> example_state(EnvObjective(PendulumEnv()), (2, 3))["th"].shape
        torch.Size([2, 3])
    """
    if isinstance(source, LatentEnv):
        spec = source.observation_spec[source.latent_key]
        shape = torch.Size((*batch, source.latent_dim))
        latent = torch.linspace(-1.0, 1.0, shape.numel(), device=spec.device, dtype=spec.dtype)
        return {source.latent_key: latent.reshape(shape)}
    if not isinstance(source, EnvObjective) or source.env.batch_size:
        return None
    specs = {}
    for group in (source.env.full_state_spec, source.env.observation_spec):
        specs.update({unravel_key(key): group[key] for key in group.keys(True, True)})
    if not set(source.in_keys) <= set(specs):
        return None
    zeros = {key: specs[key].zero() for key in source.in_keys}
    return {key: zero.expand((*batch, *zero.shape)) for key, zero in zeros.items()}


def probe_value(source: Any, name: str, head: Head) -> None:
    """Call a value on a small block of states, in evaluation mode, so that errors come early.

    Args:
        source: of costs.
        name: of the argument, for messages.
        head: the value.

    Raises:
        ValueError: if it gives a wrong shape.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.envs import PendulumEnv
        >>> twice = TensorDictModule(lambda th: torch.stack([th, th], -1), ["th"], ["state_value"])
        >>> probe_value(EnvObjective(PendulumEnv()), "terminal_value", twice)
        Traceback (most recent call last):
        ...
        ValueError: terminal_value must give one number for each row, of shape (2, 3), got (2, 3, 2)
    """
    batch = (2, 3)
    state = example_state(source, batch)
    if state is not None:
        with in_evaluation(head):
            state_value(head, state, batch, latent_key_of(source), name=name)
