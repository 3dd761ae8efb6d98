"""The silhouette of the mover and the motion of the background."""

from torchrecon.contour.global_motion import background_paths, own_motion
from torchrecon.contour.mover import MoverParams, find_mover

__all__ = ["MoverParams", "background_paths", "find_mover", "own_motion"]
