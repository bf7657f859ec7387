"""An environment whose objective is all that planners know of it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase


class OwnObjective(EnvBase):
    """Tells planners costs, and nothing of how its steps come about."""

    def __init__(self) -> None:
        super().__init__(batch_size=[])
        self.observation_spec = Composite(latent=Unbounded((1,)))
        self.action_spec = Bounded(-1, 1, (2,))
        self.reward_spec = Unbounded((1,))
        self.planning_keys = ["latent"]

    @property
    def batch_locked(self) -> bool:
        return False

    def planning_state(self, td: TensorDict) -> Tensor:
        return td["latent"]

    def objective(self, state: Any, actions: Tensor, *, generator: Any = None) -> Tensor:
        return actions.square().sum(dim=(-1, -2))

    def _step(self, td: TensorDict) -> TensorDict:
        return td

    def _reset(self, td: Any = None, **kwargs: Any) -> TensorDict:
        return TensorDict(latent=torch.zeros(1))

    def _set_seed(self, seed: int | None) -> None:
        pass
