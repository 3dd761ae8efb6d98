"""Measured depth: filtering, back-projection, cutting out the body, and depth at tracked points (eqs. 12-17)."""

from torchrecon.depth.backproject import backproject
from torchrecon.depth.bilateral import BilateralParams, bilateral_depth
from torchrecon.depth.range_box import BoxParams, auto_box, depth_cluster, range_box
from torchrecon.depth.sample import SampleParams, sample_depth

__all__ = [
    "BilateralParams",
    "BoxParams",
    "SampleParams",
    "auto_box",
    "backproject",
    "bilateral_depth",
    "depth_cluster",
    "range_box",
    "sample_depth",
]
