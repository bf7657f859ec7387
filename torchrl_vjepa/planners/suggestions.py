"""Plans that a policy suggests: an actor acts in the imagined environment."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import CompositeDistribution, TensorDictModuleBase, TensorDictSequential
from tensordict.nn.distributions import Delta as _TensorDictDelta
from torch import Tensor, nn
from torch.distributions import Distribution, Independent, TransformedDistribution
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import Delta as _TorchRLDelta

from torchrl_vjepa.actions import ActionCodec
from torchrl_vjepa.common_random_numbers import has_common_noise, sample_common
from torchrl_vjepa.planners.expansion import Expansion, State, entries
from torchrl_vjepa.planners.source import admit_head, example_state
from torchrl_vjepa.state_heads import in_evaluation

__all__ = ["action_distribution", "policy_candidates", "suggested_plans"]


def suggested_plans(
    expansion: Expansion,
    policy: TensorDictModuleBase,
    codec: ActionCodec,
    mean: Tensor,
    num: int,
    generator: torch.Generator | None,
) -> Tensor:
    r"""Plans that a policy follows in the model.

    :math:`u_{t+k} \sim \pi(\cdot \mid \hat Z_{t+k})`, where :math:`\hat Z_{t+k+1}` is the point prediction;
    an environment is stepped. The first takes the policy's deterministic action in every step, as TorchRL's
    ``ExplorationType.DETERMINISTIC`` does; the others are drawn from its distribution. What is drawn is
    common to all rows (:func:`~torchrl_vjepa.common_random_numbers.sample_common`): a row's plans depend
    neither on the other rows nor on their order.

    Args:
        expansion: where the policy acts.
        policy: reads entries of the states and writes the action.
        codec: of the actions.
        mean: stands in where the policy says what is not finite, of shape ``(*B, H, A)``.
        num: plans ``n``.
        generator: source of randomness.

    Returns:
        Codes inside the bounds, of shape ``(*B, n, H, A)``.

    Raises:
        TypeError: if the distribution is one that cannot be drawn with common noise.
        ValueError: if an action has a wrong shape.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.data import Bounded
        >>> from torchrl_vjepa.costs import quadratic_cost
        >>> from torchrl_vjepa.distributions import Delta
        >>> from torchrl_vjepa.envs import LatentEnv
        >>> from torchrl_vjepa.planners.expansion import LatentExpansion
        >>> env = LatentEnv(
        ...     lambda latent, action: Delta(latent + action),
        ...     action_spec=Bounded(-1, 1, (1,)),
        ...     cost=quadratic_cost(torch.ones(1)),
        ...     latent_dim=1,
        ... )
        >>> halve = TensorDictModule(lambda latent: -latent / 2, ["latent"], ["action"])
        >>> walk = LatentExpansion(env, torch.ones(1), 3)
        >>> suggested_plans(walk, halve, env.codec, torch.zeros(3, 1), 1, None).flatten()
        tensor([-0.5000, -0.2500, -0.1250])
    """
    *batch, horizon, size = mean.shape
    fallback = mean.reshape(-1, horizon, size)
    low, high = codec.low.to(mean), codec.high.to(mean)
    # The plans come first: their noise is their own, that of the rows behind them is common.
    state = {key: value.expand(num, *value.shape) for key, value in expansion.root.items()}
    plan: list[Tensor] = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for step in range(horizon):
            code = _acted(policy, codec, state, (num, fallback.shape[0]), generator).to(mean)
            code = codec.mode(torch.where(code.isfinite(), code, fallback[:, step]))
            plan.append(code.clamp(low, high))
            if step + 1 < horizon:
                state = expansion.move(state, plan[-1])
    return torch.stack(plan, dim=-2).reshape(num, *batch, horizon, size).movedim(0, -3)


def _acted(
    policy: TensorDictModuleBase,
    codec: ActionCodec,
    state: State,
    batch: tuple[int, int],
    generator: torch.Generator | None,
) -> Tensor:
    """Codes ``(n, R, A)`` of the policy's actions, the first of them deterministic."""
    num, rows = batch
    read = entries(state)
    p = None
    if num > 1:
        p = action_distribution(policy, TensorDict(dict(read), batch_size=batch))
        if p is None:
            raise TypeError(f"policy must have a distribution to suggest {num} plans, got none")
    point = None if p is None else getattr(p, "deterministic_sample", None)
    if point is None:  # TorchRL's actor knows a substitute
        point = policy(TensorDict({key: value[:1] for key, value in read.items()}, batch_size=(1, rows)))
    code = codec.encode(point.select(*codec.keys) if isinstance(point, TensorDictBase) else point)[:1]
    if p is None:
        return code
    drawn = codec.encode(_drawn(p, codec, batch, generator))
    return torch.cat([code, drawn[1:].to(code.dtype)])


def _drawn(
    p: Distribution, codec: ActionCodec, batch: tuple[int, int], generator: torch.Generator | None
) -> TensorDict:
    """Actions ``(n, R)`` with common noise."""
    parts = dict(p.items()) if isinstance(p, CompositeDistribution) else {codec.keys[0]: p}
    parts = {unravel_key(key): part for key, part in parts.items()}
    missing = [key for key in codec.keys if key not in parts]
    if missing:
        raise KeyError(f"the distribution of policy must hold the actions {missing}, got {list(parts)}")
    drawn = {}
    for key in codec.keys:
        part = parts[key]
        if tuple(part.batch_shape[: len(batch)]) != batch:
            raise ValueError(
                f"the distribution of policy must have a batch shape that begins with {batch}, as what it "
                f"reads, got {_name(part)} of batch shape {tuple(part.batch_shape)}"
            )
        if not has_common_noise(part):
            raise TypeError(
                "policy must have a distribution that can be drawn with noise common to all rows, got "
                f"{_name(part)}; register its rule with common_random_numbers.sample_common, or give "
                "num_policy_candidates=1: its deterministic action alone"
            )
        # Dimensions of the action that are no event are still drawn one by one.
        own = len(part.batch_shape) - len(batch)
        drawn[key] = sample_common(part, generator=generator, own_dims=own)
    return TensorDict(drawn, batch_size=batch)


def action_distribution(policy: TensorDictModuleBase, tensordict: TensorDictBase) -> Distribution | None:
    """The distribution that a policy's action is drawn from.

    Args:
        policy: an actor, or a ``TensorDictSequential`` with one at its end.
        tensordict: what it reads; may be written to.

    Returns:
        The distribution; ``None`` of a policy without one.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import Actor
        >>> front = TensorDictModule(nn.Identity(), ["latent"], ["features"])
        >>> policy = TensorDictSequential(front, Actor(nn.Linear(2, 1), in_keys=["features"]))
        >>> type(action_distribution(policy, TensorDict(latent=torch.zeros(5, 2), batch_size=5))).__name__
        'Delta'
    """
    if hasattr(policy, "get_dist"):
        return policy.get_dist(tensordict)
    if not isinstance(policy, TensorDictSequential):
        return None
    modules: Any = policy.module
    *front, last = modules.values() if isinstance(modules, nn.ModuleDict) else modules
    for module in front:
        tensordict = module(tensordict)
    return action_distribution(last, tensordict)


def policy_candidates(
    source: Any, env: EnvBase, codec: ActionCodec, policy: Any, num: int | None, num_candidates: int
) -> int:
    """How many plans a policy suggests; one that cannot suggest them is refused early.

    It acts once on a small block of states, where specifications tell their shapes.

    Args:
        source: of costs.
        env: what the user gave, for messages.
        codec: of its actions.
        policy: reads entries of states and writes the action.
        num: plans that are asked for; by default a twentieth of all, one of a policy that is deterministic.
        num_candidates: plans of a round, the policy's among them.

    Returns:
        The number ``n``, at least 1.

    Raises:
        TypeError: if the policy is no TensorDictModule, or its distribution has no common noise.
        KeyError: if it reads other entries than those of a state, or does not write the action.
        ValueError: if there is no room for so many, they would all be the same, its action has a wrong
            shape, or what should be deterministic is not.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.envs import PendulumEnv
        >>> from torchrl.modules import Actor
        >>> from torchrl_vjepa.planners import EnvObjective
        >>> source = EnvObjective(PendulumEnv())
        >>> swing = TensorDictSequential(
        ...     TensorDictModule(lambda th: th.unsqueeze(-1), ["th"], ["angle"]),
        ...     Actor(nn.Linear(1, 1), in_keys=["angle"]),
        ... )
        >>> policy_candidates(source, source.env, source.codec, swing, None, 512)
        1
    """
    if not isinstance(policy, TensorDictModuleBase):
        raise TypeError(
            "policy must be a TensorDictModule, for instance a ProbabilisticActor, got "
            f"{type(policy).__name__}"
        )
    admit_head(source, env, "policy", policy, codec.keys)
    is_random = _tried(source, codec, policy, sampled=num is None or num > 1)
    if num is None:
        num = max(1, num_candidates // 20) if is_random else 1
    if not 1 <= num < num_candidates:
        raise ValueError(
            f"num_policy_candidates must be in [1, num_candidates - 1 = {num_candidates - 1}], got {num}"
        )
    if num > 1 and is_random is False:
        raise ValueError(
            f"num_policy_candidates must be 1 for a policy that is deterministic, got {num}: all its plans "
            "are the same; give a ProbabilisticActor"
        )
    return num


def _tried(source: Any, codec: ActionCodec, policy: TensorDictModuleBase, sampled: bool) -> bool | None:
    """Whether a policy's action is random; ``None`` where it could not be tried."""
    batch = (2, 3)
    state = example_state(source, batch)
    if state is None:
        return None
    device = next(iter(state.values())).device
    cuda = [device] if device.type == "cuda" else []
    deterministic = set_exploration_type(ExplorationType.DETERMINISTIC)
    with in_evaluation(policy), deterministic, torch.random.fork_rng(cuda):
        before = torch.get_rng_state()
        codec.encode(policy(TensorDict(state, batch_size=batch)).select(*codec.keys))
        p = action_distribution(policy, TensorDict(state, batch_size=batch))
        if not torch.equal(before, torch.get_rng_state()):
            raise ValueError(
                "policy must have a deterministic action that draws nothing from the global random state, "
                f"got one that does{'' if p is None else f', of {_name(p)}'}; give its distribution a "
                "deterministic_sample"
            )
        if p is None or _is_point(p):
            return False
        if sampled:
            codec.encode(_drawn(p, codec, batch, torch.Generator(device)))
    return True


def _is_point(p: Distribution) -> bool:
    if isinstance(p, CompositeDistribution):
        return all(map(_is_point, p.values()))
    if isinstance(p, (Independent, TransformedDistribution)):
        return _is_point(p.base_dist)
    return isinstance(p, (_TorchRLDelta, _TensorDictDelta))


def _name(p: Distribution) -> str:
    inner = f"({_name(p.base_dist)})" if isinstance(p, Independent) else ""
    return f"{type(p).__name__}{inner}"
