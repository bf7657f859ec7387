"""Gradient MPC: exact solutions of least squares first, then every promise."""

from __future__ import annotations

import copy
import functools
import math
import pickle
import time
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import Bounded, TensorSpec, Unbounded
from torchrl.envs import PendulumEnv

from torchrl_vjepa.costs import action_cost, quadratic_cost
from torchrl_vjepa.distributions import Delta, diag_gaussian
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.planners import CEM, EnvObjective, GradientMPC, Plan, Planner, Proposal
from torchrl_vjepa.planners.squash import squash, unsquash
from torchrl_vjepa.risk import ChanceConstraint, expectation, mean_variance

SGD = functools.partial(torch.optim.SGD, lr=0.05)
BOUNDS = ["project", "reparameterize"]
HORIZON, EFFORT = 4, 0.1
A = torch.tensor([[0.9, 0.3], [-0.3, 0.9]], dtype=torch.float64)
B = torch.tensor([[1.0, 0.0], [0.5, 1.0]], dtype=torch.float64)


def linear(latent: Tensor, action: Tensor) -> Delta:
    return Delta(latent @ A.mT.to(latent) + action @ B.mT.to(latent))


def linear_env(limit: float = 3.0, **kwargs: Any) -> LatentEnv:
    return LatentEnv(
        kwargs.pop("model", linear),
        action_spec=kwargs.pop("action_spec", Bounded(-limit, limit, (2,), dtype=torch.float64)),
        cost=kwargs.pop("cost", quadratic_cost(torch.ones(2, dtype=torch.float64)) + EFFORT * action_cost()),
        latent_dim=2,
        dtype=torch.float64,
        **kwargs,
    )


def copy_action(latent: Tensor, action: Tensor) -> Delta:
    return Delta(action)


def reach_env(cost: Any, spec: TensorSpec | None = None) -> LatentEnv:
    """The latent is the action: what is planned is what is paid for."""
    spec = Bounded(-2, 2, (1,)) if spec is None else spec
    return LatentEnv(copy_action, action_spec=spec, cost=cost, latent_dim=math.prod(spec.shape))


def states(num: int = 5) -> Tensor:
    return torch.randn(num, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64)


def cold(planner: Planner, *batch: int) -> Proposal:
    shape = (*batch, planner.planning_horizon, planner.low.shape[0])
    return Proposal(planner.centre.expand(shape), planner.cold_std.expand(shape))


def least_squares(latent: Tensor, limit: float = math.inf) -> Tensor:
    """The optimal plan (H, 2) of one state: |G u + g - 1|^2 + 0.1 |u|^2 within the bounds, by scipy."""
    rows = []
    for step in range(1, HORIZON + 1):
        blocks = [
            torch.linalg.matrix_power(A, step - 1 - k) @ B if k < step else torch.zeros(2, 2).double()
            for k in range(HORIZON)
        ]
        rows.append(torch.cat(blocks, dim=1))
    free = torch.cat([torch.linalg.matrix_power(A, step) @ latent for step in range(1, HORIZON + 1)])
    matrix = torch.cat([torch.cat(rows), EFFORT**0.5 * torch.eye(2 * HORIZON).double()])
    target = torch.cat([1 - free, torch.zeros(2 * HORIZON).double()])
    solution = lsq_linear(matrix.numpy(), target.numpy(), bounds=(-limit, limit), tol=1e-12).x
    return torch.from_numpy(solution).reshape(HORIZON, 2)


class Counter:
    """A cost that remembers how often it was asked, and what each plan cost."""

    def __init__(self, cost: Any) -> None:
        self.cost, self.costs = cost, []

    def __call__(self, latent: Tensor, action: Tensor) -> Tensor:
        cost = self.cost(latent, action)
        self.costs.append(cost.detach().sum(-1))
        return cost


def valleys(latent: Tensor, action: Tensor) -> Tensor:
    """Two minima; the one of positive actions is the worse."""
    u = action[..., 0]
    return (u.square() - 1).square() + 0.3 * u


class TestOracles:
    @pytest.mark.parametrize("bounds", BOUNDS)
    @pytest.mark.parametrize(
        ("optimizer", "steps", "error"),
        [
            (None, 300, 1e-3),
            (functools.partial(torch.optim.SGD, lr=0.03, momentum=0.5), 300, 1e-3),
            (functools.partial(torch.optim.NAdam, lr=0.1), 300, 1e-2),
            (functools.partial(torch.optim.LBFGS, max_iter=5), 30, 1e-5),
            (functools.partial(torch.optim.LBFGS, line_search_fn="strong_wolfe"), 5, 1e-4),
        ],
    )
    def test_linear_quadratic(
        self, bounds: Any, optimizer: Callable[..., Any] | None, steps: int, error: float
    ) -> None:
        planner = GradientMPC(linear_env(), HORIZON, steps, optimizer=optimizer, bounds=bounds, seed=0)
        plan = planner.plan(states(), cold(planner, 5))
        expected = torch.stack([least_squares(latent) for latent in states()])
        assert (expected.abs() < 3).all()
        torch.testing.assert_close(plan.actions, expected, atol=error, rtol=0)
        cost = planner.env.objective(states(), plan.actions.unsqueeze(1)).squeeze(1)
        torch.testing.assert_close(plan.best_cost, cost)

    @pytest.mark.parametrize(("bounds", "excess"), [("project", 1e-6), ("reparameterize", 0.02)])
    def test_the_bounded_optimum(self, bounds: Any, excess: float) -> None:
        env = linear_env(limit=0.4)
        planner = GradientMPC(env, HORIZON, 400, bounds=bounds, seed=0)
        expected = torch.stack([least_squares(latent, 0.4) for latent in states()])
        assert (expected.abs() > 0.399).any()
        optimal = env.objective(states(), expected.unsqueeze(1)).squeeze(1)
        plan = planner.plan(states(), cold(planner, 5))
        assert (plan.best_cost < (1 + excess) * optimal + 1e-6).all()
        assert (plan.best_cost > optimal - 1e-6).all()

    def test_one_start_is_plain_gradient_descent_bit_for_bit(self) -> None:
        # The spread of a cold start is the unit of a step: 1 for these bounds.
        planner = GradientMPC(linear_env(limit=2.0), HORIZON, 7, optimizer=SGD, num_starts=1, seed=0)
        latent, start = states(1)[0], 0.1 * torch.randn(HORIZON, 2, dtype=torch.float64)
        u = start.clone()
        for _ in range(7):
            u.requires_grad_()
            z, total = latent.unsqueeze(0), []
            for action in u.unsqueeze(0).unbind(1):
                z = linear(z, action).mean
                total.append(planner.env.world_model.cost(z, action))
            (gradient,) = torch.autograd.grad(torch.stack(total).sum(), u)
            u = torch.add(u.detach(), gradient, alpha=-0.05).clamp(-2, 2)  # one rounding
        plan = planner.plan(latent, Proposal(start, torch.ones_like(start)))
        assert torch.equal(plan.actions, u)

    def test_projection_by_hand(self) -> None:
        """Each step starts on the bound onto which the one before was put: 0, 0.54 -> 0.5, 0.5 - 0.36."""
        env = reach_env(quadratic_cost(torch.full((1,), 0.3)), Bounded(-0.5, 0.5, (1,)))
        optimizer = functools.partial(torch.optim.SGD, lr=0.9)
        planner = GradientMPC(env, 1, 2, optimizer=optimizer, num_starts=1, init_std=2.0, seed=0)
        action = planner(TensorDict(latent=torch.zeros(1)))["action"]
        torch.testing.assert_close(action, torch.tensor([0.14]))

    def test_the_gradient_of_sampled_trajectories(self) -> None:
        """E (Z - 1)^2 with Z ~ N(u, (0.02 + u / 2)^2) is lowest at u = 1.98 / 2.5."""

        def gusty(latent: Tensor, action: Tensor) -> torch.distributions.Distribution:
            return diag_gaussian(action, 0.02 + 0.5 * action.clamp_min(0))

        env = LatentEnv(
            gusty, action_spec=Bounded(-1, 1, (1,)), cost=quadratic_cost(torch.ones(1)), latent_dim=1
        )
        td, found = TensorDict(latent=torch.zeros(1)), {}
        for name, risk in (("mean", expectation), ("careful", mean_variance(5.0))):
            planner = GradientMPC(env, 1, num_samples=4096, risk=risk, seed=0)
            found[name] = planner(td.clone())["action"].item()
        # The gradient at the optimum, of 4096 samples, has a standard error of about 0.02.
        assert abs(found["mean"] - 1.98 / 2.5) < 0.05
        assert found["careful"] < found["mean"] - 0.05

    def test_several_starts_escape_a_local_minimum(self) -> None:
        td = TensorDict(latent=torch.zeros(3, 1), plan=torch.full((3, 1, 1), 0.5), batch_size=3)
        for num, sign in ((1, 1.0), (16, -1.0)):
            planner = GradientMPC(reach_env(valleys), 1, num_starts=num, warm_std=1.0, seed=0)
            action = planner(td.clone())["action"]
            assert (sign * action > 0.8).all()

    def test_pendulum_through_its_own_equations(self) -> None:
        env = PendulumEnv(seed=0)
        td = env.reset(env.gen_params(batch_size=[4]), set_state=False)
        td["th"], td["thdot"] = torch.tensor([0.3, -0.3, 0.1, 0.0]), torch.zeros(4)
        planner = GradientMPC(env, 8, 8, num_starts=1, seed=0)
        start = cold(planner, 4)
        objective = EnvObjective(env)
        state = objective.planning_state(td)
        still = objective.objective(state, start.mean.unsqueeze(-3)).squeeze(-1)
        plan = planner.plan(state, start)
        assert (plan.best_cost[:3] < 0.9 * still[:3]).all()
        out = env.rollout(20, planner, tensordict=td, auto_reset=False)
        assert (out["next", "th"][:3, -1].abs() < 0.7 * td["th"][:3].abs()).all()
        assert (out["action"].abs() <= 2).all()

    def test_another_planners_plan_is_refined(self) -> None:
        env, state = linear_env(), states()
        search = CEM(env, HORIZON, 2, 32, seed=0)
        found = search.plan(state, cold(search, 5))
        refined = GradientMPC(env, HORIZON, seed=0).plan(state, Proposal(found.best, found.std))
        assert (refined.best_cost < found.best_cost).all()


class TestBestSoFar:
    @pytest.mark.parametrize("bounds", BOUNDS)
    @pytest.mark.parametrize("lr", [0.05, 2.0])  # the second diverges
    def test_it_never_costs_more_than_any_plan_that_was_evaluated(self, bounds: Any, lr: float) -> None:
        cost = Counter(quadratic_cost(torch.ones(2, dtype=torch.float64)))
        optimizer = functools.partial(torch.optim.SGD, lr=lr)
        before = torch.full((5,), math.inf)
        for steps in (1, 2, 4, 8):
            planner = GradientMPC(
                linear_env(cost=cost), HORIZON, steps, optimizer=optimizer, bounds=bounds, seed=0
            )
            cost.costs.clear()
            plan = planner.plan(states(), cold(planner, 5))
            assert len(cost.costs) == steps + 1
            lowest = torch.stack(cost.costs).amin(dim=(0, 2))
            assert torch.equal(plan.best_cost, lowest)
            assert (plan.best_cost <= before).all()
            before = plan.best_cost

    @pytest.mark.parametrize("bounds", BOUNDS)
    def test_a_perfect_plan_on_the_bound_is_kept_exactly(self, bounds: Any) -> None:
        env = reach_env(quadratic_cost(torch.full((1,), 50.0)), Bounded(0.1, 0.7, (1,)))
        td = TensorDict(latent=torch.zeros(1), plan=torch.full((3, 1), 0.7))
        out = GradientMPC(env, 3, 5, bounds=bounds, seed=0, return_stats=True)(td)
        assert torch.equal(out["plan_stats", "actions"], td["plan"])

    def test_the_last_iterate_counts(self) -> None:
        """One SGD step on a quadratic with the inverse of its curvature is the optimum."""
        env = reach_env(quadratic_cost(torch.full((1,), 0.5)))
        planner = GradientMPC(
            env, 1, 1, optimizer=functools.partial(torch.optim.SGD, lr=0.5), num_starts=1, seed=0
        )
        action = planner(TensorDict(latent=torch.zeros(1)))["action"]
        torch.testing.assert_close(action, torch.tensor([0.5]))


class TestBudget:
    def test_milliseconds(self, monkeypatch: pytest.MonkeyPatch) -> None:
        now = [0.0]
        monkeypatch.setattr(time, "perf_counter", lambda: now[0])
        target = quadratic_cost(torch.ones(2, dtype=torch.float64))

        def slow(latent: Tensor, action: Tensor) -> Tensor:
            now[0] += 0.010
            return target(latent, action)

        for max_ms, steps in ((5.0, 1), (25.0, 1), (35.0, 2), (45.0, 3), (1e6, 6)):
            cost = Counter(slow)
            planner = GradientMPC(
                linear_env(cost=cost),
                HORIZON,
                6,
                max_ms=max_ms,
                num_starts=1,
                seed=0,
                optimizer=functools.partial(torch.optim.SGD, lr=0.01),
            )
            cost.costs.clear()
            plan = planner.plan(states(), cold(planner, 5))
            assert len(cost.costs) == steps + 1
            assert (plan.best_cost < cost.costs[0].squeeze(-1)).all()

    def test_early_stop(self) -> None:
        cost = Counter(quadratic_cost(torch.ones(2, dtype=torch.float64)))
        env = linear_env(cost=cost)
        evaluations, gaps = [], []
        free = GradientMPC(env, HORIZON, 200, seed=0)
        best = free.plan(states(), cold(free, 5)).best_cost
        for tolerance in (0.5, 1e-3):
            cost.costs.clear()
            planner = GradientMPC(env, HORIZON, 200, tolerance=tolerance, seed=0)
            gaps.append((planner.plan(states(), cold(planner, 5)).best_cost - best).max())
            evaluations.append(len(cost.costs))
        assert 5 < evaluations[0] < evaluations[1] <= 201
        assert evaluations[0] < 100
        assert gaps[0] > gaps[1] >= 0

    def test_patience_counts_steps_without_improvement(self) -> None:
        cost = Counter(lambda latent, action: 1 + 0 * action.sum(-1))
        for patience in (1, 4):
            planner = GradientMPC(reach_env(cost), 2, tolerance=0.0, patience=patience, seed=0)
            cost.costs.clear()
            planner(TensorDict(latent=torch.zeros(1)))
            assert len(cost.costs) == 1 + patience  # the first evaluation is an improvement

    def test_rows_stop_alone(self) -> None:
        """A row that is finished keeps its plan while the others go on."""
        planner = GradientMPC(linear_env(), HORIZON, 200, tolerance=0.02, patience=2, seed=0)
        together = planner.plan(states(), cold(planner, 5))
        for row in range(5):
            planner.set_seed(0)
            alone = planner.plan(states()[row], Proposal(*(part[row] for part in cold(planner, 5))))
            torch.testing.assert_close(alone.actions, together.actions[row])


class TestNotFinite:
    @settings(max_examples=40)
    @given(
        value=st.sampled_from([0.0, 1e30, -1e30, 3e38, math.nan, math.inf, -math.inf]),
        slope=st.sampled_from([0.0, 1.0, 1e30, 3e38, math.nan, math.inf]),
        low=st.floats(-100, 100),
        width=st.floats(0.01, 100),
        bounds=st.sampled_from(BOUNDS),
        optimizer=st.sampled_from(
            [None, SGD, functools.partial(torch.optim.SGD, lr=0.1, momentum=0.9), torch.optim.LBFGS]
        ),
    )
    def test_actions_are_finite_and_inside_the_spec_whatever_the_cost(
        self, value: float, slope: float, low: float, width: float, bounds: Any, optimizer: Any
    ) -> None:
        spec = Bounded(low, low + width, (2,))
        env = reach_env(lambda latent, action: value + slope * action.sum(-1), spec)
        planner = GradientMPC(env, 2, 5, bounds=bounds, optimizer=optimizer, seed=0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            out = planner(TensorDict(latent=torch.zeros(3, 2), batch_size=3))
        for actions in (out["action"], out["next", "plan"].flatten(0, 1)):
            assert actions.isfinite().all()
            assert all(spec.is_in(action) for action in actions)

    @pytest.mark.parametrize("bounds", BOUNDS)
    def test_every_plan_that_is_evaluated_is_inside(self, bounds: Any) -> None:
        """Those between two steps of LBFGS too, of which the best may be returned."""
        seen: list[Tensor] = []

        def cost(latent: Tensor, action: Tensor) -> Tensor:
            seen.append(action.detach())
            return -action.sum(-1)

        planner = GradientMPC(reach_env(cost), 3, 2, optimizer=torch.optim.LBFGS, bounds=bounds, seed=0)
        seen.clear()
        action = planner(TensorDict(latent=torch.zeros(1)))["action"]
        assert len(seen) > 3  # two steps and the last plan
        assert all((actions.abs() <= 2).all() for actions in seen)
        torch.testing.assert_close(action, torch.tensor([2.0]))

    def test_what_the_optimiser_is_told_is_the_sum_of_finite_costs(self) -> None:
        told: list[float] = []

        class Listen(torch.optim.SGD):
            def step(self, closure: Any) -> None:  # type: ignore[override] (torch's has overloads)
                told.append(float(closure()))

        def cost(latent: Tensor, action: Tensor) -> Tensor:
            return torch.where(latent[..., 0] > 0, math.inf, 3.0 + 0 * action[..., 0])

        def hold(latent: Tensor, action: Tensor) -> Delta:
            return Delta(latent)

        env = LatentEnv(hold, action_spec=Bounded(-1, 1, (1,)), cost=cost, latent_dim=1)
        planner = GradientMPC(env, 1, 1, optimizer=Listen, num_starts=2, seed=0)
        told.clear()
        plan = planner.plan(torch.tensor([[1.0], [-1.0]]), cold(planner, 2))
        assert told == [6.0]
        assert plan.best_cost.tolist() == [math.inf, 3.0]

    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
    def test_no_finite_cost_gives_the_centre_and_one_warning(self, bad: float) -> None:
        env = reach_env(lambda latent, action: bad + action.sum(-1), Bounded(10, 20, (2,)))
        with pytest.warns(RuntimeWarning, match="no candidate plan has a finite cost") as caught:
            out = GradientMPC(env, 3, 4, seed=0)(TensorDict(latent=torch.zeros(5, 2), batch_size=5))
        assert len(caught) == 1
        torch.testing.assert_close(out["action"], torch.full((5, 2), 15.0))

    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
    @pytest.mark.parametrize(
        "optimizer", [None, functools.partial(torch.optim.LBFGS, line_search_fn="strong_wolfe")]
    )
    def test_a_bad_start_leaves_the_others_alone(self, bad: float, optimizer: Any) -> None:
        def cost(latent: Tensor, action: Tensor) -> Tensor:
            u = action[..., 0]
            return torch.where(u > 0.1, bad, (u + 0.3).square()) * torch.where(u > 0.1, u, 1.0)

        planner = GradientMPC(
            reach_env(cost), 1, 100, num_starts=8, warm_std=1.0, optimizer=optimizer, seed=0
        )
        td = TensorDict(latent=torch.zeros(2, 1), plan=torch.tensor([1.0, -1.0]).reshape(2, 1, 1))
        td.batch_size = [2]
        torch.testing.assert_close(planner(td)["action"], torch.full((2, 1), -0.3), atol=1e-3, rtol=0)

    def test_a_gradient_that_is_not_finite_is_no_gradient(self) -> None:
        """The root has no slope at zero: that action stays, the other goes to its optimum."""

        def cost(latent: Tensor, action: Tensor) -> Tensor:
            return action[..., 0].abs().sqrt() + (action[..., 1] - 1).square()

        planner = GradientMPC(reach_env(cost, Bounded(-2, 2, (2,))), 1, 100, num_starts=1, seed=0)
        action = planner(TensorDict(latent=torch.zeros(2)))["action"]
        torch.testing.assert_close(action, torch.tensor([0.0, 1.0]), atol=1e-2, rtol=0)

    def test_actions_that_are_no_numbers_cost_infinity(self) -> None:
        """Whatever the optimiser does, and however well the cost speaks of it."""

        def cost(latent: Tensor, action: Tensor) -> Tensor:
            return torch.where(action[..., 0].isnan(), -100.0, action[..., 0].square())

        planner = GradientMPC(
            reach_env(cost, Unbounded((1,))), 1, 3, optimizer=_Poison, num_starts=1, init_std=1.0, seed=0
        )
        plan = planner.plan(torch.zeros(1), Proposal(torch.ones(1, 1), torch.ones(1, 1)))
        assert plan.actions.item() == 1.0
        assert plan.best_cost.item() == 1.0

    def test_unbounded_actions_that_run_away_lose(self) -> None:
        """The cost is lowest where an action is no number, and it does not look at it."""

        def cost(latent: Tensor, action: Tensor) -> Tensor:
            return (action[..., 0] - 1).square() - action[..., 1].clamp(-1, 1) + action[..., 1] * 0

        optimizer = functools.partial(torch.optim.SGD, lr=1e30, momentum=0.9)
        planner = GradientMPC(
            reach_env(cost, Unbounded((2,))), 1, 20, optimizer=optimizer, init_std=1.0, seed=0
        )
        assert planner(TensorDict(latent=torch.zeros(2)))["action"].isfinite().all()


class _Poison(torch.optim.Optimizer):
    def __init__(self, variables: list[Tensor]) -> None:
        super().__init__(variables, {})

    def step(self, closure: Any) -> None:  # type: ignore[override] (torch's has overloads)
        closure()
        with torch.no_grad():
            self.param_groups[0]["params"][0].fill_(math.nan)


class _Network(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.network = nn.Sequential(nn.Linear(4, 8), nn.Tanh(), nn.Linear(8, 2))

    def forward(self, latent: Tensor, action: Tensor) -> Delta:
        return Delta(self.network(torch.cat([latent * action, action], dim=-1)))


class TestModes:
    def make(self) -> tuple[_Network, GradientMPC]:
        model = _Network().double()
        return model, GradientMPC(linear_env(model=model), 3, 5, seed=0, return_stats=True)

    @pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode, torch.enable_grad])
    def test_any_mode_gives_the_same_plan(self, mode: Any) -> None:
        _, planner = self.make()
        expected = planner(TensorDict(latent=states(), batch_size=5))
        planner.set_seed(0)
        with mode():
            td = TensorDict(latent=states(), batch_size=5)  # made inside
            if mode is torch.enable_grad:
                td["latent"].requires_grad_()
            out = planner(td)
        assert torch.equal(out["action"], expected["action"])
        assert not out["action"].requires_grad
        assert not out["plan_stats", "cost"].requires_grad
        assert not out["next", "plan"].requires_grad

    @pytest.mark.parametrize("training", [True, False])
    def test_the_model_is_left_alone(self, training: bool, monkeypatch: pytest.MonkeyPatch) -> None:
        model, planner = self.make()
        model.train(training)
        before, state = copy.deepcopy(model.state_dict()), torch.get_rng_state()
        monkeypatch.setattr(Tensor, "backward", None)  # calling it would fail
        planner(TensorDict(latent=states(), batch_size=5))
        assert all(module.training == training for module in model.modules())
        assert all(p.grad is None and p.requires_grad for p in model.parameters())
        assert all(torch.equal(before[name], value) for name, value in model.state_dict().items())
        assert torch.equal(state, torch.get_rng_state())

    def test_the_noise_is_the_same_in_every_step_and_new_in_every_call(self) -> None:
        def noisy(latent: Tensor, action: Tensor) -> torch.distributions.Distribution:
            return diag_gaussian(linear(latent, action).mean, torch.ones_like(latent))

        cost = Counter(quadratic_cost(torch.ones(2, dtype=torch.float64)))
        env = linear_env(model=noisy, cost=cost)
        frozen = functools.partial(torch.optim.SGD, lr=0.0)
        planner = GradientMPC(env, 3, 4, optimizer=frozen, num_samples=8, num_starts=1, seed=0)
        cost.costs.clear()
        for _ in range(2):
            planner.plan(states(), cold(planner, 5))
        first, second = cost.costs[:5], cost.costs[5:]
        assert all(torch.equal(costs, first[0]) for costs in first)
        assert all(torch.equal(costs, second[0]) for costs in second)
        assert not torch.equal(first[0], second[0])

    def test_all_rows_start_from_the_same_draws(self) -> None:
        planner = GradientMPC(linear_env(), 3, num_starts=5, seed=0)
        starts = planner._starts(cold(planner, 2))
        assert starts.shape == (2, 5, 3, 2)
        assert torch.equal(starts[0], starts[1])
        assert torch.equal(starts[:, 0], cold(planner, 2).mean)
        assert len(starts[0].flatten(1).unique(dim=0)) == 5

    @pytest.mark.parametrize("optimizer", [None, torch.optim.LBFGS])
    def test_empty_batch(self, optimizer: Any) -> None:
        planner = GradientMPC(linear_env(), 3, optimizer=optimizer, seed=0)
        out = planner(TensorDict(latent=states()[:0], batch_size=0))
        assert out["action"].shape == (0, 2)

    def test_survives_pickle_with_an_optimizer(self) -> None:
        planner = GradientMPC(linear_env(), 3, 3, optimizer=SGD, bounds="reparameterize", seed=0)
        other = pickle.loads(pickle.dumps(planner))
        td = TensorDict(latent=states(), batch_size=5)
        assert torch.equal(planner(td.clone())["action"], other(td.clone())["action"])


class TestRefused:
    @pytest.mark.parametrize(
        "cost",
        [
            lambda latent, action: (latent[..., 0] > 0).double(),
            lambda latent, action: latent.detach().sum(-1),
            lambda latent, action: torch.ones_like(latent[..., 0], requires_grad=True) * 1.0,
        ],
    )
    def test_a_cost_without_gradient(self, cost: Any) -> None:
        planner = GradientMPC(reach_env(cost), 2, seed=0)
        with pytest.raises(ValueError, match=r"must be differentiable in the actions.*LatentEnv.*CEM, MPPI"):
            planner(TensorDict(latent=torch.zeros(1)))

    @pytest.mark.parametrize("penalty", [None, 10.0])
    def test_constraints(self, penalty: float | None) -> None:
        def far(latent: Tensor, action: Tensor) -> Tensor:
            return latent[..., 0] > 1

        constraint = ChanceConstraint(far, 0.1, penalty=penalty)
        with pytest.raises(ValueError, match="constraints must be empty for gradient planning"):
            GradientMPC(linear_env(), 2, num_samples=8, constraints=[constraint])
        env = linear_env(how="sample", num_samples=8, constraints=[constraint])
        with pytest.raises(ValueError, match="constraints must be empty for gradient planning"):
            GradientMPC(env, 2)
        assert isinstance(GradientMPC(env, 2, constraints=[]), Planner)

    @pytest.mark.parametrize(
        ("kwargs", "error", "message"),
        [
            ({"optim_steps": 0}, ValueError, "optim_steps must be an integer of at least 1, got 0"),
            ({"num_starts": 0}, ValueError, "num_starts must be an integer of at least 1, got 0"),
            ({"patience": 0}, ValueError, "patience must be an integer of at least 1, got 0"),
            ({"bounds": "tanh"}, ValueError, "bounds must be 'reparameterize' or 'project', got 'tanh'"),
            ({"tolerance": -0.1}, ValueError, r"tolerance must be in \[0, 1\).*got -0.1"),
            ({"tolerance": math.nan}, ValueError, r"tolerance must be in \[0, 1\).*got nan"),
            ({"max_ms": 0.0}, ValueError, "max_ms must be positive and finite.*got 0.0"),
            ({"max_ms": math.inf}, ValueError, "max_ms must be positive and finite.*got inf"),
            ({"optimizer": 0.1}, TypeError, "optimizer must be a function that makes.*got 0.1"),
            ({"optimizer": list}, TypeError, "optimizer must be a function.*got one that makes list"),
            (
                {"optimizer": torch.optim.SGD([torch.zeros(1)])},
                TypeError,
                "optimizer must be a function that makes a torch optimiser",
            ),
        ],
    )
    def test_arguments(self, kwargs: dict[str, Any], error: type[Exception], message: str) -> None:
        with pytest.raises(error, match=message):
            GradientMPC(linear_env(), **{"planning_horizon": 2, **kwargs})


MIXED_LOW = torch.tensor([-1.0, 2.0, -math.inf, -math.inf, 10.0], dtype=torch.float64)
MIXED_HIGH = torch.tensor([3.0, math.inf, -1.0, math.inf, 10.5], dtype=torch.float64)


class TestSquash:
    @given(st.lists(st.floats(-3, 3), min_size=5, max_size=5), st.floats(0.1, 1.0))
    def test_there_and_back(self, values: list[float], unit: float) -> None:
        x = torch.tensor(values, dtype=torch.float64) * torch.tensor([1, 1, 1, 1, 0.1])
        unit = torch.tensor([unit, unit, unit, unit, 0.2], dtype=torch.float64)
        action = squash(x, MIXED_LOW, MIXED_HIGH, unit)
        assert ((action > MIXED_LOW) & (action < MIXED_HIGH)).all()
        torch.testing.assert_close(unsquash(action, MIXED_LOW, MIXED_HIGH, unit), x, atol=1e-6, rtol=1e-6)

    @given(st.lists(st.floats(-1e30, 1e30), min_size=5, max_size=5))
    def test_gradients_are_finite(self, values: list[float]) -> None:
        x = torch.tensor(values, dtype=torch.float64, requires_grad=True)
        action = squash(x, MIXED_LOW, MIXED_HIGH, torch.ones(5, dtype=torch.float64))
        assert ((action >= MIXED_LOW) & (action <= MIXED_HIGH)).all()
        (gradient,) = torch.autograd.grad(action.sum(), x)
        assert (gradient.isfinite() & (gradient >= 0)).all()

    def test_the_unit_is_the_step_in_the_middle(self) -> None:
        low, high, unit = torch.tensor([-8.0, -math.inf]), torch.tensor([8.0, math.inf]), torch.tensor([2, 3])
        x = torch.zeros(2, requires_grad=True)
        (gradient,) = torch.autograd.grad(squash(x, low, high, unit).sum(), x)
        torch.testing.assert_close(gradient, torch.tensor([2.0, 3.0]))

    def test_bounds_are_left_a_little(self) -> None:
        unit = torch.full((5,), 0.5, dtype=torch.float64)
        edge = torch.tensor([3.0, 2.0, -1.0, 7.0, 10.0], dtype=torch.float64)
        x = unsquash(edge, MIXED_LOW, MIXED_HIGH, unit)
        expected = torch.tensor([2.98, 2.005, -1.005, 7.0, 10.0025], dtype=torch.float64)
        torch.testing.assert_close(squash(x, MIXED_LOW, MIXED_HIGH, unit), expected)

    @pytest.mark.parametrize("bounds", BOUNDS)
    def test_planning_with_half_bounded_actions(self, bounds: Any) -> None:
        spec = Bounded(torch.tensor([2.0, -math.inf, -1.0]), torch.tensor([math.inf, -1.0, math.inf]), (3,))
        env = reach_env(quadratic_cost(torch.tensor([0.0, -3.0, 4.0])), spec)
        planner = GradientMPC(env, 1, 200, bounds=bounds, init_std=1.0, seed=0)
        action = planner(TensorDict(latent=torch.zeros(3)))["action"]
        torch.testing.assert_close(action, torch.tensor([2.0, -3.0, 4.0]), atol=0.02, rtol=0)

    def test_planning_without_bounds(self) -> None:
        env = reach_env(quadratic_cost(torch.tensor([30.0])), Unbounded((1,)))
        planner = GradientMPC(env, 1, 200, bounds="reparameterize", init_std=10.0, seed=0)
        action = planner(TensorDict(latent=torch.zeros(1)))["action"]
        torch.testing.assert_close(action, torch.tensor([30.0]), atol=0.1, rtol=0)


def test_a_plan_is_best_and_actions_at_once() -> None:
    planner = GradientMPC(linear_env(), 2, 3, seed=0)
    start = cold(planner, 5)
    plan = planner.plan(states(), start)
    assert isinstance(plan, Plan)
    assert plan.actions is plan.best
    assert torch.equal(plan.std, start.std)
