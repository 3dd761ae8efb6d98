"""The silhouette of the mover: finding it, its outline, its model over time, its parts; motion of the background."""

from torchrecon.contour.global_motion import background_paths, own_motion
from torchrecon.contour.kernel_dynamics import KernelDynamics
from torchrecon.contour.mover import MoverParams, find_mover
from torchrecon.contour.outline import NormalisedOutline, align_start, fill_outline, mask_outline, normalise_outline
from torchrecon.contour.part_model import Detections, PartMatch, PartModel, PartTemplates, motion_labels
from torchrecon.contour.repair import RepairedSilhouettes, RepairParams, repair_silhouettes
from torchrecon.contour.silhouette import SilhouetteParams, follow_silhouette, silhouette_from_box

__all__ = [
    "Detections",
    "KernelDynamics",
    "MoverParams",
    "NormalisedOutline",
    "PartMatch",
    "PartModel",
    "PartTemplates",
    "RepairParams",
    "RepairedSilhouettes",
    "SilhouetteParams",
    "align_start",
    "background_paths",
    "fill_outline",
    "find_mover",
    "follow_silhouette",
    "mask_outline",
    "motion_labels",
    "normalise_outline",
    "own_motion",
    "repair_silhouettes",
    "silhouette_from_box",
]
