"""The field's public sequences: eight non-rigid motions with ground truth, as distributed in MATLAB files."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from torchrecon._typing import Float, Tensor
from torchrecon.errors import ReconError

__all__ = ["SEQUENCES", "Benchmark", "load_benchmark"]

SEQUENCES = ("drink", "pickup", "yoga", "stretch", "dance", "walking", "face", "shark")
"""The eight names; ``shark`` is stored as ``jaws``."""


@dataclass(frozen=True, eq=False)
class Benchmark:
    """One sequence with ground truth.

    Attributes:
        name: of the sequence, one of :data:`SEQUENCES` where it was read by :func:`load_benchmark`.
        points3d: (frames, points, 3) truth in camera axes; the orthographic input is its first two coordinates.
        canonical: (frames, points, 3) truth in world axes, in the unit of ``points3d``; None where the files hold
            none.
        edges: pairs of points joined by a bone (0-based).
        stored_pta: (frames, points, 3) result of trajectory-space factorisation (PTA, Akhter et al. 2008) that the
            Akhter files carry, world axes, in the unit of ``canonical``; None elsewhere.
    """

    name: str
    points3d: Float[Tensor, "frames points 3"]
    canonical: Float[Tensor, "frames points 3"] | None = None
    edges: tuple[tuple[int, int], ...] = ()
    stored_pta: Float[Tensor, "frames points 3"] | None = None


def _mat(path: Path, key: str) -> dict[str, np.ndarray]:
    from scipy.io import loadmat

    if not path.is_file():
        raise ReconError(f"{path}: no such file; --data must be the folder that holds akhter/ and camera_frame/")
    try:
        content = loadmat(path)
    except (ValueError, NotImplementedError, OSError) as error:
        raise ReconError(f"{path}: is not a readable MATLAB file ({error})") from error
    if key not in content:
        raise ReconError(f"{path}: has no variable {key!r}")
    return {name: value for name, value in content.items() if isinstance(value, np.ndarray)}


def _frames(matrix: np.ndarray) -> Tensor:
    """(3F, P), three rows a frame, to (F, P, 3)."""
    return torch.from_numpy(np.ascontiguousarray(matrix, np.float64)).unflatten(0, (-1, 3)).mT.contiguous()


def load_benchmark(name: str, folder: str | os.PathLike[str]) -> Benchmark:
    """Read one sequence.

    Args:
        name: of the sequence, one of :data:`SEQUENCES` where it was read by :func:`load_benchmark`.
        folder: holds ``camera_frame/NAME_rearranged.mat`` (X, 3 x P x F, camera axes) and, for the Akhter
            sequences, ``akhter/NAME.mat`` (S, 3F x P, world axes).

    Raises:
        ReconError: unknown name, missing or unreadable file.
    """
    if name not in SEQUENCES:
        raise ReconError(f"sequence {name!r} is not one of {', '.join(SEQUENCES)}")
    root, stem = Path(folder), "jaws" if name == "shark" else name
    x = _mat(root / "camera_frame" / f"{stem}_rearranged.mat", "X")["X"]
    camera = torch.from_numpy(np.ascontiguousarray(x, np.float64)).permute(2, 1, 0).contiguous()
    if name not in SEQUENCES[:5]:
        return Benchmark(name, camera)
    content = _mat(root / "akhter" / f"{name}.mat", "S")
    edges = tuple((int(a) - 1, int(b) - 1) for a, b in content.get("list", np.empty((0, 2))))
    canonical = _frames(content["S"])
    centred = canonical - canonical.mean(-2, keepdim=True)
    moved = camera - camera.mean(-2, keepdim=True)
    # The two files of a sequence differ by one constant factor.
    unit = moved.norm() / centred.norm()
    canonical, centred = canonical * unit, centred * unit
    # The stored estimate is in units of the mean over frames and axes of the standard deviation over points.
    sigma = centred.square().mean(-2).sqrt().mean()
    stored = _frames(content["Shat"]) * sigma if "Shat" in content else None
    return Benchmark(name, camera, canonical, edges, stored)
