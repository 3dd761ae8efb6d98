"""Motion of the background between two frames: a homography fitted robustly to tracked corners (OpenCV helpers)."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import repeat
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchrecon._typing import Bool, Float, Tensor

__all__ = ["background_homography", "background_paths", "own_motion", "to_gray8", "warp_image"]

Image = NDArray[np.generic]


def to_gray8(frame: Float[Tensor, "3 height width"]) -> NDArray[np.uint8]:
    """Grey values 0..255 of an RGB frame in [0, 1]."""
    weights = frame.new_tensor([0.299, 0.587, 0.114])[:, None, None]
    return ((frame * weights).sum(0).clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def background_homography(
    source: NDArray[np.uint8],
    target: NDArray[np.uint8],
    exclude: NDArray[np.bool_] | None = None,
    guess: NDArray[np.float64] | None = None,
    least: int = 12,
) -> NDArray[np.float64] | None:
    """Homography that carries background pixels of ``source`` to ``target``.

    Corners are followed by pyramidal Lucas-Kanade and a homography is fitted by RANSAC, so whatever moves on its own
    is an outlier as long as it is the smaller part of the corners.

    Args:
        source, target: grey images of one size.
        exclude: (height, width) of ``source``: where no corner is taken (the mover of the frame before).
        guess: homography to start from; default identity.
        least: corners that must agree.

    Returns:
        (3, 3), or None where fewer than ``least`` corners agree (blank wall, cut, blur).
    """
    import cv2

    allowed = None if exclude is None else np.where(exclude, 0, 255).astype(np.uint8)
    spacing = max(5, int(min(source.shape) / 40))
    corners = cv2.goodFeaturesToTrack(source, 400, 0.005, spacing, mask=allowed)
    if corners is None or len(corners) < least:
        return None
    start = np.eye(3) if guess is None else guess
    predicted = cv2.perspectiveTransform(corners, start).astype(np.float32)
    options: dict[str, Any] = {"winSize": (15, 15), "maxLevel": 3, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    found, status, _ = cv2.calcOpticalFlowPyrLK(source, target, corners, predicted.copy(), **options)
    good = status[:, 0] > 0
    if good.sum() < least:
        return None
    matrix, inliers = cv2.findHomography(corners[good], found[good], cv2.RANSAC, 1.5, maxIters=500)
    if matrix is None or inliers is None or int(inliers.sum()) < least:
        return None
    result: NDArray[np.float64] = matrix.astype(np.float64)
    return result


def warp_image(image: Image, matrix: NDArray[np.float64], border: float) -> Image:
    """Image carried by a homography; pixels that come from outside get ``border``."""
    import cv2

    height, width = image.shape[:2]
    channels = 1 if image.ndim == 2 else image.shape[2]
    warped: Image = cv2.warpPerspective(
        image, matrix, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT,
        borderValue=(border,) * channels,
    )  # fmt: skip
    return warped


def background_paths(
    frames: Iterable[Float[Tensor, "3 height width"]], masks: Iterable[Bool[Tensor, "height width"]] | None = None
) -> Float[Tensor, "frames 3 3"]:
    """Homography of every frame to the first one, fitted to what lies outside the masks; float64.

    Where too few corners agree (blur, a blank wall) the camera is taken to have stood still for that frame.
    """
    paths: list[Tensor] = []
    last: NDArray[np.uint8] | None = None
    for frame, mask in zip(frames, repeat(None) if masks is None else masks, strict=False):
        gray = to_gray8(frame)
        step = None
        if last is not None:
            step = background_homography(gray, last, exclude=None if mask is None else mask.numpy())
        matrix = torch.eye(3, dtype=torch.float64) if step is None else torch.from_numpy(step)
        paths.append(matrix if not paths else paths[-1] @ matrix)
        last = gray
    return torch.stack([path / path[2, 2] for path in paths])


def own_motion(
    xy: Float[Tensor, "frames points 2"], visible: Bool[Tensor, "frames points"], paths: Float[Tensor, "frames 3 3"]
) -> Float[Tensor, " points"]:
    """How far each track departs from the background over its life: diagonal of its box in the first frame, pixels.

    A point of the background gives 0 up to noise, so ``own_motion(...) >= 3`` tells the mover's tracks from those
    that a loose mask let in.

    Args:
        xy: tracks, pixels; entries that are not visible are not read.
        visible: which entries are.
        paths: from :func:`background_paths`.

    Example:
        >>> import torch
        >>> xy = torch.tensor([[[0.0, 0.0], [9.0, 9.0]], [[3.0, 4.0], [9.0, 9.0]]])
        >>> own_motion(xy, torch.ones(2, 2, dtype=torch.bool), torch.eye(3).expand(2, 3, 3)).tolist()
        [5.0, 0.0]
    """
    known = torch.where(visible[..., None], xy, torch.zeros_like(xy)).to(paths)
    homogeneous = torch.cat([known, torch.ones_like(known[..., :1])], -1) @ paths.mT
    still = homogeneous[..., :2] / homogeneous[..., 2:]
    high = torch.where(visible[..., None], still, -torch.inf).amax(0)
    low = torch.where(visible[..., None], still, torch.inf).amin(0)
    return torch.where(visible.any(0), (high - low).norm(dim=-1), torch.zeros_like(high[:, 0])).to(xy)
