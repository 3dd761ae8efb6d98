"""SIGKILL at random moments: no broken file under a final name, and the next run ends as an undisturbed one.

``python -m tests.kill [--moments N]`` kills ``batch`` on tracks files and ``reconstruct`` on a short film; `make kill`
runs it, the test suite kills once.
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

__all__ = ["check_whole", "die_on_two", "kill_after", "results"]

ROOT = Path(__file__).resolve().parents[1]


def _start(command: list[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "torchrecon", *command],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def kill_after(command: list[str], moment: Callable[[], bool], limit: float = 120.0) -> bool:
    """Run the command line and kill it as soon as ``moment()``; True where it came to that."""
    process = _start(command)
    end = time.monotonic() + limit
    while process.poll() is None and not moment():
        if time.monotonic() > end:
            raise TimeoutError(f"{command[0]} was still running after {limit:g} s")
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


def _kill_at_random_moments(command: Callable[[Path], list[str]], work: Path, moments: int, seed: int) -> None:
    work.mkdir()
    calm, out, name = work / "calm", work / "out", command(work)[0]
    assert _start(command(calm)).wait() == 0
    wanted = results(calm)
    draw = random.Random(seed)
    hits = 0
    for number in range(moments):
        # Drawn by what is there and not by the clock: half of a short run is the loading of libraries.
        least, wait, seen = draw.randrange(len(wanted)), draw.uniform(0, 0.5), []

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
        assert [key for key in wanted if found[key] != wanted[key]] == []
        end = "killed" if killed else "had ended"
        print(f"{name} {number + 1}/{moments}: {end}, {held} of {len(wanted)} files were there", flush=True)
        shutil.rmtree(out)
    print(f"{name}: {hits} of {moments} runs killed; each next run ended as an undisturbed one")


def main() -> None:
    """Kill both commands at random moments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--moments", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        _tracks(work / "tracks", 6)
        quick = ["--rank", "1", "--solver", "rigid"]
        _kill_at_random_moments(
            lambda out: ["batch", str(work / "tracks"), "-o", str(out), "--workers", "2", *quick],
            work / "a",
            options.moments,
            options.seed,
        )
        _film(work / "film")
        clip = [str(work / "film" / "frames"), "--masks", str(work / "film" / "masks")]
        _kill_at_random_moments(
            lambda out: ["reconstruct", *clip, "-o", str(out), *quick], work / "b", options.moments, options.seed
        )


if __name__ == "__main__":
    main()
