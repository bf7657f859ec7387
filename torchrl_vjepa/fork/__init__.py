"""The fork: a wall that the vehicle passes on the left or on the right, and its exact oracle.

Importing this package registers ``torchrl_vjepa/Fork-v0`` with Gymnasium.
"""

from __future__ import annotations

import gymnasium

from torchrl_vjepa.fork.env import BatchedForkEnv, ForkEnv
from torchrl_vjepa.fork.system import ForkSystem

__all__ = ["BatchedForkEnv", "ForkEnv", "ForkSystem"]

# A second import (importlib.reload, a spawned worker) must not override with a warning.
if "torchrl_vjepa/Fork-v0" not in gymnasium.registry:
    gymnasium.register(id="torchrl_vjepa/Fork-v0", entry_point="torchrl_vjepa.fork.env:ForkEnv")
