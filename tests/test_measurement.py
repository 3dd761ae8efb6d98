"""Containers: what they accept, refuse, keep and write."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchrecon as tr
from torchrecon.measurement import (
    backproject_points,
    centre_tracks,
    project_points,
    stack_matrix,
    tracks_to_matrix,
    vector_matrix,
)

INTRINSICS = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)


def full_tracks(*batch: int) -> tr.Tracks:
    g = torch.Generator().manual_seed(1)
    shape = (*batch, 6, 5)
    visible = torch.rand(shape, generator=g) > 0.2
    visible[..., 0] = True
    return tr.Tracks(
        100 + torch.randn(*shape, 2, generator=g),
        visible,
        covariance=torch.eye(2).expand(*shape, 2, 2) * 0.3,
        depth=2 + torch.rand(shape, generator=g),
        depth_variance=torch.full(shape, 1e-4),
        intrinsics=INTRINSICS,
        fps=30.0,
        names=tuple("abcde"),
        edges=((0, 1), (1, 2)),
        extras={"age": torch.ones(*shape)},
    )


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_tracks_survive_a_file(tmp_path, batch):
    tracks = full_tracks(*batch)
    back = tr.load_tracks(tracks.save(tmp_path / "t.npz"))
    for name in ("xy", "visible", "covariance", "depth", "depth_variance", "intrinsics", "times"):
        torch.testing.assert_close(getattr(back, name), getattr(tracks, name), rtol=0, atol=0, equal_nan=True)
    assert (back.names, back.edges, back.fps) == (tracks.names, tracks.edges, 30.0)
    assert back.extras is not None
    torch.testing.assert_close(back.extras["age"], tracks.extras["age"])


def test_unseen_entries_are_forgotten():
    xy = torch.randn(4, 3, 2)
    visible = torch.ones(4, 3, dtype=torch.bool)
    visible[2, 1] = False
    other = xy.clone()
    other[2, 1] = 1e9
    one, two = tr.Tracks(xy, visible), tr.Tracks(other, visible)
    torch.testing.assert_close(one.xy, two.xy, equal_nan=True)
    assert torch.isnan(one.xy[2, 1]).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"xy": torch.zeros(4, 3)}, "xy: shape"),
        ({"xy": "tracks"}, "numeric"),
        ({"visible": torch.ones(3, 3)}, "visible: shape"),
        ({"visible": torch.zeros(4, 3)}, "no point is seen"),
        ({"covariance": torch.eye(2)}, "covariance: shape"),
        ({"covariance": -torch.eye(2).expand(4, 3, 2, 2)}, "positive definite"),
        ({"depth": torch.ones(4, 3)}, "needs intrinsics"),
        ({"depth": torch.zeros(4, 3), "intrinsics": INTRINSICS}, "not positive"),
        ({"depth_variance": torch.ones(4, 3)}, "without depth"),
        ({"intrinsics": torch.eye(2)}, "intrinsics: shape"),
        ({"fps": 0.0}, "fps"),
        ({"times": torch.tensor([0.0, 1, 1, 2])}, "increase"),
        ({"names": ("a",)}, "1 names for 3 points"),
        ({"edges": ((0, 7),)}, "outside"),
    ],
)
def test_bad_tracks_are_refused_in_words(change, words):
    with pytest.raises(tr.ReconError, match=words):
        tr.Tracks(**({"xy": torch.rand(4, 3, 2)} | change))


def test_visible_but_not_finite_names_the_entry():
    xy = torch.rand(4, 3, 2)
    xy[1, 2] = float("nan")
    with pytest.raises(tr.ReconError, match=r"\(1, 2\)"):
        tr.Tracks(xy, torch.ones(4, 3, dtype=torch.bool))


def test_numpy_and_lists_are_taken():
    assert tr.Tracks(np.zeros((4, 3, 2), np.float32)).xy.dtype == torch.float32
    assert tr.Tracks([[[0, 1]], [[2, 3]]]).frames == 2


def test_files_that_are_no_tracks(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"not an archive")
    np.savez(tmp_path / "b.npz", other=np.zeros(3))
    np.savez(tmp_path / "c.npz", xy=np.array([object()], dtype=object))
    np.savez(tmp_path / "d.npz", xy=np.zeros((4, 3, 2)), vissible=np.ones((4, 3)))
    for name, words in [("a", "not a readable"), ("b", "no key 'xy'"), ("c", "not a readable"), ("d", "vissible")]:
        with pytest.raises(tr.ReconError, match=words):
            tr.load_tracks(tmp_path / f"{name}.npz")
    with pytest.raises(tr.ReconError, match="no such file"):
        tr.load_tracks(tmp_path / "none.npz")


def test_select_reindexes_edges_and_extras():
    part = full_tracks().select(frames=[1, 3], points=[2, 1])
    assert (part.frames, part.points, part.names, part.edges) == (2, 2, ("c", "b"), ((1, 0),))
    assert part.extras is not None
    assert part.extras["age"].shape == (2, 2)
    torch.testing.assert_close(part.times, torch.tensor([1 / 30, 3 / 30]))


def test_matrix_layouts_by_hand():
    xy = torch.tensor([[[1.0, 2], [3, 6]], [[0, 0], [2, 4]]])
    assert stack_matrix(xy).tolist() == [[1, 3], [2, 6], [0, 2], [0, 4]]
    assert vector_matrix(xy).tolist() == [[1, 3, 2, 6], [0, 2, 0, 4]]
    assert tracks_to_matrix(tr.Tracks(xy)).tolist() == [[-1, 1], [-2, 2], [-1, 1], [-2, 2]]


def test_centring_ignores_points_that_come_and_go():
    xy = torch.rand(5, 4, 2)
    visible = torch.ones(5, 4, dtype=torch.bool)
    visible[1:, 3] = False
    _, centroid = centre_tracks(xy, visible)
    torch.testing.assert_close(centroid, xy[:, :3].mean(1))
    with pytest.raises(tr.ReconError, match="no point is visible in every frame"):
        centre_tracks(xy, torch.eye(5, 4, dtype=torch.bool))


def test_projection_and_back():
    points = torch.rand(7, 3) + torch.tensor([0.0, 0, 2])
    pixels = project_points(points, INTRINSICS)
    torch.testing.assert_close(backproject_points(pixels, points[:, 2], INTRINSICS), points)


def reconstruction(*batch: int, rank: int = 2) -> tr.Reconstruction:
    g = torch.Generator().manual_seed(2)
    points = torch.randn(*batch, 6, 9, 3, generator=g)
    rotations = torch.linalg.qr(torch.randn(*batch, 6, 3, 3, generator=g))[0]
    rotations = rotations * torch.linalg.det(rotations)[..., None, None]
    total = int(np.prod(batch)) if batch else 1
    status = tuple(tr.Status("ok", f"item {i}") for i in range(total))
    ranks = torch.full(batch, rank) if batch else rank
    return tr.Reconstruction.from_points(points, rotations, rank=ranks, status=status if batch else status[0])


@pytest.mark.parametrize("batch", [(), (2,), (2, 2)])
def test_reconstruction_survives_a_file(tmp_path, batch):
    rec = reconstruction(*batch)
    back = tr.Reconstruction.load(rec.save(tmp_path / "r.npz"))
    torch.testing.assert_close(back.points3d, rec.points3d)
    assert back.statuses == rec.statuses
    assert isinstance(back.rank, int) == (batch == ())


def test_canonical_frame_and_factors():
    rec = reconstruction(rank=6)
    torch.testing.assert_close(rec.rotations[0], torch.eye(3))
    torch.testing.assert_close(rec.canonical, torch.einsum("fji,fpj->fpi", rec.rotations, rec.points3d))
    # Six frames have at most six shapes, so six bases explain them without error.
    torch.testing.assert_close(torch.einsum("fk,kpc->fpc", rec.weights, rec.basis), rec.canonical)
    assert reconstruction(rank=8).basis.shape[0] == 8


def test_mirror_flips_depth_and_keeps_the_image():
    rec = reconstruction()
    other = rec.mirrored()
    torch.testing.assert_close(other.points3d[..., 2], -rec.points3d[..., 2])
    torch.testing.assert_close(other.reproject(), rec.reproject())
    torch.testing.assert_close(torch.linalg.det(other.rotations), torch.ones(6))
    torch.testing.assert_close(other.mirrored().canonical, rec.canonical)
    torch.testing.assert_close(
        torch.einsum("fk,kpc->fpc", other.weights, other.basis),
        torch.einsum("fk,kpc->fpc", rec.weights, rec.basis) * torch.tensor([1.0, 1, -1]),
    )


def test_a_killed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = full_tracks().save(tmp_path / "t.npz")
    before = path.read_bytes()
    monkeypatch.setattr(np, "savez_compressed", lambda *a, **k: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        full_tracks().save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["t.npz"]
