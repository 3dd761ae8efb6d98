"""Which action is it: a small CNN that sees a moving shape as pictures from the side and from above.

The recogniser is the ruler of Table 1, not a part of the road: it is trained on true 3D, and a method is as good as
the actions that can be told from its shapes. One function, :func:`read_out`, turns the points of any method and the
true ones into what the network sees. It never sees the camera's own view, which every method gets right for free.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from torchrecon._typing import Bool, Float, Int, Tensor
from torchrecon.errors import ReconError
from torchrecon.render.splat import splat

__all__ = [
    "ReadOut",
    "Recogniser",
    "WindowScores",
    "classify_windows",
    "load_recogniser",
    "read_out",
    "save_recogniser",
    "weights_hash",
    "yaws_of",
]

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
        gain: steepness of the occupancy 1 - exp(-gain * density), where density 1 is all points of a frame spread
            evenly over the picture: it makes a limb seen by few points as clear as one seen by many.
        yaws: how many world yaws, evenly round the circle, a test averages over (see :func:`yaws_of`).

    Example:
        >>> ReadOut(views=("camera",), yaws=1).size
        24
    """

    views: tuple[str, ...] = ("side", "top")
    size: int = 24
    extent: float = 2.8
    sigma: float = 0.7
    gain: float = 0.15
    yaws: int = 4

    def __post_init__(self) -> None:
        if not self.views or any(view not in _VIEWS for view in self.views):
            raise ReconError(f"ReadOut: views {self.views} must be one or more of {_VIEWS}")
        if min(self.size, self.extent, self.sigma, self.gain, self.yaws) <= 0:
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

    Each frame is centred at the geometric median of its observed points, the clip is divided by its rms size, the
    camera's rotations bring it to world axes, and each view is splatted. Global scale and a translation of each
    frame change nothing.

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
    shape, weight = _normalised(points3d, visible, params)
    rotations = camera_rotations.to(torch.float32)
    return _pictures(shape[..., frames, :, :], weight[..., frames, :], rotations[..., frames, :, :], params, yaw)


def _normalised(points3d: Tensor, visible: Tensor, params: ReadOut) -> tuple[Tensor, Tensor]:
    """Centred frames of clip rms size 1, zeros where unobserved, and the weight 0 or 1 of each entry; float32."""
    if params.views == ("camera",):  # depth must not leak in through centre and size either
        points3d = torch.cat([points3d[..., :2], torch.zeros_like(points3d[..., 2:])], -1)
    shape = torch.where(visible[..., None], points3d, torch.zeros_like(points3d)).to(torch.float32)
    if not torch.isfinite(shape).all():
        where = torch.nonzero(~torch.isfinite(shape).all(-1))[0].tolist()
        raise ReconError(f"read_out: points3d at index {where} is marked visible but not finite; unmark or fill it")
    weight = visible.to(torch.float32)
    total = weight.sum((-1, -2))
    if (total == 0).any():
        raise ReconError("read_out: nothing is visible in the clip; a shape needs observed points")
    # The mean first: it makes a translation of any size harmless to the float32 steps that follow.
    centre = _weighted_mean(shape, weight)
    shape = shape - centre
    size = ((shape.square().sum(-1) * weight).sum((-1, -2)) / total).sqrt()[..., None, None, None]
    shape = shape / size.clamp_min(torch.finfo(torch.float32).tiny)
    # Weiszfeld's steps to the geometric median: stray points, which some methods have and others not, move it
    # little, and unlike a median per axis it turns with the body.
    centre = torch.zeros_like(centre)
    for _ in range(5):
        distance = (shape - centre).square().sum(-1).add(1e-4).sqrt()
        centre = _weighted_mean(shape, weight / distance)
    return torch.where(visible[..., None], shape - centre, torch.zeros_like(shape)), weight


def _weighted_mean(shape: Tensor, weight: Tensor) -> Tensor:
    """(*batch, frames, 1, 3); zero in a frame without weight."""
    total = weight.sum(-1)[..., None, None].clamp_min(torch.finfo(torch.float32).tiny)
    return (shape * weight[..., None]).sum(-2, keepdim=True) / total


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


def _pictures(shape: Tensor, weight: Tensor, rotations: Tensor, params: ReadOut, yaw: float) -> Tensor:
    world = shape @ rotations  # rows: R^T x for each point
    cosine, sine = math.cos(yaw), math.sin(yaw)
    right = cosine * world[..., 0] + sine * world[..., 2]
    towards = cosine * world[..., 2] - sine * world[..., 0]
    planes = {"side": (right, -world[..., 1]), "top": (right, towards), "camera": (shape[..., 0], shape[..., 1])}
    xy = torch.stack([torch.stack(planes[view], -1) for view in params.views], -4)
    pixels = (xy / params.extent + 1) * (params.size / 2) - 0.5
    share = weight / weight.sum(-1, keepdim=True).clamp_min(1)
    share = share.unsqueeze(-3).expand(pixels.shape[:-1])
    density = splat(pixels, share, (params.size, params.size), params.sigma) * params.size**2
    return 1 - torch.exp(-params.gain * density)


class Recogniser(nn.Module):
    """A CNN on each frame's pictures, then convolutions over time, then the mean and the maximum over time.

    The same weights read any number of frames, and any picture size divisible by 8.

    Args:
        classes: names of the outputs, in order.
        params: the read-out it is trained with and must be used with.
        width: channels of the first layer.

    Example:
        >>> recogniser = Recogniser(("run", "jump"))
        >>> recogniser(torch.rand(4, 2, 32, 24, 24)).shape
        torch.Size([4, 2])
    """

    def __init__(self, classes: tuple[str, ...], params: ReadOut = ReadOut(), width: int = 16) -> None:
        super().__init__()
        if params.size % 8:
            raise ReconError(f"Recogniser: ReadOut.size {params.size} must be divisible by 8")
        self.classes = tuple(classes)
        self.params = params
        self.width = width
        channels = [len(params.views), width, 2 * width, 4 * width]
        self.per_frame = nn.Sequential(
            *[
                nn.Sequential(
                    nn.Conv2d(before, after, 3, stride=2, padding=1), nn.BatchNorm2d(after), nn.ReLU(inplace=True)
                )
                for before, after in itertools.pairwise(channels)
            ],
            nn.Flatten(),
            nn.Linear(channels[-1] * (params.size // 8) ** 2, channels[-1]),
            nn.ReLU(inplace=True),
        )
        self.over_time = nn.Sequential(
            *[
                nn.Sequential(
                    nn.Conv1d(channels[-1], channels[-1], 5, padding=2), nn.BatchNorm1d(channels[-1]), nn.ReLU()
                )
                for _ in range(2)
            ]
        )
        self.drop = nn.Dropout(0.2)
        self.to_classes = nn.Linear(2 * channels[-1], len(self.classes))

    def look(self, volume: Float[Tensor, "*batch views frames size size"]) -> Float[Tensor, "*batch channels frames"]:
        """What is seen in each frame by itself."""
        frames = volume.transpose(-4, -3)
        features: Tensor = self.per_frame(frames.reshape(-1, *frames.shape[-3:]))
        return features.reshape(*frames.shape[:-3], -1).transpose(-1, -2)

    def name(self, features: Float[Tensor, "*batch channels frames"]) -> Float[Tensor, "*batch classes"]:
        """Logits of the action that a run of frames shows."""
        features = self.over_time(features.reshape(-1, *features.shape[-2:])).reshape(features.shape)
        logits: Tensor = self.to_classes(self.drop(torch.cat([features.mean(-1), features.amax(-1)], -1)))
        return logits

    def forward(self, volume: Float[Tensor, "*batch views frames size size"]) -> Float[Tensor, "*batch classes"]:
        """Logits of the classes."""
        return self.name(self.look(volume))


class WindowScores(NamedTuple):
    """What a recogniser says of each window of a clip.

    Attributes:
        predicted: (windows,) index into ``Recogniser.classes``.
        probabilities: (windows, classes), averaged over yaws by their weights.
    """

    predicted: Int[Tensor, " windows"]
    probabilities: Float[Tensor, "windows classes"]


@torch.no_grad()
def classify_windows(
    recogniser: Recogniser,
    points3d: Float[Tensor, "frames points 3"],
    visible: Bool[Tensor, "frames points"],
    camera_rotations: Float[Tensor, "frames 3 3"],
    window: int = 32,
    stride: int = 4,
) -> WindowScores:
    """Name the action in every window of a clip, averaged over the world yaws of the read-out.

    A clip shorter than ``window`` is one window whose last picture is held.

    Args:
        points3d, visible, camera_rotations: as for :func:`read_out`.
        window, stride: frames.

    Example:
        >>> scores = classify_windows(
        ...     Recogniser(("run", "jump")).eval(),
        ...     torch.rand(40, 20, 3),
        ...     torch.ones(40, 20, dtype=torch.bool),
        ...     torch.eye(3).expand(40, 3, 3),
        ... )
        >>> scores.probabilities.shape
        torch.Size([3, 2])
    """
    shape, weight = _normalised(points3d, visible, recogniser.params)
    rotations = camera_rotations.to(torch.float32)
    dtype = next(recogniser.parameters()).dtype
    mean = torch.zeros((), dtype=dtype, device=shape.device)
    for yaw, share in zip(*yaws_of(camera_rotations, recogniser.params.yaws), strict=True):
        volume = hold_last(_pictures(shape, weight, rotations, recogniser.params, float(yaw)), window)
        windows = recogniser.look(volume.to(dtype)).unfold(-1, window, stride).transpose(0, 1)
        mean = mean + share.to(dtype) * recogniser.name(windows).softmax(-1)
    return WindowScores(mean.argmax(-1), mean)


def weights_hash(recogniser: Recogniser) -> str:
    """SHA-256 over the read-out, the classes and every weight: two recognisers with one hash give one answer.

    Example:
        >>> len(weights_hash(Recogniser(("run", "jump"))))
        64
    """
    digest = hashlib.sha256(json.dumps(_settings(recogniser), sort_keys=True).encode())
    for name, value in sorted(recogniser.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.detach().to("cpu", torch.float32).contiguous().numpy().tobytes())
    return digest.hexdigest()


def save_recogniser(recogniser: Recogniser, path: str | os.PathLike[str], report: dict[str, Any] | None = None) -> Path:
    """Write weights and settings to ``path`` (.safetensors) and, beside it, what is known of them as JSON.

    Both files appear whole or not at all; the JSON (``path`` with suffix .json: settings, hash, ``report``) is for
    readers, :func:`load_recogniser` needs the weights file alone.

    Raises:
        ReconError: the folder does not exist or the suffix is not ``.safetensors``.
    """
    target = Path(path)
    if target.suffix != ".safetensors" or not target.parent.is_dir():
        raise ReconError(f"{target}: needs an existing folder and a name that ends in .safetensors")
    weights = {name: value.detach().cpu().contiguous() for name, value in recogniser.state_dict().items()}
    metadata = {"recogniser": json.dumps(_settings(recogniser))}
    known = {**_settings(recogniser), "weights_hash": weights_hash(recogniser), **(report or {})}
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as folder:
        save_file(weights, Path(folder, "weights"), metadata)
        Path(folder, "report").write_text(json.dumps(known, indent=2) + "\n")
        os.replace(Path(folder, "report"), target.with_suffix(".json"))
        os.replace(Path(folder, "weights"), target)
    return target


def load_recogniser(path: str | os.PathLike[str]) -> Recogniser:
    """The recogniser that :func:`save_recogniser` wrote, in evaluation mode.

    Raises:
        ReconError: the file does not exist or is no recogniser.
    """
    source = Path(path)
    if not source.is_file():
        raise ReconError(f"{source}: no such file; `python -m train.recogniser` makes one")
    try:
        with safe_open(source, framework="pt") as archive:
            settings = json.loads((archive.metadata() or {})["recogniser"])
            weights = {name: archive.get_tensor(name) for name in archive.keys()}  # noqa: SIM118
        views = tuple(settings["read_out"].pop("views"))
        params = ReadOut(views=views, **settings["read_out"])
        recogniser = Recogniser(tuple(settings["classes"]), params, settings["width"])
        recogniser.load_state_dict(weights)
    except (SafetensorError, KeyError, TypeError, RuntimeError) as error:
        raise ReconError(f"{source}: is no recogniser of this version ({error}); train it again") from error
    return recogniser.eval()


def _settings(recogniser: Recogniser) -> dict[str, Any]:
    return {
        "classes": list(recogniser.classes),
        "read_out": asdict(recogniser.params),
        "width": recogniser.width,
    }
