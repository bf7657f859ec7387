"""RewardLoss against a loop, its gradients and masks, and a reward that it must fit exactly."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_vjepa import (
    VJEPA,
    PixelAR,
    PixelDecoder,
    Predictor,
    QuadraticReward,
    RewardLoss,
    history_encoder,
    linear_encoder,
)

OBS, LATENT, ACTION = 6, 3, 2


def make_model(**kwargs: Any) -> VJEPA:
    return VJEPA(linear_encoder(OBS, LATENT), Predictor(LATENT, ACTION, **kwargs)).double()


def make_head(out_features: int = 1) -> TensorDictModule:
    """A head with random parameters: a quadratic form, or a linear map to several numbers."""
    network: nn.Module = QuadraticReward(LATENT, ACTION)
    if out_features > 1:
        network = _Concat(nn.Linear(LATENT + ACTION, out_features))
    for parameter in network.parameters():
        nn.init.normal_(parameter)
    return TensorDictModule(network.double(), in_keys=["latent", "action"], out_keys=["reward"])


class _Concat(nn.Module):
    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return self.network(torch.cat([latent, action], -1))


def make_windows(*batch: int) -> TensorDict:
    windows = TensorDict(
        observation=torch.randn(*batch, OBS, dtype=torch.float64),
        action=torch.randn(*batch, ACTION, dtype=torch.float64),
        batch_size=batch,
    )
    windows["next", "reward"] = torch.randn(*batch, 1, dtype=torch.float64)
    return windows


def loop(
    model: Any, head: TensorDictModule, windows: TensorDict, steps: int, counts: Any
) -> tuple[Tensor, float]:
    """Mean squared and absolute error over the rollouts that count, one at a time."""
    squared, absolute = [], []
    rows, length = windows.shape
    for b in range(rows):
        for t in range(length - steps + 1):
            if not counts(b, t):
                continue
            latent = model.encoder(windows[b, t].clone())["latent"]
            for k in range(t, t + steps):
                action = windows["action"][b, k]
                latent = model.predictor.dist(latent, action).mean
                error = head.module(latent, action) - windows["next", "reward"][b, k]
                squared.append(error.square())
                absolute.append(error.abs().item())
    return torch.stack(squared).mean(), float(np.mean(absolute))


def everything(b: int, t: int) -> bool:
    return True


@pytest.mark.parametrize("num_steps", [1, 3])
@pytest.mark.parametrize("kind", ["vjepa", "pixel"])
def test_equals_a_loop(num_steps: int, kind: str) -> None:
    model: Any = make_model()
    if kind == "pixel":
        encoder = linear_encoder(OBS, LATENT)
        model = PixelAR(encoder, PixelDecoder(encoder, LATENT, OBS, ACTION)).double()
    head, windows = make_head(), make_windows(4, 6)
    terms = RewardLoss(model, head, num_steps=num_steps)(windows)
    squared, absolute = loop(model, head, windows, num_steps, everything)
    torch.testing.assert_close(terms["loss_reward"], squared)
    assert terms["reward_error"].item() == pytest.approx(absolute)
    assert not terms["reward_error"].requires_grad


@pytest.mark.parametrize("num_steps", [1, 3])
def test_masks(num_steps: int) -> None:
    """Rollouts that leave an episode or meet padding do not count; a last step's own reward does."""
    model, head, windows = make_model(), make_head(), make_windows(12, 9)
    done, is_init = torch.rand(12, 9) < 0.15, torch.rand(12, 9) < 0.15
    mask = torch.rand(12, 9) < 0.9
    clean = windows.clone()
    for key in ("observation", "action", ("next", "reward")):
        windows[key] = torch.where(mask.unsqueeze(-1), windows[key], math.nan)
    windows["next", "done"], windows["is_init"] = done.unsqueeze(-1), is_init
    windows["collector", "mask"] = mask.unsqueeze(-1)

    def counts(b: int, t: int) -> bool:
        last = t + num_steps - 1
        joined = not done[b, t:last].any() and not is_init[b, t + 1 : last + 1].any()
        return bool(joined and mask[b, t : last + 1].all())

    loss = RewardLoss(model, head, num_steps=num_steps)
    terms = loss(windows)
    squared, absolute = loop(model, head, clean, num_steps, counts)
    torch.testing.assert_close(terms["loss_reward"], squared)
    assert terms["reward_error"].item() == pytest.approx(absolute)
    ours = torch.autograd.grad(terms["loss_reward"], list(loss.parameters()))
    theirs = torch.autograd.grad(squared, list(head.parameters()))
    torch.testing.assert_close(ours, theirs)
    flat = loss(windows.reshape(-1)) if num_steps == 1 else None
    assert flat is None or torch.isclose(flat["loss_reward"], squared)


@pytest.mark.parametrize("num_steps", [1, 3])
def test_reductions(num_steps: int) -> None:
    model, head, windows = make_model(), make_head(), make_windows(4, 6)
    windows["collector", "mask"] = torch.rand(4, 6, 1) < 0.8
    results = {
        reduction: RewardLoss(model, head, num_steps=num_steps, reduction=reduction)(windows)
        for reduction in ("mean", "sum", "none")
    }
    rows = results["none"]["loss_reward"]
    assert list(results["none"].keys()) == ["loss_reward"]
    assert rows.shape == (4, 6)
    assert (rows[:, 7 - num_steps :] == 0).all()
    torch.testing.assert_close(rows.sum(), results["sum"]["loss_reward"])
    torch.testing.assert_close(rows.sum() / (rows != 0).sum(), results["mean"]["loss_reward"])
    torch.testing.assert_close(results["sum"]["reward_error"], results["mean"]["reward_error"])


@pytest.mark.parametrize("num_steps", [1, 3])
@pytest.mark.parametrize("train_model", [False, True])
def test_gradient_reaches_the_model_on_request_only(num_steps: int, train_model: bool) -> None:
    model, head = make_model(), make_head()
    loss = RewardLoss(model, head, num_steps=num_steps, train_model=train_model)
    windows = make_windows(4, 6)
    loss(windows)["loss_reward"].backward()
    assert all(p.grad is not None and p.grad.any() for p in head.parameters())
    encoder, trunk = model.encoder.module.network.weight, model.predictor.trunks[0].weight
    listed = {id(p) for p in loss.parameters()}
    assert {id(p) for p in head.parameters()} <= listed
    assert ({id(encoder), id(trunk)} <= listed) == train_model
    if not train_model:
        assert all(p.grad is None for p in model.parameters())
        return
    ours = encoder.grad.clone(), trunk.grad.clone()
    squared, _ = loop(model, head, windows, num_steps, everything)
    torch.testing.assert_close(ours, torch.autograd.grad(squared, [encoder, trunk]))


def test_sees_the_model_as_it_stands() -> None:
    """Nothing is copied: a model that trains on is followed."""
    model, head, windows = make_model(), make_head(), make_windows(4, 6)
    loss = RewardLoss(model, head)
    before = loss(windows)["loss_reward"]
    with torch.no_grad():
        model.encoder.module.network.weight.mul_(2)
    after = loss(windows)["loss_reward"]
    assert not torch.isclose(before, after)
    torch.testing.assert_close(after, loop(model, head, windows, 1, everything)[0])


def test_fits_a_quadratic_reward_exactly() -> None:
    """An exact linear model and a reward quadratic in state and action: LBFGS reaches rounding errors."""
    model, head = make_model(bias=True), make_head()
    windows = make_windows(40, 6)
    with torch.no_grad():
        predicted = model.predictor.dist(model.encoder(windows.clone())["latent"], windows["action"]).mean
        goal = torch.tensor([0.5, -1.0, 0.3], dtype=torch.float64)
        cost = (predicted - goal).square().sum(-1) + 0.1 * windows["action"].square().sum(-1)
    windows["next", "reward"] = -cost.unsqueeze(-1)
    loss = RewardLoss(model, head)
    optimizer = torch.optim.LBFGS(
        loss.parameters(),
        max_iter=200,
        line_search_fn="strong_wolfe",
        tolerance_grad=1e-14,
        tolerance_change=0,
    )

    def closure() -> Tensor:
        optimizer.zero_grad()
        value = loss(windows)["loss_reward"]
        value.backward()
        return value

    optimizer.step(closure)
    terms = loss(windows)
    assert terms["loss_reward"].item() < 1e-24
    assert terms["reward_error"].item() < 1e-12
    expected = -torch.diag(torch.tensor([1.0, 1, 1, 0.1, 0.1], dtype=torch.float64))
    torch.testing.assert_close(head.module.matrix.detach(), expected, rtol=0, atol=1e-10)


def test_history_encoder() -> None:
    """Windows with an episode's start inside equal acting step by step."""
    encoder = history_encoder(OBS, LATENT, hidden_dim=5)
    model = VJEPA(encoder, Predictor(LATENT, ACTION)).double()
    head, windows = make_head(), make_windows(3, 6)
    windows["is_init"] = torch.zeros(3, 6, 1, dtype=torch.bool)
    windows["is_init"][:, 0] = windows["is_init"][1, 3] = True
    value = RewardLoss(model, head)(windows)["loss_reward"]
    errors, state = [], torch.zeros(3, 1, 5, dtype=torch.float64)
    for t in range(6):
        step = windows[:, t].clone()
        step["history"] = state
        encoder(step)
        state = step["next", "history"]
        predicted = model.predictor.dist(step["latent"], step["action"]).mean
        errors.append(head.module(predicted, step["action"]) - windows["next", "reward"][:, t])
    torch.testing.assert_close(value, torch.stack(errors).square().mean())


# --- bad input


def refused(
    message: str, error: type[Exception] = ValueError, *, num_steps: int = 1, **entries: Tensor
) -> None:
    windows = make_windows(4, 6)
    for key, value in entries.items():
        windows[("next", key) if key in ("reward", "done") else key] = value
    before = windows.clone()
    with pytest.raises(error, match=message):
        RewardLoss(make_model(), make_head(), num_steps=num_steps)(windows)
    assert set(windows.keys(True, True)) == set(before.keys(True, True))


def test_bad_windows_are_refused() -> None:
    nan = make_windows(4, 6)
    for key in ("observation", "action", ("next", "reward")):
        value = nan[key].clone()
        value[1, 2] = math.nan
        name = key if isinstance(key, str) else key[-1]
        refused(f"{name}.* must be finite", **{name: value})
    refused("num_steps=7 needs windows of at least 7 steps, got T=6", num_steps=7)
    refused("must be floating point", observation=torch.zeros(4, 6, OBS, dtype=torch.uint8))
    refused("'observation' must have shape", observation=torch.zeros(4, 6, OBS + 1).double())
    refused("action must have shape", action=torch.zeros(4, 6, ACTION + 1).double())
    refused("mask 'shifted_valid' must have shape", shifted_valid=torch.ones(4, 6, 3, dtype=torch.bool))


@pytest.mark.parametrize("key", ["observation", "action", ("next", "reward")])
def test_missing_entries_are_refused(key: Any) -> None:
    name = key if isinstance(key, str) else key[-1]
    with pytest.raises(KeyError, match=f"RewardLoss reads the entry .*{name}.*, which the input lacks"):
        RewardLoss(make_model(), make_head())(make_windows(4, 6).exclude(key))


def test_a_head_of_the_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"reward_model must write reward of shape .*1\), got .*2\)"):
        RewardLoss(make_model(), make_head(2))(make_windows(4, 6))


@pytest.mark.parametrize("shape", [(4, 6, 2), (4, 6)])
def test_a_reward_of_the_wrong_shape_is_refused(shape: tuple[int, ...]) -> None:
    windows = make_windows(4, 6)
    windows["next"].batch_size = (4,)
    windows["next", "reward"] = torch.zeros(shape, dtype=torch.float64)
    windows["next"].batch_size = (4, 6)
    with pytest.raises(ValueError, match=r"'reward'.* must have shape .*got"):
        RewardLoss(make_model(), make_head())(windows)


def test_flags_of_the_wrong_shape_are_refused() -> None:
    refused("done.* must have shape", num_steps=3, done=torch.zeros(4, 6, 2, dtype=torch.bool))
    refused("is_init must have shape", num_steps=3, is_init=torch.zeros(4, 6, 2, dtype=torch.bool))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_steps": 0}, "num_steps must be positive, got 0"),
        ({"reduction": "max"}, "reduction must be .* got 'max'"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RewardLoss(make_model(), make_head(), **arguments)


def test_parts_of_the_wrong_kind_are_refused() -> None:
    with pytest.raises(TypeError, match=r"reward_model must be a TensorDictModule.*got QuadraticReward"):
        RewardLoss(make_model(), QuadraticReward(LATENT, ACTION))
    with pytest.raises(TypeError, match="model must be one LatentModel .*got list"):
        RewardLoss([make_model()], make_head())


def test_padded_images() -> None:
    encoder = TensorDictModule(
        nn.Sequential(nn.Flatten(-3), nn.Linear(OBS, LATENT)), in_keys=["observation"], out_keys=["latent"]
    )
    model = VJEPA(encoder, Predictor(LATENT, ACTION)).double()
    windows = make_windows(4, 6)
    windows["observation"] = windows["observation"].reshape(4, 6, 1, 2, OBS // 2)
    windows["collector", "mask"] = torch.ones(4, 6, 1, dtype=torch.bool)
    loss = RewardLoss(model, make_head())
    torch.testing.assert_close(
        loss(windows)["loss_reward"], loss(windows.exclude(("collector", "mask")))["loss_reward"]
    )


def test_a_model_without_actions() -> None:
    model = VJEPA(linear_encoder(OBS, LATENT), Predictor(LATENT)).double()
    head = TensorDictModule(QuadraticReward(LATENT, 0).double(), in_keys=["latent"], out_keys=["reward"])
    windows = make_windows(4, 6).exclude("action")
    latent = model.predictor.dist(model.encoder(windows.clone())["latent"]).mean
    expected = (head.module(latent) - windows["next", "reward"]).square().mean()
    torch.testing.assert_close(RewardLoss(model, head)(windows)["loss_reward"], expected)
