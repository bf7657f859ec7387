"""Moments, entropy, effective rank and the sliced distance against NumPy and closed forms."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.distributions import MultivariateNormal

from torchrl_vjepa.statistics import (
    effective_rank,
    gaussian_entropy,
    masked_moments,
    sliced_gaussian_distance,
)

FUNCTIONS = [effective_rank, gaussian_entropy, lambda x, mask=None: masked_moments(x, mask)[1]]


def _with_spectrum(values: list[float], num: int = 400) -> Tensor:
    """Float64 samples whose population covariance is exactly diagonal with these eigenvalues."""
    x = torch.randn(num, len(values), dtype=torch.float64)
    x = x - x.mean(0)
    root = torch.linalg.cholesky(x.mT @ x / num)
    return torch.linalg.solve_triangular(root, x.mT, upper=False).mT * torch.tensor(values).sqrt()


def _rotation(dim: int) -> Tensor:
    return torch.linalg.qr(torch.randn(dim, dim, dtype=torch.float64)).Q


# --- moments


@pytest.mark.parametrize("shape", [(1, 3), (7, 1), (50, 4), (5, 6, 3), (2, 3, 4, 2)])
@pytest.mark.parametrize("keepdim", [False, True])
def test_moments_equal_numpy(shape: tuple[int, ...], keepdim: bool) -> None:
    x = torch.randn(shape, dtype=torch.float64) * 3 + 5
    mean, covariance = masked_moments(x)
    rows = x.reshape(-1, shape[-1]).numpy()
    np.testing.assert_allclose(mean, rows.mean(0), atol=1e-12)
    np.testing.assert_allclose(
        covariance, np.cov(rows, rowvar=False, bias=True).reshape(covariance.shape), atol=1e-12
    )

    mask = torch.rand(shape[:-1]) < 0.6
    mask[(0,) * mask.ndim] = True
    kept = x[mask].numpy()
    garbage = torch.where(mask.unsqueeze(-1), x, math.nan)
    mean, covariance = masked_moments(garbage, mask.unsqueeze(-1) if keepdim else mask)
    np.testing.assert_allclose(mean, kept.mean(0), atol=1e-12)
    np.testing.assert_allclose(
        covariance, np.cov(kept, rowvar=False, bias=True).reshape(covariance.shape), atol=1e-12
    )


@pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e30])
def test_masked_rows_get_no_gradient_and_change_nothing(garbage: float) -> None:
    x = torch.randn(6, 3, dtype=torch.float64)
    mask = torch.tensor([False, True, True, False, True, True])
    x[~mask] = garbage
    x.requires_grad_()
    mean, covariance = masked_moments(x, mask)
    (mean.sum() + covariance.square().sum()).backward()
    assert x.grad is not None
    assert (x.grad[~mask] == 0).all()
    assert (x.grad[mask] != 0).all()
    assert torch.isfinite(x.grad).all()


def test_moments_are_differentiable() -> None:
    x = torch.randn(5, 2, dtype=torch.float64, requires_grad=True)
    mask = torch.tensor([True, True, False, True, True])
    assert torch.autograd.gradcheck(lambda x: masked_moments(x), (x,))
    assert torch.autograd.gradcheck(lambda x: masked_moments(x, mask), (x,))


def test_a_large_offset_costs_no_digits() -> None:
    small = torch.randint(-8, 8, (200, 3)).float() / 8
    expected = masked_moments(small.double())[1]
    mask = torch.ones(200, dtype=torch.bool)
    for extra in ((), (mask,)):
        covariance = masked_moments(small + 1e5, *extra)[1]  # exact in float32
        torch.testing.assert_close(covariance.double(), expected, rtol=1e-5, atol=1e-6)


def test_half_precision_and_autocast_compute_in_float32() -> None:
    x = torch.randn(64, 4)
    reference = masked_moments(x)[1]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(masked_moments(x)[1], reference)
    for dtype in (torch.float16, torch.bfloat16):
        covariance = masked_moments(x.to(dtype))[1]
        assert covariance.dtype == torch.float32
        assert torch.equal(covariance, masked_moments(x.to(dtype).float())[1])


def test_an_empty_selection_gives_zero_moments() -> None:
    mean, covariance = masked_moments(torch.full((4, 2), math.nan), torch.zeros(4).bool())
    assert (mean == 0).all()
    assert (covariance == 0).all()


@pytest.mark.parametrize("function", FUNCTIONS)
def test_bad_input_is_refused(function: Callable[..., Tensor]) -> None:
    x = torch.zeros(4, 5, 2)
    with pytest.raises(TypeError, match=r"floating point, got torch\.int64"):
        function(x.long())
    for empty in (torch.zeros(0, 2), torch.zeros(3, 0), torch.tensor(1.0)):
        with pytest.raises(ValueError, match=r"shape \(\*B, D\)"):
            function(empty)
    with pytest.raises(TypeError, match="mask must be boolean"):
        function(x, torch.ones(4, 5))
    for shape in ((4,), (5, 4), (4, 5, 2), (20,)):
        with pytest.raises(ValueError, match=r"mask must have shape \(4, 5\) or \(4, 5, 1\)"):
            function(x, torch.ones(shape, dtype=torch.bool))


# --- entropy


def test_entropy_equals_torch_distributions() -> None:
    x = _with_spectrum([3.0, 0.5, 1e-2]) @ _rotation(3)
    expected = MultivariateNormal(torch.zeros(3).double(), masked_moments(x)[1]).entropy()
    torch.testing.assert_close(gaussian_entropy(x, eps=1e-12), expected)
    mask = torch.rand(len(x)) < 0.5
    x[~mask] = math.nan
    expected = MultivariateNormal(torch.zeros(3).double(), masked_moments(x[mask])[1]).entropy()
    torch.testing.assert_close(gaussian_entropy(x, mask, eps=1e-12), expected)


def test_entropy_of_scaled_latents_grows_by_the_log_of_the_scale() -> None:
    x = torch.randn(100, 4, dtype=torch.float64)
    grown = gaussian_entropy(x * 10, eps=1e-12) - gaussian_entropy(x, eps=1e-12)
    torch.testing.assert_close(grown.item(), 4 * math.log(10))


@pytest.mark.parametrize("eps", [1e-6, 0.3])
def test_eps_is_a_variance_added_to_every_direction(eps: float) -> None:
    x = _with_spectrum([2.0, 1.0, 0.0])
    expected = sum(0.5 * math.log(2 * math.pi * math.e * (v + eps)) for v in (2.0, 1.0, 0.0))
    assert gaussian_entropy(x, eps=eps).item() == pytest.approx(expected, abs=1e-6)


def test_entropy_gradient_equals_the_inverse_covariance() -> None:
    x = torch.randn(30, 3, dtype=torch.float64, requires_grad=True)
    gaussian_entropy(x, eps=0.1).backward()
    mean, covariance = masked_moments(x.detach())
    inverse = torch.linalg.inv(covariance + 0.1 * torch.eye(3))
    torch.testing.assert_close(x.grad, (x.detach() - mean) @ inverse / 30)


def test_entropy_and_its_gradient_stay_finite_when_latents_collapse() -> None:
    direction = torch.randn(64, 1) @ torch.ones(1, 8)  # repeated eigenvalues, rank one
    for x in (torch.full((64, 8), 3.0), direction, direction * 1e-8):
        x = x.clone().requires_grad_()
        entropy = gaussian_entropy(x)
        entropy.backward()
        assert entropy >= 0.5 * 8 * math.log(2 * math.pi * math.e * 1e-6) - 1e-4
        assert torch.isfinite(x.grad).all()


@pytest.mark.parametrize("eps", [0.0, -1e-6, math.nan, math.inf])
def test_entropy_refuses_eps(eps: float) -> None:
    with pytest.raises(ValueError, match="eps must be positive and finite"):
        gaussian_entropy(torch.zeros(3, 2), eps=eps)


# --- effective rank


@pytest.mark.parametrize(
    "spectrum", [[1.0], [1.0, 1.0, 1.0], [4.0, 2.0, 1.0, 1e-3], [1.0, 0.0], [5.0, 5.0, 0.0]]
)
def test_effective_rank_is_the_exponential_entropy_of_the_spectrum(spectrum: list[float]) -> None:
    share = np.array([v for v in spectrum if v]) / sum(spectrum)
    expected = math.exp(-(share * np.log(share)).sum())
    assert effective_rank(_with_spectrum(spectrum)).item() == pytest.approx(expected, rel=1e-6)


@given(
    dim=st.integers(1, 6),
    num=st.integers(2, 40),
    scale=st.floats(1e-6, 1e6),
    shift=st.floats(-10, 10),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=40)
def test_effective_rank_bounds_and_invariance(
    dim: int, num: int, scale: float, shift: float, seed: int
) -> None:
    torch.manual_seed(seed)
    x = torch.randn(num, dim, dtype=torch.float64) * torch.rand(dim) ** 3
    rank = effective_rank(x).item()
    assert 1 <= rank <= min(dim, num) + 1e-9
    moved = (x @ _rotation(dim) + shift)[torch.randperm(num)][:, torch.randperm(dim)]
    assert effective_rank(moved * scale).item() == pytest.approx(rank, rel=1e-6)
    assert 1 <= effective_rank(x.float() * scale).item() <= dim


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_effective_rank_of_isotropic_latents_is_their_dimension(dtype: torch.dtype) -> None:
    for dim in range(1, 24):
        corners = torch.eye(dim, dtype=dtype)
        rank = effective_rank(torch.cat([corners, -corners])).item()
        assert dim - 1e-4 <= rank <= dim


@pytest.mark.parametrize("value", [0.0, 0.1, -1e6, 12345.678])
def test_effective_rank_of_constant_latents_is_zero(value: float) -> None:
    x = torch.full((37, 3), value)
    mask = torch.arange(37) % 3 == 1
    assert effective_rank(x).item() == 0
    x[~mask] = math.nan
    assert effective_rank(x, mask).item() == 0
    assert effective_rank(x, torch.zeros_like(mask)).item() == 0
    assert effective_rank(torch.randn(1, 3)).item() == 0


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_values_that_are_not_finite_come_out_as_nan(function: Callable[..., Tensor], bad: float) -> None:
    x = torch.randn(9, 4)  # from dimension 3 on, eigvalsh itself raises
    x[2, 1] = bad
    assert function(x).isnan().any()


# --- several runs at once, and compiled


@pytest.mark.parametrize("function", FUNCTIONS)
def test_vmap_equals_a_loop(function: Callable[..., Tensor]) -> None:
    x = torch.randn(3, 8, 5, 4, dtype=torch.float64)
    mask = torch.rand(3, 8, 5) < 0.7
    x[~mask] = math.nan
    mapped = torch.func.vmap(function)(x, mask)
    torch.testing.assert_close(mapped, torch.stack([function(*a) for a in zip(x, mask, strict=True)]))
    x = x.nan_to_num()
    mapped = torch.func.vmap(function)(x)
    torch.testing.assert_close(mapped, torch.stack([function(a) for a in x]))
    shared = torch.func.vmap(function, in_dims=(0, None))(x, mask[0])
    torch.testing.assert_close(shared, torch.stack([function(a, mask[0]) for a in x]))


def test_vmap_of_the_gradient_equals_a_loop() -> None:
    x = torch.randn(3, 12, 2, dtype=torch.float64)
    mask = torch.rand(3, 12) < 0.7
    gradient = torch.func.grad(gaussian_entropy)
    mapped = torch.func.vmap(gradient)(x, mask)
    torch.testing.assert_close(mapped, torch.stack([gradient(*a) for a in zip(x, mask, strict=True)]))


@pytest.mark.parametrize("function", FUNCTIONS)
def test_compiles_into_one_graph(function: Callable[..., Tensor]) -> None:
    x = torch.randn(8, 5, 4)
    mask = torch.rand(8, 5) < 0.7
    compiled = torch.compile(function, backend="eager", fullgraph=True)
    torch.testing.assert_close(compiled(x, mask), function(x, mask))


# --- the sliced distance

NULL = 1 - 1 / math.sqrt(3)  # n times the mean for samples of N(0, I)


def _epps_pulley(x: Tensor) -> Tensor:
    """The integral in closed form, for samples (n,) of one projection: O(n^2)."""
    pairs = torch.exp(-0.5 * (x[:, None] - x[None, :]).square()).mean()
    return pairs - math.sqrt(2) * torch.exp(-0.25 * x.square()).mean() + 1 / math.sqrt(3)


@pytest.mark.parametrize(("shift", "scale"), [(0.0, 1.0), (0.0, 0.0), (2.0, 0.3), (-1.0, 3.0)])
def test_sliced_distance_equals_the_closed_form_in_one_dimension(shift: float, scale: float) -> None:
    """The only slice of a line is the line itself."""
    x = (shift + scale * torch.randn(60, dtype=torch.float64)).unsqueeze(-1)
    ours = sliced_gaussian_distance(x, num_slices=3, num_points=40)
    torch.testing.assert_close(ours, _epps_pulley(x[:, 0]), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(sliced_gaussian_distance(x), ours, rtol=1e-3, atol=1e-5)


def test_sliced_distance_is_the_mean_over_the_drawn_directions() -> None:
    x = torch.randn(50, 4, dtype=torch.float64) @ torch.randn(4, 4, dtype=torch.float64) + 1
    ours = sliced_gaussian_distance(x, num_slices=9, generator=torch.Generator().manual_seed(3))
    directions = torch.randn(4, 9, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    each = [_epps_pulley(x @ a / a.norm()) for a in directions.unbind(1)]
    torch.testing.assert_close(ours, torch.stack(each).mean(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("dim", [1, 2, 32])
def test_sliced_distance_vanishes_for_the_unit_gaussian_alone(dim: int) -> None:
    """Mean (1 - 3^-1/2) / n under the unit Gaussian: zero in the limit."""
    for n in (20, 200):
        generator = torch.Generator().manual_seed(dim + n)
        draws = torch.randn(200, n, dim, generator=generator, dtype=torch.float64)
        options = {"num_slices": 8, "generator": generator}
        values = torch.stack([sliced_gaussian_distance(x, **options) for x in draws])
        assert abs(values.mean() - NULL / n) < 4 * values.std() / math.sqrt(len(values))


@pytest.mark.parametrize(
    "kind", ["collapsed", "one direction", "narrow", "wide", "shifted", "signs", "uniform"]
)
def test_sliced_distance_sees_what_is_not_a_unit_gaussian(kind: str) -> None:
    """Also where mean and covariance are those of the unit Gaussian: the moment form sees nothing there."""
    n, dim = 4000, 2
    x = torch.randn(n, dim, dtype=torch.float64)
    latents = {
        "collapsed": 0 * x,
        "one direction": x * torch.tensor([1.0, 0.0]),
        "narrow": 0.5 * x,
        "wide": 2 * x,
        "shifted": x + torch.tensor([0.5, 0.0]),
        "signs": x.sign(),
        "uniform": math.sqrt(3) * (2 * torch.rand(n, dim, dtype=torch.float64) - 1),
    }[kind]
    values = [sliced_gaussian_distance(latents).item() for _ in range(3)]
    assert min(values) > 5 * NULL / n
    if kind == "collapsed":
        expected = 1 - math.sqrt(2) + 1 / math.sqrt(3)
        assert values == pytest.approx([expected] * 3, abs=1e-5)


def test_sliced_distance_pushes_a_collapsed_batch_apart() -> None:
    """Descent from a nearly collapsed batch ends at a round one of unit scale."""
    x = (1e-2 * torch.randn(200, 4, dtype=torch.float64)).requires_grad_()
    (gradient,) = torch.autograd.grad(sliced_gaussian_distance(x), x)
    step = -(gradient - gradient.mean(0))
    assert (step * (x - x.mean(0))).sum() > 0  # outwards
    optimizer = torch.optim.Adam([x], 0.05)
    for _ in range(100):
        optimizer.zero_grad()
        sliced_gaussian_distance(x).backward()
        optimizer.step()
    mean, covariance = masked_moments(x.detach())
    torch.testing.assert_close(covariance, torch.eye(4, dtype=torch.float64), rtol=0, atol=0.25)
    assert mean.abs().max() < 0.2
    assert sliced_gaussian_distance(x) < 2 * NULL / 200


def test_sliced_distance_is_differentiable() -> None:
    x = torch.randn(6, 3, dtype=torch.float64, requires_grad=True)
    mask = torch.tensor([True, False, True, True, True, False])

    def value(x: Tensor) -> Tensor:
        return sliced_gaussian_distance(x, mask, generator=torch.Generator().manual_seed(0))

    assert torch.autograd.gradcheck(value, [x])


@pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e30])
@pytest.mark.parametrize("keepdim", [False, True])
def test_sliced_distance_of_masked_rows_is_that_of_the_others(garbage: float, keepdim: bool) -> None:
    x = torch.randn(5, 6, 3, dtype=torch.float64)
    mask = torch.rand(5, 6) < 0.6
    spoilt = torch.where(mask.unsqueeze(-1), x, garbage).requires_grad_()
    generators = [torch.Generator().manual_seed(1) for _ in range(2)]
    ours = sliced_gaussian_distance(spoilt, mask.unsqueeze(-1) if keepdim else mask, generator=generators[0])
    torch.testing.assert_close(ours, sliced_gaussian_distance(x[mask], generator=generators[1]))
    ours.backward()
    assert not spoilt.grad[~mask].any()
    assert spoilt.grad[mask].all()
    assert sliced_gaussian_distance(spoilt, torch.zeros_like(mask)) == 0


def test_sliced_distance_draws_from_the_given_generator_alone() -> None:
    x = torch.randn(20, 5)
    state = torch.get_rng_state()
    values = [sliced_gaussian_distance(x, generator=torch.Generator().manual_seed(s)) for s in (0, 0, 1)]
    assert torch.equal(torch.get_rng_state(), state)
    assert values[0] == values[1] != values[2]
    assert sliced_gaussian_distance(x) != sliced_gaussian_distance(x)


@pytest.mark.parametrize("masked", [False, True])
def test_vmap_of_the_sliced_distance_equals_a_loop(masked: bool) -> None:
    """The maps share the directions: adding a run changes no other."""
    x = torch.randn(3, 8, 5, 4, dtype=torch.float64)
    arguments = (x, torch.rand(3, 8, 5) < 0.7) if masked else (x,)
    torch.manual_seed(5)
    mapped = torch.func.vmap(sliced_gaussian_distance, randomness="same")(*arguments)
    for i in range(3):
        torch.manual_seed(5)
        torch.testing.assert_close(sliced_gaussian_distance(*[a[i] for a in arguments]), mapped[i])


def test_sliced_distance_in_half_precision_and_compiled() -> None:
    x = torch.randn(40, 4)
    torch.manual_seed(5)
    exact = sliced_gaussian_distance(x)
    torch.manual_seed(5)
    half = sliced_gaussian_distance(x.bfloat16())
    assert half.dtype == torch.float32
    torch.testing.assert_close(half, exact, rtol=0.05, atol=1e-4)
    torch.manual_seed(5)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        torch.testing.assert_close(sliced_gaussian_distance(x), exact)
    torch.manual_seed(5)
    mask = torch.ones(40, dtype=torch.bool)
    compiled = torch.compile(sliced_gaussian_distance, backend="eager", fullgraph=True)
    torch.testing.assert_close(compiled(x, mask), exact)


def test_sliced_distance_refuses_bad_input() -> None:
    x = torch.randn(4, 3)
    with pytest.raises(ValueError, match="num_slices must be at least 1, got 0"):
        sliced_gaussian_distance(x, num_slices=0)
    with pytest.raises(ValueError, match="num_points must be at least 2, got 1"):
        sliced_gaussian_distance(x, num_points=1)
    with pytest.raises(TypeError, match="floating point"):
        sliced_gaussian_distance(x.long())
    with pytest.raises(ValueError, match="mask must have shape"):
        sliced_gaussian_distance(x, torch.ones(3, dtype=torch.bool))
    assert sliced_gaussian_distance(x / 0.0 * 0.0).isnan()
