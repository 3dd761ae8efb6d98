"""Long, accurate tracks of SIFT points on a moving body: predict, match, update, frame by frame.

Every point is predicted by the alpha-beta-gamma filter (paper, eqs. 28-29), found in the new frame to sub-pixel
precision, checked forward and backward and against its neighbours, and carries a 2x2 covariance. Points are born at
SIFT keypoints (eqs. 1-5) away from living tracks and die when a check fails. Frames are read once, front to back.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import repeat
from typing import Any

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.features.following import Alive, advance, born
from torchrecon.features.region import Region, cut_region
from torchrecon.features.sift import SiftParams, detect_sift
from torchrecon.measurement import Tracks
from torchrecon.statespace import abg_predict

__all__ = ["TrackerParams", "track_points"]


@dataclass(frozen=True)
class TrackerParams:
    """Parameters of the tracker.

    Attributes:
        window: half width of the matched window, pixels; 5 means 11 x 11.
        search_window: half width of the window of the search from frame to frame, pixels of each pyramid level.
        levels: pyramid levels for the search from frame to frame; each doubles the reach.
        iterations: Gauss-Newton steps per level.
        alpha: position gain of the alpha-beta-gamma predictor, in (0, 1).
        detect_every: frames between two detections of new points.
        max_tracks: living tracks at most.
        min_distance: pixels between a new point and every living one.
        min_length: frames; shorter tracks are dropped from the result.
        mask_margin: pixels that a new point keeps from the mask's border.
        min_correlation: correlation of the window with its template below which a track ends.
        sure_correlation: correlation above which a point is confirmed that the search from the last frame lost.
        renew_correlation: correlation below which the template is taken anew.
        max_stretch: factor by which a template may be stretched or shrunk before it is taken anew.
        max_disagreement: pixels between the match with the last frame and the match with the template.
        max_backward: pixels between a point and what comes back after matching forward and backward.
        gate: standard deviations by which a point's step may differ from what its neighbours' steps suggest.
        max_neighbour: the same difference in percent of the object's size (square root of its area).
        local_std: percent of the object's size; how well a point moves with its neighbours at best.
        alike: percent of the object's size; neighbours whose step differs by more than this from a point's own count
            little in what they suggest, they may belong to another limb.
        reach: percent of the object's size; search radius for points whose motion is not known or that were lost.
        max_std: percent of the object's size; a track whose position has become less certain than this along any
            direction ends.
        misfit: share of a window's contrast that no warp explains; lower limit of the noise in the covariance.
        bend: deviation that the bent surface adds to the covariance, in half widths of the window per unit of stretch.
        shading_sigma: pixels; grey values are matched after their local mean over this range is taken out; 0 = not.
        depth_jump: metres; a step of depth near a point that counts as an edge (where depth is given); nearer than a
            metre it decides, farther away the 3 % of :func:`depth_edges`.
        sift: detection parameters.
    """

    window: int = 5
    search_window: int = 7
    levels: int = 3
    iterations: int = 6
    alpha: float = 0.8
    detect_every: int = 1
    max_tracks: int = 600
    min_distance: float = 3.0
    min_length: int = 5
    mask_margin: float = 2.0
    min_correlation: float = 0.7
    sure_correlation: float = 0.85
    renew_correlation: float = 0.75
    max_stretch: float = 2.5
    max_disagreement: float = 2.0
    max_backward: float = 1.0
    gate: float = 3.0
    max_neighbour: float = 0.75
    local_std: float = 0.25
    alike: float = 1.0
    reach: float = 8.0
    max_std: float = 1.0
    misfit: float = 0.2
    bend: float = 0.15
    shading_sigma: float = 5.0
    depth_jump: float = 0.03
    sift: SiftParams = field(default_factory=lambda: SiftParams(contrast=0.004))

    def __post_init__(self) -> None:
        for name in ("window", "search_window", "levels", "iterations", "detect_every", "max_tracks", "min_length"):
            if getattr(self, name) < 1:
                raise ReconError(f"{name}: {getattr(self, name)} is not a positive whole number")
        if not 0 < self.alpha < 1:
            raise ReconError(f"alpha: {self.alpha} is not between 0 and 1 (exclusive)")


def _detect(region: Region, alive: Alive | None, next_id: int, params: TrackerParams) -> Alive | None:
    """New tracks at keypoints that keep their distance from living ones and from stronger new ones."""
    room = params.max_tracks - (0 if alive is None else len(alive.ids))
    if room <= 0 or min(region.gray.shape) < 32 or not region.births.any():
        return None
    found = detect_sift(region.gray[None, None], region.births[None], params.sift, describe=False)
    xy = found.xy[0][found.valid[0]] + region.origin  # strongest first
    if alive is not None and len(alive.ids) and len(xy):
        xy = xy[torch.cdist(xy, alive.xy).amin(1) >= params.min_distance]
    if not len(xy):
        return None
    close = torch.cdist(xy, xy) < params.min_distance
    xy = xy[~close.tril(-1).any(1)][:room]
    return born(region, xy, next_id, params.window, alive)


def _matched(first: Iterable[Tensor], *others: Iterable[Any] | None) -> Iterator[tuple[Any, ...]]:
    """Frames with their masks and depths; a missing or a surplus one is an error that names the frame."""
    streams: list[Iterator[Any]] = [repeat(None) if other is None else iter(other) for other in others]
    end = object()
    count = 0
    for count, frame in enumerate(first, 1):
        row: list[Any] = [next(stream, end) for stream in streams]
        for name, value in zip(("masks", "depths"), row, strict=True):
            if value is end:
                raise ReconError(f"{name}: end at frame {count - 1}, before the frames; one per frame is needed")
            if value is not None and tuple(value.shape) != tuple(frame.shape[-2:]):
                raise ReconError(
                    f"{name}: frame {count - 1} is {tuple(value.shape)}, the image is {tuple(frame.shape[-2:])}; "
                    "height and width must be the same"
                )
        yield (frame, *row)
    for name, stream, other in zip(("masks", "depths"), streams, others, strict=True):
        if other is not None and next(stream, end) is not end:
            raise ReconError(f"{name}: there are more than the {count} frames; one per frame is needed")


def track_points(
    frames: Iterable[Float[Tensor, "channels height width"]],
    masks: Iterable[Bool[Tensor, "height width"]] | None = None,
    params: TrackerParams = TrackerParams(),
    fps: float = 25.0,
    depths: Iterable[Float[Tensor, "height width"]] | None = None,
) -> Tracks:
    """Track points of a moving object through a sequence of frames.

    Args:
        frames: RGB or grey images in [0, 1], one size; read once.
        masks: where the object is, one per frame; default: the whole frame.
        params: thresholds.
        fps: frames per second.
        depths: metres, NaN = none, one per frame; used to keep points away from depth edges, where a window sees
            two surfaces. Depth of the tracks themselves is sampled elsewhere.

    Returns:
        Tracks in order of birth with ``covariance`` (px^2, of the position against the point under the first
        observation), and ``extras`` ``age`` (frames since birth, -1 = not seen) and ``score`` (correlation of the
        match, NaN = not seen), both (frames, points).

    Raises:
        ReconError: no frame, frames and masks that do not match, or not one track of ``min_length`` frames.

    Example:
        >>> import torch
        >>> noise = torch.rand(1, 40, 60, generator=torch.Generator().manual_seed(0))
        >>> image = torch.nn.functional.interpolate(noise[None], scale_factor=3.0, mode="bicubic")[0].clamp(0, 1)
        >>> tracks = track_points([image[:, :96, i : i + 128] for i in range(6)])  # a camera that pans 1 px a frame
        >>> step = tracks.xy[1:] - tracks.xy[:-1]
        >>> bool(((step - torch.tensor([-1.0, 0.0])).norm(dim=-1).nanmedian() < 0.05))
        True
    """
    alive: Alive | None = None
    last: Region | None = None
    seen: list[tuple[int, Alive]] = []
    next_id, index, since = 0, -1, 0
    for index, (frame, mask, depth) in enumerate(_matched(frames, masks, depths)):
        empty = frame.new_zeros(0, 2)
        around = empty if alive is None else abg_predict(alive.state, 1.0)[..., 0]
        region = cut_region(
            frame, mask, depth, around, levels=2, margin=4 * params.window,
            birth_margin=params.mask_margin, depth_jump=params.depth_jump, edge_radius=params.window // 2,
            shading_sigma=params.shading_sigma,
        )  # fmt: skip
        if region is None or last is None:
            alive = None
        elif alive is not None and len(alive.ids):
            alive = advance(alive, last, region, params)
        since += 1
        nothing = alive is None or not len(alive.ids)
        if region is not None and (since >= params.detect_every or nothing):
            new = _detect(region, alive, next_id, params)
            if new is not None:
                next_id += len(new.ids)
                alive = new if alive is None else alive.join(new)
            since = 0
        if alive is not None and len(alive.ids):
            seen.append((index, alive))
        last = region
    if index < 0:
        raise ReconError("frames: there is none; at least one frame is needed")
    return _assemble(seen, index + 1, next_id, params, fps)


def _assemble(seen: list[tuple[int, Alive]], frames: int, points: int, params: TrackerParams, fps: float) -> Tracks:
    """Dense arrays from what was seen frame by frame; short tracks are dropped."""
    lengths = torch.zeros(points, dtype=torch.long)
    for _, alive in seen:
        lengths[alive.ids.cpu()] += 1
    keep = (lengths >= params.min_length).nonzero()[:, 0]
    if not len(keep):
        raise ReconError(
            f"frames: {points} points were found in {frames} frames and none could be followed for "
            f"{params.min_length} frames; the object needs more texture, slower motion or a sharper image"
        )
    column = torch.full((points,), -1)
    column[keep] = torch.arange(len(keep))
    like = seen[0][1].xy
    shape = (frames, len(keep))
    xy = torch.full((*shape, 2), torch.nan).to(like)
    covariance = torch.full((*shape, 2, 2), torch.nan).to(like)
    score = torch.full(shape, torch.nan).to(like)
    age = torch.full(shape, -1, device=like.device)
    for index, alive in seen:
        target = column.to(like.device)[alive.ids]
        chosen = target >= 0
        target = target[chosen]
        xy[index, target], covariance[index, target] = alive.xy[chosen], alive.covariance[chosen]
        score[index, target], age[index, target] = alive.score[chosen], alive.age[chosen]
    # The first observation was not matched with anything; it is as noisy as the match that followed it.
    first = (age == 0).nonzero()
    following = covariance[(first[:, 0] + 1).clamp_max(frames - 1), first[:, 1]]
    smallest = 0.05**2 * torch.eye(2).to(like)
    covariance[first[:, 0], first[:, 1]] = torch.where(torch.isfinite(following), following, smallest)
    return Tracks(xy, age >= 0, covariance=covariance, fps=fps, extras={"age": age, "score": score})
