"""Weights of the skips and the sliced entropy term of the joint-embedding losses."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import (
    BJEPA,
    BJEPALoss,
    JEPALoss,
    Predictor,
    TargetScale,
    VJEPALoss,
    effective_rank,
    linear_encoder,
    sliced_gaussian_distance,
)

OBS, LATENT, ACTION = 6, 3, 2
SKIPS = (1, 2, 4)


def make_model(skips: tuple[int, ...] = SKIPS) -> BJEPA:
    """A model that every loss takes; its target is a point mass in all but name."""
    scale = TargetScale(LATENT, kind="constant", init_std=1e-9, log_var_range=(-80.0, 16.0))
    predictor = Predictor(LATENT, ACTION, skips=skips)
    return BJEPA(linear_encoder(OBS, LATENT), predictor, target_scale=scale).double()


def make_windows() -> TensorDict:
    windows = TensorDict(
        observation=torch.randn(6, 9, OBS, dtype=torch.float64),
        action=torch.randn(6, 9, ACTION, dtype=torch.float64),
        is_init=torch.rand(6, 9, 1) < 0.1,
        batch_size=(6, 9),
    )
    windows["collector", "mask"] = torch.rand(6, 9, 1) < 0.9
    return windows


def associated(loss: Any) -> Any:
    SoftUpdate(loss, eps=0.9)
    return loss


def total(terms: TensorDict) -> Tensor:
    return sum(value.sum() for key, value in terms.items() if key.startswith("loss_"))


def jepa(model: Any, **kwargs: Any) -> Any:
    return associated(JEPALoss(model, prediction_coeff=2.0, **kwargs))


def vjepa(model: Any, **kwargs: Any) -> Any:
    return associated(VJEPALoss(model, **kwargs))


def vjepa_batch(model: Any, **kwargs: Any) -> Any:
    return associated(VJEPALoss(model, residual_variance="batch", **kwargs))


def bjepa(model: Any, **kwargs: Any) -> Any:
    return associated(BJEPALoss(model, **kwargs))


BUILDERS = pytest.mark.parametrize("build", [jepa, vjepa, vjepa_batch, bjepa])
# The entries that are means over pairs, which the weights concern.
OVER_PAIRS = {"loss_prediction", "loss_nll", "loss_head", "loss_structural_kl"}


# --- weights of the skips


@BUILDERS
@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_entries_are_the_weighted_mean_of_the_skips_alone(build: Callable[..., Any], reduction: str) -> None:
    """Each skip by a loss that has all its weight on it; the weights are normalised."""
    model, windows = make_model(), make_windows()
    each = [
        build(model, reduction=reduction, skip_weights=[float(k == skip) for k in SKIPS])(windows)
        for skip in SKIPS
    ]
    terms = build(model, reduction=reduction, skip_weights=(3.0, 0.0, 1.0))(windows)
    assert OVER_PAIRS & set(terms.keys())
    for key, value in terms.items():
        if key in OVER_PAIRS:
            torch.testing.assert_close(value, 0.75 * each[0][key] + 0.25 * each[2][key])
        elif key.startswith("loss_"):
            torch.testing.assert_close(value, each[1][key])


@BUILDERS
def test_weights_by_the_diagnostics_of_each_skip(build: Callable[..., Any]) -> None:
    terms = build(make_model(), skip_weights=(1, 2, 5))(make_windows())
    if build is jepa:
        each, key, factor = [terms[f"error_skip_{skip}"] for skip in SKIPS], "loss_prediction", 2.0
    else:
        each, factor = [terms[f"nll_skip_{skip}"] for skip in SKIPS], 1.0
        key = "loss_head" if build is vjepa_batch else "loss_nll"
    assert len({round(value.item(), 6) for value in each}) == len(SKIPS)
    expected = factor * (each[0] + 2 * each[1] + 5 * each[2]) / 8
    torch.testing.assert_close(terms[key].detach(), expected)


@BUILDERS
def test_weights_are_normalised_and_equal_by_default(build: Callable[..., Any]) -> None:
    model, windows = make_model(), make_windows()
    reference = build(model)(windows).to_dict()
    for weights in ((1 / 3, 1 / 3, 1 / 3), (7, 7, 7), [0.5, 0.5, 0.5]):
        torch.testing.assert_close(build(model, skip_weights=weights)(windows).to_dict(), reference)
    scaled = [build(model, skip_weights=w)(windows).to_dict() for w in ((1, 2, 3), (10.0, 20.0, 30.0))]
    torch.testing.assert_close(*scaled)
    assert math.isclose(sum(build(model, skip_weights=(1, 2, 4)).skip_weights), 1.0)


@BUILDERS
def test_a_zero_weight_leaves_the_skip_out_of_the_objective(build: Callable[..., Any]) -> None:
    """Entries and gradients equal those of a predictor that never had the skip."""
    model, windows = make_model(), make_windows()
    small = make_model((1, 4))
    weight = small.encoder.module.network.weight
    with torch.no_grad():
        weight.copy_(model.encoder.module.network.weight)
        for ours, theirs in zip(small.predictor.trunks, (0, 2), strict=True):
            ours.weight.copy_(model.predictor.trunks[theirs].weight)
    terms = build(model, skip_weights=(1.0, 0.0, 3.0))(windows)
    expected = build(small, skip_weights=(1.0, 3.0))(windows)
    for key, value in expected.items():
        torch.testing.assert_close(terms[key], value)
    total(terms).backward()
    total(expected).backward()
    torch.testing.assert_close(model.encoder.module.network.weight.grad, weight.grad)
    assert not model.predictor.trunks[1].weight.grad.any()
    for ours, theirs in zip(small.predictor.trunks, (0, 2), strict=True):
        torch.testing.assert_close(ours.weight.grad, model.predictor.trunks[theirs].weight.grad)


@pytest.mark.parametrize(
    "weights", [(1.0, 1.0), (1.0, 1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (1.0, -1.0, 1.0), (1.0, math.nan, 1.0), ()]
)
def test_bad_weights_are_refused(weights: tuple[float, ...]) -> None:
    message = r"skip_weights must be one finite weight of at least 0 for each of skips=\(1, 2, 4\).*got"
    with pytest.raises(ValueError, match=message):
        JEPALoss(make_model(), skip_weights=weights)


# --- the sliced form of the entropy term


@BUILDERS
def test_sliced_term_is_the_distance_of_the_online_latents_that_count(build: Callable[..., Any]) -> None:
    model, windows = make_model(), make_windows()
    loss = build(model, sliced_entropy_coeff=0.6, num_slices=5)
    for value in loss.target_encoder_params.values(True, True):
        value.data.normal_()
    torch.manual_seed(2)
    terms = loss(windows)
    weight = model.encoder.module.network.weight
    latent = (windows["observation"] @ weight.mT)[windows["collector", "mask"].squeeze(-1)]
    torch.manual_seed(2)
    if build is not jepa:
        torch.randn(6, 9, LATENT, dtype=torch.float64)  # the target's noise is drawn first
    expected = 0.6 * sliced_gaussian_distance(latent, num_slices=5)
    torch.testing.assert_close(terms["loss_sliced"], expected)
    ours, theirs = (torch.autograd.grad(value, weight)[0] for value in (terms["loss_sliced"], expected))
    torch.testing.assert_close(ours, theirs)
    assert not ours.isnan().any()


@BUILDERS
def test_without_the_sliced_term_nothing_is_drawn_for_it(build: Callable[..., Any]) -> None:
    model, windows = make_model(), make_windows()
    plain = build(model)
    assert "loss_sliced" not in plain.out_keys
    assert "sliced_entropy_coeff" not in plain.state_dict()
    torch.manual_seed(2)
    terms = plain(windows)
    assert "loss_sliced" not in terms
    if build is jepa:
        state = torch.get_rng_state()
        plain(windows)
        assert torch.equal(torch.get_rng_state(), state)
    with pytest.raises(TypeError, match="sliced_entropy_coeff"):
        plain.sliced_entropy_coeff = 0.5  # would be ignored
    torch.manual_seed(2)
    other = build(model, sliced_entropy_coeff=0.0)(windows)
    assert other["loss_sliced"] == 0
    torch.testing.assert_close({key: other[key] for key in terms.keys()}, terms.to_dict())  # noqa: SIM118 (a TensorDict iterates over rows, not keys)


def test_sliced_term_can_be_scheduled_from_zero() -> None:
    loss, windows = jepa(make_model(), sliced_entropy_coeff=0.0), make_windows()
    assert loss(windows)["loss_sliced"] == 0
    loss.sliced_entropy_coeff = 2.0
    assert loss(windows)["loss_sliced"] > 0


def test_sliced_term_with_several_models_and_without_reduction() -> None:
    models = [make_model(), make_model()]
    loss = jepa(models, sliced_entropy_coeff=1.0, reduction="none")
    value = loss(make_windows())["loss_sliced"]
    assert value.shape == (2, 6, 9)
    assert (value == value[:, :1, :1]).all()
    assert value[0, 0, 0] != value[1, 0, 0]


def test_sliced_term_leads_out_of_collapse() -> None:
    """From nearly collapsed latents: squared error alone leaves them flat, the term makes them round."""
    windows = TensorDict(
        observation=torch.randn(40, 3, OBS), action=torch.zeros(40, 3, ACTION), batch_size=(40, 3)
    )
    results = {}
    for coefficient in (0.0, 50.0):
        torch.manual_seed(1)
        model = make_model((1,)).float()
        with torch.no_grad():
            model.encoder.module.network.weight.mul_(0.02)
        loss = jepa(model, sliced_entropy_coeff=coefficient, collapse_rank=0.0, num_slices=8)
        updater = SoftUpdate(loss, eps=0.9)
        optimizer = torch.optim.Adam(loss.parameters(), 3e-2)
        for _ in range(60):
            optimizer.zero_grad()
            total(loss(windows)).backward()
            optimizer.step()
            updater.step()
        latent = windows["observation"] @ model.encoder.module.network.weight.detach().mT
        results[coefficient] = latent.flatten(0, 1)
    assert (results[0.0].std(0) - 1).abs().max() > 0.35
    kept = results[50.0]
    assert effective_rank(kept) > 0.95 * LATENT
    assert (kept.std(0) - 1).abs().max() < 0.3


@pytest.mark.parametrize("cls", [JEPALoss, VJEPALoss, BJEPALoss])
def test_bad_arguments_of_the_sliced_term_are_refused(cls: type[Any]) -> None:
    with pytest.raises(ValueError, match="sliced_entropy_coeff must be finite and at least 0, got -1"):
        cls(make_model(), sliced_entropy_coeff=-1.0)
    with pytest.raises(ValueError, match="num_slices must be positive, got 0"):
        cls(make_model(), sliced_entropy_coeff=1.0, num_slices=0)
