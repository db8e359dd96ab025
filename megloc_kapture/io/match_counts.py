"""``match_counts.csv``: how many matches each pair had, and has verified, beside its matches."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import read_csv_table, write_csv_table

_COLUMNS = ("image", "other", "matches", "verified")


@dataclass(frozen=True)
class PairCount:
    """Matches of one pair: what the matcher found, and what verification left."""

    image: str
    other: str
    matches: int
    verified: int


def match_counts_path(features_dir: Path, type_name: str) -> Path:
    """The table of a keypoints type in a features folder (orphan layout)."""
    return features_dir / "local_features" / type_name / "match_counts.csv"


def write_match_counts(features_dir: Path, type_name: str, counts: Iterable[PairCount]) -> None:
    """Write the table, in the order given.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    rows = ((c.image, c.other, str(c.matches), str(c.verified)) for c in counts)
    write_csv_table(match_counts_path(features_dir, type_name), _COLUMNS, rows)


def read_match_counts(features_dir: Path, type_name: str) -> list[PairCount]:
    """Read the table, in its order.

    Raises
    ------
    DataError : absent or broken table, or no numbers; names file and line.
    """
    path = match_counts_path(features_dir, type_name)
    counts = []
    for line, row in read_csv_table(path, _COLUMNS):
        for column in ("matches", "verified"):
            if not row[column].isdecimal():
                raise DataError(
                    f"{column} {row[column]!r} is no number of matches", path=path, line=line
                )
        counts.append(
            PairCount(row["image"], row["other"], int(row["matches"]), int(row["verified"]))
        )
    return counts
