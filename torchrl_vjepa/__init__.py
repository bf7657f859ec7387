"""Probabilistic joint-embedding world models, their losses, environments and planners, for TorchRL."""

from torchrl_vjepa.baselines import VAE, PixelAR, PixelARLoss, PixelDecoder, VAELoss
from torchrl_vjepa.belief import (
    LinearObservation,
    ParticleBelief,
    ParticleFilter,
    PseudoLikelihood,
    composition_gap,
    effective_sample_size,
    propagate_moments,
    rollout,
    surprise,
    systematic_resampling,
)
from torchrl_vjepa.costs import Cost, QuadraticReward, action_cost, quadratic_cost
from torchrl_vjepa.diagnostics import LinearProbe, linear_probe, mutual_information_bound
from torchrl_vjepa.distributions import Delta, diag_gaussian, point_estimate, product_of_experts, sample
from torchrl_vjepa.encoders import history_encoder, linear_encoder, mlp_encoder
from torchrl_vjepa.envs import LatentEnv
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
    AdaptiveCoefficient,
    BJEPALoss,
    CollapseWarning,
    JEPALoss,
    LatentPredictionLoss,
    RewardLoss,
    Selection,
    VJEPALoss,
    WindowLoss,
    select_best,
)
from torchrl_vjepa.planners import CEM, MPPI, EnvObjective, Planner, Proposal, RandomShooting
from torchrl_vjepa.predictor import FusedPredictor, Predictor
from torchrl_vjepa.priors import GaussianPrior
from torchrl_vjepa.risk import ChanceConstraint, cvar, entropic, expectation, mean_variance, worst_case
from torchrl_vjepa.statistics import effective_rank, gaussian_entropy, sliced_gaussian_distance
from torchrl_vjepa.whitening import Whitening

__all__ = [
    "AdaptiveCoefficient",
    "BJEPA",
    "BJEPALoss",
    "BatchedNoisyTVEnv",
    "CEM",
    "ChanceConstraint",
    "CollapseWarning",
    "Cost",
    "Delta",
    "DeltaHead",
    "DiagGaussianHead",
    "EnvObjective",
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
    "LinearObservation",
    "LinearProbe",
    "MPPI",
    "NoisyTVEnv",
    "ParticleBelief",
    "ParticleFilter",
    "PixelAR",
    "PixelARLoss",
    "PixelDecoder",
    "Planner",
    "Predictor",
    "Proposal",
    "PseudoLikelihood",
    "QuadraticReward",
    "RandomShooting",
    "RewardLoss",
    "Selection",
    "TargetScale",
    "VAE",
    "VAELoss",
    "VJEPA",
    "VJEPALoss",
    "Whitening",
    "WindowLoss",
    "action_cost",
    "composition_gap",
    "cvar",
    "diag_gaussian",
    "effective_rank",
    "effective_sample_size",
    "entropic",
    "expectation",
    "gaussian_entropy",
    "history_encoder",
    "linear_encoder",
    "linear_probe",
    "mean_variance",
    "mlp_encoder",
    "mutual_information_bound",
    "point_estimate",
    "product_of_experts",
    "propagate_moments",
    "quadratic_cost",
    "rollout",
    "sample",
    "select_best",
    "sliced_gaussian_distance",
    "surprise",
    "systematic_resampling",
    "worst_case",
]
