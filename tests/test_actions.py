"""The action code: round trips over every kind of action, and what plans, models and losses make of it."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from specs import EVERY, code_size, specs
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    MultiOneHot,
    NonTensor,
    OneHot,
    TensorSpec,
    Unbounded,
)
from torchrl.envs import EnvBase, GymEnv, PendulumEnv
from torchrl.envs.model_based import ModelBasedEnvBase
from torchrl.envs.utils import check_env_specs
from torchrl.objectives import SoftUpdate

from torchrl_vjepa.actions import ActionCodec, ActionEncoder
from torchrl_vjepa.baselines import PixelAR, PixelARLoss, PixelDecoder
from torchrl_vjepa.costs import QuadraticReward, quadratic_cost
from torchrl_vjepa.distributions import Delta
from torchrl_vjepa.encoders import linear_encoder
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.models import VJEPA
from torchrl_vjepa.objectives import RewardLoss, VJEPALoss
from torchrl_vjepa.planners import (
    CEM,
    MPPI,
    EnvObjective,
    GradientMPC,
    Planner,
    Proposal,
    ProposalFamily,
    RandomShooting,
)
from torchrl_vjepa.predictor import Predictor
from torchrl_vjepa.windows import code_of_windows

PLANNERS = [RandomShooting, CEM, MPPI]


def still(latent: Tensor, action: Tensor) -> Delta:
    return Delta(latent + 0.0 * action.sum(-1, keepdim=True))


class Weighted:
    """Cost of a step: minus the inner product of the code with weights, which the latent may flip."""

    def __init__(self, weights: Tensor) -> None:
        self.weights = weights

    def __call__(self, latent: Tensor, action: Tensor) -> Tensor:
        return -(action.to(self.weights.dtype) @ self.weights) * latent[..., 0].sign()


def make_env(spec: TensorSpec, cost: Any = None, **kwargs: Any) -> LatentEnv:
    codec = ActionCodec(spec)
    if cost is None:
        cost = Weighted(torch.linspace(-1.0, 2.0, codec.size))
    return LatentEnv(still, action_spec=spec, cost=cost, latent_dim=1, **kwargs)


class TestCodec:
    @pytest.mark.parametrize("name", EVERY)
    @pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
    def test_round_trip(self, name: str, batch: tuple[int, ...]) -> None:
        spec = EVERY[name]
        codec = ActionCodec(spec)
        full = spec if isinstance(spec, Composite) else Composite(action=spec)
        actions = torch.stack([full.rand() for _ in range(math.prod(batch))]).reshape(batch)
        code = codec.encode(actions)
        assert code.shape == (*batch, code_size(spec))
        assert code.is_floating_point()
        back = codec.decode(code)
        assert back.batch_size == torch.Size(batch)
        for key in full.keys(True, True):
            assert back[key].dtype == full[key].dtype
            assert torch.equal(back[key], actions[key])
        assert torch.equal(codec.mode(code), code)

    @settings(max_examples=60)
    @given(specs(), st.data())
    def test_whatever_is_decoded_lies_inside(self, spec: TensorSpec, data: Any) -> None:
        codec = ActionCodec(spec)
        full = spec if isinstance(spec, Composite) else Composite(action=spec)
        scale = data.draw(st.sampled_from([0.0, 1.0, 1e6]))
        generator = torch.Generator().manual_seed(data.draw(st.integers(0, 99)))
        code = scale * torch.randn(3, codec.size, generator=generator, dtype=codec.dtype)
        decoded = codec.decode(code)
        for row in decoded:
            assert full.is_in(row)
        again = codec.encode(decoded)
        inside = codec.mode(code).clamp(codec.low, codec.high)
        torch.testing.assert_close(again.to(inside.dtype), inside)

    @given(specs())
    def test_size_and_keys(self, spec: TensorSpec) -> None:
        codec = ActionCodec(spec)
        assert codec.size == code_size(spec)
        keys = [*spec.keys(True, True)] if isinstance(spec, Composite) else ["action"]
        assert codec.keys == keys

    def test_a_single_action_needs_no_tensordict(self) -> None:
        codec = ActionCodec(Categorical(3))
        assert torch.equal(codec.encode(torch.tensor([2, 0])), torch.eye(3)[[2, 0]])
        with pytest.raises(TypeError, match=r"tensordict with the keys \['a', 'b'\]"):
            ActionCodec(EVERY["two_numbers"]).encode(torch.zeros(3))
        with pytest.raises(TypeError, match="missing 'b'"):
            ActionCodec(EVERY["two_numbers"]).encode(TensorDict(a=torch.zeros(2)))

    def test_wrong_shapes_are_named(self) -> None:
        codec = ActionCodec(OneHot(3))
        with pytest.raises(ValueError, match=r"'action' must have shape \(3,\), got \(4,\)"):
            codec.encode(TensorDict(action=torch.zeros(4)))
        with pytest.raises(ValueError, match=r"code must have shape \(\*B, 3\), got \(2,\)"):
            codec.decode(torch.zeros(2))

    @pytest.mark.parametrize("spec", [NonTensor(()), Unbounded((2,), dtype=torch.int64)])
    def test_what_has_no_code_is_named(self, spec: TensorSpec) -> None:
        with pytest.raises(TypeError, match="got (NonTensor|Unbounded.*) of .* under 'action'"):
            ActionCodec(spec)

    def test_too_many_integers_are_refused(self) -> None:
        with pytest.raises(ValueError, match="must have 1 to 1024 choices"):
            ActionCodec(Bounded(0, 5000, (1,), dtype=torch.int64))

    def test_a_mask_that_forbids_all_is_refused(self) -> None:
        with pytest.raises(ValueError, match="must leave at least one choice"):
            ActionCodec(Categorical(2, mask=torch.tensor([False, False])))

    def test_masks_hold_in_every_row_of_blocks(self) -> None:
        mask = torch.tensor([[True, False, True], [False, True, False]])
        for spec in (Categorical(3, (2,), mask=mask), OneHot(3, shape=(2, 3), mask=mask)):
            codec = ActionCodec(spec)
            assert torch.equal(codec.allowed, mask.flatten())
            code = torch.tensor([0.0, 9.0, 1.0, 9.0, 0.0, 0.0])
            assert codec.most_probable(code).tolist() == [2, 1]


def cold(planner: Planner, *batch: int) -> Proposal:
    return planner.family.cold(batch, planner.planning_horizon)


class TestProposals:
    @pytest.mark.parametrize("name", EVERY)
    def test_draws_are_exact_codes_inside_the_specification(self, name: str) -> None:
        codec = ActionCodec(EVERY[name])
        family = ProposalFamily(codec, 1.0 if name == "unbounded" else None)
        proposal = family.confinement(0.01)(Proposal(*(x.clone() for x in family.cold((2,), 3))))
        torch.testing.assert_close(tuple(proposal), tuple(family.cold((2,), 3)))
        generator = torch.Generator().manual_seed(0)
        noise = 3 * torch.randn(50, 3, family.noise_dim, generator=generator, dtype=codec.dtype)
        plans = family.draw(proposal, noise)
        assert plans.shape == (2, 50, 3, codec.size)
        assert torch.equal(codec.mode(plans), plans)
        torch.testing.assert_close(codec.encode(codec.decode(plans)).to(plans.dtype), plans)

    def test_frequencies_are_the_probabilities(self) -> None:
        spec = Composite(a=Categorical(4, mask=torch.tensor([True, True, False, True])), b=Binary(2))
        codec = ActionCodec(spec)
        family = ProposalFamily(codec)
        mean = torch.tensor([[0.2, 0.5, 0.0, 0.3, 0.1, 0.8]])
        proposal = family.confinement(1e-3)(Proposal(mean, mean))
        torch.testing.assert_close(proposal.mean, mean, atol=1e-3, rtol=0)
        torch.testing.assert_close(proposal.std, (mean * (1 - mean)).sqrt(), atol=2e-3, rtol=0)
        num = 40_000
        noise = torch.randn(num, 1, family.noise_dim, generator=torch.Generator().manual_seed(0))
        frequency = family.draw(proposal, noise).mean(0)
        error = (frequency - proposal.mean).abs() / (proposal.std / num**0.5).clamp_min(1e-6)
        assert error.max() < 4
        assert frequency[0, 2] == 0  # forbidden

    def test_extreme_noise_never_draws_what_has_no_probability(self) -> None:
        codec = ActionCodec(Categorical(3, mask=torch.tensor([False, True, False])))
        family = ProposalFamily(codec)
        noise = torch.tensor([-40.0, -5.0, 0.0, 5.0, 40.0]).reshape(5, 1, 1)
        assert (codec.most_probable(family.draw(family.cold((), 1), noise)) == 1).all()

    @given(
        weights=st.lists(st.floats(0, 1), min_size=4, max_size=4),
        floor=st.floats(1e-3, 0.9),
    )
    def test_the_floor_holds_and_is_reached_once(self, weights: list[float], floor: float) -> None:
        family = ProposalFamily(ActionCodec(Composite(a=Categorical(4), b=Binary(4))))
        family.double()
        mean = torch.tensor([weights * 2], dtype=torch.float64)
        once = family.confinement(floor)(Proposal(mean, mean))
        choices, bits = once.mean[0, :4], once.mean[0, 4:]
        torch.testing.assert_close(choices.sum(), torch.ones((), dtype=torch.float64))
        assert (choices >= floor / 4 - 1e-12).all()
        assert (bits >= floor / 2).all()
        assert (bits <= 1 - floor / 2).all()
        twice = family.confinement(floor)(once)
        torch.testing.assert_close(twice.mean, once.mean)

    def test_a_warm_start_mixes_the_plan_with_the_uniform(self) -> None:
        family = ProposalFamily(ActionCodec(Composite(a=Categorical(4), b=Binary(1), c=Bounded(-1, 1, (1,)))))
        plan = torch.tensor([[0.0, 1.0, 0.0, 0.0, 1.0, 0.7]])
        proposal = family.around(plan, 0.2)
        expected = torch.tensor([[0.05, 0.85, 0.05, 0.05, 0.9, 0.7]])
        torch.testing.assert_close(proposal.mean, expected)
        torch.testing.assert_close(proposal.std[0, 5], torch.tensor(0.2 * 0.5))


DISCRETE = [name for name in EVERY if not ActionCodec(EVERY[name]).is_continuous]


class TestPlanning:
    @pytest.mark.parametrize("cls", PLANNERS)
    @pytest.mark.parametrize("name", EVERY)
    @pytest.mark.parametrize("batch", [(), (2,), (2, 1)])
    def test_every_specification(self, cls: type[Planner], name: str, batch: tuple[int, ...]) -> None:
        spec = EVERY[name]
        kwargs = {"init_std": 1.0} if name == "unbounded" else {}
        planner = cls(make_env(spec), 3, 3, num_candidates=32, seed=0, return_stats=True, **kwargs)
        td = TensorDict(latent=torch.ones(*batch, 1), batch_size=batch)
        full = spec if isinstance(spec, Composite) else Composite(action=spec)
        for _ in range(2):
            out = planner(td.clone())
            for key in full.keys(True, True):
                assert out[key].shape == (*batch, *full[key].shape)
                assert out[key].dtype == full[key].dtype
            for row in out.select(*full.keys(True, True)).reshape(-1):
                assert full.is_in(row)
            code = out["plan_stats", "actions"]
            if not planner.codec.is_identity:
                assert torch.equal(planner.codec.mode(code), code)
            assert out["next", "plan"].shape == (*batch, 3, *planner.codec.shape)
            td["plan"] = out["next", "plan"]
        state = planner.make_tensordict_primer()
        assert state.primers["plan"].shape == (3, *planner.codec.shape)

    @pytest.mark.parametrize("cls", PLANNERS)
    @pytest.mark.parametrize("name", DISCRETE)
    def test_separable_costs_are_solved_exactly(self, cls: type[Planner], name: str) -> None:
        spec = EVERY[name]
        codec = ActionCodec(spec)
        weights = torch.randn(codec.size, generator=torch.Generator().manual_seed(1))
        planner = cls(make_env(spec, Weighted(weights)), 1, 12, 512, 32, seed=0)
        td = TensorDict(latent=torch.tensor([[1.0], [-1.0]]), batch_size=2)
        out = planner(td)
        code = codec.encode(out)
        discrete = codec.is_choice | codec.is_bit
        for row, sign in zip(code, (1, -1), strict=True):
            best = codec.most_probable(sign * weights)
            assert torch.equal(codec.most_probable(row), best)
            bits = (sign * weights > 0).to(row.dtype)
            assert torch.equal(row[codec.is_bit], bits[codec.is_bit])
        assert ((code == 0) | (code == 1))[:, discrete].all()

    @pytest.mark.parametrize("cls", PLANNERS)
    @pytest.mark.parametrize("output", ["mean", "best"])
    def test_the_plan_is_the_best_of_all_sequences(self, cls: type[Planner], output: str) -> None:
        """Dependent steps: the cost of a walk on a circle, against all 3^5 plans."""
        generator = torch.Generator().manual_seed(3)
        ground = torch.rand(12, generator=generator)

        def walk(latent: Tensor, action: Tensor) -> Delta:
            return Delta((latent + action @ torch.tensor([[-1.0], [0.0], [2.0]])) % 12)

        def cost(latent: Tensor, action: Tensor) -> Tensor:
            return ground[latent[..., 0].long()]

        env = LatentEnv(walk, action_spec=Categorical(3), cost=cost, latent_dim=1)
        every = torch.tensor([*itertools.product(range(3), repeat=5)])
        codes = env.codec.encode(every.T).movedim(0, 1)
        state = torch.arange(12.0).unsqueeze(-1)
        least = env.objective(state, codes.expand(12, *codes.shape)).amin(-1)
        kwargs = {} if cls is RandomShooting else {"output": output}
        planner = cls(env, 5, 8, 256, 24, seed=0, **kwargs)
        plan = planner.plan(state, cold(planner, 12))
        torch.testing.assert_close(plan.best_cost, least)
        reached = env.objective(state, plan.actions.unsqueeze(1)).squeeze(1)
        if cls is RandomShooting or output == "best":
            torch.testing.assert_close(reached, least)
        else:
            assert (reached - least).mean() < 0.1 * least.mean()

    def test_the_elites_frequencies_are_the_next_proposal(self) -> None:
        planner = CEM(make_env(Categorical(3)), 2, 1, 64, 8, seed=0, min_std=1e-6)
        elites = planner.family.draw(cold(planner, 1), torch.randn(8, 2, 1))
        mean = planner.update(cold(planner, 1), elites, torch.zeros(1, 8)).mean
        counts = elites.sum(1)
        torch.testing.assert_close(mean, counts / 8)

    def test_a_mask_is_never_left(self) -> None:
        mask = torch.tensor([True, False, True, True])
        planner = CEM(
            make_env(Categorical(4, mask=mask), Weighted(torch.tensor([0.0, 9.0, 1.0, -1.0]))), 3, seed=0
        )
        out = planner(TensorDict(latent=torch.ones(1)))
        assert out["action"] == 2
        assert (out["next", "plan"][:, 1] == 0).all()

    def test_warm_starts_of_bits_that_are_all_zero(self) -> None:
        env = make_env(Binary(3), Weighted(-torch.ones(3)))
        planner = CEM(env, 2, 1, 1, seed=0)
        td = TensorDict(latent=torch.ones(2, 1), plan=torch.zeros(2, 2, 3), batch_size=2)
        td["is_init"] = torch.tensor([[False], [True]])
        start = planner._start(planner.memory.recall(td, td.batch_size, planner.low), td.batch_size)
        torch.testing.assert_close(start.mean[0], torch.full((2, 3), 0.15))
        torch.testing.assert_close(start.mean[1], torch.full((2, 3), 0.5))
        recalled = planner.memory.recall(td.exclude("is_init"), td.batch_size, planner.low)
        start = planner._start(recalled, td.batch_size)  # who knows: it may be a reset
        torch.testing.assert_close(start.mean, torch.full((2, 2, 3), 0.5))

    def test_gradient_planning_refuses_choices_and_takes_several_numbers(self) -> None:
        with pytest.raises(TypeError, match=r"must be continuous .* got index 'action'; use a sampling"):
            GradientMPC(make_env(Categorical(3)), 2)
        spec = Composite(a=Bounded(-1, 1, (2,)), b=Composite(c=Bounded(-1, 1, (1,))))
        planner = GradientMPC(make_env(spec, Weighted(torch.tensor([1.0, -1.0, 1.0]))), 2, seed=0)
        out = planner(TensorDict(latent=torch.ones(1)))
        torch.testing.assert_close(out["a"], torch.tensor([1.0, -1.0]))
        torch.testing.assert_close(out["b", "c"], torch.tensor([1.0]))

    def test_several_actions_are_not_renamed(self) -> None:
        with pytest.raises(ValueError, match="action_key must be None for the several actions"):
            CEM(make_env(EVERY["two_numbers"]), 2, action_key="a")
        out = CEM(make_env(Categorical(3)), 2, action_key=("policy", "a"))(TensorDict(latent=torch.ones(1)))
        assert out["policy", "a"].dtype == torch.int64

    def test_planning_returns_the_action(self) -> None:
        planner = CEM(make_env(Categorical(3)), 2, seed=0)
        assert planner.planning(TensorDict(latent=torch.ones(1))) == 2
        several = CEM(make_env(EVERY["composite"]), 2, seed=0).planning(TensorDict(latent=torch.ones(1)))
        assert several["gear"].dtype == torch.int64
        assert several["body", "wheel"].shape == (2, 1)


class TestLatentEnv:
    @pytest.mark.parametrize("name", EVERY)
    def test_it_is_an_environment(self, name: str) -> None:
        env = make_env(EVERY[name])
        rollout = env.rollout(3)
        code = env.codec.encode(rollout)
        expected = -Weighted(torch.linspace(-1.0, 2.0, env.codec.size))(rollout["latent"], code)
        torch.testing.assert_close(rollout["next", "reward"].squeeze(-1), -(-expected).to(torch.float32))
        check_env_specs(env)

    @pytest.mark.parametrize("name", EVERY)
    def test_steps_and_objective_agree(self, name: str) -> None:
        env = make_env(EVERY[name])
        td = env.rollout(4)
        cost = env.objective(td["latent"][0], env.codec.encode(td).unsqueeze(0))
        torch.testing.assert_close(cost, -td["next", "reward"].sum(0), rtol=1e-4, atol=1e-5)
        stepped = EnvObjective(env)
        state = stepped.planning_state(td[0])
        other = stepped.objective(state, env.codec.encode(td).unsqueeze(0))
        torch.testing.assert_close(other.to(cost.dtype), cost, rtol=1e-4, atol=1e-5)

    def test_the_predictor_must_have_the_size_of_the_code(self) -> None:
        with pytest.raises(ValueError, match=r"action_dim=1 numbers, got shape \(3,\) of index 'action'"):
            LatentEnv(Predictor(2, 1), action_spec=Categorical(3), cost=Weighted(torch.ones(3)))

    def test_reward_models_read_the_code(self) -> None:
        reward = TensorDictModule(nn.Linear(3, 1, bias=False), ["action"], ["reward"])
        nn.init.ones_(reward.module.weight)
        env = LatentEnv(still, action_spec=Categorical(3), reward_model=reward, latent_dim=1)
        assert (env.rollout(2)["next", "reward"] == 1).all()


class Switches(ModelBasedEnvBase):
    """A TorchRL environment of somebody else, with two actions: the reward counts the right ones."""

    def __init__(self) -> None:
        super().__init__(nn.Identity(), batch_size=torch.Size([]))
        self.observation_spec = Composite(latent=Unbounded((1,)))
        self.state_spec = Composite(latent=Unbounded((1,)))
        self.full_action_spec = Composite(gear=Categorical(4), wheel=Composite(angle=Bounded(-1, 1, (1,))))
        self.reward_spec = Unbounded((1,))

    def _step(self, tensordict: TensorDict) -> TensorDict:
        gear, angle = tensordict["gear"], tensordict["wheel", "angle"]
        assert gear.dtype == torch.int64
        reward = (gear == 2).float().unsqueeze(-1) - (angle - 0.5).square()
        out = TensorDict(latent=tensordict["latent"], reward=reward, batch_size=tensordict.batch_size)
        return out.update(self.full_done_spec.zero(out.batch_size))

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> TensorDict:
        return TensorDict(latent=torch.zeros(1)).update(self.full_done_spec.zero())


class TestOtherEnvironments:
    def test_composite_actions_through_the_adapter(self) -> None:
        env: EnvBase = Switches()
        out = CEM(env, 2, 8, 128, seed=0)(env.reset())
        assert out["gear"] == 2
        torch.testing.assert_close(out["wheel", "angle"], torch.tensor([0.5]), atol=0.03, rtol=0)
        assert env.rollout(2, policy=CEM(env, 2, seed=0))["next", "reward"].min() > 0.9


class TestTraining:
    @pytest.mark.parametrize("categorical", [False, True])
    def test_cart_pole_actions_train_as_they_come(self, categorical: bool) -> None:
        env = GymEnv("CartPole-v1", categorical_action_encoding=categorical)
        env.set_seed(0)
        windows = torch.stack([env.rollout(9, break_when_any_done=False) for _ in range(4)])
        torch.manual_seed(0)
        model = VJEPA(linear_encoder(4, 3), Predictor(3, 2, trunk="mlp", num_cells=(16,), skips=(1, 2)))
        loss = VJEPALoss(model, collapse_rank=0.0)
        SoftUpdate(loss, eps=0.99)
        before = windows["action"].clone()
        out = loss(windows)
        assert all(value.isfinite().all() for value in out.values())
        assert windows["action"].dtype == torch.int64
        assert torch.equal(windows["action"], before)
        floats = windows.clone()
        code = env.action_spec.to_one_hot(before) if categorical else before
        floats["action"] = code.float()
        torch.manual_seed(0)
        one = loss(windows.clone())
        torch.manual_seed(0)
        two = loss(floats)
        for key in set(one.keys()):
            torch.testing.assert_close(one[key], two[key])
        reward = TensorDictModule(QuadraticReward(3, 2), ["latent", "action"], ["reward"])
        assert RewardLoss(model, reward)(windows)["loss_reward"].isfinite()
        planner = CEM(LatentEnv(model, action_spec=env.action_spec, reward_model=reward), 4, 2, 32, seed=0)
        td = env.reset()
        action = planner(model.encoder(td.clone()))["action"]
        assert env.action_spec.is_in(action)
        env.step(td.set("action", action))

    def test_pixel_baseline(self) -> None:
        encoder = linear_encoder(4, 3)
        loss = PixelARLoss(PixelAR(encoder, PixelDecoder(encoder, 3, 4, action_dim=2)))
        td = TensorDict(observation=torch.randn(3, 5, 4), action=torch.ones(3, 5).long(), batch_size=(3, 5))
        assert loss(td)["loss_reconstruction"].isfinite()

    def test_indices_beyond_the_model_are_refused(self) -> None:
        with pytest.raises(ValueError, match=r"indices of actions must be in \[0, 2\).* got 0 to 2"):
            code_of_windows(torch.tensor([0, 2]), torch.Size([2]), 2, torch.float32)

    def test_other_shapes_are_left_to_the_caller(self) -> None:
        action = torch.zeros(4, 3).long()
        assert code_of_windows(action, torch.Size([4]), 5, torch.float32) is action
        model = VJEPA(linear_encoder(4, 3), Predictor(3, 5))
        windows = TensorDict(
            observation=torch.randn(2, 4, 4), action=torch.zeros(2, 4, 2).long(), batch_size=(2, 4)
        )
        loss = VJEPALoss(model)
        SoftUpdate(loss, eps=0.99)
        with pytest.raises(ValueError, match="an ActionEncoder"):
            loss(windows)
        spec = MultiCategorical([2, 3])
        encoder = ActionEncoder(ActionCodec(spec))
        model = VJEPA(linear_encoder(4, 3), Predictor(3, 5, action_key="action_code"))
        loss = VJEPALoss(model)
        SoftUpdate(loss, eps=0.99)
        assert loss(encoder(windows))["loss_variance"].isfinite()
        env = LatentEnv(model, action_spec=Composite(action=spec), cost=Weighted(torch.ones(5)))
        out = CEM(env, 2, 2, 8, seed=0)(TensorDict(latent=torch.ones(2, 3), batch_size=2))
        assert out["action"].shape == (2, 2)
        assert math.prod(MultiOneHot([2, 3]).shape) == env.codec.size


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_a_planner_of_another_dtype_executes_actions_of_the_specification(dtype: torch.dtype) -> None:
    spec = Bounded(-1, 1, (2,))
    env = LatentEnv(
        lambda latent, action: Delta(latent + action),
        action_spec=spec,
        cost=quadratic_cost(torch.full((2,), 3.0)),
        latent_dim=2,
    )
    action = CEM(env, 3, seed=0).to(dtype)(TensorDict(latent=torch.zeros(2)))["action"]
    assert spec.is_in(action)


def test_a_planner_and_what_it_steps_share_one_codec() -> None:
    planner = CEM(PendulumEnv(), 3)
    assert planner._env_objective.codec is planner.codec
