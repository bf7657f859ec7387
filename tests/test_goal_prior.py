"""GoalPrior: frozen and learned mappers, and the target encoder that a loss hands out."""

from __future__ import annotations

import copy
import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import (
    JEPA,
    VJEPA,
    GoalPrior,
    JEPALoss,
    Predictor,
    VJEPALoss,
    diag_gaussian,
    linear_encoder,
)

OBS, D = 6, 3


class Spread(nn.Module):
    """A mapper with a spread of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(2, 32), nn.Tanh(), nn.Linear(32, 2 * D))

    def forward(self, task: Tensor) -> Distribution:
        mean, log_var = self.net(task).chunk(2, -1)
        return diag_gaussian(mean, log_var=log_var)


@pytest.mark.parametrize("std", [0.5, torch.tensor([0.1, 1.0, 2.0])])
def test_density_is_the_gaussian_around_the_mapped_goal(std: Any) -> None:
    encoder = linear_encoder(OBS, D)
    prior = GoalPrior(encoder, std=std)
    goal, latent = torch.randn(4, OBS), torch.randn(7, 4, D)
    expected = diag_gaussian(goal @ encoder.module.network.weight.mT, torch.as_tensor(std).expand(D))
    torch.testing.assert_close(prior.log_prob(latent, goal), expected.log_prob(latent))


def test_a_frozen_mapper_is_a_constant() -> None:
    """A copy where its parameters could learn, itself where they cannot; the task keeps its gradient."""
    net = nn.Linear(2, D)
    prior = GoalPrior(net, std=1.0)
    task, latent = torch.randn(5, 2, requires_grad=True), torch.zeros(5, D)
    before = prior.energy(latent, task)
    before.sum().backward()
    assert task.grad is not None
    assert task.grad.any()
    assert net.weight.requires_grad
    assert net.weight.grad is None
    assert not any(p.requires_grad for p in prior.parameters())
    with torch.no_grad():
        net.weight.add_(1.0)
    assert torch.equal(prior.energy(latent, task), before)
    net.requires_grad_(False)
    assert GoalPrior(net, std=1.0).mapper is net
    # It moves and saves with the prior.
    twin = GoalPrior(nn.Linear(2, D), std=2.0)
    twin.load_state_dict(prior.state_dict())
    assert torch.equal(twin.energy(latent, task), before)


def test_a_mapper_that_is_not_frozen_is_the_priors() -> None:
    net = nn.Linear(2, D)
    prior = GoalPrior(net, std=1.0, frozen=False)
    assert list(prior.parameters()) == list(net.parameters())
    prior.energy(torch.zeros(5, D), torch.randn(5, 2)).sum().backward()
    assert net.weight.grad is not None


@pytest.mark.parametrize("spread", [False, True])
def test_a_mapper_learns_by_maximum_likelihood(spread: bool) -> None:
    """Latents are a function of the task plus noise of 0.1: both are found."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        true = torch.tensor([[1.0, -1.0], [0.5, 2.0], [0.0, 1.0]])
        task = torch.randn(512, 2)
        latent = task @ true.mT + 0.1 * torch.randn(512, D)
        mapper = Spread() if spread else nn.Linear(2, D)
        prior = GoalPrior(mapper, std=None if spread else 0.1, frozen=False)
        optimizer = torch.optim.Adam(prior.parameters(), lr=2e-2)
        for _ in range(400):
            loss = -prior(task).log_prob(latent).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        held_out = torch.randn(256, 2)
        p = prior(held_out)
    assert isinstance(p, Distribution)
    assert ((p.mean - held_out @ true.mT).square().mean().sqrt() < 0.1).item()
    assert 0.07 < p.stddev.median().item() < 0.13


@pytest.mark.parametrize("several", [False, True])
def test_the_target_encoder_of_a_loss(several: bool) -> None:
    """The averaged parameters, of the model that is asked for; later updates do not reach it."""
    models = [VJEPA(linear_encoder(OBS, D), Predictor(D)) for _ in range(2 if several else 1)]
    loss = VJEPALoss(models if several else models[0], collapse_rank=0.0)
    updater = SoftUpdate(loss, eps=0.5)
    start = [copy.deepcopy(model.encoder.module.network.weight.detach()) for model in models]
    index = len(models) - 1
    with torch.no_grad():
        for parameter in loss.encoder_params.values(True, True):
            parameter.add_(1.0)
    updater.step()
    encoder = loss.target_encoder(index if several else None)
    weight = encoder.module.network.weight
    torch.testing.assert_close(weight.detach(), start[index] + 0.5)
    assert not weight.requires_grad
    assert not encoder.training
    assert models[index].encoder.module.network.weight is not weight
    updater.step()
    torch.testing.assert_close(weight.detach(), start[index] + 0.5)
    goal = torch.randn(4, OBS)
    p = GoalPrior(encoder, std=0.1)({"task": goal})
    assert isinstance(p, Distribution)
    torch.testing.assert_close(p.mean, goal @ weight.mT)
    # The loss and its model still train.
    terms = loss(TensorDict(observation=torch.randn(4, 5, OBS), batch_size=(4, 5)))
    terms["loss_nll"].sum().backward()
    with pytest.raises(ValueError, match="index must be"):
        loss.target_encoder(None if several else 0)


def test_the_target_encoder_reads_the_encoders_own_buffers() -> None:
    class Shifted(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = nn.Linear(OBS, D)
            self.register_buffer("shift", torch.zeros(D))

        def forward(self, observation: Tensor) -> Tensor:
            return self.net(observation) + self.shift

    encoder = TensorDictModule(Shifted(), in_keys=["observation"], out_keys=["latent"])
    loss = JEPALoss(JEPA(encoder, Predictor(D)))
    SoftUpdate(loss, eps=0.5)
    encoder.module.shift.fill_(7.0)
    assert loss.target_encoder().module.shift.tolist() == [7.0] * D


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (lambda: GoalPrior(), ValueError, "std must be given where the task is a latent"),
        (lambda: GoalPrior(std=1.0, task_ndim=3), ValueError, "task_ndim must be 1 where the task is a lat"),
        (lambda: GoalPrior(std=-1.0), ValueError, "std must be positive, got"),
        (lambda: GoalPrior(std=math.nan), ValueError, "std must be a finite number"),
        (lambda: GoalPrior(std=torch.ones(2), latent_dim=D), ValueError, r"of shape \(3,\)"),
        (lambda: GoalPrior(3, std=1.0), TypeError, "mapper must be callable or None, got int"),  # type: ignore[arg-type] (meant)
        (
            lambda: GoalPrior(
                TensorDictModule(nn.Bilinear(2, 2, D), in_keys=["a", "b"], out_keys=["latent"]), std=1.0
            ),
            ValueError,
            "mapper must read one entry, the task, got in_keys",
        ),
        (lambda: GoalPrior(Spread(), std=1.0)(torch.zeros(2)), ValueError, "std must be None for a mapper"),
        (lambda: GoalPrior(nn.Linear(2, D))(torch.zeros(2)), TypeError, "mapper must return a distribution"),
        (
            lambda: GoalPrior(nn.Linear(2, D), std=1.0, latent_dim=4)(torch.zeros(5, 2)),
            ValueError,
            r"mapper's output must have shape \(5, 4\), got \(5, 3\)",
        ),
        (
            lambda: GoalPrior(lambda task: task.sum(-1), std=1.0)(torch.zeros(5, 2)),
            ValueError,
            r"mapper's output must have shape \(5, 'D'\), got \(5,\)",
        ),
        (
            lambda: GoalPrior(std=torch.ones(D))(torch.zeros(5, 1)),
            ValueError,
            r"task must have shape \(5, 3\), got \(5, 1\)",
        ),
        (
            lambda: GoalPrior(nn.Linear(2, D), std=1.0, task_ndim=3)(torch.zeros(5, 2)),
            ValueError,
            r"task must have shape \(\*B, \*task\) with 3 task dimensions, got \(5, 2\)",
        ),
        (
            lambda: GoalPrior(lambda t: t.log(), std=1.0).bind(-torch.ones(D)),
            ValueError,
            "the prior's moments must be finite",
        ),
    ],
)
def test_bad_arguments_are_refused(build: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        build()
