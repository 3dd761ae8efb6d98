"""The page without a browser: what is packed comes back, what is said is true, no stranger's text becomes markup."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
import torch

import torchrecon as tr
from torchrecon.cli import main
from torchrecon.io.frames import encode_stills, open_frames
from torchrecon.linalg.rotations import rotation_from_vector
from torchrecon.pipeline.report import write_report
from torchrecon.viz.report import build_report
from torchrecon.viz.report.payload import Block, pack_bits, pack_series, unpack_bits, unpack_series
from torchrecon.viz.report.series import bone_lengths, deformation
from torchrecon.viz.report.words import absences, unit_of, words

HOSTILE = "<script>window.hacked = 1</script><!-- ]]> {{data}} \u2028 \\u003c"
FRAMES, POINTS = 12, 9


def turning(points: torch.Tensor, frames: int = FRAMES) -> torch.Tensor:
    angle = torch.linspace(0, 2, frames)[:, None] * torch.tensor([0.1, 1.0, 0.2])
    return points @ rotation_from_vector(angle).mT


def made(intrinsics: torch.Tensor | None = None, covariance: bool = False, code: str = "ok") -> tr.Reconstruction:
    g = torch.Generator().manual_seed(0)
    shape = 40 * torch.randn(POINTS, 3, generator=g)
    spread = torch.diag(torch.tensor([1.0, 4.0, 9.0])).expand(FRAMES, POINTS, 3, 3) if covariance else None
    return tr.Reconstruction.from_points(
        turning(shape),
        rotation_from_vector(torch.linspace(0, 2, FRAMES)[:, None] * torch.tensor([0.1, 1.0, 0.2])),
        rank=2,
        status=tr.Status(code, "by hand"),
        translation=torch.tensor([100.0, 90.0, 400.0][: 2 if intrinsics is None else 3]).expand(FRAMES, -1),
        intrinsics=intrinsics,
        covariance3d=spread,
    )


def tracked(rec: tr.Reconstruction, **given) -> tr.Tracks:
    visible = torch.ones(FRAMES, POINTS, dtype=torch.bool)
    visible[4:7, 2] = False
    return tr.Tracks(rec.reproject(), visible, **given)


def film(folder, count: int = FRAMES, size: tuple[int, int] = (120, 160)):
    folder.mkdir()
    rng = np.random.default_rng(0)
    for index in range(count):
        image = cv2.GaussianBlur(rng.integers(0, 255, (*size, 3)).astype(np.uint8), (9, 9), 3)
        image[:, :40] = 8 * index
        cv2.imwrite(str(folder / f"{index:03d}.png"), image)
    return folder


class Parts(HTMLParser):
    """Every element with its attributes and text, as an HTML parser that is not ours sees it."""

    def __init__(self, page: bytes) -> None:
        super().__init__(convert_charrefs=True)
        self.found: list[tuple[str, dict[str, str | None], list[str]]] = []
        self.open = False
        self.feed(page.decode())

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs), []))
        self.open = True

    def handle_endtag(self, tag):
        self.open = False

    def handle_data(self, data):
        if self.open:
            self.found[-1][2].append(data)

    def texts(self, tag: str, **attributes: str) -> list[str]:
        fits = [t for name, have, t in self.found if name == tag and attributes.items() <= have.items()]
        return ["".join(text) for text in fits]

    @property
    def data(self) -> dict:
        return json.loads(self.texts("script", id="data")[0])


@pytest.mark.parametrize("jump", [0.0, 5e4])
def test_series_come_back_within_half_a_step_and_say_what_was_clipped(jump):
    rng = np.random.default_rng(1)
    values = np.cumsum(rng.normal(0, 3, (40, 7)), 0)
    values[20:, 0] += jump
    hidden = rng.random(values.shape) < 0.2
    hidden[0, 1] = True
    block = pack_series(np.where(hidden, np.nan, values), 0.25)
    back = unpack_series(block, 7)
    inside = ~hidden & (np.abs(values) < 0.25 * 32767)
    assert np.abs(back - values)[inside].max() <= 0.125 + 1e-9
    assert block.clipped == (0 if jump == 0 else (~hidden[20:, 0]).sum() + _repeated(hidden[20:, 0]))
    for i, j in zip(*np.nonzero(hidden), strict=True):
        assert back[i, j] == (0 if i == 0 or hidden[: i + 1, j].all() else back[i - 1, j])


def _repeated(hidden: np.ndarray) -> int:
    """Hidden entries that repeat a clipped one before them."""
    return int(sum(hidden[i] and not hidden[:i].all() for i in range(len(hidden))))


def test_extreme_steps_wrap_around_without_loss():
    ends = np.array([[-32767.0], [32767.0], [-32767.0], [0.0], [32767.0]])
    assert unpack_series(pack_series(ends, 1.0), 1).tolist() == ends.tolist()


def test_bits_come_back():
    bits = np.random.default_rng(2).random((13, 7)) < 0.5
    assert np.array_equal(unpack_bits(pack_bits(bits), bits.shape), bits)


def test_deformation_is_the_amplitude_of_the_mode_and_does_not_see_the_turn():
    g = torch.Generator().manual_seed(3)
    mean = torch.randn(30, 3, generator=g)
    mean = mean - mean.mean(0)
    mode = torch.randn(30, 3, generator=g)
    weight = torch.linspace(-0.3, 0.3, 15)
    rotations = rotation_from_vector(torch.linspace(0, 3, 15)[:, None] * torch.tensor([0.3, 1.0, 0.0]))
    points = (mean + weight[:, None, None] * mode) @ rotations.mT
    expected = 100 * weight.abs() * mode.square().sum(-1).mean().sqrt() / mean.square().sum(-1).mean().sqrt()
    found = deformation(points.numpy(), rotations.numpy(), np.ones((15, 30), bool))
    np.testing.assert_allclose(found, expected, atol=1e-9)
    unseen = np.ones((15, 30), bool)
    unseen[4] = False
    assert np.isnan(deformation(points.numpy(), rotations.numpy(), unseen)[4])


def test_bones_of_a_rigid_shape_keep_their_length():
    rec = made()
    lengths = bone_lengths(rec.points3d.numpy(), ((0, 1), (3, 2)))
    expected = [(rec.points3d[0, a] - rec.points3d[0, b]).norm().item() for a, b in ((0, 1), (3, 2))]
    np.testing.assert_allclose(lengths, np.tile(expected, (FRAMES, 1)), rtol=1e-9)


def test_unit_and_mirror_follow_the_camera():
    k = torch.tensor([[500.0, 0, 160], [0, 500, 120], [0, 0, 1]])
    flat, deep = made(), made(k)
    far = tr.Tracks(deep.reproject(), intrinsics=k, depth=deep.points3d[..., 2] + 400)
    assert unit_of(flat, tracked(flat)).short == "px"
    assert unit_of(deep, tracked(deep, intrinsics=k)).short == "u"
    assert unit_of(deep, far).short == "m"
    mirror = "Near and far may be swapped"
    assert mirror in [word.title for word in words(flat, None, None, 1.0, 0)]
    assert mirror not in [word.title for word in words(deep, None, None, 1.0, 0)]


def test_what_limits_the_answer_is_said_and_what_is_absent_is_named():
    rec = made(code="undetermined")
    rank = tr.RankEstimate(
        4, 4.0, torch.ones(6), torch.full((6,), math.nan), (3, 5), "cross_validation", "stack", ("w",)
    )
    said = words(rec, tracked(rec), rank, 0.7, 3)
    text = " ".join(word.text for word in said)
    assert [word.kind for word in said[:3]] == ["warn"] * 3
    for part in ("do not measure", "K = 2; the tracks show K = 4 (between 3 and 5)", "w", "3 of 108", "30 %"):
        assert part in text
    missing = " ".join(absences(rec, tracked(rec), rank, film=False))
    for part in ("Video", "covariance", "Uncertainty", "cross_validation has none", "Bones"):
        assert part in missing
    everything = tracked(rec, covariance=torch.eye(2).expand(FRAMES, POINTS, 2, 2), edges=[(0, 1)])
    good = tr.RankEstimate(2, 2.0, torch.ones(6), torch.ones(6), (2, 2), "mp", "stack")
    assert absences(made(covariance=True), everything, good, film=True) == []


def test_a_page_asks_for_nothing_and_runs_only_its_own_script():
    rec = made()
    page = build_report(rec, tracked(rec), title="clip")
    parts = Parts(page)
    assert not re.search(rb"(?:src|href|srcset|action)\s*=", page.split(b'<script type="application/json"')[0])
    assert not re.search(rb"url\(|@import|https?://(?!www\.w3\.org/2000/svg)", page)
    assert b"innerHTML" not in page
    policy = next(have["content"] for _, have, _ in parts.found if have.get("http-equiv") == "Content-Security-Policy")
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    scripts = [t for name, have, t in parts.found if name == "script" and not have]
    assert len(scripts) == 1

    def digest(text: str) -> str:
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    assert rules["script-src"] == digest("".join(scripts[0]))
    assert rules["style-src"] == digest(parts.texts("style")[0])


def test_hostile_names_stay_text():
    rec = made()
    names = [HOSTILE + str(i) for i in range(POINTS)]
    calm = Parts(build_report(rec, tracked(rec, names=["n"] * POINTS, edges=[(0, 1)]), title="t", command="c"))
    page = build_report(rec, tracked(rec, names=names, edges=[(0, 1)]), title=HOSTILE, command=HOSTILE)
    parts = Parts(page)
    assert [tag for tag, _, _ in parts.found] == [tag for tag, _, _ in calm.found]
    assert b"<script>window" not in page
    assert parts.texts("title") == [HOSTILE]
    assert (parts.data["title"], parts.data["names"], parts.data["made"]["command"]) == (HOSTILE, names, HOSTILE)
    assert HOSTILE in parts.data["bones"][0]["name"]


def test_what_is_not_finite_never_reaches_the_page():
    rec = made(covariance=True)
    rec.points3d[3:5, 1] = math.nan
    rec.covariance3d[2, 0] = math.inf
    parts = Parts(build_report(rec, tracked(made(), edges=[(0, 1)]), settings={"rate": math.nan, "deep": [math.inf]}))
    raw = parts.texts("script", id="data")[0]
    assert not re.search(r"NaN|Infinity", raw)
    assert parts.data["bones"][0]["values"][3] is None
    assert any("2 of 108" in word["text"] for word in parts.data["words"])
    known = unpack_bits(Block(text=parts.texts("script", id="block-known")[0]), (FRAMES, POINTS))
    assert (~known).nonzero()[0].tolist() == [3, 4]


def test_positions_on_the_page_are_those_of_the_reconstruction():
    rec = made()
    parts = Parts(build_report(rec, tracked(rec)))
    block = Block(text=parts.texts("script", id="block-points")[0], step=parts.data["steps"]["points"])
    found = unpack_series(block, 3 * POINTS).reshape(FRAMES, POINTS, 3)
    assert np.abs(found - rec.points3d.numpy()).max() < 1e-3 * rec.points3d.abs().max()


def test_the_film_gets_what_the_page_leaves_and_the_page_keeps_its_size(tmp_path):
    source = open_frames(film(tmp_path / "frames"))
    rec = made()
    empty = len(build_report(rec, tracked(rec)))
    for limit in (empty + 20_000, 8_000_000):
        page = build_report(rec, tracked(rec), film=lambda room: encode_stills(source, room), max_bytes=limit)
        assert empty < len(page) <= limit
        parts = Parts(page)
        sizes, every = parts.data["film"]["sizes"], parts.data["film"]["every"]
        joined = base64.b64decode(parts.texts("script", id="block-film")[0])
        assert len(joined) == sum(sizes)
        ends = np.cumsum(sizes)
        for index, (end, size) in enumerate(zip(ends, sizes, strict=True)):
            image = cv2.imdecode(np.frombuffer(joined[end - size : end], np.uint8), cv2.IMREAD_COLOR)
            assert abs(float(image[:, : image.shape[1] // 8].mean()) - 8 * index * every) < 4
    with pytest.raises(tr.ReconError, match="allow more"):
        build_report(rec, tracked(rec), max_bytes=empty - 1)


def test_too_many_points_are_thinned_but_bones_stay():
    g = torch.Generator().manual_seed(5)
    points = torch.randn(30, 600, 3, generator=g)
    rec = tr.Reconstruction.from_points(
        points, torch.eye(3).expand(30, 3, 3), rank=1, status=tr.Status("ok", "noise"), translation=torch.ones(30, 2)
    )
    tracks = tr.Tracks(rec.reproject(), edges=[(1, 599), (3, 5)])
    data = Parts(build_report(rec, tracks, max_bytes=260_000)).data
    assert data["drawn"] < data["points"] == 600
    assert [[data["ids"][a], data["ids"][b]] for a, b in data["edges"]] == [[1, 599], [3, 5]]
    assert any("of 600 points are drawn" in word["text"] for word in data["words"])


def test_stills_fit_and_thin_out(tmp_path):
    source = open_frames(film(tmp_path / "frames", size=(60, 80)))
    whole = encode_stills(source, 10_000_000)
    assert (len(whole.images), whole.every, whole.size) == (FRAMES, 1, (60, 80))
    for frame, image in zip(source, whole.images, strict=True):
        decoded = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        assert cv2.PSNR(decoded, (frame.permute(1, 2, 0).numpy() * 255).astype(np.uint8)) > 30
    few = encode_stills(source, 4_000)
    assert few.every > 1
    assert len(few.images) == math.ceil(FRAMES / few.every)
    assert sum(map(len, few.images)) <= 4_000
    with pytest.raises(tr.ReconError, match="not even one"):
        encode_stills(source, 100)


def test_what_does_not_fit_is_refused(tmp_path):
    rec = made()
    batch = tr.Reconstruction.from_points(
        torch.randn(2, 4, 5, 3),
        torch.eye(3).expand(2, 4, 3, 3),
        rank=torch.tensor([1, 1]),
        status=(tr.Status("ok", "a"),) * 2,
    )
    with pytest.raises(tr.ReconError, match="index the batch"):
        build_report(batch)
    with pytest.raises(tr.ReconError, match="the tracks are"):
        build_report(rec, tr.Tracks(torch.rand(FRAMES, POINTS + 1, 2)))
    with pytest.raises(tr.ReconError, match="has 5 frames, the reconstruction 12"):
        write_report(rec, tmp_path / "r.html", video=film(tmp_path / "short", 5))


def test_the_command_writes_a_page(tmp_path, capsys):
    rec = made()
    path, tracks = rec.save(tmp_path / "rec.npz"), tracked(rec).save(tmp_path / "tracks.npz")
    frames, out = film(tmp_path / "frames"), tmp_path / "a page.html"
    command = ["report", str(path), "-o", str(out), "--tracks", str(tracks), "--video", str(frames)]
    assert main([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["bytes"] == out.stat().st_size
    data = Parts(out.read_bytes()).data
    assert data["rank"]["estimate"]["k"] == tr.estimate_rank(tr.load_tracks(tracks)).rank
    assert f"--tracks {tracks}" in data["made"]["command"]
    assert f"'{out}'" in data["made"]["command"]
    assert data["made"]["versions"]["torch"] == torch.__version__
    assert main(["report", str(tmp_path / "none.npz"), "-o", str(out)]) == 2
    assert "no such file" in capsys.readouterr().err
