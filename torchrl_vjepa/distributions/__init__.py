"""What ``torch.distributions`` lacks for latent world models.

A predictive model returns a :class:`torch.distributions.Distribution` with batch shape ``*B`` and
event shape ``(D,)``; the functions here read it in the ways the paper names (mean, mode, sample,
moments, divergences), and the classes are the predictive distributions that torch has not.
"""

from torchrl_vjepa.distributions.delta import Delta
from torchrl_vjepa.distributions.densities import Density, GaussianFactor
from torchrl_vjepa.distributions.divergences import (
    Estimate,
    entropy_bounds,
    kl_divergence,
    monte_carlo_entropy,
    monte_carlo_kl,
)
from torchrl_vjepa.distributions.flows import Coupling, CouplingFlow
from torchrl_vjepa.distributions.gaussians import (
    LowRankGaussian,
    diag_gaussian,
    full_gaussian,
    soft_clamp,
)
from torchrl_vjepa.distributions.langevin import langevin
from torchrl_vjepa.distributions.mixtures import Ensemble, Mixture, log_score
from torchrl_vjepa.distributions.modes import maximize_log_prob
from torchrl_vjepa.distributions.moments import moments
from torchrl_vjepa.distributions.noise import NoiseDistribution
from torchrl_vjepa.distributions.points import point_estimate
from torchrl_vjepa.distributions.products import product_of_experts
from torchrl_vjepa.distributions.sampling import from_noise, noise_dim, sample

__all__ = [
    "Coupling",
    "CouplingFlow",
    "Delta",
    "Density",
    "Ensemble",
    "Estimate",
    "GaussianFactor",
    "LowRankGaussian",
    "Mixture",
    "NoiseDistribution",
    "diag_gaussian",
    "entropy_bounds",
    "from_noise",
    "full_gaussian",
    "kl_divergence",
    "langevin",
    "log_score",
    "maximize_log_prob",
    "moments",
    "monte_carlo_entropy",
    "monte_carlo_kl",
    "noise_dim",
    "point_estimate",
    "product_of_experts",
    "sample",
    "soft_clamp",
]
