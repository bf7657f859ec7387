"""Samples and latent MAP of a fused posterior: closed forms, numerical integration, grid search."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from oracles import INTEGRATION_GRID as GRID
from oracles import product_integrals
from torch import Tensor
from torch.distributions import (
    Categorical,
    Distribution,
    Independent,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
)

from torchrl_vjepa import (
    Density,
    diag_gaussian,
    fuse,
    langevin,
    map_estimate,
    product_of_experts,
    sample_posterior,
)

F64 = torch.float64
COVARIANCE = torch.tensor([[1.0, 0.6], [0.6, 0.8]], dtype=F64)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(mean: float = 0.0, std: float = 1.0) -> Distribution:
    return diag_gaussian(torch.tensor([mean], dtype=F64), torch.tensor([std], dtype=F64))


def wells(z: Tensor) -> Tensor:
    """Two valleys, at -1 and at 1."""
    return 3.0 * (z[..., 0].square() - 1.0).square()


# --- samples


@pytest.mark.parametrize("how", ["exact", "importance", "langevin"])
def test_samples_of_a_gaussian_posterior(how: Any) -> None:
    """Any of them is exact where the product is known."""
    p, goal = normal(0.0, 1.0), normal(2.0, 0.5)
    draws = sample_posterior(p, goal, (4000,), how, generator=seeded())
    assert draws.shape == (4000, 1)
    assert not draws.requires_grad
    assert draws.mean().item() == pytest.approx(1.6, abs=5 * math.sqrt(0.2 / 4000))
    assert draws.var().item() == pytest.approx(0.2, abs=5 * 0.2 * math.sqrt(2 / 4000))
    assert torch.equal(draws, sample_posterior(p, goal, (4000,), how, generator=seeded()))


@pytest.mark.parametrize("how", ["importance", "langevin"])
@pytest.mark.parametrize("base", [None, normal(0.4, 1.0)])
def test_samples_of_a_bimodal_posterior(how: Any, base: Distribution | None) -> None:
    """Moments and the mass of a valley within five standard errors: of draws and of the particles."""
    p, prior, num, particles = normal(0.2), Density(wells, base), 3000, 20000
    _, mean, variance = product_integrals(p, prior)
    draws = sample_posterior(
        p, prior, (num,), how, num_particles=particles, num_steps=20, generator=seeded()
    ).squeeze(-1)
    error = 5 * math.sqrt(variance / num + 3 * variance / particles)
    assert draws.mean().item() == pytest.approx(mean, abs=error)
    right = (p.log_prob(GRID.unsqueeze(-1)) + prior.log_prob(GRID.unsqueeze(-1))).softmax(0)[GRID > 0].sum()
    assert (draws > 0).double().mean().item() == pytest.approx(
        right.item(), abs=5 * math.sqrt(0.25 / num + 0.75 / particles)
    )


def test_langevin_moves_where_no_particle_was() -> None:
    """From 16 particles importance draws 16 points; the chains spread out, and have the right variance."""
    p, prior = normal(), Density(lambda z: 0.5 * ((z[..., 0] - 1.0) / 0.3).square())
    kwargs: dict[str, Any] = {"num_particles": 16, "generator": seeded()}
    points = sample_posterior(p, prior, (3000,), "importance", **kwargs)
    chains = sample_posterior(p, prior, (3000,), "langevin", num_steps=100, step_size=0.5, **kwargs)
    assert points.unique().numel() <= 16
    assert chains.unique().numel() > 2000
    variance = 1 / (1 + 1 / 0.09)
    assert chains.mean().item() == pytest.approx(1 / 1.09, abs=5 * math.sqrt(variance / 3000))
    assert chains.var().item() == pytest.approx(variance, rel=5 * math.sqrt(2 / 3000))


@pytest.mark.parametrize("step_size", [0.3, 1.0, 2.0])
def test_langevin_keeps_its_density_whatever_the_step(step_size: float) -> None:
    """Chains that start in the stationary distribution stay in it; without the correction they spread."""
    starts = torch.randn(6000, 2, dtype=F64, generator=seeded()) @ torch.linalg.cholesky(COVARIANCE).mT
    target = MultivariateNormal(torch.zeros(2, dtype=F64), COVARIANCE)
    chains = langevin(
        target.log_prob,
        starts,
        COVARIANCE.diagonal().sqrt(),
        step_size=step_size,
        num_steps=10,
        generator=seeded(1),
    )
    assert (chains != starts).any(-1).double().mean() > 0.3
    torch.testing.assert_close(torch.cov(chains.mT), COVARIANCE, rtol=0, atol=5 * math.sqrt(2 / 6000))


@pytest.mark.parametrize("outside", [-math.inf, math.nan])
def test_langevin_leaves_where_there_is_no_density(outside: float) -> None:
    def half(z: Tensor) -> Tensor:
        return torch.where(z[..., 0] > 0, -z[..., 0].square(), outside)

    chains = langevin(half, torch.full((50, 1), -0.5), num_steps=60, step_size=1.0, generator=seeded())
    assert (chains > 0).all()


# --- latent MAP

OPTIMIZERS: dict[str, Any] = {
    "Adam": lambda v: torch.optim.Adam(v, lr=0.1),
    "SGD": lambda v: torch.optim.SGD(v, lr=0.1, momentum=0.5),
    "LBFGS": lambda v: torch.optim.LBFGS(v, lr=0.5, max_iter=5),
}


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_latent_map_of_a_quadratic_energy_is_the_product_of_experts(name: str) -> None:
    p = MultivariateNormal(torch.randn(5, 2, dtype=F64), COVARIANCE)
    goal = torch.tensor([1.0, -1.0], dtype=F64)
    prior = Density(lambda z: 2.0 * (z - goal).square().sum(-1))
    point, value = map_estimate(p, prior, optimizer=OPTIMIZERS[name], num_steps=200, generator=seeded())
    expected = product_of_experts(p, diag_gaussian(goal, torch.full((2,), 0.5, dtype=F64))).mean
    torch.testing.assert_close(point, expected, rtol=0, atol=5e-3)
    torch.testing.assert_close(value, p.log_prob(point) + prior.log_prob(point))
    expert = diag_gaussian(goal, torch.full((2,), 0.5, dtype=F64))
    known, value = map_estimate(p, expert)
    torch.testing.assert_close(known, expected)
    torch.testing.assert_close(value, p.log_prob(known) + expert.log_prob(known))


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_latent_map_of_an_energy_that_is_not_convex_equals_a_grid_search(name: str) -> None:
    """Ripples in two dimensions, several rows: the best of many valleys in every row."""
    p = diag_gaussian(
        torch.tensor([[0.0, 0.0], [0.7, -0.4], [-1.0, 1.2]], dtype=F64), torch.ones(2, dtype=F64)
    )
    prior = Density(lambda z: 1.5 * torch.sin(3 * z).sum(-1) + 0.4 * z[..., 0] * z[..., 1])
    ticks = torch.linspace(-3, 3, 601, dtype=F64)
    grid = torch.cartesian_prod(ticks, ticks).unsqueeze(1)
    values, best = (p.log_prob(grid) + prior.log_prob(grid)).max(0)
    point, value = map_estimate(
        p, prior, num_restarts=24, num_steps=150, optimizer=OPTIMIZERS[name], generator=seeded()
    )
    torch.testing.assert_close(point, grid[best, 0], rtol=0, atol=0.02)
    torch.testing.assert_close(value, values, rtol=0, atol=1e-3)


def test_the_mode_of_an_importance_weighted_posterior_is_the_latent_map() -> None:
    p = normal(0.2, 1.0).expand((3,))
    posterior = fuse(p, Density(wells), num_particles=64, generator=seeded()).posterior
    z = GRID.unsqueeze(-1)
    best = GRID[(normal(0.2).log_prob(z) - wells(z)).argmax()].item()
    torch.testing.assert_close(posterior.mode, torch.full((3, 1), best, dtype=F64), rtol=0, atol=0.01)
    heavy = fuse(normal(0.0, 5.0), Density(lambda z: 1e4 * (z[..., 0] - 2.0).square()), num_particles=32)
    assert heavy.posterior.mode.item() == pytest.approx(2.0, abs=0.02)


def test_latent_map_of_a_prediction_of_ones_own() -> None:
    own = MixtureSameFamily(
        Categorical(torch.tensor([0.5, 0.5])),
        Independent(Normal(torch.tensor([[-2.0], [2.0]]), torch.ones(2, 1)), 1),
    )
    point, _ = map_estimate(own, Density(lambda z: -0.5 * z[..., 0]), generator=seeded())
    z = GRID.unsqueeze(-1).float()
    expected = GRID[(own.log_prob(z) + 0.5 * z[..., 0]).argmax()].item()
    assert point.item() == pytest.approx(expected, abs=0.02)
