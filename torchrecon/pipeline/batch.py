"""Every clip and tracks file of a folder, each to a result folder of its own."""

from __future__ import annotations

import json
import time
import traceback
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch

import torchrecon
from torchrecon.config import Config, to_mapping
from torchrecon.errors import ReconError
from torchrecon.io.files import plain, remove_leftovers, write_bytes, write_json
from torchrecon.io.frames import find_recording, load_camera
from torchrecon.io.tracks import load_tracks
from torchrecon.measurement import Reconstruction
from torchrecon.pipeline.reconstructor import reconstruct
from torchrecon.pipeline.video import RESULTS, RUN_FILE, reconstruct_video
from torchrecon.pipeline.workers import Died, work_through

__all__ = ["MANIFEST", "BatchItem", "BatchSettings", "find_items", "read_records", "run_batch", "run_item"]

MANIFEST = "manifest.json"
ITEM_FILE = "item.json"
ERROR_FILE = "error.txt"
_VIDEOS = {".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv"}
_IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"}
_TRACKS = {".npz", ".json", ".csv", ".c3d", ".trc", ".bvh", ".h5"}


@dataclass(frozen=True)
class BatchItem:
    """One thing to reconstruct.

    Attributes:
        name: of its folder under the output folder.
        source: video file, folder of images, folder that holds ``frames/`` and, where there are any, ``masks/``,
            ``depth/`` and ``camera.json`` or ``cameras.json``, tracks file, or folder of keypoint files.
        kind: ``video``, ``tracks``, or ``skipped``.
        reason: why it is skipped.
    """

    name: str
    source: Path
    kind: Literal["video", "tracks", "skipped"]
    reason: str = ""


@dataclass(frozen=True)
class BatchSettings:
    """What is the same for all items: see :func:`torchrecon.pipeline.video.reconstruct_video`."""

    rank: int | Literal["auto"] = "auto"
    solver: str = "auto"
    camera: Path | None = None
    config: Config = field(default_factory=Config)
    device: str = "cpu"
    seed: int = 0

    def record(self) -> dict[str, Any]:
        """The settings that decide the results, as JSON holds them."""
        return {
            "rank": self.rank,
            "solver": self.solver,
            "camera": None if self.camera is None else str(self.camera.resolve()),
            "config": to_mapping(self.config),
            "seed": self.seed,
            "version": torchrecon.__version__,
        }


def find_items(folder: Path, out: Path) -> list[BatchItem]:
    """What lies in a folder, by name; hidden entries and the output folder itself are passed over.

    Raises:
        ReconError: no such folder, or nothing in it that can be reconstructed.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as name:
        ...     _ = [(Path(name) / file).touch() for file in ("a.mp4", "a.npz", "notes.txt")]
        ...     [(item.name, item.kind) for item in find_items(Path(name), Path(name) / "out")]
        [('a.mp4', 'video'), ('a.npz', 'tracks'), ('notes', 'skipped')]
    """
    if not folder.is_dir():
        raise ReconError(f"{folder}: no such folder")
    entries = [e for e in folder.iterdir() if not e.name.startswith(".") and e.resolve() != out.resolve()]
    stems = Counter(entry.stem if entry.is_file() else entry.name for entry in entries)
    items = []
    for entry in sorted(entries):
        stem = entry.stem if entry.is_file() else entry.name
        kind, reason = _kind(entry)
        items.append(BatchItem(stem if stems[stem] == 1 else entry.name, entry, kind, reason))
    if all(item.kind == "skipped" for item in items):
        raise ReconError(f"{folder}: holds no video, no folder of images and no tracks file")
    return items


def _kind(entry: Path) -> tuple[Literal["video", "tracks", "skipped"], str]:
    if entry.is_file():
        suffix = entry.suffix.lower()
        if suffix in _VIDEOS:
            return "video", ""
        return (
            ("tracks", "") if suffix in _TRACKS else ("skipped", "is neither a video nor a tracks file by its suffix")
        )
    if (entry / RUN_FILE).exists() or (entry / MANIFEST).exists():
        return "skipped", "holds results of torchrecon"
    if (entry / "frames").is_dir():
        return "video", ""
    suffixes = {file.suffix.lower() for file in entry.iterdir() if file.is_file()}
    if suffixes & _IMAGES:
        return "video", ""
    return ("tracks", "") if suffixes & _TRACKS else ("skipped", "holds neither images nor keypoint files")


def run_batch(
    folder: Path,
    out: Path,
    settings: BatchSettings = BatchSettings(),
    *,
    workers: int = 1,
    threads: int = 1,
    force: bool = False,
    progress: bool = False,
) -> dict[str, Any]:
    """Reconstruct every item of a folder.

    ``out/NAME/`` holds what :func:`~torchrecon.pipeline.video.reconstruct_video` writes for a video, and
    ``tracks.npz``, ``reconstruction.npz`` and ``report.json`` for tracks, with ``item.json`` written last;
    ``out/manifest.json`` lists all items with status and reason and is renewed after each. Items that are done, from
    the same input with the same settings, are not done again.

    Args:
        folder: see :func:`find_items`.
        out: made if it is not there.
        settings: the same for all items.
        workers: processes; 0 works in this one.
        threads: threads of each; the same number gives the same results for any number of workers.
        force: go on in a folder that holds something else, or the results of other settings.
        progress: show items done and the time left on stderr.

    Returns:
        What the manifest holds.

    Raises:
        ReconError: nothing to do, or an output folder that holds something else.
    """
    items = find_items(folder, out)
    claim_folder(out, settings, force)
    todo = pending(items, out, settings)
    records = write_manifest(folder, items, out, settings)
    done = work_through(partial(run_item, out=out, settings=settings), todo, min(workers, len(todo)), threads)
    for item, result in _bar(done, len(todo), progress):
        if isinstance(result, Died):
            cause = f"signal {-result.code}" if result.code and result.code < 0 else f"exit code {result.code}"
            reason = f"its process ended ({cause}) while it worked on this; it may have run out of memory"
            _finish(item, out, settings, "failed", reason)
        records = write_manifest(folder, items, out, settings)
    return records


def claim_folder(out: Path, settings: BatchSettings, force: bool) -> None:
    """Make ``out``, or make sure that it holds this batch.

    Raises:
        ReconError: it holds something else and ``force`` is not given.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ReconError(f"{out}: cannot be made a folder ({error.strerror})") from error
    remove_leftovers(out, [MANIFEST])
    if force or not any(out.iterdir()):
        return
    earlier = _read(out / MANIFEST)
    if earlier is None:
        raise ReconError(f"{out}: is not empty and holds no batch of torchrecon; choose another folder or give --force")
    if earlier.get("settings") != plain(settings.record()):
        raise ReconError(f"{out}: holds a batch with other settings; choose another folder or give --force")


def pending(items: Sequence[BatchItem], out: Path, settings: BatchSettings) -> list[BatchItem]:
    """The items that are not done yet from the same input with the same settings."""

    def done(item: BatchItem) -> bool:
        record = _read(out / item.name / ITEM_FILE) or {}
        same = record.get("settings") == plain(settings.record()) and record.get("input") == _fingerprint(item.source)
        return record.get("status") == "done" and same and (out / item.name / "reconstruction.npz").is_file()

    return [item for item in items if item.kind != "skipped" and not done(item)]


def run_item(item: BatchItem, out: Path, settings: BatchSettings) -> dict[str, Any]:
    """Reconstruct one item into its folder; what goes wrong is recorded there and not raised.

    Returns:
        The record that ``item.json`` holds: name, source, kind, status (``done`` or ``failed``), reason, seconds,
        settings and the fingerprint of the input.
    """
    folder = out / item.name
    start = time.monotonic()
    fingerprint: list[int] | None = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        fingerprint = _fingerprint(item.source)  # before the work: a file that changes meanwhile is done again
        earlier = _read(folder / ITEM_FILE)
        if earlier is not None and earlier.get("input") != fingerprint:
            for name in (*RESULTS, RUN_FILE):  # results of another input are nothing to go on from
                (folder / name).unlink(missing_ok=True)
        (folder / ITEM_FILE).unlink(missing_ok=True)
        (folder / ERROR_FILE).unlink(missing_ok=True)
        remove_leftovers(folder, [*RESULTS, RUN_FILE, ITEM_FILE, ERROR_FILE])
        solve = _reconstruct_video if item.kind == "video" else _solve_tracks
        answer = solve(item, folder, settings)
        status, reason = "done", "; ".join(str(state) for state in answer.statuses)
    except ReconError as error:
        status, reason = "failed", str(error)
    except Exception as error:  # one item must not end the others; the record names it and error.txt holds all of it
        status, reason = "failed", f"unexpected {type(error).__name__}: {error}; {folder / ERROR_FILE} says where"
        write_bytes(folder / ERROR_FILE, traceback.format_exc().encode())
    return _finish(item, out, settings, status, reason, time.monotonic() - start, fingerprint)


def _reconstruct_video(item: BatchItem, folder: Path, settings: BatchSettings) -> Reconstruction:
    # The folder is this item's, whatever settings an earlier batch had: force.
    return reconstruct_video(
        item.source,
        folder,
        camera=find_recording(item.source).camera or settings.camera,
        config=settings.config,
        rank=settings.rank,
        solver=settings.solver,
        device=settings.device,
        seed=settings.seed,
        force=True,
    )


def _solve_tracks(item: BatchItem, folder: Path, settings: BatchSettings) -> Reconstruction:
    tracks = load_tracks(item.source)
    if settings.camera is not None:
        tracks = replace(tracks, intrinsics=load_camera(settings.camera).intrinsics.to(tracks.xy.dtype))
    generator = torch.Generator().manual_seed(settings.seed)
    tracks.save(folder / "tracks.npz")
    answer = reconstruct(tracks.to(settings.device), settings.rank, settings.solver, generator=generator).to("cpu")
    answer.save(folder / "reconstruction.npz")
    report = {
        "status": [str(status) for status in answer.statuses],
        "rank": answer.rank,
        "deformation_degree": answer.deformation_degree,
        "frames": tracks.frames,
        "tracks": tracks.points,
    }
    write_json(folder / "report.json", report)
    return answer


def _finish(
    item: BatchItem,
    out: Path,
    settings: BatchSettings,
    status: str,
    reason: str,
    seconds: float | None = None,
    fingerprint: list[int] | None = None,
) -> dict[str, Any]:
    record = {
        "name": item.name,
        "source": str(item.source),
        "kind": item.kind,
        "status": status,
        "reason": reason,
        "seconds": seconds,
        "input": fingerprint,
        "settings": settings.record(),
    }
    (out / item.name).mkdir(exist_ok=True)
    write_json(out / item.name / ITEM_FILE, record)
    return record


def read_records(items: Sequence[BatchItem], out: Path) -> list[dict[str, Any]]:
    """Name, source, kind, status, reason and seconds of every item, as their folders say."""
    records = []
    for item in items:
        state: Mapping[str, Any] = {"status": "pending", "reason": ""}
        if item.kind == "skipped":
            state = {"status": "skipped", "reason": item.reason}
        elif (found := _read(out / item.name / ITEM_FILE)) is not None:
            state = found
        fields = {key: state.get(key) for key in ("status", "reason", "seconds")}
        records.append({"name": item.name, "source": str(item.source), "kind": item.kind, **fields})
    return records


def write_manifest(folder: Path, items: Sequence[BatchItem], out: Path, settings: BatchSettings) -> dict[str, Any]:
    """Write ``out/manifest.json`` from the items' folders, and return what it holds."""
    records = read_records(items, out)
    counts = Counter(record["status"] for record in records)
    manifest = {"folder": str(folder), "counts": dict(sorted(counts.items())), "items": records}
    manifest["settings"] = settings.record()
    write_json(out / MANIFEST, manifest)
    return manifest


def _fingerprint(source: Path) -> list[int]:
    """Number of files, bytes and time of the last change: enough to see that an input was replaced."""
    files = [source] if source.is_file() else [file for file in source.rglob("*") if file.is_file()]
    stats = [file.stat() for file in files]
    return [len(stats), sum(s.st_size for s in stats), max((s.st_mtime_ns for s in stats), default=0)]


def _read(path: Path) -> dict[str, Any] | None:
    """A JSON object, or None where there is none that can be read."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def _bar(items: Any, total: int, show: bool) -> Any:
    if not show:
        return items
    from tqdm import tqdm

    return tqdm(items, total=total, desc="batch", unit="item")
