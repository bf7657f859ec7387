"""Moments, Gaussian entropy and effective rank against NumPy, closed forms and invariances."""

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

from torchrl_vjepa.statistics import effective_rank, gaussian_entropy, masked_moments

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
