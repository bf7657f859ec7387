"""Rollouts of beliefs against matrix powers and the moments of the Kalman prediction."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles import linear_gaussian_moments
from torch import Tensor
from torch.distributions import Distribution, Independent, LogNormal

from torchrl_vjepa.belief import rollout
from torchrl_vjepa.distributions import Delta, diag_gaussian
from torchrl_vjepa.heads import DeltaHead
from torchrl_vjepa.predictor import Predictor

D, A, H = 3, 2, 6


class LinearGaussian:
    """z' = a z + b u + w with independent noise; counts its calls."""

    def __init__(self) -> None:
        generator = torch.Generator().manual_seed(1)
        make = {"generator": generator, "dtype": torch.float64}
        self.a = 0.9 * torch.linalg.qr(torch.randn(D, D, **make)).Q
        self.b = torch.randn(D, A, **make)
        self.scale = torch.rand(D, **make) + 0.1
        self.calls: list[tuple[torch.Size, torch.Size]] = []

    def __call__(self, latent: Tensor, action: Tensor) -> Distribution:
        self.calls.append((latent.shape, action.shape))
        return diag_gaussian(latent @ self.a.mT + action @ self.b.mT, self.scale)

    def moments(self, start: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        return linear_gaussian_moments(self.a, self.b, torch.diag(self.scale**2), start, actions)


@pytest.fixture
def system() -> LinearGaussian:
    return LinearGaussian()


def _problem(*batch: int) -> tuple[Tensor, Tensor]:
    return torch.randn(*batch, D, dtype=torch.float64), torch.randn(*batch, H, A, dtype=torch.float64)


@pytest.mark.parametrize("how", ["mean", "mode"])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_point_rollout_equals_matrix_powers(system: LinearGaussian, how: str, batch: tuple[int, ...]) -> None:
    latent, actions = _problem(*batch)
    out = rollout(system, latent, actions, how)
    assert out.shape == (*batch, H, D)
    rows = zip(latent.reshape(-1, D), actions.reshape(-1, H, A), out.reshape(-1, H, D), strict=True)
    for start, plan, row in rows:
        torch.testing.assert_close(row, system.moments(start, plan)[0])
    assert system.calls == [((*batch, D), (*batch, A))] * H


def test_sampled_rollout_has_the_moments_of_the_kalman_prediction(system: LinearGaussian) -> None:
    draws = 50_000
    latent, actions = _problem()
    out = rollout(system, latent, actions, "sample", draws, generator=torch.Generator().manual_seed(0))
    assert out.shape == (draws, H, D)
    mean, covariance = system.moments(latent, actions)
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    assert ((out.mean(0) - mean).abs() < 5 * (variance / draws).sqrt()).all()
    centered = out - mean
    products = centered.unsqueeze(-1) * centered.unsqueeze(-2)
    assert ((products.mean(0) - covariance).abs() < 5 * products.std(0) / draws**0.5).all()
    # One trajectory, not one draw per step: Cov(z_2, z_1) = a Cov(z_1).
    lagged = centered[:, 1].unsqueeze(-1) * centered[:, 0].unsqueeze(-2)
    expected = system.a @ covariance[0]
    assert ((lagged.mean(0) - expected).abs() < 5 * lagged.std(0) / draws**0.5).all()


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("num_samples", [1, 5])
def test_sampled_rollout_shapes_and_generator(
    system: LinearGaussian, batch: tuple[int, ...], num_samples: int
) -> None:
    latent, actions = _problem(*batch)
    state = torch.get_rng_state()

    def draw(seed: int) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        return rollout(system, latent, actions, "sample", num_samples, generator=generator)

    first = draw(0)
    assert first.shape == (num_samples, *batch, H, D)
    assert system.calls == [((num_samples, *batch, D), (num_samples, *batch, A))] * H
    assert torch.equal(first, draw(0))
    assert not torch.equal(first, draw(1))
    assert torch.equal(state, torch.get_rng_state())
    rows = first.reshape(-1, H, D)[:, 0]
    assert len(torch.unique(rows[:, 0])) == len(rows)  # no two trajectories share a draw


def test_samples_of_a_deterministic_transition_are_its_mean() -> None:
    predictor = Predictor(D, A, head=DeltaHead()).double()
    latent, actions = _problem(2)
    samples = rollout(predictor.dist, latent, actions, "sample", 3)
    torch.testing.assert_close(samples, rollout(predictor.dist, latent, actions).expand(3, 2, H, D))


def test_mean_and_mode_are_different_paths() -> None:
    def skewed(latent: Tensor, action: Tensor) -> Distribution:
        return Independent(LogNormal(latent + action, torch.ones_like(latent)), 1)

    start, actions = torch.zeros(1), torch.full((2, 1), -1.0)
    mean = torch.tensor([-0.5, torch.tensor(-0.5).exp() - 0.5]).exp()
    mode = torch.tensor([-2.0, torch.tensor(-2.0).exp() - 2.0]).exp()
    torch.testing.assert_close(rollout(skewed, start, actions).squeeze(-1), mean)
    torch.testing.assert_close(rollout(skewed, start, actions, "mode").squeeze(-1), mode)


def test_gradients_reach_every_action_and_the_start(system: LinearGaussian) -> None:
    latent, actions = (value.requires_grad_() for value in _problem())
    rollout(system, latent, actions)[-1].sum().backward()
    ones = torch.ones(D, dtype=torch.float64)
    torch.testing.assert_close(latent.grad, ones @ torch.linalg.matrix_power(system.a, H))
    for h in range(H):
        expected = ones @ torch.linalg.matrix_power(system.a, H - 1 - h) @ system.b
        torch.testing.assert_close(actions.grad[h], expected)


def test_a_system_without_control_takes_empty_actions() -> None:
    predictor = Predictor(D, head=DeltaHead())
    latent = torch.randn(4, D)
    out = rollout(predictor.dist, latent, torch.empty(4, H, 0))
    weight = predictor.trunks[0].weight
    for h in range(H):
        torch.testing.assert_close(out[:, h], latent @ torch.linalg.matrix_power(weight, h + 1).mT)


@given(st.integers(1, 4), st.integers(1, 4), st.integers(1, 4))
def test_a_plan_can_be_cut_in_two(first: int, second: int, rows: int) -> None:
    system = LinearGaussian()
    latent = torch.randn(rows, D, dtype=torch.float64)
    actions = torch.randn(rows, first + second, A, dtype=torch.float64)
    head = rollout(system, latent, actions[:, :first])
    tail = rollout(system, head[:, -1], actions[:, first:])
    torch.testing.assert_close(torch.cat([head, tail], 1), rollout(system, latent, actions))


def _never(latent: Tensor, action: Tensor) -> Distribution:
    raise AssertionError("bad input must be refused before the transition is asked")


@pytest.mark.parametrize(
    ("latent", "actions"),
    [((3,), (2,)), ((4, 3), (6, 2)), ((4, 3), (5, 6, 2)), ((3,), (4, 6, 2)), ((4, 3), (4, 0, 2))],
)
def test_shapes_that_disagree_are_refused(latent: tuple[int, ...], actions: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"actions must have shape \(\*B, H, A\).*got"):
        rollout(_never, torch.zeros(latent), torch.zeros(actions))


@pytest.mark.parametrize(
    ("how", "num_samples"), [("mean", 2), ("mode", 2), ("sample", 0), ("sample", -1), ("mean", 0)]
)
def test_number_of_samples_is_checked(how: str, num_samples: int) -> None:
    with pytest.raises(ValueError, match=rf"num_samples must be positive.*got {num_samples}.*{how}"):
        rollout(_never, torch.zeros(3), torch.zeros(6, 2), how, num_samples)


def test_unknown_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="how must be 'mean', 'mode' or 'sample', got 'median'"):
        rollout(_never, torch.zeros(3), torch.zeros(6, 2), "median", 3)


def test_the_input_is_not_changed() -> None:
    latent, actions = torch.randn(2, 3), torch.randn(2, 4, 3)
    copies = latent.clone(), actions.clone()
    rollout(lambda z, u: Delta(z + u), latent, actions)
    assert torch.equal(latent, copies[0])
    assert torch.equal(actions, copies[1])


@pytest.mark.parametrize(("chunk_size", "sizes"), [(3, [3, 3, 1]), (7, [7]), (50, [7])])
def test_chunks_bound_what_the_transition_sees(
    system: LinearGaussian, chunk_size: int, sizes: list[int]
) -> None:
    latent, actions = _problem(2)
    generator = torch.Generator().manual_seed(0)
    out = rollout(system, latent, actions, "sample", 7, chunk_size=chunk_size, generator=generator)
    assert out.shape == (7, 2, H, D)
    assert [latent[0] for latent, _ in system.calls] == [size for size in sizes for _ in range(H)]
    assert len(torch.unique(out[:, 0, 0, 0])) == 7
    if len(sizes) == 1:
        generator.manual_seed(0)
        assert torch.equal(out, rollout(system, latent, actions, "sample", 7, generator=generator))


def test_chunks_have_the_moments_of_the_whole(system: LinearGaussian) -> None:
    draws = 20_000
    latent, actions = _problem()
    out = rollout(system, latent, actions, "sample", draws, chunk_size=999)
    mean, covariance = system.moments(latent, actions)
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    assert ((out.mean(0) - mean).abs() < 5 * (variance / draws).sqrt()).all()
    torch.testing.assert_close(out.var(0), variance, rtol=0.06, atol=0)


@pytest.mark.parametrize(("how", "chunk_size"), [("mean", 2), ("sample", 0)])
def test_the_chunk_size_is_checked(how: str, chunk_size: int) -> None:
    with pytest.raises(ValueError, match=f"chunk_size must be positive.*got {chunk_size} with how='{how}'"):
        rollout(_never, torch.zeros(3), torch.zeros(6, 2), how, chunk_size=chunk_size)
