"""The depth stages off in turn, before a sensor: bilateral filter, range box, contour of the body.

One film per action with a static camera; the tracks are the same in every variant, only the depth under them changes.
``error3d_camera`` is that of the default, no scale fitted, at seen entries on the body; the depth error is taken
where a variant says that it measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchrecon as tr
from eval.job import Cache, Profile, read_arrays, run_parallel, write_arrays
from eval.sequences import Filmed, Filming, film, make_clip
from eval.sequences import Sequence as Film
from torchrecon._typing import Bool, Float, Tensor
from torchrecon.depth import auto_box, backproject, bilateral_depth, range_box
from torchrecon.errors import ReconError
from torchrecon.metrics import error3d_camera
from torchrecon.pipeline.depth import with_depth

__all__ = ["VARIANTS", "Variant", "body_of", "depth_lines", "measure_depth"]


@dataclass(frozen=True)
class Variant:
    """Which stages are on."""

    key: str
    label: str
    smooth: bool = True
    box: bool = True
    contour: bool = True


VARIANTS = (
    Variant("whole", "filter, range box and contour"),
    Variant("no-filter", "bilateral filter off", smooth=False),
    Variant("no-box", "range box off", box=False),
    Variant("no-contour", "contour off: the box finds the body", contour=False),
    Variant("raw", "all three off", smooth=False, box=False, contour=False),
)


def body_of(
    depth: Float[Tensor, "height width"],
    mask: Bool[Tensor, "height width"],
    intrinsics: Float[Tensor, "3 3"],
    variant: Variant,
) -> Float[Tensor, "height width"]:
    """Depth of the body by the stages that a variant has on; NaN elsewhere."""
    found = bilateral_depth(depth) if variant.smooth else torch.where(torch.isfinite(depth), depth, depth.new_zeros(()))
    kept = found > 0
    contour = mask if variant.contour else None
    if variant.box and bool((kept if contour is None else kept & contour).any()):
        cloud = backproject(found[None, None], intrinsics[None].to(found))[0]
        kept = kept & range_box(cloud.permute(1, 2, 0), *auto_box(cloud, contour))
    if contour is not None:
        kept = kept & contour
    return torch.where(kept, found, torch.nan)


def _solve(work: tuple[Film, Filming, str]) -> None:
    """Film, track and solve one sequence under every variant."""
    sequence, filming, path = work
    filmed = film(sequence, filming, Profile())
    clip = make_clip(sequence, filming)
    frames = [clip.render(index) for index in range(sequence.frames)]
    intrinsics = clip.camera.intrinsics
    bare = replace(filmed.tracks, depth=None, depth_variance=None)
    arrays: dict[str, Any] = {}
    for variant in VARIANTS:
        depths = (body_of(frame.depth, frame.mask, intrinsics, variant) for frame in frames)
        tracks = with_depth(bare, depths, intrinsics)
        arrays[f"{variant.key} depth"] = tracks.depth
        try:
            answer = tr.reconstruct(
                tracks.to(dtype=torch.float64), generator=torch.Generator().manual_seed(sequence.seed % 1000)
            )
        except ReconError as error:
            arrays[f"{variant.key} note"] = np.asarray(str(error))
        else:
            arrays[variant.key] = answer.points3d
    write_arrays(path, {**arrays, **_truth(filmed)})


def _truth(filmed: Filmed) -> dict[str, Tensor]:
    return {"truth": torch.nan_to_num(filmed.truth), "scored": filmed.tracks.visible & filmed.known}


def measure_depth(sequences: Sequence[Film], filming: Filming, cache: Cache, workers: int) -> dict[str, Any]:
    """Solve what is not cached, then score the cache.

    Returns:
        ``variants``: each with ``error3d_camera`` (mean over films; None where an answer is missing), ``depth_rms_mm``
        and ``depth_median_mm`` of the sampled depth, ``measured_percent`` of the scored entries, and ``notes``.
    """
    place: dict[Film, Path] = {item: cache.path("depth", f"{item.name}.npz") for item in sequences}
    todo = [(item, filming, str(path)) for item, path in place.items() if not path.is_file()]
    for _ in run_parallel(_solve, todo, workers, "films with depth", name=lambda work: work[0].name):
        pass
    loaded = {item.name: read_arrays(path) for item, path in place.items()}
    rows = []
    for variant in VARIANTS:
        errors, off, entries, notes = [], [], 0, {}
        for name, arrays in loaded.items():
            truth, scored = torch.from_numpy(arrays["truth"]), torch.from_numpy(arrays["scored"])
            depth = torch.from_numpy(arrays[f"{variant.key} depth"])
            measured = scored & torch.isfinite(depth)
            off.append((depth - truth[..., 2])[measured])
            entries += int(scored.sum())
            if variant.key in arrays:
                points = torch.from_numpy(arrays[variant.key]).to(truth)
                errors.append(float(error3d_camera(torch.nan_to_num(points), truth, scored)))
            else:
                notes[name] = str(arrays[f"{variant.key} note"])
        all_off = 1000 * torch.cat(off).double()
        rows.append({
            "key": variant.key,
            "label": variant.label,
            "error3d_camera": sum(errors) / len(errors) if not notes else None,
            "depth_rms_mm": float(all_off.square().mean().sqrt()),
            "depth_median_mm": float(all_off.abs().median()),
            "measured_percent": 100 * len(all_off) / entries,
            "notes": notes,
        })  # fmt: skip
    return {"films": list(loaded), "variants": rows}


def depth_lines(found: Mapping[str, Any]) -> list[str]:
    """The result as text."""
    lines = [
        f"static camera with depth sensor, {len(found['films'])} films",
        f"{'':<40}{'error3d_camera':>16}{'depth rms':>12}{'median':>10}{'measured':>10}",
    ]
    for row in found["variants"]:
        error = "-" if row["error3d_camera"] is None else f"{row['error3d_camera']:.4f}"
        lines.append(
            f"{row['label']:<40}{error:>16}{row['depth_rms_mm']:>9.1f} mm{row['depth_median_mm']:>7.1f} mm"
            f"{row['measured_percent']:>8.1f} %"
        )
        lines += [f"    no answer, {name}: {note}" for name, note in row["notes"].items()]
    return lines
