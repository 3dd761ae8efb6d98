"""Speed of the tracker beside plain OpenCV: ``python -m eval.bench.tracker [--frames N] [--size H W]``.

A person before a camera that turns is filmed in the synthetic world. On the same frames, alternating in one process:
* the full tracker (detection, search, templates, covariance),
* OpenCV's SIFT with 1000 points on the whole frame, and its brute-force matcher from frame to frame,
* whole-frame detection of both, 1000 points.
CPU seconds are given beside wall seconds: on a busy machine only they can be compared. The last line is the peak of
the tracker's memory on the clip and on the same clip played three times.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch

from torchrecon.data.synthetic import (
    SensorNoise,
    SyntheticClip,
    SyntheticFrame,
    sample_body,
    sample_motion,
    turning_camera,
)
from torchrecon.features import detect_sift, track_points
from torchrecon.features.patches import to_gray

SEED = 5_000_001


def film(frames: int, size: tuple[int, int]) -> list[SyntheticFrame]:
    """A player who shoots, filmed at 25 frames per second."""
    generator = torch.Generator().manual_seed(SEED)
    body = sample_body(generator)
    motion = sample_motion("shoot", body, frames=frames, fps=25.0, generator=generator)
    camera = turning_camera(motion, total_turn_deg=5.0 * frames, size=size, generator=generator)
    clip = SyntheticClip(body, motion, camera, seed=SEED, sensor_noise=SensorNoise())
    return [clip.render(index) for index in range(frames)]


def opencv_chain(images: list[Any], match: bool) -> None:
    """SIFT on every frame; with ``match`` also the matches to the frame before, with the ratio test."""
    import cv2

    sift, matcher = cv2.SIFT_create(1000), cv2.BFMatcher()
    last = None
    for image in images:
        if not match:
            sift.detect(image, None)
            continue
        _, descriptors = sift.detectAndCompute(image, None)
        if last is not None and descriptors is not None:
            pairs = matcher.knnMatch(last, descriptors, k=2)
            [a for a, b in pairs if a.distance < 0.8 * b.distance]
        last = descriptors


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """(wall, CPU) seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - cpu


def repeated(items: list[Any], times: int) -> Iterator[Any]:
    """Forth and back and forth again, so that nothing jumps."""
    for turn in range(times):
        yield from items if turn % 2 == 0 else items[::-1]


def main() -> None:
    """Print seconds per frame, frames per second and ratios; the best of ``--runs``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--size", type=int, nargs=2, default=(576, 768), metavar=("H", "W"))
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    chosen = parser.parse_args()
    import cv2

    torch.set_num_threads(chosen.threads)
    cv2.setNumThreads(chosen.threads)
    shown = film(chosen.frames, tuple(chosen.size))
    rgb, masks = [frame.rgb for frame in shown], [frame.mask for frame in shown]
    grays = [to_gray(frame) for frame in rgb]
    images = [(255 * gray).round().clamp(0, 255).to(torch.uint8).numpy() for gray in grays]
    works: dict[str, Callable[[], object]] = {
        "tracker": lambda: track_points(rgb, masks),
        "OpenCV SIFT + matcher": lambda: opencv_chain(images, match=True),
        "detection": lambda: [detect_sift(gray[None, None], describe=False) for gray in grays[:5]],
        "OpenCV detection": lambda: opencv_chain(images[:5], match=False),
    }
    counts = {name: 5 if "detection" in name else chosen.frames for name in works}
    best: dict[str, tuple[float, float]] = {}
    works["detection"]()  # loads what is loaded once
    for _ in range(chosen.runs):
        for name, work in works.items():
            wall, cpu = timed(work)
            old = best.get(name, (np.inf, np.inf))
            best[name] = (min(old[0], wall / counts[name]), min(old[1], cpu / counts[name]))
    for name, (wall, cpu) in best.items():
        print(f"{name:24s} wall {1000 * wall:6.1f} ms  CPU {1000 * cpu:6.1f} ms a frame  {1 / wall:6.1f} frames/s")
    for label, column in (("wall", 0), ("CPU", 1)):
        speed = best["OpenCV SIFT + matcher"][column] / best["tracker"][column]
        cost = best["detection"][column] / best["OpenCV detection"][column]
        print(f"{label}: tracker {speed:.2f}x OpenCV's frames per second; detection {cost:.2f}x OpenCV's time")
    peaks = []
    for times in (1, 3):
        track_points(repeated(rgb, times), repeated(masks, times))
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    print(f"peak memory {peaks[0]:.0f} MB, three times as long {peaks[1]:.0f} MB")


if __name__ == "__main__":
    main()
