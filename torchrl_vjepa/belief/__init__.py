"""Beliefs over latents: predicted by rollout or by moments, corrected by observations."""

from torchrl_vjepa.belief.composition import composition_gap
from torchrl_vjepa.belief.linear_observation import LinearObservation
from torchrl_vjepa.belief.moments import propagate_moments
from torchrl_vjepa.belief.particle_filter import ParticleFilter
from torchrl_vjepa.belief.particles import (
    ParticleBelief,
    effective_sample_size,
    resampling_index,
    systematic_resampling,
)
from torchrl_vjepa.belief.pseudo_likelihood import PseudoLikelihood
from torchrl_vjepa.belief.rollouts import PreparedTransition, Transition, rollout
from torchrl_vjepa.belief.surprisal import surprise

__all__ = [
    "LinearObservation",
    "ParticleBelief",
    "ParticleFilter",
    "PseudoLikelihood",
    "PreparedTransition",
    "Transition",
    "composition_gap",
    "effective_sample_size",
    "propagate_moments",
    "resampling_index",
    "rollout",
    "surprise",
    "systematic_resampling",
]
