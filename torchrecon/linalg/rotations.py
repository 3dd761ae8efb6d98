"""Rotations: exponential map and nearest orthogonal matrices."""

from __future__ import annotations

import torch

from torchrecon._typing import Float, Tensor

__all__ = [
    "nearest_orthogonal",
    "nearest_rotation",
    "rotation_angle",
    "rotation_from_rows",
    "rotation_from_vector",
    "skew",
]


def skew(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """The matrix of the cross product: ``skew(a) @ b = a x b``."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def rotation_from_vector(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation by ``|vector|`` radians about ``vector`` (Rodrigues); smooth at zero.

    Example:
        >>> import torch
        >>> quarter = rotation_from_vector(torch.tensor([0.0, 0.0, torch.pi / 2]))
        >>> (quarter @ torch.tensor([1.0, 0.0, 0.0])).round().abs().tolist()
        [0.0, 1.0, 0.0]
    """
    square = vector.square().sum(-1)[..., None, None]
    small = square < 1e-8
    safe = torch.where(small, torch.ones_like(square), square)
    angle = safe.sqrt()
    first = torch.where(small, 1 - square / 6, angle.sin() / angle)
    second = torch.where(small, 0.5 - square / 24, (1 - angle.cos()) / safe)
    cross = skew(vector)
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return eye + first * cross + second * (cross @ cross)


def nearest_orthogonal(matrix: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3"]:
    """Polar factor: the closest orthogonal matrix, reflections included."""
    u, _, vh = torch.linalg.svd(matrix)
    return u @ vh


def nearest_rotation(matrix: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3"]:
    """The closest rotation (determinant +1): special Procrustes.

    Example:
        >>> import torch
        >>> float(torch.linalg.det(nearest_rotation(-torch.eye(3)))) > 0
        True
    """
    u, _, vh = torch.linalg.svd(matrix)
    sign = torch.where(torch.linalg.det(u @ vh) < 0, -1.0, 1.0).to(matrix.dtype)
    ones = torch.ones_like(sign)
    return (u * torch.stack([ones, ones, sign], -1)[..., None, :]) @ vh


def rotation_from_rows(rows: Float[Tensor, "*b 2 3"]) -> Float[Tensor, "*b 3 3"]:
    """The rotation whose first two rows are closest to ``rows`` (polar factor, third row by the cross product).

    Example:
        >>> import torch
        >>> rotation_from_rows(torch.tensor([[2.0, 0, 0], [0, 2.0, 0]])).tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    u, _, vh = torch.linalg.svd(rows, full_matrices=False)
    first = u @ vh
    return torch.cat([first, torch.linalg.cross(first[..., 0, :], first[..., 1, :])[..., None, :]], -2)


def rotation_angle(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Angle of a rotation in radians, 0 to pi; accurate near 0 too.

    Example:
        >>> import torch
        >>> round(float(rotation_angle(rotation_from_vector(torch.tensor([0.3, 0.0, 0.0])))), 6)
        0.3
    """
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    antisymmetric = rotation - rotation.mT
    sine = antisymmetric.square().sum((-1, -2)).sqrt() / 8**0.5
    return torch.atan2(sine, (trace - 1) / 2)
