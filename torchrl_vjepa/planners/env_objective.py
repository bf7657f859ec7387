"""Any TorchRL environment that accepts any batch size, as an objective of planning."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.envs import EnvBase

__all__ = ["EnvObjective"]


class EnvObjective:
    r"""Any TorchRL environment that is not batch-locked as a planning objective.

    The environment is stepped ``H`` times from the input's own state with a batch ``(*B, N)``; the
    cost is minus the sum of rewards, where rewards after the first ``done`` do not count. Only the
    entries that the environment reads are kept, as views: nothing is copied per candidate before
    the first step. A ``done`` in the input is dropped, so the plan never starts from a reset state.

    Args:
        env: the environment; stochastic ones draw from their own random state.
        reward_key: where the reward is; the environment's by default.

    Raises:
        ValueError: if the environment is batch-locked, or has several rewards and none is named.
        TypeError: if its action is no single tensor.

    Examples:
        >>> import torch
        >>> from torchrl.envs import PendulumEnv
        >>> env = PendulumEnv()
        >>> objective = EnvObjective(env)
        >>> state = objective.planning_state(env.reset())
        >>> objective.objective(state, torch.zeros(5, 3, 1)).shape  # N = 5 plans of H = 3 steps
        torch.Size([5])
    """

    def __init__(self, env: EnvBase, *, reward_key: NestedKey | None = None) -> None:
        if env.batch_locked:
            raise ValueError(
                "env must accept any batch size to be planned over (batch_locked=False), "
                f"got {type(env).__name__}"
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
        self.action_key = unravel_key(env.action_key)
        leaves = [*env.full_action_spec.keys(True, True)]
        if len(leaves) != 1:
            raise TypeError(f"the action of env must be one tensor, got the keys {leaves}")
        self.action_shape = env.full_action_spec[leaves[0]].shape
        own = {self.action_key, *map(unravel_key, (*env.done_keys, *env.reward_keys))}
        reads = [*env.full_state_spec.keys(True, True)]
        if not reads:
            reads = [*env.observation_spec.keys(True, True)]
        reads += getattr(getattr(env, "world_model", None), "in_keys", [])
        self.in_keys = list(dict.fromkeys(k for k in map(unravel_key, reads) if k not in own))
        done_keys = [k for k in map(unravel_key, env.done_keys) if _path(k)[-1] == "done"]
        depth = min((len(_path(k)) for k in done_keys), default=0)
        # An outer done speaks for the groups below it, as in TorchRL's planners.
        self.done_keys = [k for k in done_keys if len(_path(k)) == depth]

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

    def objective(
        self, state: TensorDictBase, actions: Tensor, *, generator: torch.Generator | None = None
    ) -> Tensor:
        """Minus the summed reward of candidate plans.

        Args:
            state: what :meth:`planning_state` returned, with batch size ``*B``.
            actions: candidate plans, of shape ``(*B, N, H, A)``.
            generator: not used: the environment draws from its own random state.

        Returns:
            Costs of shape ``(*B, N)``.
        """
        batch = actions.shape[:-2]
        current = state.unsqueeze(-1).expand(batch)
        cost = actions.new_zeros(batch)
        alive = torch.ones(batch, dtype=torch.bool, device=actions.device)
        for action in actions.unbind(-2):
            shaped = action.reshape((*batch, *self.action_shape))
            current = current.copy().set(self.action_key, shaped)
            following = self.env.step(current).get("next")
            reward = following.get(self.reward_key).reshape(*batch, -1).sum(dim=-1)
            cost = cost - torch.where(alive, reward, 0.0)
            for key in self.done_keys:
                alive = alive & ~following.get(key).reshape(*batch, -1).any(dim=-1)
            current = current.select(*self.in_keys).update(following.select(*self.in_keys, strict=False))
        return cost


def _path(key: NestedKey) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else tuple(key)
