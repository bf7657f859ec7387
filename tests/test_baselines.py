"""The pixel-autoregressive baseline against reduced-rank regression, and its loss against a loop."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable

import pytest
import torch
from oracles import pairs_that_count, reduced_rank_error
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_vjepa.baselines import PixelAR, PixelARLoss, PixelDecoder
from torchrl_vjepa.distributions import Delta
from torchrl_vjepa.encoders import history_encoder, linear_encoder, mlp_encoder

O, D, A = 7, 3, 2  # noqa: E741 (sizes, as in the docstrings)
B, T = 6, 5


def _model(action_dim: int = A, **keywords: object) -> PixelAR:
    encoder = linear_encoder(O, D)
    return PixelAR(encoder, PixelDecoder(encoder, D, O, action_dim, **keywords))


def _windows(*batch: int, action: bool = True) -> TensorDict:
    batch = batch or (B, T)
    data = TensorDict(observation=torch.randn(*batch, O), batch_size=batch)
    return data.set("action", torch.randn(*batch, A)) if action else data


def _errors(model: PixelAR, data: TensorDictBase) -> Tensor:
    """|x_{t+1} - g(f(x_t), u_t)|^2 of every pair of (B, T) windows, one at a time."""
    encode, decode = model.encoder.module.network.weight, model.predictor.decoder.weight
    out = torch.zeros(data.shape)  # the last step has no pair
    for b in range(data.shape[0]):
        for t in range(data.shape[1] - 1):
            z = encode @ data["observation"][b, t]
            inputs = torch.cat([z, data["action"][b, t]]) if data.get("action", None) is not None else z
            out[b, t] = (data["observation"][b, t + 1] - decode @ inputs).pow(2).sum()
    return out


class TestPixelDecoder:
    @pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
    def test_linear_trunk_is_a_matrix_on_latent_and_action(self, batch: tuple[int, ...]) -> None:
        decoder = _model().predictor
        latent, action = torch.randn(*batch, D), torch.randn(*batch, A)
        on_latent, on_action = decoder.decoder.weight.split([D, A], 1)
        assert decoder.decoder.bias is None
        torch.testing.assert_close(
            decoder.decode(latent, action), latent @ on_latent.mT + action @ on_action.mT
        )

    def test_transition_encodes_the_decoded_observation(self) -> None:
        model = _model()
        latent, action = torch.randn(5, D), torch.randn(5, A)
        p = model.predictor.dist(latent, action)
        assert isinstance(p, Delta)
        expected = model.predictor.decode(latent, action) @ model.encoder.module.network.weight.mT
        torch.testing.assert_close(p.mean, expected)

    def test_mlp_trunk(self) -> None:
        model = _model(trunk="mlp", num_cells=(8, 9))
        widths = [m.out_features for m in model.predictor.decoder if isinstance(m, nn.Linear)]
        assert widths == [8, 9, O]
        assert model.predictor.decode(torch.zeros(5, D), torch.zeros(5, A)).shape == (5, O)

    def test_without_control(self) -> None:
        decoder = _model(0).predictor
        latent = torch.randn(5, D)
        assert decoder.in_keys == ["latent"]
        expected = latent @ decoder.decoder.weight.mT
        torch.testing.assert_close(decoder.decode(latent), expected)
        torch.testing.assert_close(decoder.decode(latent, torch.empty(5, 0)), expected)

    @pytest.mark.parametrize(
        ("latent", "action", "message"),
        [
            ((5, D + 1), (5, A), r"latent must have shape \(\*B, 3\), got \(5, 4\)"),
            ((), (A,), r"latent must have shape \(\*B, 3\), got \(\)"),
            ((5, D), (5, A + 1), r"action must have shape \(5, 2\).*got \(5, 3\)"),
            ((5, D), (A,), r"action must have shape \(5, 2\).*got \(2,\)"),
            ((5, D), None, r"action must have shape \(5, 2\).*got None"),
        ],
    )
    def test_wrong_shapes_are_refused(
        self, latent: tuple[int, ...], action: tuple[int, ...] | None, message: str
    ) -> None:
        with pytest.raises(ValueError, match=message):
            _model().predictor.dist(torch.zeros(latent), None if action is None else torch.zeros(action))

    def test_an_action_that_nobody_reads_is_refused(self) -> None:
        with pytest.raises(ValueError, match=r"action must have shape \(5, 0\) \(None for action_dim=0\)"):
            _model(0).predictor.decode(torch.zeros(5, D), torch.zeros(5, A))

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"latent_dim": 0}, "latent_dim and observation_dim must be positive.*got 0, 7 and 2"),
            ({"observation_dim": 0}, "got 3, 0 and 2"),
            ({"action_dim": -1}, "got 3, 7 and -1"),
            ({"trunk": "conv"}, "trunk must be 'linear' or 'mlp', got 'conv'"),
            ({"encoder": history_encoder(O, D, 4)}, "encoder must read one key, the observation"),
        ],
    )
    def test_constructor_errors(self, arguments: dict[str, object], message: str) -> None:
        good = {
            "encoder": linear_encoder(O, D),
            "latent_dim": D,
            "observation_dim": O,
            "action_dim": A,
        }
        with pytest.raises(ValueError, match=message):
            PixelDecoder(**{**good, **arguments})


class TestPixelAR:
    def test_writes_latent_and_prediction(self) -> None:
        model = _model()
        data = _windows(4)
        out = model(data)
        assert model.in_keys == ["observation", "action"]
        assert model.out_keys == ["latent", ("next", "latent")]
        latent = out["observation"] @ model.encoder.module.network.weight.mT
        torch.testing.assert_close(out["latent"], latent)
        torch.testing.assert_close(out["next", "latent"], model.predictor.dist(latent, out["action"]).mean)

    def test_nested_and_renamed_keys(self) -> None:
        encoder = linear_encoder(O, D, in_key=("s", "x"), out_key=("s", "z"))
        decoder = PixelDecoder(
            encoder, D, O, A, latent_key=("s", "z"), action_key=("s", "u"), out_key=("s", "ahead")
        )
        model = PixelAR(encoder, decoder)
        assert model.in_keys == [("s", "x"), ("s", "u")]
        data = TensorDict({"s": {"x": torch.randn(4, O), "u": torch.randn(4, A)}}, batch_size=4)
        out = model(data)
        expected = decoder.dist(out["s", "z"], out["s", "u"]).mean
        torch.testing.assert_close(out["s", "ahead"], expected)
        windows = TensorDict({"s": {"x": torch.randn(4, 3, O), "u": torch.randn(4, 3, A)}}, batch_size=(4, 3))
        assert PixelARLoss(model)(windows)["loss_reconstruction"] > 0

    def test_missing_entries_are_named(self) -> None:
        with pytest.raises(KeyError, match="PixelDecoder reads the entry 'action'"):
            _model().predictor(TensorDict(latent=torch.zeros(4, D), batch_size=4))

    def test_as_world_model(self) -> None:
        model = _model()
        reward = TensorDictModule(nn.Linear(D, 1), in_keys=["latent"], out_keys=["reward"])
        latent, action = torch.randn(4, D), torch.randn(4, A)
        out = model.as_world_model(reward)(TensorDict(latent=latent, action=action, batch_size=4))
        torch.testing.assert_close(out["latent"], model.predictor.dist(latent, action).mean)
        assert out["reward"].shape == (4, 1)

    def test_encoder_and_decoder_belong_together(self) -> None:
        encoder = linear_encoder(O, D)
        with pytest.raises(ValueError, match="decoder must have been made with this very encoder"):
            PixelAR(encoder, PixelDecoder(linear_encoder(O, D), D, O))
        with pytest.raises(ValueError, match="encoder must write the predictor's latent_key='z'"):
            PixelAR(encoder, PixelDecoder(encoder, D, O, latent_key="z"))

    def test_copies_keep_one_encoder(self) -> None:
        model, data = _model(), _windows(4)
        for twin in (pickle.loads(pickle.dumps(model)), copy.deepcopy(model)):
            assert twin.predictor.encoder is twin.encoder
            assert (twin(data.clone()) == model(data.clone())).all()


class TestTraining:
    @pytest.mark.parametrize("rank", [2, 4])
    def test_reaches_the_optimal_predictor_of_its_rank(self, rank: int) -> None:
        """On linear data the global optimum is reduced-rank regression."""
        size, steps = 8, 400
        generator = torch.Generator().manual_seed(rank)
        make = {"generator": generator, "dtype": torch.float64}
        dynamics = 0.9 * torch.linalg.qr(torch.randn(size, size, **make)).Q
        control = torch.randn(size, A, **make)
        action = torch.randn(steps, A, **make)
        x = [torch.zeros(size, dtype=torch.float64)]
        for t in range(steps - 1):
            x.append(dynamics @ x[-1] + control @ action[t] + 0.3 * torch.randn(size, **make))
        x = torch.stack(x)

        encoder = linear_encoder(size, rank)
        model = PixelAR(encoder, PixelDecoder(encoder, rank, size, A)).double()
        loss = PixelARLoss(model)
        data = TensorDict(observation=x, action=action, batch_size=steps)
        optimiser = torch.optim.LBFGS(loss.parameters(), max_iter=500, line_search_fn="strong_wolfe")

        def closure() -> Tensor:
            optimiser.zero_grad()
            value = loss(data)["loss_reconstruction"]
            value.backward()
            return value

        before = float(closure().detach())
        optimiser.step(closure)
        after = float(closure().detach())
        best = float(reduced_rank_error(x[:-1], action[:-1], x[1:], rank))
        assert before > 1.2 * best
        assert best * (1 - 1e-9) <= after <= best * (1 + 1e-5)
        # The user's own model was trained, not a copy.
        torch.testing.assert_close(_errors64(model, data).mean(), torch.tensor(after).double())

    def test_every_parameter_is_listed_once_and_gets_a_gradient(self) -> None:
        model = _model()
        loss = PixelARLoss(model)
        parameters = list(loss.parameters())
        assert {id(p) for p in parameters} == {id(p) for p in model.parameters()}
        assert len(parameters) == 2
        loss(_windows())["loss_reconstruction"].backward()
        assert all(p.grad is not None and (p.grad != 0).all() for p in parameters)


def _errors64(model: PixelAR, data: TensorDictBase) -> Tensor:
    latent = data["observation"][:-1] @ model.encoder.module.network.weight.mT
    inputs = torch.cat([latent, data["action"][:-1]], -1)
    return (data["observation"][1:] - inputs @ model.predictor.decoder.weight.mT).pow(2).sum(-1)


class TestLossValue:
    @pytest.mark.parametrize("action_dim", [0, A])
    def test_equals_the_loop(self, action_dim: int) -> None:
        model, data = _model(action_dim), _windows(action=bool(action_dim))
        errors = _errors(model, data)
        for reduction, expected in (("mean", errors[:, :-1].mean()), ("sum", errors.sum()), ("none", errors)):
            out = PixelARLoss(model, reduction=reduction)(data)
            torch.testing.assert_close(out["loss_reconstruction"], expected)

    @pytest.mark.parametrize("column", [False, True])
    @pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e6])
    def test_episodes_and_padding_equal_the_loop(self, column: bool, garbage: float) -> None:
        model, data = _model(), _windows(20, 8)
        flags = [torch.rand(20, 8) < share for share in (0.2, 0.2, 0.85)]
        count = torch.tensor([pairs_that_count(*(flag[b].tolist() for flag in flags), 1) for b in range(20)])
        clean = _errors(model, data)
        done, is_init, mask = flags
        data["observation"][~mask] = garbage
        data["action"][~mask] = garbage
        shaped = [flag.unsqueeze(-1) if column else flag for flag in flags]
        for key, flag in zip((("next", "done"), "is_init", ("collector", "mask")), shaped, strict=True):
            data.set(key, flag)

        assert 10 < count.sum() < 100
        expected = torch.where(torch.nn.functional.pad(count, (0, 1)), clean, 0)
        for reduction, value in (
            ("mean", expected.sum() / count.sum()),
            ("sum", expected.sum()),
            ("none", expected),
        ):
            loss = PixelARLoss(model, reduction=reduction)
            out = loss(data)["loss_reconstruction"]
            torch.testing.assert_close(out, value)
            loss.zero_grad()
            out.sum().backward()
            assert all(p.grad.isfinite().all() for p in loss.parameters())

    def test_each_flag_counts_alone(self) -> None:
        model, data = _model(), _windows()
        clean = _errors(model, data)
        flag = torch.zeros(B, T, dtype=torch.bool)
        flag[:, 2] = True
        for key, dropped in (
            (("next", "done"), [2]),
            ("is_init", [1]),
            (("collector", "mask"), [1, 2]),
        ):
            kept = [t for t in range(T - 1) if t not in dropped]
            marked = data.clone().set(key, ~flag if "mask" in key else flag)
            out = PixelARLoss(model)(marked)["loss_reconstruction"]
            torch.testing.assert_close(out, clean[:, kept].mean())

    def test_gradient_equals_that_of_the_loop(self) -> None:
        model, data = _model(), _windows()
        expected = torch.autograd.grad(_errors(model, data)[:, :-1].mean(), list(model.parameters()))
        loss = PixelARLoss(model)
        loss(data)["loss_reconstruction"].backward()
        for parameter, gradient in zip(model.parameters(), expected, strict=True):
            torch.testing.assert_close(parameter.grad, gradient)

    def test_no_pair_at_all_is_zero_not_nan(self) -> None:
        loss = PixelARLoss(_model())
        data = _windows().set(("next", "done"), torch.ones(B, T, dtype=torch.bool))
        out = loss(data)["loss_reconstruction"]
        out.backward()
        assert out == 0
        assert all((p.grad == 0).all() for p in loss.parameters())

    def test_any_batch_dimensions_and_one_window(self) -> None:
        model, data = _model(), _windows(2, 3, T)
        loss = PixelARLoss(model, reduction="none")
        out = loss(data)["loss_reconstruction"]
        assert out.shape == (2, 3, T)
        torch.testing.assert_close(loss(data[1, 2])["loss_reconstruction"], out[1, 2])

    @pytest.mark.parametrize("make", [linear_encoder, mlp_encoder])
    def test_other_encoders(self, make: Callable[[int, int], TensorDictModule]) -> None:
        encoder = make(O, D)
        model = PixelAR(encoder, PixelDecoder(encoder, D, O, trunk="mlp", num_cells=(8,)))
        data = _windows(action=False)
        latent = encoder(data.clone())["latent"]
        expected = (model.predictor.decode(latent)[:, :-1] - data["observation"][:, 1:]).pow(2).sum(-1)
        out = PixelARLoss(model)(data)["loss_reconstruction"]
        torch.testing.assert_close(out, expected.mean())


class TestLossModule:
    def test_keys(self) -> None:
        loss = PixelARLoss(_model())
        assert loss.in_keys == ["observation", "action", ("next", "done"), "is_init"]
        assert loss.out_keys == ["loss_reconstruction"]
        assert set(loss(_windows()).keys()) == {"loss_reconstruction"}
        assert PixelARLoss(_model(0)).in_keys == ["observation", ("next", "done"), "is_init"]
        assert "PixelARLoss" in repr(loss)
        loss.in_keys = ["observation"]
        assert loss.in_keys == ["observation"]

    def test_set_keys(self) -> None:
        model, data = _model(), _windows()
        flag = torch.rand(B, T) < 0.3
        loss = PixelARLoss(model)
        expected = loss(data.clone().set(("next", "done"), flag))["loss_reconstruction"]
        loss.set_keys(done=("next", "ended"), is_init="first")
        assert loss.in_keys == ["observation", "action", ("next", "ended"), "first"]
        renamed = data.clone().set(("next", "ended"), flag).set("first", flag.roll(1, 1))
        assert loss(renamed)["loss_reconstruction"] == expected
        ignored = data.clone().set(("next", "done"), flag)
        assert loss(ignored)["loss_reconstruction"] != expected
        with pytest.raises(ValueError, match="reward is not an accepted tensordict key"):
            loss.set_keys(reward="r")

    def test_keyword_call_equals_tensordict_call(self) -> None:
        loss, data = PixelARLoss(_model()), _windows()
        done, is_init = torch.rand(B, T, 1) < 0.3, torch.rand(B, T, 1) < 0.3
        expected = loss(data.clone().set(("next", "done"), done).set("is_init", is_init))
        value = loss(observation=data["observation"], action=data["action"], next_done=done, is_init=is_init)
        torch.testing.assert_close(value, expected["loss_reconstruction"])

    def test_keyword_call_when_action_and_observation_have_one_size(self) -> None:
        encoder = linear_encoder(A, 1)
        loss = PixelARLoss(PixelAR(encoder, PixelDecoder(encoder, 1, A, A)))
        x, u = torch.randn(B, T, A), torch.randn(B, T, A)
        expected = loss(TensorDict(observation=x, action=u, batch_size=(B, T)))["loss_reconstruction"]
        torch.testing.assert_close(loss(observation=x, action=u), expected)

    def test_select_out_keys(self) -> None:
        loss = PixelARLoss(_model())
        loss.select_out_keys("loss_reconstruction")
        assert set(loss(_windows()).keys()) == {"loss_reconstruction"}

    def test_the_input_is_not_changed(self) -> None:
        data = _windows()
        mask = torch.rand(B, T) < 0.8
        data.set(("collector", "mask"), mask)
        data["observation"][~mask] = 1e6
        copied = data.clone()
        PixelARLoss(_model())(data.lock_())
        assert (data == copied).all()
        assert set(data.keys(True, True)) == set(copied.keys(True, True))

    def test_state_dict(self) -> None:
        loss, fresh, data = PixelARLoss(_model()), PixelARLoss(_model()), _windows()
        assert fresh(data)["loss_reconstruction"] != loss(data)["loss_reconstruction"]
        fresh.load_state_dict(loss.state_dict())
        assert fresh(data)["loss_reconstruction"] == loss(data)["loss_reconstruction"]

    def test_reset_parameters_recursive(self) -> None:
        model = _model()
        loss = PixelARLoss(model)
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.fill_(torch.nan)
        loss.reset_parameters_recursive()
        assert all(p.isfinite().all() for p in model.parameters())

    def test_casts_with_its_parameters(self) -> None:
        loss, data = PixelARLoss(_model()).double(), _windows()
        out = loss(data.apply(lambda value: value.double()))["loss_reconstruction"]
        assert out.dtype == torch.float64

    @pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt:FutureWarning")  # tensordict's
    def test_compiles_without_a_graph_break(self) -> None:
        loss, data = PixelARLoss(_model()), _windows()
        data.set(("collector", "mask"), torch.rand(B, T) < 0.8)
        expected = loss(data)["loss_reconstruction"]

        def value(data: TensorDictBase) -> Tensor:
            return loss(data)["loss_reconstruction"]

        torch.testing.assert_close(torch.compile(value, backend="eager", fullgraph=True)(data), expected)

    def test_vmap_of_the_model_over_stacked_parameters(self) -> None:
        models = [Decoded(_model().predictor) for _ in range(3)]
        parameters, buffers = torch.func.stack_module_state(models)
        latent, action = torch.randn(5, D), torch.randn(5, A)

        def one(parameters: dict[str, Tensor], buffers: dict[str, Tensor]) -> Tensor:
            return torch.func.functional_call(models[0], (parameters, buffers), (latent, action))

        together = torch.func.vmap(one)(parameters, buffers)
        for stacked, model in zip(together, models, strict=True):
            torch.testing.assert_close(stacked, model(latent, action))


class Decoded(nn.Module):
    def __init__(self, decoder: PixelDecoder) -> None:
        super().__init__()
        self.decoder = decoder

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return self.decoder.dist(latent, action).mean


class TestLossErrors:
    def test_reduction(self) -> None:
        with pytest.raises(ValueError, match="reduction must be 'mean', 'sum' or 'none', got 'max'"):
            PixelARLoss(_model(), reduction="max")

    @pytest.mark.parametrize("missing", ["observation", "action"])
    def test_missing_entries(self, missing: str) -> None:
        with pytest.raises(KeyError, match=f"PixelARLoss reads the entry '{missing}'"):
            PixelARLoss(_model())(_windows().exclude(missing))

    @pytest.mark.parametrize("batch", [(B, 1), (1,)])
    def test_short_windows(self, batch: tuple[int, ...]) -> None:
        with pytest.raises(ValueError, match="longer than the largest skip 1, got T=1"):
            PixelARLoss(_model())(_windows(*batch))

    def test_one_observation(self) -> None:
        data = TensorDict(observation=torch.zeros(O), action=torch.zeros(A))
        with pytest.raises(ValueError, match=r"windows of shape \(\*B, T\), got a batch of shape \(\)"):
            PixelARLoss(_model())(data)

    @pytest.mark.parametrize("key", ["observation", "action"])
    @pytest.mark.parametrize("bad", [math.nan, math.inf])
    @pytest.mark.parametrize("masked", [False, True])
    def test_values_that_count_must_be_finite(self, key: str, bad: float, masked: bool) -> None:
        data = _windows()
        if masked:
            mask = torch.ones(B, T, dtype=torch.bool)
            mask[0, 0] = False
            data.set(("collector", "mask"), mask)
        data[key][1, 2, 0] = bad
        with pytest.raises(ValueError, match=f"'{key}' must be finite .* got 1 NaN or infinite"):
            PixelARLoss(_model())(data)

    @pytest.mark.parametrize("shape", [(B, T + 1, A), (B + 1, T, A), (B, 1, A)])
    def test_actions_of_other_windows(self, shape: tuple[int, ...]) -> None:
        data = TensorDict(observation=torch.zeros(B, T, O), action=torch.zeros(shape))
        message = r"'observation' must have shape .* like 'action', got"
        with pytest.raises(ValueError, match=message):
            PixelARLoss(_model())(data)

    @pytest.mark.parametrize("key", [("next", "done"), "is_init", ("collector", "mask")])
    def test_flags_of_other_windows(self, key: str | tuple[str, str]) -> None:
        data = TensorDict(observation=torch.zeros(B, T, O), action=torch.zeros(B, T, A))
        data.set(key, torch.zeros(B, T, 2, dtype=torch.bool))
        with pytest.raises(ValueError, match=rf"must have shape \({B}, {T}\) or \({B}, {T}, 1\)"):
            PixelARLoss(_model())(data)
