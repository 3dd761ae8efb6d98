"""Figures 8 and 9: scattering points of a turning body, against deflection, frames and signal-to-noise ratio.

A body of the synthetic world turns before an orthographic camera, all points seen in all frames, as the paper's
protocol has it: ``turn`` degrees about the vertical in all, while the view nods by 15 degrees. SNR: mean square of the
image coordinates about their centre over the noise variance per coordinate. Pro-D is the disparity M^2 of
``procrustes_disparity`` with one depth sign per sequence, since parallel views leave the mirror open.

The floor is the error that least squares makes of the same noise when all rotations are known and the body is rigid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchrecon as tr
from eval.job import Cache, digest, read_arrays, run_parallel, source_digest, write_arrays
from torchrecon._typing import Float, Tensor
from torchrecon.data.synthetic import SyntheticClip, sample_body, sample_motion, static_camera
from torchrecon.errors import ReconError
from torchrecon.linalg import rotation_from_vector
from torchrecon.metrics import procrustes_disparity, similarity_align
from torchrecon.render.raycast import local_to_outer

__all__ = ["Cell", "deflection_cells", "grid_cells", "known_rotation_shape", "measure", "target_lines", "turned_body"]

_NOD = 15.0  # degrees to either side; a turn about one axis alone is the special case that rules of K must not need
_EXTENT = 100.0  # pixels per metre
_SECONDS = 2.4  # of motion, whatever the number of frames: more frames are more looks at the same movement
POINTS = 30
STEPS = (1.0, 4.0, 8.0)
DEFLECTIONS = (3.0, 12.0, 45.0, 90.0, 180.0)
RATIO = 1.3  # target: M^2 over the floor of a rigid body, for at least 50 frames, 60 degrees and 10 dB


@dataclass(frozen=True)
class Cell:
    """One reconstruction.

    Attributes:
        body: ``rigid`` or ``non-rigid``.
        frames, turn, snr: count; degrees in all; decibels.
        solver: of ``torchrecon.reconstruct``.
        seed: of body, motion and noise.
    """

    body: str
    frames: int
    turn: float
    snr: float
    solver: str
    seed: int = 0

    def __str__(self) -> str:
        return f"{self.body} body, F {self.frames}, {self.turn:g} degrees, {self.snr:g} dB, {self.solver}"


def grid_cells(
    frames: Sequence[int], turns: Sequence[float], snr: Sequence[float], solvers: Sequence[str], trials: int
) -> list[Cell]:
    """All cells of Figure 9; the rigid solver sees the rigid body only."""
    return [
        Cell(body, f, turn, ratio, solver, seed)
        for body in ("rigid", "non-rigid")
        for solver in solvers
        if body == "rigid" or solver != "rigid"
        for turn in turns
        for ratio in snr
        for f in frames
        for seed in range(trials)
    ]


def deflection_cells(deflections: Sequence[float], steps: Sequence[float], snr: float) -> list[Cell]:
    """All cells of Figure 8 that have more than three frames."""
    pairs = ((turn, round(turn / step) + 1) for turn in deflections for step in steps)
    return [Cell("non-rigid", frames, turn, snr, "auto") for turn, frames in pairs if frames > 3]


def turned_body(cell: Cell) -> tuple[Float[Tensor, "frames points 3"], Float[Tensor, "frames 3 3"]]:
    """True points in camera axes, pixels, centred per frame, and the rotations of the turn.

    Example:
        >>> points, rotations = turned_body(Cell("rigid", 9, 90.0, 20.0, "auto"))
        >>> points.shape, bool(torch.allclose(points[5], points[0] @ (rotations[5] @ rotations[0].T).T))
        (torch.Size([9, 30, 3]), True)
    """
    g = torch.Generator().manual_seed(970_000_000 + cell.seed)
    body = sample_body(g)
    motion = sample_motion("pass", body, frames=cell.frames, fps=cell.frames / _SECONDS, generator=g)
    skin = SyntheticClip(body, motion, static_camera(motion, generator=g), seed=cell.seed).sample_surface(POINTS, g)
    world = local_to_outer(body.place(motion.joints.double(), motion.bones.double()), skin.part, skin.local.double())
    points = _EXTENT * world * world.new_tensor([1.0, -1.0, -1.0])  # y up, facing z -> y down, z away
    if cell.body == "rigid":
        points = points[:1].expand(cell.frames, -1, -1)
    points = points - points.mean(1, keepdim=True)
    t = torch.linspace(-0.5, 0.5, cell.frames, dtype=torch.float64)
    zero = torch.zeros_like(t)
    nod = math.radians(_NOD) * torch.sin(2 * math.pi * t)
    yaw = rotation_from_vector(torch.stack([zero, math.radians(cell.turn) * t, zero], -1))
    rotations = rotation_from_vector(torch.stack([nod, zero, zero], -1)) @ yaw
    return points @ rotations.mT, rotations


def noisy_views(points: Float[Tensor, "frames points 3"], cell: Cell) -> tuple[Float[Tensor, "frames points 2"], float]:
    """Image positions with noise, and its standard deviation in pixels."""
    xy = points[..., :2]
    sigma = float(xy.square().mean().sqrt()) * 10 ** (-cell.snr / 20)
    g = torch.Generator().manual_seed(971_000_000 + cell.seed)
    return xy + sigma * torch.randn(xy.shape, generator=g, dtype=xy.dtype), sigma


def known_rotation_shape(
    xy: Float[Tensor, "frames points 2"], rotations: Float[Tensor, "frames 3 3"]
) -> Float[Tensor, "points 3"]:
    """The rigid shape that fits the views best when every rotation is known: one least-squares solve.

    Example:
        >>> rotations = rotation_from_vector(torch.tensor([[0.0, 0, 0], [0, 0.7, 0], [0.4, 0, 0]]))
        >>> shape = torch.tensor([[1.0, 2, 3], [-1, -2, -3]])
        >>> bool(torch.allclose(known_rotation_shape((shape @ rotations.mT)[..., :2], rotations), shape, atol=1e-4))
        True
    """
    centred = xy - xy.mean(1, keepdim=True)
    views = centred.permute(0, 2, 1).flatten(0, 1)
    return torch.linalg.lstsq(rotations[:, :2].flatten(0, 1), views).solution.mT


def _solve(work: tuple[Cell, str]) -> None:
    """Reconstruct one cell and keep answer, truth and floor; a refusal is kept as its sentence."""
    cell, path = work
    truth, rotations = turned_body(cell)
    xy, sigma = noisy_views(truth, cell)
    eye = torch.eye(2, dtype=xy.dtype)
    tracks = tr.Tracks(xy + 300, covariance=(sigma**2 * eye).expand(*xy.shape[:2], 2, 2))
    # The solve is linear, so what it makes of the noise alone is its error, whatever the body does.
    floor = truth + known_rotation_shape(xy - truth[..., :2], rotations) @ rotations.mT
    arrays: dict[str, Any] = {"truth": truth, "floor": floor}
    try:
        answer = tr.reconstruct(tracks, solver=cell.solver, generator=torch.Generator().manual_seed(cell.seed))
        arrays |= {"points3d": answer.points3d, "rank": np.asarray(answer.rank)}
        note = str(answer.status)
    except ReconError as error:
        note = f"no answer: {error}"
    write_arrays(path, {**arrays, "note": np.asarray(note)})


def with_best_sign(points3d: Tensor, truth: Tensor) -> Tensor:
    """The answer or its mirror, once per sequence, whichever is nearer."""
    both = [points3d, points3d * points3d.new_tensor([1.0, 1.0, -1.0])]
    return min(both, key=lambda points: float(procrustes_disparity(points, truth)))


def measure(cells: Sequence[Cell], out: Path, workers: int, fresh: bool) -> list[dict[str, Any]]:
    """Both passes: solve what is not cached, then score every cell from the cache.

    Returns:
        For each cell its fields, ``disparity`` (per frame, then the mean; None without an answer) and its ``root``,
        ``disparity_sequence`` (one similarity for all frames), ``floor``, ``rank`` and ``note``, and the arrays
        ``points3d`` and ``truth``, aligned by that one similarity.
    """
    config = {"code": source_digest("torchrecon", "eval/figures/scatter.py")}
    cache = Cache(out / "cache" / "scatter", config, fresh)
    place = {cell: cache.path(f"{digest(asdict(cell))}.npz") for cell in cells}
    todo = [(cell, str(path)) for cell, path in place.items() if not path.is_file()]
    for _ in run_parallel(_solve, todo, workers, "reconstructions", name=lambda work: str(work[0])):
        pass
    records = []
    for cell, path in place.items():
        arrays = read_arrays(path)
        truth = torch.from_numpy(arrays["truth"])
        record = {**asdict(cell), "note": str(arrays["note"]), "rank": None, "disparity": None, "truth": truth}
        record["floor"] = float(procrustes_disparity(torch.from_numpy(arrays["floor"]), truth))
        if "points3d" in arrays:
            points = with_best_sign(torch.from_numpy(arrays["points3d"]), truth)
            aligned = similarity_align(points, truth)[0]
            disparity = float(procrustes_disparity(points, truth))
            record |= {"rank": int(arrays["rank"]), "disparity": disparity, "root": math.sqrt(disparity)}
            record["disparity_sequence"] = float((aligned - truth).square().sum() / truth.square().sum())
            record["points3d"] = aligned
        records.append(record)
    return records


def target_lines(records: Sequence[dict[str, Any]]) -> list[str]:
    """For each solver: how far above the floor the rigid body lies where the depth is determined."""
    lines = []
    judged = [r for r in records if r["body"] == "rigid" and r["frames"] >= 50 and r["turn"] >= 60 and r["snr"] >= 10]
    for solver in dict.fromkeys(r["solver"] for r in judged):
        ratios = [
            (math.inf if r["disparity"] is None else r["disparity"] / r["floor"], r)
            for r in judged
            if r["solver"] == solver
        ]
        worst, at = max(ratios, key=lambda item: item[0])
        kept = sum(value <= RATIO for value, _ in ratios)
        lines.append(
            f"rigid body, solver {solver}: M^2 at most {RATIO} x the floor in {kept} of {len(ratios)} cells with "
            f"F >= 50, turn >= 60, SNR >= 10 dB; worst {worst:.2f} x (F {at['frames']}, {at['turn']:g} degrees, "
            f"{at['snr']:g} dB: {at['note']})"
        )
    return lines
