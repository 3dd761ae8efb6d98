"""SIGKILL at random moments: no broken file under a final name, and the next run ends as an undisturbed one.

``python -m tests.kill [--moments N] [--only JOB]`` kills ``batch`` on tracks files, ``reconstruct`` on a short film and
a small training of the recogniser; `make kill` runs it, the test suite kills ``batch`` and the training once each.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

__all__ = ["SMALL_TRAINING", "check_whole", "die_on_two", "kill_after", "results"]

ROOT = Path(__file__).resolve().parents[1]
SMALL_TRAINING = [
    "--data.films=12",
    "--data.points=80",
    "--data.validation_films=0",
    "--data.batch_size=6",
    "--trainer.enable_progress_bar=false",
]


def _start(command: list[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", *command],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def kill_after(command: list[str], moment: Callable[[], bool], limit: float = 120.0) -> bool:
    """Run a module with its arguments and kill it as soon as ``moment()``; True where it came to that."""
    process = _start(command)
    end = time.monotonic() + limit
    while process.poll() is None and not moment():
        if time.monotonic() > end:
            raise TimeoutError(f"{' '.join(command[:2])} was still running after {limit:g} s")
        time.sleep(0.002)
    killed = process.poll() is None
    if killed:
        # The command alone, as when memory runs out: its workers have to end by themselves.
        os.kill(process.pid, signal.SIGKILL)
    process.wait()
    return killed


def die_on_two(item: int) -> int:
    """Ten times the item; on 2 the process ends as if memory had run out. Here, where a new process loads little."""
    if item == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return item * 10


def check_whole(folder: Path) -> None:
    """Every file under a final name can be read to its end."""
    for path in folder.rglob("*"):
        if not path.is_file() or path.name.startswith("."):
            continue
        if path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as archive:
                for name in archive.files:
                    archive[name]
        elif path.suffix == ".png":
            import cv2

            assert path.read_bytes().endswith(b"IEND\xaeB`\x82"), path
            assert cv2.imread(str(path)) is not None, path
        elif path.suffix == ".safetensors":
            from safetensors.torch import load_file

            assert load_file(path), path
        elif path.suffix == ".ckpt":
            import torch

            assert torch.load(path, weights_only=True)["state_dict"], path
        elif path.suffix == ".html":
            assert path.read_text().rstrip().endswith("</html>"), path
        else:
            raise AssertionError(f"{path}: a file that this check does not know")


def results(folder: Path) -> dict[str, bytes]:
    """The content of every file by its path, the seconds that a run took left out."""
    found = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = path.read_bytes()
        if path.suffix == ".json":
            content = b"\n".join(line for line in content.splitlines() if b'"seconds"' not in line)
        found[str(path.relative_to(folder))] = content
    return found


def _tracks(folder: Path, count: int) -> None:
    from tests.test_batch import write_tracks

    folder.mkdir()
    for seed in range(count):
        write_tracks(folder / f"{seed:02d}.npz", seed)


def _film(folder: Path) -> None:
    from tests.test_pipeline import film

    folder.mkdir()
    film(folder, depth=False)


def _kill_at_random_moments(
    name: str, command: Callable[[Path], list[str]], work: Path, moments: int, seed: int, longest: float = 0.5
) -> None:
    """``longest``: seconds after a result appeared, or after the start, in which the kill comes."""
    work = work / name
    work.mkdir(parents=True)
    out = work / "out"  # the undisturbed run too: a page names the command that made it, and so its folder
    assert _start(command(out)).wait() == 0
    wanted = results(out)
    shutil.rmtree(out)
    draw = random.Random(seed)
    hits = 0
    for number in range(moments):
        # Drawn by what is there and not by the clock: half of a short run is the loading of libraries.
        least, wait, seen = draw.randrange(len(wanted)), draw.uniform(0, longest), []

        def moment(least: int = least, wait: float = wait, seen: list[float] = seen) -> bool:
            if not seen and sum(path.is_file() for path in out.rglob("*")) >= least:
                seen.append(time.monotonic())
            return bool(seen) and time.monotonic() >= seen[0] + wait

        killed = kill_after(command(out), moment)
        hits += killed
        held = len(results(out))
        check_whole(out)
        assert _start(command(out)).wait() == 0
        found = results(out)
        assert found.keys() == wanted.keys(), set(found) ^ set(wanted)  # temporary files are gone too
        differ = [key for key in wanted if found[key] != wanted[key]]
        assert differ == [], f"{name} {number + 1}/{moments}: another content than undisturbed: {', '.join(differ)}"
        end = "killed" if killed else "had ended"
        print(f"{name} {number + 1}/{moments}: {end}, {held} of {len(wanted)} files were there", flush=True)
        shutil.rmtree(out)
    print(f"{name}: {hits} of {moments} runs killed; each next run ended as an undisturbed one")


def main() -> None:
    """Kill each job at random moments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--moments", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=["batch", "reconstruct", "train"])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        quick = ["--rank", "1", "--solver", "rigid"]
        clip = [str(work / "film" / "frames"), "--masks", str(work / "film" / "masks")]
        tracks = [str(work / "tracks"), "--workers", "2"]
        small = [*SMALL_TRAINING, "--trainer.max_epochs=4"]
        jobs: dict[str, Callable[[Path], list[str]]] = {
            "batch": lambda out: ["torchrecon", "batch", *tracks, "-o", str(out), *quick],
            "reconstruct": lambda out: ["torchrecon", "reconstruct", *clip, "-o", str(out), *quick],
            "train": lambda out: ["train.recogniser", "--out", str(out / "recogniser.safetensors"), *small],
        }
        for name, command in jobs.items():
            if options.only not in (None, name):
                continue
            if name == "batch":
                _tracks(work / "tracks", 6)
            elif name == "reconstruct":
                _film(work / "film")
            # Training spends seconds on its films and some on each epoch, between which nothing appears.
            longest = 8.0 if name == "train" else 0.5
            _kill_at_random_moments(name, command, work / "runs", options.moments, options.seed, longest)


if __name__ == "__main__":
    main()
