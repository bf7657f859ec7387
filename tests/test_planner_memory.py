"""What planners carry from step to step, and how long they hold what they do."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, Categorical, OneHot
from torchrl.envs import Compose, InitTracker, PendulumEnv, TransformedEnv
from torchrl.modules import get_env_transforms_from_module

from torchrl_vjepa.distributions import Delta
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.planners import (
    CEM,
    MPPI,
    EnvObjective,
    ExhaustiveSearch,
    GradientMPC,
    Plan,
    Planner,
    Proposal,
    RandomShooting,
    TreeSearch,
)
from torchrl_vjepa.planners.expansion import EnvExpansion, HeldExpansion
from torchrl_vjepa.priors import GoalPrior

GOAL = torch.tensor([1.0, -0.7])
NUMBERS, CHOICES = Bounded(-1, 1, (2,)), OneHot(2, dtype=torch.float32)
EVERY = [
    (RandomShooting, {"num_candidates": 32}, NUMBERS),
    (CEM, {"num_candidates": 32}, NUMBERS),
    (MPPI, {"num_candidates": 32, "noise_beta": 1.0}, NUMBERS),
    (GradientMPC, {"optim_steps": 8}, NUMBERS),
    (CEM, {"num_candidates": 32}, CHOICES),
    (ExhaustiveSearch, {"warm_start": True}, CHOICES),
    (TreeSearch, {"num_simulations": 24}, CHOICES),
    (TreeSearch, {"num_simulations": 24, "discount": 0.8}, CHOICES),
]


def step(latent: Tensor, action: Tensor) -> Delta:
    return Delta(latent + 0.3 * action)


def distance(latent: Tensor, action: Tensor) -> Tensor:
    return (latent - GOAL).square().sum(-1)


def make_env(spec: Any = NUMBERS) -> LatentEnv:
    return LatentEnv(step, action_spec=spec, cost=distance, latent_dim=2)


def leaping_env(spec: Any, repeat: int, discount: float) -> LatentEnv:
    """The same environment, of which one step is several: written by hand."""

    def leap(latent: Tensor, action: Tensor) -> Delta:
        return Delta(latent + repeat * 0.3 * action)

    def cost(latent: Tensor, action: Tensor) -> Tensor:
        passed = [latent - 0.3 * (repeat - 1 - j) * action for j in range(repeat)]
        return sum(discount**j * distance(state, action) for j, state in enumerate(passed))

    return LatentEnv(leap, action_spec=spec, cost=cost, latent_dim=2)


def states(num: int = 3) -> TensorDict:
    latent = torch.randn(num, 2, generator=torch.Generator().manual_seed(5))
    return TensorDict(latent=latent, batch_size=num)


class Counter(CEM):
    """Counts its searches, and keeps where they started and what they tried first."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.starts: list[Proposal] = []
        self.tried: list[Tensor] = []

    def plan(self, state: Any, proposal: Proposal, suggested: Tensor | None = None) -> Plan:
        self.starts.append(proposal)
        self.tried.append(torch.empty(0))
        return super().plan(state, proposal, suggested)

    def _candidates(self, *args: Any) -> Tensor:
        candidates = super()._candidates(*args)
        if not self.tried[-1].numel():
            self.tried[-1] = candidates.clone()
        return candidates


class TestActionRepeat:
    @pytest.mark.parametrize(("cls", "kwargs", "spec"), EVERY)
    @pytest.mark.parametrize("repeat", [2, 3])
    def test_plans_are_those_of_an_environment_that_leaps(
        self, cls: type[Planner], kwargs: dict[str, Any], spec: Any, repeat: int
    ) -> None:
        held = cls(make_env(spec), 2 * repeat, seed=0, action_repeat=repeat, **kwargs)
        env = leaping_env(spec, repeat, kwargs.get("discount", 1.0))
        if "discount" in kwargs:
            kwargs = {**kwargs, "discount": kwargs["discount"] ** repeat}
        leap = cls(env, 2, seed=0, **kwargs)
        latent = states()["latent"]
        start = held.family.cold((3,), 2)
        actual, expected = held.plan(latent, start), leap.plan(latent, start)
        for name in ("actions", "std", "best", "best_cost"):
            torch.testing.assert_close(getattr(actual, name), getattr(expected, name))
        for name, value in expected.statistics.items():
            torch.testing.assert_close(actual.statistics[name], value)
        long = actual.held(repeat)
        assert long.actions.shape == long.best.shape == (3, 2 * repeat, 2)
        assert torch.equal(long.std[:, ::repeat], actual.std)
        assert torch.equal(long.std[:, repeat - 1 :: repeat], actual.std)

    @pytest.mark.parametrize(("cls", "kwargs", "spec"), EVERY)
    def test_actions_are_held_and_searches_are_as_rare(
        self, cls: type[Planner], kwargs: dict[str, Any], spec: Any
    ) -> None:
        planner = cls(make_env(spec), 6, seed=0, action_repeat=3, **kwargs)
        assert (planner.num_decisions, planner.replan_interval) == (2, 3)
        td, taken = states(), []
        for k in range(9):
            td = planner(td)
            taken.append(td["action"])
            latent = td["latent"] + 0.3 * td["action"]
            td = TensorDict(latent=latent, batch_size=3).update(td["next"])
            assert td["plan_age"].flatten().tolist() == [(k + 1) % 3] * 3
        blocks = torch.stack(taken, dim=1).unflatten(1, (3, 3))
        assert (blocks == blocks[:, :, :1]).all()

    def test_the_next_search_starts_from_what_is_left_of_the_plan(self) -> None:
        planner = Counter(make_env(), 6, 2, 32, seed=0, action_repeat=2)
        td = planner(states()).clone()
        plan = torch.cat([td["action"].unsqueeze(1), td["next", "plan"][:, :-1]], dim=1)
        td = planner(states().update(td["next"]))
        assert len(planner.starts) == 1
        planner(states().update(td["next"]))
        kept = plan[:, ::2]
        expected = torch.cat([kept[:, 1:], kept[:, -1:]], dim=1)
        torch.testing.assert_close(planner.starts[1].mean, expected)

    def test_longer_intervals_are_multiples(self) -> None:
        planner = CEM(make_env(), 8, 2, 16, seed=0, action_repeat=2, replan_interval=4)
        td = planner(states())
        first = torch.cat([td["action"].unsqueeze(1), td["next", "plan"]], dim=1)
        for k in range(1, 4):
            td = planner(states().update(td["next"]))
            torch.testing.assert_close(td["action"], first[:, k])
        torch.testing.assert_close(first[:, [0, 2]], first[:, [1, 3]])

    @pytest.mark.parametrize("repeat", [1, 3])
    def test_statistics_are_of_steps(self, repeat: int) -> None:
        planner = CEM(make_env(), 6, 2, 16, seed=0, action_repeat=repeat, return_stats=True)
        td = planner(states())
        for _ in range(3):  # in the middle of a plan too
            plan = td["plan_stats", "actions"]
            assert plan.shape == td["plan_stats", "std"].shape == (3, 6, 2)
            cost = planner.env.objective(td["latent"], plan.unsqueeze(1))
            torch.testing.assert_close(td["plan_stats", "cost"], cost)
            td = planner(states().update(td["next"]))

    @pytest.mark.parametrize(("cls", "kwargs", "spec"), EVERY)
    def test_without_a_warm_start_too(self, cls: type[Planner], kwargs: dict[str, Any], spec: Any) -> None:
        """Actions are held, and each search starts from nothing: it finds what the first one would."""
        kwargs = {**kwargs, "warm_start": False}
        planner = cls(make_env(spec), 4, seed=0, action_repeat=2, return_stats=True, **kwargs)
        td, actions = states(), []
        for _ in range(4):
            td = planner(td)
            actions.append(td["action"])
            td = states().update(td["next"])
        assert torch.equal(actions[0], actions[1])
        assert torch.equal(actions[2], actions[3])
        start = planner._start(planner.memory.recall(td, torch.Size([3]), planner.low), torch.Size([3]))
        assert torch.equal(start.mean, planner.family.cold((3,), 2).mean)

    def test_tasks_are_those_of_the_steps(self) -> None:
        """A path that is asked for step by step, followed by actions that are held."""
        spec = OneHot(2, dtype=torch.float32)
        env = LatentEnv(step, action_spec=spec, prior=GoalPrior(std=1.0), latent_dim=2)
        path = torch.randn(3, 4, 2, generator=torch.Generator().manual_seed(1))
        td = states().set("task", path)
        for planner in (
            ExhaustiveSearch(env, 4, action_repeat=2),
            TreeSearch(env, 4, 24, action_repeat=2, output="best", seed=0),
        ):
            plan = planner.plan(env.planning_state(td), planner.family.cold((3,), 2))
            cost = env.objective(env.planning_state(td), plan.held(2).best.unsqueeze(1)).squeeze(1)
            torch.testing.assert_close(plan.best_cost, cost)

    def test_what_has_ended_costs_nothing_more(self) -> None:
        class Ends(PendulumEnv):
            def _step(self, tensordict: Any) -> Any:
                out = super()._step(tensordict)
                return out.set("done", torch.ones_like(out["done"])).set("terminated", out["done"])

        source = EnvObjective(Ends(seed=0))
        root = EnvExpansion(source, source.planning_state(Ends(seed=0).reset()))
        action = torch.ones(1, 1)
        state, first = root.expand(root.root, action, 0)
        assert first > 0
        assert root.expand(state, action, 1)[1] == 0
        assert HeldExpansion(root, 3).expand(root.root, action, 0)[1] == first

    def test_it_steps_other_environments(self) -> None:
        env = PendulumEnv(seed=0)
        planner = CEM(env, 10, 2, 32, seed=0, action_repeat=5)
        env = TransformedEnv(env, Compose(InitTracker(), planner.make_tensordict_primer()))
        blocks = env.rollout(20, planner)["action"].unflatten(0, (4, 5))
        assert (blocks == blocks[:, :1]).all()
        assert len(blocks.unique()) > 1

    def test_bad_repeats_are_refused(self) -> None:
        with pytest.raises(ValueError, match="planning_horizon must be a multiple of action_repeat=4, got 6"):
            CEM(make_env(), 6, action_repeat=4)
        with pytest.raises(ValueError, match="horizon=6 and a multiple of action_repeat=2, got 3"):
            CEM(make_env(), 6, action_repeat=2, replan_interval=3)
        with pytest.raises(ValueError, match="action_repeat must be an integer of at least 1, got 0"):
            CEM(make_env(), 6, action_repeat=0)


class TestRows:
    """Rows are at steps of their own: what one does is no matter of the others."""

    OPTIONS = (
        {"action_repeat": 2},
        {"replan_interval": 3},
        {"replan_interval": 4, "action_repeat": 2, "carry_elites": 0.5},
        {"action_repeat": 2, "warm_start": False},
    )

    @staticmethod
    def walked(planner: Planner, rows: slice, resets: dict[int, int], steps: int = 9) -> Tensor:
        td, actions = states(4)[rows], []
        for k in range(steps):
            td = planner(td)
            actions.append(td["action"])
            is_init = torch.tensor([[resets.get(row, -1) == k] for row in range(4)])[rows]
            latent = td["latent"] + 0.3 * td["action"]
            td = TensorDict({"latent": latent, "is_init": is_init}, batch_size=td.batch_size).update(
                td["next"]
            )
        return torch.stack(actions, dim=1)

    @pytest.mark.parametrize("cls", [RandomShooting, CEM, MPPI])
    @pytest.mark.parametrize("options", OPTIONS)
    def test_any_split_of_a_batch_over_many_steps(self, cls: type[Planner], options: dict[str, Any]) -> None:
        resets = {1: 0, 2: 3}
        kwargs = {"num_candidates": 24, "optim_steps": 2, "seed": 0, **options}
        together = self.walked(cls(make_env(), 8, **kwargs), slice(None), resets)
        for rows in (slice(0, 1), slice(1, 3), slice(2, 4)):
            alone = self.walked(cls(make_env(), 8, **kwargs), rows, resets)
            torch.testing.assert_close(alone, together[rows])

    @pytest.mark.parametrize("options", OPTIONS)
    def test_only_rows_whose_turn_it_is_are_searched(self, options: dict[str, Any]) -> None:
        planner = Counter(make_env(), 8, 1, 16, seed=0, **options)
        self.walked(planner, slice(None), {1: 0, 2: 3}, steps=8)
        interval = planner.replan_interval
        searched = sum(start.mean.shape[0] for start in planner.starts)
        due = 2 * len(range(0, 8, interval)) + 1 + len(range(1, 8, interval))
        due += len(range(0, 4, interval)) + len(range(4, 8, interval))
        assert searched == due

    def test_a_plan_of_zeros_is_one(self) -> None:
        planner = Counter(make_env(), 6, 1, 16, seed=0, action_repeat=3)
        td = states().set("plan", torch.zeros(3, 6, 2)).set("plan_age", torch.tensor([[1], [2], [0]]))
        td["is_init"] = torch.zeros(3, 1, dtype=torch.bool)
        out = planner(td)
        assert not out["action"][:2].any()
        assert planner.starts[0].mean.shape == (1, 2, 2)
        assert (planner.starts[0].std < planner.cold_std).all()  # and one to start from
        known_from_zeros_alone = planner(td.exclude("is_init"))
        assert known_from_zeros_alone["action"].any(-1).all()

    def test_statistics_and_elites_of_both_kinds(self) -> None:
        planner = TreeSearch(make_env(CHOICES), 4, 8, seed=0, action_repeat=2, return_stats=True)
        td = states().update(planner(states())["next"])
        td["is_init"] = torch.tensor([[False], [True], [False]])
        out = planner(td)
        assert out["plan_stats", "visits"].sum(-1).tolist() == [0, 8, 0]
        assert out["plan_stats", "value"].squeeze(-1).tolist()[0] == 0
        std = planner._start(planner.memory.recall(td, torch.Size([3]), planner.low), torch.Size([3])).std
        held = out["plan_stats", "std"][0]
        torch.testing.assert_close(held, std[0].repeat_interleave(2, dim=0))

        cem = CEM(make_env(), 6, 1, 16, 4, seed=0, carry_elites=0.5, replan_interval=3, action_repeat=3)
        td = states().update(cem(states())["next"])
        td["is_init"] = torch.tensor([[False], [True], [False]])
        after = cem(td.clone())["next", "plan_elites"]
        shifted = torch.cat([td["plan_elites"][:, :, 1:], td["plan_elites"][:, :, -1:]], dim=2)
        assert torch.equal(after[[0, 2]], shifted[[0, 2]])
        assert not torch.equal(after[1], shifted[1])

    def test_carried_elites_are_held_ones(self) -> None:
        planner = Counter(make_env(), 6, 1, 16, 4, seed=0, carry_elites=0.5, action_repeat=2)
        td = planner(states())
        td = planner(states().update(td["next"]))
        planner(states().update(td["next"]))
        assert torch.equal(planner.tried[1][:, -2:], td["next", "plan_elites"][:, :, ::2])

    def test_an_age_of_another_shape_is_named(self) -> None:
        planner = CEM(make_env(), 6, 1, 16, seed=0, replan_interval=2)
        td = states().update(planner(states())["next"]).set("plan_age", torch.zeros(3, 2).long())
        with pytest.raises(ValueError, match=r"'plan_age' must have shape \(3, 1\), got \(3, 2\)"):
            planner(td)


class TestCarriedElites:
    def test_the_next_search_tries_them_one_step_on(self) -> None:
        planner = Counter(make_env(), 5, 2, 16, 4, seed=0, carry_elites=0.5)
        td = planner(states())
        found = td["next", "plan_elites"]
        assert found.shape == (3, 2, 5, 2)
        torch.testing.assert_close(found[:, :, -1], found[:, :, -2])
        planner(states().update(td["next"]))
        assert torch.equal(planner.tried[1][:, -2:], found)

    @pytest.mark.parametrize("spec", [NUMBERS, Categorical(2)])
    def test_they_are_the_best_of_the_last_round(self, spec: Any) -> None:
        planner = CEM(make_env(spec), 5, 1, 16, 4, seed=0, carry_elites=1.0)
        start = planner.family.cold((3,), 5)
        plan = planner.plan(states()["latent"], start)
        assert plan.elites is not None
        cost = planner.env.objective(states()["latent"], plan.elites)
        assert (cost.diff(dim=-1) >= 0).all()
        torch.testing.assert_close(cost[:, 0], plan.best_cost)
        planner.set_seed(0)
        everything = planner._candidates(start, planner.codec.mode(start.mean))
        costs = planner.env.objective(states()["latent"], everything)
        torch.testing.assert_close(cost, costs.sort(-1).values[:, :4])

    def test_rows_that_begin_draw_their_candidates(self) -> None:
        planner = Counter(make_env(), 5, 2, 16, 4, seed=0, carry_elites=0.5, antithetic=False)
        td = states().update(planner(states())["next"])
        td["is_init"] = torch.tensor([[False], [True], [False]])
        noise = planner.generator.get_state()
        planner(td)
        planner.generator.set_state(noise)
        fresh = planner._candidates(planner.starts[1], planner.starts[1].mean)
        assert torch.equal(planner.tried[1][1, 2:], fresh[1, 2:])
        assert torch.equal(planner.tried[1][[0, 2], -2:], td["plan_elites"][[0, 2]])

    def test_what_is_no_plan_is_drawn_and_what_is_outside_is_put_inside(self) -> None:
        planner = CEM(make_env(), 2, 1, 8, 2, seed=0)
        start = planner.family.cold((), 2)
        suggested = torch.tensor([[[3.0, 0.0]] * 2, [[math.nan, 0.0]] * 2])
        noise = planner.generator.get_state()
        candidates = planner._candidates(start, start.mean, suggested)
        planner.generator.set_state(noise)
        expected = planner._candidates(start, start.mean)
        expected[-2] = torch.tensor([1.0, 0.0])
        assert torch.equal(candidates, expected)

    def test_suggestions_of_another_length_are_refused(self) -> None:
        planner = CEM(make_env(), 3, 1, 8, seed=0)
        start = planner.family.cold((3,), 3)
        with pytest.raises(ValueError, match=r"suggested must be plans of shape \(3, 2\), got \(2, 2\)"):
            planner.plan(states()["latent"], start, torch.zeros(3, 1, 2, 2))

    def test_a_good_suggestion_is_found(self) -> None:
        planner = RandomShooting(make_env(), 3, num_candidates=8, seed=0)
        best = ((GOAL - states()["latent"]) / 0.9).clamp(-1, 1).unsqueeze(1).expand(-1, 3, -1)
        start = planner.family.cold((3,), 3)
        plain = planner.plan(states()["latent"], start)
        plan = planner.plan(states()["latent"], start, best.unsqueeze(1))
        torch.testing.assert_close(plan.actions, best)
        assert (plan.best_cost < plain.best_cost).all()

    def test_rows_in_the_middle_of_a_plan_keep_theirs(self) -> None:
        planner = Counter(make_env(), 6, 2, 16, 4, seed=0, carry_elites=0.5, replan_interval=3)
        first = planner(states())["next", "plan_elites"]
        td = states().update(planner(states())["next"])
        second = planner(td.clone())["next", "plan_elites"]
        shifted = torch.cat([td["plan_elites"][:, :, 1:], td["plan_elites"][:, :, -1:]], dim=2)
        torch.testing.assert_close(second, shifted)
        assert first.shape == second.shape
        lost = planner(td.exclude("plan_elites"))  # a plan without them goes on
        torch.testing.assert_close(lost["action"], td["plan"][:, 0])
        assert lost["next", "plan_elites"].isfinite().all()

    def test_torchrl_carries_them(self) -> None:
        planner = CEM(PendulumEnv(), 6, 2, 16, 4, seed=0, carry_elites=0.3, action_repeat=2)
        assert set(planner.make_tensordict_primer().primers.keys()) == {"plan", "plan_age", "plan_elites"}
        env = TransformedEnv(PendulumEnv(seed=0), get_env_transforms_from_module(planner))
        assert env.rollout(5, planner)["plan_elites"].shape == (5, 2, 6, 1)

    def test_off_by_default_and_checked(self) -> None:
        assert CEM(make_env(), 3).memory.keys == {"plan": "plan"}
        with pytest.raises(ValueError, match=r"carry_elites must be in \[0, 1\], got 1.5"):
            CEM(make_env(), 3, carry_elites=1.5)
        with pytest.raises(ValueError, match="carry_elites must be 0 without warm_start, got 0.5"):
            CEM(make_env(), 3, carry_elites=0.5, warm_start=False)
        with pytest.raises(ValueError, match="carry_elites must be of at most 0 plans, what num_cand"):
            CEM(make_env(), 3, num_candidates=2, carry_elites=0.5)
        planner = CEM(make_env(), 3, 1, 8, 2, carry_elites=1.0)
        td = planner(states())
        with pytest.raises(ValueError, match=r"'plan_elites' must have shape \(3, 2, 3, 2\)"):
            planner(states().update(td["next"]).set("plan_elites", torch.zeros(3, 3, 3, 2)))
        nested = CEM(make_env(), 3, carry_elites=0.5, plan_key=("memory", "plan"))
        assert ("next", "memory", "plan_elites") in nested.out_keys


class TestDecayingPopulation:
    @pytest.mark.parametrize(
        ("decay", "expected"),
        [(1.0, [40] * 5), (0.5, [40, 20, 10, 8, 8]), (0.8, [40, 32, 26, 20, 16]), (0.01, [40, 8, 8, 8, 8])],
    )
    @pytest.mark.parametrize("antithetic", [False, True])
    def test_rounds_shrink_to_twice_the_elites(
        self, decay: float, expected: list[int], antithetic: bool
    ) -> None:
        seen: list[int] = []

        def cost(latent: Tensor, action: Tensor) -> Tensor:
            seen.append(latent.shape[-3])  # (*B, N, H, D)
            return distance(latent, action)

        env = LatentEnv(step, action_spec=NUMBERS, cost=cost, latent_dim=2)
        planner = CEM(env, 3, 5, 40, 4, population_decay=decay, antithetic=antithetic, seed=0)
        seen.clear()  # probes
        planner(states())
        assert seen == expected

    def test_refused_where_nothing_would_decay(self) -> None:
        with pytest.raises(ValueError, match="population_decay must be 1 where twice top_k is no less than"):
            CEM(make_env(), 3, 4, 10, 5, population_decay=0.5)

    @pytest.mark.parametrize("decay", [0.0, 1.5, math.nan])
    def test_bad_ones_are_refused(self, decay: float) -> None:
        with pytest.raises(ValueError, match=r"population_decay must be in \(0, 1\]"):
            CEM(make_env(), 3, population_decay=decay)
