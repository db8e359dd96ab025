"""``map_consistency.csv``: how far a map's own images would move, per coordinate frame."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import read_csv_table, write_csv_table

CONSISTENCY_FILE = "map_consistency.csv"


@dataclass(frozen=True)
class ConsistencyRow:
    """What one refiner's test of one coordinate frame of a map came to.

    Attributes
    ----------
    images, contradicting : map images whose displacement is known, and those that contradict.
    moved_m, turned_deg, moved_px, claimed_m, claimed_deg, squared_distance : their medians, as of
        ``megloc_kapture.refinement.consistency.Displacement``; NaN where there is none.
    reason : why poses of queries are not refined there; empty where they are.
    """

    frame: str
    method: str
    images: int
    contradicting: int
    moved_m: float
    turned_deg: float
    moved_px: float
    claimed_m: float
    claimed_deg: float
    squared_distance: float
    reason: str


_COLUMNS = tuple(field.name for field in fields(ConsistencyRow))
_MEASURES = _COLUMNS[4:-1]


def write_consistency(path: Path, rows: Iterable[ConsistencyRow]) -> None:
    """Write the table (the file itself), in the order given.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    cells = (
        (
            row.frame,
            row.method,
            str(row.images),
            str(row.contradicting),
            *("" if math.isnan(x := getattr(row, name)) else f"{x:.6g}" for name in _MEASURES),
            row.reason,
        )
        for row in rows
    )
    write_csv_table(path, _COLUMNS, cells)


def read_consistency(path: Path | str) -> list[ConsistencyRow]:
    """Read the table (the file itself), in its order.

    Raises
    ------
    DataError : absent or broken table, a value that is no number; names file and line.
    """
    rows = []
    for line, row in read_csv_table(path, _COLUMNS):
        for name in ("images", "contradicting"):
            if not row[name].isdecimal():
                raise DataError(f"{name} {row[name]!r} is no count", path=path, line=line)
        try:
            measures = {name: float(row[name] or "nan") for name in _MEASURES}
        except ValueError:
            raise DataError(
                f"{', '.join(_MEASURES)} are numbers or empty", path=path, line=line
            ) from None
        rows.append(
            ConsistencyRow(
                frame=row["frame"],
                method=row["method"],
                images=int(row["images"]),
                contradicting=int(row["contradicting"]),
                reason=row["reason"],
                **measures,
            )
        )
    return rows
