"""K on real motion, where none is true: what held-out joints say, and the deformation degree of each action.

Motion capture is seen by a camera that turns about it, with noise. K is estimated from the whole tracks; entries are
then hidden, and factors of rank 3K are fitted to the rest for every K: the K that predicts the hidden ones best is
compared with the estimate, which has not seen that any are hidden.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from eval.job import run_parallel
from torchrecon._typing import Float, Tensor
from torchrecon.data.mocap import MocapClip, load_mocap
from torchrecon.errors import ReconError
from torchrecon.linalg import rotation_from_vector
from torchrecon.measurement import Tracks
from torchrecon.rank import CrossValidationParams, cross_validate, estimate_rank

__all__ = ["draw_heldout", "measure_heldout"]

ACTIONS = ("walk", "run", "jump", "shoot", "dribble")
_HEIGHT = 190.0  # pixels: median extent of the body in the image
_RESAMPLES = 2000


@dataclass(frozen=True, eq=False)
class Clip2D:
    """One clip as it is seen.

    Attributes:
        name, action: of the clip.
        xy: (frames, joints, 2) pixels, without noise.
        noise: standard deviation, pixels.
        seed: of noise and hidden entries.
        hidden: whether entries are hidden and predicted, or K is only estimated.
    """

    name: str
    action: str
    xy: Float[Tensor, "frames joints 2"]
    noise: float
    seed: int
    hidden: bool

    def __str__(self) -> str:
        return self.name


def turned_view(joints: Float[Tensor, "frames joints 3"], turn: float, start: float) -> Tensor:
    """Orthographic image from a level camera that turns by ``turn`` about the body (y up); radians, pixels."""
    angle = start + turn * torch.linspace(0, 1, len(joints), dtype=joints.dtype)
    vertical = joints.new_tensor([0.0, 1.0, 0.0])
    centred = joints - joints.mean(1, keepdim=True)
    seen = centred @ rotation_from_vector(angle[:, None] * vertical).mT * joints.new_tensor([1.0, -1.0, 1.0])
    height = seen[..., 1].amax(1) - seen[..., 1].amin(1)
    return seen[..., :2] * (_HEIGHT / height.median())


def run_clip(clip: Clip2D) -> dict[str, Any]:
    """The estimate, and the error of prediction at every K."""
    g = torch.Generator().manual_seed(clip.seed)
    xy = clip.xy + clip.noise * torch.randn(clip.xy.shape, generator=g, dtype=clip.xy.dtype)
    estimate = estimate_rank(Tracks(xy), generator=torch.Generator().manual_seed(clip.seed))
    low, high = estimate.interval
    record = {
        "name": clip.name,
        "action": clip.action,
        "frames": len(xy),
        "rank": int(estimate.rank),
        "degree": float(estimate.deformation_degree),
        "interval": [int(low), int(high)],
    }
    if clip.hidden:
        most = (xy.shape[1] - 1) // 3
        params = CrossValidationParams(patience=most)
        found = cross_validate(xy, torch.ones(xy.shape[:2], dtype=torch.bool), most, g, params)
        record["errors"] = list(found.errors)
        record["best"] = 1 + min(range(len(found.errors)), key=found.errors.__getitem__)
    return record


def bootstrap_mean(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean with its 95 % percentile interval over resampled clips.

    Example:
        >>> mean, low, high = bootstrap_mean([1.0, 2.0, 3.0, 4.0])
        >>> mean, low < 2.5 < high
        (2.5, True)
    """
    x = torch.tensor(values, dtype=torch.float64)
    index = torch.randint(len(x), (_RESAMPLES, len(x)), generator=torch.Generator().manual_seed(0))
    low, high = x[index].mean(1).quantile(torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    return float(x.mean()), low, high


def _lines(records: list[dict[str, Any]]) -> list[str]:
    judged = [r for r in records if "best" in r]
    near = 100 * sum(abs(r["rank"] - r["best"]) <= 1 for r in judged) / len(judged)
    lines = [
        f"Held-out joints of {len(judged)} clips: the estimate within one of the K that predicts best in {near:.0f} % "
        f"({'hit' if near >= 90 else 'MISSED'}, 90); estimate minus best: "
        + ", ".join(
            f"{d:+d}: {sum(r['rank'] - r['best'] == d for r in judged)}"
            for d in sorted({r["rank"] - r["best"] for r in judged})
        )
    ]
    loss = [r["errors"][min(r["rank"], len(r["errors"])) - 1] / min(r["errors"]) for r in judged]
    lines.append(
        f"  error at the estimate over the least error: mean {sum(loss) / len(loss):.2f}, worst {max(loss):.2f}"
    )
    lines.append("Deformation degree by action, mean over clips with 95 % interval of the mean:")
    for action in ACTIONS:
        of = [r["degree"] for r in records if r["action"] == action]
        if of:
            mean, low, high = bootstrap_mean(of)
            lines.append(f"  {action:<8} {mean:.2f} ({low:.2f} to {high:.2f}), {len(of)} clips")
    return lines


def draw_heldout(records: Sequence[Mapping[str, Any]], ax: Any) -> None:
    """Prediction error against K minus the estimate, relative to the error at the estimate."""
    offsets: dict[int, list[float]] = {}
    for r in records:
        for k, error in enumerate(r.get("errors", ()), 1):
            at = r["errors"][min(r["rank"], len(r["errors"])) - 1]
            offsets.setdefault(k - r["rank"], []).append(error / at)
    places = sorted(offsets)
    quantiles = [torch.tensor(offsets[d]).quantile(torch.tensor([0.25, 0.5, 0.75])).tolist() for d in places]
    ax.fill_between(places, [q[0] for q in quantiles], [q[2] for q in quantiles], alpha=0.2)
    ax.plot(places, [q[1] for q in quantiles], "o-")
    ax.axvline(0, color="0.7", lw=1)
    ax.set(xlabel="K minus the estimate", ylabel="error of hidden joints over that at the estimate", yscale="log")


def _clips(path: Path, part: Mapping[str, Any]) -> list[MocapClip]:
    """Optical clips of the actions that are long enough (limbs of Kinect clips change their length)."""
    found = [
        clip for clip in load_mocap(path, ACTIONS) if clip.quality.startswith("optical") and len(clip) >= part["frames"]
    ]
    if not found:
        raise ReconError(f"{path}: holds no optical clip of {part['frames']} frames of {', '.join(ACTIONS)}")
    return found


def measure_heldout(
    config: Mapping[str, Any], data: Path | None, workers: int
) -> tuple[dict[str, Any], list[str]]:  # fmt: skip
    """All records and the text about them.

    Raises:
        ReconError: no data folder, or nothing in it to measure.
    """
    if data is None:
        raise ReconError("heldout: needs real motion; give --data DIR with mocap/dev.npz in it")
    part = config["heldout"]
    clips = _clips(data / "mocap" / "dev.npz", part)
    every = max(1, len(clips) // part["clips"])
    items = []
    for index, clip in enumerate(clips):
        # one length for all, from the middle, so that degrees can be compared
        first = (len(clip) - part["frames"]) // 2
        joints = clip.joints[first : first + part["frames"]].double()
        start = 2 * math.pi * float(torch.rand((), generator=torch.Generator().manual_seed(index)))
        xy = turned_view(joints, math.radians(part["turn"]), start)
        name = f"{clip.source} {clip.subject} {clip.trial}"
        items.append(Clip2D(name, clip.label, xy, part["noise"], 30_000_000 + index, index % every == 0))
    items.sort(key=lambda item: not item.hidden)
    records = [found for _, found in run_parallel(run_clip, items, workers, "held out")]
    records.sort(key=lambda r: r["name"])
    return {"records": records}, _lines(records)
