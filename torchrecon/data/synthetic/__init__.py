"""A synthetic world of basketball: bodies, motions, cameras, rendered clips with their true 3D.

World axes: metres, y up, floor at y = 0. Camera axes: x right, y down, z forward. Integer pixel centres.
"""

from torchrecon.data.synthetic.body import BALL_RADIUS, PART_NAMES, Body, sample_body
from torchrecon.data.synthetic.cameras import (
    Camera,
    handheld_camera,
    panning_camera,
    static_camera,
    turning_camera,
)
from torchrecon.data.synthetic.clip import SurfacePoints, SyntheticClip
from torchrecon.data.synthetic.motion import ACTIONS, Motion, sample_motion
from torchrecon.data.synthetic.renderer import SensorNoise, SyntheticFrame
from torchrecon.data.synthetic.retarget import retarget_joints

__all__ = [
    "ACTIONS",
    "BALL_RADIUS",
    "PART_NAMES",
    "Body",
    "Camera",
    "Motion",
    "SensorNoise",
    "SurfacePoints",
    "SyntheticClip",
    "SyntheticFrame",
    "handheld_camera",
    "panning_camera",
    "retarget_joints",
    "sample_body",
    "sample_motion",
    "static_camera",
    "turning_camera",
]
