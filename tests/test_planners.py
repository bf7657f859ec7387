"""Planners: closed forms and brute force first, then every promise, then TorchRL's machinery.

``TestDefects`` holds what TorchRL 0.14's own planners get wrong, one test per defect.
"""

from __future__ import annotations

import copy
import math
import pickle
import warnings
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import (
    Bounded,
    Composite,
    TensorSpec,
    Unbounded,
)
from torchrl.envs import EnvBase, PendulumEnv
from torchrl.envs.model_based import ModelBasedEnvBase
from torchrl.modules import WorldModelWrapper

from torchrl_vjepa.costs import action_cost, quadratic_cost
from torchrl_vjepa.distributions import Delta, diag_gaussian
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.planners import (
    CEM,
    MPPI,
    EnvObjective,
    GradientMPC,
    Planner,
    Proposal,
    RandomShooting,
    SamplingPlanner,
)
from torchrl_vjepa.risk import (
    REJECTED_COST,
    ChanceConstraint,
    cvar,
    entropic,
    expectation,
    mean_variance,
    worst_case,
)

PLANNERS = [RandomShooting, CEM, MPPI]
REFINING = [CEM, MPPI]
ALL = [*PLANNERS, GradientMPC]  # what does not depend on how a planner searches
A_MATRIX = torch.tensor([[0.9, 0.3], [-0.3, 0.9]])
B_MATRIX = torch.tensor([[1.0, 0.0], [0.5, 1.0]])


def sized(cls: type[Planner], optim_steps: int, num_candidates: int) -> dict[str, int]:
    """Rounds of many candidates, or as many gradient steps as do the same."""
    if cls is GradientMPC:
        return {"optim_steps": 60, "num_starts": 2}
    return {"optim_steps": optim_steps, "num_candidates": num_candidates}


def linear(latent: Tensor, action: Tensor) -> Delta:
    return Delta(latent @ A_MATRIX.mT + action @ B_MATRIX.mT)


def noisy(latent: Tensor, action: Tensor) -> torch.distributions.Distribution:
    loc = latent @ A_MATRIX.mT + action @ B_MATRIX.mT
    return diag_gaussian(loc, torch.full_like(loc, 0.5))


def copy_action(latent: Tensor, action: Tensor) -> Delta:
    return Delta(action)


def lqr_env(**kwargs: Any) -> LatentEnv:
    return LatentEnv(
        kwargs.pop("model", linear),
        action_spec=kwargs.pop("action_spec", Bounded(-3, 3, (2,))),
        cost=kwargs.pop("cost", quadratic_cost(torch.ones(2)) + 0.1 * action_cost()),
        latent_dim=2,
        **kwargs,
    )


def reach_env(target: float, spec: TensorSpec, cost: Any = None) -> LatentEnv:
    """The latent is the action; the cost is its distance to ``target``."""
    dim = math.prod(spec.shape)
    return LatentEnv(
        copy_action,
        action_spec=spec,
        cost=quadratic_cost(torch.full((dim,), target)) if cost is None else cost,
        latent_dim=dim,
    )


def states(num: int = 3) -> TensorDict:
    latent = torch.randn(num, 2, generator=torch.Generator().manual_seed(5))
    return TensorDict(latent=latent, batch_size=num)


def lqr_plan(state: Tensor, horizon: int) -> Tensor:
    """Finite-horizon LQR with an affine target by backward Riccati recursion, float64."""
    a = torch.block_diag(A_MATRIX, torch.ones(1, 1)).double()  # the state is (z, 1)
    b = torch.cat([B_MATRIX, torch.zeros(1, 2)]).double()
    error = torch.cat([torch.eye(2), -torch.ones(2, 1)], dim=1).double()
    stage, effort = error.mT @ error, 0.1 * torch.eye(2).double()
    value, gains = torch.zeros(3, 3).double(), []
    for _ in range(horizon):
        ahead = stage + value
        gain = torch.linalg.solve(effort + b.mT @ ahead @ b, b.mT @ ahead @ a)
        value = a.mT @ ahead @ a - a.mT @ ahead @ b @ gain
        gains.append(gain)
    z = torch.cat([state.double(), torch.ones(len(state), 1).double()], dim=-1)
    plan = []
    for gain in reversed(gains):
        plan.append(-z @ gain.mT)
        z = z @ a.mT + plan[-1] @ b.mT
    return torch.stack(plan, dim=1).float()


class Recorder:
    """A cost that remembers what it was asked."""

    def __init__(self, cost: Any) -> None:
        self.cost = cost
        self.actions: list[Tensor] = []
        self.costs: list[Tensor] = []

    def __call__(self, latent: Tensor, action: Tensor) -> Tensor:
        self.actions.append(action.clone())
        self.costs.append(self.cost(latent, action))
        return self.costs[-1]


class TestOracles:
    @pytest.mark.parametrize("cls", REFINING)
    def test_plan_is_the_finite_horizon_lqr(self, cls: type[Planner]) -> None:
        planner = cls(lqr_env(), 4, optim_steps=25, num_candidates=512, top_k=64, seed=0)
        td = states(5)
        expected = lqr_plan(td["latent"], 4)
        assert (expected.abs() < 3).all()  # else the bounds matter and LQR is no oracle
        plan = planner.plan(td["latent"], cold(planner, 5))
        torch.testing.assert_close(plan.actions, expected, atol=0.02, rtol=0)
        torch.testing.assert_close(plan.best, expected, atol=0.1, rtol=0)
        env = planner.env
        optimal = env.objective(td["latent"], expected.unsqueeze(1)).squeeze(1)
        reached = env.objective(td["latent"], plan.actions.unsqueeze(1)).squeeze(1)
        assert (reached >= optimal - 1e-4).all()
        assert (reached < 1.001 * optimal).all()

    def test_mppi_with_default_settings_controls_at_lqr_cost(self) -> None:
        env, generator = lqr_env(), torch.Generator().manual_seed(0)
        planner = MPPI(env, planning_horizon=5, seed=0)
        noise = 0.1 * torch.randn(30, 16, 2, generator=generator)

        def episode(policy: Any) -> Tensor:
            td = TensorDict(latent=torch.zeros(16, 2), batch_size=16)
            total = torch.zeros(())
            for step in range(30):
                policy(td)
                latent = linear(td["latent"], td["action"]).mean + noise[step]
                if step >= 3:  # warm starts have arrived
                    total = total + env.world_model.cost(latent, td["action"]).mean()
                td = td["next"].set("latent", latent)
            return total

        def lqr(td: TensorDict) -> None:
            td["next"] = TensorDict(batch_size=td.batch_size)
            td["action"] = lqr_plan(td["latent"], 30)[:, 0]

        assert float(episode(planner) / episode(lqr)) < 1.02

    def test_random_shooting_executes_the_argmin_over_its_candidates(self) -> None:
        recorder = Recorder(quadratic_cost(torch.ones(2)))
        planner = RandomShooting(lqr_env(cost=recorder), 3, 4, num_candidates=50, seed=0)
        recorder.actions.clear()
        recorder.costs.clear()
        out = planner(states(4))
        actions = torch.cat(recorder.actions, dim=1)  # portions of candidates: (4, 200, 3, 2)
        costs = torch.cat(recorder.costs, dim=1).sum(-1)
        best = actions[torch.arange(4), costs.argmin(1)]
        assert torch.equal(out["action"], best[:, 0])
        assert actions.shape == (4, 200, 3, 2)

    def test_one_candidate_of_random_shooting_is_executed(self) -> None:
        recorder = Recorder(quadratic_cost(torch.ones(2)))
        planner = RandomShooting(lqr_env(cost=recorder), 3, num_candidates=1, seed=0)
        out = planner(states(4))
        assert torch.equal(out["action"], recorder.actions[-1][:, 0, 0])
        assert out["action"].abs().sum() > 0

    @pytest.mark.parametrize("cls", ALL)
    def test_bounds_hold_where_the_optimum_is_outside(self, cls: type[Planner]) -> None:
        env = reach_env(50.0, Bounded(torch.tensor([-1.0, 2.0]), torch.tensor([1.0, 3.0]), (2,)))
        planner = cls(env, 2, optim_steps=6, seed=0)
        action = planner(TensorDict(latent=torch.zeros(2)))["action"]
        if cls in REFINING:
            torch.testing.assert_close(action, torch.tensor([1.0, 3.0]), atol=0.01, rtol=0)
        assert env.action_spec.is_in(action)


def cold(planner: Planner, num: int) -> Proposal:
    shape = (num, planner.planning_horizon, planner.low.shape[0])
    return Proposal(planner.centre.expand(shape), planner.cold_std.expand(shape))


class Runaway(SamplingPlanner):
    next_std: float

    def update(self, proposal: Proposal, elites: Tensor, costs: Tensor) -> Proposal:
        mean = torch.full_like(proposal.mean, 1e6)
        return Proposal(mean, torch.full_like(mean, self.next_std))


class TestUpdate:
    def test_cem_is_mean_and_spread_around_the_mean_before(self) -> None:
        planner = CEM(lqr_env(), 3)
        elites = torch.randn(2, 6, 3, 2)
        start = Proposal(torch.randn(2, 3, 2), torch.ones(2, 3, 2))
        mean, std = planner.update(start, elites, torch.zeros(2, 6))
        torch.testing.assert_close(mean, elites.mean(1))
        variance = elites.var(1, correction=0) + (mean - start.mean).square()
        torch.testing.assert_close(std, variance.sqrt())

    @pytest.mark.parametrize("cls", REFINING)
    def test_infinite_costs_have_no_weight(self, cls: type[Planner]) -> None:
        planner = cls(lqr_env(), 3)
        elites, costs = torch.randn(2, 6, 3, 2), torch.rand(2, 6).sort(1).values
        short = planner.update(cold(planner, 2), elites[:, :4], costs[:, :4])
        costs[:, 4:] = torch.inf
        full = planner.update(cold(planner, 2), elites, costs)
        torch.testing.assert_close(full, short)

    @pytest.mark.parametrize("normalize", [True, False])
    def test_mppi_weights_are_the_formula(self, normalize: bool) -> None:
        planner = MPPI(lqr_env(), 3, temperature=0.7, normalize_costs=normalize)
        elites, costs = torch.randn(2, 6, 3, 2), 5 * torch.rand(2, 6).sort(1).values
        scale = costs.std(1, correction=0, keepdim=True) if normalize else 1.0
        weights = torch.softmax(-costs / (0.7 * scale), dim=1)
        start = Proposal(torch.randn(2, 3, 2), torch.ones(2, 3, 2))
        mean, std = planner.update(start, elites, costs)
        torch.testing.assert_close(mean, torch.einsum("bk,bkhd->bhd", weights, elites))
        deviation = elites - start.mean[:, None]
        variance = torch.einsum("bk,bkhd->bhd", weights, deviation**2)
        torch.testing.assert_close(std, variance.sqrt())

    def test_mppi_limits_of_the_temperature(self) -> None:
        elites, costs = torch.randn(2, 6, 3, 2), torch.arange(6.0).expand(2, 6)
        greedy = MPPI(lqr_env(), 3, temperature=1e-4)
        flat = MPPI(lqr_env(), 3, temperature=1e6)
        start = cold(greedy, 2)
        torch.testing.assert_close(greedy.update(start, elites, costs).mean, elites[:, 0])
        uniform = CEM(lqr_env(), 3).update(start, elites, costs)
        torch.testing.assert_close(flat.update(start, elites, costs), uniform, atol=1e-4, rtol=0)

    @given(
        scale=st.floats(1e-6, 1e6),
        shift=st.floats(-1e3, 1e3),
    )
    def test_normalised_mppi_ignores_scale_and_shift(self, scale: float, shift: float) -> None:
        planner = MPPI(lqr_env(action_spec=Bounded(-3, 3, (2,), dtype=torch.float64)), 2)
        elites = torch.randn(1, 5, 2, 2, dtype=torch.float64)
        costs = torch.rand(1, 5, dtype=torch.float64).sort(1).values
        one = planner.update(cold(planner, 1), elites, costs)
        # The shift is in units of the cost: beyond, float64 itself forgets the differences.
        two = planner.update(cold(planner, 1), elites, scale * (costs + shift))
        torch.testing.assert_close(one, two, atol=1e-6, rtol=1e-6)

    @given(
        st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=1, max_size=8),
        st.booleans(),
    )
    def test_mppi_is_finite_for_any_finite_cost(self, values: list[float], flag: bool) -> None:
        planner = MPPI(lqr_env(), 2, temperature=1e-3, normalize_costs=flag)
        costs = torch.tensor(sorted(values)).unsqueeze(0)
        elites = torch.randn(1, len(values), 2, 2)
        mean, std = planner.update(cold(planner, 1), elites, costs)
        assert mean.isfinite().all()
        assert std.isfinite().all()

    @pytest.mark.parametrize("normalize", [True, False])
    def test_mppi_where_even_the_difference_of_costs_overflows(self, normalize: bool) -> None:
        planner = MPPI(lqr_env(), 2, normalize_costs=normalize)
        elites, costs = torch.randn(1, 3, 2, 2), torch.tensor([[-3e38, 3e38, 3e38]])
        mean, std = planner.update(cold(planner, 1), elites, costs)
        assert mean.isfinite().all()
        assert std.isfinite().all()
        weight = 1 / (1 + 2 * math.exp(-(3 / 2**0.5) / 0.5)) if normalize else 1.0
        expected = weight * elites[:, 0] + (1 - weight) / 2 * elites[:, 1:].sum(1)
        torch.testing.assert_close(mean, expected)

    @pytest.mark.parametrize("std", [0.0, 1e6])
    def test_whatever_an_update_returns_stays_inside(self, std: float) -> None:
        planner = Runaway(lqr_env(), 2, 2, 16, seed=0, min_std=0.1)
        planner.next_std = std
        plan = planner.plan(states(3)["latent"], cold(planner, 3))
        assert (plan.actions == 3.0).all()
        expected = planner.cold_std * (0.1 if std == 0 else 1.0)
        torch.testing.assert_close(plan.std, expected.expand(3, 2, 2))

    def test_random_shooting_keeps_the_proposal(self) -> None:
        planner = RandomShooting(lqr_env(), 3)
        start = cold(planner, 2)
        assert planner.update(start, torch.randn(2, 6, 3, 2), torch.zeros(2, 6)) is start


class TestDefects:
    """One test for each defect of TorchRL's planners."""

    @pytest.mark.parametrize("scale", [1.0, 1e3, 1e30])
    def test_1_costs_of_any_size_give_finite_actions(self, scale: float) -> None:
        env = reach_env(0.3, Bounded(-1, 1, (1,)), _Scaled(0.3, scale))
        action = MPPI(env, 1, 8, seed=0)(TensorDict(latent=torch.zeros(1)))["action"]
        torch.testing.assert_close(action, torch.tensor([0.3]), atol=0.02, rtol=0)

    @pytest.mark.parametrize("cls", PLANNERS)
    def test_2_one_elite(self, cls: type[Planner]) -> None:
        env = reach_env(0.3, Bounded(-1, 1, (1,)))
        action = cls(env, 1, 8, 256, 1, seed=0)(TensorDict(latent=torch.zeros(1)))["action"]
        torch.testing.assert_close(action, torch.tensor([0.3]), atol=0.02, rtol=0)

    @pytest.mark.parametrize("cls", PLANNERS)
    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
    def test_2_candidates_that_are_not_finite_rank_last(self, cls: type[Planner], bad: float) -> None:
        env = reach_env(0.0, Bounded(-1, 1, (1,)), _BadAbove(bad, 0.0))
        planner = cls(env, 1, 6, 64, 32, seed=0)
        action = planner(TensorDict(latent=torch.zeros(1)))["action"]
        assert -1 <= float(action) <= 0
        torch.testing.assert_close(action, torch.tensor([-0.2]), atol=0.1, rtol=0)

    @pytest.mark.parametrize("cls", REFINING)
    @pytest.mark.parametrize(
        ("low", "high", "target"),
        [(10, 20, 15.0), (10, 20, 17.3), (-100, 100, 60.0), (-1e-3, 1e-3, 5e-4)],
    )
    def test_3_the_proposal_knows_the_bounds(
        self, cls: type[Planner], low: float, high: float, target: float
    ) -> None:
        env = reach_env(target, Bounded(low, high, (1,)))
        planner = cls(env, 3, 8, 256, seed=0)
        action = planner(TensorDict(latent=torch.zeros(1)))["action"]
        assert abs(float(action) - target) < 0.01 * abs(target)

    @pytest.mark.parametrize("cls", REFINING)
    def test_3_the_spread_has_a_floor(self, cls: type[Planner]) -> None:
        env = reach_env(0.3, Bounded(-4, 4, (1,)))
        planner = cls(env, 2, 60, 64, 8, min_std=0.05, return_stats=True, seed=0)
        out = planner(TensorDict(latent=torch.zeros(1)))
        torch.testing.assert_close(out["plan_stats", "std"], torch.full((2, 1), 0.05 * 0.5 * 4))

    @pytest.mark.parametrize("cls", ALL)
    @pytest.mark.parametrize("shape", [(), (1,), (2, 3)])
    @pytest.mark.parametrize("key", ["action", ("agent", "control")])
    @pytest.mark.parametrize("batch", [(), (2,), (2, 1)])
    def test_4_actions_of_any_rank_under_any_key(
        self, cls: type[Planner], shape: tuple[int, ...], key: Any, batch: tuple[int, ...]
    ) -> None:
        dim = max(1, math.prod(shape))
        env = LatentEnv(
            copy_action,
            action_spec=Bounded(-1, 1, shape),
            cost=quadratic_cost(torch.linspace(-0.5, 0.5, dim)),
            latent_dim=dim,
            action_key=key,
        )
        td = TensorDict(latent=torch.zeros(*batch, dim), batch_size=batch)
        planner = cls(env, 2, **sized(cls, 8, 256), seed=0, return_stats=True)
        out = planner(td)
        assert out[key].shape == (*batch, *shape)
        assert out["next", "plan"].shape == (*batch, 2, *shape)
        assert out["plan_stats", "actions"].shape == (*batch, 2, *shape)
        if cls is not RandomShooting:
            expected = torch.linspace(-0.5, 0.5, dim).reshape(shape).expand((*batch, *shape))
            torch.testing.assert_close(out[key], expected, atol=0.1, rtol=0)
        assert planner(out.exclude("next").set("plan", out["next", "plan"]))[key].isfinite().all()

    def test_4_the_action_can_be_written_elsewhere(self) -> None:
        out = CEM(lqr_env(), 2, action_key=("policy", "a"))(states(3))
        assert out["policy", "a"].shape == (3, 2)
        assert "action" not in out

    def test_5_a_done_state_is_planned_from_itself(self) -> None:
        plain = MPPI(lqr_env(), 3, seed=0)(states(3))["action"]
        done = states(3).update({"done": torch.ones(3, 1).bool(), "reward": torch.ones(3, 1)})
        assert torch.equal(MPPI(lqr_env(), 3, seed=0)(done)["action"], plain)

    def test_5_only_what_is_read_is_touched(self) -> None:
        td = states(3).set("pixels", torch.zeros(3, 4))
        for env in (lqr_env(), WrapperEnv()):
            planner = CEM(env, 2, 2, 16, seed=0)
            before = set(td.keys(True, True))
            assert "pixels" not in planner.in_keys
            out = planner(td.clone())
            assert set(out.keys(True, True)) - before == {"action", ("next", "plan")}
            assert torch.equal(out["pixels"], td["pixels"])
        state = EnvObjective(WrapperEnv()).planning_state(td)
        assert set(state.keys()) == {"latent"}
        assert state["latent"].data_ptr() == td["latent"].data_ptr()

    def test_5_gradients_are_off_and_the_model_is_left_alone(self) -> None:
        model = nn.Linear(4, 2)
        env = LatentEnv(
            _Network(model),
            action_spec=Bounded(-1, 1, (2,)),
            cost=quadratic_cost(torch.ones(2)),
            latent_dim=2,
        )
        before = copy.deepcopy(model.state_dict())
        td = states(3)
        td["latent"].requires_grad_()
        out = MPPI(env, 3, seed=0, return_stats=True)(td)
        assert not out["action"].requires_grad
        assert not out["plan_stats", "cost"].requires_grad
        assert all(p.grad is None and p.requires_grad for p in model.parameters())
        assert all(torch.equal(before[k], v) for k, v in model.state_dict().items())

    @pytest.mark.parametrize("cls", ALL)
    def test_6_own_generator(self, cls: type[Planner]) -> None:
        before = torch.get_rng_state()
        one, two, other = (cls(lqr_env(), 3, seed=s) for s in (3, 3, 4))
        first = one(states(3))["action"]
        assert torch.equal(first, two(states(3))["action"])
        assert not torch.equal(first, other(states(3))["action"])
        assert not torch.equal(first, one(states(3))["action"])  # the stream moves on
        one.set_seed(3)
        assert torch.equal(first, one(states(3))["action"])
        given_one = cls(lqr_env(), 3, generator=torch.Generator().manual_seed(3))
        assert torch.equal(first, given_one(states(3))["action"])
        assert torch.equal(before, torch.get_rng_state())

    def test_6_default_seed_follows_the_global_one(self) -> None:
        torch.manual_seed(11)
        first = MPPI(lqr_env(), 3)(states(3))["action"]
        torch.manual_seed(11)
        assert torch.equal(first, MPPI(lqr_env(), 3)(states(3))["action"])

    @pytest.mark.parametrize("cls", ALL)
    def test_6_statistics_on_request(self, cls: type[Planner]) -> None:
        env = lqr_env()
        out = cls(env, 3, return_stats=True, seed=0)(states(4))
        plan = out["plan_stats", "actions"]
        assert torch.equal(plan[:, 0], out["action"])
        expected = env.objective(out["latent"], plan.unsqueeze(1))
        torch.testing.assert_close(out["plan_stats", "cost"], expected)
        assert out["plan_stats", "cost"].shape == (4, 1)
        assert (out["plan_stats", "std"] > 0).all()
        assert "plan_stats" not in cls(env, 3)(states(4))

    @pytest.mark.parametrize(
        ("kwargs", "message"),
        [
            ({"planning_horizon": 0}, "planning_horizon must be an integer of at least 1, got 0"),
            ({"optim_steps": 0}, "optim_steps must be an integer of at least 1, got 0"),
            ({"optim_steps": True}, "optim_steps must be an integer of at least 1, got True"),
            ({"num_candidates": 0}, "num_candidates must be an integer of at least 1, got 0"),
            ({"num_candidates": 9.5}, "num_candidates must be an integer .* got 9.5"),
            (
                {"num_candidates": 64, "top_k": 128},
                r"top_k must be in \[1, num_candidates=64\], got 128",
            ),
            ({"top_k": 0}, r"top_k must be in \[1, num_candidates=512\], got 0"),
            ({"temperature": 0.0}, "temperature must be positive and finite, got 0.0"),
            ({"temperature": -1.0}, "temperature must be positive and finite, got -1.0"),
            ({"temperature": math.nan}, "temperature must be positive and finite, got nan"),
            ({"warm_std": 0.0}, r"warm_std must be in \(0, 1\], got 0.0"),
            ({"min_std": 2.0}, r"min_std must be in \(0, 1\], got 2.0"),
            ({"init_std": -1.0}, "init_std must be positive and finite, got -1.0"),
            ({"output": "median"}, "output must be 'mean' or 'best', got 'median'"),
            ({"seed": 0, "generator": torch.Generator()}, "at most one of seed and generator"),
        ],
    )
    def test_6_arguments_are_checked(self, kwargs: dict[str, Any], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            MPPI(lqr_env(), **{"planning_horizon": 3, **kwargs})

    @pytest.mark.parametrize(("low", "high"), [(1.0, 1.0), (2.0, 1.0), (math.nan, 1.0), (0.0, math.nan)])
    def test_6_degenerate_bounds_are_refused(self, low: float, high: float) -> None:
        with pytest.raises(ValueError, match="action bounds must satisfy low < high"):
            CEM(reach_env(0.0, Bounded(low, high, (1,))), 2)


class _Scaled:
    def __init__(self, target: float, scale: float) -> None:
        self.target, self.scale = target, scale

    def __call__(self, latent: Tensor, action: Tensor) -> Tensor:
        return self.scale * (latent[..., 0] - self.target).square() + 100 * self.scale


class _BadAbove:
    """Lowest at -0.2 where it is defined at all."""

    def __init__(self, bad: float, threshold: float) -> None:
        self.bad, self.threshold = bad, threshold

    def __call__(self, latent: Tensor, action: Tensor) -> Tensor:
        u = action[..., 0]
        return torch.where(u > self.threshold, self.bad, (u + 0.2).square())


class _Constant:
    def __init__(self, value: float) -> None:
        self.value = value

    def __call__(self, latent: Tensor, action: Tensor) -> Tensor:
        return torch.full_like(latent[..., 0], self.value)


class _NanBelow:
    """Not defined for rows whose latent starts negative (the latent stands still)."""

    def __call__(self, latent: Tensor, action: Tensor) -> Tensor:
        return torch.where(latent[..., 0] < 0, math.nan, (action - 0.4).square().sum(-1))


class _Network(nn.Module):
    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, latent: Tensor, action: Tensor) -> Delta:
        return Delta(self.network(torch.cat([latent, action], dim=-1)))


def _still(latent: Tensor, action: Tensor) -> Delta:
    return Delta(latent)


class TestPromises:
    @pytest.mark.parametrize("cls", PLANNERS)
    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
    def test_no_finite_cost_gives_a_finite_action_and_one_warning(
        self, cls: type[Planner], bad: float
    ) -> None:
        env = reach_env(0.0, Bounded(10, 20, (2,)), _Constant(bad))
        planner = cls(env, 3, 4, 32, seed=0)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            out = planner(TensorDict(latent=torch.zeros(5, 2), batch_size=5))
        assert [w.category for w in caught] == [RuntimeWarning]
        assert "no candidate plan has a finite cost" in str(caught[0].message)
        torch.testing.assert_close(out["action"], torch.full((5, 2), 15.0))
        assert out["next", "plan"].isfinite().all()

    def test_rows_without_finite_cost_leave_the_others_alone(self) -> None:
        env = LatentEnv(_still, action_spec=Bounded(-1, 1, (2,)), cost=_NanBelow(), latent_dim=2)
        good = TensorDict(latent=torch.ones(2, 2), batch_size=2)
        mixed = TensorDict(latent=torch.tensor([[1.0, 1.0], [-1.0, 1.0]]), batch_size=2)
        expected = MPPI(env, 2, seed=0)(good)["action"]
        with pytest.warns(RuntimeWarning, match="at least one row"):
            actual = MPPI(env, 2, seed=0)(mixed)["action"]
        assert torch.equal(actual[0], expected[0])
        assert not actual[1].any()

    @settings(max_examples=25)
    @given(
        cls=st.sampled_from(PLANNERS),
        low=st.floats(-100, 100),
        width=st.floats(0.01, 100),
        value=st.sampled_from([0.0, 1e30, -1e30, 1e38]),
        num=st.integers(1, 9),
        steps=st.integers(1, 3),
        antithetic=st.booleans(),
    )
    def test_actions_are_finite_and_inside_the_spec_whatever_the_cost(
        self,
        cls: type[Planner],
        low: float,
        width: float,
        value: float,
        num: int,
        steps: int,
        antithetic: bool,
    ) -> None:
        spec = Bounded(low, low + width, (2,))
        planner = cls(reach_env(0.0, spec, _Constant(value)), 2, steps, num, seed=0, antithetic=antithetic)
        out = planner(TensorDict(latent=torch.zeros(3, 2), batch_size=3))
        assert out["action"].isfinite().all()
        assert all(spec.is_in(action) for action in out["action"])
        assert all(spec.is_in(action) for action in out["next", "plan"].flatten(0, 1))

    @pytest.mark.parametrize("cls", ALL)
    def test_planning_at_once_equals_planning_one_by_one_in_any_order(self, cls: type[Planner]) -> None:
        planner = cls(lqr_env(), 4, seed=0)
        td = states(8)
        together = planner(td.clone())["action"]
        for row in range(8):
            planner.set_seed(0)
            alone = planner(td[row].clone())["action"]
            torch.testing.assert_close(alone, together[row], atol=1e-4, rtol=1e-4)
        order = torch.randperm(8)
        planner.set_seed(0)
        permuted = planner(td[order].clone())["action"]
        torch.testing.assert_close(permuted, together[order], atol=1e-4, rtol=1e-4)

    @pytest.mark.parametrize("cls", PLANNERS)
    @pytest.mark.parametrize("num", [1, 2, 3, 40])
    def test_more_rounds_never_worsen_the_best_plan(self, cls: type[Planner], num: int) -> None:
        td, last = states(6), torch.full((6,), math.inf)
        for steps in range(1, 8):
            planner = cls(lqr_env(), 4, steps, num, seed=0)
            plan = planner.plan(td["latent"], cold(planner, 6))
            assert (plan.best_cost <= last).all()
            last = plan.best_cost
            again = planner.env.objective(td["latent"], plan.best.unsqueeze(1)).squeeze(1)
            torch.testing.assert_close(again, plan.best_cost)

    @pytest.mark.parametrize("output", ["mean", "best"])
    def test_output(self, output: str) -> None:
        planner = CEM(lqr_env(), 3, 3, 32, output=output, seed=0)
        plan = planner.plan(states(2)["latent"], cold(planner, 2))
        assert torch.equal(plan.actions, plan.best) == (output == "best")

    def test_cem_sees_only_the_ranking(self) -> None:
        base = quadratic_cost(torch.ones(2))
        one = CEM(lqr_env(cost=base), 1, 4, 64, seed=0)(states(3))["action"]
        two = CEM(lqr_env(cost=_Exponential(base)), 1, 4, 64, seed=0)(states(3))["action"]
        assert torch.equal(one, two)

    def test_antithetic_noise_comes_in_pairs_of_opposite_sign(self) -> None:
        planner = CEM(lqr_env(), 2, 1, 40, seed=0)
        start = cold(planner, 3)
        candidates = planner._candidates(start, start.mean)
        free = (candidates[:, 2:20].abs() < 3) & (candidates[:, 22:].abs() < 3)
        assert torch.equal(candidates[:, 2:20][free], -candidates[:, 22:][free])
        plain = CEM(lqr_env(), 2, 1, 40, antithetic=False, seed=0)._candidates(start, start.mean)
        assert not torch.equal(plain[:, 2:20], -plain[:, 22:])

    def test_mean_and_best_are_candidates(self) -> None:
        planner = CEM(lqr_env(), 2, 1, 3, seed=0)
        start = cold(planner, 1)
        best = torch.full_like(start.mean, 0.7)
        candidates = planner._candidates(start, best)
        assert torch.equal(candidates[:, 0], start.mean)
        assert torch.equal(candidates[:, 1], best)
        assert candidates[:, 2].abs().sum() > 0

    @pytest.mark.parametrize("cls", ALL)
    @pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda p: pickle.loads(pickle.dumps(p))])
    def test_copies_continue_the_same_stream(self, cls: type[Planner], duplicate: Any) -> None:
        planner = cls(lqr_env(), 3, seed=0)
        planner(states(2))
        other = duplicate(planner)
        assert torch.equal(planner(states(2))["action"], other(states(2))["action"])
        assert other.generator is not planner.generator

    def test_model_noise_is_the_same_in_every_round_and_new_in_every_call(self) -> None:
        planner = CEM(GeneratorSpy(), 2, 3, 16, seed=0)
        planner(states(2))
        planner(states(2))
        seen = GeneratorSpy.seen[-6:]
        assert all(torch.equal(s, seen[0]) for s in seen[:3])
        assert all(torch.equal(s, seen[3]) for s in seen[3:])
        assert not torch.equal(seen[0], seen[3])
        assert not torch.equal(seen[0], planner.generator.get_state())

    def test_sampled_transitions_plan_too(self) -> None:
        env = lqr_env(model=noisy, how="sample", num_samples=16)
        before = torch.get_rng_state()
        action = MPPI(env, 3, 8, seed=0)(states(3))["action"]
        # Certainty equivalence: additive noise does not move the optimum of a quadratic cost.
        expected = lqr_plan(states(3)["latent"], 3)[:, 0]
        torch.testing.assert_close(action, expected, atol=0.6, rtol=0)
        assert torch.equal(before, torch.get_rng_state())

    def test_unbounded_actions_need_a_spread(self) -> None:
        env = reach_env(7.0, Unbounded((1,)))
        with pytest.raises(ValueError, match="init_std must be given, in units of the action"):
            CEM(env, 2)
        action = CEM(env, 2, 12, init_std=3.0, seed=0)(TensorDict(latent=torch.zeros(1)))["action"]
        torch.testing.assert_close(action, torch.tensor([7.0]), atol=0.1, rtol=0)

    def test_half_bounded_actions(self) -> None:
        spec = Bounded(torch.tensor([2.0, -math.inf]), torch.tensor([math.inf, -1.0]), (2,))
        planner = CEM(reach_env(0.0, spec), 1, 6, init_std=1.0, seed=0)
        assert torch.equal(planner.centre, torch.tensor([2.0, -1.0]))
        action = planner(TensorDict(latent=torch.zeros(2)))["action"]
        torch.testing.assert_close(action, torch.tensor([2.0, -1.0]), atol=0.05, rtol=0)

    def test_float64_actions_over_a_float32_model(self) -> None:
        env = lqr_env(action_spec=Bounded(-3, 3, (2,), dtype=torch.float64))
        assert CEM(env, 3, seed=0)(states(3))["action"].dtype == torch.float64

    def test_empty_batch(self) -> None:
        assert CEM(lqr_env(), 3, seed=0)(states(3)[:0])["action"].shape == (0, 2)

    def test_keywords_are_refused(self) -> None:
        with pytest.raises(TypeError, match=r"CEM takes no keywords, got \['params'\]"):
            CEM(lqr_env(), 3)(states(3), params=None)

    def test_planning_is_the_action_of_forward(self) -> None:
        planner = MPPI(lqr_env(), 3, seed=0)
        action = planner.planning(states(3))
        planner.set_seed(0)
        assert torch.equal(action, planner(states(3))["action"])

    def test_batch_locked_environments_are_refused(self) -> None:
        env = lqr_env()
        locked = LockedEnv()
        with pytest.raises(ValueError, match="batch_locked"):
            CEM(locked, 3)
        with pytest.raises(ValueError, match="accept any batch size"):
            EnvObjective(locked)
        assert not env.batch_locked


class _Exponential:
    def __init__(self, cost: Any) -> None:
        self.cost = cost

    def __call__(self, latent: Tensor, action: Tensor) -> Tensor:
        return torch.exp(0.1 * self.cost(latent, action))


class GeneratorSpy(LatentEnv):
    seen: list[Tensor] = []

    def __init__(self) -> None:
        super().__init__(
            noisy,
            action_spec=Bounded(-1, 1, (2,)),
            cost=quadratic_cost(torch.ones(2)),
            latent_dim=2,
            how="sample",
        )

    def objective(
        self, state: Tensor, actions: Tensor, *, generator: torch.Generator | None = None
    ) -> Tensor:
        self.seen.append(generator.get_state())
        return super().objective(state, actions, generator=generator)


class LockedEnv(EnvBase):
    batch_locked = True

    def __init__(self) -> None:
        super().__init__()
        self.observation_spec = Composite(latent=Unbounded((2,)))
        self.action_spec = Bounded(-1, 1, (2,))
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict: Any, **kwargs: Any) -> TensorDict:
        return TensorDict(latent=torch.zeros(2))

    def _step(self, tensordict: TensorDict) -> TensorDict:
        return tensordict

    def _set_seed(self, seed: int | None) -> None:
        pass


class TestWarmStart:
    def test_the_plan_is_shifted_by_one(self) -> None:
        out = MPPI(lqr_env(), 4, seed=0, return_stats=True)(states(3))
        plan, following = out["plan_stats", "actions"], out["next", "plan"]
        assert torch.equal(following[:, :-1], plan[:, 1:])
        assert torch.equal(following[:, -1], plan[:, -1])

    @pytest.mark.parametrize("cls", ALL)
    def test_a_perfect_plan_is_kept(self, cls: type[Planner]) -> None:
        td = states(3)
        perfect = lqr_plan(td["latent"], 4)
        td["plan"] = perfect
        best = {"output": "best"} if cls in REFINING else {}
        planner = cls(lqr_env(), 4, **sized(cls, 1, 64), **best, seed=0)
        torch.testing.assert_close(planner(td)["action"], perfect[:, 0])

    def test_is_init_clears_its_row_and_no_other(self) -> None:
        plan = torch.randn(3, 4, 2).clamp(-2, 2)
        td = states(3).set("plan", plan)
        td["is_init"] = torch.tensor([[False], [False], [False]])
        warm = MPPI(lqr_env(), 4, 2, seed=0)(td.clone())["action"]
        td["is_init"][1] = True
        mixed = MPPI(lqr_env(), 4, 2, seed=0)(td.clone())["action"]
        bare = MPPI(lqr_env(), 4, 2, seed=0)(states(3))["action"]
        assert torch.equal(mixed[[0, 2]], warm[[0, 2]])
        assert torch.equal(mixed[1], bare[1])
        assert not torch.equal(mixed[1], warm[1])

    @pytest.mark.parametrize("value", [0.0, math.nan])
    def test_plans_of_zeros_or_nan_are_a_cold_start(self, value: float) -> None:
        env = reach_env(17.0, Bounded(10, 20, (2,)))
        td = TensorDict(latent=torch.zeros(3, 2), batch_size=3)
        bare = MPPI(env, 4, 2, seed=0)(td.clone())["action"]
        td["plan"] = torch.full((3, 4, 2), value)
        assert torch.equal(MPPI(env, 4, 2, seed=0)(td)["action"], bare)

    def test_spread_is_smaller_and_the_plan_is_put_inside_the_bounds(self) -> None:
        planner = CEM(lqr_env(), 4, warm_std=0.25)
        td = states(2).set("plan", torch.full((2, 4, 2), 9.0))
        start = planner._start(planner.memory.recall(td, torch.Size([2]), planner.low), torch.Size([2]))
        assert (start.mean == 3.0).all()
        torch.testing.assert_close(start.std, torch.full((2, 4, 2), 0.25 * 0.5 * 3))

    def test_wrong_shape_is_named(self) -> None:
        td = states(2).set("plan", torch.zeros(2, 5, 2))
        with pytest.raises(ValueError, match=r"'plan' must have shape \(2, 4, 2\), got \(2, 5, 2\)"):
            CEM(lqr_env(), 4)(td)

    def test_without_warm_start_no_plan_is_read_or_written(self) -> None:
        planner = CEM(lqr_env(), 4, 2, warm_start=False, seed=0)
        assert planner.in_keys == ["latent"]
        assert planner.out_keys == ["action"]
        td = states(2).set("plan", torch.ones(2, 4, 2))
        out = planner(td.clone())
        assert "next" not in out
        planner.set_seed(0)
        assert torch.equal(out["action"], planner(states(2))["action"])
        assert not planner.make_tensordict_primer().primers.keys()

    def test_keys_can_be_renamed(self) -> None:
        planner = CEM(lqr_env(), 4, plan_key=("memory", "p"), init_key="begins")
        assert planner.in_keys == ["latent", ("memory", "p"), "begins"]
        assert planner(states(2))["next", "memory", "p"].shape == (2, 4, 2)
        primers = planner.make_tensordict_primer().primers
        assert primers["memory", "p"].shape == (4, 2)

    def test_warm_start_helps(self) -> None:
        env, td = lqr_env(), states(64)
        costs = []
        for warm in (True, False):
            planner = MPPI(env, 4, 2, 64, seed=0, warm_start=warm, return_stats=True)
            step = td.clone()
            for _ in range(4):
                out = planner(step)
                latent = linear(out["latent"], out["action"]).mean
                step = TensorDict(latent=latent, batch_size=64)
                if warm:
                    step["plan"] = out["next", "plan"]
            plan = out["plan_stats", "actions"]
            best = lqr_plan(out["latent"], 4)
            gap = env.objective(out["latent"], torch.stack([plan, best], 1))
            costs.append((gap[:, 0] - gap[:, 1]).mean())
        assert costs[0] < 0.5 * costs[1]


class WrapperEnv(ModelBasedEnvBase):
    """The stock recipe: a WorldModelWrapper in a ModelBasedEnvBase, with an optional end."""

    def __init__(self, limit: float = math.inf) -> None:
        transition = TensorDictModule(_PointLinear(), ["latent", "action"], ["latent"])
        reward = TensorDictModule(_NegativeDistance(), ["latent"], ["reward"])
        super().__init__(WorldModelWrapper(transition, reward), batch_size=torch.Size([]))
        self.limit = limit
        self.observation_spec = Composite(latent=Unbounded((2,)))
        self.state_spec = Composite(latent=Unbounded((2,)))
        self.action_spec = Bounded(-3, 3, (2,))
        self.reward_spec = Unbounded((1,))

    def _step(self, tensordict: TensorDict) -> TensorDict:
        out = super()._step(tensordict)
        return out.set("done", out["latent"][..., :1] > self.limit)

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> TensorDict:
        return TensorDict(latent=torch.full((2,), 50.0))


class _PointLinear(nn.Module):
    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return linear(latent, action).mean


class _NegativeDistance(nn.Module):
    def forward(self, latent: Tensor) -> Tensor:
        return -(latent - 1).square().sum(-1, keepdim=True)


class TestEnvObjective:
    def test_equals_the_latent_env_of_the_same_system(self) -> None:
        objective = EnvObjective(WrapperEnv())
        td, actions = states(3), torch.randn(3, 5, 4, 2).clamp(-1, 1)
        torch.testing.assert_close(
            objective.objective(objective.planning_state(td), actions),
            lqr_env(cost=quadratic_cost(torch.ones(2))).objective(td["latent"], actions),
        )
        for cls in ALL:
            one = cls(WrapperEnv(), 3, seed=0)(states(3))["action"]
            two = cls(lqr_env(cost=quadratic_cost(torch.ones(2))), 3, seed=0)(states(3))["action"]
            torch.testing.assert_close(one, two, atol=1e-4, rtol=1e-4)

    def test_rewards_after_the_end_do_not_count(self) -> None:
        objective = EnvObjective(WrapperEnv(limit=0.5))
        state = TensorDict(latent=torch.zeros(2))
        actions = torch.tensor([[[1.0, -0.5], [0.0, 0.0], [0.0, 0.0]], [[0.0, 0.0]] * 3])
        # The first plan ends at (1, 0), whose reward is the last that counts; the second stays.
        costs = objective.objective(state, actions)
        torch.testing.assert_close(costs, torch.tensor([1.0, 6.0]))

    def test_a_done_input_is_not_reset(self) -> None:
        objective = EnvObjective(WrapperEnv())
        td = states(3)
        plain = objective.objective(objective.planning_state(td), torch.zeros(3, 2, 2, 2))
        td["done"] = torch.ones(3, 1, dtype=torch.bool)
        again = objective.objective(objective.planning_state(td), torch.zeros(3, 2, 2, 2))
        assert torch.equal(plain, again)

    def test_pendulum_equals_its_own_rollout(self) -> None:
        env = PendulumEnv(seed=0)
        objective = EnvObjective(env)
        td = env.reset(env.gen_params(batch_size=[3]), set_state=False)
        assert set(objective.in_keys) >= {"th", "thdot", ("params", "g")}
        actions = 2 * torch.rand(3, 4, 6, 1) - 1
        costs = objective.objective(objective.planning_state(td), actions)
        for n in range(4):
            step, total = td.clone(), torch.zeros(3)
            for action in actions[:, n].unbind(1):
                full = env.step(step.set("action", action))
                total = total - full["next", "reward"].squeeze(-1)
                step = full["next"].exclude("reward")
            torch.testing.assert_close(costs[:, n], total)

    @pytest.mark.parametrize("cls", REFINING)
    def test_pendulum_is_balanced(self, cls: type[Planner]) -> None:
        env = PendulumEnv(seed=0)
        td = env.reset(env.gen_params(batch_size=[4]), set_state=False)
        td["th"], td["thdot"] = torch.tensor([0.3, -0.3, 0.1, 0.0]), torch.zeros(4)
        planner = cls(env, 12, 3, 64, seed=0)
        out = env.rollout(40, planner, tensordict=td, auto_reset=False)
        assert (out["next", "th"][:, -5:].abs() < 0.05).all()
        assert (out["action"].abs() <= 2).all()

    def test_missing_state_is_named(self) -> None:
        with pytest.raises(KeyError, match=r"WrapperEnv needs the entries .*missing \['latent'\]"):
            CEM(WrapperEnv(), 3)(TensorDict(pixels=torch.zeros(3)))

    def test_a_deterministic_environment_has_no_risk(self) -> None:
        objective = EnvObjective(WrapperEnv())
        state, actions = objective.planning_state(states(3)), torch.randn(3, 5, 4, 2)
        plain = objective.objective(state, actions)
        for risk in (None, cvar(0.3), worst_case):
            sampled = objective.objective(state, actions, num_samples=4, risk=risk)
            torch.testing.assert_close(sampled, plain)

    def test_a_stochastic_environment_is_sampled(self) -> None:
        """One step with noise of std 1: E|1 + w - 1|^2 = 2, the worst of many is worse."""
        env = NoisyEnv()
        objective = EnvObjective(env)
        state = TensorDict(latent=torch.zeros(2))
        torch.manual_seed(0)
        plan = torch.linalg.solve(B_MATRIX, torch.ones(2)).reshape(1, 1, 2)
        mean = objective.objective(state, plan, num_samples=4000)
        assert abs(float(mean) - 2) < 5 * 2 / 4000**0.5
        assert objective.objective(state, plan, num_samples=4000, risk=worst_case) > 8
        action = CEM(env, 1, 8, num_samples=32, risk=cvar(0.5), seed=0)(state)["action"]
        torch.testing.assert_close(action, plan.flatten(), atol=0.6, rtol=0)

    def test_constraints_are_refused(self) -> None:
        constraint = ChanceConstraint(_first_positive, 0.1)
        with pytest.raises(TypeError, match="constraints need an environment with latents.*WrapperEnv"):
            CEM(WrapperEnv(), 3, num_samples=8, constraints=[constraint])


class NoisyEnv(WrapperEnv):
    def _step(self, tensordict: TensorDict) -> TensorDict:
        out = super()._step(tensordict)
        latent = out["latent"] + torch.randn_like(out["latent"])
        return out.set("latent", latent).set("reward", -(latent - 1).square().sum(-1, keepdim=True))


def _first_positive(latent: Tensor, action: Tensor) -> Tensor:
    return latent[..., 0] > 0


def gusty(latent: Tensor, action: Tensor) -> torch.distributions.Distribution:
    """The latent is the action; the noise grows with it."""
    return diag_gaussian(action, 0.02 + 0.5 * action.clamp_min(0))


def gusty_env(**kwargs: Any) -> LatentEnv:
    """It is good to go far: the cost is minus the latent, and a fall beyond 1 costs 2 more."""
    return LatentEnv(gusty, action_spec=Bounded(-1, 1, (1,)), cost=_Far(), latent_dim=1, **kwargs)


class _Far:
    def __call__(self, latent: Tensor, action: Tensor) -> Tensor:
        return -latent[..., 0] + 2.0 * (latent[..., 0] > 1)


def beyond_one(latent: Tensor, action: Tensor) -> Tensor:
    return latent[..., 0] > 1


RISKS = [expectation, mean_variance(0.5), cvar(0.2), entropic(1.0), worst_case]


class TestRisk:
    @pytest.mark.parametrize("cls", ALL)
    @pytest.mark.parametrize("risk", RISKS)
    def test_of_the_planner_equals_that_of_the_environment(self, cls: type[Planner], risk: Any) -> None:
        settings = {"planning_horizon": 2, "seed": 0, **sized(cls, 4, 32)}
        one = cls(lqr_env(model=noisy), **settings, num_samples=16, risk=risk)(states(3))
        env = lqr_env(model=noisy, how="sample", num_samples=16, risk=risk)
        two = cls(env, **settings)(states(3))
        assert torch.equal(one["action"], two["action"])

    def test_the_planner_replaces_what_it_names_and_nothing_else(self) -> None:
        env = lqr_env(model=noisy, how="sample", num_samples=8, risk=worst_case)
        state, actions = states(3)["latent"], torch.randn(3, 5, 2, 2)

        def cost(**asked: Any) -> Tensor:
            return env.objective(state, actions, generator=torch.Generator().manual_seed(0), **asked)

        assert torch.equal(cost(), cost(num_samples=8, risk=worst_case))
        torch.testing.assert_close(cost(risk=expectation), cost(num_samples=8, risk=cvar(1.0)))
        assert not torch.equal(cost(), cost(num_samples=9))
        assert (cost() >= cost(risk=cvar(0.5))).all()
        assert (cost(risk=cvar(0.5)) >= cost(risk=expectation)).all()

    @pytest.mark.parametrize("cls", REFINING)
    def test_the_more_averse_the_more_careful(self, cls: type[Planner]) -> None:
        td = TensorDict(latent=torch.zeros(1))
        settings = {"planning_horizon": 1, "optim_steps": 8, "num_candidates": 128, "seed": 0}
        actions = [
            float(cls(gusty_env(), **settings, num_samples=256, risk=risk)(td.clone())["action"])
            for risk in (None, cvar(0.5), cvar(0.05))
        ]
        mean = float(cls(gusty_env(), **settings)(td.clone())["action"])
        assert mean > 0.95
        assert mean > actions[0] > actions[1] > actions[2]

    def test_one_bad_trajectory_makes_a_plan_the_last(self) -> None:
        env = reach_env(0.0, Bounded(-1, 1, (1,)), _BadAbove(math.nan, 0.0))
        costs = env.objective(
            torch.zeros(1), torch.tensor([0.5, -0.5]).reshape(2, 1, 1), num_samples=4, risk=cvar(0.3)
        )
        assert costs.isfinite().tolist() == [False, True]

    def test_survives_pickle(self) -> None:
        planner = CEM(
            gusty_env(),
            1,
            num_samples=16,
            risk=cvar(0.2),
            constraints=[ChanceConstraint(beyond_one, 0.4)],
            seed=0,
        )
        td = TensorDict(latent=torch.zeros(1))
        other = pickle.loads(pickle.dumps(planner))
        assert torch.equal(planner(td.clone())["action"], other(td.clone())["action"])

    @pytest.mark.parametrize(
        ("kwargs", "error", "message"),
        [
            ({"num_samples": 0}, ValueError, "num_samples must be an integer of at least 1, got 0"),
            ({"risk": cvar(0.1)}, ValueError, "risk must have sampled trajectories"),
            ({"num_samples": 4, "risk": 0.1}, TypeError, "risk must be callable"),
            (
                {"constraints": [ChanceConstraint(beyond_one, 0.1)]},
                ValueError,
                "constraints must have sampled trajectories",
            ),
            ({"num_samples": 4, "constraints": [beyond_one]}, TypeError, "sequence of ChanceConstraint"),
        ],
    )
    def test_bad_arguments_are_refused_at_construction(
        self, kwargs: dict[str, Any], error: type[Exception], message: str
    ) -> None:
        with pytest.raises(error, match=message):
            CEM(gusty_env(), 1, **kwargs)
        if "num_samples" not in kwargs:
            with pytest.raises(error, match=message):
                gusty_env(**kwargs)

    def test_an_objective_without_risk_is_named(self) -> None:
        env = GeneratorSpy()
        with pytest.raises(TypeError, match=r"num_samples and risk need an environment .* got OwnObjective"):
            CEM(OwnObjective(), 2, num_samples=4, risk=cvar(0.5))
        assert CEM(env, 2, num_samples=None).risk is None


class OwnObjective(WrapperEnv):
    def objective(self, state: Any, actions: Tensor, *, generator: Any = None) -> Tensor:
        return actions.sum(dim=(-1, -2))


class TestChanceConstraints:
    SETTINGS = {"planning_horizon": 1, "optim_steps": 8, "num_candidates": 128, "seed": 0}

    @pytest.mark.parametrize("cls", PLANNERS)
    @pytest.mark.parametrize("delta", [0.0, 0.01, 0.03])
    def test_the_best_plan_meets_the_bound(self, cls: type[Planner], delta: float) -> None:
        """P(N(u, 0.02 + u / 2) > 1) <= delta, up to the error of 512 samples; and no more careful."""
        constraint = ChanceConstraint(beyond_one, delta)
        planner = cls(gusty_env(), **self.SETTINGS, num_samples=512, constraints=[constraint])
        state = torch.zeros(1)
        plan = planner.plan(state, Proposal(*(part[0] for part in cold(planner, 1))))
        assert plan.best_cost < REJECTED_COST
        u = float(plan.best)
        tail = 1 - torch.distributions.Normal(u, 0.02 + 0.5 * u).cdf(torch.tensor(1.0))
        error = 5 * (max(delta, 1 / 512) / 512) ** 0.5
        assert tail < delta + error
        assert tail > delta - error
        assert u < 0.53, "the risk-neutral optimum is at 0.56: the constraint binds"

    def test_penalty_moves_the_plan_as_far_as_it_pays(self) -> None:
        td = TensorDict(latent=torch.zeros(1))
        actions = []
        for penalty in (0.1, 10.0, 1000.0):
            constraint = ChanceConstraint(beyond_one, 0.01, penalty=penalty)
            planner = CEM(gusty_env(), **self.SETTINGS, num_samples=512, constraints=[constraint])
            actions.append(float(planner(td.clone())["action"]))
        assert actions[0] > actions[1] + 0.02
        rejecting = ChanceConstraint(beyond_one, 0.01)
        planner = CEM(gusty_env(), **self.SETTINGS, num_samples=512, constraints=[rejecting])
        assert abs(float(planner(td.clone())["action"]) - actions[2]) < 0.05

    @pytest.mark.parametrize("cls", PLANNERS)
    def test_where_nothing_is_feasible_the_least_violation_is_taken(self, cls: type[Planner]) -> None:
        constraint = ChanceConstraint(_not_very_negative, 0.0)
        env = LatentEnv(noisy_copy, action_spec=Bounded(-1, 1, (1,)), cost=_Far(), latent_dim=1)
        planner = cls(env, **self.SETTINGS, num_samples=64, constraints=[constraint], return_stats=True)
        with pytest.warns(RuntimeWarning, match="no candidate plan satisfies the chance constraints"):
            out = planner(TensorDict(latent=torch.zeros(1)))
        assert float(out["action"]) < -0.8
        assert out["action"].isfinite().all()
        assert out["plan_stats", "cost"] >= REJECTED_COST
        assert 0 < float(out["plan_stats", "violation"]) < 1

    @pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
    def test_statistics_tell_the_probability(self, batch: tuple[int, ...]) -> None:
        constraints = [ChanceConstraint(beyond_one, 0.3), ChanceConstraint(_first_positive, 0.9)]
        planner = CEM(
            gusty_env(), 1, 2, 32, num_samples=64, constraints=constraints, return_stats=True, seed=0
        )
        assert ("plan_stats", "violation") in planner.out_keys
        out = planner(TensorDict(latent=torch.zeros(*batch, 1), batch_size=batch))
        assert out["plan_stats", "violation"].shape == (*batch, 2)
        assert ("plan_stats", "violation") not in CEM(gusty_env(), 1, return_stats=True).out_keys

    def test_constraints_of_the_environment_can_be_lifted(self) -> None:
        constraint = ChanceConstraint(beyond_one, 0.01)
        env = gusty_env(how="sample", num_samples=256, constraints=[constraint])
        td = TensorDict(latent=torch.zeros(1))
        bound = float(CEM(env, **self.SETTINGS)(td.clone())["action"])
        free = float(CEM(env, **self.SETTINGS, constraints=[])(td.clone())["action"])
        assert bound + 0.02 < free

    def test_rejected_plans_have_no_part_beside_a_feasible_one(self) -> None:
        seen: list[Tensor] = []

        class Spy(CEM):
            def update(self, proposal: Proposal, elites: Tensor, costs: Tensor) -> Proposal:
                seen.append(costs)
                return super().update(proposal, elites, costs)

        constraint = ChanceConstraint(beyond_one, 0.05)
        planner = Spy(gusty_env(), 1, 1, 32, 32, num_samples=64, constraints=[constraint], seed=0)
        planner(TensorDict(latent=torch.zeros(1)))
        assert seen[0].isfinite().any()
        assert seen[0].isinf().any()
        assert (seen[0][seen[0].isfinite()] < REJECTED_COST).all()

    def test_a_learned_constraint_moves_with_the_environment(self) -> None:
        network = nn.Linear(1, 1)
        constraint = ChanceConstraint(_Probability(network), 0.05)
        env = gusty_env(how="sample", num_samples=8, constraints=[constraint])
        assert network.weight in set(env.parameters())
        with pytest.raises(ValueError, match="constraints must hold at least one"):
            gusty_env(how="sample").violation_probability(torch.zeros(1), torch.zeros(2, 1, 1))


class _Probability(nn.Module):
    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return self.network(latent).squeeze(-1)


def noisy_copy(latent: Tensor, action: Tensor) -> torch.distributions.Distribution:
    return diag_gaussian(action, torch.full_like(action, 0.3))


def _not_very_negative(latent: Tensor, action: Tensor) -> Tensor:
    return latent[..., 0] > -0.9
