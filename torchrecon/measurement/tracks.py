"""Image tracks of points on a moving body, with what is known of their noise and depth."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.measurement._store import read_npz, write_npz

__all__ = ["Tracks"]

# What torch.as_tensor takes; the container turns it into a tensor once, here.
ArrayLike: TypeAlias = Any

_TENSORS = ("covariance", "depth", "depth_variance", "intrinsics", "times")


def _tensor(name: str, value: Any, dtype: torch.dtype | None, device: torch.device | None) -> Tensor:
    try:
        tensor = torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ReconError(f"{name}: cannot be read as a numeric array ({error})") from error
    if tensor.is_complex():
        raise ReconError(f"{name}: is complex; real numbers are needed")
    if dtype is None:
        dtype = tensor.dtype if tensor.dtype in (torch.float32, torch.float64) else torch.get_default_dtype()
    return tensor.to(device=device, dtype=dtype)


def _first(mask: Tensor) -> str:
    """Index of the first true entry, for error messages."""
    return str(tuple(int(i) for i in mask.nonzero()[0]))


def _visible(visible: Any, xy: Tensor) -> Tensor:
    finite = torch.isfinite(xy).all(-1)
    if visible is None:
        seen = finite
    else:
        try:
            seen = torch.as_tensor(visible).to(device=xy.device).bool()
        except (TypeError, ValueError, RuntimeError) as error:
            raise ReconError(f"visible: cannot be read as a boolean array ({error})") from error
        if seen.shape != finite.shape:
            raise ReconError(f"visible: shape {tuple(seen.shape)} does not fit xy; {tuple(finite.shape)} is needed")
        wrong = seen & ~finite
        if wrong.any():
            raise ReconError(
                f"xy: entry {_first(wrong)} is marked visible but is not finite; mark it invisible or give its position"
            )
    if not seen.any():
        raise ReconError("visible: no point is seen in any frame; at least one observation is needed")
    return seen


def _rate(fps: Any) -> float:
    try:
        rate = float(fps)
    except (TypeError, ValueError) as error:
        raise ReconError(f"fps: {fps!r} is not a number of frames per second") from error
    if not 0 < rate < float("inf"):
        raise ReconError(f"fps: {fps!r} is not a positive number of frames per second")
    return rate


@dataclass(frozen=True, eq=False, init=False)
class Tracks:
    """Points followed through the frames of one sequence, or of a batch of sequences.

    Convention:
        Image axes: x right, y down, pixels, integer pixel centres. Entries with ``visible`` false are never
        read, whatever stands there; the container stores NaN in their place.

    Args:
        xy: (*batch, frames, points, 2) image positions in pixels, NaN where a point is not seen.
        visible: (*batch, frames, points) bool; default: finite ``xy``.
        covariance: (*batch, frames, points, 2, 2) px^2; None means isotropic with unknown scale.
        depth: (*batch, frames, points) metres along the optical axis, NaN where there is none; needs
            ``intrinsics``.
        depth_variance: (*batch, frames, points) m^2; needs ``depth``.
        intrinsics: (*batch, 3, 3) or (3, 3) pinhole matrix; None means (scaled) orthographic.
        fps: frames per second.
        times: (*batch, frames) or (frames,) seconds, increasing; default ``arange(frames) / fps``.
        names: one name per point.
        edges: pairs of point indices that are joined by a bone, for drawing only.
        extras: tensors per point or observation (``age``, ``descriptor``, ...), kept as they are.

    Raises:
        ReconError: shapes that do not fit, visible points with non-finite coordinates, depth without
            intrinsics, a covariance that is not symmetric positive definite, nothing visible at all.

    Example:
        >>> import torch
        >>> tracks = Tracks(torch.rand(10, 5, 2))
        >>> tracks.frames, tracks.points, bool(tracks.visible.all())
        (10, 5, True)
    """

    xy: Float[Tensor, "*batch frames points 2"]
    visible: Bool[Tensor, "*batch frames points"]
    covariance: Float[Tensor, "*batch frames points 2 2"] | None
    depth: Float[Tensor, "*batch frames points"] | None
    depth_variance: Float[Tensor, "*batch frames points"] | None
    intrinsics: Float[Tensor, "*batch 3 3"] | None
    fps: float
    times: Float[Tensor, "*batch frames"]
    names: tuple[str, ...] | None
    edges: tuple[tuple[int, int], ...] | None
    extras: Mapping[str, Tensor] | None

    def __init__(
        self,
        xy: ArrayLike,
        visible: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        depth: ArrayLike | None = None,
        depth_variance: ArrayLike | None = None,
        intrinsics: ArrayLike | None = None,
        fps: float = 25.0,
        times: ArrayLike | None = None,
        names: Sequence[str] | None = None,
        edges: Sequence[Sequence[int]] | None = None,
        extras: Mapping[str, Tensor] | None = None,
    ) -> None:
        put = functools.partial(object.__setattr__, self)
        positions = _tensor("xy", xy, None, None)
        if positions.ndim < 3 or positions.shape[-1] != 2:
            raise ReconError(f"xy: shape {tuple(positions.shape)}; (*batch, frames, points, 2) is needed")
        if positions.shape[-3] < 1 or positions.shape[-2] < 1:
            raise ReconError(f"xy: shape {tuple(positions.shape)} has no frame or no point")
        if extras is not None and "xy" in extras:
            raise ReconError("extras: the name 'xy' is taken by the tracks themselves")
        shape = tuple(positions.shape[:-1])
        seen = _visible(visible, positions)
        # An unseen entry is replaced, not multiplied by zero: NaN times zero is NaN, also in gradients.
        put("xy", torch.where(seen[..., None], positions, positions.new_tensor(float("nan"))))
        put("visible", seen)
        put("covariance", self._optional("covariance", covariance))
        put("depth", self._optional("depth", depth))
        put("depth_variance", self._optional("depth_variance", depth_variance))
        put("intrinsics", self._optional("intrinsics", intrinsics))
        put("extras", extras)
        self._check_noise(shape)
        self._check_camera(shape)
        self._check_depth(shape)
        put("fps", _rate(fps))
        put("times", self._times(self._optional("times", times), shape))
        put("names", None if names is None else tuple(str(name) for name in names))
        put("edges", None if edges is None else tuple((int(a), int(b)) for a, b in edges))
        self._check_names(shape[-1])

    def _optional(self, name: str, value: Any) -> Tensor | None:
        return None if value is None else _tensor(name, value, self.xy.dtype, self.xy.device)

    def _check_noise(self, shape: tuple[int, ...]) -> None:
        if self.covariance is None:
            return
        if tuple(self.covariance.shape) != (*shape, 2, 2):
            raise ReconError(
                f"covariance: shape {tuple(self.covariance.shape)} does not fit xy; {(*shape, 2, 2)} is needed"
            )
        q = self.covariance.detach()
        a, b, c, d = q[..., 0, 0], q[..., 0, 1], q[..., 1, 0], q[..., 1, 1]
        scale = a.abs() + d.abs()
        good = torch.isfinite(q).all(-1).all(-1) & (a > 0) & (a * d - b * c > 0) & ((b - c).abs() <= 1e-4 * scale)
        wrong = self.visible & ~good
        if wrong.any():
            raise ReconError(
                f"covariance: entry {_first(wrong)} is not a symmetric positive definite 2x2 matrix in px^2"
            )

    def _check_camera(self, shape: tuple[int, ...]) -> None:
        if self.intrinsics is None:
            return
        if self.intrinsics.shape[-2:] != (3, 3):
            raise ReconError(f"intrinsics: shape {tuple(self.intrinsics.shape)}; (*batch, 3, 3) is needed")
        try:
            full = self.intrinsics.expand(*shape[:-2], 3, 3)
        except RuntimeError as error:
            raise ReconError(
                f"intrinsics: shape {tuple(self.intrinsics.shape)} does not fit the batch {shape[:-2]} of xy"
            ) from error
        if not torch.isfinite(full).all() or not (full[..., 0, 0] * full[..., 1, 1] > 0).all():
            raise ReconError("intrinsics: focal lengths K[0,0] and K[1,1] must be finite and of one sign")
        object.__setattr__(self, "intrinsics", full)

    def _check_depth(self, shape: tuple[int, ...]) -> None:
        if self.depth is None:
            if self.depth_variance is not None:
                raise ReconError("depth_variance: is given without depth")
            return
        if self.intrinsics is None:
            raise ReconError("depth: needs intrinsics, a (3, 3) pinhole matrix; give it or leave depth out")
        if tuple(self.depth.shape) != shape:
            raise ReconError(f"depth: shape {tuple(self.depth.shape)} does not fit xy; {shape} is needed")
        wrong = self.visible & (self.depth <= 0)
        if wrong.any():
            raise ReconError(f"depth: entry {_first(wrong)} is not positive; write NaN where there is no depth")
        if self.depth_variance is None:
            return
        if tuple(self.depth_variance.shape) != shape:
            raise ReconError(f"depth_variance: shape {tuple(self.depth_variance.shape)}; {shape} is needed")
        wrong = self.visible & torch.isfinite(self.depth) & ~(self.depth_variance > 0)
        if wrong.any():
            raise ReconError(f"depth_variance: entry {_first(wrong)} is not positive (m^2)")

    def _times(self, times: Tensor | None, shape: tuple[int, ...]) -> Tensor:
        if times is None:
            times = torch.arange(shape[-2], dtype=self.xy.dtype, device=self.xy.device) / self.fps
        elif times.shape[-1:] != (shape[-2],):
            raise ReconError(f"times: shape {tuple(times.shape)} does not fit {shape[-2]} frames")
        elif not torch.isfinite(times).all() or (shape[-2] > 1 and not (times.diff(dim=-1) > 0).all()):
            raise ReconError("times: must be finite and increase from frame to frame (seconds)")
        return times.expand(*shape[:-2], shape[-2])

    def _check_names(self, points: int) -> None:
        if self.names is not None and len(self.names) != points:
            raise ReconError(f"names: {len(self.names)} names for {points} points")
        for edge in self.edges or ():
            if not all(0 <= end < points for end in edge):
                raise ReconError(f"edges: {edge} names a point outside 0..{points - 1}")

    @property
    def batch_shape(self) -> torch.Size:
        """Shape of the leading batch dimensions."""
        return self.xy.shape[:-3]

    @property
    def frames(self) -> int:
        """Number of frames F."""
        return self.xy.shape[-3]

    @property
    def points(self) -> int:
        """Number of points P."""
        return self.xy.shape[-2]

    def filled_xy(self, value: float = 0.0) -> Float[Tensor, "*batch frames points 2"]:
        """``xy`` with ``value`` in place of the entries that were not seen."""
        return torch.where(self.visible[..., None], self.xy, self.xy.new_tensor(value))

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Tracks:
        """The same tracks on another device or in another floating-point type."""

        def move(tensor: Tensor) -> Tensor:
            return tensor.to(device=device, dtype=dtype if tensor.is_floating_point() else None)

        return self._mapped(move)

    def detach(self) -> Tracks:
        """The same tracks without the graph that leads to them."""
        return self._mapped(Tensor.detach)

    def _mapped(self, change: Callable[[Tensor], Tensor]) -> Tracks:
        changed: dict[str, Any] = {"xy": change(self.xy), "visible": change(self.visible)}
        changed |= {name: change(value) for name in _TENSORS if (value := getattr(self, name)) is not None}
        if self.extras is not None:
            changed["extras"] = {name: change(value) for name, value in self.extras.items()}
        return replace(self, **changed)

    def select(
        self, frames: Sequence[int] | slice | Tensor | None = None, points: Sequence[int] | slice | Tensor | None = None
    ) -> Tracks:
        """A subset of frames and points; edges are re-indexed, extras of matching shape are cut too."""
        f = torch.arange(self.frames)[frames if frames is not None else slice(None)].tolist()
        p = torch.arange(self.points)[points if points is not None else slice(None)].tolist()
        lead = len(self.batch_shape)

        def cut(tensor: Tensor) -> Tensor:
            return tensor.index_select(lead, tensor.new_tensor(f, dtype=torch.long)).index_select(
                lead + 1, tensor.new_tensor(p, dtype=torch.long)
            )

        def cut_extra(tensor: Tensor) -> Tensor:
            if tuple(tensor.shape[lead : lead + 2]) == (self.frames, self.points):
                return cut(tensor)
            if tensor.ndim > lead and tensor.shape[lead] == self.points:
                return tensor.index_select(lead, torch.tensor(p, device=tensor.device))
            return tensor

        new = {old: i for i, old in enumerate(p)}
        return replace(
            self,
            xy=cut(self.xy),
            visible=cut(self.visible),
            covariance=None if self.covariance is None else cut(self.covariance),
            depth=None if self.depth is None else cut(self.depth),
            depth_variance=None if self.depth_variance is None else cut(self.depth_variance),
            times=self.times[..., f],
            names=None if self.names is None else tuple(self.names[i] for i in p),
            edges=None
            if self.edges is None
            else tuple((new[a], new[b]) for a, b in self.edges if a in new and b in new),
            extras=None if self.extras is None else {k: cut_extra(v) for k, v in self.extras.items()},
        )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write a .npz with the fields above by name (absent means None), atomically."""
        arrays: dict[str, Any] = {"xy": self.xy, "visible": self.visible, "fps": self.fps}
        arrays |= {name: getattr(self, name) for name in _TENSORS}
        arrays["names"] = None if self.names is None else np.asarray(self.names, dtype=np.str_)
        arrays["edges"] = None if self.edges is None else np.asarray(self.edges, dtype=np.int64).reshape(-1, 2)
        arrays |= {f"extras/{name}": value for name, value in (self.extras or {}).items()}
        return write_npz(path, arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Tracks:
        """Read what :meth:`save` wrote; raises ReconError that names file and key."""
        return cls.from_arrays(read_npz(path), path)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], path: str | os.PathLike[str]) -> Tracks:
        """Tracks from the arrays that :meth:`save` writes, by name; ``path`` stands in the errors."""
        if "xy" not in arrays:
            raise ReconError(f"{path}: has no key 'xy'; keys found: {', '.join(sorted(arrays)) or 'none'}")
        known = {"xy", "visible", "fps", "names", "edges", *_TENSORS}
        unknown = [key for key in arrays if key not in known and not key.startswith("extras/")]
        if unknown:
            raise ReconError(f"{path}: unknown key {unknown[0]!r}; tracks have {', '.join(sorted(known))}, extras/NAME")
        imaginary = [key for key, array in arrays.items() if array.dtype.kind == "c"]
        if imaginary:
            raise ReconError(f"{path}: {imaginary[0]}: is complex; real numbers are needed")
        fields: dict[str, Any] = {key: arrays[key] for key in arrays if key in known}
        try:
            if "fps" in fields:
                fields["fps"] = float(fields["fps"])
            if "names" in fields:
                fields["names"] = tuple(str(name) for name in fields["names"])
            if "edges" in fields:
                fields["edges"] = tuple((int(a), int(b)) for a, b in fields["edges"])
            extras = {key[7:]: torch.as_tensor(arrays[key]) for key in arrays if key.startswith("extras/")}
            return cls(**fields, extras=extras or None)
        except (TypeError, ValueError, OverflowError, RuntimeError) as error:
            raise ReconError(f"{path}: {error}") from error
