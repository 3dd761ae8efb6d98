"""The known methods of the field: the theorem behind each, by another route."""

from __future__ import annotations

from importlib import import_module
from itertools import pairwise

import numpy as np
import pytest
import torch

from torchrecon.errors import ReconError
from torchrecon.linalg import rotation_from_vector
from torchrecon.linalg.dct import dct_basis
from torchrecon.linalg.gauss_newton import damped_gauss_newton
from torchrecon.linalg.shrinkage import shrink_singular_values
from torchrecon.measurement import Tracks
from torchrecon.metrics import error3d_akhter, error3d_camera
from torchrecon.nrsfm import get_solver
from torchrecon.nrsfm.bmm import BmmParams, least_nuclear_shapes
from torchrecon.nrsfm.csf import CsfParams
from torchrecon.nrsfm.em_ppca import EmPpcaParams
from torchrecon.nrsfm.gram import gram_upgrade
from torchrecon.nrsfm.observations import observe
from torchrecon.nrsfm.pta import cosine_shapes

KNOWN = ("bmm", "csf", "em_ppca", "pta")
# the functions of the same name hide the modules
BMM, CSF, EM = (import_module(f"torchrecon.nrsfm.{name}") for name in ("bmm", "csf", "em_ppca"))


def _turn(frames: int, degrees: float = 200.0) -> torch.Tensor:
    angle = torch.deg2rad(torch.tensor(degrees)) * torch.linspace(0, 1, frames)
    return rotation_from_vector(angle[:, None] * torch.tensor([0.1, 1.0, 0.05]))


def _world(weights: torch.Tensor, points: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Canonical shapes and rotations from weights (F, K); every shape is centred."""
    g = torch.Generator().manual_seed(seed)
    basis = torch.randn(weights.shape[1], points, 3, generator=g)
    basis = basis - basis.mean(1, keepdim=True)
    return torch.einsum("fk,kpi->fpi", weights, basis), _turn(len(weights))


def _relative(rotations: torch.Tensor) -> torch.Tensor:
    return rotations @ rotations[:1].mT


def test_dct_basis_is_scipys():
    from scipy.fft import dct

    expected = dct(np.eye(17), axis=0, norm="ortho").T
    np.testing.assert_allclose(dct_basis(17, 17).numpy(), expected, atol=1e-12)


@pytest.mark.parametrize("shape", [(7, 4), (4, 7), (3, 5, 6)])
def test_shrinkage_is_the_proximal_map_of_the_nuclear_norm(shape, generator):
    matrix = torch.randn(*shape, generator=generator)
    found = shrink_singular_values(matrix, 0.7)
    u, s, vh = torch.linalg.svd(matrix, full_matrices=False)
    torch.testing.assert_close(found, (u * (s - 0.7).clamp_min(0)[..., None, :]) @ vh)


def test_damped_gauss_newton_ends_where_scipy_does(generator):
    from scipy.optimize import least_squares

    time = torch.linspace(0, 3, 30)
    data = 2.0 * torch.exp(-0.7 * time) + 0.1 * torch.randn(30, generator=generator)

    def evaluate(x):
        decay = torch.exp(-x[..., 1:] * time)
        r = x[..., :1] * decay - data
        j = torch.stack([decay, -x[..., :1] * time * decay], -1)
        return r.square().sum(-1), (j.mT @ r[..., None])[..., 0], j.mT @ j

    found, cost, converged = damped_gauss_newton(evaluate, torch.tensor([[1.0, 0.1], [5.0, 3.0]]))
    best = least_squares(lambda x: x[0] * np.exp(-x[1] * time.numpy()) - data.numpy(), [1.0, 0.1])
    np.testing.assert_allclose(found.numpy(), np.broadcast_to(best.x, (2, 2)), rtol=1e-5)
    np.testing.assert_allclose(cost.numpy(), 2 * best.cost, rtol=1e-8)
    assert bool(converged.all())


@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("rank", [1, 2, 3])
def test_upgrade_finds_the_cameras_of_exact_tracks_without_a_start(rank, scaled, generator):
    frames = 60
    time = torch.linspace(0, 1, frames)
    weights = torch.stack([torch.ones(frames), (9 * time).sin(), (14 * time).cos()][:rank], 1) * torch.tensor(
        [1.0, 0.4, 0.3][:rank]
    )
    shapes, rotations = _world(weights, 20)
    size = 1 + 0.2 * (5 * time).sin() if scaled else torch.ones(frames)
    stack = ((shapes @ rotations.mT)[..., :2] * size[:, None, None]).mT.flatten(0, 1)
    found = gram_upgrade(stack, 3 * rank, scaled=scaled)
    assert found.converged
    if rank == 1:  # with more bases a scale and a common change of the weights are the same thing
        torch.testing.assert_close(found.scale, size / size.mean(), atol=1e-4, rtol=0)
    mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0]))
    turned = _relative(found.rotations)
    off = [float((answer - _relative(rotations)).abs().max()) for answer in (turned, mirror @ turned @ mirror)]
    assert min(off) < (1e-6 if rank == 1 else 5e-3)  # flat minimum, see the module


def test_pta_is_exact_when_the_trajectories_are_cosines():
    shapes, rotations = _world(dct_basis(50, 3) * torch.tensor([7.0, 1.0, 1.0]), 40)
    truth = shapes @ rotations.mT
    torch.testing.assert_close(cosine_shapes(truth[..., :2], rotations, 3), shapes)
    assert error3d_camera(get_solver("pta")(Tracks(truth[..., :2]), 3).points3d, truth) < 1e-2
    assert error3d_camera(get_solver("pta")(Tracks(truth[..., :2]), 2).points3d, truth) > 5e-2


def test_csf_is_exact_with_fewer_bases_than_cosines():
    weights = dct_basis(50, 5) @ torch.tensor([[7.0, 0.0], [0.0, 1.0], [0.0, 0.5], [0.0, -1.0], [0.0, 0.7]])
    shapes, rotations = _world(weights, 20)
    truth = shapes @ rotations.mT
    assert error3d_camera(get_solver("csf")(Tracks(truth[..., :2]), 2).points3d, truth) < 1e-4
    assert error3d_camera(get_solver("pta")(Tracks(truth[..., :2]), 2).points3d, truth) > 1e-2


def test_csf_normal_equations_are_the_derivatives_of_the_projected_cost(generator):
    frames, points, rank = 12, 9, 2
    xy = torch.randn(frames, points, 2, generator=generator)
    root = torch.randn(frames, points, 2, 2, generator=generator)
    seen = (torch.rand(frames, points, generator=generator) < 0.8)[..., None, None]
    columns = CSF._Columns(xy, root @ root.mT * seen, _turn(frames)[:, :2], dct_basis(frames, 4), 0.0)
    flat = torch.randn(4 * rank, generator=generator)
    slope = torch.autograd.functional.jacobian(lambda x: columns.evaluate(x)[0], flat)
    _, gradient, normal = columns.evaluate(flat)
    torch.testing.assert_close(gradient, slope / 2)
    # Gauss-Newton of the joint problem, bases not eliminated: the same step.
    bases = columns.bases(columns.weights(flat))[3]
    rows = columns.rows

    def residual(x, b):
        motion = torch.einsum("fk,fai->faki", columns.weights(x), rows).flatten(2)
        r = xy - torch.einsum("fai,pi->fpa", motion, b)
        return ((root.mT @ r[..., None]) * seen).flatten()

    left, right = torch.autograd.functional.jacobian(residual, (flat, bases))
    jacobian = torch.cat([left, right.flatten(1)], 1)
    step = torch.linalg.lstsq(jacobian, -residual(flat, bases)[:, None], driver="gelsd").solution[: 4 * rank, 0]
    # the change of weights by a K x K matrix is free in both; compare what is not
    torch.testing.assert_close(normal @ step, -gradient)


def test_least_nuclear_shapes_have_the_least_nuclear_norm(generator):
    from scipy.optimize import minimize

    turn = _turn(7)
    xy = torch.randn(7, 5, 2, generator=generator)
    shapes, converged = least_nuclear_shapes(xy, turn, params=BmmParams(tolerance=1e-6, iterations=3000))
    assert converged
    torch.testing.assert_close((shapes @ turn.mT)[..., :2], xy)

    def smoothed(depth):
        z = torch.tensor(depth, requires_grad=True)
        full = torch.cat([xy, z.view(7, 5, 1)], -1) @ turn
        cost = (torch.linalg.svdvals(full.flatten(1)).square() + 1e-10).sqrt().sum()
        cost.backward()
        return float(cost.detach()), z.grad.numpy()

    best = minimize(smoothed, np.zeros(35), jac=True, method="L-BFGS-B", options={"maxiter": 3000, "maxfun": 6000})
    assert float(torch.linalg.svdvals(shapes.flatten(1)).sum()) < best.fun * (1 + 1e-4)


def test_nuclear_norm_at_the_edge_of_the_noise_removes_noise_and_only_it(generator):
    """On pure noise the shape is zero; on a rigid body the error is below that of an exact projection."""
    turn = _turn(60)
    noise = torch.randn(60, 30, 2, generator=generator)
    silent, _ = least_nuclear_shapes(noise, turn, 1.1)
    assert silent.norm() < 0.1 * noise.norm()
    shapes, _ = _world(torch.ones(60, 1), 30)
    xy = (shapes @ turn.mT)[..., :2] + 0.1 * noise
    errors = [float((least_nuclear_shapes(xy, turn, sigma)[0] - shapes).norm()) for sigma in (0.1, 0.0)]
    assert errors[0] < 0.6 * errors[1]


def _em_problem(generator):
    """A small scene with gaps, noise and a covariance per observation, and a model that is not yet its maximum."""
    time = torch.linspace(0, 1, 14)
    shapes, rotations = _world(torch.stack([torch.ones(14), (8 * time).sin(), (13 * time).cos()], 1), 8)
    xy = (shapes @ rotations.mT)[..., :2] + 0.05 * torch.randn(14, 8, 2, generator=generator)
    visible = torch.rand(14, 8, generator=generator) < 0.85
    root = 0.05 * torch.randn(14, 8, 2, 2, generator=generator)
    data = observe(Tracks(xy, visible, root @ root.mT + 0.002 * torch.eye(2)))
    model = EM._start(data, 3, False, EmPpcaParams())
    return data, data.weight.mT @ data.weight, model


def _dense(model, data, information, frame):
    """Seen coordinates of a frame, their mean and loadings on z, and the noise covariance, all dense."""
    seen = data.visible[frame]
    loading = torch.einsum("ai,pki->pak", model.rows[frame], model.bases[seen]).flatten(0, 1)
    mean = loading[:, 0] + model.translation[frame].repeat(int(seen.sum()))
    noise = torch.block_diag(*(model.noise * torch.linalg.inv(information[frame, seen])))
    return data.xy[frame, seen].flatten(), mean, loading[:, 1:], noise


def test_em_expectation_is_gaussian_conditioning(generator):
    data, information, model = _em_problem(generator)
    first, second = EM._expect(model, data, information)
    for frame in range(14):
        x, mean, loading, noise = _dense(model, data, information, frame)
        gain = loading.T @ torch.linalg.inv(loading @ loading.T + noise)
        z, spread = gain @ (x - mean), torch.eye(2) - gain @ loading
        torch.testing.assert_close(first[frame, 1:], z)
        torch.testing.assert_close(second[frame, 1:, 1:], torch.outer(z, z) + spread)


def test_em_never_loses_likelihood(generator):
    data, information, model = _em_problem(generator)

    def likelihood(model):
        total = 0.0
        for frame in range(14):
            x, mean, loading, noise = _dense(model, data, information, frame)
            spread = loading @ loading.T + noise
            total += float(torch.distributions.MultivariateNormal(mean, spread).log_prob(x))
        return total

    values = [likelihood(model)]
    for _ in range(12):
        model = EM._maximise(model, data, information, *EM._expect(model, data, information), False)
        values.append(likelihood(model))
    assert all(after > before - 1e-6 * abs(before) for before, after in pairwise(values)), values
    assert values[-1] > values[0] + 1


@pytest.mark.parametrize("name", KNOWN)
def test_a_body_that_comes_nearer_keeps_its_size(name):
    """Weak perspective: with intrinsics the distance of every frame is solved for."""
    frames = 40
    shapes, rotations = _world(torch.ones(frames, 1), 15)
    truth = 0.1 * shapes @ rotations.mT
    distance = 40 + 8 * torch.linspace(0, 6, frames).sin()
    k = torch.tensor([[1100.0, 0, 380], [0, 1100, 290], [0, 0, 1]])
    image = (truth + torch.stack([0 * distance, 0 * distance, distance], -1)[:, None]) @ k.T
    rec = get_solver(name)(Tracks(image[..., :2] / image[..., 2:], intrinsics=k), 1)
    assert error3d_camera(rec.points3d, truth, align_scale="sequence") < 0.02
    found = rec.translation[:, 2]
    torch.testing.assert_close(found / found.mean(), distance / distance.mean(), atol=0.01, rtol=0)


@pytest.mark.parametrize("name", KNOWN)
def test_single_precision_gives_the_same_answer(name):
    time = torch.linspace(0, 1, 40)
    shapes, rotations = _world(torch.stack([torch.ones(40), 0.3 * (4 * time).sin()], 1), 15)
    tracks = Tracks(100 * (shapes @ rotations.mT)[..., :2])
    double = get_solver(name)(tracks, 2).points3d
    single = get_solver(name)(tracks.to(dtype=torch.float32), 2).points3d
    assert single.dtype == torch.float32
    # the flat minimum of the upgrade is followed less far in single precision
    assert error3d_camera(single.double(), double) < 4e-2


@pytest.mark.parametrize("name", ["csf", "em_ppca"])
def test_tracks_in_short_bands_are_not_called_solved(name):
    shapes, rotations = _world(torch.ones(60, 1), 90)
    start = torch.arange(90) % 45
    time = torch.arange(60)[:, None]
    rec = get_solver(name)(Tracks((shapes @ rotations.mT)[..., :2], (time >= start) & (time < start + 15)), 1)
    assert rec.status.code == "undetermined"
    assert "share fewer than 4 points" in rec.status.text


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["csf", "em_ppca"])
def test_an_empty_frame_and_a_point_never_seen_do_no_harm(name, dtype):
    shapes, rotations = _world(torch.ones(30, 1), 15)
    truth = shapes @ rotations.mT
    visible = torch.ones(30, 15, dtype=torch.bool)
    visible[7], visible[:, 3] = False, False
    rec = get_solver(name)(Tracks(100 * truth[..., :2].to(dtype), visible), 1)
    assert bool(torch.isfinite(rec.points3d).all())
    assert error3d_camera(rec.points3d.double(), 100 * truth, visible) < 1e-2


def test_iteration_limits_are_reported():
    time = torch.linspace(0, 1, 30)
    shapes, rotations = _world(torch.stack([torch.ones(30), 0.3 * (4 * time).sin()], 1), 15)
    tracks = Tracks((shapes @ rotations.mT)[..., :2])
    g = torch.Generator()
    for rec in (
        BMM._solve(tracks, 2, g, BmmParams(iterations=1)),
        CSF._solve(tracks, 2, g, CsfParams(iterations=1)),
        EM._solve(tracks, 2, g, EmPpcaParams(iterations=1)),
    ):
        assert rec.status.code == "not_converged", rec.status.text


@pytest.mark.data
def test_pta_gives_the_stored_result_of_its_authors(data_dir):
    from torchrecon.data.benchmarks import load_benchmark

    for name, rank in (("stretch", 12), ("yoga", 11)):
        sequence = load_benchmark(name, data_dir / "nrsfm")
        rec = get_solver("pta")(Tracks(sequence.points3d[..., :2].clone()), rank)
        assert error3d_akhter(rec.canonical, sequence.stored_pta) < 0.02, name


def test_rank_option_of_the_benchmark():
    from eval.nrsfm import chosen_rank

    assert chosen_rank("paper", "pta", "yoga") == 11
    assert chosen_rank("paper", "em_ppca", "yoga") == chosen_rank("auto", "pta", "yoga") == "auto"
    assert chosen_rank("4", "pta", "yoga") == 4
    with pytest.raises(ReconError, match="neither 'auto' nor 'paper'"):
        chosen_rank("0", "pta", "yoga")
