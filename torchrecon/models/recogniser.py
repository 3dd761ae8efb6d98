"""Which action is it: a small CNN that sees a moving shape as pictures from the side and from above.

The recogniser is the ruler of Table 1, not a part of the road: it is trained on true 3D, and a method is as good as
the actions that can be told from its shapes. One function, :func:`read_out`, turns the points of any method and the
true ones into what the network sees. It never sees the camera's own view, which every method gets right for free.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from torchrecon._typing import Bool, Float, Int, Tensor
from torchrecon.errors import ReconError
from torchrecon.models.views import ReadOut, held, hold_last, pictures, read_out, settle, yaws_of

__all__ = [
    "AROUND",
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

AROUND = 4
"""Frames around those in which a point was seen, 0.16 s at 25 frames per second, in which Table 1 shows it too: every
method says where it is, and a fast limb that the tracker lost for a moment is no sign of an action. Chosen on films of
training seeds that the tracker had followed, by what is made of true 3D alone: 22 % of the windows of standing
cameras' jumps are misread without it, 1 % with it (2 frames: 6 %)."""

_READ_OUT = ReadOut()


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

    def __init__(self, classes: tuple[str, ...], params: ReadOut = _READ_OUT, width: int = 16) -> None:
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
    around: int = 0,
) -> WindowScores:
    """Name the action in every window of a clip, averaged over the world yaws of the read-out.

    A clip shorter than ``window`` is one window whose last picture is held.

    Args:
        points3d, visible, camera_rotations: as for :func:`read_out`.
        window, stride: frames.
        around: frames before and after it was seen in which a point is shown too, where ``points3d`` is finite.

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
    if around:
        visible = held(visible, around) & torch.isfinite(points3d).all(-1)
    settled = settle(points3d, visible, camera_rotations, recogniser.params)
    dtype = next(recogniser.parameters()).dtype
    mean = torch.zeros((), dtype=dtype, device=settled.world.device)
    for yaw, share in zip(*yaws_of(camera_rotations, recogniser.params.yaws), strict=True):
        volume = hold_last(pictures(settled, recogniser.params, float(yaw)), window)
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
