"""``refinement.csv``: what refining each query's pose came to, step by step."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import read_csv_table, write_csv_table
from megloc_kapture.io.pose_cells import pose_cell, read_pose_cell
from megloc_kapture.values import RefinementRow

REFINEMENT_FILE = "refinement.csv"
_COLUMNS = ("image", "method", "accepted", "reason", "moved_m", "turned_deg", "measures", "before")


def refinement_text(rows: Sequence[RefinementRow]) -> str:
    """What became of a query's pose, as ``status.csv`` has it."""
    return "; ".join(f"{row.method}: {'accepted' if row.accepted else row.reason}" for row in rows)


def write_refinement(path: Path, rows: Iterable[RefinementRow]) -> None:
    """Write the table (the file itself), sorted by image; the steps of an image stay in order.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    cells = (
        (
            row.image,
            row.method,
            "yes" if row.accepted else "no",
            row.reason,
            f"{row.moved_m:.6f}",
            f"{row.turned_deg:.6f}",
            ";".join(row.measures),
            pose_cell(row.before),
        )
        for row in sorted(rows, key=lambda row: row.image)
    )
    write_csv_table(path, _COLUMNS, cells)


def read_refinement(path: Path | str) -> list[RefinementRow]:
    """Read the table (the file itself), in its order.

    Raises
    ------
    DataError : absent or broken table, a value that is not of its kind; names file and line.
    """
    rows = []
    for line, row in read_csv_table(path, _COLUMNS):
        try:
            moved, turned = float(row["moved_m"]), float(row["turned_deg"])
        except ValueError:
            raise DataError("moved_m and turned_deg are numbers", path=path, line=line) from None
        measures = tuple(row["measures"].split(";")) if row["measures"] else ()
        before = read_pose_cell(row["before"], "before", path=path, line=line)
        if before is None:
            raise DataError("before is empty, a pose is expected", path=path, line=line)
        found = RefinementRow(
            row["image"], row["method"], row["reason"], moved, turned, measures, before
        )
        if row["accepted"] != ("yes" if found.accepted else "no"):
            raise DataError(
                f"accepted {row['accepted']!r} and reason {row['reason']!r} contradict each other",
                path=path,
                line=line,
            )
        rows.append(found)
    return rows
