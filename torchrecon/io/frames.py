"""Frames, masks and depth maps from video files and folders of numbered images, and camera files.

Frames are streamed: a source holds one decoded frame at a time and can be iterated again from the start.
"""

from __future__ import annotations

import json
import math
import os
import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError

__all__ = [
    "CameraFile",
    "FrameSource",
    "ImageFolder",
    "Recording",
    "Stills",
    "encode_stills",
    "find_recording",
    "load_camera",
    "open_depths",
    "open_frames",
    "open_masks",
]

_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
_DEFAULT_FPS = 25.0
_STILLS = 600  # pictures of a film at most; longer ones are thinned
# (longest side in pixels, JPEG quality), best first
_RUNGS = ((720, 70), (640, 65), (640, 50), (560, 45), (480, 45), (400, 40), (320, 40), (320, 25), (240, 20), (160, 15))
Image = NDArray[np.generic]
Item = TypeVar("Item", covariant=True)


@runtime_checkable
class FrameSource(Protocol):
    """A sequence of frames of one size that is read front to back, as often as asked.

    Attributes:
        path: where the frames come from.
        fps: frames per second.
        size: (height, width) in pixels.
    """

    path: Path
    fps: float
    size: tuple[int, int]

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Float[Tensor, "3 height width"]]: ...


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Sort key under which frame2 comes before frame10."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts if part]


def _list_images(folder: Path) -> list[Path]:
    files = [f for f in folder.iterdir() if f.suffix.lower() in _IMAGES and not f.name.startswith(".") and f.is_file()]
    if not files:
        raise ReconError(f"{folder}: holds no image ({', '.join(_IMAGES)}); one image per frame is needed")
    return sorted(files, key=_natural)


def _read_image(path: Path) -> Image:
    """One image as it is stored: (height, width) or (height, width, channels), BGR, 8 or 16 bit."""
    import cv2

    data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    image: Image | None = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None:
        raise ReconError(f"{path}: is not a readable image (empty, cut short or of an unknown format)")
    return image


def _to_rgb(image: Image, path: Path) -> Float[Tensor, "3 height width"]:
    full = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0}.get(image.dtype)
    if full is None:
        raise ReconError(f"{path}: holds {image.dtype} values; images of 8 or 16 bit per channel are read")
    if image.ndim == 2:
        image = image[..., None]
    if image.shape[2] in (1, 2):
        image = np.repeat(image[..., :1], 3, axis=2)
    rgb = torch.from_numpy(np.ascontiguousarray(image[..., 2::-1]).astype(np.float32))
    return (rgb / full).permute(2, 0, 1).contiguous()


def _to_mask(image: Image, path: Path) -> Bool[Tensor, "height width"]:
    colour = image if image.ndim == 2 else image[..., :3].max(axis=2)
    return torch.from_numpy(np.ascontiguousarray(colour != 0))


def _to_depth(image: Image, path: Path) -> Float[Tensor, "height width"]:
    if image.ndim != 2 or image.dtype != np.uint16:
        raise ReconError(f"{path}: depth is read from one channel of 16-bit millimetres, found {image.dtype}")
    metres = torch.from_numpy(image.astype(np.float32)) / 1000.0
    return torch.where(metres > 0, metres, torch.nan)


class ImageFolder(Generic[Item]):
    """One image per frame, in the order of the numbers in their names.

    Args:
        folder: holds the images; other files in it are passed over.
        convert: from the stored array and its path to what is yielded.
        fps: frames per second; a folder does not know it, so 25 is taken unless it is given.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        convert: Callable[[Image, Path], Item],
        fps: float | None = None,
    ) -> None:
        self.path = Path(folder)
        if not self.path.is_dir():
            raise ReconError(f"{self.path}: no such folder")
        self.files = _list_images(self.path)
        self.fps = _check_fps(fps, self.path) if fps is not None else _DEFAULT_FPS
        self._convert = convert
        height, width = _read_image(self.files[0]).shape[:2]
        self.size: tuple[int, int] = (int(height), int(width))

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[Item]:
        for index in range(len(self)):
            yield self[index]

    def __getitem__(self, index: int) -> Item:
        path = self.files[index]
        image = _read_image(path)
        if image.shape[:2] != self.size:
            raise ReconError(
                f"{path}: is {image.shape[0]} x {image.shape[1]} pixels, the first image of the folder "
                f"{self.size[0]} x {self.size[1]}; all frames must have one size"
            )
        return self._convert(image, path)


class _VideoFile:
    """A video file read by OpenCV; the frames are counted by decoding, not by the container's word."""

    def __init__(self, path: Path, fps: float | None = None) -> None:
        self.path = path
        capture = self._open()
        try:
            declared = int(capture.get(7))  # CAP_PROP_FRAME_COUNT: may be wrong or negative
            stated = float(capture.get(5))  # CAP_PROP_FPS
            good, first = capture.read()
            if not good or first is None:
                raise ReconError(f"{path}: holds no readable frame; it may be cut short or of an unknown codec")
            self.size = (int(first.shape[0]), int(first.shape[1]))
            count = 1
            while capture.grab():
                count += 1
        finally:
            capture.release()
        if count < declared:
            warnings.warn(f"{path}: {count} of {declared} frames can be read; the rest is left out", stacklevel=3)
        self._count = count
        if fps is None and not (math.isfinite(stated) and 0.0 < stated <= 1000.0):
            raise ReconError(f"{path}: states {stated} frames per second; give the frame rate (fps)")
        self.fps = stated if fps is None else _check_fps(fps, path)

    def _open(self) -> Any:
        import cv2

        capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            capture.release()
            raise ReconError(f"{self.path}: cannot be opened as a video; it may be cut short or of an unknown codec")
        return capture

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Float[Tensor, "3 height width"]]:
        capture = self._open()
        try:
            for index in range(self._count):
                good, image = capture.read()
                if not good or image is None:
                    raise ReconError(f"{self.path}: frame {index} could be counted but not decoded; convert the file")
                yield _to_rgb(image, self.path)
        finally:
            capture.release()


def _check_fps(fps: float, path: Path) -> float:
    if not (math.isfinite(fps) and fps > 0):
        raise ReconError(f"{path}: fps is {fps}; a positive number is needed")
    return float(fps)


def open_frames(path: str | os.PathLike[str], fps: float | None = None) -> FrameSource:
    """Open a video file, or a folder of numbered images, as a source of RGB frames.

    Args:
        path: a video file that OpenCV can decode, or a folder (8 or 16 bit, grey or colour, alpha ignored), or one
            that holds such a folder as ``frames/``.
        fps: frames per second; default: what the file states, and 25 for a folder.

    Returns:
        A source with ``len``, ``fps``, ``size`` = (height, width), that yields (3, height, width) float32 RGB
        in [0, 1] and can be iterated more than once. A video that ends before its stated length gives the
        frames it has and a warning.

    Raises:
        ReconError: no such file, no frame, unreadable, images of different sizes.

    Example:
        >>> try:
        ...     open_frames("no/such/clip.mp4")
        ... except ReconError as error:
        ...     print(error)
        no/such/clip.mp4: no such file or folder
    """
    source = Path(path)
    if source.is_dir():
        return ImageFolder(source / "frames" if (source / "frames").is_dir() else source, _to_rgb, fps)
    if not source.is_file():
        raise ReconError(f"{source}: no such file or folder")
    if source.stat().st_size == 0:
        raise ReconError(f"{source}: is empty")
    return _VideoFile(source, fps)


@dataclass(frozen=True)
class Recording:
    """What lies beside the frames of a clip; None where there is none."""

    masks: Path | None
    depth: Path | None
    camera: Path | None


def find_recording(path: str | os.PathLike[str]) -> Recording:
    """The ``masks/``, ``depth/`` and ``camera.json`` (or ``cameras.json``) of a folder that holds ``frames/``.

    Example:
        >>> find_recording("clip.mp4")
        Recording(masks=None, depth=None, camera=None)
    """
    folder = Path(path)
    if not (folder / "frames").is_dir():
        return Recording(None, None, None)
    masks, depth = (folder / name if (folder / name).is_dir() else None for name in ("masks", "depth"))
    cameras = [folder / name for name in ("camera.json", "cameras.json") if (folder / name).is_file()]
    return Recording(masks, depth, cameras[0] if cameras else None)


def open_masks(folder: str | os.PathLike[str]) -> ImageFolder[Bool[Tensor, "height width"]]:
    """Person masks, one image per frame, matched to the frames by order; non-zero = person."""
    return ImageFolder(folder, _to_mask)


def open_depths(folder: str | os.PathLike[str]) -> ImageFolder[Float[Tensor, "height width"]]:
    """Depth maps, one 16-bit image of millimetres per frame, as float32 metres; 0 (none) becomes NaN."""
    return ImageFolder(folder, _to_depth)


@dataclass(frozen=True, eq=False)
class CameraFile:
    """What a camera file says.

    Attributes:
        intrinsics: (3, 3) pinhole matrix, pixels.
        rotations: (frames, 3, 3) camera -> world, or None; ``X_world = R X_camera + t``.
        translations: (frames, 3) metres, or None.
    """

    intrinsics: Float[Tensor, "3 3"]
    rotations: Float[Tensor, "frames 3 3"] | None = None
    translations: Float[Tensor, "frames 3"] | None = None


def _matrix(value: Any, shape: tuple[int, ...], where: str) -> Tensor:
    try:
        array = torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ReconError(f"{where}: is not a table of numbers") from error
    if array.numel() != math.prod(shape) or not torch.isfinite(array).all():
        raise ReconError(f"{where}: finite numbers of shape {shape} are needed, found shape {tuple(array.shape)}")
    return array.reshape(shape)


def _intrinsics(value: Any, where: str) -> Tensor:
    k = _matrix(value, (3, 3), where)
    if not (k[0, 0] > 0 and k[1, 1] > 0 and k[2].tolist() == [0.0, 0.0, 1.0]):
        raise ReconError(f"{where}: is not a pinhole matrix [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0")
    return k


def load_camera(path: str | os.PathLike[str]) -> CameraFile:
    """Read ``{"K": 3x3}`` or ``{"cameras": [{"intrinsic": 3x3, "R": 3x3, "t": 3}, ...]}`` (one entry per frame).

    Raises:
        ReconError: no such file, no JSON, keys missing, intrinsics that change over the frames.
    """
    source = Path(path)
    if not source.is_file():
        raise ReconError(f"{source}: no such file")
    try:
        content = json.loads(source.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ReconError(f"{source}: is not JSON ({error})") from error
    if isinstance(content, dict) and "K" in content:
        return CameraFile(_intrinsics(content["K"], f"{source}: K"))
    cameras = content.get("cameras") if isinstance(content, dict) else content
    if not isinstance(cameras, list) or not cameras:
        raise ReconError(f'{source}: has neither "K" (3x3) nor a list "cameras"')
    for index, camera in enumerate(cameras):
        if not isinstance(camera, dict) or "intrinsic" not in camera:
            raise ReconError(f'{source}: camera {index} has no "intrinsic" (3x3)')
    each = torch.stack([_intrinsics(c["intrinsic"], f"{source}: camera {i}") for i, c in enumerate(cameras)])
    if not torch.allclose(each, each[:1], rtol=1e-6, atol=1e-6):
        raise ReconError(f"{source}: the intrinsics change over the cameras; one matrix for the clip is needed")
    if not all("R" in camera and "t" in camera for camera in cameras):
        return CameraFile(each[0])
    rotations = [_matrix(c["R"], (3, 3), f"{source}: camera {i} R") for i, c in enumerate(cameras)]
    translations = [_matrix(c["t"], (3,), f"{source}: camera {i} t") for i, c in enumerate(cameras)]
    return CameraFile(each[0], torch.stack(rotations), torch.stack(translations))


@dataclass(frozen=True)
class Stills:
    """A film as small JPEG images; image ``i`` shows frames ``i * every`` up to the next one.

    Attributes:
        images: one JPEG file each.
        every: frames per image.
        size: (height, width) of the film itself in pixels.
    """

    images: tuple[bytes, ...]
    every: int
    size: tuple[int, int]


def encode_stills(frames: FrameSource, budget: int) -> Stills:
    """Re-encode a film so that its images take at most ``budget`` bytes together.

    Size and quality are the best of a ladder that fits; where the lowest does not, every other image is left out.

    Raises:
        ReconError: not even one image fits.

    Example:
        >>> import cv2, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for name in "abc":
        ...         _ = cv2.imwrite(f"{folder}/{name}.png", np.full((24, 32, 3), 90, np.uint8))
        ...     stills = encode_stills(open_frames(folder), 10_000)
        >>> len(stills.images), stills.every, stills.size
        (3, 1, (24, 32))
    """
    every = math.ceil(len(frames) / _STILLS)
    # The film is decoded once; what is kept of it is small however long it is.
    kept = [_to_jpeg(_to_bytes(f), *_RUNGS[0]) for i, f in enumerate(frames) if i % every == 0]
    while True:
        sample = kept[:: max(1, len(kept) // 8)]
        for rung in _RUNGS:
            if sum(len(_again(image, *rung)) for image in sample) * len(kept) > 1.1 * budget * len(sample):
                continue
            images = kept if rung == _RUNGS[0] else [_again(image, *rung) for image in kept]
            if sum(map(len, images)) <= budget:
                return Stills(tuple(images), every, frames.size)
        if len(kept) == 1:
            raise ReconError(f"{frames.path}: not even one small image fits into {budget} bytes; allow a larger page")
        kept, every = kept[::2], 2 * every


def _to_bytes(frame: Float[Tensor, "3 height width"]) -> Image:
    """BGR, 8 bit, as OpenCV writes it."""
    return (frame.flip(0).permute(1, 2, 0) * 255).round().to(torch.uint8).contiguous().numpy()


def _to_jpeg(image: Image, longest: int, quality: int) -> bytes:
    import cv2

    shrink = longest / max(image.shape[:2])
    if shrink < 1:
        size = (max(1, round(image.shape[1] * shrink)), max(1, round(image.shape[0] * shrink)))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    good, data = cv2.imencode(".jpg", image, options)
    if not good:
        raise ReconError(f"an image of shape {image.shape} cannot be encoded as JPEG")
    return bytes(data)


def _again(jpeg: bytes, longest: int, quality: int) -> bytes:
    import cv2

    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    return _to_jpeg(np.asarray(image), longest, quality)
