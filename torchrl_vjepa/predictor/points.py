"""The mean of the predictor, iterated along plans."""

from __future__ import annotations

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
        affine: list[tuple[Tensor, Tensor, list[Any]]] = []  # and what follows each
        for layer in layers:
            if isinstance(layer, tuple):
                weight, bias = layer if dtype is None else (part.to(dtype) for part in layer)
                affine.append((bias, weight.t(), []))
            elif layer._forward_hooks or layer._forward_pre_hooks:
                affine[-1][2].append(layer)
                self.watched = True
            else:
                affine[-1][2].append(layer.forward)
        *self.hidden, (self.bias, self.weight, _) = affine

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
        hidden = [
            (bias, weight, latent.new_empty((num, weight.shape[1]), dtype=dtype), others)
            for bias, weight, others in self.hidden
        ]
        weight, residual, addmm = self.weight, self.residual, torch.addmm
        for inputs, out in zip(joined.unbind(0), following.unbind(0), strict=False):
            x = inputs
            for bias, matrix, buffer, others in hidden:
                x = addmm(bias, x, matrix, out=buffer)
                for other in others:
                    x = other(x)
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
            for bias, weight, others in self.hidden:
                x = torch.addmm(bias, x, weight)
                for other in others:
                    x = other(x)
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
