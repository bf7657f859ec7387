"""VAE and VAELoss: values by hand, the linear VAE against principal components, masks."""

from __future__ import annotations

import copy
import math
import pickle
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.distributions import Independent, Normal, kl_divergence

from torchrl_vjepa import VAE, VAELoss

OBS, LATENT = 7, 3


def make_windows(*batch: int) -> TensorDict:
    return TensorDict(observation=torch.randn(*batch, OBS, dtype=torch.float64), batch_size=batch)


def weights(model: VAE) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, log-variance and decoder matrices."""
    return (*model.encoder.module.weight.chunk(2), model.decoder.module.weight)


def elbo_terms(model: VAE, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Squared error and KL of each step, by hand."""
    to_mean, to_log_var, decoder = weights(model)
    mean, std = observation @ to_mean.mT, (0.5 * observation @ to_log_var.mT).exp()
    error = observation - (mean + std * noise) @ decoder.mT
    q = Independent(Normal(mean, std), 1)
    unit = Independent(Normal(torch.zeros_like(mean), 1.0), 1)
    return error.square().sum(-1), kl_divergence(q, unit)


# --- the model


def test_writes_the_posterior_mean() -> None:
    model = VAE(OBS, LATENT).double()
    windows = make_windows(4, 5)
    out = model(windows.clone())
    torch.testing.assert_close(out["latent"], windows["observation"] @ weights(model)[0].mT)
    assert model.in_keys == ["observation"]
    assert model.out_keys == ["latent"]
    assert len(list(model.parameters())) == 2  # no bias, as in the paper


def test_nested_and_renamed_keys() -> None:
    model = VAE(OBS, LATENT, observation_key=("s", "x"), latent_key=("s", "z"))
    data = TensorDict({"s": {"x": torch.randn(4, 3, OBS)}}, batch_size=(4, 3))
    assert model(data.clone())["s", "z"].shape == (4, 3, LATENT)
    assert VAELoss(model)(data)["loss_kl"] > 0


def test_mlp_trunks() -> None:
    model = VAE(OBS, LATENT, trunk="mlp", num_cells=(8, 9))
    for module, sizes in ((model.encoder, [8, 9, 2 * LATENT]), (model.decoder, [8, 9, OBS])):
        assert [m.out_features for m in module.module if isinstance(m, nn.Linear)] == sizes
    loss = VAELoss(model)
    sum(loss(make_windows(4, 5).float()).values()).backward()
    assert all(p.grad.any() for p in loss.parameters())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"observation_dim": 0}, "observation_dim and latent_dim must be positive, got 0 and 3"),
        ({"latent_dim": 0}, "observation_dim and latent_dim must be positive, got 7 and 0"),
        ({"trunk": "conv"}, "trunk must be 'linear' or 'mlp', got 'conv'"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        VAE(**{"observation_dim": OBS, "latent_dim": LATENT, **arguments})


def test_missing_entries_are_named() -> None:
    with pytest.raises(KeyError, match="VAE reads the entry 'observation'"):
        VAE(OBS, LATENT)(TensorDict(batch_size=3))
    with pytest.raises(KeyError, match="VAELoss reads the entry 'observation'"):
        VAELoss(VAE(OBS, LATENT))(TensorDict(batch_size=(3, 4)))


def test_copies_and_pickles() -> None:
    model, windows = VAE(OBS, LATENT).double(), make_windows(4)
    for twin in (copy.deepcopy(model), pickle.loads(pickle.dumps(model))):
        assert torch.equal(twin(windows.clone())["latent"], model(windows.clone())["latent"])


# --- the value


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_loss_equals_the_formula(reduction: str) -> None:
    model = VAE(OBS, LATENT).double()
    windows = make_windows(6, 5)
    torch.manual_seed(4)
    terms = VAELoss(model, kl_coeff=0.3, reduction=reduction)(windows)
    torch.manual_seed(4)
    noise = torch.randn(LATENT, 6, 5, dtype=torch.float64).movedim(0, -1)
    error, kl = elbo_terms(model, windows["observation"], noise)
    reduce = {"mean": Tensor.mean, "sum": Tensor.sum, "none": lambda x: x}[reduction]
    assert list(terms.keys()) == ["loss_reconstruction", "loss_kl"]
    torch.testing.assert_close(terms["loss_reconstruction"], reduce(error))
    torch.testing.assert_close(terms["loss_kl"], 0.3 * reduce(kl))


def test_posterior_is_sampled_anew() -> None:
    """E |x - g(z)|^2 = |x - W m|^2 + sum_d s_d^2 |w_d|^2."""
    model = VAE(OBS, LATENT).double()
    x = torch.randn(OBS, dtype=torch.float64)
    windows = TensorDict(observation=x.expand(20_000, 1, OBS), batch_size=(20_000, 1))
    loss = VAELoss(model, reduction="none")
    errors = loss(windows)["loss_reconstruction"].detach()
    assert not torch.equal(errors, loss(windows)["loss_reconstruction"])
    to_mean, to_log_var, decoder = weights(model)
    expected = (x - decoder @ to_mean @ x).square().sum()
    expected = expected + ((to_log_var @ x).exp() * decoder.square().sum(0)).sum()
    assert abs(errors.mean() - expected) < 4 * errors.std() / math.sqrt(len(errors))


@pytest.mark.parametrize("garbage", [math.nan, 1e6])
def test_padding_counts_nowhere_and_ends_of_episodes_do(garbage: float) -> None:
    """Every step that is real counts: the VAE forms no pairs."""
    model = VAE(OBS, LATENT).double()
    windows = make_windows(6, 5)
    mask = torch.rand(6, 5) < 0.7
    torch.manual_seed(4)
    noise = torch.randn(LATENT, 6, 5, dtype=torch.float64).movedim(0, -1)
    error, kl = elbo_terms(model, windows["observation"], noise)
    windows["observation"][~mask] = garbage
    windows["collector", "mask"] = mask.unsqueeze(-1)
    windows["next", "done"] = torch.ones(6, 5, 1, dtype=torch.bool)
    expected = {
        "mean": (error[mask].mean(), kl[mask].mean()),
        "sum": (error[mask].sum(), kl[mask].sum()),
        "none": (torch.where(mask, error, 0), torch.where(mask, kl, 0)),
    }
    for reduction, (reconstruction, divergence) in expected.items():
        torch.manual_seed(4)
        loss = VAELoss(model, reduction=reduction)
        terms = loss(windows)
        torch.testing.assert_close(terms["loss_reconstruction"], reconstruction)
        torch.testing.assert_close(terms["loss_kl"], divergence)
        loss.zero_grad()
        sum(value.sum() for value in terms.values()).backward()
        assert all(p.grad.isfinite().all() for p in loss.parameters())


def test_nothing_left_gives_zero() -> None:
    windows = make_windows(4, 5)
    windows["collector", "mask"] = torch.zeros(4, 5, 1, dtype=torch.bool)
    loss = VAELoss(VAE(OBS, LATENT).double())
    terms = loss(windows)
    assert all(value == 0 for value in terms.values())
    sum(terms.values()).backward()
    assert not any(p.grad.any() for p in loss.parameters())


def test_windows_may_be_one_step_long_in_any_batch() -> None:
    loss = VAELoss(VAE(OBS, LATENT).double(), reduction="none")
    assert loss(make_windows(2, 3, 1))["loss_kl"].shape == (2, 3, 1)
    assert loss(make_windows(4))["loss_kl"].shape == (4,)


@pytest.mark.parametrize("value", [-1.0, math.inf, math.nan])
def test_bad_coefficients_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match="kl_coeff must be finite and at least 0, got"):
        VAELoss(VAE(OBS, LATENT), kl_coeff=value)


def test_other_models_are_refused() -> None:
    with pytest.raises(ValueError, match=r"model must be a VAE .* got \['Linear'\]"):
        VAELoss(nn.Linear(2, 2))


def test_values_that_count_must_be_finite() -> None:
    windows = make_windows(4, 5)
    windows["observation"][1, 2, 0] = math.nan
    with pytest.raises(ValueError, match="'observation' must be finite .* got 1 NaN or infinite"):
        VAELoss(VAE(OBS, LATENT).double())(windows)


# --- the optimum

SPECTRUM = torch.tensor([9.0, 6.0, 4.0, 1.0, 0.8, 0.6, 0.3], dtype=torch.float64)


def gaussian_data(num: int) -> tuple[Tensor, Tensor]:
    """Observations whose sample covariance has exactly this spectrum, and its principal directions."""
    white = torch.randn(num, OBS, dtype=torch.float64)
    white = torch.linalg.qr(white - white.mean(0)).Q * math.sqrt(num)
    basis = torch.linalg.qr(torch.randn(OBS, OBS, dtype=torch.float64)).Q
    return white * SPECTRUM.sqrt() @ basis.mT, basis


def optimal_value(beta: float) -> float:
    """Per direction min over (e, d): (1 - e d)^2 v + d^2 + beta e^2 v / 2 = sqrt(2 beta v) - beta / 2."""
    kept = SPECTRUM[:LATENT]
    return float((2 * beta * kept).sqrt().sum() - LATENT * beta / 2 + SPECTRUM[LATENT:].sum())


@pytest.mark.parametrize("beta", [0.5, 1.0])
def test_optimal_linear_vae_spans_the_leading_principal_subspace(beta: float) -> None:
    x, basis = gaussian_data(256)
    model = VAE(OBS, LATENT).double()
    loss = VAELoss(model, kl_coeff=beta)
    windows = TensorDict(observation=x.unsqueeze(1), batch_size=(256, 1))
    optimizer = torch.optim.Adam(loss.parameters(), 0.03)
    steps, tail = 800, []
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = 0.03 * (1 - step / steps)
        optimizer.zero_grad()
        value = sum(loss(windows).values())
        value.backward()
        optimizer.step()
        if step >= steps - 100:
            tail.append(value.item())
    to_mean, to_log_var, decoder = (w.detach() for w in weights(model))
    leading = basis[:, :LATENT]
    for rows in (to_mean, decoder.mT):
        angles = torch.linalg.svdvals(torch.linalg.qr(rows.mT).Q.mT @ leading)
        assert angles.min() > 0.995
    # Unit posterior variance is optimal at zero mean, so the scale stops reading the observation.
    assert (x @ to_log_var.mT).abs().mean() < 0.1
    best = optimal_value(beta)
    assert sum(tail) / len(tail) == pytest.approx(best, rel=0.02)


def test_closed_form_optimum_has_the_closed_form_value() -> None:
    """The matrices of the theory reach the value of the theory, and perturbations do not pass it."""
    beta = 1.0
    x, basis = gaussian_data(256)
    model = VAE(OBS, LATENT).double()
    kept = SPECTRUM[:LATENT]
    encoder = ((2 * kept / beta).sqrt() - 1).div(kept).sqrt()
    decoder = encoder * kept / (1 + encoder**2 * kept)
    rows = torch.cat([encoder.diag() @ basis[:, :LATENT].mT, torch.zeros(LATENT, OBS)])

    def value(noise: float) -> float:
        with torch.no_grad():
            for target, centre in (
                (model.encoder.module.weight, rows),
                (model.decoder.module.weight, basis[:, :LATENT] * decoder),
            ):
                target.copy_(centre + noise * torch.randn_like(centre))
        windows = TensorDict(observation=x.expand(200, -1, -1), batch_size=(200, 256))
        return sum(VAELoss(model, kl_coeff=beta)(windows).values()).item()

    best = value(0.0)
    assert best == pytest.approx(optimal_value(beta), rel=5e-3)
    assert all(value(0.2) > best + 0.01 for _ in range(5))
