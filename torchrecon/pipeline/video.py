"""From a video to tracks, and from a video to a folder with tracks, reconstruction and report."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, TypeVar

import torch

import torchrecon
from torchrecon._typing import Bool, Float, Tensor
from torchrecon.config import Config, to_mapping
from torchrecon.contour import background_paths, find_mover, own_motion
from torchrecon.errors import ReconError
from torchrecon.features import track_points
from torchrecon.io.files import remove_leftovers, write_json
from torchrecon.io.frames import FrameSource, find_recording, load_camera, open_depths, open_frames, open_masks
from torchrecon.measurement import RankEstimate, Reconstruction, Solver, Tracks
from torchrecon.pipeline.depth import body_depth, with_depth
from torchrecon.pipeline.reconstructor import reconstruct
from torchrecon.pipeline.report import write_report
from torchrecon.rank import estimate_rank
from torchrecon.viz.views import draw_views

__all__ = ["reconstruct_video", "track_video"]

Item = TypeVar("Item")
RUN_FILE = "run.json"
RESULTS = ("tracks.npz", "reconstruction.npz", "report.json", "views.png", "report.html")


def track_video(
    video: str | os.PathLike[str],
    masks: str | os.PathLike[str] | None = None,
    depth: str | os.PathLike[str] | None = None,
    camera: str | os.PathLike[str] | None = None,
    config: Config = Config(),
    progress: bool = False,
) -> Tracks:
    """Track points of the moving body in a clip.

    Args:
        video: video file or folder of numbered images; a folder that holds these as ``frames/`` brings its ``masks/``,
            ``depth/`` and ``camera.json`` (or ``cameras.json``), unless they are given.
        masks: folder with one image per frame, non-zero = person; None: the mover is found in the clip itself.
        depth: folder with one 16-bit image per frame in millimetres, registered to the frames; needs ``camera``.
        camera: JSON file with the intrinsics.
        config: parameters of all stages.
        progress: show a progress bar on stderr.

    Returns:
        Tracks with visibility and covariance; with intrinsics where ``camera`` is given, with depth where ``depth`` is.

    Raises:
        ReconError: unreadable input, counts or sizes that do not fit, or too few tracks.
    """
    beside = find_recording(video)
    masks, depth, camera = masks or beside.masks, depth or beside.depth, camera or beside.camera
    frames = open_frames(video)
    if depth is not None and camera is None:
        raise ReconError("--depth: needs --camera FILE with the intrinsics of the sensor")
    intrinsics = None if camera is None else load_camera(camera).intrinsics.to(torch.get_default_dtype())
    shown: Iterable[Tensor] = _bar(frames, len(frames), f"tracking {Path(video).name}", progress)
    body: Iterable[Tensor] = find_mover(frames, config.mover) if masks is None else _checked(open_masks(masks), frames)
    filtered: list[Tensor] | None = None
    if depth is not None and intrinsics is not None:
        sensor, filtered = _checked(open_depths(depth), frames), []
        body = _bodies(sensor, None if masks is None else body, intrinsics, config, filtered)
        tracks = track_points(shown, body, config.tracker, frames.fps, depths=_follow(filtered))
        tracks = with_depth(tracks, filtered, intrinsics, config.depth.sample)
    else:
        tracks = track_points(shown, body, config.tracker, frames.fps)
        if masks is None:
            # The mask that was found is loose: what it let in of the background does not move by itself.
            moves = own_motion(tracks.xy, tracks.visible, background_paths(frames)) >= config.least_own_motion
            long = tracks.visible.sum(-2) >= config.min_track_frames
            _check_enough(int((moves & long).sum()), config)
            tracks = tracks.select(points=moves.nonzero()[:, 0])
        tracks = replace(tracks, intrinsics=intrinsics)
    _check_enough(int((tracks.visible.sum(-2) >= config.min_track_frames).sum()), config)
    return tracks


def reconstruct_video(
    video: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    masks: str | os.PathLike[str] | None = None,
    depth: str | os.PathLike[str] | None = None,
    camera: str | os.PathLike[str] | None = None,
    config: Config = Config(),
    rank: int | Literal["auto"] = "auto",
    solver: str | Solver = "auto",
    device: str = "cpu",
    seed: int = 0,
    force: bool = False,
    progress: bool = False,
) -> Reconstruction:
    """Everything from a clip to 3D, written to a folder.

    The folder holds ``run.json`` (what was run), ``tracks.npz``, ``reconstruction.npz``, ``views.png`` (front, side
    and top view at three frames; only where matplotlib is installed), ``report.json`` and ``report.html`` (all of it
    to look at, in one file). Tracks of the same run are taken from the folder again, so a run that was interrupted
    after tracking goes on from there.

    Raises:
        ReconError: as :func:`track_video`; a folder that holds another run's results, without ``force``.
    """
    folder, beside = Path(out), find_recording(video)
    masks, depth, camera = masks or beside.masks, depth or beside.depth, camera or beside.camera
    run: dict[str, object] = {
        "video": str(Path(video).resolve()),
        "masks": None if masks is None else str(Path(masks).resolve()),
        "depth": None if depth is None else str(Path(depth).resolve()),
        "camera": None if camera is None else str(Path(camera).resolve()),
        "config": to_mapping(config),
        "rank": rank,
        "solver": solver if isinstance(solver, str) else repr(solver),
        "seed": seed,
        "version": torchrecon.__version__,
    }
    resumes = _claim(folder, run, force)
    tracks_file = folder / "tracks.npz"
    if resumes and tracks_file.is_file():
        tracks = Tracks.load(tracks_file)
    else:
        tracks = track_video(video, masks, depth, camera, config, progress)
        tracks.save(tracks_file)
    answer, estimate = _solve(tracks.to(device), rank, solver, seed)
    answer.save(folder / "reconstruction.npz")
    write_json(
        folder / "report.json",
        {
            "status": [str(status) for status in answer.statuses],
            "rank": answer.rank,
            "deformation_degree": answer.deformation_degree,
            "frames": tracks.frames,
            "tracks": tracks.points,
            "tracks_per_frame": tracks.visible.sum(-1),
            "median_track_length": tracks.visible.sum(-2).double().median(),
        },
    )
    if find_spec("matplotlib") is not None:  # an extra; the page shows the same and more
        draw_views(answer, folder / "views.png")
    write_report(
        answer,
        folder / "report.html",
        tracks=tracks,
        video=video,
        rank=estimate,
        command=_command(video, out, masks, depth, camera, rank, run["solver"], seed),
        settings=to_mapping(config),
    )
    return answer


def _solve(
    tracks: Tracks, rank: int | Literal["auto"], solver: str | Solver, seed: int
) -> tuple[Reconstruction, RankEstimate]:
    """What ``reconstruct`` gives, and the evidence for K, estimated once; for a given K it is kept beside it."""
    generator = torch.Generator().manual_seed(seed)
    estimate = estimate_rank(tracks, generator=generator)
    if rank == "auto":
        answer = reconstruct(tracks, int(estimate.rank), solver, generator=generator)
        return replace(answer, deformation_degree=estimate.deformation_degree).to("cpu"), estimate
    return reconstruct(tracks, rank, solver, generator=torch.Generator().manual_seed(seed)).to("cpu"), estimate


def _command(
    video: object, out: object, masks: object, depth: object, camera: object, rank: object, solver: object, seed: int
) -> str:
    """The command line that does the same."""
    options = {"--masks": masks, "--depth": depth, "--camera": camera}
    options |= {"--rank": rank, "--solver": solver, "--seed": seed}
    usual = {"--rank": "auto", "--solver": "auto", "--seed": 0}
    words = ["torchrecon", "reconstruct", str(video), "-o", str(out)]
    for name, value in options.items():
        if value is not None and value != usual.get(name):
            words += [name, str(value)]
    return shlex.join(words)


def _claim(folder: Path, run: Mapping[str, object], force: bool) -> bool:
    """Make the folder this run's; True where it already is."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ReconError(f"{folder}: cannot be made a folder ({error.strerror})") from error
    remove_leftovers(folder, [*RESULTS, RUN_FILE])
    record = folder / RUN_FILE
    if record.is_file():
        try:
            earlier = json.loads(record.read_text(encoding="utf-8"))
        except ValueError:
            earlier = None
        if earlier == json.loads(json.dumps(run)):
            return True
        # A run that ended before its first result leaves nothing to protect.
        if not force and any((folder / name).exists() for name in RESULTS):
            raise ReconError(f"{folder}: holds another run's results; choose another folder or give --force")
    elif any(folder.iterdir()) and not force:
        raise ReconError(
            f"{folder}: is not empty and holds no run of torchrecon; choose another folder or give --force"
        )
    for name in RESULTS:
        (folder / name).unlink(missing_ok=True)
    write_json(record, run)
    return False


def _checked(items: Iterable[Item], frames: FrameSource) -> Iterable[Item]:
    count = len(items)  # type: ignore[arg-type]
    if count != len(frames):
        raise ReconError(
            f"{getattr(items, 'folder', items)}: {count} images for the {len(frames)} frames of {frames.path}; "
            "one per frame is needed"
        )
    return items


def _bodies(
    depths: Iterable[Float[Tensor, "height width"]],
    masks: Iterable[Bool[Tensor, "height width"]] | None,
    intrinsics: Float[Tensor, "3 3"],
    config: Config,
    filtered: list[Tensor],
) -> Iterator[Bool[Tensor, "height width"]]:
    """Body pixels frame by frame; the filtered depth images are kept in ``filtered`` on the way."""
    pairs = ((d, None) for d in depths) if masks is None else zip(depths, masks, strict=True)
    for image, mask in pairs:
        found = body_depth(image, mask, intrinsics, config.depth)
        filtered.append(found.depth)
        yield found.body


def _follow(items: list[Tensor]) -> Iterator[Tensor]:
    """The items of a list that another iterator fills one step ahead."""
    index = 0
    while index < len(items):
        yield items[index]
        index += 1


def _check_enough(found: int, config: Config) -> None:
    if found < config.min_tracks:
        raise ReconError(
            f"{found} tracks of {config.min_track_frames} frames or more were found on the mover, {config.min_tracks} "
            "are needed; the clip shows too little texture on it, it moves too fast, or it was not found (give --masks)"
        )


def _bar(items: Iterable[Item], total: int, title: str, show: bool) -> Iterable[Item]:
    if not show:
        return items
    from tqdm import tqdm

    return tqdm(items, total=total, desc=title, unit="frame")
