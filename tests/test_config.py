"""Configuration files may name only what exists."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchrecon.config import Config, from_mapping, load_config, to_mapping
from torchrecon.errors import ReconError

ROOT = Path(__file__).resolve().parents[1]


def test_defaults_survive_a_round_trip():
    config = Config()
    assert from_mapping(Config, to_mapping(config)) == config


def test_the_shipped_file_is_the_default():
    assert load_config(ROOT / "configs" / "reconstruct.yaml") == Config()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("tracker: {detect_evry: 3}", r"unknown key 'detect_evry'; did you mean detect_every"),
        ("trackr: {}", "tracker"),
        ("min_tracks: many", "not of type int"),
        ("min_tracks: true", "not of type int"),
        ("tracker: 3", "not a mapping"),
        ("tracker: {alpha: 2.0}", "alpha"),
        ("a: [", "not YAML"),
        ("- 1", "not a mapping"),
    ],
)
def test_bad_files_say_which_key(tmp_path, text, words):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(ReconError, match=words):
        load_config(path)


def test_whole_numbers_serve_as_floats(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("tracker: {max_std: 2}")
    assert load_config(path).tracker.max_std == 2.0
    with pytest.raises(ReconError, match="no such file"):
        load_config(tmp_path / "none.yaml")
