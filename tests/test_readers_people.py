"""People through the frames of files that list them in any order."""

from __future__ import annotations

import json

import numpy as np
import pytest

import torchrecon as tr
from tests import track_files as files
from tests.reading import check, load
from tests.track_files import scores, walk
from torchrecon.io.readers import Source
from torchrecon.io.readers.people import Detection, follow


def crossing(seed, frames=80, joints=17, noise=1.5, lost=0.15):
    """Two people who walk through each other, listed in random order, with misses and hidden joints; and the truth."""
    rng = np.random.default_rng(seed)
    body = rng.uniform([-25, -80], [25, 80], (2, joints, 2))
    truth = np.empty((2, frames, joints, 2))
    found = {}
    for t in range(frames):
        listed = []
        for i in range(2):
            swing = 8 * np.sin(0.3 * t + np.arange(joints) + i)[:, None] * [1.0, 0.2]
            truth[i, t] = body[i] + [150 + 4 * t, 200] + swing if i == 0 else body[i] + [450 - 4 * t, 205] + swing
            if rng.random() > lost:
                xy = truth[i, t] + noise * rng.standard_normal((joints, 2))
                confidence = np.where(rng.random(joints) < 0.1, 0.0, rng.uniform(0.3, 1.0, joints))
                listed.append(Detection(xy, confidence))
        found[t] = [listed[k] for k in rng.permutation(len(listed))]
    return found, truth


def test_crossing_people_keep_their_identity(tmp_path):
    source = Source(tmp_path)
    for seed in range(6):
        found, truth = crossing(seed)
        people = follow(source, found)
        assert len(people[1].seen) > 55
        assert len(people) == 2, seed
        owners = []
        for person in people[:2]:
            errors = [
                [np.nanmedian(np.linalg.norm(d.xy - truth[i, t], axis=-1)) for i in range(2)]
                for t, d in person.seen.items()
            ]
            near = np.argmin(errors, axis=1)
            owners.append(int(np.median(near)))
            assert (near == owners[-1]).all(), seed
        assert sorted(owners) == [0, 1]


def test_prediction_tells_people_of_one_shape_apart(tmp_path):
    """They meet in frame 8, where both are lost; by their last positions alone they would be swapped."""
    body = np.random.default_rng(0).uniform([-25, -80], [25, 80], (17, 2))
    x = np.stack([200 + 6 * np.arange(17), 300 - 6 * np.arange(17)])
    assert np.abs(x[:, 9] - x[:, 7]).sum() > np.abs(x[:, 9] - x[::-1, 7]).sum()
    sure = np.ones(17)
    found = {t: [Detection(body + np.array([x[i, t], 200]), sure) for i in (t % 2, 1 - t % 2)] for t in range(17)}
    found[8] = []
    first = follow(Source(tmp_path), found)[0]
    seen = [first.seen[t].xy[0, 0] - body[0, 0] for t in sorted(first.seen)]
    assert seen == pytest.approx([x[0, t] for t in range(17) if t != 8])


def test_several_people_are_counted_and_chosen(tmp_path):
    path = files.coco_results(tmp_path)
    tracks, said = load(path)
    check(tracks, walk(17), scores(17))
    assert "2 people are found; the longest and surest, person 0, seen in 12 frames, is taken" in said[0]
    other, said = load(path, person=1)
    check(other, walk(17, (400.0, 210.0), -3.0))
    assert said == []
    with pytest.raises(tr.ReconError, match=r"person 2 is not there: 2 people are found .* 12, 12 frames"):
        tr.load_tracks(path, person=2)
    with pytest.raises(tr.ReconError, match=r"person -1 is not there"):
        tr.load_tracks(path, person=-1)


def test_identities_of_the_file_are_believed(tmp_path):
    """Two people who swap places at once: only the file can know."""
    body = np.random.default_rng(0).uniform(0, 100, (17, 2))
    entries = []
    for t in range(10):
        for who in (0, 1):
            xy = body + np.array([300 * ((who + (t > 4)) % 2), 0])
            keypoints = np.c_[xy, np.full(17, 0.9 - 0.1 * who)].reshape(-1).tolist()
            entries.append({"image_id": f"{t}.jpg", "keypoints": keypoints, "idx": who})
    path = tmp_path / "alphapose.json"
    path.write_text(json.dumps(entries))
    tracks, _ = load(path, person=0)
    assert tracks.xy[9, 0, 0].item() - tracks.xy[0, 0, 0].item() == pytest.approx(300)
    for entry in entries:
        del entry["idx"]
    path.write_text(json.dumps(entries))
    tracks, _ = load(path, person=0)
    assert tracks.xy[9, 0, 0].item() == pytest.approx(tracks.xy[0, 0, 0].item())


def test_a_short_gap_is_bridged_and_a_stranger_is_not_joined(tmp_path):
    body = np.random.default_rng(1).uniform(0, 100, (17, 2))
    frames = {t: [Detection(body + np.array([3 * t, 0]), np.ones(17))] for t in range(30) if not 10 <= t < 16}
    (one,) = follow(Source(tmp_path), frames)
    assert len(one.seen) == 24
    frames |= {t: [Detection(body + np.array([900, 0]), np.ones(17))] for t in range(30, 40)}
    people = follow(Source(tmp_path), frames)
    assert [len(person.seen) for person in people] == [24, 10]


def test_there_is_no_second_person_where_nothing_tells_people_apart(tmp_path):
    for write in (files.tracks_npz, files.cotracker, files.tapir, files.penn_action, files.long_csv, files.wide_csv):
        path = write(tmp_path)
        assert load(path, person=0)[0].frames == 12
        with pytest.raises(tr.ReconError, match="person 1 is not there"):
            tr.load_tracks(path, person=1)


def test_humaneva_recordings_are_chosen_by_number(tmp_path):
    path = files.humaneva(tmp_path)
    tracks, said = load(path)
    assert "4 recordings" in said[0]
    check(tracks, walk(15))
    assert tracks.fps == 60.0
    check(load(path, person=3)[0], walk(15)[:8] + 1)
