"""The page in a real browser: size, time to load and frame rate for a synthetic clip of ten seconds.

    python -m eval.page [--points N ...] [--seconds S] [-o DIR]

Needs Debian's ``chromium`` and ``chromium-driver``. The shape is the true one with made-up noise: the page is measured,
no solver. The frame rate is that of the whole page while it plays and is turned in every frame, without a graphics card
(WebGL runs on the processor), so a computer with one is faster. Screenshots are put beside ``page.json``.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from eval.browser import CHROMIUM, DRIVER, load, open_browser, resize, screenshot, severe
from eval.job import provenance, write_json
from torchrecon._typing import Float, Tensor
from torchrecon.data.synthetic import SyntheticClip, sample_body, sample_motion, turning_camera
from torchrecon.data.synthetic.skeleton import JOINTS, PARENTS
from torchrecon.io.files import write_bytes
from torchrecon.io.frames import encode_stills
from torchrecon.measurement import RankEstimate, Reconstruction, Status, Tracks
from torchrecon.viz.report import build_report

FPS, SIZE = 25.0, (360, 480)
# Frames a second of an idle page (what the machine can give now), then of one that plays and turns; milliseconds of one
# drawing until the graphics queue holds it, and until its pixels can be read.
_RATE = """
const length = 1000 * arguments[0], done = arguments[1];
const canvas = document.getElementById("shape-canvas"), gl = canvas.getContext("webgl2"), pixel = new Uint8Array(4);
const median = (values) => values.sort((a, b) => a - b)[values.length >> 1];
const turn = new KeyboardEvent("keydown", { key: "ArrowRight", shiftKey: true, bubbles: true });
const count = (work) => new Promise((finish) => {
  let frames = 0, begin = null;
  const step = (now) => {
    if (begin === null) begin = now;
    else if (now - begin > length) return finish((1000 * frames) / (now - begin));
    frames++;
    work();
    requestAnimationFrame(step);
  };
  requestAnimationFrame(step);
});
(async () => {
  const idle = await count(() => {});
  document.getElementById("play").click();
  const busy = await count(() => document.body.dispatchEvent(turn)); // the page itself draws once a frame
  document.getElementById("play").click();
  const queued = [], drawn = [];
  for (let i = 0; i < 30; i++) {
    const start = performance.now();
    torchrecon.draw();
    queued.push(performance.now() - start);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    drawn.push(performance.now() - start);
  }
  done([idle, busy, median(queued), median(drawn)]);
})();
"""


class Rendered:
    """A synthetic clip as a source of frames."""

    def __init__(self, clip: SyntheticClip) -> None:
        self.clip, self.path, self.fps, self.size = clip, Path("synthetic"), clip.fps, clip.size

    def __len__(self) -> int:
        return len(self.clip)

    def __iter__(self) -> Iterator[Float[Tensor, "3 height width"]]:
        return (self.clip.render(index).rgb.float() for index in range(len(self.clip)))


def make_clip(seconds: float, seed: int = 0) -> SyntheticClip:
    """A shot at goal seen by a camera that turns about the player."""
    g = torch.Generator().manual_seed(seed)
    body = sample_body(g)
    motion = sample_motion("shoot", body, frames=round(seconds * FPS), fps=FPS, generator=g)
    return SyntheticClip(body, motion, turning_camera(motion, size=SIZE, generator=g), seed=seed)


def truth(clip: SyntheticClip, points: int) -> tuple[Reconstruction, Tracks]:
    """Joints and skin of the clip as if reconstructed: 2 cm of noise that the covariance states, gaps from the view."""
    g = torch.Generator().manual_seed(1)
    skin, seen = clip.trajectory(clip.sample_surface(points - len(JOINTS), g))
    xyz = torch.cat([clip.joints3d, skin], 1)
    visible = torch.cat([torch.ones(len(clip), len(JOINTS), dtype=torch.bool), seen], 1)
    sigma = torch.tensor([0.01, 0.01, 0.03])
    noise = sigma * torch.randn(xyz.shape, generator=g)
    xy = clip.camera.project(xyz) + 0.5 * torch.randn(*xyz.shape[:-1], 2, generator=g)
    names = [*JOINTS, *(f"skin {i}" for i in range(points - len(JOINTS)))]
    covariance = (0.25 * torch.eye(2)).expand(*xy.shape, 2)
    edges = [(a, b) for b, a in enumerate(PARENTS) if a >= 0]
    tracks = Tracks(xy, visible, covariance, intrinsics=clip.camera.intrinsics, fps=FPS, names=names, edges=edges)
    answer = Reconstruction.from_points(
        xyz + noise,
        clip.camera.rotations,
        rank=3,
        status=Status("ok", "true shape with noise, to measure the page"),
        translation=xyz.mean(-2),
        covariance3d=torch.diag(sigma**2).expand(*xyz.shape, 3),
        intrinsics=clip.camera.intrinsics,
        observed=visible,
    )
    return answer, tracks


def evidence() -> RankEstimate:
    """Eigenvalues as they look for K = 3; what they say of this clip is not the matter here."""
    values = torch.cat([torch.tensor([9e3, 5e3, 2e3, 300.0, 180, 90, 24, 12, 7]), torch.linspace(2.6, 0.4, 40)])
    return RankEstimate(3, 3.0, values, torch.full_like(values, 3.1), (2, 4), "kritchman_nadler", "stack")


def measure(page: Path, folder: Path, seconds: float = 4.0) -> dict[str, Any]:
    """Open the page, take its pictures, and clock it."""
    with open_browser() as driver:
        load(driver, page)
        loaded = driver.execute_script("return torchrecon.loaded")
        driver.set_script_timeout(60)
        idle, rate, queued, drawn = driver.execute_async_script(_RATE, seconds)
        for name, width, height, phone, dark in (
            ("desktop", 1400, 900, False, False),
            ("dark", 1400, 900, False, True),
            ("phone", 390, 844, True, False),
        ):
            resize(driver, width, height, phone, dark)
            time.sleep(0.5)
            screenshot(driver, folder / f"{page.stem}-{name}.png", width)
        return {
            "bytes": page.stat().st_size,
            "load_ms": loaded,
            "frames_per_second": rate,
            "frames_per_second_idle": idle,
            "queued_ms": queued,
            "drawn_ms": drawn,
            "errors": severe(driver),
        }


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m eval.page", description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, nargs="+", default=[400, 4000], metavar="N", help="default: 400 4000")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the clip (default: 10)")
    parser.add_argument("-o", "--out", type=Path, default=Path("runs/page"), metavar="DIR")
    options = parser.parse_args(arguments)
    if CHROMIUM is None or DRIVER is None:
        print("eval.page: chromium and chromedriver are needed (Debian: chromium chromium-driver)", file=sys.stderr)
        return 2
    options.out.mkdir(parents=True, exist_ok=True)
    clip = make_clip(options.seconds)
    found: dict[str, Any] = {}
    for points in options.points:
        answer, tracks = truth(clip, points)
        begin = time.perf_counter()
        command = "python -m eval.page " + " ".join(arguments if arguments is not None else sys.argv[1:])
        page = build_report(
            answer,
            tracks,
            evidence(),
            lambda budget: encode_stills(Rendered(clip), budget),
            title=f"Synthetic clip, {points} points",
            command=command.strip(),
            versions=provenance("cpu", 0)["versions"],
        )
        built = time.perf_counter() - begin
        path = write_bytes(options.out / f"page{points}.html", page)
        found[str(points)] = {"build_s": built} | measure(path, options.out)
        row = found[str(points)]
        print(
            f"{points:5d} points: {row['bytes'] / 1e6:.2f} MB, built in {built:.1f} s, "
            f"loads in {row['load_ms']:.0f} ms, "
            f"{row['frames_per_second']:.0f} frames per second (idle {row['frames_per_second_idle']:.0f}), "
            f"one drawing queued in {row['queued_ms']:.1f} ms and drawn without a graphics card in "
            f"{row['drawn_ms']:.0f} ms, "
            f"{len(row['errors'])} errors"
        )
    write_json(options.out / "page.json", found | {"origin": provenance("cpu", 0)})
    return 0 if all(not row["errors"] and row["bytes"] < 8e6 for row in found.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
