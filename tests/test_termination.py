"""Predicted ends: the head's loss, what a plan costs that may end, and the environment's flags."""

from __future__ import annotations

from typing import Any

import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded, OneHot
from torchrl.envs.utils import check_env_specs

from torchrl_vjepa import (
    CEM,
    VJEPA,
    Delta,
    EnvObjective,
    ExhaustiveSearch,
    LatentEnv,
    Predictor,
    TerminationLoss,
    TreeSearch,
    diag_gaussian,
    linear_encoder,
)


def walk(latent: Tensor, action: Tensor) -> Delta:
    return Delta(latent + action)


def noisy_walk(latent: Tensor, action: Tensor) -> Any:
    return diag_gaussian(latent + action, torch.full_like(latent, 0.3))


class Edge(nn.Module):
    """An end where the latent is above one."""

    def __init__(self, sharpness: float = 1e4) -> None:
        super().__init__()
        self.sharpness = sharpness

    def forward(self, latent: Tensor) -> Tensor:
        return self.sharpness * (latent[..., :1] - 1.0)


def one(latent: Tensor, action: Tensor) -> Tensor:
    return torch.ones_like(latent[..., 0])


def make_env(sharpness: float = 1e4, model: Any = walk, **kwargs: Any) -> LatentEnv:
    head = TensorDictModule(Edge(sharpness), ["latent"], ["termination_logit"])
    kwargs.setdefault("cost", one)
    kwargs.setdefault("action_spec", Bounded(-1, 1, (1,)))
    return LatentEnv(model, latent_dim=1, termination_model=head, **kwargs)


class TestPlanning:
    def test_costs_count_up_to_the_end(self) -> None:
        env = make_env()
        plans = torch.tensor([[0.6, 0.6, 0.6, 0.6], [0.1, 0.1, 0.1, 0.1], [0.9, 0.9, -0.9, -0.9]])
        costs = env.objective(torch.zeros(1), plans.unsqueeze(-1))
        assert costs.tolist() == [2.0, 4.0, 2.0]  # an episode that ended does not come back

    def test_expected_cost_of_uncertain_ends(self) -> None:
        env = make_env(sharpness=2.0, termination_cost=5.0)
        actions = torch.randn(3, 6, 1) * 0.5
        latents = actions.cumsum(1)
        p = torch.sigmoid(2.0 * (latents[..., 0] - 1.0))
        expected, alive = torch.zeros(3), torch.ones(3)
        for k in range(6):
            expected = expected + alive * (1.0 + 5.0 * p[:, k])
            alive = alive * (1 - p[:, k])
        torch.testing.assert_close(env.objective(torch.zeros(1), actions), expected)

    def test_agrees_with_stepping(self) -> None:
        env = make_env(termination_cost=3.0)
        actions = torch.rand(5, 7, 4, 1) - 0.3
        state = TensorDict(latent=torch.rand(5, 1) * 0.5, batch_size=[5])
        stepped = EnvObjective(env)
        torch.testing.assert_close(
            env.objective(state["latent"], actions), stepped.objective(stepped.planning_state(state), actions)
        )

    def test_a_planner_avoids_an_end_that_costs(self) -> None:
        def towards_two(latent: Tensor, action: Tensor) -> Tensor:
            return (latent[..., 0] - 2.0).square()

        state = TensorDict(latent=torch.tensor([0.5]))
        kwargs: dict[str, Any] = {"planning_horizon": 4, "optim_steps": 6, "num_candidates": 256, "seed": 0}
        careless = CEM(make_env(sharpness=20.0, cost=towards_two), **kwargs)(state.clone())
        careful = CEM(make_env(sharpness=20.0, cost=towards_two, termination_cost=100.0), **kwargs)
        plan = careful(state.clone())["next", "plan"]
        assert careless["action"] > 0.5  # over the edge: positive costs end there
        assert (0.5 + careful(state.clone())["action"] + plan.cumsum(0) < 1.05).all()

    def test_gradients_flow_through_the_probability(self) -> None:
        env = make_env(sharpness=2.0, termination_cost=10.0)
        actions = torch.zeros(1, 3, 1, requires_grad=True)
        (gradient,) = torch.autograd.grad(env.objective(torch.zeros(1), actions).sum(), actions)
        assert (gradient > 0).all()  # towards the edge is dearer


class TestStepping:
    def test_flags_follow_the_logit(self) -> None:
        env = make_env()
        check_env_specs(env)
        td = TensorDict(latent=torch.tensor([[0.0], [0.9]]), action=torch.full((2, 1), 0.5), batch_size=[2])
        out = env.step(td)["next"]
        assert out["terminated"].flatten().tolist() == [False, True]
        assert out["done"].flatten().tolist() == [False, True]

    def test_sampled_ends_have_their_probability(self) -> None:
        env = make_env(sharpness=1.0, model=noisy_walk, how="sample")
        env.set_seed(0)
        num = 20_000
        td = TensorDict(latent=torch.zeros(num, 1), action=torch.zeros(num, 1), batch_size=[num])
        out = env.step(td)["next"]
        probability = torch.sigmoid(out["latent"] - 1.0)
        error = (probability * (1 - probability)).sum().sqrt() / num
        assert (out["terminated"].double().mean() - probability.mean()).abs() < 4 * error

    def test_an_end_costs_in_the_reward(self) -> None:
        env = make_env(termination_cost=7.0)
        td = TensorDict(latent=torch.tensor([0.9]), action=torch.tensor([0.5]))
        assert env.step(td)["next", "reward"].item() == -8.0


@pytest.mark.parametrize(
    ("head", "error", "message"),
    [
        (Edge(), TypeError, r"termination_model must be a TensorDictModule, for instance .*nn\.Linear"),
        (
            TensorDictModule(Edge(), ["z"], ["termination_logit"]),
            KeyError,
            "termination_model must read only latent_key='latent'",
        ),
        (
            TensorDictModule(Edge(), ["latent"], ["end"]),
            KeyError,
            "termination_model must write 'termination_logit'",
        ),
        (
            TensorDictModule(nn.Linear(1, 2), ["latent"], ["termination_logit"]),
            ValueError,
            r"termination_model must return a tensor of shape \(2, 3, 1\)",
        ),
    ],
)
def test_bad_heads_are_refused(head: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        LatentEnv(walk, action_spec=Bounded(-1, 1, (1,)), cost=one, latent_dim=1, termination_model=head)


def make_loss(**kwargs: Any) -> TerminationLoss:
    model = VJEPA(linear_encoder(3, 2), Predictor(2, action_dim=1))
    head = TensorDictModule(nn.Linear(2, 1), ["latent"], ["termination_logit"])
    return TerminationLoss(model, head, **kwargs)


def windows() -> TensorDict:
    terminated = torch.rand(6, 5, 1) < 0.3
    following = TensorDict(
        terminated=terminated, done=terminated, reward=torch.randn(6, 5, 1), batch_size=(6, 5)
    )
    return TensorDict(
        observation=torch.randn(6, 5, 3), action=torch.randn(6, 5, 1), next=following, batch_size=(6, 5)
    )


class TestLoss:
    def test_is_the_cross_entropy_of_imagined_latents(self) -> None:
        loss, data = make_loss(positive_weight=3.0), windows()
        losses = loss(data)
        predicted = loss.predictor.dist(loss.encoder.module(data["observation"]), data["action"]).mean
        logit = loss.termination_model.module(predicted)
        target = data["next", "terminated"].float()
        expected = F.binary_cross_entropy_with_logits(logit, target, pos_weight=torch.tensor(3.0))
        torch.testing.assert_close(losses["loss_termination"], expected)
        wrong = ((logit > 0) != data["next", "terminated"]).float().mean()
        torch.testing.assert_close(losses["termination_error"], wrong)

    def test_rollouts_do_not_cross_an_end(self) -> None:
        loss, data = make_loss(num_steps=2, reduction="none"), windows()
        values = loss(data)["loss_termination"]
        crossed = data["next", "done"].squeeze(-1)[:, :-1]
        assert not values[:, :-1][crossed].any()
        assert not values[:, -1].any()
        assert values[:, :-1][~crossed].all()

    def test_gradients_reach_the_head_alone(self) -> None:
        loss = make_loss()
        loss(windows())["loss_termination"].backward()
        assert {name.split(".")[0] for name, _ in loss.named_parameters()} == {"termination_model_params"}
        assert all(parameter.grad is not None for parameter in loss.parameters())
        both = make_loss(train_model=True)
        both(windows())["loss_termination"].backward()
        assert all(p.grad is not None for p in both.encoder.parameters())

    def test_learns_where_episodes_end(self) -> None:
        model = VJEPA(linear_encoder(1, 1), Predictor(1, action_dim=1))
        with torch.no_grad():
            next(model.encoder.parameters()).fill_(1.0)
            model.predictor.trunks[0].weight.copy_(torch.tensor([[1.0, 1.0], [0.0, 0.0]]))
        head = TensorDictModule(nn.Linear(1, 1), ["latent"], ["termination_logit"])
        loss = TerminationLoss(model, head)
        observation, action = torch.randn(64, 8, 1), torch.randn(64, 8, 1)
        following = TensorDict(terminated=observation + action > 1.0, batch_size=(64, 8))
        following["done"] = torch.zeros(64, 8, 1, dtype=torch.bool)
        data = TensorDict(observation=observation, action=action, next=following, batch_size=(64, 8))
        optimizer = torch.optim.Adam(loss.parameters(), lr=0.3)
        for _ in range(200):
            loss(data)["loss_termination"].backward()
            optimizer.step()
            optimizer.zero_grad()
        edge = -head.module.bias / head.module.weight
        assert abs(edge.item() - 1.0) < 0.05
        assert loss(data)["termination_error"] < 0.02

    @pytest.mark.parametrize(
        ("kwargs", "message"),
        [
            ({"positive_weight": 0.0}, "positive_weight must be positive and finite, got 0.0"),
            ({"positive_weight": float("inf")}, "positive_weight must be positive and finite"),
            ({"num_steps": 0}, "num_steps must be positive, got 0"),
        ],
    )
    def test_bad_arguments_are_refused(self, kwargs: dict[str, Any], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            make_loss(**kwargs)

    def test_a_plain_module_is_refused(self) -> None:
        model = VJEPA(linear_encoder(3, 2), Predictor(2, action_dim=1))
        with pytest.raises(TypeError, match="termination_model must be a TensorDictModule"):
            TerminationLoss(model, nn.Linear(2, 1))
        with pytest.raises(TypeError, match="of several, give each a TerminationLoss of its own"):
            TerminationLoss([model], TensorDictModule(nn.Linear(2, 1), ["latent"], ["l"]))

    def test_keys_can_be_renamed(self) -> None:
        loss, data = make_loss(), windows()
        expected = loss(data)["loss_termination"]
        data["next", "crashed"] = data["next"].pop("terminated")
        loss.set_keys(terminated=("next", "crashed"))
        torch.testing.assert_close(loss(data)["loss_termination"], expected)


class TestBehindACertainEnd:
    """Nothing counts there, were it infinite or no number."""

    @staticmethod
    def explosive(factor: float, **kwargs: Any) -> LatentEnv:
        def explode(latent: Tensor, action: Tensor) -> Delta:
            following = factor * (latent.abs() + 2)
            return Delta(torch.where(following.isinf(), torch.nan, following))

        def square(latent: Tensor, action: Tensor) -> Tensor:
            return latent[..., 0].square()

        return make_env(
            model=explode,
            cost=square,
            action_spec=OneHot(2, dtype=torch.float32),
            termination_cost=7.0,
            **kwargs,
        )

    @pytest.mark.parametrize("factor", [1e12, 1e20])  # squares overflow, latents themselves
    def test_plans_cost_what_they_did_before(self, factor: float) -> None:
        env = self.explosive(factor)
        plans = torch.eye(2)[:, None].expand(2, 5, 2)
        cost = env.objective(torch.zeros(1), plans)
        if factor == 1e12:
            assert (cost == (2 * torch.tensor(factor)).square() + 7.0).all()
        assert not cost.isnan().any()
        value = env.objective(torch.zeros(1), plans, terminal_value=lambda z: z[..., 0] * torch.nan)
        torch.testing.assert_close(value, cost)

    @pytest.mark.parametrize("cls", [CEM, ExhaustiveSearch, TreeSearch])
    def test_every_planner_sees_the_same(self, cls: type[Any]) -> None:
        env = self.explosive(1e12)
        planner = cls(env, 5, seed=0, return_stats=True, terminal_value=lambda z: z[..., 0] * torch.nan)
        out = planner(TensorDict(latent=torch.zeros(1)))
        plan = planner.plan(torch.zeros(1), planner.family.cold((), 5))
        expected = (2 * torch.tensor(1e12)).square() + 7.0
        torch.testing.assert_close(plan.best_cost, expected)
        torch.testing.assert_close(out["plan_stats", "cost"], expected[None])

    def test_before_it_faults_are_faults(self) -> None:
        env = make_env(sharpness=1.0, cost=lambda latent, action: latent[..., 0] * torch.nan)
        assert env.objective(torch.zeros(1), torch.ones(1, 3, 1)).isnan().all()
