"""How many tracks of a real clip count: no truth is known there, so each has to pass conditions that anyone can check.

A track counts in a window of ``LONG`` frames if it is seen in all of them and
* was born at a SIFT feature that OpenCV's detector finds there too, within ``AT_FEATURE`` pixels,
* departs by ``MOVES`` pixels or more, within the window, from where the fitted motion of the background would have
  carried it (or lies in the mask that came with the clip),
* keeps ``APART`` pixels from every other counted track in every frame of the window,
* has a witness: OpenCV's pyramidal Lucas-Kanade, started on the track's first frame and left to itself, ends within
  ``ENDS`` pixels of the track, or comes back to within ``RETURNS`` pixels of where it started.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchrecon._typing import Bool, Float, Int, Tensor
from torchrecon.measurement import Tracks

__all__ = ["LONG", "MOVES", "Counted", "at_features", "best_window", "spaced", "witnessed"]

LONG, MOVES, APART, ENDS, RETURNS = 20, 3.0, 4.0, 3.0, 1.5  # frames; pixels
AT_FEATURE, CONTRAST = 2.0, 0.004  # pixels; |D| in grey values of [0, 1]
Grays = list[NDArray[np.uint8]]


@dataclass(frozen=True)
class Counted:
    """Tracks of the best common window, and how many are left after each condition.

    Attributes:
        start: first frame of the window.
        cover: tracks seen in all of its frames.
        born: of those, at a SIFT feature of OpenCV's.
        move: of those, against the background, or in the given mask.
        witness: of those, confirmed from their own first frame.
        count: of those, that keep their distance: the figure.
        count_in_window: the same where the witness starts on the window's first frame.
    """

    start: int = 0
    cover: int = 0
    born: int = 0
    move: int = 0
    witness: int = 0
    count: int = 0
    count_in_window: int = 0


def at_features(tracks: Tracks, grays: Iterable[NDArray[np.uint8]]) -> Bool[Tensor, " points"]:
    """Whether OpenCV's SIFT, at the contrast that the tracker asks for, has a keypoint where each track begins."""
    import cv2

    # OpenCV compares |D| times its 3 layers per octave with the threshold.
    detector = cv2.SIFT_create(nfeatures=0, nOctaveLayers=3, contrastThreshold=3 * CONTRAST, edgeThreshold=10)
    first = tracks.visible.int().argmax(0)
    result = torch.zeros(tracks.points, dtype=torch.bool)
    for index, gray in enumerate(grays):
        columns = (first == index).nonzero()[:, 0]
        if not len(columns):
            continue
        xy = tracks.xy[index, columns].double()
        low, high = (xy.amin(0) - 40).clamp_min(0).long(), (xy.amax(0) + 41).long()
        part = np.ascontiguousarray(gray[low[1] : high[1], low[0] : high[0]])
        found = [point.pt for point in detector.detect(part, None)]
        if found:
            result[columns] = torch.cdist(xy - low, torch.tensor(found, dtype=xy.dtype)).amin(1) <= AT_FEATURE
    return result


def _follow(grays: Grays, frames: list[int], xy: Tensor, joins: Tensor) -> Tensor:
    """Positions after Lucas-Kanade through ``frames``; a point stands still until the frame at which it joins."""
    import cv2

    flow: Any = cv2.calcOpticalFlowPyrLK
    here = xy.float()
    for last, now in pairwise(frames):
        chosen = (joins <= min(last, now)) & torch.isfinite(here).all(-1)
        if not chosen.any():
            continue
        found, status, _ = flow(grays[last], grays[now], here[chosen].numpy()[:, None], None)
        moved = torch.from_numpy(found[:, 0])
        moved[torch.from_numpy(status[:, 0] == 0)] = torch.nan
        here[chosen] = moved
    return here


def witnessed(
    grays: Grays, xy: Float[Tensor, "frames points 2"], first: Int[Tensor, " points"], last: int
) -> Bool[Tensor, " points"]:
    """Whether OpenCV's pyramidal Lucas-Kanade confirms the tracks from frame ``first`` of each to frame ``last``."""
    if not len(first):
        return torch.zeros(0, dtype=torch.bool)
    begin = xy[first, torch.arange(len(first))]
    span = list(range(int(first.min()), last + 1))
    end = _follow(grays, span, begin.clone(), first)
    good = (end - xy[last]).norm(dim=-1) < ENDS
    rest = ~good & torch.isfinite(end).all(-1)
    back = _follow(grays, span[::-1], end[rest], first[rest])
    good[rest] = (back - begin[rest]).norm(dim=-1) < RETURNS
    return good


def spaced(xy: Float[Tensor, "frames points 2"], apart: float = APART) -> Bool[Tensor, " points"]:
    """Tracks that keep ``apart`` pixels in every frame from every earlier one that is kept.

    Example:
        >>> import torch
        >>> spaced(torch.tensor([[[0.0, 0.0], [3.0, 0.0], [6.0, 0.0]]]), 4.0).tolist()
        [True, False, True]
    """
    near = torch.zeros(xy.shape[1], xy.shape[1], dtype=torch.bool)
    for positions in xy:
        near |= torch.cdist(positions, positions) < apart
    keep = torch.zeros(xy.shape[1], dtype=torch.bool)
    for index in range(len(keep)):
        keep[index] = not (near[index] & keep).any()
    return keep


def best_window(
    tracks: Tracks,
    grays: Grays,
    background: Float[Tensor, "frames 3 3"],
    masks: Bool[Tensor, "frames height width"] | None = None,
) -> Counted:
    """The common window in which most tracks count.

    Args:
        tracks: of the whole clip.
        grays: 8-bit frames.
        background: homography of each frame to the first one.
        masks: that came with the clip; where there are none a track has to move.
    """
    xy = tracks.xy.double()
    homogeneous = torch.cat([xy, torch.ones_like(xy[..., :1])], -1) @ background.mT
    still = homogeneous[..., :2] / homogeneous[..., 2:]
    born = at_features(tracks, grays)
    inside = None if masks is None else _in_masks(tracks, masks)
    candidates = []
    for start in range(tracks.frames - LONG + 1):
        window = slice(start, start + LONG)
        cover = tracks.visible[window].all(0)
        path = still[window]
        moves = (path - path[0]).norm(dim=-1).amax(0) >= MOVES
        if inside is not None:
            moves |= inside[window].all(0)
        candidates.append((int((cover & born & moves).sum()), start, cover, cover & born & moves))
    first = tracks.visible.int().argmax(0)
    best = Counted()
    # The other conditions only lower a count, so windows are looked at from the most promising one on.
    for bound, start, cover, chosen in sorted(candidates, key=lambda item: -item[0]):
        if bound <= best.count:
            break
        columns, last = chosen.nonzero()[:, 0], start + LONG - 1
        confirmed = columns[witnessed(grays, tracks.xy[:, columns], first[columns], last)]
        count = int(spaced(xy[start : last + 1, confirmed]).sum())
        if count > best.count:
            begins = torch.full_like(first[columns], start)
            within = columns[witnessed(grays, tracks.xy[:, columns], begins, last)]
            best = Counted(
                start, int(cover.sum()), int((cover & born).sum()), bound, len(confirmed), count,
                int(spaced(xy[start : last + 1, within]).sum()),
            )  # fmt: skip
    return best


def _in_masks(tracks: Tracks, masks: Tensor) -> Tensor:
    nearest = torch.nan_to_num(tracks.xy).round().long()
    height, width = masks.shape[-2:]
    x, y = nearest[..., 0].clamp(0, width - 1), nearest[..., 1].clamp(0, height - 1)
    return masks[torch.arange(tracks.frames)[:, None], y, x] & tracks.visible
