r"""A latent model as a TorchRL environment.

Planners ask an environment for two things: ``planning_state(tensordict)``, where to start, and
``objective(state, actions (*B, N, H, A)) -> (*B, N)``, the cost of candidate plans, lower is
better. :class:`LatentEnv` answers both on plain tensors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.model_based import ModelBasedEnvBase

from torchrl_vjepa.belief import resampling_index, rollout
from torchrl_vjepa.common_random_numbers import CommonNoise
from torchrl_vjepa.costs import StageCost
from torchrl_vjepa.generators import pack_generator, unpack_generator
from torchrl_vjepa.latent_step import LatentStep
from torchrl_vjepa.risk import ChanceConstraint, Risk, Sampling, expectation, plan_cost

__all__ = ["LatentEnv"]

#: Trajectories per plan where a belief is given and no number: one particle would be a matter of luck.
BELIEF_SAMPLES = 64


class LatentEnv(ModelBasedEnvBase):
    r"""The latent model as an environment: imagine trajectories, and plan in them.

    A step is :math:`Z_{t+1} \sim p_\phi(\cdot \mid Z_t, u_t)` (or its mean or mode) followed by the
    reward of :math:`(Z_{t+1}, u_t)`: a reward model's, or minus a cost. The batch size is empty, so
    tensordicts of any batch size go in. An imagined ``done`` never triggers a reset.

    :meth:`objective` is the cost of whole plans on plain tensors (``eq:latent_mpc_objective``); the
    planners of this package call it, and TorchRL's own planners roll the environment out. How plans
    are sampled and judged (``num_samples``, ``risk``, ``constraints``) is a default that a planner can
    replace for itself; a plan with one trajectory whose cost is not finite costs infinity.

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
        num_samples: trajectories ``M`` per candidate plan for ``how="sample"`` (1 by default), or from ``M``
            particles of a belief with any ``how`` (64 by default). They share their
            random numbers across candidates and across the batch (common random numbers: the ranking
            of plans does not depend on luck), as far as
            :func:`~torchrl_vjepa.common_random_numbers.sample_common` knows the distribution.
        risk: ``(costs (M, *B)) -> (*B)``, applied to the summed costs of the ``M`` trajectories; by
            default their :func:`~torchrl_vjepa.risk.expectation`.
        constraints: chance constraints on the ``M`` trajectories.
        latent_dim: size ``D``; needed only if the model does not tell.
        latent_key: where the latent is; by default the model's, else ``"latent"``.
        belief_key: where a belief is, ``("next", "belief")`` behind a
            :class:`~torchrl_vjepa.belief.ParticleFilter`: planning then starts from ``num_samples`` of
            its particles, the same for all candidates, instead of from the latent.
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
        num_samples: int | None = None,
        risk: Risk | None = None,
        constraints: Sequence[ChanceConstraint] = (),
        latent_dim: int | None = None,
        latent_key: NestedKey | None = None,
        belief_key: NestedKey | None = None,
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
        sampled = how == "sample" or belief_key is not None
        if num_samples is None:
            num_samples = 1 if belief_key is None else BELIEF_SAMPLES
        if num_samples < 1 or (num_samples > 1 and not sampled):
            raise ValueError(
                "num_samples must be at least 1, and 1 unless how='sample', "
                f"got {num_samples} with how={how!r} and no belief_key"
            )
        Sampling.checked(num_samples if sampled else None, risk, constraints)
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
        world_model = LatentStep(
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
        self.planning_keys = [self.latent_key]
        self.belief_key = None if belief_key is None else unravel_key(belief_key)
        if belief_key is not None:
            self.planning_keys = [unravel_key((belief_key, name)) for name in ("particles", "log_weights")]
        self.how, self.num_samples, self.risk = how, num_samples, risk
        self.constraints: Any = nn.ModuleList(constraints)  # registered: their modules move along
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
        self.sampling()  # refuses what does not go together

    def planning_state(self, tensordict: TensorDictBase) -> Tensor | TensorDictBase:
        """Where imagination starts: the latent or the belief, and nothing else of the input.

        Args:
            tensordict: holds the latent, or the belief if there is a ``belief_key``.

        Returns:
            Latent of shape ``(*B, D)``; or a tensordict of batch size ``*B`` with ``particles
            (K, D)`` and ``log_weights (K)``.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if its last dimension is not ``D``.
        """
        values = [tensordict.get(key, None) for key in self.planning_keys]
        for key, value in zip(self.planning_keys, values, strict=True):
            if value is None:
                raise KeyError(
                    f"planning needs the entry {key!r}, got a tensordict with "
                    f"{sorted(map(str, tensordict.keys(True, True)))}; put the "
                    f"{'encoder' if self.belief_key is None else 'particle filter'} in front"
                )
        start = values[0]
        if start.shape[-1:] != (self.latent_dim,):
            lead = "(*B" if self.belief_key is None else "(*B, K"
            raise ValueError(
                f"{self.planning_keys[0]!r} must have shape {lead}, {self.latent_dim}), "
                f"got {tuple(start.shape)}"
            )
        if self.belief_key is None:
            return start
        if values[1].shape != start.shape[:-1]:
            raise ValueError(
                f"{self.planning_keys[1]!r} must have shape {tuple(start.shape[:-1])}, one for each "
                f"particle, got {tuple(values[1].shape)}"
            )
        if not bool(values[1].logsumexp(-1).isfinite().all()):
            raise ValueError(
                f"{self.planning_keys[1]!r} must hold some weight in every row, got rows that are all "
                "zero or nan"
            )
        names = ("particles", "log_weights")
        return TensorDict(dict(zip(names, values, strict=True)), batch_size=start.shape[:-2])

    def sampling(
        self,
        num_samples: int | None = None,
        risk: Risk | None = None,
        constraints: Sequence[ChanceConstraint] | None = None,
    ) -> Sampling:
        """How plans are evaluated where this is asked for: the environment's own settings for the rest.

        Args:
            num_samples: trajectories per plan; ``None``: as many as the environment samples, if it does.
            risk: ``None``: the environment's.
            constraints: ``None``: the environment's.

        Returns:
            The settings together.

        Raises:
            ValueError: if ``num_samples`` is not positive, or a risk or constraint has no samples to read.
            TypeError: if ``risk`` is not callable or ``constraints`` holds something else.
        """
        sampled = self.how == "sample" or self.belief_key is not None
        own = self.num_samples if sampled else None
        settings = Sampling.checked(
            own if num_samples is None else num_samples,
            self.risk if risk is None else risk,
            self.constraints if constraints is None else constraints,
        )
        judged = settings.constraints or settings.risk is not expectation
        if judged and self.belief_key is not None and self.how != "sample":
            raise ValueError(
                "how must be 'sample' for a risk or a constraint on plans that start from a belief, got "
                f"{self.how!r}: it would leave out the noise of the transitions"
            )
        return settings

    def objective(
        self,
        state: Tensor | TensorDictBase,
        actions: Tensor,
        *,
        generator: torch.Generator | None = None,
        num_samples: int | None = None,
        risk: Risk | None = None,
        constraints: Sequence[ChanceConstraint] | None = None,
    ) -> Tensor:
        r"""Cost of candidate plans, :math:`\sum_{k=0}^{H-1} c(Z_{t+k+1}, u_{t+k})`.

        Gradients flow to ``actions`` if they require them.

        Args:
            state: what :meth:`planning_state` gives: latents of shape ``(*B, D)``, or a belief.
            actions: candidate plans, of shape ``(*B, N, H, A)``.
            generator: source of randomness for sampled trajectories.
            num_samples: trajectories per plan; ``None``: as the environment does.
            risk: of their costs; ``None``: the environment's.
            constraints: on their latents and actions; ``None``: the environment's.

        Returns:
            Costs of shape ``(*B, N)``: of the point prediction, or the risk of ``M`` trajectories.

        Raises:
            ValueError: if a shape does not fit, or what is asked for needs samples and has none.
        """
        num_samples, risk, constraints = self.sampling(num_samples, risk, constraints)
        latents, actions = self._imagine(state, actions, num_samples, generator)
        costs = self.world_model.stage_cost(latents, actions).sum(dim=-1)
        return costs if num_samples is None else plan_cost(costs, risk, constraints, latents, actions)

    def violation_probability(
        self,
        state: Tensor | TensorDictBase,
        actions: Tensor,
        *,
        generator: torch.Generator | None = None,
        num_samples: int | None = None,
        constraints: Sequence[ChanceConstraint] | None = None,
    ) -> Tensor:
        """How often candidate plans violate each constraint, among their sampled trajectories.

        Args:
            state: what :meth:`planning_state` gives: latents of shape ``(*B, D)``, or a belief.
            actions: candidate plans, of shape ``(*B, N, H, A)``.
            generator: source of randomness.
            num_samples: trajectories per plan; ``None``: as the environment does.
            constraints: ``C`` of them; ``None``: the environment's.

        Returns:
            Frequencies of shape ``(*B, N, C)``.

        Raises:
            ValueError: if there are no constraints or no samples, or a shape does not fit.
        """
        num_samples, _, constraints = self.sampling(num_samples, None, constraints)
        if not constraints:
            raise ValueError("constraints must hold at least one ChanceConstraint, got none")
        latents, actions = self._imagine(state, actions, num_samples, generator)
        return torch.stack([constraint(latents, actions) for constraint in constraints], dim=-1)

    def _imagine(
        self,
        state: Tensor | TensorDictBase,
        actions: Tensor,
        num_samples: int | None,
        generator: torch.Generator | None,
    ) -> tuple[Tensor, Tensor]:
        """Latents and actions, ``(*B, N, H, ...)``, or ``(M, *B, N, H, ...)`` where they are sampled."""
        batch, (num_candidates, _, action_dim) = actions.shape[:-3], actions.shape[-3:]
        drawn = not isinstance(state, Tensor)
        start = _drawn(state, num_samples or 1, generator) if drawn else state
        if start.shape[drawn:] != (*batch, self.latent_dim) or action_dim != self.action_dim:
            raise ValueError(
                f"state and actions must have shapes (*B, {self.latent_dim}) and (*B, N, H, "
                f"{self.action_dim}), got {tuple(start.shape[drawn:])} and {tuple(actions.shape)}"
            )
        actions = actions.to(start.dtype)
        transition = self.world_model.transition
        if not drawn and num_samples is not None:
            start = start.expand(num_samples, *start.shape)
        start = start.unsqueeze(-2).expand(*start.shape[:-1], num_candidates, self.latent_dim)
        if num_samples is None:
            return rollout(transition, start, actions, self.how), actions
        actions = actions.expand(num_samples, *actions.shape)
        if drawn and self.how != "sample":  # the belief is sampled, what follows is not
            return rollout(transition, start, actions, self.how), actions
        return rollout(CommonNoise(transition, generator), start, actions, "mean"), actions

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


def _drawn(belief: TensorDictBase, num_samples: int, generator: torch.Generator | None) -> Tensor:
    """Particles ``(M, *B, D)`` of a belief, by one random number for all rows, as all planning noise."""
    index = resampling_index(
        belief.get("log_weights"), num_samples, shared=True, generator=generator
    ).unsqueeze(-1)
    particles = belief.get("particles")
    return particles.gather(-2, index.expand(*index.shape[:-1], particles.shape[-1])).movedim(-2, 0)


def _first(*values: Any) -> Any:
    return next((value for value in values if value is not None), None)


def _single_leaf(spec: TensorSpec, action_key: NestedKey) -> TensorSpec:
    if not isinstance(spec, Composite):
        return spec
    leaves = [unravel_key(key) for key in spec.keys(True, True)]
    if leaves != [unravel_key(action_key)]:
        raise TypeError(
            f"action_spec must be one tensor under action_key={action_key!r}, got the keys {leaves}"
        )
    return spec[leaves[0]]
