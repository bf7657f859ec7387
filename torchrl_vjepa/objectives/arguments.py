"""Arguments of losses: weights of skips, and lists of models that train as one batch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

__all__ = ["blueprint", "normalised_weights"]


def blueprint(model: torch.nn.Module) -> dict[str, Any]:
    """What models must share to train as one batch: modules, their settings, shapes of their tensors.

    Args:
        model: the model.

    Returns:
        One entry for each module, setting and tensor.

    Examples:
        >>> blueprint(torch.nn.Linear(2, 3))["weight (tensor)"]
        ((3, 2), 'learned')
    """
    learned = dict(model.named_parameters())
    found: dict[str, Any] = {
        f"{name} (tensor)": (tuple(value.shape), "learned" if name in learned else "fixed")
        for name, value in model.state_dict().items()
    }
    for name, module in model.named_modules():
        found[name] = type(module).__name__
        for key, value in vars(module).items():
            # Not where a scale starts: that is a value of the tensor.
            plain = isinstance(value, (bool, int, float, str, tuple, type(None)))
            if plain and not key.startswith("_") and key not in ("training", "init_std"):
                found[f"{name}.{key}" if name else key] = value
    return found


def normalised_weights(weights: Sequence[float] | None, skips: tuple[int, ...]) -> tuple[float, ...]:
    """Weights of skips that sum to one.

    Args:
        weights: one for each skip; equal by default.
        skips: the skips.

    Returns:
        One for each skip.

    Raises:
        ValueError: if their number is wrong, or they are negative, not finite or all zero.

    Examples:
        >>> normalised_weights((1.0, 3.0), (1, 4))
        (0.25, 0.75)
    """
    if weights is None:
        return tuple(1.0 / len(skips) for _ in skips)
    if (
        len(weights) != len(skips)
        or not all(math.isfinite(w) and w >= 0 for w in weights)
        or not sum(weights)
    ):
        raise ValueError(
            f"skip_weights must be one finite weight of at least 0 for each of skips={skips}, not all zero, "
            f"got {tuple(weights)}"
        )
    return tuple(float(w) / sum(weights) for w in weights)
