"""Tasks in a row: as priors they leave the first one as it was, as rewards to fine-tune on they do not."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Bounded
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import (
    CEM,
    JEPA,
    Ball,
    DeltaHead,
    GoalPrior,
    JEPALoss,
    LatentEnv,
    Predictor,
    ProductPrior,
    QuadraticReward,
    RegionPrior,
    RewardLoss,
    linear_encoder,
)

STEP = 0.3
GOALS = torch.tensor([[(-1.0) ** i, i / 5 - 1] for i in range(10)])


def random_steps(goal: Tensor) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    actions = 2 * torch.rand(64, 8, 2, generator=generator) - 1
    start = torch.randn(64, 1, 2, generator=generator)
    after = start + STEP * actions.cumsum(1)
    before = torch.cat([start, after[:, :-1]], dim=1)
    reward = -(after - goal).square().sum(-1, keepdim=True)
    done = torch.zeros(64, 8, 1, dtype=torch.bool)
    following = TensorDict(observation=after, reward=reward, done=done, batch_size=[64, 8])
    return TensorDict(observation=before, action=actions, next=following, batch_size=[64, 8])


def descend(
    loss: torch.nn.Module, data: TensorDict, steps: int, lr: float, updater: SoftUpdate | None
) -> None:
    optimizer = torch.optim.Adam(loss.parameters(), lr=lr)
    for _ in range(steps):
        losses = loss(data)
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        optimizer.step()
        optimizer.zero_grad()
        if updater is not None:
            updater.step()


@pytest.fixture(scope="module", autouse=True)
def seeded() -> Iterator[None]:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


@pytest.fixture(scope="module")
def model(seeded: None) -> JEPA:
    """A point that is moved by its action, learned without any reward."""
    model = JEPA(linear_encoder(2, 2), Predictor(2, action_dim=2, head=DeltaHead()))
    loss = JEPALoss(model, marginal_entropy_coeff=1.0)
    descend(loss, random_steps(GOALS[0]), 200, 0.03, SoftUpdate(loss, eps=0.9))
    return model


def cost(model: JEPA, planner: CEM, wanted: Tensor, **task: Tensor) -> float:
    """Squared distance of the true position to the goal, mean of 12 steps."""
    planner.set_seed(0)
    position, total = torch.zeros(1, 2), 0.0
    for _ in range(12):
        td = TensorDict(observation=position, **task, batch_size=[1])
        with torch.no_grad():
            action = planner(model.encoder(td))["action"]
        position = position + STEP * action
        total += (position - wanted).square().sum().item() / 12
    return total


def make_planner(world: LatentEnv) -> CEM:
    return CEM(world, planning_horizon=4, optim_steps=3, num_candidates=64, warm_start=False)


def test_ten_tasks_leave_the_first_one_exactly_as_it_was(model: JEPA) -> None:
    wall = RegionPrior(Ball(torch.zeros(2), 0.3), "out", sharpness=10.0, task_key="obstacle")
    prior = ProductPrior(GoalPrior(model.encoder, std=0.1, task_key="goal"), wall)
    planner = make_planner(LatentEnv(model, action_spec=Bounded(-1, 1, (2,)), prior=prior))
    before = copy.deepcopy(model.state_dict())

    def run(k: int) -> float:
        obstacle = torch.full((1, 2), 100.0 if k % 2 == 0 else 0.5)
        return cost(model, planner, GOALS[k], goal=GOALS[k : k + 1], obstacle=obstacle)

    costs = [run(k) for k in range(10)]
    assert run(0) == costs[0]
    assert costs[0] < 0.5 * GOALS[0].square().sum()
    after = model.state_dict()
    assert all(torch.equal(value, after[key]) for key, value in before.items())


def test_a_model_that_is_fine_tuned_forgets(model: JEPA) -> None:
    model = copy.deepcopy(model)
    head = QuadraticReward(2, 2)
    reward_model = TensorDictModule(head, in_keys=["latent", "action"], out_keys=["reward"])
    costs = []
    for goal in GOALS[:4]:
        descend(RewardLoss(model, reward_model, train_model=True), random_steps(goal), 150, 0.05, None)
        world = LatentEnv(model, action_spec=Bounded(-1, 1, (2,)), reward_model=reward_model)
        costs.append(cost(model, make_planner(world), GOALS[0]))
    assert costs[0] < 0.5 * GOALS[0].square().sum()
    assert costs[1] > 2 * costs[0]
    assert costs[-1] > 2 * costs[0]
