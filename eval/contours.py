"""How much of the damage in silhouettes the kernel dynamical model undoes, on clips of the synthetic world."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from torchrecon._typing import Bool, Float, Int, Tensor
from torchrecon.contour import mask_outline, repair_silhouettes
from torchrecon.data.synthetic import SyntheticClip, sample_body, sample_motion, static_camera, turning_camera

DROPPED, HOLES, LEAKS = 0.2, 0.15, 0.15  # shares of the frames
RADIUS = (0.08, 0.20)  # of the discs cut out or added, share of the body's height
SAMPLES = 256


def corrupt(
    masks: Bool[Tensor, "frames height width"], generator: torch.Generator
) -> tuple[Bool[Tensor, "frames height width"], Int[Tensor, " frames"]]:
    """Silhouettes with dropped frames (kind 1), discs cut out (2) and added (3) at random places of their outlines.

    Returns:
        the masks, and the kind of damage per frame (0: none).
    """
    outline = mask_outline(masks, SAMPLES)
    height = outline[..., 1].amax(1) - outline[..., 1].amin(1)
    v, u = torch.meshgrid(torch.arange(masks.shape[1]), torch.arange(masks.shape[2]), indexing="ij")
    pixels = torch.stack([u, v], -1)
    bounds = torch.tensor([DROPPED, DROPPED + HOLES, DROPPED + HOLES + LEAKS])
    bad, kinds = masks.clone(), torch.zeros(len(masks), dtype=torch.long)
    for t in range(len(masks)):
        kind = int(torch.bucketize(torch.rand((), generator=generator), bounds, right=True)) + 1
        kinds[t] = kind % 4
        place = outline[t, int(torch.randint(SAMPLES, (), generator=generator))]
        share = RADIUS[0] + (RADIUS[1] - RADIUS[0]) * torch.rand((), generator=generator)
        disc = (pixels - place).norm(dim=-1) < share * height[t]
        if kind == 1:
            bad[t] = False
        elif kind == 2:
            bad[t] &= ~disc
        elif kind == 3:
            bad[t] |= disc
    return bad, kinds


def hold_last(masks: Bool[Tensor, "frames height width"]) -> Bool[Tensor, "frames height width"]:
    """Dropped frames filled with the last silhouette (the first ones with the next)."""
    given = masks.flatten(1).any(1)
    order = torch.arange(len(masks))
    last = torch.where(given, order, -1).cummax(0).values
    return masks[torch.where(last >= 0, last, order[given].amin())]


def contour_error(
    masks: Bool[Tensor, "frames height width"], truth: Bool[Tensor, "frames height width"]
) -> Float[Tensor, " frames"]:
    """Mean distance between two outlines, pixels: from each to the nearest point of the other, both ways."""
    distance = torch.cdist(mask_outline(masks, SAMPLES), mask_outline(truth, SAMPLES))
    return (distance.amin(-1).mean(-1) + distance.amin(-2).mean(-1)) / 2


def overlap(a: Bool[Tensor, "*b height width"], b: Bool[Tensor, "*b height width"]) -> Float[Tensor, "*b"]:
    """Intersection over union; 1 where both are empty."""
    union = (a | b).sum((-2, -1))
    return torch.where(union > 0, (a & b).sum((-2, -1)) / union.clamp_min(1), 1.0)


def run_repair(action: str, view: str, seed: int, out: Path) -> dict[str, Any]:
    """Figures of one clip of 60 frames, 384 x 288 at 25 per second: contour error and overlap before and after."""
    generator = torch.Generator().manual_seed(seed)
    body = sample_body(generator)
    motion = sample_motion(action, body, frames=60, fps=25.0, generator=generator)
    make = turning_camera if view == "turning" else static_camera
    clip = SyntheticClip(body, motion, make(motion, size=(288, 384), generator=generator), seed=seed)
    rendered = [clip.render(index) for index in range(len(clip))]
    truth = torch.stack([frame.mask for frame in rendered])
    bad, kinds = corrupt(truth, torch.Generator().manual_seed(seed))
    before, after = hold_last(bad), repair_silhouettes(bad).masks
    errors = {"corrupted": contour_error(before, truth), "repaired": contour_error(after, truth)}
    figures: dict[str, Any] = {f"{name}_px": float(error.mean()) for name, error in errors.items()}
    figures["lowered_by"] = 1 - figures["repaired_px"] / figures["corrupted_px"]
    for kind, name in enumerate(("clean", "dropped", "holes", "leaks")):
        if (kinds == kind).any():
            figures[f"{name}_px"] = [float(error[kinds == kind].mean()) for error in errors.values()]
    figures["iou"] = [float(overlap(masks, truth).mean()) for masks in (before, after)]
    worst = int(errors["corrupted"].argmax())
    curves = [mask_outline(masks[worst], SAMPLES) for masks in (after, before)]
    draw_outlines(rendered[worst].rgb, curves, out / f"repair_{action}_{view}.png")
    return figures


def draw_outlines(
    frame: Float[Tensor, "3 height width"], outlines: Sequence[Float[Tensor, "samples 2"]], path: Path
) -> None:
    """Closed curves on a frame: the first in yellow, further ones in red."""
    from matplotlib.figure import Figure

    height, width = frame.shape[-2:]
    figure = Figure(figsize=(width / 100, height / 100), dpi=100)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(frame.permute(1, 2, 0).numpy())
    for index, curve in enumerate(outlines):
        closed = torch.cat([curve, curve[:1]])
        axes.plot(closed[:, 0], closed[:, 1], color="yellow" if index == 0 else "red", linewidth=1.0)
        axes.plot(*curve[0], "o", color="cyan", markersize=4)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.axis("off")
    figure.savefig(path)
