"""Splines and flows: inverses, log-determinants against autograd, moments of affine flows."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchrl_vjepa.distributions import CouplingFlow, moments
from torchrl_vjepa.distributions.flows import normal_points
from torchrl_vjepa.distributions.splines import BOUND, MAX_SLOPE, spline, spline_size
from torchrl_vjepa.heads import FlowHead

SEEDS = st.integers(0, 10_000)


def flow(dim: int, *batch: int, num_layers: int = 3, num_points: int = 64, size: float = 1.0) -> CouplingFlow:
    head = FlowHead(num_layers, 8, 5, num_points=num_points)
    features = size * torch.randn(*batch, head.num_features(dim), dtype=torch.float64)
    constants = head.init_constants(dim).double()
    return head(features, constants + 0.5 * size * torch.randn_like(constants))


class TestSpline:
    @settings(max_examples=40)
    @given(SEEDS, st.integers(2, 12), st.floats(0.0, 20.0))
    def test_inverts_and_is_monotone(self, seed: int, num_bins: int, size: float) -> None:
        torch.manual_seed(seed)
        parameters = size * torch.randn(3, spline_size(num_bins), dtype=torch.float64)
        x = torch.linspace(-6, 6, 501, dtype=torch.float64).unsqueeze(-1).expand(501, 3)
        y, log_slope = spline(x, parameters)
        back, negative = spline(y, parameters, inverse=True)
        torch.testing.assert_close(back, x, rtol=0, atol=1e-8)
        torch.testing.assert_close(negative, -log_slope, rtol=0, atol=1e-6)
        assert (y.diff(dim=0) > 0).all()

    @settings(max_examples=20)
    @given(SEEDS)
    def test_slope_is_the_derivative(self, seed: int) -> None:
        torch.manual_seed(seed)
        parameters = torch.randn(1, spline_size(6), dtype=torch.float64)
        x = (5 * torch.rand(200, 1, dtype=torch.float64) - 2.5).requires_grad_()
        for inverse in (False, True):
            y, log_slope = spline(x, parameters, inverse=inverse)
            (slope,) = torch.autograd.grad(y.sum(), x)
            torch.testing.assert_close(slope.log(), log_slope)

    def test_zero_parameters_are_the_identity(self) -> None:
        x = torch.linspace(-6, 6, 101, dtype=torch.float64).unsqueeze(-1)
        y, log_slope = spline(x, torch.zeros(1, spline_size(5), dtype=torch.float64))
        torch.testing.assert_close(y, x)
        torch.testing.assert_close(log_slope, torch.zeros_like(x))

    def test_is_the_identity_outside_and_smooth_at_the_bound(self) -> None:
        parameters = torch.randn(1, spline_size(5), dtype=torch.float64)
        x = torch.tensor([-1e30, -BOUND - 1, -BOUND, BOUND, BOUND + 1, 1e30], dtype=torch.float64).unsqueeze(
            -1
        )
        y, log_slope = spline(x, parameters)
        torch.testing.assert_close(y, x)
        assert (log_slope.abs() < 1e-9).all()
        inside = torch.tensor([[-BOUND + 1e-7], [BOUND - 1e-7]], dtype=torch.float64)
        assert (spline(inside, parameters)[1].abs() < 1e-4).all()

    def test_slopes_are_bounded_for_any_parameters(self) -> None:
        for size in (1e2, 1e6, 1e30):
            parameters = (size * torch.randn(50, spline_size(8))).requires_grad_()
            y, log_slope = spline(torch.linspace(-5, 5, 50), parameters)
            assert y.isfinite().all()
            # A bin of the least width over one of nearly everything, bent by the steepest knots.
            assert (log_slope.exp() < 100 * MAX_SLOPE**2).all()
            (y.sum() + log_slope.sum()).backward()
            assert parameters.grad.isfinite().all()


class TestCouplingFlow:
    @settings(max_examples=15)
    @given(SEEDS, st.integers(1, 5), st.integers(0, 4))
    def test_inverse_is_exact(self, seed: int, dim: int, num_layers: int) -> None:
        torch.manual_seed(seed)
        p = flow(dim, 4, num_layers=num_layers)
        noise = torch.randn(20, 4, dim, dtype=torch.float64)
        back, log_det = p.to_noise(p.from_noise(noise))
        torch.testing.assert_close(back, noise, rtol=0, atol=1e-7)
        assert log_det.shape == (20, 4)

    @pytest.mark.parametrize("dim", [1, 2, 3, 4])
    def test_log_determinant_is_autograds(self, dim: int) -> None:
        p = flow(dim)
        z = p.sample((30,))
        jacobian = torch.func.vmap(torch.func.jacrev(lambda value: p.to_noise(value)[0]))(z)
        torch.testing.assert_close(p.to_noise(z)[1], torch.linalg.slogdet(jacobian)[1])

    def test_every_dimension_depends_on_every_noise(self) -> None:
        p = flow(4)
        noise = torch.randn(4, dtype=torch.float64)
        jacobian = torch.autograd.functional.jacobian(p.from_noise, noise)
        assert (jacobian != 0).all()

    def test_moments_of_an_affine_flow_are_exact(self) -> None:
        loc, scale = torch.randn(5, 3, dtype=torch.float64), torch.rand(5, 3, dtype=torch.float64) + 0.1
        p = CouplingFlow(loc, scale, torch.zeros(5, 3, spline_size(4), dtype=torch.float64), ())
        torch.testing.assert_close(p.mean, loc)
        torch.testing.assert_close(p.variance, scale**2)
        torch.testing.assert_close(moments(p)[1], torch.diag_embed(scale**2))

    def test_moments_are_deterministic_and_leave_the_random_state(self) -> None:
        p = flow(3, 4)
        before = torch.get_rng_state()
        assert torch.equal(p.mean, p.mean)
        normal_points.cache_clear()
        assert torch.equal(p.variance, p.variance)
        assert torch.equal(before, torch.get_rng_state())

    def test_more_points_are_more_accurate(self) -> None:
        errors = []
        for num_points in (8, 4096):
            torch.manual_seed(3)
            p = flow(2, 10, num_points=num_points)
            exact = p.sample((10_000,)).mean(0)
            errors.append(float((p.mean - exact).norm()))
        assert errors[1] < 0.5 * errors[0]

    def test_points_of_one_batch_serve_training_after_inference_mode(self) -> None:
        normal_points.cache_clear()
        with torch.inference_mode():
            assert flow(2, 3).mean.isfinite().all()
        head = FlowHead(1, 4, 4)
        features = torch.randn(3, head.num_features(2), dtype=torch.float64, requires_grad=True)
        head(features, head.init_constants(2).double()).mean.sum().backward()
        assert features.grad.isfinite().all()

    def test_mode_has_the_gradient_of_the_location(self) -> None:
        loc = torch.randn(2, dtype=torch.float64, requires_grad=True)
        p = CouplingFlow(loc, torch.ones(2).double(), torch.randn(2, spline_size(5)).double(), ())
        (gradient,) = torch.autograd.grad(p.mode.sum(), loc)
        torch.testing.assert_close(gradient, torch.ones(2).double())

    def test_pickles_and_copies(self) -> None:
        p = flow(3, 4)
        for twin in (pickle.loads(pickle.dumps(p)), copy.deepcopy(p)):
            assert torch.equal(twin.log_prob(p.loc), p.log_prob(p.loc))

    def test_number_of_points_is_checked(self) -> None:
        with pytest.raises(ValueError, match="num_points must be positive, got 0"):
            CouplingFlow(torch.zeros(2), torch.ones(2), torch.zeros(2, 5), (), num_points=0)


@pytest.mark.parametrize(("num", "dim"), [(1, 1), (64, 4), (5, 20)])
def test_points_have_zero_mean_and_unit_covariance(num: int, dim: int) -> None:
    points = normal_points(num, dim)
    assert len(points) >= max(num, 2 * dim)

    def close(value: Tensor, expected: Tensor) -> None:
        torch.testing.assert_close(value, expected.double(), rtol=0, atol=1e-9)

    close(points.mean(0), torch.zeros(dim))
    close(points.mT @ points / len(points), torch.eye(dim))
