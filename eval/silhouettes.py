"""How well silhouettes are found: from a first-frame mask in colour, and from depth; Fig. 3 as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from eval.contours import draw_outlines, overlap
from torchrecon._typing import Float, Tensor
from torchrecon.contour import follow_silhouette, mask_outline, silhouette_from_box
from torchrecon.data.synthetic import SensorNoise, SyntheticClip, sample_body, sample_motion, static_camera
from torchrecon.depth import bilateral_depth
from torchrecon.io.frames import load_camera, open_depths, open_frames, open_masks
from torchrecon.pipeline.depth import body_depth
from torchrecon.viz.depth import draw_depth


def static_clip(action: str, seed: int, size: tuple[int, int] = (576, 768), frames: int = 60) -> SyntheticClip:
    """A clip of one action before a camera on a tripod, 25 frames per second."""
    generator = torch.Generator().manual_seed(seed)
    body = sample_body(generator)
    motion = sample_motion(action, body, frames=frames, fps=25.0, generator=generator)
    return SyntheticClip(
        body, motion, static_camera(motion, size=size, generator=generator), seed, sensor_noise=SensorNoise()
    )


def _figures(found: list[Tensor], truth: list[Tensor]) -> dict[str, Any]:
    """The first frame is the prompt and is not counted."""
    iou = torch.stack([overlap(a, b) for a, b in zip(found[1:], truth[1:], strict=True)])
    return {"frames": len(truth), "iou": float(iou.mean()), "iou_worst": float(iou.min()), "iou_last": float(iou[-1])}


def _draw(frames: list[Tensor], found: list[Tensor], truth: list[Tensor], path: Path) -> None:
    """Outline that was found (yellow) and the true one (red) in the middle frame."""
    index = len(frames) // 2
    curves = [mask_outline(masks[index], 256) for masks in (found, truth) if masks[index].any()]
    draw_outlines(frames[index], curves, path)


def run_synthetic_silhouette(action: str, seed: int, out: Path) -> dict[str, Any]:
    """A static camera, prompted by the true mask of the first frame."""
    clip = static_clip(action, seed)
    rendered = [clip.render(index) for index in range(len(clip))]
    frames, truth = [f.rgb for f in rendered], [f.mask for f in rendered]
    found = list(follow_silhouette(frames, truth[0]))
    _draw(frames, found, truth, out / f"silhouette_{action}.png")
    return _figures(found, truth)


def run_clip_silhouette(folder: Path, out: Path) -> dict[str, Any]:
    """A real clip with masks, prompted by its first one."""
    frames, truth = list(open_frames(folder / "frames")), list(open_masks(folder / "masks"))
    found = list(follow_silhouette(frames, truth[0]))
    _draw(frames, found, truth, out / f"silhouette_{folder.name}.png")
    return _figures(found, truth)


def run_depth_silhouette(folder: Path, out: Path) -> dict[str, Any]:
    """A real clip with depth, no prompt: filter (13), back-project (12), range box (17)."""
    intrinsics = load_camera(folder / "cameras.json").intrinsics.float()
    depths, truth = list(open_depths(folder / "depth")), list(open_masks(folder / "masks"))
    bodies = [body_depth(depth, None, intrinsics) for depth in depths]
    iou = torch.stack([overlap(b.body, t) for b, t in zip(bodies, truth, strict=True)])
    middle = len(depths) // 2
    draw_depth(depths[middle], bodies[middle].depth, bodies[middle].body, out / f"depth_{folder.name}.png")
    return {"frames": len(truth), "iou": float(iou.mean()), "iou_worst": float(iou.min())}


def run_depth_figure(seed: int, out: Path) -> dict[str, Any]:
    """Fig. 3: the deepest squat of a jump, depth before and after the filter, and the body cut out of it."""
    clip = static_clip("jump", seed)
    index = int(clip.motion.joints[:, 0, 1].argmin())
    noisy = clip.render(index)
    clean = SyntheticClip(clip.body, clip.motion, clip.camera, seed).render(index).depth
    filtered = bilateral_depth(noisy.depth)
    # the floor touches the feet, so the range box needs a silhouette, here from a box prompt
    v, u = noisy.mask.nonzero(as_tuple=True)
    box = (int(u.amin()) - 8, int(v.amin()) - 8, int(u.amax()) + 8, int(v.amax()) + 8)
    mask = silhouette_from_box(noisy.rgb, box)
    body = body_depth(noisy.depth, mask, clip.camera.intrinsics.float()).body
    draw_depth(noisy.depth, filtered, body, out / "fig3_squat.png")
    peak = float(clean[noisy.mask].max() - clean[noisy.mask].min())

    def psnr(depth: Float[Tensor, "height width"]) -> float:
        error = (depth - clean)[noisy.mask & torch.isfinite(depth)]
        return float(10 * torch.log10(peak**2 / error.square().mean()))

    return {
        "frame": index,
        "psnr_before_db": psnr(noisy.depth),
        "psnr_after_db": psnr(filtered),
        "box_prompt_iou": float(overlap(mask, noisy.mask)),
        "body_iou": float(overlap(body, noisy.mask)),
    }
