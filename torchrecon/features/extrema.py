"""Extrema of the difference-of-Gaussian scale space of one image, on the CPU: where SIFT keypoints are.

The scale space is the one of Kornia's detector (doubled image, three intervals per octave, sigma 1.6), and so are the
extrema; they are found in a fraction of its time by OpenCV's blur and morphology, and because weak extrema are
left out before they are refined, not after.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from torchrecon._typing import Bool, Float, Tensor

__all__ = ["scale_space_extrema"]

_INTERVALS, _SIGMA, _BORDER = 3, 1.6, 5
_TINY = 1e-20


def _octaves(image: Tensor) -> list[Tensor]:
    """Per octave the differences of neighbouring levels, (5, h, w); the first octave has half the pixel spacing."""
    import cv2

    size = [2 * n - 1 for n in image.shape]  # every second pixel is one of the image
    doubled = F.interpolate(image[None, None], size=size, mode="bilinear", align_corners=True)
    first: Any = F.pad(doubled, (0, 1, 0, 1), mode="replicate")[0, 0].numpy()

    def blur(level: Any, sigma: float) -> Any:
        side = int(8 * sigma + 1) | 1
        return cv2.GaussianBlur(level, (side, side), sigma, borderType=cv2.BORDER_REFLECT_101)

    step = 2 ** (1 / _INTERVALS)
    first = blur(first, math.sqrt(_SIGMA**2 - 1.0))  # a camera blurs by half a pixel
    result = []
    while True:
        levels = [first]
        for index in range(_INTERVALS + 2):
            levels.append(blur(levels[-1], _SIGMA * step**index * math.sqrt(step**2 - 1)))
        result.append(torch.from_numpy(np.stack([after - before for before, after in pairwise(levels)])))
        height, width = (n // 2 for n in first.shape)
        if min(height, width) < 12:
            return result
        first = np.ascontiguousarray(levels[_INTERVALS][: 2 * height : 2, : 2 * width : 2])


def _cube(dog: Tensor, at: Tensor) -> Tensor:
    """The 3 x 3 x 3 neighbourhoods (n, 27) of voxels ``at`` (n, 3): scale, row, column."""
    _, height, width = dog.shape
    near = torch.arange(-1, 2)
    offset = (near[:, None, None] * height + near[:, None]) * width + near
    centre = (at[:, 0] * height + at[:, 1]) * width + at[:, 2]
    return dog.flatten()[centre[:, None] + offset.flatten()]


def _candidates(dog: Tensor, least: float, keep: Tensor | None) -> Tensor:
    """Voxels (n, 3) above ``least`` and strictly above, or below ``-least`` and below, their 26 neighbours."""
    import cv2

    window, inner = np.ones((3, 3), np.uint8), slice(_BORDER, -_BORDER)
    found = []
    for scale in range(1, len(dog) - 1):
        level: Any = dog[scale].numpy()
        high = (level == cv2.dilate(level, window)) & (level > least)
        low = (level == cv2.erode(level, window)) & (level < -least)
        chosen = torch.from_numpy(high | low)[inner, inner]
        where = (chosen if keep is None else chosen & keep[inner, inner]).nonzero() + _BORDER
        found.append(F.pad(where, (1, 0), value=scale))
    at = torch.cat(found)
    values = _cube(dog, at)
    values = values * values[:, 13:14].sign()
    return at[(values >= values[:, 13:14]).sum(1) == 1]


def _refine(dog: Tensor, at: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Voxel, offset of the extremum of the quadratic through its neighbours, and |D| there; the converged ones."""
    bounds = torch.tensor(dog.shape) - torch.tensor([1, _BORDER, _BORDER])
    start = torch.tensor([1, _BORDER, _BORDER])
    offset = torch.zeros(len(at), 3, dtype=dog.dtype)
    gradient, alive = offset, torch.ones(len(at), dtype=torch.bool)
    for _ in range(5):
        value = _cube(dog, at).reshape(-1, 3, 3, 3)
        ahead = torch.stack([value[:, 2, 1, 1], value[:, 1, 2, 1], value[:, 1, 1, 2]], -1)
        behind = torch.stack([value[:, 0, 1, 1], value[:, 1, 0, 1], value[:, 1, 1, 0]], -1)
        gradient = (ahead - behind) / 2
        hessian = torch.diag_embed(ahead + behind - 2 * value[:, 1, 1, 1, None])
        planes = (value[:, :, :, 1], value[:, :, 1, :], value[:, 1, :, :])
        for (i, j), plane in zip(((0, 1), (0, 2), (1, 2)), planes, strict=True):
            mixed = (plane[:, 2, 2] - plane[:, 2, 0] - plane[:, 0, 2] + plane[:, 0, 0]) / 4
            hessian[:, i, j] = hessian[:, j, i] = mixed
        scale = hessian.abs().amax((1, 2)).clamp_min(_TINY)
        solved, wrong = torch.linalg.solve_ex(hessian / scale[:, None, None], -(gradient / scale[:, None])[..., None])
        offset = solved[..., 0]
        alive &= (wrong == 0) & torch.isfinite(offset).all(1) & (offset.abs() < 1e3).all(1)
        offset = torch.where(alive[:, None], offset, 0.0)
        moved = at + torch.where(offset.abs() >= 0.5, offset.round(), 0.0).long()
        alive &= ((moved >= start) & (moved < bounds)).all(1)
        moves = alive & (moved != at).any(1)
        if not moves.any():
            break
        at = torch.where(moves[:, None], moved, at)
    good = alive & (offset.abs() < 0.5).all(1)
    response = (_cube(dog, at)[:, 13] + (gradient * offset).sum(1) / 2).abs()
    return at[good], offset[good], response[good]


def scale_space_extrema(
    image: Float[Tensor, "height width"], contrast: float, mask: Bool[Tensor, "height width"] | None = None
) -> tuple[Float[Tensor, "points 2"], Float[Tensor, " points"], Float[Tensor, " points"]]:
    """Positions (pixels), scales (pixels) and |D| of the extrema of at least ``contrast``, strongest first.

    Args:
        image: grey values in [0, 1], float32, on the CPU.
        contrast: smallest |D|.
        mask: extrema are kept where true.

    Example:
        >>> import torch
        >>> y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
        >>> blob = torch.exp(-((x - 30) ** 2 + (y - 33) ** 2) / (2 * 4.0**2))
        >>> xy, sigma, response = scale_space_extrema(blob.float(), 0.02)
        >>> [round(v) for v in xy[0].tolist()], len(xy)
        ([30, 33], 1)
    """
    parts = []
    for octave, dog in enumerate(_octaves(image.detach())):
        spacing = 0.5 * 2**octave
        keep = None
        if mask is not None:
            outside = F.adaptive_max_pool2d((~mask).to(dog.dtype)[None, None], list(dog.shape[1:]))
            keep = outside[0, 0] == 0  # pixels of the octave that cover none outside the mask
        at, offset, response = _refine(dog, _candidates(dog, contrast / 2, keep))
        index = at + offset
        if keep is not None:
            low, high = index[:, 1:].floor().long(), index[:, 1:].ceil().long()
            corners = [keep[r[:, 0], c[:, 1]] for r in (low, high) for c in (low, high)]
            inside = torch.stack(corners).all(0)
            index, response = index[inside], response[inside]
        sigma = spacing * _SIGMA * 2 ** (index[:, 0] / _INTERVALS)
        parts.append(torch.cat([index[:, [2, 1]] * spacing, sigma[:, None], response[:, None]], -1))
    rows = torch.cat(parts)
    rows = torch.unique(rows[rows[:, 3] >= contrast], dim=0)  # two starts may have come to one extremum
    rows = rows[rows[:, 3].argsort(descending=True)]
    return rows[:, :2], rows[:, 2], rows[:, 3]
