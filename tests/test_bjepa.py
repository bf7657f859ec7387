"""BJEPA and BJEPALoss: values by loops over pairs, who moves the prior, VJEPA as a limit, lists."""

from __future__ import annotations

import copy
import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import Independent, MultivariateNormal, Normal, kl_divergence
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import (
    BJEPA,
    VJEPA,
    BJEPALoss,
    DiagGaussianHead,
    GaussianPrior,
    JEPALoss,
    Predictor,
    VJEPALoss,
    linear_encoder,
)

OBS, LATENT, ACTION = 6, 3, 2
SKIPS = (1, 3)
COVARIANCE = torch.tensor([[2.0, 0.6, -0.3], [0.6, 1.0, 0.2], [-0.3, 0.2, 0.5]])
PRIORS = {
    "learned": lambda: GaussianPrior(LATENT, mean=0.7, std=0.4, learnable=True),
    "fixed": lambda: GaussianPrior(LATENT, mean=torch.tensor([1.0, -1.0, 0.0]), std=2.0),
    "full": lambda: GaussianPrior(LATENT, mean=-0.5, covariance=COVARIANCE, learnable=True),
}
EVERY_PRIOR = pytest.mark.parametrize("prior", PRIORS)


def make_model(prior: str = "learned", **kwargs: Any) -> BJEPA:
    return BJEPA(
        linear_encoder(OBS, LATENT),
        Predictor(LATENT, ACTION, skips=SKIPS, **kwargs),
        structural_prior=PRIORS[prior](),
    ).double()


def make_windows(*batch: int, boundaries: bool = False) -> TensorDict:
    windows = TensorDict(
        observation=torch.randn(*batch, OBS, dtype=torch.float64),
        action=torch.randn(*batch, ACTION, dtype=torch.float64),
        batch_size=batch,
    )
    if boundaries:
        mask = torch.rand(*batch, 1) < 0.9
        windows = windows.apply(lambda x: torch.where(mask, x, math.nan))
        windows["next", "done"] = torch.rand(*batch, 1) < 0.15
        windows["is_init"] = torch.rand(*batch, 1) < 0.15
        windows["collector", "mask"] = mask
    return windows


def associated(loss: Any) -> Any:
    SoftUpdate(loss, eps=0.9)
    return loss


def total(terms: TensorDict) -> Tensor:
    return sum(value.sum() for key, value in terms.items() if key.startswith("loss_"))


def seeded(loss: Any, windows: TensorDict) -> TensorDict:
    torch.manual_seed(7)
    return loss(windows)


def divergence(model: BJEPA, windows: TensorDict, b: int, t: int, skip: int) -> Tensor:
    """KL(p_like || p_struct) of one pair, by torch's own formula for full Gaussians."""
    latent = windows["observation"][b, t] @ model.encoder.module.network.weight.mT
    p = model.predictor.dist(latent, windows["action"][b, t : t + skip], skip=skip)
    prior = model.structural_prior()
    root = prior.scale_tril if isinstance(prior, MultivariateNormal) else prior.stddev.diag()
    return kl_divergence(
        MultivariateNormal(p.mean, scale_tril=p.stddev.diag()),
        MultivariateNormal(prior.mean, scale_tril=root),
    )


def by_loops(model: BJEPA, windows: TensorDict, weights: tuple[float, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """The term for "mean", "sum" and "none"."""
    done, begin, mask = (windows[key] for key in (("next", "done"), "is_init", ("collector", "mask")))
    rows, mean = torch.zeros(windows.shape, dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    for weight, skip in zip(weights, SKIPS, strict=True):
        values = []
        for b in range(windows.shape[0]):
            for t in range(windows.shape[1] - skip):
                ends = done[b, t : t + skip].any() or begin[b, t + 1 : t + skip + 1].any()
                if not ends and mask[b, t : t + skip + 1].all():
                    values.append(divergence(model, windows, b, t, skip))
                    rows[b, t] += weight * values[-1].detach()
        assert 3 < len(values) < windows.shape[0] * (windows.shape[1] - skip)
        mean = mean + weight * torch.stack(values).mean()
    return mean, rows.sum(), rows


# --- the model


def test_default_prior_is_the_papers() -> None:
    """Learned, static, and the unit Gaussian at the start."""
    model = BJEPA(linear_encoder(OBS, LATENT), Predictor(LATENT))
    assert isinstance(model, VJEPA)
    assert isinstance(model.structural_prior, GaussianPrior)
    p = model.structural_prior()
    assert torch.equal(p.mean, torch.zeros(LATENT))
    assert torch.equal(p.variance, torch.ones(LATENT))
    assert all(parameter.requires_grad for parameter in model.structural_prior.parameters())
    assert any("structural_prior" in name for name in model.state_dict())


def test_writes_what_a_vjepa_writes() -> None:
    model = make_model().float()
    plain = VJEPA(model.encoder, model.predictor)
    assert model.in_keys == plain.in_keys
    assert model.out_keys == plain.out_keys
    data = make_windows(4).float()
    ours, theirs = model(data.clone()), plain(data.clone())
    torch.testing.assert_close(ours.to_dict(), theirs.to_dict(), rtol=0, atol=0)


# --- the value


@EVERY_PRIOR
@pytest.mark.parametrize("skip_weights", [None, (1.0, 3.0)])
def test_term_equals_a_loop_over_pairs(prior: str, skip_weights: tuple[float, ...] | None) -> None:
    model = make_model(prior)
    windows = make_windows(8, 9, boundaries=True)
    clean = windows.apply(torch.nan_to_num)
    mean, summed, rows = by_loops(model, clean, (0.25, 0.75) if skip_weights else (0.5, 0.5))
    for reduction, expected in (("mean", mean), ("sum", summed), ("none", rows)):
        loss = BJEPALoss(model, structural_kl_coeff=0.7, skip_weights=skip_weights, reduction=reduction)
        terms = associated(loss)(windows)
        torch.testing.assert_close(terms["loss_structural_kl"], 0.7 * expected)
        if reduction == "none":
            assert "structural_kl" not in terms
        else:
            torch.testing.assert_close(terms["structural_kl"], mean.detach())
            assert not terms["structural_kl"].requires_grad


@EVERY_PRIOR
def test_gradient_equals_that_of_the_loop(prior: str) -> None:
    model = make_model(prior)
    windows = make_windows(8, 9, boundaries=True)
    trained = [p for name, p in model.named_parameters() if p.numel() and "target_scale" not in name]
    expected = torch.autograd.grad(by_loops(model, windows.apply(torch.nan_to_num), (0.5, 0.5))[0], trained)
    loss = associated(BJEPALoss(model, structural_kl_coeff=1.0))
    ours = torch.autograd.grad(loss(windows)["loss_structural_kl"], trained)
    for one, other in zip(ours, expected, strict=True):
        torch.testing.assert_close(one, other)


def test_is_zero_where_the_dynamics_equal_the_prior() -> None:
    model = make_model(head=DiagGaussianHead("constant"))
    with torch.no_grad():
        for trunk in model.predictor.trunks:
            trunk.weight.zero_()
        model.predictor.constants.copy_(model.structural_prior.log_var)
        model.structural_prior.mean.zero_()
    terms = associated(BJEPALoss(model))(make_windows(4, 6))
    assert abs(terms["structural_kl"].item()) < 1e-9


def test_reference_prior_is_the_unit_gaussian_whatever_the_structural_one() -> None:
    """beta KL(q || N(0, I)): the loss of the target does not know p_struct."""
    windows = make_windows(5, 6)
    model = make_model()
    loss = associated(BJEPALoss(model, target_kl_coeff=0.3))
    before = loss(windows)["loss_target_kl"].item()
    with torch.no_grad():
        model.structural_prior.mean.add_(5.0)
    assert loss(windows)["loss_target_kl"].item() == before
    target = windows["observation"] @ loss.target_encoder_params["module", "network", "weight"].mT
    std = model.target_scale.module(windows["observation"])
    q = Independent(Normal(target, std), 1)
    unit = Independent(Normal(torch.zeros_like(target), 1.0), 1)
    assert before == pytest.approx(0.3 * kl_divergence(q, unit).mean().item())


# --- who moves what


@pytest.mark.parametrize("prior", ["learned", "full"])
@pytest.mark.parametrize("residual_variance", ["head", "batch"])
def test_the_structural_prior_moves_with_its_own_term_alone(prior: str, residual_variance: str) -> None:
    model = make_model(prior)
    loss = associated(
        BJEPALoss(
            model,
            residual_variance=residual_variance,
            target_kl_coeff=0.5,
            variance_coeff=1.0,
            covariance_coeff=1.0,
            marginal_entropy_coeff=1.0,
            sliced_entropy_coeff=1.0,
            target_scale_gradient="both",
        )
    )
    terms = loss(make_windows(5, 6))
    parameters = list(model.structural_prior.parameters())
    assert parameters
    for key, value in terms.items():
        if not key.startswith("loss_"):
            continue
        gradients = torch.autograd.grad(value, parameters, retain_graph=True, allow_unused=True)
        for gradient in gradients:
            moved = gradient is not None and bool(gradient.any())
            assert moved == (key == "loss_structural_kl"), key
    # The term shapes the dynamics and the representation too, and no target.
    others = [model.encoder.module.network.weight, *(trunk.weight for trunk in model.predictor.trunks)]
    for gradient in torch.autograd.grad(terms["loss_structural_kl"], others, retain_graph=True):
        assert gradient.any()
    scale = list(model.target_scale.parameters())
    assert torch.autograd.grad(terms["loss_structural_kl"], scale, allow_unused=True) == (None,)


def test_a_fixed_prior_stays() -> None:
    model = make_model("fixed")
    loss = associated(BJEPALoss(model))
    assert not [name for name, _ in loss.named_parameters() if name.startswith("prior_params")]
    before = copy.deepcopy(model.structural_prior.state_dict())
    optimizer = torch.optim.Adam(loss.parameters(), 0.1)
    total(loss(make_windows(5, 6))).backward()
    optimizer.step()
    torch.testing.assert_close(model.structural_prior.state_dict(), before, rtol=0, atol=0)


def test_the_learned_prior_becomes_the_aggregate_prediction() -> None:
    """argmin_r E KL(p_i || r): the moments of the mixture of predictions."""
    model = make_model(head=DiagGaussianHead("constant"))
    windows = make_windows(40, 6)
    loss = associated(BJEPALoss(model, structural_kl_coeff=1.0, skip_weights=(1.0, 0.0)))
    optimizer = torch.optim.LBFGS(
        model.structural_prior.parameters(), max_iter=200, line_search_fn="strong_wolfe"
    )

    def closure() -> Tensor:
        optimizer.zero_grad()
        value = loss(windows)["loss_structural_kl"]
        value.backward()
        return value

    optimizer.step(closure)
    latent = windows["observation"][:, :-1] @ model.encoder.module.network.weight.mT
    p = model.predictor.dist(latent, windows["action"][:, :-1])
    means = p.mean.flatten(0, 1)
    variance = p.variance.flatten(0, 1).mean(0) + means.var(0, correction=0)
    prior = model.structural_prior()
    torch.testing.assert_close(prior.mean, means.mean(0), rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(prior.variance, variance, rtol=1e-3, atol=1e-3)


# --- limits


@pytest.mark.parametrize("residual_variance", ["head", "batch"])
def test_gamma_zero_is_the_vjepa_loss(residual_variance: str) -> None:
    """Every entry and every gradient, bit for bit."""
    model = make_model()
    windows = make_windows(5, 7, boundaries=True)
    kwargs = {
        "residual_variance": residual_variance,
        "target_kl_coeff": 0.2,
        "marginal_entropy_coeff": 0.5,
        "sliced_entropy_coeff": 0.5,
        "skip_weights": (1.0, 2.0),
    }
    results = []
    for loss in (BJEPALoss(model, structural_kl_coeff=0.0, **kwargs), VJEPALoss(model, **kwargs)):
        terms = seeded(associated(loss), windows)
        model.zero_grad()
        total(terms).backward()
        gradients = {name: copy.deepcopy(p.grad) for name, p in model.named_parameters() if p.numel()}
        results.append((terms.detach().to_dict(), gradients))
    (ours, our_gradients), (theirs, their_gradients) = results
    assert ours.pop("loss_structural_kl") == 0
    assert ours.pop("structural_kl") > 0
    torch.testing.assert_close(ours, theirs, rtol=0, atol=0)
    for name, gradient in their_gradients.items():
        if "structural_prior" in name:
            assert gradient is None
            assert not our_gradients[name].any()
        else:
            torch.testing.assert_close(our_gradients[name], gradient, rtol=0, atol=0)


def test_gamma_can_be_scheduled() -> None:
    loss = associated(BJEPALoss(make_model(), structural_kl_coeff=0.0))
    windows = make_windows(4, 6)
    loss.structural_kl_coeff = 0.25
    terms = loss(windows)
    torch.testing.assert_close(terms["loss_structural_kl"].detach(), 0.25 * terms["structural_kl"])
    assert "structural_kl_coeff" in loss.state_dict()


# --- several models


@EVERY_PRIOR
def test_a_list_equals_one_by_one(prior: str) -> None:
    """Priors that differ among the models too, fixed ones included."""
    models = [make_model(prior) for _ in range(3)]
    for i, model in enumerate(models):
        with torch.no_grad():
            model.structural_prior.mean.add_(0.3 * i)
    windows = make_windows(5, 7, boundaries=True)
    several = associated(BJEPALoss(copy.deepcopy(models)))
    terms = seeded(several, windows)
    total(terms).backward()
    gradients = {name: p.grad for name, p in several.named_parameters() if p.numel()}
    for i, model in enumerate(models):
        loss = associated(BJEPALoss(model))
        alone = seeded(loss, windows)
        torch.testing.assert_close({k: v[i] for k, v in terms.items()}, alone.to_dict())
        total(alone).backward()
        for name, parameter in loss.named_parameters():
            if parameter.numel():
                torch.testing.assert_close(gradients[name][i], parameter.grad)


def test_a_learned_prior_is_handed_back() -> None:
    models = [make_model() for _ in range(2)]
    loss = associated(BJEPALoss(models))
    with torch.no_grad():
        loss.prior_params["module", "mean"][1] = 4.0
    model = loss.get_model(1)
    torch.testing.assert_close(model.structural_prior().mean, torch.full((LATENT,), 4.0).double())
    latent = torch.zeros(1, LATENT, dtype=torch.float64)
    torch.testing.assert_close(
        model.fuse().dist(latent, torch.zeros(1, ACTION).double()).mean,
        (4.0 * 0.4**-2 / (1 + 0.4**-2) * torch.ones(1, LATENT)).double(),
        rtol=1e-5,
        atol=1e-5,
    )


# --- bad arguments


@pytest.mark.parametrize("value", [-1.0, math.inf, math.nan])
def test_bad_coefficients_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match="structural_kl_coeff must be finite and at least 0, got"):
        BJEPALoss(make_model(), structural_kl_coeff=value)


def test_bad_models_and_options_are_refused() -> None:
    plain = VJEPA(linear_encoder(OBS, LATENT), Predictor(LATENT))
    with pytest.raises(ValueError, match=r"model must be a BJEPA .* got \['VJEPA'\]"):
        BJEPALoss(plain)
    with pytest.raises(ValueError, match="target_scale_gradient must be 'kl', 'both' or 'none'"):
        BJEPALoss(make_model(), target_scale_gradient="all")
    with pytest.raises(TypeError, match="prediction_coeff"):
        BJEPALoss(make_model(), prediction_coeff=1.0)
    JEPALoss(make_model())  # a BJEPA is a JEPA
