"""MPII Human Pose (Andriluka et al. 2014): annotated stills in the CSV and JSON forms, and stored predictions.

Every record is one person in one still: 16 joints in the image, no depth, no time. What that can serve for is said in
docs/evaluation.md.
"""

from __future__ import annotations

import csv
import gzip
import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.metrics import pckh

__all__ = ["MPII_JOINTS", "MPII_PARTS", "MpiiPredictions", "MpiiStills", "load_mpii", "load_mpii_predictions"]

MPII_JOINTS = (
    "r ankle", "r knee", "r hip", "l hip", "l knee", "l ankle", "pelvis", "thorax",
    "upper neck", "head top", "r wrist", "r elbow", "r shoulder", "l shoulder", "l elbow", "l wrist",
)  # fmt: skip
"""Order of the joints in all forms."""

MPII_PARTS: dict[str, tuple[str, ...]] = {
    "head": ("head top",),
    **{part: (f"l {part}", f"r {part}") for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")},
}
"""Columns of a PCKh table: head top, and the mean of left and right."""
_HEAD_BIAS = 0.6  # of the head box's diagonal, as the benchmark defines the size of a head


@dataclass(frozen=True, eq=False)
class MpiiStills:
    """Annotated people.

    Attributes:
        names: image file of each person.
        xy: pixels, x right, y down, in the order of :data:`MPII_JOINTS`; NaN where a joint is not annotated.
        scale: height of the person over 200 pixels.
        activity: of each person; empty strings where the form holds none (JSON).
    """

    names: tuple[str, ...]
    xy: Float[Tensor, "people joints 2"]
    scale: Float[Tensor, " people"]
    activity: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, eq=False)
class MpiiPredictions:
    """Truth and one method's predictions for the same people.

    Attributes:
        predicted, truth: pixels, in the order of :data:`MPII_JOINTS`.
        present: annotated joints.
        head_size: 0.6 times the diagonal of the head box, pixels.
    """

    predicted: Float[Tensor, "people joints 2"]
    truth: Float[Tensor, "people joints 2"]
    present: Bool[Tensor, "people joints"]
    head_size: Float[Tensor, " people"]

    def scores(self, threshold: float = 0.5) -> dict[str, float]:
        """PCKh of each part and their ``mean``, which weighs every joint but pelvis and thorax by its annotations."""
        each = pckh(self.predicted, self.truth, self.head_size, self.present, threshold=threshold)
        found = {part: float(each[[MPII_JOINTS.index(n) for n in names]].mean()) for part, names in MPII_PARTS.items()}
        counted = [i for i, name in enumerate(MPII_JOINTS) if name not in ("pelvis", "thorax")]
        weight = self.present[:, counted].sum(0).to(each.dtype)
        return {**found, "mean": float((each[counted].nan_to_num() * weight).sum() / weight.sum())}


def load_mpii(path: str | os.PathLike[str]) -> MpiiStills:
    """Read annotations: ``.csv`` or ``.csv.gz`` (a column per coordinate) or ``.json`` (a list of people).

    Raises:
        ReconError: the file is missing or unreadable; a column, key or value is missing or no number. Names the
            file, the row (the first is 0) and the key.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "two.json"
        ...     person = {"image": "a.jpg", "scale": 2.0, "joints": [[5.0, 7.0]] * 16, "joints_vis": [1] * 15 + [0]}
        ...     _ = path.write_text(json.dumps([person]))
        ...     stills = load_mpii(path)
        >>> len(stills), stills.xy[0, 0].tolist(), bool(stills.xy[0, 15].isnan().all())
        (1, [5.0, 7.0], True)
    """
    source = Path(path)
    if not source.is_file():
        raise ReconError(f"{source}: no such file; give the MPII annotations as .csv, .csv.gz or .json")
    try:
        stills = _json_form(source) if source.suffix == ".json" else _csv_form(source)
    except (OSError, EOFError, UnicodeDecodeError, json.JSONDecodeError, csv.Error) as error:
        raise ReconError(f"{source}: is not readable as MPII annotations ({error})") from error
    if not len(stills):
        raise ReconError(f"{source}: holds nobody")
    return stills


def _csv_form(source: Path) -> MpiiStills:
    columns = ["Scale", *(f"{joint}_{axis}" for joint in MPII_JOINTS for axis in "XY")]
    with gzip.open(source, "rt", newline="") if source.suffix == ".gz" else source.open(newline="") as stream:
        reader = csv.DictReader(stream)
        for key in ("NAME", "Activity", *columns):
            if key not in (reader.fieldnames or ()):
                raise ReconError(f"{source}: has no column {key!r}; it is not the CSV form of MPII")
        rows = list(reader)
    values = np.empty((len(rows), len(columns)))
    for index, row in enumerate(rows):
        try:
            values[index] = [float(row[key]) for key in columns]
        except (TypeError, ValueError) as error:  # a short row holds None
            raise ReconError(f"{source}: row {index}: a coordinate or the scale is no number ({error})") from error
    xy = values[:, 1:].reshape(-1, len(MPII_JOINTS), 2)
    # Joints may lie outside the image: only the pair -1, -1 means that there is none.
    xy = np.where((xy == -1).all(-1, keepdims=True), np.nan, xy)
    names, activity = (tuple(row[key] for row in rows) for key in ("NAME", "Activity"))
    return MpiiStills(names, torch.from_numpy(xy), torch.from_numpy(values[:, 0].copy()), activity)


def _json_form(source: Path) -> MpiiStills:
    content = json.loads(source.read_text(encoding="utf-8"))
    if not isinstance(content, list):
        raise ReconError(f"{source}: is not the JSON form of MPII; a list of people is needed")
    xy, scale = np.empty((len(content), len(MPII_JOINTS), 2)), np.empty(len(content))
    for index, item in enumerate(content):
        where = f"{source}: person {index}"
        for key in ("image", "scale", "joints", "joints_vis"):
            if not isinstance(item, dict) or key not in item:
                raise ReconError(f"{where}: has no key {key!r}")
        try:
            joints, shown = np.array(item["joints"], np.float64), np.array(item["joints_vis"], np.float64)
            scale[index] = float(item["scale"])
        except (TypeError, ValueError) as error:
            raise ReconError(f"{where}: joints, joints_vis and scale must be numbers ({error})") from error
        if joints.shape != xy.shape[1:] or shown.shape != joints.shape[:1]:
            raise ReconError(f"{where}: joints {joints.shape} and joints_vis {shown.shape}; 16 joints are needed")
        xy[index] = np.where(shown[:, None] > 0, joints, np.nan)
    names = tuple(str(item["image"]) for item in content)
    return MpiiStills(names, torch.from_numpy(xy), torch.from_numpy(scale), ("",) * len(names))


def load_mpii_predictions(path: str | os.PathLike[str]) -> MpiiPredictions:
    """Read ``detections_our_format.mat``: truth, head boxes and one method's predictions of the validation set.

    Raises:
        ReconError: the file is missing or unreadable, or lacks a variable.
    """
    from scipy.io import loadmat

    source = Path(path)
    if not source.is_file():
        raise ReconError(f"{source}: no such file; give the .mat file of predictions")
    try:
        content = loadmat(source)
    except (ValueError, NotImplementedError, OSError) as error:
        raise ReconError(f"{source}: is not a readable MATLAB file ({error})") from error
    for key in ("pos_pred_src", "pos_gt_src", "headboxes_src", "jnt_missing"):
        if key not in content:
            raise ReconError(f"{source}: has no variable {key!r}; it is no file of MPII predictions")
    # Stored as (joints, xy, people), head boxes as (corner, xy, people).
    predicted, truth = (torch.from_numpy(content[k]).double().permute(2, 0, 1) for k in ("pos_pred_src", "pos_gt_src"))
    box = torch.from_numpy(content["headboxes_src"]).double()
    present = torch.from_numpy(content["jnt_missing"].T == 0)
    return MpiiPredictions(predicted, truth, present, _HEAD_BIAS * (box[1] - box[0]).norm(dim=0))
