"""HumanEva as filmed: 2D joints of one of three real cameras that stand, and the true joints in its axes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from torchrecon._typing import Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.linalg import nearest_orthogonal

__all__ = ["CAMERAS", "FILE", "FPS", "at_image_scale", "camera_axes", "recording", "recordings"]

FILE = "humaneva15_train.npz"
CAMERAS, FPS = 3, 60.0


def camera_axes(
    world: Float[Tensor, "frames points 3"], xy: Float[Tensor, "frames points 2"]
) -> Float[Tensor, "frames points 3"]:
    """World points in the axes of the camera that sees them at ``xy``: x right, y down, z away, world origin kept.

    The projection matrix is the linear least-squares one of all pairs (resection); its left part is intrinsics times
    rotation, which the RQ decomposition takes apart.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> world = torch.randn(4, 9, 3, generator=g, dtype=torch.float64)
        >>> turn = nearest_orthogonal(torch.randn(3, 3, generator=g, dtype=torch.float64))
        >>> turn = turn * torch.linalg.det(turn)
        >>> seen = world @ turn.T + torch.tensor([0.0, 0.0, 9.0], dtype=torch.float64)
        >>> xy = 700 * seen[..., :2] / seen[..., 2:] + 300
        >>> bool((camera_axes(world, xy) - world @ turn.T).abs().max() < 1e-6)
        True
    """
    points = world.reshape(-1, 3)
    middle, size = points.mean(0), points.std()
    plane = xy.reshape(-1, 2)
    shift, unit = plane.mean(0), plane.std()
    h = torch.cat([(points - middle) / size, torch.ones_like(points[:, :1])], 1)
    u, v = ((plane - shift) / unit).unbind(1)
    zero = torch.zeros_like(h)
    system = torch.cat([torch.cat([h, zero, -u[:, None] * h], 1), torch.cat([zero, h, -v[:, None] * h], 1)])
    matrix = torch.linalg.svd(system, full_matrices=False)[2][-1].view(3, 4)
    away = h @ matrix[2]
    matrix = matrix * torch.sign(away.mean())
    # M = K R with K upper triangular and of positive diagonal: QR of M with rows and columns in reverse.
    q, r = torch.linalg.qr(matrix[:, :3].flip(0).T)
    sign = torch.diag(torch.sign(r.diagonal()))
    rotation = nearest_orthogonal((sign @ q.T).flip(0))
    return world @ rotation.T


def recordings(folder: Path) -> list[str]:
    """Names of the recordings in the folder of the keypoints.

    Raises:
        ReconError: the file is not there.
    """
    file = folder / FILE
    if not file.is_file():
        raise ReconError(f"{file}: no such file; --data names no folder that holds the keypoints")
    with np.load(file, allow_pickle=False) as data:
        return sorted(name.removesuffix("__xyz") for name in data.files if name.endswith("__xyz"))


def recording(
    name: str, camera: int, folder: Path
) -> tuple[Float[Tensor, "frames 15 2"], Float[Tensor, "frames 15 3"]]:
    """Pixels at 60 Hz and true joints in metres, camera axes.

    Args:
        camera: 0 to 2.
    """
    with np.load(folder / FILE, allow_pickle=False) as data:
        xy = torch.from_numpy(data[f"{name}__xy"][camera]).double()
        world = torch.from_numpy(data[f"{name}__xyz"]).double()
    return xy, camera_axes(world, xy)


def at_image_scale(
    metres: Float[Tensor, "frames points 3"], xy: Float[Tensor, "frames points 2"]
) -> Float[Tensor, "frames points 3"]:
    """The joints in pixels, each frame as large as its image (weak perspective): what parallel views could tell.

    Example:
        >>> import torch
        >>> truth = torch.randn(2, 9, 3, generator=torch.Generator().manual_seed(0))
        >>> size = torch.tensor([100.0, 150.0])[:, None, None]
        >>> bool((at_image_scale(truth, size * truth[..., :2]) - size * truth).abs().max() < 1e-3)
        True
    """
    seen, flat = (part - part.mean(1, keepdim=True) for part in (xy, metres[..., :2]))
    return metres * ((seen * flat).sum((1, 2)) / flat.square().sum((1, 2)))[:, None, None]
