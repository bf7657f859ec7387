"""Surprise: log-densities, its mean on the true model, what raises it and what does not."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.distributions import Distribution, MultivariateNormal

from torchrl_vjepa.belief import surprise
from torchrl_vjepa.distributions import diag_gaussian
from torchrl_vjepa.heads import DeltaHead
from torchrl_vjepa.noisy_tv import LinearGaussianSystem
from torchrl_vjepa.predictor import Predictor


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("last", [True, False])
def test_it_is_the_negative_log_density(batch: tuple[int, ...], last: bool) -> None:
    predictor = Predictor(4, action_dim=2)
    latents, actions = torch.randn(*batch, 6, 4), torch.randn(*batch, 6, 2)
    value = surprise(predictor.dist, latents, actions if last else actions[..., :-1, :])
    assert value.shape == (*batch, 5)
    for t in range(5):
        p = predictor.dist(latents[..., t, :], actions[..., t, :])
        torch.testing.assert_close(value[..., t], -p.log_prob(latents[..., t + 1, :]))


def test_expected_surprise_is_the_entropy() -> None:
    system = LinearGaussianSystem(control_dim=2, seed=1)
    covariance = system.signal_std**2 * torch.eye(4).double()

    def transition(latent: Tensor, action: Tensor) -> Distribution:
        return MultivariateNormal(latent @ system.A.mT + action @ system.B.mT, covariance)

    data = system.simulate(200, 8.0, torch.randn(200, 2), batch_size=(50,), dtype=torch.float64)
    value = surprise(transition, data["signal"], data["action"])
    entropy = 2 * math.log(2 * math.pi * math.e) + 4 * math.log(system.signal_std)
    assert abs(value.mean() - entropy) < 4 * math.sqrt(2 / value.numel())  # Var = D / 2
    # An actuator that has lost its strength is seen at once.
    weak = system.simulate(200, 8.0, 0.5 * data["action"][0], batch_size=(50,), dtype=torch.float64)
    assert surprise(transition, weak["signal"], data["action"]).mean() > entropy + 1


def walk(latent: Tensor, action: Tensor) -> Distribution:
    return diag_gaussian(latent + action, torch.ones_like(latent[..., :1]))


@pytest.mark.parametrize(
    ("latents", "actions", "message"),
    [
        ((1, 2), (1, 2), "T of at least 2, got \\(1, 2\\)"),
        ((4,), (4,), "latents must have shape"),
        ((5, 2), (3, 2), "actions must have shape"),
        ((3, 5, 2), (5, 2), "actions must have shape"),
    ],
)
def test_bad_shapes_are_refused(latents: tuple[int, ...], actions: tuple[int, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        surprise(walk, torch.zeros(latents), torch.zeros(actions))


def test_nan_and_point_masses_are_refused() -> None:
    latents = torch.zeros(4, 2)
    latents[2, 0] = math.nan
    with pytest.raises(ValueError, match="latents must be finite"):
        surprise(walk, latents, torch.zeros(4, 2))
    with pytest.raises(ValueError, match="got a point mass: use a probabilistic head"):
        surprise(Predictor(2, action_dim=2, head=DeltaHead()).dist, torch.zeros(4, 2), torch.zeros(4, 2))
