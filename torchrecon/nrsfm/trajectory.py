"""Tracks that are born and die: a turning view and Gaussian-process trajectories, fitted by maximum likelihood.

What is sought is the camera path alone; the points are integrated out (see ``likelihood``). Candidates are the turns of
a rigid body, found in the robust, smooth way of ``turning``: the trunk decides them. Rotations refined under the
trajectory likelihood raise it and the error together (the points are independent there, so limbs that swing together
are explained by a turn), so only the translation is. Rest positions are spread about the turning axis as the image
shows them: an isotropic prior would charge every point for a depth extent that the body does not have, and so favour
too slow a turn. Under each candidate the kernels are learned from the tracks, and the likeliest wins; the points are
then the posterior mean. With intrinsics the likelihood and the rigid fit together tell the two mirror images apart;
without, the documented rule picks one. Assumption to keep in mind: the view turns about one axis, at a rate that
changes slowly.
Derived here; not a published method.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.linalg import interpolated
from torchrecon.measurement import Reconstruction, Status, Tracks
from torchrecon.nrsfm.base import check_size, mirror_sign, solve_items, turn_of_view
from torchrecon.nrsfm.likelihood import (
    CameraPath,
    MotionPrior,
    Packed,
    learn_kernels,
    matern32,
    negative_log_likelihood,
    pack,
    posterior_points,
)
from torchrecon.nrsfm.observations import Observations, observe
from torchrecon.nrsfm.turning import RigidTurn, TurnParams, longest, rigid_turns, rigid_under

__all__ = ["FoundPath", "TrajectoryParams", "find_path", "place_points", "solve_trajectories", "thinning", "trajectory"]


@dataclass(frozen=True)
class TrajectoryParams:
    """Parameters of the trajectory solver.

    Attributes:
        variances: of the deviation from the rest position per class of points, relative to the body's mean square
            extent (no unit); smallest: trunk, largest: hands and feet.
        memory: length of the Matern kernel of the deviation (seconds).
        floor: variance of the unpredictable part of the deviation (relative, as ``variances``).
        inflation: factor on the standard deviation of the observations: tracks drift more than their covariance says.
        default_noise: standard deviation where no covariance is given (rms sizes of the body in the image).
        axes: directions of the turning axis in the image (degrees from the vertical).
        turn: of the search for the turn of a rigid body.
        narrow: field of view that stands for parallel rays (radians per rms size).
        entries: observations per point that the search uses at most; frames are thinned to reach it (count).
        iterations: descent steps of the translation (count).
        drift: standard deviation of the translation about that of the rigid body (rms sizes).
        drift_memory: its time scale (seconds).
        kernel_weight: weight of the Matern kernels against the learned ones (coordinates, three per point).
        kernel_iterations: rounds of learning the kernels (count).
        last_weight, last_iterations: of learning on from these once the path is found. Kernels as free as that choose
            wrong paths; under the right one they follow the limbs better.
        static_turn: change of view below which depth is called undetermined (degrees): a fixed camera on a moving
            person fits turns of 25 to 45 degrees.
        evidence: what a turn has to gain over a fixed view for depth to be called determined, and with measured depth
            to be taken at all (nats per observation).
            Two real clips of standing cameras gain 0.04, eight synthetic ones nothing or turn by less than
            ``static_turn``; synthetic films that turn by 300 degrees gain 0.08 at least, those of jumps least. Of 131
            such films of real motion about six gain less than the limit.
    """

    variances: tuple[float, ...] = (0.001, 0.01, 0.05, 0.3)
    memory: float = 0.2
    floor: float = 1e-5
    inflation: float = 2.0
    default_noise: float = 0.01
    axes: tuple[float, ...] = (0.0, 45.0, 90.0, 135.0)
    turn: TurnParams = field(default_factory=TurnParams)
    narrow: float = 0.01
    entries: int = 16
    iterations: int = 12
    drift: float = 0.3
    drift_memory: float = 0.4
    kernel_weight: float = 100.0
    kernel_iterations: int = 5
    last_weight: float = 30.0
    last_iterations: int = 24
    static_turn: float = 60.0
    evidence: float = 0.06


@dataclass(frozen=True, eq=False)
class FoundPath:
    """The likeliest camera path and what speaks for it.

    Attributes:
        path: pose of every frame.
        prior: of the points: rest positions as measured about the turning axis, kernels learned under this path.
        noise: factor on the standard deviation of the observations.
        speed: (3,) angular velocity, radians per second; zero where a fixed view is the likeliest.
        evidence: gain of the best turn over the best fixed view, nats per observation; infinite with measured
            depth, which needs no turn.
    """

    path: CameraPath
    prior: MotionPrior
    noise: float
    speed: Float[Tensor, " 3"]
    evidence: float


def _centres(data: Observations) -> Tensor:
    """Mean image position of the seen points (F, 2), interpolated over frames that see nothing."""
    count = data.visible.sum(1)
    return interpolated(data.xy.sum(1) / count.clamp_min(1)[:, None], count > 0)


def _prior(data: Observations, axis: Tensor, params: TrajectoryParams) -> MotionPrior:
    """Rest positions as wide along and across the axis as the image shows them, and one kernel per class."""
    flat = axis[:2] / axis[:2].norm().clamp_min(1e-6)
    spread = torch.where(data.visible[..., None], data.xy - _centres(data)[:, None], data.xy.new_zeros(()))
    second = torch.einsum("fpa,fpb->ab", spread, spread) / data.visible.sum()
    along = flat @ second @ flat
    across = (second.trace() - along).clamp_min(1e-3 * along)
    eye = torch.eye(3, dtype=axis.dtype, device=axis.device)
    rest = across * eye + (along - across) * axis[:, None] * axis
    size = (along + across) / 2
    times = data.tracks.times
    base = matern32(times, params.memory)
    jitter = params.floor * torch.eye(len(times), dtype=axis.dtype, device=axis.device)
    kernels = torch.stack([size * (variance * base + jitter) for variance in params.variances])
    share = kernels.new_full((len(params.variances),), -math.log(len(params.variances)))
    return MotionPrior(rest, kernels, share)


def _distances(data: Observations) -> Float[Tensor, " frames"]:
    """Log scale that measured depth asks for, NaN in frames without any."""
    depth = data.tracks.depth
    if depth is None:
        return torch.full_like(data.tracks.times, torch.nan)
    there = data.visible & torch.isfinite(depth)
    body = torch.where(there, depth, depth.new_full((), float("nan"))).nanmedian(1).values / data.length
    return -torch.log(body * data.unit)


def _starts(
    data: Observations, points: Tensor, params: TrajectoryParams
) -> tuple[CameraPath, list[tuple[CameraPath, float]]]:
    """A rigid body before a view that does not turn, and under the best turns with their mean squared residuals.

    Paths are the identity in mid-sequence.
    """
    measured = _distances(data)
    log_scale = torch.where(torch.isfinite(measured), measured, torch.zeros_like(measured))
    perspective = data.tracks.intrinsics is not None
    # Without intrinsics the rays are parallel: the same as a body far away, seen within a narrow angle.
    plane = (data.offset + data.unit * data.xy if perspective else params.narrow * data.xy)[:, points]
    visible = data.visible[:, points]
    away = torch.exp(-log_scale) / data.unit if perspective else torch.full_like(log_scale, 1 / params.narrow)
    middle = len(plane) // 2

    def path(turn: RigidTurn) -> CameraPath:
        shift = turn.translation[:, :2] / turn.translation[:, 2:] * away[:, None]
        return CameraPath(turn.rotations @ turn.rotations[middle].mT, shift, log_scale)

    eye = torch.eye(3, dtype=plane.dtype, device=plane.device).expand(len(plane), 3, 3)
    rigid = rigid_under(plane, visible, eye, params.turn)
    if perspective and bool(torch.isfinite(measured).any()):
        # Out of the sensor's range the size of the body in the image says how far away it is.
        size = -torch.log(rigid.translation[:, 2].clamp_min(1e-6))
        log_scale = size + interpolated(measured - size, torch.isfinite(measured))
        away = torch.exp(-log_scale) / data.unit
    still = path(rigid)
    found = rigid_turns(plane, visible, data.tracks.fps, params.axes, not perspective, params.turn)
    return still, [(path(turn), turn.cost) for turn in found]


def _velocity(rotations: Tensor, times: Tensor) -> Tensor:
    """Mean angular velocity (3,) of a path in camera axes, radians per second."""
    step = rotations[1:] @ rotations[:-1].mT
    twist = torch.stack([step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]])
    return twist.sum(1) / (2 * (times[-1] - times[0]).clamp_min(1e-9))


def _refine(
    packed: Packed, data: Observations, start: CameraPath, prior: MotionPrior, noise: float, params: TrajectoryParams
) -> CameraPath:
    """The path whose smooth translation near that of ``start`` has the highest posterior density."""
    times = data.tracks.times
    frames = len(times)
    eye = torch.eye(frames, dtype=times.dtype, device=times.device)
    drift = torch.linalg.cholesky(
        params.drift**2 * matern32(times, params.drift_memory) + (0.1 * params.drift) ** 2 * eye
    )
    unknown = torch.zeros(frames, 2, dtype=times.dtype, device=times.device, requires_grad=True)
    optimiser = torch.optim.LBFGS(
        [unknown],
        max_iter=params.iterations,
        max_eval=params.iterations * 5 // 4,
        history_size=15,
        line_search_fn="strong_wolfe",
    )

    def path() -> CameraPath:
        return CameraPath(start.rotations, start.translation + drift @ unknown, start.log_scale)

    def closure() -> Tensor:
        optimiser.zero_grad()
        value = negative_log_likelihood(packed, path(), prior, noise) + 0.5 * unknown.square().sum()
        value.backward()
        return value

    with torch.enable_grad():
        optimiser.step(closure)
    with torch.no_grad():
        return path()


def thinning(data: Observations, params: TrajectoryParams) -> int:
    """Keep every n-th frame so that no track brings more than ``params.entries`` observations to the search."""
    return max(1, -(-int(data.visible.sum(0).max()) // params.entries))


def find_path(data: Observations, params: TrajectoryParams) -> FoundPath:
    """The likeliest of the turns of a rigid body and, where depth is not measured, of fixed views.

    The rigid fit has its say beside the likelihood of the trajectories: it reads perspective off the trunk.
    """
    noise = params.inflation if data.noise_known else params.default_noise
    packed = pack(data, thinning(data, params))
    seen = int(packed.seen.sum())
    order = longest(packed.seen.T, params.turn.search_points)
    search = packed.select(order)
    upright = data.xy.new_tensor([0.0, 1.0, 0.0])

    def judged(start: CameraPath, axis: Tensor) -> tuple[float, CameraPath, MotionPrior]:
        prior = _prior(data, axis, params)
        return _learned(packed, _refine(search, data, start, prior, noise, params), prior, noise, params)

    still, found = _starts(data, order, params)
    measured = data.tracks.depth is not None
    if measured:  # a sensor sees by itself what turns; the rigid fit, which does not read it, has no say
        candidates = [(still, 0.0), *((start, params.evidence) for start, _ in found)]
    else:
        candidates = [(start, math.log(cost) / params.turn.together) for start, cost in found]
    turns = []
    for start, doubt in candidates:
        velocity = _velocity(start.rotations, data.tracks.times)
        value, path, prior = judged(start, velocity / velocity.norm() if velocity.any() else upright)
        turns.append((value + seen * doubt, value, path, prior, velocity))
    _, value, path, prior, velocity = min(turns, key=lambda turn: turn[0])
    evidence = math.inf
    if not measured:
        # A body is longest along or across the image.
        views = [judged(still, axis) for axis in (upright, data.xy.new_tensor([1.0, 0.0, 0.0]))]
        fixed = min(views, key=lambda answer: answer[0])
        evidence = (fixed[0] - value) / seen
        if evidence < 0:
            _, path, prior = fixed
            velocity = torch.zeros_like(velocity)
    return FoundPath(path, prior, noise, velocity, evidence)


def _learned(
    packed: Packed, path: CameraPath, prior: MotionPrior, noise: float, params: TrajectoryParams
) -> tuple[float, CameraPath, MotionPrior]:
    """A path with kernels learned under it, led by minus the log-likelihood of all points.

    Kernels as given rank the mirror image or half the rate first where the motion of the body is unlike them.
    """
    with torch.no_grad():
        prior = learn_kernels(
            packed, path, prior, noise, weight=params.kernel_weight, iterations=params.kernel_iterations
        )
        return float(negative_log_likelihood(packed, path, prior, noise)), path, prior


def place_points(
    data: Observations,
    found: FoundPath,
    canonical: Float[Tensor, "frames points 3"],
    spread: Float[Tensor, "frames points 3 3"] | None,
    rank: int,
    params: TrajectoryParams,
) -> Reconstruction:
    """Canonical points seen along a camera path, in the container's units, with the status of the view."""
    item, path, rotations = data.tracks, found.path, found.path.rotations
    points3d = canonical @ rotations.mT
    covariance = None if spread is None else rotations[:, None] @ spread @ rotations.mT[:, None]
    turn = float(turn_of_view(rotations))
    status = check_size(item, 1)
    rate = math.degrees(float(found.speed.norm()))
    if status is None and item.depth is None and (turn < params.static_turn or found.evidence < params.evidence):
        status = Status(
            "undetermined",
            f"a view that turns by {turn:.0f} degrees explains the tracks hardly better than one that does not turn "
            f"({found.evidence:.2f} nats per observation, {params.evidence:.2f} are needed); depth is not determined",
        )
    if status is None and item.depth is not None:
        status = Status("ok", f"depth is measured; steady turn of {rate:.0f} degrees per second")
    if status is None:
        status = Status("ok", f"steady turn of {rate:.0f} degrees per second, the likeliest of all axes and rates")
    if item.intrinsics is not None:
        distance = torch.exp(-path.log_scale) / data.unit
        placed = torch.cat([path.translation, distance[:, None]], 1) + points3d.mean(-2)
        return Reconstruction.from_points(
            points3d * data.length,
            rotations,
            rank=rank,
            status=status,
            translation=placed * data.length,
            covariance3d=None if covariance is None else covariance * data.length**2,
            intrinsics=item.intrinsics,
            observed=data.visible,
        )
    flip = torch.ones(3, dtype=points3d.dtype, device=points3d.device)
    flip[2] = mirror_sign(points3d)
    both = flip[:, None] * flip
    return data.reconstruction(
        points3d * flip,
        rotations * both,
        torch.exp(path.log_scale),
        path.translation,
        rank=rank,
        status=status,
        covariance3d=None if covariance is None else covariance * both,
    )


def _at_distance(data: Observations, depth: Tensor, path: CameraPath, canonical: Tensor) -> CameraPath:
    """The pinhole path with the distance of each frame moved by what measured depth still lies beyond the points.

    The search starts from the median depth of the seen points, which is not that of the body's origin.
    """
    there = data.visible & torch.isfinite(depth)
    distance = torch.exp(-path.log_scale) / data.unit
    rest = depth / data.length - (canonical @ path.rotations.mT)[..., 2] - distance[:, None]
    moved = torch.where(there, rest, torch.zeros_like(rest)).sum(1) / there.sum(1).clamp_min(1)
    factor = (distance + moved) / distance
    return CameraPath(path.rotations, path.translation * factor[:, None], path.log_scale - torch.log(factor))


def _parallel(packed: Packed, path: CameraPath) -> tuple[Packed, CameraPath]:
    """The same pinhole path with the rays of a frame parallel, so that a fixed view says nothing of depth.

    Rays that converge seem to say a lot where the view shifts: a body that turns a little is a body of great depth.
    """
    distance = torch.exp(-path.log_scale) / packed.unit
    shift = (path.translation - packed.offset * distance[:, None]) * torch.exp(path.log_scale)[:, None]
    return replace(packed, perspective=False), CameraPath(path.rotations, shift, path.log_scale)


def solve_trajectories(
    item: Tracks, rank: int, generator: torch.Generator, params: TrajectoryParams | None = None
) -> Reconstruction:
    """Solve one sequence of any visibility; see the module's text. Nothing is random, ``generator`` is not used.

    Gradients go through the posterior of the points, with camera path and kernels held.
    """
    params = params or TrajectoryParams()
    data, held = observe(item), observe(item.detach())
    found = find_path(held, params)
    with torch.no_grad():
        thin = pack(held, thinning(held, params))
        prior = learn_kernels(
            thin, found.path, found.prior, found.noise, weight=params.last_weight, iterations=params.last_iterations
        )
    packed, path = pack(data), found.path
    if packed.perspective and item.depth is None and not found.speed.any():
        packed, path = _parallel(packed, path)
    canonical, spread, _ = posterior_points(packed, path, prior, found.noise)
    if item.depth is not None and item.intrinsics is not None:
        found = replace(found, path=_at_distance(data, item.depth, found.path, canonical))
        canonical, spread, _ = posterior_points(packed, found.path, prior, found.noise)
    return place_points(data, found, canonical, spread, rank, params)


def trajectory(
    tracks: Tracks, rank: int | Int[Tensor, "*batch"], *, generator: torch.Generator | None = None
) -> Reconstruction:
    """Gaussian-process trajectories under a steadily turning view; any visibility, any leading batch.

    Args:
        tracks: seen entries only are read; covariance, intrinsics and depth are used where they are there.
        rank: reported as it is given; the solver needs none.
        generator: taken for the contract; nothing here is random.

    Example:
        >>> import torch
        >>> from torchrecon.linalg import rotation_from_vector
        >>> g = torch.Generator().manual_seed(0)
        >>> shape = torch.randn(12, 3, generator=g)
        >>> turn = rotation_from_vector(torch.linspace(0, 2, 20)[:, None] * torch.tensor([0.0, 1.0, 0.0]))
        >>> visible = torch.rand(20, 12, generator=g) < 0.8
        >>> trajectory(Tracks((shape @ turn.mT)[..., :2], visible), 1).points3d.shape
        torch.Size([20, 12, 3])
    """
    return solve_items(tracks, rank, solve_trajectories, generator)
