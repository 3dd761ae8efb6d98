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
from typing import Any

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
        people = _json_people(source) if source.suffix == ".json" else _csv_people(source)
    except (OSError, EOFError, UnicodeDecodeError, json.JSONDecodeError, csv.Error) as error:
        raise ReconError(f"{source}: is not readable as MPII annotations ({error})") from error
    if not people:
        raise ReconError(f"{source}: holds nobody")
    xy = torch.tensor([joints for _, joints, _, _ in people], dtype=torch.float64)
    scale = torch.tensor([size for _, _, size, _ in people], dtype=torch.float64)
    return MpiiStills(tuple(p[0] for p in people), xy, scale, tuple(p[3] for p in people))


_Person = tuple[str, list[list[float]], float, str]


def _csv_people(source: Path) -> list[_Person]:
    people: list[_Person] = []
    with gzip.open(source, "rt", newline="") if source.suffix == ".gz" else source.open(newline="") as stream:
        rows = csv.DictReader(stream)
        needed = ["NAME", "Scale", "Activity", *(f"{joint}_{axis}" for joint in MPII_JOINTS for axis in "XY")]
        for key in needed:
            if key not in (rows.fieldnames or ()):
                raise ReconError(f"{source}: has no column {key!r}; it is not the CSV form of MPII")
        for index, row in enumerate(rows):
            joints = []
            for joint in MPII_JOINTS:
                x, y = (_number(row[f"{joint}_{axis}"], f"{source}: row {index}, {joint}_{axis}") for axis in "XY")
                # Joints may lie outside the image: only the pair -1, -1 means that there is none.
                joints.append([float("nan")] * 2 if x == y == -1 else [x, y])
            people.append(
                (row["NAME"], joints, _number(row["Scale"], f"{source}: row {index}, Scale"), row["Activity"])
            )
    return people


def _json_people(source: Path) -> list[_Person]:
    content = json.loads(source.read_text(encoding="utf-8"))
    if not isinstance(content, list):
        raise ReconError(f"{source}: is not the JSON form of MPII; a list of people is needed")
    people: list[_Person] = []
    for index, item in enumerate(content):
        where = f"{source}: person {index}"
        for key in ("image", "scale", "joints", "joints_vis"):
            if not isinstance(item, dict) or key not in item:
                raise ReconError(f"{where}: has no key {key!r}")
        joints, shown = np.asarray(item["joints"], np.float64), np.asarray(item["joints_vis"])
        if joints.shape != (len(MPII_JOINTS), 2) or shown.shape != (len(MPII_JOINTS),):
            raise ReconError(f"{where}: joints {joints.shape} and joints_vis {shown.shape}; 16 joints are needed")
        kept = np.where(shown[:, None] > 0, joints, np.nan)
        people.append((str(item["image"]), kept.tolist(), _number(item["scale"], f"{where}, scale"), ""))
    return people


def _number(value: Any, where: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise ReconError(f"{where}: {value!r} is no number") from error


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
