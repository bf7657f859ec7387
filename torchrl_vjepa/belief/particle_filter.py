"""Sequential importance resampling in latent space: prediction, weighting, resampling."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.distributions import Distribution
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import TensorDictPrimer

from torchrl_vjepa.actions import ActionCodec
from torchrl_vjepa.belief.particles import ParticleBelief, effective_sample_size, resampling_index
from torchrl_vjepa.belief.primer import BeliefPrimer
from torchrl_vjepa.distributions import diag_gaussian, sample
from torchrl_vjepa.generators import pack_generator, unpack_generator

__all__ = ["ParticleFilter"]

Likelihood = Callable[[Tensor, Tensor], Tensor]
Proposal = Callable[[Distribution, Tensor], Distribution]


class ParticleFilter(TensorDictModuleBase):
    r"""Particle filter over latents (section "A Particle-Filter Interpretation of VJEPA").

    One step, for every row of the batch:

    1. *resample*, systematically, if the effective sample size is below ``resample_threshold * K``;
    2. *predict* (bootstrap proposal): :math:`Z^{(k)}_{t+1} \sim p_\phi(\cdot \mid Z^{(k)}_t, u_t)`;
    3. *weigh*: :math:`w_{t+1} \propto w_t\, L(x_{t+1} \mid Z_{t+1})`, in log space, with an observation
       model :math:`L = p_\psi(x \mid Z)` (option A) or a
       :class:`~torchrl_vjepa.belief.PseudoLikelihood` (option B).

    The paper resamples at the end of a step; doing it first in the next one is the same algorithm, and
    the belief in between keeps its weights, whose mean has less variance. The normaliser of the weights is
    ``log_evidence``, an estimate of :math:`\log p(x_{t+1} \mid x_{\le t}, u_{\le t})`; the exponential of
    its sum over time is unbiased.

    A bootstrap proposal needs about as many particles as the prediction is wider than the likelihood, in
    volume. Where the likelihood is sharp, give a ``proposal`` that looks at the observation; the weights
    then are :math:`w_t\, p_\phi(Z) L(x \mid Z) / r(Z)`.

    **On tensors** there are :meth:`start`, :meth:`step` and, over whole trajectories, :meth:`filter`.

    **As a TensorDictModule** it goes in front of a planner: it reads the observation and the belief of
    the step before, ``(belief_key, ...)``, and writes the new one to ``("next", belief_key, ...)`` and its
    mean to ``latent_key``. A planner over ``LatentEnv(..., belief_key=("next", belief_key))`` starts from
    the particles; any other one starts from the mean. ``get_env_transforms_from_module(policy)``
    gives the environment what carries the belief *and the action that was executed*, noise of an
    exploration module included. Rows with ``init_key`` set start anew; without a belief in the
    input all do. Collected data holds ``K (D + 1)`` numbers a step twice: exclude ``belief_key`` and
    ``("next", belief_key)`` from a replay buffer.

    **Faults are not silent.** A likelihood of ``nan`` or plus infinity counts as zero; where all
    particles of a row have weight zero, its observation is ignored (the belief is the prediction, the log
    evidence minus infinity); one ``RuntimeWarning`` tells of either. A prediction that is not finite is
    refused.

    Args:
        model: what predicts: a ``VJEPA`` or anything with ``predictor``; a ``Predictor`` or anything with
            ``dist``; or a transition ``(latent (*B, D), action (*B, A)) -> Distribution``.
        likelihood: ``(observation (*B, 1, *O), latent (*B, K, D)) -> (*B, K)``: the log-likelihood of
            each particle; the observation has a particle dimension of one, which broadcasts.
        num_particles: :math:`K`.
        initial: :math:`p(Z_0)`, before the first observation: a distribution with event ``(D,)``, or a
            callable without arguments that returns one (a ``GaussianPrior``); standard normal by default.
        proposal: ``(p, observation (*B, 1, *O)) -> Distribution``, batch ``(*B, K)``: what particles are
            drawn from, given the prediction ``p`` (or ``initial``, at the start). ``product_of_experts`` of
            the prediction and the target distribution, for instance. ``None`` is the bootstrap filter.
        resample_threshold: fraction of ``K`` in ``[0, 1]``; 0 never resamples, 1 always.
        chunk_size: how many particles go through transition and likelihood at a time, all by default: a
            bound on the memory of what they compute on the way.
        latent_dim: size ``D``; needed only if the model does not tell.
        action_dim: size ``A`` of the flattened action; needed only if the model does not tell.
        action_spec: of the environment (``env.full_action_spec_unbatched``), for actions that models read in
            the code of :class:`~torchrl_vjepa.actions.ActionCodec`: choices, bits, several tensors.
        observation_ndim: number of dimensions of one observation: 1 for vectors, 3 for images.
        return_stats: also write ``("belief_stats", "log_evidence")`` and
            ``("belief_stats", "effective_sample_size")``, of shape ``(*B)``.
        observation_key: where the observation is read; the encoder's latent, for instance.
        latent_key: where the mean of the belief is written.
        action_key: where the executed action is found; by default the model's, else ``"action"``.
        belief_key: name of the belief: ``"particles"``, ``"log_weights"`` and ``"action"`` in it.
        init_key: set where an episode begins (``InitTracker``).
        generator: source of randomness, on the device of the particles; the global one if ``None``.
        dtype: of the particles; by default the one of the model's parameters.

    Raises:
        ValueError: if an argument is out of its range, or a size is neither given nor known.
        TypeError: if the model is no transition or the likelihood not callable.

    Examples:
        >>> import torch
        >>> from torch.distributions import Normal
        >>> from torchrl_vjepa import PseudoLikelihood, diag_gaussian
        >>> def walk(latent, action):
        ...     return diag_gaussian(latent + action, 0.1 * torch.ones(1))
        >>> def sensor(observation, latent):  # option A: log N(x; Z, 0.2)
        ...     return Normal(latent, 0.2).log_prob(observation).sum(-1)
        >>> filter = ParticleFilter(walk, sensor, num_particles=1000, latent_dim=1, action_dim=1)
        >>> belief, log_evidence = filter.start(torch.tensor([[0.5], [-0.5]]))
        >>> belief, log_evidence = filter.step(belief, torch.ones(2, 1), torch.tensor([[1.5], [0.5]]))
        >>> belief.mean.round(decimals=1), log_evidence.shape
        (tensor([[1.5000],
                [0.5000]]), torch.Size([2]))

        Between encoder and planner, with the encoder's latent as the measurement (option B):

        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictSequential
        >>> from torchrl.data import Bounded
        >>> from torchrl_vjepa import CEM, VJEPA, LatentEnv, Predictor, linear_encoder, quadratic_cost
        >>> model = VJEPA(linear_encoder(20, 4), Predictor(4, action_dim=2))
        >>> likelihood = PseudoLikelihood(lambda z: diag_gaussian(z, 0.5 * torch.ones(1)))
        >>> filter = ParticleFilter(model, likelihood, num_particles=100, observation_key="latent")
        >>> world = LatentEnv(
        ...     model,
        ...     action_spec=Bounded(-1, 1, (2,)),
        ...     cost=quadratic_cost(torch.zeros(4)),
        ...     how="sample",
        ...     num_samples=8,
        ...     belief_key=("next", "belief"),
        ... )
        >>> policy = TensorDictSequential(model.encoder, filter, CEM(world, 3, 2, 64))
        >>> out = policy(TensorDict(observation=torch.zeros(5, 20), batch_size=[5]))
        >>> out["action"].shape, out["next", "belief", "particles"].shape
        (torch.Size([5, 2]), torch.Size([5, 100, 4]))
    """

    def __init__(
        self,
        model: Any,
        likelihood: Likelihood,
        *,
        num_particles: int = 1000,
        initial: Distribution | Callable[[], Distribution] | None = None,
        proposal: Proposal | None = None,
        resample_threshold: float = 0.5,
        chunk_size: int | None = None,
        latent_dim: int | None = None,
        action_dim: int | None = None,
        action_spec: TensorSpec | None = None,
        observation_ndim: int = 1,
        return_stats: bool = False,
        observation_key: NestedKey = "observation",
        latent_key: NestedKey = "latent",
        action_key: NestedKey | None = None,
        belief_key: NestedKey = "belief",
        init_key: NestedKey = "is_init",
        generator: torch.Generator | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        # What is a transition itself comes first: a FusedPredictor has a predictor inside.
        predictor = model if hasattr(model, "dist") else getattr(model, "predictor", model)
        transition = getattr(predictor, "dist", predictor)
        for name, value in (("model", transition), ("likelihood", likelihood)):
            if not callable(value):
                raise TypeError(f"{name} must be callable, got {type(value).__name__}")
        latent_dim = getattr(predictor, "latent_dim", None) if latent_dim is None else latent_dim
        action_dim = getattr(predictor, "action_dim", None) if action_dim is None else action_dim
        if action_key is None:
            action_key = getattr(predictor, "action_key", "action")
        codec = None if action_spec is None else ActionCodec(action_spec, action_key)
        if codec is not None and action_dim not in (None, codec.size):
            raise ValueError(
                f"action_spec must be of action_dim={action_dim} numbers, got {codec.size} of "
                f"{codec.describe()}"
            )
        action_dim = action_dim if codec is None else codec.size
        for name, value, least in (
            ("num_particles", num_particles, 1),
            ("chunk_size", num_particles if chunk_size is None else chunk_size, 1),
            ("latent_dim", latent_dim, 1),
            ("action_dim", action_dim, 0),
            ("observation_ndim", observation_ndim, 0),
        ):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"{name} must be an integer of at least {least}, got {value!r}")
        if not 0 <= resample_threshold <= 1:
            raise ValueError(f"resample_threshold must be in [0, 1], got {resample_threshold}")
        self.predictor = predictor  # a module is registered: its parameters move with the filter
        self.transition = transition
        self.likelihood = likelihood
        self.num_particles, self.chunk_size = num_particles, chunk_size
        self.initial, self.proposal = initial, proposal
        self.resample_threshold = float(resample_threshold)
        self.codec = codec
        self.latent_dim, self.action_dim = int(latent_dim or 0), int(action_dim or 0)
        self.observation_ndim, self.return_stats = observation_ndim, return_stats
        self.generator = generator
        self._dtype = dtype
        self.action_key, self.belief_key = unravel_key(action_key), unravel_key(belief_key)
        memory = [unravel_key((belief_key, name)) for name in ("particles", "log_weights", "action")]
        self.in_keys = [unravel_key(observation_key), *memory, unravel_key(init_key)]
        self.out_keys = [unravel_key(latent_key), *(unravel_key(("next", key)) for key in memory[:2])]
        if return_stats:
            self.out_keys += [("belief_stats", "log_evidence"), ("belief_stats", "effective_sample_size")]

    @property
    def dtype(self) -> torch.dtype:
        """What the particles are stored in; by default it follows the parameters."""
        if self._dtype is not None:
            return self._dtype
        parameter = next((p for p in self.parameters() if p.is_floating_point()), None)
        return torch.get_default_dtype() if parameter is None else parameter.dtype

    def start(self, observation: Tensor) -> tuple[ParticleBelief, Tensor]:
        """The belief after the first observation.

        Args:
            observation: :math:`x_0`, of shape ``(*B, *O)``.

        Returns:
            Belief with batch ``*B``, and the log evidence ``(*B)``.

        Raises:
            ValueError: if a shape does not fit or a particle is not finite.
        """
        batch = self._batch(observation)
        initial = self.initial
        if initial is None:
            zeros = torch.zeros(self.latent_dim, dtype=self.dtype, device=observation.device)
            initial = diag_gaussian(zeros, torch.ones_like(zeros[:1]))
        elif not isinstance(initial, Distribution):
            initial = initial()
        if tuple(initial.event_shape) != (self.latent_dim,) or initial.batch_shape:
            raise ValueError(
                f"initial must have no batch and event shape {(self.latent_dim,)}, got "
                f"{tuple(initial.batch_shape)} and {tuple(initial.event_shape)}"
            )
        prior = initial
        parts = [self._weighed(prior.expand((*batch, num)), observation) for _, num in self._chunks()]
        log_weights = parts[0][1].new_full((*batch, self.num_particles), -math.log(self.num_particles))
        return self._posterior(parts, log_weights)

    def step(
        self, belief: ParticleBelief, action: Tensor, observation: Tensor
    ) -> tuple[ParticleBelief, Tensor]:
        """The belief after an action and the observation that followed.

        Args:
            belief: the one before, with batch ``*B``.
            action: the executed action :math:`u_t`, in code, of shape ``(*B, A)``.
            observation: :math:`x_{t+1}`, of shape ``(*B, *O)``.

        Returns:
            Belief with batch ``*B``, and the log evidence ``(*B)``.

        Raises:
            ValueError: if a shape does not fit or a particle is not finite.
        """
        batch = self._batch(observation)
        expected = (*batch, self.num_particles, self.latent_dim)
        if tuple(belief.particles.shape) != expected:
            raise ValueError(
                f"belief must have particles of shape {expected} for the observation "
                f"{tuple(observation.shape)}, got {tuple(belief.particles.shape)}"
            )
        if tuple(action.shape) != (*batch, self.action_dim):
            raise ValueError(f"action must have shape {(*batch, self.action_dim)}, got {tuple(action.shape)}")
        particles, log_weights = self._resampled(belief)
        action = action.to(particles.dtype).unsqueeze(-2)
        parts = []
        for first, num in self._chunks():
            chunk = particles[..., first : first + num, :]
            p = self.transition(chunk, action.expand(*batch, num, self.action_dim))
            parts.append(self._weighed(p, observation))
        return self._posterior(parts, log_weights)

    def filter(self, observations: Tensor, actions: Tensor) -> TensorDict:
        """Beliefs at every step of trajectories, each of one episode.

        Args:
            observations: of shape ``(*B, T, *O)``, ``T`` of at least 1.
            actions: of shape ``(*B, T, A)``, ``u_t`` moving step ``t`` to ``t + 1``: the last one is
                not used.

        Returns:
            A TensorDict of batch size ``(*B, T)`` with ``mean (D)``, ``covariance (D, D)``,
            ``log_evidence`` and ``effective_sample_size``; the particles are not kept.

        Raises:
            ValueError: if a shape does not fit or a particle is not finite.

        Examples:
            >>> import torch
            >>> from torchrl_vjepa import PseudoLikelihood, diag_gaussian
            >>> filter = ParticleFilter(
            ...     lambda z, u: diag_gaussian(z + u, torch.ones(1)),
            ...     PseudoLikelihood(lambda x: diag_gaussian(x, torch.ones_like(x))),
            ...     latent_dim=1,
            ...     action_dim=1,
            ... )
            >>> filter.filter(torch.zeros(5, 10, 1), torch.zeros(5, 10, 1))["covariance"].shape
            torch.Size([5, 10, 1, 1])
        """
        time = observations.ndim - self.observation_ndim - 1
        if time < 0 or not observations.shape[time]:
            raise ValueError(
                "observations must have shape (*B, T, *O) with T of at least 1, got "
                f"{tuple(observations.shape)}"
            )
        batch = observations.shape[: time + 1]
        if tuple(actions.shape) != (*batch, self.action_dim):
            raise ValueError(
                f"actions must have shape {(*batch, self.action_dim)}, got {tuple(actions.shape)}"
            )
        steps = []
        for t, observation in enumerate(observations.unbind(time)):
            if t == 0:
                belief, log_evidence = self.start(observation)
            else:
                belief, log_evidence = self.step(belief, actions[..., t - 1, :], observation)
            steps.append(
                TensorDict(
                    {
                        "mean": belief.mean,
                        "covariance": belief.covariance_matrix,
                        "log_evidence": log_evidence,
                        "effective_sample_size": belief.effective_sample_size,
                    },
                    batch_size=batch[:-1],
                )
            )
        return torch.stack(steps, dim=time)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the belief after this observation, and its mean.

        Args:
            tensordict: holds the observation and, from the second step on, the belief of the step
                before, the action executed since, and where episodes begin.

        Returns:
            The same tensordict with the entries of ``out_keys``.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if a shape does not fit or a particle is not finite.
        """
        observation_key, *memory, init_key = self.in_keys
        observation = tensordict.get(observation_key, None)
        if observation is None:
            raise KeyError(f"ParticleFilter needs the entry {observation_key!r}")
        with torch.no_grad():
            belief, log_evidence = self._advance(tensordict, observation, memory, init_key)
        results = [belief.mean, belief.particles, belief.log_weights]
        if self.return_stats:
            results += [log_evidence, belief.effective_sample_size]
        for key, value in zip(self.out_keys, results, strict=True):
            tensordict.set(key, value)
        return tensordict

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that carries the belief and the executed action from step to step.

        Returns:
            A primer of the entries of ``belief_key``, found by TorchRL's
            ``get_env_transforms_from_module``, which also adds the ``InitTracker``.
        """
        device = next((p.device for p in self.parameters()), None)
        shapes = [(self.num_particles, self.latent_dim), (self.num_particles,), (self.action_dim,)]
        primers = Composite()
        for key, shape in zip(self.in_keys[1:4], shapes, strict=True):
            primers[key] = Unbounded(shape, device=device, dtype=self.dtype)
        action = self.action_key if self.codec is None else self.codec
        return BeliefPrimer(primers, action, self.in_keys[3])

    def _advance(
        self,
        tensordict: TensorDictBase,
        observation: Tensor,
        memory: list[NestedKey],
        init_key: NestedKey,
    ) -> tuple[ParticleBelief, Tensor]:
        if tensordict.get(memory[0], None) is None:
            return self.start(observation)
        missing = [key for key in (*memory, init_key) if tensordict.get(key, None) is None]
        if missing:
            raise KeyError(
                f"ParticleFilter needs the entries {missing} to go on from a belief: append "
                "torchrl.modules.get_env_transforms_from_module(filter) to the environment"
            )
        is_init = tensordict.get(init_key).reshape(self._batch(observation)).bool()
        particles, log_weights, action = (tensordict.get(key) for key in memory)
        if not bool(is_init.any()):
            before = ParticleBelief(particles, log_weights, validate_args=False)
            return self.step(before, action, observation)
        fresh, evidence = self.start(observation[is_init])
        particles, log_weights = particles.clone(), log_weights.clone()
        log_evidence = evidence.new_empty(is_init.shape)
        particles[is_init], log_weights[is_init], log_evidence[is_init] = (
            fresh.particles,
            fresh.log_weights,
            evidence,
        )
        # Only the rows that go on are moved: what a row held that begins anew must not even warn.
        goes_on = ~is_init
        if bool(goes_on.any()):
            before = ParticleBelief(particles[goes_on], log_weights[goes_on], validate_args=False)
            moved, evidence = self.step(before, action[goes_on], observation[goes_on])
            particles[goes_on], log_weights[goes_on], log_evidence[goes_on] = (
                moved.particles,
                moved.log_weights,
                evidence,
            )
        return ParticleBelief(particles, log_weights, validate_args=False), log_evidence

    def _batch(self, observation: Tensor) -> torch.Size:
        if observation.ndim < self.observation_ndim:
            raise ValueError(
                f"observation must have {self.observation_ndim} dimensions after the batch, got shape "
                f"{tuple(observation.shape)}"
            )
        return observation.shape[: observation.ndim - self.observation_ndim]

    def _chunks(self) -> list[tuple[int, int]]:
        """First particle and number of particles of every chunk."""
        size = self.num_particles if self.chunk_size is None else self.chunk_size
        return [(i, min(size, self.num_particles - i)) for i in range(0, self.num_particles, size)]

    def _resampled(self, belief: ParticleBelief) -> tuple[Tensor, Tensor]:
        particles, log_weights = belief.particles, belief.log_weights
        lost = ~log_weights.logsumexp(-1).isfinite()
        if bool(lost.any()):
            warnings.warn(
                f"the weights that {int(lost.sum())} of {lost.numel()} beliefs came with are all zero or "
                "nan: their particles count the same again",
                RuntimeWarning,
                stacklevel=3,
            )
            log_weights = torch.where(lost.unsqueeze(-1), -math.log(self.num_particles), log_weights)
        if self.resample_threshold == 0:
            return particles, log_weights
        num = self.num_particles
        keep = effective_sample_size(log_weights) >= self.resample_threshold * num
        index = resampling_index(log_weights, generator=self.generator)
        rows = keep.unsqueeze(-1)
        index = torch.where(rows, torch.arange(num, device=index.device), index)
        particles = particles.gather(-2, index.unsqueeze(-1).expand(particles.shape))
        return particles, torch.where(rows, log_weights, -math.log(num))

    def _weighed(self, p: Distribution, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Particles from the proposal, and the logarithm of what their weights are multiplied by."""
        observation = observation.unsqueeze(observation.ndim - self.observation_ndim)
        if self.proposal is None:
            particles = sample(p, generator=self.generator).to(self.dtype)
            log_factor = self.likelihood(observation, particles)
        else:
            r = self.proposal(p, observation)
            particles = sample(r, generator=self.generator).to(self.dtype)
            log_factor = p.log_prob(particles) - r.log_prob(particles)
            log_factor = log_factor + self.likelihood(observation, particles)
        expected = (*p.batch_shape, self.latent_dim)
        for name, value, shape in (
            ("proposal" if self.proposal else "model", particles, expected),
            ("likelihood", log_factor, expected[:-1]),
        ):
            if tuple(value.shape) != tuple(shape):
                what = "draws" if name != "likelihood" else "values"
                raise ValueError(f"{name} must give {what} of shape {tuple(shape)}, got {tuple(value.shape)}")
        return particles, log_factor

    def _posterior(
        self, parts: list[tuple[Tensor, Tensor]], log_weights: Tensor
    ) -> tuple[ParticleBelief, Tensor]:
        particles, log_factor = parts[0]
        if len(parts) > 1:
            particles = torch.cat([part[0] for part in parts], dim=-2)
            log_factor = torch.cat([part[1] for part in parts], dim=-1)
        joint = log_weights + log_factor
        log_evidence = joint.logsumexp(-1)
        # One look at one number a row finds nan, infinity and rows without any weight.
        if bool(log_evidence.isfinite().all()):
            return ParticleBelief(particles, joint, validate_args=False), log_evidence
        if not bool(particles.isfinite().all()):
            raise ValueError("model must predict finite latents, got NaN or infinite particles")
        joint = torch.where(joint.isnan() | joint.isposinf(), -math.inf, joint)
        log_evidence = joint.logsumexp(-1)
        dead = log_evidence == -math.inf
        warnings.warn(
            f"the weights of {int(dead.sum())} of {dead.numel()} beliefs are all zero (their observation is "
            "ignored), or a likelihood is nan or inf (it counts as zero): more particles or a proposal "
            "that looks at the observation help where the likelihood is sharp; check the observation",
            RuntimeWarning,
            stacklevel=4,
        )
        joint = torch.where(dead.unsqueeze(-1), log_weights, joint)
        return ParticleBelief(particles, joint, validate_args=False), log_evidence

    def __getstate__(self) -> dict[str, Any]:
        generator = None if self.generator is None else pack_generator(self.generator)
        return {**super().__getstate__(), "generator": generator}

    def __setstate__(self, state: dict[str, Any]) -> None:
        packed = state["generator"]
        generator = None if packed is None else unpack_generator(packed)
        super().__setstate__({**state, "generator": generator})
