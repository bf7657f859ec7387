"""The contract of every head, the soft clamp by its properties, the target scale by its definition."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from torchrl_vjepa.distributions import Delta, sample, soft_clamp
from torchrl_vjepa.heads import DeltaHead, DiagGaussianHead, Head, TargetScale
from torchrl_vjepa.predictor import Predictor

# One line per head, and every test of TestEveryHead runs for it.
HEADS: dict[str, Callable[[], Head]] = {
    "delta": DeltaHead,
    "diag_gaussian_state": DiagGaussianHead,
    "diag_gaussian_constant": lambda: DiagGaussianHead("constant"),
    "diag_gaussian_narrow": lambda: DiagGaussianHead(log_var_range=(-2.0, 1.0)),
}
D = 3

FLOATS = st.floats(-60.0, 60.0)
RANGES = st.tuples(st.floats(-20.0, 20.0), st.floats(0.5, 40.0)).map(lambda r: (r[0], r[0] + r[1]))


@pytest.fixture(params=list(HEADS))
def head(request: pytest.FixtureRequest) -> Head:
    return HEADS[request.param]()


def _inputs(head: Head, *batch: int, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    features = torch.randn(*batch, head.num_features(D)).to(dtype).requires_grad_()
    return features, torch.randn(head.num_constants(D)).to(dtype).requires_grad_()


class TestEveryHead:
    @pytest.mark.parametrize("batch", [(), (5,), (2, 4), (1, 0, 3)])
    def test_batch_and_event_shapes(self, head: Head, batch: tuple[int, ...]) -> None:
        p = head(*_inputs(head, *batch))
        assert p.batch_shape == batch
        assert p.event_shape == (D,)
        assert p.mean.shape == p.variance.shape == (*batch, D)
        assert p.sample((7,)).shape == p.rsample((7,)).shape == (7, *batch, D)
        if 0 not in batch:  # torch's Independent cannot sum an empty batch
            assert p.log_prob(p.mean).shape == batch
        assert sample(p, (7,), generator=torch.Generator()).shape == (7, *batch, D)

    def test_the_first_features_are_the_mean(self, head: Head) -> None:
        features, constants = _inputs(head, 4)
        assert head.num_features(D) >= D
        assert torch.equal(head(features, constants).mean, features[..., :D])

    def test_rows_are_independent(self, head: Head) -> None:
        features, constants = _inputs(head, 6)
        p, value = head(features, constants), torch.randn(6, D)
        for i in range(6):
            q = head(features[i], constants)
            torch.testing.assert_close(p.log_prob(value)[i], q.log_prob(value[i]))
            torch.testing.assert_close(p.variance[i], q.variance)

    @pytest.mark.parametrize("by", ["rsample", "log_prob"])
    def test_gradients_reach_every_feature_and_constant(self, head: Head, by: str) -> None:
        features, constants = _inputs(head, 5)
        p = head(features, constants)
        # A point has no density: its mean is what a squared loss trains.
        drawn = (
            p.log_prob(torch.randn(5, D)) if by == "log_prob" and not isinstance(p, Delta) else p.rsample()
        )
        (drawn * torch.randn(drawn.shape)).sum().backward()
        assert (features.grad != 0).all()
        if constants.numel():
            assert (constants.grad != 0).all()

    @pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
    def test_dtype_in_is_dtype_out(self, head: Head, dtype: torch.dtype) -> None:
        p = head(*_inputs(head, 4, dtype=dtype))
        for value in (p.mean, p.variance, p.sample(), p.rsample(), p.log_prob(p.mean)):
            assert value.dtype == dtype

    def test_features_of_autocast_meet_constants_in_full_precision(self, head: Head) -> None:
        features, _ = _inputs(head, 4, dtype=torch.bfloat16)
        _, constants = _inputs(head, 4)
        p = head(features, constants)
        assert p.sample((2,)).shape == (2, 4, D)
        assert p.rsample().isfinite().all()
        assert sample(p, generator=torch.Generator()).dtype == p.mean.dtype

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize("size", [1e3, 1e6])
    def test_extreme_features_stay_finite(self, head: Head, size: float, dtype: torch.dtype) -> None:
        features, constants = _inputs(head, 64, dtype=dtype)
        with torch.no_grad():
            features.copy_(features.sign() * size)
            constants.copy_(constants.sign() * size)
        p = head(features, constants)
        assert p.rsample().isfinite().all()
        assert p.variance.isfinite().all()
        if isinstance(p, Delta):
            return
        assert (p.variance > 0).all()
        log_prob = p.log_prob(torch.zeros(64, D, dtype=dtype))
        assert log_prob.isfinite().all()
        log_prob.sum().backward()
        assert features.grad.isfinite().all()
        if constants.numel():
            assert constants.grad.isfinite().all()

    def test_pickles_and_copies(self, head: Head) -> None:
        features, constants = _inputs(head, 4)
        p = head(features, constants)
        for twin in (pickle.loads(pickle.dumps(head)), copy.deepcopy(head)):
            q = twin(features, constants)
            assert torch.equal(p.mean, q.mean)
            assert torch.equal(p.variance, q.variance)

    def test_vmap_over_stacked_parameters_of_predictors(self, head: Head) -> None:
        models = []
        for _ in range(4):
            model = PredictedMoments(Predictor(D, 2, head=copy.deepcopy(head), skips=(1, 2)))
            nn.init.normal_(model.predictor.constants)
            models.append(model)
        parameters, buffers = torch.func.stack_module_state(models)
        latent, action, value = torch.randn(5, D), torch.randn(5, 2, 2), torch.randn(5, D)

        def one(parameters: dict[str, Tensor], buffers: dict[str, Tensor]) -> tuple[Tensor, ...]:
            return torch.func.functional_call(models[0], (parameters, buffers), (latent, action, value))

        together = torch.func.vmap(one)(parameters, buffers)
        for i, model in enumerate(models):
            for stacked, alone in zip(together, model(latent, action, value), strict=True):
                torch.testing.assert_close(stacked[i], alone)

    def test_state_dict_is_a_round_trip_through_a_predictor(self, head: Head) -> None:
        source, twin = (Predictor(D, head=copy.deepcopy(head)) for _ in range(2))
        nn.init.normal_(source.constants)
        twin.load_state_dict(source.state_dict())
        latent = torch.randn(5, D)
        assert torch.equal(source.dist(latent).mean, twin.dist(latent).mean)
        assert torch.equal(source.dist(latent).variance, twin.dist(latent).variance)


class PredictedMoments(nn.Module):
    def __init__(self, predictor: Predictor) -> None:
        super().__init__()
        self.predictor = predictor

    def forward(self, latent: Tensor, action: Tensor, value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        p = self.predictor.dist(latent, action, skip=2)
        return p.mean, p.variance, p.log_prob(value)


class TestDiagGaussianHead:
    def test_sizes(self) -> None:
        state, constant = DiagGaussianHead("state"), DiagGaussianHead("constant")
        assert (state.num_features(5), state.num_constants(5)) == (10, 0)
        assert (constant.num_features(5), constant.num_constants(5)) == (5, 5)

    def test_variance_is_the_exponential_of_the_second_half(self) -> None:
        features = torch.randn(6, 2 * D, dtype=torch.float64) * 2
        p = DiagGaussianHead()(features, torch.empty(0))
        torch.testing.assert_close(p.variance, features[..., D:].exp(), rtol=1e-3, atol=0)

    def test_variance_is_the_exponential_of_the_constants(self) -> None:
        constants = torch.tensor([-2.0, 0.0, 3.0], dtype=torch.float64)
        p = DiagGaussianHead("constant")(torch.randn(6, D, dtype=torch.float64), constants)
        torch.testing.assert_close(p.variance, constants.exp().expand(6, D), rtol=1e-3, atol=0)

    @pytest.mark.parametrize("scale", ["state", "constant"])
    def test_log_variance_stays_in_its_range(self, scale: str) -> None:
        head = DiagGaussianHead(scale, log_var_range=(-3.0, 1.0))
        for size, bound in ((1e4, 1.0), (-1e4, -3.0)):
            features = torch.full((1, head.num_features(D)), size)
            p = head(features, torch.full((head.num_constants(D),), size))
            torch.testing.assert_close(p.variance.log(), torch.full((1, D), bound), atol=1e-3, rtol=0)

    def test_default_range_is_16_nats(self) -> None:
        p = DiagGaussianHead("constant")(torch.zeros(2), torch.tensor([-1e4, 1e4]))
        torch.testing.assert_close(p.variance.log(), torch.tensor([-16.0, 16.0]), atol=1e-3, rtol=0)

    def test_errors(self) -> None:
        with pytest.raises(ValueError, match="scale must be 'state' or 'constant', got 'full'"):
            DiagGaussianHead("full")
        for bounds in ((1.0, 1.0), (2.0, -2.0), (-math.inf, 0.0), (0.0, math.inf), (0.0, math.nan)):
            with pytest.raises(ValueError, match=r"log_var_range must be finite \(low, high\)"):
                DiagGaussianHead(log_var_range=bounds)


class TestSoftClamp:
    @given(FLOATS, RANGES)
    def test_stays_in_bounds(self, value: float, bounds: tuple[float, float]) -> None:
        for dtype in (torch.float32, torch.float64):
            low, high = bounds
            out = float(soft_clamp(torch.tensor(value, dtype=dtype), low, high))
            slack = 4 * torch.finfo(dtype).eps * max(abs(low), abs(high), high - low)
            assert low - slack <= out <= high + slack

    @given(FLOATS, st.floats(0.0, 60.0), RANGES)
    def test_is_monotone(self, value: float, step: float, bounds: tuple[float, float]) -> None:
        x = torch.tensor([value, value + step], dtype=torch.float64)
        first, second = soft_clamp(x, *bounds)
        assert first <= second + 1e-7

    @given(st.floats(0.0, 1.0), RANGES)
    def test_is_near_the_identity_inside(self, part: float, bounds: tuple[float, float]) -> None:
        low, high = bounds
        value = low + part * (high - low)
        margin = min(value - low, high - value)
        out = float(soft_clamp(torch.tensor(value, dtype=torch.float64), low, high))
        assert abs(out - value) <= 3 * math.exp(-margin) + 1e-12

    @given(FLOATS, RANGES)
    def test_gradient_is_between_zero_and_one_and_positive_inside(
        self, value: float, bounds: tuple[float, float]
    ) -> None:
        x = torch.tensor(value, dtype=torch.float64, requires_grad=True)
        soft_clamp(x, *bounds).backward()
        assert 0.0 <= float(x.grad) <= 1.0 + 1e-9
        if bounds[0] <= value <= bounds[1]:
            assert float(x.grad) > 0.1 * (1 - math.exp(-(bounds[1] - bounds[0])))

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
    def test_infinities_give_the_bounds_without_nan(self, dtype: torch.dtype) -> None:
        x = torch.tensor([-math.inf, -1e30, 1e30, math.inf], dtype=dtype, requires_grad=True)
        out = soft_clamp(x, -16.0, 16.0)
        assert out.dtype == dtype
        torch.testing.assert_close(out, torch.tensor([-16.0, -16.0, 16.0, 16.0], dtype=dtype))
        out.sum().backward()
        assert x.grad.abs().max() < 1e-30
        assert x.grad[[0, 3]].tolist() == [0.0, 0.0]

    def test_is_symmetric_for_wide_symmetric_bounds(self) -> None:
        x = torch.linspace(-30, 30, 121, dtype=torch.float64)
        torch.testing.assert_close(
            soft_clamp(x, -12.0, 12.0), -soft_clamp(-x, -12.0, 12.0), atol=1e-5, rtol=1e-5
        )


class TestTargetScale:
    def test_linear_is_a_matrix_of_log_variances(self) -> None:
        scale = TargetScale(D, 5, kind="linear").double()
        x = torch.randn(2, 4, 5, dtype=torch.float64)
        expected = (0.5 * x @ scale.linear.weight.mT).exp()
        torch.testing.assert_close(scale(x), expected, rtol=1e-3, atol=0)
        assert [name for name, _ in scale.named_parameters()] == ["linear.weight"]

    @pytest.mark.parametrize("kind", ["learned", "constant"])
    @pytest.mark.parametrize("init_std", [0.01, 0.5, 3.0])
    def test_starts_at_init_std(self, kind: str, init_std: float) -> None:
        scale = TargetScale(D, kind=kind, init_std=init_std)
        torch.testing.assert_close(scale(torch.randn(2, 4, 7)), torch.full((D,), init_std), rtol=2e-3, atol=0)

    def test_default_is_learned_and_one(self) -> None:
        scale = TargetScale(D)
        torch.testing.assert_close(scale(torch.zeros(2, 1)), torch.ones(D))
        assert [name for name, _ in scale.named_parameters()] == ["log_var"]

    def test_only_the_learned_kind_has_a_parameter(self) -> None:
        learned, constant = TargetScale(D), TargetScale(D, kind="constant")
        learned(torch.zeros(4, 2)).sum().backward()
        torch.testing.assert_close(learned.log_var.grad, torch.full((D,), 0.5))  # d exp(v/2) / dv = 1/2
        assert list(constant.parameters()) == []
        assert "log_var" in constant.state_dict()

    @pytest.mark.parametrize("kind", ["learned", "constant", "linear"])
    def test_range_holds(self, kind: str) -> None:
        scale = TargetScale(2, 2, kind=kind, log_var_range=(-3.0, 1.0))
        x = torch.tensor([[-1e4, 1e4]])
        if kind == "linear":
            nn.init.eye_(scale.linear.weight)
        else:
            with torch.no_grad():
                scale.log_var.copy_(x[0])
        torch.testing.assert_close(
            2 * scale(x).log().reshape(2), torch.tensor([-3.0, 1.0]), atol=1e-3, rtol=0
        )

    def test_reset_restores_the_learned_scale(self) -> None:
        scale = TargetScale(D, init_std=0.5)
        before = scale(torch.zeros(1))
        nn.init.normal_(scale.log_var)
        scale.reset_parameters()
        assert torch.equal(scale(torch.zeros(1)), before)
        linear = TargetScale(D, 2, kind="linear")
        weight = linear.linear.weight.clone()
        linear.reset_parameters()
        assert torch.equal(linear.linear.weight, weight)

    @pytest.mark.parametrize("kind", ["learned", "constant", "linear"])
    def test_pickles_casts_and_loads(self, kind: str) -> None:
        scale = TargetScale(D, 2, kind=kind, init_std=0.5)
        x = torch.randn(4, 2)
        assert torch.equal(pickle.loads(pickle.dumps(scale))(x), scale(x))
        twin = TargetScale(D, 2, kind=kind)
        twin.load_state_dict(scale.state_dict())
        assert torch.equal(twin(x), scale(x))
        assert scale.double()(x.double()).dtype == torch.float64

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"latent_dim": 0}, "latent_dim must be positive, got 0"),
            ({"kind": "free"}, "kind must be one of .*'linear', 'learned', 'constant'.*'free'"),
            ({"init_std": 0.0}, "init_std must be positive, got 0"),
            ({"init_std": math.nan}, "init_std must be positive, got nan"),
            ({"init_std": math.inf}, "init_std must have a log-variance in log_var_range"),
            ({"init_std": 1e-4}, "init_std must have a log-variance in .*got 0.0001 with -18.4"),
            ({"init_std": 1e4, "kind": "constant"}, "init_std must have a log-variance in"),
            ({"kind": "linear"}, "observation_dim must be positive for kind='linear', got None"),
            ({"kind": "linear", "observation_dim": 0}, "observation_dim must be positive.*got 0"),
            ({"log_var_range": (1.0, -1.0)}, r"log_var_range must be finite \(low, high\)"),
        ],
    )
    def test_errors(self, arguments: dict[str, object], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            TargetScale(**{"latent_dim": 3, **arguments})
