"""Searches over discrete actions: brute force and a plain reference search first, then every promise."""

from __future__ import annotations

import copy
import itertools
import math
import pickle
import warnings
from typing import Any

import pytest
import specs
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    OneHot,
    TensorSpec,
    Unbounded,
)
from torchrl.envs import Compose, EnvBase, TransformedEnv
from torchrl.modules import OneHotCategorical, get_env_transforms_from_module
from torchrl.modules.mcts import EXP3Score, PUCTScore, UCBScore

from torchrl_vjepa import GoalPrior
from torchrl_vjepa.actions import ActionCodec
from torchrl_vjepa.costs import quadratic_cost
from torchrl_vjepa.distributions import Delta, diag_gaussian
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.planners import ExhaustiveSearch, Planner, Proposal, TreeSearch
from torchrl_vjepa.planners.discrete import DiscretePlanner, joint_choices
from torchrl_vjepa.planners.search_tree import SearchTree
from torchrl_vjepa.predictor import Predictor
from torchrl_vjepa.risk import cvar

F64 = {"dtype": torch.float64}
SEARCHES: list[tuple[type[DiscretePlanner], dict[str, Any]]] = [
    (ExhaustiveSearch, {}),
    (TreeSearch, {"num_simulations": 12}),
    (TreeSearch, {"num_simulations": 12, "output": "best"}),
]
search = pytest.mark.parametrize(("cls", "kwargs"), SEARCHES)


def pushes(n: int) -> Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(n), **F64)


def swirl(latent: Tensor, action: Tensor) -> Delta:
    """Nonlinear, without matrix products: the same numbers in any batch."""
    push = (action.unsqueeze(-1) * pushes(action.shape[-1]).to(action)).sum(-2)
    return Delta(torch.sin(1.7 * latent.roll(1, -1)) + push)


def bumpy(latent: Tensor, action: Tensor) -> Tensor:
    return latent[..., 0] + torch.cos(3 * latent[..., 1]) + 2.0 * (latent[..., 2] > 0.5)


def make_env(n: int = 3, **kwargs: Any) -> LatentEnv:
    return LatentEnv(
        kwargs.pop("model", swirl),
        action_spec=kwargs.pop("action_spec", OneHot(n)),
        cost=kwargs.pop("cost", bumpy),
        latent_dim=kwargs.pop("latent_dim", 3),
        **{"dtype": torch.float64, **kwargs},
    )


def latents(*batch: int) -> Tensor:
    return torch.randn(*batch, 3, generator=torch.Generator().manual_seed(5), **F64)


def cold(planner: Planner, *batch: int) -> Proposal:
    return planner.family.cold(batch, planner.planning_horizon)


def every_plan(codes: Tensor, horizon: int) -> Tensor:
    return torch.stack([torch.stack(plan) for plan in itertools.product(codes, repeat=horizon)])


def brute_force(env: LatentEnv, state: Any, horizon: int, **kwargs: Any) -> tuple[Tensor, Tensor]:
    """Lowest cost and the first plan that has it, through the objective."""
    plans = every_plan(joint_choices(env.codec), horizon)
    batch = state.shape[:-1] if isinstance(state, Tensor) else state.batch_size
    costs = env.objective(state, plans.expand(*batch, *plans.shape), **kwargs)
    lowest, index = costs.min(-1)
    return lowest, plans[index]


class Counter:
    """A model that counts the states it was asked for."""

    def __init__(self) -> None:
        self.calls, self.states = 0, 0

    def __call__(self, latent: Tensor, action: Tensor) -> Delta:
        self.calls += 1
        self.states += latent[..., 0].numel()
        return swirl(latent, action)


@search
def test_networks_compute_in_the_dtype_of_the_environment(
    cls: type[DiscretePlanner], kwargs: dict[str, Any]
) -> None:
    torch.manual_seed(0)
    predictor = Predictor(3, action_dim=3, trunk="mlp", num_cells=[16], residual=True)
    rough = make_env(model=predictor, dtype=torch.float32, rollout_dtype=torch.bfloat16)
    fine = make_env(model=predictor, dtype=torch.float32)
    start = latents(5).float()
    with torch.no_grad():
        planner = cls(rough, 4, seed=0, **kwargs)
        plan = planner.plan(start, cold(planner, 5))
        best = plan.best.unsqueeze(-3)
        torch.testing.assert_close(plan.best_cost, rough.objective(start, best).squeeze(-1))
        assert not torch.isclose(plan.best_cost, fine.objective(start, best).squeeze(-1), rtol=1e-5).any()


class TestChoices:
    @pytest.mark.parametrize(
        ("spec", "num"),
        [
            (OneHot(3), 3),
            (Categorical(4), 4),
            (MultiCategorical([2, 4]), 8),
            (Binary(3), 8),
            (specs.EVERY["masked_one_hot"], 2),
            (specs.EVERY["masked_categorical"], 1),
            (specs.EVERY["one_hots"], 9),
            (specs.EVERY["integers"], 36),
            (Composite(gear=Categorical(3), body=Composite(lights=Binary(2))), 12),
        ],
    )
    def test_all_of_them_and_each_once(self, spec: TensorSpec, num: int) -> None:
        codec = ActionCodec(spec)
        codes = joint_choices(codec)
        assert codes.shape == (num, codec.size)
        assert len(codes.unique(dim=0)) == num
        assert torch.equal(codec.mode(codes), codes)  # none that a mask forbids
        inside = codec.decode(codes)
        whole = spec if isinstance(spec, Composite) else Composite({codec.keys[0]: spec})
        assert all(whole.is_in(inside[k]) for k in range(num))

    def test_what_cannot_be_enumerated_is_refused(self) -> None:
        with pytest.raises(TypeError, match="must be discrete in all its parts"):
            joint_choices(ActionCodec(Composite(gear=Categorical(2), wheel=Bounded(-1, 1, (1,)))))
        with pytest.raises(ValueError, match="at most 4096 joint choices to be enumerated, got 8192"):
            joint_choices(ActionCodec(Binary(13)))


class TestExhaustive:
    @pytest.mark.parametrize("chunk_size", [None, 1, 4, 7, 1000])
    @pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
    def test_equals_brute_force(self, batch: tuple[int, ...], chunk_size: int | None) -> None:
        env = make_env()
        planner = ExhaustiveSearch(env, 4, chunk_size=chunk_size)
        plan = planner.plan(latents(*batch), cold(planner, *batch))
        cost, best = brute_force(env, latents(*batch), 4)
        torch.testing.assert_close(plan.best_cost, cost)
        assert torch.equal(plan.actions, best.to(plan.actions.dtype))
        assert torch.equal(plan.best, plan.actions)

    def test_common_beginnings_are_imagined_once(self) -> None:
        model = Counter()
        planner = ExhaustiveSearch(make_env(model=model), 5)
        model.calls, model.states = 0, 0
        planner.plan(latents(2), cold(planner, 2))
        assert model.calls == 5
        assert model.states == 2 * sum(3**k for k in range(1, 6))

    @pytest.mark.parametrize("chunk_size", [1, 6, 30])
    def test_chunks_bound_what_is_imagined_at_once(self, chunk_size: int) -> None:
        widths = []

        def model(latent: Tensor, action: Tensor) -> Delta:
            widths.append(latent.shape[1])
            return swirl(latent, action)

        planner = ExhaustiveSearch(make_env(model=model), 4, chunk_size=chunk_size)
        widths.clear()
        planner.plan(latents(2), cold(planner, 2))
        assert max(widths) <= max(chunk_size, 3)
        assert sum(widths) == sum(3**k for k in range(1, 5))

    @pytest.mark.parametrize("chunk_size", [None, 2])
    def test_the_first_of_equal_plans(self, chunk_size: int | None) -> None:
        env = make_env(cost=lambda latent, action: 0 * latent[..., 0])
        planner = ExhaustiveSearch(env, 3, chunk_size=chunk_size)
        assert (planner.plan(latents(2), cold(planner, 2)).actions.argmax(-1) == 0).all()

    @pytest.mark.parametrize("chunk_size", [None, 5])
    def test_sampled_plans_under_a_risk_go_through_the_objective(self, chunk_size: int | None) -> None:
        def noisy(latent: Tensor, action: Tensor) -> Any:
            return diag_gaussian(swirl(latent, action).mean, torch.full_like(latent, 0.5))

        env = make_env(model=noisy, how="sample", num_samples=16, risk=cvar(0.3))
        planner = ExhaustiveSearch(env, 3, chunk_size=chunk_size, seed=3)
        generator = torch.Generator()
        generator.set_state(planner._model_generator.get_state())
        plan = planner.plan(latents(2), cold(planner, 2))
        cost, best = brute_force(env, latents(2), 3, generator=generator)
        torch.testing.assert_close(plan.best_cost.double(), cost, rtol=1e-5, atol=1e-5)
        assert torch.equal(plan.actions, best.to(plan.actions.dtype))

    def test_too_many_plans_are_refused(self) -> None:
        with pytest.raises(ValueError, match="planning_horizon=12 with 3 actions makes 531441 plans, more"):
            ExhaustiveSearch(make_env(), 12)
        assert ExhaustiveSearch(make_env(), 12, max_plans=531441).num_plans == 531441
        with pytest.raises(ValueError, match="chunk_size must be an integer of at least 1, got 0"):
            ExhaustiveSearch(make_env(), 2, chunk_size=0)


class TestScores:
    @staticmethod
    def grown(score: Any = None, num: int = 40) -> SearchTree:
        generator = torch.Generator().manual_seed(0)
        prior = torch.rand(5, 3, generator=generator, **F64).softmax(-1)
        tree = SearchTree(prior, num + 1, 4, PUCTScore(c=1.5) if score is None else score)
        for node in range(1, num + 1):
            path = tree.descend()
            actions = tree.choice.gather(1, path)
            depth = tree.depth.gather(1, path[:, -1:]).squeeze(1)
            tree.add(node, path[:, -1], actions[:, -1], prior.roll(node, -1), depth < 4)
            tree.backup(path, actions, torch.randn(5, generator=generator, **F64))
        return tree

    def test_puct_by_hand(self) -> None:
        tree = self.grown()
        nodes = torch.arange(12).expand(5, 12)
        visits, mean = tree.visits[:, :12], tree.mean[:, :12]
        for row, node in itertools.product(range(5), range(12)):
            n, j = visits[row, node], mean[row, node]
            seen = j[n > 0]
            total = n.sum()
            if len(seen) and seen.max() > seen.min():
                q = (seen.max() - j) / (seen.max() - seen.min())
            else:
                q = torch.full_like(j, 0.5)
            average = (q * n).sum() / total if total else torch.zeros(())
            q = torch.where(n > 0, q, average)
            expected = q + 1.5 * tree.prior[row, node] * (total + 1).sqrt() / (1 + n)
            torch.testing.assert_close(tree.scores(nodes)[row, node], expected)
            torch.testing.assert_close(tree.values(nodes)[row, node], q)

    @pytest.mark.parametrize("module", [PUCTScore(c=1.5), UCBScore(c=0.7)])
    def test_they_are_torchrls(self, module: Any) -> None:
        tree = self.grown(module)
        visits = tree.visits[:, 0]
        assert (visits > 0).all()
        td = TensorDict(
            win_count=tree.values(torch.zeros(5, 1, dtype=torch.long))[:, 0] * visits,
            visits=visits,
            total_visits=visits.sum(-1) + 1,
            prior_prob=tree.prior[:, 0],
            batch_size=5,
        )
        scores = tree.scores(torch.zeros(5, 1, dtype=torch.long))[:, 0]
        torch.testing.assert_close(scores, module(td)["score"])
        assert torch.equal(tree.choice[:, 0], scores.argmax(-1))

    def test_pointers_and_counts_are_those_of_the_tree(self) -> None:
        tree = self.grown()
        assert (tree.visits[:, 0].sum(-1) == 40).all()
        every = torch.arange(41).expand(5, 41)
        torch.testing.assert_close(tree.choice, tree.scores(every).argmax(-1))
        child = tree.children.gather(-1, tree.choice.unsqueeze(-1)).squeeze(-1)
        assert torch.equal(tree.following, torch.where(child < 0, every, child))
        linked = tree.children >= 0
        below = tree.visits.sum(-1).gather(1, tree.children.clamp_min(0).flatten(1)).reshape(linked.shape)
        depth = tree.depth.unsqueeze(-1) + 1
        # One visit made the child, the others went on below it.
        inner = linked & (depth < 4)
        assert torch.equal(tree.visits[inner] - 1, below[inner])
        assert (below[linked & (depth == 4)] == 0).all()
        assert tree.depth[:, :].max() <= 5

    def test_the_prior_decides_first(self) -> None:
        tree = SearchTree(torch.tensor([[0.2, 0.5, 0.3]]), 3, 2, PUCTScore(c=1.0))
        assert tree.choice[0, 0] == 1

    def test_costs_that_are_not_finite_count_as_the_worst(self) -> None:
        tree = SearchTree(torch.full((1, 3), 1 / 3), 9, 1, PUCTScore(c=0.0))
        root, here = torch.zeros(1, 1, dtype=torch.long), torch.ones(1, dtype=torch.bool)
        for node, (action, cost) in enumerate([(0, math.inf), (1, 5.0), (2, 7.0), (1, math.nan)]):
            chosen = torch.tensor([[action]])
            tree.add(node + 1, root[:, 0], chosen[:, 0], torch.full((1, 3), 1 / 3), here)
            tree.backup(root, chosen, torch.tensor([cost]))
        assert tree.values(root).flatten().tolist() == [0.0, 0.5, 0.0]
        assert tree.mean[0, 0].tolist() == [0.0, 5.0, 7.0]


class Reference:
    """The search as a textbook writes it: one row, nodes as objects, no tensors over nodes."""

    def __init__(self, env: LatentEnv, horizon: int, num: int, c: float, leaf: Any, policy: Any) -> None:
        self.env, self.horizon, self.num, self.c = env, horizon, num, c
        self.leaf, self.policy = leaf, policy

    def node(self, latent: Tensor) -> dict[str, Any]:
        prior = self.policy(latent.unsqueeze(0)).softmax(-1)[0]
        n = len(prior)
        return {"z": latent, "P": prior, "N": [0] * n, "W": [0.0] * n, "children": [None] * n}

    def q(self, node: dict[str, Any]) -> list[float]:
        means = [w / n if n else None for w, n in zip(node["W"], node["N"], strict=True)]
        seen = [m for m in means if m is not None]
        if not seen:
            return [0.0] * len(means)
        low, high = min(seen), max(seen)
        scaled = [None if m is None else (m - low) / (high - low) if high > low else 0.5 for m in means]
        average = sum(n * s for n, s in zip(node["N"], scaled, strict=True) if n) / sum(node["N"])
        return [average if s is None else s for s in scaled]

    def __call__(self, latent: Tensor) -> list[int]:
        root = self.node(latent)
        eye = torch.eye(len(root["P"]), **F64)
        for _ in range(self.num):
            node, depth, paid, path = root, 0, 0.0, []
            while True:
                total = math.sqrt(sum(node["N"]) + 1)
                scores = [
                    q + self.c * float(p) * total / (1 + n)
                    for q, p, n in zip(self.q(node), node["P"], node["N"], strict=True)
                ]
                action = scores.index(max(scores))
                path.append((node, action))
                z = swirl(node["z"], eye[action]).mean
                paid += float(self.env.world_model.cost(z, eye[action]))
                depth += 1
                fresh = node["children"][action] is None
                if fresh:
                    node["children"][action] = self.node(z)
                node = node["children"][action]
                if fresh or depth == self.horizon:
                    break
            value = float(self.leaf(node["z"].unsqueeze(0))) - paid
            for edge, chosen in path:
                edge["N"][chosen] += 1
                edge["W"][chosen] += value
        return root["N"]


def value_of(latent: Tensor) -> Tensor:
    return torch.tanh(latent[..., 1]) - latent[..., 2]


def policy_of(latent: Tensor) -> Tensor:
    return 2 * torch.stack([latent[..., 0], latent[..., 2], -latent[..., 1]], dim=-1)


class TestTreeSearch:
    @pytest.mark.parametrize(("horizon", "num"), [(2, 60), (3, 25), (6, 80)])
    def test_visits_are_those_of_a_textbook_search(self, horizon: int, num: int) -> None:
        env = make_env()
        planner = TreeSearch(env, horizon, num, exploration=1.3, prior_policy=policy_of, leaf_value=value_of)
        plan = planner.plan(latents(4), cold(planner, 4))
        reference = Reference(env, horizon, num, 1.3, value_of, policy_of)
        expected = torch.tensor([reference(latent) for latent in latents(4)])
        assert torch.equal(plan.statistics["visits"].long(), expected)

    @pytest.mark.parametrize(("output", "horizon"), [("visits", 3), ("best", 4)])
    def test_enough_simulations_find_the_optimum(self, output: Any, horizon: int) -> None:
        env = make_env(2)
        planner = TreeSearch(env, horizon, 300, output=output, seed=0)
        plan = planner.plan(latents(6), cold(planner, 6))
        cost, best = brute_force(env, latents(6), horizon)
        torch.testing.assert_close(plan.best_cost, cost)
        assert torch.equal(plan.actions, best.to(plan.actions.dtype))

    def test_regret_falls_with_simulations(self) -> None:
        env = make_env()
        optimal = brute_force(env, latents(16), 6)[0]
        regrets = []
        for num in (5, 50, 500):
            planner = TreeSearch(env, 6, num, seed=0)
            plan = planner.plan(latents(16), cold(planner, 16))
            cost = env.objective(latents(16), plan.actions.unsqueeze(1).double()).squeeze(1)
            assert (cost >= optimal - 1e-12).all()
            assert (plan.best_cost <= cost + 1e-12).all() or num < 500
            regrets.append(float((cost - optimal).mean()))
        assert regrets[0] > 1.5 * regrets[1] > 3 * regrets[2]

    def test_a_delayed_cost_where_the_next_step_misleads(self) -> None:
        def chain(latent: Tensor, action: Tensor) -> Delta:  # 0: back to the start, 1: one step on
            return Delta(torch.where(action[..., 1:] > 0.5, latent + 1, 0 * latent))

        def far(latent: Tensor, action: Tensor) -> Tensor:  # a step on costs, the end of the chain pays
            return action[..., 1] - 30.0 * (latent[..., 0] >= 4)

        env = make_env(model=chain, cost=far, latent_dim=1, action_spec=Categorical(2))
        td = TensorDict(latent=torch.zeros(3, 1, **F64), batch_size=3)
        assert (ExhaustiveSearch(env, 1)(td.clone())["action"] == 0).all()  # greedy
        planner = TreeSearch(env, 8, 300, seed=0, return_stats=True)
        out = planner(td)
        assert (out["action"] == 1).all()
        assert (out["plan_stats", "cost"] == 8 - 5 * 30).all()

    def test_an_exact_value_needs_no_depth(self) -> None:
        env = make_env(2)

        def ahead(latent: Tensor) -> Tensor:
            return -brute_force(env, latent, 3)[0]

        # After one step the value says what the best three further steps cost.
        planner = TreeSearch(env, 1, 2, leaf_value=ahead)
        plan = planner.plan(latents(5), cold(planner, 5))
        cost, best = brute_force(env, latents(5), 4)
        torch.testing.assert_close(plan.best_cost, cost)
        assert torch.equal(plan.actions[:, 0], best[:, 0].to(plan.actions.dtype))

    def test_without_exploration_a_prior_is_followed(self) -> None:
        env = make_env(cost=lambda latent, action: 0 * latent[..., 0])
        planner = TreeSearch(
            env, 3, 3, exploration=1e-3, prior_policy=lambda z: torch.tensor([0.0, 9, 0]).expand(len(z), 3)
        )
        plan = planner.plan(latents(2), cold(planner, 2))
        assert (plan.actions.argmax(-1) == 1).all()

    @pytest.mark.parametrize("discount", [1.0, 0.8])
    def test_what_a_simulation_costs(self, discount: float) -> None:
        env = make_env()
        planner = TreeSearch(env, 5, 1, discount=discount, leaf_value=value_of)
        start = torch.eye(3)[torch.tensor([[0, 2, 1, 1, 0], [2, 2, 2, 0, 1]])]
        plan = planner.plan(latents(2), planner.family.around(start, 0.3))
        z, total = latents(2), torch.zeros(2, **F64)
        for k, action in enumerate(start.double().unbind(1)):
            z = swirl(z, action).mean
            total = total + discount**k * bumpy(z, action)
        total = total - discount**5 * value_of(z)
        # The warm start is one of two simulations.
        assert (plan.best_cost <= total + 1e-12).all()
        mean = -plan.statistics["value"].squeeze(-1)
        other = 2 * mean - total
        torch.testing.assert_close(torch.minimum(total, other), plan.best_cost)

    @pytest.mark.parametrize("score", [UCBScore(c=6.0), PUCTScore(c=8.0)])
    def test_any_score_of_torchrl(self, score: Any) -> None:
        planner = TreeSearch(make_env(2), 3, 200, score=score, seed=0)
        plan = planner.plan(latents(4), cold(planner, 4))
        torch.testing.assert_close(plan.best_cost, brute_force(planner.env, latents(4), 3)[0])

    def test_scale_and_offset_of_the_cost_do_not_matter(self) -> None:
        plain = TreeSearch(make_env(), 5, 60, seed=0)
        other = TreeSearch(make_env(cost=lambda z, a: 4096.0 * bumpy(z, a) - 64.0), 5, 60, seed=0)
        one, two = (p.plan(latents(6), cold(p, 6)) for p in (plain, other))
        assert torch.equal(one.statistics["visits"], two.statistics["visits"])
        assert torch.equal(one.actions, two.actions)


class TestModels:
    """A plan costs what the objective says, whatever the environment has."""

    def check(self, env: LatentEnv, td: TensorDict, horizon: int = 4) -> None:
        state = env.planning_state(td)
        cost, best = brute_force(env, state, horizon)
        exhaustive, tree = ExhaustiveSearch(env, horizon), TreeSearch(env, horizon, 30, seed=0)
        plan = exhaustive.plan(state, cold(exhaustive, *td.batch_size))
        torch.testing.assert_close(plan.best_cost, cost)
        assert torch.equal(plan.actions, best.to(plan.actions.dtype))
        plan = tree.plan(state, cold(tree, *td.batch_size))
        again = env.objective(state, plan.best.unsqueeze(-3).double()).squeeze(-1)
        torch.testing.assert_close(plan.best_cost, again)

    @pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
    def test_predicted_ends(self, batch: tuple[int, ...]) -> None:
        head = TensorDictModule(nn.Linear(3, 1, **F64), ["latent"], ["termination_logit"])
        with torch.random.fork_rng():
            torch.manual_seed(0)
            nn.init.normal_(head.module.weight)
        env = make_env(termination_model=head, termination_cost=2.0)
        self.check(env, TensorDict(latent=latents(*batch), batch_size=batch))

    def test_a_value_counts_as_far_as_it_is_reached(self) -> None:
        head = TensorDictModule(lambda z: 50 * (z[..., :1] + 10), ["latent"], ["termination_logit"])
        env = make_env(termination_model=head)  # every first step is the last
        planner = TreeSearch(env, 3, 10, leaf_value=lambda z: 100 + z[..., 0], seed=0)
        plan = planner.plan(latents(2), cold(planner, 2))
        torch.testing.assert_close(plan.best_cost, brute_force(env, latents(2), 1)[0])

    @pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
    @pytest.mark.parametrize("steps", [None, 4])
    def test_tasks_by_row_and_by_step(self, batch: tuple[int, ...], steps: int | None) -> None:
        env = make_env(prior=GoalPrior(std=1.0))
        shape = batch if steps is None else (*batch, steps)
        task = torch.randn(*shape, 3, generator=torch.Generator().manual_seed(1), **F64)
        self.check(env, TensorDict(latent=latents(*batch), task=task, batch_size=batch))

    @pytest.mark.parametrize("spec", [Categorical(3), MultiCategorical([2, 2]), Binary(2)])
    def test_kinds_of_actions(self, spec: TensorSpec) -> None:
        self.check(make_env(action_spec=spec), TensorDict(latent=latents(3), batch_size=3), 3)

    def test_an_environment_that_is_stepped(self) -> None:
        env, latent = (
            Walk(),
            make_env(model=walk, cost=lambda z, a: z.square().sum(-1), latent_dim=2, dtype=None),
        )
        td = TensorDict(position=torch.tensor([[1.5, -2.0], [0.5, 3.0]]), batch_size=2)
        td["latent"] = td["position"]
        for cls, kwargs in SEARCHES:
            stepped = cls(env, 3, return_stats=True, seed=0, **kwargs)(td.clone())
            imagined = cls(latent, 3, return_stats=True, seed=0, **kwargs)(td.clone())
            assert torch.equal(stepped["action"], imagined["action"])
            torch.testing.assert_close(stepped["plan_stats", "cost"], imagined["plan_stats", "cost"])

    def test_what_has_ended_costs_nothing_more(self) -> None:
        env = Walk(end=True)
        td = TensorDict(position=torch.tensor([[3.5, 3.0]]), batch_size=1)
        for cls, kwargs in SEARCHES:
            planner = cls(env, 4, seed=0, **kwargs)
            source = planner._source
            state = source.planning_state(td)
            plan = planner.plan(state, cold(planner, 1))
            assert plan.best_cost == source.objective(state, plan.best.unsqueeze(-3))
            # One step out of the area, and nothing after it.
            plan = planner.plan(state, planner.family.around(torch.eye(3)[torch.tensor([[0, 1, 2, 1]])], 0.3))
            assert plan.best_cost <= 4.5**2 + 9.0

    def test_it_acts_in_torchrl(self) -> None:
        env = Walk()
        planner = TreeSearch(env, 3, 20, seed=0)
        real = TransformedEnv(Walk(), Compose(*get_env_transforms_from_module(planner)))
        start = real.reset().set("position", torch.tensor([2.0, -2.0]))
        data = real.rollout(6, planner, auto_reset=False, tensordict=start)
        assert data["next", "position"][-1].abs().sum() <= 1
        assert torch.equal(data["plan"][1:], data["next", "plan"][:-1])

    def test_heads_as_tensordict_modules(self) -> None:
        value = TensorDictModule(lambda z: value_of(z).unsqueeze(-1), ["latent"], ["state_value"])
        logits = TensorDictModule(policy_of, ["latent"], ["logits"])
        actor = TensorDictSequential(
            logits,
            ProbabilisticTensorDictModule(["logits"], ["action"], distribution_class=OneHotCategorical),
        )
        found = []
        for policy, leaf in ((policy_of, value_of), (logits, value), (actor, value)):
            planner = TreeSearch(make_env(), 4, 40, prior_policy=policy, leaf_value=leaf, seed=0)
            found.append(planner.plan(latents(3), cold(planner, 3)))
        for other in found[1:]:
            assert torch.equal(found[0].statistics["visits"], other.statistics["visits"])
            torch.testing.assert_close(found[0].statistics["value"], other.statistics["value"])


def walk(latent: Tensor, action: Tensor) -> Delta:
    return Delta(latent + action[..., :2] - action[..., 2:])


class Walk(EnvBase):
    """A walk in the plane, by steps of one-hot actions of which the third goes back in both."""

    def __init__(self, end: bool = False) -> None:
        super().__init__(batch_size=[])
        self.end = end
        self.observation_spec = Composite(position=Unbounded((2,)))
        self.state_spec = Composite(position=Unbounded((2,)))
        self.action_spec = OneHot(3)
        self.reward_spec = Unbounded((1,))

    @property
    def batch_locked(self) -> bool:
        return False

    def _step(self, td: Any) -> TensorDict:
        position = walk(td["position"], td["action"].float()).mean
        done = (position > 4).any(-1, keepdim=True) & self.end
        out = {"position": position, "reward": -position.square().sum(-1, keepdim=True)}
        return TensorDict({**out, "done": done, "terminated": done}, batch_size=td.batch_size)

    def _reset(self, td: Any = None, **kwargs: Any) -> Any:
        return TensorDict(position=torch.zeros(2))

    def _set_seed(self, seed: int | None) -> None:
        pass


class TestPromises:
    @search
    def test_rows_are_independent(self, cls: type[DiscretePlanner], kwargs: dict[str, Any]) -> None:
        def plan(rows: Any) -> Any:
            planner = cls(make_env(), 4, seed=1, **kwargs)
            return planner.plan(latents(6)[rows], cold(planner, len(rows)))

        together = plan(list(range(6)))
        for rows in ([0], [3], [5, 2], [4, 3, 2, 1, 0, 5]):
            part = plan(rows)
            assert torch.equal(part.actions, together.actions[rows])
            assert torch.equal(part.best_cost, together.best_cost[rows])
            for name, value in part.statistics.items():
                assert torch.equal(value, together.statistics[name][rows])

    @search
    @pytest.mark.parametrize("batch", [(), (1,), (2, 3), (0,)])
    def test_any_batch(
        self, cls: type[DiscretePlanner], kwargs: dict[str, Any], batch: tuple[int, ...]
    ) -> None:
        planner = cls(make_env(), 3, return_stats=True, warm_start=True, seed=0, **kwargs)
        td = planner(TensorDict(latent=latents(*batch), batch_size=batch))
        assert td["action"].shape == (*batch, 3)
        assert td["next", "plan"].shape == (*batch, 3, 3)
        assert td["plan_stats", "cost"].shape == (*batch, 1)
        if cls is TreeSearch:
            assert td["plan_stats", "visits"].shape == (*batch, 3)
            assert td["plan_stats", "value"].shape == (*batch, 1)
        planner(td["next"].set("latent", latents(*batch)))

    @search
    def test_warm_and_cold_rows_beside_each_other(
        self, cls: type[DiscretePlanner], kwargs: dict[str, Any]
    ) -> None:
        def action(rows: list[int]) -> Tensor:
            planner = cls(make_env(), 4, warm_start=True, seed=2, **kwargs)
            td = TensorDict(latent=latents(4)[rows], batch_size=len(rows))
            plan = torch.eye(3)[torch.tensor([[0, 1, 2, 0]] * 4)]
            td["plan"], td["is_init"] = plan[rows], torch.tensor([[True], [False], [True], [False]])[rows]
            return planner(td)["next", "plan"]

        together = action([0, 1, 2, 3])
        for row in range(4):
            assert torch.equal(action([row])[0], together[row])

    def test_a_cold_row_is_offered_no_plan(self) -> None:
        env = make_env(cost=lambda latent, action: -action[..., 0])  # the first action is the best
        planner = TreeSearch(
            env, 4, 1, seed=0, prior_policy=lambda z: z.new_tensor([-9.0, 9, 0]).expand(len(z), 3)
        )
        start, warm = cold(planner, 2), planner.family.around(torch.eye(3)[2].expand(2, 4, 3), 0.3)
        row = torch.tensor([True, False])[:, None, None]
        mixed = Proposal(*(torch.where(row, a, b) for a, b in zip(warm, start, strict=True)))
        alone = planner.plan(latents(2)[1:], cold(planner, 1))
        together = planner.plan(latents(2), mixed)
        assert alone.best_cost == together.best_cost[1] == 0

    def test_a_perfect_plan_is_kept(self) -> None:
        env = make_env()
        best = brute_force(env, latents(8), 6)[1].float()
        planner = TreeSearch(env, 6, 5, output="best", seed=0)
        td = TensorDict(latent=latents(8), plan=best, batch_size=8)
        out = planner(td)
        assert torch.equal(out["action"].float(), best[:, 0])
        assert torch.equal(out["next", "plan"], torch.cat([best[:, 1:], best[:, -1:]], 1))

    def test_the_plan_before_is_the_first_simulation(self) -> None:
        env = make_env()
        start = torch.eye(3)[torch.randint(3, (8, 6), generator=torch.Generator().manual_seed(0))]
        cost = env.objective(latents(8), start.unsqueeze(1).double()).squeeze(1)
        planner = TreeSearch(env, 6, 1, seed=0)
        plan = planner.plan(latents(8), planner.family.around(start, 0.3))
        assert (plan.best_cost <= cost + 1e-12).all()
        assert (plan.best_cost == cost).any()
        assert (plan.statistics["visits"].sum(-1) == 2).all()

    def test_more_simulations_never_worsen_the_best(self) -> None:
        env, costs = make_env(), []
        for num in (1, 3, 10, 30, 100):
            planner = TreeSearch(env, 5, num, seed=4)
            costs.append(planner.plan(latents(8), cold(planner, 8)).best_cost)
        for more, fewer in itertools.pairwise(reversed(costs)):
            assert (more <= fewer).all()

    @search
    def test_same_seed_same_plan_and_nothing_else_is_touched(
        self, cls: type[DiscretePlanner], kwargs: dict[str, Any]
    ) -> None:
        model = nn.Sequential(nn.Linear(6, 8), nn.Dropout(0.0), nn.Linear(8, 3)).train()

        def transition(latent: Tensor, action: Tensor) -> Delta:
            return Delta(model(torch.cat([latent, action], -1)))

        env = make_env(model=transition, dtype=torch.float32)
        before = copy.deepcopy(model.state_dict())
        planners = [cls(env, 4, seed=7, **kwargs) for _ in range(2)]
        planners.append(pickle.loads(pickle.dumps(cls(make_env(), 4, seed=7, **kwargs))))
        state = torch.random.get_rng_state()
        td = TensorDict(latent=latents(4).float(), batch_size=4)
        one, two = (planner(td.clone()) for planner in planners[:2])
        assert torch.equal(one["action"], two["action"])
        assert torch.equal(torch.random.get_rng_state(), state)
        assert all(torch.equal(value, before[key]) for key, value in model.state_dict().items())
        assert all(p.grad is None for p in model.parameters())
        assert all(module.training for module in model.modules())
        assert planners[2](TensorDict(latent=latents(4), batch_size=4))["action"].shape == (4, 3)

    @search
    @settings(max_examples=25, deadline=None)
    @given(
        values=st.lists(
            st.one_of(st.floats(width=32), st.sampled_from([1e30, -1e30, 3e38, -3e38, 0.0])),
            min_size=3,
            max_size=3,
        ),
        dtype=st.sampled_from([torch.float32, torch.float64]),
        spec=st.sampled_from(
            [OneHot(3), Categorical(3), MultiCategorical([2, 2]), Binary(2), specs.EVERY["masked_one_hot"]]
        ),
    )
    def test_actions_are_inside_whatever_the_cost(
        self,
        cls: type[DiscretePlanner],
        kwargs: dict[str, Any],
        values: list[float],
        dtype: torch.dtype,
        spec: TensorSpec,
    ) -> None:
        table = torch.tensor(values, dtype=dtype)

        def cost(latent: Tensor, action: Tensor) -> Tensor:
            return table[(7 * latent[..., 0].nan_to_num(0, 0, 0)).long() % 3] * latent[..., 1].sign()

        env = make_env(action_spec=spec, cost=cost, dtype=dtype)
        planner = cls(env, 3, warm_start=True, return_stats=True, seed=0, **kwargs)
        td = TensorDict(latent=latents(3).to(dtype), batch_size=3)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            for _ in range(2):
                planner(td)
                assert all(spec.is_in(action) for action in td["action"])
                assert td["next", "plan"].isfinite().all()
                td = td["next"].set("latent", latents(3).to(dtype))

    @pytest.mark.parametrize("fault", [math.nan, math.inf, -math.inf])
    def test_a_branch_of_faults_is_left(self, fault: float) -> None:
        def cost(latent: Tensor, action: Tensor) -> Tensor:
            return torch.where(action[..., 0] > 0.5, fault, bumpy(latent, action))

        env = make_env(cost=cost)
        planner = TreeSearch(env, 3, 200, seed=0)
        plan = planner.plan(latents(4), cold(planner, 4))
        assert (plan.actions.argmax(-1) != 0).all()
        assert plan.best_cost.isfinite().all()

    @search
    def test_one_warning_where_nothing_is_finite(
        self, cls: type[DiscretePlanner], kwargs: dict[str, Any]
    ) -> None:
        planner = cls(make_env(cost=lambda z, a: z[..., 0] * math.nan), 2, **kwargs)
        with pytest.warns(RuntimeWarning, match="no candidate plan has a finite cost") as caught:
            td = planner(TensorDict(latent=latents(2), batch_size=2))
        assert len(caught) == 1
        assert (td["action"].sum(-1) == 1).all()

    def test_a_policy_and_a_value_that_are_not_finite(self) -> None:
        def nan(latent: Tensor) -> Tensor:
            return torch.full((len(latent),), math.nan)

        planner = TreeSearch(
            make_env(), 3, 20, prior_policy=lambda z: nan(z).unsqueeze(-1).expand(-1, 3), seed=0
        )
        uniform = TreeSearch(make_env(), 3, 20, seed=0)
        td = TensorDict(latent=latents(4), batch_size=4)
        assert torch.equal(planner(td.clone())["action"], uniform(td.clone())["action"])
        planner = TreeSearch(make_env(), 3, 20, leaf_value=nan)
        with pytest.warns(RuntimeWarning, match="finite cost"):
            assert (planner(td)["action"].sum(-1) == 1).all()

    def test_statistics(self) -> None:
        planner = TreeSearch(make_env(), 4, 30, return_stats=True, seed=0)
        out = planner(TensorDict(latent=latents(3), batch_size=3))
        stats = out["plan_stats"]
        assert (stats["visits"].sum(-1) == 30).all()
        assert torch.equal(stats["visits"].argmax(-1), out["action"].int().argmax(-1))
        share = stats["visits"] / 30
        torch.testing.assert_close(stats["std"][:, 0], (share * (1 - share)).sqrt().float())
        assert set(planner.out_keys) >= {("plan_stats", "visits"), ("plan_stats", "value")}
        # The visited mean is no better than the best and no worse than the worst.
        plan = planner.plan(latents(3), cold(planner, 3))
        assert (-plan.statistics["value"].squeeze(-1) >= plan.best_cost).all()


class TestArguments:
    @pytest.mark.parametrize(
        ("kwargs", "error", "message"),
        [
            ({"num_simulations": 0}, ValueError, "num_simulations must be an integer of at least 1, got 0"),
            ({"exploration": -1.0}, ValueError, "exploration must be finite and not negative, got -1.0"),
            ({"exploration": math.nan}, ValueError, "exploration must be finite and not negative, got nan"),
            ({"discount": 0.0}, ValueError, r"discount must be in \(0, 1\], got 0.0"),
            ({"output": "mean"}, ValueError, "output must be 'visits' or 'best', got 'mean'"),
            ({"score": EXP3Score()}, TypeError, "score must be a module of torchrl.modules.mcts that reads"),
            ({"score": nn.Identity()}, TypeError, "score must be a module of torchrl.modules.mcts"),
            ({"leaf_value": 3.0}, TypeError, "leaf_value must be callable, latents to a tensor, got float"),
            ({"num_samples": 4}, ValueError, "env must predict one next state for tree search"),
        ],
    )
    def test_refused(self, kwargs: dict[str, Any], error: type[Exception], message: str) -> None:
        with pytest.raises(error, match=message):
            TreeSearch(make_env(), 3, **kwargs)

    def test_models_that_are_not_deterministic_are_refused(self) -> None:
        with pytest.raises(ValueError, match="env must predict one next state for tree search"):
            TreeSearch(make_env(how="sample"), 3)
        with pytest.raises(ValueError, match="env must predict one next state for tree search"):
            TreeSearch(make_env(belief_key="belief"), 3)

    def test_continuous_actions_are_refused(self) -> None:
        for cls in (TreeSearch, ExhaustiveSearch):
            with pytest.raises(TypeError, match="the action of env must be discrete in all its parts"):
                cls(make_env(action_spec=Bounded(-1, 1, (3,))), 3)

    def test_heads_of_wrong_shape_are_refused_when_planning(self) -> None:
        td = TensorDict(latent=latents(2), batch_size=2)
        with pytest.raises(ValueError, match=r"prior_policy must give one number for each of the 3 actions"):
            TreeSearch(make_env(), 3, prior_policy=lambda z: z[..., :2])(td)
        with pytest.raises(
            ValueError, match=r"leaf_value must give one number for each row, of shape \(2,\)"
        ):
            TreeSearch(make_env(), 3, leaf_value=lambda z: z)(td)

    def test_a_function_of_latents_needs_latents(self) -> None:
        with pytest.raises(TypeError, match="leaf_value must be a TensorDictModule for Walk"):
            TreeSearch(Walk(), 3, leaf_value=value_of)


class Negated(LatentEnv):
    """Overrides what planners call, and nothing else."""

    def objective_from(self, state: Any, **settings: Any) -> Any:
        evaluate = super().objective_from(state, **settings)
        return lambda actions, generator=None: -evaluate(actions, generator)


def test_an_objective_of_ones_own_is_not_bypassed() -> None:
    env = Negated(
        lambda latent, action: Delta(latent + action[..., 1:] - action[..., :1]),
        action_spec=OneHot(2),
        cost=quadratic_cost(torch.tensor([3.0])),
        latent_dim=1,
    )
    td = TensorDict(latent=torch.zeros(1))
    assert ExhaustiveSearch(env, 2)(td.clone())["action"].tolist() == [True, False]
    with pytest.raises(ValueError, match="env must predict one next state for tree search"):
        TreeSearch(env, 2)
