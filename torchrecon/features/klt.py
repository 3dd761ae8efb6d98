"""Frame-to-frame search by OpenCV's pyramidal Lucas-Kanade: where a point is roughly, and whether it comes back.

Its windows are square, see through the mask and are not freed of shading, so what it finds is a start for the
match with the track's own template (:mod:`torchrecon.features.align`), not a measurement. It runs on the CPU
whatever device the frames are on.
"""

from __future__ import annotations

from typing import Any

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.features.region import Region

__all__ = ["pair_of_images", "there_and_back"]


def pair_of_images(last: Region, now: Region) -> tuple[Any, Any, Tensor]:
    """Both frames cut to one box, as 8-bit images of equal brightness on the object, and the box's first pixel."""
    corner = torch.minimum(last.origin, now.origin)
    end = torch.maximum(last.origin + last.extent, now.origin + now.extent)
    (x0, y0), (x1, y1) = (v.round().long().tolist() for v in (corner, end))
    first, second = last.luma[y0:y1, x0:x1], now.luma[y0:y1, x0:x1]
    # Lucas-Kanade takes brightness as constant; a lamp that flickers, or an exposure that adapts, is divided out.
    gain = float((last.brightness / now.brightness).clamp(0.5, 2.0))
    images = [(255 * image).round().clamp(0, 255).to(torch.uint8).cpu().numpy() for image in (first, gain * second)]
    return images[0], images[1], corner


def there_and_back(
    images: tuple[Any, Any, Tensor],
    start: Float[Tensor, "points 2"],
    guess: Float[Tensor, "points 2"],
    half: int,
    levels: int,
) -> tuple[Float[Tensor, "points 2"], Float[Tensor, " points"]]:
    """Follow points from one frame to the next and back.

    Args:
        images: from :func:`pair_of_images`.
        start: where the points are, pixels of the frame.
        guess: where they are looked for.
        half: half width of the window, pixels of each level.
        levels: of the pyramid.

    Returns:
        where they went; pixels by which the way back misses the start, infinite where either way failed.
    """
    import cv2

    first, second, corner = images
    flow: Any = cv2.calcOpticalFlowPyrLK
    options = {
        "winSize": (2 * half + 1, 2 * half + 1),
        "maxLevel": levels - 1,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.03),
    }
    here, there = ((v - corner).detach().cpu().float().numpy()[:, None] for v in (start, guess))
    if not len(here):
        return guess.clone(), start.new_zeros(0)
    found, went, _ = flow(first, second, here, there.copy(), **options)
    # The way back starts from the opposite of the guess, not from the answer: it must find it by itself.
    home, came, _ = flow(second, first, found, found + here - there, **options)
    moved = torch.from_numpy(found[:, 0]).to(start) + corner
    missed = torch.from_numpy(home[:, 0] - here[:, 0]).to(start).norm(dim=-1)
    arrived = torch.from_numpy((went[:, 0] > 0) & (came[:, 0] > 0)).to(start.device)
    return moved, torch.where(arrived, missed, torch.inf)
