"""Linear probe against scikit-learn; mutual information bound against linear-Gaussian formulas."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.linear_model import LinearRegression
from sklearn.metrics import r2_score
from torch import Tensor
from torch.distributions import MultivariateNormal

from torchrl_vjepa import diagnostics, statistics
from torchrl_vjepa.diagnostics import LinearProbe, linear_probe, mutual_information_bound


def _regression(
    train: int, test: int, latent_dim: int, target_dim: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    latent = torch.randn(train + test, latent_dim, dtype=torch.float64) * 2 + 5
    mixing = torch.randn(latent_dim, target_dim, dtype=torch.float64)
    noise = torch.randn(train + test, target_dim) * torch.linspace(0.1, 10, target_dim)
    target = latent.sin() @ mixing + noise - 3
    return latent[:train], target[:train], latent[train:], target[train:]


# --- linear probe


@given(
    latent_dim=st.integers(1, 5),
    target_dim=st.integers(1, 4),
    extra=st.integers(1, 40),
    test=st.integers(2, 30),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=30)
def test_probe_equals_scikit_learn(
    latent_dim: int, target_dim: int, extra: int, test: int, seed: int
) -> None:
    torch.manual_seed(seed)
    data = _regression(latent_dim + extra, test, latent_dim, target_dim)
    z, s, z_test, s_test = (x.numpy() for x in data)
    reference = LinearRegression().fit(z, s)
    probe = linear_probe(*data)
    np.testing.assert_allclose(probe.weight, reference.coef_, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(probe.bias, reference.intercept_, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(probe.predict(data[2]), reference.predict(z_test), atol=1e-6)
    for score, target, latent in ((probe.r2_train, s, z), (probe.r2_test, s_test, z_test)):
        expected = r2_score(target, reference.predict(latent), multioutput="variance_weighted")
        assert score == pytest.approx(expected, rel=1e-6, abs=1e-8)


def test_r2_is_the_papers_formula_by_hand() -> None:
    # On train the fit is exactly s = 2 z. On test: residuals 0, (1, 0), deviations from the mean
    # of the test targets (-2.5, -1), (2.5, 1): 1 - 1 / 14.5.
    z = torch.tensor([[0.0], [1.0], [2.0]])
    s = torch.cat([2 * z, z], -1)
    z_test = torch.tensor([[0.0], [2.0]])
    s_test = torch.tensor([[0.0, 0.0], [5.0, 2.0]])
    probe = linear_probe(z, s, z_test, s_test)
    assert probe.r2_train == pytest.approx(1.0)
    assert probe.r2_test == pytest.approx(1 - 1 / 14.5)
    torch.testing.assert_close(probe.weight, torch.tensor([[2.0], [1.0]]).double())


def test_leading_dimensions_are_samples_and_dtypes_do_not_matter() -> None:
    data = _regression(60, 20, 3, 2)
    flat = linear_probe(*data)
    z, s, z_test, s_test = data
    shaped = linear_probe(
        z.reshape(6, 10, 3), s.reshape(6, 10, 2), z_test.reshape(4, 5, 3), s_test.reshape(4, 5, 2)
    )
    assert shaped.r2_test == pytest.approx(flat.r2_test, abs=1e-12)
    assert shaped.predict(z.reshape(6, 10, 3)).shape == (6, 10, 2)
    single = linear_probe(*(x.float() for x in data))
    assert single.weight.dtype == torch.float64
    assert single.r2_test == pytest.approx(flat.r2_test, abs=1e-5)
    assert single.predict(z[0].float()).shape == (2,)


def test_large_offsets_keep_their_digits() -> None:
    z, s, z_test, s_test = _regression(60, 20, 3, 2)
    plain = linear_probe(z, s, z_test, s_test)
    moved = linear_probe(z + 1e6, s - 1e6, z_test + 1e6, s_test - 1e6)
    assert moved.r2_test == pytest.approx(plain.r2_test, abs=1e-6)


def test_collinear_latents_take_the_solution_of_smallest_norm() -> None:
    z = torch.randn(50, 1, dtype=torch.float64)
    s = 3 * z + 1
    doubled = torch.cat([z, z, torch.zeros_like(z)], -1)
    probe = linear_probe(doubled, s, doubled, s)
    torch.testing.assert_close(probe.weight, torch.tensor([[1.5, 1.5, 0.0]]).double())
    assert probe.r2_test == pytest.approx(1.0)
    constant = linear_probe(torch.ones(50, 2), s.float(), torch.ones(9, 2), s[:9].float())
    assert constant.r2_train == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("value", [0.0, 0.1, 1e6])
def test_constant_targets_have_no_score(value: float) -> None:
    z, s, z_test, s_test = _regression(30, 11, 2, 2)
    probe = linear_probe(z, s, z_test, torch.full_like(s_test, value))
    assert math.isnan(probe.r2_test)
    assert probe.r2_train <= 1
    assert math.isnan(linear_probe(z, torch.full_like(s, value), z_test, s_test).r2_train)


def test_probe_is_detached_and_pickles() -> None:
    z, s, z_test, s_test = _regression(30, 10, 2, 2)
    probe = linear_probe(z.requires_grad_(), s, z_test, s_test)
    assert not probe.weight.requires_grad
    assert not probe.predict(z).requires_grad
    again = pickle.loads(pickle.dumps(probe))
    assert isinstance(again, LinearProbe)
    assert torch.equal(again.weight, probe.weight)
    with pytest.raises(ValueError, match=r"last dimension 2 .* got shape \(4, 3\)"):
        probe.predict(torch.zeros(4, 3))


@pytest.mark.parametrize("index", range(4))
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_probe_refuses_values_that_are_not_finite(index: int, bad: float) -> None:
    data = list(_regression(30, 10, 2, 2))
    data[index][4, 1] = bad
    name = ["latent_train", "target_train", "latent_test", "target_test"][index]
    with pytest.raises(ValueError, match=f"{name} must be finite, .* 1 of"):
        linear_probe(*data)


def test_probe_refuses_shapes_dtypes_and_too_few_samples() -> None:
    z, s, z_test, s_test = _regression(30, 10, 4, 2)
    with pytest.raises(ValueError, match="latent_train and target_train must hold the same"):
        linear_probe(z[:-1], s, z_test, s_test)
    with pytest.raises(ValueError, match="latent_test and target_test must hold the same"):
        linear_probe(z, s, z_test, s_test[:-1])
    with pytest.raises(ValueError, match="latent_train and latent_test must have the same last"):
        linear_probe(z, s, z_test[:, :3], s_test)
    with pytest.raises(ValueError, match="target_train and target_test must have the same last"):
        linear_probe(z, s, z_test, s_test[:, :1])
    with pytest.raises(ValueError, match=r"latent dimension \+ 1 = 5 samples, got 4"):
        linear_probe(z[:4], s[:4], z_test, s_test)
    linear_probe(z[:5], s[:5], z_test, s_test)
    with pytest.raises(ValueError, match="at least 2 samples, got 1"):
        linear_probe(z, s, z_test[:1], s_test[:1])
    with pytest.raises(ValueError, match=r"target_train must have shape \(\*B, features\)"):
        linear_probe(z, s[:, 0], z_test, s_test[:, 0])
    with pytest.raises(TypeError, match=r"target_test must be floating point, got torch\.int64"):
        linear_probe(z, s, z_test, s_test.long())


# --- mutual information bound


class _LinearGaussian:
    """z ~ N(0, S), z' = A z + w with w ~ N(0, Q), and the empirical best linear model."""

    def __init__(self, num: int = 20_000, dim: int = 3) -> None:
        self.dynamics = torch.randn(dim, dim, dtype=torch.float64) * 0.6
        root = torch.randn(dim, dim, dtype=torch.float64)
        self.noise = 0.3 * torch.eye(dim) + 0.05 * root @ root.mT
        self.latent = torch.randn(num, dim, dtype=torch.float64)
        self.target = self.latent @ self.dynamics.mT + MultivariateNormal(
            torch.zeros(dim).double(), self.noise
        ).sample((num,))
        total = self.dynamics @ self.dynamics.mT + self.noise
        self.information = 0.5 * (total.logdet() - self.noise.logdet())

    def log_prob(self, shift: float = 0.0) -> Tensor:
        mean = self.latent @ self.dynamics.mT + shift
        return MultivariateNormal(mean, self.noise).log_prob(self.target)


def test_bound_is_tight_for_the_fitted_linear_gaussian() -> None:
    system = _LinearGaussian(500)
    data = (system.latent, system.target)
    residual = system.target - linear_probe(*data, *data).predict(system.latent)
    # In sample, the mean log-likelihood of the maximum-likelihood Gaussian is exactly minus its
    # entropy, so the bound has a closed form without any Monte Carlo error.
    covariance = residual.mT @ residual / len(residual)
    log_prob = MultivariateNormal(torch.zeros(3).double(), covariance).log_prob(residual)
    expected = 0.5 * (torch.cov(system.target.mT, correction=0).logdet() - covariance.logdet())
    bound = mutual_information_bound(log_prob, system.target, eps=1e-12)
    torch.testing.assert_close(bound, expected)
    # A biased model pays exactly its KL divergence: b' inv(Sigma) b / 2.
    bias = torch.tensor([0.3, -0.2, 0.5]).double()
    wrong = MultivariateNormal(bias, covariance).log_prob(residual)
    gap = bound - mutual_information_bound(wrong, system.target, eps=1e-12)
    torch.testing.assert_close(gap, 0.5 * bias @ torch.linalg.solve(covariance, bias))


def test_bound_reaches_the_true_information_at_the_true_model_and_stays_below_elsewhere() -> None:
    system = _LinearGaussian()
    bound = mutual_information_bound(system.log_prob(), system.target)
    # Fluctuation of the pointwise information log p(z'|z) - log p(z').
    total = system.dynamics @ system.dynamics.mT + system.noise
    marginal = MultivariateNormal(torch.zeros(3).double(), total).log_prob(system.target)
    pointwise = system.log_prob() - marginal
    error = (pointwise.std() / math.sqrt(len(pointwise))).item()
    assert abs(bound - system.information) < 6 * error + 1e-4
    assert mutual_information_bound(system.log_prob(0.5), system.target) < bound - 0.1
    assert abs(mutual_information_bound(marginal, system.target)) < 6 * error + 1e-4


def test_masked_pairs_do_not_count() -> None:
    system = _LinearGaussian(60)
    mask = (torch.rand(60) < 0.5).reshape(6, 10)
    kept = mask.reshape(-1)
    expected = mutual_information_bound(system.log_prob()[kept], system.target[kept])
    log_prob = system.log_prob().masked_fill(~kept, math.nan).reshape(6, 10)
    target = torch.where(kept.unsqueeze(-1), system.target, math.inf).reshape(6, 10, 3)
    for flag in (mask, mask.unsqueeze(-1)):
        torch.testing.assert_close(mutual_information_bound(log_prob, target, flag), expected)
    assert mutual_information_bound(log_prob, target, torch.zeros_like(mask)).isnan()


def test_bound_is_differentiable_and_maps_over_runs() -> None:
    log_prob = torch.randn(3, 8, dtype=torch.float64)
    target = torch.randn(3, 8, 2, dtype=torch.float64)
    mask = torch.rand(3, 8) < 0.8
    mapped = torch.func.vmap(mutual_information_bound)(log_prob, target, mask)
    loop = [mutual_information_bound(*a) for a in zip(log_prob, target, mask, strict=True)]
    torch.testing.assert_close(mapped, torch.stack(loop))
    inputs = (log_prob[0].requires_grad_(), target[0].requires_grad_())
    assert torch.autograd.gradcheck(lambda p, z: mutual_information_bound(p, z, mask[0]), inputs)


def test_bound_refuses_shapes() -> None:
    target = torch.randn(8, 2)
    with pytest.raises(ValueError, match=r"log_prob must have shape \(8,\) .* got \(8, 2\)"):
        mutual_information_bound(torch.zeros(8, 2), target)
    with pytest.raises(ValueError, match="mask must have shape"):
        mutual_information_bound(torch.zeros(8), target, torch.ones(7, dtype=torch.bool))
    with pytest.raises(ValueError, match="eps must be positive"):
        mutual_information_bound(torch.zeros(8), target, eps=0.0)


def test_effective_rank_is_the_one_of_statistics() -> None:
    assert diagnostics.effective_rank is statistics.effective_rank
    assert "effective_rank" in diagnostics.__all__
