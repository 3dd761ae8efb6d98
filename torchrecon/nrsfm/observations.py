"""The seen entries of one sequence in solver units, and the way back to the units of the tracks."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.measurement import Reconstruction, Status, Tracks, normalised_coordinates

__all__ = ["Observations", "observe"]


@dataclass(frozen=True, eq=False)
class Observations:
    """Image coordinates in units in which the body has rms size about one.

    Attributes:
        xy: (frames, points, 2); zero where nothing is seen.
        visible: (frames, points).
        weight: (frames, points, 2, 2) whitening factor: ``weight @ noise`` has equal variance in all seen entries
            (one where the covariance is known; without covariance the identity); zero where nothing is seen.
        noise_known: True where the tracks bring a covariance.
        unit: pixels (without intrinsics) or tangents of the viewing angle (with) per unit of ``xy``.
        offset: (2,) that was subtracted before the division by ``unit``.
        tracks: where all this came from.
    """

    xy: Float[Tensor, "frames points 2"]
    visible: Bool[Tensor, "frames points"]
    weight: Float[Tensor, "frames points 2 2"]
    noise_known: bool
    unit: Float[Tensor, ""]
    offset: Float[Tensor, " 2"]
    tracks: Tracks

    @property
    def length(self) -> Tensor:
        """Metres per unit of length: from the median measured depth, or one where there is no depth."""
        if self.tracks.depth is None:
            return torch.ones_like(self.unit)
        there = self.visible & torch.isfinite(self.tracks.depth)
        return self.tracks.depth[there].median() * self.unit if there.any() else torch.ones_like(self.unit)

    def held(self) -> Float[Tensor, "frames points 2"]:
        """Every entry with a value: unseen ones take the point's nearest seen position, moved with the frame's mean.

        A start for iterations, never a measurement.
        """
        frames, points = self.visible.shape
        mask = self.visible[..., None]
        mean = self.xy.sum(1) / self.visible.sum(1).clamp_min(1)[:, None]
        index = torch.arange(frames, device=self.xy.device)
        distance = (index[:, None] - index[None, :]).abs()[..., None] + (~self.visible)[None] * 10 * frames
        nearest = distance.argmin(1)
        relative = torch.where(mask, self.xy - mean[:, None], self.xy.new_zeros(()))
        moved = relative.gather(0, nearest[..., None].expand(frames, points, 2)) + mean[:, None]
        return torch.where(mask, self.xy, moved)

    def reconstruction(
        self,
        points3d: Float[Tensor, "frames points 3"],
        rotations: Float[Tensor, "frames 3 3"],
        scale: Float[Tensor, " frames"],
        translation: Float[Tensor, "frames 2"],
        *,
        rank: int,
        status: Status,
        covariance3d: Tensor | None = None,
    ) -> Reconstruction:
        """The container's units from weak-perspective views ``xy = scale * points3d[:2] + translation``.

        With intrinsics the scale becomes the distance of the body in every frame, in units of ``points3d``.
        """
        centre = points3d.mean(-2)
        translation = translation + scale[:, None] * centre[:, :2]
        plane = translation * self.unit + self.offset
        if self.tracks.intrinsics is None:
            unit, shift, factor = self.unit, plane, scale
        else:
            # One unit of length spans ``unit * scale`` tangents, so the body is 1 / (unit * scale) away.
            distance = 1 / (self.unit * scale)
            shift = torch.cat([plane, torch.ones_like(plane[:, :1])], 1) * distance[:, None]
            unit, factor = torch.ones_like(self.unit), torch.ones_like(scale)
        return Reconstruction.from_points(
            points3d * unit,
            rotations,
            rank=rank,
            status=status,
            scale=factor,
            translation=shift,
            intrinsics=self.tracks.intrinsics,
            observed=self.visible,
            covariance3d=None if covariance3d is None else covariance3d * unit**2,
        )


def observe(tracks: Tracks) -> Observations:
    """Bring one sequence (batch ``()``) into solver units; entries that are not visible are never read.

    Example:
        >>> import torch
        >>> data = observe(Tracks(100 * torch.rand(6, 5, 2)))
        >>> 0.5 < float(data.xy.square().mean().sqrt()) < 2.0
        True
    """
    visible = tracks.visible
    mask = visible[..., None]
    zero = tracks.xy.new_zeros(())
    plane = torch.where(mask, tracks.xy, zero)
    if tracks.intrinsics is not None:
        plane = normalised_coordinates(plane, tracks.intrinsics)
    plane = torch.where(mask, plane, zero)
    count = visible.sum(1).clamp_min(1)[:, None]
    mean = plane.sum(1) / count
    spread = torch.where(mask, plane - mean[:, None], zero)
    unit = (spread.square().sum() / (2 * visible.sum())).sqrt()
    unit = torch.where(unit > 0, unit, torch.ones_like(unit))
    offset = mean[visible.any(1)].mean(0)
    xy = torch.where(mask, (plane - offset) / unit, zero)
    eye = torch.eye(2, dtype=xy.dtype, device=xy.device)
    if tracks.covariance is None:
        weight = torch.where(mask[..., None], eye, zero)
    else:
        noise = torch.where(mask[..., None], tracks.covariance, eye)
        if tracks.intrinsics is not None:
            inner = torch.linalg.inv(tracks.intrinsics[:2, :2])
            noise = inner @ noise @ inner.mT
        factor = torch.linalg.cholesky(noise / unit**2)
        weight = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)
        weight = torch.where(mask[..., None], weight, zero)
    return Observations(xy, visible, weight, tracks.covariance is not None, unit, offset, tracks)
