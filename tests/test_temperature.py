"""Temperature: moments and densities of tempered distributions, and the predictor that keeps it."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import (
    Categorical,
    Distribution,
    Exponential,
    Independent,
    LowRankMultivariateNormal,
    MixtureSameFamily,
    MultivariateNormal,
    StudentT,
)
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import (
    VJEPA,
    CouplingFlow,
    Delta,
    DeltaHead,
    DiagGaussianHead,
    Ensemble,
    FlowHead,
    FusedPredictor,
    GaussianPrior,
    LowRankGaussian,
    Mixture,
    Predictor,
    VJEPALoss,
    diag_gaussian,
    full_gaussian,
    linear_encoder,
    temper,
)

B, D = 5, 3


def _diagonal() -> Distribution:
    return diag_gaussian(torch.randn(B, D).double(), torch.rand(B, D).double() + 0.5)


def _full() -> Distribution:
    root = torch.randn(B, D, D).double()
    return MultivariateNormal(torch.randn(B, D).double(), root @ root.mT + torch.eye(D))


def _low_rank() -> Distribution:
    factor, scale = torch.randn(B, D, 2).double(), torch.rand(B, D).double() + 0.5
    return LowRankGaussian(torch.randn(B, D).double(), factor, scale)


def _mixture() -> Distribution:
    components = diag_gaussian(2 * torch.randn(B, 4, D).double(), torch.rand(B, 4, D).double() + 0.2)
    return Mixture(torch.randn(B, 4).double(), components)


def _ensemble() -> Distribution:
    root = torch.randn(B, 2, D, D).double()
    loc = 2 * torch.randn(B, 2, D).double()
    return Ensemble(full_gaussian(loc, torch.linalg.cholesky(root @ root.mT + torch.eye(D))))


def _low_rank_mixture() -> Distribution:
    loc, factor = 2 * torch.randn(B, 2, D).double(), torch.randn(B, 2, D, 1).double()
    return Mixture(torch.randn(B, 2).double(), LowRankGaussian(loc, factor, torch.ones(B, 2, D).double()))


def _flow() -> Distribution:
    head = FlowHead(1).double()
    features = torch.randn(B, head.num_features(D)).double()
    return head(features, 0.3 * torch.randn(head.num_constants(D)).double())


def _torch_mixture() -> Distribution:
    root = torch.randn(B, 2, D, D).double()
    components = MultivariateNormal(2 * torch.randn(B, 2, D).double(), root @ root.mT + torch.eye(D))
    return MixtureSameFamily(Categorical(torch.rand(B, 2).double()), components)


def _student() -> Distribution:
    return Independent(StudentT(5.0, torch.randn(B, D).double(), torch.rand(B, D).double() + 0.5), 1)


FAMILIES = {
    "diagonal": _diagonal,
    "full": _full,
    "low_rank": _low_rank,
    "mixture": _mixture,
    "ensemble": _ensemble,
    "low_rank_mixture": _low_rank_mixture,
    "flow": _flow,
    "torch_mixture": _torch_mixture,
    "student": _student,
}


@pytest.mark.parametrize("make", FAMILIES.values(), ids=FAMILIES)
@pytest.mark.parametrize("temperature", [0.3, 1.0, torch.tensor(2.5).double()])
class TestEveryFamily:
    def test_the_mean_stays_and_the_variance_scales(
        self, make: Callable[[], Distribution], temperature: Tensor | float
    ) -> None:
        p = make()
        hot = temper(p, temperature)
        assert hot.batch_shape == p.batch_shape
        assert hot.event_shape == p.event_shape
        torch.testing.assert_close(hot.mean, p.mean)
        torch.testing.assert_close(hot.variance, p.variance * temperature**2)

    def test_the_density_is_that_of_the_scaled_variable(
        self, make: Callable[[], Distribution], temperature: Tensor | float
    ) -> None:
        p = make()
        z = torch.randn(7, B, D).double()
        # Z' = m + t (Z - m): p'(z) = p(m + (z - m) / t) / t^D
        expected = p.log_prob(p.mean + (z - p.mean) / temperature) - D * torch.as_tensor(temperature).log()
        torch.testing.assert_close(temper(p, temperature).log_prob(z), expected)

    def test_samples_are_the_scaled_samples(
        self, make: Callable[[], Distribution], temperature: Tensor | float
    ) -> None:
        p = make()
        hot = temper(p, temperature)
        with torch.random.fork_rng():
            torch.manual_seed(1)
            plain = p.sample((6,))
            torch.manual_seed(1)
            scaled = hot.sample((6,))
        torch.testing.assert_close(scaled, p.mean + temperature * (plain - p.mean))

    def test_temperatures_multiply(
        self, make: Callable[[], Distribution], temperature: Tensor | float
    ) -> None:
        p, z = make(), torch.randn(B, D).double()
        twice = temper(temper(p, temperature), 1.7)
        torch.testing.assert_close(twice.log_prob(z), temper(p, 1.7 * temperature).log_prob(z))

    def test_expands(self, make: Callable[[], Distribution], temperature: Tensor | float) -> None:
        hot = temper(make(), temperature)
        z = torch.randn(2, B, D).double()
        wide = hot.expand((2, B))
        assert wide.batch_shape == (2, B)
        torch.testing.assert_close(wide.log_prob(z), hot.log_prob(z))


def test_families_keep_their_class() -> None:
    assert isinstance(temper(_full(), 2.0), MultivariateNormal)
    assert isinstance(temper(_low_rank(), 2.0), LowRankGaussian)
    assert type(temper(_mixture(), 2.0)) is Mixture
    assert isinstance(temper(_ensemble(), 2.0), Ensemble)
    assert isinstance(temper(_flow(), 2.0), CouplingFlow)
    point = Delta(torch.ones(B, D))
    assert temper(point, 2.0) is point


def test_torchs_low_rank_gaussian_becomes_ours() -> None:
    factor, diagonal = torch.randn(B, D, 2).double(), torch.rand(B, D).double() + 0.5
    p, z = LowRankMultivariateNormal(torch.ones(B, D).double(), factor, diagonal), torch.randn(B, D).double()
    hot = temper(p, 3.0)
    assert isinstance(hot, LowRankGaussian)
    torch.testing.assert_close(hot.covariance_matrix, 9 * p.covariance_matrix)
    torch.testing.assert_close(
        hot.log_prob(z), MultivariateNormal(p.mean, 9 * p.covariance_matrix).log_prob(z)
    )


def test_a_gaussian_at_temperature_one_is_bit_equal() -> None:
    p = _diagonal()
    same = temper(p, torch.tensor(1.0))
    assert torch.equal(same.mean, p.mean)
    assert torch.equal(same.stddev, p.stddev)


def test_the_mode_moves_with_the_density() -> None:
    p = Independent(Exponential(torch.ones(B, D)), 1)  # mean 1, mode 0
    torch.testing.assert_close(temper(p, 3.0).mode, torch.full((B, D), -2.0))


def test_gradients_reach_parameters_and_temperature() -> None:
    loc, temperature = torch.randn(D, requires_grad=True), torch.tensor(2.0, requires_grad=True)
    for make in (lambda: diag_gaussian(loc, torch.ones(D)), lambda: Independent(StudentT(5.0, loc), 1)):
        gradients = torch.autograd.grad(
            temper(make(), temperature).log_prob(torch.zeros(D)), (loc, temperature)
        )
        assert all(g.abs().sum() > 0 for g in gradients)


class _NoMean(Distribution):
    arg_constraints: dict[str, object] = {}


def test_refuses() -> None:
    with pytest.raises(ValueError, match=r"event shape \(D,\), got \(\)"):
        temper(torch.distributions.Normal(torch.zeros(D), torch.ones(D)), 2.0)
    with pytest.raises(ValueError, match=r"temperature must be a scalar, got shape \(3,\)"):
        temper(_diagonal(), torch.ones(3))
    with pytest.raises(TypeError, match="p must have a mean"):
        temper(_NoMean(torch.Size([B]), torch.Size([D]), validate_args=False), 2.0)


# --- the predictor


def _predictor(**arguments: object) -> Predictor:
    return Predictor(D, skips=(1, 4, 2), **arguments)


def test_a_fresh_predictor_has_none() -> None:
    predictor = _predictor()
    assert predictor.temperature is None
    assert "temperature" not in predictor.state_dict()


@pytest.mark.parametrize("scale", ["state", "constant"])
def test_each_skip_has_its_own(scale: str) -> None:
    predictor, latent = _predictor(head=DiagGaussianHead(scale)), torch.randn(B, D)
    before = {skip: predictor.dist(latent, skip=skip) for skip in predictor.skips}
    predictor.set_temperature([0.5, 2.0, 3.0])
    for skip, factor in zip(predictor.skips, [0.5, 2.0, 3.0], strict=True):
        after = predictor.dist(latent, skip=skip)
        assert torch.equal(after.mean, before[skip].mean)
        assert torch.equal(after.stddev, factor * before[skip].stddev)
    predictor.set_temperature([1.0, 1.0, 1.0])
    for skip in predictor.skips:
        assert torch.equal(predictor.dist(latent, skip=skip).stddev, before[skip].stddev)
    predictor.set_temperature(None)
    assert predictor.temperature is None


def test_points_have_no_temperature() -> None:
    predictor = _predictor(head=DeltaHead())
    predictor.set_temperature([2.0, 2.0, 2.0])
    assert isinstance(predictor.dist(torch.randn(B, D)), Delta)


def test_it_is_part_of_the_state() -> None:
    hot, cold = _predictor(), _predictor()
    hot.set_temperature([0.5, 2.0, 3.0])
    for twin in (copy.deepcopy(hot), pickle.loads(pickle.dumps(hot))):
        assert torch.equal(twin.temperature, hot.temperature)
    state = hot.state_dict()
    cold.load_state_dict(state)
    assert torch.equal(cold.temperature, torch.tensor([0.5, 2.0, 3.0]))
    assert cold.temperature is not hot.temperature
    model = VJEPA(linear_encoder(6, D), _predictor())
    model.load_state_dict(VJEPA(linear_encoder(6, D), hot).state_dict())
    assert torch.equal(model.predictor.temperature, hot.temperature)
    # The state of a predictor without one takes it away.
    cold.load_state_dict(_predictor().state_dict())
    assert cold.temperature is None
    assert hot.double().temperature.dtype == torch.float64


def test_reset_forgets_it() -> None:
    model = VJEPA(linear_encoder(6, D), _predictor())
    model.predictor.set_temperature([2.0, 2.0, 2.0])
    model.predictor.reset_parameters_recursive()
    assert torch.equal(model.predictor.temperature, torch.ones(3))


def test_the_likelihood_of_a_loss_feels_it_and_models_of_a_list_have_their_own() -> None:
    data = TensorDict(observation=torch.randn(2, 7, 6), batch_size=(2, 7))
    models = [VJEPA(linear_encoder(6, D), _predictor()) for _ in range(2)]

    def nll(models: VJEPA | list[VJEPA]) -> Tensor:
        loss = VJEPALoss(copy.deepcopy(models), collapse_rank=0.0)
        updater = SoftUpdate(loss, eps=0.9)
        with torch.random.fork_rng():
            torch.manual_seed(2)
            value = loss(data)["loss_nll"]
        value.sum().backward()
        updater.step()
        return value.detach()

    before = nll(models)
    for model, factor in zip(models, (3.0, 0.5), strict=True):
        model.predictor.set_temperature([factor, 1.0, 1.0])
    after = nll(models)
    assert not torch.isclose(after, before).any()
    torch.testing.assert_close(after, torch.stack([nll(model) for model in models]))
    # Models with and without one are not of one architecture.
    models[0].predictor.set_temperature(None)
    with pytest.raises(ValueError, match="one architecture"):
        VJEPALoss(models)


def test_it_is_no_parameter() -> None:
    predictor = _predictor()
    before = len(list(predictor.parameters()))
    predictor.set_temperature(torch.ones(3, requires_grad=True))
    assert len(list(predictor.parameters())) == before
    assert not predictor.temperature.requires_grad


def test_the_product_with_a_prior_feels_it() -> None:
    predictor = _predictor(head=DiagGaussianHead("constant"))
    predictor.set_temperature([2.0, 1.0, 1.0])
    variance = FusedPredictor(predictor, GaussianPrior(D)).dist(torch.zeros(B, D)).variance
    torch.testing.assert_close(variance, torch.full((B, D), 4 / 5))


def test_it_maps_over_models() -> None:
    predictors = [_predictor() for _ in range(2)]
    for i, predictor in enumerate(predictors):
        predictor.set_temperature([1.0 + i] * 3)
    params = TensorDict.from_modules(*predictors, as_module=False)
    latent = torch.randn(B, D)

    def spread(p: TensorDict) -> Tensor:
        with p.to_module(predictors[0]):
            return predictors[0].dist(latent, skip=4).stddev

    mapped = torch.vmap(spread)(params)
    torch.testing.assert_close(mapped[1], predictors[1].dist(latent, skip=4).stddev)


@pytest.mark.parametrize("wrong", [[1.0], [1.0, 2.0, 0.0], [1.0, 2.0, -1.0], [1.0, 2.0, float("nan")], 2.0])
def test_the_predictor_refuses(wrong: list[float]) -> None:
    predictor = _predictor()
    with pytest.raises(ValueError, match="temperature must"):
        predictor.set_temperature(wrong)
    assert predictor.temperature is None


@pytest.mark.parametrize("temperature", [-1.0, 0.0, math.nan, math.inf])
def test_temperatures_that_are_not_positive_are_refused(temperature: float) -> None:
    with pytest.raises(ValueError, match="temperature must be positive and finite"):
        temper(diag_gaussian(torch.zeros(2), torch.ones(2)), temperature)
