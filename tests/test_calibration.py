"""Intervals, scores and recalibration against closed forms, integrals and known factors."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.integrate import quad
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import (
    Categorical,
    Distribution,
    Independent,
    Laplace,
    LowRankMultivariateNormal,
    MixtureSameFamily,
    MultivariateNormal,
)

from torchrl_vjepa import (
    VJEPA,
    Delta,
    DeltaHead,
    DiagGaussianHead,
    Head,
    LowRankGaussian,
    Mixture,
    PixelAR,
    PixelDecoder,
    Predictor,
    calibration_by_horizon,
    calibration_by_skip,
    coverage,
    credible_interval,
    crps,
    diag_gaussian,
    energy_score,
    linear_encoder,
    pit_histogram,
    probability_integral_transform,
    recalibrate,
    reliability_curve,
    rollout,
)

N, D = 3000, 2
GRID = torch.arange(1, N + 1).double() / (N + 1)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal_scores() -> Tensor:
    """Quantiles of N(0, 1) at an even grid: a sample without sampling error, (N, 1)."""
    return torch.special.ndtri(GRID).unsqueeze(-1)


def gaussian(scale: float, num: int = N, dim: int = 1) -> Distribution:
    return diag_gaussian(torch.zeros(num, dim).double(), torch.full((dim,), scale).double())


def correlated(num: int = N) -> MultivariateNormal:
    loc = torch.tensor([1.0, -2.0]).double().expand(num, D)
    return MultivariateNormal(loc, torch.tensor([[4.0, 1.5], [1.5, 1.0]]).double())


def mixture(num: int = N) -> MixtureSameFamily:
    """Skewed, bimodal, correlated by its components."""
    loc = torch.tensor([[-2.0, 0.0], [1.0, 1.0], [4.0, -1.0]]).double()
    scale = torch.tensor([[0.5, 1.0], [1.0, 0.3], [0.2, 2.0]]).double()
    weights = torch.tensor([0.5, 0.3, 0.2]).double()
    return MixtureSameFamily(Categorical(weights.expand(num, 3)), diag_gaussian(loc.expand(num, 3, D), scale))


def laplace(num: int = N) -> Distribution:
    return Independent(Laplace(torch.zeros(num, D).double(), torch.tensor([1.0, 3.0]).double()), 1)


FAMILIES: dict[str, Callable[..., Distribution]] = {
    "full": correlated,
    "low_rank": lambda num=N: LowRankMultivariateNormal(
        torch.zeros(num, D).double(), torch.ones(num, D, 1).double(), torch.ones(num, D).double()
    ),
    "our_low_rank": lambda num=N: LowRankGaussian(
        torch.zeros(num, D).double(), torch.ones(num, D, 1).double(), torch.ones(num, D).double()
    ),
    "diagonal": lambda num=N: gaussian(2.0, num, D),
    "mixture": mixture,
    "laplace": laplace,
}
EVERY_FAMILY = pytest.mark.parametrize("make", FAMILIES.values(), ids=FAMILIES)


def truth(make: Callable[..., Distribution], num: int = N, seed: int = 1) -> Tensor:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return make(num).sample()


# --- intervals


@pytest.mark.parametrize("level", [0.05, 0.5, 0.9, 0.99])
def test_gaussian_intervals_are_those_of_scipy(level: float) -> None:
    low, high = credible_interval(correlated(1), level)
    for d, (loc, std) in enumerate(((1.0, 2.0), (-2.0, 1.0))):
        expected = stats.norm.interval(level, loc, std)
        assert (low[0, d].item(), high[0, d].item()) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("level", [0.05, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_coverage_of_a_wrong_scale_has_a_closed_form(scale: float, level: float) -> None:
    # P(|Z| <= s q) = 2 Phi(s q) - 1, with q the quantile of (1 + level) / 2
    expected = 2 * stats.norm.cdf(scale * stats.norm.ppf((1 + level) / 2)) - 1
    covered = coverage(gaussian(scale), normal_scores(), level)
    assert covered.item() == pytest.approx(expected, abs=2 / N)
    assert reliability_curve(gaussian(scale), normal_scores(), [level]).coverage.item() == covered.item()


@pytest.mark.parametrize("level", [0.1, 0.9])
@pytest.mark.parametrize("count", [19, 20, 57, 400])
def test_sample_intervals_cover_exactly_on_average_however_few_samples(count: int, level: float) -> None:
    rounds = 5000
    target = truth(laplace, rounds)
    samples = truth(laplace, rounds * count, seed=2).reshape(rounds, count, D).transpose(0, 1)
    inside = credible_interval(samples, level).contains(target).double()
    assert inside.mean(0) == pytest.approx(level, abs=5 * math.sqrt(level * (1 - level) / rounds))


@pytest.mark.parametrize("count", [19, 20, 57])
def test_sample_intervals_are_numpys_quantiles(count: int) -> None:
    samples = truth(laplace, count).unsqueeze(1)
    expected = np.quantile(samples.numpy(), [0.05, 0.95], axis=0, method="weibull")
    for end, value in zip(credible_interval(samples, 0.9), expected, strict=True):
        np.testing.assert_allclose(end.numpy(), value, rtol=1e-12)


@EVERY_FAMILY
@pytest.mark.parametrize("joint", [False, True])
def test_the_true_belief_covers_what_it_says(make: Callable[..., Distribution], joint: bool) -> None:
    target = truth(make)
    for level in (0.5, 0.9):
        covered = coverage(make(), target, level, joint=joint, num_samples=99, generator=generator())
        # Dimensions may be dependent: the error is at most that of N independent trials.
        assert abs(covered - level) < 5 * math.sqrt(level * (1 - level) / N)


def test_joint_regions_see_correlations() -> None:
    target = truth(correlated)
    ignorant = diag_gaussian(correlated().mean, correlated().stddev)
    assert abs(coverage(ignorant, target, 0.9) - 0.9) < 0.02
    assert coverage(correlated(), target, 0.5, joint=True) < 0.52
    assert coverage(ignorant, target, 0.5, joint=True) > 0.55


def test_the_joint_region_of_a_gaussian_is_the_ellipsoid() -> None:
    p, target = correlated(), truth(correlated)
    difference = target - p.mean
    distance = (difference * torch.linalg.solve(p.covariance_matrix, difference)).sum(-1)
    expected = stats.chi2(D).cdf(distance.numpy())
    values = probability_integral_transform(p, target, joint=True)
    np.testing.assert_allclose(values.numpy(), expected, atol=1e-9)
    inside = torch.as_tensor(expected <= 0.5).double().mean()
    assert coverage(p, target, 0.5, joint=True) == inside


def test_the_joint_rank_counts_the_region_of_higher_density() -> None:
    target = torch.tensor([[0.0, 0.0], [9.0, 30.0]]).double()
    centre, far = probability_integral_transform(laplace(2), target, joint=True, generator=generator())
    assert centre < 0.01
    assert far > 0.99


def test_points_cover_only_themselves() -> None:
    p = Delta(torch.zeros(4, D))
    target = torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [-1.0, 1.0]])
    assert coverage(p, target, 0.5) == 0.5
    assert coverage(p, target, 0.5, joint=True) == 0.25
    values = probability_integral_transform(p, target, generator=generator())
    assert values[1:, 0].tolist()[1:] == [1.0, 0.0]
    assert 0 < values[0, 0] < 1


# --- probability integral transform


@EVERY_FAMILY
@pytest.mark.parametrize("joint", [False, True])
def test_the_transform_of_the_truth_is_uniform(make: Callable[..., Distribution], joint: bool) -> None:
    values = probability_integral_transform(
        make(), truth(make), joint=joint, num_samples=99, generator=generator()
    )
    assert values.shape == ((N,) if joint else (N, D))
    for column in values.reshape(N, -1).unbind(-1):
        # Kolmogorov and Smirnov, with the bound of Dvoretzky, Kiefer, Wolfowitz and Massart at 1e-6
        distance = stats.kstest(column.numpy(), "uniform").statistic
        assert distance < math.sqrt(math.log(2 / 1e-6) / (2 * N))


def test_the_transform_is_the_distribution_function() -> None:
    p, target = correlated(), truth(correlated)
    expected = stats.norm.cdf(target.numpy(), p.mean.numpy(), p.stddev.numpy())
    np.testing.assert_allclose(probability_integral_transform(p, target).numpy(), expected, atol=1e-12)


def test_ties_share_the_interval_between_them() -> None:
    samples = torch.tensor([0.0, 1.0, 1.0, 2.0]).reshape(4, 1, 1).expand(4, 10_000, 1)
    values = probability_integral_transform(samples, torch.ones(10_000, 1), generator=generator())
    assert values.min() >= 0.2
    assert values.max() <= 0.8
    assert values.mean().item() == pytest.approx(0.5, abs=5 * 0.6 / math.sqrt(12 * 10_000))


def test_the_histogram_is_a_density() -> None:
    density, edges = pit_histogram(torch.tensor([0.0, 0.24, 0.25, 1.0, math.nan]), 4)
    assert density.tolist() == [2.0, 1.0, 0.0, 1.0]
    assert edges.tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]
    values = probability_integral_transform(gaussian(1.0), normal_scores())
    torch.testing.assert_close(pit_histogram(values, 10).density, torch.ones(10).double(), atol=0.01, rtol=0)


@pytest.mark.parametrize(("scale", "valley"), [(0.5, True), (2.0, False)])
def test_a_narrow_belief_has_a_valley_and_a_wide_one_a_hill(scale: float, valley: bool) -> None:
    density = pit_histogram(probability_integral_transform(gaussian(scale), normal_scores()), 4).density
    assert bool(density[0] > density[1]) == valley
    assert bool(density[3] > density[2]) == valley


def test_the_reliability_curve_of_an_overconfident_belief_is_under_the_diagonal() -> None:
    curve = reliability_curve(gaussian(0.5), normal_scores())
    assert len(curve.levels) == 19
    assert (curve.coverage < curve.levels).all()
    assert curve.error == (curve.levels - curve.coverage).mean()
    assert reliability_curve(gaussian(1.0), normal_scores()).error < 1e-3


# --- scores


@pytest.mark.parametrize("target", [-3.0, 0.2, 1.0, 40.0])
def test_gaussian_crps_is_the_integral(target: float) -> None:
    p = diag_gaussian(torch.tensor([1.0]).double(), torch.tensor([2.0]).double())

    def below(y: float) -> float:
        return stats.norm.cdf(y, 1.0, 2.0) ** 2

    def above(y: float) -> float:
        return stats.norm.sf(y, 1.0, 2.0) ** 2

    integral = quad(below, -60, target, points=[1.0])[0] + quad(above, target, 80, points=[1.0])[0]
    value = crps(p, torch.tensor([target]).double())
    assert value.item() == pytest.approx(integral, rel=1e-6)


def test_expected_gaussian_crps_has_a_closed_form() -> None:
    # E_{z ~ N(0, 1)} CRPS(N(0, s), z) = E|sX - z| - s / sqrt(pi), and sX - z ~ N(0, 1 + s^2)
    nodes, weights = np.polynomial.hermite_e.hermegauss(120)
    for scale in (0.3, 1.0, 2.5):
        target = torch.from_numpy(nodes).unsqueeze(-1)
        scores = crps(gaussian(scale, len(nodes)), target).squeeze(-1).numpy()
        expected = math.sqrt(2 * (1 + scale**2) / math.pi) - scale / math.sqrt(math.pi)
        assert (scores @ weights) / weights.sum() == pytest.approx(expected, rel=1e-3)


def mixture_crps(p: MixtureSameFamily, target: Tensor) -> Tensor:
    """Closed form for mixtures of Gaussians (Grimit and others, 2006), (B, D)."""
    weight = p.mixture_distribution.probs.unsqueeze(-1)
    loc, var = p.component_distribution.mean, p.component_distribution.variance

    def absolute(mean: Tensor, variance: Tensor) -> Tensor:
        """E|X| of a Gaussian."""
        std = variance.sqrt()
        return mean * torch.erf(mean / std / math.sqrt(2)) + std * math.sqrt(2 / math.pi) * torch.exp(
            -0.5 * (mean / std) ** 2
        )

    first = (weight * absolute(target.unsqueeze(1) - loc, var)).sum(1)
    pairs = absolute(loc.unsqueeze(1) - loc.unsqueeze(2), var.unsqueeze(1) + var.unsqueeze(2))
    second = (weight.unsqueeze(1) * weight.unsqueeze(2) * pairs).sum((1, 2))
    return first - 0.5 * second


@pytest.mark.parametrize("num_samples", [2, 3, 20])
def test_sampled_crps_is_unbiased_however_few_samples(num_samples: int) -> None:
    rounds = 40_000
    target = torch.tensor([0.7, -0.4]).double().expand(rounds, D)
    estimates = crps(mixture(rounds), target, num_samples=num_samples, generator=generator())
    exact = mixture_crps(mixture(1), target[:1])[0]
    error = estimates.std(0) / math.sqrt(rounds)
    assert ((estimates.mean(0) - exact).abs() < 5 * error).all()


@pytest.mark.parametrize("num_samples", [2, 5])
def test_sampled_energy_score_is_unbiased(num_samples: int) -> None:
    # For two independent standard normals E|Z - z| at z = 0 is sqrt(pi / 2), and E|Z - Z'| is sqrt(pi).
    rounds = 20_000
    p = gaussian(1.0, rounds, D)
    estimates = energy_score(
        p, torch.zeros(rounds, D).double(), num_samples=num_samples, generator=generator()
    )
    exact = math.sqrt(math.pi / 2) - math.sqrt(math.pi) / 2
    assert abs(estimates.mean() - exact) < 5 * estimates.std() / math.sqrt(rounds)


def test_the_estimators_are_their_definitions() -> None:
    samples, target = torch.randn(7, 3, D).double(), torch.randn(3, D).double()
    scores, whole = crps(samples, target), energy_score(samples, target)
    for b in range(3):
        pairs = [(i, j) for i in range(7) for j in range(7)]
        for d in range(D):
            near = sum(abs(samples[i, b, d] - target[b, d]) for i in range(7)) / 7
            spread = sum(abs(samples[i, b, d] - samples[j, b, d]) for i, j in pairs) / (2 * 7 * 6)
            assert scores[b, d].item() == pytest.approx((near - spread).item())
        near = sum((samples[i, b] - target[b]).norm() for i in range(7)) / 7
        spread = sum((samples[i, b] - samples[j, b]).norm() for i, j in pairs) / (2 * 7 * 6)
        assert whole[b].item() == pytest.approx((near - spread).item())


def test_the_energy_score_is_the_crps_in_one_dimension(monkeypatch: pytest.MonkeyPatch) -> None:
    samples, target = torch.randn(50, 4, 6, 1).double(), torch.randn(4, 6, 1).double()
    torch.testing.assert_close(energy_score(samples, target), crps(samples, target).squeeze(-1))
    whole = energy_score(samples, target)
    monkeypatch.setattr("torchrl_vjepa.diagnostics.scores._CHUNK", 1)  # one latent at a time
    torch.testing.assert_close(energy_score(samples, target), whole)


def test_close_samples_far_from_zero_lose_no_digits() -> None:
    samples = torch.randn(60, 1, D).double() * 1e-6 + 1e4
    shifted = samples - 1e4
    target = torch.zeros(1, D).double()
    torch.testing.assert_close(
        energy_score(samples, target + 1e4), energy_score(shifted, target), rtol=1e-4, atol=0
    )


@pytest.mark.parametrize(
    "score", [lambda p, z: crps(p, z).mean(), lambda p, z: energy_score(p, z, num_samples=40).mean()]
)
def test_scores_prefer_the_truth(score: Callable[[Distribution, Tensor], Tensor]) -> None:
    torch.manual_seed(0)
    target = normal_scores()
    right = score(gaussian(1.0), target)
    for scale in (0.6, 1.6):
        assert score(gaussian(scale), target) > right + 0.01
    biased = diag_gaussian(torch.full((N, 1), 0.5).double(), torch.ones(1).double())
    assert score(biased, target) > right + 0.01


def test_the_energy_score_sees_correlations() -> None:
    target = truth(correlated)
    ignorant = diag_gaussian(correlated().mean, correlated().stddev)
    torch.testing.assert_close(crps(ignorant, target), crps(correlated(), target))
    difference = energy_score(ignorant, target, num_samples=60, generator=generator()) - energy_score(
        correlated(), target, num_samples=60, generator=generator()
    )
    assert difference.mean() > 3 * difference.std() / math.sqrt(N)


def test_a_points_scores_are_distances() -> None:
    target = torch.randn(5, D)
    torch.testing.assert_close(crps(Delta(torch.ones(5, D)), target), (target - 1).abs())
    torch.testing.assert_close(energy_score(Delta(torch.ones(5, D)), target), (target - 1).norm(dim=-1))


def test_gaussian_crps_is_differentiable() -> None:
    target = torch.randn(3, D).double()
    inputs = (torch.randn(3, D).double().requires_grad_(), torch.rand(D).double().requires_grad_())
    assert torch.autograd.gradcheck(lambda m, s: crps(diag_gaussian(m, s + 0.5), target), inputs)


@settings(max_examples=25)
@given(
    st.floats(-1e3, 1e3),
    st.floats(1e-3, 1e3),
    st.floats(-1e3, 1e3),
    st.floats(1e-2, 1e2),
    st.floats(0.01, 0.99),
)
def test_units_and_origin_do_not_matter(
    mean: float, std: float, target: float, unit: float, level: float
) -> None:
    def measures(unit: float, origin: float) -> tuple[Tensor, ...]:
        loc, scale, z = torch.tensor(
            [[origin + unit * mean], [unit * std], [origin + unit * target]], dtype=torch.float64
        )
        p = diag_gaussian(loc, scale)
        low, high = credible_interval(p, level)
        return crps(p, z) / unit, probability_integral_transform(p, z), (high - low) / unit

    for one, other in zip(measures(1.0, 0.0), measures(unit, 7.0), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)
    # Between nothing and what the expected distance to a draw would cost.
    assert 0 < measures(1.0, 0.0)[0] <= abs(mean - target) + std


# --- what counts, and what is refused

MEASURES = {
    "coverage": lambda p, z, **k: coverage(p, z, **k),
    "joint coverage": lambda p, z, **k: coverage(p, z, joint=True, **k),
    "pit": lambda p, z, **k: probability_integral_transform(p, z, **k).nanmean(),
    "reliability": lambda p, z, **k: reliability_curve(p, z, **k).coverage,
    "crps": lambda p, z, **k: crps(p, z, **k).nanmean(),
    "energy": lambda p, z, **k: energy_score(p, z, num_samples=500, **k).nanmean(),
}
EVERY_MEASURE = pytest.mark.parametrize("measure", MEASURES.values(), ids=MEASURES)


@EVERY_MEASURE
@pytest.mark.parametrize("column", [False, True])
def test_masked_targets_do_not_count(measure: Callable[..., Tensor], column: bool) -> None:
    torch.manual_seed(0)
    target, mask = torch.randn(4, 5, D), torch.rand(4, 5) < 0.5
    loc = torch.randn(4, 5, D)
    expected = measure(diag_gaussian(loc[mask], torch.ones(D)), target[mask])
    spoiled = torch.where(mask.unsqueeze(-1), target, math.nan)
    loc = torch.where(mask.unsqueeze(-1), loc, math.nan)
    p = diag_gaussian(loc, torch.ones(D))
    if "energy" in str(measure.__code__.co_names):
        p = diag_gaussian(loc.nan_to_num(), torch.ones(D))  # samples must not be NaN
    value = measure(p, spoiled, mask=mask.unsqueeze(-1) if column else mask)
    torch.testing.assert_close(value, expected, atol=0.05, rtol=0.02)


@EVERY_MEASURE
def test_bad_input_is_refused(measure: Callable[..., Tensor]) -> None:
    p, target = gaussian(1.0, 5, D), torch.zeros(5, D).double()
    for bad in (math.nan, math.inf):
        spoiled = target.clone()
        spoiled[1, 1] = bad
        with pytest.raises(ValueError, match=r"target must be finite where it counts, got .* in 1 of 10"):
            measure(p, spoiled)
        with pytest.raises(ValueError, match="p must have a finite mean and a positive, finite standard dev"):
            measure(diag_gaussian(spoiled, torch.ones(D).double()), target)
    for bad in (0.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="p must have a finite mean and a positive, finite standard dev"):
            measure(diag_gaussian(target, torch.tensor([1.0, bad]).double()), target)
    with pytest.raises(ValueError, match=r"target must have shape \(5, 2\)"):
        measure(p, target[:4])
    with pytest.raises(TypeError, match="target must be floating point"):
        measure(p, target.long())
    with pytest.raises(ValueError, match=r"mask must have shape \(5,\) or \(5, 1\), got \(4,\)"):
        measure(p, target, mask=torch.ones(4, dtype=torch.bool))
    with pytest.raises(TypeError, match="mask must be boolean"):
        measure(p, target, mask=torch.ones(5))
    with pytest.raises(ValueError, match=r"p must have event shape \(D,\)"):
        measure(torch.distributions.Normal(target, 1.0), target)


@pytest.mark.parametrize("level", [0.0, 1.0, -0.1, 90.0, math.nan])
def test_levels_outside_of_zero_and_one_are_refused(level: float) -> None:
    p, target = gaussian(1.0, 5), torch.zeros(5, 1).double()
    model, data = _world()
    for call in (
        lambda: credible_interval(p, level),
        lambda: coverage(p, target, level),
        lambda: coverage(p, target, level, joint=True),
        lambda: reliability_curve(p, target, [0.5, level]),
        lambda: calibration_by_horizon(p.expand((1, 5)), target.unsqueeze(0), levels=[level]),
        lambda: recalibrate(model, data, method="coverage", level=level),
    ):
        with pytest.raises(ValueError, match=r"level must be in \(0, 1\)"):
            call()


def test_samples_are_checked() -> None:
    target = torch.zeros(5, 1).double()
    with pytest.raises(ValueError, match="num_samples must be at least 19 for .* level 0.9, got 18"):
        credible_interval(torch.zeros(18, 5, 1).double(), 0.9)
    with pytest.raises(ValueError, match="num_samples must be at least 2, got 1"):
        crps(laplace(5), torch.zeros(5, D).double(), num_samples=1)
    with pytest.raises(ValueError, match="at least 2 samples in its first dimension, got 1"):
        crps(torch.zeros(1, 5, 1).double(), target)
    with pytest.raises(ValueError, match="p must not be NaN, but its samples are"):
        energy_score(torch.full((3, 5, 1), math.nan).double(), target)
    with pytest.raises(ValueError, match="samples alone have no density"):
        coverage(torch.zeros(30, 5, 1).double(), target, joint=True)
    for bad, match in (([0.5, 1.1], "values from 0.5 to 1.1"), ([math.nan], "at least one that is not NaN")):
        with pytest.raises(ValueError, match=match):
            pit_histogram(torch.tensor(bad))
    with pytest.raises(ValueError, match="num_bins must be at least 1, got 0"):
        pit_histogram(torch.tensor([0.5]), 0)


@EVERY_MEASURE
def test_the_callers_generator_decides(measure: Callable[..., Tensor]) -> None:
    p, target = laplace(50), truth(laplace, 50)
    torch.manual_seed(0)
    state = torch.get_rng_state()
    one, other = (measure(p, target, generator=generator(3)) for _ in range(2))
    assert torch.equal(one, other)
    assert torch.equal(torch.get_rng_state(), state)


def test_nothing_left_is_nan() -> None:
    p, target, none = gaussian(1.0, 5), torch.zeros(5, 1).double(), torch.zeros(5, dtype=torch.bool)
    assert coverage(p, target, mask=none).isnan()
    assert crps(p, target, mask=none).isnan().all()
    with pytest.raises(ValueError, match="leaves none for horizon 1"):
        calibration_by_horizon(p.expand((1, 5)), target.unsqueeze(0), mask=none.unsqueeze(0))


# --- by horizon


def test_by_horizon_each_row_is_that_of_its_own_targets() -> None:
    scale = torch.tensor([0.5, 1.0, 2.0]).double()
    p = diag_gaussian(torch.zeros(N, 3, D).double(), scale.unsqueeze(-1).expand(3, D))
    target = normal_scores().unsqueeze(-1).expand(N, 3, D)
    table = calibration_by_horizon(p, target, levels=[0.5, 0.9], num_bins=4, num_samples=50)
    assert table.steps == (1, 2, 3)
    for h in range(3):
        alone = gaussian(scale[h].item(), dim=D)
        expected = reliability_curve(alone, target[:, h], [0.5, 0.9]).coverage
        torch.testing.assert_close(table.coverage[h], expected)
        pit = probability_integral_transform(alone, target[:, h])
        torch.testing.assert_close(table.pit_density[h], pit_histogram(pit, 4).density)
        torch.testing.assert_close(table.crps[h], crps(alone, target[:, h]).mean())
        score = energy_score(alone, target[:, h], num_samples=50)
        assert abs(table.energy_score[h] - score.mean()) < 8 * score.std() / math.sqrt(N)
    torch.testing.assert_close(table.error, (table.coverage - table.levels).abs().mean(-1))
    assert table.error.argmin() == 1


def test_by_horizon_masked_targets_do_not_count() -> None:
    target = torch.randn(40, 3, D, generator=generator())
    mask = torch.rand(40, 3, generator=generator()) < 0.6
    p = diag_gaussian(torch.zeros(40, 3, D), torch.ones(D))
    spoiled = torch.where(mask.unsqueeze(-1), target, math.nan)
    table = calibration_by_horizon(p, spoiled, mask=mask, levels=[0.5], num_bins=4, num_samples=400)
    for h in range(3):
        kept = target[mask[:, h], h]
        alone = calibration_by_horizon(
            diag_gaussian(torch.zeros(len(kept), 1, D), torch.ones(D)),
            kept.unsqueeze(1),
            levels=[0.5],
            num_bins=4,
            num_samples=400,
        )
        for name in ("coverage", "pit_density", "crps"):
            torch.testing.assert_close(getattr(table, name)[h], getattr(alone, name)[0])
        torch.testing.assert_close(table.energy_score[h], alone.energy_score[0], atol=0.05, rtol=0)


def test_by_horizon_of_a_sampled_rollout() -> None:
    def walk(latent: Tensor, action: Tensor) -> Distribution:
        return diag_gaussian(0.9 * latent + action, torch.ones_like(latent))

    start, actions = torch.randn(1000, D), torch.randn(1000, 4, D)
    first = rollout(walk, start, actions, "sample", num_samples=100, generator=generator(1))
    truth = rollout(walk, start, actions, "sample", generator=generator(2))[0]
    table = calibration_by_horizon(first, truth, levels=[0.5, 0.9], generator=generator())
    torch.testing.assert_close(table.coverage, table.levels.expand(4, 2), atol=0.05, rtol=0)
    joint = calibration_by_horizon(
        diag_gaussian(0.9 * start + actions[:, 0], torch.ones(D)).expand((1, 1000)),
        truth[:, 0].unsqueeze(0),
        levels=[0.9],
        joint=True,
    )
    assert joint.coverage.shape == (1000, 1)


# --- by skip, and temperatures


class LaplaceHead(Head):
    """A head that is neither Gaussian nor a point."""

    def forward(self, features: Tensor, constants: Tensor) -> Distribution:
        return Independent(Laplace(features, torch.ones_like(features)), 1)


class SkewedHead(Head):
    """Two components, the lighter one further from the mean."""

    def forward(self, features: Tensor, constants: Tensor) -> Distribution:
        loc = torch.stack([features - 1.0, features + 2.0], dim=-2)
        logits = torch.tensor([2.0, 1.0], dtype=features.dtype).log()
        return Mixture(logits, diag_gaussian(loc, torch.ones_like(loc)))


SKIPS = (1, 3, 2)


def _world(
    head: Head | None = None, *, batch: tuple[int, ...] = (20,), steps: int = 200, spread: float = 1.0
) -> tuple[VJEPA, TensorDict]:
    """A random walk whose step has the spread of ``head`` at the factors that are its skips' roots.

    The model says the scale of one step for every skip, so its temperature must become the root of the
    skip, times ``spread``.
    """
    encoder = TensorDictModule(nn.Identity(), in_keys=["observation"], out_keys=["latent"])
    head = DiagGaussianHead("constant") if head is None else head
    predictor = Predictor(D, 1, head=head, skips=SKIPS).double()
    action = torch.randn(*batch, steps, 1, generator=generator(4)).double()
    control = torch.tensor([1.0, -1.0]).double()
    with torch.no_grad():
        for skip, trunk in zip(SKIPS, predictor.trunks, strict=True):
            trunk.weight.zero_()
            trunk.weight[:D, :D] = torch.eye(D)
            trunk.weight[:D, D:] = control.unsqueeze(-1).expand(D, skip)
    noise = spread * torch.randn(*batch, steps, D, generator=generator(5)).double()
    moved = noise + action @ control.unsqueeze(0)
    path = torch.cat([torch.zeros(*batch, 1, D).double(), moved[..., :-1, :].cumsum(-2)], dim=-2)
    return VJEPA(encoder, predictor), TensorDict(observation=path, action=action, batch_size=(*batch, steps))


@pytest.mark.parametrize("method", ["likelihood", "coverage"])
@pytest.mark.parametrize("spread", [0.2, 1.0, 3.0])
def test_recalibration_recovers_the_known_factor(method: str, spread: float) -> None:
    model, data = _world(spread=spread)
    before = model.predictor.dist(torch.zeros(1, D).double(), torch.zeros(1, 1).double()).stddev
    temperature = recalibrate(model, data, method=method)
    # 4,000 steps of two dimensions; pairs of skip 3 overlap.
    expected = spread * torch.tensor(SKIPS).double().sqrt()
    torch.testing.assert_close(temperature, expected, rtol=0.05, atol=0)
    assert torch.equal(model.predictor.temperature, temperature)
    after = model.predictor.dist(torch.zeros(1, D).double(), torch.zeros(1, 1).double()).stddev
    torch.testing.assert_close(after, before * temperature[0])
    # What it was fitted on is calibrated: coverage at the level, or a mean squared distance of D.
    if method == "coverage":
        table = calibration_by_skip(model, data, levels=[0.9], num_samples=2)
        torch.testing.assert_close(table.coverage[:, 0], torch.full((3,), 0.9).double(), atol=1e-3, rtol=0)
    again = recalibrate(model, data, method=method)
    torch.testing.assert_close(again, temperature)


def test_the_likelihood_of_a_gaussian_is_highest_at_the_root_of_the_mean_square() -> None:
    model, data = _world()
    z, u = data["observation"], data["action"]
    residual = z[:, 1:] - z[:, :-1] - u[:, :-1] @ torch.tensor([[1.0, -1.0]]).double()
    torch.testing.assert_close(recalibrate(model, data)[0], residual.square().mean().sqrt())


def test_the_search_agrees_with_the_closed_form(monkeypatch: pytest.MonkeyPatch) -> None:
    model, data = _world(spread=2.0)
    exact = recalibrate(model, data)
    model.predictor.set_temperature(None)
    monkeypatch.setattr("torchrl_vjepa.diagnostics.calibration.gaussian_marginals", lambda p: None)
    torch.testing.assert_close(recalibrate(model, data), exact, rtol=1e-4, atol=0)


@pytest.mark.parametrize("head", [LaplaceHead(), SkewedHead()], ids=["laplace", "mixture"])
@pytest.mark.parametrize("method", ["likelihood", "coverage"])
def test_other_distributions_are_recalibrated_too(head: Head, method: str) -> None:
    model, data = _world(head, batch=(4,), steps=80)
    z, u = data["observation"], data["action"]
    # Errors drawn from the head itself, widened: the truth is known.
    p = model.predictor.dist(z[:, :-1], u[:, :-1])
    with torch.random.fork_rng():
        torch.manual_seed(7)
        draw = p.mean + 2.5 * (p.sample() - p.mean)
    starts = torch.stack([z[:, :-1], draw], dim=2)
    pairs = TensorDict(
        observation=starts,
        action=torch.stack([u[:, :-1], u[:, :-1]], dim=2),
        batch_size=starts.shape[:-1],
    )
    short = Predictor(D, 1, head=head, skips=(1,)).double()
    short.trunks[0].load_state_dict(model.predictor.trunks[0].state_dict())
    one_step = VJEPA(model.encoder, short)
    temperature = recalibrate(one_step, pairs, method=method, num_samples=500, generator=generator())
    assert temperature.item() == pytest.approx(2.5, rel=0.1)
    table = calibration_by_skip(one_step, pairs, levels=[0.9], num_samples=50, generator=generator())
    assert table.coverage.item() == pytest.approx(0.9, abs=0.03)


@pytest.mark.parametrize("step", [6.0, -6.0])
def test_each_side_of_a_skewed_belief_has_its_own_reach(step: float) -> None:
    model, _ = _world(SkewedHead())
    model.predictor.skips = (1,)
    path = (step * torch.arange(60.0).double()).reshape(1, 60, 1).expand(1, 60, D)
    data = TensorDict(observation=path, action=torch.zeros(1, 60, 1).double(), batch_size=(1, 60))
    p = model.predictor.dist(path[:, :1], data["action"][:, :1])
    low, high = credible_interval(p, 0.9, num_samples=50_000, generator=generator(1))
    end = high if step > 0 else low
    assert ((high - p.mean) / (p.mean - low)).min() > 1.1  # the sides differ
    expected = (step / (end - p.mean)).mean().item()
    temperature = recalibrate(model, data, method="coverage", num_samples=2000, generator=generator())
    # The 0.9 quantile over latents of an interval's sampling error, about 2 %, is in it too.
    assert temperature.item() == pytest.approx(expected, rel=0.05)


def test_by_skip_is_what_the_pairs_say() -> None:
    model, data = _world(batch=(3, 2), steps=30)
    table = calibration_by_skip(model, data, levels=[0.5, 0.9], num_bins=5)
    assert table.steps == SKIPS
    z, u = data["observation"], data["action"]
    drift = (u @ torch.tensor([[1.0, -1.0]]).double()).cumsum(-2)
    for row, skip in enumerate(SKIPS):
        moved = torch.cat([torch.zeros(3, 2, 1, D).double(), drift], dim=-2)[..., :30, :]
        mean = z[..., :-skip, :] + moved[..., skip:, :] - moved[..., :-skip, :]
        p, target = diag_gaussian(mean, torch.ones(D).double()), z[..., skip:, :]
        expected = reliability_curve(p, target, [0.5, 0.9]).coverage
        torch.testing.assert_close(table.coverage[row], expected)
        torch.testing.assert_close(table.crps[row], crps(p, target).mean())
        pit = probability_integral_transform(p, target)
        torch.testing.assert_close(table.pit_density[row], pit_histogram(pit, 5).density)
    assert (calibration_by_skip(model, data, levels=[0.9], joint=True).coverage[1] < 0.6).all()


@pytest.mark.parametrize("mark", ["done", "is_init", "mask"])
def test_pairs_across_an_end_do_not_count(mark: str) -> None:
    model, data = _world(batch=(2,), steps=40)
    expected = recalibrate(model, data)
    model.predictor.set_temperature(None)
    jump = data["observation"].clone()
    jump[:, :] += 1e3  # the second episode is elsewhere
    joined = torch.cat([data, data.clone().set("observation", jump)], dim=1)
    flags = torch.zeros(2, 80, 1, dtype=torch.bool)
    if mark == "done":
        flags[:, 39] = True
        joined["next", "done"] = flags
    elif mark == "is_init":
        flags[:, 40] = True
        joined["is_init"] = flags
    else:
        joined["observation"][:, 40:] = math.nan
        joined["action"][:, 40:] = math.nan
        flags[:, :40] = True
        joined["collector", "mask"] = flags
    torch.testing.assert_close(recalibrate(model, joined), expected)
    table = calibration_by_skip(model, joined, levels=[0.9])
    assert (table.crps < 3.0).all()


def test_the_data_are_not_changed_and_nothing_has_gradients() -> None:
    model, data = _world(batch=(2,), steps=20)
    before = data.clone()
    temperature = recalibrate(model, data)
    table = calibration_by_skip(model, data)
    assert set(data.keys(True)) == set(before.keys(True))
    assert (data == before).all()
    assert not any(value.requires_grad for value in (temperature, *table[1:]))


def test_recalibration_refuses() -> None:
    model, data = _world(batch=(2,), steps=20)

    def refused(match: str, model: object = model, data: TensorDict = data, **arguments: object) -> None:
        with pytest.raises(ValueError, match=match):
            recalibrate(model, data, **arguments)

    refused("method must be 'likelihood' or 'coverage', got 'moments'", method="moments")
    refused(r"longer than the largest skip 3, got \(2, 3\)", data=data[:, :3])
    refused("predicts points", model=_world(DeltaHead())[0])
    still = data.clone().zero_()
    refused("positive and finite, got a temperature of 0.0 for skip 1", data=still)
    refused(
        "got a temperature of inf for skip 1",
        model=_world(LaplaceHead())[0],
        data=data.apply(lambda x: 1e9 * x),
    )
    masked = data.clone().set(("collector", "mask"), torch.zeros(2, 20, dtype=torch.bool))
    for method in ("likelihood", "coverage"):
        refused("got a temperature of nan", data=masked, method=method)
    nan = data.clone()
    nan["observation"][0, 3] = math.nan
    refused("target must be finite", data=nan)
    assert model.predictor.temperature is None
    with pytest.raises(KeyError, match="calibration reads the entry 'action'"):
        recalibrate(model, data.exclude("action"))
    encoder = linear_encoder(D, D)
    with pytest.raises(TypeError, match="must have a Predictor to calibrate"):
        recalibrate(PixelAR(encoder, PixelDecoder(encoder, D, D)), data)


def test_side_information_is_that_of_the_target() -> None:
    encoder = TensorDictModule(nn.Identity(), in_keys=["observation"], out_keys=["latent"])
    predictor = Predictor(1, skips=(2,), side_info_dim=1, head=DiagGaussianHead("constant")).double()
    with torch.no_grad():
        predictor.trunks[0].weight.copy_(torch.tensor([[0.0, 1.0]]))
    clock = torch.arange(50.0).double().reshape(1, 50, 1)
    data = TensorDict(observation=clock + 0.5, side_info=clock, batch_size=(1, 50))
    assert recalibrate(VJEPA(encoder, predictor), data).item() == pytest.approx(0.5)
