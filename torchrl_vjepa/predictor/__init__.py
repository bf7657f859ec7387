"""Predictive models: the dynamics, and the dynamics fused with a prior."""

from torchrl_vjepa.predictor.fused import FusedPredictor
from torchrl_vjepa.predictor.model import PredictiveModel
from torchrl_vjepa.predictor.predictor import Predictor

__all__ = ["FusedPredictor", "PredictiveModel", "Predictor"]
