"""The read-out: a moving shape of any method, or the truth, becomes pictures from the side and from above.

It takes out what a method cannot know or need not know (place, size, names) and what a tracker decides and not the
shape (how many points there are where, and which of them are seen when). It never shows the camera's own view, which
every method gets right for free.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.render.splat import splat

__all__ = ["ReadOut", "Settled", "held", "hold_last", "pictures", "read_out", "settle", "yaws_of"]

_VIEWS = ("side", "top", "camera")


@dataclass(frozen=True)
class ReadOut:
    """How a moving shape becomes pictures.

    Attributes:
        views: any of ``side`` (from one world yaw), ``top`` (from above, turned by that yaw) and ``camera`` (the
            camera's own view, depth unread: only for the recogniser of 2D views).
        size: height and width of a picture, pixels.
        extent: half the width of a picture, in rms sizes of the clip.
        sigma: standard deviation of a splatted point, pixels.
        gain: steepness of the occupancy 1 - exp(-gain * mass), where a place of width ``spacing`` that is seen at all,
            by one point or by twenty, has mass 1.
        spacing: radius of that place, rms sizes of the clip.
        anchor: how strongly the centre of a frame is tied to the median of its own points, against the tracks it
            shares with other frames (see :func:`settle`).
        yaws: how many world yaws, evenly round the circle, a test averages over (see :func:`yaws_of`).

    Example:
        >>> ReadOut(views=("camera",), yaws=1).size
        24
    """

    views: tuple[str, ...] = ("side", "top")
    size: int = 24
    extent: float = 2.8
    sigma: float = 0.7
    gain: float = 3.0
    spacing: float = 0.3
    anchor: float = 0.003
    yaws: int = 4

    def __post_init__(self) -> None:
        if not self.views or any(view not in _VIEWS for view in self.views):
            raise ReconError(f"ReadOut: views {self.views} must be one or more of {_VIEWS}")
        if min(self.size, self.extent, self.sigma, self.gain, self.spacing, self.anchor, self.yaws) <= 0:
            raise ReconError(f"ReadOut: every number must be positive, got {self}")


def read_out(
    points3d: Float[Tensor, "*batch frames points 3"],
    visible: Bool[Tensor, "*batch frames points"],
    camera_rotations: Float[Tensor, "*batch frames 3 3"],
    params: ReadOut = ReadOut(),
    yaw: float = 0.0,
    frames: slice = slice(None),
) -> Float[Tensor, "*batch views shown size size"]:
    """Turn a moving shape into pictures over time, the same way for every method and for the truth.

    The shape is settled (:func:`settle`), the camera's rotations bring it to world axes, and each view is splatted.
    Global scale and a translation of each frame change nothing, nor does how densely the points lie.

    Convention:
        World axes have Y up. At yaw 0 the side view looks along -Z (picture right = +X, picture down = -Y) and the
        top view has picture right = +X, picture down = +Z. ``yaw`` turns the world about Y before it is seen.

    Args:
        points3d: camera axes (x right, y down, z forward), any unit. Entries that are not visible are not read.
        visible: the observed entries.
        camera_rotations: world -> camera, of the film.
        yaw: radians.
        frames: which frames to show; the rms size is always that of the whole clip.

    Returns:
        float32 occupancy in [0, 1); a frame without observed points is empty.

    Raises:
        ReconError: an observed entry is not finite, or nothing is observed.

    Example:
        >>> points = torch.rand(5, 20, 3)
        >>> read_out(points, torch.ones(5, 20, dtype=torch.bool), torch.eye(3).expand(5, 3, 3)).shape
        torch.Size([2, 5, 24, 24])
    """
    return pictures(settle(points3d, visible, camera_rotations, params), params, yaw, frames)


def held(visible: Bool[Tensor, "frames points"], frames: int) -> Bool[Tensor, "frames points"]:
    """Each stretch in which a point is seen, longer by ``frames`` at both ends.

    Example:
        >>> held(torch.tensor([0, 0, 0, 1, 0, 0])[:, None] > 0, 2)[:, 0].int().tolist()
        [0, 1, 1, 1, 1, 1]
    """
    reach = min(frames, len(visible))
    return torch.nn.functional.max_pool1d(visible.T.float(), 2 * reach + 1, stride=1, padding=reach).T > 0


class Settled(NamedTuple):
    """A moving shape without place and size, its points in no order.

    Attributes:
        world: (*batch, frames, kept, 3) world axes, rms sizes of the clip; zero where nothing is observed.
        camera: (*batch, frames, kept, 2) the same in camera axes, x right and y down.
        weight: (*batch, frames, kept) of each entry: a place seen by many points weighs what one seen by one does.
    """

    world: Float[Tensor, "*batch frames kept 3"]
    camera: Float[Tensor, "*batch frames kept 2"]
    weight: Float[Tensor, "*batch frames kept"]


def settle(
    points3d: Float[Tensor, "*batch frames points 3"],
    visible: Bool[Tensor, "*batch frames points"],
    camera_rotations: Float[Tensor, "*batch frames 3 3"],
    params: ReadOut = ReadOut(),
) -> Settled:
    """Take place, size and density out of a moving shape: what :func:`read_out` does before it draws.

    A tracker holds many points on a trunk and few on a forearm, so each point weighs one over the number of points
    at its place. Each frame is first centred at the geometric median of its points, which jumps as points come and
    go; then so that, in world axes, each track lies as close to its own mean as the frames allow: the points that
    two frames share say where one is against the other. Last, the clip is divided by its rms size.

    Args:
        points3d, visible, camera_rotations: as for :func:`read_out`.

    Example:
        >>> points = torch.rand(1, 20, 3) + torch.rand(5, 1, 3)  # the frames differ by a translation alone
        >>> visible = torch.rand(5, 20) < 0.8
        >>> world = settle(points, visible, torch.eye(3).expand(5, 3, 3)).world
        >>> world.shape[:-2], world.shape[-1]
        (torch.Size([5]), 3)
    """
    if params.views == ("camera",):  # depth must not leak in through centre and size either
        points3d = torch.cat([points3d[..., :2], torch.zeros_like(points3d[..., 2:])], -1)
    # In float64: the equations of the sway and the distances of near neighbours lose too many digits for float32.
    shape = torch.where(visible[..., None], points3d, torch.zeros_like(points3d)).to(torch.float64)
    if not torch.isfinite(shape).all():
        where = torch.nonzero(~torch.isfinite(shape).all(-1))[0].tolist()
        raise ReconError(f"read_out: points3d at index {where} is marked visible but not finite; unmark or fill it")
    if not visible.any(-1).any(-1).all():
        raise ReconError("read_out: nothing is visible in the clip; a shape needs observed points")
    rotations = camera_rotations.to(torch.float64)
    weight = visible.to(torch.float64)
    shape = shape - _weighted_mean(shape, weight)
    shape = shape / _rms_size(shape, weight)
    weight = weight / _crowd(shape, visible, params.spacing)
    shape = shape - _weighted_mean(shape, weight)
    shape = shape / _rms_size(shape, weight)
    shape = torch.where(visible[..., None], shape - _median(shape, weight), torch.zeros_like(shape))
    # In its own axes the recogniser of 2D views must not learn of depth from how the camera turns.
    world = shape if params.views == ("camera",) else shape @ rotations
    world = torch.where(visible[..., None], world - _sway(world, weight, params.anchor), torch.zeros_like(world))
    # Keep no more entries per frame than the fullest frame shows: most points are unseen most of the time.
    fullest = int(visible.sum(-1).amax())
    kept = visible.to(torch.uint8).argsort(dim=-1, descending=True, stable=True)[..., :fullest]
    world = world.gather(-2, kept[..., None].expand(*kept.shape, 3))
    camera = world if params.views == ("camera",) else world @ rotations.transpose(-1, -2)
    return Settled(world.float(), camera[..., :2].float(), weight.gather(-1, kept).float())


def _crowd(shape: Tensor, visible: Tensor, spacing: float) -> Tensor:
    """(*batch, frames, points) how many points of the frame share the place of each, itself counted.

    The place ends at ``spacing``; what a point counts falls to zero towards there as 1 - (distance / spacing)^2.
    """
    count = shape.shape[-2]
    crowds = []
    # Frame by frame: the pairs of one frame stay in the processor's cache, those of a clip do not.
    for place, shown in zip(shape.reshape(-1, count, 3), visible.reshape(-1, count), strict=True):
        place = place[shown]
        square = place.square().sum(-1)
        apart = torch.addmm(square[:, None] + square, place, place.T, alpha=-2)
        near = (1 - apart / spacing**2).clamp(0, 1).sum(-1).clamp_min(1)
        crowds.append(near.new_ones(count).masked_scatter(shown, near))
    return torch.stack(crowds).reshape(visible.shape)


def _median(shape: Tensor, weight: Tensor) -> Tensor:
    """(*batch, frames, 1, 3) the geometric median of each frame by Weiszfeld's steps.

    Stray points, which some methods have and others not, move it little, and unlike a median per axis it turns with
    the body.
    """
    centre = torch.zeros_like(shape[..., :1, :])
    for _ in range(5):
        centre = _weighted_mean(shape, weight / _softened(shape - centre))
    return centre


def _sway(world: Tensor, weight: Tensor, anchor: float) -> Tensor:
    """(*batch, frames, 1, 3) the translation of each frame that its tracks do not follow.

    The c_f that, with the tracks' means m_i, minimise sum_fi w_fi |x_fi - m_i - c_f|^2 + anchor * w * sum_f |c_f|^2,
    where w is the mean weight of a frame. The m_i are eliminated, which leaves one equation per frame. The second
    pass weighs an entry by one over its distance from the first, so that stray points count little.
    """
    robust = weight
    centre = torch.zeros_like(world[..., :1, :])
    for _ in range(2):
        own = robust.sum(-2, keepdim=True).clamp_min(torch.finfo(torch.float32).tiny)
        mean = (world * robust[..., None]).sum(-3, keepdim=True) / own[..., None]
        shared = (robust / own) @ robust.transpose(-1, -2)
        frames = robust.sum(-1)
        normal = torch.diag_embed(frames + anchor * frames.mean(-1, keepdim=True)) - shared
        centre = torch.linalg.solve(normal, ((world - mean) * robust[..., None]).sum(-2))[..., None, :]
        robust = weight / _softened(world - mean - centre)
    return centre


def _softened(away: Tensor) -> Tensor:
    """Lengths (*batch, points), never nearer to zero than 0.05 rms sizes."""
    return away.square().sum(-1).add(0.05**2).sqrt()


def _weighted_mean(shape: Tensor, weight: Tensor) -> Tensor:
    """(*batch, frames, 1, 3); zero in a frame without weight."""
    total = weight.sum(-1)[..., None, None].clamp_min(torch.finfo(torch.float32).tiny)
    return (shape * weight[..., None]).sum(-2, keepdim=True) / total


def _rms_size(shape: Tensor, weight: Tensor) -> Tensor:
    """(*batch, 1, 1, 1) of the whole clip, its frames centred."""
    size = ((shape.square().sum(-1) * weight).sum((-1, -2)) / weight.sum((-1, -2))).sqrt()
    return size[..., None, None, None].clamp_min(torch.finfo(torch.float32).tiny)


def pictures(
    settled: Settled, params: ReadOut = ReadOut(), yaw: float = 0.0, frames: slice = slice(None)
) -> Float[Tensor, "*batch views shown size size"]:
    """Draw a settled shape, as :func:`read_out` says.

    Example:
        >>> settled = settle(torch.rand(5, 20, 3), torch.ones(5, 20, dtype=torch.bool), torch.eye(3).expand(5, 3, 3))
        >>> pictures(settled, yaw=1.0).shape
        torch.Size([2, 5, 24, 24])
    """
    world, camera, weight = settled.world[..., frames, :, :], settled.camera[..., frames, :, :], settled.weight
    cosine, sine = math.cos(yaw), math.sin(yaw)
    right = cosine * world[..., 0] + sine * world[..., 2]
    towards = cosine * world[..., 2] - sine * world[..., 0]
    planes = {
        "side": (right, -world[..., 1]),
        "top": (right, towards),
        "camera": (camera[..., 0], camera[..., 1]),
    }
    xy = torch.stack([torch.stack(planes[view], -1) for view in params.views], -4)
    pixels = (xy / params.extent + 1) * (params.size / 2) - 0.5
    shares = weight[..., frames, :].unsqueeze(-3).expand(pixels.shape[:-1])
    mass = splat(pixels, shares, (params.size, params.size), params.sigma)
    return 1 - torch.exp(-params.gain * mass)


def yaws_of(
    camera_rotations: Float[Tensor, "frames 3 3"], count: int
) -> tuple[Float[Tensor, " yaws"], Float[Tensor, " yaws"]]:
    """World yaws to look from, and how much each counts: never the camera's own view.

    The weight of a yaw is the share of the side view's horizontal axis that is depth to the camera, mean over the
    frames of cos^2 of the angle between the two: 0 for the own view of a camera that stands still, about the same
    for all yaws if it goes round. The first yaw is the one of largest weight, the others follow evenly.

    Returns:
        yaws: radians.
        weights: they sum to 1.

    Example:
        >>> yaws, weights = yaws_of(torch.eye(3).expand(5, 3, 3), 4)  # a camera that looks along Z
        >>> [round(math.degrees(yaw)) for yaw in yaws], [round(float(weight), 2) for weight in weights]
        ([90, 180, 270, 360], [0.5, 0.0, 0.5, 0.0])
    """
    axis = camera_rotations[:, 2, ::2].double()
    axis = axis / axis.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    # Twice the angle, so that opposite directions, which show the same depth, do not cancel.
    double = torch.stack([axis[:, 0].square() - axis[:, 1].square(), 2 * axis[:, 0] * axis[:, 1]], -1).mean(0)
    best = torch.atan2(double[1], double[0]) / 2
    yaws = best + 2 * math.pi * torch.arange(count, dtype=torch.float64, device=axis.device) / count
    right = torch.stack([yaws.cos(), yaws.sin()], -1)
    weights = (right @ axis.T).square().mean(-1)
    return yaws, weights / weights.sum()


def hold_last(volume: Float[Tensor, "views frames size size"], window: int) -> Tensor:
    """The volume itself, or, where it is shorter than ``window`` frames, with its last picture held."""
    missing = window - volume.shape[1]
    return volume if missing <= 0 else torch.cat([volume, volume[:, -1:].expand(-1, missing, -1, -1)], 1)
