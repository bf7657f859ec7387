"""Hard fusion of a prediction with a prior: posterior, latent MAP, samples, and its use as a filter."""

from torchrl_vjepa.fusion.estimates import map_estimate, sample_posterior
from torchrl_vjepa.fusion.posterior import FusedBelief, Fusion, fuse, known_product
from torchrl_vjepa.fusion.virtual_observation import VirtualObservation

__all__ = [
    "FusedBelief",
    "Fusion",
    "VirtualObservation",
    "fuse",
    "known_product",
    "map_estimate",
    "sample_posterior",
]
