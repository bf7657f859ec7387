"""The noisy TV: linear-Gaussian data, control environments on it, and their exact oracle.

Importing this package registers ``torchrl_vjepa/NoisyTV-v0`` with Gymnasium.
"""

from __future__ import annotations

import gymnasium

from torchrl_vjepa.noisy_tv.env import BatchedNoisyTVEnv, NoisyTVEnv
from torchrl_vjepa.noisy_tv.oracle import KalmanFilter, LQGController, LQRSolution, solve_lqr
from torchrl_vjepa.noisy_tv.system import LinearGaussianSystem

__all__ = [
    "BatchedNoisyTVEnv",
    "KalmanFilter",
    "LQGController",
    "LQRSolution",
    "LinearGaussianSystem",
    "NoisyTVEnv",
    "solve_lqr",
]

# A second import (importlib.reload, a spawned worker) must not override with a warning.
if "torchrl_vjepa/NoisyTV-v0" not in gymnasium.registry:
    gymnasium.register(id="torchrl_vjepa/NoisyTV-v0", entry_point="torchrl_vjepa.noisy_tv.env:NoisyTVEnv")
