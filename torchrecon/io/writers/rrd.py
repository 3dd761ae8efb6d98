"""Recordings for the Rerun viewer."""

from __future__ import annotations

import tempfile
from pathlib import Path

from torchrecon.errors import ReconError
from torchrecon.io.writers.motion import Motion

__all__ = ["encode"]


def encode(motion: Motion) -> bytes:
    """Points and bones on the timelines ``frame`` and ``time`` (s), camera axes declared as right, down, forward.

    Raises:
        ReconError: rerun-sdk is not installed.
    """
    try:
        import rerun
    except ImportError as error:
        raise ReconError("export: .rrd needs rerun-sdk; install it with pip install 'torchrecon[rerun]'") from error
    with tempfile.TemporaryDirectory() as folder:  # the recording streams to a path only
        path = Path(folder) / "out.rrd"
        recording = rerun.RecordingStream("torchrecon")
        recording.save(str(path))
        recording.log("shape", rerun.ViewCoordinates.RDF, static=True)
        for f, frame in enumerate(motion.points):
            recording.set_time("frame", sequence=f)
            recording.set_time("time", duration=f / motion.fps)
            recording.log("shape/points", rerun.Points3D(frame, labels=list(motion.names), show_labels=False))
            if motion.edges:
                recording.log("shape/bones", rerun.LineStrips3D([frame[[a, b]] for a, b in motion.edges]))
        recording.flush()
        recording.disconnect()
        return path.read_bytes()
