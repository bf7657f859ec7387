"""Any TorchRL environment that accepts any batch size, as an objective of planning."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_vjepa.actions import ActionCodec
from torchrl_vjepa.risk import ChanceConstraint, Risk, Sampling, plan_cost
from torchrl_vjepa.state_heads import Head, check_head, state_value

__all__ = ["EnvObjective"]


class EnvObjective:
    r"""Any TorchRL environment that is not batch-locked as a planning objective.

    The environment is stepped ``H`` times from the input's own state with a batch ``(*B, N)``; the
    cost is minus the sum of rewards, where rewards after the first ``done`` do not count. Only the
    entries that the environment reads are kept, as views: nothing is copied per candidate before
    the first step. A ``done`` in the input is dropped, so the plan never starts from a reset state.

    A stochastic environment can be sampled (``num_samples`` with a ``risk``): every trajectory is a row
    of its batch. Its noise is its own, so it is not common to the candidates. Chance constraints are
    refused: they read latents, which an environment does not have in general.

    Args:
        env: the environment; stochastic ones draw from their own random state.
        reward_key: where the reward is; the environment's by default.
        codec: of its actions, if somebody has one, who then moves it between devices.

    Raises:
        ValueError: if the environment is batch-locked, or has several rewards and none is named.
        TypeError: if its actions have no code (see :class:`~torchrl_vjepa.actions.ActionCodec`).

    Examples:
        >>> import torch
        >>> from torchrl.envs import PendulumEnv
        >>> env = PendulumEnv()
        >>> objective = EnvObjective(env)
        >>> state = objective.planning_state(env.reset())
        >>> objective.objective(state, torch.zeros(5, 3, 1)).shape  # N = 5 plans of H = 3 steps
        torch.Size([5])
    """

    def __init__(
        self, env: EnvBase, *, reward_key: NestedKey | None = None, codec: ActionCodec | None = None
    ) -> None:
        if env.batch_locked:
            raise ValueError(
                "env must accept any batch size to be planned over (batch_locked=False), "
                f"got {type(env).__name__}"
            )
        base = getattr(env, "base_env", env)
        own = getattr(base, "sampling", None)
        if own is not None:
            settings = own()
            if settings.constraints or (settings.num_samples or 1) > 1:
                raise ValueError(
                    f"env must not wrap a {type(base).__name__} with num_samples, risk or constraints, which "
                    "stepping would ignore: plan over the LatentEnv itself, or leave them out"
                )
        if reward_key is None:
            if len(env.reward_keys) != 1:
                raise ValueError(
                    f"reward_key must be one of {env.reward_keys} for an environment with "
                    "several rewards, got None"
                )
            reward_key = env.reward_keys[0]
        self.env = env
        self.reward_key = unravel_key(reward_key)
        self.codec = ActionCodec(env.full_action_spec) if codec is None else codec
        # A LatentEnv's model reads the code of the action, which the environment makes itself.
        code_key = getattr(getattr(base, "world_model", None), "action_key", None)
        own = {code_key, *self.codec.keys, *map(unravel_key, (*env.done_keys, *env.reward_keys))}
        reads = [*env.full_state_spec.keys(True, True)]
        if not reads:
            reads = [*env.observation_spec.keys(True, True)]
        reads += getattr(getattr(env, "world_model", None), "in_keys", [])
        reads += getattr(base, "task_keys", [])  # no specification knows them
        self.in_keys = list(dict.fromkeys(k for k in map(unravel_key, reads) if k not in own))
        done_keys = [k for k in map(unravel_key, env.done_keys) if _path(k)[-1] == "done"]
        depth = min((len(_path(k)) for k in done_keys), default=0)
        # An outer done speaks for the groups below it, as in TorchRL's planners.
        self.done_keys = [k for k in done_keys if len(_path(k)) == depth]

    @property
    def head_keys(self) -> list[NestedKey]:
        """What values and policies may read: the state, and what the environment observes."""
        observed = map(unravel_key, self.env.observation_spec.keys(True, True))
        return list(dict.fromkeys([*self.in_keys, *observed]))

    def keep(self, keys: Sequence[NestedKey]) -> list[NestedKey]:
        """Also carry these entries from step to step, because a value or a policy reads them.

        Args:
            keys: some of :attr:`head_keys`.

        Returns:
            Those that were not carried before; they are :attr:`in_keys` now.
        """
        new = [key for key in map(unravel_key, keys) if key not in self.in_keys]
        self.in_keys = [*self.in_keys, *new]
        return new

    def planning_state(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The entries that the environment reads; no ``done``, no reward, nothing else.

        Args:
            tensordict: holds the state of the environment.

        Returns:
            A tensordict of the same batch size, sharing memory with the input.

        Raises:
            KeyError: if an entry is missing.
        """
        missing = [key for key in self.in_keys if tensordict.get(key, None) is None]
        if missing:
            raise KeyError(
                f"planning over {type(self.env).__name__} needs the entries {self.in_keys}, missing {missing}"
            )
        return tensordict.select(*self.in_keys)

    def sampling(
        self,
        num_samples: int | None = None,
        risk: Risk | None = None,
        constraints: Sequence[ChanceConstraint] | None = None,
        fusion: str | None = None,
        terminal_value: Head | None = None,
    ) -> Sampling:
        """How plans are evaluated where this is asked for.

        Args:
            num_samples: trajectories per plan; ``None``: one, whose cost is taken as it is.
            risk: of their costs; ``None``: the expectation.
            constraints: none is supported.
            fusion: none is supported.
            terminal_value: ``None``: nothing is behind the horizon.

        Returns:
            The settings together.

        Raises:
            ValueError: if ``num_samples`` is not positive, or a risk has no samples to read.
            TypeError: if ``risk`` is not callable, constraints or a fusion are given, or
                ``terminal_value`` is no TensorDictModule.
            KeyError: if ``terminal_value`` reads something else than :attr:`head_keys`.
        """
        if fusion is not None:
            raise TypeError(
                f"fusion needs an environment with a prior, as LatentEnv, got {type(self.env).__name__}"
            )
        if constraints:
            raise TypeError(
                "constraints need an environment with latents, as LatentEnv, got "
                f"{type(self.env).__name__}; put the violation into its reward, or use a LatentEnv"
            )
        if terminal_value is not None:
            name, readable, env = "terminal_value", self.head_keys, type(self.env).__name__
            check_head(name, terminal_value, readable, env=env, has_latent=False, writes=["state_value"])
        return Sampling.checked(num_samples, risk, ())._replace(terminal_value=terminal_value)

    def objective(
        self,
        state: TensorDictBase,
        actions: Tensor,
        *,
        generator: torch.Generator | None = None,
        num_samples: int | None = None,
        risk: Risk | None = None,
        constraints: Sequence[ChanceConstraint] | None = None,
        terminal_value: Head | None = None,
    ) -> Tensor:
        """Minus the summed reward of candidate plans, and minus the value of where they get.

        Args:
            state: what :meth:`planning_state` returned, with batch size ``*B``.
            actions: candidate plans, in code, of shape ``(*B, N, H, A)``.
            generator: not used: the environment draws from its own random state.
            num_samples: trajectories per plan; ``None``: one, whose cost is taken as it is.
            risk: of their costs; ``None``: the expectation.
            constraints: none is supported.
            terminal_value: a TensorDictModule that reads entries of :attr:`in_keys` and writes
                ``state_value`` of shape ``(*B, 1)``; counts where a plan is not done at its end.

        Returns:
            Costs of shape ``(*B, N)``.

        Raises:
            ValueError: if ``num_samples`` is not positive, or a risk has no samples to read.
            TypeError: if ``risk`` is not callable, or constraints are given.
        """
        settings = self.sampling(num_samples, risk, constraints, terminal_value=terminal_value)
        num_samples, risk = settings.num_samples, settings.risk
        state = state.unsqueeze(-1).expand(actions.shape[:-2])
        if num_samples is None:
            return self._stepped(state, actions, terminal_value)
        state = state.expand(num_samples, *state.batch_size)
        actions = actions.expand(num_samples, *actions.shape)
        return plan_cost(self._stepped(state, actions, terminal_value), risk)

    def stepped(self, state: TensorDictBase, action: Tensor) -> TensorDictBase:
        """One step of the environment.

        Args:
            state: what it reads, with batch size ``*B``; stays as it is.
            action: in code, of shape ``(*B, A)``.

        Returns:
            What comes next: state, reward and done.
        """
        state = state.copy()
        for key, leaf in zip(self.codec.keys, self.codec.executed(action), strict=True):
            state.set(key, leaf)
        return self.env.step(state).get("next")

    def _stepped(self, state: TensorDictBase, actions: Tensor, head: Head | None) -> Tensor:
        """Minus the summed reward, and the value, of one plan per row: ``(*B)`` of ``(*B, H, A)``."""
        batch = actions.shape[:-2]
        current = state
        cost = actions.new_zeros(batch)
        alive = torch.ones(batch, dtype=torch.bool, device=actions.device)
        for action in actions.unbind(-2):
            following = self.stepped(current, action)
            reward = following.get(self.reward_key).reshape(*batch, -1).sum(dim=-1)
            cost = cost - torch.where(alive, reward, 0.0)
            for key in self.done_keys:
                alive = alive & ~following.get(key).reshape(*batch, -1).any(dim=-1)
            current = current.select(*self.in_keys).update(following.select(*self.in_keys, strict=False))
        if head is None:
            return cost
        reached = {key: current.get(key) for key in self.in_keys}
        value = state_value(head, reached, batch, None, needs_gradient=actions.requires_grad)
        return cost - torch.where(alive, value, 0.0).to(cost.dtype)


def _path(key: NestedKey) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else tuple(key)
