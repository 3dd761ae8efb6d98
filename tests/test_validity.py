"""What is said of a recogniser: errors, confusion, calibration; and what its training may and may not see."""

from __future__ import annotations

import pytest
import torch

from torchrecon.data.mocap import MocapClip
from torchrecon.data.synthetic import sample_body, sample_motion
from torchrecon.models.recogniser import ReadOut, Recogniser
from train import recogniser
from train.films import MOCAP_CLASSES, Augmentation, Film
from train.validity import Reading, calibration, confusion, error_rates, report_text, validity


def test_a_coin_that_is_right_as_often_as_it_says_is_calibrated(generator):
    classes, windows = 4, 40_000
    logits = 2 * torch.randn(windows, classes, generator=generator)
    truth = torch.multinomial(logits.softmax(-1), 1, generator=generator)[:, 0]

    def ece(sharpness):
        said = (sharpness * logits).softmax(-1)
        return calibration([Reading(k, said[truth == k]) for k in range(classes)])["ece"]

    assert ece(1.0) < 0.01
    # Twice as sure of itself: what it says is too high by the difference of the means, since it is so in every bin.
    sharper = (2 * logits).softmax(-1)
    gap = sharper.amax(-1).mean() - (sharper.argmax(-1) == truth).double().mean()
    assert ece(2.0) == pytest.approx(float(gap), abs=0.01)
    assert float(gap) > 0.05


def test_errors_are_those_of_the_confusion(generator):
    readings = [Reading(k % 3, torch.rand(5, 3, generator=generator).softmax(-1)) for k in range(12)]
    table = confusion(readings, ("run", "jump", "idle"))
    assert sum(sum(row.values()) for row in table.values()) == 60
    rates = error_rates(table)
    for index, name in enumerate(("run", "jump", "idle")):
        said = torch.cat([r.probabilities.argmax(-1) for r in readings if r.label == index])
        assert rates[name] == pytest.approx(100 * float((said != index).double().mean()))
    assert rates["mean"] == pytest.approx((rates["run"] + rates["jump"]) / 2)  # idle is no action of the paper


def test_report_names_every_source(generator):
    torch.set_default_dtype(torch.float32)
    shown = []
    for label in (0, 1):
        points = torch.randn(40, 80, 3, generator=generator)
        eye = torch.eye(3).expand(40, 3, 3)
        shown.append(Film(points, torch.ones(40, 80, dtype=torch.bool), eye, torch.full((80,), 0.1), label))
    always = Recogniser(("shoot", "run", "flat"), ReadOut(views=("top",), yaws=1)).eval()
    with torch.no_grad():
        always.to_classes.bias[0] = 1e3
    figures = validity(always, shown, ["A", "B"])
    assert figures["true_3d"] == {"shoot": 0.0, "run": 100.0, "mean": 50.0}
    assert figures["by_source"] == {"A": {"shoot": 0.0, "mean": 0.0}, "B": {"run": 100.0, "mean": 100.0}}
    assert figures["confusion"]["run"] == {"shoot": 3, "run": 0, "flat": 0}
    assert figures["calibration"]["ece"] == pytest.approx(0.5)
    assert not figures["valid"]
    text = report_text(figures)
    assert "A: shoot 0.0 %" in text
    assert "error 0.500" in text


def _clips(generator, subjects):
    """One clip of each class but dribble for every subject."""
    motion = sample_motion("run", sample_body(generator), frames=40, generator=generator)
    return [
        MocapClip(motion.joints, motion.parents, motion.names, 30.0, name, subject, source=f"source of {subject}")
        for name in MOCAP_CLASSES
        for subject in subjects
        if name != "dribble"
    ]


def test_excluded_subjects_are_validated_on_and_never_trained_on(generator, monkeypatch):
    clips = _clips(generator, ("a", "b"))
    monkeypatch.setattr(recogniser, "load_mocap", lambda file, labels: [c for c in clips if c.label in labels])
    data = recogniser.Films(Augmentation(), file="x.npz", exclude=["b"], films=12, points=20, workers=1)
    maker = data._maker()
    assert {clip.subject for of_class in maker.keywords["clips"].values() for clip in of_class} == {"a"}
    shown, sources = data.validation(300.0, "films")
    assert {(MOCAP_CLASSES[film.label], source) for film, source in zip(shown, sources, strict=True)} == {
        (name, f"source of b {name}") for name in ("shoot", "run", "jump", "pass")
    }
    assert len(shown) == 4


def test_another_seed_is_other_films_and_weights_and_stays_within_the_training_seeds():
    words = recogniser._plain(["--seed", "3"])
    assert words[words.index("--seed_everything") + 1] == "3"
    first = int(words[words.index("--data.train_seeds") + 1])
    assert first >= 1_000_000 + 720
    last = recogniser._plain([f"--seed={recogniser.MAX_SEED}"])
    assert int(last[last.index("--data.train_seeds") + 1]) + recogniser.SEED_STRIDE <= 2_000_000
    for bad in ("-1", "16", "x"):
        with pytest.raises(SystemExit):
            recogniser._plain(["--seed", bad])
