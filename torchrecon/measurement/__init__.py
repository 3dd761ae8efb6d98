"""What is measured and what comes out: tracks, reconstructions, rank estimates, cameras and matrix views."""

from torchrecon.measurement.belief import ShapeBelief
from torchrecon.measurement.camera import backproject_points, normalised_coordinates, project_points
from torchrecon.measurement.filled import FilledTracks
from torchrecon.measurement.protocols import GapFiller, RankRule, ShapePrior, Solver
from torchrecon.measurement.rank_estimate import RankEstimate
from torchrecon.measurement.reconstruction import Reconstruction, Status
from torchrecon.measurement.tracks import Tracks
from torchrecon.measurement.views import centre_tracks, stack_matrix, tracks_to_matrix, vector_matrix

__all__ = [
    "FilledTracks",
    "GapFiller",
    "RankEstimate",
    "RankRule",
    "Reconstruction",
    "ShapeBelief",
    "ShapePrior",
    "Solver",
    "Status",
    "Tracks",
    "backproject_points",
    "centre_tracks",
    "normalised_coordinates",
    "project_points",
    "stack_matrix",
    "tracks_to_matrix",
    "vector_matrix",
]
