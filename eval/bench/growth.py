"""How time and memory of the default solver grow with frames and with points. ``python -m eval.bench.growth``.

Every size runs in a process of its own, so that its peak memory is its own. The tracks are those of a body of three
shape bases before a swaying camera, with noise. ``--full`` goes to 20,000 frames and 20,000 points.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time

import torch

import torchrecon as tr
from torchrecon.linalg import rotation_from_vector
from torchrecon.metrics import error3d_camera

__all__ = ["main", "world"]

FRAMES, POINTS = 100, 50  # of the other dimension
SIZES = (500, 1000, 2000, 4000)
FULL = (5000, 10_000, 20_000)


def world(frames: int, points: int, seed: int = 0, noise: float = 0.01) -> tuple[tr.Tracks, torch.Tensor]:
    """Orthographic tracks and their truth (frames, points, 3); unit: about the size of the body.

    Example:
        >>> world(20, 9)[1].shape
        torch.Size([20, 9, 3])
    """
    g = torch.Generator().manual_seed(seed)
    t = torch.arange(frames, dtype=torch.float64) / 15
    basis = torch.randn(3, points, 3, generator=g, dtype=torch.float64)
    weights = torch.stack([torch.ones_like(t), 0.3 * torch.sin(2.3 * t), 0.2 * torch.sin(1.3 * t + 1)], 1)
    shape = torch.einsum("fk,kpc->fpc", weights, basis)
    turn = torch.stack([0.5 * torch.sin(0.9 * t), 1.4 * torch.sin(0.6 * t), 0.3 * torch.cos(0.7 * t)], 1)
    truth = (shape - shape.mean(1, keepdim=True)) @ rotation_from_vector(turn).mT
    xy = truth[..., :2] + noise * torch.randn(frames, points, 2, generator=g, dtype=torch.float64)
    return tr.Tracks(xy), truth


def _measure(frames: int, points: int) -> dict[str, float | int | str]:
    tracks, truth = world(frames, points)
    wall, cpu = time.perf_counter(), time.process_time()
    answer = tr.reconstruct(tracks)
    return {
        "frames": frames,
        "points": points,
        "seconds": time.perf_counter() - wall,
        "cpu_seconds": time.process_time() - cpu,
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "error3d_camera": float(error3d_camera(answer.points3d, truth)),
        "status": answer.status.code,
    }


def main(argv: list[str] | None = None) -> int:
    """Command line of the benchmark."""
    parser = argparse.ArgumentParser(prog="python -m eval.bench.growth", description=__doc__.split("\n")[0])
    parser.add_argument("--full", action="store_true", help="up to 20,000 frames and 20,000 points")
    parser.add_argument("--only", nargs=2, type=int, metavar=("FRAMES", "POINTS"), help="one size, printed as JSON")
    arguments = parser.parse_args(argv)
    if arguments.only:
        print(json.dumps(_measure(*arguments.only)))
        return 0
    sizes = SIZES + (FULL if arguments.full else ())
    print(f"{'frames':>7}{'points':>8}{'seconds':>9}{'CPU s':>8}{'MiB':>7}{'error3d':>9}  status")
    for frames, points in [(size, POINTS) for size in sizes] + [(FRAMES, size) for size in sizes]:
        command = [sys.executable, "-m", "eval.bench.growth", "--only", str(frames), str(points)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode != 0:
            print(f"{frames:7d}{points:8d}  ended with exit code {done.returncode}; its message stands above")
            continue
        row = json.loads(done.stdout.splitlines()[-1])
        print(
            f"{frames:7d}{points:8d}{row['seconds']:9.1f}{row['cpu_seconds']:8.1f}{row['peak_mib']:7.0f}"
            f"{row['error3d_camera']:9.4f}  {row['status']}",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
