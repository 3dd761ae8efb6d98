"""True rotations: what is left to gain from better rotations of the camera.

The rotations are those of the film; the translation is that of the rigid body which fits the tracks best under them,
and the points are the posterior mean of the default's Gaussian-process trajectories, kernels learned as there.
Rest positions are spread alike in all directions: the turn is known, so no candidate has to be charged for it.
Not a bound: the translation is not refined, and a body that turns by itself may be described better by another path.
"""

from __future__ import annotations

import math

import torch

from eval.rows.base import Context, RowOutput, without_depth
from torchrecon.errors import ReconError
from torchrecon.measurement import Tracks
from torchrecon.nrsfm.likelihood import CameraPath, MotionPrior, learn_kernels, matern32, pack, posterior_points
from torchrecon.nrsfm.observations import Observations, observe
from torchrecon.nrsfm.trajectory import TrajectoryParams, thinning
from torchrecon.nrsfm.turning import rigid_under

__all__ = ["solve_true_rotations"]


def _prior(data: Observations, params: TrajectoryParams) -> MotionPrior:
    """Isotropic rest positions of the size that the image shows, and one kernel per class."""
    xy = torch.where(data.visible[..., None], data.xy, torch.nan)
    size = (xy - xy.nanmean(1, keepdim=True)).square()[data.visible].mean()
    times = data.tracks.times
    eye = torch.eye(len(times), dtype=times.dtype)
    base = matern32(times, params.memory)
    kernels = torch.stack([size * (variance * base + params.floor * eye) for variance in params.variances])
    share = kernels.new_full((len(params.variances),), -math.log(len(params.variances)))
    return MotionPrior(size * torch.eye(3, dtype=size.dtype), kernels, share)


def solve_true_rotations(tracks: Tracks, context: Context) -> RowOutput:
    """The row, for pinhole tracks.

    Raises:
        ReconError: the context has no true rotations, or the tracks no intrinsics.
    """
    if context.rotations is None or tracks.intrinsics is None:
        raise ReconError("true rotations: need context.rotations and the intrinsics of the tracks")
    params = TrajectoryParams()
    data = observe(without_depth(tracks))
    turn = context.rotations.to(data.xy)
    turn = turn @ turn[len(turn) // 2].mT
    rigid = rigid_under(data.offset + data.unit * data.xy, data.visible, turn, params.turn)
    # The body is at distance one in units of the rigid fit, and at 1 / unit in those of the likelihood.
    shift = rigid.translation[:, :2] / rigid.translation[:, 2:] / data.unit
    path = CameraPath(turn, shift, torch.zeros_like(data.tracks.times))
    noise = params.inflation if data.noise_known else params.default_noise
    with torch.no_grad():
        thin, prior = pack(data, thinning(data, params)), _prior(data, params)
        rounds = ((params.kernel_weight, params.kernel_iterations), (params.last_weight, params.last_iterations))
        for weight, iterations in rounds:
            prior = learn_kernels(thin, path, prior, noise, weight=weight, iterations=iterations)
        canonical, _, _ = posterior_points(pack(data), path, prior, noise)
    return RowOutput(canonical @ turn.mT, tracks.visible, "true rotations")
