"""A skeleton of constant bone lengths fitted to moving points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchrecon.io.writers.motion import Motion

__all__ = ["Skeleton", "fit_skeleton", "rigid_tree", "root_tree"]

Array = NDArray[np.float64]
_TIE = 1e-3  # of a bone's length: all pairs of a rigid body vary equally little, then short bones win


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Bones of constant length that follow the points.

    Attributes:
        parents: parent of each point, -1 for the root.
        order: all points, each after its parent.
        lengths: (points,) length of the bone to the parent: the median over the frames; 0 for the root.
        positions: (frames, points, 3) of the fitted joints, camera axes.
    """

    parents: tuple[int, ...]
    order: tuple[int, ...]
    lengths: Array
    positions: Array

    def children(self, joint: int) -> list[int]:
        """Children of a joint, in the order of their indices."""
        return [child for child, parent in enumerate(self.parents) if parent == joint]


def _change_of_distance(points: Array) -> Array:
    """(points, points): standard deviation over time of each pair's distance, ties broken by its mean."""
    count = points.shape[1]
    first = np.linalg.norm(points[0][:, None] - points[0], axis=-1)
    total, square = np.zeros((count, count)), np.zeros((count, count))
    for frame in points:  # frame by frame, the memory of one matrix; about the first, so that digits are kept
        change = np.linalg.norm(frame[:, None] - frame, axis=-1) - first
        total += change
        square += change**2
    mean = total / len(points)
    return np.sqrt(np.maximum(square / len(points) - mean**2, 0.0)) + _TIE * (first + mean)


def rigid_tree(points: Array, edges: Sequence[tuple[int, int]] = ()) -> list[tuple[int, int]]:
    """Spanning tree whose bones change their length least; given edges are taken before any other pair.

    Where the given edges close a circle, the bone of the circle that changes most is left out; parts that they do not
    join are joined by the most rigid pair.

    Args:
        points: (frames, points, 3).
        edges: known bones.

    Returns:
        points - 1 pairs (near, far) in the order in which the tree grew from point 0.

    Example:
        >>> line = np.array([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 5, 0]]])
        >>> rigid_tree(line), rigid_tree(line, [(0, 3)])
        ([(0, 1), (1, 2), (2, 3)], [(0, 3), (0, 1), (1, 2)])
    """
    cost = _change_of_distance(points)
    reach = cost.max() + 1.0
    preferred = np.full_like(cost, reach)
    for a, b in edges:
        preferred[a, b] = preferred[b, a] = 0.0
    cost = cost + preferred
    # Prim's rule: the cheapest pair from the tree to a point outside it.
    best, source = cost[0].copy(), np.zeros(len(cost), int)
    inside = np.zeros(len(cost), bool)
    inside[0] = True
    tree = []
    for _ in range(len(cost) - 1):
        far = int(np.where(inside, np.inf, best).argmin())
        tree.append((int(source[far]), far))
        inside[far] = True
        nearer = cost[far] < best
        best[nearer], source[nearer] = cost[far][nearer], far
    return tree


def root_tree(tree: Sequence[tuple[int, int]], lengths: Sequence[float]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Parents and an order (parents first) of a tree, rooted where the way to all other points is shortest.

    Args:
        tree: pairs that span the points.
        lengths: length of each pair.

    Example:
        >>> root_tree([(0, 1), (1, 2)], [1.0, 1.0])
        ((1, -1, 1), (1, 0, 2))
    """
    count = len(tree) + 1
    near: list[list[tuple[int, float]]] = [[] for _ in range(count)]
    for (a, b), length in zip(tree, lengths, strict=True):
        near[a].append((b, float(length)))
        near[b].append((a, float(length)))

    parents, order = _walk(near, 0)
    below = [1] * count
    for joint in reversed(order[1:]):
        below[parents[joint]] += below[joint]
    way = [0.0] * count  # to all points, less that of point 0: a step down a bone brings nearer what is below it
    for joint in order[1:]:
        length = dict(near[joint])[parents[joint]]
        way[joint] = way[parents[joint]] + length * (count - 2 * below[joint])
    parents, order = _walk(near, min(range(count), key=way.__getitem__))
    return tuple(parents), tuple(order)


def _walk(near: Sequence[Sequence[tuple[int, float]]], root: int) -> tuple[list[int], list[int]]:
    parents, order, seen = [-1] * len(near), [root], {root}
    for joint in order:
        for other, _ in sorted(near[joint]):
            if other not in seen:
                seen.add(other)
                parents[other] = joint
                order.append(other)
    return parents, order


def fit_skeleton(motion: Motion) -> Skeleton:
    """Constant bone lengths, and joints that aim their bones at the points.

    The tree is :func:`rigid_tree` over the motion's edges. The root follows its point; every other joint lies at the
    median length of its bone from its parent's joint, in the direction of its own point, so that what a length is
    wrong in one frame does not shift what hangs on it.

    Example:
        >>> bent = np.array([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0.0, 0, 0], [1, 0, 0], [1, 1, 0]]])
        >>> fit_skeleton(Motion(bent)).lengths.tolist()
        [1.0, 0.0, 1.0]
    """
    points = motion.points
    tree = rigid_tree(points, motion.edges)
    medians = [float(np.median(np.linalg.norm(points[:, a] - points[:, b], axis=-1))) for a, b in tree]
    parents, order = root_tree(tree, medians)
    of_bone = {frozenset(pair): median for pair, median in zip(tree, medians, strict=True)}
    lengths = np.array([0.0 if p < 0 else of_bone[frozenset((j, p))] for j, p in enumerate(parents)])
    positions = points.copy()
    for joint in order[1:]:
        aim = points[:, joint] - positions[:, parents[joint]]
        far = np.linalg.norm(aim, axis=-1, keepdims=True)
        # A point that lies on its parent's joint names no direction; the bone keeps the camera's down.
        unit = np.where(far > 0, aim / np.where(far > 0, far, 1.0), np.array([0.0, 1.0, 0.0]))
        positions[:, joint] = positions[:, parents[joint]] + lengths[joint] * unit
    return Skeleton(parents, order, lengths, positions)
