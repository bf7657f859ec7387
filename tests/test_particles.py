"""Particle beliefs: moments, effective size, resampling that is unbiased, refusals."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from torchrl_vjepa.belief import ParticleBelief, effective_sample_size, systematic_resampling
from torchrl_vjepa.distributions import point_estimate, sample

WEIGHTS = torch.tensor([0.5, 0.25, 0.0, 0.05, 0.2], dtype=torch.float64)


def make_belief(*batch: int, num: int = 7, dim: int = 3) -> ParticleBelief:
    return ParticleBelief(torch.randn(*batch, num, dim).double(), torch.randn(*batch, num).double())


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_moments_are_weighted_sums(batch: tuple[int, ...]) -> None:
    belief = make_belief(*batch)
    assert (belief.batch_shape, belief.event_shape, belief.num_particles) == (batch, (3,), 7)
    assert belief.mean.shape == belief.variance.shape == belief.mode.shape == (*batch, 3)
    rows = zip(
        belief.particles.reshape(-1, 7, 3),
        belief.log_weights.reshape(-1, 7).exp(),
        belief.mean.reshape(-1, 3),
        belief.variance.reshape(-1, 3),
        belief.covariance_matrix.reshape(-1, 3, 3),
        belief.mode.reshape(-1, 3),
        belief.entropy().reshape(-1),
        strict=True,
    )
    for z, w, mean, variance, covariance, mode, entropy in rows:
        torch.testing.assert_close(w.sum(), torch.ones(()).double())
        expected = sum(w[k] * z[k] for k in range(7))
        torch.testing.assert_close(mean, expected)
        spread = sum(w[k] * torch.outer(z[k] - expected, z[k] - expected) for k in range(7))
        torch.testing.assert_close(covariance, spread)
        torch.testing.assert_close(variance, spread.diagonal())
        assert torch.equal(mode, z[w.argmax()])
        torch.testing.assert_close(entropy, -(w * w.log()).sum())


def test_equal_weights_are_the_default() -> None:
    particles = torch.randn(2, 10, 3)
    belief = ParticleBelief(particles)
    torch.testing.assert_close(belief.mean, particles.mean(1))
    torch.testing.assert_close(belief.variance, particles.var(1, unbiased=False))
    torch.testing.assert_close(belief.entropy(), torch.full((2,), math.log(10)))
    torch.testing.assert_close(belief.effective_sample_size, torch.full((2,), 10.0))


def test_a_belief_does_not_depend_on_the_order_of_its_particles() -> None:
    belief = make_belief(2)
    order = torch.randperm(7)
    other = ParticleBelief(belief.particles[:, order], belief.log_weights[:, order])
    for name in ("mean", "variance", "covariance_matrix", "mode", "effective_sample_size"):
        torch.testing.assert_close(getattr(other, name), getattr(belief, name))
    torch.testing.assert_close(other.entropy(), belief.entropy())


@given(st.floats(-700, 700), st.integers(1, 50))
def test_effective_sample_size(shift: float, equal: int) -> None:
    log_weights = torch.full((60,), -math.inf, dtype=torch.float64)
    log_weights[:equal] = shift
    assert effective_sample_size(log_weights).item() == pytest.approx(equal)
    some = torch.randn(3, 9, dtype=torch.float64)
    weights = some.softmax(-1)
    torch.testing.assert_close(effective_sample_size(some + shift), 1 / weights.square().sum(-1))


def test_draws_have_the_weights_as_frequencies() -> None:
    particles = torch.arange(5.0).double().unsqueeze(-1).expand(2, 5, 1)
    log_weights = torch.stack([WEIGHTS, WEIGHTS.flip(0)]).log()
    belief = ParticleBelief(particles, log_weights)
    num = 40_000
    draws = belief.sample((num // 4, 4), generator=torch.Generator().manual_seed(0))
    assert draws.shape == (num // 4, 4, 2, 1)
    for row, weights in enumerate(log_weights.exp()):
        found = torch.bincount(draws[..., row, 0].reshape(-1).long(), minlength=5) / num
        error = (weights * (1 - weights) / num).sqrt()
        assert ((found - weights).abs() <= 5 * error).all()
    for other in (sample(belief, (3,)), point_estimate(belief, "sample").unsqueeze(0)):
        assert other.shape[1:] == (2, 1)
    assert torch.equal(point_estimate(belief, "mean"), belief.mean)
    assert belief.sample((0,)).shape == (0, 2, 1)


def test_randomness_comes_from_the_generator() -> None:
    belief = make_belief(4)
    state = torch.get_rng_state()
    draws: list[Callable[[torch.Generator], Tensor]] = [
        lambda g: belief.sample((5,), generator=g),
        lambda g: belief.resample(generator=g).particles,
        lambda g: sample(belief, (5,), generator=g),
        lambda g: systematic_resampling(belief.log_weights, 100, generator=g),
    ]
    for draw in draws:
        one, again, other = (draw(torch.Generator().manual_seed(seed)) for seed in (0, 0, 1))
        assert torch.equal(one, again)
        assert not torch.equal(one, other)
    assert torch.equal(torch.get_rng_state(), state)


# --- systematic resampling


@pytest.mark.parametrize("num", [1, 5, 13])
def test_resampling_is_unbiased_and_close(num: int) -> None:
    """Every count is the floor or the ceiling of M w, and M w on average."""
    rows = 20_000
    generator = torch.Generator().manual_seed(0)
    index = systematic_resampling(WEIGHTS.log().expand(rows, 5), num, generator=generator)
    assert index.shape == (rows, num)
    assert index.dtype == torch.int64
    assert (index.diff(dim=-1) >= 0).all()
    counts = torch.nn.functional.one_hot(index, 5).sum(1).double()
    expected = num * WEIGHTS
    assert (counts >= (expected - 1e-9).floor()).all()
    assert (counts <= (expected + 1e-9).ceil()).all()
    error = counts.std(0) / rows**0.5
    assert ((counts.mean(0) - expected).abs() <= 5 * error + 1e-9).all()
    assert not counts[:, 2].any()


def test_resampling_keeps_the_mean_of_the_belief() -> None:
    belief = ParticleBelief(torch.randn(20, 3), torch.randn(20)).expand((20_000,))
    new = belief.resample(8, generator=torch.Generator().manual_seed(0))
    assert new.particles.shape == (20_000, 8, 3)
    torch.testing.assert_close(new.effective_sample_size, torch.full((20_000,), 8.0))
    means = new.mean
    error = means.std(0) / len(means) ** 0.5
    assert ((means.mean(0) - belief.mean[0]).abs() < 5 * error).all()


def test_one_number_for_all_rows() -> None:
    log_weights = torch.randn(50, 9)
    index = systematic_resampling(log_weights, 4, shared=True, generator=torch.Generator().manual_seed(3))
    for row in range(50):
        alone = systematic_resampling(
            log_weights[row], 4, shared=True, generator=torch.Generator().manual_seed(3)
        )
        assert torch.equal(index[row], alone)
    same = log_weights[:1].expand(50, 9)
    assert (systematic_resampling(same, 4, shared=True).diff(dim=0) == 0).all()
    assert (systematic_resampling(same, 4).diff(dim=0) != 0).any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("uniform", [0.0, 1 - 2**-24])
def test_a_particle_of_weight_zero_is_never_drawn(
    dtype: torch.dtype, uniform: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where rounding carries the last position to one."""
    monkeypatch.setattr(torch, "rand", lambda shape, **kwargs: torch.full(shape, uniform, dtype=dtype))
    num = 20_001
    log_weights = torch.zeros(num, dtype=dtype)
    log_weights[[0, -1]] = -math.inf
    log_weights[7:9] = -math.inf
    index = systematic_resampling(log_weights)
    counts = torch.bincount(index, minlength=num)
    assert not counts[[0, 7, 8, num - 1]].any()
    # Equal weights: once each, but for rounding.
    assert counts.max() <= 2


def test_resampling_is_the_identity_for_equal_weights() -> None:
    assert torch.equal(systematic_resampling(torch.zeros(3, 64)), torch.arange(64).expand(3, 64))


# --- refusals


@pytest.mark.parametrize(
    ("particles", "log_weights", "message"),
    [
        (torch.zeros(2, 0, 3), None, "K of at least 1, got \\(2, 0, 3\\)"),
        (torch.zeros(3), None, "particles must have shape"),
        (torch.zeros(2, 4, 3), torch.zeros(2, 3), "log_weights must have shape \\(2, 4\\)"),
        (torch.full((4, 3), math.nan), None, "particles must be finite"),
        (torch.zeros(2, 3), torch.tensor([0.0, math.nan]), "below infinity, got nan or inf"),
        (torch.zeros(2, 3), torch.tensor([0.0, math.inf]), "below infinity, got nan or inf"),
        (
            torch.zeros(2, 2, 3),
            torch.tensor([[0.0, -math.inf], [-math.inf, -math.inf]]),
            "a row of zero weights",
        ),
    ],
)
def test_bad_beliefs_are_refused(particles: Tensor, log_weights: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ParticleBelief(particles, log_weights)


def test_empty_weights_are_refused() -> None:
    for function in (effective_sample_size, systematic_resampling):
        with pytest.raises(ValueError, match="K of at least 1"):
            function(torch.zeros(3, 0))
    with pytest.raises(ValueError, match="num_samples must be positive, got 0"):
        systematic_resampling(torch.zeros(3), 0)
