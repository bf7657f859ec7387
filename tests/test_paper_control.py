"""When planning on the mean is optimal: theorems of the paper on the library's own environments."""

from __future__ import annotations

import functools
import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torchrl.data import Bounded

from torchrl_vjepa import (
    BJEPA,
    DiagGaussianHead,
    GaussianPrior,
    GradientMPC,
    LatentEnv,
    Predictor,
    TargetScale,
    action_cost,
    linear_encoder,
    quadratic_cost,
)
from torchrl_vjepa.planners import Proposal

A = torch.tensor([[0.9, 0.3], [-0.2, 0.8]], dtype=torch.float64)
B = torch.tensor([[1.0], [0.5]], dtype=torch.float64)
LATENT = torch.tensor([1.0, -0.5], dtype=torch.float64)
GOAL = torch.tensor([0.2, 0.7], dtype=torch.float64)
Q = torch.tensor([[2.0, 0.3], [0.3, 1.0]], dtype=torch.float64)
EFFORT = 0.1
GRID = torch.linspace(-2, 2, 41, dtype=torch.float64)


def make_model(action_dependent: bool = False) -> BJEPA:
    """Known linear dynamics; a variance of 0.3 and 0.6, or one that grows with the action."""
    head = DiagGaussianHead(**({} if action_dependent else {"scale": "constant"}))
    predictor = Predictor(2, action_dim=1, head=head)
    model = BJEPA(linear_encoder(5, 2), predictor, target_scale=TargetScale(2)).double()
    with torch.no_grad():
        weight = predictor.trunks[0].weight
        weight.zero_()
        weight[:2] = torch.cat([A, B], 1)
        if action_dependent:
            weight[2:, 2] = 3.0
        else:
            predictor.constants.copy_(torch.tensor([[math.log(0.3), math.log(0.6)]]))
    return model


def stage_cost(latent: Tensor, action: Tensor) -> Tensor:
    return quadratic_cost(GOAL, Q)(latent, action) + action_cost(EFFORT)(latent, action)


def costs(transition: Any, plans: Tensor, how: str) -> Tensor:
    """Cost of every plan (N, H, 1), with common random numbers over plans if sampled."""
    spec = Bounded(-2, 2, (1,), dtype=torch.float64)
    env = LatentEnv(
        transition,
        action_spec=spec,
        cost=stage_cost,
        how=how,
        num_samples=20_000 if how == "sample" else 1,
        latent_dim=2,
        dtype=torch.float64,
    )
    torch.manual_seed(1)
    return env.objective(LATENT, plans).detach()


def test_thm_map_optimal() -> None:
    """E c(Z', u) = c(mu, u) + tr(Q Sigma): the action that is best at the mean is best."""
    model = make_model()
    plans = GRID[:, None, None]
    mean, expected = costs(model.predictor.dist, plans, "mean"), costs(model.predictor.dist, plans, "sample")
    variance = model.predictor.dist(LATENT, torch.zeros(1).double()).variance.detach()
    gap = (Q.diagonal() * variance).sum()
    assert ((expected - mean - gap).abs() < 0.1).all()
    assert mean.argmin() == expected.argmin()
    # Minimum of (A z + B u - g)' Q (A z + B u - g) + r u^2.
    best = -(B.mT @ Q @ (A @ LATENT - GOAL)) / (B.mT @ Q @ B + EFFORT)
    assert abs(GRID[mean.argmin()] - best).item() <= 0.05


def test_cor_map_optimal_multistep() -> None:
    """Over H steps the covariances add a constant: sum_h tr(Q P_h), P_{h+1} = A P_h A' + Sigma."""
    model = make_model()
    plans = torch.randn(30, 4, 1, dtype=torch.float64).clamp(-2, 2)
    mean, expected = costs(model.predictor.dist, plans, "mean"), costs(model.predictor.dist, plans, "sample")
    sigma = model.predictor.dist(LATENT, torch.zeros(1).double()).variance.detach().diag()
    covariance, gap = torch.zeros_like(sigma), 0.0
    for _ in range(4):
        covariance = A @ covariance @ A.mT + sigma
        gap += (Q @ covariance).trace().item()
    assert ((expected - mean) / gap - 1).abs().max() < 0.05
    assert mean.argmin() == expected.argmin()


def test_a_covariance_that_depends_on_the_action_breaks_the_theorem() -> None:
    """Risk is part of the cost: planning on the mean picks an action that is not the best."""
    model = make_model(action_dependent=True)
    plans = GRID[:, None, None]
    mean, expected = costs(model.predictor.dist, plans, "mean"), costs(model.predictor.dist, plans, "sample")
    assert (GRID[mean.argmin()] - GRID[expected.argmin()]).abs() > 0.3
    assert expected[mean.argmin()] > expected.min() + 0.1


@pytest.mark.parametrize("aim", [-1.0, 2.0])
def test_thm_bjepa_map_optimal(aim: float) -> None:
    """The fused posterior is Gaussian with a covariance that no action moves: MAP planning is optimal."""
    model = make_model()
    prior = GaussianPrior(2, mean=aim, std=torch.tensor([0.5, 1.0])).double()
    fused = model.fuse(prior)
    posts = [fused.dist(LATENT, u.reshape(1)) for u in GRID[::20]]
    for post in posts[1:]:
        torch.testing.assert_close(post.variance, posts[0].variance)
    plans = GRID[:, None, None]
    mean, mode, expected = (costs(fused.dist, plans, how) for how in ("mean", "mode", "sample"))
    torch.testing.assert_close(mean, mode)
    gap = (Q.diagonal() * posts[0].variance).sum().detach()
    assert ((expected - mean - gap).abs() < 0.06).all()
    assert mean.argmin() == expected.argmin()
    # Minimum over u at mu_post = K (A z + B u) + (I - K) m, K = S_post / S_dyn.
    dynamics = model.predictor.dist(LATENT, torch.zeros(1).double()).variance
    gain = (posts[0].variance / dynamics).detach().diag()
    at_zero = gain @ A @ LATENT + (torch.eye(2, dtype=torch.float64) - gain) @ torch.full((2,), aim).double()
    b = gain @ B
    best = -(b.mT @ Q @ (at_zero - GOAL)) / (b.mT @ Q @ b + EFFORT)
    assert abs(GRID[mean.argmin()] - best.clamp(-2, 2)).item() <= 0.05


@pytest.mark.parametrize("steps", [5, 400])
def test_alg_bjepa_mpc(steps: int) -> None:
    """The algorithm as printed: mean rollout, energy of the task, control cost, gradient step."""
    model, horizon, alpha = make_model(), 3, 0.05
    prior = GaussianPrior(2, mean=GOAL, std=torch.tensor([0.5, 1.0])).double().requires_grad_(False)

    def energy(latent: Tensor, action: Tensor) -> Tensor:
        return prior.energy(latent)

    env = LatentEnv(
        model,
        action_spec=Bounded(-2, 2, (1,), dtype=torch.float64),
        cost=EFFORT * action_cost() + energy,
    )
    sgd = functools.partial(torch.optim.SGD, lr=alpha)
    planner = GradientMPC(env, horizon, steps, optimizer=sgd, num_starts=1)
    start = torch.zeros(horizon, 1, dtype=torch.float64)
    plan = planner.plan(LATENT, Proposal(start, torch.ones_like(start))).actions
    assert all(parameter.grad is None for parameter in model.parameters())
    u = start
    for _ in range(steps):
        u.requires_grad_()
        z, total = LATENT, torch.zeros((), dtype=torch.float64)
        for k in range(horizon):
            z = model.predictor.dist(z, u[k]).mean
            total = total + energy(z, u[k]) + EFFORT * u[k].square().sum()
        u = u.detach() - alpha * torch.autograd.grad(total, u)[0]
    # At the minimum, which of two plans is the better is a matter of rounding.
    torch.testing.assert_close(plan, u, rtol=0, atol=1e-12 if steps == 5 else 1e-6)
    if steps == 5:
        return
    # Energies of a Gaussian are quadratic, |P (z - g)|^2 / 2 + constant: least squares.
    root = (torch.tensor([2.0, 1.0], dtype=torch.float64) / 2**0.5).diag()
    powers = [torch.linalg.matrix_power(A, k) for k in range(horizon + 1)]
    rows = [
        torch.cat([root @ powers[k - j] @ B if j <= k else torch.zeros_like(B) for j in range(horizon)], 1)
        for k in range(horizon)
    ]
    target = [root @ (GOAL - powers[k + 1] @ LATENT) for k in range(horizon)]
    matrix = torch.cat([*rows, EFFORT**0.5 * torch.eye(horizon, dtype=torch.float64)])
    best = torch.linalg.lstsq(matrix, torch.cat([*target, start.flatten()]).unsqueeze(-1)).solution
    torch.testing.assert_close(plan, best, rtol=0, atol=1e-6)
