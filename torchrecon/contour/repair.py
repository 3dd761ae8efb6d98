"""Repair of a sequence of silhouettes: what contradicts the kernel dynamical model is replaced by what it predicts.

A bite moves every sample of an equal-arc-length curve but only the nearby signed distances, so the vectors of the
model are truncated signed distances to the outline on a coarse grid that travels with the body.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.contour.kernel_dynamics import KernelDynamics
from torchrecon.errors import ReconError

__all__ = ["RepairParams", "RepairedSilhouettes", "repair_silhouettes"]

_FOLDS = 4
"""A frame is predicted without itself and every fourth from it, from neighbours on both sides."""

_LEAST_WRONG = 0.15
"""Summed differences below this are never repaired: a straight edge that is off by 1.5 % of the body's longer side."""


@dataclass(frozen=True)
class RepairParams:
    """Parameters of :func:`repair_silhouettes`.

    Attributes:
        kernel, n_components, ridge: of :class:`KernelDynamics`; broken sequences need a strong ridge. Fewer components
            are used where few frames are given.
        grid: points of the signed-distance grid along the longer side of the body.
        reach: signed distances are cut off there, as a share of the body's longer side.
        patch: standard deviation of the Gaussian over which the difference from the prediction is summed, share of
            the body's longer side.
        tolerance: the prediction is taken where that difference, the smallest over the frame's prediction and those of
            the frames beside it, exceeds this multiple of a frame's typical worst one.
        rounds: of fitting and repairing, at least 1.
    """

    kernel: Literal["rbf", "linear"] = "rbf"
    n_components: int = 20
    ridge: float = 10.0
    grid: int = 64
    reach: float = 0.1
    patch: float = 0.04
    tolerance: float = 3.0
    rounds: int = 1


@dataclass(frozen=True, eq=False)
class RepairedSilhouettes:
    """Silhouettes after repair.

    Attributes:
        masks: (frames, height, width).
        replaced: (frames, height, width) pixels that the model decided; a dropped frame whole.
        novelty: (frames) squared Mahalanobis deviation of each given silhouette from what the others say; NaN where
            none was given.
    """

    masks: Bool[Tensor, "frames height width"]
    replaced: Bool[Tensor, "frames height width"]
    novelty: Float[Tensor, " frames"]


@dataclass(frozen=True, eq=False)
class _Window:
    """A grid that travels with the body along a smooth path, so that a bad frame does not move its own window."""

    centre: NDArray[np.float64]  # (frames, 2) x, y of the grid's middle, pixels
    step: NDArray[np.float64]  # (frames) pixels from one grid point to the next
    rows: int
    cols: int

    def bounds(self, frame: int, size: tuple[int, int]) -> tuple[slice, slice]:
        """Rows and columns of the image that the grid covers."""
        half = self.step[frame] * np.array([self.cols, self.rows]) / 2
        low = np.clip(np.floor(self.centre[frame] - half), 0, [size[1] - 1, size[0] - 1]).astype(int)
        high = np.clip(np.ceil(self.centre[frame] + half) + 1, low + 1, [size[1], size[0]]).astype(int)
        return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))

    def to_grid(self, frame: int, mask: NDArray[np.bool_], reach: float) -> NDArray[np.float64]:
        """Truncated signed distances of a mask on the grid, in grid steps; positive inside."""
        inside = self.bounds(frame, mask.shape)
        distance = _signed_distance(mask[inside]) / self.step[frame]
        row = self.centre[frame, 1] + self.step[frame] * (np.arange(self.rows) - (self.rows - 1) / 2)
        col = self.centre[frame, 0] + self.step[frame] * (np.arange(self.cols) - (self.cols - 1) / 2)
        place = np.meshgrid(row - inside[0].start, col - inside[1].start, indexing="ij")
        values = ndimage.map_coordinates(distance, place, order=1, mode="nearest")
        return np.clip(values, -reach, reach)

    def to_image(self, frame: int, grid: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
        """Signed distances, pixels, in the part of the image that ``bounds`` gives."""
        rows, cols = self.bounds(frame, size)
        v = (np.arange(rows.start, rows.stop) - self.centre[frame, 1]) / self.step[frame] + (self.rows - 1) / 2
        u = (np.arange(cols.start, cols.stop) - self.centre[frame, 0]) / self.step[frame] + (self.cols - 1) / 2
        place = np.meshgrid(v, u, indexing="ij")
        values: NDArray[np.float64] = ndimage.map_coordinates(grid, place, order=1, mode="nearest")
        return values * self.step[frame]


def _signed_distance(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Pixels to the outline, which runs half-way between the pixels of both sides; positive inside."""
    if mask.all() or not mask.any():
        return np.full(mask.shape, np.inf if mask.any() else -np.inf)
    inside: NDArray[np.float64] = ndimage.distance_transform_edt(mask)
    outside: NDArray[np.float64] = ndimage.distance_transform_edt(~mask)
    return np.where(mask, inside - 0.5, 0.5 - outside)


def _follow(masks: NDArray[np.bool_], present: NDArray[np.bool_], points: int) -> _Window:
    frames = np.arange(len(masks))
    known = np.flatnonzero(present)
    centre, root, reach = np.empty((len(known), 2)), np.empty(len(known)), np.empty((len(known), 2))
    for row, frame in enumerate(known):
        y, x = np.nonzero(masks[frame])
        centre[row] = x.mean(), y.mean()
        root[row] = np.sqrt(len(x))
        reach[row] = np.abs(x - centre[row, 0]).max(), np.abs(y - centre[row, 1]).max()
    steady = [ndimage.median_filter(v, 5, mode="nearest") for v in (*centre.T, np.log(root))]
    path = [ndimage.gaussian_filter1d(np.interp(frames, known, v), 2.0, mode="nearest") for v in steady]
    size = np.exp(path[2])
    # wide enough for almost every frame, and for what a bad one lacks
    half = 1.2 * np.quantile(reach / size[known, None], 0.95, axis=0)
    step = 2 * half.max() / points
    rows, cols = (max(8, int(np.ceil(2 * h / step))) for h in (half[1], half[0]))
    return _Window(np.stack(path[:2], 1), size * step, rows, cols)


def repair_silhouettes(
    masks: Bool[Tensor, "frames height width"], params: RepairParams = RepairParams()
) -> RepairedSilhouettes:
    """Fill holes and dropped frames of a silhouette sequence, and take leaks out of it.

    A first repair by the median of each frame's neighbours gives the sequence that a kernel dynamical model (7) is
    fitted to. Each frame is then compared with what the model's smoothing says from the frames around it alone: where
    the silhouette has much more or much less there than predicted the prediction is taken, elsewhere the silhouette
    stays as it is. A whole silhouette that is wrong is replaced whole.

    Args:
        masks: one silhouette a frame; an empty one is a dropped frame.
        params: see :class:`RepairParams`.

    Raises:
        ReconError: fewer than 8 frames hold a silhouette.

    Example:
        >>> import torch
        >>> masks = torch.zeros(20, 40, 60, dtype=torch.bool)
        >>> for t in range(20):
        ...     masks[t, 10:30, 15 + t : 25 + t] = True
        >>> bad = masks.clone()
        >>> bad[9] = False
        >>> bad[5, 10:30, 20:26] = False
        >>> out = repair_silhouettes(bad)
        >>> [bool(((out.masks[t] ^ masks[t]).sum() < 30)) for t in (5, 9, 12)]
        [True, True, True]
    """
    if params.rounds < 1 or params.grid < 8 or not (params.reach > 0 and params.patch > 0 and params.tolerance > 0):
        raise ReconError(f"params: {params} must have rounds of 1, a grid of 8 or more, and positive lengths")
    given = masks.cpu().numpy()
    present = np.asarray(given.any((1, 2)))
    if present.sum() < 2 * _FOLDS:
        raise ReconError(
            f"masks: {int(present.sum())} of {len(given)} frames hold a silhouette; {2 * _FOLDS} are needed"
        )
    window = _follow(given, present, params.grid)
    reach = params.reach * params.grid
    learn = torch.from_numpy(present)

    def to_vectors(shapes: NDArray[np.bool_]) -> Tensor:
        return torch.from_numpy(np.stack([window.to_grid(t, mask, reach).ravel() for t, mask in enumerate(shapes)]))

    def replace(predicted: Tensor) -> NDArray[np.bool_]:
        shown, expected = (v.numpy().reshape(-1, window.rows, window.cols) for v in (raw, predicted))
        return _replace(given, present, shown, expected, window, params)

    raw = to_vectors(given)
    fixed = replace(_neighbours_median(raw, learn))
    for _ in range(params.rounds):
        vectors = to_vectors(fixed)
        model = KernelDynamics(params.kernel, params.n_components, params.ridge).fit(vectors, learn)
        fixed = replace(_predict_each(model, vectors, learn))
    novelty = torch.where(learn, model.deviation(raw, learn), torch.nan)
    out = torch.from_numpy(fixed).to(masks.device)
    return RepairedSilhouettes(out, (out ^ masks) | ~torch.from_numpy(present).to(masks.device)[:, None, None], novelty)


def _neighbours_median(x: Float[Tensor, "frames dims"], seen: Bool[Tensor, " frames"]) -> Float[Tensor, "frames dims"]:
    """Median over the two seen frames before and the two after, a first prediction that a bad one does not spoil."""
    known = seen.nonzero()[:, 0]
    out = torch.empty_like(x)
    for t in range(len(x)):
        before, after = known[known < t][-2:], known[known > t][:2]
        out[t] = x[torch.cat([before, after])].quantile(0.5, 0)
    return out


def _predict_each(
    model: KernelDynamics, x: Float[Tensor, "frames dims"], learn: Bool[Tensor, " frames"]
) -> Float[Tensor, "frames dims"]:
    """What the model says about each frame from other frames alone."""
    out = torch.empty_like(x)
    fold = torch.arange(len(x)) % _FOLDS
    for index in range(_FOLDS):
        out[fold == index] = model.smooth(x, learn & (fold != index))[fold == index]
    if not learn.all():
        out[~learn] = model.smooth(x, learn)[~learn]
    return out


def _replace(
    given: NDArray[np.bool_],
    present: NDArray[np.bool_],
    raw: NDArray[np.float64],
    predicted: NDArray[np.float64],
    window: _Window,
    params: RepairParams,
) -> NDArray[np.bool_]:
    """The given masks with the prediction's word where both differ too much."""
    size, patch = given.shape[1:], params.patch * params.grid
    shown, expected = (np.clip(grids + 0.5, 0.0, 1.0) for grids in (raw, predicted))
    frames = np.arange(len(given))
    # a limb that moves fast is where it is expected, or was seen, a frame earlier or later
    known = np.flatnonzero(present)
    place = np.searchsorted(known, frames)
    before = known[np.clip(place - 1, 0, None)]
    after = known[np.clip(place + present, None, len(known) - 1)]
    before, after = np.where(before < frames, before, after), np.where(after > frames, after, before)
    against = [expected[np.clip(frames + shift, 0, frames[-1])] for shift in (-1, 0, 1)] + [shown[before], shown[after]]
    net = np.stack([ndimage.gaussian_filter(shown - other, (0, patch, patch)) for other in against])
    wrong = np.maximum(net.min(0), -net.max(0))
    worst = wrong.max((1, 2))
    limit = max(_LEAST_WRONG, params.tolerance * float(np.median(worst[present])))
    out = given.copy()
    for t in frames[~present | (worst > limit)].tolist():
        part = window.bounds(t, size)
        image = window.to_image(t, predicted[t], size) > 0
        if present[t]:
            near = 2 * patch - ndimage.distance_transform_edt(wrong[t] <= limit)
            image = np.where(window.to_image(t, near, size) > 0, image, given[t][part])
        out[t][part] = image
    return out
