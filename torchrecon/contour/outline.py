"""The outline of a silhouette as an ordered sub-pixel curve: marching squares, all frames at once.

Every edge of the pixel grid that the 0.5 level of the smoothed mask crosses is entered by one cell and left by
another, so the crossings form a permutation whose cycles are the outlines. Pointer doubling labels and orders the
cycles in a logarithmic number of steps, without walking along them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from torchrecon._typing import Bool, Float, Int, Tensor
from torchrecon.errors import ReconError

__all__ = ["NormalisedOutline", "align_start", "fill_outline", "mask_outline", "normalise_outline"]

_PIXELS = 8_000_000
"""Mask pixels looked at once, to bound the memory."""


@dataclass(frozen=True, eq=False)
class NormalisedOutline:
    """An outline without its place and size; ``restore()`` puts them back.

    Attributes:
        shape: (*batch, samples, 2), centroid 0, root mean square distance from it 1.
        centre: (*batch, 2) pixels.
        scale: (*batch) pixels.
    """

    shape: Float[Tensor, "*batch samples 2"]
    centre: Float[Tensor, "*batch 2"]
    scale: Float[Tensor, "*batch"]

    def restore(self) -> Float[Tensor, "*batch samples 2"]:
        """The outline in pixels."""
        return self.shape * self.scale[..., None, None] + self.centre[..., None, :]


def mask_outline(
    masks: Bool[Tensor, "*batch height width"], samples: int = 128, smoothing: float = 1.0
) -> Float[Tensor, "*batch samples 2"]:
    """Outline of the largest part of each mask, sampled at equal arc length.

    The first sample is the top-most point (of several the left-most); the curve runs clockwise on the screen. Holes
    and smaller parts are left out. The mask is taken as zero outside the image, so a cut body is closed along the
    image's border.

    Args:
        masks: True = silhouette.
        samples: number of points on the curve.
        smoothing: standard deviation of the Gaussian that turns the staircase into a curve, pixels; parts thinner than
            about this vanish. A convex curve of radius r moves inwards by about smoothing^2 / (2 r).

    Returns:
        Pixels, x right, y down; integer coordinates are pixel centres.

    Raises:
        ReconError: an empty mask, or one that is too thin to have an outline; fewer than 3 samples.

    Example:
        >>> import torch
        >>> mask = torch.zeros(20, 20, dtype=torch.bool)
        >>> mask[5:15, 4:12] = True
        >>> curve = mask_outline(mask, samples=36, smoothing=0.0)
        >>> [round(v, 1) for v in curve.amin(0).tolist() + curve.amax(0).tolist()]
        [3.5, 4.5, 11.5, 14.5]
    """
    if samples < 3 or smoothing < 0:
        raise ReconError(f"mask_outline: samples {samples} must be at least 3, smoothing {smoothing} not negative")
    batch = masks.shape[:-2]
    flat = masks.reshape(-1, *masks.shape[-2:])
    empty = ~flat.flatten(1).any(1)
    if empty.any():
        raise ReconError(f"masks: {_which(empty, batch)} is empty; leave it out or repair the sequence first")
    curves, known = [], []
    # bounded memory, and frames of a clip close in time are cropped alike
    for chunk in flat.split(max(1, _PIXELS // flat[0].numel())):
        curve, area = _largest_outline(chunk, samples, smoothing)
        curves.append(curve)
        known.append(area > 0)
    thin = ~torch.cat(known)
    if thin.any():
        raise ReconError(f"masks: {_which(thin, batch)} is too thin for an outline at smoothing {smoothing}")
    return torch.cat(curves).reshape(*batch, samples, 2)


def _which(bad: Bool[Tensor, " frames"], batch: torch.Size) -> str:
    """The first bad frame by name."""
    index = int(bad.nonzero()[0])
    return f"frame {index}" if batch else "the mask"


def _largest_outline(
    masks: Bool[Tensor, "frames height width"], samples: int, smoothing: float
) -> tuple[Float[Tensor, "frames samples 2"], Float[Tensor, " frames"]]:
    """The outline that holds the largest area in each frame, and that area; 0 where there is none."""
    rows, columns = (masks.any(0).any(axis).nonzero()[:, 0] for axis in (1, 0))
    top, left = int(rows[0]), int(columns[0])
    box = masks[:, top : int(rows[-1]) + 1, left : int(columns[-1]) + 1].to(torch.get_default_dtype())
    frame, xy, following = _crossings(_smooth(box, smoothing))
    label, order = _cycles(following)
    # signed area of each cycle; outlines of parts are positive, those of holes negative
    after = xy[following]
    cross = (xy[:, 0] * after[:, 1] - xy[:, 1] * after[:, 0]) / 2
    area = torch.zeros_like(cross).index_add(0, label, cross)[label]
    largest = area.new_zeros(len(masks)).scatter_reduce(0, frame, area, "amax")
    # of two parts of one size the first one
    best = torch.where(area == largest[frame], label, len(label))
    first = label.new_full((len(masks),), len(label)).scatter_reduce(0, frame, best, "amin")
    chosen = label == first[frame]
    curve = xy.new_zeros(len(masks), samples, 2)
    if chosen.any():
        curve = _resample(frame[chosen], order[chosen], xy[chosen], len(masks), samples)
    return curve + xy.new_tensor([left, top]), largest


def _smooth(level: Float[Tensor, "n height width"], sigma: float) -> Float[Tensor, "n rows cols"]:
    """Gaussian blur of the mask, with a border of zeros wide enough that every curve closes."""
    radius = math.ceil(3 * sigma)
    level = F.pad(level[:, None], (radius + 1,) * 4)
    if radius:
        taps = torch.exp(-0.5 * (torch.arange(-radius, radius + 1).to(level) / sigma) ** 2)
        taps = taps / taps.sum()
        level = F.conv2d(F.conv2d(level, taps[None, None, :, None]), taps[None, None, None, :])
    return level[:, 0]


def _crossings(
    level: Float[Tensor, "n rows cols"],
) -> tuple[Int[Tensor, " edges"], Float[Tensor, "edges 2"], Int[Tensor, " edges"]]:
    """Where grid edges are crossed: frame, position in pixels of the unpadded mask, and the crossing that follows.

    A cell has corners 0..3 clockwise from the top left and edge k between corners k and k + 1. The curve keeps the
    inside on its right, so it enters a cell where corner k is inside and k + 1 is not, and leaves by the edge before
    the run of inside corners that ends in k. Of two opposite inside corners the cell's mean tells whether they touch.
    """
    rows, cols = level.shape[1:]
    inside = level > 0.5
    total = inside[:, :-1, :-1].byte() + inside[:, :-1, 1:] + inside[:, 1:, 1:] + inside[:, 1:, :-1]
    frame, row, col = ((total > 0) & (total < 4)).nonzero(as_tuple=True)
    here = (frame * rows + row) * cols + col
    values = level.flatten()[here + here.new_tensor([0, 1, cols + 1, cols])[:, None]]
    corner = values > 0.5
    # edges by the pixel at their upper or left end: 2 * pixel to the right, 2 * pixel + 1 down
    edge = torch.stack([2 * here, 2 * here + 3, 2 * (here + cols), 2 * here + 1])
    joined = (corner[0] == corner[2]) & (corner[1] == corner[3]) & (values.mean(0) > 0.5)
    start, end = [], []
    for k in range(4):
        enters = corner[k] & ~corner[(k + 1) % 4]
        run = torch.where(corner[k - 1], torch.where(corner[k - 2], 3, 2), 1)
        # joined across the cell: the run of inside corners goes on behind the outside one
        leaves = edge.gather(0, ((k - torch.where(joined, 3, run)) % 4)[None])[0]
        start.append(edge[k][enters])
        end.append(leaves[enters])
    begin, finish = torch.cat(start), torch.cat(end)
    begin, order = begin.sort()
    following = torch.searchsorted(begin, finish[order])
    pixel, axis = begin // 2, begin % 2
    other = pixel + torch.where(axis == 0, 1, cols)
    a, b = level.flatten()[pixel], level.flatten()[other]
    share = (0.5 - a) / (b - a)
    # the border of zeros is one pixel wide
    x = (pixel % cols).to(level) - 1 + torch.where(axis == 0, share, 0.0)
    y = (pixel // cols % rows).to(level) - 1 + torch.where(axis == 1, share, 0.0)
    return pixel // (rows * cols), torch.stack([x, y], -1), following


def _cycles(following: Int[Tensor, " edges"]) -> tuple[Int[Tensor, " edges"], Int[Tensor, " edges"]]:
    """Label (smallest member) of each element's cycle, and its steps from that member."""
    count = len(following)
    label, jump = torch.arange(count, device=following.device), following
    for _ in range(max(1, count.bit_length())):
        label, jump = torch.minimum(label, label[jump]), jump[jump]
    # steps to the end of the list that each cycle becomes when cut before its label
    last = following == label
    jump = torch.where(last, torch.arange(count, device=following.device), following)
    steps = (~last).long()
    for _ in range(max(1, count.bit_length())):
        steps, jump = steps + steps[jump], jump[jump]
    return label, steps[label] - steps


def _resample(
    frame: Int[Tensor, " edges"], order: Int[Tensor, " edges"], xy: Float[Tensor, "edges 2"], frames: int, samples: int
) -> Float[Tensor, "frames samples 2"]:
    """Equal arc length from the top-most point; curves of different lengths are padded with their last point."""
    length = torch.bincount(frame, minlength=frames).clamp_min(1)
    width = int(length.max())
    curve = xy.new_zeros(frames, width, 2)
    curve[frame, order] = xy
    place = torch.arange(width, device=xy.device).expand(frames, width)
    y = torch.where(place < length[:, None], curve[..., 1], torch.inf)
    x = torch.where(y <= y.amin(1, keepdim=True) + 1e-6, curve[..., 0], torch.inf)
    place = (x.argmin(1, keepdim=True) + place.clamp(max=length[:, None])) % length[:, None]
    # the column after the last one closes the curve
    place = torch.cat([place, x.argmin(1, keepdim=True)], 1)
    curve = curve.gather(1, place[..., None].expand(-1, -1, 2))
    arc = F.pad((curve[:, 1:] - curve[:, :-1]).norm(dim=-1).cumsum(1), (1, 0))
    target = arc[:, -1:] * torch.arange(samples, device=xy.device).to(xy) / samples
    upper = torch.searchsorted(arc, target, right=True).clamp(1, width)
    low, high = arc.gather(1, upper - 1), arc.gather(1, upper)
    share = ((target - low) / (high - low).clamp_min(1e-12))[..., None]
    ends = (curve.gather(1, (upper + step)[..., None].expand(-1, -1, 2)) for step in (-1, 0))
    return torch.lerp(next(ends), next(ends), share)


def normalise_outline(xy: Float[Tensor, "*batch samples 2"]) -> NormalisedOutline:
    """Take place and size out of outlines.

    Raises:
        ReconError: a curve whose points all coincide.

    Example:
        >>> import torch
        >>> square = torch.tensor([[3.0, 3.0], [5.0, 3.0], [5.0, 5.0], [3.0, 5.0]])
        >>> out = normalise_outline(square)
        >>> out.centre.tolist(), round(float(out.scale), 3), bool((out.restore() - square).abs().max() < 1e-6)
        ([4.0, 4.0], 1.414, True)
    """
    centre = xy.mean(-2)
    shape = xy - centre[..., None, :]
    scale = shape.square().sum(-1).mean(-1).sqrt()
    if not (scale > 0).all():
        raise ReconError("xy: the points of an outline coincide (or are NaN); it has no size")
    return NormalisedOutline(shape / scale[..., None, None], centre, scale)


def align_start(
    xy: Float[Tensor, "*batch samples 2"], reference: Float[Tensor, "*batch samples 2"]
) -> Float[Tensor, "*batch samples 2"]:
    """Outlines whose first sample is moved along the curve so that they lie closest to a reference.

    The top-most point jumps when a hand rises above the head; this keeps the numbering of a sequence together.

    Example:
        >>> import torch
        >>> square = torch.tensor([[3.0, 3.0], [5.0, 3.0], [5.0, 5.0], [3.0, 5.0]])
        >>> bool((align_start(square.roll(1, 0), square) == square).all())
        True
    """
    samples = xy.shape[-2]
    a, b = (v - v.mean(-2, keepdim=True) for v in (xy, reference))
    # correlation of the complex curves over all shifts; the real part is the sum of both coordinates' products
    spectrum = (
        torch.fft.fft(torch.complex(a[..., 0], a[..., 1])) * torch.fft.fft(torch.complex(b[..., 0], b[..., 1])).conj()
    )
    shift = torch.fft.ifft(spectrum).real.argmax(-1)
    index = (torch.arange(samples, device=xy.device) + shift[..., None]) % samples
    return xy.gather(-2, index[..., None].expand_as(xy))


def fill_outline(xy: Float[Tensor, "*batch samples 2"], size: tuple[int, int]) -> Bool[Tensor, "*batch height width"]:
    """Mask of the pixels whose centres lie inside closed curves (non-zero winding number).

    Args:
        xy: pixels; may reach beyond the image.
        size: (height, width).

    Example:
        >>> import torch
        >>> square = torch.tensor([[0.5, 0.5], [3.5, 0.5], [3.5, 2.5], [0.5, 2.5]])
        >>> fill_outline(square, (4, 5)).int().tolist()
        [[0, 0, 0, 0, 0], [0, 1, 1, 1, 0], [0, 1, 1, 1, 0], [0, 0, 0, 0, 0]]
    """
    height, width = size
    curve = xy.reshape(-1, *xy.shape[-2:])
    after = curve.roll(-1, 1)
    row = torch.arange(height, device=xy.device).to(xy)[:, None]
    (x0, y0), (x1, y1) = curve[:, None].unbind(-1), after[:, None].unbind(-1)
    direction = (y0 <= row).long() - (y1 <= row).long()
    # an edge that crosses a row's centre line changes the winding number of all pixels to its right
    rise = torch.where(direction == 0, 1.0, y1 - y0)
    column = torch.ceil(x0 + (row - y0) / rise * (x1 - x0)).clamp(0, width).nan_to_num(width).long()
    turns = torch.zeros(len(curve), height, width + 1, dtype=torch.long, device=xy.device)
    turns.scatter_add_(2, column, direction)
    return (turns.cumsum(2)[..., :width] != 0).reshape(*xy.shape[:-2], height, width)
