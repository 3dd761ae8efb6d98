"""The learned prior of human shape: what joints in the image say of their depth, to somebody who has seen people move.

Where the view does not turn, geometry is silent about depth and this prior is all there is. It knows joints by name
(:mod:`torchrecon.models.joints`), not points in general.
"""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.linalg import interpolated, rotation_from_vector
from torchrecon.measurement import ShapeBelief, Tracks
from torchrecon.measurement.camera import normalised_coordinates
from torchrecon.models.joints import JOINTS, PARENTS, match_joints
from torchrecon.models.lifting import Lifting, centre_and_size

__all__ = ["HumanPrior", "load_prior", "save_prior"]

RATE = 15.0
"""Frames per second that the network sees."""
WINDOW, STRIDE = 32, 8
"""Frames that it sees at once, and by which its windows are apart."""


class HumanPrior(nn.Module):
    """Tracks with named joints to a Gaussian over their places in 3D.

    Args:
        width, dilations: of the network (:class:`torchrecon.models.lifting.Lifting`).
        source: what it was trained on.

    Attributes:
        bones: sum of the bone lengths of an average person, metres; it fixes the scale where there are intrinsics.
        widen: factors on the standard deviations across the image and along depth, from subjects held out in training.

    Example:
        >>> names = [f"{side}_{joint}" for side in "lr" for joint in ("shoulder", "elbow", "wrist", "hip", "knee")]
        >>> belief = HumanPrior(16, (0, 1))(Tracks(100 * torch.rand(20, 10, 2), names=names))
        >>> belief.points3d.shape
        torch.Size([20, 10, 3])
    """

    bones: Tensor
    widen: Tensor

    def __init__(
        self, width: int = 192, dilations: tuple[int, ...] = (0, 1, 2, 4, 8), source: str = "untrained"
    ) -> None:
        super().__init__()
        self.network = Lifting(width, dilations)
        self.source = source
        self.register_buffer("bones", torch.tensor(4.0))
        self.register_buffer("widen", torch.ones(2))

    @torch.no_grad()
    def forward(self, tracks: Tracks) -> ShapeBelief:
        """What the prior believes of one sequence.

        Args:
            tracks: no batch dimension; ``names`` decide which points are joints.

        Raises:
            ReconError: a batch, or too few named joints (:func:`torchrecon.models.joints.match_joints`).
        """
        if tracks.batch_shape:
            raise ReconError(f"tracks: batch {tuple(tracks.batch_shape)}; a prior is asked about one sequence")
        where = match_joints(tracks.names)
        points = [point for point, joint in enumerate(where) if joint is not None]
        joints = [joint for joint in where if joint is not None]
        inner = self.bones.dtype
        xy = tracks.filled_xy().to(self.bones.device, inner)
        visible = tracks.visible.to(xy.device)
        turn = torch.eye(3, dtype=inner, device=xy.device).expand(len(xy), 3, 3)
        if tracks.intrinsics is not None:
            xy = normalised_coordinates(xy, tracks.intrinsics.to(xy))
            # As a camera would see it that looks straight at the person: what the network was trained on.
            turn = _towards(xy[:, points], visible[:, points])
            xy = _turned(xy, turn)
        placed = xy.new_zeros(len(xy), len(JOINTS), 2)
        seen = torch.zeros(placed.shape[:2], dtype=torch.bool, device=xy.device)
        placed[:, joints], seen[:, joints] = xy[:, points], visible[:, points]
        mean, deviation = self._lift(placed, seen, tracks.times.to(xy))
        shape, spread = _all_points(mean, deviation, xy, visible, where)
        if tracks.intrinsics is None:
            translation = shape.mean(1)
            covariance = torch.diag_embed(spread.square())
        else:
            parents = torch.tensor(PARENTS[1:], device=xy.device)
            length = (mean[:, 1:] - mean[:, parents]).norm(dim=-1).sum(-1)
            metres = (self.bones / length)[:, None, None]
            # On the ray where it is measured; depth counts from the pelvis, whose own depth is ``metres``.
            ahead = 1 + shape[..., 2:] - mean[:, :1, 2:]
            ray = torch.where(visible[..., None], xy * ahead, shape[..., :2])
            shape = metres * torch.cat([ray, ahead], -1) @ turn
            across = torch.where(visible, xy.new_zeros(()), spread[..., 0])
            slope = torch.where(visible[..., None], xy, xy.new_zeros(()))
            along = torch.cat([slope, torch.ones_like(slope[..., :1])], -1) * spread[..., 2:]
            covariance = along[..., :, None] * along[..., None, :]
            covariance = covariance + torch.diag_embed(torch.stack([across, across, 0 * across], -1).square())
            covariance = turn.mT[:, None] @ (metres[..., None].square() * covariance) @ turn[:, None]
            translation = shape.mean(1)
        device, dtype = tracks.xy.device, tracks.xy.dtype
        return ShapeBelief(
            (shape - shape.mean(1, keepdim=True)).to(device, dtype),
            covariance.to(device, dtype),
            translation[:, : 2 if tracks.intrinsics is None else 3].to(device, dtype),
            torch.tensor([joint is not None for joint in where], device=device),
            self.source,
        )

    def _lift(
        self, xy: Float[Tensor, "frames joints 2"], seen: Bool[Tensor, "frames joints"], times: Tensor
    ) -> tuple[Float[Tensor, "frames joints 3"], Float[Tensor, "frames joints 2"]]:
        """The network's answers at the times of the tracks, in the unit of ``xy``: windows that overlap are averaged,
        each with most weight in its middle."""
        count = int(torch.ceil((times[-1] - times[0]) * RATE)) + 1
        grid = times[0] + torch.arange(count, dtype=times.dtype, device=times.device) / RATE
        before, share = _between(times, grid)
        after = (before + 1).clamp_max(len(times) - 1)
        at = xy[before] + share[:, None, None] * (xy[after] - xy[before])
        there = (seen[before] | (share == 1)[:, None]) & (seen[after] | (share == 0)[:, None])
        centre = _bridged(centre_and_size(at, there)[0], there.any(-1))
        starts = torch.arange(0, max(1, count - WINDOW + STRIDE), STRIDE, device=xy.device)
        frame = (starts[:, None] + torch.arange(WINDOW, device=xy.device)).clamp_max(count - 1)
        window, shown = at[frame], there[frame]
        _, size = centre_and_size(window, shown)
        mean, deviation = self.network.both_sides((window - centre[frame]) / size, shown)
        mean = mean * size + torch.nn.functional.pad(centre[frame], (0, 1))
        deviation = deviation * size * self.widen
        weight = torch.arange(1, WINDOW + 1, device=xy.device)
        weight = torch.minimum(weight, weight.flip(0)).to(xy.dtype).expand(frame.shape)
        total = xy.new_zeros(count).index_add(0, frame.flatten(), weight.flatten())[:, None, None]
        blended = []
        for value in (mean, deviation):
            sums = value.new_zeros(count, *value.shape[2:])
            weighted = (weight[..., None, None] * value).flatten(0, 1)
            blended.append(sums.index_add(0, frame.flatten(), weighted) / total)
        before, share = _between(grid, times)
        after = (before + 1).clamp_max(count - 1)
        mean, deviation, passed = (v[before] + share[:, None, None] * (v[after] - v[before]) for v in (*blended, at))
        # What a measured entry does between two times of the grid is kept.
        kept = seen & there[before] & there[after]
        mean[..., :2] += torch.where(kept[..., None], xy - passed, xy.new_zeros(()))
        return mean, deviation


def _between(times: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """For each wanted time the last index at or before it, and how far it lies on the way to the next, 0 to 1."""
    before = (torch.searchsorted(times, wanted, right=True) - 1).clamp(0, max(0, len(times) - 2))
    after = (before + 1).clamp_max(len(times) - 1)
    step = (times[after] - times[before]).clamp_min(torch.finfo(times.dtype).tiny)
    share = ((wanted - times[before]) / step).clamp(0, 1)
    near = share.round()
    # Times that agree but for rounding are the same: an entry that is measured must not be taken for one between two.
    return before, torch.where((share - near).abs() < 1e-3, near, share)


def _bridged(centre: Float[Tensor, "frames 1 2"], seen: Bool[Tensor, " frames"]) -> Float[Tensor, "frames 1 2"]:
    """Centres with those of frames that show nothing on a straight line between their neighbours."""
    if not bool(seen.any()):
        raise ReconError("tracks: no joint that the prior knows is seen in two frames in a row; nothing can be said")
    return interpolated(centre, seen)


def _towards(xy: Float[Tensor, "frames joints 2"], seen: Bool[Tensor, "frames joints"]) -> Float[Tensor, "frames 3 3"]:
    """Rotations that bring the middle of what each frame shows onto the optical axis; a frame without any takes that
    of all."""
    weight = seen[..., None].to(xy.dtype)
    total = (xy * weight).sum((0, 1)) / weight.sum((0, 1)).clamp_min(1)
    count = weight.sum(1)
    middle = torch.where(count > 0, (xy * weight).sum(1) / count.clamp_min(1), total)
    ray = torch.nn.functional.normalize(torch.cat([middle, torch.ones_like(middle[:, :1])], -1), dim=-1)
    axis = torch.stack([ray[:, 1], -ray[:, 0], torch.zeros_like(ray[:, 0])], -1)
    sine = axis.norm(dim=-1, keepdim=True)
    angle = torch.atan2(sine, ray[:, 2:])
    return rotation_from_vector(axis * angle / sine.clamp_min(torch.finfo(xy.dtype).tiny))


def _turned(
    xy: Float[Tensor, "frames points 2"], turn: Float[Tensor, "frames 3 3"]
) -> Float[Tensor, "frames points 2"]:
    """Image-plane positions as a turned camera would see them."""
    ray = torch.cat([xy, torch.ones_like(xy[..., :1])], -1) @ turn.mT
    return ray[..., :2] / ray[..., 2:]


def _all_points(
    mean: Float[Tensor, "frames joints 3"],
    deviation: Float[Tensor, "frames joints 2"],
    xy: Float[Tensor, "frames points 2"],
    visible: Bool[Tensor, "frames points"],
    where: tuple[int | None, ...],
) -> tuple[Float[Tensor, "frames points 3"], Float[Tensor, "frames points 3"]]:
    """Mean and deviation of every point; one that is no joint has the depth of the joint nearest to it in the image.

    A point that stands away from its joint by r in the image does so, on average over directions, by r / sqrt(2) in
    depth: that is what its depth is uncertain by, beside the joint's own. Where it is not seen it is at its joint.
    """
    points, spreads = [], []
    for point, joint in enumerate(where):
        if joint is None:
            seen = visible[:, point, None]
            apart = (mean[..., :2] - xy[:, point, None]).square().sum(-1)
            apart = torch.where(seen, apart, apart.new_zeros(())).sum(0) / seen.sum().clamp_min(1)
            joint = int(apart.argmin())
            place = torch.where(seen, xy[:, point], mean[:, joint, :2])
            across = torch.where(
                visible[:, point], apart.new_zeros(()), (deviation[:, joint, 0].square() + apart[joint]).sqrt()
            )
            depth = (deviation[:, joint, 1].square() + apart[joint] / 2).sqrt()
            points.append(torch.cat([place, mean[:, joint, 2:]], -1))
        else:
            across, depth = deviation[:, joint].unbind(-1)
            points.append(mean[:, joint])
        spreads.append(torch.stack([across, across, depth], -1))
    return torch.stack(points, 1), torch.stack(spreads, 1)


def save_prior(prior: HumanPrior, path: str | os.PathLike[str], report: dict[str, Any] | None = None) -> Path:
    """Write weights and settings to ``path`` (.safetensors) and, beside it, what is known of them as JSON.

    Both files appear whole or not at all; :func:`load_prior` needs the weights file alone.

    Raises:
        ReconError: the folder does not exist or the suffix is not ``.safetensors``.
    """
    target = Path(path)
    if target.suffix != ".safetensors" or not target.parent.is_dir():
        raise ReconError(f"{target}: needs an existing folder and a name that ends in .safetensors")
    weights = {name: value.detach().cpu().contiguous() for name, value in prior.state_dict().items()}
    settings = {"width": prior.network.width, "dilations": list(prior.network.dilations), "source": prior.source}
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as folder:
        save_file(weights, Path(folder, "weights"), {"prior": json.dumps({**settings, "joints": JOINTS})})
        Path(folder, "report").write_text(json.dumps({**settings, **(report or {})}, indent=2) + "\n")
        os.replace(Path(folder, "report"), target.with_suffix(".json"))
        os.replace(Path(folder, "weights"), target)
    return target


def load_prior(path: str | os.PathLike[str]) -> HumanPrior:
    """The prior that :func:`save_prior` wrote, in evaluation mode.

    Raises:
        ReconError: the file does not exist or is no prior of this version.
    """
    source = Path(path)
    if not source.is_file():
        raise ReconError(f"{source}: no such file; `python -m train.prior` makes one")
    try:
        with safe_open(source, framework="pt") as archive:
            settings = json.loads((archive.metadata() or {})["prior"])
            weights = {name: archive.get_tensor(name) for name in archive.keys()}  # noqa: SIM118
        if tuple(settings["joints"]) != JOINTS:
            raise KeyError("other joints")
        prior = HumanPrior(int(settings["width"]), tuple(settings["dilations"]), str(settings["source"]))
        prior.load_state_dict(weights)
    except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ReconError(f"{source}: is no shape prior of this version ({error}); train it again") from error
    return prior.eval()
