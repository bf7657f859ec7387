"""What makes planning cheaper leaves the plan as it is, or says by how much it may differ."""

from __future__ import annotations

import copy
import pickle
import time
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import Bounded, OneHot
from torchrl.modules import MLP

from torchrl_vjepa import MPPI, LatentEnv, Predictor, rollout
from torchrl_vjepa.belief import PreparedTransition
from torchrl_vjepa.costs import action_cost, quadratic_cost
from torchrl_vjepa.distributions import diag_gaussian
from torchrl_vjepa.heads import (
    DeltaHead,
    DiagGaussianHead,
    EnsembleHead,
    FullGaussianHead,
    Head,
    LowRankGaussianHead,
)
from torchrl_vjepa.planners import CEM, Proposal, SamplingPlanner, TreeSearch
from torchrl_vjepa.planners.clock import Clock

HEADS: dict[str, Callable[[], Head]] = {
    "delta": DeltaHead,
    "diagonal": DiagGaussianHead,
    "constant": lambda: DiagGaussianHead("constant"),
    "full": FullGaussianHead,
    "low rank": lambda: LowRankGaussianHead(2),
}


class Shifted(DiagGaussianHead):
    """Another forward: the statement about that of the parent does not hold."""

    def forward(self, features: Tensor, constants: Tensor) -> Any:
        return super().forward(features + 1, constants)


def by_steps(predictor: Predictor, latent: Tensor, actions: Tensor) -> Tensor:
    """The mean, one distribution at a time."""
    out = []
    for action in actions.unbind(-2):
        latent = predictor.dist(latent, action).mean
        out.append(latent)
    return torch.stack(out, dim=-2)


class _Rolled(nn.Module):
    """A rollout as a module, whose weights can be given."""

    def __init__(self, predictor: Predictor) -> None:
        super().__init__()
        self.predictor = predictor

    def forward(self, latent: Tensor, actions: Tensor) -> Tensor:
        return rollout(self.predictor.dist, latent, actions)


def make_env(how: Any = "mean", **kwargs: Any) -> LatentEnv:
    torch.manual_seed(1)
    predictor = Predictor(4, action_dim=2, trunk="mlp", num_cells=(32, 32), residual=True)
    return LatentEnv(
        predictor,
        action_spec=Bounded(-1, 1, (2,)),
        cost=quadratic_cost(torch.ones(4)) + 0.1 * action_cost(),
        how=how,
        **kwargs,
    )


def states(num: int = 3) -> TensorDict:
    latent = torch.randn(num, 4, generator=torch.Generator().manual_seed(5))
    return TensorDict(latent=latent, batch_size=num)


class TestPointRollout:
    @pytest.mark.parametrize("head", HEADS)
    @pytest.mark.parametrize("residual", [False, True])
    @pytest.mark.parametrize(
        "trunk",
        [
            {"trunk": "linear"},
            {"trunk": "linear", "bias": True},
            {"trunk": "mlp", "num_cells": ()},
            {"trunk": "mlp", "num_cells": (8, 8), "activation_class": nn.ReLU},
            {"trunk": "mlp", "num_cells": (8,), "activation_class": nn.Tanh},
        ],
        ids=str,
    )
    @pytest.mark.parametrize("grad", [False, True])
    def test_is_the_mean_of_the_distribution(
        self, head: str, residual: bool, trunk: dict[str, Any], grad: bool
    ) -> None:
        predictor = Predictor(3, 2, head=HEADS[head](), skips=(2, 1), residual=residual, **trunk)
        predictor.set_temperature([2.0, 3.0])
        latent, actions = torch.randn(2, 5, 3), torch.randn(2, 5, 4, 2)
        with torch.set_grad_enabled(grad):
            assert predictor.point_rollout(latent[0], actions[0, :, 0]) is not None
            for how in ("mean", "mode"):
                out = rollout(predictor.dist, latent, actions, how)
                torch.testing.assert_close(out, by_steps(predictor, latent, actions), atol=1e-5, rtol=1e-5)
            assert out.is_contiguous()

    def test_gradients_are_those_of_the_distribution(self) -> None:
        predictor = Predictor(3, 2, trunk="mlp", num_cells=(8,))
        latent, actions = torch.randn(5, 3), torch.randn(5, 4, 2, requires_grad=True)
        variables = [actions, *predictor.trunks.parameters()]
        gradients = [
            torch.autograd.grad(out.square().sum(), variables)
            for out in (rollout(predictor.dist, latent, actions), by_steps(predictor, latent, actions))
        ]
        for ours, expected in zip(*gradients, strict=True):
            torch.testing.assert_close(ours, expected, atol=1e-5, rtol=1e-5)

    def test_without_control(self) -> None:
        predictor = Predictor(3, trunk="mlp", num_cells=(8,))
        latent, actions = torch.randn(5, 3), torch.zeros(5, 4, 0)
        torch.testing.assert_close(
            rollout(predictor.dist, latent, actions), by_steps(predictor, latent, actions)
        )

    def test_what_is_not_plain_goes_the_long_way(self) -> None:
        latent, actions = torch.randn(5, 3), torch.randn(5, 4, 2)

        def same(predictor: Predictor) -> bool:
            move = predictor.point_rollout(latent, actions[:, 0])
            out = rollout(predictor.dist, latent, actions)
            return move is None and torch.equal(out, by_steps(predictor, latent, actions))

        assert same(Predictor(3, 2, head=EnsembleHead(num_members=2)))
        assert same(Predictor(3, 2, head=Shifted()))
        hooked = Predictor(3, 2)
        hooked.head.register_forward_hook(lambda module, inputs, p: diag_gaussian(p.mean + 1, p.stddev))
        assert same(hooked)
        hooked = Predictor(3, 2, trunk="mlp", num_cells=(8,))
        hooked.trunks[0].register_forward_hook(lambda module, inputs, out: out + 1)
        assert same(hooked)
        inner = Predictor(3, 2, trunk="mlp", num_cells=(8, 8))
        inner.trunks[0][2].register_forward_hook(lambda module, inputs, out: out + 1)
        assert same(inner)

        class Other(Predictor):
            def dist(self, *args: Any, **kwargs: Any) -> Any:
                p = super().dist(*args, **kwargs)
                return diag_gaussian(p.mean + 1, p.stddev)

        assert same(Other(3, 2))

    def test_hooks_of_activations_run(self) -> None:
        predictor = Predictor(3, 2, trunk="mlp", num_cells=(8,))
        predictor.trunks[0][1].register_forward_hook(lambda module, inputs, out: out + 1)
        latent, actions = torch.randn(5, 3), torch.randn(5, 4, 2)
        with torch.no_grad():
            torch.testing.assert_close(
                rollout(predictor.dist, latent, actions), by_steps(predictor, latent, actions)
            )

    def test_what_hooks_keep_is_not_overwritten(self) -> None:
        predictor = Predictor(3, 2, trunk="mlp", num_cells=(8,))
        seen: list[Tensor] = []
        predictor.trunks[0][1].register_forward_hook(lambda module, inputs, out: seen.append(out))
        latent, actions = torch.randn(5, 3), torch.randn(5, 4, 2)
        with torch.no_grad():
            rollout(predictor.dist, latent, actions)
            kept, seen[:] = list(seen), []
            by_steps(predictor, latent, actions)
        for ours, expected in zip(kept, seen, strict=True):
            torch.testing.assert_close(ours, expected)

    def test_steps_share_memory_only_where_nobody_follows_them(self) -> None:
        predictor = Predictor(3, 2, trunk="mlp", num_cells=(8,), residual=True)
        latent, actions = torch.randn(6, 5, 3), torch.randn(6, 5, 4, 2)
        expected = by_steps(predictor, latent, actions)
        with torch.no_grad():
            mapped = torch.func.vmap(lambda z, u: rollout(predictor.dist, z, u))(latent, actions)
            torch.testing.assert_close(mapped, expected)
            moved = {name: torch.stack([value, 2 * value]) for name, value in predictor.named_parameters()}
            by_weights = torch.func.vmap(
                lambda weights: torch.func.functional_call(
                    _Rolled(predictor), {f"predictor.{k}": v for k, v in weights.items()}, (latent, actions)
                )
            )(moved)
            torch.testing.assert_close(by_weights[0], expected)
            with torch.autocast("cpu", torch.bfloat16):
                rounded = rollout(predictor.dist, latent, actions)
        torch.testing.assert_close(rounded.float(), expected, atol=0.1, rtol=0.1)

    @pytest.mark.parametrize("first", [torch.bfloat16, torch.float32])
    def test_inputs_of_two_dtypes_compute_in_that_of_the_weights(self, first: torch.dtype) -> None:
        predictor = Predictor(3, 2, trunk="mlp", num_cells=(8,))
        latent, actions = torch.randn(5, 3).to(first), torch.randn(5, 4, 2)
        actions = actions.to(torch.bfloat16 if first == torch.float32 else torch.float32)
        out = []
        for grad in (False, True):
            with torch.set_grad_enabled(grad):
                out.append(rollout(predictor.dist, latent, actions))
        assert out[0].dtype == out[1].dtype == torch.float32
        torch.testing.assert_close(out[0], out[1], atol=1e-5, rtol=1e-5)

    def test_the_network_is_left_alone(self) -> None:
        predictor = Predictor(3, 2, trunk="mlp", num_cells=(8,))
        latent, actions = torch.randn(5, 3), torch.randn(5, 4, 2)
        before = copy.deepcopy(predictor.state_dict()), latent.clone(), actions.clone()
        with torch.no_grad():
            rollout(predictor.dist, latent, actions)
        assert all(torch.equal(v, before[0][k]) for k, v in predictor.state_dict().items())
        assert torch.equal(latent, before[1])
        assert torch.equal(actions, before[2])
        assert predictor.trunks[0][1].inplace is False

    def test_wrong_input_is_refused_as_by_the_distribution(self) -> None:
        predictor = Predictor(3, 2)
        with pytest.raises(ValueError, match="latent must have shape"):
            rollout(predictor.dist, torch.zeros(5, 4), torch.zeros(5, 2, 2))
        with pytest.raises(ValueError, match="action must have shape"):
            rollout(predictor.dist, torch.zeros(5, 3), torch.zeros(5, 2, 3))
        with pytest.raises(TypeError, match="dtype of the predictor"):
            rollout(predictor.dist, torch.zeros(5, 3).double(), torch.zeros(5, 2, 2).double())
        with pytest.raises(ValueError, match="skip must be one of"):
            rollout(Predictor(3, 2, skips=(2,)).dist, torch.zeros(5, 3), torch.zeros(5, 2, 2))
        with pytest.raises(ValueError, match="side_info must have shape"):
            rollout(Predictor(3, 2, side_info_dim=1).dist, torch.zeros(5, 3), torch.zeros(5, 2, 2))

    def test_a_prepared_transition_reads_the_weights_once(self) -> None:
        predictor = Predictor(3, 2)
        move = PreparedTransition(predictor.dist)
        latent, actions = torch.randn(5, 3), torch.randn(5, 4, 2)
        with torch.no_grad():
            first = rollout(move, latent, actions)
            predictor.trunks = nn.ModuleList([nn.Linear(5, 6)])
            assert torch.equal(rollout(move, latent, actions), first)
            assert not torch.allclose(rollout(predictor.dist, latent, actions), first)
            assert torch.equal(move(latent, actions[:, 0]).mean, predictor.dist(latent, actions[:, 0]).mean)


class TestChunks:
    @given(size=st.integers(1, 40), num_envs=st.integers(1, 3), sampled=st.booleans())
    def test_the_plan_is_the_same(self, size: int, num_envs: int, sampled: bool) -> None:
        env = make_env("sample", num_samples=3) if sampled else make_env()
        td = states(num_envs)
        whole, parts = (
            CEM(env, 3, 2, 32, seed=0, chunk_size=chunk, return_stats=True)(td.clone())
            for chunk in (None, size)
        )
        for key in ("action", ("plan_stats", "actions"), ("plan_stats", "cost")):
            torch.testing.assert_close(parts[key], whole[key], atol=1e-4, rtol=1e-4)

    def test_no_more_candidates_are_imagined_at_a_time(self) -> None:
        seen = []

        class Spy(LatentEnv):
            def objective(self, state: Any, actions: Tensor, **kwargs: Any) -> Tensor:
                seen.append(actions.shape[-3])
                return super().objective(state, actions, **kwargs)

        base = make_env()
        env = Spy(
            base.world_model.predictor, action_spec=Bounded(-1, 1, (2,)), cost=quadratic_cost(torch.ones(4))
        )
        CEM(env, 3, 1, 32, chunk_size=12)(states())
        assert seen == [12, 12, 8]

    @pytest.mark.parametrize("size", [0, -1, 1.5])
    def test_bad_sizes_are_refused(self, size: Any) -> None:
        with pytest.raises(ValueError, match="chunk_size"):
            CEM(make_env(), 3, chunk_size=size)


class Rounds(SamplingPlanner):
    """Counts its rounds."""

    done = 0

    def update(self, proposal: Proposal, elites: Tensor, costs: Tensor) -> Proposal:
        self.done += 1
        return proposal


class TestTime:
    @pytest.mark.parametrize(
        ("max_ms", "rounds"), [(5.0, 1), (19.0, 1), (21.0, 2), (39.0, 3), (1000.0, 8), (None, 8)]
    )
    def test_no_round_begins_that_would_end_too_late(
        self, max_ms: float | None, rounds: int, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        ticks = iter(range(100))
        monkeypatch.setattr(time, "perf_counter", lambda: 0.01 * next(ticks))  # a round takes 10 ms
        planner = Rounds(make_env(), 3, 8, 16, max_ms=max_ms)
        planner(states())
        assert planner.done == rounds

    def test_the_plan_is_that_of_the_rounds_that_ran(self, monkeypatch: pytest.MonkeyPatch) -> None:
        ticks = iter(range(100))
        monkeypatch.setattr(time, "perf_counter", lambda: 0.01 * next(ticks))
        short = MPPI(make_env(), 3, 8, 16, seed=0, max_ms=21.0)(states())
        assert torch.equal(short["action"], MPPI(make_env(), 3, 2, 16, seed=0)(states())["action"])

    def test_what_comes_before_the_rounds_takes_time(self, monkeypatch: pytest.MonkeyPatch) -> None:
        now = [0.0]
        monkeypatch.setattr(time, "perf_counter", lambda: now[0])
        clock = Clock(35.0)
        now[0] = 0.020  # a policy has suggested plans
        clock.begin()
        now[0] = 0.027
        assert clock.another(torch.zeros(1))  # 27 + 7 is less than 35
        now[0] = 0.029
        assert not clock.another(torch.zeros(1))  # 29 + 7 is not

    @pytest.mark.parametrize(("max_ms", "simulations"), [(5.0, 1), (39.0, 3), (1000.0, 12), (None, 12)])
    def test_tree_search_too(
        self, max_ms: float | None, simulations: int, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        ticks = iter(range(100))
        monkeypatch.setattr(time, "perf_counter", lambda: 0.01 * next(ticks))
        env = LatentEnv(
            Predictor(4, action_dim=2),
            action_spec=OneHot(2),
            cost=quadratic_cost(torch.ones(4)),
        )
        settings = {"seed": 0, "return_stats": True}
        out = TreeSearch(env, 3, 12, max_ms=max_ms, **settings)(states())
        assert (out["plan_stats", "visits"].sum(-1) == simulations).all()
        few = TreeSearch(env, 3, simulations, **settings)(states())
        assert torch.equal(out["plan_stats", "visits"], few["plan_stats", "visits"])
        with pytest.raises(ValueError, match="max_ms must be positive and finite"):
            TreeSearch(env, 3, max_ms=0.0)

    @pytest.mark.parametrize("max_ms", [0.0, -1.0, float("inf"), float("nan")])
    def test_bad_times_are_refused(self, max_ms: float) -> None:
        with pytest.raises(ValueError, match="max_ms"):
            CEM(make_env(), 3, max_ms=max_ms)


class TestRolloutDtype:
    def test_the_ranking_of_plans_survives(self) -> None:
        plans = torch.rand(3, 256, 5, 2) * 2 - 1
        state = states()["latent"]
        exact, half = (make_env(rollout_dtype=d).objective(state, plans) for d in (None, torch.bfloat16))
        assert half.dtype == exact.dtype
        assert not torch.equal(half, exact)
        ranks = [cost.argsort(-1).argsort(-1).float() for cost in (exact, half)]
        correlation = torch.stack(
            [torch.corrcoef(torch.stack(pair))[0, 1] for pair in zip(*ranks, strict=True)]
        )
        assert correlation.min() > 0.999
        # What bfloat16 takes for the best of 256 is as good.
        chosen = exact.gather(-1, half.argmin(-1, keepdim=True)).squeeze(-1)
        torch.testing.assert_close(chosen, exact.amin(-1), rtol=5e-3, atol=0.0)

    @pytest.mark.parametrize("how", ["mean", "sample"])
    def test_of_any_transition(self, how: Any) -> None:
        def walk(latent: Tensor, action: Tensor) -> Any:
            return diag_gaussian(latent + action @ torch.ones(2, 4), torch.full((4,), 0.1))

        env = LatentEnv(
            walk, action_spec=Bounded(-1, 1, (2,)), cost=quadratic_cost(torch.ones(4)), latent_dim=4,
            how=how, rollout_dtype=torch.bfloat16,
        )  # fmt: skip
        action = CEM(env, 3, 2, 32)(states())["action"]
        assert action.dtype == torch.float32
        assert action.isfinite().all()

    def test_integers_are_refused(self) -> None:
        with pytest.raises(ValueError, match="rollout_dtype"):
            make_env(rollout_dtype=torch.int32)


class TestCompile:
    def test_the_plan_is_the_same(self) -> None:
        plain, compiled = (
            CEM(make_env(), 3, 2, 16, seed=0, compile=options) for options in (False, {"backend": "eager"})
        )
        expected = plain(states())["action"]
        torch.testing.assert_close(compiled(states())["action"], expected, atol=1e-4, rtol=1e-4)
        other = pickle.loads(pickle.dumps(compiled))
        assert other.compile_options == {"backend": "eager"}
        assert other._compiled is None

    def test_what_fails_is_named(self) -> None:
        def broken(graph: Any, inputs: Any) -> Any:
            raise RuntimeError("no compiler here")

        planner = CEM(make_env(), 3, 1, 16, compile={"backend": broken})
        with pytest.raises(RuntimeError, match=r"(?s)compile must be False .* no compiler here"):
            planner(states())


@pytest.mark.parametrize("size", [3, 40])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", ["none", "number", "diagonal", "matrix"])
def test_quadratic_costs_are_the_formula(size: int, dtype: torch.dtype, kind: str) -> None:
    latent, action, target = torch.randn(2, 5, size, dtype=dtype), torch.randn(2, 5, 2), torch.randn(size)
    diagonal = torch.rand(size)
    matrix = {"none": torch.eye(size), "number": 2.5 * torch.eye(size)}.get(kind, diagonal.diag())
    if kind == "matrix" and dtype == torch.float64:
        pytest.skip("matrices have the dtype of the latent")
    weight = {"none": None, "number": 2.5, "diagonal": diagonal, "matrix": matrix}[kind]
    error = (latent - target).double()
    expected = torch.einsum("abi,ij,abj->ab", error, matrix.double(), error)
    cost = quadratic_cost(target, weight)(latent, action)
    assert cost.dtype == dtype
    torch.testing.assert_close(cost.double(), expected, atol=1e-4, rtol=1e-5)


def test_mlp_is_what_the_predictor_is_made_of() -> None:
    assert type(Predictor(3, trunk="mlp").trunks[0]) is MLP
