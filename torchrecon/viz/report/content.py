"""Everything the page shows, as plain data and packed arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrecon.measurement import RankEstimate, Reconstruction, Tracks
from torchrecon.viz.report.payload import Block, pack_bits, pack_series
from torchrecon.viz.report.series import as_array, bone_lengths, finite, lanes
from torchrecon.viz.report.words import absences, headline, unit_of, words

__all__ = ["content", "plain", "times_of"]

Array = NDArray[Any]
# Steps from the centre to the edge of the 3D view, the finest that fits; the last is still finer than a large screen.
_FINENESS = (2048, 1024, 512)
_BORDER = 8.0  # positions further out than this many times the view are drawn at the border
_ELLIPSOIDS = 400  # more of them hide one another
_POINTS_SHARE = 0.5  # of the page; the film gets the rest


def content(
    rec: Reconstruction, tracks: Tracks | None, rank: RankEstimate | None, film: bool, max_bytes: int
) -> tuple[dict[str, Any], dict[str, Block]]:
    """The data of the page, and the arrays that it unpacks.

    Args:
        rec, tracks, rank: see ``build_report``.
        film: whether pictures follow.
        max_bytes: of the whole page.
    """
    points = as_array(rec.points3d)
    known = finite(points)
    seen = known if rec.observed is None else rec.observed.cpu().numpy() & known
    if tracks is not None:
        seen = tracks.visible.cpu().numpy()
    xy = as_array(rec.reproject() if tracks is None else tracks.xy)
    # Wrongly tracked points must not decide the scale of the picture.
    reach, deep = _reach(points, known, seen)
    edges = () if tracks is None or tracks.edges is None else tracks.edges
    unit, (corner, size) = unit_of(rec, tracks), _canvas(xy)
    drawn, blocks = _fitting(points, xy, known, seen, reach, edges, int(_POINTS_SHARE * max_bytes))
    said = words(rec, tracks, rank, float(seen.mean()), int((~known).sum()))
    notes = [{"kind": word.kind, "title": word.title, "text": word.text} for word in said]
    if len(drawn) < points.shape[1]:
        text = (
            f"To keep the page small, {len(drawn)} of {points.shape[1]} points are drawn; all numbers use all points."
        )
        notes.append({"kind": "note", "title": "Points left out of the drawing", "text": text})
    spread = None
    if rec.covariance3d is not None:
        chosen = np.unique(np.linspace(0, len(drawn) - 1, min(_ELLIPSOIDS, len(drawn))).astype(int))
        blocks["spread"] = _spread(as_array(rec.covariance3d)[:, drawn[chosen]], reach)
        spread = {"points": chosen.tolist(), "step": blocks["spread"].step}
    place = {int(point): index for index, point in enumerate(drawn)}
    names = None if tracks is None or tracks.names is None else [tracks.names[i] for i in drawn]
    status = rec.statuses[0]
    return {
        "status": {"ok": status.ok, "code": status.code, "headline": headline(status.code), "text": status.text},
        "unit": unit.short,
        "frames": points.shape[0],
        "points": points.shape[1],
        "drawn": len(drawn),
        "ids": drawn.tolist(),
        "names": names,
        "edges": [[place[a], place[b]] for a, b in edges],
        "reach": reach,
        "deep": deep,
        "floor": _floor(points, known, reach),
        "corner": corner,
        "size": size,
        "steps": {"points": blocks["points"].step, "xy": blocks["xy"].step},
        "spread": spread,
        "tracked": tracks is not None,
        "mirror": rec.intrinsics is None,
        "camera": _camera(rec),
        "rank": _rank(rec, rank),
        "lanes": [
            {
                "key": lane.key,
                "label": lane.label,
                "unit": lane.unit,
                "hint": lane.hint,
                "total": lane.total,
                "sigma": lane.sigma,
            }
            | {"values": plain(_short(lane.values))}
            for lane in lanes(rec, tracks, seen, unit.short)
        ],
        "bones": _bones(points, edges, tracks),
        "words": notes,
        "absent": absences(rec, tracks, rank, film),
    }, blocks


def _fitting(
    points: Array, xy: Array, known: Array, seen: Array, reach: float, edges: Sequence[tuple[int, int]], room: int
) -> tuple[Array, dict[str, Block]]:
    """As fine and as many points as fit into ``room`` characters, bones always among them."""
    frames, count = known.shape
    ends = np.unique(np.asarray(edges, dtype=int).reshape(-1))
    shape = np.where(known[..., None], np.clip(points, -_BORDER * reach, _BORDER * reach), np.nan)
    flat = np.where(finite(xy)[..., None], xy, np.nan)
    size = max(float(np.nanquantile(np.abs(flat), 0.999)), 1.0) if finite(xy).any() else 1.0

    def packed(drawn: Array, fineness: int) -> dict[str, Block]:
        return {
            "points": pack_series(shape[:, drawn].reshape(frames, -1), reach / fineness),
            "xy": pack_series(flat[:, drawn].reshape(frames, -1), size / (4 * fineness)),
            "seen": pack_bits(seen[:, drawn]),
            "known": pack_bits(known[:, drawn]),
        }

    def length(blocks: Mapping[str, Block]) -> int:
        return sum(len(block.text) for block in blocks.values())

    rungs = [(1, fineness) for fineness in _FINENESS]
    rungs += [(2**power, _FINENESS[-1]) for power in range(1, count.bit_length() + 1)]
    for stride, fineness in rungs:
        drawn = np.union1d(np.arange(0, count, stride), ends)
        # A few of the points tell how large all of them will be.
        few = drawn[:: max(1, len(drawn) // 128)]
        last = (stride, fineness) == rungs[-1]
        if not last and length(packed(few, fineness)) * len(drawn) > 1.1 * room * len(few):
            continue
        blocks = packed(drawn, fineness)
        if last or length(blocks) <= room:
            break
    return drawn, blocks


def _spread(covariance: Array, reach: float) -> Block:
    """Square roots of the covariances, six numbers each (xx, xy, xz, yy, yz, zz); zero where there is none."""
    good = finite(covariance.reshape(*covariance.shape[:-2], 9))
    values, vectors = np.linalg.eigh(np.where(good[..., None, None], covariance, 0.0))
    root = (vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]) @ vectors.swapaxes(-1, -2)
    rows, columns = np.triu_indices(3)
    return pack_series(root[..., rows, columns].reshape(len(root), -1), reach / 4096)


def _reach(points: Array, known: Array, seen: Array) -> tuple[float, float]:
    """Half the side of a cube that holds the shape, and half its usual depth; > 0 also where nothing is known."""
    if not known.any():
        return 1.0, 1.0
    sure = points[known & seen] if (known & seen).any() else points[known]
    reach = max(float(np.quantile(np.abs(sure), 0.995)), float(np.quantile(np.abs(points[known]), 0.98)))
    deep = float(np.quantile(np.abs(sure[:, 2]), 0.95))
    return reach or 1.0, deep or reach or 1.0


def _floor(points: Array, known: Array, reach: float) -> float:
    """Height (y down) of the grid under the shape."""
    return float(np.quantile(points[..., 1][known], 0.99)) if known.any() else reach


def _canvas(xy: Array) -> tuple[list[float], list[float]]:
    """Corner (x, y) and (height, width) of a picture that holds the points, for a page without a film."""
    inside = xy[finite(xy)]
    if not len(inside):
        return [0.0, 0.0], [480.0, 640.0]
    low, high = np.quantile(inside, [0.002, 0.998], axis=0)
    margin = 0.08 * float((high - low).max()) + 1.0
    wide, tall = (high - low + 2 * margin).tolist()
    return (low - margin).tolist(), [tall, wide]


def _camera(rec: Reconstruction) -> dict[str, Any]:
    return {
        "intrinsics": None if rec.intrinsics is None else plain(as_array(rec.intrinsics).tolist()),
        "scale": plain(_short(as_array(rec.scale), 7)),
        "translation": plain(_short(as_array(rec.translation), 7)),
        "rotations": plain(_short(as_array(rec.rotations).reshape(-1, 9), 6)),
    }


def _rank(rec: Reconstruction, rank: RankEstimate | None) -> dict[str, Any]:
    found: dict[str, Any] = {"k": int(rec.rank), "degree": plain(float(rec.deformation_degree)), "estimate": None}
    if rank is not None:
        found["estimate"] = {
            "k": int(rank.rank),
            "degree": plain(float(rank.deformation_degree)),
            "interval": [int(end) for end in rank.interval],
            "rule": rank.rule,
            "layout": rank.layout,
            "eigenvalues": plain(_short(as_array(rank.eigenvalues)[:200])),
            "threshold": plain(_short(as_array(rank.threshold)[:200])),
        }
    return found


def _bones(points: Array, edges: Sequence[tuple[int, int]], tracks: Tracks | None) -> list[dict[str, Any]]:
    lengths = bone_lengths(points, tuple(edges))
    names = tracks.names if tracks is not None and tracks.names is not None else None

    def name(point: int) -> str:
        return names[point] if names is not None else str(point)

    return [
        {"name": f"{name(a)} \u2013 {name(b)}", "values": plain(_short(lengths[:, i], 4))}
        for i, (a, b) in enumerate(edges)
    ]


def times_of(tracks: Tracks | None, frames: int, fps: float) -> list[float]:
    if tracks is None:
        return [frame / fps for frame in range(frames)]
    times: list[float] = (tracks.times - tracks.times[..., :1]).tolist()
    return times


def _short(values: Array, digits: int = 5) -> Any:
    """Numbers with as many digits as a screen can show, so that the page stays small."""
    return [_short(row, digits) for row in values] if values.ndim > 1 else [float(f"{v:.{digits}g}") for v in values]


def plain(value: Any) -> Any:
    """What JSON can hold: numbers that are not finite become null, what it does not know becomes text."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int, str)) else str(value)
