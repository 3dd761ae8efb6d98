"""The 3D shape over time that a solver found, with what it does not know."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.errors import ReconError
from torchrecon.measurement._store import read_npz, write_npz

__all__ = ["Reconstruction", "Status"]


@dataclass(frozen=True)
class Status:
    """How a solve ended, in one sentence.

    Attributes:
        code: ``ok``; ``not_converged`` (the iteration limit came first); ``undetermined`` (the view carries too
            little 3D information); ``degenerate`` (too few points or frames for the rank asked for).
        text: the explanation.

    Example:
        >>> Status("ok", "converged after 12 iterations").ok
        True
    """

    code: str
    text: str

    @property
    def ok(self) -> bool:
        """True when the answer is determined by the data."""
        return self.code == "ok"

    def __str__(self) -> str:
        return f"{self.code}: {self.text}"


_TENSORS = (
    "points3d",
    "rotations",
    "scale",
    "translation",
    "basis",
    "weights",
    "covariance3d",
    "intrinsics",
    "observed",
)


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Shape and pose of every frame in camera axes.

    Convention:
        Camera axes: x right, y down, z away from the camera; each frame is centred. ``rotations`` maps canonical
        to camera axes and ``rotations[0]`` is the identity. Without intrinsics lengths are pixels of the tracks,
        with intrinsics metres up to one global scale, with measured depth true metres. For orthographic input the
        sign of depth is a mirror ambiguity: one sign per sequence, chosen so that the third moment of depth over all
        frames and points is positive; :meth:`mirrored` is the other answer. With intrinsics, perspective decides.

    Attributes:
        points3d: (*batch, frames, points, 3).
        rotations: (*batch, frames, 3, 3) canonical -> camera.
        scale: (*batch, frames) image scale: pixels of the track per unit of ``points3d``, divided out.
        translation: (*batch, frames, 2) pixels without intrinsics, (*batch, frames, 3) with intrinsics.
        rank: K, an int for batch ``()`` else an int64 tensor.
        deformation_degree: count of signal eigenvalues / 6 or / 3, not rounded.
        basis: (*batch, rank, points, 3) best rank-K factors of ``canonical``, the mean shape counted as a basis.
        weights: (*batch, frames, rank).
        covariance3d: (*batch, frames, points, 3, 3), or None where the solver gives none.
        status: one :class:`Status` for batch ``()``, else a tuple in row-major batch order.
        intrinsics: those of the tracks, or None.
        observed: (*batch, frames, points) bool: entries with a measurement; elsewhere ``points3d`` is inferred.

    Example:
        >>> import torch
        >>> points = torch.randn(4, 6, 3)
        >>> points = points - points.mean(-2, keepdim=True)
        >>> eye = torch.eye(3).expand(4, 3, 3)
        >>> rec = Reconstruction.from_points(points, eye, rank=1, status=Status("ok", "made by hand"))
        >>> rec.reproject().shape, rec.mirrored().points3d.shape
        (torch.Size([4, 6, 2]), torch.Size([4, 6, 3]))
    """

    points3d: Float[Tensor, "*batch frames points 3"]
    rotations: Float[Tensor, "*batch frames 3 3"]
    scale: Float[Tensor, "*batch frames"]
    translation: Float[Tensor, "*batch frames dim"]
    rank: int | Int[Tensor, "*batch"]
    deformation_degree: float | Float[Tensor, "*batch"]
    basis: Float[Tensor, "*batch rank points 3"]
    weights: Float[Tensor, "*batch frames rank"]
    status: Status | tuple[Status, ...]
    covariance3d: Float[Tensor, "*batch frames points 3 3"] | None = None
    intrinsics: Float[Tensor, "*batch 3 3"] | None = None
    observed: Tensor | None = None

    @classmethod
    def from_points(
        cls,
        points3d: Float[Tensor, "*batch frames points 3"],
        rotations: Float[Tensor, "*batch frames 3 3"],
        *,
        rank: int | Int[Tensor, "*batch"],
        status: Status | tuple[Status, ...],
        deformation_degree: float | Tensor | None = None,
        scale: Tensor | None = None,
        translation: Tensor | None = None,
        covariance3d: Tensor | None = None,
        intrinsics: Tensor | None = None,
        observed: Tensor | None = None,
    ) -> Reconstruction:
        """Build the result of a solver from camera-frame points and rotations.

        The points are centred per frame, the rotations are made relative to the first frame, and ``basis`` and
        ``weights`` are the best rank-K factors of ``canonical``.
        """
        points3d = points3d - points3d.mean(-2, keepdim=True)
        rotations = rotations @ rotations[..., :1, :, :].transpose(-1, -2)
        frames = points3d.shape[-3]
        if scale is None:
            scale = points3d.new_ones(points3d.shape[:-2])
        if translation is None:
            translation = points3d.new_zeros(*points3d.shape[:-2], 2 if intrinsics is None else 3)
        canonical = points3d @ rotations
        flat = canonical.flatten(-2)
        u, s, vh = torch.linalg.svd(flat.detach(), full_matrices=False)
        largest = int(torch.as_tensor(rank).max())
        available = min(largest, s.shape[-1])
        order = torch.arange(available, device=s.device)
        keep = (order < torch.as_tensor(rank, device=s.device)[..., None]).to(s.dtype)
        root = frames**0.5
        weights = u[..., :available] * s[..., None, :available] * keep[..., None, :] / root
        basis = (vh[..., :available, :] * keep[..., None] * root).unflatten(-1, (points3d.shape[-2], 3))
        sign = torch.where(weights.sum(-2, keepdim=True) < 0, -1.0, 1.0).to(weights.dtype)
        weights, basis = weights * sign, basis * sign.transpose(-1, -2)[..., None]
        if available < largest:
            weights = torch.nn.functional.pad(weights, (0, largest - available))
            basis = torch.nn.functional.pad(basis, (0, 0, 0, 0, 0, largest - available))
        degree = rank if deformation_degree is None else deformation_degree
        degree = degree.to(points3d.dtype) if isinstance(degree, Tensor) else float(degree)
        return cls(
            points3d=points3d,
            rotations=rotations,
            scale=scale,
            translation=translation,
            rank=rank,
            deformation_degree=degree,
            basis=basis,
            weights=weights,
            status=status,
            covariance3d=covariance3d,
            intrinsics=intrinsics,
            observed=observed,
        )

    @property
    def canonical(self) -> Float[Tensor, "*batch frames points 3"]:
        """Shapes in canonical axes: ``rotations^T points3d``."""
        return self.points3d @ self.rotations

    @property
    def statuses(self) -> tuple[Status, ...]:
        """The status of every batch item as a tuple, also for batch ``()``."""
        return (self.status,) if isinstance(self.status, Status) else self.status

    def reproject(self) -> Float[Tensor, "*batch frames points 2"]:
        """Pixels at which the reconstruction would be seen."""
        if self.intrinsics is None:
            return self.points3d[..., :2] * self.scale[..., None, None] + self.translation[..., None, :]
        placed = self.points3d * self.scale[..., None, None] + self.translation[..., None, :]
        homogeneous = placed @ self.intrinsics[..., None, :, :].transpose(-1, -2)
        return homogeneous[..., :2] / homogeneous[..., 2:]

    def mirrored(self) -> Reconstruction:
        """The other answer of the mirror ambiguity: every depth negated."""
        flip = self.points3d.new_tensor([1.0, 1.0, -1.0])
        both = flip[:, None] * flip
        return replace(
            self,
            points3d=self.points3d * flip,
            rotations=self.rotations * both,
            basis=self.basis * flip,
            covariance3d=None if self.covariance3d is None else self.covariance3d * both,
        )

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Reconstruction:
        """The same result on another device or in another floating-point type."""
        moved: dict[str, Any] = {}
        for name in (*_TENSORS, "rank", "deformation_degree"):
            value = getattr(self, name)
            if isinstance(value, torch.Tensor):
                moved[name] = value.to(device=device, dtype=dtype if value.is_floating_point() else None)
        return replace(self, **moved)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write a .npz with the attributes by name (absent means None), atomically."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in _TENSORS}
        arrays |= {"rank": self.rank, "deformation_degree": self.deformation_degree}
        arrays["status_code"] = np.asarray([status.code for status in self.statuses], dtype=np.str_)
        arrays["status_text"] = np.asarray([status.text for status in self.statuses], dtype=np.str_)
        return write_npz(path, arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Reconstruction:
        """Read what :meth:`save` wrote; raises ReconError that names file and key."""
        arrays = read_npz(path)
        needed = {"points3d", "rotations", "scale", "translation", "rank", "deformation_degree", "basis", "weights"}
        missing = sorted((needed | {"status_code", "status_text"}) - arrays.keys())
        if missing:
            raise ReconError(f"{path}: has no key {missing[0]!r}; it is not a reconstruction")
        try:
            fields: dict[str, Any] = {k: torch.as_tensor(arrays[k]) for k in _TENSORS if k in arrays}
            codes = arrays["status_code"].reshape(-1).tolist()
            texts = arrays["status_text"].reshape(-1).tolist()
            statuses = tuple(Status(str(code), str(text)) for code, text in zip(codes, texts, strict=True))
            single = fields["points3d"].ndim == 3
            rank, degree = arrays["rank"], arrays["deformation_degree"]
            return cls(
                **fields,
                rank=int(rank) if single else torch.as_tensor(rank),
                deformation_degree=float(degree) if single else torch.as_tensor(degree),
                status=statuses[0] if single else statuses,
            )
        except (TypeError, ValueError, IndexError) as error:
            raise ReconError(f"{path}: is not a reconstruction ({error})") from error
