r"""A latent model as a TorchRL environment.

Planners ask an environment for two things: ``planning_state(tensordict)``, where to start, and
``objective(state, actions (*B, N, H, A)) -> (*B, N)``, the cost of candidate plans, lower is
better. :class:`LatentEnv` answers both on plain tensors.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.model_based import ModelBasedEnvBase

from torchrl_vjepa.belief import Transition, rollout
from torchrl_vjepa.costs import Risk, StageCost, expectation
from torchrl_vjepa.distributions import Delta, from_noise, noise_dim, point_estimate, sample

__all__ = ["LatentEnv"]


class LatentEnv(ModelBasedEnvBase):
    r"""The latent model as an environment: imagine trajectories, and plan in them.

    A step is :math:`Z_{t+1} \sim p_\phi(\cdot \mid Z_t, u_t)` (or its mean or mode) followed by the
    reward of :math:`(Z_{t+1}, u_t)`: a reward model's, or minus a cost. The batch size is empty, so
    tensordicts of any batch size go in. An imagined ``done`` never triggers a reset.

    :meth:`objective` is the cost of whole plans on plain tensors (``eq:latent_mpc_objective``); the
    planners of this package call it, and TorchRL's own planners roll the environment out.

    Args:
        model: what predicts: a :class:`~torchrl_vjepa.models.JEPA` or anything with ``predictor``;
            a :class:`~torchrl_vjepa.predictor.Predictor` or anything with ``dist``; or a transition
            ``(latent (*B, D), action (*B, A)) -> Distribution`` with batch ``*B``, event ``(D,)``.
            Actions of any rank are flattened to ``A`` numbers for it and for ``cost``.
        action_spec: the actions, without batch dimensions: ``env.action_spec_unbatched`` of the
            real environment.
        reward_model: TensorDictModule that reads ``latent_key`` (the next latent) and
            ``action_key`` (in the shape of ``action_spec``) and writes ``reward_key`` with shape
            ``(*B, 1)``. Either this or ``cost``.
        cost: ``(next latent (*B, D), action (*B, A)) -> (*B)``; the reward is minus the cost.
        how: the next latent: ``"mean"``, ``"mode"`` or ``"sample"``.
        num_samples: trajectories ``M`` per candidate plan for ``how="sample"``. They share their
            random numbers across candidates and across the batch for predictions that are transforms of
            normal noise, those of every head (common random numbers: the ranking of plans does not
            depend on luck); other distributions are sampled independently.
        risk: ``(costs (M, *B)) -> (*B)``, applied to the summed costs of the ``M`` trajectories.
        latent_dim: size ``D``; needed only if the model does not tell.
        latent_key: where the latent is; by default the model's, else ``"latent"``.
        action_key: where the action is; by default the model's, else ``"action"``.
        reward_key: where the reward is written.
        device: by default the one of the model's parameters.
        dtype: of the latent; by default the one of the model's parameters.

    Raises:
        ValueError: if not exactly one of ``reward_model`` and ``cost`` is given, a size does not
            fit, or a probe call returns a wrong shape.
        KeyError: if the reward model reads or writes other keys.
        TypeError: if the model is no transition or the action specification no single tensor.

    Examples:
        >>> import torch
        >>> from torchrl.data import Bounded
        >>> from torchrl_vjepa.costs import quadratic_cost
        >>> from torchrl_vjepa.distributions import Delta
        >>> def move(latent, action):
        ...     return Delta(latent + action)
        >>> env = LatentEnv(
        ...     move,
        ...     action_spec=Bounded(-1, 1, (2,)),
        ...     cost=quadratic_cost(torch.ones(2)),
        ...     latent_dim=2,
        ... )
        >>> env.rollout(3).batch_size
        torch.Size([3])
        >>> plans = torch.tensor([[[1.0, 1.0]], [[0.0, 0.0]]])  # N = 2 candidates, H = 1
        >>> env.objective(torch.zeros(2), plans)
        tensor([0., 2.])
    """

    def __init__(
        self,
        model: Any,
        *,
        action_spec: TensorSpec,
        reward_model: TensorDictModuleBase | None = None,
        cost: StageCost | None = None,
        how: Literal["mean", "mode", "sample"] = "mean",
        num_samples: int = 1,
        risk: Risk = expectation,
        latent_dim: int | None = None,
        latent_key: NestedKey | None = None,
        action_key: NestedKey | None = None,
        reward_key: NestedKey = "reward",
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        if (reward_model is None) == (cost is None):
            raise ValueError(
                "exactly one of reward_model and cost must be given, got "
                f"{'neither' if cost is None else 'both'}"
            )
        if how not in ("mean", "mode", "sample"):
            raise ValueError(f"how must be 'mean', 'mode' or 'sample', got {how!r}")
        if num_samples < 1 or (num_samples > 1 and how != "sample"):
            raise ValueError(
                "num_samples must be at least 1, and 1 unless how='sample', "
                f"got {num_samples} with how={how!r}"
            )
        predictor = getattr(model, "predictor", model)
        transition = getattr(predictor, "dist", predictor)
        if not callable(transition):
            raise TypeError(
                "model must have a predictor, a method dist, or be a callable "
                f"(latent, action) -> Distribution, got {type(model).__name__}"
            )
        latent_key = _first(latent_key, getattr(predictor, "latent_key", None), "latent")
        action_key = _first(action_key, getattr(predictor, "action_key", None), "action")
        latent_dim = _first(latent_dim, getattr(predictor, "latent_dim", None), None)
        if latent_dim is None or latent_dim < 1:
            raise ValueError(
                f"latent_dim must be a positive integer, got {latent_dim}; give it where the model "
                "has no attribute latent_dim"
            )
        spec = _single_leaf(action_spec, action_key)
        action_dim = math.prod(spec.shape)
        expected = getattr(predictor, "action_dim", action_dim)
        if action_dim != expected:
            raise ValueError(
                f"action_spec must hold the predictor's action_dim={expected} numbers, got shape "
                f"{tuple(spec.shape)}; for a batched environment give action_spec_unbatched"
            )
        world_model = _LatentStep(
            predictor, transition, reward_model, cost, how, spec.shape,
            latent_key=latent_key, action_key=action_key, reward_key=unravel_key(reward_key),
        )  # fmt: skip
        parameter = next((p for p in world_model.parameters() if p.is_floating_point()), None)
        if device is None:
            device = "cpu" if parameter is None else parameter.device
        if dtype is None:
            dtype = torch.get_default_dtype() if parameter is None else parameter.dtype
        super().__init__(world_model, device=device, batch_size=torch.Size([]))
        self.latent_dim, self.action_dim = latent_dim, action_dim
        self.latent_key = unravel_key(latent_key)
        self.how, self.num_samples, self.risk = how, num_samples, risk
        self.rng: torch.Generator | None = None
        latent_spec = Unbounded((latent_dim,), device=self.device, dtype=dtype)
        self.observation_spec = Composite({self.latent_key: latent_spec}, device=self.device)
        self.state_spec = Composite({self.latent_key: latent_spec.clone()}, device=self.device)
        self.full_action_spec = Composite(
            {unravel_key(action_key): spec.clone().to(self.device)}, device=self.device
        )
        self.full_reward_spec = Composite(
            {unravel_key(reward_key): Unbounded((1,), device=self.device, dtype=dtype)},
            device=self.device,
        )
        world_model.probe(latent_dim, action_dim, self.device, dtype)

    def planning_state(self, tensordict: TensorDictBase) -> Tensor:
        """Where imagination starts: the latent, and nothing else of the input.

        Args:
            tensordict: holds the latent.

        Returns:
            Latent of shape ``(*B, D)``.

        Raises:
            KeyError: if there is no latent.
            ValueError: if its last dimension is not ``D``.
        """
        latent = tensordict.get(self.latent_key, None)
        if latent is None:
            raise KeyError(
                f"planning needs the entry {self.latent_key!r}, got a tensordict with "
                f"{sorted(map(str, tensordict.keys(True, True)))}; put the encoder in front"
            )
        if latent.shape[-1:] != (self.latent_dim,):
            raise ValueError(
                f"{self.latent_key!r} must have shape (*B, {self.latent_dim}), got {tuple(latent.shape)}"
            )
        return latent

    def objective(
        self, state: Tensor, actions: Tensor, *, generator: torch.Generator | None = None
    ) -> Tensor:
        r"""Cost of candidate plans, :math:`\sum_{k=0}^{H-1} c(Z_{t+k+1}, u_{t+k})`.

        Gradients flow to ``actions`` if they require them.

        Args:
            state: latents to start from, of shape ``(*B, D)``.
            actions: candidate plans, of shape ``(*B, N, H, A)``.
            generator: source of randomness for ``how="sample"``.

        Returns:
            Costs of shape ``(*B, N)``: of the point prediction, or the risk of ``M`` trajectories.

        Raises:
            ValueError: if a shape does not fit.
        """
        batch, (num_candidates, _, action_dim) = actions.shape[:-3], actions.shape[-3:]
        if state.shape != (*batch, self.latent_dim) or action_dim != self.action_dim:
            raise ValueError(
                f"state and actions must have shapes (*B, {self.latent_dim}) and (*B, N, H, "
                f"{self.action_dim}), got {tuple(state.shape)} and {tuple(actions.shape)}"
            )
        actions = actions.to(state.dtype)
        start = state.unsqueeze(-2).expand(*batch, num_candidates, self.latent_dim)
        model = self.world_model
        if self.how != "sample":
            latents = rollout(model.transition, start, actions, self.how)
            return model.stage_cost(latents, actions).sum(dim=-1)
        start = start.expand(self.num_samples, *start.shape)
        actions = actions.expand(self.num_samples, *actions.shape)
        latents = rollout(_SharedNoise(model.transition, generator), start, actions, "mean")
        costs = self.risk(model.stage_cost(latents, actions).sum(dim=-1))
        return _checked_shape(costs, (*batch, num_candidates), "risk")

    def any_done(self, tensordict: TensorDictBase) -> bool:
        """Never: an imagined end must not trigger a reset.

        Args:
            tensordict: not looked at.

        Returns:
            ``False``.
        """
        return False

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Nothing: an imagined end must not trigger a reset.

        Args:
            tensordict: returned as it is.

        Returns:
            The input.
        """
        return tensordict

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.world_model.step(tensordict, self.rng)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        if tensordict is None:
            out = self.observation_spec.rand()
        elif tensordict.get(self.latent_key, None) is None:
            out = self.observation_spec.rand(tensordict.batch_size)
        else:
            out = tensordict.select(self.latent_key)
        return out.update(self.full_done_spec.zero(out.batch_size))

    def _set_seed(self, seed: int | None) -> None:
        # Only how="sample" draws; without a seed it reads the global random state, as EnvBase does.
        self.rng = None if seed is None else torch.Generator(self.device).manual_seed(seed)

    def __getstate__(self) -> dict[str, Any]:
        rng = None if self.rng is None else pack_generator(self.rng)
        return {**super().__getstate__(), "rng": rng}

    def __setstate__(self, state: dict[str, Any]) -> None:
        rng = state["rng"]
        super().__setstate__({**state, "rng": None if rng is None else unpack_generator(rng)})


def pack_generator(generator: torch.Generator) -> tuple[str, bytes]:
    """Device and state of a generator, in a form that survives every way of pickling.

    ``torch.Generator`` pickles its state as a temporary tensor, whose file descriptor is closed too
    early when a process is spawned.

    Args:
        generator: the generator.

    Returns:
        Name of its device, and its state.
    """
    return str(generator.device), generator.get_state().numpy().tobytes()


def unpack_generator(packed: tuple[str, bytes]) -> torch.Generator:
    """The inverse of :func:`pack_generator`.

    Args:
        packed: device and state.

    Returns:
        A generator that continues where the packed one was.
    """
    device, state = packed
    generator = torch.Generator(device)
    generator.set_state(torch.frombuffer(bytearray(state), dtype=torch.uint8))
    return generator


class _LatentStep(TensorDictModuleBase):
    """``latent, action -> next latent -> reward``, on tensors and on tensordicts."""

    def __init__(
        self,
        predictor: Any,
        transition: Transition,
        reward_model: TensorDictModuleBase | None,
        cost: StageCost | None,
        how: Literal["mean", "mode", "sample"],
        action_shape: torch.Size,
        *,
        latent_key: NestedKey,
        action_key: NestedKey,
        reward_key: NestedKey,
    ) -> None:
        super().__init__()
        self.predictor = predictor  # registered: its parameters move and synchronise with the env
        self.transition = transition
        self.reward_model: Any = reward_model
        self.cost = cost
        self.how = how
        self.action_shape = tuple(action_shape)
        self.action_dim = math.prod(action_shape)
        self.latent_key, self.action_key = unravel_key(latent_key), unravel_key(action_key)
        self.reward_key = reward_key
        self.in_keys = [self.latent_key, self.action_key]
        self.out_keys = [self.latent_key, self.reward_key]
        self.reward_calls_tensors = False
        if reward_model is not None:
            if not isinstance(reward_model, TensorDictModuleBase):
                raise TypeError(
                    "reward_model must be a TensorDictModule, for instance TensorDictModule("
                    "QuadraticReward(D, A), ['latent', 'action'], ['reward']), got "
                    f"{type(reward_model).__name__}"
                )
            reads = [unravel_key(key) for key in reward_model.in_keys]
            if not set(reads) <= set(self.in_keys):
                raise KeyError(
                    f"reward_model must read only latent_key={self.latent_key!r} and "
                    f"action_key={self.action_key!r}, got in_keys={reads}; rename its in_keys"
                )
            if self.reward_key not in [unravel_key(key) for key in reward_model.out_keys]:
                raise KeyError(
                    f"reward_model must write reward_key={self.reward_key!r}, "
                    f"got out_keys={list(reward_model.out_keys)}"
                )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.update(self.step(tensordict, None))

    def step(self, tensordict: TensorDictBase, generator: torch.Generator | None) -> TensorDictBase:
        # A new tensordict: no stale done or reward of the input passes through.
        latent = tensordict.get(self.latent_key)
        action = tensordict.get(self.action_key)
        action = action.reshape((*latent.shape[:-1], self.action_dim)).to(latent.dtype)
        p = self.transition(latent, action)
        latent = point_estimate(p, self.how, generator=generator)
        reward = -self.stage_cost(latent, action).unsqueeze(-1)
        out = TensorDict({}, batch_size=tensordict.batch_size, device=tensordict.device)
        return out.set(self.latent_key, latent).set(self.reward_key, reward)

    def stage_cost(self, latent: Tensor, action: Tensor) -> Tensor:
        """Costs ``(*B)`` of next latents ``(*B, D)`` and flat actions ``(*B, A)``, all at once."""
        if self.cost is not None:
            return _checked_shape(self.cost(latent, action), latent.shape[:-1], "cost")
        batch = latent.shape[:-1]
        shaped = action.reshape((*batch, *self.action_shape))
        if self.reward_calls_tensors:
            reward = self._reward_of_tensors(latent, shaped)
        else:
            reward = self._reward_of_tensordict(latent, shaped)
        return -_checked_shape(reward, (*batch, 1), "reward_model").squeeze(-1)

    def probe(
        self, latent_dim: int, action_dim: int, device: torch.device | None, dtype: torch.dtype
    ) -> None:
        """Call every part on a small block, in evaluation mode, so that errors come early."""
        batch = (2, 3)
        latent = torch.linspace(-1.0, 1.0, 6 * latent_dim, device=device, dtype=dtype)
        latent = latent.reshape(*batch, latent_dim)
        action = torch.linspace(-0.9, 1.1, 6 * action_dim, device=device, dtype=dtype)
        action = action.reshape(*batch, action_dim)
        training = [module for module in self.modules() if module.training]
        for module in training:
            module.training = False
        try:
            with torch.no_grad():
                self._probe(latent, action)
        finally:
            for module in training:
                module.training = True

    def _probe(self, latent: Tensor, action: Tensor) -> None:
        batch = latent.shape[:-1]
        p = self.transition(latent, action)
        if not isinstance(p, Distribution):
            raise TypeError(
                "model must return a torch Distribution over the next latent, got "
                f"{type(p).__name__}; wrap a point prediction in Delta"
            )
        if tuple(p.batch_shape) != batch or tuple(p.event_shape) != latent.shape[-1:]:
            raise ValueError(
                f"model must return a distribution with batch shape {tuple(batch)} and event shape "
                f"{tuple(latent.shape[-1:])} for latent {tuple(latent.shape)} and action "
                f"{tuple(action.shape)}, got {tuple(p.batch_shape)} and {tuple(p.event_shape)}"
            )
        first = self.stage_cost(latent, action)
        model = self.reward_model
        if (
            type(model) is TensorDictModule
            and isinstance(model.module, nn.Module)
            and list(map(unravel_key, model.out_keys)) == [self.reward_key]
        ):
            # A plain network needs no tensordict per call, provided that it says the same.
            try:
                second = self._reward_of_tensors(latent, action.reshape((*batch, *self.action_shape)))
                self.reward_calls_tensors = torch.equal(second.squeeze(-1), -first)
            except (TypeError, RuntimeError, ValueError):  # keyword inputs, for instance
                self.reward_calls_tensors = False

    def _reward_of_tensors(self, latent: Tensor, action: Tensor) -> Tensor:
        model = self.reward_model
        inputs = {self.latent_key: latent, self.action_key: action}
        return model.module(*(inputs[unravel_key(key)] for key in model.in_keys))

    def _reward_of_tensordict(self, latent: Tensor, action: Tensor) -> Tensor:
        inputs = TensorDict({}, batch_size=latent.shape[:-1], device=latent.device)
        inputs.set(self.latent_key, latent).set(self.action_key, action)
        return self.reward_model(inputs).get(self.reward_key)


class _SharedNoise:
    """A transition that moves to one draw, the same noise for every candidate and batch row."""

    def __init__(self, transition: Transition, generator: torch.Generator | None) -> None:
        self.transition = transition
        self.generator = generator

    def __call__(self, latent: Tensor, action: Tensor) -> Delta:
        p = self.transition(latent, action)
        size = noise_dim(p)
        if size is None:
            return Delta(sample(p, generator=self.generator))
        shape = (latent.shape[0], *[1] * (latent.ndim - 2), size)
        noise = torch.randn(shape, generator=self.generator, device=latent.device, dtype=latent.dtype)
        return Delta(from_noise(p, noise))


def _first(*values: Any) -> Any:
    return next((value for value in values if value is not None), None)


def _checked_shape(value: Tensor, expected: tuple[int, ...], name: str) -> Tensor:
    if not isinstance(value, Tensor) or tuple(value.shape) != tuple(expected):
        got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise ValueError(
            f"{name} must return a tensor of shape {tuple(expected)} for the batch "
            f"{tuple(expected)[: None if name != 'reward_model' else -1]}, got {got}"
        )
    return value


def _single_leaf(spec: TensorSpec, action_key: NestedKey) -> TensorSpec:
    if not isinstance(spec, Composite):
        return spec
    leaves = [unravel_key(key) for key in spec.keys(True, True)]
    if leaves != [unravel_key(action_key)]:
        raise TypeError(
            f"action_spec must be one tensor under action_key={action_key!r}, got the keys {leaves}"
        )
    return spec[leaves[0]]
