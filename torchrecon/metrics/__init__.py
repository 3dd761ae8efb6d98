"""Figures of merit; every one declares its alignment, unit and whether a reflection is allowed."""

from torchrecon.metrics.actions import action_error
from torchrecon.metrics.images import mse, psnr, ssim
from torchrecon.metrics.keypoints import pck3d, pckh
from torchrecon.metrics.points import (
    centre_visible,
    error3d_akhter,
    error3d_camera,
    error3d_camera_frameflip,
    mpjpe,
    nrmse,
    pa_mpjpe,
    procrustes_disparity,
    similarity_align,
)
from torchrecon.metrics.reprojection import matching_degree, place_in_view

__all__ = [
    "action_error",
    "centre_visible",
    "error3d_akhter",
    "error3d_camera",
    "error3d_camera_frameflip",
    "matching_degree",
    "mpjpe",
    "mse",
    "nrmse",
    "pa_mpjpe",
    "pck3d",
    "pckh",
    "place_in_view",
    "procrustes_disparity",
    "psnr",
    "similarity_align",
    "ssim",
]
