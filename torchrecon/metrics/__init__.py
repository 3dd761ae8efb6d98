"""Figures of merit; every one declares its alignment, unit and whether a reflection is allowed."""

from torchrecon.metrics.actions import action_error
from torchrecon.metrics.points import (
    centre_visible,
    error3d_akhter,
    error3d_camera,
    error3d_camera_frameflip,
    mpjpe,
    nrmse,
    pa_mpjpe,
    procrustes_disparity,
)

__all__ = [
    "action_error",
    "centre_visible",
    "error3d_akhter",
    "error3d_camera",
    "error3d_camera_frameflip",
    "mpjpe",
    "nrmse",
    "pa_mpjpe",
    "procrustes_disparity",
]
