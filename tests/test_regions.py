"""Regions against projections and brute force; RegionPrior and what it constrains."""

from __future__ import annotations

import copy
import math
import pickle
from functools import partial
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchrl_vjepa import Ball, Box, ChanceConstraint, HalfSpace, LinearProbe, Region, RegionPrior

INF = math.inf
SEEDS = st.integers(0, 10**6)


def make(kind: str, dim: int, generator: torch.Generator) -> Region:
    point = torch.randn(dim, generator=generator, dtype=torch.float64)
    size = 0.2 + 2 * torch.rand(dim, generator=generator, dtype=torch.float64)
    if kind == "ball":
        return Ball(point, float(size[0])).double()
    if kind == "half-space":
        return HalfSpace(size[0] * point, float(size[0])).double()
    if kind == "open box":
        low = torch.where(torch.arange(dim) % 2 == 0, point, -INF)
        return Box(low, torch.where(torch.arange(dim) % 3 == 0, point + size, INF)).double()
    return Box(point, point + size).double()


KINDS = ["ball", "half-space", "box", "open box"]
EVERY = pytest.mark.parametrize("kind", KINDS)


def projection(region: Region, x: Tensor) -> Tensor:
    """The nearest point of the set."""
    if isinstance(region, Ball):
        off = x - region.centre
        return region.centre + off * (region.radius / off.norm(dim=-1, keepdim=True)).clamp_max(1.0)
    if isinstance(region, HalfSpace):
        return x - ((x @ region.normal - region.offset).clamp_min(0.0)).unsqueeze(-1) * region.normal
    assert isinstance(region, Box)
    return x.clamp(region.low, region.high)


def exit_distance(region: Region, x: Tensor) -> Tensor:
    """From inside: the shortest way to a face."""
    if isinstance(region, Ball):
        return region.radius - (x - region.centre).norm(dim=-1)
    if isinstance(region, HalfSpace):
        return region.offset - x @ region.normal
    assert isinstance(region, Box)
    return torch.cat([x - region.low, region.high - x], -1).amin(-1)


@EVERY
@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, dim=st.integers(1, 4))
def test_signed_distance_equals_the_projections(kind: str, seed: int, dim: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    region = make(kind, dim, generator)
    x = 3 * torch.randn(50, dim, generator=generator, dtype=torch.float64)
    distance = region.signed_distance(x)
    outside = (x - projection(region, x)).norm(dim=-1)
    inside = outside < 1e-12
    expected = torch.where(inside, -exit_distance(region, x), outside)
    torch.testing.assert_close(distance, expected, rtol=1e-6, atol=1e-7)
    assert torch.equal(region.contains(x), distance <= 0)


@EVERY
@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, dim=st.integers(1, 4))
def test_signed_distance_has_unit_slope_and_is_lipschitz(kind: str, seed: int, dim: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    region = make(kind, dim, generator)
    x = 3 * torch.randn(20, dim, generator=generator, dtype=torch.float64)
    x.requires_grad_()
    distance = region.signed_distance(x)
    (slope,) = torch.autograd.grad(distance.sum(), x)
    torch.testing.assert_close(slope.norm(dim=-1), torch.ones(20, dtype=torch.float64))
    gaps = (distance - distance.flip(0)).abs()
    assert (gaps <= (x - x.flip(0)).norm(dim=-1) + 1e-9).all()


@pytest.mark.parametrize("kind", ["ball", "box"])
def test_distance_by_brute_force(kind: str) -> None:
    """Over a fine grid of the boundary in two dimensions."""
    region = make(kind, 2, torch.Generator().manual_seed(1))
    turn = torch.linspace(0, 2 * math.pi, 4001, dtype=torch.float64)
    if isinstance(region, Ball):
        boundary = region.centre + region.radius * torch.stack([turn.cos(), turn.sin()], -1)
    else:
        assert isinstance(region, Box)
        side = torch.linspace(0, 1, 2001, dtype=torch.float64)
        one, zero = torch.ones_like(side), torch.zeros_like(side)
        square = torch.cat(
            [torch.stack(p, -1) for p in ((side, zero), (side, one), (zero, side), (one, side))]
        )
        boundary = region.low + (region.high - region.low) * square
    x = 3 * torch.randn(200, 2, dtype=torch.float64)
    torch.testing.assert_close(
        region.signed_distance(x).abs(), torch.cdist(x, boundary).amin(-1), rtol=2e-3, atol=2e-3
    )


def test_gradients_are_finite_where_there_is_no_nearest_point() -> None:
    for region in (Ball(torch.zeros(2), 1.0), Box(-torch.ones(2), torch.ones(2))):
        x = torch.zeros(2, requires_grad=True)
        region.signed_distance(x).backward()
        assert x.grad is not None
        assert x.grad.isfinite().all()
        assert not x.grad.any()


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Ball(torch.zeros(2), 0.0), "radius must be positive and finite, got 0"),
        (lambda: Ball(torch.zeros(2), math.nan), "radius must be positive and finite"),
        (lambda: Ball(torch.tensor([math.nan]), 1.0), "centre must be a finite number or"),
        (lambda: Ball(torch.tensor(1.0), 1.0), r"centre must have shape \(P,\), got \(\)"),
        (lambda: HalfSpace(torch.zeros(2), 1.0), "normal must be no zero vector"),
        (lambda: HalfSpace(torch.ones(2), math.inf), "offset must be a finite number"),
        (lambda: Box(torch.ones(2), torch.ones(2)), "low must be under high"),
        (lambda: Box(torch.full((2,), math.nan), torch.ones(2)), "low must be under high"),
        (lambda: Box(torch.full((1,), -INF), torch.full((1,), INF)), "one of them finite"),
        (
            lambda: Box(torch.zeros(2), torch.ones(3)),
            r"the same shape \(P,\), got \(2,\) and \(3,\)",
        ),
        (lambda: Ball(torch.zeros(2), 1.0).contains(torch.zeros(3)), "x must have last dimension 2"),
    ],
)
def test_bad_regions_are_refused(build: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()


# --- the prior


BALL = Ball(torch.tensor([1.0, 0.0]), 0.5)
POINTS = torch.tensor([[1.0, 0.0], [1.5, 0.0], [1.7, 0.0], [4.0, 4.0]])


@pytest.mark.parametrize("keep", ["in", "out"])
def test_energy_is_the_stated_barrier(keep: Any) -> None:
    prior = RegionPrior(BALL, keep, sharpness=7.0)
    d = BALL.signed_distance(POINTS) * (1 if keep == "in" else -1)
    torch.testing.assert_close(prior.energy(POINTS), (1 + (7.0 * d).exp()).log(), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(prior.distance(POINTS), d)
    assert prior.energy(POINTS)[1].item() == pytest.approx(math.log(2))


@pytest.mark.parametrize("keep", ["in", "out"])
def test_a_sharp_barrier_is_the_hard_constraint(keep: Any) -> None:
    prior = RegionPrior(BALL, keep, sharpness=1e4)
    energy, violated = prior.energy(POINTS), prior.violated(POINTS)
    off = torch.tensor([True, False, True, True])
    assert (energy[off & ~violated] < 1e-6).all()
    assert (energy[off & violated] > 1e3).all()
    assert energy.isfinite().all()


def test_the_boundary_belongs_to_the_region_and_nan_to_none() -> None:
    edge = torch.tensor([[0.0, 1.0], [math.nan, 0.0]])
    square = Box(torch.zeros(2), torch.ones(2))
    assert RegionPrior(square, "in", sharpness=1.0).violated(edge).tolist() == [False, True]
    assert RegionPrior(square, "out", sharpness=1.0).violated(edge).tolist() == [True, True]


def test_a_probe_puts_the_region_into_physical_coordinates() -> None:
    weight, bias = torch.randn(2, 3), torch.randn(2)
    probe = LinearProbe(weight.double(), bias.double(), 1.0, 1.0)
    latent = torch.randn(6, 3)
    expected = RegionPrior(BALL, "out", sharpness=3.0).energy(latent @ weight.mT + bias)
    linear = torch.nn.Linear(3, 2)
    linear.load_state_dict({"weight": weight, "bias": bias})
    for spec in (probe, (weight, bias), linear):
        prior = RegionPrior(BALL, "out", sharpness=3.0, probe=spec)
        assert prior.latent_dim == 3
        torch.testing.assert_close(prior.energy(latent), expected)
        assert prior.energy(latent).dtype == torch.float32
        assert not list(prior.parameters())


def test_a_moving_obstacle() -> None:
    """The displacement moves the region: energies of latents that move along stay."""
    prior = RegionPrior(BALL, "out", sharpness=3.0, task_key="obstacle")
    still = RegionPrior(BALL, "out", sharpness=3.0)
    shift = torch.randn(4, 5, 2)
    latent = torch.randn(4, 5, 2)
    torch.testing.assert_close(prior.energy(latent + shift, {"obstacle": shift}), still.energy(latent))
    steps = prior.along({"obstacle": shift}, batch_ndim=1, horizon=3)
    torch.testing.assert_close(prior.energy(latent[:, :3] + shift[:, :3], steps), still.energy(latent[:, :3]))
    with pytest.raises(ValueError, match="task must be given to RegionPrior"):
        prior()
    with pytest.raises(ValueError, match=r"task must be a displacement of shape \(\*B, 2\), got \(3,\)"):
        prior(torch.zeros(3))


def test_as_a_chance_constraint() -> None:
    prior = RegionPrior(BALL, "out", sharpness=3.0)
    latents = torch.full((4, 3, 2), 9.0)
    latents[0, 1] = torch.tensor([1.0, 0.0])
    constraint = ChanceConstraint(prior.violated, delta=0.1)
    assert constraint(latents, torch.zeros(4, 3, 1)).item() == pytest.approx(0.25)
    moving = RegionPrior(BALL, "out", sharpness=3.0, task_key="obstacle")
    shift = torch.tensor([[0.0, 0.0], [50.0, 0.0], [0.0, 0.0]])  # away at the step that violated
    constraint = ChanceConstraint(partial(moving.violated, task=shift), delta=0.1)
    assert constraint(latents, torch.zeros(4, 3, 1)).item() == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_copies_casts_and_vmap(dtype: torch.dtype) -> None:
    prior = RegionPrior(BALL, "in", sharpness=3.0, probe=(torch.randn(2, 3), torch.zeros(2))).to(dtype)
    latent = torch.randn(5, 4, 3, dtype=dtype, requires_grad=True)
    energy = prior.energy(latent)
    assert energy.dtype == dtype
    assert torch.autograd.grad(energy.sum(), latent)[0].any(-1).all()
    torch.testing.assert_close(torch.func.vmap(prior.energy)(latent), energy)
    for twin in (copy.deepcopy(prior), pickle.loads(pickle.dumps(prior))):
        assert torch.equal(twin.energy(latent), energy)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"keep": "near"}, "keep must be 'in' or 'out', got 'near'"),
        ({"sharpness": 0.0}, "sharpness must be positive and finite, got 0.0"),
        ({"sharpness": INF}, "sharpness must be positive and finite"),
        ({"probe": torch.eye(3)}, r"probe must give the 2 coordinates of the region, got matrix \(3, 3\)"),
        ({"probe": (torch.full((2, 2), math.nan), 0.0)}, "matrix must be a finite tensor"),
    ],
)
def test_bad_priors_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RegionPrior(BALL, **{"keep": "in", "sharpness": 1.0, **arguments})


def test_a_latent_of_another_size_is_refused() -> None:
    prior = RegionPrior(BALL, "in", sharpness=1.0)
    for call in (prior.energy, prior.violated, prior().log_prob):
        with pytest.raises(ValueError, match="latent must have last dimension 2"):
            call(torch.zeros(4, 3))
