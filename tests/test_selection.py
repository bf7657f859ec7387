"""Restarts chosen by a score."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import (
    JEPA,
    VAE,
    VJEPA,
    DeltaHead,
    DiagGaussianHead,
    JEPALoss,
    Predictor,
    TargetScale,
    VAELoss,
    VJEPALoss,
    linear_encoder,
    select_best,
)

A = torch.tensor([0.95, 0.5, 0.0])


def make_windows(num: int = 2000) -> TensorDict:
    """Three independent components; the first is the most predictable, the last is noise."""
    first = torch.randn(num, 3)
    second = A * first + (1 - A**2).sqrt() * torch.randn(num, 3)
    return TensorDict(observation=torch.stack([first, second], 1), batch_size=(num, 2))


def reader(component: int, scale: float = 1.0) -> VJEPA:
    """The model whose latent is one component, with its true dynamics."""
    target = TargetScale(1, kind="constant", init_std=1e-3)
    predictor = Predictor(1, head=DiagGaussianHead("constant"))
    model = VJEPA(linear_encoder(3, 1), predictor, target_scale=target)
    with torch.no_grad():
        model.encoder.module.network.weight.copy_(scale * torch.eye(3)[component : component + 1])
        predictor.trunks[0].weight.fill_(A[component])
        predictor.constants.fill_(math.log(scale**2 * (1 - A[component] ** 2)))
    return model


def make_loss(models: Any, build: Any = VJEPALoss, **kwargs: Any) -> Any:
    loss = build(models, collapse_rank=0.0, **kwargs)
    SoftUpdate(loss, eps=0.9)
    return loss


def test_the_bound_prefers_the_most_predictable_representation_whatever_its_scale() -> None:
    """thm:mi_bound: scores are the information of each component, -log(1 - a^2) / 2."""
    models = [reader(2, 0.5), reader(1, 0.01), reader(0, 3.0), reader(0)]
    models[3].predictor.trunks[0].weight.data.mul_(0.5)  # right encoder, wrong dynamics
    best = select_best(make_loss(models), make_windows())
    assert best.index == 2
    assert best.model is models[2]
    exact = -0.5 * (1 - A**2).log()
    torch.testing.assert_close(best.scores[:3], exact.flip(0), rtol=0, atol=0.08)
    assert best.scores[3] < best.scores[2] - 0.5
    assert not best.scores.requires_grad


def test_the_chosen_model_has_its_trained_parameters() -> None:
    models = [reader(2), reader(0)]
    loss = make_loss(models)
    with torch.no_grad():
        loss.predictor_params.data["trunks", "0", "weight"].fill_(0.9)
    assert select_best(loss, make_windows()).model.predictor.trunks[0].weight.item() == pytest.approx(0.9)
    assert models[0].predictor.trunks[0].weight.item() == 0.0  # the others stay


def test_a_diverged_run_is_never_chosen() -> None:
    """torch.argmax would take it."""
    models = [reader(0), reader(1), reader(2)]
    loss = make_loss(models)
    with torch.no_grad():
        loss.encoder_params["module", "network", "weight"][0].fill_(math.nan)
    windows = make_windows()
    assert loss(windows)["mutual_information"].argmax() == 0
    best = select_best(loss, windows)
    assert best.index == 1
    assert best.scores[0].isnan()
    with torch.no_grad():
        loss.encoder_params["module", "network", "weight"].fill_(math.nan)
    with pytest.raises(ValueError, match=r"must be finite for some model, got mutual_information=\[nan"):
        select_best(loss, windows)


def test_smaller_scores_are_better_on_request() -> None:
    def model(weight: float) -> JEPA:
        made = JEPA(linear_encoder(3, 1), Predictor(1, head=DeltaHead()))
        with torch.no_grad():
            made.encoder.module.network.weight.copy_(torch.eye(3)[:1])
            made.predictor.trunks[0].weight.fill_(weight)
        return made

    loss = make_loss([model(w) for w in (0.2, 0.9, -1.0)], JEPALoss)
    assert select_best(loss, make_windows(), "error_skip_1", maximize=False).index == 1
    assert select_best(loss, make_windows(), "error_skip_1").index == 2


def test_windows_of_each_model() -> None:
    """stacked_data: each model is scored on its own windows."""
    windows = torch.stack([make_windows(), make_windows()])
    windows["observation"][0, :, 1] = torch.randn(2000, 3)  # nothing to predict there
    assert select_best(make_loss([reader(0), reader(0)], stacked_data=True), windows).index == 1


def test_bad_requests_are_refused() -> None:
    windows = make_windows(8)
    with pytest.raises(ValueError, match="must hold a list of models, got a VJEPALoss of a single one"):
        select_best(make_loss(reader(0)), windows)
    with pytest.raises(KeyError, match="score must be an entry of the losses, one of .*, got 'r2'"):
        select_best(make_loss([reader(0)]), windows, "r2")
    with pytest.raises(KeyError, match="got 'mutual_information'"):
        select_best(VAELoss([VAE(3, 1)]), windows)
    with pytest.raises(ValueError, match=r"got 'loss_nll' of shape \(1, 8, 2\); build the loss with"):
        select_best(make_loss([reader(0)], reduction="none"), windows, "loss_nll")
