"""How much faster ``batch`` is on two processes: ``python -m tests.throughput [--clips N]``, on a machine at rest.

Short films with masks, one thread a process. The results of both runs have to be the same.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.kill import ROOT, results
from tests.test_pipeline import film


def _run(folder: Path, out: Path, workers: int) -> float:
    command = [sys.executable, "-m", "torchrecon", "batch", str(folder), "-o", str(out), "--workers", str(workers)]
    start = time.monotonic()
    subprocess.run(command, cwd=ROOT, check=True)
    return time.monotonic() - start


def main() -> None:
    """Print seconds for one and two processes and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=int, default=20)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        clips = Path(name) / "clips"
        (clips / "00").mkdir(parents=True)
        film(clips / "00", depth=False)
        shutil.rmtree(clips / "00" / "depth")
        for number in range(1, options.clips):
            shutil.copytree(clips / "00", clips / f"{number:02d}")
        out = Path(name) / "out"  # of both runs: a page names the command that made it, and so its folder
        one, first = _run(clips, out, 1), results(out)
        shutil.rmtree(out)
        two, second = _run(clips, out, 2), results(out)
        print(f"{options.clips} clips: {one:.1f} s on one process, {two:.1f} s on two, {one / two:.2f}x", end="; ")
        print(f"same: {first == second}")


if __name__ == "__main__":
    main()
