"""SIFT features of frames and the tracks of points through them."""

from torchrecon.features.sift import SiftParams, detect_sift
from torchrecon.features.tracking import TrackerParams, track_points

__all__ = ["SiftParams", "TrackerParams", "detect_sift", "track_points"]
