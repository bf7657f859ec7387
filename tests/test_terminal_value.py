"""What lies behind the horizon: exact values make short horizons long, in every planner alike."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from own_objective import OwnObjective
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Binary, Bounded, Categorical, Composite, OneHot, Unbounded
from torchrl.envs import EnvBase, PendulumEnv, TransformedEnv, UnsqueezeTransform
from torchrl.modules import ValueOperator

from torchrl_vjepa import GoalPrior
from torchrl_vjepa.distributions import Delta, diag_gaussian
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.planners import (
    CEM,
    MPPI,
    EnvObjective,
    ExhaustiveSearch,
    GradientMPC,
    Planner,
    RandomShooting,
    TreeSearch,
)
from torchrl_vjepa.planners.discrete import joint_choices
from torchrl_vjepa.risk import ChanceConstraint, cvar, entropic, expectation, worst_case
from torchrl_vjepa.state_heads import in_evaluation

F64 = {"dtype": torch.float64}
# A scalar linear system with quadratic cost of the next latent and the action.
GAIN, PUSH, STATE_COST, ACTION_COST = 1.1, 0.5, 1.0, 0.3


def riccati(steps: int) -> float:
    """``P`` of the cost-to-go ``P z^2`` with so many steps left."""
    p = 0.0
    for _ in range(steps):
        s = STATE_COST + p
        p = GAIN**2 * s * ACTION_COST / (ACTION_COST + PUSH**2 * s)
    return p


def feedback(steps: int) -> float:
    """``K`` of the first optimal action ``-K z`` of so many steps."""
    s = STATE_COST + riccati(steps - 1)
    return GAIN * PUSH * s / (ACTION_COST + PUSH**2 * s)


class CostToGo(nn.Module):
    def __init__(self, steps: int) -> None:
        super().__init__()
        self.p = nn.Parameter(torch.tensor(riccati(steps), **F64))

    def forward(self, latent: Tensor) -> Tensor:
        return -self.p * latent.square().sum(-1)


class Column(nn.Module):
    def __init__(self, inner: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, *latent: Tensor) -> Tensor:
        return self.inner(*latent).unsqueeze(-1)


def scalar_env(**kwargs: Any) -> LatentEnv:
    return LatentEnv(
        lambda latent, action: Delta(GAIN * latent + PUSH * action),
        action_spec=Bounded(-8, 8, (1,), **F64),
        cost=lambda z, u: STATE_COST * z.square().sum(-1) + ACTION_COST * u.square().sum(-1),
        latent_dim=1,
        **{**F64, **kwargs},
    )


def td_of(latent: Tensor, **more: Tensor) -> TensorDict:
    return TensorDict(latent=latent, batch_size=latent.shape[:-1], **more)


def cold(planner: Planner, *batch: int) -> Any:
    return planner.family.cold(batch, planner.planning_horizon)


START = torch.tensor([[1.0], [-2.0], [0.3]], **F64)
SEARCHES = [
    (CEM, {"optim_steps": 20, "num_candidates": 256}),
    (MPPI, {"optim_steps": 20, "num_candidates": 256, "temperature": 0.05}),
    (RandomShooting, {"num_candidates": 4096}),
    (GradientMPC, {"optim_steps": 200, "tolerance": None}),
]


class TestLinearQuadratic:
    @pytest.mark.parametrize(("cls", "kwargs"), SEARCHES)
    @pytest.mark.parametrize(("horizon", "behind"), [(1, 4), (2, 30)])
    @pytest.mark.parametrize("as_module", [False, True])
    def test_the_exact_cost_to_go_gives_the_action_of_the_long_horizon(
        self, cls: type[Planner], kwargs: dict[str, Any], horizon: int, behind: int, as_module: bool
    ) -> None:
        value: Any = CostToGo(behind)
        if as_module:
            value = ValueOperator(Column(value), in_keys=["latent"])
        planner = cls(scalar_env(), horizon, terminal_value=value, return_stats=True, seed=0, **kwargs)
        out = planner(td_of(START.clone()))
        rough = cls is RandomShooting
        expected = -feedback(horizon + behind) * START
        torch.testing.assert_close(out["action"], expected, atol=0.3 if rough else 5e-3, rtol=0)
        optimum = (riccati(horizon + behind) * START.square()).squeeze(-1)
        cost = out["plan_stats", "cost"].squeeze(-1)
        torch.testing.assert_close(cost, optimum, atol=0.02 if rough else 1e-4, rtol=0)
        assert (cost >= optimum - 1e-9).all()
        myopic = -feedback(horizon) * START
        assert ((myopic - expected).abs() > 0.05 * START.abs()).all()

    def test_the_module_is_the_planners(self) -> None:
        value = CostToGo(3)
        planner = CEM(scalar_env(), 1, terminal_value=value, seed=0)
        assert any(part is value for part in planner.modules())
        assert "terminal_value.p" in planner.state_dict()
        state = START
        before = planner.plan(state, cold(planner, 3)).best_cost
        with torch.no_grad():
            value.p.mul_(3)
        assert (planner.plan(state, cold(planner, 3)).best_cost > before).all()
        assert CEM(scalar_env(), 1).terminal_value is None

    @pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
    def test_it_travels(self, copied: Callable[[Any], Any]) -> None:
        env = LatentEnv(drift, action_spec=Bounded(-1, 1, (1,), **F64), cost=plain, latent_dim=1, **F64)
        planner = CEM(env, 2, terminal_value=CostToGo(3), seed=0)
        again = copied(planner)
        assert again.terminal_value is not planner.terminal_value
        one, two = (p(td_of(START.clone()))["action"] for p in (planner, again))
        assert torch.equal(one, two)

    def test_nothing_is_touched(self) -> None:
        value = nn.Sequential(nn.Linear(1, 4, **F64), nn.Tanh(), nn.Linear(4, 1, **F64), nn.Flatten(-2))
        value.train()
        value[0].eval()
        before = copy.deepcopy(value.state_dict())
        random = torch.get_rng_state()
        for cls in (CEM, GradientMPC):
            cls(scalar_env(), 2, 3, terminal_value=value, seed=0)(td_of(START.clone()))
        assert torch.equal(random, torch.get_rng_state())
        assert [part.training for part in value] == [False, True, True, True]
        assert all(p.grad is None and p.requires_grad for p in value.parameters())
        assert all(torch.equal(before[key], part) for key, part in value.state_dict().items())

    def test_compiled(self) -> None:
        kwargs = {"terminal_value": CostToGo(4), "seed": 0, "return_stats": True}
        eager, compiled = (
            CEM(scalar_env(), 2, 2, 32, compile=how, **kwargs)(td_of(START.clone()))["plan_stats", "cost"]
            for how in (False, {"backend": "eager"})
        )
        torch.testing.assert_close(eager, compiled)

    @pytest.mark.parametrize("batch", [(), (3,), (2, 2), (0,)])
    def test_any_batch_and_any_split(self, batch: tuple[int, ...]) -> None:
        latent = torch.randn(*batch, 1, generator=torch.Generator().manual_seed(0), **F64)
        out = CEM(scalar_env(), 2, terminal_value=CostToGo(4), seed=0)(td_of(latent))
        assert out["action"].shape == (*batch, 1)
        for row in range(batch[0] if batch == (3,) else 0):
            alone = CEM(scalar_env(), 2, terminal_value=CostToGo(4), seed=0)(td_of(latent[row]))
            torch.testing.assert_close(alone["action"], out["action"][row])


def drift(latent: Tensor, action: Tensor) -> Delta:
    return Delta(0.9 * latent + action)


def plain(latent: Tensor, action: Tensor) -> Tensor:
    return latent.square().sum(-1)


def nothing(latent: Tensor, action: Tensor) -> Tensor:
    return 0 * latent[..., 0]


def wave(latent: Tensor, action: Any = None) -> Tensor:
    return torch.sin(3 * latent[..., 0]) + latent.square().sum(-1)


def minus_wave(latent: Tensor) -> Tensor:
    return -wave(latent)


def gust(latent: Tensor, action: Tensor) -> Any:
    return diag_gaussian(0.9 * latent + action, torch.full_like(latent, 0.5))


class TestObjective:
    """With one step and no other cost, minus the value is the cost of the next latent."""

    def both(self, **kwargs: Any) -> tuple[Callable[..., Tensor], Callable[..., Tensor]]:
        def objective(cost: Any, value: Any) -> Callable[..., Tensor]:
            env = LatentEnv(
                gust, action_spec=Bounded(-1, 1, (2,)), cost=cost, latent_dim=2, how="sample", **kwargs
            )

            def evaluate(td: TensorDict, actions: Tensor, **asked: Any) -> Tensor:
                generator = torch.Generator().manual_seed(4)
                state = env.planning_state(td)
                return env.objective(state, actions, generator=generator, terminal_value=value, **asked)

            return evaluate

        return objective(wave, None), objective(nothing, minus_wave)

    @staticmethod
    def plans(*batch: int, horizon: int = 1) -> Tensor:
        return torch.rand(*batch, 7, horizon, 2, generator=torch.Generator().manual_seed(1)) * 2 - 1

    @pytest.mark.parametrize("risk", [expectation, worst_case, cvar(0.3), entropic(2.0)])
    @pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
    def test_every_trajectory_has_its_own(self, risk: Any, batch: tuple[int, ...]) -> None:
        cost, value = self.both(num_samples=16, risk=risk)
        td = td_of(torch.randn(*batch, 2, generator=torch.Generator().manual_seed(0)))
        torch.testing.assert_close(cost(td, self.plans(*batch)), value(td, self.plans(*batch)))

    @pytest.mark.parametrize("fusion", ["energy", "weight", "propose"])
    @pytest.mark.parametrize("constrained", [False, True])
    def test_under_a_prior(self, fusion: Any, constrained: bool) -> None:
        def far(latent: Tensor, action: Tensor) -> Tensor:
            return latent[..., 0] > 0.3

        constraints = [ChanceConstraint(far, 0.1, penalty=2.0)] if constrained else []
        cost, value = self.both(
            prior=GoalPrior(std=1.0), num_samples=16, fusion=fusion, constraints=constraints
        )
        td = td_of(torch.zeros(3, 2), task=torch.ones(3, 2))
        torch.testing.assert_close(cost(td, self.plans(3)), value(td, self.plans(3)))

    def test_under_a_prior_and_a_predicted_end(self) -> None:
        end = TensorDictModule(lambda z: 3 * z[..., :1], ["latent"], ["termination_logit"])
        env = LatentEnv(
            gust,
            action_spec=Bounded(-1, 1, (2,)),
            cost=nothing,
            latent_dim=2,
            how="sample",
            num_samples=8,
            fusion="propose",
            prior=GoalPrior(std=1.0),
            termination_model=end,
        )
        state = env.planning_state(td_of(torch.zeros(3, 2), task=torch.ones(3, 2)))
        plans = self.plans(3, horizon=2)
        costs = []
        for value in (None, lambda z: 0 * z[..., 0] + 7.0):
            generator = torch.Generator().manual_seed(0)
            costs.append(env.objective(state, plans, generator=generator, terminal_value=value))
        # Minus the logarithm of a mean of exp(-J + 7 a) with 0 < a < 1 lies between.
        assert (costs[0] > costs[1]).all()
        assert (costs[0] - 7 < costs[1]).all()

    def test_from_a_belief(self) -> None:
        cost, value = self.both(belief_key="belief", num_samples=32)
        particles = torch.randn(3, 10, 2, generator=torch.Generator().manual_seed(0))
        td = TensorDict(belief={"particles": particles, "log_weights": torch.zeros(3, 10)}, batch_size=3)
        torch.testing.assert_close(cost(td, self.plans(3)), value(td, self.plans(3)))

    @pytest.mark.parametrize("ends", [False, True])
    def test_it_counts_as_far_as_the_horizon_is_reached(self, ends: bool) -> None:
        end = TensorDictModule(lambda z: 2 * z[..., :1], ["latent"], ["termination_logit"])
        env = LatentEnv(
            drift,
            action_spec=Bounded(-1, 1, (2,)),
            cost=plain,
            latent_dim=2,
            termination_model=end if ends else None,
            termination_cost=0.7 if ends else 0.0,
        )
        plans, start = self.plans(3, horizon=4), torch.randn(3, 2, generator=torch.Generator().manual_seed(2))
        z, alive = start.unsqueeze(1).expand(3, 7, 2), torch.ones(3, 7)
        for action in plans.unbind(-2):
            z = 0.9 * z + action
            if ends:
                alive = alive * (1 - (2 * z[..., 0]).sigmoid())
        difference = env.objective(start, plans) - env.objective(start, plans, terminal_value=minus_wave)
        torch.testing.assert_close(difference, -alive * wave(z))

    def test_gradients_flow_through_it(self) -> None:
        env = LatentEnv(drift, action_spec=Bounded(-1, 1, (1,)), cost=nothing, latent_dim=1)
        planner = GradientMPC(env, 2, 100, terminal_value=lambda z: -(z[..., 0] - 1.2).square(), seed=0)
        plan = planner.plan(torch.zeros(2, 1), cold(planner, 2))
        assert (plan.best_cost < 1e-4).all()
        actions = torch.zeros(1, 3, 1, requires_grad=True)
        cost = env.objective(torch.ones(1), actions, terminal_value=lambda z: -z[..., 0])
        (gradient,) = torch.autograd.grad(cost.sum(), actions)
        torch.testing.assert_close(gradient.flatten(), torch.tensor([0.81, 0.9, 1.0]))

    @pytest.mark.parametrize("stepped", [False, True])
    def test_a_value_without_gradient_is_refused_for_gradients(self, stepped: bool) -> None:
        env: Any = LatentEnv(drift, action_spec=Bounded(-1, 1, (1,)), cost=plain, latent_dim=1)
        rounded = TensorDictModule(lambda z: z.round().detach()[..., :1], ["latent"], ["state_value"])
        if stepped:
            env = TransformedEnv(env)
        planner = GradientMPC(env, 2, terminal_value=rounded)
        with pytest.raises(
            ValueError, match="terminal_value must have a gradient for actions that require one"
        ):
            planner(td_of(torch.zeros(2, 1)))
        assert CEM(env, 2, terminal_value=rounded)(td_of(torch.zeros(2, 1)))["action"].shape == (2, 1)

    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
    def test_a_value_that_is_not_finite_ranks_its_plans_last(self, bad: float) -> None:
        env = LatentEnv(drift, action_spec=Bounded(-1, 1, (1,)), cost=plain, latent_dim=1)

        def value(latent: Tensor) -> Tensor:
            return torch.where(latent[..., 0] < 0.2, bad, 0.0)

        plan = CEM(env, 1, terminal_value=value, output="best", seed=0)
        assert plan(td_of(torch.zeros(2, 1)))["action"].min() >= 0.2

    def test_every_risk_of_the_statistics_has_it(self) -> None:
        env = LatentEnv(
            gust, action_spec=Bounded(-1, 1, (2,)), cost=plain, latent_dim=2, how="sample", num_samples=16
        )
        kwargs = {"return_stats": {"worst": worst_case}, "optim_steps": 1, "seed": 0, "num_candidates": 4}
        worth = [
            MPPI(env, 2, top_k=4, temperature=1e9, terminal_value=value, **kwargs)(td_of(torch.zeros(2, 2)))
            for value in (None, lambda z: 0 * z[..., 0] + 5.0)
        ]
        for name in ("cost", "worst"):
            one, two = (out["plan_stats", name] for out in worth)
            torch.testing.assert_close(one - 5.0, two, atol=1e-4, rtol=1e-4)


def pushes(n: int) -> Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(n), **F64)


def swirl(latent: Tensor, action: Tensor) -> Delta:
    push = (action.unsqueeze(-1) * pushes(action.shape[-1]).to(action)).sum(-2)
    return Delta(torch.sin(1.7 * latent.roll(1, -1)) + push)


def bumpy(latent: Tensor, action: Tensor) -> Tensor:
    return latent[..., 0] + torch.cos(3 * latent[..., 1]) + 2.0 * (latent[..., 2] > 0.5)


def discrete_env(spec: Any = None, **kwargs: Any) -> LatentEnv:
    spec = OneHot(3) if spec is None else spec
    return LatentEnv(swirl, action_spec=spec, cost=bumpy, latent_dim=3, **{**F64, **kwargs})


def latents(*batch: int) -> Tensor:
    return torch.randn(*batch, 3, generator=torch.Generator().manual_seed(5), **F64)


def best_of(env: LatentEnv, latent: Tensor, horizon: int, value: Any = None) -> tuple[Tensor, Tensor]:
    """Cost and plan by brute force."""
    codes = joint_choices(env.codec).double()
    plans = torch.cartesian_prod(*[torch.arange(len(codes))] * horizon).reshape(-1, horizon)
    plans = codes[plans]
    costs = env.objective(latent, plans.expand(*latent.shape[:-1], *plans.shape), terminal_value=value)
    lowest, index = costs.min(-1)
    return lowest, plans[index]


class TestSearches:
    @pytest.mark.parametrize("spec", [OneHot(3), Categorical(2), Binary(2)])
    @pytest.mark.parametrize(
        ("cls", "kwargs"),
        [
            (ExhaustiveSearch, {}),
            (ExhaustiveSearch, {"chunk_size": 4}),
            (TreeSearch, {"num_simulations": 150, "output": "best"}),
            (CEM, {"optim_steps": 6, "num_candidates": 128, "output": "best"}),
            (RandomShooting, {"num_candidates": 256}),
        ],
    )
    def test_a_short_horizon_and_an_exact_value_are_a_long_one(
        self, cls: type[Planner], kwargs: dict[str, Any], spec: Any
    ) -> None:
        env = discrete_env(spec)

        def ahead(latent: Tensor) -> Tensor:
            return -best_of(env, latent, 2)[0]

        planner = cls(env, 2, terminal_value=ahead, seed=0, **kwargs)
        plan = planner.plan(latents(4), cold(planner, 4))
        cost, best = best_of(env, latents(4), 4)
        torch.testing.assert_close(plan.best_cost.double(), cost, rtol=1e-5, atol=1e-5)
        assert torch.equal(plan.actions.double(), best[:, :2])
        assert not torch.equal(best_of(env, latents(4), 2)[1], best[:, :2])

    @pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
    @pytest.mark.parametrize("cls", [ExhaustiveSearch, TreeSearch])
    def test_plans_cost_what_the_objective_says(self, cls: type[Planner], batch: tuple[int, ...]) -> None:
        end = TensorDictModule(lambda z: z[..., :1], ["latent"], ["termination_logit"])
        env = discrete_env(termination_model=end, termination_cost=1.0)
        value = ValueOperator(Column(minus_wave), in_keys=["latent"])
        kwargs = {"num_simulations": 25} if cls is TreeSearch else {}
        planner = cls(env, 4, terminal_value=value, seed=0, **kwargs)
        plan = planner.plan(latents(*batch), cold(planner, *batch))
        again = env.objective(latents(*batch), plan.best.unsqueeze(-3), terminal_value=value).squeeze(-1)
        torch.testing.assert_close(plan.best_cost.double(), again)
        if cls is ExhaustiveSearch:
            torch.testing.assert_close(plan.best_cost, best_of(env, latents(*batch), 4, value)[0])

    def test_sampled_plans_of_an_exhaustive_search(self) -> None:
        def noisy(latent: Tensor, action: Tensor) -> Any:
            return diag_gaussian(swirl(latent, action).mean, torch.full_like(latent, 0.5))

        env = LatentEnv(
            noisy, action_spec=OneHot(3), cost=bumpy, latent_dim=3, how="sample", num_samples=8, **F64
        )
        one, two = (ExhaustiveSearch(env, 2, terminal_value=value, seed=0) for value in (None, minus_wave))
        assert (
            one.plan(latents(3), cold(one, 3)).best_cost != two.plan(latents(3), cold(two, 3)).best_cost
        ).all()

    @pytest.mark.parametrize("discount", [1.0, 0.8])
    def test_the_rollout_of_a_tree_search_ends_in_it(self, discount: float) -> None:
        env = discrete_env()
        planner = TreeSearch(env, 4, 30, discount=discount, terminal_value=minus_wave, seed=0)
        plan = planner.plan(latents(5), cold(planner, 5))
        z, total = latents(5), torch.zeros(5, **F64)
        for k, action in enumerate(plan.best.double().unbind(1)):
            z = swirl(z, action).mean
            total = total + discount**k * bumpy(z, action)
        torch.testing.assert_close(plan.best_cost.double(), total + discount**4 * wave(z))

    @pytest.mark.parametrize("ends", [False, True])
    @pytest.mark.parametrize(
        ("cls", "kwargs"),
        [
            (ExhaustiveSearch, {"warm_start": True}),
            (TreeSearch, {"num_simulations": 25}),
            (CEM, {"num_candidates": 16}),
        ],
    )
    def test_it_is_behind_the_horizon_of_actions_that_are_held(
        self, cls: type[Planner], kwargs: dict[str, Any], ends: bool
    ) -> None:
        end = TensorDictModule(lambda z: z[..., :1], ["latent"], ["termination_logit"])
        env = discrete_env(termination_model=end if ends else None)
        planner = cls(env, 6, action_repeat=2, terminal_value=minus_wave, seed=0, **kwargs)
        plan = planner.plan(latents(3), planner.family.cold((3,), 3))
        held = plan.best.double().repeat_interleave(2, dim=-2).unsqueeze(-3)
        cost = env.objective(latents(3), held, terminal_value=minus_wave).squeeze(-1)
        torch.testing.assert_close(plan.best_cost.double(), cost, rtol=1e-5, atol=1e-5)

    def test_it_is_no_leaf_value(self) -> None:
        with pytest.raises(ValueError, match="at most one of leaf_value and terminal_value must be given"):
            TreeSearch(discrete_env(), 3, terminal_value=minus_wave, leaf_value=minus_wave)


class Walk(EnvBase):
    """A walk on the line that ends beyond four."""

    def __init__(self) -> None:
        super().__init__(batch_size=[])
        self.observation_spec = Composite(position=Unbounded((1,)))
        self.state_spec = Composite(position=Unbounded((1,)))
        self.action_spec = Categorical(2)
        self.reward_spec = Unbounded((1,))

    @property
    def batch_locked(self) -> bool:
        return False

    def _step(self, td: Any) -> TensorDict:
        position = td["position"] + 2.0 * td["action"].unsqueeze(-1) - 1.0
        done = position > 4
        out = {"position": position, "reward": -position, "done": done, "terminated": done}
        return TensorDict(out, batch_size=td.batch_size)

    def _reset(self, td: Any = None, **kwargs: Any) -> Any:
        return TensorDict(position=torch.zeros(1))

    def _set_seed(self, seed: int | None) -> None:
        pass


class TestStepped:
    def test_where_an_environment_gets_to(self) -> None:
        env = PendulumEnv()
        source = EnvObjective(env)
        start = env.reset().expand(3).clone().set("th", torch.tensor([0.1, 1.0, -2.0]))
        state = source.planning_state(start)
        value = ValueOperator(Column(lambda th, thdot: th.cos() + 2 * thdot), in_keys=["th", "thdot"])
        plans = torch.rand(3, 5, 4, 1, generator=torch.Generator().manual_seed(0)) * 4 - 2
        current, reward = state.unsqueeze(-1).expand(3, 5), 0
        for action in plans.unbind(-2):
            following = env.step(current.copy().set("action", action))["next"]
            reward = reward + following["reward"].squeeze(-1)
            current = current.copy().update(following.select("th", "thdot"))
        expected = -reward - (current["th"].cos() + 2 * current["thdot"])
        torch.testing.assert_close(source.objective(state, plans, terminal_value=value), expected)
        sampled = source.objective(state, plans, num_samples=2, terminal_value=value)
        torch.testing.assert_close(sampled, expected)

    def test_nothing_is_behind_an_end(self) -> None:
        source = EnvObjective(Walk())
        state = TensorDict(position=torch.tensor([[3.0], [0.0]]), batch_size=2)
        plans = torch.eye(2)[torch.tensor([[1, 1], [0, 0]])].expand(2, 2, 2, 2)
        value = ValueOperator(Column(lambda z: 100 * z[..., 0]), in_keys=["position"])
        difference = source.objective(state, plans) - source.objective(state, plans, terminal_value=value)
        assert difference.tolist() == [[0.0, 100.0], [200.0, -200.0]]
        for cls, kwargs in ((ExhaustiveSearch, {}), (TreeSearch, {"num_simulations": 20, "seed": 0})):
            planner = cls(Walk(), 2, terminal_value=value, **kwargs)
            plan = planner.plan(state, cold(planner, 2))
            costs = planner._source.objective(state, plan.best.unsqueeze(1), terminal_value=value)
            torch.testing.assert_close(plan.best_cost, costs.squeeze(1))

    def test_what_only_an_observation_holds_is_carried(self) -> None:
        def observed(name: str) -> EnvBase:
            return TransformedEnv(PendulumEnv(), UnsqueezeTransform(-1, in_keys=["th"], out_keys=[name]))

        value = ValueOperator(nn.Linear(1, 1), in_keys=["angle"])
        planner = CEM(observed("angle"), 3, 2, 16, terminal_value=value, seed=0, return_stats=True)
        assert "angle" in planner.in_keys
        assert "angle" not in CEM(observed("angle"), 3).in_keys
        td = observed("angle").reset()
        planner(td)
        same = ValueOperator(Column(lambda th: value.module(th.unsqueeze(-1))[..., 0]), in_keys=["th"])
        again = CEM(PendulumEnv(), 3, 2, 16, terminal_value=same, seed=0, return_stats=True)(
            td.select("th", "thdot", "params")
        )
        torch.testing.assert_close(td["plan_stats", "cost"], again["plan_stats", "cost"])
        assert planner(observed("angle").reset())["action"].shape == (1,)
        with pytest.raises(KeyError, match=r"missing \['angle'\]"):
            planner(td.exclude("angle"))

    def test_heads_of_a_tree_search_read_observations_too(self) -> None:
        env = TransformedEnv(Walk(), UnsqueezeTransform(-1, in_keys=["position"], out_keys=["seen"]))
        value = ValueOperator(Column(lambda seen: -seen[..., 0, 0]), in_keys=["seen"])
        same = ValueOperator(Column(lambda position: -position[..., 0]), in_keys=["position"])
        logits = TensorDictModule(lambda seen: torch.cat([seen, -seen], -1)[..., 0, :], ["seen"], ["logits"])
        td = env.reset().expand(2).clone().set("position", torch.tensor([[1.0], [-1.0]]))
        td["seen"] = td["position"].unsqueeze(-1)
        for name in ("leaf_value", "terminal_value"):
            planner = TreeSearch(env, 3, 12, seed=0, return_stats=True, prior_policy=logits, **{name: value})
            assert planner.in_keys.count("seen") == 1
            other = TreeSearch(env, 3, 12, seed=0, return_stats=True, prior_policy=logits, **{name: same})
            assert torch.equal(
                planner(td.clone())["plan_stats", "value"], other(td.clone())["plan_stats", "value"]
            )
        assert "seen" in TreeSearch(env, 3, leaf_value=value).in_keys
        assert "seen" not in TreeSearch(env, 3, leaf_value=same).in_keys

    def test_it_helps_a_pendulum(self) -> None:
        """Energy is worth something: a short horizon alone does not swing up."""

        def energy(th: Tensor, thdot: Tensor) -> Tensor:
            return -(0.5 * thdot.square() + 10 * th.cos() - 10).square()

        value = ValueOperator(Column(energy), in_keys=["th", "thdot"])
        env = PendulumEnv()
        upright = []
        for head in (None, value):
            planner = MPPI(env, 2, 3, 32, terminal_value=head, seed=0, warm_start=False)
            td = env.reset()
            td["th"], td["thdot"] = torch.tensor(math.pi), torch.tensor(0.1)
            highest = torch.tensor(-1.0)
            for _ in range(80):
                td = (
                    env.step(planner(td))["next"]
                    .exclude("reward", "done", "terminated")
                    .set("params", td["params"])
                )
                highest = torch.maximum(highest, td["th"].cos())
            upright.append(float(highest))
        assert upright[1] > 0.9 > upright[0]


class OlderObjective(LatentEnv):
    def objective(self, state: Any, actions: Tensor, *, generator: Any = None) -> Tensor:
        return super().objective(state, actions, generator=generator)


class TestArguments:
    @pytest.mark.parametrize(
        ("value", "error", "message"),
        [
            (3.0, TypeError, "terminal_value must be callable, latents to a tensor, got float"),
            (
                nn.Linear(1, 1, **F64),
                ValueError,
                r"terminal_value must give one number for each row, of shape \(2, 3\), got \(2, 3, 1\); drop",
            ),
            (lambda z: 1.0, ValueError, r"of shape \(2, 3\), got float"),
            (lambda z: z.sum(), ValueError, r"of shape \(2, 3\), got \(\)"),
            (
                ValueOperator(nn.Linear(1, 2, **F64), in_keys=["latent"]),
                ValueError,
                r"of shape \(2, 3\), got \(2, 3, 2\)",
            ),
            (
                ValueOperator(nn.Linear(1, 1, **F64), in_keys=["observation"]),
                KeyError,
                r"terminal_value must read only \['latent'\] of LatentEnv, got in_keys=\['observation'\]",
            ),
            (
                TensorDictModule(nn.Linear(1, 1, **F64), ["latent"], ["value"]),
                KeyError,
                r"terminal_value must write \['state_value'\], got out_keys=\['value'\]",
            ),
        ],
    )
    @pytest.mark.parametrize("cls", [CEM, GradientMPC])
    def test_refused_when_the_planner_is_made(
        self, cls: type[Planner], value: Any, error: type[Exception], message: str
    ) -> None:
        with pytest.raises(error, match=message):
            cls(scalar_env(), 2, terminal_value=value)

    def test_environments_that_do_not_take_it(self) -> None:
        message = "terminal_value need an environment whose objective takes them, as LatentEnv does, got "
        with pytest.raises(TypeError, match=f"{message}OwnObjective, whose own objective has no method samp"):
            CEM(OwnObjective(), 2, terminal_value=minus_wave)
        older = OlderObjective(drift, action_spec=Bounded(-1, 1, (1,)), cost=plain, latent_dim=1)
        with pytest.raises(TypeError, match=f"{message}OlderObjective, whose own objective was written with"):
            CEM(older, 2, terminal_value=minus_wave)
        assert CEM(older, 2)(td_of(torch.zeros(1)))["action"].shape == (1,)

    def test_a_function_of_latents_needs_latents(self) -> None:
        with pytest.raises(TypeError, match="terminal_value must be a TensorDictModule for PendulumEnv, whi"):
            CEM(PendulumEnv(), 2, terminal_value=minus_wave)
        with pytest.raises(KeyError, match=r"terminal_value must read only \['th', 'thdot'"):
            CEM(PendulumEnv(), 2, terminal_value=ValueOperator(nn.Linear(1, 1), in_keys=["pixels"]))

    def test_a_trial_leaves_modes_and_gradients(self) -> None:
        part = nn.Sequential(nn.Dropout(0.5), nn.Linear(2, 2)).train()
        part[0].eval()
        with in_evaluation(part):
            assert not any(p.training for p in part.modules())
            assert not part[1](torch.ones(2)).requires_grad
        assert [p.training for p in part.modules()] == [True, False, True]
        with pytest.raises(RuntimeError), in_evaluation(part):
            part[1](torch.ones(3))
        assert [p.training for p in part.modules()] == [True, False, True]
