"""BVH: joint angles on a skeleton of constant bone lengths."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchrecon.io.writers.motion import Motion
from torchrecon.io.writers.skeleton import Skeleton, fit_skeleton

__all__ = ["encode"]

Array = NDArray[np.float64]
_KEEP = 1e-3  # weight of the previous frame's turn where the bones leave a joint's twist open


def encode(motion: Motion) -> bytes:
    """Joint angles of :func:`~torchrecon.io.writers.skeleton.fit_skeleton`, y up and z towards the camera.

    The format names no unit: the numbers are those of the motion. A joint with one child turns as little as its bone
    allows. A joint with several children takes the turn that fits them best, and each child gets a joint of its own
    at the same place (``PARENT_to_CHILD``) for what is left, so that limbs on one joint move freely. All rotation
    channels are Z, X, Y in degrees.

    Example:
        >>> bent = np.array([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0.0, 0, 0], [1, 0, 0], [1, 1, 0]]])
        >>> print(encode(Motion(bent, fps=10.0)).decode().splitlines()[1], encode(Motion(bent)).count(b"JOINT"))
        ROOT p1 4
    """
    skeleton = fit_skeleton(motion)
    lines, channels = _hierarchy(motion.names, skeleton, skeleton.positions * np.array([1.0, -1.0, -1.0]))
    values = np.concatenate(channels, 1)
    head = ["HIERARCHY", *lines, "MOTION", f"Frames: {len(values)}", f"Frame Time: {1 / motion.fps:.9f}"]
    rows = [" ".join(f"{value:.9g}" for value in row) for row in values]
    return ("\n".join(head + rows) + "\n").encode()


def _typical_frame(positions: Array, skeleton: Skeleton) -> int:
    """The frame whose bones point most like those of all frames together: the rest pose."""
    joints = skeleton.order[1:]
    bones = positions[:, joints] - positions[:, [skeleton.parents[joint] for joint in joints]]
    return int((bones * bones.sum(0)).sum((-1, -2)).argmax())


def _hierarchy(names: tuple[str, ...], skeleton: Skeleton, positions: Array) -> tuple[list[str], list[Array]]:
    """Lines of the hierarchy and blocks of channel values, depth first: the order in which the file is read."""
    rest = positions[_typical_frame(positions, skeleton)]
    lines: list[str] = []
    channels: list[Array] = []

    def start(title: str, offset: Array, turn: Array, depth: int, place: Array | None = None) -> None:
        pad = "\t" * depth
        position = "" if place is None else "Xposition Yposition Zposition "
        lines.extend([f"{pad}{title}", f"{pad}{{", f"{pad}\tOFFSET " + " ".join(f"{value:.9g}" for value in offset)])
        lines.append(f"{pad}\tCHANNELS {3 if place is None else 6} {position}Zrotation Xrotation Yrotation")
        channels.extend([] if place is None else [place])
        channels.append(_zxy_degrees(turn))

    still = np.broadcast_to(np.eye(3), (len(positions), 3, 3))
    # A stack and not recursion: a chain of points may be longer than Python's calls go deep.
    todo: list[tuple[int, Array, int] | tuple[int, int, Array, int] | str] = [(skeleton.order[0], still, 0)]
    while todo:
        item = todo.pop()
        if isinstance(item, str):
            lines.append(item)
        elif len(item) == 4:  # a joint of its own for one child among several
            joint, child, above, depth = item
            turn = _swing(above, rest[child] - rest[joint], positions[:, child] - positions[:, joint])
            start(f"JOINT {names[joint]}_to_{names[child]}", np.zeros(3), above.swapaxes(-1, -2) @ turn, depth)
            todo += ["\t" * depth + "}", (child, turn, depth + 1)]
        else:
            joint, above, depth = item
            parent, children = skeleton.parents[joint], skeleton.children(joint)
            bones, aims = rest[children] - rest[joint], positions[:, children] - positions[:, [joint]]
            turn = above
            if len(children) == 1:
                turn = _swing(above, bones[0], aims[:, 0])
            elif children:
                turn = _best_turn(above, bones, aims, follow=parent < 0)
            local = above.swapaxes(-1, -2) @ turn
            if parent < 0:
                start(f"ROOT {names[joint]}", np.zeros(3), local, depth, positions[:, joint])
            else:
                start(f"JOINT {names[joint]}", rest[joint] - rest[parent], local, depth)
            todo.append("\t" * depth + "}")
            if not children:
                pad = "\t" * (depth + 1)
                lines += [f"{pad}End Site", f"{pad}{{", f"{pad}\tOFFSET 0 0 0", f"{pad}}}"]
            elif len(children) == 1:
                todo.append((children[0], turn, depth + 1))
            else:
                todo += [(joint, child, turn, depth + 1) for child in reversed(children)]
    return lines, channels


def _swing(above: Array, bone: Array, aim: Array) -> Array:
    """The turn nearest to ``above`` that brings ``bone`` (3,) into the direction of ``aim`` (frames, 3)."""
    if not bone.any():
        return above
    # Both are made units here, not by the known length: what is a hair too long grows with every bone of a chain.
    start, end = above @ bone, np.where(aim.any(-1, keepdims=True), aim, above @ bone)
    start = start / np.linalg.norm(start, axis=-1, keepdims=True)
    end = end / np.linalg.norm(end, axis=-1, keepdims=True)
    half = start + end
    size = np.linalg.norm(half, axis=-1, keepdims=True)
    # Opposite directions: any axis across the bone is as short a way; the one farthest from it is well defined.
    across = np.eye(3)[np.abs(start).argmin(-1)]
    across = across - (across * start).sum(-1, keepdims=True) * start
    half = np.where(size > 1e-9, half, across)
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    # A half turn about the start, then one about the bisector: together the shortest turn from start to end.
    return _half_turn(half) @ _half_turn(start) @ above


def _half_turn(axis: Array) -> Array:
    return 2.0 * axis[..., :, None] * axis[..., None, :] - np.eye(3)


def _best_turn(above: Array, bones: Array, aims: Array, follow: bool) -> Array:
    """The turn that brings ``bones`` (children, 3) nearest to ``aims`` (frames, children, 3) in least squares.

    What they leave open is kept from ``above``, or with ``follow`` from the frame before.
    """
    moment = np.einsum("fci,cj->fij", aims, bones)
    weight = _KEEP * float((bones**2).sum())
    if weight == 0.0:
        return above
    if not follow:
        return _nearest_rotation(moment + weight * above)
    turns = np.empty_like(moment)
    keep = above[0]
    for f, matrix in enumerate(moment):
        turns[f] = keep = _nearest_rotation(matrix + weight * keep)
    return turns


def _nearest_rotation(matrix: Array) -> Array:
    u, _, vt = np.linalg.svd(matrix)
    sign = np.ones((*matrix.shape[:-1], 1))
    sign[..., 2, 0] = np.sign(np.linalg.det(u @ vt))
    return (u * sign.swapaxes(-1, -2)) @ vt


def _zxy_degrees(turn: Array) -> Array:
    """Angles (frames, 3) about z, x, y with turn = Rz Rx Ry, without jumps of whole turns over time."""
    sine = np.clip(turn[:, 2, 1], -1.0, 1.0)
    locked = np.abs(sine) > 1.0 - 1e-12  # z and y turn about one axis: all of it goes to z
    z = np.where(locked, np.arctan2(turn[:, 1, 0], turn[:, 0, 0]), np.arctan2(-turn[:, 0, 1], turn[:, 1, 1]))
    y = np.where(locked, 0.0, np.arctan2(-turn[:, 2, 0], turn[:, 2, 2]))
    return np.rad2deg(np.unwrap(np.stack([z, np.arcsin(sine), y], -1), axis=0))
