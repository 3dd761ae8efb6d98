"""Training films of the recogniser: true 3D of body surfaces as a camera sees them, made to look like tracks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import Dataset, Sampler

from torchrecon.data.mocap import MocapClip
from torchrecon.data.synthetic import (
    ACTIONS,
    Body,
    Camera,
    Motion,
    SyntheticClip,
    retarget_joints,
    sample_body,
    sample_motion,
    static_camera,
    turning_camera,
)
from torchrecon.models.views import ReadOut, held, hold_last, pictures, settle, yaws_of

WINDOW = 32
"""Frames that the recogniser looks at."""


@dataclass(frozen=True, eq=False)
class Film:
    """Surface points of one body in one motion before one camera.

    Attributes:
        points3d: (frames, points, 3) camera axes, metres.
        visible: (frames, points) the points that the camera sees.
        rotations: (frames, 3, 3) world -> camera.
        thickness: (points,) metres, radius of the limb or trunk that a point sits on.
        label: index of the class.
    """

    points3d: Tensor
    visible: Tensor
    rotations: Tensor
    thickness: Tensor
    label: int


@dataclass(frozen=True)
class Augmentation:
    """How a film is varied each time it is shown.

    Attributes:
        points: fewest and most points that are tracked at all.
        crowding: spread (log) of how often a region of the body is tracked: texture is uneven.
        thin: lowest and highest power of the thickness of a part with which its points are tracked: few windows fit on
            a thin part, so a tracker has fewer points on a forearm than its area would give.
        speed: lowest and highest speed in the image against the body's mean, metres per frame, at which every second
            track is lost.
        steep: lowest and highest power with which the loss grows with the speed beyond that.
        life: shortest and longest life of a track, frames; between lives a point is lost for a third of a life.
        shortest: fewest and most frames that a track must live to be one: a limb that is fast nearly always has none.
        shown: odds that a film shows each point while it is tracked, for a while before and after too, or always:
            a method may say where a point is that the camera does not see.
        hold: longest "while before and after", frames.
        jitter: largest noise of a coordinate, rms sizes of the clip.
        offset: largest standing error of a track's depth, rms sizes.
        depth_scale: largest relative error of the scale of depth.
        tempo: largest relative change of speed.
        flat: odds that a variation has no depth to speak of and is shown as the distractor class ``flat``: what can
            be read without depth must not be what the recogniser reads. Not for the recogniser of 2D views.
        flat_depth: largest share of its depth that a flat variation keeps: little, because what is seen of a body from
            one side is shallow too.
    """

    points: tuple[int, int] = (150, 600)
    crowding: float = 1.0
    thin: tuple[float, float] = (0.5, 4.0)
    speed: tuple[float, float] = (0.007, 0.06)
    steep: tuple[float, float] = (1.0, 3.0)
    life: tuple[int, int] = (8, 60)
    shortest: tuple[int, int] = (1, 8)
    shown: tuple[float, float, float] = (0.5, 0.25, 0.25)
    hold: int = 16
    jitter: float = 0.06
    offset: float = 0.1
    depth_scale: float = 0.15
    tempo: float = 0.15
    flat: float = 0.1
    flat_depth: float = 0.05


AS_TRACKED = Augmentation(
    points=(600, 601),
    thin=(2.0, 2.0),
    speed=(0.02, 0.02),
    steep=(1.0, 1.0),
    life=(8, 30),
    shortest=(5, 5),
    shown=(1.0, 0.0, 0.0),
    jitter=0.0,
    offset=0.0,
    depth_scale=0.0,
    tempo=0.0,
)
"""Exact 3D at the points and times that a tracker would give: what the validity check looks at. Thickness and speed
are fitted to where the tracker holds points on films of training seeds."""


FLAT_CLASS = "flat"
"""The distractor class of shapes without depth, the last of the recogniser of 3D shapes."""

MOCAP_CLASSES = ("shoot", "run", "jump", "pass", "dribble", "walk")
"""Of real motion; dribble and walk are the distractors."""


def synthetic_film(seed: int, points: int, turn: float | None = None) -> Film:
    """Film number ``seed`` of the synthetic world; the action is ``ACTIONS[seed % 6]``.

    Args:
        turn: degrees that the camera turns in all; None draws: every third camera stands still.
    """
    g = torch.Generator().manual_seed(seed)
    label = seed % len(ACTIONS)
    body = sample_body(g)
    motion = sample_motion(ACTIONS[label], body, generator=g)
    return film_of(body, motion, label, points, turn, g)


def film_of(body: Body, motion: Motion, label: int, points: int, turn: float | None, g: torch.Generator) -> Film:
    """Surface points of a moving body before a random camera."""
    draw = torch.rand(3, generator=g).tolist()
    if turn is None:
        turn = 0.0 if draw[0] < 1 / 3 else 360 * draw[1]
    distance = 6 + 2 * draw[2]
    camera: Camera
    if turn == 0:
        camera = static_camera(motion, distance=distance, generator=g)
    else:
        camera = turning_camera(motion, total_turn_deg=turn, distance=distance, generator=g)
    clip = SyntheticClip(body, motion, camera)
    surface = clip.sample_surface(points, g)
    xyz, seen = clip.trajectory(surface)
    thickness = (body.radii.mean(-1) * body.scale.amin(-1))[surface.part]
    ever = seen.any(0)
    return Film(xyz[:, ever].float(), seen[:, ever], camera.rotations.float(), thickness[ever].float(), label)


def mocap_film(seed: int, clips: dict[str, list[MocapClip]], points: int) -> Film:
    """Film number ``seed`` of real motion on a random body; the action is ``MOCAP_CLASSES[seed % 6]``.

    Every other film of what the synthetic world can perform is its own: a few people show an action in a few ways. A
    class without clips is performed by it alone.
    """
    g = torch.Generator().manual_seed(seed)
    turn, label = divmod(seed, len(MOCAP_CLASSES))
    name = MOCAP_CLASSES[label]
    of_class = clips[name]
    body = sample_body(g)
    if of_class and (name not in ACTIONS or turn % 2):
        clip = of_class[turn // (1 + (name in ACTIONS)) % len(of_class)]
        motion = retarget_joints(clip.joints, clip.parents, clip.names, body, clip.fps)
    else:
        motion = sample_motion(name, body, generator=g)
    return film_of(body, motion, label, points, None, g)


def held_out_film(seed: int, clips: list[MocapClip], points: int, turn: float) -> Film:
    """Clip number ``seed % len(clips)`` on a random body before a camera that turns by ``turn`` degrees."""
    g = torch.Generator().manual_seed(seed)
    clip = clips[seed % len(clips)]
    body = sample_body(g)
    motion = retarget_joints(clip.joints, clip.parents, clip.names, body, clip.fps)
    return film_of(body, motion, MOCAP_CLASSES.index(clip.label), points, turn, g)


def make_films(make: Callable[[int], Film], seeds: range, workers: int) -> Iterator[Film]:
    """``make`` of each seed, in order."""
    with ProcessPoolExecutor(max(1, workers), initializer=torch.set_num_threads, initargs=(1,)) as pool:
        for *arrays, label in pool.map(partial(_arrays, make), seeds, chunksize=4):
            yield Film(*(torch.from_numpy(array) for array in arrays), label)


def _arrays(make: Callable[[int], Film], seed: int) -> tuple[Any, ...]:
    """Arrays travel between processes by value; tensors would hold a file open for each."""
    film = make(seed)
    tensors = (film.points3d, film.visible, film.rotations, film.thickness)
    return (*(tensor.numpy() for tensor in tensors), film.label)


def augment(film: Film, how: Augmentation, generator: torch.Generator) -> Film:
    """A variation of the film: fewer points, tracks that are born and die, another tempo, a mirror image, noise."""

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=generator)

    points3d, visible, rotations = _retimed(film, float(uniform(1 - how.tempo, 1 + how.tempo)))
    frames, count = visible.shape

    middle = points3d[frames // 2]
    seeds = middle[torch.randint(count, (12,), generator=generator)]
    region = torch.cdist(middle, seeds).argmin(-1)
    odds = torch.exp(how.crowding * torch.randn(len(seeds), generator=generator))[region]
    odds = odds * (film.thickness / film.thickness.amax()) ** uniform(*how.thin)
    wanted = min(count, int(uniform(*how.points)))
    chosen = torch.multinomial(odds, wanted, generator=generator)
    points3d, visible = points3d[:, chosen], visible[:, chosen]

    life = uniform(*how.life, wanted)
    clock = torch.arange(frames)[:, None] / (life * 4 / 3) + uniform(0, 1, wanted)
    alive = visible & (clock.remainder(1.0) < 0.75)
    # A tracker loses what is fast in the image against the rest of the body; some windows hold on longer than others.
    # Mostly gradually, as on real tracks: were fast limbs never seen, their absence would be what names a jump.
    pace = (_image_speed(points3d, visible) / uniform(*how.speed)) ** uniform(*how.steep)
    alive = alive & (uniform(0, 1, wanted) < 1 / (1 + pace))
    alive = _lasting(alive, int(torch.randint(how.shortest[0], how.shortest[1] + 1, (), generator=generator)))
    visible = torch.where(alive.any(1, keepdim=True), alive, visible)
    kept = visible.any(0)
    points3d, visible, wanted, chosen = points3d[:, kept], visible[:, kept], int(kept.sum()), chosen[kept]
    visible = _held(visible, how, generator)

    if float(uniform(0, 1)) < 0.5:  # the mirror image of body, world and camera together
        mirror = torch.tensor([-1.0, 1.0, 1.0])
        points3d, rotations = points3d * mirror, rotations * mirror[:, None] * mirror

    size = _rms_size(points3d, visible)
    depth = points3d[..., 2:]
    centre = depth.mean(1, keepdim=True)
    depth = centre + (depth - centre) * uniform(1 - how.depth_scale, 1 + how.depth_scale)
    depth = depth + size * uniform(0, how.offset) * torch.randn(wanted, 1, generator=generator)
    points3d = torch.cat([points3d[..., :2], depth], -1)
    points3d = points3d + size * uniform(0, how.jitter) * torch.randn(points3d.shape, generator=generator)
    return replace(film, points3d=points3d, visible=visible, rotations=rotations, thickness=film.thickness[chosen])


def _lasting(alive: Tensor, shortest: int) -> Tensor:
    """Without the lives that are shorter than ``shortest`` frames."""
    alive = F.pad(alive.T.float(), (shortest - 1, shortest - 1))
    whole = -F.max_pool1d(-alive, shortest, stride=1)  # 1 where a stretch of that length begins
    return F.max_pool1d(whole, shortest, stride=1).T > 0


def _held(visible: Tensor, how: Augmentation, generator: torch.Generator) -> Tensor:
    """The entries that a method would stand for: those tracked, some more around them, or all."""
    kind = int(torch.multinomial(torch.tensor(how.shown), 1, generator=generator))
    hold = (0, int(torch.randint(1, how.hold + 1, (), generator=generator)), len(visible))[kind]
    return held(visible, hold) if hold < len(visible) else torch.ones_like(visible)


def flat(film: Film, share: float = 0.0) -> Film:
    """The same film with a share of its depth, about the mean of each frame; 0: with depth unknown."""
    depth = film.points3d[..., 2:]
    depth = share * (depth - depth.mean(1, keepdim=True))
    return replace(film, points3d=torch.cat([film.points3d[..., :2], depth], -1))


def _rms_size(points3d: Tensor, visible: Tensor) -> Tensor:
    weight = visible[..., None].to(points3d.dtype)
    centre = (points3d * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp_min(1)
    return (((points3d - centre).square() * weight).sum() / weight.sum()).sqrt()


def _image_speed(points3d: Tensor, visible: Tensor) -> Tensor:
    """Steps parallel to the image against the mean step of the visible points, (frames, points), unit of the points."""
    step = points3d[1:, :, :2] - points3d[:-1, :, :2]
    weight = visible[1:, :, None].to(step.dtype)
    mean = (step * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp_min(1)
    pace = (step - mean).norm(dim=-1)
    return torch.cat([pace[:1], pace])


def _retimed(film: Film, speed: float) -> tuple[Tensor, Tensor, Tensor]:
    """The film at another speed: points between frames on straight lines, the rest from the nearest frame."""
    if speed == 1:
        return film.points3d, film.visible, film.rotations
    last = len(film.points3d) - 1
    at = torch.arange(0, last + 1e-6, speed)
    before = at.floor().long().clamp(max=last - 1)
    share = (at - before)[:, None, None]
    nearest = at.round().long()
    # The camera of the nearest frame belongs to the points of that frame: interpolate them in world axes.
    world = film.points3d @ film.rotations
    world = world[before] * (1 - share) + world[before + 1] * share
    rotations = film.rotations[nearest]
    return world @ rotations.transpose(-1, -2), film.visible[nearest], rotations


class Windows(Dataset[tuple[Tensor, Tensor]]):
    """Windows of one variation of a film, asked for by (epoch, index): the same pair is the same windows.

    Each starts at another frame and is seen from another yaw; to settle the shape costs more than to draw it.
    """

    def __init__(
        self,
        films: list[Film],
        params: ReadOut,
        how: Augmentation,
        windows: int,
        seed: int,
        flat_label: int | None = None,
    ) -> None:
        self.films, self.params, self.how, self.windows, self.seed = films, params, how, windows, seed
        self.flat_label = flat_label

    def __len__(self) -> int:
        return len(self.films)

    def __getitem__(self, drawn: tuple[int, int]) -> tuple[Tensor, Tensor]:
        epoch, index = drawn
        generator = torch.Generator().manual_seed((self.seed * 10_007 + epoch) * 1_000_003 + index)
        film = augment(self.films[index], self.how, generator)
        label = film.label
        if self.flat_label is not None and float(torch.rand((), generator=generator)) < self.how.flat:
            film = flat(film, self.how.flat_depth * float(torch.rand((), generator=generator)))
            label = self.flat_label
        settled = settle(film.points3d, film.visible, film.rotations, self.params)
        yaws, weights = yaws_of(film.rotations, 60)
        volumes = []
        for yaw in yaws[torch.multinomial(weights, self.windows, replacement=True, generator=generator)].tolist():
            start = int(torch.randint(max(1, len(film.points3d) - WINDOW + 1), (), generator=generator))
            volumes.append(hold_last(pictures(settled, self.params, yaw, slice(start, start + WINDOW)), WINDOW))
        return torch.stack(volumes), torch.full((self.windows,), label)


class Draws(Sampler[tuple[int, int]]):
    """(epoch, index) of the films that an epoch shows, the trainer sets which; rare classes come as often as others."""

    def __init__(self, films: list[Film]) -> None:
        labels = torch.tensor([film.label for film in films])
        self.odds = 1.0 / torch.bincount(labels)[labels]
        self.epoch = self.first = 0

    def begin(self, epoch: int) -> None:
        """Draw no epoch before this one: the trainer of a resumed run asks for films before it sets the epoch."""
        self.epoch = self.first = epoch

    def set_epoch(self, epoch: int) -> None:
        self.epoch = max(epoch, self.first)

    def __len__(self) -> int:
        return len(self.odds)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        generator = torch.Generator().manual_seed(self.epoch)
        for index in torch.multinomial(self.odds, len(self), replacement=True, generator=generator).tolist():
            yield self.epoch, index
