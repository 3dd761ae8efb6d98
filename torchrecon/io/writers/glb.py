"""Animated glTF 2.0 in one binary file."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrecon.io.writers.motion import Motion

__all__ = ["encode"]

_FLOAT, _SHORT = 5126, 5123
_VERTICES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32)
_FACES = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], np.uint16)
_THICK, _THIN = 0.012, 0.005  # radii of points and bones, of the reach of the whole motion


class _Buffer:
    """The binary chunk with its views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray[Any], kind: str, target: int | None = None) -> int:
        """Append an array (count, components) and return the number of its accessor."""
        array = np.ascontiguousarray(array)
        content = array.astype(array.dtype.newbyteorder("<")).tobytes()
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        self.views.append(view if target is None else view | {"target": target})
        self.data += content + bytes(-len(content) % 4)
        rows = array.reshape(len(array), -1)
        self.accessors.append(
            {
                "bufferView": len(self.views) - 1,
                "componentType": _SHORT if array.dtype == np.uint16 else _FLOAT,
                "count": len(array),
                "type": kind,
                "min": [item.item() for item in rows.min(0)],
                "max": [item.item() for item in rows.max(0)],
            }
        )
        return len(self.accessors) - 1


def encode(motion: Motion) -> bytes:
    """One node a point with an animated translation, one a bone with animated place, turn and length.

    Axes y up, z towards the viewer, single precision. The format's unit is the metre; where the motion is in another
    unit the numbers stay as they are and ``asset.extras.unit`` names it.

    Example:
        >>> encode(Motion(np.zeros((2, 1, 3))))[:4]
        b'glTF'
    """
    points = motion.upright.astype(np.float32)
    reach = float(np.linalg.norm(points - points.reshape(-1, 3).mean(0), axis=-1).max()) or 1.0
    buffer = _Buffer()
    vertices = buffer.add(_VERTICES, "VEC3", 34962)
    faces = buffer.add(_FACES.reshape(-1, 1), "SCALAR", 34963)
    times = buffer.add(np.arange(len(points), dtype=np.float32)[:, None] / np.float32(motion.fps), "SCALAR")
    nodes: list[dict[str, Any]] = []
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def animate(path: str, values: NDArray[np.float32]) -> None:
        output = buffer.add(values, "VEC4" if path == "rotation" else "VEC3")
        samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})
        channels.append({"sampler": len(samplers) - 1, "target": {"node": len(nodes) - 1, "path": path}})

    for index, name in enumerate(motion.names):
        start = [value.item() for value in points[0, index]]
        nodes.append({"name": name, "mesh": 0, "scale": [_THICK * reach] * 3, "translation": start})
        animate("translation", points[:, index])
    for a, b in motion.edges:
        place, turn, size = _bone(points[:, a], points[:, b], _THIN * reach)
        nodes.append({"name": f"{motion.names[a]}--{motion.names[b]}", "mesh": 1})
        for path, values in (("translation", place), ("rotation", turn), ("scale", size)):
            nodes[-1][path] = [value.item() for value in values[0]]
            animate(path, values)
    document = {
        "asset": {"version": "2.0", "generator": "torchrecon", "extras": {"unit": motion.unit, "fps": motion.fps}},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": vertices}, "indices": faces, "material": m}]}
            for m in range(2 if motion.edges else 1)
        ],
        "materials": [_material("points", [0.9, 0.35, 0.0]), _material("bones", [0.35, 0.7, 0.9])],
        "animations": [{"name": "motion", "samplers": samplers, "channels": channels}],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + len(buffer.data)
    parts = [struct.pack("<4sII", b"glTF", 2, total), struct.pack("<I4s", len(text), b"JSON"), text]
    return b"".join([*parts, struct.pack("<I4s", len(buffer.data), b"BIN\0"), bytes(buffer.data)])


def _material(name: str, colour: list[float]) -> dict[str, Any]:
    return {"name": name, "pbrMetallicRoughness": {"baseColorFactor": [*colour, 1.0], "metallicFactor": 0.0}}


def _bone(start: NDArray[np.float32], end: NDArray[np.float32], radius: float) -> tuple[NDArray[np.float32], ...]:
    """Place (frames, 3), turn (frames, 4; x y z w) and size (frames, 3) that lay the y axis from start to end."""
    along = (end - start).astype(np.float64)
    length = np.linalg.norm(along, axis=-1)
    unit = np.where(length[:, None] > 0, along / np.where(length > 0, length, 1.0)[:, None], np.array([0.0, 1.0, 0.0]))
    # The shortest turn from y to the bone is (y x unit, 1 + y . unit) normalised; straight down it is about x.
    turn = np.stack([unit[:, 2], np.zeros(len(unit)), -unit[:, 0], 1.0 + unit[:, 1]], -1)
    turn = np.where(turn[:, 3:] > 1e-9, turn, np.array([1.0, 0.0, 0.0, 0.0]))
    turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
    flip = np.cumprod(np.where((turn[1:] * turn[:-1]).sum(-1) < 0, -1.0, 1.0))  # neighbours on one side: no whirl
    turn[1:] *= flip[:, None]
    size = np.stack([np.full(len(unit), radius), np.maximum(length / 2, 1e-9), np.full(len(unit), radius)], -1)
    return tuple(part.astype(np.float32) for part in ((start + end) / 2, turn, size))
