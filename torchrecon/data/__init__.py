"""Where data comes from: the synthetic world and readers of motion capture."""

from torchrecon.data.c3d import read_c3d
from torchrecon.data.markers import Markers, read_trc
from torchrecon.data.mocap import MocapClip, load_mocap, read_bvh

__all__ = ["Markers", "MocapClip", "load_mocap", "read_bvh", "read_c3d", "read_trc"]
