"""Priors in LatentEnv: tasks by row and by step, costs that add up, and planning by posterior."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torch.distributions import Distribution, MultivariateNormal
from torchrl.data import Bounded, Categorical, Unbounded
from torchrl.envs import RewardScaling, TransformedEnv

from torchrl_vjepa import (
    CEM,
    MPPI,
    ChanceConstraint,
    EnergyPrior,
    ExhaustiveSearch,
    FusedPredictor,
    GaussianPrior,
    GradientMPC,
    HalfSpace,
    LatentEnv,
    ParticleFilter,
    Predictor,
    Prior,
    ProbedPrior,
    ProductPrior,
    PseudoLikelihood,
    RandomShooting,
    RegionPrior,
    TreeSearch,
    trajectory_prior,
)
from torchrl_vjepa.costs import action_cost, prior_cost, quadratic_cost
from torchrl_vjepa.distributions import Density, diag_gaussian
from torchrl_vjepa.priors import LatentDensity, Task
from torchrl_vjepa.risk import REJECTED_COST, cvar, entropic, free_energy

A_MATRIX = torch.tensor([[0.9, 0.2], [-0.2, 0.9]], dtype=torch.float64)
B_MATRIX = torch.tensor([[1.0], [0.5]], dtype=torch.float64)
STD = 0.3


def gaussian(latent: Tensor, action: Tensor) -> Distribution:
    loc = latent @ A_MATRIX.mT.to(latent) + action @ B_MATRIX.mT.to(latent)
    return diag_gaussian(loc, torch.full_like(loc, STD))


class Well(Prior):
    """A Gaussian around the task."""

    def __init__(self, std: float = 0.5, task_key: Any = "goal") -> None:
        super().__init__(task_key=task_key, latent_dim=2)
        self.std = std

    def forward(self, task: Task = None) -> LatentDensity:
        goal = self.own_task(task)
        return diag_gaussian(goal, torch.full_like(goal, self.std))


class EnergyWell(Well):
    """The same as an energy that nobody knows to be Gaussian."""

    def forward(self, task: Task = None) -> LatentDensity:
        density = super().forward(task)
        return Density(lambda z: -density.log_prob(z))


class Encoded(Well):
    """The task is read by an encoder, which is trained and expensive."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = torch.nn.Linear(2, 2, dtype=torch.float64)
        self.calls: list[torch.Size] = []
        self.encoder.register_forward_hook(lambda module, inputs, out: self.calls.append(out.shape))

    def forward(self, task: Task = None) -> LatentDensity:
        return super().forward(self.encoder(self.own_task(task)))


def make_env(prior: Prior | None = None, **kwargs: Any) -> LatentEnv:
    spec = kwargs.pop("action_spec", Bounded(-2, 2, (1,), dtype=torch.float64))
    kwargs.setdefault("dtype", torch.float64)
    return LatentEnv(gaussian, action_spec=spec, prior=prior, latent_dim=2, **kwargs)


def state_of(env: LatentEnv, batch: tuple[int, ...] = (3,), **tasks: Tensor) -> Any:
    latent = torch.randn(*batch, 2, dtype=torch.float64)
    return env.planning_state(TensorDict(latent=latent, **tasks, batch_size=batch))


def plans(batch: tuple[int, ...] = (3,), num: int = 5, horizon: int = 4) -> Tensor:
    return torch.randn(*batch, num, horizon, 1, dtype=torch.float64)


class TestWhatRoundsShare:
    """Tasks do not change within a planning call: what the prior makes of them is made once."""

    @staticmethod
    def planners(env: LatentEnv) -> dict[str, Any]:
        sizes = {"num_candidates": 16, "seed": 0}
        return {
            "energy": CEM(env, 4, 3, **sizes),
            "chunked": CEM(env, 4, 3, chunk_size=5, **sizes),
            "weight": MPPI(env, 4, 3, fusion="weight", num_samples=2, **sizes),
            "propose": MPPI(env, 4, 3, fusion="propose", num_samples=2, **sizes),
            "gradient": GradientMPC(env, 4, 3, num_starts=2, seed=0),
            "gradient, propose": GradientMPC(env, 4, 3, fusion="propose", num_samples=2, seed=0),
        }

    @pytest.mark.parametrize("time_indexed", [False, True])
    @pytest.mark.parametrize(
        "name", ["energy", "chunked", "weight", "propose", "gradient", "gradient, propose"]
    )
    def test_the_goal_encoder_runs_once(self, name: str, time_indexed: bool) -> None:
        prior = Encoded()
        env = make_env(prior, how="sample" if name != "energy" else "mean")
        planner = self.planners(env)[name]
        shape = (3, 6, 2) if time_indexed else (3, 2)
        goal = torch.randn(shape, dtype=torch.float64)
        td = TensorDict(latent=torch.randn(3, 2, dtype=torch.float64), goal=goal, batch_size=3)
        prior.calls.clear()
        out = planner(td)
        # Steps that are fused one by one have each their own task, where it is another.
        assert len(prior.calls) == (4 if time_indexed and "propose" in name else 1)
        assert out["action"].isfinite().all()
        assert prior.encoder.weight.grad is None

    @pytest.mark.parametrize("time_indexed", [False, True])
    def test_searches_over_choices_too(self, time_indexed: bool) -> None:
        prior = Encoded()
        spec = Categorical(1)
        env = make_env(prior, how="mean", action_spec=spec)
        shape = (3, 6, 2) if time_indexed else (3, 2)
        goal = torch.randn(shape, dtype=torch.float64)
        td = TensorDict(latent=torch.randn(3, 2, dtype=torch.float64), goal=goal, batch_size=3)
        for planner, steps in ((ExhaustiveSearch(env, 4), 4), (TreeSearch(env, 4, 2, seed=0), 7)):
            prior.calls.clear()
            planner(td.clone())
            assert len(prior.calls) == (steps if time_indexed else 1)

    @pytest.mark.parametrize("fusion", ["energy", "weight", "propose"])
    @pytest.mark.parametrize("ends", [False, True])
    def test_later_rounds_cost_what_a_call_of_their_own_does(self, fusion: Any, ends: bool) -> None:
        head = torch.nn.Linear(2, 1, dtype=torch.float64)
        ends_by = TensorDictModule(head, ["latent"], ["termination_logit"]) if ends else None
        env = make_env(Encoded(), how="sample", num_samples=3, termination_model=ends_by)
        state = state_of(env, goal=torch.randn(3, 6, 2, dtype=torch.float64))
        evaluate = env.objective_from(state, fusion=fusion)
        for horizon in (4, 4, 3):
            actions, seed = plans(horizon=horizon), torch.Generator().manual_seed(1)
            costs = env.objective(state, actions, fusion=fusion, generator=seed)
            torch.testing.assert_close(evaluate(actions, torch.Generator().manual_seed(1)), costs)

    def test_a_new_call_sees_new_weights_and_new_tasks(self) -> None:
        prior = Encoded()
        planner = CEM(make_env(prior), 4, 2, num_candidates=16, seed=0)
        latent = torch.randn(3, 2, dtype=torch.float64)

        def cost(goal: float) -> Tensor:
            task = torch.full((3, 2), goal, dtype=torch.float64)
            state = planner.env.planning_state(TensorDict(latent=latent, goal=task, batch_size=3))
            return planner.env.objective(state, torch.zeros(3, 1, 4, 1, dtype=torch.float64))

        first = cost(0.0)
        assert not torch.allclose(cost(1.0), first)
        with torch.no_grad():
            prior.encoder.bias.add_(1.0)
        assert not torch.allclose(cost(0.0), first)

    def test_the_objective_alone_has_gradients_for_the_prior(self) -> None:
        prior = Encoded()
        env = make_env(prior)
        state = state_of(env, goal=torch.randn(3, 2, dtype=torch.float64))
        env.objective(state, plans()).sum().backward()
        assert prior.encoder.weight.grad.abs().sum() > 0


class TestTasks:
    def test_every_row_has_its_own(self) -> None:
        goals = torch.randn(3, 2, dtype=torch.float64)
        env = make_env(Well())
        state, actions = state_of(env, goal=goals), plans()
        together = env.objective(state, actions)
        for row in range(3):
            alone = make_env(Well().bind(goals[row]))
            torch.testing.assert_close(alone.objective(state["latent"][row], actions[row]), together[row])

    def test_time_indexed(self) -> None:
        path = torch.randn(3, 6, 2, dtype=torch.float64)  # longer than the horizon
        env = make_env(Well())
        state, actions = state_of(env, goal=path), plans()
        latent = state["latent"].unsqueeze(-2).expand(3, 5, 2)
        expected: Tensor | float = 0.0
        for k in range(4):
            latent = gaussian(latent, actions[..., k, :]).mean
            expected = expected + Well().energy(latent, path[:, k].unsqueeze(1))
        torch.testing.assert_close(env.objective(state, actions), expected)

    def test_a_path_that_is_too_short_is_refused(self) -> None:
        env = make_env(Well())
        state = state_of(env, goal=torch.zeros(3, 2, 2, dtype=torch.float64))
        with pytest.raises(ValueError, match="'goal' must hold the tasks of at least 4 steps, got 2"):
            env.objective(state, plans())

    def test_stepping_reads_and_shifts_them(self) -> None:
        path = torch.arange(8.0, dtype=torch.float64).reshape(4, 2)
        env = make_env(Well(), cost=action_cost())
        start = TensorDict(latent=torch.zeros(2, dtype=torch.float64), goal=path)
        td = env.rollout(
            3,
            lambda td: td.set("action", torch.ones(1, dtype=torch.float64)),
            tensordict=start,
            auto_reset=False,
        )
        expected = -1.0 - Well().energy(td["next", "latent"], path[:3])
        torch.testing.assert_close(td["next", "reward"].squeeze(-1), expected)
        torch.testing.assert_close(td["next", "goal"][0], path[[1, 2, 3, 3]])

    def test_stepping_with_a_constant_task(self) -> None:
        env = make_env(Well())
        goal = torch.ones(3, 2, dtype=torch.float64)
        start = TensorDict(latent=torch.zeros(3, 2, dtype=torch.float64), goal=goal, batch_size=[3])
        td = env.rollout(4, tensordict=start, auto_reset=False)
        expected = -Well().energy(td["next", "latent"], goal.unsqueeze(1))
        torch.testing.assert_close(td["next", "reward"].squeeze(-1), expected)

    def test_stepping_counts_the_time(self) -> None:
        path = torch.arange(8.0, dtype=torch.float64).reshape(4, 2)
        both = ProductPrior(
            trajectory_prior(path, 0.5), ProbedPrior(Well(), torch.eye(2, dtype=torch.float64))
        )
        env = make_env(both)
        goal = torch.ones(2, dtype=torch.float64)
        start = TensorDict(
            latent=torch.zeros(2, dtype=torch.float64), step_count=torch.tensor([1]), goal=goal
        )
        td = env.rollout(3, tensordict=start, auto_reset=False)
        assert td["next", "step_count"].flatten().tolist() == [2, 3, 4]

        def wells(latent: Tensor) -> Tensor:
            return Well().energy(latent, path[[2, 3, 3]]) + Well().energy(latent, goal)

        energy = -td["next", "reward"].squeeze(-1)
        # A product of Gaussians is known up to a constant, which depends on the tasks.
        constant = energy - wells(td["next", "latent"])

        def again(latent: Tensor) -> Tensor:
            return both.energy(latent, {"step_count": torch.tensor([[2], [3], [3]]), "goal": goal})

        elsewhere = torch.randn(3, 2, dtype=torch.float64)
        expected = (
            again(elsewhere) - Well().energy(elsewhere, path[[2, 3, 3]]) - Well().energy(elsewhere, goal)
        )
        torch.testing.assert_close(constant, expected)

    def test_missing_and_misshapen_tasks_are_refused(self) -> None:
        env = make_env(Well())
        with pytest.raises(KeyError, match=r"entries \['goal'\].*prior\.bind\(task\)"):
            env.planning_state(TensorDict(latent=torch.zeros(3, 2), batch_size=[3]))
        with pytest.raises(ValueError, match=r"'goal' must have the batch dimensions \(3,\) in front"):
            env.planning_state(TensorDict(latent=torch.zeros(3, 2), goal=torch.zeros(2)))
        with pytest.raises(KeyError, match="state must hold the tasks"):
            env.objective(torch.zeros(3, 2, dtype=torch.float64), plans())

    def test_planners_carry_them(self) -> None:
        env = make_env(Well(std=0.1))
        planner = CEM(env, planning_horizon=1, optim_steps=10, num_candidates=256, seed=0)
        latent = torch.zeros(2, 2, dtype=torch.float64)
        wanted = torch.tensor([[0.7], [-0.4]], dtype=torch.float64)
        goal = gaussian(latent, wanted).mean
        td = planner(TensorDict(latent=latent, goal=goal, batch_size=[2]))
        torch.testing.assert_close(td["action"], wanted, atol=0.02, rtol=0)
        assert "goal" in planner.in_keys

    def test_from_a_belief(self) -> None:
        env = make_env(Well(), belief_key="belief", num_samples=4)
        particles = torch.ones(3, 10, 2, dtype=torch.float64)
        td = TensorDict(goal=torch.zeros(3, 2, dtype=torch.float64), batch_size=[3])
        td["belief"] = TensorDict(particles=particles, log_weights=particles.new_zeros(3, 10), batch_size=[3])
        actions = plans()
        plain = make_env(Well())
        same = plain.planning_state(td.clone().set("latent", particles[:, 0]))
        torch.testing.assert_close(
            env.objective(env.planning_state(td), actions), plain.objective(same, actions)
        )


class TestCosts:
    def test_energy_cost_and_reward_add_up(self) -> None:
        prior = GaussianPrior(2, mean=1.0).double()
        cost = quadratic_cost(torch.ones(2, dtype=torch.float64))
        actions, latent = plans(), torch.randn(3, 2, dtype=torch.float64)
        both = make_env(prior, cost=cost).objective(latent, actions)
        apart = make_env(prior).objective(latent, actions) + make_env(cost=cost).objective(latent, actions)
        torch.testing.assert_close(both, apart)
        summed = make_env(cost=cost + prior_cost(prior)).objective(latent, actions)
        torch.testing.assert_close(both, summed)

    def test_prior_cost_binds_a_task(self) -> None:
        goal = torch.ones(2, dtype=torch.float64)
        cost = prior_cost(Well(), goal)
        latent = torch.randn(3, 2, dtype=torch.float64)
        torch.testing.assert_close(cost(latent, latent), Well().energy(latent, goal))
        with pytest.raises(ValueError, match=r"task must be given for a prior that reads \['goal'\]"):
            prior_cost(Well())

    @pytest.mark.parametrize(
        ("kwargs", "error", "message"),
        [
            ({"prior": lambda z: z}, TypeError, "prior must be a Prior, for instance EnergyPrior"),
            (
                {"prior": GaussianPrior(3)},
                ValueError,
                "prior must be over latents of size 2",
            ),
            ({"fusion": "add"}, ValueError, "fusion must be 'energy', 'weight' or 'propose', got 'add'"),
            ({"fusion": "weight"}, ValueError, "num_samples must be at least 2 for fusion='weight'"),
            (
                {"fusion": "propose", "prior": None, "cost": action_cost()},
                ValueError,
                "fusion='propose' needs a prior, got none",
            ),
            (
                {"fusion": "weight", "how": "sample", "num_samples": 8, "risk": cvar(0.5)},
                ValueError,
                "risk must be None for fusion='weight'",
            ),
        ],
    )
    def test_bad_arguments_are_refused(
        self, kwargs: dict[str, Any], error: type[Exception], message: str
    ) -> None:
        with pytest.raises(error, match=message):
            make_env(**{"prior": GaussianPrior(2).double(), **kwargs})

    def test_a_prior_on_another_device_is_refused(self) -> None:
        with pytest.raises(ValueError, match="prior must be on the device of the model, cpu, got meta"):
            make_env(GaussianPrior(2).to("meta"), dtype=torch.float64, device="cpu")

    def test_an_energy_of_the_wrong_shape_is_refused(self) -> None:
        class Wrong(Prior):
            def forward(self, task: Task = None) -> LatentDensity:
                return Density(lambda z: z)

        with pytest.raises(ValueError, match=r"energy must return a tensor of shape \(2, 3\)"):
            make_env(Wrong())


def joint(latent: Tensor, actions: Tensor) -> MultivariateNormal:
    """Exact distribution of all H next latents, (*N, H * D), for fixed actions (*N, H, 1)."""
    horizon = actions.shape[-2]
    mean, blocks, loc = [], [], latent.expand(*actions.shape[:-2], 2)
    for k in range(horizon):
        loc = gaussian(loc, actions[..., k, :]).mean
        mean.append(loc)
        blocks.append([torch.linalg.matrix_power(A_MATRIX, k - j) if j <= k else torch.zeros_like(A_MATRIX)
                       for j in range(horizon)])  # fmt: skip
    noise = torch.cat([torch.cat(row, dim=1) for row in blocks])
    return MultivariateNormal(torch.cat(mean, dim=-1), STD**2 * noise @ noise.mT)


def exact_free_energy(latent: Tensor, actions: Tensor, goal: Tensor, std: float) -> Tensor:
    """-log E[prod_k N(Z_k; goal, std^2)]: the goals are a noisy measurement of all latents."""
    p = joint(latent, actions)
    horizon = actions.shape[-2]
    covariance = p.covariance_matrix + std**2 * torch.eye(2 * horizon, dtype=torch.float64)
    return -MultivariateNormal(p.mean, covariance).log_prob(goal.repeat(horizon))


class TestPosterior:
    goal = torch.tensor([0.6, -0.3], dtype=torch.float64)
    latent = torch.tensor([0.2, 0.4], dtype=torch.float64)

    @pytest.mark.parametrize("fusion", ["weight", "propose"])
    @pytest.mark.parametrize("prior", [Well(), EnergyWell()], ids=["closed form", "importance"])
    def test_both_routes_give_the_exact_free_energy(self, prior: Prior, fusion: Any) -> None:
        env = make_env(prior.bind(self.goal))
        actions = plans((), num=6, horizon=3)
        generator = torch.Generator().manual_seed(0)
        num = 4000
        values = torch.stack(
            [
                env.objective(self.latent, actions, generator=generator, num_samples=num, fusion=fusion)
                for _ in range(8)
            ]
        )
        exact = exact_free_energy(self.latent, actions, self.goal, 0.5)
        error = values.std(0) / len(values) ** 0.5
        # The logarithm of a mean is biased by about half its relative variance.
        bias = 0.5 * values.var(0)
        assert ((values.mean(0) - exact).abs() < 4 * error + bias + 1e-3).all(), (values.mean(0), exact)

    def test_proposing_has_less_variance_than_weighing(self) -> None:
        env = make_env(Well(std=0.1).bind(self.goal))
        actions = plans((), num=4, horizon=3)
        spread = {}
        for fusion in ("weight", "propose"):
            generator = torch.Generator().manual_seed(0)
            draws = [
                env.objective(self.latent, actions, generator=generator, num_samples=200, fusion=fusion)
                for _ in range(30)
            ]
            spread[fusion] = torch.stack(draws).std(0)
        assert (spread["propose"] < 0.5 * spread["weight"]).all(), spread

    @pytest.mark.parametrize("fusion", ["weight", "propose"])
    def test_mppi_with_unit_temperature_is_the_posterior_of_the_plan(self, fusion: Any) -> None:
        """Closed form: a Gaussian prior over plans, linear dynamics, Gaussian experts."""
        spec = Unbounded((1,), dtype=torch.float64)
        env = make_env(Well().bind(self.goal), action_spec=spec)
        horizon, init_std = 2, 0.8
        planner = MPPI(
            env, horizon, 1, 20_000, 20_000, temperature=1.0, normalize_costs=False, init_std=init_std,
            warm_start=False, num_samples=64, fusion=fusion, seed=0,
        )  # fmt: skip
        plan = planner.plan(self.latent, planner.family.cold((), planner.num_decisions))
        zero = torch.zeros(horizon, 1, dtype=torch.float64)
        base = joint(self.latent, zero)
        columns = [joint(self.latent, zero.index_fill(0, torch.tensor([k]), 1.0)).mean - base.mean
                   for k in range(horizon)]  # fmt: skip
        gain = torch.stack(columns, dim=-1)  # d mean / d plan
        noise = base.covariance_matrix + 0.5**2 * torch.eye(2 * horizon, dtype=torch.float64)
        precision = gain.mT @ torch.linalg.solve(noise, gain) + torch.eye(horizon) / init_std**2
        wanted = gain.mT @ torch.linalg.solve(noise, self.goal.repeat(horizon) - base.mean)
        exact = torch.linalg.solve(precision, wanted)
        torch.testing.assert_close(plan.actions.squeeze(-1), exact, atol=0.03, rtol=0)

    @pytest.mark.parametrize("fusion", ["weight", "propose"])
    def test_cem_finds_the_most_probable_plan(self, fusion: Any) -> None:
        env = make_env(Well().bind(self.goal))
        planner = CEM(env, 2, 12, 256, 32, num_samples=128, fusion=fusion, min_std=1e-3, seed=0)
        plan = planner.plan(self.latent, planner.family.cold((), planner.num_decisions))
        actions = plan.actions.clone().requires_grad_()

        # The gradient of the exact objective vanishes where it is least; a Newton step says how far that is.
        def exact(flat: Tensor) -> Tensor:
            return exact_free_energy(self.latent, flat.reshape(2, 1), self.goal, 0.5)

        flat = actions.detach().flatten()
        gradient = torch.autograd.functional.jacobian(exact, flat)
        hessian = torch.autograd.functional.hessian(exact, flat)
        assert torch.linalg.solve(hessian, gradient).abs().max() < 0.08

    def test_the_same_noise_for_every_row_and_round(self) -> None:
        env = make_env(Well())
        state = state_of(env, goal=torch.zeros(3, 2, dtype=torch.float64))
        actions = plans()
        for fusion in ("weight", "propose"):
            kwargs = {"num_samples": 5, "fusion": fusion}
            generator = torch.Generator().manual_seed(1)
            together = env.objective(state, actions, generator=generator, **kwargs)
            for row in range(3):
                generator = torch.Generator().manual_seed(1)
                alone = env.objective(state[row], actions[row], generator=generator, **kwargs)
                torch.testing.assert_close(alone, together[row])

    def test_global_random_state_is_not_touched(self) -> None:
        env = make_env(EnergyWell().bind(self.goal))
        planner = RandomShooting(env, 2, 1, 16, num_samples=4, fusion="propose", seed=0)
        before = torch.get_rng_state()
        planner(TensorDict(latent=self.latent))
        assert torch.equal(before, torch.get_rng_state())


def test_free_energy_is_entropic_with_an_aversion_of_minus_one() -> None:
    costs = torch.randn(50, 3, dtype=torch.float64)
    torch.testing.assert_close(free_energy(costs), -entropic(1.0)(-costs))
    assert (free_energy(costs) < costs.mean(0)).all()
    torch.testing.assert_close(free_energy(costs + 1e4), free_energy(costs) + 1e4)


class TestNothingIsIgnored:
    """What would give a wrong plan without a word."""

    def test_a_fused_predictor_is_the_transition_itself(self) -> None:
        fused = FusedPredictor(Predictor(2, action_dim=1), GaussianPrior(2, mean=5.0, std=1e-3))
        env = LatentEnv(fused, action_spec=Bounded(-2, 2, (1,)), cost=quadratic_cost(torch.full((2,), 5.0)))
        assert env.objective(torch.zeros(2), torch.zeros(1, 1, 1)) < 1e-3
        filter = ParticleFilter(fused, PseudoLikelihood(lambda x: diag_gaussian(x, torch.ones(1))))
        assert filter.transition == fused.dist

    def test_constraints_look_at_the_dynamics_and_not_at_the_fused_trajectories(self) -> None:
        """The prior pulls its trajectories out of what half of the real ones run into."""
        wall = RegionPrior(HalfSpace(torch.tensor([1.0, 0.0]), 0.0), "in", sharpness=50.0).double()
        env = make_env(wall, how="sample", num_samples=400)
        constraint = ChanceConstraint(wall.violated, delta=0.1)
        state, actions = torch.zeros(2, dtype=torch.float64), torch.zeros(1, 1, 1, dtype=torch.float64)
        for fusion in ("energy", "weight", "propose"):
            generator = torch.Generator().manual_seed(0)
            cost = env.objective(state, actions, constraints=[constraint], fusion=fusion, generator=generator)
            assert (cost >= REJECTED_COST).all(), fusion

    @pytest.mark.parametrize("cost", [None, action_cost()])
    def test_both_posterior_routes_agree_where_episodes_end(self, cost: Any) -> None:
        network = torch.nn.Linear(2, 1).double()
        end = TensorDictModule(network, ["latent"], ["termination_logit"])
        with torch.no_grad():
            network.weight.fill_(2.0)
            network.bias.zero_()
        env = make_env(
            GaussianPrior(2, mean=0.5, std=0.5).double(),
            cost=cost,
            termination_model=end,
            termination_cost=0.5,
        )
        state, actions = torch.zeros(2, dtype=torch.float64), 0.3 * torch.ones(1, 3, 1, dtype=torch.float64)
        weight, propose = (
            torch.stack(
                [
                    env.objective(state, actions, num_samples=4000, fusion=fusion, generator=generator)
                    for generator in [torch.Generator().manual_seed(0)]
                    for _ in range(10)
                ]
            )
            for fusion in ("weight", "propose")
        )
        error = ((weight.var() + propose.var()) / 10).sqrt()
        assert (weight.mean() - propose.mean()).abs() < 4 * error, (weight.mean(), propose.mean(), error)

    def test_bound_goals_of_several_rows_are_refused(self) -> None:
        """With as many rows as steps they would pass for a path."""
        with pytest.raises(ValueError, match="prior without a task must be one for all latents"):
            make_env(Well().bind(torch.zeros(3, 2, dtype=torch.float64)))

    @pytest.mark.parametrize("fusion", ["energy", "weight", "propose"])
    def test_an_energy_without_gradient_is_refused_beside_a_cost_that_has_one(self, fusion: Any) -> None:
        step = EnergyPrior(lambda z: (z[..., 0] < 0.5).to(z.dtype))
        env = make_env(step, cost=action_cost())
        td = TensorDict(latent=torch.zeros(2, dtype=torch.float64))
        planner = GradientMPC(env, 2, 3, seed=0, fusion=fusion, num_samples=4)
        with pytest.raises(ValueError, match="prior must have a gradient"):
            planner(td)
        CEM(env, 2, 2, num_candidates=16, seed=0)(td)
        declared = EnergyPrior(lambda z: (z[..., 0] < 0.5).to(z.dtype), latent_dim=2, differentiable=False)
        with pytest.raises(ValueError, match="differentiable=False, got EnergyPrior"):
            GradientMPC(make_env(declared, cost=action_cost()), 2)

    def test_a_flat_prior_needs_no_gradient(self) -> None:
        env = make_env(ProductPrior(), cost=action_cost())
        GradientMPC(env, 2, 3, seed=0)(TensorDict(latent=torch.zeros(2, dtype=torch.float64)))

    def test_a_gradient_that_is_never_finite_is_told(self) -> None:
        env = make_env(EnergyPrior(lambda z: (z - 1).square().sum(-1) + (0 * z.sum(-1)).sqrt()))
        with pytest.warns(RuntimeWarning, match="no finite gradient at any plan in at least one row"):
            GradientMPC(env, 2, 3, seed=0)(TensorDict(latent=torch.zeros(2, dtype=torch.float64)))

    @pytest.mark.parametrize("route", ["closed form", "importance"])
    def test_gradients_of_the_proposing_route_are_those_of_the_free_energy(self, route: str) -> None:
        """Which particle is taken depends on the plan too: without its share they are off by a tenth."""
        goal = torch.tensor([0.6, -0.3], dtype=torch.float64)
        prior = Well() if route == "closed form" else EnergyWell()
        env = make_env(prior.bind(goal))
        latent = torch.tensor([0.2, 0.4], dtype=torch.float64)
        actions = torch.full((1, 3, 1), 0.1, dtype=torch.float64).requires_grad_()
        generator = torch.Generator().manual_seed(0)

        def gradient(value: Tensor) -> Tensor:
            return torch.autograd.grad(value.sum(), actions)[0].flatten()

        draws = torch.stack(
            [
                gradient(
                    env.objective(latent, actions, generator=generator, num_samples=1000, fusion="propose")
                )
                for _ in range(20)
            ]
        )
        exact = gradient(exact_free_energy(latent, actions, goal, 0.5))
        error = draws.std(0) / len(draws) ** 0.5
        assert ((draws.mean(0) - exact).abs() < 4 * error + 0.01).all(), (draws.mean(0), exact, error)

    def test_a_transformed_env_keeps_the_tasks(self) -> None:
        latent = torch.zeros(2, 2, dtype=torch.float64)
        goals = torch.tensor([[1.0, 0.5], [-1.0, -0.5]], dtype=torch.float64)
        path = torch.stack([goals, -goals], dim=1)
        for goal in (goals, path):
            td = TensorDict(latent=latent, goal=goal, batch_size=[2])
            plain, stepped = (
                CEM(env, 2, 3, num_candidates=32, seed=0, warm_start=False)
                for env in (make_env(Well()), TransformedEnv(make_env(Well()), RewardScaling(0.0, 1.0)))
            )
            assert "goal" in stepped.in_keys
            torch.testing.assert_close(stepped(td.clone())["action"], plain(td.clone())["action"])

    def test_the_proposing_route_reads_the_task_of_each_step(self) -> None:
        env = make_env(Well())
        path = torch.tensor([[0.5, 0.2], [-0.5, 0.4], [0.8, -0.6]], dtype=torch.float64)
        state = env.planning_state(TensorDict(latent=torch.zeros(2, dtype=torch.float64), goal=path))
        actions, generator = plans((), num=3, horizon=3), torch.Generator().manual_seed(0)
        draws = torch.stack(
            [
                env.objective(state, actions, generator=generator, num_samples=2000, fusion="propose")
                for _ in range(10)
            ]
        )
        p = joint(torch.zeros(2, dtype=torch.float64), actions)
        covariance = p.covariance_matrix + 0.5**2 * torch.eye(6, dtype=torch.float64)
        exact = -MultivariateNormal(p.mean, covariance).log_prob(path.flatten())
        assert ((draws.mean(0) - exact).abs() < 4 * draws.std(0) / 10**0.5 + 0.5 * draws.var(0) + 1e-3).all()
