"""Risk functionals against closed forms and brute force; chance constraints against counting."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor, nn
from torch.distributions import Distribution, Normal
from torchrl.data import Bounded
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import RewardScaling

from torchrl_vjepa.costs import quadratic_cost
from torchrl_vjepa.distributions import diag_gaussian
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.planners import CEM, MPPI
from torchrl_vjepa.risk import (
    REJECTED_COST,
    ChanceConstraint,
    Risk,
    Sampling,
    cvar,
    entropic,
    expectation,
    mean_variance,
    plan_cost,
    worst_case,
)


class Case(NamedTuple):
    risk: Risk
    monotone: bool
    homogeneous: bool


RISKS = {
    "expectation": Case(expectation, True, True),
    "mean_variance": Case(mean_variance(0.7), False, False),
    "cvar": Case(cvar(0.3), True, True),
    "cvar_all": Case(cvar(1.0), True, True),
    "cvar_tiny": Case(cvar(1e-9), True, True),
    "entropic": Case(entropic(0.5), True, False),
    "worst_case": Case(worst_case, True, True),
}
every_risk = pytest.mark.parametrize("case", RISKS.values(), ids=RISKS)

numbers = st.lists(st.floats(-50, 50), min_size=1, max_size=9)


def column(values: list[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


class TestEveryRisk:
    @every_risk
    @given(values=numbers, shift=st.floats(-100, 100))
    def test_is_translation_equivariant(self, case: Case, values: list[float], shift: float) -> None:
        costs = column(values)
        torch.testing.assert_close(case.risk(costs + shift), case.risk(costs) + shift, atol=1e-9, rtol=1e-9)

    @every_risk
    @given(values=numbers)
    def test_is_between_mean_and_worst_case(self, case: Case, values: list[float]) -> None:
        costs = column(values)
        assert case.risk(costs) >= costs.mean() - 1e-9
        if case.monotone:
            assert case.risk(costs) <= costs.max() + 1e-9

    @every_risk
    @given(values=numbers, times=st.integers(1, 4), seed=st.integers(0, 99))
    def test_belongs_to_the_empirical_distribution(
        self, case: Case, values: list[float], times: int, seed: int
    ) -> None:
        """Neither the order of the samples nor repeating all of them matters."""
        costs = column(values)
        again = costs.repeat(times)[torch.randperm(times * len(costs))]
        torch.testing.assert_close(case.risk(again), case.risk(costs), atol=1e-9, rtol=1e-9)

    @pytest.mark.parametrize("name", [name for name, case in RISKS.items() if case.monotone])
    @given(pairs=st.lists(st.tuples(st.floats(-50, 50), st.floats(0, 50)), min_size=1, max_size=9))
    def test_is_monotone(self, name: str, pairs: list[tuple[float, float]]) -> None:
        risk = RISKS[name].risk
        low, excess = (column(list(part)) for part in zip(*pairs, strict=True))
        assert risk(low) <= risk(low + excess) + 1e-9

    def test_mean_variance_is_not_monotone(self) -> None:
        better, worse = column([-10.0, 1.0]), column([1.0, 1.0])
        assert (better <= worse).all()
        assert mean_variance(0.7)(better) > mean_variance(0.7)(worse)

    @pytest.mark.parametrize("name", [name for name, case in RISKS.items() if case.homogeneous])
    @given(values=numbers, factor=st.floats(0, 100))
    def test_is_positively_homogeneous(self, name: str, values: list[float], factor: float) -> None:
        risk, costs = RISKS[name].risk, column(values)
        torch.testing.assert_close(risk(factor * costs), factor * risk(costs), atol=1e-9, rtol=1e-9)

    @pytest.mark.parametrize("name", [name for name, case in RISKS.items() if not case.homogeneous])
    def test_is_not_homogeneous_where_the_table_says_so(self, name: str) -> None:
        risk, costs = RISKS[name].risk, column([0.0, 4.0])
        assert risk(3 * costs) > 1.01 * 3 * risk(costs)

    @pytest.mark.parametrize("name", [name for name, case in RISKS.items() if case.homogeneous])
    @given(pairs=st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=1, max_size=9))
    def test_is_subadditive(self, name: str, pairs: list[tuple[float, float]]) -> None:
        risk = RISKS[name].risk
        one, two = (column(list(part)) for part in zip(*pairs, strict=True))
        assert risk(one + two) <= risk(one) + risk(two) + 1e-9

    @every_risk
    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize("batch", [(), (3,), (2, 0), (2, 3)])
    def test_works_on_any_batch(self, case: Case, dtype: torch.dtype, batch: tuple[int, ...]) -> None:
        costs = torch.randn(7, *batch, dtype=dtype)
        value = case.risk(costs)
        assert value.shape == batch
        assert value.dtype == dtype
        if 0 not in batch:
            flat = costs.reshape(7, -1)
            alone = torch.stack([case.risk(one) for one in flat.unbind(1)]).reshape(batch)
            torch.testing.assert_close(value, alone)
            stacked = torch.vmap(case.risk, in_dims=1)(flat)
            torch.testing.assert_close(stacked.reshape(batch), value)

    @every_risk
    def test_gradient(self, case: Case) -> None:
        costs = torch.randn(7, 3, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(case.risk, costs)
        (gradient,) = torch.autograd.grad(case.risk(costs).sum(), costs)
        # Translation equivariance: the weights of the samples sum to one.
        torch.testing.assert_close(gradient.sum(0), torch.ones(3, dtype=torch.float64))
        assert not case.monotone or (gradient >= 0).all()

    @every_risk
    @pytest.mark.parametrize("bad", [math.nan, math.inf])
    def test_a_sample_that_is_not_finite_shows(self, case: Case, bad: float) -> None:
        costs = torch.randn(7, 3)
        costs[4, 1] = bad
        assert case.risk(costs).isfinite().tolist() == [True, False, True]

    @every_risk
    def test_one_sample_is_its_own_risk(self, case: Case) -> None:
        costs = torch.randn(1, 4)
        torch.testing.assert_close(case.risk(costs), costs[0])

    @every_risk
    def test_survives_pickle_and_copy(self, case: Case) -> None:
        costs = torch.randn(7, 3)
        for other in (pickle.loads(pickle.dumps(case.risk)), copy.deepcopy(case.risk)):
            assert torch.equal(other(costs), case.risk(costs))

    @every_risk
    @pytest.mark.parametrize(
        "costs", [torch.zeros(()), torch.zeros(0, 3), torch.zeros(4, 3, dtype=torch.int64)]
    )
    def test_bad_costs_are_refused(self, case: Case, costs: Tensor) -> None:
        with pytest.raises(ValueError, match=r"costs must be floating point of shape \(M, \*B\)"):
            case.risk(costs)


@pytest.mark.parametrize(
    ("make", "value", "message"),
    [
        (cvar, 0.0, r"level must be in \(0, 1\], the fraction .* got 0.0"),
        (cvar, 1.01, r"level must be in \(0, 1\]"),
        (cvar, -0.1, r"level must be in \(0, 1\]"),
        (cvar, math.nan, r"level must be in \(0, 1\]"),
        (mean_variance, -1.0, "coeff must be finite and at least 0, got -1.0"),
        (mean_variance, math.inf, "coeff must be finite and at least 0"),
        (mean_variance, math.nan, "coeff must be finite and at least 0"),
        (entropic, 0.0, "risk_aversion must be positive and finite, got 0.0"),
        (entropic, -1.0, "risk_aversion must be positive and finite"),
        (entropic, math.inf, "risk_aversion must be positive and finite"),
        (entropic, math.nan, "risk_aversion must be positive and finite"),
    ],
)
def test_bad_levels_are_refused(make: Callable[[float], Risk], value: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(value)


class TestCVaR:
    @given(values=numbers, level=st.floats(1e-3, 1.0))
    def test_is_the_minimum_of_rockafellar_and_uryasev(self, values: list[float], level: float) -> None:
        costs = column(values)
        # The minimum over v is attained at one of the samples.
        excess = (costs - costs[:, None]).clamp_min(0).mean(1)
        torch.testing.assert_close(cvar(level)(costs), (costs + excess / level).min(), atol=1e-9, rtol=1e-9)

    @given(values=numbers)
    def test_of_level_one_is_the_mean(self, values: list[float]) -> None:
        torch.testing.assert_close(cvar(1.0)(column(values)), column(values).mean(), atol=1e-9, rtol=1e-9)

    @given(values=numbers)
    def test_of_one_sample_or_less_is_the_worst_case(self, values: list[float]) -> None:
        costs = column(values)
        for level in (1 / len(values), 0.5 / len(values)):
            torch.testing.assert_close(cvar(level)(costs), costs.max())

    @given(values=numbers, one=st.floats(1e-3, 1.0), two=st.floats(1e-3, 1.0))
    def test_does_not_increase_with_the_level(self, values: list[float], one: float, two: float) -> None:
        costs = column(values)
        assert cvar(min(one, two))(costs) >= cvar(max(one, two))(costs) - 1e-9

    def test_counts_the_sample_at_the_edge_by_its_fraction(self) -> None:
        costs = column([1.0, 2.0, 3.0, 4.0, 5.0])
        torch.testing.assert_close(cvar(0.5)(costs), (5 + 4 + 0.5 * 3) / 2.5 * torch.ones(()).double())
        torch.testing.assert_close(cvar(0.4)(costs), torch.tensor(4.5).double())

    @pytest.mark.parametrize("num", [3, 10, 20, 30, 70])
    def test_levels_that_are_rounded_change_nothing(self, num: int) -> None:
        """0.1 * 30 is a little more than 3 in floating point."""
        costs = torch.randn(num, dtype=torch.float64)
        for k in range(1, num + 1):
            expected = costs.sort(descending=True).values[:k].mean()
            torch.testing.assert_close(cvar(k / num)(costs), expected)


class TestEntropic:
    @given(values=numbers, exponent=st.integers(-12, 3))
    def test_equals_the_formula_in_higher_precision(self, values: list[float], exponent: int) -> None:
        from decimal import Decimal, getcontext

        getcontext().prec = 60
        c = Decimal(10) ** exponent
        mean = sum((c * Decimal(v)).exp() for v in values) / len(values)
        expected = float(mean.ln() / c)
        torch.testing.assert_close(
            entropic(float(c))(column(values)),
            torch.tensor(expected, dtype=torch.float64),
            atol=1e-9,
            rtol=1e-9,
        )

    def test_limits(self) -> None:
        costs = torch.randn(100, 3)
        torch.testing.assert_close(entropic(1e-12)(costs), costs.mean(0))
        torch.testing.assert_close(entropic(1e12)(costs), costs.amax(0))

    @pytest.mark.parametrize("scale", [1e-30, 1e30, 1e38])
    def test_neither_overflows_nor_vanishes(self, scale: float) -> None:
        costs = scale * torch.tensor([1.0, 2.0, 3.0])
        for c in (1e-3, 1.0, 1e3):
            value = entropic(c)(costs)
            assert 2 * scale * (1 - 1e-5) <= value <= 3 * scale * (1 + 1e-6)

    @given(values=numbers, one=st.floats(1e-3, 10), two=st.floats(1e-3, 10))
    def test_does_not_decrease_with_the_aversion(self, values: list[float], one: float, two: float) -> None:
        costs = column(values)
        assert entropic(min(one, two))(costs) <= entropic(max(one, two))(costs) + 1e-9

    def test_gradient_where_the_two_branches_meet(self) -> None:
        for gap in (0.1, 1.0, 1.38, 1.40, 50.0, 1000.0):
            costs = torch.tensor([0.0, gap], dtype=torch.float64, requires_grad=True)
            (gradient,) = torch.autograd.grad(entropic(1.0)(costs), costs)
            torch.testing.assert_close(gradient, torch.softmax(costs.detach(), 0))


class TestGaussianCosts:
    """Closed forms, within five standard errors of the estimator."""

    NUM = 20_000
    MEAN, STD = 1.5, 0.8

    @pytest.fixture
    def costs(self) -> Tensor:
        generator = torch.Generator().manual_seed(1)
        noise = torch.randn(self.NUM, 50, generator=generator, dtype=torch.float64)
        return self.MEAN + self.STD * noise

    def check(self, value: Tensor, expected: float, error: float) -> None:
        assert ((value - expected).abs() < 5 * error).all()
        # Not for a trivial reason: the scatter of the 50 columns is the standard error.
        assert 0.6 < float(value.std() / error) < 1.5

    def test_expectation(self, costs: Tensor) -> None:
        self.check(expectation(costs), self.MEAN, self.STD / self.NUM**0.5)

    @pytest.mark.parametrize("coeff", [0.0, 0.5, 3.0])
    def test_mean_variance(self, costs: Tensor, coeff: float) -> None:
        variance = self.STD**2 + coeff**2 * 2 * self.STD**4
        expected = self.MEAN + coeff * self.STD**2
        self.check(mean_variance(coeff)(costs), expected, (variance / self.NUM) ** 0.5)

    @pytest.mark.parametrize("c", [0.1, 1.0, 2.0])
    def test_entropic(self, costs: Tensor, c: float) -> None:
        variance = (math.exp((c * self.STD) ** 2) - 1) / c**2  # delta method
        expected = self.MEAN + 0.5 * c * self.STD**2
        self.check(entropic(c)(costs), expected, (variance / self.NUM) ** 0.5)

    @pytest.mark.parametrize("level", [0.01, 0.05, 0.3, 0.9])
    def test_cvar(self, costs: Tensor, level: float) -> None:
        standard = Normal(torch.zeros((), dtype=torch.float64), 1.0)
        v = standard.icdf(torch.tensor(1 - level, dtype=torch.float64))
        density = standard.log_prob(v).exp()
        expected = self.MEAN + self.STD * float(density) / level
        # Of (X - v)_+ for a standard normal X: first and second moment.
        first = density - v * level
        second = (1 + v**2) * level - v * density
        variance = self.STD**2 * float(second - first**2) / level**2
        self.check(cvar(level)(costs), expected, (variance / self.NUM) ** 0.5)

    def test_worst_case(self, costs: Tensor) -> None:
        # P(max <= x) = P(X <= x)^M: the maximum, sent through its own distribution, is uniform.
        uniform = Normal(self.MEAN, self.STD).cdf(worst_case(costs)) ** self.NUM
        assert abs(float(uniform.mean()) - 0.5) < 5 * (1 / 12 / 50) ** 0.5
        assert float(uniform.std()) > 0.2

    def test_mean_variance_is_entropic_of_twice_the_coefficient(self, costs: Tensor) -> None:
        torch.testing.assert_close(
            mean_variance(0.25)(costs).mean(), entropic(0.5)(costs).mean(), atol=2e-3, rtol=0
        )


def above_one(latent: Tensor, action: Tensor) -> Tensor:
    return latent[..., 0] > 1.0


def margin(latent: Tensor, action: Tensor) -> Tensor:
    return latent[..., 0] - 1.0


def trajectories() -> tuple[Tensor, Tensor]:
    """Four trajectories of three plans of two steps; the plans violate in 0, 1 and 3 of them."""
    latents = torch.zeros(4, 3, 2, 1)
    latents[0, 1, 1] = 2.0
    latents[0, 2, 0] = latents[1, 2, 1] = 2.0
    latents[2, 2] = 2.0
    return latents, torch.zeros(4, 3, 2, 1)


class TestChanceConstraint:
    @pytest.mark.parametrize("violated", [above_one, margin])
    def test_counts_trajectories_or_steps(self, violated: Any) -> None:
        latents, actions = trajectories()
        joint = ChanceConstraint(violated, 0.1)(latents, actions)
        torch.testing.assert_close(joint, torch.tensor([0.0, 0.25, 0.75]))
        single = ChanceConstraint(violated, 0.1, joint=False)(latents, actions)
        torch.testing.assert_close(single, torch.tensor([0.0, 0.25, 0.5]))

    def test_nan_violates_and_the_boundary_does_not(self) -> None:
        latents = torch.tensor([math.nan, 1.0, 1.5]).reshape(1, 3, 1, 1)
        constraint = ChanceConstraint(margin, 0.1)
        assert constraint(latents, latents).tolist() == [1.0, 0.0, 1.0]

    def test_probability_of_a_gaussian_is_within_its_standard_error(self) -> None:
        num = 10_000
        generator = torch.Generator().manual_seed(0)
        latents = torch.randn(num, 5, 2, 1, generator=generator)
        tail = 1 - Normal(0.0, 1.0).cdf(torch.tensor(1.0))
        for joint, p in ((True, 1 - (1 - tail) ** 2), (False, tail)):
            value = ChanceConstraint(above_one, 0.1, joint=joint)(latents, latents)
            # The larger of two frequencies is a little above both.
            assert ((value - p).abs() < 5 * (p * (1 - p) / num).sqrt()).all()

    def test_the_joint_bound_is_the_stronger_one(self) -> None:
        latents = torch.randn(50, 20, 6, 1)
        joint = ChanceConstraint(above_one, 0.1)(latents, latents)
        single = ChanceConstraint(above_one, 0.1, joint=False)(latents, latents)
        assert (single <= joint).all()
        assert (joint <= 6 * single + 1e-6).all()  # Boole

    def test_parameters_of_a_learned_constraint_belong_to_it(self) -> None:
        constraint = ChanceConstraint(_Classifier(), 0.1)
        assert len(list(constraint.parameters())) == 2
        assert "delta=0.1, penalty=None" in repr(constraint)
        again = pickle.loads(pickle.dumps(constraint))
        latents = torch.randn(5, 3, 2, 4)
        assert torch.equal(again(latents, latents), constraint(latents, latents))

    @pytest.mark.parametrize(
        ("kwargs", "error", "message"),
        [
            ({"delta": 1.0}, ValueError, r"delta must be in \[0, 1\), got 1.0"),
            ({"delta": -0.1}, ValueError, r"delta must be in \[0, 1\)"),
            ({"delta": math.nan}, ValueError, r"delta must be in \[0, 1\)"),
            ({"delta": 0.1, "penalty": 0.0}, ValueError, "penalty must be positive and finite, or None"),
            ({"delta": 0.1, "penalty": math.inf}, ValueError, "penalty must be positive and finite"),
            ({"delta": 0.1, "violated": 3}, TypeError, "violated must be callable"),
        ],
    )
    def test_bad_arguments_are_refused(
        self, kwargs: dict[str, Any], error: type[Exception], message: str
    ) -> None:
        with pytest.raises(error, match=message):
            ChanceConstraint(kwargs.pop("violated", above_one), **kwargs)

    @pytest.mark.parametrize("violated", [lambda z, u: z, lambda z, u: True])
    def test_wrong_shapes_are_refused(self, violated: Any) -> None:
        with pytest.raises(ValueError, match=r"violated must return a tensor of shape \(4, 3, 2\)"):
            ChanceConstraint(violated, 0.1)(*trajectories())


class _Classifier(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(4, 1)

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return self.linear(latent).squeeze(-1)


class TestPlanCost:
    def test_without_constraints_is_the_risk(self) -> None:
        costs = torch.randn(5, 4)
        torch.testing.assert_close(plan_cost(costs, cvar(0.4)), cvar(0.4)(costs))

    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
    @pytest.mark.parametrize("risk", [expectation, cvar(0.1), worst_case, entropic(1.0), lambda c: c[0]])
    def test_one_bad_trajectory_costs_infinity(self, risk: Risk, bad: float) -> None:
        """Also where the risk would not look at it."""
        costs = torch.arange(20.0).reshape(10, 2)
        costs[3, 1] = bad
        value = plan_cost(costs, risk)
        assert value[0].isfinite()
        assert value[1] == math.inf

    def test_penalty_grows_with_the_excess(self) -> None:
        latents, actions = trajectories()
        constraint = ChanceConstraint(above_one, 0.25, penalty=10.0)
        value = plan_cost(torch.ones(4, 3), expectation, [constraint], latents, actions)
        torch.testing.assert_close(value, torch.tensor([1.0, 1.0, 6.0]))

    def test_rejected_plans_rank_after_feasible_and_by_violation(self) -> None:
        latents, actions = trajectories()
        costs = torch.tensor([1e20, 5.0, 1.0]).expand(4, 3)
        for delta, rejected in ((0.0, [1, 2]), (0.25, [2]), (0.8, [])):
            constraint = ChanceConstraint(above_one, delta)
            value = plan_cost(costs, expectation, [constraint], latents, actions)
            assert (value >= REJECTED_COST).nonzero().flatten().tolist() == rejected
            assert value.isfinite().all()
            if len(rejected) == 2:
                assert value[0] < value[1] < value[2]

    def test_equally_probable_violations_rank_by_their_duration(self) -> None:
        latents = torch.zeros(2, 3, 4, 1)
        latents[:, 0, 0] = latents[:, 1, :2] = latents[:, 2] = 2.0
        value = plan_cost(
            torch.zeros(2, 3), expectation, [ChanceConstraint(above_one, 0.1)], latents, latents
        )
        assert value[0] < value[1] < value[2]

    @pytest.mark.parametrize("num", [3, 10, 20, 30, 70, 1000])
    def test_a_bound_that_is_met_exactly_does_not_reject(self, num: int) -> None:
        for k in (1, num // 3, num - 1):
            latents = torch.zeros(num, 1, 1, 1)
            latents[:k] = 2.0
            at = ChanceConstraint(above_one, k / num)
            assert plan_cost(torch.ones(num, 1), expectation, [at], latents, latents) == 1.0
            below = ChanceConstraint(above_one, (k - 0.5) / num)
            assert plan_cost(torch.ones(num, 1), expectation, [below], latents, latents) >= REJECTED_COST

    def test_several_constraints_add_up(self) -> None:
        latents, actions = trajectories()
        reject = ChanceConstraint(above_one, 0.5)
        soft = ChanceConstraint(above_one, 0.0, penalty=8.0)
        one = plan_cost(torch.ones(4, 3), expectation, [reject, soft], latents, actions)
        torch.testing.assert_close(one[:2], torch.tensor([1.0, 3.0]))
        two = plan_cost(torch.ones(4, 3), expectation, [reject, reject], latents, actions)
        assert two[2] > one[2] >= REJECTED_COST
        loose = ChanceConstraint(above_one, 0.9)
        for both in ([reject, loose], [loose, reject]):
            assert plan_cost(torch.ones(4, 3), expectation, both, latents, actions)[2] >= REJECTED_COST

    def test_broken_plans_rank_after_rejected_ones(self) -> None:
        latents, actions = trajectories()
        costs = torch.ones(4, 3)
        costs[0, 2] = math.nan
        value = plan_cost(costs, expectation, [ChanceConstraint(above_one, 0.1)], latents, actions)
        assert value[0] < value[1] < value[2] == math.inf

    def test_wrong_input_is_refused(self) -> None:
        with pytest.raises(ValueError, match=r"risk must return a tensor of shape \(4,\)"):
            plan_cost(torch.zeros(5, 4), lambda costs: costs)
        with pytest.raises(ValueError, match="risk must return a tensor .* got float"):
            plan_cost(torch.zeros(5, 4), lambda costs: 1.0)
        with pytest.raises(ValueError, match="latents and actions must be given"):
            plan_cost(torch.zeros(5, 4), expectation, [ChanceConstraint(above_one, 0.1)])


class TestSampling:
    @pytest.mark.parametrize(
        ("arguments", "error", "message"),
        [
            ((0, None, ()), ValueError, "num_samples must be an integer of at least 1, got 0"),
            ((True, None, ()), ValueError, "num_samples must be an integer .* got True"),
            ((2.5, None, ()), ValueError, "num_samples must be an integer .* got 2.5"),
            ((4, 0.1, ()), TypeError, "risk must be callable"),
            ((4, None, [above_one]), TypeError, "constraints must be a sequence of ChanceConstraint"),
            ((4, None, ChanceConstraint(above_one, 0.1)), TypeError, "must be a sequence"),
            ((None, cvar(0.1), ()), ValueError, "risk must have sampled trajectories .* give num_samples"),
            ((None, None, [ChanceConstraint(above_one, 0.1)]), ValueError, "constraints must have sampled"),
        ],
    )
    def test_what_cannot_be_evaluated_is_refused(
        self, arguments: tuple[Any, ...], error: type[Exception], message: str
    ) -> None:
        with pytest.raises(error, match=message):
            Sampling.checked(*arguments)

    def test_defaults(self) -> None:
        assert Sampling.checked(None, None, []) == (None, expectation, (), "energy", None)
        assert Sampling.checked(3, worst_case, []) == (3, worst_case, (), "energy", None)


@pytest.mark.parametrize("planner_class", [CEM, MPPI])
def test_a_mean_that_breaks_a_constraint_is_not_executed(planner_class: type) -> None:
    """Plans on both sides of a forbidden zone are feasible, their mean is not."""

    def move(latent: Tensor, action: Tensor) -> Distribution:
        return diag_gaussian(latent + action, torch.full_like(latent, 0.01))

    forbidden = ChanceConstraint(lambda latent, action: latent.squeeze(-1).abs() < 0.4, 0.05)
    env = LatentEnv(move, action_spec=Bounded(-1, 1, (1,)), cost=quadratic_cost(torch.zeros(1)), latent_dim=1)
    planner = planner_class(
        env, planning_horizon=1, num_candidates=256, num_samples=64, constraints=[forbidden], seed=0
    )
    action = planner(TensorDict(latent=torch.zeros(5, 1), batch_size=5))["action"]
    assert (action.abs() > 0.4).all()


def test_what_stepping_would_ignore_is_refused() -> None:
    def move(latent: Tensor, action: Tensor) -> Distribution:
        return diag_gaussian(latent + action, torch.ones_like(latent))

    spec, cost = Bounded(-1, 1, (1,)), quadratic_cost(torch.zeros(1))
    env = LatentEnv(
        move, action_spec=spec, cost=cost, latent_dim=1, how="sample", num_samples=8, risk=cvar(0.5)
    )
    with pytest.raises(ValueError, match="which stepping would ignore"):
        CEM(TransformedEnv(env, RewardScaling(0.0, 2.0)), planning_horizon=1)
    with pytest.raises(ValueError, match="num_samples must be at least 2 for a risk"):
        LatentEnv(move, action_spec=spec, cost=cost, latent_dim=1, how="sample", risk=cvar(0.5))
