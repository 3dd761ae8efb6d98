"""Figures 1 to 7: graph of the part model, views, filtered depth, reference frames, six methods."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from eval.leftout import Answer, Solved
from eval.sequences import make_clip
from torchrecon._typing import Bool, Float, Tensor
from torchrecon.data.synthetic import SensorNoise, SyntheticClip, sample_body, sample_motion, static_camera
from torchrecon.depth import bilateral_depth
from torchrecon.measurement.camera import project_points
from torchrecon.metrics import psnr
from torchrecon.pipeline.depth import body_depth
from torchrecon.viz.views import save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["METHODS", "draw_depth", "draw_graph", "draw_methods", "draw_reference", "draw_views", "edges_of"]

JOINT = "f(y|x,B) f(B|A) f(A) f(P) f(x|P)"
"""The paper's (8): every factor names a node and the nodes that it depends on."""
NODES = {
    "P": ("presence of parts", 0.0, 1.0),
    "x": ("direction and speed", 1.0, 1.0),
    "y": ("detected direction\nand speed", 2.0, 0.5),
    "A": ("appearance templates", 0.0, 0.0),
    "B": ("detected appearance", 1.0, 0.0),
}
METHODS = ("ref4", "ref5", "ref6", "ref7", "ref8", "default")


def edges_of(joint: str) -> list[tuple[str, str]]:
    """The directed graph that a product of conditional densities stands for.

    Example:
        >>> edges_of("f(a) f(b|a,c)")
        [('a', 'b'), ('c', 'b')]
    """
    factors = re.findall(r"f\((\w+)(?:\|([\w,]+))?\)", joint)
    return [(parent, child) for child, parents in factors for parent in parents.split(",") if parent]


def _figure(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def draw_graph(path: Path) -> dict[str, Any]:
    """Figure 1: the graph of (8); what is observed is shaded."""
    figure, ((axes,),) = _figure(7, 3.2)
    for parent, child in edges_of(JOINT):
        start, end = NODES[parent][1:], NODES[child][1:]
        arrow = {"arrowstyle": "-|>", "shrinkA": 20, "shrinkB": 20, "lw": 1.4}
        axes.annotate("", end, start, arrowprops=arrow)
    for name, (meaning, x, y) in NODES.items():
        face = "0.8" if name in "yB" else "white"
        axes.text(x, y, name, ha="center", va="center", size=15, bbox={"boxstyle": "circle", "fc": face, "ec": "k"})
        axes.text(x, y - 0.27, meaning, ha="center", va="top", size=8)
    axes.set(xlim=(-0.5, 2.5), ylim=(-0.6, 1.4), title=f"{JOINT}; shaded: observed")
    axes.axis("off")
    save_figure(figure, path)
    return {"edges": edges_of(JOINT)}


def _show(axes: Axes, rgb: Float[Tensor, "3 height width"]) -> None:
    axes.imshow(rgb.permute(1, 2, 0).clamp(0, 1).numpy())
    axes.axis("off")


def _scatter(axes: Axes, points: Tensor, chosen: Tensor, view: tuple[int, int], half: float, **style: Any) -> None:
    a, b = view
    axes.scatter(points[chosen, a], points[chosen, b], s=5, **style)
    # y is down and z away from the camera: from above, what is near the camera is drawn below.
    axes.set(xlim=(-half, half), ylim=(half, -half) if b == 1 else (-half, half), aspect="equal")
    axes.tick_params(labelsize=6)


_VIEWS = {"front": (0, 1), "side": (2, 1), "top": (0, 2)}


def _body_frame(solved: Solved, answer: Answer, frame: int) -> tuple[Tensor, Tensor, Bool[Tensor, " points"]]:
    """Points of the row and of the truth about the middle of the true body, and those that both have."""
    truth = solved.truth[frame]
    middle = truth[solved.filmed.known].mean(0)
    return answer.aligned[frame] - middle, truth - middle, answer.found[frame]


def draw_views(solved: Solved, answers: dict[str, Answer], path: Path) -> dict[str, Any]:
    """Figure 2: original, and the default's points from the front, the side and above, at the reference frames."""
    clip, answer = make_clip(solved.sequence, solved.filming), answers["default"]
    frames = solved.protocol.reference
    figure, axes = _figure(10, 2.8 * len(frames), len(frames), 4)
    half = 0.6 * solved.stature
    for row, frame in zip(axes, frames, strict=True):
        _show(row[0], clip.render(frame).rgb)
        row[0].set_title(f"frame {frame}", size=8)
        points, _, chosen = _body_frame(solved, answer, frame)
        for ax, (name, view) in zip(row[1:], _VIEWS.items(), strict=True):
            _scatter(ax, points, chosen, view, half, c=points[chosen, 2], cmap="viridis", vmin=-0.5, vmax=0.5)
            ax.set_title(f"{name}, metres; colour: depth", size=8)
    save_figure(figure, path)
    return {"frames": list(frames), "note": answer.note}


def squat_clip(size: tuple[int, int], noise: SensorNoise | None, seed: int = 0) -> tuple[SyntheticClip, int]:
    """A player who jumps before a depth sensor, and the frame in which he squats lowest."""
    g = torch.Generator().manual_seed(972_000_000 + seed)
    body = sample_body(g)
    motion = sample_motion("jump", body, frames=60, generator=g)
    clip = SyntheticClip(body, motion, static_camera(motion, size=size, generator=g), seed=seed, sensor_noise=noise)
    return clip, int(motion.joints[:, 0, 1].argmin())


def draw_depth(path: Path, size: tuple[int, int] = (576, 768)) -> dict[str, Any]:
    """Figure 3: a squat frame's depth as sensed, filtered (13)-(16) and cut out (17), and what the filter gains.

    PSNR is taken over pixels of the body with a measured depth, against the noise-free depth, peak 1 m. The range box
    is set by the contour of the body, as in the paper; by itself a box cannot part feet from the floor they stand on,
    which ``iou_without_contour`` says.
    """
    clip, frame = squat_clip(size, SensorNoise())
    exact = squat_clip(size, None)[0].render(frame).depth
    sensed = clip.render(frame)
    filtered = bilateral_depth(sensed.depth)
    cut, alone = (body_depth(sensed.depth, mask, clip.camera.intrinsics) for mask in (sensed.mask, None))
    whole = sensed.mask & torch.isfinite(sensed.depth) & torch.isfinite(exact)
    before, after = (float(psnr(image[whole][None], exact[whole][None])) for image in (sensed.depth, filtered))
    iou = [float((found.body & sensed.mask).sum() / (found.body | sensed.mask).sum()) for found in (cut, alone)]
    figure, ((*panels,),) = _figure(14, 3.4, 1, 4)
    _show(panels[0], sensed.rgb)
    panels[0].set_title(f"squat, frame {frame}")
    near, far = (float(torch.quantile(exact[whole], q)) for q in (0.01, 0.99))
    kept = torch.where(cut.body, cut.depth, torch.nan)
    texts = (f"sensed, {before:.1f} dB", f"filtered, {after:.1f} dB", f"in the range box, IoU {iou[0]:.3f}")
    for ax, image, text in zip(panels[1:], (sensed.depth, filtered, kept), texts, strict=True):
        ax.imshow(image.numpy(), vmin=near - 0.1, vmax=far + 0.1, cmap="viridis")
        ax.set_title(text)
        ax.axis("off")
    save_figure(figure, path)
    return {"frame": frame, "psnr_before": before, "psnr_after": after, "iou": iou[0], "iou_without_contour": iou[1]}


def draw_reference(solved: Solved, path: Path) -> dict[str, Any]:
    """Figure 4: the reference images, given points in white and left-out true points in red."""
    clip = make_clip(solved.sequence, solved.filming)
    frames = solved.protocol.reference
    figure, axes = _figure(12, 3.4, 1, len(frames))
    counts = []
    for number, (ax, frame) in enumerate(zip(axes[0], frames, strict=True), 1):
        _show(ax, clip.render(frame).rgb)
        seen, left = solved.given.visible[frame], solved.left_out[frame] & solved.filmed.known
        pixels = project_points(solved.truth[frame], solved.intrinsics)
        ax.scatter(*solved.given.xy[frame, seen].T, s=3, c="white")
        ax.scatter(*pixels[left].T, s=12, facecolors="none", edgecolors="red")
        ax.set_title(f"({number}) frame {frame}")
        counts.append({"frame": frame, "given": int(seen.sum()), "left_out": int(left.sum())})
    save_figure(figure, path)
    return {"images": counts}


def draw_methods(solved: Solved, answers: dict[str, Answer], frame: int, path: Path) -> dict[str, Any]:
    """Figures 5 to 7: six methods at one frame; the row's points in blue on the true ones in grey."""
    present = [key for key in METHODS if key in answers]
    figure, axes = _figure(2.3 * len(present), 6.6, len(_VIEWS), len(present))
    half = 0.6 * solved.stature
    errors = {}
    for column, key in enumerate(present):
        points, truth, chosen = _body_frame(solved, answers[key], frame)
        distance = (points - truth)[chosen].norm(dim=-1)
        errors[key] = float(distance.median())
        for ax, (name, view) in zip(axes[:, column], _VIEWS.items(), strict=True):
            _scatter(ax, truth, chosen, view, half, c="0.75")
            _scatter(ax, points, chosen, view, half, c="tab:blue")
            ax.set_title(f"{answers[key].row.label}\n{name}" if name == "front" else name, size=7)
    figure.suptitle(f"Pass, frame {frame}: found (blue), true (grey), metres", size=9)
    save_figure(figure, path)
    return {"frame": frame, "median_error_m": errors}
