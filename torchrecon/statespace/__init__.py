"""Motion models of one coordinate over time: alpha-beta-gamma (causal) and constant-acceleration smoothing."""

from torchrecon.statespace.abg import (
    abg_alpha,
    abg_covariance,
    abg_gains,
    abg_innovation_variance,
    abg_predict,
    abg_tracking_index,
    abg_update,
)
from torchrecon.statespace.rts import Smoothed, best_tracking_index, rts_smooth

__all__ = [
    "Smoothed",
    "abg_alpha",
    "abg_covariance",
    "abg_gains",
    "abg_innovation_variance",
    "abg_predict",
    "abg_tracking_index",
    "abg_update",
    "best_tracking_index",
    "rts_smooth",
]
