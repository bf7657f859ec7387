"""Batches of JEPALoss and VJEPALoss: masks, flat slices, several models at once, bad input."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import (
    JEPA,
    VJEPA,
    DeltaHead,
    JEPALoss,
    Predictor,
    TargetScale,
    VJEPALoss,
    Whitening,
    linear_encoder,
)

OBS, LATENT, ACTION = 6, 3, 2
SKIPS = (1, 3)
REGULARISERS = {"variance_coeff": 0.5, "covariance_coeff": 0.3, "marginal_entropy_coeff": 0.2}


def make_windows(*batch: int) -> TensorDict:
    return TensorDict(
        observation=torch.randn(*batch, OBS, dtype=torch.float64),
        action=torch.randn(*batch, ACTION, dtype=torch.float64),
        batch_size=batch,
    )


def make_model(
    cls: type[JEPA] = VJEPA,
    *,
    std: float | None = None,
    skips: tuple[int, ...] = SKIPS,
    whitening: Whitening | None = None,
) -> Any:
    kwargs = {}
    if cls is VJEPA:
        kind = "learned" if std is None else "constant"
        scale = TargetScale(LATENT, kind=kind, init_std=std or 0.6, log_var_range=(-80.0, 16.0))
        kwargs["target_scale"] = scale
    predictor = Predictor(LATENT, ACTION, head=DeltaHead() if cls is JEPA else None, skips=skips)
    return cls(linear_encoder(OBS, LATENT, whitening=whitening), predictor, **kwargs).double()


def jepa(model: Any = None, **kwargs: Any) -> Any:
    loss = JEPALoss(model or make_model(JEPA), **REGULARISERS, **kwargs)
    SoftUpdate(loss, eps=0.9)
    return loss


def vjepa(model: Any = None, **kwargs: Any) -> Any:
    """The target's noise is negligible unless a model is given."""
    loss = VJEPALoss(model or make_model(std=1e-9), **REGULARISERS, **kwargs)
    SoftUpdate(loss, eps=0.9)
    return loss


def vjepa_batch(model: Any = None, **kwargs: Any) -> Any:
    return vjepa(model, residual_variance="batch", **kwargs)


def total(terms: TensorDict) -> torch.Tensor:
    return sum(value.sum() for key, value in terms.items() if key.startswith("loss_"))


def assert_same(loss: Any, windows: TensorDict, reference: TensorDict, **tolerance: float) -> None:
    """All entries and all gradients of the two batches agree."""
    results = []
    for data in (windows, reference):
        torch.manual_seed(3)
        terms = loss(data)
        parameters = [p for p in loss.parameters() if p.numel()]
        results.append((terms, torch.autograd.grad(total(terms), parameters)))
    (ours, our_gradients), (theirs, their_gradients) = results
    assert all(g.isfinite().all() for g in our_gradients)
    torch.testing.assert_close(ours.to_dict(), theirs.to_dict(), **tolerance)
    torch.testing.assert_close(our_gradients, their_gradients, **tolerance)


BUILDERS = pytest.mark.parametrize("build", [jepa, vjepa, vjepa_batch])


# --- what does not count


@BUILDERS
@pytest.mark.parametrize("reduction", ["mean", "sum"])
@pytest.mark.parametrize("key", [("collector", "mask"), "shifted_valid", "valid"])
@pytest.mark.parametrize("garbage", [math.nan, 1e6])
def test_padded_windows_change_nothing(
    build: Callable[..., Any], reduction: str, key: Any, garbage: float
) -> None:
    """A batch with padded windows equals the batch without them, statistics included."""
    loss = build(reduction=reduction)
    if key == "valid":
        loss.loss_mask_key = "valid"
    windows = make_windows(5, 6)
    padded = torch.cat([windows[:2], torch.full_like(windows[:2], garbage), windows[2:]])
    mask = torch.ones(7, 6, 1, dtype=torch.bool)
    mask[2:4] = False
    padded[key] = mask
    assert_same(loss, padded, windows)


@BUILDERS
def test_padded_steps_change_nothing(build: Callable[..., Any]) -> None:
    """Slices padded at the end: what stands there has no influence, and no diagnostic is NaN."""
    loss = build()
    windows = make_windows(5, 8)
    windows["collector", "mask"] = torch.ones(5, 8, 1, dtype=torch.bool)
    windows["collector", "mask"][1, 5:] = windows["collector", "mask"][4, 2:] = False
    other = windows.clone()
    for key in ("observation", "action"):
        other[key][1, 5:] = math.nan
        other[key][4, 2:] = math.inf
    assert_same(loss, other, windows)
    # Whatever a padded step says about the end of an episode is padding too.
    assert all(value.isfinite().all() for value in loss(other).values())


@BUILDERS
@pytest.mark.parametrize("flag", ["done", "is_init"])
def test_pairs_across_an_episodes_end_do_not_count(build: Callable[..., Any], flag: str) -> None:
    """Two episodes in one window equal the two in windows of their own."""
    loss = build()
    windows = make_windows(4, 10)
    if flag == "done":
        windows["next", "done"] = torch.zeros(4, 10, 1, dtype=torch.bool)
        windows["next", "done"][:, 4] = True
    else:
        windows["is_init"] = torch.zeros(4, 10, 1, dtype=torch.bool)
        windows["is_init"][:, 5] = True
    apart = torch.cat([windows[:, :5], windows[:, 5:]])
    assert_same(loss, windows, apart.select("observation", "action"))
    joined = loss(windows.select("observation", "action"))
    assert not torch.isclose(total(joined), total(loss(windows)), rtol=1e-4)


@BUILDERS
def test_nothing_left_gives_zero_and_no_gradient(build: Callable[..., Any]) -> None:
    loss = build()
    windows = make_windows(2, 6)
    windows["next", "done"] = torch.ones(2, 6, 1, dtype=torch.bool)
    terms = loss(windows)
    key = "loss_prediction" if build is jepa else "loss_nll"
    assert terms[key].isfinite()
    predictor = [p for n, p in loss.named_parameters() if "trunks" in n]
    gradients = torch.autograd.grad(terms[key], predictor, allow_unused=True)
    assert all(g is None or not g.any() for g in gradients)


@BUILDERS
def test_flat_slices_of_a_replay_buffer(build: Callable[..., Any]) -> None:
    """A SliceSampler's batch as it comes equals the same batch as windows."""
    steps = make_windows(90)
    steps["episode"] = torch.arange(3).repeat_interleave(30)
    steps["next", "done"] = steps["next", "truncated"] = torch.zeros(90, 1, dtype=torch.bool)
    steps["next", "terminated"] = torch.zeros(90, 1, dtype=torch.bool)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(90), sampler=SliceSampler(slice_len=6, traj_key="episode"), batch_size=48
    )
    buffer.extend(steps)
    flat = buffer.sample()
    windows = flat.reshape(-1, 6)
    assert flat.shape == (48,)
    assert windows["next", "done"][:, -1].all()
    assert_same(build(make_model(JEPA) if build is jepa else make_model()), flat, windows)


@BUILDERS
def test_any_number_of_batch_dimensions(build: Callable[..., Any]) -> None:
    windows = make_windows(2, 3, 6)
    windows["is_init"] = torch.rand(2, 3, 6, 1) < 0.2
    assert_same(build(), windows, windows.reshape(6, 6))


@pytest.mark.parametrize("flag", [("next", "done"), "is_init", ("collector", "mask")])
def test_flags_with_and_without_a_trailing_dimension(flag: Any) -> None:
    windows = make_windows(4, 8)
    windows[flag] = torch.rand(4, 8) < (0.8 if flag == ("collector", "mask") else 0.2)
    trailing = windows.clone()
    trailing[flag] = windows[flag].unsqueeze(-1)
    assert_same(vjepa(), windows, trailing)


def test_side_information_is_that_of_the_target() -> None:
    """p(Z_{t+k} | Z_t, xi_{t+k}): xi before t + k has no influence."""
    model = VJEPA(
        linear_encoder(OBS, LATENT),
        Predictor(LATENT, ACTION, skips=(2,), side_info_dim=2),
        target_scale=TargetScale(LATENT, kind="constant", init_std=1e-3),
    ).double()
    loss = vjepa(model)
    windows = make_windows(5, 6)
    windows["side_info"] = torch.randn(5, 6, 2, dtype=torch.float64)
    other = windows.clone()
    other["side_info"][:, :2] += 5
    assert_same(loss, other, windows)
    other["side_info"][:, 2] += 5
    assert not torch.isclose(loss(other)["loss_nll"], loss(windows)["loss_nll"])


# --- several models as one batch


def first_gradients(loss: Any, batch: TensorDict) -> dict[str, torch.Tensor]:
    torch.manual_seed(11)
    total(loss(batch)).backward()
    return {name: p.grad for name, p in loss.named_parameters() if p.numel()}


def trained(loss: Any, batches: list[TensorDict]) -> list[TensorDict]:
    updater = SoftUpdate(loss, eps=0.8)
    optimizer = torch.optim.Adam(loss.parameters(), 1e-2)
    history = []
    for step, batch in enumerate(batches):
        torch.manual_seed(step)
        terms = loss(batch)
        total(terms).backward()
        optimizer.step()
        optimizer.zero_grad()
        updater.step()
        history.append(terms.detach())
    return history


@pytest.mark.parametrize(("stacked", "whitened"), [(False, False), (True, False), (False, True)])
@BUILDERS
def test_a_list_trains_like_each_model_alone(
    build: Callable[..., Any], stacked: bool, whitened: bool
) -> None:
    """Values, gradients and five steps of Adam and EMA; the targets are sampled."""
    whitening = Whitening(OBS) if whitened else None
    if whitening is not None:
        whitening.update(torch.randn(100, OBS) * torch.linspace(0.5, 2, OBS) + 1)
    cls = JEPA if build is jepa else VJEPA
    models = [make_model(cls, whitening=copy.deepcopy(whitening)) for _ in range(3)]
    batches = [make_windows(3, 4, 7) if stacked else make_windows(4, 7) for _ in range(5)]
    for batch in batches:
        batch["is_init"] = torch.rand(*batch.shape, 1) < 0.1
        batch["collector", "mask"] = torch.rand(*batch.shape, 1) < 0.9
    gradients = first_gradients(build(copy.deepcopy(models), stacked_data=stacked), batches[0])
    several = build(copy.deepcopy(models), stacked_data=stacked)
    history = trained(several, batches)
    for i, model in enumerate(models):
        mine = [batch[i] if stacked else batch for batch in batches]
        for name, gradient in first_gradients(build(copy.deepcopy(model)), mine[0]).items():
            torch.testing.assert_close(gradient, gradients[name][i])
        alone = build(model)
        for ours, theirs in zip(history, trained(alone, mine), strict=True):
            ours = {key: value[i] for key, value in ours.items()}
            torch.testing.assert_close(ours, theirs.to_dict(), rtol=1e-6, atol=1e-8)
        state = several.get_model(i).state_dict()
        torch.testing.assert_close(state, alone.get_model().state_dict(), rtol=1e-6, atol=1e-8)


def test_adding_a_model_changes_no_other_models_numbers() -> None:
    models = [make_model() for _ in range(3)]
    windows = make_windows(4, 7)
    results = []
    for number in (1, 2, 3):
        torch.manual_seed(2)
        results.append(vjepa(copy.deepcopy(models[:number]))(windows))
    for key, values in results[-1].items():
        torch.testing.assert_close(results[0][key], values[:1])
        torch.testing.assert_close(results[1][key], values[:2])


def test_get_model_hands_back_the_given_object() -> None:
    models = [make_model() for _ in range(2)]
    loss = vjepa(models)
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter[1] += 1
    before = [copy.deepcopy(model.state_dict()) for model in models]
    assert loss.get_model(1) is models[1]
    for name, value in models[1].state_dict().items():
        torch.testing.assert_close(value, before[1][name] + (0 if "log_var_" in name else 1))
    assert all(torch.equal(v, before[0][n]) for n, v in models[0].state_dict().items())
    single = vjepa()
    assert all(a is b for a, b in zip(single.get_model().parameters(), single.parameters(), strict=True))


def test_a_list_with_reduction_none() -> None:
    loss = vjepa([make_model(std=1e-9), make_model(std=1e-9)], reduction="none")
    terms = loss(make_windows(4, 7))
    assert all(value.shape == (2, 4, 7) for value in terms.values())


# --- bad input


def spoilt(**entries: Any) -> TensorDict:
    windows = make_windows(4, 6)
    for key, value in entries.items():
        windows[key] = value
    return windows


def with_value(key: str, value: float) -> TensorDict:
    windows = make_windows(4, 6)
    windows[key][1, 2, 0] = value
    return windows


BAD_WINDOWS = {
    "no action": (lambda: make_windows(4, 6).exclude("action"), KeyError, "'action', which the input lacks"),
    "no observation": (lambda: make_windows(4, 6).exclude("observation"), KeyError, "'observation', which"),
    "bytes": (
        lambda: spoilt(observation=torch.zeros(4, 6, OBS, dtype=torch.uint8)),
        ValueError,
        "'observation' must be floating point, got torch.uint8; convert it first",
    ),
    "integer actions": (
        lambda: spoilt(action=torch.zeros(4, 6, ACTION + 1, dtype=torch.int64)),
        ValueError,
        "'action' must be floating point, got torch.int64",
    ),
    "NaN": (lambda: with_value("observation", math.nan), ValueError, "'observation' must be finite.*got 1 "),
    "infinite": (lambda: with_value("action", math.inf), ValueError, "'action' must be finite.*mark them"),
    "short": (lambda: make_windows(4, 3), ValueError, "longer than the largest skip 3, got T=3; sample"),
    "one step": (lambda: make_windows(), ValueError, "must be windows of shape"),
    "observation size": (
        lambda: spoilt(observation=torch.randn(4, 6, OBS + 1).double()),
        ValueError,
        r"'observation' must have shape .*6\), got \(24, 7\)",
    ),
    "action size": (lambda: spoilt(action=torch.randn(4, 6, 3).double()), ValueError, "action must have"),
    "other dtype": (lambda: make_windows(4, 6).float(), TypeError, "dtype of the encoder's weights"),
    "mask shape": (
        lambda: spoilt(shifted_valid=torch.ones(4, 6, 2, dtype=torch.bool)),
        ValueError,
        r"mask 'shifted_valid' must have shape .*got \(4, 6, 2\)",
    ),
    "is_init shape": (
        lambda: spoilt(is_init=torch.ones(4, 6, 2, dtype=torch.bool)),
        ValueError,
        r"is_init must have shape .*got \(4, 6, 2\)",
    ),
}


@pytest.mark.parametrize("case", BAD_WINDOWS)
@pytest.mark.parametrize("build", [jepa, vjepa])
def test_bad_windows_are_refused(build: Callable[..., Any], case: str) -> None:
    make, error, message = BAD_WINDOWS[case]
    windows = make()
    before = windows.clone()
    loss = build()
    state = copy.deepcopy(loss.state_dict())
    with pytest.raises(error, match=message):
        loss(windows)
    assert set(windows.keys(True, True)) == set(before.keys(True, True))
    for key, value in windows.items(True, True):
        torch.testing.assert_close(value, before[key], equal_nan=True)
    after = loss.state_dict()
    assert all(torch.equal(value, after[key]) for key, value in state.items() if torch.is_tensor(value))


def test_the_other_entry_may_have_any_size_alike() -> None:
    """Observation and action of one size: dispatch takes it for a batch dimension."""
    model = JEPA(linear_encoder(4, LATENT), Predictor(LATENT, 4, head=DeltaHead(), skips=(1, 2)))
    loss = jepa(model)
    windows = TensorDict(observation=torch.randn(4, 4, 4), action=torch.randn(4, 4, 4), batch_size=(4, 4))
    by_keyword = loss(**windows.to_dict())
    torch.testing.assert_close(dict(zip(loss.out_keys, by_keyword, strict=True)), loss(windows).to_dict())


@BUILDERS
def test_keyword_call_without_actions(build: Callable[..., Any]) -> None:
    """A single entry, from which dispatch cannot tell the batch size at all."""
    model = VJEPA(linear_encoder(OBS, LATENT), Predictor(LATENT, skips=(1, 2))).double()
    loss = build(model)
    windows = make_windows(4, 6).select("observation")
    torch.manual_seed(1)
    expected = loss(windows)
    torch.manual_seed(1)
    results = loss(observation=windows["observation"])
    torch.testing.assert_close(dict(zip(loss.out_keys, results, strict=True)), expected.to_dict())


@pytest.mark.parametrize("cls", [JEPALoss, VJEPALoss])
def test_a_regulariser_can_be_switched_on_later(cls: type[Any]) -> None:
    """Coefficients of zero at the start, raised by a schedule."""
    loss = cls(make_model())
    SoftUpdate(loss, eps=0.99)
    windows = make_windows(4, 7)
    loss(windows)
    loss.marginal_entropy_coeff = 0.1
    assert loss(windows)["loss_entropy"] > 0
    assert "loss_entropy" in loss.out_keys


@pytest.mark.parametrize("cls", [JEPA, VJEPA])
def test_images(cls: type[JEPA]) -> None:
    """Observations of any shape, with padding, equal the same numbers as vectors."""
    network = nn.Linear(OBS, LATENT)
    encoders = [
        TensorDictModule(nn.Sequential(flatten, network), ["observation"], ["latent"])
        for flatten in (nn.Flatten(-3), nn.Identity())
    ]
    windows = make_windows(4, 7).float()
    windows["collector", "mask"] = torch.rand(4, 7, 1) < 0.8
    images = windows.clone()
    images["observation"] = images["observation"].reshape(4, 7, 1, 2, OBS // 2)
    predictor = Predictor(LATENT, ACTION, skips=SKIPS)
    results = []
    for encoder, data in zip(encoders, (images, windows), strict=True):
        loss = (JEPALoss if cls is JEPA else VJEPALoss)(cls(encoder, predictor))
        SoftUpdate(loss, eps=0.99)
        torch.manual_seed(1)
        results.append(loss(data))
    torch.testing.assert_close(results[0].to_dict(), results[1].to_dict())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: VJEPALoss([]), "non-empty list"),
        (lambda: VJEPALoss(None), "must be a VJEPA .* got .*NoneType"),
        (lambda: VJEPALoss(make_model(), skip_weights=(1.0, -1.0)), "skip_weights must be one finite weight"),
        (lambda: JEPALoss([make_model(), "model"]), "must be a JEPA or a non-empty list"),
        (lambda: VJEPALoss(make_model(JEPA)), r"model must be a VJEPA .* got \['JEPA'\]"),
        (lambda: VJEPALoss([make_model(), make_model(JEPA)]), "must be a VJEPA"),
        (lambda: JEPALoss(make_model(JEPA), stacked_data=True), "stacked_data=True needs a list of models"),
        (lambda: JEPALoss(make_model(JEPA), reduction="max"), "reduction must be .* got 'max'"),
        (lambda: JEPALoss(make_model(JEPA), prediction_coeff=-1.0), "prediction_coeff .* got -1.0"),
        (lambda: VJEPALoss(make_model(), target_kl_coeff=math.nan), "target_kl_coeff .* got nan"),
        (lambda: VJEPALoss(make_model(), variance_coeff=math.inf), "variance_coeff .* got inf"),
        (lambda: VJEPALoss(make_model(), covariance_coeff=-2), "covariance_coeff .* got -2"),
        (lambda: VJEPALoss(make_model(), marginal_entropy_coeff=-2), "marginal_entropy_coeff .* got -2"),
        (lambda: VJEPALoss(make_model(), target_scale_gradient="all"), "target_scale_gradient .* got 'all'"),
        (lambda: VJEPALoss(make_model(), residual_variance="full"), "residual_variance .* got 'full'"),
    ],
)
def test_bad_arguments_are_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_models_of_different_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="one architecture, but '.*' is .* in model 1"):
        VJEPALoss([make_model(), make_model(skips=(1, 2))])


def test_the_same_model_twice_is_refused() -> None:
    """get_model(0) and get_model(1) would write into the same object."""
    model = make_model()
    with pytest.raises(ValueError, match="distinct models"):
        VJEPALoss([model, model])


@pytest.mark.parametrize("shape", [(4, 6), (3, 4, 6)])
def test_stacked_data_of_the_wrong_shape_is_refused(shape: tuple[int, ...]) -> None:
    loss = vjepa([make_model(), make_model()], stacked_data=True)
    with pytest.raises(ValueError, match=r"stacked_data=True needs windows of shape \(2, \*B, T\).*got"):
        loss(make_windows(*shape))


@pytest.mark.parametrize("index", [None, -1, 2])
def test_bad_index_of_a_model_is_refused(index: int | None) -> None:
    with pytest.raises(ValueError, match=rf"index must be in \[0, 1\], got {index}"):
        vjepa([make_model(), make_model()]).get_model(index)
    with pytest.raises(ValueError, match="index must be None for a single model, got 0"):
        vjepa().get_model(0)
