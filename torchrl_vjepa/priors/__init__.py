"""Priors: from a task to a density over latents."""

from torchrl_vjepa.priors.base import BoundPrior, LatentDensity, Prior, Task
from torchrl_vjepa.priors.gaussian import GaussianPrior

__all__ = ["BoundPrior", "GaussianPrior", "LatentDensity", "Prior", "Task"]
