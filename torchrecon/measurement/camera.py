"""Pinhole geometry of the tracks: projection, its inverse, and normalised image coordinates."""

from __future__ import annotations

import torch

from torchrecon._typing import Float, Tensor

__all__ = ["backproject_points", "normalised_coordinates", "project_points"]


def project_points(points3d: Float[Tensor, "*b 3"], intrinsics: Float[Tensor, "*k 3 3"]) -> Float[Tensor, "*b 2"]:
    """Pinhole projection of camera-frame points (metres) to pixels; ``intrinsics`` broadcasts over ``*b``.

    Example:
        >>> import torch
        >>> k = torch.tensor([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]])
        >>> project_points(torch.tensor([0.5, 0.0, 2.0]), k).tolist()
        [75.0, 40.0]
    """
    homogeneous: Tensor = (intrinsics @ points3d[..., None])[..., 0]
    return homogeneous[..., :2] / homogeneous[..., 2:]


def normalised_coordinates(xy: Float[Tensor, "*b 2"], intrinsics: Float[Tensor, "*k 3 3"]) -> Float[Tensor, "*b 2"]:
    """Pixels to the image plane at distance 1: the first two entries of ``K^-1 [u, v, 1]^T``."""
    homogeneous = torch.cat([xy, torch.ones_like(xy[..., :1])], -1)
    ray: Tensor = (torch.linalg.inv(intrinsics) @ homogeneous[..., None])[..., 0]
    return ray[..., :2] / ray[..., 2:]


def backproject_points(
    xy: Float[Tensor, "*b 2"], depth: Float[Tensor, "*b"], intrinsics: Float[Tensor, "*k 3 3"]
) -> Float[Tensor, "*b 3"]:
    """Pixels and z-depth to camera-frame points (paper, eq. 12): ``V = d(u, v) K^-1 [u, v, 1]^T``.

    Args:
        xy: pixels.
        depth: metres along the optical axis (not along the ray); NaN stays NaN.
        intrinsics: pinhole matrix, broadcast over the leading dimensions of ``xy``.

    Example:
        >>> import torch
        >>> k = torch.tensor([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]])
        >>> backproject_points(torch.tensor([75.0, 40.0]), torch.tensor(2.0), k).tolist()
        [0.5, 0.0, 2.0]
    """
    plane = normalised_coordinates(xy, intrinsics)
    return torch.cat([plane, torch.ones_like(plane[..., :1])], -1) * depth[..., None]
