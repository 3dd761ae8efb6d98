"""Reading a file in a test: what the reader says, and known values against its tracks."""

from __future__ import annotations

import warnings

import numpy as np

import torchrecon as tr


def load(path, **options):
    """The tracks and what the reader had to say."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        tracks = tr.load_tracks(path, **options)
    return tracks, [str(w.message) for w in said]


def check(tracks, xy, confidence=None, floor=0.1):
    """Positions where the confidence is above the floor, nothing elsewhere."""
    seen = np.ones(xy.shape[:-1], bool) if confidence is None else confidence > floor
    np.testing.assert_array_equal(tracks.visible.numpy(), seen)
    np.testing.assert_allclose(tracks.xy.numpy()[seen], xy[seen], rtol=0, atol=1e-9)
