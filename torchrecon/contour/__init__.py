"""The silhouette of the mover, its outline, and the motion of the background."""

from torchrecon.contour.global_motion import background_paths, own_motion
from torchrecon.contour.mover import MoverParams, find_mover
from torchrecon.contour.outline import align_start, fill_outline, mask_outline, normalise_outline

__all__ = [
    "MoverParams",
    "align_start",
    "background_paths",
    "fill_outline",
    "find_mover",
    "mask_outline",
    "normalise_outline",
    "own_motion",
]
