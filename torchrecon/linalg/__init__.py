"""Small linear algebra on tensors: rotations and alignment, low-rank fits with missing entries."""

from torchrecon.linalg.interpolation import interpolated
from torchrecon.linalg.rotations import (
    nearest_orthogonal,
    nearest_rotation,
    rotation_angle,
    rotation_from_rows,
    rotation_from_vector,
    skew,
)

__all__ = [
    "interpolated",
    "nearest_orthogonal",
    "nearest_rotation",
    "rotation_angle",
    "rotation_from_rows",
    "rotation_from_vector",
    "skew",
]
