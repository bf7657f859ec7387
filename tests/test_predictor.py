"""The predictor against matrix products written by hand, and the TensorDictModule around it."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_vjepa.heads import DeltaHead, DiagGaussianHead
from torchrl_vjepa.predictor import Predictor

D, A, S, B = 3, 2, 4, 5
SKIPS = (1, 4, 2)  # neither sorted nor contiguous


def _latent() -> Tensor:
    return torch.randn(B, D)


class TestLinearTrunk:
    @pytest.mark.parametrize("skip", SKIPS)
    @pytest.mark.parametrize("bias", [False, True])
    @pytest.mark.parametrize("residual", [False, True])
    def test_equals_the_matrix_product(self, skip: int, bias: bool, residual: bool) -> None:
        predictor = Predictor(
            D, A, skips=SKIPS, side_info_dim=S, bias=bias, residual=residual, head=DiagGaussianHead()
        )
        latent, action, side_info = _latent(), torch.randn(B, skip, A), torch.randn(B, S)
        p = predictor.dist(latent, action, skip=skip, side_info=side_info)

        layer = predictor.trunks[SKIPS.index(skip)]
        assert (layer.bias is not None) == bias
        on_latent, *on_actions, on_side = layer.weight.split([D] + [A] * skip + [S], dim=1)
        features = latent @ on_latent.mT + side_info @ on_side.mT
        for i in range(skip):  # u_t first
            features = features + action[:, i] @ on_actions[i].mT
        if bias:
            features = features + layer.bias
        mean, log_var = features[:, :D], features[:, D:]
        torch.testing.assert_close(p.mean, mean + latent if residual else mean)
        torch.testing.assert_close(p.variance, log_var.exp(), rtol=1e-3, atol=0)

    def test_every_skip_has_its_own_matrix_and_constants(self) -> None:
        predictor = Predictor(D, skips=SKIPS, head=DiagGaussianHead("constant"))
        assert predictor.constants.shape == (3, D)
        with torch.no_grad():
            predictor.constants.copy_(torch.arange(3.0)[:, None].expand(3, D))
        latent = _latent()
        for index, skip in enumerate(SKIPS):
            p = predictor.dist(latent, skip=skip)
            torch.testing.assert_close(p.mean, latent @ predictor.trunks[index].weight.mT)
            torch.testing.assert_close(p.variance.log(), torch.full((B, D), float(index)), atol=1e-3, rtol=0)

    def test_has_no_bias_unless_asked(self) -> None:
        assert Predictor(D, A).trunks[0].bias is None


class TestMLPTrunk:
    @pytest.mark.parametrize("skip", SKIPS)
    @pytest.mark.parametrize("residual", [False, True])
    def test_reads_latent_padded_chunk_one_hot_and_side_info(self, skip: int, residual: bool) -> None:
        predictor = Predictor(
            D, A, skips=SKIPS, trunk="mlp", num_cells=(8,), side_info_dim=S, residual=residual
        )
        latent, action, side_info = _latent(), torch.randn(B, skip, A), torch.randn(B, S)
        p = predictor.dist(latent, action, skip=skip, side_info=side_info)

        assert len(predictor.trunks) == 1
        one_hot = torch.tensor([float(skip == other) for other in SKIPS]).expand(B, -1)
        padding = torch.zeros(B, (4 - skip) * A)
        inputs = torch.cat([latent, action.reshape(B, -1), padding, one_hot, side_info], dim=-1)
        features = predictor.trunks[0](inputs)
        mean = features[:, :D] + latent if residual else features[:, :D]
        torch.testing.assert_close(p.mean, mean)
        torch.testing.assert_close(p.variance, features[:, D:].exp(), rtol=1e-3, atol=0)

    def test_weights_on_the_padding_do_not_matter(self) -> None:
        predictor = Predictor(D, A, skips=SKIPS, trunk="mlp", num_cells=(8,))
        latent, action = _latent(), torch.randn(B, 2, A)
        before = predictor.dist(latent, action, skip=2).mean
        weight = predictor.trunks[0][0].weight
        with torch.no_grad():
            weight[:, D + 2 * A : D + 4 * A] = 1e6
        torch.testing.assert_close(predictor.dist(latent, action, skip=2).mean, before)
        with torch.no_grad():
            weight[:, D + A : D + 2 * A] += 1.0  # the last action of the chunk does matter
        assert not torch.allclose(predictor.dist(latent, action, skip=2).mean, before)

    def test_the_skip_matters_without_actions_too(self) -> None:
        predictor = Predictor(D, skips=SKIPS, trunk="mlp", num_cells=(8,))
        latent = _latent()
        means = [predictor.dist(latent, skip=skip).mean for skip in SKIPS]
        assert predictor.trunks[0][0].in_features == D + 3
        assert not torch.allclose(means[0], means[1])
        assert not torch.allclose(means[1], means[2])

    def test_widths_and_activation(self) -> None:
        predictor = Predictor(D, trunk="mlp", num_cells=(7, 9), activation_class=nn.Tanh)
        layers = list(predictor.trunks[0])
        assert [layer.out_features for layer in layers if isinstance(layer, nn.Linear)] == [7, 9, 2 * D]
        assert sum(isinstance(layer, nn.Tanh) for layer in layers) == 2


TRUNKS = pytest.mark.parametrize("trunk", ["linear", "mlp"])


class TestDist:
    @TRUNKS
    @pytest.mark.parametrize("batch", [(), (5,), (2, 3), (2, 0, 3)])
    @pytest.mark.parametrize("skip", [1, 3])
    def test_any_batch_dimensions(self, trunk: str, batch: tuple[int, ...], skip: int) -> None:
        predictor = Predictor(D, A, skips=(1, 3), trunk=trunk, side_info_dim=S)
        latent, action = torch.randn(*batch, D), torch.randn(*batch, skip, A)
        side_info = torch.randn(*batch, S)
        p = predictor.dist(latent, action, skip=skip, side_info=side_info)
        assert p.batch_shape == batch
        assert p.event_shape == (D,)
        flat = predictor.dist(
            latent.reshape(-1, D), action.reshape(-1, skip, A), skip=skip, side_info=side_info.reshape(-1, S)
        )
        torch.testing.assert_close(p.mean.reshape(-1, D), flat.mean)

    @TRUNKS
    def test_one_step_takes_a_flat_action_or_a_chunk_of_one(self, trunk: str) -> None:
        predictor = Predictor(D, A, skips=(2, 1), trunk=trunk)
        latent, action = _latent(), torch.randn(B, A)
        flat = predictor.dist(latent, action)
        assert torch.equal(flat.mean, predictor.dist(latent, action.unsqueeze(1), skip=1).mean)

    @TRUNKS
    def test_the_order_of_the_chunk_matters(self, trunk: str) -> None:
        predictor = Predictor(D, A, skips=(3,), trunk=trunk)
        latent, action = _latent(), torch.randn(B, 3, A)
        forward = predictor.dist(latent, action, skip=3).mean
        assert not torch.allclose(forward, predictor.dist(latent, action.flip(1), skip=3).mean)

    @TRUNKS
    def test_without_actions_none_and_empty_are_the_same(self, trunk: str) -> None:
        predictor = Predictor(D, skips=(1, 2), trunk=trunk)
        latent = _latent()
        for skip, empty in ((1, (B, 0)), (1, (B, 1, 0)), (2, (B, 2, 0))):
            p = predictor.dist(latent, torch.empty(empty), skip=skip)
            assert torch.equal(p.mean, predictor.dist(latent, skip=skip).mean)

    def test_residual_touches_the_mean_only(self) -> None:
        plain = Predictor(D, A)
        residual = Predictor(D, A, residual=True)
        residual.load_state_dict(plain.state_dict())
        latent, action = _latent(), torch.randn(B, A)
        p, q = plain.dist(latent, action), residual.dist(latent, action)
        torch.testing.assert_close(q.mean, p.mean + latent)
        torch.testing.assert_close(q.variance, p.variance)

    @TRUNKS
    @pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
    def test_dtypes(self, trunk: str, dtype: torch.dtype) -> None:
        predictor = Predictor(D, A, trunk=trunk, head=DiagGaussianHead("constant")).to(dtype)
        p = predictor.dist(_latent().to(dtype), torch.randn(B, A).to(dtype))
        assert p.mean.dtype == p.variance.dtype == dtype

    @TRUNKS
    def test_autocast(self, trunk: str) -> None:
        predictor = Predictor(D, A, trunk=trunk, head=DiagGaussianHead("constant"))
        latent, action = _latent(), torch.randn(B, A)
        with torch.autocast("cpu", torch.bfloat16):
            p = predictor.dist(latent.bfloat16(), action.bfloat16())
            assert p.rsample().isfinite().all()
        torch.testing.assert_close(p.mean.float(), predictor.dist(latent, action).mean, atol=0.05, rtol=0.05)

    @TRUNKS
    def test_compiles_without_a_graph_break(self, trunk: str) -> None:
        predictor = Predictor(D, A, skips=(1, 2), trunk=trunk, num_cells=(8,))

        def mean(latent: Tensor, action: Tensor) -> Tensor:
            return predictor.dist(latent, action, skip=2).mean

        compiled = torch.compile(mean, backend="eager", fullgraph=True)
        latent, action = _latent(), torch.randn(B, 2, A)
        torch.testing.assert_close(compiled(latent, action), mean(latent, action))


class TestErrors:
    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"latent_dim": 0}, "latent_dim must be positive, got 0"),
            ({"action_dim": -1}, "action_dim and side_info_dim must be at least 0, got -1 and 0"),
            ({"side_info_dim": -2}, "action_dim and side_info_dim must be at least 0, got 0 and -2"),
            ({"skips": ()}, r"skips must be distinct positive integers, at least one, got \(\)"),
            ({"skips": (0, 1)}, "skips must be distinct positive integers"),
            ({"skips": (1, 1)}, "skips must be distinct positive integers"),
            ({"skips": (1.5,)}, r"skips must be integers, got \(1.5,\)"),
            ({"trunk": "conv"}, "trunk must be 'linear' or 'mlp', got 'conv'"),
            ({"how": "median"}, "how must be 'mean', 'mode' or 'sample', got 'median'"),
        ],
    )
    def test_constructor(self, arguments: dict[str, object], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            Predictor(**{"latent_dim": 3, **arguments})

    @TRUNKS
    @pytest.mark.parametrize(
        ("latent", "action", "skip", "message"),
        [
            ((B, D), (B, 2, A), 5, r"skip must be one of skips=\(1, 2\), got 5"),
            ((B, D + 1), (B, A), 1, r"latent must have shape \(\*B, 3\), got \(5, 4\)"),
            ((), (A,), 1, r"latent must have shape \(\*B, 3\), got \(\)"),
            ((B, D), None, 1, r"action must have shape \(5, 1, 2\) or \(5, 2\) for skip=1.*got None"),
            ((B, D), (B, A + 1), 1, r"action must have shape .*got \(5, 3\)"),
            ((B, D), (B + 1, A), 1, r"action must have shape .*got \(6, 2\)"),
            ((B, D), (B, 2, A), 1, r"action must have shape .*got \(5, 2, 2\)"),
            ((B, D), (A,), 1, r"action must have shape .*got \(2,\)"),
            ((B, D), (B, A), 2, r"action must have shape \(5, 2, 2\) for skip=2 and action_dim=2.*\(5, 2\)"),
            ((B, D), (B, 1, A), 2, r"action must have shape \(5, 2, 2\) for skip=2"),
            ((B, D), (B, 2 * A), 2, r"action must have shape \(5, 2, 2\) for skip=2"),
        ],
    )
    def test_dist(
        self,
        trunk: str,
        latent: tuple[int, ...],
        action: tuple[int, ...] | None,
        skip: int,
        message: str,
    ) -> None:
        predictor = Predictor(D, A, skips=(1, 2), trunk=trunk)
        with pytest.raises(ValueError, match=message):
            predictor.dist(torch.zeros(latent), None if action is None else torch.zeros(action), skip=skip)

    def test_action_for_a_system_without_control(self) -> None:
        with pytest.raises(ValueError, match="action must have shape .* for skip=1 and action_dim=0"):
            Predictor(D).dist(_latent(), torch.zeros(B, A))

    @pytest.mark.parametrize("side_info", [None, (B, S + 1), (B + 1, S), (S,)])
    def test_side_info(self, side_info: tuple[int, ...] | None) -> None:
        value = None if side_info is None else torch.zeros(side_info)
        with pytest.raises(ValueError, match=r"side_info must have shape \(5, 4\) for side_info_dim=4"):
            Predictor(D, side_info_dim=S).dist(_latent(), side_info=value)

    def test_side_info_that_nobody_reads(self) -> None:
        with pytest.raises(ValueError, match=r"side_info must have shape \(5, 0\) for side_info_dim=0"):
            Predictor(D).dist(_latent(), side_info=torch.zeros(B, S))

    @TRUNKS
    def test_dtypes_that_do_not_fit(self, trunk: str) -> None:
        predictor = Predictor(D, A, trunk=trunk)
        message = "latent, action and side_info must have the dtype .*torch.float32.*float64"
        with pytest.raises(TypeError, match=message):
            predictor.dist(_latent(), torch.zeros(B, A, dtype=torch.float64))
        with pytest.raises(TypeError, match=message):
            predictor.dist(_latent().double(), torch.zeros(B, A))
        with pytest.raises(TypeError, match=message):
            Predictor(D).dist(_latent().double())

    @pytest.mark.parametrize("missing", ["latent", "action", "side_info"])
    def test_missing_entries_are_named(self, missing: str) -> None:
        data = TensorDict(
            latent=_latent(), action=torch.zeros(B, A), side_info=torch.zeros(B, S), batch_size=B
        )
        predictor = Predictor(D, A, side_info_dim=S)
        with pytest.raises(KeyError, match=f"Predictor reads the entry '{missing}'"):
            predictor(data.exclude(missing))
        assert ("next", "latent") not in data.keys(True)


class TestForward:
    @pytest.mark.parametrize("how", ["mean", "mode"])
    def test_writes_the_one_step_prediction(self, how: str) -> None:
        predictor = Predictor(D, A, skips=(2, 1), side_info_dim=S, how=how)
        latent, action, side_info = _latent(), torch.randn(B, A), torch.randn(B, S)
        data = TensorDict(latent=latent, action=action, side_info=side_info, batch_size=B)
        out = predictor(data)
        assert out is data
        assert predictor.in_keys == ["latent", "action", "side_info"]
        assert predictor.out_keys == [("next", "latent")]
        expected = predictor.dist(latent, action, side_info=side_info).mean
        assert torch.equal(out["next", "latent"], expected)
        assert torch.equal(out["latent"], latent)

    def test_writes_a_draw_if_asked(self) -> None:
        predictor = Predictor(D, how="sample")
        latent = _latent()
        torch.manual_seed(3)
        expected = predictor.dist(latent).sample()
        torch.manual_seed(3)
        out = predictor(TensorDict(latent=latent, batch_size=B))
        assert torch.equal(out["next", "latent"], expected)

    def test_side_info_without_actions(self) -> None:
        predictor = Predictor(D, side_info_dim=S)
        latent, side_info = _latent(), torch.randn(B, S)
        out = predictor(TensorDict(latent=latent, side_info=side_info, batch_size=B))
        assert predictor.in_keys == ["latent", "side_info"]
        assert torch.equal(out["next", "latent"], predictor.dist(latent, side_info=side_info).mean)

    def test_nested_and_renamed_keys(self) -> None:
        predictor = Predictor(
            D,
            A,
            side_info_dim=S,
            latent_key=("agent", "z"),
            action_key=("agent", "u"),
            side_info_key="context",
            out_key=("agent", "prediction"),
        )
        assert predictor.in_keys == [("agent", "z"), ("agent", "u"), "context"]
        assert predictor.out_keys == [("agent", "prediction")]
        latent, action, side_info = _latent(), torch.randn(B, A), torch.randn(B, S)
        data = TensorDict({"agent": {"z": latent, "u": action}, "context": side_info}, batch_size=B)
        expected = predictor.dist(latent, action, side_info=side_info).mean
        assert torch.equal(predictor(data)["agent", "prediction"], expected)

    def test_pickle_deepcopy_and_state_dict(self) -> None:
        predictor = Predictor(D, A, skips=SKIPS, head=DiagGaussianHead("constant"))
        nn.init.normal_(predictor.constants)
        latent, action = _latent(), torch.randn(B, A)
        fresh = Predictor(D, A, skips=SKIPS, head=DiagGaussianHead("constant"))
        fresh.load_state_dict(predictor.state_dict())
        p = predictor.dist(latent, action)
        for twin in (pickle.loads(pickle.dumps(predictor)), copy.deepcopy(predictor), fresh):
            q = twin.dist(latent, action)
            assert torch.equal(p.mean, q.mean)
            assert torch.equal(p.variance, q.variance)

    def test_functional_call(self) -> None:
        predictor = Predictor(D, A, head=DeltaHead())
        latent, action = _latent(), torch.randn(B, A)
        doubled = {name: 2 * value for name, value in predictor.named_parameters()}
        data = TensorDict(latent=latent, action=action, batch_size=B)
        out = torch.func.functional_call(predictor, doubled, (data.clone(),))
        torch.testing.assert_close(out["next", "latent"], 2 * predictor(data)["next", "latent"])

    def test_reset(self) -> None:
        predictor = Predictor(D, A, head=DiagGaussianHead("constant"))
        nn.init.normal_(predictor.constants)
        weight = predictor.trunks[0].weight.clone()
        predictor.reset_parameters_recursive()
        assert (predictor.constants == 0).all()
        assert not torch.equal(predictor.trunks[0].weight, weight)

    def test_reset_of_parameters_that_are_kept_elsewhere(self) -> None:
        predictor = Predictor(D, A, head=DiagGaussianHead("constant"))
        nn.init.ones_(predictor.constants)
        fresh = predictor.reset_parameters_recursive(TensorDict.from_module(predictor).clone())
        assert (fresh["constants"] == 0).all()
        assert (predictor.constants == 1).all()

    def test_default_head_is_gaussian_at_unit_scale_constants(self) -> None:
        predictor = Predictor(D)
        assert isinstance(predictor.head, DiagGaussianHead)
        assert predictor.skips == (1,)
        constant = Predictor(D, head=DiagGaussianHead("constant"))
        torch.testing.assert_close(constant.dist(_latent()).variance, torch.ones(B, D))
