"""What readers refuse, within what bounds, and how they take damaged files."""

from __future__ import annotations

import pickle
import random
import zipfile

import h5py
import numpy as np
import pytest

import torchrecon as tr
from tests import track_files as files
from tests.fuzz import SECONDS, read_mutants
from tests.mutants import mutate
from tests.track_files import WRITERS


def test_mpii_says_what_it_serves_for(tmp_path):
    for write in (files.mpii_csv, files.mpii_json):
        with pytest.raises(tr.ReconError, match=r"single images of different people.*PCKh"):
            tr.load_tracks(write(tmp_path))


def test_nothing_is_unpickled(tmp_path):
    class Evil:
        def __reduce__(self):
            return (exec, (f"open({str(tmp_path / 'ran')!r}, 'w')",))

    np.savez(tmp_path / "a.npz", xy=np.array([Evil()], dtype=object))
    np.save(tmp_path / "b.npy", np.array([Evil()], dtype=object))
    (tmp_path / "c.pkl").write_bytes(pickle.dumps(Evil()))
    path = files.deeplabcut_h5(tmp_path)
    with h5py.File(path, "r+") as file:
        file["df_with_missing/table"].attrs["values_block_0_kind"] = np.bytes_(pickle.dumps(Evil(), 0))
    for name, words in (("a.npz", "pickled"), ("b.npy", "pickled"), ("c.pkl", "never loaded"), (path.name, "CSV")):
        with pytest.raises(tr.ReconError, match=words):
            tr.load_tracks(tmp_path / name)
    assert not (tmp_path / "ran").exists()


def test_sizes_are_checked_before_memory_is_taken(tmp_path):
    bomb = zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1)
    with bomb as archive, archive.open("xy.npy", "w") as member:
        header = {"descr": "|u1", "fortran_order": False, "shape": (300, 1 << 19, 2)}
        np.lib.format.write_array_header_1_0(member, header)
        for _ in range(300):
            member.write(bytes(1 << 20))
    with pytest.raises(tr.ReconError, match="more than the 268435456 that are read"):
        tr.load_tracks(tmp_path / "bomb.npz")
    with zipfile.ZipFile(tmp_path / "lie.npz", "w") as archive, archive.open("xy.npy", "w") as member:
        header = {"descr": "<f8", "fortran_order": False, "shape": (10**9, 10**6, 2)}
        np.lib.format.write_array_header_1_0(member, header)
    with pytest.raises(tr.ReconError, match="0 are stored"):
        tr.load_tracks(tmp_path / "lie.npz")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("deep.json", b"[" * 200_000, "nested too deeply|not JSON"),
        ("empty.csv", b"", "is empty"),
        ("words.txt", b"once upon a time\n", "no known format"),
        ("list.json", b"[1, 2, 3]", "no known format"),
        ("dict.json", b'{"a": 1}', "keys found: a"),
        ("x.bin", bytes(range(256)), "binary"),
        ("x.gz", b"\x1f\x8b\x08\x00broken", "damaged gzip"),
        ("x.json", b'[{"image_id": 1, "keypoints": [1, 2]}]', "x, y, confidence per point"),
        ("y.json", b'[{"image_id": 1, "keypoints": [1e300, 2, 1]}]', "beyond"),
        ("z.json", b'[{"version": 1, "people": []}]', "nobody is found"),
        ("a.csv", b"frame,point,x,y\n0,a,1,one\n", "row 2, column 4: 'one' is no number"),
        ("b.csv", b"frame,point,x,y\n0,a,1,1\n0,a,1,1\n", "stands twice"),
        ("c.csv", b"frame,point,x,y\n", "no frames"),
    ],
)
def test_errors_name_the_file_and_what_is_wrong(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(tr.ReconError, match=words) as caught:
        tr.load_tracks(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)


@pytest.mark.parametrize("name", WRITERS)
def test_fifty_damaged_files_give_tracks_or_a_typed_error(tmp_path, name):
    outcomes = list(read_mutants(name, 50, 0, tmp_path))
    assert {outcome for _, outcome, _ in outcomes} <= {"tracks", "ReconError"}, outcomes
    assert max(seconds for _, _, seconds in outcomes) < SECONDS
    assert sum(outcome == "ReconError" for _, outcome, _ in outcomes) >= 10  # the damage is real


def test_damage_is_the_same_for_the_same_seed(tmp_path):
    path = files.coco_results(tmp_path)
    one, two = (mutate(path, tmp_path / "m", random.Random(3)).read_bytes() for _ in range(2))
    assert one == two != path.read_bytes()
