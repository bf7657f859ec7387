"""Theorem thm:map_optimal, its corollary and its remark: when mean planning is optimal, and when not."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from oracles import linear_gaussian_moments
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import Distribution, MultivariateNormal
from torchrl.data import Bounded

from torchrl_vjepa import CEM, MPPI, LatentEnv, cvar, diag_gaussian, quadratic_cost, worst_case

A = torch.tensor([[0.9, 0.3], [-0.2, 0.8]], dtype=torch.float64)
B = torch.tensor([[1.0, 0.0], [0.5, 1.0]], dtype=torch.float64)
ROOT = torch.tensor([[0.5, 0.0], [0.3, 0.2]], dtype=torch.float64)
TARGET = torch.tensor([1.0, -0.5], dtype=torch.float64)
WEIGHT = torch.tensor([[2.0, 0.5], [0.5, 1.0]], dtype=torch.float64)


def nonlinear_mean(latent: Tensor, action: Tensor) -> Tensor:
    return torch.tanh(latent @ A.mT) + action @ B.mT + 0.3 * action.square()


def one_step(latent: Tensor, action: Tensor) -> Distribution:
    """Any mean, and a covariance that does not depend on the action."""
    return MultivariateNormal(nonlinear_mean(latent, action), scale_tril=ROOT, validate_args=False)


def linear(latent: Tensor, action: Tensor) -> Distribution:
    loc = latent @ A.mT + action @ B.mT
    return MultivariateNormal(loc, scale_tril=ROOT, validate_args=False)


def effort(latent: Tensor, action: Tensor) -> Tensor:
    """The arbitrary r(u) of the theorem, neither convex nor smooth."""
    return 0.3 * torch.sin(3 * action).sum(-1) + 0.1 * action.abs().sum(-1)


def make_env(transition: Any, cost: Any = None, **kwargs: Any) -> LatentEnv:
    cost = quadratic_cost(TARGET, WEIGHT) + effort if cost is None else cost
    spec = Bounded(-2, 2, (2,), dtype=torch.float64)
    return LatentEnv(transition, action_spec=spec, cost=cost, latent_dim=2, dtype=torch.float64, **kwargs)


def expected_costs(env: LatentEnv, plans: Tensor, num: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return env.objective(torch.tensor([0.5, 0.2]).double(), plans, generator=generator, num_samples=num)


def test_optimality_of_map_control_under_quadratic_costs() -> None:
    """thm:map_optimal: E[c] is the cost of the mean plus tr(Q Sigma), for every action."""
    env, num = make_env(one_step), 40_000
    plans = torch.rand(30, 1, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 4 - 2
    of_mean = env.objective(torch.tensor([0.5, 0.2]).double(), plans)
    constant = (WEIGHT @ ROOT @ ROOT.mT).trace()
    expected = expected_costs(env, plans, num)
    # Var = 4 m' Q Sigma Q m + 2 tr((Q Sigma)^2), with m the error of the mean.
    mean = nonlinear_mean(torch.tensor([0.5, 0.2]).double(), plans[:, 0])
    error = (mean - TARGET) @ WEIGHT
    q_sigma = WEIGHT @ ROOT @ ROOT.mT
    variance = 4 * (error @ ROOT).square().sum(-1) + 2 * (q_sigma @ q_sigma).trace()
    assert ((expected - of_mean - constant).abs() < 5 * (variance / num).sqrt()).all()


def test_map_equals_mean_control() -> None:
    """thm:map_optimal, last sentence: the mode of a Gaussian is its mean."""
    plans = torch.randn(30, 3, 2, dtype=torch.float64)
    state = torch.zeros(2, dtype=torch.float64)
    of_mean = make_env(one_step).objective(state, plans)
    torch.testing.assert_close(make_env(one_step, how="mode").objective(state, plans), of_mean)


def test_the_minimisers_agree() -> None:
    """thm:map_optimal: the two sets of minimisers are one, on a grid of actions."""
    line = torch.linspace(-2, 2, 21, dtype=torch.float64)
    plans = torch.cartesian_prod(line, line).unsqueeze(1)
    env = make_env(one_step)
    of_mean = env.objective(torch.tensor([0.5, 0.2]).double(), plans)
    sampled = expected_costs(env, plans, 4_000)
    # Common noise leaves its linear term in the difference: little, and nothing at the optimum's scale.
    assert of_mean[sampled.argmin()] - of_mean.min() < 0.02
    assert of_mean.max() - of_mean.min() > 5


def test_multi_step_mean_planning_under_action_independent_covariance() -> None:
    """cor:map_optimal_multistep: J(u) is the cost of the mean trajectory plus a sum of traces."""
    horizon, num = 4, 40_000
    env = make_env(linear)
    plans = torch.rand(20, horizon, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 0.5
    state = torch.tensor([0.5, 0.2], dtype=torch.float64)
    _, covariances = linear_gaussian_moments(A, B, ROOT @ ROOT.mT, state, plans[0])
    constant = torch.stack([(WEIGHT @ covariance).trace() for covariance in covariances]).sum()
    costs = []

    def keep(values: Tensor) -> Tensor:
        costs.append(values)
        return values.mean(0)

    generator = torch.Generator().manual_seed(0)
    expected = env.objective(state, plans, generator=generator, num_samples=num, risk=keep)
    error = costs[0].std(0) / num**0.5
    assert ((expected - env.objective(state, plans) - constant).abs() < 5 * error).all()
    # The constant is no small matter here: planning may drop it, evaluation may not.
    assert constant > 20 * error.max()


@pytest.mark.parametrize("planner", [CEM, MPPI])
def test_mean_and_sampled_planning_act_alike(planner: Any) -> None:
    """cor:map_optimal_multistep for whole planners: the same first action."""
    env = make_env(linear, quadratic_cost(TARGET, WEIGHT) + (lambda z, u: 0.5 * u.square().sum(-1)))
    td = TensorDict(latent=torch.randn(4, 2, dtype=torch.float64), batch_size=4)
    settings = {"planning_horizon": 2, "optim_steps": 8, "num_candidates": 96, "seed": 0}
    of_mean = planner(env, **settings)(td.clone())["action"]
    # The sample mean of the noise moves the minimiser by its standard error: O(1 / sqrt(M)).
    sampled = planner(env, **settings, num_samples=400)(td.clone())["action"]
    torch.testing.assert_close(sampled, of_mean, atol=0.1, rtol=0)


def reckless(latent: Tensor, action: Tensor) -> Distribution:
    """A remark of the proof: the covariance depends on the action, sigma = |u|."""
    return diag_gaussian(latent + action, 0.05 + action.abs())


def test_where_the_covariance_depends_on_the_action_mean_planning_is_wrong() -> None:
    """Remark "Assumptions matter": to go from 0 to g, E[(u - g)^2 + u^2] is least at g / 2, not at g."""
    goal = torch.ones(2, dtype=torch.float64)
    env = make_env(reckless, quadratic_cost(goal))
    td = TensorDict(latent=torch.zeros(2, dtype=torch.float64))
    settings = {"planning_horizon": 1, "optim_steps": 10, "num_candidates": 256, "seed": 0}
    of_mean = CEM(env, **settings)(td.clone())["action"]
    sampled = CEM(env, **settings, num_samples=800)(td.clone())["action"]
    torch.testing.assert_close(of_mean, goal, atol=0.02, rtol=0)
    # d/du [(u - 1)^2 + (u + 0.05)^2] = 0
    torch.testing.assert_close(sampled, torch.full_like(goal, 0.475), atol=0.06, rtol=0)

    def expected(action: Tensor) -> Tensor:
        return ((action - 1).square() + (0.05 + action.abs()).square()).sum()

    assert expected(of_mean) > 1.8 * expected(sampled)
    # The more averse, the more careful; averse enough, it does not move at all.
    careful = [
        CEM(env, **settings, num_samples=800, risk=risk)(td.clone())["action"].mean()
        for risk in (cvar(1.0), cvar(0.3), cvar(0.02), worst_case)
    ]
    assert careful[0] > careful[1] + 0.1 > careful[2] + 0.1
    assert careful[2].abs() < 0.05
    assert careful[3].abs() < 0.05
    torch.testing.assert_close(careful[0], sampled.mean())


def either_way(latent: Tensor, action: Tensor) -> Distribution:
    """A remark of the proof: two modes, left and right of where the action points."""
    from torch.distributions import Categorical, MixtureSameFamily

    loc = latent + action
    parts = diag_gaussian(torch.stack([loc - 1, loc + 1], -2), torch.full((2, 2), 0.05).double())
    return MixtureSameFamily(Categorical(torch.ones(*loc.shape[:-1], 2).double()), parts)


def test_for_two_modes_and_a_wall_mean_planning_is_wrong() -> None:
    """Remark "Assumptions matter": the mean lies between the modes, where nothing ever is."""

    def wall(latent: Tensor, action: Tensor) -> Tensor:
        return torch.exp(-4 * latent.square().sum(-1)) + 0.001 * action.square().sum(-1)

    env = make_env(either_way, wall)
    state, plan = torch.zeros(2, dtype=torch.float64), torch.zeros(1, 1, 2, dtype=torch.float64)
    assert env.objective(state, plan) > 0.99
    assert expected_costs(env, plan, 1000) < 0.5
