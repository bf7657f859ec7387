"""Heads: from the features of a predictor to a distribution over latents.

A head says how many features it wants (``num_features``), how many of its numbers do not depend on
the state (``num_constants``: the predictor keeps one learned row of them for every skip), and turns
both into a :class:`torch.distributions.Distribution` with event shape ``(D,)``.
"""

from torchrl_vjepa.heads.base import Head, soft_clamp
from torchrl_vjepa.heads.ensemble import EnsembleHead
from torchrl_vjepa.heads.flow import FlowHead
from torchrl_vjepa.heads.gaussian import DeltaHead, DiagGaussianHead, FullGaussianHead, LowRankGaussianHead
from torchrl_vjepa.heads.mixture import MixtureHead
from torchrl_vjepa.heads.target_scale import TargetScale

__all__ = [
    "DeltaHead",
    "DiagGaussianHead",
    "EnsembleHead",
    "FlowHead",
    "FullGaussianHead",
    "Head",
    "LowRankGaussianHead",
    "MixtureHead",
    "TargetScale",
    "soft_clamp",
]
