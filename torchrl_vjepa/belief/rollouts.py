"""The predictive distribution, iterated: latent trajectories."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor
from torch.distributions import Distribution

from torchrl_vjepa.distributions import point_estimate

__all__ = ["PreparedTransition", "Transition", "check_plan", "rollout"]

Transition = Callable[[Tensor, Tensor], Distribution]
PointRollout = Callable[[Tensor, Tensor], Tensor]


def rollout(
    transition: Transition,
    latent: Tensor,
    actions: Tensor,
    how: Literal["mean", "mode", "sample"] = "mean",
    num_samples: int = 1,
    *,
    chunk_size: int | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Latent trajectories under a plan (``eq:VJEPA_multi_step_prediction``).

    ``"mean"`` and ``"mode"`` iterate the point prediction, :math:`\hat Z_{t+1} = \mu_\phi(\hat Z_t, u_t)`;
    ``"sample"`` draws :math:`Z^{(m)}_{t+1} \sim p_\phi(\cdot \mid Z^{(m)}_t, u_t)` for
    :math:`m = 1, \dots, M`.

    Args:
        transition: ``(latent (*B, D), action (*B, A)) -> Distribution``, for instance ``Predictor.dist``.
        latent: where to start, of shape ``(*B, D)``.
        actions: the plan, of shape ``(*B, H, A)``.
        how: point prediction or Monte Carlo.
        num_samples: number of trajectories :math:`M` for ``"sample"``.
        chunk_size: how many of the ``M`` trajectories are rolled out at a time, for ``"sample"``; all
            by default. What the transition computes on the way then takes memory for ``chunk_size``
            trajectories, whatever ``M`` is. The draws are others, of the same distribution.
        generator: source of randomness for ``"sample"``.

    Returns:
        Predicted latents :math:`Z_{t+1}, \dots, Z_{t+H}`: ``(*B, H, D)``, or ``(M, *B, H, D)`` for
        ``"sample"``.

    Raises:
        ValueError: if shapes disagree, the plan is empty, ``how`` is unknown, ``num_samples`` or
            ``chunk_size`` is not positive, or a point prediction is asked for with ``num_samples > 1``
            or a ``chunk_size``.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> def walk(latent, action):
        ...     return diag_gaussian(latent + action, torch.full_like(latent, 0.1))
        >>> rollout(walk, torch.zeros(1), torch.ones(3, 1))
        tensor([[1.],
                [2.],
                [3.]])
        >>> rollout(walk, torch.zeros(1), torch.ones(3, 1), "sample", num_samples=8).shape
        torch.Size([8, 3, 1])
    """
    if how not in ("mean", "mode", "sample"):
        raise ValueError(f"how must be 'mean', 'mode' or 'sample', got {how!r}")
    check_plan(latent, actions)
    if num_samples < 1 or (how != "sample" and num_samples != 1):
        raise ValueError(
            f"num_samples must be positive, and 1 unless how='sample', got {num_samples} with how={how!r}"
        )
    if chunk_size is not None and (chunk_size < 1 or how != "sample"):
        raise ValueError(
            f"chunk_size must be positive, and None unless how='sample', got {chunk_size} with how={how!r}"
        )
    if how != "sample":
        return _roll(transition, latent, actions, how, None)
    size = num_samples if chunk_size is None else chunk_size
    out: Tensor | None = None
    for first in range(0, num_samples, size):
        num = min(size, num_samples - first)
        part = _roll(
            transition,
            latent.expand(num, *latent.shape),
            actions.expand(num, *actions.shape),
            how,
            generator,
        )
        if num == num_samples:
            return part
        if out is None:  # written in place: a concatenation would hold everything twice
            out = part.new_empty((num_samples, *part.shape[1:]))
        out[first : first + num] = part
    return torch.as_tensor(out)


def check_plan(latent: Tensor, actions: Tensor) -> None:
    """Refuse a plan that does not fit the latents.

    Args:
        latent: where it starts, ``(*B, D)``.
        actions: the plan, ``(*B, H, A)``.

    Raises:
        ValueError: if batch dimensions disagree or the plan is empty.

    Examples:
        >>> check_plan(torch.zeros(5, 3), torch.zeros(5, 10, 2))
    """
    if actions.ndim != latent.ndim + 1 or actions.shape[:-2] != latent.shape[:-1] or not actions.shape[-2]:
        raise ValueError(
            "actions must have shape (*B, H, A) with H of at least 1 and the batch dimensions of latent "
            f"{tuple(latent.shape)}, got {tuple(actions.shape)}"
        )


def _roll(
    transition: Transition,
    latent: Tensor,
    actions: Tensor,
    how: Literal["mean", "mode", "sample"],
    generator: torch.Generator | None,
) -> Tensor:
    if how != "sample" and latent.numel() and actions.numel():
        move = PreparedTransition.of(transition).point_rollout(latent, actions)
        if move is not None:
            horizon, size = actions.shape[-2], latent.shape[-1]
            rows = latent.reshape(-1, size)
            moved = move(rows, actions.reshape(len(rows), horizon, actions.shape[-1]))
            return moved.view(*latent.shape[:-1], horizon, size)
    latents = []
    for action in actions.unbind(-2):
        latent = point_estimate(transition(latent, action), how, generator=generator)
        latents.append(latent)
    return torch.stack(latents, dim=-2)


class PreparedTransition:
    """A transition that is iterated several times from latents and actions of the same shape.

    A method ``dist`` whose owner has a ``point_rollout``, as
    :class:`~torchrl_vjepa.predictor.Predictor` has, is then prepared once for all rollouts of mean and
    mode: the weights that it has at the first rollout count.

    Args:
        transition: ``(latent (*B, D), action (*B, A)) -> Distribution``.
        dtype: what networks compute in: a ``point_rollout`` by weights of that dtype, others by autocast;
            ``None``: as they do without.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.predictor import Predictor
        >>> move = PreparedTransition(Predictor(4, action_dim=2).dist)
        >>> rollout(move, torch.zeros(7, 4), torch.zeros(7, 5, 2)).shape
        torch.Size([7, 5, 4])
    """

    def __init__(self, transition: Transition, dtype: torch.dtype | None = None) -> None:
        self.transition, self.dtype = transition, dtype
        self._move: PointRollout | None = None
        self._example: tuple[Any, ...] | None = None

    @classmethod
    def of(cls, transition: Transition) -> PreparedTransition:
        """The transition itself, where it is prepared already.

        Args:
            transition: any transition, or a prepared one.

        Returns:
            A prepared transition.
        """
        return transition if isinstance(transition, cls) else cls(transition)

    def __call__(self, latent: Tensor, action: Tensor) -> Distribution:
        """The distribution of the next latent.

        Args:
            latent: of shape ``(*B, D)``.
            action: of shape ``(*B, A)``.

        Returns:
            What the transition returns.
        """
        if self.dtype is None:
            return self.transition(latent, action)
        with torch.autocast(latent.device.type, self.dtype):
            return self.transition(latent, action)

    def point_rollout(self, latent: Tensor, actions: Tensor) -> PointRollout | None:
        """The short way to mean and mode, where the owner of the transition knows one.

        Args:
            latent: where a rollout starts, of shape ``(*B, D)``.
            actions: its plan, of shape ``(*B, H, A)``.

        Returns:
            ``(latent (R, D), actions (R, H, A)) -> (R, H, D)``, or ``None``.
        """
        example = (latent.shape[-1], actions.shape[-1], latent.dtype, actions.dtype, torch.is_grad_enabled())
        if self._example != example:
            owner = getattr(self.transition, "__self__", None)
            prepare = getattr(owner, "point_rollout", None)
            self._move = None
            if prepare is not None and self.transition == getattr(owner, "dist", None):
                rows = latent.reshape(-1, latent.shape[-1])[:1]
                self._move = prepare(rows, actions.reshape(-1, actions.shape[-1])[:1], self.dtype)
            self._example = example
        return self._move
