"""Tracks that are born and die: a turning view and Gaussian-process trajectories, fitted by maximum likelihood.

What is sought is the camera path alone; the points are integrated out (see ``likelihood``). A turn at constant
angular velocity is looked for on a grid of axes and rates, with rest positions spread about the axis as the image
shows them: an isotropic prior would charge every point for a depth extent that the body does not have, and so favour
too slow a turn. The best candidates are refined with a smooth translation. Rotations that are free in every frame
raise the likelihood and the error together (limbs are explained by wobble), so they are not offered. With the
camera path found, the kernels are learned from the tracks; the points are then the posterior mean. With intrinsics
the likelihood itself tells the two mirror images apart; without, the documented rule picks one. Assumption to keep in
mind: the view turns steadily in the axes of the body.
Derived here; not a published method.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.linalg import rotation_from_vector
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
        rates: angular velocities of the grid (degrees per second), tried in both senses where the sense matters.
        axes: directions of the turning axis in the image (degrees from the vertical).
        entries: observations per point that the search uses at most; frames are thinned to reach it (count).
        grid_points: longest tracks that are scored on the grid (count).
        search_points: longest tracks that the refinement uses (count).
        candidates: turns of the grid that are refined and learned (count).
        iterations: descent steps per round, two rounds per candidate (count).
        drift: standard deviation of the translation about the mean image position of the seen points (rms sizes).
        drift_memory: its time scale (seconds).
        rate_spread: standard deviation of the angular velocity about the grid point (degrees per second).
        kernel_weight: weight of the Matern kernels against the learned ones (coordinates, three per point).
        kernel_iterations: rounds of learning the kernels (count).
        static_turn: change of view below which depth is called undetermined (degrees): a fixed camera on a moving
            person fits turns of 25 to 45 degrees.
        evidence: what a turn has to gain over a fixed view for depth to be called determined (nats per observation);
            views that do not turn gain -0.4 to 0.16 (limbs that swing look a little like a turn), views that turn by
            300 degrees 0.24 to 0.7.
    """

    variances: tuple[float, ...] = (0.001, 0.01, 0.05, 0.3)
    memory: float = 0.2
    floor: float = 1e-5
    inflation: float = 1.4
    default_noise: float = 0.01
    rates: tuple[float, ...] = (25.0, 50.0, 75.0, 100.0, 125.0, 150.0, 200.0)
    axes: tuple[float, ...] = (0.0, 45.0, 90.0, 135.0)
    entries: int = 16
    grid_points: int = 100
    search_points: int = 200
    candidates: int = 4
    iterations: int = 12
    drift: float = 0.3
    drift_memory: float = 0.4
    rate_spread: float = 25.0
    kernel_weight: float = 100.0
    kernel_iterations: int = 5
    static_turn: float = 60.0
    evidence: float = 0.2


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
    mean = data.xy.sum(1) / count.clamp_min(1)[:, None]
    if bool((count > 0).all()):
        return mean
    seen = (count > 0).nonzero()[:, 0]
    frames = torch.arange(len(count), device=seen.device)
    right = torch.searchsorted(seen, frames).clamp(max=len(seen) - 1)
    left = (right - 1).clamp_min(0)
    span = (seen[right] - seen[left]).clamp_min(1)
    part = ((frames - seen[left]) / span).clamp(0, 1).to(mean.dtype)[:, None]
    return torch.where((count > 0)[:, None], mean, mean[seen[left]] * (1 - part) + mean[seen[right]] * part)


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


def _distances(data: Observations) -> Tensor:
    """Start of the log scale: zero, or the measured distance of the body where there is depth."""
    depth = data.tracks.depth
    start = torch.zeros_like(data.tracks.times)
    if depth is None:
        return start
    there = data.visible & torch.isfinite(depth)
    body = torch.where(there, depth, depth.new_full((), float("nan"))).nanmedian(1).values / data.length
    return torch.where(torch.isfinite(body), -torch.log(body * data.unit), start)


def _start(data: Observations) -> tuple[Tensor, Tensor]:
    """Translation and log scale that put the mean of the seen points at the origin of the body."""
    log_scale = _distances(data)
    centres = _centres(data)
    if data.tracks.intrinsics is None:
        return centres, log_scale
    distance = torch.exp(-log_scale) / data.unit
    return (data.offset + data.unit * centres) * distance[:, None], log_scale


def _turning(times: Tensor, velocity: Tensor) -> Tensor:
    """Rotations (F, 3, 3) at constant angular velocity (3,) in radians per second, identity in mid-sequence."""
    return rotation_from_vector((times - times.mean())[:, None] * velocity)


def _refine(
    packed: Packed,
    data: Observations,
    velocity: Tensor,
    prior: MotionPrior,
    noise: float,
    params: TrajectoryParams,
    turning: bool = True,
) -> tuple[float, Tensor, CameraPath]:
    """Angular velocity (unless the view is held) and smooth translation of highest posterior density."""
    times = data.tracks.times
    shift, log_scale = _start(data)
    eye = torch.eye(len(times), dtype=times.dtype, device=times.device)
    drift = torch.linalg.cholesky(
        params.drift**2 * matern32(times, params.drift_memory) + (0.1 * params.drift) ** 2 * eye
    )
    unknown = torch.zeros(3 + 2 * len(times), dtype=times.dtype, device=times.device, requires_grad=True)
    optimiser = torch.optim.LBFGS(
        [unknown],
        max_iter=params.iterations,
        max_eval=params.iterations * 5 // 4,
        history_size=15,
        line_search_fn="strong_wolfe",
    )

    def path() -> tuple[Tensor, CameraPath]:
        speed = velocity + math.radians(params.rate_spread) * unknown[:3] * float(turning)
        return speed, CameraPath(_turning(times, speed), shift + drift @ unknown[3:].view(len(times), 2), log_scale)

    def closure() -> Tensor:
        optimiser.zero_grad()
        value = negative_log_likelihood(packed, path()[1], prior, noise) + 0.5 * unknown.square().sum()
        value.backward()
        return value

    with torch.enable_grad():
        optimiser.step(closure)
    with torch.no_grad():
        speed, found = path()
        value = negative_log_likelihood(packed, found, prior, noise) + 0.5 * unknown.square().sum()
    return float(value), speed, found


def _grid(data: Observations, params: TrajectoryParams) -> list[Tensor]:
    """Angular velocities (3,) in radians per second; one sense only where the mirror image is as likely."""
    senses = (1.0, -1.0) if data.tracks.intrinsics is not None else (1.0,)
    grid = []
    for degrees in params.axes:
        angle = math.radians(degrees)
        axis = data.xy.new_tensor([math.sin(angle), math.cos(angle), 0.0])
        grid += [axis * (sense * math.radians(rate)) for rate in params.rates for sense in senses]
    return grid


def _distinct(velocities: list[Tensor], count: int) -> list[Tensor]:
    """The first ones, best first, that are not neighbours on the grid."""
    kept: list[Tensor] = []
    for velocity in velocities:
        if all(float((velocity - other).norm()) > 0.4 * float(velocity.norm()) for other in kept):
            kept.append(velocity)
    return kept[:count]


def thinning(data: Observations, params: TrajectoryParams) -> int:
    """Keep every n-th frame so that no track brings more than ``params.entries`` observations to the search."""
    return max(1, -(-int(data.visible.sum(0).max()) // params.entries))


def find_path(data: Observations, params: TrajectoryParams) -> FoundPath:
    """The likeliest of all steady turns and, where depth is not measured, of fixed views."""
    noise = params.inflation if data.noise_known else params.default_noise
    thinned = pack(data, thinning(data, params))
    order = torch.argsort(thinned.seen.sum(1), descending=True, stable=True)[: params.search_points]
    search = thinned.select(order)
    coarse = thinned.select(order[: params.grid_points])
    shift, log_scale = _start(data)
    scored = []
    with torch.no_grad():
        for velocity in _grid(data, params):
            prior = _prior(data, velocity / velocity.norm(), params)
            path = CameraPath(_turning(data.tracks.times, velocity), shift, log_scale)
            scored.append((float(negative_log_likelihood(coarse, path, prior, noise)), velocity))
    scored.sort(key=lambda entry: entry[0])
    answers = []
    for velocity in _distinct([velocity for _, velocity in scored], params.candidates):
        speed = velocity
        # The refined axis may have left that of the grid: a second round measures the body about its own axis.
        for _ in range(2):
            prior = _prior(data, speed / speed.norm().clamp_min(1e-9), params)
            value, speed, path = _refine(search, data, speed, prior, noise, params)
        answers.append(_learned(thinned, value, speed, path, prior, noise, params))
    best = min(answers, key=lambda answer: answer[0])
    evidence = math.inf
    if data.tracks.depth is None:
        still = []
        for degrees in (0.0, 90.0):  # the body is longest along or across the image
            axis = data.xy.new_tensor([math.sin(math.radians(degrees)), math.cos(math.radians(degrees)), 0.0])
            prior = _prior(data, axis, params)
            still.append((*_refine(search, data, torch.zeros_like(axis), prior, noise, params, turning=False), prior))
        value, speed, path, prior = min(still, key=lambda answer: answer[0])
        evidence = (value - best[1]) / int(search.seen.sum())
        if evidence < 0:
            best = _learned(thinned, value, speed, path, prior, noise, params)
    _, _, speed, path, prior = best
    return FoundPath(path, prior, noise, speed, evidence)


def _learned(
    packed: Packed,
    value: float,
    speed: Tensor,
    path: CameraPath,
    prior: MotionPrior,
    noise: float,
    params: TrajectoryParams,
) -> tuple[float, float, Tensor, CameraPath, MotionPrior]:
    """The answer with kernels learned under its path, led by minus the log-likelihood of all points under them.

    Kernels as given rank the mirror image or half the rate first where the motion of the body is unlike them.
    """
    with torch.no_grad():
        prior = learn_kernels(
            packed, path, prior, noise, weight=params.kernel_weight, iterations=params.kernel_iterations
        )
        return float(negative_log_likelihood(packed, path, prior, noise)), value, speed, path, prior


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


def solve_trajectories(
    item: Tracks, rank: int, generator: torch.Generator, params: TrajectoryParams | None = None
) -> Reconstruction:
    """Solve one sequence of any visibility; see the module's text. Nothing is random, ``generator`` is not used."""
    params = params or TrajectoryParams()
    data = observe(item)
    found = find_path(data, params)
    with torch.no_grad():
        canonical, spread, _ = posterior_points(pack(data), found.path, found.prior, found.noise)
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
