"""A depth map as an organised cloud of points (paper, eq. 12)."""

from __future__ import annotations

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.measurement import backproject_points

__all__ = ["backproject"]


def backproject(
    depth: Float[Tensor, "batch 1 height width"], intrinsics: Float[Tensor, "*k 3 3"]
) -> Float[Tensor, "batch 3 height width"]:
    """Every pixel of a depth map to a point in camera axes (paper, eq. 12): ``V = d(u, v) K^-1 [u, v, 1]^T``.

    Args:
        depth: metres along the optical axis (z, not the length of the ray); zero, negative and NaN mean "none".
        intrinsics: (3, 3) or (batch, 3, 3) pinhole matrix; integer pixel coordinates are pixel centres.

    Returns:
        metres, camera axes (x right, y down, z forward); NaN where there is no depth, never a point at the origin.

    Example:
        >>> import torch
        >>> k = torch.tensor([[100.0, 0, 2], [0, 100, 1], [0, 0, 1]])
        >>> depth = torch.full((1, 1, 3, 5), 2.0)
        >>> depth[0, 0, 0, 0] = 0
        >>> cloud = backproject(depth, k)
        >>> [round(x, 3) for x in cloud[0, :, 1, 4].tolist()], bool(cloud[0, :, 0, 0].isnan().all())
        ([0.04, 0.0, 2.0], True)
    """
    z = depth[:, 0]
    z = torch.where(z > 0, z, z.new_tensor(float("nan")))
    height, width = z.shape[-2:]
    v, u = torch.meshgrid(
        torch.arange(height, dtype=z.dtype, device=z.device),
        torch.arange(width, dtype=z.dtype, device=z.device),
        indexing="ij",
    )
    xy = torch.stack([u, v], -1).reshape(1, -1, 2).expand(z.shape[0], -1, 2)
    camera = intrinsics.to(z)
    if camera.ndim > 2:
        camera = camera[:, None]
    points = backproject_points(xy, z.flatten(1), camera)
    return points.transpose(-1, -2).reshape(-1, 3, height, width)
