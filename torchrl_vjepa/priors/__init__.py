"""Priors: from a task to a density over latents."""

from torchrl_vjepa.priors.base import BoundPrior, LatentDensity, Prior, Task
from torchrl_vjepa.priors.energy import EnergyPrior
from torchrl_vjepa.priors.gaussian import GaussianPrior
from torchrl_vjepa.priors.goal import GoalPrior
from torchrl_vjepa.priors.probed import ProbedPrior
from torchrl_vjepa.priors.product import ProductPrior
from torchrl_vjepa.priors.region import RegionPrior
from torchrl_vjepa.priors.regions import Ball, Box, HalfSpace, Region
from torchrl_vjepa.priors.structure import SlownessPrior, SparsityPrior
from torchrl_vjepa.priors.trajectory import TimeIndexedPrior, trajectory_prior

__all__ = [
    "Ball",
    "BoundPrior",
    "Box",
    "EnergyPrior",
    "GaussianPrior",
    "GoalPrior",
    "HalfSpace",
    "LatentDensity",
    "Prior",
    "ProbedPrior",
    "ProductPrior",
    "Region",
    "RegionPrior",
    "SlownessPrior",
    "SparsityPrior",
    "Task",
    "TimeIndexedPrior",
    "trajectory_prior",
]
