"""Delimited text as rows, streamed: cells become Python objects one row at a time."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence

from torchrecon.io.readers.source import Source

__all__ = ["cell_number", "row_numbers", "table_rows"]

_MAX_CELLS = 8_000_000


def table_rows(source: Source) -> Iterator[list[str]]:
    """Rows of a text table that are not empty; the delimiter is the comma, semicolon or tab of its first lines.

    Raises:
        ReconError: more cells than are read, or quotes that do not close within the size of a field.
    """
    text = source.text
    head = text[:4096]
    delimiter = max(",;\t", key=head.count)
    if text.count(delimiter) > _MAX_CELLS:
        raise source.error(f"more than {_MAX_CELLS} cells; cut the clip into pieces or use an .npz")
    try:
        for row in csv.reader(io.StringIO(text.replace("\x00", " "), newline=None), delimiter=delimiter):
            row = [cell.strip() for cell in row]
            if any(row):
                yield row
    except csv.Error as error:
        raise source.error(f"is not a table ({error}); export it again") from error


def cell_number(source: Source, row: list[str], column: int, number: int) -> float:
    """A cell as a number; NaN where it is empty, missing or says that nothing is there."""
    cell = row[column] if column < len(row) else ""
    if cell.lower() in ("", "nan", "na", "none", "null"):
        return float("nan")
    try:
        return float(cell)
    except ValueError as error:
        raise source.error(f"row {number}, column {column + 1}: {cell[:40]!r} is no number") from error


def row_numbers(source: Source, row: list[str], columns: Sequence[int | None], number: int) -> list[float]:
    """The cells of these columns as numbers; NaN for a column that is None."""
    try:  # most rows are full, and a table may have millions of cells
        return [float("nan") if c is None else float(row[c]) for c in columns]
    except (ValueError, IndexError):
        return [float("nan") if c is None else cell_number(source, row, c, number) for c in columns]
