"""What every comparison row is given and must return.

A row takes the tracks of one sequence and a :class:`Context` and returns points in camera axes. Every monocular
row of another's style works on :class:`Views`: image positions in the units of one shared rigid factorisation,
which is also the one source of camera rotations for all of them (see ``turning_rigid``), so that rows differ in their
idea and not in their rotations. The sign of depth is that of the shared factorisation, decided there by perspective,
for all rows alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.measurement import FilledTracks, Reconstruction, Tracks
from torchrecon.measurement.camera import normalised_coordinates
from torchrecon.nrsfm import get_solver
from torchrecon.nrsfm.turning import turning_rigid

__all__ = [
    "Context",
    "Row",
    "RowOutput",
    "Views",
    "in_camera",
    "registered_views",
    "shared_rigid",
    "with_perspective",
    "without_depth",
]


@dataclass(frozen=True)
class RowOutput:
    """What a row answers.

    Attributes:
        points3d: (frames, points, 3) camera axes (x right, y down, z away), centred per frame or not, any one unit.
        visible: (frames, points) entries that the row stands for.
        note: one sentence about how it went (status, rank), kept with the result.
    """

    points3d: Float[Tensor, "frames points 3"]
    visible: Bool[Tensor, "frames points"]
    note: str = ""


@dataclass(frozen=True)
class Context:
    """What all rows of one sequence share.

    Attributes:
        rigid: the rigid factorisation of the tracks: the one source of rotations.
        filled: gap-free tracks for the rows that need complete matrices.
        prior: trained shape prior for the supervised row, else None.
        seed: of every random choice in a row.
        rotations: (frames, 3, 3) world -> camera, of the film: for oracle rows alone, else None.
    """

    rigid: Reconstruction
    filled: FilledTracks | None = None
    prior: Any = None
    seed: int = 0
    rotations: Float[Tensor, "frames 3 3"] | None = None


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Attributes:
        key: short name, also the folder of its predictions.
        label: what is printed.
        solve: the method; None for lines that need no reconstruction (true 3D, 2D-trained recogniser).
        supervised: trained on 3D that other rows do not get.
        filled: works on the filled tracks because it needs complete matrices.
        uses_depth: reads measured depth where the tracks have it.
        oracle: is told something of the truth, so it is no method.
    """

    key: str
    label: str
    solve: Callable[[Tracks, Context], RowOutput] | None = None
    supervised: bool = False
    filled: bool = False
    uses_depth: bool = False
    oracle: bool = False


@dataclass(frozen=True)
class Views:
    """One sequence in the units and axes of its rigid factorisation.

    Attributes:
        xy: (frames, points, 2) image-plane positions relative to the body, NaN where not seen.
        visible: (frames, points).
        rotations: (frames, 3, 3) canonical -> camera.
        shape: (points, 3) rigid shape in canonical axes.
        noise: standard deviation of ``xy`` per coordinate, from the tracks' covariance; 0 where there is none.
    """

    xy: Float[Tensor, "frames points 2"]
    visible: Bool[Tensor, "frames points"]
    rotations: Float[Tensor, "frames 3 3"]
    shape: Float[Tensor, "points 3"]
    noise: float = 0.0

    @property
    def seen(self) -> Float[Tensor, "frames points 2"]:
        """``xy`` with zero where nothing was seen, to be multiplied by :attr:`weight`."""
        return torch.where(self.visible[..., None], self.xy, torch.zeros_like(self.xy))

    @property
    def weight(self) -> Float[Tensor, "frames points"]:
        """1 where seen, 0 elsewhere."""
        return self.visible.to(self.xy.dtype)


def shared_rigid(tracks: Tracks, seed: int = 0) -> Reconstruction:
    """The one source of rotations: :func:`turning_rigid` for pinhole tracks, else the library's factorisation."""
    if tracks.intrinsics is not None:
        return turning_rigid(tracks)
    return get_solver("rigid")(tracks, 1, generator=torch.Generator().manual_seed(seed))


def registered_views(tracks: Tracks, rigid: Reconstruction, depth: Tensor | None = None) -> Views:
    """Tracks in the units and origin of a rigid factorisation.

    A pinhole point lies at ``s X + t`` in the camera, so with ``n`` its normalised image coordinates
    ``X_xy = (n (t_z + s z) - t_xy) / s``; without a known ``depth`` z it is taken as 0 (weak perspective).

    Args:
        tracks: one sequence.
        rigid: a :class:`Reconstruction` of the same tracks.
        depth: (frames, points) z of the points relative to the body, in the factorisation's units.
    """
    scale, shift = rigid.scale[:, None, None], rigid.translation[:, None]
    if tracks.intrinsics is None:
        xy = (tracks.xy - shift[..., :2]) / scale
        unit = scale[:, 0, 0]
    else:
        away = shift[..., 2:].expand((*tracks.xy.shape[:-1], 1))
        if depth is not None:
            away = away + scale * depth[..., None]
        xy = (normalised_coordinates(tracks.xy, tracks.intrinsics) * away - shift[..., :2]) / scale
        unit = scale[:, 0, 0] * tracks.intrinsics[0, 0] / shift[:, 0, 2]
    noise = 0.0
    if tracks.covariance is not None:
        variance = tracks.covariance.diagonal(dim1=-2, dim2=-1).mean(-1) / unit[:, None].square()
        noise = float(variance[tracks.visible].mean().sqrt())
    shape = rigid.canonical.mean(0)
    return Views(xy, tracks.visible, rigid.rotations, shape, noise)


def with_perspective(
    tracks: Tracks, rigid: Reconstruction, solve: Callable[[Views], Float[Tensor, "frames points 3"]], rounds: int = 2
) -> Float[Tensor, "frames points 3"]:
    """Run a row that thinks in orthographic views on pinhole tracks: its depths correct its input, and again.

    Each round replaces the image positions by those that parallel rays would give for the depths found so far.
    """
    points = solve(registered_views(tracks, rigid))
    if tracks.intrinsics is None:
        return points
    for _ in range(rounds):
        points = solve(registered_views(tracks, rigid, points[..., 2]))
    return points


def in_camera(views: Views, model: Float[Tensor, "frames points 3"]) -> Float[Tensor, "frames points 3"]:
    """Camera-axes points of a model with the measured image position where there is one: rows are scored on depth."""
    xy = torch.where(views.visible[..., None], views.xy, model[..., :2])
    return torch.cat([xy, model[..., 2:]], -1)


def without_depth(tracks: Tracks) -> Tracks:
    """The same tracks for a method that has no place for measured depth."""
    return replace(tracks, depth=None, depth_variance=None)
