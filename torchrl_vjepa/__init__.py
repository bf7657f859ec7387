"""Probabilistic joint-embedding world models, their losses, environments and planners, for TorchRL."""

from torchrl_vjepa.baselines import VAE, PixelAR, PixelARLoss, PixelDecoder, VAELoss
from torchrl_vjepa.belief import rollout
from torchrl_vjepa.costs import Cost, QuadraticReward, action_cost, expectation, quadratic_cost
from torchrl_vjepa.diagnostics import LinearProbe, linear_probe, mutual_information_bound
from torchrl_vjepa.distributions import Delta, diag_gaussian, point_estimate, product_of_experts, sample
from torchrl_vjepa.encoders import history_encoder, linear_encoder, mlp_encoder
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.fork import BatchedForkEnv, ForkEnv, ForkSystem
from torchrl_vjepa.heads import DeltaHead, DiagGaussianHead, Head, TargetScale
from torchrl_vjepa.models import BJEPA, JEPA, VJEPA, LatentModel
from torchrl_vjepa.noisy_tv import (
    BatchedNoisyTVEnv,
    KalmanFilter,
    LinearGaussianSystem,
    LQGController,
    NoisyTVEnv,
)
from torchrl_vjepa.objectives import (
    BJEPALoss,
    CollapseWarning,
    JEPALoss,
    LatentPredictionLoss,
    RewardLoss,
    VJEPALoss,
    WindowLoss,
)
from torchrl_vjepa.planners import CEM, MPPI, EnvObjective, Planner, Proposal, RandomShooting
from torchrl_vjepa.predictor import FusedPredictor, Predictor
from torchrl_vjepa.priors import GaussianPrior
from torchrl_vjepa.statistics import effective_rank, gaussian_entropy, sliced_gaussian_distance
from torchrl_vjepa.whitening import Whitening

__all__ = [
    "BJEPA",
    "BJEPALoss",
    "BatchedForkEnv",
    "BatchedNoisyTVEnv",
    "CEM",
    "CollapseWarning",
    "Cost",
    "Delta",
    "DeltaHead",
    "DiagGaussianHead",
    "EnvObjective",
    "ForkEnv",
    "ForkSystem",
    "FusedPredictor",
    "GaussianPrior",
    "Head",
    "JEPA",
    "JEPALoss",
    "KalmanFilter",
    "LQGController",
    "LatentEnv",
    "LatentModel",
    "LatentPredictionLoss",
    "LinearGaussianSystem",
    "LinearProbe",
    "MPPI",
    "NoisyTVEnv",
    "PixelAR",
    "PixelARLoss",
    "PixelDecoder",
    "Planner",
    "Predictor",
    "Proposal",
    "QuadraticReward",
    "RandomShooting",
    "RewardLoss",
    "TargetScale",
    "VAE",
    "VAELoss",
    "VJEPA",
    "VJEPALoss",
    "Whitening",
    "WindowLoss",
    "action_cost",
    "diag_gaussian",
    "effective_rank",
    "expectation",
    "gaussian_entropy",
    "history_encoder",
    "linear_encoder",
    "linear_probe",
    "mlp_encoder",
    "mutual_information_bound",
    "point_estimate",
    "product_of_experts",
    "quadratic_cost",
    "rollout",
    "sample",
    "sliced_gaussian_distance",
]
