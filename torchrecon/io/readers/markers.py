"""Files that hold 3D positions already: C3D, TRC, BVH, free throws of the SPL Open Data.

They need no reconstruction, so they become tracks only on request: ``view`` projects them orthographically, as a
camera far away would see them, and one pixel then stands for one millimetre.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrecon.data import Markers, read_bvh, read_c3d, read_trc
from torchrecon.io.readers.base import Format, ReadOptions, build
from torchrecon.io.readers.layouts import Layout
from torchrecon.io.readers.people import alone
from torchrecon.io.readers.source import Floats, Source, numbers
from torchrecon.measurement import Tracks

__all__ = [
    "BVH",
    "C3D",
    "FREE_THROW",
    "TRC",
    "VIEWS",
    "project",
    "read_bvh_markers",
    "read_c3d_markers",
    "read_free_throw",
    "read_trc_markers",
]

VIEWS = ("front", "side", "top")
# Image right and image up in the laboratory, by vertical axis: front looks along the horizontal axis that makes x (or
# for x up, y) point right; side looks against that axis; top looks down.
_AXES = {
    "y": {"front": (("x", 1), ("y", 1)), "side": (("z", -1), ("y", 1)), "top": (("x", 1), ("z", -1))},
    "z": {"front": (("x", 1), ("z", 1)), "side": (("y", 1), ("z", 1)), "top": (("x", 1), ("y", 1))},
    "x": {"front": (("y", 1), ("x", 1)), "side": (("z", 1), ("x", 1)), "top": (("y", 1), ("z", 1))},
}
_MM = 1000.0


def project(
    source: Source,
    options: ReadOptions,
    positions: Floats,
    up: str,
    fps: float | None = None,
    names: Sequence[str] = (),
    edges: Sequence[tuple[int, int]] = (),
) -> Tracks:
    """Orthographic view of 3D positions.

    Args:
        source: stands in the errors.
        options: ``view`` is front, side or top; None is an error that says what the file is good for.
        positions: (frames, points, 3) millimetres, NaN where a point was not seen.
        up: vertical axis, x, y or z.
        fps: frames per second.
        names: of the points.
        edges: bones.

    Raises:
        ReconError: no view was asked for, or an unknown one.
    """
    alone(source, options)
    if options.view is None:
        raise source.error(
            f"holds 3D positions already ({positions.shape[1]} points, {positions.shape[0]} frames), so there is "
            "nothing to reconstruct. To try a reconstruction on one view of them give view='front', 'side' or 'top' "
            "(on the command line --view); the 3D positions are then its ground truth"
        )
    if options.view not in VIEWS:
        raise source.error(f"view {options.view!r} is unknown; use one of {', '.join(VIEWS)}")
    (right, sign), (upward, lift) = _AXES[up][options.view]
    xy = np.stack([sign * positions[..., "xyz".index(right)], -lift * positions[..., "xyz".index(upward)]], -1)
    layout = Layout(tuple(names), tuple(edges)) if names else None
    return build(source, options, xy, layout=layout, fps=fps)


def _from_markers(source: Source, options: ReadOptions | None, markers: Markers) -> Tracks:
    positions = _MM * markers.positions.double().numpy()
    return project(source, options or ReadOptions(), positions, markers.up, markers.fps, markers.names)


def read_c3d_markers(source: Source, options: ReadOptions | None = None) -> Tracks:
    """One view of a C3D file, see :func:`project`."""
    return _from_markers(source, options, read_c3d(source.plain_path))


def read_trc_markers(source: Source, options: ReadOptions | None = None) -> Tracks:
    """One view of a TRC file, see :func:`project`."""
    return _from_markers(source, options, read_trc(source.plain_path))


def read_bvh_markers(source: Source, options: ReadOptions | None = None) -> Tracks:
    """One view of the joints of a BVH file, see :func:`project`; centimetres are taken, the format states no unit."""
    clip = read_bvh(source.plain_path)
    edges = [(parent, joint) for joint, parent in enumerate(clip.parents) if parent >= 0]
    positions = _MM * clip.joints.double().numpy()
    return project(source, options or ReadOptions(), positions, "y", clip.fps, clip.names, edges)


def _sniff_free_throw(source: Source) -> bool:
    if source.kind != "json" or not isinstance(source.json, dict):
        return False
    frames = source.json.get("tracking")
    first = frames[0] if isinstance(frames, list) and frames else None
    return isinstance(first, dict) and isinstance(first.get("data"), dict) and "player" in first["data"]


def read_free_throw(source: Source, options: ReadOptions | None = None) -> Tracks:
    """One view of the player of a free throw (MLSE SPL Open Data: feet, z up); the ball is left out.

    Raises:
        ReconError: a frame without player, joints that change from frame to frame, no view asked for.
    """
    frames = source.json["tracking"]
    joints: tuple[str, ...] = ()
    rows, milliseconds = [], []
    for index, frame in enumerate(frames):
        data = frame.get("data") if isinstance(frame, dict) else None
        player = data.get("player") if isinstance(data, dict) else None
        if not isinstance(player, dict) or not player:
            raise source.error(f"frame {index}: has no data.player")
        joints = joints or tuple(player)
        if set(player) != set(joints):
            raise source.error(f"frame {index}: its joints are others than those of frame 0")
        rows.append([player[name] for name in joints])
        milliseconds.append(frame.get("time"))
    feet = numbers(source, rows, "tracking", columns=3)
    if feet.ndim != 3:
        raise source.error(f"tracking: shape {feet.shape}; x, y, z per joint are needed")
    # The times are whole milliseconds, so the rate is that of the whole recording, not of one step.
    times = numbers(source, milliseconds, "time").reshape(-1)
    span = float(times[-1] - times[0]) if len(times) == len(rows) else 0.0
    fps = 1000.0 * (len(rows) - 1) / span if 1.0 <= span < 1e9 and len(rows) > 1 else None
    names = tuple(str(name)[:100] for name in joints)
    with np.errstate(over="ignore"):
        return project(source, options or ReadOptions(), 304.8 * feet, "z", fps, names)


def _begins(source: Source, word: bytes) -> bool:
    return source.kind == "text" and source.data[:200].removeprefix(b"\xef\xbb\xbf").lstrip().startswith(word)


C3D = Format("C3D", lambda source: source.kind == "c3d", read_c3d_markers)
TRC = Format("TRC", lambda source: _begins(source, b"PathFileType"), read_trc_markers)
BVH = Format("BVH", lambda source: _begins(source, b"HIERARCHY"), read_bvh_markers)
FREE_THROW = Format("SPL free throw JSON", _sniff_free_throw, read_free_throw)
