"""TorchRL's own conventions for losses, on every loss of the library."""

from __future__ import annotations

import copy
import math
import pickle
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.modules import RandomPolicy
from torchrl.objectives import SoftUpdate
from torchrl.objectives.common import LossModule
from torchrl.trainers import TargetNetUpdaterHook, Trainer

from torchrl_vjepa import (
    BJEPA,
    JEPA,
    VAE,
    VJEPA,
    BatchedNoisyTVEnv,
    BJEPALoss,
    DeltaHead,
    GaussianPrior,
    JEPALoss,
    PixelAR,
    PixelARLoss,
    PixelDecoder,
    Predictor,
    QuadraticReward,
    RewardLoss,
    TargetScale,
    VAELoss,
    VJEPALoss,
    linear_encoder,
    mlp_encoder,
)

# The observation's size is the batch's and the window's: dispatch must not be fooled by it.
OBS, LATENT, ACTION = 5, 3, 2
ROWS, STEPS = 5, 5
REGULARISERS = {
    "variance_coeff": 0.5,
    "covariance_coeff": 0.3,
    "marginal_entropy_coeff": 0.2,
    "sliced_entropy_coeff": 0.4,
}
OF_THE_BATCH = {"loss_variance", "loss_covariance", "loss_entropy", "loss_sliced"}  # statistics
SKIPS = (1, 2)


def _encoder() -> Any:
    return mlp_encoder(OBS, LATENT, num_cells=[8])


def _vjepa() -> VJEPA:
    # Not 1, where the KL of the target's scale is least.
    scale = TargetScale(LATENT, init_std=0.5)
    return VJEPA(_encoder(), Predictor(LATENT, ACTION, skips=SKIPS), target_scale=scale)


def _jepa_loss(**kwargs: Any) -> LossModule:
    predictor = Predictor(LATENT, ACTION, head=DeltaHead(), skips=SKIPS)
    return JEPALoss(JEPA(_encoder(), predictor), **REGULARISERS, **kwargs)


def _head_loss(**kwargs: Any) -> LossModule:
    return VJEPALoss(_vjepa(), **REGULARISERS, **kwargs)


def _batch_loss(**kwargs: Any) -> LossModule:
    return VJEPALoss(_vjepa(), residual_variance="batch", **REGULARISERS, **kwargs)


def _list_loss(**kwargs: Any) -> LossModule:
    return VJEPALoss([_vjepa(), _vjepa()], **REGULARISERS, **kwargs)


def _bjepa() -> BJEPA:
    prior = GaussianPrior(LATENT, mean=0.3, std=0.6, learnable=True)
    return BJEPA(
        _encoder(),
        Predictor(LATENT, ACTION, skips=SKIPS),
        structural_prior=prior,
        target_scale=TargetScale(LATENT, init_std=0.5),
    )


def _structural_loss(**kwargs: Any) -> LossModule:
    return BJEPALoss(_bjepa(), **REGULARISERS, **kwargs)


def _structural_list_loss(**kwargs: Any) -> LossModule:
    return BJEPALoss([_bjepa(), _bjepa()], skip_weights=(1.0, 2.0), **REGULARISERS, **kwargs)


def _reward_loss(**kwargs: Any) -> LossModule:
    head = QuadraticReward(LATENT, ACTION)
    torch.nn.init.normal_(head.linear)
    return RewardLoss(_vjepa(), TensorDictModule(head, ["latent", "action"], ["reward"]), **kwargs)


def _pixel_loss(**kwargs: Any) -> LossModule:
    encoder = _encoder()
    return PixelARLoss(PixelAR(encoder, PixelDecoder(encoder, LATENT, OBS, ACTION)), **kwargs)


def _pixel_list_loss(**kwargs: Any) -> LossModule:
    encoders = [_encoder(), _encoder()]
    models = [PixelAR(e, PixelDecoder(e, LATENT, OBS, ACTION)) for e in encoders]
    return PixelARLoss(models, **kwargs)


def _vae_loss(**kwargs: Any) -> LossModule:
    return VAELoss(VAE(OBS, LATENT), **kwargs)


BUILDERS = {
    "JEPALoss": _jepa_loss,
    "VJEPALoss head": _head_loss,
    "VJEPALoss batch": _batch_loss,
    "VJEPALoss list": _list_loss,
    "BJEPALoss": _structural_loss,
    "BJEPALoss list": _structural_list_loss,
    "RewardLoss": _reward_loss,
    "PixelARLoss": _pixel_loss,
    "PixelARLoss list": _pixel_list_loss,
    "VAELoss": _vae_loss,
}
JOINT = [name for name in BUILDERS if "JEPA" in name]
EVERY = pytest.mark.parametrize("name", BUILDERS)
EVERY_JOINT = pytest.mark.parametrize("name", JOINT)


def make_loss(name: str, **kwargs: Any) -> Any:
    if name in JOINT:
        kwargs.setdefault("collapse_rank", 0.0)
    loss = BUILDERS[name](**kwargs)
    if name in JOINT:
        SoftUpdate(loss, eps=0.9)
    return loss


def make_windows(dtype: torch.dtype = torch.float32) -> TensorDict:
    windows = TensorDict(
        observation=torch.randn(ROWS, STEPS, OBS, dtype=dtype),
        action=torch.randn(ROWS, STEPS, ACTION, dtype=dtype),
        is_init=torch.zeros(ROWS, STEPS, 1, dtype=torch.bool),
        batch_size=(ROWS, STEPS),
    )
    windows["next"] = TensorDict(
        reward=torch.randn(ROWS, STEPS, 1, dtype=dtype),
        done=torch.zeros(ROWS, STEPS, 1, dtype=torch.bool),
        batch_size=(ROWS, STEPS),
    )
    windows["next", "done"][1, 2] = windows["is_init"][1, 3] = True
    return windows


def total(terms: TensorDict) -> Tensor:
    return sum(value.sum() for key, value in terms.items() if key.startswith("loss_"))


def seeded(loss: Any, *args: Any, **kwargs: Any) -> Any:
    torch.manual_seed(7)
    return loss(*args, **kwargs)


# --- keys


@EVERY
def test_set_keys(name: str) -> None:
    loss = make_loss(name)
    windows = make_windows()
    expected = seeded(loss, windows)
    renamed = windows.rename_key_("is_init", "begin").rename_key_(("next", "done"), ("next", "end"))
    without = seeded(loss, renamed)
    if name not in ("RewardLoss", "VAELoss"):  # neither one step of imagination nor none crosses an end
        assert not torch.isclose(total(without), total(expected), rtol=1e-6)
    loss.set_keys(is_init="begin", done=("next", "end"))
    assert loss.tensor_keys.is_init == "begin"
    assert "begin" in loss.in_keys
    assert ("next", "end") in loss.in_keys
    assert "is_init" not in loss.in_keys
    torch.testing.assert_close(seeded(loss, renamed).to_dict(), expected.to_dict())
    assert make_loss(name).tensor_keys.is_init == "is_init"
    loss.set_keys(is_init=None)
    assert loss.tensor_keys.is_init == "is_init"
    with pytest.raises(ValueError, match="colour is not an accepted tensordict key"):
        loss.set_keys(colour="red")


def test_reward_key() -> None:
    loss = make_loss("RewardLoss")
    windows = make_windows()
    expected = loss(windows)
    windows.rename_key_(("next", "reward"), ("next", "gain"))
    loss.set_keys(reward=("next", "gain"))
    assert ("next", "gain") in loss.in_keys
    torch.testing.assert_close(loss(windows).to_dict(), expected.to_dict())


@EVERY
def test_keyword_call_equals_tensordict_call(name: str) -> None:
    loss = make_loss(name)
    windows = make_windows()
    expected = seeded(loss, windows)
    flat = {"_".join([k] if isinstance(k, str) else k): windows[k] for k in loss.in_keys}
    results = seeded(loss, **flat)
    results = results if isinstance(results, tuple) else (results,)
    assert list(expected.keys()) == loss.out_keys
    torch.testing.assert_close(dict(zip(loss.out_keys, results, strict=True)), expected.to_dict())


@EVERY
def test_select_out_keys(name: str) -> None:
    loss = make_loss(name)
    windows = make_windows()
    key = loss.out_keys[0]
    expected = seeded(loss, windows)[key]
    loss.select_out_keys(key)
    assert loss.out_keys == [key]
    terms = seeded(loss, windows)
    assert list(terms.keys()) == [key]
    torch.testing.assert_close(terms[key], expected)
    flat = {"_".join([k] if isinstance(k, str) else k): windows[k] for k in loss.in_keys}
    torch.testing.assert_close(seeded(loss, **flat), expected)
    with pytest.raises(ValueError, match="loss_none"):
        loss.select_out_keys("loss_none")


@EVERY
def test_input_is_unchanged(name: str) -> None:
    windows = make_windows()
    before, keys = windows.clone(), list(windows.keys(True, True))
    total(make_loss(name)(windows)).backward()
    assert list(windows.keys(True, True)) == keys
    assert (windows == before).all()
    assert not any(value.requires_grad for value in windows.values(True, True))
    make_loss(name)(windows.lock_())


# --- outputs


@EVERY
def test_entries_fit_the_trainer(name: str) -> None:
    """loss_* entries carry the gradient, nothing else does; finite scalars, one per model."""
    terms = make_loss(name)(make_windows())
    shape = (2,) if "list" in name else ()
    assert any(key.startswith("loss_") for key in terms.keys())  # noqa: SIM118 (a TensorDict iterates over rows, not keys)
    for key, value in terms.items():
        assert value.shape == shape
        assert value.dtype == torch.float32
        assert value.isfinite().all()
        assert value.requires_grad == key.startswith("loss_"), key


@EVERY
def test_reductions(name: str) -> None:
    windows = make_windows()
    results = {}
    for reduction in ("mean", "sum", "none"):
        torch.manual_seed(1)
        loss = make_loss(name, reduction=reduction)
        results[reduction] = seeded(loss, windows)
        assert list(results[reduction].keys()) == loss.out_keys
    assert all(key.startswith("loss_") for key in results["none"].keys())  # noqa: SIM118 (a TensorDict iterates over rows, not keys)
    lead = (2,) if "list" in name else ()
    per_pair = {"loss_nll", "loss_head", "loss_prediction", "loss_reconstruction", "loss_structural_kl"}
    for key, value in results["none"].items():
        assert value.shape == (*lead, ROWS, STEPS)
        summed, mean = results["sum"][key], results["mean"][key]
        if key in OF_THE_BATCH:
            torch.testing.assert_close(value, mean.reshape(*lead, 1, 1).expand_as(value))
            torch.testing.assert_close(summed, mean)
            continue
        torch.testing.assert_close(value.sum((-1, -2)), summed)
        if key not in per_pair:
            torch.testing.assert_close(summed / (ROWS * STEPS), mean)
    if name == "PixelARLoss":
        summed, mean = (results[reduction]["loss_reconstruction"] for reduction in ("sum", "mean"))
        torch.testing.assert_close(summed / (ROWS * (STEPS - 1) - 1), mean)


@EVERY
def test_mask_semantics(name: str) -> None:
    """("collector", "mask") and "shifted_valid" by default; another key on request; None: no mask."""
    loss = make_loss(name)
    windows = make_windows()
    mask = torch.ones(ROWS, STEPS, 1, dtype=torch.bool)
    mask[3:] = False
    plain = seeded(loss, windows)
    reference = seeded(loss, windows.clone().set(("collector", "mask"), mask))
    assert not torch.isclose(total(reference), total(plain), rtol=1e-6)
    shifted = seeded(loss, windows.clone().set("shifted_valid", mask))
    torch.testing.assert_close(shifted.to_dict(), reference.to_dict())
    fewer = mask.clone()
    fewer[:2] = False
    both = windows.clone().set("shifted_valid", fewer | ~mask).set(("collector", "mask"), mask)
    joined = seeded(loss, windows.clone().set("shifted_valid", fewer))
    torch.testing.assert_close(seeded(loss, both).to_dict(), joined.to_dict())
    loss.loss_mask_key = None
    masked = windows.clone().set(("collector", "mask"), mask)
    torch.testing.assert_close(seeded(loss, masked).to_dict(), plain.to_dict())
    loss.loss_mask_key = "keep"
    other = seeded(loss, windows.clone().set("keep", mask.squeeze(-1)))
    torch.testing.assert_close(other.to_dict(), reference.to_dict())


# --- parameters


@EVERY
def test_gradients_reach_every_parameter_and_no_target(name: str) -> None:
    loss = make_loss(name)
    total(loss(make_windows())).backward()
    parameters = {n: p for n, p in loss.named_parameters() if p.numel()}
    assert not any(n.startswith("target_") for n in parameters)
    for n, parameter in parameters.items():
        assert parameter.grad is not None, n
        assert parameter.grad.any(), n
    for n, buffer in loss.named_buffers():
        assert buffer.grad is None, n
        assert not buffer.requires_grad, n
    targets = [n for n, _ in loss.named_buffers() if n.startswith("target_encoder_params")]
    assert bool(targets) == (name in JOINT)


@EVERY_JOINT
def test_an_updater_can_be_built_after_a_forward(name: str) -> None:
    """The targets stay buffers: TorchRL's updaters refuse a target that requires a gradient."""
    loss = make_loss(name)
    total(loss(make_windows())).backward()
    assert not any(value.requires_grad for value in loss.target_encoder_params.values(True, True))
    SoftUpdate(loss, eps=0.9)


@EVERY_JOINT
def test_parameters_are_the_users_own(name: str) -> None:
    """A planner that holds the model sees the updates; a list is stacked, and handed back."""
    loss = make_loss(name)
    own = {id(p) for p in loss.parameters()}
    if "list" in name:
        assert {id(p) for p in loss.get_model(0).parameters()}.isdisjoint(own)
    else:
        assert {id(p) for p in loss.get_model().parameters()} == own


@EVERY_JOINT
def test_soft_update(name: str) -> None:
    """eq:target_encoder_weights_EMA, with tau = eps, on every parameter and no more."""
    loss = make_loss(name)
    updater = SoftUpdate(loss, eps=0.9)
    for value in loss.target_encoder_params.values(True, True):
        value.data.normal_()
    before = {key: value.clone() for key, value in loss.target_encoder_params.data.items(True, True)}
    loss(make_windows())
    updater.step()
    online = loss.encoder_params.data
    for key, value in loss.target_encoder_params.data.items(True, True):
        torch.testing.assert_close(value, 0.9 * before[key] + 0.1 * online[key])


@EVERY_JOINT
def test_missing_updater_warns(name: str) -> None:
    loss = BUILDERS[name]()
    with pytest.warns(UserWarning, match="No target network updater has been associated"):
        loss(make_windows())
    SoftUpdate(loss, eps=0.9)
    loss(make_windows())  # warnings are errors


@EVERY
def test_construction_and_repr_are_quiet(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loss = make_loss(name)
        assert type(loss).__name__ in repr(loss)
        assert loss.out_keys[0] in repr(loss)


@EVERY
def test_state_dict_round_trip(name: str) -> None:
    """Into a fresh loss, after its updater was built (building one overwrites the targets)."""
    loss = make_loss(name)
    for buffer_name, buffer in loss.named_buffers():
        if buffer_name.startswith("target_encoder"):
            buffer.data.normal_()
    state = copy.deepcopy(loss.state_dict())
    assert any(key.startswith("target_encoder") for key in state) == (name in JOINT)
    fresh = make_loss(name)
    windows = make_windows()
    if name == "RewardLoss":  # the model is not the loss's to save
        fresh.__dict__.update({part: getattr(loss, part) for part in ("encoder", "predictor")})
    assert not torch.isclose(total(seeded(fresh, windows)), total(seeded(loss, windows)), rtol=1e-6)
    fresh.load_state_dict(state)
    torch.testing.assert_close(seeded(fresh, windows).to_dict(), seeded(loss, windows).to_dict())


@EVERY
def test_copies_and_pickles(name: str) -> None:
    loss = make_loss(name)
    windows = make_windows()
    expected = seeded(loss, windows).to_dict()
    for clone in (copy.deepcopy(loss), pickle.loads(pickle.dumps(loss))):
        torch.testing.assert_close(seeded(clone, windows).to_dict(), expected)


@EVERY
def test_reset_parameters_recursive(name: str) -> None:
    loss = make_loss(name)
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter.fill_(3.0)
    loss.reset_parameters_recursive()
    for n, parameter in loss.named_parameters():
        if parameter.numel():
            assert not (parameter == 3.0).any(), n
    assert total(loss(make_windows())).isfinite()


# --- numbers


@EVERY
def test_casts(name: str) -> None:
    loss = make_loss(name)
    if name == "RewardLoss":
        loss.encoder.double(), loss.predictor.double()
    loss.double()
    terms = loss(make_windows(torch.float64))
    assert all(value.dtype == torch.float64 for value in terms.values())
    total(terms).backward()
    if name == "RewardLoss":
        loss.encoder.float(), loss.predictor.float()
    terms = loss.float()(make_windows())
    assert all(value.dtype == torch.float32 for value in terms.values())


@EVERY
def test_autocast_computes_the_loss_in_single_precision(name: str) -> None:
    loss = make_loss(name)
    windows = make_windows()
    exact = seeded(loss, windows)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        terms = seeded(loss, windows)
    total(terms).backward()
    for key, value in terms.items():
        assert value.dtype == torch.float32, key
        assert value.isfinite().all(), key
    assert all(p.grad.isfinite().all() for p in loss.parameters() if p.numel())
    torch.testing.assert_close(total(terms), total(exact), rtol=0.05, atol=0.05)


@EVERY_JOINT
def test_coefficients_are_schedulable(name: str) -> None:
    loss = make_loss(name)
    windows = make_windows()
    pairs = {"marginal_entropy_coeff": "loss_entropy", "variance_coeff": "loss_variance"}
    pairs |= {"covariance_coeff": "loss_covariance", "sliced_entropy_coeff": "loss_sliced"}
    if "BJEPA" in name:
        pairs["structural_kl_coeff"] = "loss_structural_kl"
    pairs["prediction_coeff" if name == "JEPALoss" else "target_kl_coeff"] = (
        "loss_prediction" if name == "JEPALoss" else "loss_target_kl"
    )
    for coefficient, key in pairs.items():
        unit = seeded(loss, windows)[key] / getattr(loss, coefficient)
        setattr(loss, coefficient, 0.125)
        assert coefficient in loss.state_dict()
        assert isinstance(dict(loss.named_buffers())[coefficient], Tensor)
        torch.testing.assert_close(seeded(loss, windows)[key], 0.125 * unit)


@pytest.mark.parametrize(
    "name", ["VJEPALoss batch", "BJEPALoss list", "RewardLoss", "PixelARLoss", "VAELoss"]
)
@pytest.mark.filterwarnings("ignore:.*inline_inbuilt_nn_modules:FutureWarning")  # tensordict's own,
@pytest.mark.filterwarnings("ignore:Using lock_:UserWarning")  # under vmap
def test_compiles_as_one_graph(name: str) -> None:
    loss = make_loss(name)
    windows = make_windows()
    expected = seeded(loss, windows)
    torch._dynamo.reset()
    compiled = torch.compile(loss, backend="eager", fullgraph=True)
    terms = seeded(compiled, windows)
    torch.testing.assert_close(dict(terms.items()), dict(expected.items()), rtol=1e-4, atol=1e-5)
    total(terms).backward()
    assert all(p.grad is not None for p in loss.parameters() if p.numel())


# --- TorchRL's training loop


class _Log:
    def __init__(self) -> None:
        self.logged: dict[str, float] = {}

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        self.logged[name] = float(value)


@pytest.mark.parametrize("build", [JEPALoss, VJEPALoss, BJEPALoss, RewardLoss, PixelARLoss, VAELoss])
@pytest.mark.filterwarnings("ignore:The 'optimizer' hook stage:FutureWarning")  # Trainer's own
def test_trains_under_the_trainer(build: Callable[..., Any]) -> None:
    """Collector, loss, optimizer and EMA hook of TorchRL, as they come."""
    env = BatchedNoisyTVEnv(4, noise_scale=1.0, seed=0)
    encoder = linear_encoder(20, LATENT)
    model: Any = BJEPA(encoder, Predictor(LATENT, ACTION))
    if build is PixelARLoss:
        model = PixelAR(encoder, PixelDecoder(encoder, LATENT, 20, ACTION))
    if build is VAELoss:
        model = VAE(20, LATENT)
    head = TensorDictModule(QuadraticReward(LATENT, ACTION), ["latent", "action"], ["reward"])
    loss = RewardLoss(model, head) if build is RewardLoss else build(model)
    before = copy.deepcopy(loss.state_dict())
    targets = build in (JEPALoss, VJEPALoss, BJEPALoss)
    updater = SoftUpdate(loss, eps=0.9) if targets else None
    logger = _Log()
    trainer = Trainer(
        collector=Collector(env, RandomPolicy(env.action_spec), frames_per_batch=40, total_frames=80),
        total_frames=80,
        frame_skip=1,
        optim_steps_per_batch=2,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), 1e-2),
        logger=logger,
        log_interval=1,
        progress_bar=False,
        save_trainer_file=None,
    )
    if updater is not None:
        trainer.register_op("post_optim", TargetNetUpdaterHook(updater))
    trainer.train()
    assert set(loss.out_keys) <= set(logger.logged)
    assert all(math.isfinite(value) for value in logger.logged.values())
    changed = {key for key, value in loss.state_dict().items() if not torch.equal(value, before[key])}
    assert any("encoder" in key or "reward_model" in key for key in changed)
    assert any(key.startswith("target_encoder_params") for key in changed) == targets
