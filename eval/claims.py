"""What the paper says in prose, and what our numbers say of it: holds, does not hold, by how much."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from eval.ablation.bases import NEAR
from eval.tables import NAMES, NOTHING, PAPER, VIEWS

__all__ = ["CLAIMS", "Claim", "Verdict", "judge"]

Results = Mapping[str, Any]
"""What the jobs wrote, by name: ``table1`` to ``table5``, ``figures``, ``ablation``; one that has not run is absent."""


@dataclass(frozen=True)
class Verdict:
    """Outcome of one claim; ``holds`` is None where the numbers are missing."""

    holds: bool | None
    why: str

    def __str__(self) -> str:
        says = "not judged" if self.holds is None else "holds" if self.holds else "does not hold"
        return f"{says}: {self.why}"


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper and how it is judged; ``needs`` names the results it is read from."""

    where: str
    text: str
    needs: str
    test: Callable[[Any], Verdict]


def judge(claim: Claim, results: Results) -> Verdict:
    """The verdict on a claim.

    Example:
        >>> claim = Claim("here", "one is more than none", "table9", lambda result: Verdict(result > 0, "by 1"))
        >>> str(judge(claim, {"table9": 1})), str(judge(claim, {}))
        ('holds: by 1', 'not judged: table9 has not been computed')
    """
    if claim.needs not in results:
        return Verdict(None, f"{claim.needs} has not been computed")
    return claim.test(results[claim.needs])


def _recognition(table: Any) -> dict[str, dict[str, float]]:
    """Error of each method in each action; true 3D, views and other references are no methods."""
    keys = set(PAPER[2])
    return {
        row["key"]: {name: cell["error"] for name, cell in row["cells"].items() if name != "mean"}
        for row in table["rows"]
        if row["key"] in keys
    }


def _lowest_recognition_error(table: Any) -> Verdict:
    errors = _recognition(table)
    lead = {
        action: min(row[action] for key, row in errors.items() if key != "default") - errors["default"][action]
        for action in errors["default"]
    }
    worst = min(lead, key=lambda action: lead[action])
    return Verdict(
        lead[worst] > 0, f"ahead of the best of Ref. 4-8 by {lead[worst]:.1f} points or more (least: {worst})"
    )


def _printed_recognition_error(table: Any) -> Verdict:
    row = next(row for row in table["rows"] if row["key"] == "default")
    over = {action: row["cells"][action]["error"] - printed for action, printed in row["paper"].items()}
    worst = max(over, key=lambda action: over[action])
    return Verdict(over[worst] <= 0, f"{over[worst]:+.1f} points against the printed number at worst ({worst})")


def _ref4_is_worst(table: Any) -> Verdict:
    errors = {key: sum(row.values()) / len(row) for key, row in _recognition(table).items()}
    order = sorted(errors, key=lambda key: errors[key])
    return Verdict(order[-1] == "ref4", f"from best to worst: {', '.join(order)}")


def _methods(table: Any, number: int) -> dict[str, Any]:
    """The six methods of the paper that have figures in a table."""
    return {row["key"]: row for row in table["rows"] if row["key"] in PAPER[number] and NAMES[number] in row}


def _at_reference(table: Any, values: list[float]) -> list[float]:
    return [values[table["frames"].index(frame)] for frame in table["reference"]]


def _best_matching(table: Any) -> Verdict:
    found = {key: _at_reference(table, row["matching"]) for key, row in _methods(table, 2).items()}
    lead = [found["default"][i] - max(v[i] for k, v in found.items() if k != "default") for i in range(3)]
    return Verdict(min(lead) >= 0, f"ahead of the best of Ref. 4-8 by {', '.join(f'{v:+.1f}' for v in lead)} points")


def _printed_matching(table: Any) -> Verdict:
    row = _methods(table, 2)["default"]
    ours = [*_at_reference(table, row["matching"]), row["accuracy"]]
    over = [value - printed for value, printed in zip(ours, PAPER[2]["default"], strict=True)]
    return Verdict(min(over) >= 0, f"against the printed numbers {', '.join(f'{v:+.1f}' for v in over)} points")


def _best_pictures(number: int) -> Callable[[Any], Verdict]:
    name, sign = NAMES[number], -1 if number == 5 else 1

    def test(table: Any) -> Verdict:
        rows = _methods(table, number)
        lead = {}
        for view in VIEWS:
            found = {key: _at_reference(table, row[name][view]) for key, row in rows.items()}
            for i, frame in enumerate(table["reference"]):
                best = max((sign * v[i], k) for k, v in found.items() if k != "default")
                lead[f"{view} {frame}, {best[1]}"] = sign * found["default"][i] - best[0]
        won = sum(value > 0 for value in lead.values())
        worst = min(lead, key=lambda cell: lead[cell])
        return Verdict(won == len(lead), f"best in {won} of {len(lead)} cells; least lead {lead[worst]:+.3g} ({worst})")

    return test


def _smaller_fluctuation(number: int) -> Callable[[Any], Verdict]:
    name = NAMES[number]

    def test(table: Any) -> Verdict:
        rows = _methods(table, number)
        texts, won = [], 0
        for view in VIEWS:
            spread = {key: max(row[name][view]) - min(row[name][view]) for key, row in rows.items()}
            best = min((value, key) for key, value in spread.items() if key != "default")
            won += spread["default"] < best[0]
            texts.append(f"{view} {spread['default']:.3g} against {best[0]:.3g} ({best[1]})")
        return Verdict(won == len(VIEWS), "range over frames: " + ", ".join(texts))

    return test


def _both_tables_one_picture(table: Any) -> Verdict:
    off = [
        abs(ratio + 10 * math.log10(error))
        for row in table["rows"]
        if "psnr" in row and row["key"] != NOTHING.key
        for view in VIEWS
        for ratio, error in zip(row["psnr"][view], row["mse"][view], strict=True)
        if ratio is not None and error > 0
    ]
    implied = [
        math.sqrt(error * 10 ** (ratio / 10))
        for key in PAPER[3]
        for ratio, error in zip(PAPER[3][key], PAPER[5][key], strict=True)
    ]
    return Verdict(
        False,
        f"PSNR and MSE of one picture fix its peak: the printed ones imply {min(implied):.0f} to {max(implied):.0f}; "
        f"ours agree within {max(off):.0e} dB at peak 1",
    )


def _solved(figures: Any) -> list[dict[str, Any]]:
    """Cells of Figure 9 that the default solved."""
    records = figures["figures"].get("9", {}).get("records", [])
    return [r for r in records if r["disparity"] is not None and r["solver"] == "auto"]


def _falls(by: str, other: str) -> Callable[[Any], Verdict]:
    """Does M^2 fall from the smallest to the largest value of ``by``, all else equal?"""

    def test(figures: Any) -> Verdict:
        groups: dict[tuple[Any, ...], dict[float, list[float]]] = {}
        for r in _solved(figures):
            key = (r["body"], r["turn"], r[other])
            groups.setdefault(key, {}).setdefault(r[by], []).append(r["disparity"])
        ends = {
            key: (sum(v[min(v)]) / len(v[min(v)]), sum(v[max(v)]) / len(v[max(v)]))
            for key, v in groups.items()
            if len(v) > 1
        }
        if not ends:
            return Verdict(None, "figure 9 has not been computed")
        falls = sum(last < first for first, last in ends.values())
        ratio = math.exp(sum(math.log(first / last) for first, last in ends.values()) / len(ends))
        return Verdict(
            falls == len(ends), f"falls in {falls} of {len(ends)} series, by a factor of {ratio:.1f} in the mean"
        )

    return test


def _below_a_thousandth(figures: Any) -> Verdict:
    at = [r for r in _solved(figures) if r["frames"] == 100]
    if not at:
        return Verdict(None, "figure 9 has no cell with 100 frames")
    worst = max(at, key=lambda r: r["disparity"])
    floor = max(at, key=lambda r: r["floor"])
    good = sorted({r["snr"] for r in at} - {r["snr"] for r in at if r["disparity"] >= 1e-3})
    return Verdict(
        worst["disparity"] < 1e-3,
        f"at F 100 up to {worst['disparity']:.1e} ({worst['snr']:g} dB); below 1e-3 everywhere only at "
        f"{', '.join(f'{v:g} dB' for v in good) or 'no SNR'}; with all rotations known the floor is already "
        f"{floor['floor']:.1e} at {floor['snr']:g} dB, if SNR is that of the tracks",
    )


def _scatter_is_near(figures: Any) -> Verdict:
    records = figures["figures"].get("8", {}).get("records", [])
    if not records:
        return Verdict(None, "figure 8 has not been computed")
    near = [r for r in records if r["disparity"] is not None and r["disparity"] < 0.01]
    least = min((r["turn"] for r in near), default=None)
    from_where = "" if least is None else f", from a deflection of {least:g} degrees on"
    return Verdict(len(near) == len(records), f"M^2 below 0.01 in {len(near)} of {len(records)} cells{from_where}")


def _filter_cleans(figures: Any) -> Verdict:
    squat = figures["figures"].get("3")
    if squat is None:
        return Verdict(None, "figure 3 has not been computed")
    gain = squat["psnr_after"] - squat["psnr_before"]
    return Verdict(
        gain > 0, f"depth of the body {gain:+.1f} dB ({squat['psnr_before']:.1f} to {squat['psnr_after']:.1f})"
    )


def _wrong_number_of_bases(ablation: Any) -> Verdict:
    """Is the error of every solver that takes a K least near the true K?"""
    rows = ablation.get("bases", {}).get("rows", [])
    if not rows or any(row["minimum"] is None for row in rows):
        return Verdict(None, "the part 'bases' of the ablation has not been computed, or lacks an answer")
    texts, near = [], []
    for row in rows:
        errors = row["error3d_camera"]
        near.append(NEAR[0] <= row["minimum"] <= NEAR[1])
        worst = max(range(len(errors)), key=lambda i: errors[i])
        texts.append(
            f"{row['solver']} least at {row['minimum']:g} x the true K, {errors[worst] / min(errors):.1f} times that "
            f"at {row['assumed'][worst] / ablation['bases']['true']:g} x"
        )
    return Verdict(all(near), "; ".join(texts))


def _bases_by_count(ablation: Any) -> Verdict:
    found = ablation.get("bases")
    if found is None:
        return Verdict(None, "the part 'bases' of the ablation has not been computed")
    exact = {rule: sum(k == found["true"] for k in values) for rule, values in found["estimates"].items()}
    count = len(found["estimates"]["paper"])
    off = sum(found["estimates"]["paper"]) / count - found["true"]
    return Verdict(
        exact["paper"] == count,
        f"the true K in {exact['paper']} of {count} films, {off:+.1f} in the mean; our rule in {exact['auto']}",
    )


def _stage(key: str, what: str) -> Callable[[Any], Verdict]:
    """Is the whole road better than the variant ``key``, for every solver that was asked?"""

    def test(ablation: Any) -> Verdict:
        rows = {row["key"]: row["error3d_camera"] for row in ablation.get("stages", {}).get("variants", [])}
        if not rows:
            return Verdict(None, "the part 'stages' of the ablation has not been computed")
        pairs = {name: (error, rows[key][name]) for name, error in rows["whole"].items()}
        pairs = {name: pair for name, pair in pairs.items() if None not in pair}
        if not pairs:
            return Verdict(None, "no solver has both answers")
        texts = (f"{name} {off:.3f} {what}, {on:.3f} otherwise" for name, (on, off) in pairs.items())
        better = [off > on if key == "no-covariance" else off < on for on, off in pairs.values()]
        return Verdict(all(better), "error3d_camera: " + "; ".join(texts))

    return test


CLAIMS = (
    Claim("III-A", "Its recognition error is the lowest in all four actions.", "table1", _lowest_recognition_error),
    Claim("Table 1", "Its recognition error is 21.22, 20.51, 20.97 and 21.08 %.", "table1", _printed_recognition_error),
    Claim("III-A", "The method of Ref. 4 has the highest recognition error.", "table1", _ref4_is_worst),
    Claim("III-B", "It matches pixels best in all three reference images.", "table2", _best_matching),
    Claim("III-B", "It matches up to 96.53 % of pixels and reconstructs 95.98 %.", "table2", _printed_matching),
    Claim("III-C", "Its PSNR is the highest at every frame.", "table3", _best_pictures(3)),
    Claim("III-D", "Its SSIM is the highest at every frame.", "table4", _best_pictures(4)),
    Claim("III-E", "Its MSE is the lowest at every frame.", "table5", _best_pictures(5)),
    Claim("IV (3)", "Its PSNR fluctuates least.", "table3", _smaller_fluctuation(3)),
    Claim("IV (3)", "Its SSIM fluctuates least.", "table4", _smaller_fluctuation(4)),
    Claim("IV (3)", "Its MSE fluctuates least.", "table5", _smaller_fluctuation(5)),
    Claim("Tables 3, 5", "PSNR and MSE as printed describe the same pictures.", "table3", _both_tables_one_picture),
    Claim("IV (1)", "Bilateral filtering removes noise and keeps the shape.", "figures", _filter_cleans),
    Claim("abstract", "A wrongly estimated number of shape bases makes it fail.", "ablation", _wrong_number_of_bases),
    Claim("II-C", "Eigenvalues above one, counted and divided by 6, are K.", "ablation", _bases_by_count),
    Claim("II-C", "The covariance of the tracks helps.", "ablation", _stage("no-covariance", "without it")),
    Claim("II-D", "Filling gaps by prediction helps.", "ablation", _stage("fill-abg", "with filled gaps")),
    Claim("III-F", "Reconstructed scattering points lie very close to the real ones.", "figures", _scatter_is_near),
    Claim("III-F", "Pro-D falls as the number of frames F grows.", "figures", _falls("frames", "snr")),
    Claim("III-F", "Pro-D falls as the SNR grows.", "figures", _falls("snr", "frames")),
    Claim("III-F", "At F = 100 Pro-D is below 1e-3 whatever the SNR.", "figures", _below_a_thousandth),
)
