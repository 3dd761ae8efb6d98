"""The pictures of the documentation, made from the synthetic world: ``python docs/pictures.py [FOLDER]``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

import torchrecon as tr
from torchrecon.data.synthetic import SyntheticClip, sample_body, sample_motion, turning_camera
from torchrecon.features import track_points
from torchrecon.gaps import fill_gaps
from torchrecon.viz.views import save_figure

PIXELS_PER_METRE, NOISE = 100.0, 0.5


def make_clip() -> SyntheticClip:
    """A shot at goal, 60 frames, before a camera that turns by 200 degrees."""
    g = torch.Generator().manual_seed(2)
    body = sample_body(g)
    motion = sample_motion("shoot", body, frames=60, fps=25.0, generator=g)
    camera = turning_camera(motion, total_turn_deg=200.0, distance=5.0, size=(240, 320), generator=g)
    return SyntheticClip(body, motion, camera, seed=2)


def make_tracks(clip: SyntheticClip) -> tuple[tr.Tracks, torch.Tensor]:
    """Forty points of the skin as a far camera sees them, with noise; and their true 3D in the tracks' pixels."""
    g = torch.Generator().manual_seed(3)
    xyz, _ = clip.trajectory(clip.sample_surface(40, g))
    truth = PIXELS_PER_METRE * (xyz - xyz.mean(1, keepdim=True)).double()
    noise = NOISE * torch.randn(*truth.shape[:2], 2, generator=g, dtype=torch.float64)
    return tr.Tracks(truth[..., :2] + noise, fps=clip.fps), truth


def _axes(width: float, height: float, columns: int = 1) -> tuple[Figure, list[Any]]:
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, list(figure.subplots(1, columns, squeeze=False)[0])


def draw_tracking(clip: SyntheticClip, path: Path, frames: int = 16) -> None:
    """Frames of the film with the paths of the points that were followed so far."""
    film = [clip.render(index) for index in range(frames)]
    tracks = track_points([frame.rgb for frame in film], [frame.mask for frame in film], fps=clip.fps)
    figure, axes = _axes(10, 2.8, 3)
    for axis, index in zip(axes, (0, frames // 2, frames - 1), strict=True):
        axis.imshow(film[index].rgb.permute(1, 2, 0).numpy())
        here = tracks.visible[index]
        axis.plot(*tracks.xy[: index + 1, here].unbind(-1), color="#56b4e9", lw=0.7)
        axis.scatter(*tracks.xy[index, here].unbind(-1), s=6, color="#e69f00")
        axis.set(title=f"frame {index}: {int(here.sum())} points", xticks=[], yticks=[])
    save_figure(figure, path)


def draw_gap(tracks: tr.Tracks, path: Path, point: int = 0) -> None:
    """A point that is hidden for twelve frames, and what is said about it."""
    visible = tracks.visible.clone()
    hidden = slice(24, 36)
    visible[hidden, point] = False
    filled = fill_gaps(tr.Tracks(tracks.xy, visible, fps=tracks.fps))
    value, reach = filled.xy[:, point, 0], 2 * filled.covariance[:, point, 0, 0].sqrt()
    figure, (axis,) = _axes(7, 3)
    axis.fill_between(range(hidden.start, hidden.stop), (value - reach)[hidden], (value + reach)[hidden], alpha=0.25)
    axis.plot(value, color="#0072b2", label="filled, with twice its standard deviation")
    axis.plot(tracks.xy[:, point, 0], ".", color="#d55e00", ms=4, label="measured (frames 24 to 35 were hidden)")
    axis.set(xlabel="frame", ylabel="x, pixels")
    axis.legend(frameon=False)
    save_figure(figure, path)


def draw_scree(tracks: tr.Tracks, path: Path) -> None:
    """Eigenvalues of the tracks and the value that noise alone would reach."""
    estimate = tr.estimate_rank(tracks)
    figure, (axis,) = _axes(7, 3)
    shown = 3 * int(estimate.rank) + 9
    axis.semilogy(range(1, shown + 1), estimate.eigenvalues[:shown], "o", color="#0072b2", label="eigenvalue")
    axis.semilogy(range(1, shown + 1), estimate.threshold[:shown], color="#d55e00", label="limit that it has to exceed")
    axis.axvline(3 * int(estimate.rank) + 0.5, color="0.6", lw=0.8)
    axis.xaxis.get_major_locator().set_params(integer=True)
    axis.set(xlabel="number", ylabel="noise variances", title=f"K = {estimate.rank}: three eigenvalues a basis")
    axis.legend(frameon=False)
    save_figure(figure, path)


def draw_shape(tracks: tr.Tracks, truth: torch.Tensor, path: Path, frame: int = 30) -> str:
    """Front, side and top view of the answer and of the truth; returns the solver's word."""
    rec = tr.reconstruct(tracks)
    if (rec.points3d[..., 2] * truth[..., 2]).sum() < 0:  # parallel views leave the mirror open
        rec = rec.mirrored()
    figure, axes = _axes(9, 3.6, 3)
    reach = 1.1 * float(truth[frame].abs().max())
    for axis, (name, a, b) in zip(axes, (("front", 0, 1), ("side", 2, 1), ("top", 0, 2)), strict=True):
        answer, true = rec.points3d[frame], truth[frame]
        axis.plot(torch.stack([answer[:, a], true[:, a]]), torch.stack([answer[:, b], true[:, b]]), color="0.7", lw=0.8)
        axis.scatter(true[:, a], true[:, b], s=30, facecolors="none", edgecolors="0.4", label="truth")
        axis.scatter(answer[:, a], answer[:, b], s=10, color="#0072b2", label="reconstructed")
        axis.set(title=name, aspect="equal", xlim=(-reach, reach), ylim=(reach, -reach), xticks=[], yticks=[])
        if name == "top":
            axis.invert_yaxis()
    axes[0].legend(frameon=False, fontsize=8, loc="lower left")
    save_figure(figure, path)
    return str(rec.status)


def draw_all(folder: Path, again: bool = False) -> None:
    """All pictures that are not there yet."""
    folder.mkdir(exist_ok=True)
    names = ("tracking.png", "gap.png", "scree.png", "shape.png")
    wanted = [name for name in names if again or not (folder / name).exists()]
    if not wanted:
        return
    clip = make_clip()
    tracks, truth = make_tracks(clip)
    for name in wanted:
        path = folder / name
        if name == "tracking.png":
            draw_tracking(clip, path)
        elif name == "gap.png":
            draw_gap(tracks, path)
        elif name == "scree.png":
            draw_scree(tracks, path)
        else:
            print(draw_shape(tracks, truth, path))


if __name__ == "__main__":
    draw_all(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "pictures", again=True)
