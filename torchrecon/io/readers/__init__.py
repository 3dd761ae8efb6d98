"""Readers of every kind of tracks that people have: one format, or family of formats, a file.

A reader is a pure function ``read_x(source, options) -> Tracks``; a :class:`Format` joins it to a name and to a
``sniff`` that tells from the content whether a source is of that format. ``FORMATS`` is tried in order.
"""

from torchrecon.io.readers.base import Format, Read, ReadOptions
from torchrecon.io.readers.coco import COCO
from torchrecon.io.readers.confidence import ConfidenceParams
from torchrecon.io.readers.cotracker import COTRACKER
from torchrecon.io.readers.deeplabcut import DEEPLABCUT_CSV, DEEPLABCUT_H5
from torchrecon.io.readers.humaneva import HUMANEVA
from torchrecon.io.readers.markers import BVH, C3D, FREE_THROW, TRC
from torchrecon.io.readers.mediapipe import MEDIAPIPE
from torchrecon.io.readers.mmpose import MMPOSE
from torchrecon.io.readers.mpii import MPII
from torchrecon.io.readers.openpose import OPENPOSE
from torchrecon.io.readers.penn_action import PENN_ACTION
from torchrecon.io.readers.points_csv import POINTS_CSV
from torchrecon.io.readers.sleap import SLEAP_CSV, SLEAP_H5
from torchrecon.io.readers.source import Source
from torchrecon.io.readers.tapir import TAPIR
from torchrecon.io.readers.tracks_npz import TRACKS

__all__ = ["FORMATS", "ConfidenceParams", "Format", "Read", "ReadOptions", "Source", "detect"]

FORMATS: tuple[Format, ...] = (
    TRACKS,
    COTRACKER,
    MMPOSE,
    HUMANEVA,
    TAPIR,
    MPII,
    PENN_ACTION,
    OPENPOSE,
    COCO,
    FREE_THROW,
    MEDIAPIPE,
    SLEAP_H5,
    DEEPLABCUT_H5,
    C3D,
    TRC,
    BVH,
    DEEPLABCUT_CSV,
    SLEAP_CSV,
    POINTS_CSV,
)


def detect(source: Source) -> Format | None:
    """The format of a source, told from its content; None where no reader knows it."""
    return next((known for known in FORMATS if known.sniff(source)), None)
