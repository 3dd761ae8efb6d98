"""Motion models over time: alpha-beta-gamma (causal), constant-acceleration smoothing, and a given linear model."""

from torchrecon.statespace.abg import (
    abg_alpha,
    abg_covariance,
    abg_gains,
    abg_innovation_variance,
    abg_predict,
    abg_tracking_index,
    abg_update,
)
from torchrecon.statespace.linear_gaussian import LinearModel, SmoothedStates, smooth_states
from torchrecon.statespace.rts import Smoothed, best_tracking_index, rts_smooth

__all__ = [
    "LinearModel",
    "Smoothed",
    "SmoothedStates",
    "abg_alpha",
    "abg_covariance",
    "abg_gains",
    "abg_innovation_variance",
    "abg_predict",
    "abg_tracking_index",
    "abg_update",
    "best_tracking_index",
    "rts_smooth",
    "smooth_states",
]
