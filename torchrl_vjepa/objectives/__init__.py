"""The losses of the paper as TorchRL LossModules."""

from torchrl_vjepa.objectives.balancing import AdaptiveCoefficient
from torchrl_vjepa.objectives.base import CollapseWarning, LatentPredictionLoss
from torchrl_vjepa.objectives.bjepa import BJEPALoss
from torchrl_vjepa.objectives.imagined import ImaginedLoss, RewardLoss, TerminationLoss
from torchrl_vjepa.objectives.jepa import JEPALoss
from torchrl_vjepa.objectives.selection import Selection, select_best
from torchrl_vjepa.objectives.vjepa import VJEPALoss
from torchrl_vjepa.objectives.window_loss import WindowLoss

__all__ = [
    "AdaptiveCoefficient",
    "BJEPALoss",
    "CollapseWarning",
    "ImaginedLoss",
    "JEPALoss",
    "LatentPredictionLoss",
    "RewardLoss",
    "Selection",
    "TerminationLoss",
    "VJEPALoss",
    "WindowLoss",
    "select_best",
]
