"""Delta, the diagonal Gaussian and draws from one's own generator, against closed forms and torch."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.distributions import (
    Beta,
    Categorical,
    Distribution,
    Exponential,
    Independent,
    LowRankMultivariateNormal,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
    TransformedDistribution,
)
from torch.distributions.transforms import ExpTransform

from torchrl_vjepa.distributions import Delta, diag_gaussian, point_estimate, sample

DRAWS = 200_000


def _mixture(dtype: torch.dtype = torch.float64) -> MixtureSameFamily:
    loc = torch.tensor([[-2.0, 1.0], [3.0, 0.0]], dtype=dtype)
    scale = torch.tensor([[0.5, 1.0], [1.0, 2.0]], dtype=dtype)
    return MixtureSameFamily(
        Categorical(torch.tensor([0.25, 0.75], dtype=dtype)), Independent(Normal(loc, scale), 1)
    )


def _low_rank() -> LowRankMultivariateNormal:
    return LowRankMultivariateNormal(
        torch.tensor([1.0, -1.0], dtype=torch.float64),
        torch.tensor([[2.0], [1.0]], dtype=torch.float64),
        torch.tensor([0.5, 0.1], dtype=torch.float64),
    )


def _gaussian() -> Independent:
    return diag_gaussian(torch.tensor([0.5, -3.0]).double(), torch.tensor([0.1, 2.0]).double())


def _flow() -> TransformedDistribution:
    """Has no mean in torch."""
    return TransformedDistribution(_gaussian(), [ExpTransform()])


def _beta() -> Independent:
    """An Independent whose base is not Gaussian."""
    return Independent(Beta(torch.tensor([2.0, 0.5]).double(), torch.tensor([1.0, 3.0]).double()), 1)


ALL = [_gaussian, _mixture, _low_rank, _beta, _flow]
WITH_MOMENTS = [_gaussian, _mixture, _low_rank, _beta]


class TestDelta:
    @pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
    def test_shapes_and_moments(self, batch: tuple[int, ...]) -> None:
        loc = torch.randn(*batch, 4)
        p = Delta(loc)
        assert p.batch_shape == batch
        assert p.event_shape == (4,)
        assert torch.equal(p.mean, loc)
        assert torch.equal(p.mode, loc)
        assert torch.equal(p.variance, torch.zeros(*batch, 4))
        assert torch.equal(p.stddev, torch.zeros(*batch, 4))

    @pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
    def test_keeps_the_dtype(self, dtype: torch.dtype) -> None:
        p = Delta(torch.zeros(2, 3, dtype=dtype))
        for value in (p.mean, p.mode, p.variance, p.stddev, p.sample(), p.rsample()):
            assert value.dtype == dtype

    def test_samples_are_the_point_and_only_rsample_has_a_gradient(self) -> None:
        loc = torch.randn(2, 3, requires_grad=True)
        p = Delta(loc)
        assert p.has_rsample
        drawn = p.sample((5,))
        assert not drawn.requires_grad
        assert torch.equal(drawn, loc.detach().expand(5, 2, 3))
        weight = torch.randn(5, 2, 3)
        (p.rsample((5,)) * weight).sum().backward()
        torch.testing.assert_close(loc.grad, weight.sum(0))

    def test_log_prob_is_infinite_at_the_point_only(self) -> None:
        p = Delta(torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
        values = torch.tensor([[1.0, 2.0], [3.0, 4.1]])
        assert p.log_prob(values).tolist() == [math.inf, -math.inf]

    def test_expand(self) -> None:
        loc = torch.randn(1, 3)
        p = Delta(loc).expand((4, 2))
        assert type(p) is Delta
        assert p.batch_shape == (4, 2)
        assert p.event_shape == (3,)
        assert torch.equal(p.mean, loc.expand(4, 2, 3))
        assert p.variance.shape == (4, 2, 3)
        assert Delta(loc).expand(torch.Size([1])).batch_shape == (1,)

    def test_support_is_the_whole_space(self) -> None:
        support = Delta(torch.zeros(3)).support
        assert support.event_dim == 1
        assert support.check(torch.randn(5, 3)).all()

    def test_pickles_and_copies(self) -> None:
        p = Delta(torch.randn(2, 3))
        for twin in (pickle.loads(pickle.dumps(p)), copy.deepcopy(p)):
            assert torch.equal(twin.mean, p.mean)
            assert torch.equal(twin.variance, p.variance)

    def test_vmap(self) -> None:
        loc = torch.randn(5, 3)
        mean, variance = torch.func.vmap(lambda x: (Delta(x).mean, Delta(x).variance))(loc)
        assert torch.equal(mean, loc)
        assert torch.equal(variance, torch.zeros(5, 3))


class TestDiagGaussian:
    @pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
    def test_equals_the_multivariate_normal(self, batch: tuple[int, ...]) -> None:
        loc = torch.randn(*batch, 4, dtype=torch.float64)
        scale = torch.rand(*batch, 4, dtype=torch.float64) + 0.1
        p = diag_gaussian(loc, scale)
        q = MultivariateNormal(loc, torch.diag_embed(scale**2))
        value = torch.randn(*batch, 4, dtype=torch.float64)
        assert p.batch_shape == q.batch_shape
        assert p.event_shape == q.event_shape
        for name in ("mean", "mode", "variance"):
            torch.testing.assert_close(getattr(p, name), getattr(q, name))
        torch.testing.assert_close(p.log_prob(value), q.log_prob(value))
        torch.testing.assert_close(p.entropy(), q.entropy())

    def test_broadcasts_both_ways(self) -> None:
        assert diag_gaussian(torch.zeros(5, 3), torch.ones(3)).batch_shape == (5,)
        assert diag_gaussian(torch.zeros(3), torch.ones(5, 3)).mean.shape == (5, 3)
        assert diag_gaussian(torch.zeros(3), torch.ones(())).event_shape == (3,)

    @pytest.mark.parametrize(
        ("loc", "scale", "expected"),
        [
            (torch.bfloat16, torch.float32, torch.float32),
            (torch.float32, torch.bfloat16, torch.float32),
            (torch.float32, torch.float64, torch.float64),
            (torch.bfloat16, torch.bfloat16, torch.bfloat16),
        ],
    )
    def test_dtypes_are_joined(self, loc: torch.dtype, scale: torch.dtype, expected: torch.dtype) -> None:
        p = diag_gaussian(torch.zeros(2, 3, dtype=loc), torch.ones(3, dtype=scale))
        assert p.mean.dtype == p.variance.dtype == expected
        assert p.sample((4,)).dtype == p.rsample().dtype == expected
        assert sample(p, generator=torch.Generator()).dtype == expected
        assert p.log_prob(p.mean).dtype == expected

    def test_does_not_look_at_values(self) -> None:
        p = diag_gaussian(torch.tensor([torch.nan, 0.0]), torch.tensor([1.0, -1.0]))
        assert p.log_prob(torch.full((2,), torch.nan)).isnan()

    def test_vmap_over_its_parameters(self) -> None:
        loc, scale, value = torch.randn(6, 3), torch.rand(6, 3) + 0.1, torch.randn(3)
        batched = torch.func.vmap(lambda m, s: diag_gaussian(m, s).log_prob(value))(loc, scale)
        torch.testing.assert_close(batched, diag_gaussian(loc, scale).log_prob(value))


class TestSample:
    @pytest.mark.parametrize("make", ALL)
    @pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
    def test_generator_decides_and_the_global_state_stays(
        self, make: Callable[[], Distribution], shape: tuple[int, ...]
    ) -> None:
        p = make()
        before = torch.get_rng_state()
        generator = torch.Generator().manual_seed(3)
        first = sample(p, shape, generator=generator)
        second = sample(p, shape, generator=generator)
        assert torch.equal(before, torch.get_rng_state())
        assert first.shape == (*shape, 2)
        assert not torch.equal(first, second)
        torch.manual_seed(99)  # the global state must not matter either
        generator.manual_seed(3)
        assert torch.equal(first, sample(p, shape, generator=generator))
        assert torch.equal(second, sample(p, shape, generator=generator))
        assert not torch.equal(first, sample(p, shape, generator=generator.manual_seed(4)))

    @pytest.mark.parametrize("make", ALL)
    def test_without_a_generator_it_is_torch(self, make: Callable[[], Distribution]) -> None:
        p = make()
        torch.manual_seed(5)
        expected = p.sample((3,))
        torch.manual_seed(5)
        assert torch.equal(sample(p, (3,)), expected)

    @pytest.mark.parametrize("make", WITH_MOMENTS)
    @pytest.mark.parametrize("own", [True, False])
    def test_moments(self, make: Callable[[], Distribution], own: bool) -> None:
        p = make()
        drawn = sample(p, (DRAWS,), generator=torch.Generator().manual_seed(1) if own else None)
        error = (p.variance / DRAWS).sqrt()
        assert ((drawn.mean(0) - p.mean).abs() < 5 * error).all()
        squared = (drawn - p.mean) ** 2
        assert ((squared.mean(0) - p.variance).abs() < 5 * squared.std(0) / DRAWS**0.5).all()

    def test_dimensions_and_draws_are_independent(self) -> None:
        p = diag_gaussian(torch.zeros(2, 2), torch.ones(2, 2))
        drawn = sample(p, (DRAWS,), generator=torch.Generator().manual_seed(0)).reshape(DRAWS, 4)
        covariance = drawn.mT @ drawn / DRAWS
        bound = 5 * (torch.eye(4) + 1).sqrt() / DRAWS**0.5
        assert ((covariance - torch.eye(4)).abs() < bound).all()
        assert (drawn[1:] * drawn[:-1]).mean(0).abs().max() < 5 / DRAWS**0.5

    @pytest.mark.parametrize("own", [True, False])
    @pytest.mark.parametrize("kind", ["gaussian", "delta", "exponential"])
    def test_draws_carry_no_gradient(self, own: bool, kind: str) -> None:
        loc = torch.ones(2, 3, requires_grad=True)
        p = {
            "gaussian": diag_gaussian(loc, loc),
            "delta": Delta(loc),
            "exponential": Independent(Exponential(loc), 1),
        }[kind]
        drawn = sample(p, (4,), generator=torch.Generator() if own else None)
        assert drawn.shape == (4, 2, 3)
        assert not drawn.requires_grad

    def test_a_point_consumes_no_randomness(self) -> None:
        generator = torch.Generator().manual_seed(0)
        before = generator.get_state()
        loc = torch.randn(2, 3)
        assert torch.equal(sample(Delta(loc), (4,), generator=generator), loc.expand(4, 2, 3))
        assert torch.equal(before, generator.get_state())

    @pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
    def test_keeps_the_dtype(self, dtype: torch.dtype) -> None:
        p = diag_gaussian(torch.zeros(3, dtype=dtype), torch.ones(3, dtype=dtype))
        assert sample(p, (2,), generator=torch.Generator()).dtype == dtype

    @pytest.mark.parametrize("make", [_mixture, _flow])
    def test_other_devices_are_not_seeded(
        self, make: Callable[[], Distribution], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """``torch.manual_seed`` would restart the accelerators' generators, which nothing restores."""
        seeded: list[int] = []
        monkeypatch.setattr(torch.cuda, "manual_seed_all", seeded.append)
        monkeypatch.setattr(torch.cuda, "manual_seed", seeded.append)
        sample(make(), generator=torch.Generator())
        assert seeded == []

    def test_the_state_is_restored_after_an_error(self) -> None:
        class Broken(Distribution):
            arg_constraints: dict[str, object] = {}

            def sample(self, sample_shape: torch.Size = torch.Size()) -> Tensor:  # noqa: B008 (the signature of torch)
                torch.rand(3)
                raise RuntimeError("broken")

        before = torch.get_rng_state()
        with pytest.raises(RuntimeError, match="broken"):
            sample(Broken(), generator=torch.Generator())
        assert torch.equal(before, torch.get_rng_state())

    @pytest.mark.parametrize("kind", ["gaussian", "exponential"])
    def test_refuses_a_generator_of_another_device(self, kind: str) -> None:
        ones = torch.ones(3, device="meta")
        p = {
            "gaussian": diag_gaussian(ones, ones),
            "exponential": Independent(Exponential(ones, validate_args=False), 1, validate_args=False),
        }[kind]
        with pytest.raises(ValueError, match="generator must be on the device of the distribution, meta"):
            sample(p, generator=torch.Generator())


class TestPointEstimate:
    def test_mean_and_mode_differ_where_they_should(self) -> None:
        p = Independent(Beta(torch.tensor([2.0, 3.0]), torch.tensor([5.0, 2.0])), 1)
        torch.testing.assert_close(point_estimate(p), torch.tensor([2 / 7, 3 / 5]))
        torch.testing.assert_close(point_estimate(p, "mean"), torch.tensor([2 / 7, 3 / 5]))
        torch.testing.assert_close(point_estimate(p, "mode"), torch.tensor([1 / 5, 2 / 3]))

    def test_sample_is_one_draw_of_the_generator(self) -> None:
        p = _gaussian()
        drawn = point_estimate(p, "sample", generator=torch.Generator().manual_seed(2))
        assert torch.equal(drawn, sample(p, generator=torch.Generator().manual_seed(2)))
        assert drawn.shape == (2,)

    @pytest.mark.parametrize("how", ["mean", "mode"])
    def test_keeps_gradients(self, how: str) -> None:
        loc = torch.randn(2, 3, requires_grad=True)
        for p in (Delta(loc), diag_gaussian(loc, torch.ones(3))):
            (gradient,) = torch.autograd.grad(point_estimate(p, how).sum(), loc)
            assert torch.equal(gradient, torch.ones(2, 3))

    @settings(max_examples=20)
    @given(st.text().filter(lambda text: text not in ("mean", "mode", "sample")))
    def test_unknown_names_are_refused(self, how: str) -> None:
        with pytest.raises(ValueError, match="how must be 'mean', 'mode' or 'sample', got"):
            point_estimate(Delta(torch.zeros(2)), how)
