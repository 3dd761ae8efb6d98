"""The page of everything: verdicts on hand-made results, and a page that needs no other file."""

from __future__ import annotations

import argparse
import os
import re
import subprocess
from pathlib import Path

import pytest

from eval import all as everything
from eval.claims import CLAIMS, Verdict, judge
from eval.job import write_json
from eval.tables import NAMES, PAPER, VIEWS


def picture_table(number: int, default: float, others: float) -> dict:
    """Two frames, every view alike: the default's figure and that of the five others, which vary by a tenth."""
    rows = []
    for key in PAPER[number]:
        value = default if key == "default" else others
        spread = [value, value * (1.0 if key == "default" else 1.1)]
        rows.append({"key": key, NAMES[number]: dict.fromkeys(VIEWS, spread)})
    return {"frames": [10, 20], "reference": [10, 20], "rows": rows}


def verdict(text: str, results: dict) -> Verdict:
    (claim,) = (claim for claim in CLAIMS if claim.text == text)
    return judge(claim, results)


@pytest.mark.parametrize(("number", "best", "text"), [
    (3, 40.0, "Its PSNR is the highest at every frame."),
    (4, 0.95, "Its SSIM is the highest at every frame."),
    (5, 0.001, "Its MSE is the lowest at every frame."),
])  # fmt: skip
def test_the_better_direction_of_each_table(number, best, text):
    worse = 0.7 * best if number != 5 else 2 * best
    assert verdict(text, {f"table{number}": picture_table(number, best, worse)}).holds
    lost = verdict(text, {f"table{number}": picture_table(number, worse, best)})
    assert lost.holds is False
    assert "best in 0 of 6 cells" in lost.why


def test_fluctuation_is_the_range_over_frames():
    steady = verdict("Its SSIM fluctuates least.", {"table4": picture_table(4, 0.9, 0.5)})
    assert steady.holds
    assert "input 0 against 0.05" in steady.why


def test_recognition_is_compared_with_the_papers_rows_only():
    def row(key: str, error: float) -> dict:
        cells = {name: {"error": error} for name in ("run", "mean")}
        return {"key": key, "cells": cells, "paper": {"run": 20.51} if key == "default" else {}}

    table = {"rows": [row("default", 10.0), row("ref4", 9.0), row("ref5", 30.0), row("true3d", 0.0)]}
    first = verdict("Its recognition error is the lowest in all four actions.", {"table1": table})
    assert first.holds is False
    assert "-1.0 points" in first.why
    assert verdict("Its recognition error is 21.22, 20.51, 20.97 and 21.08 %.", {"table1": table}).holds
    assert "ref4, default, ref5" in verdict(
        "The method of Ref. 4 has the highest recognition error.", {"table1": table}
    ).why  # fmt: skip


def test_disparity_is_judged_on_the_default_and_a_missing_figure_is_not_judged():
    def cell(frames: int, snr: float, disparity: float | None, solver: str = "auto") -> dict:
        fields = {"body": "rigid", "turn": 60.0, "frames": frames, "snr": snr, "solver": solver}
        return {**fields, "disparity": disparity, "floor": 2e-3}

    records = [cell(50, 0.0, 1e-1), cell(100, 0.0, 1e-2), cell(50, 30.0, 2e-4), cell(100, 30.0, 1e-4)]
    records += [cell(200, 30.0, None), cell(100, 0.0, 9.0, "rigid")]
    results = {"figures": {"figures": {"9": {"records": records}}}}
    falls = verdict("Pro-D falls as the number of frames F grows.", results)
    assert falls.holds
    assert "in 2 of 2 series" in falls.why
    assert verdict("Pro-D falls as the SNR grows.", results).holds
    below = verdict("At F = 100 Pro-D is below 1e-3 whatever the SNR.", results)
    assert below.holds is False
    assert "everywhere only at 30 dB" in below.why
    for claim in CLAIMS:
        if claim.needs == "figures":
            assert judge(claim, {"figures": {"figures": {}}}).holds is None
        assert judge(claim, {}).holds is None


def test_the_page_holds_its_pictures_and_says_what_is_missing(tmp_path, capsys):
    folder = tmp_path / "tables-turning"
    write_json(folder / "table5.json", {**picture_table(5, 0.001, 0.002), "provenance": {"commit": "abc"}})
    (folder / "table5.txt").write_text("Table 5: 1 < 2 & 3\n")
    figures = tmp_path / "figures-turning"
    write_json(figures / "figures.json", {"figures": {}})
    (figures / "figures.txt").write_text("")
    (figures / "figure1.png").write_bytes(b"\x89PNG")
    assert everything.main(["--page", "-o", str(tmp_path)]) == 0
    page = (tmp_path / "all-turning.html").read_text()
    assert "1 &lt; 2 &amp; 3" in page
    assert "data:image/png;base64,iVBORw==" in page
    assert "not computed; <code>python -m eval.table1</code>" in page
    assert "best in 6 of 6 cells" in page
    # Nothing is fetched from anywhere.
    assert not re.findall(r"(?:src|href)=['\"](?!data:)", page)
    assert "does not hold" not in capsys.readouterr().out.split("Its MSE is the lowest")[1].splitlines()[1]


def test_a_job_that_fails_is_named_and_the_page_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(everything, "jobs_of", lambda *_: [everything.Job("table9", "eval.nowhere", Path("x"))])
    assert everything.main(["-o", str(tmp_path)]) == 2
    assert "No module named eval.nowhere" in capsys.readouterr().err
    assert "table9 ended with exit code 1" in (tmp_path / "all-turning.html").read_text()
    assert everything.main(["--only", "table1", "-o", str(tmp_path)]) == 2
    assert "--only table1: is not one of table9" in capsys.readouterr().err


def test_claims_about_bases_and_stages_are_read_from_the_ablation():
    def row(solver: str, errors: list[float], minimum: float) -> dict:
        return {"solver": solver, "assumed": [2, 4, 8], "error3d_camera": errors, "minimum": minimum}

    near, far = row("em_ppca", [0.3, 0.1, 0.2], 1.0), row("csf", [0.1, 0.4, 0.5], 0.5)
    bases = {"true": 4, "rows": [near], "estimates": {"paper": [7, 6], "auto": [4, 3]}}
    text = "A wrongly estimated number of shape bases makes it fail."
    assert verdict(text, {"ablation": {"bases": bases}}).holds
    lost = verdict(text, {"ablation": {"bases": {**bases, "rows": [near, far]}}})
    assert lost.holds is False
    assert "csf least at 0.5 x the true K, 5.0 times that at 2 x" in lost.why
    counted = verdict("Eigenvalues above one, counted and divided by 6, are K.", {"ablation": {"bases": bases}})
    assert counted.holds is False
    assert counted.why == "the true K in 0 of 2 films, +2.5 in the mean; our rule in 1"

    def variant(key: str, default: float, other: float | None) -> dict:
        return {"key": key, "error3d_camera": {"auto": default, "em_ppca": other}}

    stages = [variant("whole", 0.1, 0.2), variant("no-covariance", 0.15, None), variant("fill-abg", 0.05, 0.3)]
    results = {"ablation": {"stages": {"variants": stages}}}
    assert verdict("The covariance of the tracks helps.", results).holds
    assert verdict("Filling gaps by prediction helps.", results).holds is False
    for claim in CLAIMS:
        if claim.needs == "ablation":
            assert judge(claim, {"ablation": {}}).holds is None


def test_a_job_is_kept_while_its_code_and_result_are_the_same(tmp_path, monkeypatch):
    job = everything.Job("said", "eval.said", tmp_path / "said", ("word",), prints=True, takes=("seed",))
    commands = []

    def run(command, **_):
        commands.append(command[3:])
        write_json(job.out / "said.json", {})
        return subprocess.CompletedProcess(command, 0, stdout="a word\n", stderr="")

    monkeypatch.setattr(everything.subprocess, "run", run)
    arguments = argparse.Namespace(seed=3, smoke=True, fresh=False)
    assert everything.run_job(job, arguments) is None
    assert commands == [["-o", str(job.out), "word", "--seed", "3"]]
    assert (job.out / "said.txt").read_text() == "a word\n"
    assert everything.run_job(job, arguments) is None
    assert len(commands) == 1
    monkeypatch.setattr(everything, "source_digest", lambda *_: "changed")
    assert everything.run_job(job, arguments) is None
    assert len(commands) == 2
    later = (job.out / "said.json").stat().st_mtime + 100
    os.utime(job.out / "said.json", (later, later))  # by somebody else
    assert everything.run_job(job, arguments) is None
    assert len(commands) == 3
    os.utime(job.out / "said.json", (later - 200, later - 200))
    arguments.fresh = True
    assert everything.run_job(job, arguments) is None
    assert len(commands) == 4
