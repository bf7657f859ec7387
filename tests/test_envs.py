"""LatentEnv: closed forms first, then TorchRL's contracts for environments."""

from __future__ import annotations

import copy
import inspect
import pickle
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, Independent, MixtureSameFamily
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.utils import check_env_specs
from torchrl.modules import CEMPlanner, MPPIPlanner, ValueOperator
from torchrl.objectives.value import TDLambdaEstimator

from torchrl_vjepa.costs import QuadraticReward, action_cost, quadratic_cost
from torchrl_vjepa.distributions import Delta, diag_gaussian
from torchrl_vjepa.encoders import linear_encoder
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.models import VJEPA
from torchrl_vjepa.predictor import Predictor
from torchrl_vjepa.simulation import BatchedSimulationEnv

A_MATRIX = torch.tensor([[0.9, 0.2], [-0.2, 0.9]])
B_MATRIX = torch.tensor([[1.0, 0.0], [0.5, 1.0]])


def point(latent: Tensor, action: Tensor) -> Delta:
    return Delta(latent @ A_MATRIX.mT + action @ B_MATRIX.mT)


def gaussian(latent: Tensor, action: Tensor) -> Distribution:
    loc = latent @ A_MATRIX.mT + action @ B_MATRIX.mT
    return diag_gaussian(loc, torch.full_like(loc, 0.3))


def bimodal(latent: Tensor, action: Tensor) -> Distribution:
    loc = latent + action
    parts = diag_gaussian(torch.stack([loc - 1, loc + 1], -2), torch.full((2, 2), 0.1))
    weights = Categorical(logits=torch.zeros(*loc.shape[:-1], 2))
    return MixtureSameFamily(weights, parts, validate_args=False)


def make_env(model: Any = point, **kwargs: Any) -> LatentEnv:
    if "reward_model" not in kwargs:
        kwargs.setdefault("cost", quadratic_cost(torch.ones(2)) + 0.1 * action_cost())
    kwargs.setdefault("latent_dim", 2)
    return LatentEnv(model, action_spec=kwargs.pop("action_spec", Bounded(-2, 2, (2,))), **kwargs)


def reward_module(**keys: Any) -> TensorDictModule:
    head = QuadraticReward(2, 2)
    for parameter in head.parameters():
        nn.init.normal_(parameter)
    return TensorDictModule(
        head,
        [keys.get("latent_key", "latent"), keys.get("action_key", "action")],
        [keys.get("reward_key", "reward")],
    )


class TestObjective:
    def test_equals_a_loop_over_the_definition(self) -> None:
        env = make_env()
        state, actions = torch.randn(3, 2), torch.randn(3, 4, 5, 2)
        costs = env.objective(state, actions)
        for i in range(3):
            for n in range(4):
                z, total = state[i], 0.0
                for u in actions[i, n]:
                    z = A_MATRIX @ z + B_MATRIX @ u
                    total = total + (z - 1).square().sum() + 0.1 * u.square().sum()
                torch.testing.assert_close(costs[i, n], total)

    @pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
    def test_is_minus_the_return_of_a_rollout(self, batch: tuple[int, ...]) -> None:
        for env in (make_env(), make_env(reward_model=reward_module())):
            state, actions = torch.randn(*batch, 2), torch.randn(*batch, 4, 5, 2)
            td = TensorDict(latent=state, batch_size=batch).unsqueeze(-1).expand(*batch, 4)
            total = torch.zeros(*batch, 4)
            for action in actions.unbind(-2):
                td = env.step(td.clone().set("action", action))["next"]
                total = total - td["reward"].squeeze(-1)
            torch.testing.assert_close(env.objective(state, actions), total)

    def test_mode_and_mean_differ_where_they_should(self) -> None:
        class Skewed(Independent):
            @property
            def mode(self) -> Tensor:
                return self.mean + 1

        def skewed(latent: Tensor, action: Tensor) -> Distribution:
            return Skewed(gaussian(latent, action).base_dist, 1, validate_args=False)

        zero = torch.zeros(1, 1, 2)
        cost = quadratic_cost(torch.zeros(2))
        assert make_env(skewed, cost=cost).objective(torch.zeros(2), zero) == 0
        assert make_env(skewed, cost=cost, how="mode").objective(torch.zeros(2), zero) == 2

    def test_samples_have_the_closed_form_expectation(self) -> None:
        # E|z1|^2 + E|z2|^2 with z1 = A s + B u + w1, z2 = A z1 + B u' + w2, w ~ N(0, 0.09 I).
        num = 20_000
        env = make_env(gaussian, how="sample", num_samples=num, cost=quadratic_cost(torch.zeros(2)))
        state, actions = torch.tensor([1.0, -1.0]), torch.randn(3, 2, 2)
        generator = torch.Generator().manual_seed(1)
        costs = env.objective(state, actions, generator=generator)
        first = state @ A_MATRIX.mT + actions[:, 0] @ B_MATRIX.mT
        second = first @ A_MATRIX.mT + actions[:, 1] @ B_MATRIX.mT
        spread = 0.09 * (2 + 2 + (A_MATRIX @ A_MATRIX.mT).trace())
        expected = first.square().sum(-1) + second.square().sum(-1) + spread
        # Var|m + w|^2 = 4 s^2 |m|^2 + 2 D s^4 for each step; doubled twice for their correlation.
        variance = 4 * (4 * 0.18 * (first.square() + second.square()).sum(-1) + 4 * 0.18**2)
        assert ((costs - expected).abs() < 5 * (variance / num).sqrt()).all()

    def test_random_numbers_are_common_to_candidates_and_rows(self) -> None:
        env = make_env(gaussian, how="sample", num_samples=3)
        state = torch.ones(4, 2)
        actions = torch.full((4, 6, 5, 2), 0.3)
        costs = env.objective(state, actions, generator=torch.Generator().manual_seed(0))
        assert (costs == costs[0, 0]).all()
        again = env.objective(state, actions, generator=torch.Generator().manual_seed(0))
        other = env.objective(state, actions, generator=torch.Generator().manual_seed(1))
        assert torch.equal(costs, again)
        assert not torch.equal(costs, other)
        # Samples differ from each other and between the steps.
        spread = make_env(
            gaussian, how="sample", num_samples=64, risk=_std, cost=quadratic_cost(torch.zeros(2))
        )
        assert (spread.objective(state, actions) > 0.1).all()

    def test_mixtures_share_their_random_numbers_too(self) -> None:
        env = make_env(bimodal)
        generator = torch.Generator().manual_seed(0)
        actions = torch.full((4, 6, 5, 2), 0.3)
        costs = env.objective(torch.ones(4, 2), actions, generator=generator, num_samples=3)
        assert (costs == costs[0, 0]).all()

    def test_other_distributions_are_sampled_too(self) -> None:
        env = make_env(bimodal, how="sample", num_samples=4000, cost=quadratic_cost(torch.zeros(2)))
        before = torch.get_rng_state()
        generator = torch.Generator().manual_seed(0)
        cost = env.objective(torch.zeros(2), torch.zeros(1, 1, 2), generator=generator)
        assert torch.equal(before, torch.get_rng_state())
        assert abs(float(cost) - 2.02) < 5 * 0.4 / 4000**0.5

    def test_risk_functional_is_applied_to_trajectory_costs(self) -> None:
        env = make_env(gaussian, how="sample", num_samples=500, risk=_worst)
        mean = make_env(gaussian, how="sample", num_samples=500)
        state, actions = torch.zeros(3, 2), torch.randn(3, 4, 2, 2)
        worst = env.objective(state, actions, generator=torch.Generator().manual_seed(0))
        assert worst.shape == (3, 4)
        average = mean.objective(state, actions, generator=torch.Generator().manual_seed(0))
        assert (worst > average).all()
        bad = make_env(gaussian, how="sample", num_samples=5, risk=_identity)
        with pytest.raises(ValueError, match=r"risk must return a tensor of shape \(3, 4\)"):
            bad.objective(state, actions)

    def test_gradient_reaches_the_actions(self) -> None:
        env = make_env()
        actions = torch.randn(4, 3, 2, dtype=torch.float64, requires_grad=True)
        global A_MATRIX, B_MATRIX
        matrices = A_MATRIX, B_MATRIX
        A_MATRIX, B_MATRIX = A_MATRIX.double(), B_MATRIX.double()
        try:
            assert torch.autograd.gradcheck(
                lambda u: env.objective(torch.ones(2, dtype=torch.float64), u), actions
            )
        finally:
            A_MATRIX, B_MATRIX = matrices

    def test_wrong_shapes_are_refused(self) -> None:
        env = make_env()
        for state, actions in (
            (torch.zeros(3), torch.zeros(4, 5, 2)),
            (torch.zeros(2), torch.zeros(4, 5, 3)),
            (torch.zeros(6, 2), torch.zeros(4, 5, 2)),
        ):
            with pytest.raises(ValueError, match=r"state and actions must have shapes \(\*B, 2\)"):
                env.objective(state, actions)


def _worst(costs: Tensor) -> Tensor:
    return costs.amax(0)


def _std(costs: Tensor) -> Tensor:
    return costs.std(0)


def _identity(costs: Tensor) -> Tensor:
    return costs


class TestReward:
    def test_network_and_tensordict_path_agree(self) -> None:
        module = reward_module()
        plain = make_env(reward_model=module)
        general = make_env(reward_model=TensorDictSequential(module))
        assert plain.world_model.reward_calls_tensors
        assert not general.world_model.reward_calls_tensors
        state, actions = torch.randn(3, 2), torch.randn(3, 4, 5, 2)
        torch.testing.assert_close(plain.objective(state, actions), general.objective(state, actions))

    def test_order_of_in_keys_is_kept(self) -> None:
        head = reward_module().module
        swapped = TensorDictModule(_Swapped(head), ["action", "latent"], ["reward"])
        straight = TensorDictModule(head, ["latent", "action"], ["reward"])
        state, actions = torch.randn(2), torch.randn(4, 5, 2)
        torch.testing.assert_close(
            make_env(reward_model=swapped).objective(state, actions),
            make_env(reward_model=straight).objective(state, actions),
        )

    def test_keyword_inputs_fall_back_to_the_tensordict(self) -> None:
        module = TensorDictModule(
            reward_module().module, {"latent": "latent", "action": "action"}, ["reward"]
        )
        env = make_env(reward_model=module)
        assert env.objective(torch.zeros(2), torch.zeros(4, 5, 2)).shape == (4,)

    def test_a_network_that_says_something_else_is_called_by_its_tensordict(self) -> None:
        env = make_env(reward_model=TensorDictModule(_Counter(), ["latent"], ["reward"]))
        assert not env.world_model.reward_calls_tensors

    def test_reward_of_the_latent_alone(self) -> None:
        env = make_env(reward_model=TensorDictModule(nn.Linear(2, 1), ["latent"], ["reward"]))
        assert env.world_model.reward_calls_tensors
        assert env.rollout(3)["next", "reward"].shape == (3, 1)

    def test_probe_leaves_module_and_random_state_alone(self) -> None:
        norm = nn.Sequential(nn.Flatten(0, 1), nn.BatchNorm1d(2), nn.Unflatten(0, (2, 3)))
        model = nn.Sequential(norm, nn.Dropout(0.5), nn.Linear(2, 1))
        model[2].eval()
        before = torch.get_rng_state()
        make_env(reward_model=TensorDictModule(model, ["latent"], ["reward"]))
        assert torch.equal(before, torch.get_rng_state())
        assert norm[1].num_batches_tracked == 0
        assert model.training
        assert norm[1].training
        assert not model[2].training

    @pytest.mark.parametrize("out_features", [2, 3])
    def test_wrong_shape_is_refused_at_construction(self, out_features: int) -> None:
        module = TensorDictModule(nn.Linear(2, out_features), ["latent"], ["reward"])
        for model in (module, TensorDictSequential(module)):
            with pytest.raises(
                ValueError,
                match=rf"reward_model must return .* \(2, 3, 1\) .* got \(2, 3, {out_features}\)",
            ):
                make_env(reward_model=model)

    def test_cost_of_wrong_shape_is_refused_at_construction(self) -> None:
        with pytest.raises(ValueError, match=r"cost must return .* \(2, 3\) .* got \(2, 3, 2\)"):
            make_env(cost=_no_reduction)

    def test_wrong_keys_are_refused(self) -> None:
        with pytest.raises(KeyError, match=r"must read only latent_key='latent'"):
            make_env(reward_model=reward_module(latent_key="z"))
        with pytest.raises(KeyError, match=r"reward_model must write 'reward'"):
            make_env(reward_model=reward_module(reward_key="r"))


class _Counter(nn.Module):
    """Another answer at every call."""

    calls = 0

    def forward(self, latent: Tensor) -> Tensor:
        self.calls += 1
        return torch.full_like(latent[..., :1], self.calls)


class _Swapped(nn.Module):
    def __init__(self, head: nn.Module) -> None:
        super().__init__()
        self.head = head

    def forward(self, action: Tensor, latent: Tensor) -> Tensor:
        return self.head(latent, action)


def _no_reduction(latent: Tensor, action: Tensor) -> Tensor:
    return latent - action


class TestEnvironment:
    @pytest.mark.parametrize("how", ["mean", "mode", "sample"])
    def test_specs(self, how: str) -> None:
        check_env_specs(make_env(gaussian, how=how))
        check_env_specs(make_env(reward_model=reward_module(), how=how))

    def test_nested_keys_and_matrix_actions(self) -> None:
        keys = {
            "latent_key": ("agent", "z"),
            "action_key": ("agent", "control"),
            "reward_key": ("agent", "r"),
        }
        spec = Bounded(-2, 2, (2, 1))
        env = make_env(action_spec=spec, **keys)
        check_env_specs(env)
        td = env.rollout(4)
        assert td["agent", "control"].shape == (4, 2, 1)
        assert td["next", "agent", "r"].shape == (4, 1)
        torch.testing.assert_close(
            td["next", "agent", "z"], point(td["agent", "z"], td["agent", "control"][..., 0]).mean
        )

    @pytest.mark.parametrize("shape", [(), (1,), (2, 1)])
    def test_reward_model_sees_actions_in_the_shape_of_their_spec(self, shape: tuple[int, ...]) -> None:
        module = TensorDictModule(_ShapeOf(shape), ["latent", "action"], ["reward"])
        env = make_env(_still, action_spec=Bounded(-1, 1, shape), reward_model=module)
        size = 2 if shape == (2, 1) else 1
        env.objective(torch.zeros(3, 2), torch.zeros(3, 4, 5, size))
        assert env.rollout(2).batch_size == (2,)

    def test_any_batch_size_rolls_out(self) -> None:
        env = make_env()
        td = env.reset(TensorDict(latent=torch.randn(3, 4, 2), batch_size=[3, 4]))
        out = env.rollout(5, tensordict=td, auto_reset=False)
        assert out.batch_size == (3, 4, 5)
        torch.testing.assert_close(out["next", "latent"], point(out["latent"], out["action"]).mean)

    def test_reset_keeps_a_given_latent_and_draws_a_missing_one(self) -> None:
        env = make_env()
        latent = torch.randn(3, 2)
        td = env.reset(TensorDict(latent=latent, pixels=torch.zeros(3, 9), batch_size=3))
        assert torch.equal(td["latent"], latent)
        assert env.reset(TensorDict(batch_size=3))["latent"].shape == (3, 2)

    def test_stale_done_and_reward_do_not_pass_through(self) -> None:
        env = make_env()
        td = TensorDict(
            latent=torch.ones(3, 2),
            action=torch.zeros(3, 2),
            done=torch.ones(3, 1, dtype=torch.bool),
            terminated=torch.ones(3, 1, dtype=torch.bool),
            reward=torch.full((3, 1), 99.0),
            batch_size=3,
        )
        out = env.step(td)["next"]
        assert not out["done"].any()
        assert not out["terminated"].any()
        assert (out["reward"] < 0).all()

    def test_done_in_the_input_does_not_trigger_a_reset(self) -> None:
        env = make_env()
        td = TensorDict(latent=torch.ones(3, 2), done=torch.ones(3, 1, dtype=torch.bool), batch_size=3)
        out = env.rollout(2, tensordict=td, auto_reset=False, break_when_any_done=False)
        assert torch.equal(out["latent"][:, 0], torch.ones(3, 2))
        assert env.maybe_reset(td) is td
        assert not env.any_done(td)

    def test_seed_makes_sampled_steps_reproducible(self) -> None:
        env = make_env(gaussian, how="sample")
        td = TensorDict(latent=torch.zeros(5, 2), action=torch.zeros(5, 2), batch_size=5)
        draws = []
        for _ in range(2):
            env.set_seed(7)
            draws.append(env.step(td.clone())["next", "latent"])
        assert torch.equal(*draws)
        assert not torch.equal(draws[0][0], draws[0][1])
        assert not torch.equal(draws[0], env.step(td.clone())["next", "latent"])

    @pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
    def test_copies_continue_the_same_random_numbers(self, duplicate: Any) -> None:
        env = make_env(gaussian, how="sample")
        td = TensorDict(latent=torch.zeros(5, 2), action=torch.zeros(5, 2), batch_size=5)
        env.set_seed(7)
        env.step(td.clone())
        other = duplicate(env)
        one, two = (e.step(td.clone())["next", "latent"] for e in (env, other))
        assert torch.equal(one, two)

    def test_pickle_and_deepcopy_keep_the_model_together(self) -> None:
        predictor = Predictor(2, 2)
        env = LatentEnv(predictor, action_spec=Bounded(-1, 1, (2,)), cost=quadratic_cost(torch.zeros(2)))
        state, actions = torch.randn(2), torch.randn(4, 5, 2)
        for other in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):
            torch.testing.assert_close(other.objective(state, actions), env.objective(state, actions))
            with torch.no_grad():  # the copy's transition uses the copy's parameters
                for parameter in other.world_model.parameters():
                    parameter.zero_()
            assert not torch.equal(other.objective(state, actions), env.objective(state, actions))

    def test_reads_keys_sizes_and_dtype_from_a_model(self) -> None:
        predictor = Predictor(4, 2, latent_key="z", action_key=("agent", "u")).double()
        model = VJEPA(linear_encoder(6, 4, out_key="z").double(), predictor)
        env = LatentEnv(model, action_spec=Unbounded((2,)), cost=quadratic_cost(torch.zeros(4).double()))
        check_env_specs(env)
        assert env.observation_spec["z"].dtype == torch.float64
        td = env.rollout(3)
        expected = predictor.dist(td["z"], td["agent", "u"].double()).mean
        torch.testing.assert_close(td["next", "z"], expected)
        # What training changes is what the environment imagines with.
        torch.nn.init.zeros_(predictor.trunks[0].weight)
        assert not env.rollout(3)["next", "z"].any()

    @pytest.mark.parametrize(
        ("kwargs", "error", "message"),
        [
            (
                {"cost": None},
                ValueError,
                "at least one of reward_model, cost and prior must be given, got none",
            ),
            ({"how": "median"}, ValueError, "how must be 'mean', 'mode' or 'sample'"),
            ({"num_samples": 0}, ValueError, "num_samples must be at least 1"),
            ({"num_samples": 3}, ValueError, "1 unless how='sample', got 3"),
            ({"latent_dim": None}, ValueError, "latent_dim must be a positive integer, got None"),
            ({"latent_dim": 0}, ValueError, "latent_dim must be a positive integer, got 0"),
            ({"model": 3}, TypeError, "model must have a predictor"),
            ({"model": torch.add}, TypeError, "must return a torch Distribution .* got Tensor"),
            ({"model": lambda z, a: Delta(z[0])}, ValueError, r"batch shape \(2, 3\)"),
            ({"model": lambda z, a: Delta(z[..., :1])}, ValueError, r"event shape \(2,\)"),
            ({"model": Predictor(2, 3)}, ValueError, r"action_dim=3 numbers, got shape \(2,\)"),
            ({"action_spec": Composite()}, TypeError, "got an empty Composite"),
        ],
    )
    def test_bad_arguments_are_refused(
        self, kwargs: dict[str, Any], error: type[Exception], message: str
    ) -> None:
        with pytest.raises(error, match=message):
            make_env(kwargs.pop("model", point), **kwargs)

    def test_reward_and_cost_add_up(self) -> None:
        reward, cost = reward_module(), quadratic_cost(torch.zeros(2))
        state, actions = torch.randn(3, 2), torch.randn(3, 5, 4, 2)
        both = make_env(reward_model=reward, cost=cost).objective(state, actions)
        apart = make_env(reward_model=reward).objective(state, actions)
        apart = apart + make_env(cost=cost).objective(state, actions)
        torch.testing.assert_close(both, apart)

    def test_missing_or_wrong_latent_is_named(self) -> None:
        env = make_env()
        with pytest.raises(KeyError, match=r"needs the entries \['latent'\], got .*'pixels'"):
            env.planning_state(TensorDict(pixels=torch.zeros(3)))
        with pytest.raises(ValueError, match=r"shape \(\*B, 2\), got \(3,\)"):
            env.planning_state(TensorDict(latent=torch.zeros(3)))


class _ShapeOf(nn.Module):
    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.shape = shape

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        if tuple(action.shape) != (*latent.shape[:-1], *self.shape):
            raise ValueError(f"action has shape {tuple(action.shape)}")
        return latent[..., :1]


def _still(latent: Tensor, action: Tensor) -> Delta:
    return Delta(latent)


class TestTorchRLPlanners:
    def test_cem_and_mppi_plan_over_it(self) -> None:
        # One step from the origin to the target 1: u = B^{-1} 1 = (1, 0.5), inside N(0, 1).
        env = make_env(cost=quadratic_cost(torch.ones(2)), reward_key="reward")
        td = TensorDict(latent=torch.zeros(3, 2), batch_size=3)
        expected = torch.tensor([1.0, 0.5]).expand(3, 2)
        cem = CEMPlanner(env, planning_horizon=1, optim_steps=8, num_candidates=200, top_k=20)
        torch.testing.assert_close(cem(td.clone())["action"], expected, atol=0.05, rtol=0)
        value = ValueOperator(nn.Linear(2, 1), in_keys=["latent"])
        for parameter in value.parameters():
            nn.init.zeros_(parameter)
        mppi = MPPIPlanner(
            env,
            TDLambdaEstimator(gamma=1.0, lmbda=1.0, value_network=value),
            temperature=20.0,
            planning_horizon=1,
            optim_steps=8,
            num_candidates=200,
            top_k=20,
        )
        torch.testing.assert_close(mppi(td.clone())["action"], expected, atol=0.05, rtol=0)


def test_a_reward_network_without_keys_is_refused() -> None:
    with pytest.raises(TypeError, match="reward_model must be a TensorDictModule.*got QuadraticReward"):
        make_env(reward_model=QuadraticReward(2, 2))


def test_editors_see_the_arguments() -> None:
    class Other(LatentEnv):
        def __init__(self, size: int) -> None: ...

    own = inspect.signature(LatentEnv)
    assert "self" not in own.parameters
    assert list(own.parameters) == list(inspect.signature(LatentEnv.__init__).parameters)[1:]
    assert own.parameters["model"].kind is inspect.Parameter.POSITIONAL_OR_KEYWORD
    assert own.parameters["action_spec"].kind is inspect.Parameter.KEYWORD_ONLY
    assert list(inspect.signature(Other).parameters) == ["size"]
    assert "num_envs" in inspect.signature(BatchedSimulationEnv).parameters
    assert not hasattr(make_env(cost=quadratic_cost(torch.ones(2))), "__signature__")
