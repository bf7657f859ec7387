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
    "JEPA": (JEPALoss, jepa, {**REGULARISERS, "sliced_entropy_coeff": 0.4}),
    "VJEPA": (VJEPALoss, vjepa, {**REGULARISERS, "skip_weights": (1.0, 2.0), "sliced_entropy_coeff": 0.3}),
    "VJEPA batch": (VJEPALoss, vjepa, {**REGULARISERS, "residual_variance": "batch"}),
    "BJEPA": (
        BJEPALoss,
        bjepa,
        {**REGULARISERS, "structural_kl_coeff": 0.4, "sliced_entropy_coeff": 0.2, "target_kl_coeff": 0.5},
    ),
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


@EVERY
def test_the_best_models_train_on_in_a_new_loss(case: str) -> None:
    models = make_models(case)
    trainable = [[p.requires_grad for p in model.parameters()] for model in models]
    first, _ = train(case, models, make_batches(stacked=False))
    survivors = [first.get_model(i) for i in (0, 2)]
    assert [[p.requires_grad for p in model.parameters()] for model in survivors] == [
        trainable[0],
        trainable[2],
    ]
    before = [copy.deepcopy(model.encoder.state_dict()) for model in survivors]
    second, _ = train(case, survivors, make_batches(stacked=False))
    for i, old in enumerate(before):
        new = second.get_model(i).encoder.state_dict()
        assert all((new[key] != value).all() for key, value in old.items())


def _vjepa(**changes: Any) -> VJEPA:
    """A small model; ``changes`` are arguments of its predictor, or its target scale."""
    scale = changes.pop("target_scale", None)
    return VJEPA(linear_encoder(6, 3), Predictor(3, **{"skips": (1, 2), **changes}), target_scale=scale)


@pytest.mark.parametrize(
    "changes",
    [
        {"skips": (1, 3)},
        {"residual": True},
        {"head": DiagGaussianHead(log_var_range=(-2.0, 2.0))},
        {"target_scale": TargetScale(3, kind="constant")},
    ],
    ids=["skips", "residual", "range", "kind of scale"],
)
def test_models_that_differ_in_more_than_numbers_are_refused(changes: dict[str, Any]) -> None:
    """They would all train as the first one."""
    with pytest.raises(ValueError, match="one architecture, but '.*' is .* in model 1 and .* in model 0"):
        VJEPALoss([_vjepa(), _vjepa(**changes)])


def test_models_may_start_their_scales_anywhere() -> None:
    scales = [TargetScale(3, kind="constant", init_std=std) for std in (0.1, 1.0)]
    assert VJEPALoss([_vjepa(target_scale=scale) for scale in scales]).num_models == 2


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
@pytest.mark.parametrize("stacked_data", [False, True])
def test_stacked_models_equal_mapped_ones(stacked_data: bool, reduction: str) -> None:
    """Linear models use stacked weights as they are; mapping over the models gives the same numbers."""
    loss = VJEPALoss(
        [_vjepa() for _ in range(3)],
        stacked_data=stacked_data,
        residual_variance="batch",
        marginal_entropy_coeff=1.0,
        reduction=reduction,
    ).double()
    SoftUpdate(loss, eps=0.9)
    shape = (3, 5, 7) if stacked_data else (5, 7)
    windows = TensorDict(
        observation=torch.randn(*shape, 6, dtype=torch.float64),
        is_init=torch.rand(*shape, 1) < 0.1,
        batch_size=shape,
    )
    assert loss._stackable
    results = []
    for stackable in (True, False):
        loss._stackable = stackable
        torch.manual_seed(3)
        terms = loss(windows)
        total = sum(value.sum() for key, value in terms.items() if key.startswith("loss_"))
        learned = [p for p in loss.parameters() if p.numel()]
        gradients = torch.autograd.grad(total, learned, allow_unused=True)
        results.append(({k: v.detach() for k, v in terms.items()}, gradients))
    torch.testing.assert_close(results[0][0], results[1][0])
    for stacked, mapped in zip(results[0][1], results[1][1], strict=True):
        if mapped is not None:
            torch.testing.assert_close(stacked, mapped)
