"""``fuse`` and what is built on it, against closed forms and numerical integration."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles import product_integrals
from torch import Tensor
from torch.distributions import (
    Distribution,
    Independent,
    Laplace,
    MultivariateNormal,
    Normal,
)

from torchrl_vjepa import (
    Delta,
    Density,
    FusedBelief,
    Fusion,
    GaussianFactor,
    Mixture,
    ParticleBelief,
    diag_gaussian,
    full_gaussian,
    fuse,
    langevin,
    map_estimate,
    product_of_experts,
    sample_posterior,
)
from torchrl_vjepa.distributions.products import has_closed_form

F64 = torch.float64
COVARIANCE = torch.tensor([[1.0, 0.6], [0.6, 0.8]], dtype=F64)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(mean: float = 0.0, std: float = 1.0) -> Distribution:
    return diag_gaussian(torch.tensor([mean], dtype=F64), torch.tensor([std], dtype=F64))


def full(mean: float = 0.0) -> Distribution:
    return MultivariateNormal(torch.tensor([mean], dtype=F64), torch.tensor([[0.7]], dtype=F64))


def mixture() -> Mixture:
    means = torch.tensor([[-2.0], [1.0], [3.0]], dtype=F64)
    return Mixture(
        torch.tensor([0.1, 0.5, -1.0], dtype=F64), diag_gaussian(means, torch.tensor([0.5], dtype=F64))
    )


def factor(precision: float = 2.0, information: float = 1.0) -> GaussianFactor:
    return GaussianFactor(torch.tensor([[precision]], dtype=F64), torch.tensor([information], dtype=F64), 0.3)


def laplace() -> Distribution:
    """Nothing of this library's."""
    return Independent(Laplace(torch.tensor([0.5], dtype=F64), torch.tensor([1.0], dtype=F64)), 1)


def wells(z: Tensor) -> Tensor:
    """Two valleys, at -1 and at 1."""
    return 3.0 * (z[..., 0].square() - 1.0).square()


PREDICTIONS = {"diagonal": normal, "full": full, "mixture": mixture}
GAUSSIANS: dict[str, Callable[[], Any]] = {
    "diagonal": lambda: normal(1.5, 0.6),
    "full": lambda: full(-1.0),
    "factor": factor,
    "flat factor": lambda: factor(0.0, 0.0),
}


# --- closed forms


@pytest.mark.parametrize("p", PREDICTIONS)
@pytest.mark.parametrize("prior", GAUSSIANS)
def test_closed_forms_equal_numerical_integration(p: str, prior: str) -> None:
    prediction, expert = PREDICTIONS[p](), GAUSSIANS[prior]()
    log_evidence, mean, variance = product_integrals(prediction, expert)
    fusion = fuse(prediction, expert)
    assert isinstance(fusion, Fusion)
    assert fusion.effective_sample_size is None
    assert fusion.log_evidence.item() == pytest.approx(log_evidence, abs=1e-8)
    assert fusion.posterior.mean.item() == pytest.approx(mean, abs=1e-8)
    assert fusion.posterior.variance.item() == pytest.approx(variance, abs=1e-8)
    z = torch.linspace(-2, 2, 9, dtype=F64).unsqueeze(-1)
    expected = prediction.log_prob(z) + expert.log_prob(z) - log_evidence
    torch.testing.assert_close(fusion.posterior.log_prob(z), expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("p", [*PREDICTIONS, "laplace"])
def test_a_flat_prior_gives_the_prediction_itself(p: str) -> None:
    prediction = laplace() if p == "laplace" else PREDICTIONS[p]()
    fusion = fuse(prediction.expand((3,)), Density())
    assert torch.equal(fusion.log_evidence, torch.zeros(3, dtype=F64))
    assert fuse(prediction, Density()).posterior is prediction


@given(seed=st.integers(0, 2**31), far=st.floats(0, 30))
def test_the_evidence_of_gaussians_is_the_density_of_their_difference(seed: int, far: float) -> None:
    r"""\int N(z; a, A) N(z; b, B) dz = N(a; b, A + B), also of a mixture, also far away."""
    torch.manual_seed(seed)
    a, b = torch.randn(4, 3, dtype=F64), torch.randn(3, dtype=F64) + far
    root = torch.randn(4, 3, 3, dtype=F64)
    covariance = root @ root.mT + 0.1 * torch.eye(3, dtype=F64)
    std = torch.rand(3, dtype=F64) + 0.1
    fusion = fuse(full_gaussian(a, torch.linalg.cholesky(covariance)), diag_gaussian(b, std))
    total = MultivariateNormal(b.expand(4, 3), covariance + torch.diag(std**2))
    torch.testing.assert_close(fusion.log_evidence, total.log_prob(a), rtol=1e-6, atol=1e-6)
    mixed = fuse(
        Mixture(torch.zeros(4), full_gaussian(a, torch.linalg.cholesky(covariance))), diag_gaussian(b, std)
    )
    expected = total.log_prob(a).logsumexp(0) - math.log(4)
    torch.testing.assert_close(mixed.log_evidence, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("diagonal", [True, False])
def test_a_singular_factor_is_a_measurement_of_some_coordinates(diagonal: bool) -> None:
    """The Kalman update with H = (1, 2), R = 0.5: what the precision form says without inverting it."""
    h, noise, x = torch.tensor([[1.0, 2.0]], dtype=F64), 0.5, torch.tensor([1.7], dtype=F64)
    covariance = torch.diag(COVARIANCE.diagonal()) if diagonal else COVARIANCE
    mean = torch.tensor([0.3, -1.0], dtype=F64)
    p = (
        diag_gaussian(mean, covariance.diagonal().sqrt())
        if diagonal
        else MultivariateNormal(mean, covariance)
    )
    constant = -0.5 * x.square().sum() / noise - 0.5 * math.log(2 * math.pi * noise)
    sensor = GaussianFactor(h.mT @ h / noise, (h.mT @ x) / noise, constant)
    fusion = fuse(p, sensor)
    spread = h @ covariance @ h.mT + noise
    gain = covariance @ h.mT / spread
    torch.testing.assert_close(fusion.posterior.mean, mean + gain @ (x - h @ mean))
    torch.testing.assert_close(
        fusion.posterior.covariance_matrix, (torch.eye(2, dtype=F64) - gain @ h) @ covariance
    )
    innovation = Normal(h @ mean, spread.sqrt().squeeze(-1)).log_prob(x)
    torch.testing.assert_close(fusion.log_evidence.reshape(1), innovation)


def test_one_expert_alone_and_factors_alone() -> None:
    p = mixture()
    assert product_of_experts(p) is p
    both = product_of_experts(factor(2.0, 1.0), factor(3.0, 0.0))
    assert (both.mean.item(), both.variance.item()) == (pytest.approx(0.2), pytest.approx(0.2))
    assert product_of_experts(factor(4.0, 2.0)).mean.item() == pytest.approx(0.5)
    with pytest.raises(ValueError, match="fused precision that is finite and positive definite"):
        product_of_experts(factor(0.0, 0.0))
    with pytest.raises(ValueError, match="finite and positive definite"):
        product_of_experts(full(), full_gaussian(torch.zeros(1), torch.full((1, 1), 1e-30)))


def test_contradicting_experts_are_finite() -> None:
    """Precisions of 1e60 overflow float32; relative to the sharpest expert they do not."""
    sharp = diag_gaussian(torch.tensor([-5.0]), torch.tensor([1e-30]))
    other = diag_gaussian(torch.tensor([5.0]), torch.tensor([1e-30]))
    p = product_of_experts(sharp, other)
    assert p.mean.item() == 0.0
    assert p.stddev.item() == pytest.approx(1e-30 / math.sqrt(2), rel=1e-5)
    far = fuse(normal(-50.0, 0.01), normal(50.0, 0.01))
    assert far.log_evidence.item() == pytest.approx(-25e6, rel=1e-3)
    assert far.posterior.mean.item() == pytest.approx(0.0, abs=1e-9)


def test_the_evidence_of_far_components_keeps_its_digits() -> None:
    """Read where densities are near one: between components both are 1e5 nats down."""
    p = Mixture(torch.zeros(2), diag_gaussian(torch.tensor([[0.3], [1000.0]]), torch.ones(1)))
    evidence = fuse(p, diag_gaussian(torch.zeros(1), torch.ones(1))).log_evidence
    expected = Normal(0.3, math.sqrt(2)).log_prob(torch.zeros(())) - math.log(2)
    torch.testing.assert_close(evidence, expected, rtol=0, atol=1e-5)


def test_what_has_a_closed_form() -> None:
    normals = (normal(), full(), factor())
    assert has_closed_form(*normals, mixture())
    assert not has_closed_form(mixture(), mixture())
    assert not has_closed_form(normal(), laplace())
    nested = Mixture(torch.zeros(1), mixture().expand((1,)))
    assert not has_closed_form(nested, normal())


# --- importance weights


class Case:
    """A prediction, a prior, and why no product is known."""

    def __init__(self, p: Callable[[], Distribution], prior: Callable[[], Any]) -> None:
        self.p, self.prior = p, prior


IMPORTANCE = {
    "energy": Case(normal, lambda: Density(wells)),
    "energy and base": Case(normal, lambda: Density(wells, normal(0.5, 0.8))),
    "energy and singular base": Case(full, lambda: Density(wells, factor(0.5, 0.2))),
    "mixture and energy": Case(mixture, lambda: Density(wells)),
    "two mixtures": Case(mixture, mixture),
    "another's": Case(laplace, lambda: normal(1.0, 0.8)),
    "another's and energy and base": Case(laplace, lambda: Density(wells, normal(1.0, 0.8))),
    "another's prior": Case(lambda: normal(-0.5), laplace),
}
EVERY = pytest.mark.parametrize("case", IMPORTANCE.values(), ids=IMPORTANCE)


@EVERY
def test_importance_weights_equal_numerical_integration(case: Case) -> None:
    """Evidence and moments within five standard errors of themselves, of a hundred independent runs."""
    log_evidence, mean, variance = product_integrals(case.p(), case.prior())
    fusion = fuse(case.p().expand((100,)), case.prior(), num_particles=2000, generator=seeded())
    posterior, size = fusion.posterior, fusion.effective_sample_size
    assert isinstance(posterior, FusedBelief)
    assert size is not None
    assert size.shape == fusion.log_evidence.shape == (100,)
    assert bool(((size > 50) & (size <= 2000)).all())
    for got, expected in (
        (fusion.log_evidence.exp(), math.exp(log_evidence)),
        (posterior.mean.squeeze(-1), mean),
        (posterior.variance.squeeze(-1), variance),
    ):
        error = got.std().item() / 10
        assert got.mean().item() == pytest.approx(expected, abs=5 * error + 2e-3 * abs(expected))
    z = torch.linspace(-1, 1, 5, dtype=F64).reshape(5, 1, 1)
    density = case.p().log_prob(z) + case.prior().log_prob(z) - log_evidence
    error = fusion.log_evidence.std().item()
    assert (posterior.log_prob(z).mean(1, keepdim=True) - density).abs().max() < error
    assert posterior.expand((2, 100)).log_prob(z.unsqueeze(1)).shape == (5, 2, 100)


@pytest.mark.parametrize("how", ["heads", "own"])
def test_gradients_equal_those_of_numerical_integration(how: str) -> None:
    """Of mean, variance and evidence with respect to what the prediction was computed from."""
    make: Callable[[Tensor], Distribution]
    if how == "heads":

        def make(x: Tensor) -> Distribution:
            return diag_gaussian(x, torch.tensor([0.8], dtype=F64) * x.exp().sqrt())
    else:  # drawn without gradients: the likelihood ratio moves the weights

        def make(x: Tensor) -> Distribution:
            return Independent(Laplace(x, torch.tensor([0.8], dtype=F64)), 1)

    prior = Density(wells)
    exact = []
    for shift in (-1e-4, 1e-4):
        x = torch.tensor([0.3 + shift], dtype=F64)
        exact.append(torch.tensor(product_integrals(make(x), prior)))
    expected = (exact[1] - exact[0]) / 2e-4
    x = torch.full((200, 1), 0.3, dtype=F64, requires_grad=True)
    fusion = fuse(make(x), prior, num_particles=4000, generator=seeded())
    values = fusion.log_evidence, fusion.posterior.mean, fusion.posterior.variance
    for value, want in zip(values, expected.tolist(), strict=True):
        (gradient,) = torch.autograd.grad(value.sum(), x, retain_graph=True)
        error = gradient.std().item() / math.sqrt(200)
        assert gradient.mean().item() == pytest.approx(want, abs=5 * error + 1e-2 * abs(want))


def test_common_noise_is_shared_by_all_rows_but_the_first_dimension() -> None:
    p = diag_gaussian(torch.zeros(2, 3, 4, 1), torch.ones(1))
    for shared in (True, False):
        belief = fuse(p, Density(wells), num_particles=5, shared_noise=shared).posterior
        rows = belief.particles.flatten(1, 2)
        assert bool((rows == rows[:, :1]).all()) is shared
        assert not torch.equal(rows[0], rows[1])
    one = fuse(diag_gaussian(torch.zeros(1), torch.ones(1)), Density(wells), shared_noise=True)
    assert one.posterior.particles.unique().numel() == 128


def test_a_belief_of_particles_is_weighed_where_it_is() -> None:
    belief = ParticleBelief(torch.tensor([[[-1.0], [0.0], [2.0]]]), torch.tensor([[0.2, 0.3, 0.5]]).log())
    fusion = fuse(belief, Density(lambda z: z[..., 0].abs()))
    weights = torch.tensor([[0.2, 0.3, 0.5]]) * torch.tensor([-1.0, 0.0, -2.0]).exp()
    torch.testing.assert_close(fusion.log_evidence, weights.sum(-1).log())
    torch.testing.assert_close(fusion.posterior.weights, weights / weights.sum())
    assert type(fusion.posterior) is ParticleBelief
    again = fuse(fuse(normal(), Density(wells)).posterior, Density(lambda z: z[..., 0].abs()))
    assert isinstance(again.posterior, FusedBelief)


def test_batches_of_both_broadcast() -> None:
    p = diag_gaussian(torch.zeros(5, 1, 2), torch.ones(2))
    goal = diag_gaussian(torch.randn(3, 2), torch.ones(2))
    assert fuse(p, goal).log_evidence.shape == (5, 3)
    own = Independent(Laplace(torch.zeros(5, 1, 2), torch.ones(2)), 1)
    assert fuse(own, goal).posterior.mean.shape == (5, 3, 2)
    scales = torch.arange(5.0, dtype=F64)
    measured = GaussianFactor(torch.eye(1, dtype=F64), torch.zeros(1, dtype=F64), scales)
    evidence = fuse(mixture().expand((5,)), measured).log_evidence
    torch.testing.assert_close(evidence - scales, evidence[:1].expand(5))
    tasks = torch.randn(3, 2)
    energy = Density(lambda z: (z - tasks).square().sum(-1))
    assert fuse(p.expand((5, 3)), energy).posterior.mean.shape == (5, 3, 2)


# --- faults


def row_energy(*values: float) -> Density:
    table = torch.tensor(values, dtype=F64)
    return Density(lambda z: table + 0.0 * z[..., 0])


def test_rows_without_weight_fall_back_with_a_warning() -> None:
    p = normal().expand((4,))
    prior = row_energy(0.0, math.inf, math.nan, -math.inf)
    with pytest.warns(RuntimeWarning, match="gives 3 of 4 rows no weight at all"):
        fusion = fuse(p, prior, generator=seeded())
    assert fusion.log_evidence.tolist() == [pytest.approx(0.0), -math.inf, -math.inf, -math.inf]
    posterior = fusion.posterior
    torch.testing.assert_close(posterior.mean, posterior.particles.mean(-2))
    torch.testing.assert_close(
        posterior.log_prob(torch.ones(4, 1, dtype=F64)), p.log_prob(torch.ones(4, 1, dtype=F64))
    )
    assert fusion.effective_sample_size.tolist() == pytest.approx([128.0] * 4)


def test_a_weight_that_is_nan_counts_as_zero_and_gradients_stay_finite() -> None:
    x = torch.zeros(2, 1, dtype=F64, requires_grad=True)

    def energy(z: Tensor) -> Tensor:
        good = torch.where(z[..., 0] > 0, z[..., 0].square(), math.nan)
        return torch.where(torch.tensor([True, False]), good, math.inf)

    with pytest.warns(RuntimeWarning, match="it counts as zero"):
        fusion = fuse(diag_gaussian(x, torch.ones(1, dtype=F64)), Density(energy))
    assert fusion.posterior.mean[0] > 0.1
    (gradient,) = torch.autograd.grad(fusion.posterior.mean.sum() + fusion.log_evidence[0], x)
    assert gradient.isfinite().all()


def test_a_healthy_fusion_does_not_warn() -> None:
    hard = Density(lambda z: torch.where(z[..., 0] > 0, 0.0, math.inf))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fusion = fuse(normal(), hard, num_particles=4000, generator=seeded())
    assert fusion.log_evidence.exp().item() == pytest.approx(0.5, abs=5 * 0.5 / math.sqrt(4000))
    assert fusion.posterior.log_prob(torch.tensor([-1.0], dtype=F64)).item() == -math.inf


def sampled(how: Any, p: Distribution | None = None, **kwargs: Any) -> Tensor:
    return sample_posterior(normal() if p is None else p, Density(wells), how=how, **kwargs)


PARTICLES = ParticleBelief(torch.zeros(3, 1))
META = {"device": "meta"}
WIDE = GaussianFactor(torch.eye(3), torch.zeros(3))
REFUSED: dict[str, tuple[Callable[[], Any], type[Exception]]] = {
    "num_particles must be at least 1, got 0": (
        lambda: fuse(normal(), Density(wells), num_particles=0),
        ValueError,
    ),
    r"latent size of p, \(1,\), got \(2,\)": (
        lambda: fuse(normal(), diag_gaussian(torch.zeros(2), torch.ones(2))),
        ValueError,
    ),
    r"latent size of p, \(1,\), got \(3,\)": (lambda: fuse(normal(), Density(wells, WIDE)), ValueError),
    "on the device of p, cpu, got meta": (
        lambda: fuse(normal(), diag_gaussian(torch.zeros(1, **META), torch.ones(1, **META))),
        ValueError,
    ),
    "must have a width for the prior": (lambda: fuse(Delta(torch.zeros(1)), normal()), TypeError),
    r"must return a tensor of shape \(128,\)": (lambda: fuse(normal(), Density(lambda z: z)), ValueError),
    "energy must return a tensor": (lambda: fuse(normal(), Density(lambda z: 1.0)), ValueError),
    r"broadcast to \(128,\) for latents \(128, 1\), got \(7, 128\)": (
        lambda: fuse(normal(), Density(lambda z: torch.zeros(7, *z.shape[:-1]))),
        ValueError,
    ),
    "p must give finite latents": (lambda: fuse(normal(math.nan), Density(wells)), ValueError),
    "how='exact' needs Gaussians": (lambda: sampled("exact"), ValueError),
    "how must be 'exact', 'importance' or 'langevin', got 'best'": (lambda: sampled("best"), ValueError),
    "needs the density of p": (lambda: sampled("langevin", PARTICLES), TypeError),
    "step_size must be positive, got 0.0": (lambda: sampled("langevin", step_size=0.0), ValueError),
    "num_steps must be at least 0, got -1": (lambda: sampled("langevin", num_steps=-1), ValueError),
    r"must return a tensor of shape \(3,\)": (lambda: langevin(lambda z: z, torch.zeros(3, 1)), ValueError),
    "log_prob must be differentiable": (
        lambda: langevin(lambda z: wells(z).detach(), torch.zeros(3, 1)),
        ValueError,
    ),
    "num_restarts must be at least 1, got 0": (
        lambda: map_estimate(normal(), Density(wells), num_restarts=0),
        ValueError,
    ),
    "prior must be differentiable in the latent": (
        lambda: map_estimate(normal(), Density(lambda z: wells(z).detach())),
        ValueError,
    ),
    "p must have a density": (lambda: map_estimate(PARTICLES, Density(wells)), TypeError),
}


@pytest.mark.parametrize("message", REFUSED)
def test_bad_input_is_refused(message: str) -> None:
    call, error = REFUSED[message]
    with pytest.raises(error, match=message):
        call()
