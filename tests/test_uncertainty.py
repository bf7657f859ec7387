"""What examples/uncertainty.py computes: fits, routes and the oracle against closed forms."""

from __future__ import annotations

import importlib
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_vjepa import KalmanFilter, linear_encoder
from torchrl_vjepa.models import VJEPA
from torchrl_vjepa.predictor import Predictor


@pytest.fixture(scope="module")
def example() -> Any:
    """The script as a module: pytest knows the folder."""
    return importlib.import_module("uncertainty")


class World:
    """A hidden signal s' = A s + w, seen as latents z = s + n: the exact covariances are known."""

    def __init__(self, length: int, noise_std: float, decay: float = 0.9) -> None:
        generator = torch.Generator().manual_seed(0)
        self.matrix = decay * torch.tensor([[0.8, -0.6], [0.6, 0.8]], dtype=torch.float64)
        self.process = torch.tensor([[1.0, 0.3], [0.3, 0.5]]).double()
        self.noise = noise_std**2 * torch.eye(2).double()
        w = torch.randn(length, 2, generator=generator).double() @ torch.linalg.cholesky(self.process).mT
        signal = [torch.zeros(2).double()]
        for step in w[1:]:
            signal.append(self.matrix @ signal[-1] + step)
        noise = noise_std * torch.randn(length, 2, generator=generator).double()
        self.data = TensorDict(observation=torch.stack(signal) + noise, batch_size=length).unsqueeze(0)
        encoder = linear_encoder(2, 2)
        with torch.no_grad():
            encoder.module.network.weight.copy_(torch.eye(2))
        self.model = VJEPA(encoder, Predictor(2), target_scale=nn.Identity()).double()


@pytest.fixture(scope="module")
def world() -> World:
    return World(20_000, 0.7)


def test_the_fit_has_the_moments_of_the_errors(example: Any, world: World) -> None:
    belief = example.fit_belief(world.model, world.data, 4)
    latent = world.data["observation"][0]
    means, covariances = example.direct(belief, latent)
    assert means.shape == (20_000, 4, 2)
    assert covariances.shape == (4, 2, 2)
    for h in range(1, 5):
        error = latent[h:] - means[:-h, h - 1]
        torch.testing.assert_close(latent[:-h].mT @ error, torch.zeros(2, 2).double(), atol=1e-6, rtol=0)
        torch.testing.assert_close(error.mean(0), torch.zeros(2).double(), atol=1e-9, rtol=0)
        torch.testing.assert_close(covariances[h - 1], error.mT @ error / len(error), rtol=1e-3, atol=1e-4)


def test_iterating_is_matrix_powers(example: Any, world: World) -> None:
    belief = example.fit_belief(world.model, world.data, 3)
    latent = torch.randn(5, 2).double()
    means, covariances = example.iterated(belief, latent)
    matrix, bias = belief.predictor.trunks[0].weight, belief.predictor.trunks[0].bias
    assert bias.abs().min() > 0
    noise = belief.predictor.dist(latent).covariance_matrix[0]
    for h in range(1, 4):
        powers = [torch.linalg.matrix_power(matrix, k) for k in range(h + 1)]
        drift = sum(p @ bias for p in powers[:h])
        torch.testing.assert_close(means[:, h - 1], latent @ powers[h].mT + drift)
        torch.testing.assert_close(covariances[h - 1], sum(p @ noise @ p.mT for p in powers[:h]))


@pytest.mark.parametrize("noise_std", [0.0, 0.3, 0.7])
def test_iterating_counts_the_sensor_noise_at_every_step(example: Any, noise_std: float) -> None:
    world, h = World(20_000, noise_std, decay=1.0), 8
    belief = example.fit_belief(world.model, world.data, h)
    latent = world.data["observation"][0]
    iterated, direct = (route(belief, latent)[1][-1].trace() for route in (example.iterated, example.direct))
    # For a rotation A: h (Q + 2 N) against h Q + 2 N, in trace.
    process, noise = world.process.trace(), world.noise.trace()
    torch.testing.assert_close(iterated, h * (process + 2 * noise), rtol=0.06, atol=0)
    torch.testing.assert_close(direct, h * process + 2 * noise, rtol=0.06, atol=0)


def test_the_oracle_one_step_ahead_is_the_filters_own(example: Any) -> None:
    settings = example.Settings(test_trajectories=3, length=40, horizon=3)
    data = example.Data.simulate(1, 4.0, settings)
    p = example.kalman(data, 3)
    assert p.batch_shape == (3, 40, 3)
    belief = KalmanFilter(data.system, 4.0).filter(data.test["raw"].double())
    torch.testing.assert_close(p.mean[..., 0, :], belief["next_signal_mean"])
    variance = belief["next_signal_cov"].diagonal(dim1=-2, dim2=-1)
    torch.testing.assert_close(p.variance[..., 0, :], variance)
    a = data.system.A
    torch.testing.assert_close(p.mean[..., 2, :], belief["signal_mean"] @ torch.linalg.matrix_power(a, 3).mT)


def test_targets_are_those_that_many_steps_later(example: Any) -> None:
    series = torch.arange(40.0).reshape(1, 40, 1)
    ahead = example.ahead(series, 3)
    starts = series[:, example.BURN_IN : -3]
    assert ahead.shape == (1, starts.shape[1], 3, 1)
    torch.testing.assert_close(ahead[..., 0], starts + torch.arange(1.0, 4.0))


def test_the_parts_differ_and_scales_share_their_signal(example: Any) -> None:
    settings = example.Settings(length=30, test_trajectories=2)
    quiet, loud = (example.Data.simulate(3, scale, settings) for scale in (0.0, 8.0))
    assert [part.shape for part in quiet[2:]] == [(24, 30), (16, 30), (2, 30)]
    for name in ("train", "held_out", "test"):
        assert torch.equal(getattr(quiet, name)["signal"], getattr(loud, name)["signal"])
    assert not torch.equal(quiet.train["signal"][:2], quiet.test["signal"])
    covariance = torch.cov(loud.train["observation"].flatten(0, 1).mT, correction=0)
    torch.testing.assert_close(covariance, torch.eye(20), atol=2e-3, rtol=0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--horizon", "490"], "--length"),
        (["--horizon", "0"], "at least 1"),
        (["--window", "16"], "--window"),
    ],
)
def test_the_command_line_refuses(
    example: Any, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        example.parse(arguments)
    assert message in capsys.readouterr().err
