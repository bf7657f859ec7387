"""Several models as one batch: each trains as it would alone, whoever else is in the list."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import (
    BJEPA,
    JEPA,
    VAE,
    VJEPA,
    BJEPALoss,
    DeltaHead,
    DiagGaussianHead,
    EnsembleHead,
    FlowHead,
    FullGaussianHead,
    GaussianPrior,
    JEPALoss,
    LowRankGaussianHead,
    MixtureHead,
    PixelAR,
    PixelARLoss,
    PixelDecoder,
    Predictor,
    TargetScale,
    VAELoss,
    VJEPALoss,
    linear_encoder,
    mlp_encoder,
)

OBS, LATENT, ACTION = 6, 3, 2
STEPS = 4
NUM = 3
REGULARISERS = {"variance_coeff": 0.5, "covariance_coeff": 0.3, "marginal_entropy_coeff": 0.2}


def jepa(i: int) -> nn.Module:
    return JEPA(linear_encoder(OBS, LATENT), Predictor(LATENT, ACTION, head=DeltaHead(), skips=(1, 3)))


def vjepa(i: int) -> nn.Module:
    """Targets of a fixed scale that differs from run to run."""
    scale = TargetScale(LATENT, kind="constant", init_std=0.2 + 0.2 * i)
    predictor = Predictor(LATENT, ACTION, skips=(1, 2))
    return VJEPA(mlp_encoder(OBS, LATENT, num_cells=[5]), predictor, target_scale=scale)


def bjepa(i: int) -> nn.Module:
    predictor = Predictor(LATENT, ACTION, head=DiagGaussianHead("constant"))
    return BJEPA(linear_encoder(OBS, LATENT), predictor)


def bjepa_fixed(i: int) -> nn.Module:
    """A fixed full prior that differs from run to run."""
    prior = GaussianPrior(LATENT, mean=0.5 * i, covariance=torch.eye(LATENT) + 0.2 * i)
    return BJEPA(linear_encoder(OBS, LATENT), Predictor(LATENT, ACTION), structural_prior=prior)


def with_head(head: Callable[[], nn.Module], trunk: str = "linear") -> Callable[[int], nn.Module]:
    """A BJEPA, whose loss asks for everything: likelihood, draws of the target, a divergence."""

    def build(i: int) -> nn.Module:
        predictor = Predictor(LATENT, ACTION, head=head(), skips=(1, 2), trunk=trunk, num_cells=[5])
        return BJEPA(linear_encoder(OBS, LATENT), predictor)

    return build


def vae(i: int) -> nn.Module:
    return VAE(OBS, LATENT)


def pixel_ar(i: int) -> nn.Module:
    encoder = linear_encoder(OBS, LATENT)
    return PixelAR(encoder, PixelDecoder(encoder, LATENT, OBS, ACTION))


CASES: dict[str, tuple[Callable[..., Any], Callable[[int], nn.Module], dict[str, Any]]] = {
    "JEPA": (JEPALoss, jepa, REGULARISERS),
    "VJEPA": (VJEPALoss, vjepa, {**REGULARISERS, "skip_weights": (1.0, 2.0), "sliced_entropy_coeff": 0.3}),
    "VJEPA batch": (VJEPALoss, vjepa, {**REGULARISERS, "residual_variance": "batch"}),
    "BJEPA": (BJEPALoss, bjepa, {**REGULARISERS, "structural_kl_coeff": 0.4}),
    "BJEPA fixed full prior": (BJEPALoss, bjepa_fixed, REGULARISERS),
    "BJEPA full": (BJEPALoss, with_head(FullGaussianHead), {}),
    "BJEPA low rank": (BJEPALoss, with_head(lambda: LowRankGaussianHead(1), "mlp"), {}),
    "BJEPA mixture": (BJEPALoss, with_head(lambda: MixtureHead(2)), {"num_kl_samples": 4}),
    "BJEPA flow": (BJEPALoss, with_head(lambda: FlowHead(2, 4, 3), "mlp"), {"num_kl_samples": 4}),
    "BJEPA ensemble": (BJEPALoss, with_head(lambda: EnsembleHead(None, 2, 4)), {"num_kl_samples": 4}),
    "VAE": (VAELoss, vae, {"kl_coeff": 0.5}),
    "PixelAR": (PixelARLoss, pixel_ar, {}),
}
EVERY = pytest.mark.parametrize("case", CASES)
STACKED = pytest.mark.parametrize("stacked", [False, True])


def make_models(case: str) -> list[nn.Module]:
    return [CASES[case][1](i).double() for i in range(NUM)]


def make_batches(stacked: bool) -> list[TensorDict]:
    """One for each step, with ends of episodes and padding; each model its own if stacked."""
    batches = []
    shape = (NUM, 4, 7) if stacked else (4, 7)
    for _ in range(STEPS):
        batch = TensorDict(
            observation=torch.randn(*shape, OBS, dtype=torch.float64),
            action=torch.randn(*shape, ACTION, dtype=torch.float64),
            is_init=torch.rand(*shape, 1) < 0.1,
            batch_size=shape,
        )
        batch["collector", "mask"] = torch.rand(*shape, 1) < 0.9
        batches.append(batch)
    return batches


def train(case: str, models: Any, batches: list[TensorDict], stacked: bool = False) -> tuple[Any, list[Any]]:
    """Adam with weight decay, a schedule and the EMA of the targets; entries of every step."""
    build, _, kwargs = CASES[case]
    joint = "JEPA" in case
    loss = build(models, stacked_data=stacked, **kwargs, **({"collapse_rank": 0.0} if joint else {}))
    updater = SoftUpdate(loss, eps=0.8) if joint else None
    optimizer = torch.optim.AdamW(loss.parameters(), 3e-2, weight_decay=0.1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    history = []
    for step, batch in enumerate(batches):
        torch.manual_seed(step)
        terms = loss(batch)
        optimizer.zero_grad()
        sum(value.sum() for key, value in terms.items() if key.startswith("loss_")).backward()
        optimizer.step()
        schedule.step()
        if updater is not None:
            updater.step()
        history.append(terms.detach().to_dict())
    return loss, history


def targets(loss: Any) -> dict[str, torch.Tensor]:
    return {name: b for name, b in loss.named_buffers() if name.startswith("target_encoder_params")}


CLOSE = {"rtol": 1e-8, "atol": 1e-10}


@EVERY
@STACKED
def test_a_list_trains_like_each_model_alone(case: str, stacked: bool) -> None:
    models, batches = make_models(case), make_batches(stacked)
    start = [copy.deepcopy(model.state_dict()) for model in models]
    several, history = train(case, copy.deepcopy(models), batches, stacked)
    moved = 0.0
    for i, model in enumerate(models):
        mine = [batch[i] if stacked else batch for batch in batches]
        alone, reference = train(case, model, mine)
        for step in range(STEPS):
            ours = {key: value[i] for key, value in history[step].items()}
            torch.testing.assert_close(ours, reference[step], **CLOSE)
        state = several.get_model(i).state_dict()
        torch.testing.assert_close(state, alone.get_model().state_dict(), **CLOSE)
        stacks = {name: value[i] for name, value in targets(several).items()}
        torch.testing.assert_close(stacks, targets(alone), **CLOSE)
        moved = max(moved, *((state[name] - value).norm().item() for name, value in start[i].items()))
    assert moved > 0.05
    first = next(iter(history[-1].values()))
    assert len(set(first.tolist())) == NUM  # the runs differ


@EVERY
@STACKED
@pytest.mark.parametrize("chosen", [(2, 0), (1,)])
def test_adding_removing_and_reordering_changes_no_other_run(
    case: str, stacked: bool, chosen: tuple[int, ...]
) -> None:
    models, batches = make_models(case), make_batches(stacked)
    every, history = train(case, copy.deepcopy(models), batches, stacked)
    fewer = [batch[list(chosen)] if stacked else batch for batch in batches]
    some, other = train(case, [copy.deepcopy(models[i]) for i in chosen], fewer, stacked)
    for step in range(STEPS):
        ours = {key: value[list(chosen)] for key, value in history[step].items()}
        torch.testing.assert_close(ours, other[step], **CLOSE)
    for place, i in enumerate(chosen):
        state = some.get_model(place).state_dict()
        torch.testing.assert_close(every.get_model(i).state_dict(), state, **CLOSE)


@EVERY
def test_a_run_that_diverges_spoils_no_other(case: str) -> None:
    """NaN in one model's weights stays there."""
    models, batches = make_models(case), make_batches(False)
    _, reference = train(case, copy.deepcopy(models), batches)
    with torch.no_grad():
        for parameter in models[1].parameters():
            parameter.fill_(torch.nan)
    _, history = train(case, models, batches)
    rest = [0, 2]
    for ours, theirs in zip(history, reference, strict=True):
        assert any(value[1].isnan() for value in ours.values())
        for key, value in ours.items():
            torch.testing.assert_close(value[rest], theirs[key][rest], **CLOSE)


@EVERY
def test_parameters_of_a_list_all_train(case: str) -> None:
    """One stack for each parameter of the model, none twice, each with a gradient."""
    models = make_models(case)
    loss, _ = train(case, models, make_batches(False))
    stacks = [p for p in loss.parameters() if p.numel()]
    assert len(stacks) == len([p for p in models[0].parameters() if p.numel()])
    assert all(len(p) == NUM and p.grad is not None for p in stacks)


def test_models_that_share_a_module_are_refused() -> None:
    """A stack would give each model its own copy, or none that trains."""
    prior = GaussianPrior(LATENT, learnable=True)
    models = [BJEPA(linear_encoder(OBS, LATENT), Predictor(LATENT), structural_prior=prior) for _ in range(2)]
    message = "share no parameters, but 'structural_prior_module.module.mean' of model 1 is that of model 0"
    with pytest.raises(ValueError, match=message):
        BJEPALoss(models)
    fixed = GaussianPrior(LATENT)  # what does not train may be shared
    models = [BJEPA(linear_encoder(OBS, LATENT), Predictor(LATENT), structural_prior=fixed) for _ in range(2)]
    loss = BJEPALoss(models)
    SoftUpdate(loss, eps=0.9)
    windows = TensorDict(observation=torch.randn(4, 5, OBS), batch_size=(4, 5))
    assert loss(windows)["loss_structural_kl"].shape == (2,)
