"""Where data comes from: the synthetic world and readers of motion capture."""

from torchrecon.data.mocap import Markers, MocapClip, load_mocap, read_bvh, read_c3d

__all__ = ["Markers", "MocapClip", "load_mocap", "read_bvh", "read_c3d"]
