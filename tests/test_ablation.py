"""The ablation job: bodies of known K, noise of the covariance that is told, stages that do what their name says."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from eval.ablation import bases, depth, stages
from eval.ablation.__main__ import RECOGNISER, _recogniser
from eval.ablation.draw import draw
from eval.ablation.world import Person, film_person, noisy
from eval.job import Cache, write_arrays

PERSON = Person("jump", 3, 40, 30, 3)


def test_the_body_has_exactly_its_bases_and_turns_rigidly():
    scene = film_person(PERSON)
    body = scene.truth @ scene.rotations
    values = torch.linalg.svdvals(body.flatten(1))
    assert float(values[2] / values[0]) > 1e-4
    assert float(values[3] / values[0]) < 1e-12
    assert float(scene.truth.mean(1).abs().max()) < 1e-9
    eye = torch.eye(3, dtype=torch.float64).expand(40, 3, 3)
    torch.testing.assert_close(scene.rotations @ scene.rotations.mT, eye)
    assert torch.equal(torch.linalg.det(scene.rotations).round(), torch.ones(40, dtype=torch.float64))


def test_the_head_is_above_the_feet_in_the_picture():
    # y down in the camera, y up in the world: the world axis e_y points up in the image all the time.
    assert bool((film_person(PERSON).rotations[:, 1, 1] < -0.9).all())


def test_noise_is_that_of_the_covariance_and_of_the_ratio():
    person = replace(PERSON, frames=400, points=40)
    scene = film_person(person)
    tracks = noisy(scene, person, 20.0, anisotropy=3.0, spread=0.5)
    noise = tracks.xy - 300 - scene.truth[..., :2]
    white = torch.linalg.solve(torch.linalg.cholesky(tracks.covariance), noise[..., None])[..., 0]
    found = torch.einsum("fpa,fpb->ab", white, white) / (400 * 40)
    torch.testing.assert_close(found, torch.eye(2, dtype=torch.float64), atol=0.04, rtol=0)
    told = tracks.covariance.diagonal(dim1=-2, dim2=-1).mean()
    assert float(scene.truth[..., :2].square().mean() / told) == pytest.approx(100.0, rel=1e-9)


def test_gaps_have_two_ends_and_the_share_that_was_asked_for():
    visible = noisy(film_person(PERSON), PERSON, 20.0, missing=0.2).visible
    assert bool(visible[0].all() & visible[-1].all())
    assert 0.2 <= float((~visible).double().mean()) < 0.22


def test_every_variant_differs_from_the_whole_in_what_it_says():
    tracks = noisy(film_person(PERSON), PERSON, 20.0, missing=0.1)
    by_key = {variant.key: variant for variant in stages.variants(3)}
    assert by_key["whole"].prepare(tracks) is tracks
    assert by_key["no-covariance"].prepare(tracks).covariance is None
    assert by_key["rank-true"].rule == 3
    for key in ("fill-abg", "paper"):
        filled = by_key[key].prepare(tracks)
        assert bool(filled.visible.all())
        assert torch.equal(filled.xy[tracks.visible], tracks.xy[tracks.visible])


def test_stages_are_scored_from_the_cache_and_a_refusal_is_no_mean_of_the_others(tmp_path):
    persons = [PERSON, replace(PERSON, seed=4)]
    cache = Cache(tmp_path / "cache", {})
    flat = torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    for person in persons:
        truth = film_person(person).truth
        arrays = {f"{key} K": torch.tensor(2) for key in stages.VARIANTS}
        arrays |= {f"{key} em_ppca": truth * (1.0 if key == "whole" else flat) for key in stages.VARIANTS}
        if person is persons[1]:
            del arrays["paper em_ppca"]
            arrays["paper em_ppca note"] = torch.tensor(0)
        visible = torch.ones(40, 30, dtype=torch.bool)
        write_arrays(cache.path("stages", f"{person}.npz"), {**arrays, "truth": truth, "visible": visible})
    found = stages.measure_stages(persons, cache, 1)
    by_key = {row["key"]: row for row in found["variants"]}
    assert by_key["whole"]["error3d_camera"]["em_ppca"] < 1e-9
    assert by_key["rank-paper"]["error3d_camera"]["em_ppca"] > 0.1
    assert by_key["paper"]["error3d_camera"]["em_ppca"] is None
    assert list(by_key["paper"]["notes"]) == [f"{persons[1]}, em_ppca"]
    assert any("no answer" in line for line in stages.stage_lines(found))


def test_the_least_error_is_found_and_the_thesis_judged(tmp_path):
    cache = Cache(tmp_path / "cache", {})
    scene = film_person(PERSON)
    g = torch.Generator().manual_seed(0)
    noise = torch.randn(scene.truth.shape, generator=g, dtype=torch.float64)
    arrays = {"K paper": torch.tensor(9), "K auto": torch.tensor(4), "auto 4": scene.truth}
    for solver, best in (("em_ppca", 4), ("bmm", 8), ("csf", 5)):
        arrays |= {f"{solver} {k}": scene.truth + (1 + abs(k - best)) * noise for k in bases.ASSUMED}
    path = cache.path("bases", f"{PERSON}.npz")
    write_arrays(path, {**arrays, "truth": scene.truth, "rotations": scene.rotations})
    found = bases.measure_bases([PERSON], cache, None, 1)
    assert [row["minimum"] for row in found["rows"]] == [1.0, 2.0, 1.25]
    text = "\n".join(bases.bases_lines(found))
    assert text.count("the thesis holds") == 2
    assert text.count("the thesis does not hold") == 1
    assert found["default"]["error3d_camera"] < 1e-9
    assert found["ceiling"] is None
    draw({"bases": found}, tmp_path / "ablation.png")
    assert (tmp_path / "ablation.png").stat().st_size > 1000


def test_stages_of_the_depth_cut_what_their_name_says():
    g = torch.Generator().manual_seed(0)
    # A flat body at 3 m before a wall at 5 m; the contour is a pixel too wide on the left.
    exact = torch.full((60, 80), 5.0)
    exact[15:45, 30:50] = 3.0
    depth_image = exact + 0.02 * torch.randn(60, 80, generator=g)
    mask = torch.zeros(60, 80, dtype=torch.bool)
    mask[15:45, 29:50] = True
    k = torch.tensor([[80.0, 0, 40], [0, 80.0, 30], [0, 0, 1]])
    found = {v.key: depth.body_of(depth_image, mask, k, v) for v in depth.VARIANTS}
    inside = torch.zeros_like(mask)
    inside[18:42, 33:47] = True
    error = {key: float((image - exact)[inside].nan_to_num(1.0).square().mean().sqrt()) for key, image in found.items()}
    assert error["whole"] < 0.5 * error["no-filter"]
    assert float(torch.isfinite(found["no-box"][:, 29]).double().sum()) == 30
    assert not bool(torch.isfinite(found["whole"][16:44, 29]).any())
    assert not bool(torch.isfinite(found["whole"][~mask]).any())
    assert bool(torch.isfinite(found["raw"]).all())
    assert torch.equal(found["raw"], depth_image)


def test_a_recogniser_that_was_never_trained_is_no_error(tmp_path):
    assert _recogniser(tmp_path / "none.safetensors") is None
    assert RECOGNISER.name == "recogniser.safetensors"
