"""Whitening against exact moments; encoders against plain layers and step-by-step recurrence."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict, from_module
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import GymEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.modules import get_env_transforms_from_module, set_recurrent_mode
from torchrl.objectives import LossModule
from torchrl.objectives.utils import SoftUpdate

from torchrl_vjepa.encoders import history_encoder, linear_encoder, mlp_encoder
from torchrl_vjepa.whitening import Whitening

FACTORIES: dict[str, Callable[..., TensorDictModuleBase]] = {
    "linear": linear_encoder,
    "mlp": lambda *args, **kw: mlp_encoder(*args, num_cells=(16,), **kw),
    "residual mlp": lambda *args, **kw: mlp_encoder(*args, num_cells=(16,), residual=True, **kw),
    "history": lambda *args, **kw: history_encoder(*args, hidden_dim=6, **kw),
}
every_encoder = pytest.mark.parametrize("make", FACTORIES.values(), ids=FACTORIES)


def _correlated(num: int, dim: int, spread: float = 3.0) -> Tensor:
    scales = torch.logspace(0, -spread, dim, dtype=torch.float64)
    rotation = torch.linalg.qr(torch.randn(dim, dim, dtype=torch.float64)).Q
    return (torch.randn(num, dim, dtype=torch.float64) * scales) @ rotation.mT + 4


def _covariance(x: Tensor) -> Tensor:
    return torch.cov(x.reshape(-1, x.shape[-1]).mT, correction=0).reshape(x.shape[-1], -1)


def _whitening(dim: int, **kwargs: float | str) -> Whitening:
    whitening = Whitening(dim, **kwargs)
    whitening.update(_correlated(200, dim))
    return whitening


# --- whitening: the mathematics


@pytest.mark.parametrize("dim", [1, 2, 8])
def test_whitened_data_have_zero_mean_and_identity_covariance(dim: int) -> None:
    x = _correlated(300, dim)
    whitening = Whitening(dim).double()
    whitening.update(x)
    y = whitening(x)
    identity = torch.eye(dim, dtype=torch.float64)
    torch.testing.assert_close(y.mean(0), torch.zeros(dim).double(), atol=1e-9, rtol=0)
    torch.testing.assert_close(_covariance(y), identity, atol=1e-8, rtol=0)
    # The ZCA root is the symmetric one, and the inverse is its inverse.
    torch.testing.assert_close(whitening.transform, whitening.transform.mT)
    squared = whitening.transform @ _covariance(x) @ whitening.transform
    torch.testing.assert_close(squared, identity, atol=1e-8, rtol=0)
    torch.testing.assert_close(whitening.inverse(y), x)
    single = Whitening(dim)
    single.update(x.float())
    torch.testing.assert_close(_covariance(single(x.float())), torch.eye(dim), atol=2e-3, rtol=0)


@given(
    sizes=st.lists(st.integers(0, 30), min_size=1, max_size=6).filter(lambda s: sum(s) > 1),
    dim=st.integers(1, 5),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=40)
def test_streaming_equals_one_batch(sizes: list[int], dim: int, seed: int) -> None:
    torch.manual_seed(seed)
    x = _correlated(sum(sizes), dim, spread=1) + 100
    once, streamed = Whitening(dim), Whitening(dim)
    once.update(x)
    for part in x.split(sizes):
        streamed.update(part)
    torch.testing.assert_close(streamed.mean, x.mean(0))
    torch.testing.assert_close(streamed.covariance, _covariance(x), rtol=1e-9, atol=1e-9)
    assert streamed.count == once.count == sum(sizes)
    if sum(sizes) > 2 * dim:
        torch.testing.assert_close(streamed.transform, once.transform, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("keepdim", [False, True])
@pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e300])
def test_masked_rows_do_not_count(keepdim: bool, garbage: float) -> None:
    x = _correlated(60, 3).reshape(6, 10, 3)
    mask = torch.rand(6, 10) < 0.6
    expected = Whitening(3)
    expected.update(x[mask])
    masked = Whitening(3)
    masked.update(torch.full((4, 3), garbage, dtype=torch.float64), torch.zeros(4, dtype=torch.bool))
    assert masked.count == 0
    assert torch.equal(masked.transform, torch.eye(3))
    masked.update(torch.where(mask.unsqueeze(-1), x, garbage), mask.unsqueeze(-1) if keepdim else mask)
    assert masked.count == mask.sum()
    torch.testing.assert_close(masked.state_dict(), expected.state_dict())
    masked.update(torch.full((4, 3), math.nan), torch.zeros(4, dtype=torch.bool))
    masked.update(torch.zeros(0, 3))
    torch.testing.assert_close(masked.state_dict(), expected.state_dict())


def test_ill_conditioned_and_rank_deficient_data() -> None:
    rotation = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64)).Q
    x = torch.randn(500, 3, dtype=torch.float64) * torch.tensor([1.0, 1e-3, 1e-7]) @ rotation.mT
    within, floored = Whitening(3, eps=1e-16).double(), Whitening(3, eps=1e-8).double()
    for whitening in (within, floored):
        whitening.update(x)
        torch.testing.assert_close(whitening.inverse(whitening(x)), x, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(_covariance(within(x)), torch.eye(3).double(), atol=1e-2, rtol=0)
    # Under the floor a direction keeps less than unit variance: value / floor.
    spectrum = torch.linalg.eigvalsh(_covariance(floored(x)))
    values = torch.linalg.eigvalsh(_covariance(x))
    expected = values / values.clamp(min=1e-8 * values.max())
    torch.testing.assert_close(spectrum, expected.sort().values, atol=1e-6, rtol=1e-3)

    flat = torch.randn(50, 1) @ torch.ones(1, 4)
    whitening = Whitening(4)
    whitening.update(flat)
    y = whitening(flat)
    assert torch.isfinite(y).all()
    spectrum = torch.linalg.eigvalsh(_covariance(y))
    torch.testing.assert_close(spectrum, torch.tensor([0.0, 0, 0, 1]), atol=1e-3, rtol=0)


def test_floor_is_relative_or_absolute() -> None:
    x = torch.tensor([[10.0, 0.1], [-10.0, 0.1], [10.0, -0.1], [-10.0, -0.1]])
    for floor, eps, expected in (
        ("relative", 0.01, [1 / 10, 1 / 1.0]),  # 0.01 * 100
        ("relative", 1e-6, [1 / 10, 1 / 0.1]),
        ("absolute", 0.04, [1 / 10, 1 / 0.2]),
        ("absolute", 400.0, [1 / 20, 1 / 20]),
    ):
        whitening = Whitening(2, eps=eps, floor=floor)
        whitening.update(x)
        torch.testing.assert_close(whitening.transform, torch.diag(torch.tensor(expected)))


def test_before_the_first_update_and_after_one_sample() -> None:
    whitening = Whitening(3)
    x = torch.randn(4, 3)
    assert torch.equal(whitening(x), x)
    assert torch.equal(whitening.inverse(x), x)
    whitening.update(torch.tensor([1.0, 2.0, 3.0]))
    assert whitening.count == 1
    torch.testing.assert_close(whitening(x), x - torch.tensor([1.0, 2.0, 3.0]))
    whitening.update(torch.tensor([1.0, 2.0, 3.0]).expand(5, 3))
    torch.testing.assert_close(whitening(x), x - torch.tensor([1.0, 2.0, 3.0]))
    whitening.update(torch.tensor([3.0, 2.0, 3.0]))
    assert torch.isfinite(whitening.transform).all()


# --- whitening: the module


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e200])
def test_refused_observations_leave_the_state_unchanged(bad: float) -> None:
    whitening = _whitening(3)
    before = copy.deepcopy(whitening.state_dict())
    x = torch.randn(5, 3, dtype=torch.float64)
    x[3, 1] = bad
    with pytest.raises(ValueError, match=r"observation must be finite.* whitening is unchanged"):
        whitening.update(x)
    with pytest.raises(ValueError, match="whitening is unchanged"):
        whitening.update(x, torch.tensor([True, True, True, True, False]))
    with pytest.raises(ValueError, match=r"shape \(\*B, 3\), got \(5, 2\)"):
        whitening.update(x[:, :2])
    with pytest.raises(TypeError, match="floating point"):
        whitening.update(torch.ones(5, 3, dtype=torch.int64))
    with pytest.raises(TypeError, match="mask must be boolean"):
        whitening.update(torch.ones(5, 3), torch.ones(5))
    with pytest.raises(ValueError, match="mask must have shape"):
        whitening.update(torch.ones(5, 3), torch.ones(4, dtype=torch.bool))
    torch.testing.assert_close(whitening.state_dict(), before, rtol=0, atol=0)
    whitening.update(x, torch.tensor([True, True, True, False, True]))
    assert whitening.count == 204


def test_overflow_of_the_merged_covariance_is_refused() -> None:
    whitening = Whitening(1)
    whitening.update(torch.tensor([1e200], dtype=torch.float64))
    before = copy.deepcopy(whitening.state_dict())
    with pytest.raises(ValueError, match="finite covariance, got one that overflows"):
        whitening.update(torch.tensor([-1e200], dtype=torch.float64))
    torch.testing.assert_close(whitening.state_dict(), before, rtol=0, atol=0)


def test_forward_never_updates_and_update_never_tracks_gradients() -> None:
    whitening = _whitening(3).train()
    before = copy.deepcopy(whitening.state_dict())
    x = torch.randn(50, 3, requires_grad=True)
    whitening(x).sum().backward()
    assert torch.isfinite(x.grad).all()
    torch.testing.assert_close(whitening.state_dict(), before, rtol=0, atol=0)
    whitening.update(x)
    assert not any(buffer.requires_grad for buffer in whitening.buffers())
    assert not list(whitening.parameters())


def test_state_dict_round_trip_continues_the_stream() -> None:
    first, second = _whitening(4), Whitening(4)
    second.load_state_dict(first.state_dict())
    more = _correlated(30, 4)
    for whitening in (first, second):
        whitening.update(more)
    torch.testing.assert_close(first.state_dict(), second.state_dict(), rtol=0, atol=0)
    third = pickle.loads(pickle.dumps(first))
    assert torch.equal(third(more.float()), first(more.float()))


def test_updates_are_in_place_so_that_sharers_see_them_and_copies_do_not() -> None:
    whitening = Whitening(3)
    shared = dict(whitening.named_buffers())
    whitening.update(_correlated(50, 3))
    assert all(shared[name] is buffer for name, buffer in whitening.named_buffers())

    class Loss(LossModule):
        encoder: TensorDictModuleBase
        encoder_params: TensorDict
        target_encoder_params: TensorDict

        def __init__(self, encoder: TensorDictModuleBase) -> None:
            super().__init__()
            self.convert_to_functional(encoder, "encoder", create_target_params=True)

    loss = Loss(linear_encoder(3, 2, whitening=whitening))
    updater = SoftUpdate(loss, eps=0.5)
    fitted = whitening.transform.clone()
    whitening.update(_correlated(50, 3) * 10)
    updater.step()
    key = ("module", "whitening", "transform")
    assert torch.equal(loss.encoder_params[key], whitening.transform)
    # Documented in Whitening: a target encoder keeps the statistics it was built with.
    assert torch.equal(loss.target_encoder_params[key], fitted)
    assert not torch.equal(whitening.transform, fitted)


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
def test_dtype_casts(dtype: torch.dtype) -> None:
    whitening = _whitening(3)
    x = torch.randn(8, 3)
    expected = whitening(x)
    cast = copy.deepcopy(whitening).to(dtype)
    assert cast(x.to(dtype)).dtype == dtype
    tolerance = 0.05 if dtype.itemsize == 2 else 1e-4
    relative = (cast(x.to(dtype)) - expected).abs().max() / expected.abs().max()
    assert relative < tolerance
    assert cast.count.dtype == torch.int64
    cast.update(x.to(dtype))
    assert cast.count == 208


def test_whitening_maps_over_stacked_buffers() -> None:
    modules = [_whitening(3) for _ in range(4)]
    x = torch.randn(4, 7, 3)
    _, buffers = torch.func.stack_module_state(modules)
    mapped = torch.func.vmap(lambda state, row: torch.func.functional_call(modules[0], state, (row,)))(
        buffers, x
    )
    torch.testing.assert_close(mapped, torch.stack([m(row) for m, row in zip(modules, x, strict=True)]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"observation_dim": 0}, "observation_dim must be an integer of at least 1, got 0"),
        ({"observation_dim": 2.0}, "observation_dim must be an integer of at least 1, got 2.0"),
        ({"eps": 0.0}, "eps must be positive and finite, got 0.0"),
        ({"eps": math.nan}, "eps must be positive and finite, got nan"),
        ({"floor": "none"}, "floor must be 'relative' or 'absolute', got 'none'"),
    ],
)
def test_whitening_refuses_arguments(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Whitening(**{"observation_dim": 3, **arguments})


# --- encoders


def test_linear_encoder_is_exactly_its_matrix() -> None:
    encoder = linear_encoder(5, 2)
    (weight,) = encoder.parameters()
    x = torch.randn(7, 5)
    torch.testing.assert_close(encoder(observation=x), x @ weight.mT)
    assert (encoder(observation=torch.zeros(5)) == 0).all()
    assert len(list(linear_encoder(5, 2, bias=True).parameters())) == 2


def test_mlp_encoder_is_its_layers() -> None:
    encoder = mlp_encoder(5, 2, num_cells=(8, 4), activation_class=nn.Tanh)
    weights = list(encoder.parameters())
    assert [tuple(w.shape) for w in weights] == [(8, 5), (8,), (4, 8), (4,), (2, 4), (2,)]
    x = torch.randn(7, 5)
    hidden = torch.tanh(torch.tanh(x @ weights[0].mT + weights[1]) @ weights[2].mT + weights[3])
    torch.testing.assert_close(encoder(observation=x), hidden @ weights[4].mT + weights[5])
    assert len(list(mlp_encoder(5, 2, num_cells=()).parameters())) == 2


@pytest.mark.parametrize("whitened", [False, True])
def test_residual_mlp_encoder_adds_a_linear_map(whitened: bool) -> None:
    whitening = _whitening(5) if whitened else None
    encoder = mlp_encoder(5, 2, num_cells=(8,), residual=True, whitening=whitening)
    network = encoder.module.network
    assert [tuple(w.shape) for w in network.linear.parameters()] == [(2, 5)]
    assert [tuple(w.shape) for w in network.mlp.parameters()] == [(8, 5), (8,), (2, 8), (2,)]
    x = torch.randn(7, 5)
    y = x if whitening is None else whitening(x)
    torch.testing.assert_close(
        encoder(observation=x), y @ network.linear.weight.mT + network.mlp(y), atol=1e-5, rtol=1e-5
    )
    assert {"linear", "mlp"} == {name for name, _ in network.named_children()}


@every_encoder
@pytest.mark.parametrize("batch", [(), (3,), (2, 3), (2, 1, 3), (0,)])
def test_any_batch_dimensions(make: Callable, batch: tuple[int, ...]) -> None:
    encoder = make(5, 2)
    x = torch.randn(*batch, 5)
    out = encoder(TensorDict(observation=x, batch_size=batch))["latent"]
    assert out.shape == (*batch, 2)
    if x.numel():
        rows = encoder(TensorDict(observation=x.reshape(-1, 5)))["latent"]
        torch.testing.assert_close(out.reshape(-1, 2), rows)


@every_encoder
def test_keys_can_be_renamed_and_nested(make: Callable) -> None:
    encoder = make(5, 2, in_key=("agent", "pixels"), out_key=("agent", "z"))
    x = torch.randn(3, 5)
    out = encoder(TensorDict(agent={"pixels": x}, batch_size=3))
    assert out["agent", "z"].shape == (3, 2)
    assert "latent" not in out
    assert encoder.in_keys[0] == ("agent", "pixels")
    assert encoder.out_keys[0] == ("agent", "z")
    with pytest.raises(ValueError, match=r"\('agent', 'pixels'\) must have shape \(\*B, 5\)"):
        encoder(TensorDict(agent={"pixels": x[:, :3]}, batch_size=3))


@every_encoder
def test_whitening_is_applied_first_and_not_trained(make: Callable) -> None:
    whitening = _whitening(3)
    white = make(3, 2, whitening=whitening)
    plain = make(3, 2)
    plain.load_state_dict({k: v for k, v in white.state_dict().items() if "whitening" not in k})
    x = torch.randn(6, 3)
    out = white(TensorDict(observation=x))["latent"]
    torch.testing.assert_close(out, plain(TensorDict(observation=whitening(x)))["latent"])
    assert not torch.allclose(out, plain(TensorDict(observation=x))["latent"])
    out.sum().backward()
    assert all(p.grad is not None for p in white.parameters())
    assert {id(p) for p in white.parameters()}.isdisjoint(id(b) for b in white.buffers())
    whitening.update(torch.randn(50, 3) * 9)  # shared, not copied
    assert not torch.allclose(out, white(TensorDict(observation=x))["latent"])


@every_encoder
def test_encoders_refuse_sizes_shapes_dtypes_and_missing_keys(make: Callable) -> None:
    encoder = make(5, 2)
    with pytest.raises(ValueError, match=r"'observation' must have shape \(\*B, 5\), got \(3, 4\)"):
        encoder(TensorDict(observation=torch.zeros(3, 4)))
    with pytest.raises(TypeError, match="'observation' must be floating point, got torch.uint8"):
        encoder(TensorDict(observation=torch.zeros(3, 5, dtype=torch.uint8)))
    with pytest.raises(TypeError, match=r"dtype of the encoder's weights, torch\.float32"):
        encoder(TensorDict(observation=torch.zeros(3, 5, dtype=torch.float64)))
    with pytest.raises(KeyError, match="observation"):
        encoder(TensorDict(state=torch.zeros(3, 5)))
    for sizes in ((0, 2), (5, 0), (5, -1), (2.5, 2), (True, 2)):
        with pytest.raises(ValueError, match="_dim must be an integer of at least 1, got"):
            make(*sizes)
    with pytest.raises(ValueError, match="whitening must have observation_dim=5 .* got 3"):
        make(5, 2, whitening=Whitening(3))


def test_sizes_of_hidden_layers_are_checked() -> None:
    with pytest.raises(ValueError, match="num_cells must be an integer of at least 1, got 0"):
        mlp_encoder(5, 2, num_cells=(8, 0))
    with pytest.raises(ValueError, match="hidden_dim must be an integer of at least 1, got 0"):
        history_encoder(5, 2, 0)
    with pytest.raises(ValueError, match="num_layers must be an integer of at least 1, got 0"):
        history_encoder(5, 2, 4, num_layers=0)


@every_encoder
def test_values_that_are_not_finite_pass_through(make: Callable) -> None:
    x = torch.randn(4, 3)
    x[1, 0] = math.nan
    out = make(3, 2, whitening=_whitening(3))(TensorDict(observation=x))["latent"]
    assert out[1].isnan().all()
    assert torch.isfinite(out[[0, 2, 3]]).all()


@every_encoder
def test_encoders_pickle_and_run_under_autocast_and_in_double(make: Callable) -> None:
    encoder = make(3, 2, whitening=_whitening(3))
    x = torch.randn(4, 3)
    expected = encoder(TensorDict(observation=x))["latent"]
    again = pickle.loads(pickle.dumps(encoder))
    assert torch.equal(again(TensorDict(observation=x))["latent"], expected)
    double = copy.deepcopy(encoder).double()(TensorDict(observation=x.double()))["latent"]
    torch.testing.assert_close(double, expected.double(), rtol=1e-3, atol=1e-3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        encoder(TensorDict(observation=x.bfloat16()))


@every_encoder
@pytest.mark.parametrize("windows", [False, True])
def test_encoders_map_over_stacked_parameters(make: Callable, windows: bool) -> None:
    encoders = [make(3, 2, whitening=_whitening(3)).double() for _ in range(4)]
    template = make(3, 2, whitening=Whitening(3)).double()
    data = TensorDict(
        observation=torch.randn(4, 5, 6, 3, dtype=torch.float64),
        is_init=torch.rand(4, 5, 6, 1) < 0.3,
        batch_size=[4],
    )

    def with_params(params: TensorDict, row: TensorDict) -> Tensor:
        with params.to_module(template):
            return template(row.copy())["latent"]

    def with_call(state: dict[str, Tensor], row: TensorDict) -> Tensor:
        return torch.func.functional_call(template, state, (row.copy(),))["latent"]

    with set_recurrent_mode(windows), torch.no_grad():
        own = torch.stack([e(row.copy())["latent"] for e, row in zip(encoders, data, strict=True)])
        same = torch.stack([e(data[0].copy())["latent"] for e in encoders])
        params = TensorDict.from_modules(*encoders, as_module=False)
        torch.testing.assert_close(torch.func.vmap(with_params)(params, data), own)
        shared = torch.func.vmap(with_params, in_dims=(0, None))(params, data[0])
        torch.testing.assert_close(shared, same)
        weights, buffers = torch.func.stack_module_state(encoders)
        torch.testing.assert_close(torch.func.vmap(with_call)({**weights, **buffers}, data), own)


@every_encoder
def test_swapped_parameters_leave_the_encoder_as_it_was(make: Callable) -> None:
    encoder = make(3, 2)
    data = TensorDict(observation=torch.randn(4, 3))
    before = encoder(data.copy())["latent"]
    with from_module(encoder).apply(torch.zeros_like).to_module(encoder):
        assert (encoder(data.copy())["latent"] == 0).all()
    assert torch.equal(encoder(data.copy())["latent"], before)


# --- history


def _stepwise(encoder: TensorDictModuleBase, window: TensorDict) -> tuple[Tensor, Tensor]:
    """Acting, one step after the other, the state carried by hand."""
    latents, states, state = [], [], None
    for step in window.unbind(-1):
        step = step.exclude(("next", "history"))
        if state is not None:
            step["history"] = state
        out = encoder(step)
        state = out["next", "history"]
        latents.append(out["latent"])
        states.append(state)
    return torch.stack(latents, window.ndim - 1), torch.stack(states, window.ndim - 1)


def _window(*batch: int, share: float = 0.3) -> TensorDict:
    return TensorDict(
        observation=torch.randn(*batch, 3), is_init=torch.rand(*batch, 1) < share, batch_size=batch
    )


@pytest.mark.parametrize("num_layers", [1, 2])
def test_history_equals_torch_gru_on_each_episode(num_layers: int) -> None:
    encoder = history_encoder(3, 2, 6, num_layers=num_layers)
    reference = nn.GRU(3, 6, num_layers, batch_first=True)
    reference.load_state_dict(encoder.gru.state_dict())
    x = torch.randn(1, 9, 3)
    window = TensorDict(observation=x, is_init=torch.zeros(1, 9, 1).bool(), batch_size=[1, 9])
    window["is_init"][0, [0, 4, 5]] = True
    with set_recurrent_mode(True):
        out = encoder(window)
    parts = [reference(part) for part in (x[:, :4], x[:, 4:5], x[:, 5:])]
    features = torch.cat([features for features, _ in parts], 1)
    torch.testing.assert_close(out["latent"], encoder.readout(features))
    for end, (_, state) in zip((3, 4, 8), parts, strict=True):
        torch.testing.assert_close(out["next", "history"][:, end], state.transpose(0, 1))


@pytest.mark.parametrize("batch", [(7,), (4, 7), (2, 3, 7), (4, 1)])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("num_layers", [1, 2])
def test_windows_equal_acting_step_by_step(batch: tuple[int, ...], share: float, num_layers: int) -> None:
    encoder = history_encoder(3, 2, 6, num_layers=num_layers, whitening=_whitening(3))
    window = _window(*batch, share=share)
    latent, state = _stepwise(encoder, window)
    with set_recurrent_mode(True):
        out = encoder(window.copy())
    torch.testing.assert_close(out["latent"], latent)
    torch.testing.assert_close(out["next", "history"], state)


def test_windows_start_from_the_stored_state_and_reset_whatever_is_stored() -> None:
    encoder = history_encoder(3, 2, 6)
    whole = _window(4, 10)
    whole["is_init"][:, 5] = False
    whole["is_init"][1, 5] = True
    latent, state = _stepwise(encoder, whole)
    tail = whole[:, 5:].copy()
    # Right at the first step; elsewhere garbage that must not be read, at resets least of all.
    tail["history"] = torch.full((4, 5, 1, 6), math.nan)
    tail["history"][:, 0] = state[:, 4]
    tail["history"][1, 0] = math.nan
    with set_recurrent_mode(True):
        torch.testing.assert_close(encoder(tail.copy())["latent"], latent[:, 5:])
        fresh = encoder(tail.exclude("history"))["latent"]
    restarted = whole[:, 5:].copy()
    restarted["is_init"][:, 0] = True
    torch.testing.assert_close(fresh, _stepwise(encoder, restarted)[0])
    assert not torch.allclose(fresh, latent[:, 5:])


def test_the_past_matters_the_future_and_other_episodes_do_not() -> None:
    encoder = history_encoder(3, 2, 6)
    window = _window(1, 8, share=0.0)
    window["is_init"][0, 4] = True
    x = window["observation"].requires_grad_()
    with set_recurrent_mode(True):
        latent = encoder(window)["latent"]
    for t in range(8):
        (gradient,) = torch.autograd.grad(latent[0, t].sum(), x, retain_graph=True)
        seen = gradient[0].abs().sum(-1) > 0
        start = 0 if t < 4 else 4
        assert seen.tolist() == [start <= s <= t for s in range(8)]


def test_a_missing_flag_falls_back_to_done_and_then_to_one_episode() -> None:
    encoder = history_encoder(3, 2, 6)
    window = _window(4, 9)
    window["is_init"][:, 0] = False
    done = torch.cat([window["is_init"][:, 1:], torch.ones(4, 1, 1).bool()], 1)
    unmarked = window.exclude("is_init")
    with set_recurrent_mode(True):
        expected = encoder(window.copy())["latent"]
        marked = unmarked.copy()
        marked["next", "done"] = done
        torch.testing.assert_close(encoder(marked)["latent"], expected)
        unbroken = encoder(unmarked.copy())["latent"]
        zeros = window.copy()
        zeros["is_init"] = torch.zeros_like(window["is_init"])
        torch.testing.assert_close(unbroken, encoder(zeros)["latent"])
    # Acting: nothing is reset, and ("next", "done") of another step is not read.
    step = TensorDict(observation=torch.randn(2, 3), history=torch.randn(2, 1, 6), batch_size=[2])
    expected = encoder(step.copy())["latent"]
    step["next"] = TensorDict(done=torch.ones(2, 1).bool(), batch_size=[2])
    torch.testing.assert_close(encoder(step)["latent"], expected)


def test_history_keys_can_be_renamed() -> None:
    encoder = history_encoder(3, 2, 6, state_key=("memory", "gru"), is_init_key=("agent", "is_init"))
    renamed = TensorDict(
        observation=torch.randn(2, 3),
        agent={"is_init": torch.tensor([True, False])},  # without a last dimension too
        memory={"gru": torch.randn(2, 1, 6)},
        batch_size=[2],
    )
    plain = history_encoder(3, 2, 6)
    plain.load_state_dict(encoder.state_dict())
    expected = plain(
        TensorDict(
            observation=renamed["observation"],
            is_init=renamed["agent", "is_init"].unsqueeze(-1),
            history=renamed["memory", "gru"],
            batch_size=[2],
        )
    )
    out = encoder(renamed)
    torch.testing.assert_close(out["latent"], expected["latent"])
    torch.testing.assert_close(out["next", "memory", "gru"], expected["next", "history"])
    assert encoder.in_keys == ["observation", ("memory", "gru"), ("agent", "is_init")]
    primer = encoder.make_tensordict_primer()
    assert ("memory", "gru") in primer.primers.keys(True, True)


def test_history_refuses_shapes() -> None:
    encoder = history_encoder(3, 2, 6)
    with pytest.raises(ValueError, match=r"'history' must have shape \(4, 1, 6\) .* got \(4, 6\)"):
        encoder(TensorDict(observation=torch.zeros(4, 3), history=torch.zeros(4, 6)))
    with pytest.raises(ValueError, match=r"'is_init' must have shape \(4,\) or \(4, 1\)"):
        encoder(TensorDict(observation=torch.zeros(4, 3), is_init=torch.zeros(4, 3).bool()))
    with (
        set_recurrent_mode(True),
        pytest.raises(ValueError, match=r"\(\*B, T, 3\) under set_recurrent_mode"),
    ):
        encoder(TensorDict(observation=torch.zeros(3)))
    with (
        set_recurrent_mode(True),
        pytest.raises(ValueError, match=r"at least one step.* got \(4, 0, 3\)"),
    ):
        encoder(TensorDict(observation=torch.zeros(4, 0, 3)))


@pytest.mark.parametrize("windows", [False, True])
def test_history_compiles_into_one_graph(windows: bool) -> None:
    encoder = history_encoder(3, 2, 6, whitening=_whitening(3))
    window = _window(4, 3)
    data = window if windows else window[:, 0]
    data["history"] = torch.randn(*data.batch_size, 1, 6)
    with set_recurrent_mode(windows):
        compiled = torch.compile(encoder, backend="eager", fullgraph=True)
        out = compiled(data.copy())
        torch.testing.assert_close(out["latent"], encoder(data.copy())["latent"])


def _pendulum(steps: int) -> TransformedEnv:
    return TransformedEnv(GymEnv("Pendulum-v1"), StepCounter(steps))


class _Torque(nn.Module):
    def forward(self, latent: Tensor) -> Tensor:
        return latent.tanh()


@pytest.mark.parametrize("workers", [1, 2])
def test_acting_in_an_environment_equals_windows(workers: int) -> None:
    encoder = history_encoder(3, 1, 6)
    # Episodes of different lengths: resets reach some rows of the batch only.
    if workers == 1:
        env = _pendulum(4)
    else:
        env = TransformedEnv(SerialEnv(2, [partial(_pendulum, 4), partial(_pendulum, 7)]))
    for transform in get_env_transforms_from_module(encoder):
        env.append_transform(transform.clone())
    policy = TensorDictSequential(
        encoder, TensorDictModule(_Torque(), in_keys=["latent"], out_keys=["action"])
    )
    env.set_seed(0)
    with torch.no_grad():
        data = env.rollout(15, policy, break_when_any_done=False)
        starts = data["is_init"].squeeze(-1).reshape(workers, 15)
        assert starts.sum(-1).tolist() == ([4] if workers == 1 else [4, 3])
        assert (data["history"][data["is_init"].squeeze(-1)] == 0).all()
        assert (data["history"] != 0).any()
        with set_recurrent_mode(True):
            again = encoder(data.exclude("latent", ("next", "history")))
        torch.testing.assert_close(again["latent"], data["latent"])
        torch.testing.assert_close(again["next", "history"], data["next", "history"])
        # A slice from the middle of the data, with the stored state at its start.
        with set_recurrent_mode(True):
            part = encoder(data[..., 5:12].exclude("latent", ("next", "history")))
        torch.testing.assert_close(part["latent"], data[..., 5:12]["latent"])
    env.close()
