"""Trajectories of candidate plans: where they start, and how the next latent is chosen."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from torchrl_vjepa.belief import ParticleBelief, Transition, resampling_index, rollout
from torchrl_vjepa.common_random_numbers import CommonNoise, common_particle, sample_common
from torchrl_vjepa.fusion import fuse
from torchrl_vjepa.priors import LatentDensity, Prior

__all__ = [
    "PlanPrior",
    "Tasks",
    "check_prior",
    "densities",
    "drawn",
    "first_latents",
    "imagine",
    "imagine_fused",
    "plan_tasks",
    "read_state",
]

Tasks = Mapping[NestedKey, Tensor]


def check_prior(prior: Prior | None, latent_dim: int, device: torch.device) -> None:
    """Refuse a prior over other latents than the model's, or one that lives elsewhere.

    Args:
        prior: the prior, if there is one.
        latent_dim: size of the model's latent.
        device: of the model.

    Raises:
        ValueError: if the sizes differ, or a parameter or buffer of the prior is on another device.

    Examples:
        >>> from torchrl_vjepa import GaussianPrior
        >>> check_prior(GaussianPrior(2), 2, torch.device("cpu"))
    """
    if prior is not None and prior.latent_dim not in (None, latent_dim):
        raise ValueError(
            f"prior must be over latents of size {latent_dim}, got latent_dim={prior.latent_dim}"
        )
    for tensor in () if prior is None else (*prior.parameters(), *prior.buffers()):
        if tensor.device.type != device.type or device.index not in (None, tensor.device.index):
            raise ValueError(
                f"prior must be on the device of the model, {device}, got {tensor.device}; move it with "
                "prior.to(device)"
            )


def densities(prior: Prior, tasks: Tasks | None, time_dim: int) -> Callable[[int], LatentDensity]:
    """The density of a prior at each step of a plan, made once where the task is the same.

    Args:
        prior: the prior.
        tasks: what it reads, with a time dimension of size ``H`` or 1; ``None`` if it reads nothing.
        time_dim: which dimension that is.

    Returns:
        Step ``k`` -> density.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import GoalPrior
        >>> path = {"task": torch.arange(3.0).reshape(1, 3, 1)}  # (*B, H, D)
        >>> densities(GoalPrior(std=1.0), path, time_dim=1)(2).mean
        tensor([[2.]])
    """
    known: dict[tuple[int, ...], LatentDensity] = {}

    def at(k: int) -> LatentDensity:
        steps = {key: min(k, value.shape[time_dim] - 1) for key, value in (tasks or {}).items()}
        index = tuple(steps.values())
        if index not in known:
            chosen = {key: value.select(time_dim, steps[key]) for key, value in (tasks or {}).items()}
            known[index] = prior(None if tasks is None else chosen)
        return known[index]

    return at


class PlanPrior(NamedTuple):
    """What a prior gives along plans, once for all rounds of a planning call.

    Attributes:
        whole: the density of all steps at once, where it is needed.
        at: the density of each step, where it is needed.

    Examples:
        >>> from torchrl_vjepa import GaussianPrior
        >>> PlanPrior.of(GaussianPrior(2), None, 2).at is None
        True
    """

    whole: LatentDensity | None
    at: Callable[[int], LatentDensity] | None

    @classmethod
    def of(
        cls,
        prior: Prior | None,
        tasks: Tasks | None,
        latent_dim: int,
        time_dim: int | None = None,
        *,
        whole: bool = True,
    ) -> PlanPrior:
        """From the prior and its tasks.

        Args:
            prior: the prior, if there is one.
            tasks: what it reads, with a dimension of time; ``None`` if it reads nothing.
            latent_dim: ``D``.
            time_dim: which dimension that is, where each step is asked for.
            whole: whether all steps at once are asked for.

        Returns:
            What is asked for.

        Examples:
            >>> from torchrl_vjepa import GaussianPrior
            >>> PlanPrior.of(GaussianPrior(2), None, 2).whole.event_shape
            torch.Size([2])
        """
        if prior is None:
            return cls(None, None)
        at = None if time_dim is None else densities(prior, tasks, time_dim)
        return cls(prior.density(latent_dim, tasks) if whole else None, at)


def drawn(belief: TensorDictBase, num_samples: int, generator: torch.Generator | None) -> Tensor:
    """Particles of a belief, by one random number for all rows, as all planning noise.

    Args:
        belief: with ``particles (*B, K, D)`` and ``log_weights (*B, K)``.
        num_samples: how many, ``M``.
        generator: source of randomness.

    Returns:
        Of shape ``(M, *B, D)``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> belief = TensorDict(particles=torch.zeros(5, 2), log_weights=torch.zeros(5))
        >>> drawn(belief, 3, None).shape
        torch.Size([3, 2])
    """
    index = resampling_index(
        belief.get("log_weights"), num_samples, shared=True, generator=generator
    ).unsqueeze(-1)
    particles = belief.get("particles")
    return particles.gather(-2, index.expand(*index.shape[:-1], particles.shape[-1])).movedim(-2, 0)


def plan_tasks(prior: Prior, state: Tensor | TensorDictBase, horizon: int) -> Tasks | None:
    """Tasks of every step of a plan.

    Args:
        prior: reads them.
        state: what ``LatentEnv.planning_state`` gives, with batch ``*B``.
        horizon: steps ``H``.

    Returns:
        Of shape ``(*B, 1, H or 1, *task)``, which broadcasts against ``(M, *B, N, H)``; ``None`` where the
        state holds none.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_vjepa import GoalPrior
        >>> state = TensorDict(tasks=TensorDict(task=torch.ones(5, 2), batch_size=[5]), batch_size=[5])
        >>> plan_tasks(GoalPrior(std=1.0), state, 3)["task"].shape
        torch.Size([5, 1, 1, 2])
    """
    if isinstance(state, Tensor):
        return None
    batch_ndim = len(state.batch_size)
    tasks = prior.along(state.get("tasks"), batch_ndim, horizon)
    return {key: task.unsqueeze(batch_ndim) for key, task in tasks.items()}


def read_state(
    tensordict: TensorDictBase, keys: list[NestedKey], task_keys: list[NestedKey], latent_dim: int
) -> Tensor | TensorDictBase:
    """What planning starts from: the entries of a tensordict, checked.

    Args:
        tensordict: holds the entries.
        keys: the latent, or particles and log weights of a belief; then the tasks.
        task_keys: which of them are tasks.
        latent_dim: ``D``.

    Returns:
        See :meth:`~torchrl_vjepa.envs.LatentEnv.planning_state`.

    Raises:
        KeyError: if an entry is missing.
        ValueError: if its last dimension is not ``D``, or a task lacks the batch dimensions.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> td = TensorDict(latent=torch.zeros(5, 2), goal=torch.ones(5, 3), batch_size=[5])
        >>> read_state(td, ["latent", "goal"], ["goal"], 2)["tasks", "goal"].shape
        torch.Size([5, 3])
    """
    own = [key for key in keys if key not in task_keys]
    read = {key: tensordict.get(key, None) for key in keys}
    missing = [key for key, value in read.items() if value is None]
    if missing:
        advice = f"put the {'encoder' if len(own) == 1 else 'particle filter'} in front"
        if missing[0] in task_keys:
            advice = "put the task there, or give the environment prior.bind(task)"
        got = sorted(map(str, tensordict.keys(True, True)))
        raise KeyError(f"planning needs the entries {missing}, got a tensordict with {got}; {advice}")
    start = read[keys[0]]
    if start.shape[-1:] != (latent_dim,):
        lead = "(*B" if len(own) == 1 else "(*B, K"
        raise ValueError(f"{keys[0]!r} must have shape {lead}, {latent_dim}), got {tuple(start.shape)}")
    state = {"latent": start}
    batch = start.shape[:-1]
    if len(own) > 1:
        log_weights = read[keys[1]]
        if log_weights.shape != start.shape[:-1]:
            raise ValueError(
                f"{keys[1]!r} must have shape {tuple(start.shape[:-1])}, one for each "
                f"particle, got {tuple(log_weights.shape)}"
            )
        if not bool(log_weights.logsumexp(-1).isfinite().all()):
            raise ValueError(
                f"{keys[1]!r} must hold some weight in every row, got rows that are all zero or nan"
            )
        state, batch = {"particles": start, "log_weights": log_weights}, batch[:-1]
    elif not task_keys:
        return start
    tasks = {key: read[key] for key in task_keys}
    for key, task in tasks.items():
        if task.shape[: len(batch)] != batch:
            raise ValueError(
                f"{key!r} must have the batch dimensions {tuple(batch)} in front, as the latent has, got "
                f"shape {tuple(task.shape)}; use bind(task) for one that all rows share"
            )
    return TensorDict({**state, "tasks": tasks}, batch_size=batch)


def first_latents(
    state: Tensor | TensorDictBase,
    actions: Tensor,
    latent_dim: int,
    action_dim: int,
    num_samples: int | None,
    generator: torch.Generator | None,
) -> tuple[Tensor, Tensor]:
    """Where every candidate plan starts, and the plans, both with samples in front.

    Args:
        state: latents ``(*B, D)``, or what ``LatentEnv.planning_state`` gives.
        actions: candidate plans, of shape ``(*B, N, H, A)``.
        latent_dim: ``D``.
        action_dim: ``A``.
        num_samples: ``M``; ``None``: no dimension of samples.
        generator: source of randomness, for beliefs.

    Returns:
        First latents ``(*B, N, D)`` and actions ``(*B, N, H, A)``; with ``M`` in front where sampled.

    Raises:
        ValueError: if the shapes do not fit.

    Examples:
        >>> import torch
        >>> start, actions = first_latents(torch.zeros(5, 2), torch.zeros(5, 7, 3, 1), 2, 1, 4, None)
        >>> start.shape, actions.shape
        (torch.Size([4, 5, 7, 2]), torch.Size([4, 5, 7, 3, 1]))
    """
    batch, num_candidates = actions.shape[:-3], actions.shape[-3]
    lead = not isinstance(state, Tensor) and state.get("particles", None) is not None
    if isinstance(state, Tensor):
        start = state
    else:
        start = drawn(state, num_samples or 1, generator) if lead else state.get("latent")
    if start.shape[lead:] != (*batch, latent_dim) or actions.shape[-1] != action_dim:
        raise ValueError(
            f"state and actions must have shapes (*B, {latent_dim}) and (*B, N, H, {action_dim}), got "
            f"{tuple(start.shape[lead:])} and {tuple(actions.shape)}"
        )
    actions = actions.to(start.dtype)
    if num_samples is not None:
        actions = actions.expand(num_samples, *actions.shape)
        start = start if lead else start.expand(num_samples, *start.shape)
    return start.unsqueeze(-2).expand(*start.shape[:-1], num_candidates, latent_dim), actions


def imagine(
    transition: Transition,
    start: Tensor,
    actions: Tensor,
    how: Literal["mean", "mode", "sample"],
    generator: torch.Generator | None,
) -> Tensor:
    r"""Next latents :math:`Z_{t+1}, \dots, Z_{t+H}` of candidate plans.

    Args:
        transition: ``(latent (*B, D), action (*B, A)) -> Distribution``.
        start: of shape ``(*B, N, D)``, or ``(M, *B, N, D)`` for ``how="sample"``.
        actions: of shape ``(*B, N, H, A)``, or with ``M`` in front.
        how: the next latent; samples share their noise across all but the first dimension.
        generator: source of randomness for samples.

    Returns:
        Of the shape of ``actions``, with ``D`` for ``A``.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import Delta
        >>> move = lambda latent, action: Delta(latent + action)
        >>> imagine(move, torch.zeros(1, 1), torch.ones(1, 3, 1), "mean", None).flatten()
        tensor([1., 2., 3.])
    """
    if how == "sample":
        return rollout(CommonNoise(transition, generator), start, actions, "mean")
    return rollout(transition, start, actions, how)


def imagine_fused(
    transition: Transition,
    start: Tensor,
    actions: Tensor,
    prior_at: Callable[[int], LatentDensity],
    generator: torch.Generator | None,
    num_particles: int = 128,
) -> tuple[Tensor, Tensor]:
    r"""Trajectories drawn from the fused transition, and what corrects for it.

    :math:`Z_{t+k+1} \sim p(\cdot \mid Z_{t+k}, u_{t+k}, \eta_{t+k+1})` (``eq:bjepa_filter``). The
    normalisers :math:`c_k = \int p_{\text{like}}(Z \mid Z_{t+k}, u_{t+k})\, p_{\text{prior}}(Z \mid
    \eta_{t+k+1})\, dZ` say how far the prior had to pull: their product has the same mean over
    trajectories as :math:`\prod_k p_{\text{prior}}(Z_{t+k+1})` has over those of :math:`p_{\text{like}}`.

    Args:
        transition: ``(latent (*B, D), action (*B, A)) -> Distribution``.
        start: of shape ``(M, *B, N, D)``.
        actions: of shape ``(M, *B, N, H, A)``.
        prior_at: step ``k`` -> the density of the next latent, batch broadcasting against ``(M, *B, N)``.
        generator: source of randomness; trajectories share their noise across all but the first dimension.
        num_particles: of every fusion that has no closed form; the memory grows with them.

    Returns:
        Next latents ``(M, *B, N, H, D)``, and :math:`\log c_k` of shape ``(M, *B, N, H)``.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> walk = lambda latent, action: diag_gaussian(latent + action, torch.ones(1))
        >>> goal = diag_gaussian(torch.zeros(1), torch.ones(1))
        >>> latents, evidence = imagine_fused(
        ...     walk, torch.zeros(64, 2, 1), torch.zeros(64, 2, 3, 1), lambda k: goal, None
        ... )
        >>> latents.shape, evidence.shape
        (torch.Size([64, 2, 3, 1]), torch.Size([64, 2, 3]))
    """
    latent = start
    latents, evidence = [], []
    for k, action in enumerate(actions.unbind(-2)):
        # Quiet: a plan without evidence has an infinite cost, of which the planner tells.
        fusion = fuse(
            transition(latent, action),
            prior_at(k),
            num_particles=num_particles,
            generator=generator,
            shared_noise=True,
            quiet=True,
        )
        posterior, log_evidence = fusion.posterior, fusion.log_evidence
        if isinstance(posterior, ParticleBelief):
            index = common_particle(posterior, generator=generator).unsqueeze(-1)
            latent = torch.take_along_dim(posterior.particles, index.unsqueeze(-1), -2).squeeze(-2)
            # Which particle is taken cannot move with the plan: its probability does (value zero).
            log_prob = posterior.log_weights.log_softmax(-1).take_along_dim(index, -1).squeeze(-1)
            log_evidence = log_evidence + log_prob - log_prob.detach()
        else:
            latent = sample_common(posterior, generator=generator)
        latents.append(latent)
        evidence.append(log_evidence.expand(latent.shape[:-1]))
    return torch.stack(latents, dim=-2), torch.stack(evidence, dim=-1)
