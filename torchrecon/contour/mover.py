"""Find the one thing that moves before a static or slowly drifting camera: masks without a mask.

A first pass compares frames a few steps apart by dense optical flow, takes out the motion of the background (a
homography), and collects where in the picture something moves on its own and which colours it has there. Where nothing
does, a picture twice as large is looked at; where what moves is a small part of the picture, as a player filmed with
the whole court, it is looked at again from nearer by. The last pass labels every frame by a graph cut (GrabCut) seeded
with what moves now and with what those two maps say, so that parts of the body that rest for a while are still found.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.contour.global_motion import background_homography, to_gray8, warp_image
from torchrecon.errors import ReconError

__all__ = ["MoverParams", "find_mover"]

_BINS = 12  # colour bins per channel


@runtime_checkable
class Frames(Protocol):
    """Frames that can be iterated more than once."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Float[Tensor, "3 height width"]]: ...


@dataclass(frozen=True)
class MoverParams:
    """Parameters of the search for the mover.

    Attributes:
        working_size: longer side, pixels, of the images on which masks are found; masks are scaled up again.
        step: frames between the two that are compared; slow motion needs more, 4 at 25 to 30 per second.
        least_motion: pixels of the working image by which something moves against the background in ``step`` frames.
        min_area: smallest mover, as a share of the image.
        room: kept around what moves where it is looked at from nearer by, as a share of its longer side.
        nearer: enlargement from which on that is worth a pass over the frames (no unit).
        cut_iterations: GrabCut iterations per frame; 0 leaves the seeds.
    """

    working_size: int = 360
    step: int = 4
    least_motion: float = 0.8
    min_area: float = 0.002
    room: float = 0.5
    nearer: float = 1.5
    cut_iterations: int = 1


@dataclass(frozen=True)
class _Look:
    """What is looked at: rows and columns of every frame, in an image of ``scale`` times their size."""

    rows: slice
    columns: slice
    scale: float

    def image(self, frame: Tensor) -> NDArray[np.uint8]:
        """(h, w, 3) 8-bit RGB."""
        part = frame[:, self.rows, self.columns]
        if self.scale < 1.0:
            size = (max(16, round(part.shape[-2] * self.scale)), max(16, round(part.shape[-1] * self.scale)))
            part = torch.nn.functional.interpolate(part[None], size=size, mode="area")[0]
        eight = (part.clamp(0, 1) * 255).round().to(torch.uint8)
        image: NDArray[np.uint8] = eight.permute(1, 2, 0).contiguous().numpy()
        return image

    def placed(self) -> NDArray[np.float64]:
        """Pixels of its image -> pixels of the frame, (3, 3)."""
        step = 1 / self.scale
        left, top = self.columns.start + 0.5 * step - 0.5, self.rows.start + 0.5 * step - 0.5
        return np.array([[step, 0, left], [0, step, top], [0, 0, 1]])


@dataclass(eq=False)
class _Evidence:
    """What the first pass learns; its size does not depend on the length of the clip."""

    heat: NDArray[np.float32]  # (h, w) in the first frame's picture: share of the time that something moves there
    moving: NDArray[np.float64]  # colour histogram of what moves
    resting: NDArray[np.float64]  # colour histogram of all else
    paths: list[NDArray[np.float64]]  # per frame, frame -> first frame


def _bin(image: NDArray[np.uint8]) -> NDArray[np.int64]:
    parts = (image.astype(np.int64) * _BINS) // 256
    return (parts[..., 0] * _BINS + parts[..., 1]) * _BINS + parts[..., 2]


def _own_motion(
    now: NDArray[np.uint8], other: NDArray[np.uint8], homography: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Length of the optical flow now -> other that the background's homography does not explain, pixels.

    Flow is smooth and spills over the edge of what moves; it counts only near pixels whose grey value changed, too.
    """
    import cv2

    opencv: Any = cv2  # its stubs leave out the dense flow
    flow = opencv.DISOpticalFlow_create(opencv.DISOPTICAL_FLOW_PRESET_FAST).calc(now, other, None)
    height, width = now.shape
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float32)
    still = cv2.perspectiveTransform(grid.reshape(1, -1, 2), homography).reshape(height, width, 2) - grid
    length = np.linalg.norm(flow - still, axis=-1)
    carried = warp_image(other, np.linalg.inv(homography).astype(np.float64), 0.0).astype(np.float32)
    change = cv2.GaussianBlur(np.abs(carried - now.astype(np.float32)), (0, 0), 1.0)
    changed = cv2.dilate((change > 6.0).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    moved: NDArray[np.float32] = np.where(changed, length, 0.0).astype(np.float32)
    return moved


def _moving_maps(frames: Frames, whole: _Look, look: _Look, params: MoverParams) -> Iterator[tuple[Any, Any, Any]]:
    """Per frame: image of the look, how much of it moves (pixels per ``step`` frames), homography to the frame before.

    The background's homographies are fitted in the whole picture, of which a nearer look may show little else than the
    mover.
    """
    to_look = np.linalg.inv(look.placed()) @ whole.placed()
    from_look = np.linalg.inv(to_look)
    images: list[NDArray[np.uint8]] = []
    grays: list[NDArray[np.uint8]] = []
    links: list[NDArray[np.float64]] = []
    steps: list[NDArray[np.float32]] = []

    def gray(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return to_gray8(torch.from_numpy(image).permute(2, 0, 1) / 255.0)

    def between(first: int, second: int) -> NDArray[np.float32]:
        chain = np.eye(3)
        for link in links[first + 1 : second + 1]:
            chain = np.linalg.inv(link) @ chain
        refined = background_homography(grays[first], grays[second], guess=chain)
        carried = to_look @ (chain if refined is None else refined) @ from_look
        return _own_motion(gray(images[first]), gray(images[second]), carried)

    for frame in frames:
        small = gray(whole.image(frame))
        back = background_homography(small, grays[-1]) if grays else None
        images.append(look.image(frame))
        grays.append(small)
        links.append(np.eye(3) if back is None else back)
        if len(images) > params.step:
            ahead = between(0, params.step)
            steps.append(ahead)
            yield images.pop(0), ahead, to_look @ links.pop(0) @ from_look
            grays.pop(0)
    # The last frames have nothing ahead of them; the last map is carried on.
    last = steps[-1] if steps else np.zeros(images[0].shape[:2], np.float32)
    for image, link in zip(images, links, strict=True):
        yield image, last, to_look @ link @ from_look


def _learn(frames: Frames, whole: _Look, look: _Look, params: MoverParams) -> _Evidence:
    heat: NDArray[np.float32] | None = None
    path = np.eye(3)
    paths: list[NDArray[np.float64]] = []
    moving_colours, resting_colours = np.ones(_BINS**3), np.ones(_BINS**3)
    count = 0
    for image, motion, link in _moving_maps(frames, whole, look, params):
        path = path @ link
        path = path / path[2, 2]
        paths.append(path)
        moving = motion > params.least_motion
        heat = np.zeros(motion.shape, np.float32) if heat is None else heat
        heat += np.asarray(warp_image(moving.astype(np.float32), path, 0.0), dtype=np.float32)
        codes = _bin(image)
        moving_colours += np.bincount(codes[motion > 2 * params.least_motion], minlength=_BINS**3)
        resting_colours += np.bincount(codes[~moving], minlength=_BINS**3)
        count += 1
    if heat is None:
        raise ReconError("frames: there is none; at least one frame is needed")
    return _Evidence((heat / count).astype(np.float32), moving_colours, resting_colours, paths)


def _largest(mask: NDArray[np.uint8], least: int, weight: NDArray[np.float32]) -> NDArray[np.uint8]:
    """The component of the largest weight, and components close to it."""
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    power = np.bincount(labels.ravel(), weights=weight.ravel().astype(np.float64), minlength=count)
    power[0] = 0.0
    power[stats[:, cv2.CC_STAT_AREA] < least] = 0.0
    if count <= 1 or power.max() <= 0:
        return np.zeros_like(mask)
    best = int(power.argmax())
    radius = max(2, int(0.05 * stats[best, cv2.CC_STAT_HEIGHT]))
    reach = cv2.dilate((labels == best).astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0
    near = np.unique(labels[reach])
    chosen: NDArray[np.uint8] = np.isin(labels, near[near > 0]).astype(np.uint8)
    return chosen


def _cut(
    image: NDArray[np.uint8], likely: NDArray[np.uint8], sure: NDArray[np.uint8], iterations: int
) -> NDArray[np.uint8]:
    """GrabCut in the box around the likely pixels; what lies far from them is background."""
    import cv2

    rows, columns = np.nonzero(likely)
    margin = max(6, int(0.15 * (rows.max() - rows.min() + 1)))
    y0, y1 = max(0, rows.min() - margin), min(likely.shape[0], rows.max() + margin + 1)
    x0, x1 = max(0, columns.min() - margin), min(likely.shape[1], columns.max() + margin + 1)
    seed = likely[y0:y1, x0:x1]
    around = cv2.dilate(seed, np.ones((2 * (margin // 2) + 1,) * 2, np.uint8))
    labels = np.full(seed.shape, cv2.GC_BGD, np.uint8)
    labels[around > 0] = cv2.GC_PR_BGD
    labels[seed > 0] = cv2.GC_PR_FGD
    labels[(sure[y0:y1, x0:x1] > 0) & (seed > 0)] = cv2.GC_FGD
    if (seed > 0).sum() < 20 or (labels == cv2.GC_BGD).sum() < 20:
        return likely
    models = [np.zeros((1, 65)), np.zeros((1, 65))]
    cv2.setRNGSeed(0)  # GrabCut draws its colour clusters at random
    window = np.ascontiguousarray(image[y0:y1, x0:x1, ::-1])
    cv2.grabCut(window, labels, None, models[0], models[1], iterations, cv2.GC_INIT_WITH_MASK)
    result = np.zeros_like(likely)
    result[y0:y1, x0:x1] = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    return result


def find_mover(frames: Frames, params: MoverParams = MoverParams()) -> Iterator[Bool[Tensor, "height width"]]:
    """Masks of the mover, one per frame, for a camera that stands still or drifts slowly.

    It is not a person detector: of several movers it takes the one that moves most in sum, and a body part that
    never moves during the clip and has the background's colours is missed.

    Args:
        frames: RGB in [0, 1], one size, iterable twice (a frame source, a list).
        params: thresholds.

    Yields:
        (height, width) bool; all false in a frame where no mover is found.

    Raises:
        ReconError: fewer than 8 frames: too few to know what moves.
    """
    if len(frames) < 8:
        raise ReconError(f"frames: {len(frames)} frames are too few to tell a mover from the background; give masks")
    height, width = next(iter(frames)).shape[-2:]
    rows, columns = slice(0, height), slice(0, width)
    whole = _Look(rows, columns, min(1.0, params.working_size / max(height, width)))
    known = _learn(frames, whole, whole, params)
    while whole.scale < 1 and not known.heat.any():
        whole = replace(whole, scale=min(1.0, 2 * whole.scale))
        known = _learn(frames, whole, whole, params)
    look = _nearer(known, whole, params)
    if look.scale < params.nearer * whole.scale:
        look = whole
    else:
        known = _learn(frames, whole, look, params)
    for part in _label(frames, whole, look, known, params):
        mask = torch.zeros(height, width, dtype=torch.bool)
        mask[look.rows, look.columns] = part
        yield mask


def _nearer(known: _Evidence, whole: _Look, params: MoverParams) -> _Look:
    """A look at the place of most motion, wherever it drifts, with room; never smaller than the working size."""
    import cv2

    warm = (known.heat > 0.25 * _typical_heat(known.heat, params)).astype(np.uint8)
    y, x = np.nonzero(_largest(warm, 1, known.heat))
    if not len(y):
        return whole
    room = params.room * (1 + max(np.ptp(y), np.ptp(x)))
    (left, right), (top, bottom) = ((v.min() - room, v.max() + 1 + room) for v in (x, y))
    corners = np.array([[[left, top], [right, top], [left, bottom], [right, bottom]]], np.float64)
    moved = np.concatenate(
        [cv2.perspectiveTransform(corners, whole.placed() @ np.linalg.inv(p))[0] for p in known.paths]
    )
    centre, half = (moved.max(0) + moved.min(0)) / 2, np.ptp(moved, 0) / 2
    half = np.maximum(half, params.working_size / 2)
    size = np.array([whole.columns.stop, whole.rows.stop])
    low, high = np.floor(centre - half).clip(0).astype(int), np.ceil(centre + half).clip(max=size).astype(int)
    scale = min(1.0, params.working_size / int((high - low).max()))
    return _Look(slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0])), scale)


def _label(
    frames: Frames, whole: _Look, look: _Look, known: _Evidence, params: MoverParams
) -> Iterator[Bool[Tensor, "height width"]]:
    """Masks of the mover, one per frame, in the rows and columns of the look."""
    import cv2

    ratio = np.log(known.moving / known.moving.sum()) - np.log(known.resting / known.resting.sum())
    size = (look.rows.stop - look.rows.start, look.columns.stop - look.columns.start)
    least = int(params.min_area * known.heat.size)
    typical = _typical_heat(known.heat, params)
    for index, (image, motion, _) in enumerate(_moving_maps(frames, whole, look, params)):
        back = np.linalg.inv(known.paths[index]).astype(np.float64)
        heat = np.asarray(warp_image(known.heat, back, 0.0), dtype=np.float32)
        likely_colour = cv2.GaussianBlur(ratio[_bin(image)].astype(np.float32), (0, 0), 1.5)
        moving = (motion > params.least_motion).astype(np.float32)
        # log odds: moves now, moved here before, has the mover's colours
        belief = 2.0 * moving + np.log((heat + 0.01) / (typical + 0.01)) + 0.7 * likely_colour
        likely = cv2.morphologyEx((belief > 0.0).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        likely = cv2.morphologyEx(likely, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        chosen = _largest(likely, least, heat + moving)
        if chosen.any() and params.cut_iterations > 0:
            sure = cv2.erode(((belief > 2.0) & (chosen > 0)).astype(np.uint8), np.ones((3, 3), np.uint8))
            chosen = _largest(_cut(image, chosen, sure, params.cut_iterations), least, heat + moving)
        mask = torch.from_numpy(chosen.astype(np.float32))[None, None]
        big = torch.nn.functional.interpolate(mask, size=size, mode="bilinear", align_corners=False)
        yield big[0, 0] > 0.5


def _typical_heat(heat: NDArray[np.float32], params: MoverParams) -> float:
    """A third of the heat of the hottest pixels that together make a smallest mover."""
    least = int(params.min_area * heat.size)
    top = np.sort(heat.ravel())[-max(1, 2 * least) :]
    return float(np.median(top)) / 3.0
