"""Probabilistic part model of one frame (paper, eqs. 8-11): which detection is which part, and which parts are there.

The joint density (8) is a product along the graph presence -> label -> motion <- detections <- appearance, the family
of constellation models. What print and meaning differ in: (9) is a Bernoulli mass over the presence ``s`` (its indices
are mixed up), (10) is constant, and (11) is the usual likelihood of matched detections and uniform clutter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from torchrecon._typing import Bool, Float, Int, Tensor
from torchrecon.errors import ReconError

__all__ = ["Detections", "PartMatch", "PartModel", "PartTemplates", "motion_labels"]

_MOST_PARTS = 16
"""The exact posterior sums over all sets of parts."""


@dataclass(frozen=True, eq=False)
class Detections:
    """What was found in a frame.

    Attributes:
        appearance: (detections, features), any unit.
        orientation: (detections) direction of motion, radians, any branch.
        speed: (detections) pixels per second.
    """

    appearance: Float[Tensor, "detections features"]
    orientation: Float[Tensor, " detections"]
    speed: Float[Tensor, " detections"]

    def __len__(self) -> int:
        return self.appearance.shape[0]


@dataclass(frozen=True, eq=False)
class PartTemplates:
    """What each part looks like and how it is expected to move.

    Attributes:
        presence: (parts) probability that the part is seen, inside (0, 1).
        appearance: (parts, features) mean; ``covariance``: (parts, features, features).
        orientation: (parts) radians; ``concentration``: (parts) of the von Mises density, 0 = any direction.
        speed: (parts) pixels per second; ``speed_deviation``: (parts).
    """

    presence: Float[Tensor, " parts"]
    appearance: Float[Tensor, "parts features"]
    covariance: Float[Tensor, "parts features features"]
    orientation: Float[Tensor, " parts"]
    concentration: Float[Tensor, " parts"]
    speed: Float[Tensor, " parts"]
    speed_deviation: Float[Tensor, " parts"]

    def __len__(self) -> int:
        return self.presence.shape[0]


@dataclass(frozen=True, eq=False)
class PartMatch:
    """The most probable reading of a frame.

    Attributes:
        present: (parts) s.
        detection: (parts) D, the detection of each part; -1 for an absent one.
        log_joint: of that reading.
        orientation, speed: (parts) of the matched detection; NaN for an absent part.
    """

    present: Bool[Tensor, " parts"]
    detection: Int[Tensor, " parts"]
    log_joint: float
    orientation: Float[Tensor, " parts"]
    speed: Float[Tensor, " parts"]


@dataclass(frozen=True)
class PartModel:
    """Density of detections given parts.

    Attributes:
        appearance_volume: V of (11), volume of the space in which clutter is spread evenly, unit of the features.
        motion_volume: the same for orientation and speed, radians times pixels per second.
        labels: N of (10), number of motion labels of a part; it shifts the density by a constant.

    Example:
        >>> import torch
        >>> templates = PartTemplates(
        ...     torch.tensor([0.9, 0.5]), torch.tensor([[0.0], [5.0]]), torch.ones(2, 1, 1),
        ...     torch.zeros(2), torch.zeros(2), torch.zeros(2), torch.full((2,), 10.0))
        >>> found = Detections(torch.tensor([[5.2], [60.0], [0.1]]), torch.zeros(3), torch.zeros(3))
        >>> PartModel(appearance_volume=100.0, motion_volume=2 * torch.pi * 100.0).match(found, templates).detection
        tensor([2, 0])
    """

    appearance_volume: float
    motion_volume: float
    labels: int = 1

    def __post_init__(self) -> None:
        if not (self.appearance_volume > 0 and self.motion_volume > 0 and self.labels >= 1):
            raise ReconError("PartModel: both volumes must be positive and labels at least 1")

    def log_presence(self, s: Bool[Tensor, "*b parts"], templates: PartTemplates) -> Float[Tensor, "*b"]:
        """(9): ``sum_i s_i log p_i + (1 - s_i) log(1 - p_i)``; sums to 1 over all s."""
        p = templates.presence
        return torch.where(s, p.log(), torch.log1p(-p)).sum(-1)

    def log_labels(self, templates: PartTemplates) -> float:
        """(10): all motion labels are equally probable, ``(1 / N)^parts``."""
        return -len(templates) * math.log(self.labels)

    def log_appearance(self, detections: Detections, templates: PartTemplates) -> Float[Tensor, "parts detections"]:
        """(11), a matched pair: log normal density of each detection under each part."""
        factor = torch.linalg.cholesky(templates.covariance)
        error = detections.appearance - templates.appearance[:, None]
        white = torch.linalg.solve_triangular(factor, error.mT, upper=False)
        size = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1) + error.shape[-1] * math.log(2 * math.pi) / 2
        return -white.square().sum(-2) / 2 - size[:, None]

    def log_motion(self, detections: Detections, templates: PartTemplates) -> Float[Tensor, "parts detections"]:
        """f(y | x, B) of a matched pair: von Mises in orientation, normal in speed."""
        kappa = templates.concentration[:, None]
        turn = detections.orientation - templates.orientation[:, None]
        # i0e is I0 times exp(-kappa), which a large concentration does not overflow
        mises = kappa * (turn.cos() - 1) - torch.special.i0e(kappa).log() - math.log(2 * math.pi)
        deviation = templates.speed_deviation[:, None]
        rest = (detections.speed - templates.speed[:, None]) / deviation
        return mises - rest.square() / 2 - deviation.log() - math.log(2 * math.pi) / 2

    def log_joint(
        self,
        detections: Detections,
        templates: PartTemplates,
        s: Bool[Tensor, " parts"],
        D: Int[Tensor, " parts"],
    ) -> float:
        """(8): log density of the frame together with presence ``s`` and assignment ``D``.

        Args:
            s: which parts are present; each has a detection.
            D: index of each part's detection; not read where the part is absent.

        Raises:
            ReconError: two present parts share a detection, or an index that does not exist.
        """
        self._check(detections, templates)
        parts = s.nonzero()[:, 0]
        chosen = D[parts]
        if len(chosen.unique()) < len(chosen) or bool(((chosen < 0) | (chosen >= len(detections))).any()):
            raise ReconError(f"D: {chosen.tolist()} must be different detections of 0 to {len(detections) - 1}")
        matched = self.log_appearance(detections, templates) + self.log_motion(detections, templates)
        clutter = (len(detections) - len(parts)) * self._log_clutter
        total = self.log_presence(s, templates) + matched[parts, chosen].sum()
        return float(total) + self.log_labels(templates) - clutter

    def log_odds(self, detections: Detections, templates: PartTemplates) -> Float[Tensor, "parts detections"]:
        """What is gained by matching a part to a detection rather than taking it as absent and that as clutter."""
        p = templates.presence[:, None]
        pair = self.log_appearance(detections, templates) + self.log_motion(detections, templates)
        return p.log() - torch.log1p(-p) + pair + self._log_clutter

    def match(self, detections: Detections, templates: PartTemplates) -> PartMatch:
        """The most probable (s, D), exactly: a linear assignment in which a pair that gains nothing stays unmatched.

        Raises:
            ReconError: shapes that do not fit, NaN, presence outside (0, 1).
        """
        self._check(detections, templates)
        gain = self.log_odds(detections, templates)
        rows, cols = linear_sum_assignment(gain.clamp_min(0).detach().cpu().numpy(), maximize=True)
        D = torch.full((len(templates),), -1, dtype=torch.int64, device=gain.device)
        D[torch.from_numpy(rows)] = torch.from_numpy(np.asarray(cols, dtype=np.int64)).to(D)
        best = gain[torch.arange(len(D)), D.clamp_min(0)] if len(detections) else gain.new_zeros(len(D))
        D = torch.where((D >= 0) & (best > 0), D, -1)
        s = D >= 0

        def of_part(values: Tensor) -> Tensor:
            padded = torch.cat([values, values.new_full((1,), torch.nan)])
            return padded[D]

        joint = self.log_joint(detections, templates, s, D)
        return PartMatch(s, D, joint, of_part(detections.orientation), of_part(detections.speed))

    def posterior(self, detections: Detections, templates: PartTemplates) -> Float[Tensor, "parts detections"]:
        """Probability of each pair over all readings (s, D), exactly; a row sums to the probability of presence.

        Detections are taken one after the other while the set of parts that are taken is carried along, forward and
        backward, so the work grows as 2^parts times detections.

        Raises:
            ReconError: more than 16 parts.
        """
        self._check(detections, templates)
        parts = len(templates)
        if parts > _MOST_PARTS:
            raise ReconError(f"templates: the exact posterior of {parts} parts is too much; {_MOST_PARTS} at most")
        gain = self.log_odds(detections, templates)
        sets = torch.arange(2**parts, device=gain.device)
        free = [(sets >> part) % 2 == 0 for part in range(parts)]
        start = gain.new_full((2**parts,), -torch.inf)
        start[0] = 0.0
        forward = [start]
        for column in gain.T:
            level = forward[-1]
            terms = [level]
            for part in range(parts):
                moved = torch.full_like(level, -torch.inf)
                moved[sets[free[part]] + 2**part] = level[free[part]] + column[part]
                terms.append(moved)
            forward.append(torch.logsumexp(torch.stack(terms), 0))
        total = torch.logsumexp(forward[-1], 0)
        backward = torch.zeros_like(start)
        out = torch.zeros_like(gain)
        for index in range(len(detections) - 1, -1, -1):
            column, level = gain[:, index], forward[index]
            terms = [backward]
            for part in range(parts):
                ahead = backward[sets[free[part]] + 2**part] + column[part]
                out[part, index] = torch.exp(torch.logsumexp(level[free[part]] + ahead, 0) - total)
                moved = torch.full_like(backward, -torch.inf)
                moved[free[part]] = ahead
                terms.append(moved)
            backward = torch.logsumexp(torch.stack(terms), 0)
        return out

    @property
    def _log_clutter(self) -> float:
        return math.log(self.appearance_volume) + math.log(self.motion_volume)

    def _check(self, detections: Detections, templates: PartTemplates) -> None:
        if detections.appearance.shape[1] != templates.appearance.shape[1]:
            raise ReconError(
                f"detections have {detections.appearance.shape[1]} features, templates {templates.appearance.shape[1]}"
            )
        if not bool(((templates.presence > 0) & (templates.presence < 1)).all()):
            raise ReconError("templates: presence must lie inside (0, 1); a part that is always there is 1 - 1e-6")
        if not bool((templates.speed_deviation > 0).all() & (templates.concentration >= 0).all()):
            raise ReconError("templates: speed_deviation must be positive and concentration not negative")
        for name in ("appearance", "orientation", "speed"):
            if not torch.isfinite(getattr(detections, name)).all():
                raise ReconError(f"detections: {name} holds NaN or infinite values; leave those detections out")


def motion_labels(
    before: Float[Tensor, "*b 2"], after: Float[Tensor, "*b 2"], seconds: float
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Orientation (radians, 0 = right, clockwise on the screen) and speed (pixels per second) of moving points.

    Example:
        >>> import torch
        >>> orientation, speed = motion_labels(torch.zeros(2), torch.tensor([0.0, 2.0]), seconds=0.04)
        >>> round(float(orientation), 4), round(float(speed), 3)
        (1.5708, 50.0)
    """
    if not seconds > 0:
        raise ReconError(f"seconds: {seconds} is not positive")
    step = after - before
    return torch.atan2(step[..., 1], step[..., 0]), step.norm(dim=-1) / seconds
