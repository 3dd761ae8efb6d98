"""What every evaluation job shares: a cache for one configuration, results with their origin, timers, workers.

A job works in two passes. The first writes predictions into a :class:`Cache`, the second scores what is there.
The cache remembers the configuration that filled it; one from another configuration is refused, never reused.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import multiprocessing
import os
import platform
import shutil
import subprocess
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchrecon.errors import ReconError
from torchrecon.io import files
from torchrecon.io.files import plain, write_bytes, write_npz
from torchrecon.io.files import read_npz as read_arrays

__all__ = [
    "Cache",
    "Profile",
    "digest",
    "plain",
    "provenance",
    "read_arrays",
    "read_json",
    "run_parallel",
    "source_digest",
    "write_arrays",
    "write_json",
    "write_text",
]

ROOT = Path(__file__).resolve().parents[1]
_PACKAGES = ("torch", "kornia", "numpy", "scipy", "lightning", "opencv-python-headless")


def digest(value: Any) -> str:
    """A hash of the plain form that does not depend on the order of keys."""
    text = json.dumps(plain(value), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def source_digest(*places: str) -> str:
    """A hash of every Python file below the given places of the repository: the code that a prediction depends on."""
    total = hashlib.sha256()
    for place in places:
        root = ROOT / place
        files = [root] if root.is_file() else sorted(root.rglob("*.py"))
        if not files:
            raise ReconError(f"{root}: holds no Python file")
        for file in files:
            total.update(str(file.relative_to(ROOT)).encode() + b"\0" + file.read_bytes() + b"\0")
    return total.hexdigest()[:16]


def _in_folder(path: str | os.PathLike[str]) -> Path:
    """The path, its folder made."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    return target


def write_text(path: str | os.PathLike[str], text: str) -> Path:
    """Write a text file, atomically."""
    return write_bytes(_in_folder(path), text.encode())


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, Any]) -> Path:
    """Write named tensors or arrays to a .npz, atomically; None is left out."""
    return write_npz(_in_folder(path), dict(arrays))


def write_json(path: str | os.PathLike[str], payload: Any) -> Path:
    """Write the plain form of ``payload``, atomically and unrounded."""
    return files.write_json(_in_folder(path), payload)


def read_json(path: str | os.PathLike[str]) -> Any:
    """Read a JSON file; raises ReconError that names it."""
    source = Path(path)
    try:
        return json.loads(source.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ReconError(f"{source}: is not a readable JSON file ({error})") from error


def _differences(old: Any, new: Any, where: str = "") -> list[str]:
    """The keys at which two plain values differ, with both values."""
    if isinstance(old, dict) and isinstance(new, dict):
        found: list[str] = []
        for key in sorted(old.keys() | new.keys()):
            found += _differences(old.get(key), new.get(key), f"{where}.{key}" if where else key)
        return found
    return [] if old == new else [f"{where}: {old!r} there, {new!r} now"]


class Cache:
    """A folder of predictions that all come from one configuration.

    Args:
        folder: made if absent; ``config.json`` in it is the configuration that its contents come from.
        config: everything that a prediction depends on.
        fresh: throw away what another configuration left instead of refusing it.

    Raises:
        ReconError: the folder was filled under another configuration, or holds files but no configuration.

    Example:
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     cache = Cache(Path(folder) / "cache", {"seed": 0})
        ...     cache.path("rows", "flat.npz").name
        'flat.npz'
    """

    def __init__(self, folder: str | os.PathLike[str], config: Mapping[str, Any], fresh: bool = False) -> None:
        self.folder = Path(folder)
        self.config = plain(config)
        record = self.folder / "config.json"
        if record.is_file():
            old = read_json(record)
            if old != self.config and not fresh:
                raise ReconError(
                    f"{self.folder}: holds predictions of another configuration "
                    f"({'; '.join(_differences(old, self.config)[:3])}); "
                    "choose another --out or throw it away with --fresh"
                )
            if old != self.config:  # only a folder that a cache has marked as its own is ever removed
                shutil.rmtree(self.folder)
                write_json(record, self.config)
        elif self.folder.is_dir() and any(self.folder.iterdir()):
            raise ReconError(f"{self.folder}: holds files that no job of this kind has written; choose another --out")
        else:
            write_json(record, self.config)

    def path(self, *parts: str) -> Path:
        """The place of one prediction; its folder exists afterwards."""
        target = self.folder.joinpath(*parts)
        target.parent.mkdir(parents=True, exist_ok=True)
        return target


def provenance(device: str, seed: int) -> dict[str, Any]:
    """Where a result comes from: commit (``+`` when the tree differs from it), versions, device and seed."""

    def git(*arguments: str) -> str | None:
        if shutil.which("git") is None:
            return None
        answer = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
        return answer.stdout.strip() if answer.returncode == 0 else None

    import torchrecon

    commit = git("rev-parse", "HEAD")
    versions = {"python": platform.python_version(), "torchrecon": torchrecon.__version__}
    for package in _PACKAGES:
        versions[package] = importlib.metadata.version(package)
    return {
        "commit": None if commit is None else commit + ("+" if git("status", "--porcelain") else ""),
        "versions": versions,
        "device": device,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "seed": seed,
    }


class Profile:
    """CPU and wall seconds per named stage, summed over workers.

    Example:
        >>> profile = Profile()
        >>> with profile("render"):
        ...     pass
        >>> sorted(profile.stages["render"])
        ['calls', 'cpu_s', 'wall_s']
    """

    def __init__(self, stages: Mapping[str, Mapping[str, float]] | None = None) -> None:
        self.stages: dict[str, dict[str, float]] = {name: dict(value) for name, value in (stages or {}).items()}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        cpu, wall = time.process_time(), time.perf_counter()
        try:
            yield
        finally:
            self.add(stage, time.process_time() - cpu, time.perf_counter() - wall)

    def add(self, stage: str, cpu_s: float, wall_s: float, calls: int = 1) -> None:
        """Add one or more calls of a stage."""
        entry = self.stages.setdefault(stage, {"cpu_s": 0.0, "wall_s": 0.0, "calls": 0})
        entry["cpu_s"] += cpu_s
        entry["wall_s"] += wall_s
        entry["calls"] += calls

    def merge(self, other: Profile) -> None:
        """Add what another profile has measured."""
        for name, value in other.stages.items():
            self.add(name, value["cpu_s"], value["wall_s"], int(value["calls"]))

    def text(self) -> str:
        """A table of the stages in the order in which they were first met."""
        lines = [f"{'stage':<28}{'calls':>6}{'CPU min':>10}{'wall min':>10}"]
        for name, value in self.stages.items():
            lines.append(f"{name:<28}{int(value['calls']):>6}{value['cpu_s'] / 60:>10.2f}{value['wall_s'] / 60:>10.2f}")
        total = sum(value["cpu_s"] for value in self.stages.values())
        return "\n".join([*lines, f"{'sum':<28}{'':>6}{total / 60:>10.2f}"])


def _start_worker(parent: int) -> None:
    import torch

    torch.set_num_threads(1)

    def leave_with_the_job() -> None:
        # A job that is killed outright cannot stop its workers: they look after themselves.
        while os.getppid() == parent:
            time.sleep(2)
        os._exit(1)

    threading.Thread(target=leave_with_the_job, daemon=True).start()


def _call(task: Callable[[Any], Any], item: Any) -> tuple[Any, str | None]:
    try:
        return task(item), None
    except ReconError as error:
        return None, str(error)
    except Exception:
        # The traceback travels as text: not every exception of a library survives pickling.
        return None, traceback.format_exc()


def run_parallel(
    task: Callable[[Any], Any],
    items: Sequence[Any],
    workers: int = 2,
    label: str = "",
    name: Callable[[Any], str] = str,
) -> Iterable[tuple[Any, Any]]:
    """Run a picklable ``task`` on every item in single-threaded worker processes; a progress bar shows the count.

    Yields:
        (item, result) in the order in which they are finished.

    Raises:
        ReconError: a task failed (the message names the item and holds its error) or a worker was killed; what
            other workers have written stays, the rest is not started.
    """
    from tqdm import tqdm

    context = multiprocessing.get_context("spawn")  # a fork of a process that has used torch's thread pool can hang
    pool = ProcessPoolExecutor(
        max_workers=workers, mp_context=context, initializer=_start_worker, initargs=(os.getpid(),)
    )
    try:
        futures = {pool.submit(_call, task, item): item for item in items}
        with tqdm(total=len(items), desc=label, unit="seq") as bar:
            for future in as_completed(futures):
                item = futures[future]
                try:
                    result, error = future.result()
                except BrokenProcessPool as broken:
                    raise ReconError(
                        f"{label}: a worker process was killed, perhaps for want of memory; "
                        "run the same command again, finished sequences are kept"
                    ) from broken
                if error is not None:
                    raise ReconError(f"{label}: {name(item)} failed: {error}")
                bar.update()
                yield item, result
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
