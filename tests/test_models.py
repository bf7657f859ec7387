"""JEPA and VJEPA as TensorDictModules, and as a world model of TorchRL's model-based environments."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable

import pytest
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torch.distributions import MultivariateNormal
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import ModelBasedEnvBase
from torchrl.envs.utils import check_env_specs
from torchrl.modules import WorldModelWrapper

from torchrl_vjepa.encoders import history_encoder, linear_encoder, mlp_encoder
from torchrl_vjepa.heads import DeltaHead, TargetScale
from torchrl_vjepa.models import JEPA, VJEPA, LatentModel
from torchrl_vjepa.noisy_tv import BatchedNoisyTVEnv, LinearGaussianSystem
from torchrl_vjepa.predictor import Predictor

O, D, A, B = 7, 3, 2, 5  # noqa: E741 (sizes, as in the docstrings)


class Reward(nn.Module):
    """Reads the latent that the action led to."""

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return latent.sum(-1, keepdim=True) - action.pow(2).sum(-1, keepdim=True)


def _reward_model(latent_key: NestedKey = "latent", action_key: NestedKey = "action") -> TensorDictModule:
    return TensorDictModule(Reward(), in_keys=[latent_key, action_key], out_keys=["reward"])


def _jepa(action_dim: int = A, **keywords: object) -> JEPA:
    return JEPA(linear_encoder(O, D), Predictor(D, action_dim, head=DeltaHead(), **keywords))


def _vjepa(action_dim: int = A, **keywords: object) -> VJEPA:
    return VJEPA(mlp_encoder(O, D, num_cells=(8,)), Predictor(D, action_dim, **keywords))


MODELS = pytest.mark.parametrize("make", [_jepa, _vjepa])


def _data(*batch: int, action: bool = True) -> TensorDict:
    data = TensorDict(observation=torch.randn(*batch, O), batch_size=batch)
    return data.set("action", torch.randn(*batch, A)) if action else data


class TestForward:
    @MODELS
    @pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
    def test_writes_what_encoder_and_predictor_say(
        self, make: Callable[..., JEPA], batch: tuple[int, ...]
    ) -> None:
        model, data = make(), _data(*batch)
        before = data.clone()
        out = model(data)
        assert out is data
        latent = model.encoder(before.clone())["latent"]
        p = model.predictor.dist(latent, before["action"])
        torch.testing.assert_close(out["latent"], latent)
        torch.testing.assert_close(out["next", "latent"], p.mean)
        if isinstance(model, VJEPA):
            torch.testing.assert_close(out["loc"], p.mean)
            torch.testing.assert_close(out["scale"], p.variance.sqrt())
        for key in ("observation", "action"):
            assert torch.equal(out[key], before[key])

    @MODELS
    def test_keys_are_what_is_read_and_written(self, make: Callable[..., JEPA]) -> None:
        model, data = make(), _data(B)
        given = set(data.keys(True, True))
        assert set(model.in_keys) == given == {"observation", "action"}
        assert set(model(data).keys(True, True)) - given == set(model.out_keys)

    @MODELS
    def test_without_an_action_it_encodes_only(self, make: Callable[..., JEPA]) -> None:
        model = make()
        out = model(_data(B, action=False))
        assert set(out.keys(True, True)) == {"observation", "latent"}

    @MODELS
    def test_a_system_without_control_always_predicts(self, make: Callable[..., JEPA]) -> None:
        model = make(action_dim=0)
        assert model.in_keys == ["observation"]
        out = model(_data(B, action=False))
        torch.testing.assert_close(out["next", "latent"], model.predictor.dist(out["latent"]).mean)

    def test_side_information_is_read(self) -> None:
        model = _vjepa(side_info_dim=2)
        assert model.in_keys == ["observation", "action", "side_info"]
        assert ("next", "latent") not in model(_data(B)).keys(True)
        side_info = torch.randn(B, 2)
        out = model(_data(B).set("side_info", side_info))
        p = model.predictor.dist(out["latent"], out["action"], side_info=side_info)
        torch.testing.assert_close(out["loc"], p.mean)

    @pytest.mark.parametrize("how", ["mode", "sample"])
    def test_vjepa_writes_the_point_that_the_predictor_asks_for(self, how: str) -> None:
        model = _vjepa(how=how)
        torch.manual_seed(1)
        out = model(_data(B))
        assert torch.equal(out["next", "latent"], out["loc"]) == (how == "mode")

    @pytest.mark.parametrize("kind", [JEPA, VJEPA])
    def test_nested_and_renamed_keys(self, kind: type[JEPA]) -> None:
        encoder = linear_encoder(O, D, in_key=("agent", "pixels"), out_key=("agent", "z"))
        predictor = Predictor(
            D, A, latent_key=("agent", "z"), action_key=("agent", "u"), out_key=("agent", "ahead")
        )
        model = kind(encoder, predictor)
        assert model.in_keys == [("agent", "pixels"), ("agent", "u")]
        assert model.latent_key == ("agent", "z")
        assert model.action_key == ("agent", "u")
        inputs = {"pixels": torch.randn(B, O), "u": torch.randn(B, A)}
        data = TensorDict({"agent": TensorDict(inputs, batch_size=B)}, batch_size=B)
        out = model(data)
        expected = encoder.module(inputs["pixels"])
        torch.testing.assert_close(out["agent", "z"], expected)
        torch.testing.assert_close(out["agent", "ahead"], predictor.dist(expected, inputs["u"]).mean)
        assert set(out.keys(True, True)) == {*model.in_keys, *model.out_keys}
        if isinstance(model, VJEPA):
            assert model.target_scale.in_keys == [("agent", "pixels")]

    def test_keys_are_not_listed_twice(self) -> None:
        """The encoder may read the action and make the side information itself."""
        encoder = TensorDictModule(
            EncodeWithContext(),
            in_keys=["observation", "action"],
            out_keys=["latent", "side_info"],
        )
        model = VJEPA(encoder, Predictor(D, A, side_info_dim=2))
        assert model.in_keys == ["observation", "action"]
        out = model(_data(B))
        p = model.predictor.dist(out["latent"], out["action"], side_info=out["side_info"])
        torch.testing.assert_close(out["next", "latent"], p.mean)

    def test_history_encoder(self) -> None:
        model = VJEPA(history_encoder(O, D, hidden_dim=4), Predictor(D, A))
        assert model.in_keys == ["observation", "history", "is_init", "action"]
        assert model.observation_key == "observation"
        out = model(_data(B))
        assert out["next", "history"].shape == (B, 1, 4)
        assert out["loc"].shape == (B, D)

    @pytest.mark.parametrize("kind", [JEPA, VJEPA, LatentModel])
    def test_keys_that_do_not_meet_are_refused(self, kind: type[LatentModel]) -> None:
        message = r"encoder must write the predictor's latent_key='latent'.*out_keys are \['z'\]"
        with pytest.raises(ValueError, match=message):
            kind(linear_encoder(O, D, out_key="z"), Predictor(D, A))

    @MODELS
    def test_pickle_deepcopy_and_state_dict(self, make: Callable[..., JEPA]) -> None:
        model, fresh, data = make(), make(), _data(B)
        fresh.load_state_dict(model.state_dict())
        expected = model(data.clone())
        for twin in (pickle.loads(pickle.dumps(model)), copy.deepcopy(model), fresh):
            assert (twin(data.clone()) == expected).all()

    @MODELS
    def test_select_out_keys(self, make: Callable[..., JEPA]) -> None:
        model = make().select_out_keys("latent")
        assert set(model(_data(B)).keys(True, True)) == {"observation", "action", "latent"}


class EncodeWithContext(nn.Module):
    def forward(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        return observation[..., :D], action


class TestTargetDist:
    @pytest.mark.parametrize("kind", ["linear", "learned", "constant"])
    def test_is_a_gaussian_around_the_latent(self, kind: str) -> None:
        scale = TargetScale(D, O, kind=kind, init_std=0.3)
        model = VJEPA(linear_encoder(O, D), Predictor(D, A), target_scale=scale)
        latent, x, value = torch.randn(B, D), torch.randn(B, O), torch.randn(B, D)
        q = model.target_dist(latent, x)
        expected = MultivariateNormal(latent, torch.diag_embed(scale(x) ** 2))
        torch.testing.assert_close(q.log_prob(value), expected.log_prob(value))
        assert torch.equal(q.mean, latent)

    def test_default_scale_is_learned_and_one(self) -> None:
        model = _vjepa()
        q = model.target_dist(torch.zeros(B, D), torch.zeros(B, O))
        torch.testing.assert_close(q.variance, torch.ones(B, D))
        assert any("target_scale" in name for name, _ in model.named_parameters())

    def test_observation_key(self) -> None:
        assert _vjepa().target_scale.in_keys == ["observation"]
        model = VJEPA(linear_encoder(O, D), Predictor(D), observation_key="whitened")
        assert model.observation_key == "whitened"
        assert model.target_scale.in_keys == ["whitened"]


class ImaginedEnv(ModelBasedEnvBase):
    """The smallest environment over a world model."""

    def __init__(self, world_model: WorldModelWrapper) -> None:
        super().__init__(world_model, batch_size=torch.Size([]))
        self.observation_spec = Composite(latent=Unbounded((D,)))
        self.state_spec = Composite(latent=Unbounded((D,)))
        self.action_spec_unbatched = Bounded(-1.0, 1.0, (A,))
        self.reward_spec = Unbounded((1,))

    def any_done(self, tensordict: TensorDictBase) -> bool:
        return False

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = self.world_model(tensordict.select(*self.world_model.in_keys))
        return out.select("latent", "reward", "done", "terminated", strict=False)

    def _reset(self, tensordict: TensorDictBase | None = None, **keywords: object) -> TensorDictBase:
        if tensordict is None:
            return self.observation_spec.rand()
        if tensordict.get("latent", None) is not None:
            out = tensordict.select("latent")
        else:
            out = self.observation_spec.rand(tensordict.batch_size)
        return out.update(self.full_done_spec.zero(out.batch_size))

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(seed)


class Feedback(nn.Module):
    def forward(self, latent: Tensor) -> Tensor:
        return latent[..., :A].tanh()


class TestWorldModel:
    @MODELS
    def test_transition_then_reward_of_the_next_latent(self, make: Callable[..., JEPA]) -> None:
        model = make()
        world = model.as_world_model(_reward_model())
        assert isinstance(world, WorldModelWrapper)
        assert world.in_keys == ["latent", "action"]
        assert world.out_keys == ["latent", "reward"]
        latent, action = torch.randn(B, D), torch.randn(B, A)
        out = world(TensorDict(latent=latent, action=action, batch_size=B))
        after = model.predictor.dist(latent, action).mean
        torch.testing.assert_close(out["latent"], after)
        torch.testing.assert_close(out["reward"], Reward()(after, action))

    @MODELS
    def test_operators_work_alone(self, make: Callable[..., JEPA]) -> None:
        model = make()
        world = model.as_world_model(_reward_model())
        latent, action = torch.randn(B, D), torch.randn(B, A)
        data = TensorDict(latent=latent, action=action, batch_size=B)
        moved = world.get_transition_model_operator()(data.clone())
        assert set(moved.keys()) == {"latent", "action"}
        torch.testing.assert_close(moved["latent"], model.predictor.dist(latent, action).mean)
        paid = world.get_reward_operator()(data.clone())
        torch.testing.assert_close(paid["reward"], Reward()(latent, action))
        assert torch.equal(paid["latent"], latent)

    @MODELS
    def test_parameters_are_shared(self, make: Callable[..., JEPA]) -> None:
        model = make()
        world = model.as_world_model(_reward_model())
        ours = {id(parameter) for parameter in model.predictor.parameters()}
        assert {id(parameter) for parameter in world.parameters()} == ours
        data = TensorDict(latent=torch.randn(B, D), action=torch.randn(B, A), batch_size=B)
        before = world(data.clone())["latent"]
        with torch.no_grad():
            for parameter in model.predictor.parameters():
                parameter.add_(1.0)
        after = world(data.clone())["latent"]
        assert not torch.allclose(before, after)
        torch.testing.assert_close(after, model.predictor.dist(data["latent"], data["action"]).mean)

    @pytest.mark.parametrize("how", ["mean", "mode", "sample"])
    def test_point_of_the_transition(self, how: str) -> None:
        model = _vjepa(how="mean" if how == "sample" else "sample")  # the predictor's own is not used
        world = model.as_world_model(_reward_model(), how=how)
        latent, action = torch.randn(B, D), torch.randn(B, A)
        p = model.predictor.dist(latent, action)
        torch.manual_seed(4)
        expected = p.sample() if how == "sample" else p.mean
        torch.manual_seed(4)
        out = world(TensorDict(latent=latent, action=action, batch_size=B))
        torch.testing.assert_close(out["latent"], expected)

    def test_without_control(self) -> None:
        model = _jepa(action_dim=0)
        reward = TensorDictModule(nn.Linear(D, 1), in_keys=["latent"], out_keys=["reward"])
        world = model.as_world_model(reward)
        assert world.in_keys == ["latent"]
        latent = torch.randn(B, D)
        out = world(TensorDict(latent=latent, batch_size=B))
        torch.testing.assert_close(out["latent"], model.predictor.dist(latent).mean)

    def test_renamed_keys(self) -> None:
        model = JEPA(
            linear_encoder(O, D, out_key=("s", "z")),
            Predictor(D, A, head=DeltaHead(), latent_key=("s", "z"), action_key="u"),
        )
        world = model.as_world_model(_reward_model(("s", "z"), "u"))
        latent, action = torch.randn(B, D), torch.randn(B, A)
        out = world(TensorDict({"s": {"z": latent}, "u": action}, batch_size=B))
        after = model.predictor.dist(latent, action).mean
        torch.testing.assert_close(out["s", "z"], after)
        torch.testing.assert_close(out["reward"], Reward()(after, action))

    def test_errors(self) -> None:
        with pytest.raises(ValueError, match="how must be 'mean', 'mode' or 'sample', got 'best'"):
            _vjepa().as_world_model(_reward_model(), how="best")
        with pytest.raises(ValueError, match="must have side_info_dim=0, got 2"):
            _vjepa(side_info_dim=2).as_world_model(_reward_model())

    @MODELS
    @pytest.mark.parametrize("how", ["mean", "sample"])
    def test_environment_specs(self, make: Callable[..., JEPA], how: str) -> None:
        env = ImaginedEnv(make().as_world_model(_reward_model(), how=how))
        check_env_specs(env)

    @MODELS
    def test_environment_rollout_equals_the_predictor(self, make: Callable[..., JEPA]) -> None:
        model = make()
        env = ImaginedEnv(model.as_world_model(_reward_model()))
        policy = TensorDictSequential(TensorDictModule(Feedback(), in_keys=["latent"], out_keys=["action"]))
        start = TensorDict(latent=torch.randn(B, D), batch_size=B)
        with torch.no_grad():
            data = env.rollout(
                6, policy, auto_reset=False, tensordict=env.reset(start), auto_cast_to_device=False
            )
            latent = start["latent"]
            for t in range(6):
                action = Feedback()(latent)
                torch.testing.assert_close(data["latent"][:, t], latent)
                torch.testing.assert_close(data["action"][:, t], action)
                latent = model.predictor.dist(latent, action).mean
                torch.testing.assert_close(data["next", "latent"][:, t], latent)
                torch.testing.assert_close(data["next", "reward"][:, t], Reward()(latent, action))

    @MODELS
    def test_world_model_pickles(self, make: Callable[..., JEPA]) -> None:
        world = make().as_world_model(_reward_model())
        data = TensorDict(latent=torch.randn(B, D), action=torch.randn(B, A), batch_size=B)
        twin = pickle.loads(pickle.dumps(world))
        assert (twin(data.clone()) == world(data.clone())).all()


@MODELS
def test_policy_in_an_environment(make: Callable[..., JEPA]) -> None:
    model = make()
    system = LinearGaussianSystem(observation_dim=O, control_dim=A, seed=0)
    env = BatchedNoisyTVEnv(4, system=system, seed=0)
    act = TensorDictModule(Feedback(), in_keys=["latent"], out_keys=["action"])
    policy = TensorDictSequential(model.encoder, act)
    with torch.no_grad():
        data = env.rollout(5, policy=policy)
        latent = model.encoder(data.select("observation"))["latent"]
    torch.testing.assert_close(data["latent"], latent)
    torch.testing.assert_close(data["action"], Feedback()(latent))
    selected = env.rollout(2, policy=policy.select_out_keys("action"))
    assert selected.get("latent", None) is None


def test_a_predictor_may_be_any_module_with_dist() -> None:
    """What LatentModel asks of a predictor is what its docstring says, and no more."""

    class Still(TensorDictModuleBase):
        latent_dim, action_dim, latent_key, action_key = D, 0, "latent", "action"

        def __init__(self) -> None:
            super().__init__()
            self.in_keys, self.out_keys = ["latent"], [("next", "latent")]
            self.inner = Predictor(D, head=DeltaHead())

        def dist(self, latent: Tensor, action: Tensor | None = None) -> object:
            return self.inner.dist(latent)

        def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
            return tensordict.set(self.out_keys[0], self.dist(tensordict["latent"]).mean)

    model = LatentModel(linear_encoder(O, D), Still())
    out = model(_data(B))
    torch.testing.assert_close(out["next", "latent"], model.predictor.dist(out["latent"]).mean)
    reward = TensorDictModule(nn.Linear(D, 1), in_keys=["latent"], out_keys=["reward"])
    assert model.as_world_model(reward)(out.select("latent"))["reward"].shape == (B, 1)
