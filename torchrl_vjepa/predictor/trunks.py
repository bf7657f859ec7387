"""The layers of a trunk, one by one."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torchrl.modules import MLP

from torchrl_vjepa.stacking import is_plain_linear

__all__ = ["linear_and_others"]


def linear_and_others(trunk: nn.Module) -> list[Any] | None:
    """The layers of a trunk in their order, if it begins and ends with an affine map and has no hooks.

    Args:
        trunk: an affine map or an ``MLP``.

    Returns:
        The layers; where gradients are off, activations are copies that work in place. ``None`` if the
        trunk is something else.

    Examples:
        >>> [type(layer).__name__ for layer in linear_and_others(MLP(3, 2, num_cells=[4]))]
        ['Linear', 'Tanh', 'Linear']
        >>> linear_and_others(nn.Identity())
    """
    if is_plain_linear(trunk):
        return [trunk]
    if type(trunk) is not MLP or trunk._forward_hooks or trunk._forward_pre_hooks:
        return None
    layers = list(trunk)
    if not (layers and is_plain_linear(layers[0]) and is_plain_linear(layers[-1])):
        return None
    for layer in layers[1:-1]:
        if isinstance(layer, nn.Linear) and not is_plain_linear(layer):
            return None
    if torch.is_grad_enabled():
        return layers
    return [_in_place(layer) if getattr(layer, "inplace", None) is False else layer for layer in layers]


def _in_place(activation: nn.Module) -> nn.Module:
    """A copy that overwrites its input, which no one else holds behind an affine map."""
    copied = object.__new__(type(activation))  # copy.copy takes five times as long
    copied.__dict__.update(activation.__dict__, inplace=True)
    return copied
