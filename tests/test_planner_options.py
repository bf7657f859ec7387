"""Options of the planners: each against what it says, and off by default."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite
from torchrl.envs import Compose, InitTracker, PendulumEnv, TransformedEnv

from torchrl_vjepa.costs import quadratic_cost
from torchrl_vjepa.distributions import Delta, diag_gaussian
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.planners import CEM, MPPI, GradientMPC, Plan, Planner, Proposal, RandomShooting
from torchrl_vjepa.planners.noise import coloured_noise_factor
from torchrl_vjepa.priors import Ball, RegionPrior
from torchrl_vjepa.risk import REJECTED_COST, ChanceConstraint, cvar, expectation, worst_case


def integrate(latent: Tensor, action: Tensor) -> Delta:
    return Delta(latent + 0.3 * action)


def noisy(latent: Tensor, action: Tensor) -> torch.distributions.Distribution:
    loc = latent + 0.3 * action
    return diag_gaussian(loc, torch.full_like(loc, 0.1))


def make_env(model: Any = integrate, spec: Any = None, **kwargs: Any) -> LatentEnv:
    spec = Bounded(-1, 1, (2,)) if spec is None else spec
    return LatentEnv(model, action_spec=spec, cost=quadratic_cost(torch.ones(2)), latent_dim=2, **kwargs)


def states(num: int = 3) -> TensorDict:
    latent = torch.randn(num, 2, generator=torch.Generator().manual_seed(5))
    return TensorDict(latent=latent, batch_size=num)


class TestColouredNoise:
    @pytest.mark.parametrize("horizon", [1, 2, 7, 40])
    @pytest.mark.parametrize("beta", [0.0, 1.0, 2.0, 4.0])
    def test_the_covariance_is_the_spectrum(self, horizon: int, beta: float) -> None:
        factor = coloured_noise_factor(horizon, beta)
        covariance = factor @ factor.mT
        frequencies = torch.arange(horizon + 1).double() / (2 * horizon)
        power = frequencies.clone()
        power[0] = power[1]
        power = power**-beta
        # Frequencies between zero and Nyquist stand for two: themselves and their negatives.
        count = torch.full_like(power, 2.0)
        count[0] = count[-1] = 1.0
        lags = (torch.arange(horizon).unsqueeze(-1) - torch.arange(horizon)).double()
        waves = torch.cos(2 * math.pi * frequencies * lags.unsqueeze(-1))
        expected = (count * power * waves).sum(-1) / (count * power).sum()
        torch.testing.assert_close(covariance, expected)
        torch.testing.assert_close(covariance.diagonal(), torch.ones(horizon).double())

    def test_white_is_white(self) -> None:
        torch.testing.assert_close(coloured_noise_factor(9, 0.0), torch.eye(9).double())

    @pytest.mark.parametrize("spec", [Bounded(-1, 1, (2,)), Categorical(2)])
    def test_candidates_hold_what_they_do(self, spec: Any) -> None:
        env = make_env(spec=spec)
        share = []
        for beta in (0.0, 1.0, 3.0):
            planner = CEM(env, 20, num_candidates=2000, seed=0, noise_beta=beta)
            start = planner.family.cold((), 20)
            plans = planner._candidates(start, planner.codec.mode(start.mean))[2:]
            sides = plans[..., 0] > start.mean[..., 0]
            share.append(float((sides[:, 1:] == sides[:, :-1]).float().mean()))
            # Each step alone is distributed as before.
            std = plans[..., 0].std(0)
            torch.testing.assert_close(std, planner.cold_std[:1].expand(20), atol=0.06, rtol=0)
        assert abs(share[0] - 0.5) < 0.02
        assert share[0] < share[1] - 0.05 < share[2] - 0.1

    def test_pairs_stay_antithetic_and_the_stream_the_same(self) -> None:
        planner = CEM(make_env(), 6, num_candidates=40, seed=0, noise_beta=2.0, init_std=0.1)
        start = planner.family.cold((), 6)
        plans = planner._candidates(start, start.mean)
        torch.testing.assert_close(plans[2:20], -plans[22:])
        plain = CEM(make_env(), 6, num_candidates=40, seed=0, init_std=0.1)
        plain._candidates(start, start.mean)
        assert torch.equal(plain.generator.get_state(), planner.generator.get_state())

    @pytest.mark.parametrize("cls", [RandomShooting, CEM, MPPI])
    def test_it_finds_long_ways_sooner(self, cls: type[Planner]) -> None:
        """Far from the goal all steps point the same way: what white noise hardly draws."""
        td = TensorDict(latent=torch.full((2,), -4.0))
        cost = {}
        for beta in (0.0, 2.0):
            planner = cls(make_env(), 20, 1, 64, seed=0, noise_beta=beta)
            plan = planner.plan(td["latent"], planner.family.cold((), 20))
            cost[beta] = float(plan.best_cost)
        assert cost[2.0] < 0.9 * cost[0.0]

    @pytest.mark.parametrize("beta", [-1.0, 5.0, math.nan])
    def test_bad_colours_are_refused(self, beta: float) -> None:
        with pytest.raises(ValueError, match=r"noise_beta must be in \[0, 4\]"):
            CEM(make_env(), 3, noise_beta=beta)

    def test_it_follows_the_dtype(self) -> None:
        env = make_env(spec=Bounded(-1, 1, (2,), dtype=torch.float64))
        assert CEM(env, 3, 2, 16, seed=0, noise_beta=1.0)(states())["action"].dtype == torch.float64


class _Spy(CEM):
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.seen: list[Tensor] = []
        self.elites: list[Tensor] = []

    def _evaluator(self, state: Any) -> Callable[[Tensor], Tensor]:
        evaluate = super()._evaluator(state)

        def spied(candidates: Tensor) -> Tensor:
            self.seen.append(candidates.clone())
            return evaluate(candidates)

        return spied

    def update(self, proposal: Proposal, elites: Tensor, costs: Tensor) -> Proposal:
        self.elites.append(elites.clone())
        return super().update(proposal, elites, costs)


class TestKeptElites:
    def test_they_are_candidates_of_the_next_round(self) -> None:
        planner = _Spy(make_env(), 4, 3, 32, 8, seed=0, keep_elites=0.5)
        planner(states())
        for before, after in zip(planner.elites, planner.seen[1:], strict=False):
            torch.testing.assert_close(after[:, -4:], before[:, 1:5])

    def test_off_by_default(self) -> None:
        one = CEM(make_env(), 4, 3, 32, seed=0)(states())["action"]
        two = CEM(make_env(), 4, 3, 32, seed=0, keep_elites=0.0, noise_beta=0.0)(states())["action"]
        assert torch.equal(one, two)

    @pytest.mark.parametrize("num", [1, 2, 3, 5])
    def test_mean_and_best_keep_their_places(self, num: int) -> None:
        planner = _Spy(make_env(), 2, 3, num, num, seed=0, keep_elites=1.0)
        planner(states())
        assert planner._num_kept == max(0, min(num - 1, num - 2))
        if num > 2:
            torch.testing.assert_close(planner.seen[1][:, 1], planner.elites[0][:, 0])

    def test_bad_fractions_are_refused(self) -> None:
        with pytest.raises(ValueError, match=r"keep_elites must be in \[0, 1\], got 1.5"):
            CEM(make_env(), 3, keep_elites=1.5)


class TestReportedRisks:
    RISKS = {"mean": expectation, "tail": cvar(0.2), "worst": worst_case}

    def test_they_are_risks_of_the_same_trajectories(self) -> None:
        env = make_env(noisy, how="sample", num_samples=40)
        planner = CEM(env, 3, 2, 16, seed=0, return_stats=self.RISKS)
        out = planner(states(4))
        stats = out["plan_stats"]
        assert set(stats.keys()) == {"actions", "std", "cost", "mean", "tail", "worst"}
        assert {("plan_stats", name) for name in self.RISKS} <= set(planner.out_keys)
        torch.testing.assert_close(stats["mean"], stats["cost"])
        assert (stats["mean"] < stats["tail"]).all()
        assert (stats["tail"] < stats["worst"]).all()
        plain = CEM(env, 3, 2, 16, seed=0, return_stats=True)(states(4))
        assert torch.equal(plain["action"], out["action"])
        assert torch.equal(plain["plan_stats", "cost"], stats["cost"])

    def test_they_leave_constraints_out(self) -> None:
        constraint = ChanceConstraint(_always, 0.1)
        env = make_env(noisy, how="sample", num_samples=8)
        planner = CEM(env, 2, 2, 16, seed=0, constraints=[constraint], return_stats={"worst": worst_case})
        with pytest.warns(RuntimeWarning, match="no candidate plan satisfies"):
            stats = planner(states())["plan_stats"]
        assert (stats["cost"] >= REJECTED_COST).all()
        assert (stats["worst"] < REJECTED_COST).all()
        assert stats["violation"].shape == (3, 1)

    def test_early_refusal(self) -> None:
        with pytest.raises(TypeError, match="return_stats must be True, False or risks by name.*got list"):
            CEM(make_env(), 3, return_stats=[worst_case])  # type: ignore[arg-type]  # wrong on purpose
        with pytest.raises(ValueError, match="return_stats must not rename 'cost'"):
            CEM(make_env(noisy, how="sample"), 2, return_stats={"cost": expectation})
        with pytest.raises(ValueError, match="num_samples"):
            CEM(make_env(), 2, return_stats={"tail": cvar(0.2)})
        with pytest.raises(TypeError, match="risk"):
            CEM(make_env(noisy, how="sample", num_samples=4), 2, return_stats={"tail": 0.2})

    def test_of_other_environments(self) -> None:
        env = PendulumEnv(seed=0)
        td = env.reset()
        planner = CEM(env, 2, 1, 8, seed=0, num_samples=4, return_stats={"worst": worst_case})
        stats = planner(td)["plan_stats"]
        torch.testing.assert_close(stats["worst"], stats["cost"])  # exact dynamics have no risk


def _always(latent: Tensor, action: Tensor) -> Tensor:
    return torch.ones_like(latent[..., 0]).bool()


class Counter(CEM):
    """Counts its searches."""

    searches = 0

    def plan(self, state: Any, proposal: Proposal) -> Plan:
        self.searches += 1
        return super().plan(state, proposal)


class TestReplanInterval:
    @pytest.mark.parametrize(
        "spec", [Bounded(-1, 1, (2,)), Categorical(2), Composite(a=Binary(1), b=Binary(1))]
    )
    def test_a_plan_is_executed_step_by_step(self, spec: Any) -> None:
        planner = Counter(make_env(spec=spec), 5, 2, 32, seed=0, replan_interval=3, return_stats=True)
        td, plans, taken = states(4), [], []
        for step in range(7):
            out = planner(td.clone())
            assert planner.searches == 1 + step // 3
            plans.append(planner.codec.mode(out["plan_stats", "actions"]))
            taken.append(planner.codec.encode(out))
            torch.testing.assert_close(out["next", "plan_age"], torch.full((4, 1), (step + 1) % 3))
            td = states(4).update(out["next"]).set("is_init", torch.zeros(4, 1).bool())
        for step in range(7):
            begin = 3 * (step // 3)
            torch.testing.assert_close(taken[step], plans[begin][:, step - begin])

    def test_rows_are_at_steps_of_their_own(self) -> None:
        planner = Counter(make_env(), 5, 2, 32, seed=0, replan_interval=4)
        out = planner(states(3))
        td = states(3).update(out["next"])
        td["is_init"] = torch.tensor([[False], [True], [False]])
        again = planner(td.clone())
        assert planner.searches == 2  # for the row that begins
        assert again["next", "plan_age"].flatten().tolist() == [2, 1, 2]
        torch.testing.assert_close(again["action"][[0, 2]], out["next", "plan"][[0, 2], 0])
        planner.set_seed(0)
        planner(states(3))
        new = planner(states(3))
        torch.testing.assert_close(again["action"][1], new["action"][1])

    def test_torchrl_carries_plan_and_age(self) -> None:
        env = PendulumEnv(seed=0)
        planner = Counter(env, 6, 2, 16, seed=0, replan_interval=3)
        primer = planner.make_tensordict_primer()
        assert set(primer.primers.keys()) == {"plan", "plan_age"}
        env = TransformedEnv(env, Compose(InitTracker(), primer))
        rollout = env.rollout(9, planner)
        assert planner.searches == 3
        assert rollout["plan_age"].flatten().tolist() == [0, 1, 2] * 3

    def test_off_by_default_and_checked(self) -> None:
        planner = CEM(make_env(), 3)
        assert ("next", "plan_age") not in planner.out_keys
        with pytest.raises(ValueError, match="replan_interval must be at most planning_horizon=3"):
            CEM(make_env(), 3, replan_interval=4)
        with pytest.raises(ValueError, match="replan_interval must be an integer of at least 1, got 0"):
            CEM(make_env(), 3, replan_interval=0)
        nested = CEM(make_env(), 3, plan_key=("memory", "plan"), replan_interval=2)
        assert ("next", "memory", "plan_age") in nested.out_keys

    def test_gradient_planning_too(self) -> None:
        planner = GradientMPC(make_env(), 4, 10, seed=0, replan_interval=2)
        out = planner(states())
        again = planner(states().update(out["next"]))
        assert torch.equal(again["action"], out["next", "plan"][:, 0])


class TestRegions:
    @pytest.mark.parametrize("cls", [RandomShooting, CEM, MPPI])
    def test_a_region_prior_is_a_constraint(self, cls: type[Planner]) -> None:
        """An obstacle between start and goal: plans go around it with the probability asked for."""
        obstacle = RegionPrior(Ball(torch.tensor([0.0, 0.0]), 0.5), sharpness=5.0, keep="out")
        env = make_env(noisy, how="sample", num_samples=64)
        td = TensorDict(latent=torch.tensor([[-1.0, -0.9]]), batch_size=1)
        settings = {"optim_steps": 6, "num_candidates": 256, "seed": 0, "num_samples": 64}
        constraint = ChanceConstraint(obstacle.violated, 0.1)
        planner = cls(env, 8, **settings, constraints=[constraint], return_stats=True)
        out = planner(td.clone())
        assert float(out["plan_stats", "violation"]) < 0.25  # of fresh noise
        free = cls(env, 8, **settings, return_stats=True)(td.clone())
        through = env.violation_probability(
            td["latent"], free["plan_stats", "actions"].unsqueeze(1), constraints=[constraint], num_samples=64
        )
        assert float(through) > 0.5
