"""What models must have in common to train as one batch."""

from __future__ import annotations

from typing import Any

import torch

__all__ = ["blueprint"]


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
