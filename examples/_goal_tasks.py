"""Tasks on the noisy TV: goals, a path and keep-out regions, and the exact controller for each."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_vjepa import BatchedNoisyTVEnv, KalmanFilter, LinearGaussianSystem

EFFORT = 0.1  # weight of |u|^2 in the cost of a step, |s' - r|^2 + 0.1 |u|^2
NOWHERE = 1e3  # where keep-out regions are that a task does not have


@dataclass
class Task:
    """One task: what it costs, and what a planner is told.

    Attributes:
        name: of the task.
        reference: where the signal should be at step count ``t``, ``(period, 4)``; its end joins its start.
        film: one noisy frame of each reference, ``(period, 20)``; all the same for a goal.
        regions: centres of two keep-out discs in the plane of the goals, ``(2, 2)``.
    """

    name: str
    reference: Tensor
    film: Tensor
    regions: Tensor


def holdable_plane(system: LinearGaussianSystem) -> Tensor:
    """Signals that a constant action can hold, ``s = A s + B u``: an orthonormal basis, ``(4, 2)``.

    Two actions hold a plane of signals. Its first direction is the one that takes least effort.
    """
    identity = torch.eye(system.signal_dim, dtype=torch.float64)
    held = torch.linalg.svd(torch.cat([identity - system.A, -system.B], dim=1)).Vh[system.signal_dim :]
    signals, actions = held[:, : system.signal_dim].mT, held[:, system.signal_dim :].mT
    basis, factor = torch.linalg.qr(signals)
    effort = torch.linalg.svd(actions @ torch.linalg.inv(factor)).Vh
    plane = basis @ effort.flip(0).mT
    # The sign of a singular vector is arbitrary; this one does not depend on the library.
    return plane * torch.where(plane.sum(0) < 0, -1.0, 1.0)


def make_tasks(
    env: BatchedNoisyTVEnv, seed: int, *, goals: int, period: int, radius: float, gap: float, frames: int = 1
) -> tuple[list[Task], Tensor]:
    """The circle; goals around it; each of them also with one and with two regions in its way.

    Args:
        env: the noisy TV.
        seed: of the frames.
        goals: how many.
        period: steps of the circle.
        radius: of the keep-out discs.
        gap: from where the optimal controller would hold the signal to the edge of the disc.
        frames: noisy frames that are averaged for each goal.

    Returns:
        The tasks, and the plane ``(4, 2)`` they lie in.
    """
    system, plane = env.system, holdable_plane(env.system)
    generator = torch.Generator().manual_seed(seed)

    def around(count: int) -> Tensor:
        angle = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
        return torch.stack([angle.cos(), angle.sin()], dim=-1)

    def seen(signals: Tensor) -> Tensor:
        shape = (frames, len(signals))
        data = system.simulate(
            1, env.noise_scale, batch_size=shape, signal=signals.expand(*shape, -1), generator=generator
        )
        return data["observation"].squeeze(-2).mean(0)

    wanted = around(goals) @ plane.mT
    held = steady_state(system, wanted) @ plane
    # In front of the goal, as seen from the origin, and beside it.
    front = -torch.nn.functional.normalize(held, dim=-1)
    side = torch.stack([-front[:, 1], front[:, 0]], dim=-1)
    nowhere = torch.full_like(held, NOWHERE)
    first, second = held + (radius + gap) * front, held + (radius + gap) * side
    circle = around(period) @ plane.mT
    film, tasks = seen(wanted), [Task("circle", circle, seen(circle), nowhere[:2])]
    for name, regions in (
        ("goal", (nowhere, nowhere)),
        ("keep-out", (first, nowhere)),
        ("two-regions", (first, second)),
    ):
        for k in range(goals):
            places = torch.stack([region[k] for region in regions])
            tasks.append(
                Task(f"{name}-{k}", wanted[k].expand(period, -1), film[k].expand(period, -1), places)
            )
    return tasks, plane


def tracking(
    system: LinearGaussianSystem, references: Tensor, effort: float = EFFORT
) -> tuple[Tensor, Tensor]:
    r"""Linear-quadratic tracking with preview, exact for a finite horizon.

    Minimises :math:`\sum_{t=0}^{T-1} |s_{t+1} - r_{t+1}|^2 + \lambda |u_t|^2` by the value functions
    :math:`V_t(s) = s^\top P_t s - 2 p_t^\top s + \text{const}`, with :math:`P_T = 0, p_T = 0`,

    .. math::
        W &= I + P_{t+1}, \quad w = r_{t+1} + p_{t+1}, \quad M = \lambda I + B^\top W B \\
        u_t &= k_t - K_t s_t, \quad K_t = M^{-1} B^\top W A, \quad k_t = M^{-1} B^\top w \\
        P_t &= A^\top W (A - B K_t), \quad p_t = (A - B K_t)^\top w

    the reference is known ahead. With noise in the signal and the Kalman filter's
    estimate for :math:`s_t` it is optimal too (certainty equivalence).

    Args:
        system: the system.
        references: :math:`r_1, \dots, r_T`, of shape ``(*B, T, 4)``.
        effort: :math:`\lambda`.

    Returns:
        Gains ``(T, 2, 4)`` and feedforwards ``(*B, T, 2)``.
    """
    A, B = system.A, system.B
    identity = torch.eye(len(A), dtype=torch.float64)
    value, slope = torch.zeros_like(A), torch.zeros_like(references[..., 0, :], dtype=torch.float64)
    gains, feedforwards = [], []
    for reference in reversed(references.double().unbind(-2)):
        weight, pull = identity + value, reference + slope
        curvature = effort * torch.eye(B.shape[1], dtype=torch.float64) + B.mT @ weight @ B
        gain = torch.linalg.solve(curvature, B.mT @ weight @ A)
        feedforwards.append(torch.linalg.solve(curvature, B.mT @ pull.unsqueeze(-1)).squeeze(-1))
        gains.append(gain)
        value, slope = A.mT @ weight @ (A - B @ gain), pull @ (A - B @ gain)
    return torch.stack(gains[::-1]), torch.stack(feedforwards[::-1], dim=-2)


def steady_state(system: LinearGaussianSystem, goals: Tensor) -> Tensor:
    """Where the optimal controller holds the signal, ``(K, 4)``: the goal, less what it is worth to save."""
    gains, feedforwards = tracking(system, goals.unsqueeze(1).expand(-1, 500, -1))
    identity = torch.eye(system.signal_dim, dtype=torch.float64)
    closed = system.A - system.B @ gains[0]
    return torch.linalg.solve(identity - closed, (feedforwards[:, 0] @ system.B.mT).mT).mT


def references(tasks: Sequence[Task], steps: int) -> Tensor:
    """What the next signal is compared with at each step, ``(tasks, steps, 4)``."""
    times = torch.arange(1, steps + 1)
    return torch.stack([task.reference[times % len(task.reference)] for task in tasks])


def run_oracle(
    env: BatchedNoisyTVEnv, wanted: Tensor, see: Callable[[Tensor], Tensor] | None = None
) -> TensorDict:
    """Episodes under the optimal controller: Kalman filter and tracking, for each row's references.

    Args:
        env: the noisy TV.
        wanted: references of each row, ``(rows, steps, 4)``.
        see: what tells the signal from a frame, in place of the Kalman filter.

    Returns:
        The episodes, ``(rows, steps)``.
    """
    gains, feedforwards = tracking(env.system, wanted)
    kalman = KalmanFilter(env.system, env.noise_scale)
    memory = torch.zeros(len(wanted), len(kalman.F), dtype=torch.float64)
    state, steps = env.reset(), []
    for t, (gain, feedforward) in enumerate(zip(gains, feedforwards.unbind(-2), strict=True)):
        mean = kalman.update(memory, state["observation"], torch.tensor(t))
        signal = mean[..., : env.system.signal_dim] if see is None else see(state["observation"])
        action = feedforward - signal @ gain.mT
        state["action"] = action.clamp(-2.0, 2.0).float()
        memory = kalman.predict(mean, state["action"])
        step, state = env.step_and_maybe_reset(state)
        steps.append(step)
    return torch.stack(steps, dim=1)


def stage_costs(episodes: TensorDict, wanted: Tensor) -> Tensor:
    """Cost of each step, ``(rows, steps)``, with the true signal."""
    error = episodes["next", "signal"].double() - wanted
    return error.square().sum(-1) + EFFORT * episodes["action"].double().square().sum(-1)


def violations(episodes: TensorDict, regions: Tensor, plane: Tensor, radius: float) -> Tensor:
    """Whether the true signal is in a region after each step, ``(rows, steps)``."""
    place = episodes["next", "signal"].double() @ plane
    distance = (place.unsqueeze(-2) - regions.unsqueeze(1)).norm(dim=-1)
    return (distance < radius).any(-1)
