"""The mean of the predictor, iterated along plans."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

__all__ = ["PointRollout"]


class PointRollout:
    """Plans through the layers of a trunk: what each step writes is what the next one reads.

    Where gradients are off all steps work in one buffer, into which the last layer writes. Otherwise (also
    where calls are traced, mapped over, autocast or seen by hooks) every step makes new tensors.

    Args:
        layers: affine maps as ``(weight (out, in), bias)``, and what comes between them; the first reads
            ``(latent, action)``, the last gives the latent.
        residual: whether the next latent is the latent plus what the layers give.
        dtype: what the layers compute in; ``None``: the dtype of latents and actions.

    Examples:
        >>> import torch
        >>> move = PointRollout([(torch.tensor([[1.0, 2.0]]), torch.zeros(1))])  # z + 2 u
        >>> move(torch.zeros(1, 1), torch.ones(1, 3, 1)).flatten()
        tensor([2., 4., 6.])
    """

    def __init__(
        self, layers: Sequence[Any], residual: bool = False, dtype: torch.dtype | None = None
    ) -> None:
        self.residual, self.dtype = residual, dtype
        self.watched = False  # by hooks, which may keep what they see
        self.hidden: list[Any] = []
        for layer in layers:
            if isinstance(layer, tuple):
                weight, bias = layer if dtype is None else (part.to(dtype) for part in layer)
                self.hidden.append((weight.t(), bias))
            elif layer._forward_hooks or layer._forward_pre_hooks:
                self.hidden.append(layer)
                self.watched = True
            else:
                self.hidden.append(layer.forward)
        self.weight, self.bias = self.hidden.pop()

    def __call__(self, latent: Tensor, actions: Tensor) -> Tensor:
        """Latents along the plans.

        Args:
            latent: where they start, of shape ``(R, D)``.
            actions: of shape ``(R, H, A)``.

        Returns:
            Of shape ``(R, H, D)``, contiguous.
        """
        if self.dtype is None and not self.watched and _in_place_is_safe(latent.device.type):
            return self._in_one_buffer(latent, actions)
        return self._by_new_tensors(latent, actions)

    def _in_one_buffer(self, latent: Tensor, actions: Tensor) -> Tensor:
        num, horizon, action_dim = actions.shape
        size = latent.shape[-1]
        dtype = self.weight.dtype
        joined = latent.new_empty((horizon + 1, num, size + action_dim), dtype=dtype)
        joined.narrow(0, 0, horizon).narrow(2, size, action_dim).copy_(actions.transpose(0, 1))
        joined.select(0, 0).narrow(1, 0, size).copy_(latent)
        following = joined.narrow(0, 1, horizon).narrow(2, 0, size)
        following.copy_(self.bias)  # of all steps at once, to which the last layer adds
        hidden: list[Any] = []
        for layer in self.hidden:
            if isinstance(layer, tuple):
                weight, bias = layer
                out = latent.new_empty((num, weight.shape[1]), dtype=dtype)
                layer = functools.partial(torch.addmm, bias, mat2=weight, out=out)
            hidden.append(layer)
        weight, residual = self.weight, self.residual
        for inputs, out in zip(joined.unbind(0), following.unbind(0), strict=False):
            x = inputs
            for layer in hidden:
                x = layer(x)
            out.addmm_(x, weight)
            if residual:
                out.add_(inputs.narrow(1, 0, size))
        return following.transpose(0, 1).contiguous()

    def _by_new_tensors(self, latent: Tensor, actions: Tensor) -> Tensor:
        latents = []
        for action in actions.unbind(1):
            x = torch.cat([latent, action], dim=-1)
            if self.dtype is not None:
                x = x.to(self.dtype)
            for layer in self.hidden:
                x = torch.addmm(layer[1], x, layer[0]) if isinstance(layer, tuple) else layer(x)
            x = torch.addmm(self.bias, x, self.weight)
            if self.dtype is not None:
                x = x.to(latent.dtype)
            latent = latent + x if self.residual else x
            latents.append(latent)
        return torch.stack(latents, dim=1)


def _in_place_is_safe(device_type: str) -> bool:
    """Whether nobody follows what happens to tensors: no graph, no tracing, no mapping, no casting."""
    return not (
        torch.is_grad_enabled()
        or torch.compiler.is_compiling()
        or torch._C._are_functorch_transforms_active()
        or torch.is_autocast_enabled(device_type)
    )
