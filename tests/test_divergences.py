"""Divergences and entropies: torch's where it has them, definitions and bounds where it has not."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.distributions import (
    Beta,
    Distribution,
    Exponential,
    Independent,
    LowRankMultivariateNormal,
    MultivariateNormal,
    Normal,
)
from torch.distributions import kl_divergence as torch_kl

from torchrl_vjepa.distributions import (
    Delta,
    LowRankGaussian,
    Mixture,
    diag_gaussian,
    entropy_bounds,
    full_gaussian,
    kl_divergence,
    moments,
    monte_carlo_entropy,
    monte_carlo_kl,
    product_of_experts,
)
from torchrl_vjepa.heads import EnsembleHead, FlowHead

D = 3


def _loc(*batch: int) -> Tensor:
    return torch.randn(*batch, D, dtype=torch.float64)


def _scale(*batch: int) -> Tensor:
    return torch.rand(*batch, D, dtype=torch.float64) + 0.3


def _tril(*batch: int) -> Tensor:
    lower = torch.randn(*batch, D, D, dtype=torch.float64).tril(-1)
    return lower + torch.diag_embed(_scale(*batch))


def _factor(*batch: int) -> Tensor:
    return torch.randn(*batch, D, 2, dtype=torch.float64)


GAUSSIANS: dict[str, Callable[..., Distribution]] = {
    "diagonal": lambda *b: diag_gaussian(_loc(*b), _scale(*b)),
    "torch's diagonal": lambda *b: Independent(Normal(_loc(*b), _scale(*b)), 1),
    "full": lambda *b: full_gaussian(_loc(*b), _tril(*b)),
    "torch's full": lambda *b: MultivariateNormal(_loc(*b), scale_tril=_tril(*b)),
    "low rank": lambda *b: LowRankGaussian(_loc(*b), _factor(*b), _scale(*b)),
    "torch's low rank": lambda *b: LowRankMultivariateNormal(_loc(*b), _factor(*b), _scale(*b)),
}


def dense(p: Distribution) -> MultivariateNormal:
    return MultivariateNormal(*moments(p))


@pytest.mark.parametrize("first", GAUSSIANS)
@pytest.mark.parametrize("second", GAUSSIANS)
@pytest.mark.parametrize(("batch_p", "batch_q"), [((), ()), ((4,), ()), ((2, 4), (4,)), ((), (4,))])
def test_every_pair_of_gaussians_in_closed_form(
    first: str, second: str, batch_p: tuple[int, ...], batch_q: tuple[int, ...]
) -> None:
    p, q = GAUSSIANS[first](*batch_p), GAUSSIANS[second](*batch_q)
    shape = torch.broadcast_shapes(batch_p, batch_q)
    found = kl_divergence(p, q)
    torch.testing.assert_close(found, torch_kl(dense(p).expand(shape), dense(q).expand(shape)))
    assert (found > 0).all()
    torch.testing.assert_close(
        kl_divergence(p, p), torch.zeros(batch_p, dtype=torch.float64), rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("second", GAUSSIANS)
def test_divergences_under_vmap_and_with_gradients(second: str) -> None:
    q = GAUSSIANS[second]()
    loc, scale = _loc(5).requires_grad_(), _scale(5).requires_grad_()
    together = torch.vmap(lambda m, s: kl_divergence(diag_gaussian(m, s), q))(loc, scale)
    torch.testing.assert_close(together, kl_divergence(diag_gaussian(loc, scale), q))
    assert torch.autograd.gradcheck(lambda m, s: kl_divergence(diag_gaussian(m, s), q), (loc, scale))


@pytest.mark.parametrize("name", ["full", "low rank"])
def test_gaussians_are_torchs(name: str) -> None:
    p = GAUSSIANS[name](4)
    q = dense(p)
    z = torch.randn(6, 4, D, dtype=torch.float64)
    torch.testing.assert_close(p.log_prob(z), q.log_prob(z))
    torch.testing.assert_close(p.entropy(), q.entropy())
    torch.testing.assert_close(p.variance, q.variance)
    torch.testing.assert_close(p.mode, q.mean)


def test_a_pair_that_torch_knows_is_torchs() -> None:
    p, q = (Independent(Beta(torch.rand(4, 2) + 1, torch.rand(4, 2) + 1), 1) for _ in range(2))
    torch.testing.assert_close(kl_divergence(p, q), torch_kl(p, q))


# Estimators ---------------------------------------------------------------------------------------


def _mixture(*batch: int) -> Mixture:
    logits = torch.randn(*batch, 3, dtype=torch.float64)
    return Mixture(logits, diag_gaussian(2 * _loc(*batch, 3), _scale(*batch, 3)))


def _flow(*batch: int) -> Distribution:
    head = FlowHead(2, 8, 4)
    features = torch.randn(*batch, head.num_features(D), dtype=torch.float64)
    return head(features, head.init_constants(D).double())


def _ensemble(*batch: int) -> Distribution:
    head = EnsembleHead(num_members=3, num_cells=4)
    features = torch.randn(*batch, head.num_features(D), dtype=torch.float64)
    return head(features, head.init_constants(D).double())


ALL = {**GAUSSIANS, "mixture": _mixture, "flow": _flow, "ensemble": _ensemble}
NO_CLOSED_FORM = ["mixture", "flow", "ensemble"]


@pytest.mark.parametrize("name", [name for name in ALL if name != "torch's low rank"])
def test_the_estimate_is_within_its_standard_error(name: str) -> None:
    """Of the closed form for Gaussians; of a plain average over many draws for others."""
    p, q = ALL[name](4), GAUSSIANS["diagonal"]()
    value, error = monte_carlo_kl(p, q, 4000, generator=torch.Generator().manual_seed(0))
    assert value.shape == error.shape == (4,)
    if name in GAUSSIANS:
        reference, spread = kl_divergence(p, q), torch.zeros(4, dtype=torch.float64)
    else:
        with torch.no_grad():
            z = p.sample((40_000,))
            ratio = p.log_prob(z) - q.log_prob(z)
        reference, spread = ratio.mean(0), ratio.std(0) / 200
    assert ((value - reference).abs() < 5 * (error**2 + spread**2).sqrt()).all()
    assert (error > 0).all()


@pytest.mark.parametrize("name", NO_CLOSED_FORM)
def test_the_standard_error_is_the_spread_of_the_estimate(name: str) -> None:
    p, q = ALL[name](), GAUSSIANS["diagonal"]()
    found = [monte_carlo_kl(p, q, 50, generator=torch.Generator().manual_seed(i)) for i in range(200)]
    values = torch.stack([value.detach() for value, _ in found])
    stated = torch.stack([error for _, error in found]).square().mean().sqrt()
    assert abs(float(values.std() / stated) - 1) < 0.25


@pytest.mark.parametrize("name", NO_CLOSED_FORM)
def test_estimates_of_a_generator_are_deterministic(name: str) -> None:
    p, q = ALL[name](2), GAUSSIANS["full"]()
    before = torch.get_rng_state()
    first, second = (
        kl_divergence(p, q, num_samples=8, generator=torch.Generator().manual_seed(1)) for _ in range(2)
    )
    assert torch.equal(first, second)
    assert torch.equal(before, torch.get_rng_state())


def test_strata_make_the_gradient_of_a_mixture_exact_in_expectation() -> None:
    """The cross-entropy with a Gaussian has a closed form; the entropy's gradient comes from quadrature."""
    logits = torch.tensor([0.3, -0.2], dtype=torch.float64, requires_grad=True)
    loc = torch.tensor([[-1.0], [0.8]], dtype=torch.float64, requires_grad=True)
    scale = torch.tensor([[0.5], [0.9]], dtype=torch.float64, requires_grad=True)
    q = diag_gaussian(torch.zeros(1).double(), torch.ones(1).double())
    grid = torch.linspace(-12, 12, 4001, dtype=torch.float64).unsqueeze(-1)
    log_p = Mixture(logits, diag_gaussian(loc, scale)).log_prob(grid)
    exact = (log_p.exp() * (log_p - q.log_prob(grid))).sum() * (grid[1, 0] - grid[0, 0])
    expected = torch.autograd.grad(exact, (logits, loc, scale))
    rows = [
        torch.autograd.grad(
            kl_divergence(
                Mixture(logits, diag_gaussian(loc, scale)),
                q,
                num_samples=500,
                generator=torch.Generator().manual_seed(i),
            ),
            (logits, loc, scale),
        )
        for i in range(30)
    ]
    for store, reference in zip(zip(*rows, strict=True), expected, strict=True):
        stacked = torch.stack(list(store))
        assert ((stacked.mean(0) - reference).abs() < 5 * stacked.std(0) / 30**0.5 + 1e-9).all()


# Entropy ------------------------------------------------------------------------------------------


@settings(max_examples=25)
@given(st.integers(0, 10_000), st.integers(1, 4), st.floats(0.0, 10.0))
def test_bounds_hold_the_entropy(seed: int, num: int, spread: float) -> None:
    torch.manual_seed(seed)
    loc = spread * torch.randn(num, 1, dtype=torch.float64)
    scale = torch.rand(num, 1, dtype=torch.float64) + 0.3
    p = Mixture(torch.randn(num, dtype=torch.float64), diag_gaussian(loc, scale))
    width = float(loc.abs().max()) + 12
    grid = torch.linspace(-width, width, 20_001, dtype=torch.float64).unsqueeze(-1)
    log_p = p.log_prob(grid)
    entropy = -(log_p.exp() * log_p).sum() * (grid[1, 0] - grid[0, 0])
    low, high = entropy_bounds(p)
    assert low - 1e-6 <= entropy <= high + 1e-6
    value, error = monte_carlo_entropy(p, 2000, generator=torch.Generator().manual_seed(0))
    assert (value - entropy).abs() < 5 * error + 1e-9


def test_bounds_are_exact_for_equal_and_for_far_components() -> None:
    scale = torch.tensor([0.5, 2.0, 1.0])
    own = Independent(Normal(torch.zeros(D), scale), 1).entropy()
    weights = torch.tensor([0.3, 0.7])
    for distance, extra in ((0.0, 0.0), (1e3, -float((weights * weights.log()).sum()))):
        loc = torch.stack([torch.zeros(D), torch.full((D,), distance)])
        for bound in entropy_bounds(Mixture(weights.log(), diag_gaussian(loc, scale))):
            torch.testing.assert_close(bound, own + extra)


def test_bounds_have_batches() -> None:
    low, high = entropy_bounds(_mixture(2, 4))
    assert low.shape == high.shape == (2, 4)
    assert (low <= high).all()


# Moments and products -----------------------------------------------------------------------------


def test_moments_of_what_torch_does_not_know_are_sampled() -> None:
    base = Independent(Normal(torch.zeros(2), torch.tensor([0.1, 0.2])), 1)
    p = torch.distributions.TransformedDistribution(base, [torch.distributions.transforms.ExpTransform()])
    mean, covariance = moments(p, num_samples=50_000, generator=torch.Generator().manual_seed(0))
    variance = torch.tensor([0.01, 0.04])
    exact = (variance / 2).exp()
    spread = ((variance.exp() - 1) * variance.exp()).sqrt()
    assert ((mean - exact).abs() < 5 * spread / 50_000**0.5).all()
    torch.testing.assert_close(covariance.diagonal(), spread**2, rtol=0.05, atol=0)
    assert torch.equal(covariance, covariance.mT)


def test_moments_of_a_point() -> None:
    mean, covariance = moments(Delta(torch.ones(4, 2)))
    assert torch.equal(mean, torch.ones(4, 2))
    assert torch.equal(covariance, torch.zeros(4, 2, 2))


@pytest.mark.parametrize("prior", ["diagonal", "full", "low rank"])
def test_product_with_a_mixture_is_the_normalised_product_of_densities(prior: str) -> None:
    p, q = _mixture(4), GAUSSIANS[prior]()
    product = product_of_experts(q, p)
    assert isinstance(product, Mixture)
    z = torch.randn(50, 4, D, dtype=torch.float64)
    log_ratio = p.log_prob(z) + q.log_prob(z) - product.log_prob(z)
    torch.testing.assert_close(log_ratio, log_ratio[:1].expand_as(log_ratio))
    draws = q.sample((40_000,)).unsqueeze(1)
    overlap = p.log_prob(draws).exp()  # E_q[p] is the constant
    bound = 5 * overlap.std(0) / 200
    assert ((overlap.mean(0) - log_ratio[0].exp()).abs() < bound).all()


def test_product_with_a_low_rank_gaussian_is_that_with_its_covariance() -> None:
    p, q = GAUSSIANS["low rank"](4), GAUSSIANS["diagonal"]()
    found, expected = product_of_experts(p, q), product_of_experts(dense(p), q)
    torch.testing.assert_close(found.mean, expected.mean)
    torch.testing.assert_close(moments(found)[1], moments(expected)[1])


def test_a_mixture_alone_is_its_own_product_and_two_are_refused() -> None:
    p = _mixture(4)
    assert product_of_experts(p) is p
    with pytest.raises(TypeError, match="one Mixture of them may be"):
        product_of_experts(p, _mixture(4))


# Bad input ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda: kl_divergence(_mixture(), _flow()),
            TypeError,
            "closed form, got Mixture and Coupling",
        ),
        (
            lambda: kl_divergence(Delta(_loc()), _mixture()),
            TypeError,
            "p must have a density, got a point mass",
        ),
        (lambda: monte_carlo_kl(_mixture(), Delta(_loc())), TypeError, "q must have a density"),
        (lambda: monte_carlo_entropy(Delta(_loc())), TypeError, "p must have a density"),
        (lambda: monte_carlo_kl(_mixture(), _flow(), 1), ValueError, "num_samples must be at least 2, got 1"),
        (
            lambda: kl_divergence(_mixture(), diag_gaussian(torch.zeros(2), torch.ones(2))),
            ValueError,
            r"same event shape, got \(3,\) and \(2,\)",
        ),
        (lambda: entropy_bounds(_flow()), TypeError, "mixture of diagonal Gaussians, got CouplingFlow"),
        (
            lambda: monte_carlo_entropy(
                Independent(Exponential(torch.ones(2)), 1), generator=torch.Generator()
            ),
            TypeError,
            "generator must be None for a Independent",
        ),
        (lambda: moments(Normal(torch.zeros(2), 1.0)), ValueError, r"event of shape \(D,\), got \(\)"),
        (lambda: moments(_flow(), num_samples=1), ValueError, "num_samples must be at least 2, got 1"),
        (
            lambda: LowRankGaussian(torch.zeros(3), torch.zeros(2, 1), torch.ones(3)),
            ValueError,
            r"shapes \(\*B, D\), \(\*B, D, R\) and \(\*B, D\), got \(3,\), \(2, 1\) and \(3,\)",
        ),
    ],
)
def test_bad_input_is_refused(call: Callable[[], object], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        call()


def test_entropy_of_a_gaussian_by_draws() -> None:
    p = GAUSSIANS["torch's diagonal"](4)
    value, error = monte_carlo_entropy(p, 5000, generator=torch.Generator().manual_seed(0))
    assert ((value - p.entropy()).abs() < 5 * error).all()
    exponential = Independent(Exponential(torch.ones(1)), 1)
    value, error = monte_carlo_entropy(exponential, 5000)
    assert abs(float(value) - 1.0) < 5 * float(error)
    assert math.isfinite(float(error))
