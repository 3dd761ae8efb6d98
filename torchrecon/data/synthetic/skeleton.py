"""The 21-joint skeleton of the synthetic body and the rotations that turn it.

Body axes: x to the body's left, y up, z forward. In the rest pose the body stands with hanging arms and every bone
frame is the identity; joint j sits at ``position[parent] + frame[j] @ offset[j]``, so bones cannot change length.
"""

from __future__ import annotations

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.models.joints import JOINTS, MIRROR, PARENTS

__all__ = ["JOINTS", "MIRROR", "PARENTS", "forward_kinematics", "joint", "rotation_x", "rotation_y", "rotation_z"]


def joint(name: str) -> int:
    """Index of a joint by name.

    Example:
        >>> joint("r_wrist")
        11
    """
    return JOINTS.index(name)


def _rotation(angle: Tensor, first: int, second: int) -> Tensor:
    matrix = torch.eye(3, dtype=angle.dtype, device=angle.device).expand(*angle.shape, 3, 3).clone()
    matrix[..., first, first] = matrix[..., second, second] = angle.cos()
    matrix[..., second, first] = angle.sin()
    matrix[..., first, second] = -angle.sin()
    return matrix


def rotation_x(angle: Float[Tensor, "*b"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation about x (radians): a positive angle tips up towards forward (bowing)."""
    return _rotation(angle, 1, 2)


def rotation_y(angle: Float[Tensor, "*b"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation about y (radians): a positive angle turns forward to the left."""
    return _rotation(angle, 2, 0)


def rotation_z(angle: Float[Tensor, "*b"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation about z (radians): a positive angle leans up to the right."""
    return _rotation(angle, 0, 1)


def forward_kinematics(
    root: Float[Tensor, "frames 3"], frames: Float[Tensor, "frames joints 3 3"], offsets: Float[Tensor, "joints 3"]
) -> Float[Tensor, "frames joints 3"]:
    """Joint positions (metres) from the pelvis position, the bone frames and the constant offsets."""
    position = [root]
    for index in range(1, len(PARENTS)):
        step = torch.einsum("fij,j->fi", frames[:, index], offsets[index])
        position.append(position[PARENTS[index]] + step)
    return torch.stack(position, 1)
