"""Batches: what is done, what is done again, what a crash or a kill leaves."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import torchrecon as tr
from tests.kill import check_whole, die_on_two, kill_after, results
from torchrecon.cli import main
from torchrecon.errors import ReconError
from torchrecon.io.frames import find_recording
from torchrecon.pipeline import batch as module
from torchrecon.pipeline.batch import BatchSettings, find_items, run_batch, run_item
from torchrecon.pipeline.workers import Died, work_through

SETTINGS = BatchSettings(rank=1, solver="rigid")


def write_tracks(path: Path, seed: int) -> Path:
    g = torch.Generator().manual_seed(seed)
    angle = torch.linspace(0, 3, 24)
    c, s, o = angle.cos(), angle.sin(), torch.zeros(24)
    turn = torch.stack([c, o, s, o, o + 1, o, -s, o, c], -1).reshape(24, 3, 3)
    xy = 50 * (torch.randn(14, 3, generator=g) @ turn.mT)[..., :2] + 0.01 * torch.randn(24, 14, 2, generator=g)
    return tr.Tracks(xy).save(path)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "in"
    made.mkdir()
    for seed, name in enumerate(("b", "a", "c")):
        write_tracks(made / f"{name}.npz", seed)
    (made / "broken.npz").write_bytes(b"PK\x03\x04 not really")
    (made / "notes.txt").write_text("mine")
    return made


def states(manifest: dict) -> dict[str, str]:
    return {item["name"]: item["status"] for item in manifest["items"]}


def test_every_item_has_a_status_and_a_second_run_does_only_what_is_missing(folder, tmp_path, monkeypatch):
    out = tmp_path / "out"
    manifest = run_batch(folder, out, SETTINGS, workers=0)
    assert states(manifest) == {"a": "done", "b": "done", "c": "done", "broken": "failed", "notes": "skipped"}
    assert manifest == json.loads((out / "manifest.json").read_text())
    reasons = {item["name"]: item["reason"] for item in manifest["items"]}
    assert "not a readable .npz" in reasons["broken"]
    assert reasons["a"].startswith("ok")
    alone = tr.reconstruct(tr.load_tracks(folder / "a.npz"), 1, "rigid", generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(tr.Reconstruction.load(out / "a" / "reconstruction.npz").points3d, alone.points3d)

    done: list[str] = []
    monkeypatch.setattr(module, "run_item", lambda item, **rest: done.append(item.name) or run_item(item, **rest))

    def again() -> list[str]:
        done.clear()
        run_batch(folder, out, SETTINGS, workers=0)
        return done

    assert again() == ["broken"]
    write_tracks(folder / "broken.npz", 7)
    assert again() == ["broken"]
    assert again() == []
    (out / "b" / "reconstruction.npz").unlink()
    write_tracks(folder / "c.npz", 8)  # another input under an old name
    os.utime(folder / "c.npz", ns=(1, 1))
    assert again() == ["b", "c"]
    before = (out / "a" / "reconstruction.npz").stat().st_mtime_ns
    with pytest.raises(ReconError, match="other settings"):
        run_batch(folder, out, BatchSettings(rank=2, solver="rigid"), workers=0)
    assert (out / "a" / "reconstruction.npz").stat().st_mtime_ns == before
    assert states(run_batch(folder, out, BatchSettings(rank=2, solver="rigid"), workers=0, force=True))["a"] == "done"
    assert tr.Reconstruction.load(out / "a" / "reconstruction.npz").rank == 2


def test_names_kinds_and_refusals(tmp_path, capsys):
    made = tmp_path / "in"
    for name in ("images", "keypoints", "empty", "earlier"):
        (made / name).mkdir(parents=True)
    for name in ("images/0.png", "keypoints/0.json", "earlier/run.json", "walk.MP4", "walk.npz", ".hidden.mp4"):
        (made / name).touch()
    kinds = {item.name: item.kind for item in find_items(made, made / "out")}
    assert kinds == {
        "images": "video",
        "keypoints": "tracks",
        "empty": "skipped",
        "earlier": "skipped",
        "walk.MP4": "video",
        "walk.npz": "tracks",
    }
    with pytest.raises(ReconError, match="no such folder"):
        find_items(tmp_path / "none", tmp_path)
    with pytest.raises(ReconError, match="holds no video"):
        find_items(made / "empty", tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "holiday.txt").touch()
    write_tracks(made / "walk.npz", 0)
    assert main(["batch", str(made), "-o", str(tmp_path / "mine"), "--workers", "0"]) == 2
    assert "--force" in capsys.readouterr().err
    assert main(["batch", str(made), "-o", str(tmp_path / "out"), "--workers", "-1"]) == 2
    capsys.readouterr()
    command = ["batch", str(made), "-o", str(tmp_path / "out"), "--workers", "0", "--rank", "1", "--solver", "rigid"]
    assert main([*command, "--json"]) == 2  # some items failed: said in words, counted on stdout
    printed = capsys.readouterr()
    assert json.loads(printed.out) == {"done": 1, "failed": 3, "skipped": 2, "out": str(tmp_path / "out")}
    assert "images, keypoints, walk.MP4: failed" in printed.err
    assert "Traceback" not in printed.err


def test_a_folder_with_frames_brings_its_masks_depth_and_camera(tmp_path, monkeypatch):
    for name in ("all/frames", "all/masks", "all/depth", "bare/frames", "images"):
        (tmp_path / "in" / name).mkdir(parents=True)
    (tmp_path / "in" / "images" / "0.png").touch()
    (tmp_path / "in" / "all" / "cameras.json").touch()
    given: dict[str, list[object]] = {}

    def record(video, out, *, camera, **rest):
        beside = find_recording(video)
        paths = (video, beside.masks, beside.depth, camera)
        given[out.name] = [None if p is None else str(p.relative_to(tmp_path)) for p in paths]
        raise ReconError("seen")

    monkeypatch.setattr(module, "reconstruct_video", record)
    settings = BatchSettings(camera=tmp_path / "common.json")
    assert set(states(run_batch(tmp_path / "in", tmp_path / "out", settings, workers=0)).values()) == {"failed"}
    assert given == {
        "all": ["in/all", "in/all/masks", "in/all/depth", "in/all/cameras.json"],
        "bare": ["in/bare", None, None, "common.json"],
        "images": ["in/images", None, None, "common.json"],
    }


def test_an_unexpected_error_is_recorded_and_the_next_item_runs(folder, tmp_path, monkeypatch):
    def fail(path):
        if path.stem == "a":
            raise ZeroDivisionError("a bug")
        return tr.load_tracks(path)

    monkeypatch.setattr(module, "load_tracks", fail)
    manifest = run_batch(folder, tmp_path / "out", SETTINGS, workers=0)
    assert states(manifest)["a"] == "failed"
    assert states(manifest)["b"] == "done"
    assert "ZeroDivisionError: a bug" in (tmp_path / "out" / "a" / "error.txt").read_text()


def test_a_process_that_dies_loses_its_item_only():
    found = dict(work_through(die_on_two, range(4), workers=1))
    assert {item: result for item, result in found.items() if item != 2} == {0: 0, 1: 10, 3: 30}
    assert isinstance(found[2], Died)
    assert found[2].code == -signal.SIGKILL


def test_a_killed_batch_leaves_whole_files_and_the_next_run_finishes(folder, tmp_path):
    run_batch(folder, tmp_path / "calm", SETTINGS, workers=0)
    out = tmp_path / "out"
    command = ["torchrecon", "batch", str(folder), "-o", str(out), "--rank", "1", "--solver", "rigid", "--workers", "0"]
    assert kill_after(command, lambda: (out / "a" / "reconstruction.npz").exists())
    check_whole(out)
    run_batch(folder, out, SETTINGS, workers=0)
    assert results(out) == results(tmp_path / "calm")


DDP_JOB = """
import sys
from lightning import Trainer
from torchrecon.pipeline.batch import BatchSettings
from torchrecon.pipeline.predict import BatchPredictor

trainer = Trainer(
    accelerator="cpu", devices=2, strategy="ddp", logger=False, enable_progress_bar=False, enable_model_summary=False
)
trainer.predict(BatchPredictor(sys.argv[1], sys.argv[2], BatchSettings(rank=1, solver="rigid")))
"""


def test_two_processes_of_torchrun_share_the_work(folder, tmp_path):
    calm, out = tmp_path / "calm", tmp_path / "out"
    run_batch(folder, calm, SETTINGS, workers=0)
    (tmp_path / "job.py").write_text(DDP_JOB)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1]), "OMP_NUM_THREADS": "1"}
    command += [str(tmp_path / "job.py"), str(folder), str(out)]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False, cwd=tmp_path, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert results(out) == results(calm)
