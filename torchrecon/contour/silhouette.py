"""Silhouettes of a body that is pointed at: by its mask in the first frame, or by a box around it there.

Each mask is the one before carried along by dense optical flow, corrected by what the background model says where the
camera stands still, and drawn along the edges of the picture by a graph cut (GrabCut). All
OpenCV helpers are imported when called.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.contour.global_motion import background_homography
from torchrecon.errors import ReconError

__all__ = ["SilhouetteParams", "follow_silhouette", "silhouette_from_box"]

_BINS = 16  # colour bins per channel

Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]


@runtime_checkable
class Frames(Protocol):
    """Frames that can be iterated more than once."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Float[Tensor, "3 height width"]]: ...


@dataclass(frozen=True)
class SilhouetteParams:
    """Parameters of :func:`follow_silhouette`.

    Attributes:
        band: how far an outline may lie from where the flow carries it, as a share of the body's height.
        cut_iterations: of GrabCut per frame.
        samples: frames from which the background of a static camera is learnt.
        changed: difference from the background, in standard deviations of its noise, from which a pixel is not it.
        same: difference below which it is.
        still: largest motion of a camera that counts as static, pixels over the clip.
    """

    band: float = 0.06
    cut_iterations: int = 2
    samples: int = 40
    changed: float = 6.0
    same: float = 3.0
    still: float = 1.0


@dataclass(frozen=True, eq=False)
class _Background:
    """Colours behind the body and their noise; NaN where the body always hides them."""

    colour: NDArray[np.float32]  # (h, w, 3) BGR, 0 to 255
    noise: float

    def difference(self, image: Image) -> NDArray[np.float32]:
        """Distance from the background in standard deviations, (h, w); NaN where it is not known."""
        # no blur: it would carry the body's colours over its edge
        away: NDArray[np.float32] = np.sqrt(((image.astype(np.float32) - self.colour) ** 2).sum(-1)) / self.noise
        return away


def _to_image(frame: Tensor) -> Image:
    """(h, w, 3) 8-bit BGR."""
    image: Image = (frame.clamp(0, 1) * 255).round().to(torch.uint8).flip(0).permute(1, 2, 0).contiguous().cpu().numpy()
    return image


def _gray(image: Image) -> Image:
    import cv2

    gray: Image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.uint8)
    return gray


def _grow(mask: Mask, radius: int) -> Mask:
    """The mask grown by a disc, or for a negative radius shrunk by one."""
    import cv2

    if mask.all() or not mask.any():
        return mask
    # to the nearest pixel of the other kind; the cost does not grow with the radius
    from_inside = (mask if radius < 0 else ~mask).astype(np.uint8)
    distance = cv2.distanceTransform(from_inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    grown: Mask = distance > -radius if radius < 0 else distance <= radius
    return grown


def _carry(mask: Mask, now: Image, before: Image) -> Mask:
    """The mask of the frame before, carried into this one by dense flow."""
    import cv2

    opencv: Any = cv2  # its stubs leave out the dense flow
    flow = opencv.DISOpticalFlow_create(opencv.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(now, before, None)
    height, width = now.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    carried = cv2.remap(mask.astype(np.float32), x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR)
    result: Mask = carried > 0.5
    return result


def _bin(image: Image) -> NDArray[np.int64]:
    """Index of each pixel's colour in a histogram."""
    part = image.astype(np.int64) * _BINS // 256
    return (part[..., 0] * _BINS + part[..., 1]) * _BINS + part[..., 2]


def _palette(image: Image, mask: Mask) -> NDArray[np.float64]:
    """Log odds of each colour bin, body against all else, in the frame whose mask is given."""
    codes = _bin(image)
    share = []
    for region in (mask, ~mask):
        counts = np.bincount(codes[region], minlength=_BINS**3).reshape((_BINS,) * 3)
        smooth = ndimage.gaussian_filter(counts / max(1, region.sum()), 0.7, mode="constant").ravel()
        share.append(smooth + 1.0 / _BINS**3)
    odds: NDArray[np.float64] = np.log(share[0] / share[1])
    return odds


def _cut(image: Image, labels: NDArray[np.uint8], iterations: int) -> Mask:
    """GrabCut in the box of what is not surely background."""
    import cv2

    open_ = labels != cv2.GC_BGD
    rows, cols = np.nonzero(open_)
    pad = 12
    y0, y1 = max(0, int(rows.min()) - pad), int(rows.max()) + pad + 1
    x0, x1 = max(0, int(cols.min()) - pad), int(cols.max()) + pad + 1
    window = np.ascontiguousarray(labels[y0:y1, x0:x1])
    front = np.isin(window, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if front.sum() >= 20 and (~front).sum() >= 20 and iterations > 0:
        cv2.setRNGSeed(0)  # GrabCut draws its colour clusters at random
        models = np.zeros((1, 65)), np.zeros((1, 65))
        patch = np.ascontiguousarray(image[y0:y1, x0:x1])
        cv2.grabCut(patch, window, (0, 0, 0, 0), *models, iterations, cv2.GC_INIT_WITH_MASK)
        front = np.isin(window, (cv2.GC_FGD, cv2.GC_PR_FGD))
    result = np.zeros(labels.shape, bool)
    result[y0:y1, x0:x1] = front
    return result


def _connected(mask: Mask, core: Mask) -> Mask:
    """Parts of the mask that touch the core, with small holes filled."""
    import cv2

    _, labels = cv2.connectedComponents(mask.astype(np.uint8))
    kept = np.unique(labels[mask & core])
    result: Mask = np.isin(labels, kept[kept > 0])
    return result


def silhouette_from_box(
    frame: Float[Tensor, "3 height width"], box: tuple[int, int, int, int], iterations: int = 5
) -> Bool[Tensor, "height width"]:
    """Mask of what fills a box, by GrabCut: all outside the box is background.

    Args:
        frame: RGB in [0, 1].
        box: left, top, right, bottom, pixels; it should leave a small margin around the body.

    Raises:
        ReconError: the box does not lie inside the image, is too small, or the cut finds nothing in it.

    Example:
        >>> import torch
        >>> frame = torch.rand(3, 80, 80, generator=torch.Generator().manual_seed(0)) * 0.2
        >>> frame[0, 30:60, 30:50] += 0.7
        >>> mask = silhouette_from_box(frame, (24, 24, 56, 66))
        >>> bool(mask[35:55, 35:45].all()), bool(mask[:24].any())
        (True, False)
    """
    import cv2

    height, width = frame.shape[-2:]
    left, top, right, bottom = box
    if not (0 <= left < right <= width and 0 <= top < bottom <= height) or min(right - left, bottom - top) < 8:
        raise ReconError(
            f"box: {box} must be left, top, right, bottom inside the {width} x {height} image, 8 pixels or more wide"
        )
    labels = np.full((height, width), cv2.GC_BGD, np.uint8)
    labels[top:bottom, left:right] = cv2.GC_PR_FGD
    # a margin of background around the box tells what is not the body
    mask = _cut(_to_image(frame), labels, iterations)
    if not mask.any():
        raise ReconError("box: nothing in it differs from what is around it; give a mask of the first frame")
    return torch.from_numpy(mask)


def follow_silhouette(
    frames: Frames, first: Bool[Tensor, "height width"], params: SilhouetteParams = SilhouetteParams()
) -> Iterator[Bool[Tensor, "height width"]]:
    """Follow a body through a clip from its mask in the first frame.

    Where the camera stands still, a second pass knows the background from the frames in which the body is elsewhere,
    which tells body from wall of one colour apart; before a moving camera flow and colours have to do. A body that
    turns or moves by more than its limbs' width a frame is soon lost then.

    Args:
        frames: RGB in [0, 1], iterable twice.
        first: mask of the body in the first frame; see :func:`silhouette_from_box`.

    Yields:
        One mask a frame; the first is ``first`` itself. Once nothing of the body is left, empty masks.

    Raises:
        ReconError: an empty first mask, or one of another size.
    """
    size = tuple(next(iter(frames)).shape[-2:])
    if tuple(first.shape) != size:
        raise ReconError(f"first: is {tuple(first.shape)}, the frames are {size}; one pixel for each is needed")
    if not first.any():
        raise ReconError("first: the mask is empty; mark the body in the first frame")
    loose = list(_pass(frames, first.cpu().numpy(), None, params))
    background = _learn_background(frames, loose, params)
    tight = iter(loose) if background is None else _pass(frames, first.cpu().numpy(), background, params)
    for mask in tight:
        yield torch.from_numpy(mask)


def _pass(frames: Frames, first: Mask, background: _Background | None, params: SilhouetteParams) -> Iterator[Mask]:
    import cv2

    mask, before = first, None
    palette = np.zeros(_BINS**3)
    for frame in frames:
        image = _to_image(frame)
        gray = _gray(image)
        if before is None:
            palette = _palette(image, first)
        if before is None or not mask.any():
            before = gray
            yield mask
            continue
        guess = _carry(mask, gray, before)
        before = gray
        if not guess.any():
            mask = guess
            yield mask
            continue
        rows = np.flatnonzero(guess.any(1))
        band = max(4, round(params.band * (rows[-1] - rows[0] + 1)))
        core = _grow(guess, -band)
        labels = np.full(guess.shape, cv2.GC_BGD, np.uint8)
        near = _grow(guess, band)
        labels[near] = cv2.GC_PR_BGD
        labels[guess] = cv2.GC_PR_FGD
        labels[core] = cv2.GC_FGD
        if background is not None:
            away = background.difference(image)
            # what is neither background nor of the body's colours is something that it holds or passes
            changed, likely = away > params.changed, palette[_bin(image)] > 0
            labels[near & ~guess & changed & likely] = cv2.GC_PR_FGD
            labels[guess & changed & likely] = cv2.GC_FGD
            labels[guess & ~core & changed & ~likely] = cv2.GC_PR_BGD
            same = away < params.same
            labels[near & ~guess & same] = cv2.GC_BGD
            # what was the body and looks like the background may be either
            labels[guess & ~core & same] = cv2.GC_PR_BGD
        mask = _connected(_cut(image, labels, params.cut_iterations), guess)
        yield mask


def _learn_background(frames: Frames, masks: list[Mask], params: SilhouetteParams) -> _Background | None:
    """Median colour of each pixel over frames in which it is not near the body; None where the camera moves."""
    step = max(1, len(masks) // params.samples)
    images, known = [], []
    reference: Image | None = None
    for index, (frame, mask) in enumerate(zip(frames, masks, strict=True)):
        if index % step:
            continue
        image = _to_image(frame)
        gray = _gray(image)
        if reference is None:
            reference = gray
        elif _camera_motion(gray, reference, mask) > params.still:
            return None
        rows = np.flatnonzero(mask.any(1))
        reach = max(4, round(params.band * (rows[-1] - rows[0] + 1))) if len(rows) else 3
        images.append(image.astype(np.float32))
        known.append(~_grow(mask, reach))
    stack, there = np.stack(images), np.stack(known)
    stack[~there] = np.nan
    enough = there.sum(0) >= 3
    colour = np.full(stack.shape[1:], np.nan, np.float32)
    colour[enough] = np.nanmedian(stack[:, enough], 0)
    spread = np.sqrt(((stack - colour) ** 2).sum(-1))
    # three channels together; the median of such a distance is near 1.54 standard deviations of one
    noise = float(np.nanmedian(spread)) / 1.54
    return _Background(colour, max(noise, 0.5))


def _camera_motion(now: Image, reference: Image, mask: Mask) -> float:
    """How far the corners of the picture move between two frames, pixels; infinite where they are lost."""
    matrix = background_homography(now, reference, exclude=_grow(mask, 5))
    if matrix is None:
        return float("inf")
    height, width = now.shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], np.float64)
    moved = corners @ matrix.T
    return float(np.abs(moved[:, :2] / moved[:, 2:] - corners[:, :2]).max())
