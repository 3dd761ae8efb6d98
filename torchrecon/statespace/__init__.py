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

__all__ = [
    "abg_alpha",
    "abg_covariance",
    "abg_gains",
    "abg_innovation_variance",
    "abg_predict",
    "abg_tracking_index",
    "abg_update",
]
