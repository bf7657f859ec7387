"""The tasks of examples/goal_swap.py: the plane, the exact tracker, and what must not change."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from _goal_tasks import (
    EFFORT,
    NOWHERE,
    holdable_plane,
    make_tasks,
    references,
    run_oracle,
    stage_costs,
    steady_state,
    tracking,
    violations,
)
from torchrl_vjepa import BatchedNoisyTVEnv, LinearGaussianSystem, LQGController
from torchrl_vjepa.noisy_tv import solve_lqr


def total_cost(system: LinearGaussianSystem, start: Tensor, actions: Tensor, wanted: Tensor) -> Tensor:
    signal, cost = start, torch.zeros((), dtype=torch.float64)
    for action, reference in zip(actions, wanted, strict=True):
        signal = system.A @ signal + system.B @ action
        cost = cost + (signal - reference).square().sum() + EFFORT * action.square().sum()
    return cost


@pytest.mark.parametrize("seed", [0, 3])
def test_the_tracker_is_the_optimum_of_brute_force(seed: int) -> None:
    """All actions at once: a quadratic function, whose minimum is one linear solve."""
    system, horizon = LinearGaussianSystem(control_dim=2, seed=seed), 7
    generator = torch.Generator().manual_seed(seed)
    wanted = torch.randn(horizon, 4, generator=generator, dtype=torch.float64)
    start = torch.randn(4, generator=generator, dtype=torch.float64)

    def cost(flat: Tensor) -> Tensor:
        return total_cost(system, start, flat.reshape(horizon, 2), wanted)

    zero = torch.zeros(2 * horizon, dtype=torch.float64)
    hessian = torch.autograd.functional.hessian(cost, zero)
    gradient = torch.autograd.functional.jacobian(cost, zero)
    best = -torch.linalg.solve(hessian, gradient).reshape(horizon, 2)
    gains, feedforwards = tracking(system, wanted)
    signal, actions = start, []
    for gain, feedforward in zip(gains, feedforwards, strict=True):
        actions.append(feedforward - gain @ signal)
        signal = system.A @ signal + system.B @ actions[-1]
    torch.testing.assert_close(torch.stack(actions), best)


def test_far_from_the_end_a_constant_reference_is_the_regulator() -> None:
    system = LinearGaussianSystem(control_dim=2, seed=1)
    wanted = system.goal.expand(3, 400, 4)
    gains, feedforwards = tracking(system, wanted)
    regulator = solve_lqr(system)
    torch.testing.assert_close(gains[0], regulator.gain)
    torch.testing.assert_close(feedforwards[:, 0], regulator.feedforward.expand(3, 2))
    held = steady_state(system, system.goal.unsqueeze(0))[0]
    action = regulator.feedforward - regulator.gain @ held
    torch.testing.assert_close(system.A @ held + system.B @ action, held)


def test_the_oracle_pays_what_the_regulator_pays() -> None:
    env = BatchedNoisyTVEnv(16, noise_scale=8.0, system_seed=2, seed=0)
    wanted = env.system.goal.expand(16, 200, 4)
    cost = stage_costs(run_oracle(env, wanted), wanted).mean().item()
    # Within the spread of 16 episodes of the exact expectation.
    assert cost == pytest.approx(LQGController(env.system, 8.0).expected_cost(200), rel=0.03)


@pytest.mark.parametrize("seed", range(5))
def test_signals_of_the_plane_can_be_held(seed: int) -> None:
    system = LinearGaussianSystem(control_dim=2, seed=seed)
    plane = holdable_plane(system)
    torch.testing.assert_close(plane.mT @ plane, torch.eye(2, dtype=torch.float64))
    missing = plane - system.A @ plane
    action = torch.linalg.lstsq(system.B, missing).solution
    torch.testing.assert_close(system.B @ action, missing)
    assert action[:, 0].norm() < action[:, 1].norm()


def test_tasks_and_what_they_count() -> None:
    env = BatchedNoisyTVEnv(1, noise_scale=8.0, system_seed=0, seed=0)
    tasks, plane = make_tasks(env, 0, goals=3, period=5, radius=0.3, gap=0.1)
    assert [task.name for task in tasks][:4] == ["circle", "goal-0", "goal-1", "goal-2"]
    assert len({task.name for task in tasks}) == len(tasks) == 10
    for task in tasks:
        assert task.film.shape == (5, 20)
        torch.testing.assert_close(task.reference.norm(dim=-1), torch.ones(5, dtype=torch.float64))
    circle = references(tasks, 6)[0]
    torch.testing.assert_close(circle[0], tasks[0].reference[1])
    torch.testing.assert_close(circle[-1], tasks[0].reference[1])
    goal, one, two = (
        next(t for t in tasks if t.name == f"{name}-1") for name in ("goal", "keep-out", "two-regions")
    )
    held = steady_state(env.system, goal.reference[:1])[0] @ plane
    torch.testing.assert_close((two.regions - held).norm(dim=-1), torch.full((2,), 0.4, dtype=torch.float64))
    assert (goal.regions == NOWHERE).all()
    assert torch.equal(one.regions[0], two.regions[0])
    signal = torch.stack([plane @ one.regions[0], plane @ held]).float().reshape(1, 2, 4)
    episodes = TensorDict(next=TensorDict(signal=signal, batch_size=[1, 2]), batch_size=[1, 2])
    assert violations(episodes, one.regions.unsqueeze(0), plane, 0.3).tolist() == [[True, False]]
