"""Moments of the predicted belief against Kalman predictions, quadrature and samples; skip routes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles import linear_gaussian_moments
from torch import Tensor
from torch.distributions import (
    Categorical,
    Distribution,
    Independent,
    Laplace,
    LowRankMultivariateNormal,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
    kl_divergence,
)

from torchrl_vjepa.belief import composition_gap, propagate_moments, rollout
from torchrl_vjepa.distributions import Delta, diag_gaussian
from torchrl_vjepa.heads import DeltaHead, DiagGaussianHead
from torchrl_vjepa.noisy_tv import KalmanFilter, LinearGaussianSystem
from torchrl_vjepa.predictor import Predictor

D, A, H = 3, 2, 5
METHODS = ["linearize", "sigma_points"]


class Linear:
    """z' = a z + b u + w, w ~ N(0, noise), as the distribution that ``kind`` names."""

    def __init__(self, kind: str = "full") -> None:
        generator = torch.Generator().manual_seed(2)
        make: Any = {"generator": generator, "dtype": torch.float64}
        self.a = 0.8 * torch.randn(D, D, **make)
        self.b = torch.randn(D, A, **make)
        factor = torch.randn(D, D, **make)
        self.kind, self.offset = kind, 0.5 * factor[:, 0]
        self.noise = factor @ factor.mT if kind in ("full", "mixture") else torch.diag(factor[0].square())
        if kind == "point":
            self.noise = torch.zeros_like(self.noise)

    def __call__(self, latent: Tensor, action: Tensor) -> Distribution:
        loc = latent @ self.a.mT + action @ self.b.mT
        scale = self.noise.diagonal().sqrt()
        if self.kind == "point":
            return Delta(loc)
        if self.kind == "diagonal":
            return diag_gaussian(loc, scale)
        if self.kind == "laplace":
            return Independent(Laplace(loc, scale / math.sqrt(2)), 1)
        if self.kind == "low rank":
            half = (0.5 * self.noise).sqrt()
            return LowRankMultivariateNormal(loc, half, 0.5 * self.noise.diagonal())
        if self.kind == "full":
            return MultivariateNormal(loc, self.noise)
        # Two Gaussians on both sides of the mean: what is between them is missing within them.
        locs = torch.stack([loc + self.offset, loc - self.offset], dim=-2)
        parts = MultivariateNormal(locs, self.noise - torch.outer(self.offset, self.offset))
        return MixtureSameFamily(Categorical(torch.ones(*loc.shape[:-1], 2)), parts)

    def moments(self, start: Tensor, actions: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
        means, covariances = linear_gaussian_moments(self.a, self.b, self.noise, start, actions)
        powers = [torch.linalg.matrix_power(self.a, h) for h in range(1, len(actions) + 1)]
        return means, covariances + torch.stack([power @ covariance @ power.mT for power in powers])


def problem(*batch: int) -> tuple[Tensor, Tensor, Tensor]:
    """Where a belief is, its covariance, and a plan."""
    factor = torch.randn(*batch, D, D, dtype=torch.float64)
    latent = torch.randn(*batch, D, dtype=torch.float64)
    return latent, factor @ factor.mT, torch.randn(*batch, H, A, dtype=torch.float64)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["full", "diagonal", "laplace", "low rank", "mixture", "point"])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_exact_for_linear_transitions(method: Any, kind: str, batch: tuple[int, ...]) -> None:
    system = Linear(kind)
    latent, covariance, actions = problem(*batch)
    for start in (None, covariance):
        means, covariances = propagate_moments(system, latent, actions, method, covariance=start)
        assert means.shape == (*batch, H, D)
        assert covariances.shape == (*batch, H, D, D)
        rows = zip(
            latent.reshape(-1, D),
            actions.reshape(-1, H, A),
            covariance.reshape(-1, D, D),
            means.reshape(-1, H, D),
            covariances.reshape(-1, H, D, D),
            strict=True,
        )
        for z, plan, p, mean, cov in rows:
            expected = system.moments(z, plan, torch.zeros_like(p) if start is None else p)
            torch.testing.assert_close(mean, expected[0], rtol=1e-9, atol=1e-9)
            torch.testing.assert_close(cov, expected[1], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("horizon", [1, 4, 16])
def test_kalman_predictive_moments_on_the_noisy_tv(method: Any, horizon: int) -> None:
    """Section "Uncertainty Propagation": eq:kf_mean_update and eq:kf_cov_update over horizons."""
    system = LinearGaussianSystem(control_dim=2, seed=3)
    kalman = KalmanFilter(system, noise_scale=4.0)
    data = system.simulate(30, 4.0, torch.randn(30, 2), batch_size=(2,), dtype=torch.float64)
    belief = kalman.filter(data["observation"], data["action"])
    plan = torch.randn(2, horizon, 2, dtype=torch.float64)

    def transition(latent: Tensor, action: Tensor) -> Distribution:
        std = torch.full((4,), system.signal_std, dtype=torch.float64)
        return diag_gaussian(latent @ system.A.mT + action @ system.B.mT, std)

    mean, covariance = belief["signal_mean"][:, -1], belief["signal_cov"][:, -1]
    means, covariances = propagate_moments(transition, mean, plan, method, covariance=covariance)
    for h in range(horizon):
        mean = mean @ system.A.mT + plan[:, h] @ system.B.mT
        covariance = system.A @ covariance @ system.A.mT + 0.01 * torch.eye(4, dtype=torch.float64)
        torch.testing.assert_close(means[:, h], mean)
        torch.testing.assert_close(covariances[:, h], covariance)


def cubic(latent: Tensor, action: Tensor) -> Distribution:
    """Heteroscedastic and nonlinear, with the moments of a polynomial."""
    loc = latent + 0.1 * latent.pow(3) + action
    return diag_gaussian(loc, (0.2 + 0.3 * latent.square()).sqrt())


def test_one_nonlinear_step_against_quadrature() -> None:
    """P' = E[Sigma] + Var[mu]: both parts by sigma points, to first order by linearisation."""
    mean, variance, action = 0.7, 0.09, 0.2
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    z = mean + math.sqrt(variance) * nodes
    w = weights / weights.sum()
    mu, sigma = z + 0.1 * z**3 + action, 0.2 + 0.3 * z**2
    exact_mean = (w * mu).sum()
    exact_noise, exact_spread = (w * sigma).sum(), (w * (mu - exact_mean) ** 2).sum()
    start = torch.tensor([mean], dtype=torch.float64)
    covariance = torch.tensor([[variance]], dtype=torch.float64)
    plan = torch.full((1, 1), action, dtype=torch.float64)
    means, covariances = propagate_moments(cubic, start, plan, "sigma_points", covariance=covariance)
    assert means.item() == pytest.approx(exact_mean, abs=1e-12)
    # The spread of a cubic is of sixth degree: two points miss a little of it.
    assert covariances.item() == pytest.approx(exact_noise + exact_spread, rel=0.01)
    means, covariances = propagate_moments(cubic, start, plan, "linearize", covariance=covariance)
    slope = 1 + 0.3 * mean**2
    assert means.item() == pytest.approx(mean + 0.1 * mean**3 + action, abs=1e-12)
    assert covariances.item() == pytest.approx(0.2 + 0.3 * mean**2 + slope**2 * variance, abs=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_full_covariances_depend_on_the_state_too(method: Any) -> None:
    def full(latent: Tensor, action: Tensor) -> Distribution:
        p = cubic(latent, action)
        return MultivariateNormal(p.mean, torch.diag_embed(p.variance))

    latent, covariance, actions = problem(2)
    arguments = (0.3 * latent, actions[..., :2, :1].expand(2, 2, D), method)
    expected = propagate_moments(cubic, *arguments, covariance=0.05 * covariance)
    for value, other in zip(
        propagate_moments(full, *arguments, covariance=0.05 * covariance), expected, strict=True
    ):
        torch.testing.assert_close(value, other)


def test_nonlinear_moments_against_samples() -> None:
    torch.manual_seed(0)
    predictor = Predictor(D, A, trunk="mlp", num_cells=(16,), residual=True)
    torch.nn.init.constant_(predictor.trunks[0][-1].bias[D:], -4.0)
    latent, plan = torch.randn(D), torch.randn(4, A)
    draws = rollout(predictor.dist, latent, plan, "sample", 50_000)
    expected = torch.stack([torch.cov(step.mT) for step in draws.unbind(1)])
    for method in METHODS:
        means, covariances = propagate_moments(predictor.dist, latent, plan, method)
        torch.testing.assert_close(means, draws.mean(0), atol=0.01, rtol=0.02)
        torch.testing.assert_close(covariances, expected, atol=0.003, rtol=0.05)


@pytest.mark.parametrize("method", METHODS)
@given(first=st.integers(1, 3), second=st.integers(1, 3))
def test_a_plan_can_be_cut_in_two(method: Any, first: int, second: int) -> None:
    latent, covariance, _ = problem(2)
    actions = torch.randn(2, first + second, 1, dtype=torch.float64).expand(-1, -1, D)
    latent, covariance = 0.1 * latent, 0.01 * covariance
    whole = propagate_moments(cubic, latent, actions, method, covariance=covariance)
    head = propagate_moments(cubic, latent, actions[:, :first], method, covariance=covariance)
    tail = propagate_moments(cubic, head[0][:, -1], actions[:, first:], method, covariance=head[1][:, -1])
    for one, a, b in zip(whole, head, tail, strict=True):
        torch.testing.assert_close(one, torch.cat([a, b], 1))


@pytest.mark.parametrize("method", METHODS)
def test_singular_and_shared_covariances(method: Any) -> None:
    system = Linear("diagonal")
    latent, _, actions = problem(4)
    direction = torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64)
    for covariance in (torch.zeros(D, D, dtype=torch.float64), torch.outer(direction, direction)):
        means, covariances = propagate_moments(system, latent, actions, method, covariance=covariance)
        for row in range(4):
            expected = system.moments(latent[row], actions[row], covariance)
            torch.testing.assert_close(means[row], expected[0])
            torch.testing.assert_close(covariances[row], expected[1])


@pytest.mark.parametrize("method", METHODS)
def test_units_of_the_dimensions_do_not_matter(method: Any) -> None:
    """In float32, with standard deviations from a hundred down to a hundredth."""
    units = torch.tensor([100.0, 1.0, 0.01])

    def transition(latent: Tensor, action: Tensor) -> Distribution:
        return diag_gaussian(latent, 0.1 * units)

    covariance = torch.diag(units.square())
    actions = torch.zeros(2, 0)
    _, covariances = propagate_moments(transition, torch.zeros(3), actions, method, covariance=covariance)
    torch.testing.assert_close(covariances[-1] / units / units.unsqueeze(-1), 1.02 * torch.eye(3))


@pytest.mark.parametrize("method", METHODS)
def test_gradients_and_vmap(method: Any) -> None:
    predictor = Predictor(D, A, trunk="mlp", num_cells=(8,)).double()
    latent, _, actions = problem(2)
    latent.requires_grad_()
    actions.requires_grad_()

    def last(latent: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        means, covariances = propagate_moments(predictor.dist, latent, actions[..., :3, :], method)
        return means[..., -1, :], covariances[..., -1, :, :]

    assert torch.autograd.gradcheck(last, (latent, actions))
    assert all(p.grad is None for p in predictor.parameters())
    last(latent, actions)[1].sum().backward()
    assert predictor.trunks[0][0].weight.grad.abs().sum() > 0
    with torch.no_grad():
        together = last(latent, actions)
        mapped = torch.func.vmap(last)(latent, actions)
    for one, other in zip(together, mapped, strict=True):
        assert not one.requires_grad
        torch.testing.assert_close(one, other)


def test_float32_and_the_input_is_not_changed() -> None:
    predictor = Predictor(D, A)
    latent, covariance, actions = (value.float() for value in problem(2))
    copies = [value.clone() for value in (latent, covariance, actions)]
    for method in METHODS:
        means, covariances = propagate_moments(predictor.dist, latent, actions, method, covariance=covariance)
        assert means.dtype == covariances.dtype == torch.float32
        assert torch.linalg.eigvalsh(covariances).min() > 0
    for value, copy in zip((latent, covariance, actions), copies, strict=True):
        assert torch.equal(value, copy)


def _never(latent: Tensor, action: Tensor) -> Distribution:
    raise AssertionError("bad input must be refused before the transition is asked")


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        (torch.eye(2), r"covariance must have shape \(4, 3, 3\).*got \(2, 2\)"),
        (torch.full((3, 3), math.nan), "covariance must be finite"),
        (torch.tensor([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), "must be symmetric"),
        (torch.diag(torch.tensor([1.0, 1.0, -0.1])), "positive semi-definite, got the eigenvalue -0.1"),
    ],
)
def test_bad_covariances_are_refused(covariance: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        propagate_moments(_never, torch.zeros(4, 3), torch.zeros(4, 5, 2), covariance=covariance)


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="method must be 'linearize' or 'sigma_points', got 'exact'"):
        propagate_moments(_never, torch.zeros(3), torch.zeros(5, 2), "exact")  # type: ignore[arg-type] (meant)
    with pytest.raises(ValueError, match=r"actions must have shape \(\*B, H, A\)"):
        propagate_moments(_never, torch.zeros(3), torch.zeros(0, 2))
    matrices = Independent(Normal(torch.zeros(3, 2), 1.0), 2)
    with pytest.raises(ValueError, match=r"p must have an event of shape \(D,\)"):
        propagate_moments(lambda z, u: matrices, torch.zeros(3), torch.zeros(1, 2))


# --- two routes to the same future


def compositional(skips: tuple[int, ...], noise: float = 0.1) -> Predictor:
    """A linear predictor whose skips are powers of one isotropic system z' = 0.9 R z + B u + w."""
    torch.manual_seed(1)
    head = DiagGaussianHead("constant") if noise else DeltaHead()
    predictor = Predictor(D, A, head=head, skips=skips).double()
    a = 0.9 * torch.linalg.qr(torch.randn(D, D, dtype=torch.float64)).Q
    b = torch.randn(D, A, dtype=torch.float64)
    with torch.no_grad():
        for index, skip in enumerate(skips):
            powers = [torch.linalg.matrix_power(a, k) for k in range(skip + 1)]
            columns = [powers[skip - 1 - i] @ b for i in range(skip)]
            predictor.trunks[index].weight.copy_(torch.cat([powers[skip], *columns], dim=1))
            if noise:
                variance = noise**2 * sum(0.81**k for k in range(skip))
                predictor.constants[index].fill_(math.log(variance))
    return predictor


@pytest.mark.parametrize("divergence", ["wasserstein", "kl"])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("step", [1, 2])
def test_no_gap_in_a_compositional_model(divergence: Any, method: Any, step: int) -> None:
    predictor = compositional((1, 2, 4))
    latent, actions = torch.randn(5, D).double(), torch.randn(5, 4, A).double()
    gap = composition_gap(predictor.dist, latent, actions, step=step, divergence=divergence, method=method)
    assert gap.shape == (5,)
    torch.testing.assert_close(gap, torch.zeros(5).double(), atol=1e-6, rtol=0)


def test_the_gap_measures_the_disagreement() -> None:
    predictor = compositional((1, 4))
    latent, actions = torch.randn(5, D).double(), torch.randn(5, 4, A).double()
    p = predictor.dist(latent, actions, skip=4)
    before = diag_gaussian(p.mean.detach().clone(), p.stddev.detach().clone())
    with torch.no_grad():
        predictor.trunks[1].weight[:, 0] += 0.1
        predictor.constants[1] += math.log(4.0)  # twice the standard deviation
    after = predictor.dist(latent, actions, skip=4)
    shift = (after.mean - before.mean).square().sum(-1)
    spread = (after.stddev - before.stddev).square().sum(-1)
    gap = composition_gap(predictor.dist, latent, actions)
    torch.testing.assert_close(gap, (shift + spread).sqrt())
    torch.testing.assert_close(
        composition_gap(predictor.dist, latent, actions, divergence="kl"), kl_divergence(before, after)
    )


def test_wasserstein_of_full_covariances() -> None:
    """Gaussians with commuting covariances: the distance of their roots."""
    torch.manual_seed(0)
    q = torch.linalg.qr(torch.randn(D, D, dtype=torch.float64)).Q
    one, other = torch.rand(D).double(), torch.rand(D).double()

    def dist(latent: Tensor, actions: Tensor, skip: int) -> Distribution:
        if skip == 2:
            return MultivariateNormal(latent, q @ torch.diag(other) @ q.mT)
        return MultivariateNormal(latent, q @ torch.diag(0.5 * one) @ q.mT)

    gap = composition_gap(dist, torch.zeros(D).double(), torch.zeros(2, A).double())
    torch.testing.assert_close(gap, (one.sqrt() - other.sqrt()).norm())


def test_gap_of_point_predictions() -> None:
    predictor = compositional((1, 2), noise=0.0)
    latent, actions = torch.randn(5, D).double(), torch.randn(5, 2, A).double()
    assert composition_gap(predictor.dist, latent, actions).max() < 1e-12
    with torch.no_grad():
        predictor.trunks[1].weight.add_(0.1)
    iterated = rollout(predictor.dist, latent, actions)[:, -1]
    expected = (predictor.dist(latent, actions, skip=2).mean - iterated).norm(dim=-1)
    torch.testing.assert_close(composition_gap(predictor.dist, latent, actions), expected)
    kl = composition_gap(predictor.dist, latent, actions, divergence="kl")
    assert (kl == math.inf).all()


def test_gap_without_control() -> None:
    predictor = Predictor(D, skips=(1, 3))
    gap = composition_gap(predictor.dist, torch.randn(2, D), torch.empty(2, 3, 0))
    assert gap.shape == (2,)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"step": 3}, "step must divide the length 4 of the plan and be smaller, got 3"),
        ({"step": 4}, "be smaller, got 4"),
        ({"step": 0}, "got 0"),
        ({"step": 2}, "skip must be one of"),
        ({"divergence": "l2"}, "divergence must be 'wasserstein' or 'kl', got 'l2'"),
        ({"method": "none"}, "method must be"),
    ],
)
def test_bad_routes_are_refused(kwargs: dict[str, Any], message: str) -> None:
    predictor = compositional((1, 4))
    with pytest.raises(ValueError, match=message):
        composition_gap(predictor.dist, torch.zeros(D).double(), torch.zeros(4, A).double(), **kwargs)
