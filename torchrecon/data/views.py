"""Known 3D motion seen again: by cameras that people hold, with noise and with gaps."""

from __future__ import annotations

import math

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.linalg import nearest_rotation, rotation_from_vector
from torchrecon.measurement import Tracks

__all__ = ["CAMERAS", "degrade_tracks", "film_again"]

CAMERAS = ("turn60", "turn90", "turn120", "pan", "sway")


def _turns(camera: str, frames: int) -> Float[Tensor, "frames 3"]:
    """Rotation vectors (radians) in axes whose second is the vertical."""
    t = torch.arange(frames, dtype=torch.float64)
    turns = torch.zeros(frames, 3, dtype=torch.float64)
    if camera.startswith("turn"):
        share = ((t - 3 * frames / 8) / (frames / 4)).clamp(0, 1)
        turns[:, 1] = math.radians(float(camera[4:])) * share
    elif camera == "pan":
        turns[:, 1] = math.radians(60) * t / max(1, frames - 1)
    else:  # a hand: a few degrees about every axis, periods of 2 to 7 s at 30 frames per second
        for axis, (size, periods) in enumerate(((4, (61, 97)), (10, (151, 211)), (2, (53, 83)))):
            turns[:, axis] = sum(math.radians(size) * torch.sin(2 * math.pi * t / p) / 2 for p in periods)
    return turns


def film_again(
    canonical: Float[Tensor, "frames points 3"], points3d: Float[Tensor, "frames points 3"], camera: str
) -> Float[Tensor, "frames points 3"]:
    """World-frame motion through another camera path.

    Args:
        canonical: world axes, any unit.
        points3d: the same in the axes of the camera that filmed it first; its path gives the vertical, its first
            frame the direction from which the new camera starts.
        camera: ``turn60``, ``turn90``, ``turn120`` (still, a steady yaw of so many degrees between 3/8 and 5/8 of the
            frames, still), ``pan`` (a steady yaw of 60 degrees over all frames), ``sway`` (hand-held).

    Returns:
        camera axes, centred per frame.

    Raises:
        ReconError: unknown camera, or a first camera that does not turn, so that no vertical can be told.

    Example:
        >>> import torch
        >>> world = torch.randn(16, 5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> turn = torch.arange(16.0, dtype=torch.float64)[:, None] * torch.tensor([0, 0.1, 0], dtype=torch.float64)
        >>> film_again(world, world @ rotation_from_vector(turn).mT, "turn90").shape
        torch.Size([16, 5, 3])
    """
    if camera not in CAMERAS:
        raise ReconError(f"camera {camera!r} is not one of {', '.join(CAMERAS)}")
    world = canonical - canonical.mean(-2, keepdim=True)
    rotations = nearest_rotation((points3d - points3d.mean(-2, keepdim=True)).mT @ world)
    step = rotations[:-1].mT @ rotations[1:]
    twist = torch.stack(
        [step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]], 1
    )
    axis = twist.mean(0)
    if float(axis.norm()) < 1e-3:
        raise ReconError("film_again: the first camera does not turn, so the vertical of the world is not known")
    vertical = rotations[0] @ (axis / axis.norm())  # in the axes of the first frame
    # The camera's own right and viewing direction stay level with that vertical.
    right = torch.linalg.cross(vertical, vertical.new_tensor([0.0, 0.0, 1.0]))
    right = right / right.norm()
    level = torch.stack([right, vertical, torch.linalg.cross(right, vertical)])
    moved = level.mT @ rotation_from_vector(_turns(camera, len(world)).to(world)) @ level
    seen: Tensor = world @ (moved @ rotations[0]).mT
    return seen


def degrade_tracks(
    xy: Float[Tensor, "frames points 2"],
    noise: float = 0.0,
    missing: float = 0.0,
    gaps: tuple[int, int] | None = None,
    *,
    generator: torch.Generator,
) -> Tracks:
    """Tracks with noise and missing entries, no covariance given.

    Args:
        xy: complete and exact.
        noise: standard deviation as a share of the largest coordinate of the centred tracks.
        missing: share of the entries that are not seen.
        gaps: shortest and longest gap in frames; None drops entries independently of one another.
        generator: source of the randomness.

    Raises:
        ReconError: a share that is negative or not below one, gaps that are not ordered.

    Example:
        >>> import torch
        >>> tracks = degrade_tracks(torch.rand(40, 9, 2), 0.01, 0.3, (3, 8), generator=torch.Generator().manual_seed(0))
        >>> 0.65 < float(tracks.visible.double().mean()) <= 0.7
        True
    """
    if not 0 <= missing < 1 or noise < 0:
        raise ReconError(f"noise {noise} must not be negative, missing {missing} must lie in [0, 1)")
    centred = xy - xy.mean(-2, keepdim=True)
    sigma = noise * float(centred.abs().max())
    noisy = xy + sigma * torch.randn(xy.shape, generator=generator, dtype=torch.float64).to(xy)
    frames, points = xy.shape[:2]
    if gaps is None:
        return Tracks(noisy, torch.rand(frames, points, generator=generator, dtype=torch.float64) >= missing)
    shortest, longest = gaps
    if not 1 <= shortest <= longest <= frames:
        raise ReconError(f"gaps {gaps}: must be ordered and between 1 and {frames} frames")
    visible = torch.ones(frames, points, dtype=torch.bool)
    left = round(missing * frames * points)
    while left > 0:
        point = int(torch.randint(points, (1,), generator=generator))
        length = int(torch.randint(shortest, longest + 1, (1,), generator=generator))
        start = int(torch.randint(frames - length + 1, (1,), generator=generator))
        left -= int(visible[start : start + length, point].sum())
        visible[start : start + length, point] = False
    return Tracks(noisy, visible)
