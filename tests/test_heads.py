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

from torchrl_vjepa.distributions import Delta, from_noise, moments, noise_dim, sample, soft_clamp
from torchrl_vjepa.heads import (
    DeltaHead,
    DiagGaussianHead,
    EnsembleHead,
    FlowHead,
    FullGaussianHead,
    Head,
    LowRankGaussianHead,
    MixtureHead,
    TargetScale,
)
from torchrl_vjepa.predictor import Predictor

# One line per head, and every test of TestEveryHead runs for it.
HEADS: dict[str, Callable[[], Head]] = {
    "delta": DeltaHead,
    "diag_gaussian_state": DiagGaussianHead,
    "diag_gaussian_constant": lambda: DiagGaussianHead("constant"),
    "diag_gaussian_narrow": lambda: DiagGaussianHead(log_var_range=(-2.0, 1.0)),
    "full_gaussian_state": FullGaussianHead,
    "full_gaussian_constant": lambda: FullGaussianHead("constant"),
    "low_rank_gaussian_state": lambda: LowRankGaussianHead(2),
    "low_rank_gaussian_constant": lambda: LowRankGaussianHead(1, "constant"),
    "mixture": lambda: MixtureHead(3),
    "flow": lambda: FlowHead(2, 8, 4, num_points=512),
    "ensemble": lambda: EnsembleHead(num_members=3, num_cells=4),
    "ensemble_of_mixtures": lambda: EnsembleHead(MixtureHead(2), 2, 4),
    "ensemble_of_flows": lambda: EnsembleHead(FlowHead(1, 4, 4, num_points=512), 2, 4),
}
WITH_DENSITY = [name for name in HEADS if name != "delta"]
D = 3

FLOATS = st.floats(-60.0, 60.0)
RANGES = st.tuples(st.floats(-20.0, 20.0), st.floats(0.5, 40.0)).map(lambda r: (r[0], r[0] + r[1]))


@pytest.fixture(params=list(HEADS))
def head(request: pytest.FixtureRequest) -> Head:
    return HEADS[request.param]()


def _inputs(
    head: Head, *batch: int, dim: int = D, dtype: torch.dtype = torch.float32
) -> tuple[Tensor, Tensor]:
    features = torch.randn(*batch, head.num_features(dim)).to(dtype).requires_grad_()
    constants = head.init_constants(dim) + 0.5 * torch.randn(head.num_constants(dim))
    return features, constants.to(dtype).requires_grad_()


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

    def test_the_first_features_move_the_distribution(self, head: Head) -> None:
        features, constants = _inputs(head, 4, dtype=torch.float64)
        assert head.num_features(D) >= D
        shift = torch.randn(D, dtype=torch.float64)
        moved = features + nn.functional.pad(shift, (0, features.shape[-1] - D))
        p, q = head(features, constants), head(moved, constants)
        noise = torch.randn(5, 4, noise_dim(p), dtype=torch.float64)
        torch.testing.assert_close(from_noise(q, noise), from_noise(p, noise) + shift)
        torch.testing.assert_close(q.mean, p.mean + shift)
        torch.testing.assert_close(q.variance, p.variance)

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
        # A point has no density: its mean is what a squared loss trains. Many draws, because a bin of a
        # spline is seen by what falls into it.
        drawn = p.rsample((20_000,))
        if by == "log_prob" and not isinstance(p, Delta):
            drawn = p.log_prob(drawn.detach())
        (drawn * torch.randn(drawn.shape)).sum().backward()
        # A knot of a spline where nothing falls has none.
        assert (features.grad != 0).float().mean() > 0.99
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
            model = PredictedMoments(Predictor(D, 2, head=copy.deepcopy(head), skips=(1, 2))).double()
            with torch.no_grad():
                model.predictor.constants.add_(0.3 * torch.randn_like(model.predictor.constants))
            models.append(model)
        parameters, buffers = torch.func.stack_module_state(models)
        latent, action, value = (torch.randn(5, *n, dtype=torch.float64) for n in ((D,), (2, 2), (D,)))

        def one(parameters: dict[str, Tensor], buffers: dict[str, Tensor]) -> tuple[Tensor, ...]:
            return torch.func.functional_call(models[0], (parameters, buffers), (latent, action, value))

        together = torch.func.vmap(one)(parameters, buffers)
        for i, model in enumerate(models):
            for stacked, alone in zip(together, model(latent, action, value), strict=True):
                torch.testing.assert_close(stacked[i], alone)

    def test_state_dict_is_a_round_trip_through_a_predictor(self, head: Head) -> None:
        source, twin = (Predictor(D, head=copy.deepcopy(head)) for _ in range(2))
        nn.init.normal_(source.constants, std=0.5)
        twin.load_state_dict(source.state_dict())
        latent = torch.randn(5, D)
        assert torch.equal(source.dist(latent).mean, twin.dist(latent).mean)
        assert torch.equal(source.dist(latent).variance, twin.dist(latent).variance)

    def test_reset_starts_again(self, head: Head) -> None:
        predictor = Predictor(D, head=head, skips=(1, 2))
        torch.manual_seed(1)
        expected = torch.stack([head.init_constants(D) for _ in range(2)])
        nn.init.normal_(predictor.constants)
        torch.manual_seed(1)
        predictor.reset_parameters()
        assert torch.equal(predictor.constants, expected)
        assert expected.shape == (2, head.num_constants(D))

    def test_draws_of_a_generator_are_deterministic_and_leave_the_global_state(self, head: Head) -> None:
        p = head(*_inputs(head, 4))
        before = torch.get_rng_state()
        first, second = (sample(p, (6,), generator=torch.Generator().manual_seed(3)) for _ in range(2))
        assert torch.equal(first, second)
        assert torch.equal(before, torch.get_rng_state())
        assert not first.requires_grad

    @pytest.mark.parametrize("how", ["mean", "variance", "sample", "log_prob"])
    def test_autocast(self, head: Head, how: str) -> None:
        predictor = Predictor(D, 2, head=head, trunk="mlp", num_cells=[8])
        with torch.autocast("cpu", torch.bfloat16):
            p = predictor.dist(torch.randn(5, D), torch.randn(5, 2))
            value = p.sample() if how == "sample" else torch.randn(5, D)
            if how == "log_prob" and isinstance(p, Delta):
                return
            out = {"mean": p.mean, "variance": p.variance, "sample": value}.get(how)
            out = p.log_prob(value) if out is None else out
        assert out.isfinite().all()
        assert out.shape[0] == 5


@pytest.mark.parametrize("name", WITH_DENSITY)
class TestEveryDensity:
    @pytest.mark.parametrize("dim", [1, 2])
    def test_integrates_to_one(self, name: str, dim: int) -> None:
        head = HEADS[name]()
        with torch.no_grad():
            # Milder parameters where the grid is coarse.
            p = head(*(value.detach() / dim for value in _inputs(head, dim=dim, dtype=torch.float64)))
        # The widest component may be far narrower than the distance between two: a fine grid.
        num = 200_001 if dim == 1 else 701
        reach = 9 * p.stddev + 4
        axes = [
            torch.linspace(float(m - r), float(m + r), num, dtype=torch.float64)
            for m, r in zip(p.mean, reach, strict=True)
        ]
        grid = torch.cartesian_prod(*axes).reshape(-1, dim)
        cell = math.prod(float(axis[1] - axis[0]) for axis in axes)
        with torch.no_grad():
            mass = sum(float(p.log_prob(part).exp().sum()) for part in grid.split(200_000)) * cell
        # The grid's own error: splines have bends that it does not resolve.
        assert abs(mass - 1) < (1e-5 if dim == 1 else 1e-2 if "flow" in name else 1e-4)

    def test_draws_have_the_moments(self, name: str) -> None:
        head = HEADS[name]()
        with torch.no_grad():
            p = head(*_inputs(head, 2, dtype=torch.float64))
        num = 40_000
        drawn = sample(p, (num,), generator=torch.Generator().manual_seed(0))
        mean, covariance = moments(p)
        torch.testing.assert_close(covariance.diagonal(dim1=-2, dim2=-1), p.variance)
        # The moments of a flow are themselves an average over 512 points.
        effective = 1 / (1 / num + ("flow" in name) / 512)
        assert ((drawn.mean(0) - mean).abs() < 5 * (p.variance / effective).sqrt()).all()
        centred = drawn - mean
        products = centred.unsqueeze(-1) * centred.unsqueeze(-2)
        assert ((products.mean(0) - covariance).abs() < 5 * products.std(0) / effective**0.5).all()

    def test_draws_have_the_density(self, name: str) -> None:
        """The mean of log p over draws is minus the entropy: p log p integrated on a grid."""
        head = HEADS[name]()
        with torch.no_grad():
            p = head(*_inputs(head, dim=1, dtype=torch.float64))
            width = float(9 * p.stddev + 4)
            grid = float(p.mean) + torch.linspace(-width, width, 400_001, dtype=torch.float64).unsqueeze(-1)
            log_prob = p.log_prob(grid)
            exact = float((log_prob.exp() * log_prob).sum() * (grid[1] - grid[0]))
            drawn = p.log_prob(sample(p, (100_000,), generator=torch.Generator().manual_seed(0)))
        assert abs(float(drawn.mean()) - exact) < 5 * float(drawn.std()) / 100_000**0.5

    @pytest.mark.parametrize("dim", [1, 2])
    def test_mode_is_the_maximum(self, name: str, dim: int) -> None:
        head = HEADS[name]()
        with torch.no_grad():
            p = head(*_inputs(head, 3, dim=dim, dtype=torch.float64))
        mode = p.mode
        assert mode.shape == (3, dim)
        best = p.log_prob(mode)
        assert (
            p.log_prob(sample(p, (20_000,), generator=torch.Generator().manual_seed(0))) <= best + 1e-3
        ).all()
        for size in (1e-2, 1e-1):
            for step in (torch.eye(dim).double() * p.stddev.unsqueeze(-2)).unbind(-2):
                for sign in (-size, size):
                    assert (p.log_prob(mode + sign * step) <= best + 1e-4).all()

    def test_mode_works_in_inference_mode(self, name: str) -> None:
        head = HEADS[name]()
        features, constants = _inputs(head, 2, dtype=torch.float64)
        expected = head(features, constants).mode.detach()
        with torch.inference_mode():
            torch.testing.assert_close(head(features.clone(), constants.clone()).mode, expected)

    def test_vmap_equals_a_loop(self, name: str) -> None:
        head = HEADS[name]()
        features, constants = _inputs(head, 4, dtype=torch.float64)
        noise = torch.randn(6, noise_dim(head(features, constants)), dtype=torch.float64)

        def one(row: Tensor) -> tuple[Tensor, ...]:
            p = head(row, constants)
            drawn = from_noise(p, noise)
            return drawn, p.log_prob(drawn), p.mean, p.variance, moments(p)[1]

        together = torch.vmap(one)(features)
        for i in range(4):
            for stacked, alone in zip(together, one(features[i]), strict=True):
                torch.testing.assert_close(stacked[i], alone)

    def test_expands(self, name: str) -> None:
        head = HEADS[name]()
        p = head(*_inputs(head, 4, dtype=torch.float64))
        q = p.expand(torch.Size([3, 4]))
        assert q.batch_shape == (3, 4)
        assert q.rsample((2,)).shape == (2, 3, 4, D)
        value = torch.randn(3, 4, D, dtype=torch.float64)
        torch.testing.assert_close(q.log_prob(value), p.log_prob(value))
        torch.testing.assert_close(q.variance[2], p.variance)

    def test_constants_may_have_batch_dimensions(self, name: str) -> None:
        """What ensembles rely on."""
        head = HEADS[name]()
        features, _ = _inputs(head, 4, dtype=torch.float64)
        constants = torch.stack([_inputs(head, dtype=torch.float64)[1] for _ in range(4)])
        p = head(features, constants)
        value = torch.randn(4, D, dtype=torch.float64)
        assert p.batch_shape == (4,)
        for i in range(4):
            q = head(features[i], constants[i])
            torch.testing.assert_close(p.log_prob(value)[i], q.log_prob(value[i]))
            torch.testing.assert_close(p.mean[i], q.mean)


class PredictedMoments(nn.Module):
    def __init__(self, predictor: Predictor) -> None:
        super().__init__()
        self.predictor = predictor

    def forward(self, latent: Tensor, action: Tensor, value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        p = self.predictor.dist(latent, action, skip=2)
        return p.mean, p.variance, p.log_prob(value)


class TestSizes:
    @pytest.mark.parametrize(
        ("head", "dim", "features", "constants"),
        [
            (FullGaussianHead(), 4, 4 + 4 + 6, 10),
            (FullGaussianHead("constant"), 4, 4, 10),
            (FullGaussianHead(), 1, 2, 1),
            (LowRankGaussianHead(3), 4, 4 + 4 + 12, 16),
            (LowRankGaussianHead(3, "constant"), 4, 4, 16),
            (MixtureHead(3), 4, 4 + 3 * 9, 3 * 9),
            (FlowHead(2, 8, 4), 1, 2 + 11, 12),  # one dimension needs no coupling
            (FlowHead(2, 8, 4), 3, 3 * 13 + 16, 3 * 12 + (8 + 8 + 8 * 22 + 22) + (8 + 16 + 8 * 11 + 11)),
            (EnsembleHead(num_members=2, num_cells=5), 3, 3 + 10, 2 * (5 + 5 * 6 + 6)),
            (EnsembleHead(DiagGaussianHead("constant"), 2, 5), 3, 3 + 10, 2 * (5 + 5 * 3 + 3 + 3)),
        ],
    )
    def test_counts(self, head: Head, dim: int, features: int, constants: int) -> None:
        assert (head.num_features(dim), head.num_constants(dim)) == (features, constants)

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: FullGaussianHead("free"), "scale must be 'state' or 'constant', got 'free'"),
            (lambda: FullGaussianHead(log_var_range=(1.0, 0.0)), "log_var_range must be finite"),
            (lambda: LowRankGaussianHead(0), "rank must be positive, got 0"),
            (lambda: MixtureHead(0), "num_components must be positive, got 0"),
            (lambda: MixtureHead(init_spread=-1.0), "init_spread must be finite and at least 0, got -1"),
            (lambda: FlowHead(-1), "num_layers must be at least 0, got -1"),
            (lambda: FlowHead(num_cells=0), "num_cells must be positive, got 0"),
            (lambda: FlowHead(num_bins=1), r"num_bins must be in \[2, 50\], got 1"),
            (lambda: FlowHead(num_points=0), "num_points must be positive, got 0"),
            (lambda: EnsembleHead(num_members=1), "num_members must be at least 2, got 1"),
            (lambda: EnsembleHead(num_cells=0), "num_cells must be positive, got 0"),
            (lambda: EnsembleHead(init_gain=0.0), "init_gain must be positive and finite, got 0"),
        ],
    )
    def test_bad_sizes_are_refused(self, make: Callable[[], Head], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            make()

    def test_an_ensemble_of_points_has_no_likelihood(self) -> None:
        with pytest.raises(TypeError, match="head must have a density, got DeltaHead"):
            EnsembleHead(DeltaHead())


class TestCorrelatedHeads:
    @pytest.mark.parametrize("make", [FullGaussianHead, LowRankGaussianHead])
    def test_marginal_variance_is_the_exponential_of_its_parameter(self, make: Callable[..., Head]) -> None:
        head = make(scale="constant")
        constants = _inputs(head, dtype=torch.float64)[1].detach() * 3
        p = head(torch.zeros(D, dtype=torch.float64), constants)
        torch.testing.assert_close(p.variance, constants[:D].exp(), rtol=1e-3, atol=0)

    @pytest.mark.parametrize("make", [FullGaussianHead, LowRankGaussianHead])
    def test_without_loadings_it_is_the_diagonal_head(self, make: Callable[..., Head]) -> None:
        head = make(scale="constant")
        constants = torch.zeros(head.num_constants(D))
        constants[:D] = torch.tensor([-1.0, 0.0, 1.0])
        features, value = torch.randn(5, D), torch.randn(5, D)
        p, q = head(features, constants), DiagGaussianHead("constant")(features, constants[:D])
        torch.testing.assert_close(p.log_prob(value), q.log_prob(value))
        torch.testing.assert_close(moments(p)[1], moments(q)[1])

    @pytest.mark.parametrize("make", [FullGaussianHead, lambda **k: LowRankGaussianHead(4, **k)])
    def test_any_correlations_are_within_reach(self, make: Callable[..., Head]) -> None:
        """Fitted by likelihood to a covariance, it finds it."""
        root = torch.randn(D, D, dtype=torch.float64)
        target = root @ root.mT + 0.2 * torch.eye(D, dtype=torch.float64)
        head = make(scale="constant")
        constants = head.init_constants(D).double().requires_grad_()
        optimizer = torch.optim.LBFGS([constants], max_iter=300, line_search_fn="strong_wolfe")

        def closure() -> Tensor:
            optimizer.zero_grad()
            covariance = moments(head(torch.zeros(D, dtype=torch.float64), constants))[1]
            loss = torch.logdet(covariance) + torch.linalg.solve(covariance, target).trace()
            loss.backward()
            return loss

        optimizer.step(closure)
        fitted = moments(head(torch.zeros(D, dtype=torch.float64), constants.detach()))[1]
        torch.testing.assert_close(fitted, target, rtol=1e-2, atol=1e-2)

    @pytest.mark.parametrize("make", [FullGaussianHead, LowRankGaussianHead])
    def test_correlations_are_bounded(self, make: Callable[..., Head]) -> None:
        """No dimension is known from the others to less than 1 / 101 of its variance."""
        head = make(scale="constant")
        constants = torch.full((head.num_constants(D),), 1e6, dtype=torch.float64)
        constants[:D] = 0.0
        covariance = moments(head(torch.zeros(D, dtype=torch.float64), constants))[1]
        conditional = 1 / torch.linalg.inv(covariance[:2, :2]).diagonal()
        assert (conditional >= 1 / 101 - 1e-6).all()
        assert (conditional < 0.03).all()


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


@pytest.mark.parametrize("name", WITH_DENSITY)
def test_reading_without_gradients_takes_none_away(name: str) -> None:
    """What was computed under no_grad or by sample() is not handed out where gradients are wanted."""
    head = HEADS[name]()
    features = torch.randn(5, head.num_features(D), requires_grad=True)
    constants = head.init_constants(D).requires_grad_()
    target = torch.randn(5, D)

    def gradients(read: Callable[..., object]) -> list[Tensor]:
        p = head(features, constants)
        with torch.no_grad():
            read(p)
        inputs = [features, constants] if constants.numel() else [features]
        return list(torch.autograd.grad(p.log_prob(target).sum(), inputs, allow_unused=True))

    expected = gradients(lambda p: None)
    for read in (lambda p: p.sample(), lambda p: p.log_prob(target), lambda p: p.mean):
        for got, want in zip(gradients(read), expected, strict=True):
            if want is not None:
                torch.testing.assert_close(got, want)
