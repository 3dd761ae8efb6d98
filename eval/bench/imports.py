"""Import and help times: ``python -m eval.bench.imports``.

Each command runs as a whole process, alternating, several times; the minimum is the figure least disturbed by
other work on the machine.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time

COMMANDS = {
    "import torch, kornia": [sys.executable, "-c", "import torch, kornia"],
    "import torchrecon": [sys.executable, "-c", "import torchrecon"],
    "torchrecon --help": [sys.executable, "-m", "torchrecon", "--help"],
    "tr.Tracks; tr.reconstruct": [sys.executable, "-c", "import torchrecon as tr; tr.Tracks; tr.reconstruct"],
}


def main() -> None:
    """Print minimum and median wall seconds of each command, and the ratio to torch and kornia alone."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    runs = parser.parse_args().runs
    seconds: dict[str, list[float]] = {name: [] for name in COMMANDS}
    for _ in range(runs):
        for name, command in COMMANDS.items():
            start = time.perf_counter()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            seconds[name].append(time.perf_counter() - start)
    base = min(seconds["import torch, kornia"])
    for name, taken in seconds.items():
        print(f"{name:28s} min {min(taken):.2f} s  median {sorted(taken)[runs // 2]:.2f} s  x{min(taken) / base:.2f}")


if __name__ == "__main__":
    main()
