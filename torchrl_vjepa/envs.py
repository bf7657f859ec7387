r"""A latent model as a TorchRL environment.

Planners ask an environment for two things: ``planning_state(tensordict)``, where to start, and
``objective(state, actions (*B, N, H, A)) -> (*B, N)``, the cost of candidate plans, lower is
better. :class:`LatentEnv` answers both on plain tensors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.model_based import ModelBasedEnvBase

from torchrl_vjepa.actions import ActionCodec
from torchrl_vjepa.belief import PreparedTransition
from torchrl_vjepa.costs import StageCost
from torchrl_vjepa.generators import pack_generator, unpack_generator
from torchrl_vjepa.imagination import (
    PlanPrior,
    check_prior,
    first_latents,
    imagine,
    imagine_fused,
    plan_tasks,
    read_state,
)
from torchrl_vjepa.latent_step import NO_GRADIENT, LatentStep
from torchrl_vjepa.priors import Prior
from torchrl_vjepa.risk import ChanceConstraint, Risk, Sampling, expectation, plan_cost
from torchrl_vjepa.signatures import InitSignature
from torchrl_vjepa.state_heads import Head, check_head

__all__ = ["LatentEnv"]

#: Trajectories per plan where a belief is given and no number: one particle would be a matter of luck.
BELIEF_SAMPLES = 64


class LatentEnv(ModelBasedEnvBase):
    r"""The latent model as an environment: imagine trajectories, and plan in them.

    A step is :math:`Z_{t+1} \sim p_\phi(\cdot \mid Z_t, u_t)` (or its mean or mode) followed by the
    reward of :math:`(Z_{t+1}, u_t)`: a reward model's, minus a cost, minus the energy of a prior. The batch
    size is empty, so tensordicts of any batch size go in. An imagined ``done`` never triggers a reset.

    **Tasks are swapped, the model stays.** The ``prior`` says what is wanted; its task (a goal, the place of
    an obstacle) is an entry of the tensordict that is planned from, one for each row, constant or
    time-indexed: a new task is a new entry. How the prior enters a plan is ``fusion``:

    - ``"energy"``: as a cost, :math:`-\sum_k \log p_{\text{prior}}(Z_{t+k} \mid \eta_{t+k})`, with the other
      costs and under any risk (``alg:bjepa_mpc``).
    - ``"weight"``: by posterior. A plan costs the free energy :math:`-\log \frac1M \sum_m e^{-J^{(m)}}` of
      its ``M`` sampled trajectories: minus the log-probability that the dynamics satisfy the prior (and, with
      costs, that :math:`e^{-c}` accepts). Control as inference: it hopes for lucky noise.
    - ``"propose"``: the same number with less variance: trajectories are drawn from the fused transition,
      and weighed by how far the prior had to pull them (:func:`~torchrl_vjepa.imagination.imagine_fused`).

    :meth:`objective` is the cost of whole plans on plain tensors (``eq:latent_mpc_objective``); the
    planners of this package call it, and TorchRL's own planners roll the environment out. How plans
    are sampled and judged (``num_samples``, ``risk``, ``constraints``) is a default that a planner can
    replace for itself; a plan with one trajectory whose cost is not finite costs infinity.

    Args:
        model: what predicts: a :class:`~torchrl_vjepa.models.JEPA` or anything with ``predictor``;
            a :class:`~torchrl_vjepa.predictor.Predictor` or anything with ``dist``; or a transition
            ``(latent (*B, D), action (*B, A)) -> Distribution`` with batch ``*B``, event ``(D,)``.
            It and ``cost`` read actions as the flat code of :class:`~torchrl_vjepa.actions.ActionCodec`,
            ``A`` floats: one-hot codes where actions are discrete.
        action_spec: the actions of any kind, without batch dimensions: ``env.action_spec_unbatched`` of the
            real environment, or its ``full_action_spec_unbatched``, which brings its own keys.
        reward_model: TensorDictModule that reads ``latent_key`` (the next latent) and
            ``action_key`` (a single continuous action in its own shape, else the flat code) and writes
            ``reward_key`` with shape ``(*B, 1)``.
        cost: ``(next latent (*B, D), action (*B, A)) -> (*B)``; subtracted from the reward.
        prior: of the task; its energy is subtracted from the reward. Of ``reward_model``, ``cost`` and
            ``prior`` at least one must be given; what is given is added up.
        fusion: how the prior enters the cost of a plan; all but ``"energy"`` need sampled trajectories.
        num_particles: of ``fusion="propose"``, in every step that has no closed form; memory grows with them.
        termination_model: TensorDictModule that reads ``latent_key`` (the next latent) and ``action_key`` and
            writes ``"termination_logit"`` of shape ``(*B, 1)``, the logit of the episode's end
            (:class:`~torchrl_vjepa.objectives.TerminationLoss` trains it). Costs of a plan count as far as it
            lives, :math:`\sum_k \prod_{j<k} (1 - p_j)\,(c_k + p_k c_{\text{end}})`, and a step writes
            ``terminated`` and ``done``.
        termination_cost: :math:`c_{\text{end}}`, what an end costs: where costs are positive, ending would
            otherwise be a way to save them.
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
        action_key: where the action is, if ``action_spec`` is no ``Composite``, and the name under which
            models read it; by default the model's, else ``"action"``.
        reward_key: where the reward is written.
        rollout_dtype: what the network computes in while planning, for instance ``torch.bfloat16``; latents
            and costs keep their dtype. Not for ``fusion="propose"``, which factorises covariances.
        device: by default the one of the model's parameters.
        dtype: of the latent; by default the one of the model's parameters.

    Raises:
        ValueError: if none of ``reward_model``, ``cost`` and ``prior`` is given, a size does not
            fit, or a probe call returns a wrong shape.
        KeyError: if the reward model reads or writes other keys.
        TypeError: if the model is no transition, the prior no ``Prior``, or an action is of a kind that has
            no code.

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

    __signature__ = InitSignature()

    def __init__(
        self,
        model: Any,
        *,
        action_spec: TensorSpec,
        reward_model: TensorDictModuleBase | None = None,
        cost: StageCost | None = None,
        prior: Prior | None = None,
        fusion: Literal["energy", "weight", "propose"] = "energy",
        num_particles: int = 128,
        termination_model: TensorDictModuleBase | None = None,
        termination_cost: float = 0.0,
        how: Literal["mean", "mode", "sample"] = "mean",
        num_samples: int | None = None,
        risk: Risk | None = None,
        constraints: Sequence[ChanceConstraint] = (),
        latent_dim: int | None = None,
        latent_key: NestedKey | None = None,
        belief_key: NestedKey | None = None,
        action_key: NestedKey | None = None,
        reward_key: NestedKey = "reward",
        rollout_dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        if reward_model is None and cost is None and prior is None:
            raise ValueError("at least one of reward_model, cost and prior must be given, got none")
        if how not in ("mean", "mode", "sample"):
            raise ValueError(f"how must be 'mean', 'mode' or 'sample', got {how!r}")
        if rollout_dtype is not None and not rollout_dtype.is_floating_point:
            raise ValueError(f"rollout_dtype must be a floating point dtype, got {rollout_dtype}")
        sampled = how == "sample" or belief_key is not None
        if num_samples is None:
            num_samples = 1 if belief_key is None else BELIEF_SAMPLES
        if num_samples < 1 or (num_samples > 1 and not sampled):
            raise ValueError(
                "num_samples must be at least 1, and 1 unless how='sample', "
                f"got {num_samples} with how={how!r} and no belief_key"
            )
        Sampling.checked(num_samples if sampled else None, risk, constraints)
        # What is a transition itself comes first: a FusedPredictor has a predictor inside.
        predictor = model if hasattr(model, "dist") else getattr(model, "predictor", model)
        transition = getattr(predictor, "dist", predictor)
        if not callable(transition):
            raise TypeError(
                "model must have a predictor, a method dist, or be a callable "
                f"(latent, action) -> Distribution, got {type(model).__name__}"
            )
        latent_key = _first(latent_key, getattr(predictor, "latent_key", None), "latent")
        action_key = _first(action_key, getattr(predictor, "action_key", None), "action")
        codec = ActionCodec(action_spec, action_key)
        latent_dim = _first(latent_dim, getattr(predictor, "latent_dim", None), None)
        if latent_dim is None or latent_dim < 1:
            raise ValueError(
                f"latent_dim must be a positive integer, got {latent_dim}; give it where the model "
                "has no attribute latent_dim"
            )
        action_dim = codec.size
        expected = getattr(predictor, "action_dim", action_dim)
        if action_dim != expected:
            raise ValueError(
                f"action_spec must hold the predictor's action_dim={expected} numbers, got shape "
                f"{tuple(codec.shape)} of {codec.describe()}; for a batched environment give "
                "action_spec_unbatched"
            )
        world_model = LatentStep(
            predictor, transition, reward_model, cost, how, codec.shape,
            latent_key=latent_key, action_key=action_key, reward_key=unravel_key(reward_key), prior=prior,
            termination_model=termination_model, termination_cost=termination_cost,
        )  # fmt: skip
        parameter = next((p for p in world_model.parameters() if p.is_floating_point()), None)
        if device is None:
            device = "cpu" if parameter is None else parameter.device
        if dtype is None:
            dtype = torch.get_default_dtype() if parameter is None else parameter.dtype
        check_prior(prior, latent_dim, torch.device(device))
        super().__init__(world_model, device=device, batch_size=torch.Size([]))
        self.codec = codec.to(self.device)
        self.latent_dim, self.action_dim = latent_dim, action_dim
        self.latent_key = unravel_key(latent_key)
        self.planning_keys = [self.latent_key]
        self.belief_key = None if belief_key is None else unravel_key(belief_key)
        if belief_key is not None:
            self.planning_keys = [unravel_key((belief_key, name)) for name in ("particles", "log_weights")]
        self.task_keys = [] if prior is None else [unravel_key(key) for key in prior.in_keys]
        self.planning_keys += self.task_keys
        self.how, self.num_samples, self.risk, self.fusion = how, num_samples, risk, fusion
        self.num_particles = num_particles
        self.constraints: Any = nn.ModuleList(constraints)  # registered: their modules move along
        self.rng: torch.Generator | None = None
        self.rollout_dtype = rollout_dtype
        latent_spec = Unbounded((latent_dim,), device=self.device, dtype=dtype)
        self.observation_spec = Composite({self.latent_key: latent_spec}, device=self.device)
        self.state_spec = Composite({self.latent_key: latent_spec.clone()}, device=self.device)
        if not isinstance(action_spec, Composite):
            action_spec = Composite({codec.keys[0]: action_spec})
        self.full_action_spec = action_spec.clone().to(self.device)
        self.full_reward_spec = Composite(
            {unravel_key(reward_key): Unbounded((1,), device=self.device, dtype=dtype)},
            device=self.device,
        )
        world_model.probe(latent_dim, action_dim, self.device, dtype)
        self.sampling()  # refuses what does not go together

    def planning_state(self, tensordict: TensorDictBase) -> Tensor | TensorDictBase:
        """Where imagination starts: the latent or the belief, the tasks, and nothing else of the input.

        Args:
            tensordict: holds the latent, or the belief if there is a ``belief_key``, and the entries that
                the prior reads.

        Returns:
            Latent of shape ``(*B, D)``; or a tensordict of batch size ``*B`` with ``latent (D)``, or
            ``particles (K, D)`` and ``log_weights (K)``, and what the prior reads under ``tasks``.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if its last dimension is not ``D``, or a task lacks the batch dimensions.
        """
        return read_state(tensordict, self.planning_keys, self.task_keys, self.latent_dim)

    def sampling(
        self,
        num_samples: int | None = None,
        risk: Risk | None = None,
        constraints: Sequence[ChanceConstraint] | None = None,
        fusion: Literal["energy", "weight", "propose"] | None = None,
        terminal_value: Head | None = None,
    ) -> Sampling:
        """How plans are evaluated where this is asked for: the environment's own settings for the rest.

        Args:
            num_samples: trajectories per plan; ``None``: as many as the environment samples, if it does.
            risk: ``None``: the environment's.
            constraints: ``None``: the environment's.
            fusion: ``None``: the environment's.
            terminal_value: ``None``: nothing is behind the horizon.

        Returns:
            The settings together; planning by posterior has the risk
            :func:`~torchrl_vjepa.risk.free_energy`.

        Raises:
            ValueError: if ``num_samples`` is not positive, a risk or constraint has no samples to read, or
                planning by posterior has none, no prior, or another risk.
            TypeError: if ``risk`` is not callable or ``constraints`` holds something else.
            KeyError: if ``terminal_value`` reads something else than the latent.
        """
        sampled = self.how == "sample" or self.belief_key is not None
        own = self.num_samples if sampled else None
        fusion = self.fusion if fusion is None else fusion
        if fusion != "energy" and self.world_model.prior is None:
            raise ValueError(f"fusion={fusion!r} needs a prior, got none; give one to LatentEnv")
        settings = Sampling.checked(
            own if num_samples is None else num_samples,
            self.risk if risk is None else risk,
            self.constraints if constraints is None else constraints,
            fusion,
        )
        if (
            (settings.constraints or settings.risk is not expectation)
            and self.belief_key is not None
            and self.how != "sample"
        ):
            raise ValueError(
                "how must be 'sample' for a risk or a constraint on plans that start from a belief, got "
                f"{self.how!r}: it would leave out the noise of the transitions"
            )
        if terminal_value is not None:
            readable, env = [self.latent_key], type(self).__name__
            check_head(
                "terminal_value", terminal_value, readable, env=env, has_latent=True, writes=["state_value"]
            )
        return settings._replace(terminal_value=terminal_value)

    def objective(
        self,
        state: Tensor | TensorDictBase,
        actions: Tensor,
        *,
        generator: torch.Generator | None = None,
        num_samples: int | None = None,
        risk: Risk | None = None,
        constraints: Sequence[ChanceConstraint] | None = None,
        fusion: Literal["energy", "weight", "propose"] | None = None,
        terminal_value: Head | None = None,
    ) -> Tensor:
        r"""Cost of candidate plans, :math:`\sum_{k=0}^{H-1} c(Z_{t+k+1}, u_{t+k}) - a_H V(Z_{t+H})`.

        Gradients flow to ``actions`` if they require them.

        Args:
            state: what :meth:`planning_state` gives: latents of shape ``(*B, D)``, or a belief.
            actions: candidate plans, of shape ``(*B, N, H, A)``.
            generator: source of randomness for sampled trajectories.
            num_samples: trajectories per plan; ``None``: as the environment does.
            risk: of their costs; ``None``: the environment's.
            constraints: on their latents and actions; ``None``: the environment's.
            fusion: how the prior enters; ``None``: the environment's.
            terminal_value: :math:`V`, weighted by the probability :math:`a_H` of being alive; see
                :func:`~torchrl_vjepa.state_heads.state_value`.

        Returns:
            Costs of shape ``(*B, N)``: of the point prediction, or the risk of ``M`` trajectories.

        Raises:
            ValueError: if a shape does not fit, what is asked for needs samples and has none, or actions
                require gradients and the energy of the prior gives none.
        """
        evaluate = self.objective_from(
            state,
            num_samples=num_samples,
            risk=risk,
            constraints=constraints,
            fusion=fusion,
            terminal_value=terminal_value,
        )
        return evaluate(actions, generator)

    def objective_from(
        self, state: Tensor | TensorDictBase, **settings: Any
    ) -> Callable[[Tensor, torch.Generator | None], Tensor]:
        """:meth:`objective` of one planning call: what its rounds share is checked and prepared once.

        Args:
            state: see :meth:`objective`.
            **settings: ``num_samples``, ``risk``, ``constraints``, ``fusion``, ``terminal_value``; see
                :meth:`objective`.

        Returns:
            ``(actions (*B, N, H, A), generator) -> costs (*B, N)``, for as long as no weight changes. What
            the prior gives for the tasks is made at its first call: gradients of later ones are for actions.
        """
        given = self.sampling(**settings)
        if given.fusion == "propose" and self.rollout_dtype is not None:
            raise ValueError(f"rollout_dtype must be None for fusion='propose', got {self.rollout_dtype}")
        world_model = self.world_model
        transition = PreparedTransition(world_model.transition, self.rollout_dtype)
        prior_of: dict[int, PlanPrior] = {}  # by horizon

        def evaluate(actions: Tensor, generator: torch.Generator | None = None) -> Tensor:
            start, actions = self._start(state, actions, given.num_samples, generator)
            prior = prior_of.get(actions.shape[-2])
            if prior is None:
                tasks = plan_tasks(world_model.prior, state, actions.shape[-2]) if self.task_keys else None
                by_step = given.fusion == "propose"
                prior = PlanPrior.of(
                    world_model.prior, tasks, self.latent_dim, actions.ndim - 3 if by_step else None,
                    whole=not by_step or world_model.termination_model is not None,
                )  # fmt: skip
                prior_of[actions.shape[-2]] = prior
            if prior.at is not None:
                latents, evidence = imagine_fused(
                    transition, start, actions, prior.at, generator, self.num_particles
                )
                if actions.requires_grad and not evidence.requires_grad:
                    raise ValueError(NO_GRADIENT)
                costs, reached = world_model.fused_cost(latents, actions, evidence, prior.whole), latents
                if given.constraints:  # what violates is what the dynamics do, not what the prior asks for
                    latents = imagine(transition, start, actions, "sample", generator)
            else:
                latents = imagine(transition, start, actions, self._following(state, given), generator)
                latents, needs_gradient = latents.to(start.dtype), actions.requires_grad
                costs = world_model.stage_cost(
                    latents, actions, density=prior.whole, needs_gradient=needs_gradient
                )
                costs, reached = world_model.until_end(costs, latents, actions), latents
            costs = costs.sum(dim=-1)
            if given.terminal_value is not None:
                costs = costs - world_model.value_behind(given.terminal_value, reached, actions)
            if given.num_samples is None:
                return costs
            return plan_cost(costs, given.risk, given.constraints, latents, actions)

        return evaluate

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
        settings = self.sampling(num_samples, None, constraints)
        if not settings.constraints:
            raise ValueError("constraints must hold at least one ChanceConstraint, got none")
        start, actions = self._start(state, actions, settings.num_samples, generator)
        how = self._following(state, settings)
        latents = imagine(self.world_model.transition, start, actions, how, generator)
        return torch.stack([constraint(latents, actions) for constraint in settings.constraints], dim=-1)

    def _start(
        self, state: Tensor | TensorDictBase, actions: Tensor, samples: int | None, rng: Any
    ) -> tuple[Tensor, Tensor]:
        if isinstance(state, Tensor) and self.task_keys:
            raise KeyError(f"state must hold the tasks {self.task_keys} under 'tasks', got a tensor")
        return first_latents(state, actions, self.latent_dim, self.action_dim, samples, rng)

    def _following(
        self, state: Tensor | TensorDictBase, settings: Sampling
    ) -> Literal["mean", "mode", "sample"]:
        """How the next latent is chosen: what starts from a belief may be sampled at its start alone."""
        from_belief = self.belief_key is not None and not isinstance(state, Tensor)
        return self.how if settings.num_samples is None or from_belief else "sample"

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

    @property
    def _observation_keys_step_mdp(self) -> list[NestedKey]:  # no specification knows the shapes of tasks
        return [*super()._observation_keys_step_mdp, *self.task_keys]

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self.codec.is_identity:
            code = self.codec.encode(tensordict)
            tensordict = tensordict.copy().set(self.world_model.action_key, code)
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


def _first(*values: Any) -> Any:
    return next((value for value in values if value is not None), None)
