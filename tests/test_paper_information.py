"""Information identities of the paper, each on the library's own losses and diagnostics."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import Independent, MultivariateNormal, Normal, kl_divergence
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import (
    VAE,
    VJEPA,
    DiagGaussianHead,
    PixelAR,
    PixelARLoss,
    PixelDecoder,
    Predictor,
    TargetScale,
    VAELoss,
    VJEPALoss,
    gaussian_entropy,
    linear_encoder,
    mutual_information_bound,
)

SEEDS = st.integers(0, 2**16)


def exact_normal(num: int, dim: int, generator: torch.Generator | None = None) -> Tensor:
    """Samples with mean exactly zero and covariance exactly the identity."""
    x = torch.randn(num, dim, dtype=torch.float64, generator=generator)
    return torch.linalg.qr(x - x.mean(0)).Q * math.sqrt(num)


def correlated(dims: int, seed: int, num: int = 200) -> Tensor:
    """Samples of a random full covariance that is not nearly singular."""
    generator = torch.Generator().manual_seed(seed)
    mix = torch.randn(dims, dims, dtype=torch.float64, generator=generator)
    return exact_normal(num, dims, generator) @ (mix + 2 * torch.eye(dims, dtype=torch.float64))


def entropy(x: Tensor) -> Tensor:
    return gaussian_entropy(x, eps=1e-12)


def information(context: Tensor, target: Tensor) -> Tensor:
    """The library's bound at the best linear Gaussian model, which for these samples is the true one."""
    residual = target - context @ torch.linalg.lstsq(context, target).solution
    covariance = residual.mT @ residual / len(residual)
    p = MultivariateNormal(torch.zeros_like(residual), covariance)
    return mutual_information_bound(p.log_prob(residual), target, eps=1e-12)


def windows_of(*steps: Tensor) -> TensorDict:
    return TensorDict(observation=torch.stack(steps, 1), batch_size=(len(steps[0]), len(steps)))


def linear_vjepa(observation_dim: int, latent_dim: int) -> VJEPA:
    """Constant predicted variance, and a target that is a point mass in all but name."""
    predictor = Predictor(latent_dim, head=DiagGaussianHead("constant", log_var_range=(-40.0, 16.0)))
    scale = TargetScale(latent_dim, kind="constant", init_std=1e-9, log_var_range=(-80.0, 16.0))
    return VJEPA(linear_encoder(observation_dim, latent_dim), predictor, target_scale=scale).double()


# --- identities between entropies


@given(seed=SEEDS)
def test_mutual_information_is_symmetric_and_a_difference_of_entropies(seed: int) -> None:
    """I(X;Y) = H(Y) - H(Y|X) = H(X) - H(X|Y) = H(X) + H(Y) - H(X,Y), and it is not negative."""
    joint = correlated(5, seed)
    x, y = joint[:, :2], joint[:, 2:]
    expected = entropy(x) + entropy(y) - entropy(joint)
    torch.testing.assert_close(information(x, y), expected, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(information(y, x), expected, rtol=1e-6, atol=1e-8)
    assert expected > 0


@given(seed=SEEDS)
def test_chain_rule_for_mutual_information(seed: int) -> None:
    """I(X,Y;Z) = I(X;Z) + I(Y;Z|X), the last from H(X,Y) + H(X,Z) - H(X) - H(X,Y,Z)."""
    joint = correlated(5, seed)
    x, z = joint[:, :1], joint[:, 3:]  # and y between them
    xy, xz = joint[:, :3], torch.cat([x, z], 1)
    conditional = entropy(xy) + entropy(xz) - entropy(x) - entropy(joint)
    torch.testing.assert_close(information(xy, z), information(x, z) + conditional, rtol=1e-6, atol=1e-8)
    assert conditional > -1e-9


@given(seed=SEEDS)
def test_eq_cross_entropy_identity(seed: int) -> None:
    """H(p, q) = H(p) + KL(p || q): the likelihood term of VJEPA at any model.

    Its excess over the conditional entropy of the true system is the expected divergence.
    """
    generator = torch.Generator().manual_seed(seed)
    a = torch.rand(2, dtype=torch.float64, generator=generator) * 0.9
    z, w = exact_normal(200, 4, generator).chunk(2, -1)
    model = linear_vjepa(2, 2)
    trunk = a.diag() + 0.5 * torch.randn(2, 2, dtype=torch.float64, generator=generator)
    log_var = torch.randn(2, dtype=torch.float64, generator=generator)
    with torch.no_grad():
        model.encoder.module.network.weight.copy_(torch.eye(2))
        model.predictor.trunks[0].weight.copy_(trunk)
        model.predictor.constants[0].copy_(log_var)
    loss = VJEPALoss(model, target_kl_coeff=0.0, collapse_rank=0.0)
    SoftUpdate(loss, eps=0.9)
    terms = loss(windows_of(z, z * a + w * (1 - a**2).sqrt()))
    truth = Independent(Normal(z * a, (1 - a**2).sqrt().expand_as(z)), 1)
    divergence = kl_divergence(truth, model.predictor.dist(z)).mean().detach()
    conditional_entropy = truth.entropy()[0]
    torch.testing.assert_close(
        terms["loss_nll"].detach(), conditional_entropy + divergence, rtol=1e-6, atol=0
    )
    # The same divergence is the gap of thm:mi_bound: it holds, and is tight at the true model alone.
    exact = -0.5 * (1 - a**2).log().sum()
    torch.testing.assert_close(exact - terms["mutual_information"], divergence, rtol=1e-4, atol=1e-5)
    assert divergence > 0


def test_evidence_lower_bound() -> None:
    """log p(x) = ELBO + KL(q || p(z | x)), the negative ELBO being VAELoss up to a constant.

    The squared error is the likelihood of a decoder of variance 1/2.
    """
    num, dim, latent = 20_000, 3, 2
    model = VAE(dim, latent).double()
    x = torch.randn(dim, dtype=torch.float64)
    windows = TensorDict(observation=x.expand(num, 1, dim), batch_size=(num, 1))
    with torch.no_grad():  # log-variances that count
        wanted = torch.tensor([-1.5, -2.0], dtype=torch.float64)
        model.encoder.module.weight[latent:] = torch.outer(wanted, x) / (x @ x)
    values = sum(VAELoss(model, reduction="none")(windows).values()).squeeze(-1).detach()
    decoder = model.decoder.module.weight.detach()
    mean, log_var = model.encoder.module(x).detach().chunk(2)
    eye = torch.eye(dim, dtype=torch.float64)
    log_evidence = MultivariateNormal(torch.zeros_like(x), decoder @ decoder.mT + 0.5 * eye).log_prob(x)
    precision = torch.eye(latent, dtype=torch.float64) + 2 * decoder.mT @ decoder
    posterior = MultivariateNormal(
        2 * torch.linalg.solve(precision, decoder.mT @ x), precision_matrix=precision
    )
    q = MultivariateNormal(mean, log_var.exp().diag())
    expected = kl_divergence(q, posterior) - log_evidence - 0.5 * dim * math.log(math.pi)
    assert abs(values.mean() - expected) < 4 * values.std() / math.sqrt(num)
    assert values.std() / math.sqrt(num) < 0.02


# --- predictive objectives against generative ones


def signal_and_nuisance(num: int = 400) -> tuple[TensorDict, Tensor, Tensor]:
    """Two independent processes, both predictable: a signal of variance 1, a nuisance of variance 9."""
    samples = exact_normal(num, 4)
    signal, nuisance = samples[:, :1], 3 * samples[:, 1:2]
    following = torch.cat([0.8 * signal + 0.6 * samples[:, 2:3], 0.6 * nuisance + 2.4 * samples[:, 3:]], 1)
    return windows_of(torch.cat([signal, nuisance], 1), following), signal, nuisance


def pixel_loss(windows: TensorDict, rows: list[int]) -> float:
    """The autoregressive loss at its optimum for the encoder that keeps some components."""
    encoder = linear_encoder(2, 2)
    model = PixelAR(encoder, PixelDecoder(encoder, 2, 2)).double()
    keep = torch.zeros(2, 2, dtype=torch.float64)
    keep[rows, rows] = 1.0
    x, y = windows["observation"].unbind(1)
    with torch.no_grad():
        encoder.module.network.weight.copy_(keep)
        solution = torch.linalg.lstsq(x @ keep, y, driver="gelsd").solution.mT
        next(iter(model.decoder_module.parameters())).copy_(solution)
    return PixelARLoss(model)(windows)["loss_reconstruction"].item()


def test_eq_ar_loss_decomposed() -> None:
    """The generative loss falls by what the latent explains of the signal and of the nuisance.

    For independent components the two gains add, and ignoring the nuisance costs its whole gain.
    """
    windows, _, _ = signal_and_nuisance()
    nothing, signal, nuisance, both = (pixel_loss(windows, rows) for rows in ([], [0], [1], [0, 1]))
    assert nothing == pytest.approx(10.0)
    assert nothing - signal == pytest.approx(0.8**2)
    assert nothing - nuisance == pytest.approx(0.6**2 * 9)
    assert nothing - both == pytest.approx(0.8**2 + 0.6**2 * 9)


def test_eq_vjepa_loss_decomposed() -> None:
    """With the signal as the target there is no term for the nuisance: L = H(Z') - I(Z; S')."""
    windows, _, _ = signal_and_nuisance()
    model = linear_vjepa(2, 1)
    with torch.no_grad():
        model.encoder.module.network.weight.copy_(torch.tensor([[1.0, 0.0]]))
        model.predictor.trunks[0].weight.fill_(0.8)
        model.predictor.constants.fill_(math.log(0.36))
    loss = VJEPALoss(model, target_kl_coeff=0.0, collapse_rank=0.0)
    SoftUpdate(loss, eps=0.9)
    marginal = 0.5 * math.log(2 * math.pi * math.e)
    predictive = -0.5 * math.log(1 - 0.8**2)
    assert loss(windows)["loss_nll"].item() == pytest.approx(marginal - predictive, abs=1e-6)
    # All information about the nuisance in the context could lower it by nothing: conditioning on
    # signal and nuisance leaves the same residual as conditioning on the signal.
    x, y = windows["observation"].unbind(1)
    torch.testing.assert_close(information(x, y[:, :1]), information(x[:, :1], y[:, :1]))
