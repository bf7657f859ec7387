"""Plans that a policy suggests: exactly what it does in the model, and no promise of a planner is broken."""

from __future__ import annotations

import copy
import math
import pickle
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from own_objective import OwnObjective
from specs import EVERY, specs
from tensordict import TensorDict
from tensordict.nn import (
    CompositeDistribution,
    NormalParamExtractor,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torch.distributions import (
    Bernoulli,
    Beta,
    Distribution,
    Independent,
    LogNormal,
    Normal,
    TransformedDistribution,
)
from torch.distributions import Categorical as CategoricalDistribution
from torch.distributions.transforms import SigmoidTransform
from torchrl.data import Bounded, Categorical, Composite, OneHot, TensorSpec
from torchrl.envs import PendulumEnv, TransformedEnv, UnsqueezeTransform
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import (
    Actor,
    MaskedCategorical,
    OneHotCategorical,
    ProbabilisticActor,
    QValueActor,
    TanhNormal,
    TruncatedNormal,
)

from torchrl_vjepa.actions import ActionCodec
from torchrl_vjepa.distributions import Delta, diag_gaussian
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.planners import CEM, MPPI, Proposal, RandomShooting, SamplingPlanner

F64 = {"dtype": torch.float64}
PLANNERS = [RandomShooting, CEM, MPPI]
planners = st.sampled_from(PLANNERS)
every_planner = pytest.mark.parametrize("cls", PLANNERS)


def drift(latent: Tensor, action: Tensor) -> Delta:
    return Delta(0.9 * latent + 0.1 * action.sum(-1, keepdim=True).tanh())


def bumpy(latent: Tensor, action: Tensor) -> Tensor:
    weights = torch.linspace(1.0, 2.0, action.shape[-1], dtype=action.dtype)
    return 3 * (5 * latent[..., 0]).sin() + ((action - 0.3) * weights).sin().sum(-1)


class Parameters(nn.Module):
    """Of a distribution for every tensor of any action, all different in every latent; or spoilt."""

    def __init__(self, codec: ActionCodec, value: float | None) -> None:
        super().__init__()
        self.leaves, self.value = codec._leaves, value

    def forward(self, latent: Tensor) -> tuple[Tensor, ...]:
        out = []
        for number, leaf in enumerate(self.leaves):
            shape = (*leaf.shape, max(leaf.sizes)) if leaf.kind == "index" else leaf.shape
            size = math.prod(shape)
            wave = torch.linspace(1.0, 5.0, size, dtype=latent.dtype) + number
            loc = 2 * torch.sin(wave * latent[..., :1]).reshape((*latent.shape[:-1], *shape))
            loc = loc if self.value is None else torch.where(loc > 0, self.value, loc)
            out += (
                [loc.to(leaf.dtype), torch.full_like(loc, 0.5).to(leaf.dtype)] if number_of(leaf) else [loc]
            )
        return tuple(out)


def number_of(leaf: Any) -> bool:
    return leaf.kind == "number"


CLASSES = {"number": Normal, "index": CategoricalDistribution, "one_hot": Bernoulli, "bit": Bernoulli}


def actor_of(spec: TensorSpec, value: float | None = None) -> ProbabilisticTensorDictSequential:
    """A random policy for any specification, in TorchRL's own parts."""
    codec = ActionCodec(spec)
    keys: list[Any] = []
    for leaf in codec._leaves:
        path = (leaf.key,) if isinstance(leaf.key, str) else leaf.key
        names = ("loc", "scale") if number_of(leaf) else ("logits",)
        keys += [("params", *path, name) for name in names]
    front = TensorDictModule(Parameters(codec, value), ["latent"], keys)
    classes = {leaf.key: CLASSES[leaf.kind] for leaf in codec._leaves}
    back = ProbabilisticTensorDictModule(
        in_keys=["params"],
        out_keys=codec.keys,
        distribution_class=CompositeDistribution,
        distribution_kwargs={"distribution_map": classes},
    )
    return ProbabilisticTensorDictSequential(front, back)


def make_planner(cls: type[SamplingPlanner], spec: TensorSpec, cost: Any = bumpy, **kwargs: Any) -> Any:
    env = LatentEnv(drift, action_spec=spec, cost=cost, latent_dim=1, **F64)
    horizon = kwargs.pop("horizon", 3)
    return cls(
        env,
        horizon,
        **{"optim_steps": 2, "num_candidates": 12, "top_k": 4, "init_std": 0.5, "seed": 0, **kwargs},
    )


def states(*batch: int) -> TensorDict:
    latent = 2 * torch.randn(*batch, 1, generator=torch.Generator().manual_seed(0), **F64)
    return TensorDict(latent=latent, batch_size=batch)


def suggested(planner: SamplingPlanner, td: TensorDict) -> Tensor:
    start = planner.family.cold(td.batch_size, planner.planning_horizon)
    return planner._policy_plans(planner._source.planning_state(td), start)


class TestPromises:
    @settings(max_examples=80)
    @given(
        cls=planners,
        spec=specs(),
        value=st.sampled_from([None, math.nan, math.inf, -math.inf, 1e30, -1e30]),
        batch=st.sampled_from([(), (3,), (2, 1), (0,)]),
        num=st.integers(1, 11),
    )
    def test_actions_are_finite_and_inside_whatever_the_policy_writes(
        self, cls: type[SamplingPlanner], spec: TensorSpec, value: Any, batch: tuple[int, ...], num: int
    ) -> None:
        policy = actor_of(spec, value)
        planner = make_planner(cls, spec, policy=policy, num_policy_candidates=num)
        whole = spec if isinstance(spec, Composite) else Composite(action=spec)
        td = states(*batch)
        plans = suggested(planner, td)
        codec = planner.codec
        assert plans.shape == (*batch, num, 3, codec.size)
        assert plans.isfinite().all()
        assert ((plans >= codec.low) & (plans <= codec.high)).all()
        assert torch.equal(codec.mode(plans), plans)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            planner(td)
        if 0 in batch:
            return
        for action in codec.decode(plans.reshape(-1, codec.size)):
            assert whole.is_in(action)
        for row in td.select(*codec.keys).reshape(-1):
            assert whole.is_in(row)

    @settings(max_examples=30)
    @given(cls=planners, spec=specs(), split=st.integers(1, 7), num=st.integers(1, 6))
    def test_any_split_of_a_batch_gives_the_same_plans(
        self, cls: type[SamplingPlanner], spec: TensorSpec, split: int, num: int
    ) -> None:
        planner = make_planner(cls, spec, policy=actor_of(spec), num_policy_candidates=num)
        together = planner(states(8))
        parts = []
        for part in states(8).split([split, 8 - split]):
            planner.set_seed(0)
            parts.append(planner(part))
        for key in planner.out_keys:
            torch.testing.assert_close(torch.cat([part[key] for part in parts]), together[key])
        planner.set_seed(0)
        several = planner(states(8).reshape(2, 2, 2))
        for key in planner.out_keys:
            torch.testing.assert_close(several[key].flatten(0, 2), together[key])

    @settings(max_examples=30)
    @given(cls=planners, spec=specs(), order=st.permutations(range(6)))
    def test_permuting_environments_permutes_plans(
        self, cls: type[SamplingPlanner], spec: TensorSpec, order: list[int]
    ) -> None:
        planner = make_planner(cls, spec, policy=actor_of(spec), num_policy_candidates=5)
        expected = planner(states(6))
        planner.set_seed(0)
        permuted = planner(states(6)[order])
        for key in planner.out_keys:
            torch.testing.assert_close(permuted[key], expected[key][order])

    @every_planner
    @pytest.mark.parametrize("training", [False, True])
    def test_nothing_is_touched_and_the_seed_decides(
        self, cls: type[SamplingPlanner], training: bool
    ) -> None:
        policy = tanh_policy().train(training)
        before = copy.deepcopy(policy.state_dict())
        random = torch.get_rng_state()
        one, two = (
            make_planner(cls, Bounded(-1, 1, (2,)), policy=policy, num_policy_candidates=5) for _ in range(2)
        )
        first = one(states(4))
        assert torch.equal(first["action"], two(states(4))["action"])
        assert torch.equal(random, torch.get_rng_state())
        assert all(torch.equal(before[key], value) for key, value in policy.state_dict().items())
        assert all(p.grad is None and p.requires_grad for p in policy.parameters())
        assert all(part.training == training for part in policy.modules())
        assert not any(value.requires_grad for value in first.values(True, True))
        assert set(first.keys(True)) == {"latent", *one.out_keys, "next"}  # no parameters of the policy
        other = suggested(one, states(4))
        assert not other.requires_grad
        one.set_seed(1)
        assert not torch.equal(other[:, 1:], suggested(one, states(4))[:, 1:])

    @pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
    def test_it_travels(self, copied: Callable[[Any], Any]) -> None:
        planner = make_planner(CEM, Bounded(-1, 1, (2,)), policy=tanh_policy(), num_policy_candidates=3)
        assert any(key.startswith("policy.") for key in planner.state_dict())
        assert any(part is planner.policy for part in planner.modules())
        again = copied(planner)
        assert again.policy is not planner.policy
        assert torch.equal(planner(states(3))["action"], again(states(3))["action"])


def tanh_policy(size: int = 2, **kwargs: Any) -> ProbabilisticActor:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        net = nn.Sequential(nn.Linear(1, 8, **F64), nn.Tanh(), nn.Linear(8, 2 * size, **F64))
    front = TensorDictModule(nn.Sequential(net, NormalParamExtractor()), ["latent"], ["loc", "scale"])
    return ProbabilisticActor(front, in_keys=["loc", "scale"], **{"distribution_class": TanhNormal, **kwargs})


class TestWhatItDoes:
    @pytest.mark.parametrize("name", EVERY)
    def test_the_first_plan_is_a_deterministic_rollout(self, name: str) -> None:
        spec = EVERY[name]
        policy = actor_of(spec)
        planner = make_planner(CEM, spec, policy=policy, num_policy_candidates=4, horizon=5)
        td = states()
        with set_exploration_type(ExplorationType.RANDOM):
            plan = suggested(planner, td)[0]
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            start = planner.env.reset(td.clone())

            def inside(td: TensorDict) -> TensorDict:
                code = planner.codec.encode(policy(td).select(*planner.codec.keys))
                code = planner.codec.mode(code.clamp(planner.low, planner.high))
                return td.update(planner.codec.decode(code))

            data = planner.env.rollout(5, inside, auto_reset=False, tensordict=start)
        torch.testing.assert_close(plan, planner.codec.encode(data.select(*planner.codec.keys)).to(plan))

    def test_in_an_environment_that_is_stepped(self) -> None:
        env = PendulumEnv()
        front = TensorDictModule(
            lambda th, thdot: (torch.stack([-th - thdot], -1), 0.3 + 0 * th.unsqueeze(-1)),
            ["th", "thdot"],
            ["loc", "scale"],
        )
        policy = ProbabilisticActor(
            front,
            in_keys=["loc", "scale"],
            distribution_class=TanhNormal,
            distribution_kwargs={"low": -2.0, "high": 2.0},
        )
        planner = MPPI(env, 6, policy=policy, seed=0)
        assert planner.num_policy_candidates == 25
        td = env.reset()
        plans = suggested(planner, td)
        assert plans.shape == (25, 6, 1)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            data = env.rollout(6, policy, auto_reset=False, tensordict=td.clone())
        torch.testing.assert_close(plans[0], data["action"])
        assert len(plans[:, 0].unique()) == 25
        batch = torch.stack([td, td.clone().set("th", td["th"] + 1)])
        torch.testing.assert_close(suggested(MPPI(env, 6, policy=policy, seed=0), batch)[0], plans)

    def test_an_observation_alone_may_be_read(self) -> None:
        env = TransformedEnv(PendulumEnv(), UnsqueezeTransform(-1, in_keys=["th"], out_keys=["angle"]))
        policy = Actor(nn.Linear(1, 1), in_keys=["angle"])
        planner = CEM(env, 3, 1, 16, policy=policy, seed=0)
        assert "angle" in planner.in_keys
        td = env.reset()
        data = env.rollout(3, policy, auto_reset=False, tensordict=td.clone())
        torch.testing.assert_close(suggested(planner, td)[0], data["action"].clamp(-2, 2))

    def test_stepping_and_imagining_agree(self) -> None:
        env = LatentEnv(drift, action_spec=Bounded(-1, 1, (2,), **F64), cost=bumpy, latent_dim=1, **F64)
        one, two = (
            CEM(e, 3, 2, 12, policy=tanh_policy(), num_policy_candidates=4, seed=0, return_stats=True)
            for e in (env, TransformedEnv(env))
        )
        torch.testing.assert_close(suggested(one, states(3)), suggested(two, states(3)))
        imagined, stepped = one(states(3)), two(states(3))
        torch.testing.assert_close(imagined["plan_stats", "cost"], stepped["plan_stats", "cost"])

    @pytest.mark.parametrize("stepped", [False, True])
    def test_actions_are_held_as_those_of_plans(self, stepped: bool) -> None:
        spec = Bounded(-1, 1, (2,), **F64)
        env: Any = LatentEnv(drift, action_spec=spec, cost=bumpy, latent_dim=1, **F64)
        env = TransformedEnv(env) if stepped else env
        policy = tanh_policy()
        planner = CEM(env, 6, 2, 12, action_repeat=2, policy=policy, num_policy_candidates=3, seed=0)
        plans = planner._policy_plans(planner._source.planning_state(states(4)), planner.family.cold((4,), 3))
        assert plans.shape == (4, 3, 3, 2)
        td = states(4)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            for step in range(3):
                action = policy(td.clone())["action"]
                torch.testing.assert_close(plans[:, 0, step], action)
                for _ in range(2):
                    td["latent"] = drift(td["latent"], action).mean
        assert planner(states(4))["next", "plan"].shape == (4, 6, 2)

    def test_samples_have_the_distribution_of_the_policy_in_every_step(self) -> None:
        front = TensorDictModule(lambda z: (0.5 * z, 0.2 + 0 * z), ["latent"], ["loc", "scale"])
        policy = ProbabilisticActor(
            front,
            in_keys=["loc", "scale"],
            distribution_class=lambda loc, scale: Independent(Normal(loc, scale), 1),
        )
        env = LatentEnv(
            lambda z, u: Delta(z + u), action_spec=Bounded(-50, 50, (1,)), cost=bumpy, latent_dim=1
        )
        num = 20_000
        planner = CEM(env, 3, 1, num + 1, policy=policy, num_policy_candidates=num, seed=0)
        plans = suggested(planner, TensorDict(latent=torch.tensor([[1.0], [-2.0]]), batch_size=2))[
            ..., 1:, :, 0
        ]
        z = torch.tensor([[1.0], [-2.0]])
        for step in range(3):
            rest = (plans[..., step] - 0.5 * z) / 0.2
            z = z + plans[..., step]
            error = 5 / math.sqrt(num)
            assert (rest.mean(-1).abs() < error).all()
            assert ((rest.std(-1) - 1).abs() < error).all()
            torch.testing.assert_close(rest[0], rest[1], atol=1e-4, rtol=1e-4)  # common to all rows
        assert not torch.allclose(plans[..., 0], plans[..., 1])

    def test_numbers_of_one_action_are_drawn_one_by_one(self) -> None:
        for name in ("matrix", "categorical_vector", "binary_matrix"):
            planner = make_planner(
                CEM, EVERY[name], policy=actor_of(EVERY[name]), num_candidates=200, num_policy_candidates=150
            )
            td = TensorDict(latent=torch.zeros(1, **F64))
            first = suggested(planner, td)[1:, 0]
            halves = first.chunk(2, dim=-1)
            assert (halves[0] != halves[1]).any()

    def test_from_a_belief_and_with_noise_the_mean_is_followed(self) -> None:
        def gust(latent: Tensor, action: Tensor) -> Any:
            return diag_gaussian(drift(latent, action).mean, torch.ones_like(latent))

        spec = Bounded(-1, 1, (2,))
        plain = make_planner(CEM, spec, policy=tanh_policy(), num_policy_candidates=3)
        noisy = LatentEnv(
            gust,
            action_spec=spec,
            cost=bumpy,
            latent_dim=1,
            how="sample",
            belief_key="belief",
            num_samples=4,
            **F64,
        )
        other = CEM(noisy, 3, 1, 12, policy=tanh_policy(), num_policy_candidates=3, seed=0)
        particles = states(4)["latent"].unsqueeze(1) + torch.tensor([[1.0], [-1.0]], **F64)
        belief = {"particles": particles, "log_weights": torch.zeros(4, 2, **F64)}
        td = TensorDict(belief=belief, batch_size=4)
        torch.testing.assert_close(suggested(other, td), suggested(plain, states(4)))
        assert other(td)["action"].shape == (4, 2)

    def test_what_is_not_finite_is_the_mean_of_the_proposal(self) -> None:
        policy = TensorDictModule(
            lambda z: torch.stack([z[..., 0], z[..., 0] * math.nan], -1), ["latent"], ["action"]
        )
        planner = make_planner(CEM, Bounded(-1, 1, (2,)), policy=policy, horizon=2)
        mean = torch.tensor([[0.0, 0.25], [0.0, -0.5]]).expand(3, 2, 2)  # another in every step
        plans = planner._policy_plans(states(3)["latent"], Proposal(mean, torch.ones(3, 2, 2)))
        assert torch.equal(plans[:, 0, :, 1], mean[..., 1].to(plans.dtype))
        expected = states(3)["latent"].clamp(-1, 1).float()
        torch.testing.assert_close(plans[:, 0, :1, 0], expected)


class Recorder(SamplingPlanner):
    """Keeps all candidates of every round, best first."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.rounds: list[tuple[Tensor, Tensor]] = []

    def update(self, proposal: Proposal, elites: Tensor, costs: Tensor) -> Proposal:
        self.rounds.append((elites, costs))
        return Proposal(elites[..., 0, :, :], proposal.std)


class TestCandidates:
    @pytest.mark.parametrize("keep", [0.0, 0.5])
    def test_they_are_candidates_of_every_round(self, keep: float) -> None:
        planner = make_planner(
            Recorder,
            Bounded(-1, 1, (2,)),
            policy=tanh_policy(),
            num_policy_candidates=4,
            optim_steps=3,
            top_k=12,
            keep_elites=keep,
        )
        state = planner.generator.get_state()
        plans = suggested(planner, states(2))
        planner.generator.set_state(state)
        planner.plan(states(2)["latent"], planner.family.cold((2,), 3))
        assert len(planner.rounds) == 3
        for elites, _ in planner.rounds:
            assert elites.shape == (2, 12, 3, 2)
            same = (elites.unsqueeze(2) == plans.unsqueeze(1)).flatten(-2).all(-1)
            assert (same.sum(1) >= 1).all()  # one of them may be kept as an elite, too
        kept = (planner.rounds[1][0][:, 0, None] == planner.rounds[2][0]).flatten(-2).all(-1)
        assert kept.any(-1).all(), "the best plan is still a candidate"

    def test_they_are_the_last(self) -> None:
        seen: list[Tensor] = []

        def cost(latent: Tensor, action: Tensor) -> Tensor:
            seen.append(action)
            return bumpy(latent, action)

        planner = make_planner(CEM, Bounded(-1, 1, (2,)), cost, policy=tanh_policy(), num_policy_candidates=4)
        state = planner.generator.get_state()
        plans = suggested(planner, states(2))
        planner.generator.set_state(state)
        seen.clear()
        planner.plan(states(2)["latent"], planner.family.cold((2,), 3))
        assert [actions.shape for actions in seen] == [(2, 12, 3, 2)] * 2
        assert all(torch.equal(actions[:, -4:], plans.double()) for actions in seen)

    @pytest.mark.parametrize(("num", "kept"), [(2, 8), (9, 1), (10, 0), (11, 0)])
    def test_elites_are_kept_where_there_is_room_for_them(self, num: int, kept: int) -> None:
        planner = make_planner(
            Recorder,
            Bounded(-1, 1, (2,)),
            policy=tanh_policy(),
            num_policy_candidates=num,
            keep_elites=1.0,
            top_k=12,
        )
        assert planner._num_kept == kept
        planner.plan(states(2)["latent"], planner.family.cold((2,), 3))
        first, second = (elites for elites, _ in planner.rounds)
        again = (first[:, :1] == second).flatten(-2).all(-1).any(-1)
        assert again.all() or num == 11, "the best plan is a candidate again"

    @pytest.mark.parametrize(("num", "top_k"), [(1, 2), (4, 2), (8, 2), (1, 5)])
    def test_beside_elites_that_are_carried_and_a_population_that_decays(self, num: int, top_k: int) -> None:
        planner = make_planner(
            Recorder,
            Bounded(-1, 1, (2,)),
            policy=tanh_policy(),
            num_policy_candidates=num,
            optim_steps=4,
            top_k=top_k,
            keep_elites=0.5,
            carry_elites=1.0,
            population_decay=0.5,
        )
        sizes: list[int] = []
        costs_of = planner._evaluator

        def spied(state: Any) -> Any:
            evaluate = costs_of(state)

            def evaluated(candidates: Tensor) -> Tensor:
                sizes.append(candidates.shape[-3])
                assert torch.equal(candidates[..., -num:, :, :], plans)
                return evaluate(candidates)

            return evaluated

        planner._evaluator = spied
        td = states(2)
        for _ in range(2):
            state = planner.generator.get_state()
            plans = suggested(planner, td)
            planner.generator.set_state(state)
            sizes.clear()
            planner(td)
            least = max(2 * top_k, num + 2 + planner._num_kept)
            assert sizes == [12, *(max(size, least) for size in (6, 3, 2))]
            td = states(2).update(td["next"])

    @every_planner
    def test_the_others_are_those_without_a_policy(self, cls: type[SamplingPlanner]) -> None:
        """One useless plan more: the best of one round is no worse, and the same candidates are drawn."""
        useless = TensorDictModule(
            lambda z: torch.ones_like(z).expand(*z.shape[:-1], 2), ["latent"], ["action"]
        )
        spec, one = Bounded(-1, 1, (2,)), {"optim_steps": 1}
        without = make_planner(cls, spec, **one)
        with_it = make_planner(cls, spec, policy=useless, num_candidates=13, **one)
        start = without.family.cold((50,), 3)
        latent = states(50)["latent"]
        best = without.plan(latent, start).best_cost
        assert (with_it.plan(latent, start).best_cost <= best).all()
        assert (with_it.plan(latent, start).best_cost < 1e9).all()

    @pytest.mark.parametrize("cls", [CEM, MPPI])
    def test_a_useless_policy_costs_no_quality(self, cls: type[SamplingPlanner]) -> None:
        """At the same number of other candidates, within the spread over seeds (rows share their noise)."""

        def away(latent: Tensor, action: Tensor) -> Tensor:
            return latent.square().sum(-1) + (action - 0.3).square().sum(-1)

        front = TensorDictModule(
            lambda z: (
                torch.full_like(z, 4.0).expand(*z.shape[:-1], 2),
                (0.3 + 0 * z).expand(*z.shape[:-1], 2),
            ),
            ["latent"],
            ["loc", "scale"],
        )
        policy = ProbabilisticActor(front, in_keys=["loc", "scale"], distribution_class=TanhNormal)
        differences = []
        for seed in range(12):
            kwargs = {"optim_steps": 4, "seed": seed, "top_k": 8, "return_stats": True}
            spec = Bounded(-1, 1, (2,))
            plain = make_planner(cls, spec, away, num_candidates=64, **kwargs)
            other = make_planner(
                cls, spec, away, num_candidates=70, policy=policy, num_policy_candidates=6, **kwargs
            )
            costs = [planner(states(20))["plan_stats", "cost"].mean() for planner in (other, plain)]
            differences.append(costs[0] - costs[1])
        difference = torch.stack(differences)
        error = difference.std() / math.sqrt(len(differences))
        assert difference.mean() < 3 * error
        assert error < 0.01

    @settings(max_examples=30)
    @given(cls=planners, spec=specs(), num=st.integers(1, 6), steps=st.integers(1, 3))
    def test_the_best_plan_is_no_worse_than_the_policys(
        self, cls: type[SamplingPlanner], spec: TensorSpec, num: int, steps: int
    ) -> None:
        kwargs = {} if cls is RandomShooting else {"output": "best"}
        planner = make_planner(
            cls, spec, policy=actor_of(spec), num_policy_candidates=num, optim_steps=steps, **kwargs
        )
        state = planner.generator.get_state()
        plans = suggested(planner, states(5))
        planner.generator.set_state(state)
        plan = planner.plan(states(5)["latent"], planner.family.cold((5,), 3))
        costs = planner.env.objective(states(5)["latent"], plans.double())
        assert (plan.best_cost <= costs.amin(-1) + 1e-5).all()
        cost = planner.env.objective(states(5)["latent"], plan.actions.unsqueeze(-3).double())
        assert (cost.squeeze(-1) <= costs.amin(-1) + 1e-5).all()


# A scalar linear system with quadratic cost, and its optimal feedback.
GAIN, PUSH, STATE_COST, ACTION_COST = 1.3, 0.5, 1.0, 0.3


def riccati() -> float:
    p = 0.0
    for _ in range(200):
        s = STATE_COST + p
        p = GAIN**2 * s * ACTION_COST / (ACTION_COST + PUSH**2 * s)
    return p


class Optimal(nn.Module):
    def forward(self, latent: Tensor) -> Tensor:
        s = STATE_COST + riccati()
        return -GAIN * PUSH * s / (ACTION_COST + PUSH**2 * s) * latent


class TestPerfectPolicy:
    @staticmethod
    def env() -> LatentEnv:
        return LatentEnv(
            lambda z, u: Delta(GAIN * z + PUSH * u),
            action_spec=Bounded(-20, 20, (1,), **F64),
            cost=lambda z, u: STATE_COST * z.square().sum(-1) + ACTION_COST * u.square().sum(-1),
            latent_dim=1,
            **F64,
        )

    @every_planner
    @pytest.mark.parametrize("stepped", [False, True])
    def test_it_is_found_in_one_round(self, cls: type[SamplingPlanner], stepped: bool) -> None:
        """With the exact value behind the horizon it is optimal at any horizon."""
        env: Any = TransformedEnv(self.env()) if stepped else self.env()
        value = TensorDictModule(lambda z: -riccati() * z.square(), ["latent"], ["state_value"])
        policy = Actor(Optimal(), in_keys=["latent"])
        kwargs = {} if cls is RandomShooting else {"output": "best"}
        planner = cls(
            env, 12, 1, 4, policy=policy, terminal_value=value, seed=0, return_stats=True, top_k=1, **kwargs
        )
        assert planner.num_policy_candidates == 1
        td = TensorDict(latent=torch.tensor([[1.0], [-3.0]], **F64), batch_size=2)
        out = planner(td.clone())
        torch.testing.assert_close(out["action"], Optimal()(td["latent"]))
        cost = riccati() * td["latent"].square()
        torch.testing.assert_close(out["plan_stats", "cost"], cost)
        kwargs = kwargs | {"terminal_value": value, "top_k": 1}
        alone = cls(env, 12, 1, 4, seed=0, return_stats=True, **kwargs)(td.clone())
        assert (alone["plan_stats", "cost"] > 1.5 * cost).all()

    def test_a_noisy_one_is_improved(self) -> None:
        """The mean of its draws is its deterministic action, which is found exactly."""
        front = TensorDictModule(lambda z: (Optimal()(z), 0.5 + 0 * z), ["latent"], ["loc", "scale"])
        policy = ProbabilisticActor(
            front,
            in_keys=["loc", "scale"],
            distribution_class=lambda loc, scale: Independent(Normal(loc, scale), 1),
        )
        planner = CEM(self.env(), 8, 1, 32, 1, policy=policy, num_policy_candidates=16, output="best", seed=0)
        td = TensorDict(latent=torch.tensor([[1.0], [-3.0]], **F64), batch_size=2)
        costs = self.env().objective(td["latent"], suggested(planner, td))
        assert (costs.argmin(-1) == 0).all()

    def test_it_acts(self) -> None:
        env = PendulumEnv()
        policy = Actor(Torque(), in_keys=["th", "thdot"])
        planner = MPPI(env, 4, 2, 16, policy=policy, seed=0)
        data = env.rollout(5, TensorDictSequential(planner), break_when_any_done=False)
        assert data["action"].abs().max() <= 2


class Torque(nn.Module):
    def forward(self, th: Tensor, thdot: Tensor) -> Tensor:
        return (-10 * th - 2 * thdot).unsqueeze(-1)


def discrete(distribution: Any, keys: Any, net: Any, **kwargs: Any) -> ProbabilisticActor:
    return ProbabilisticActor(
        TensorDictModule(net, ["latent"], keys), in_keys=keys, distribution_class=distribution, **kwargs
    )


def logits_of(z: Tensor) -> Tensor:
    return torch.cat([torch.sin(3 * z), torch.cos(5 * z), z.sin()], -1)


KINDS: dict[str, tuple[TensorSpec, Callable[[], Any]]] = {
    "tanh_normal": (Bounded(-1, 1, (2,)), tanh_policy),
    "truncated_normal": (
        Bounded(-1, 1, (2,)),
        lambda: tanh_policy(distribution_class=TruncatedNormal),
    ),
    "one_hot": (OneHot(3), lambda: discrete(OneHotCategorical, ["logits"], logits_of)),
    "categorical": (Categorical(3), lambda: discrete(CategoricalDistribution, ["logits"], logits_of)),
    "masked": (
        Categorical(3),
        lambda: discrete(
            MaskedCategorical,
            ["logits", "mask"],
            lambda z: (logits_of(z), torch.tensor([True, False, True]).expand(*z.shape[:-1], 3)),
        ),
    ),
    "log_normal": (
        Bounded(0, 3, (2,)),
        lambda: tanh_policy(distribution_class=LogNormal),
    ),
}


class TestKinds:
    @pytest.mark.parametrize("name", KINDS)
    def test_actors_of_torchrl(self, name: str) -> None:
        spec, make = KINDS[name]
        planner = make_planner(CEM, spec, policy=make(), num_candidates=60, num_policy_candidates=40)
        plans = suggested(planner, states(3))
        assert len(plans[0, 1:, 0].unique(dim=0)) > (1 if planner.codec.members.numel() else 30)
        for row in range(3):
            planner.set_seed(0)
            torch.testing.assert_close(suggested(planner, states(3)[row]), suggested_again(planner, row))
        planner.set_seed(0)
        torch.testing.assert_close(suggested(planner, states(3)), plans)
        if name == "masked":
            assert (plans[..., 1] == 0).all()

    def test_choices_are_drawn_as_often_as_the_policy_says(self) -> None:
        spec, make = KINDS["one_hot"]
        num = 5000
        planner = make_planner(CEM, spec, policy=make(), num_candidates=num + 1, num_policy_candidates=num)
        shares = suggested(planner, states(3))[:, 1:, 0].mean(1)
        expected = logits_of(states(3)["latent"]).softmax(-1).float()
        assert ((shares - expected).abs() < 5 * (expected * (1 - expected) / num).sqrt()).all()

    def test_a_sequence_with_an_actor_at_its_end(self) -> None:
        front = TensorDictModule(lambda z: 2 * z, ["latent"], ["features"])
        actor = ProbabilisticActor(
            TensorDictModule(lambda f: (f, 0.1 + 0 * f), ["features"], ["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=TanhNormal,
        )
        spec = Bounded(-1, 1, (1,))
        for policy in (
            TensorDictSequential(front, actor),
            TensorDictSequential({"front": front, "actor": actor}),
            TensorDictSequential(TensorDictSequential(front), TensorDictSequential(actor)),
        ):
            planner = make_planner(CEM, spec, policy=policy, num_policy_candidates=4)
            plans = suggested(planner, states(2))
            torch.testing.assert_close(plans[:, 0, 0], (2 * states(2)["latent"]).tanh().float())
            assert len(plans[0].unique(dim=0)) == 4

    @pytest.mark.parametrize(
        "policy",
        [
            Actor(nn.Linear(1, 3, **F64), in_keys=["latent"]),
            TensorDictModule(nn.Linear(1, 3, **F64), ["latent"], ["action"]),
            QValueActor(nn.Linear(1, 3, **F64), in_keys=["latent"], spec=OneHot(3)),
        ],
    )
    def test_a_deterministic_policy_suggests_one_plan(self, policy: Any) -> None:
        planner = make_planner(CEM, OneHot(3), policy=policy)
        assert planner.num_policy_candidates == 1
        action = policy(states(2))["action"]
        plans = suggested(planner, states(2))
        assert torch.equal(plans[:, 0, 0].argmax(-1), action.to(torch.float64).argmax(-1))
        with pytest.raises(
            ValueError, match="num_policy_candidates must be 1 for a policy that is determinist"
        ):
            make_planner(CEM, OneHot(3), policy=policy, num_policy_candidates=2)

    def test_two_actions_of_one_policy(self) -> None:
        spec = EVERY["composite"]
        planner = make_planner(MPPI, spec, policy=actor_of(spec), num_policy_candidates=6)
        out = planner(states(3))
        assert out["gear"].dtype == torch.int64
        assert out["body", "wheel"].shape == (3, 2, 1)


def suggested_again(planner: Any, row: int) -> Tensor:
    planner.set_seed(0)
    return suggested(planner, states(3))[row]


class Wide(Distribution):
    """Without common noise."""

    has_rsample = True

    def __init__(self, loc: Tensor, scale: Tensor) -> None:
        super().__init__(loc.shape[:-1], loc.shape[-1:])
        self.loc = loc

    @property
    def mean(self) -> Tensor:
        return self.loc

    @property
    def deterministic_sample(self) -> Tensor:
        return self.loc

    def rsample(self, shape: Any = ()) -> Tensor:
        return self.loc + torch.randn(*shape, *self.loc.shape)


class TestArguments:
    SPEC = Bounded(-1, 1, (2,))

    @pytest.mark.parametrize(
        ("kwargs", "error", "message"),
        [
            ({"num_policy_candidates": 3}, ValueError, "num_policy_candidates must be None without a policy"),
            (
                {"policy": tanh_policy(), "num_policy_candidates": 0},
                ValueError,
                "num_policy_candidates must be an integer of at least 1, got 0",
            ),
            (
                {"policy": tanh_policy(), "num_policy_candidates": 12},
                ValueError,
                r"num_policy_candidates must be in \[1, num_candidates - 1 = 11\], got 12",
            ),
            (
                {"policy": lambda z: z},
                TypeError,
                "policy must be a TensorDictModule, for instance a ProbabilisticActor, got function",
            ),
            (
                {"policy": Actor(nn.Linear(1, 2, **F64), in_keys=["observation"])},
                KeyError,
                r"policy must read only \['latent'\] of LatentEnv, got in_keys=\['observation'\]",
            ),
            (
                {"policy": Actor(nn.Linear(1, 2, **F64), in_keys=["latent"], out_keys=["move"])},
                KeyError,
                r"policy must write \['action'\], got out_keys=\['move'\]",
            ),
            (
                {"policy": Actor(nn.Linear(1, 3, **F64), in_keys=["latent"])},
                ValueError,
                r"'action' must have shape \(2, 3, 2\), got \(2, 3, 3\)",
            ),
            (
                {"policy": tanh_policy(distribution_class=Wide), "num_policy_candidates": 2},
                TypeError,
                r"noise common to all rows, got Wide; register its rule .* num_policy_candidates=1",
            ),
            (
                {"policy": tanh_policy(distribution_class=Wide), "num_candidates": 40, "top_k": 5},
                TypeError,
                "drawn with noise common to all rows, got Wide",
            ),
        ],
    )
    def test_refused(self, kwargs: dict[str, Any], error: type[Exception], message: str) -> None:
        with pytest.raises(error, match=message):
            make_planner(CEM, self.SPEC, **kwargs)

    def test_one_plan_of_any_distribution(self) -> None:
        policy = tanh_policy(distribution_class=Wide)
        random = torch.get_rng_state()
        planner = make_planner(CEM, self.SPEC, policy=policy, num_policy_candidates=1)
        assert planner(states(3))["action"].shape == (3, 2)
        assert torch.equal(random, torch.get_rng_state())

    def test_beta_has_no_rule(self) -> None:
        def beta(loc: Tensor, scale: Tensor) -> Distribution:
            return Independent(Beta(loc.exp(), scale), 1)

        with pytest.raises(TypeError, match=r"got Independent\(Beta\); register its rule"):
            make_planner(CEM, self.SPEC, policy=tanh_policy(distribution_class=beta), num_policy_candidates=2)

    def test_a_deterministic_action_must_not_be_random(self) -> None:
        def squashed(loc: Tensor, scale: Tensor) -> Distribution:
            return TransformedDistribution(Independent(Normal(loc, scale), 1), [SigmoidTransform()])

        random = torch.get_rng_state()
        with pytest.raises(
            ValueError, match="draws nothing from the global random state, got one that does, of"
        ):
            make_planner(CEM, self.SPEC, policy=tanh_policy(distribution_class=squashed))
        assert torch.equal(random, torch.get_rng_state())

    def test_a_distribution_of_part_of_the_action(self) -> None:
        spec = Composite(a=Bounded(-1, 1, (1,)), b=Bounded(-1, 1, (1,)))
        policy = ProbabilisticTensorDictSequential(
            TensorDictModule(lambda z: (z, 0.1 + 0 * z, z), ["latent"], ["loc", "scale", "b"]),
            ProbabilisticTensorDictModule(["loc", "scale"], ["a"], distribution_class=TanhNormal),
        )
        with pytest.raises(
            KeyError, match=r"the distribution of policy must hold the actions \['b'\], got \['a'"
        ):
            make_planner(CEM, spec, policy=policy, num_policy_candidates=2)
        assert make_planner(CEM, spec, policy=policy, num_policy_candidates=1)(states(2))["a"].shape == (2, 1)

    def test_a_distribution_that_mixes_rows(self) -> None:
        def joint(loc: Tensor, scale: Tensor) -> Distribution:
            return Independent(Normal(loc, scale), 2)

        with pytest.raises(
            ValueError, match=r"batch shape that begins with \(2, 3\), as what it reads, got Inde"
        ):
            make_planner(
                CEM, self.SPEC, policy=tanh_policy(distribution_class=joint), num_policy_candidates=2
            )

    def test_an_environment_with_an_objective_alone(self) -> None:
        with pytest.raises(TypeError, match="policy needs an environment that imagines step by step"):
            CEM(OwnObjective(), 2, policy=tanh_policy())

    def test_defaults(self) -> None:
        assert make_planner(CEM, self.SPEC).num_policy_candidates == 0
        for num, expected in ((512, 25), (40, 2), (12, 1)):
            planner = make_planner(CEM, self.SPEC, policy=tanh_policy(), num_candidates=num, top_k=4)
            assert planner.num_policy_candidates == expected
