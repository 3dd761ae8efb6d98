"""One file per comparison row of Table 1, and the list of them in the order in which they are printed."""

from eval.rows import reference
from eval.rows.base import Context, Row, RowOutput
from eval.rows.oracle import solve_true_rotations
from eval.rows.papers_rules import solve as solve_papers_rules
from eval.rows.ref4_style import solve as solve_ref4
from eval.rows.ref5_style import solve as solve_ref5
from eval.rows.ref6_style import solve as solve_ref6
from eval.rows.ref7_style import solve as solve_ref7
from eval.rows.ref8_style import solve as solve_ref8
from eval.rows.siblings import solve_with

__all__ = [
    "FLAT",
    "ORACLE",
    "ROWS",
    "SENSOR",
    "SIBLINGS",
    "TRUE_3D",
    "VIEWS_2D",
    "Context",
    "Row",
    "RowOutput",
    "all_rows",
    "rows_of",
]

FLAT = Row("flat", "flat (zero depth)", reference.solve_flat)
SENSOR = Row("sensor", "sensor depth, no method", reference.solve_sensor, uses_depth=True)
VIEWS_2D = Row("views2d", "2D-trained recogniser")  # reads the predictions of FLAT
TRUE_3D = Row("true3d", "true 3D")
ORACLE = Row("true-rotations", "true rotations (oracle)", solve_true_rotations, oracle=True)
SIBLINGS = tuple(
    Row(name, f"{label} (filled)", solve_with(name), filled=True)
    for name, label in (("pta", "PTA"), ("bmm", "BMM"), ("pnd2", "PND2"))
)

ROWS = (
    Row("ref4", "Ref. 4-style (supervised)", solve_ref4, supervised=True),
    Row("ref5", "Ref. 5-style", solve_ref5),
    Row("ref6", "Ref. 6-style", solve_ref6),
    Row("ref7", "Ref. 7-style", solve_ref7),
    Row("ref8", "Ref. 8-style", solve_ref8),
    Row("rigid", "rigid factorisation", reference.solve_rigid),
    Row("paper", "paper's rules (filled)", solve_papers_rules, filled=True),
    Row("default", "torchrecon default", reference.solve_default, uses_depth=True),
    FLAT,
    VIEWS_2D,
    TRUE_3D,
)


def rows_of(regime: str) -> tuple[Row, ...]:
    """The rows of a regime: with a depth sensor, what the sensor alone says is a row too."""
    if regime != "depth":
        return ROWS
    place = ROWS.index(FLAT)
    return (*ROWS[:place], SENSOR, *ROWS[place:])


def all_rows(regime: str) -> tuple[Row, ...]:
    """What Table 1 can show: besides :func:`rows_of` the library's other solvers, and before a turning camera, whose
    path has to be found, the oracle that is told the rotations.

    Example:
        >>> [row.key for row in all_rows("turning") if row not in rows_of("turning")]
        ['pta', 'bmm', 'pnd2', 'true-rotations']
    """
    rows = rows_of(regime)
    place = rows.index(next(row for row in rows if row.key == "default"))
    oracle = (ORACLE,) if regime == "turning" else ()
    return (*rows[:place], *SIBLINGS, rows[place], *oracle, *rows[place + 1 :])
