"""The part of a frame that a tracker looks at: the object's box, its mask, where points may be born and live."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.features.patches import gaussian_blur, image_pyramid, patch_grid, sample_image, to_gray

__all__ = ["Region", "cut_region", "depth_edges", "erode", "remove_shading"]


@dataclass(frozen=True, eq=False)
class Region:
    """One frame cut to the object and a margin.

    Attributes:
        gray: (h, w) grey values of the cut.
        pyramid: of ``gray``, level 0 lightly smoothed and freed of shading.
        inside: per level 1.0 on the object; None means everywhere.
        births: (h, w) where points may be born.
        allowed: (h, w) where points may live.
        origin: (2,) x, y of the cut's first pixel in the image.
        size: of the object, pixels: square root of its area; without a mask a fifth of the frame's.
        luma: (height, width) grey values of the whole frame.
        brightness: () mean grey value of the object.
    """

    gray: Tensor
    pyramid: list[Tensor]
    inside: list[Tensor] | None
    births: Tensor
    allowed: Tensor
    origin: Tensor
    size: float
    luma: Tensor
    brightness: Tensor

    @property
    def extent(self) -> Tensor:
        """Width and height of the cut."""
        return self.origin.new_tensor(self.gray.shape[::-1])

    def admits(self, xy: Float[Tensor, "points 2"]) -> Bool[Tensor, " points"]:
        """Whether the nearest pixel lies in the cut and points may live there; ``xy`` in the cut."""
        nearest = torch.nan_to_num(xy, nan=-1.0).round().long()
        height, width = self.allowed.shape
        x, y = nearest.unbind(-1)
        known = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        return known & self.allowed[y.clamp(0, height - 1), x.clamp(0, width - 1)]

    def weights(self, xy: Float[Tensor, "points 2"], half: int) -> list[Tensor] | None:
        """Per pyramid level, how much of each window sample lies on the object; ``xy`` in the cut."""
        if self.inside is None:
            return None
        grid = patch_grid(half, xy)
        return [sample_image(image, xy[:, None] / 2**level + grid) for level, image in enumerate(self.inside)]


def erode(mask: Bool[Tensor, "height width"], radius: float) -> Bool[Tensor, "height width"]:
    """Pixels whose disc of ``radius`` pixels lies in the mask; the outside of the image is outside the mask.

    Example:
        >>> import torch
        >>> erode(torch.ones(5, 7, dtype=torch.bool), 2.0).sum().item()
        3
    """
    r = math.ceil(radius)
    if r <= 0:
        return mask
    grid = patch_grid(r, torch.zeros(1, dtype=torch.float32, device=mask.device))
    disc = ((grid**2).sum(-1) <= radius**2).to(torch.float32).reshape(1, 1, 2 * r + 1, 2 * r + 1)
    outside = F.pad(1.0 - mask.to(torch.float32)[None, None], (r,) * 4, value=1.0)
    return F.conv2d(outside, disc)[0, 0] < 0.5


def depth_edges(depth: Float[Tensor, "height width"], jump: float, radius: int) -> Bool[Tensor, "height width"]:
    """Pixels with a depth step within ``radius`` pixels, or in a hole of the depth image.

    A step is more than ``jump`` metres, and more than 3 % of the depth: the noise of depth sensors grows with it.
    A single pixel that the sensor missed among measured ones is no hole.

    Example:
        >>> import torch
        >>> depth_edges(torch.tensor([[1.0, 1.0, 1.0, 2.0, 2.0]]), 0.1, 1).tolist()
        [[False, False, True, True, False]]
    """
    known = torch.isfinite(depth)
    side = 2 * radius + 1
    far = F.max_pool2d(torch.where(known, depth, -torch.inf)[None, None], side, 1, radius)
    near = F.max_pool2d(torch.where(known, -depth, -torch.inf)[None, None], side, 1, radius)
    hole = F.max_pool2d(known.to(depth.dtype)[None, None], 3, 1, 1)[0, 0] == 0
    return ((far + near)[0, 0] > (-0.03 * near[0, 0]).clamp_min(jump)) | hole


def remove_shading(
    gray: Float[Tensor, "height width"], inside: Float[Tensor, "height width"] | None, sigma: float
) -> Float[Tensor, "height width"]:
    """Logarithm of the grey values minus its local mean on the object.

    Shading stays with the light while texture moves with a turning body, so slow variations would pull a match
    back; in the logarithm shading is an offset, and the mean over ``sigma`` pixels takes it out.

    Args:
        gray: values in [0, 1].
        inside: 1 on the object, only there is the mean taken; elsewhere the result is 0. None: everywhere.
        sigma: pixels.

    Example:
        >>> import torch
        >>> float(remove_shading(torch.full((9, 9), 0.4), None, 2.0).abs().max()) < 1e-6
        True
    """
    log = torch.log(gray.clamp_min(0) + 0.05)  # the offset keeps the noise of dark pixels in bounds
    if inside is None:
        return log - gaussian_blur(log, sigma)
    share = gaussian_blur(inside, sigma).clamp_min(1e-3)
    return torch.where(inside > 0, log - gaussian_blur(log * inside, sigma) / share, torch.zeros_like(log))


def _box(mask: Tensor, around: Tensor, margin: int) -> tuple[int, int, int, int] | None:
    """x0, y0, x1, y1 of the mask and the points with a margin, at least 32 pixels a side where the image has them."""
    height, width = mask.shape
    rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
    corners = [around.amin(0), around.amax(0)] if len(around) else []
    if len(rows):
        corners += [torch.stack([columns[0], rows[0]]).to(around), torch.stack([columns[-1], rows[-1]]).to(around)]
    if not corners:
        return None
    box = torch.stack(corners)
    low, high = (box.amin(0) - margin).floor(), (box.amax(0) + margin).ceil()
    x0, y0 = (min(max(int(v), 0), max(n - 32, 0)) for v, n in zip(low, (width, height), strict=True))
    x1, y1 = (min(max(int(v), s + 32), n) for v, s, n in zip(high, (x0, y0), (width, height), strict=True))
    return x0, y0, x1, y1


def cut_region(
    frame: Float[Tensor, "channels height width"],
    mask: Bool[Tensor, "height width"] | None,
    depth: Float[Tensor, "height width"] | None,
    around: Float[Tensor, "points 2"],
    *,
    levels: int,
    margin: int,
    birth_margin: float,
    depth_jump: float,
    edge_radius: int,
    shading_sigma: float,
) -> Region | None:
    """Cut a frame to the object; None where there is neither mask nor point to look at.

    Args:
        frame: RGB or grey.
        mask: the object; None means the whole frame.
        depth: metres; points keep away from its edges.
        around: expected positions of living points, pixels, finite.
        levels: of the pyramid.
        margin: pixels added around the object's box.
        birth_margin: pixels that new points keep from the mask's border.
        depth_jump: metres, see :func:`depth_edges`.
        edge_radius: pixels, see :func:`depth_edges`.
        shading_sigma: pixels, see :func:`remove_shading`; 0 leaves the grey values as they are.
    """
    height, width = frame.shape[-2:]
    box = (0, 0, width, height) if mask is None else _box(mask, around, margin)
    if box is None:
        return None
    x0, y0, x1, y1 = box
    luma = to_gray(frame)
    gray = luma[y0:y1, x0:x1]
    inside = None
    allowed = births = torch.ones_like(gray, dtype=torch.bool)
    if mask is not None:
        allowed = mask[y0:y1, x0:x1]
        births = erode(allowed, birth_margin)
        inside = [allowed.to(gray)]
        for _ in range(levels - 1):
            inside.append(inside[-1][::2, ::2])
    if depth is not None:
        smooth = ~depth_edges(depth[y0:y1, x0:x1], depth_jump, edge_radius)
        births, allowed = births & smooth, allowed & smooth
    origin = frame.new_tensor([float(x0), float(y0)])
    pyramid = image_pyramid(gray, levels)
    if shading_sigma > 0:
        pyramid[0] = remove_shading(pyramid[0], None if inside is None else inside[0], shading_sigma)
    area = height * width / 25.0 if mask is None else max(float(mask.sum()), 900.0)
    brightness = (gray if mask is None or not mask.any() else gray[mask[y0:y1, x0:x1]]).mean().clamp_min(1e-3)
    return Region(gray, pyramid, inside, births, allowed, origin, math.sqrt(area), luma, brightness)
