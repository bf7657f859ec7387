"""What a model has learned: linear probe, information, effective rank, calibration of its beliefs."""

from torchrl_vjepa.diagnostics.calibration import (
    Calibration,
    calibration_by_horizon,
    calibration_by_skip,
    recalibrate,
)
from torchrl_vjepa.diagnostics.information import mutual_information_bound
from torchrl_vjepa.diagnostics.intervals import (
    CredibleInterval,
    PITHistogram,
    ReliabilityCurve,
    coverage,
    credible_interval,
    pit_histogram,
    probability_integral_transform,
    reliability_curve,
)
from torchrl_vjepa.diagnostics.probe import LinearProbe, linear_probe
from torchrl_vjepa.diagnostics.scores import crps, energy_score
from torchrl_vjepa.statistics import effective_rank

__all__ = [
    "Calibration",
    "CredibleInterval",
    "PITHistogram",
    "LinearProbe",
    "ReliabilityCurve",
    "calibration_by_horizon",
    "calibration_by_skip",
    "coverage",
    "credible_interval",
    "crps",
    "effective_rank",
    "energy_score",
    "linear_probe",
    "mutual_information_bound",
    "pit_histogram",
    "probability_integral_transform",
    "recalibrate",
    "reliability_curve",
]
