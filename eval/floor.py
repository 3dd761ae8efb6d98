"""What noise and gaps leave to one who knows the views and the family of shapes: a floor beside solvers' errors."""

from __future__ import annotations

import torch

import torchrecon as tr
from torchrecon._typing import Float, Tensor
from torchrecon.linalg import nearest_rotation
from torchrecon.metrics import error3d_camera

__all__ = ["known_subspace_floor"]

_MODES = (1, 2, 3, 4, 6, 8, 10, 13, 16, 20, 25, 30, 40)


def _aligned(truth: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations canonical -> camera by generalised Procrustes analysis, and the shapes in canonical axes."""
    mean = truth[0]
    for _ in range(30):
        rotations = nearest_rotation(truth.mT @ mean)
        shapes = truth @ rotations
        mean = shapes.mean(0)
    return rotations, shapes


def known_subspace_floor(tracks: tr.Tracks, truth: Float[Tensor, "frames points 3"], noise: float) -> float:
    """Least ``error3d_camera`` over K when rotations, mean, the K true modes and their variances are known.

    Each frame's weights and translation are the posterior mean given its own seen entries: no solver that treats frames
    alike and apart does better on average; one that uses time can.

    Args:
        truth: camera axes, units of the tracks.
        noise: standard deviation of a coordinate, same units.

    Example:
        >>> import torch
        >>> truth = torch.randn(6, 5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> known_subspace_floor(tr.Tracks(truth[..., :2]), truth, 0.0) < 0.5
        True
    """
    truth = truth - truth.mean(-2, keepdim=True)
    rotations, shapes = _aligned(truth)
    mean = shapes.mean(0)
    _, values, directions = torch.linalg.svd((shapes - mean).flatten(1), full_matrices=False)
    frames, points = truth.shape[:2]
    seen = tracks.visible[..., None].expand(-1, -1, 2).flatten(1)
    target = torch.where(seen, (tracks.xy - (mean @ rotations.mT)[..., :2]).flatten(1), truth.new_zeros(()))
    variance = max(noise, 1e-6 * float(truth.norm()) / (frames * points) ** 0.5) ** 2
    shift = torch.eye(2, dtype=truth.dtype).repeat(points, 1).expand(frames, -1, -1)
    errors = []
    for count in (k for k in _MODES if k < min(len(values), frames)):
        modes = directions[:count].unflatten(1, (points, 3))
        placed = torch.einsum("fij,kpj->fpik", rotations, modes)
        design = torch.cat([placed[:, :, :2].flatten(1, 2), shift], -1) * seen[..., None]
        strength = values[:count].square() / frames
        precision = torch.cat([variance / strength.clamp_min(1e-12 * float(strength[0])), truth.new_zeros(2)])
        weights = torch.linalg.solve(design.mT @ design + torch.diag(precision), design.mT @ target[..., None])
        found = mean @ rotations.mT + (placed @ weights[:, None, :count])[..., 0]
        errors.append(float(error3d_camera(found, truth)))
    return min(errors)
