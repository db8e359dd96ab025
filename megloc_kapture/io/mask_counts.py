"""``masked.csv``: keypoints that masks removed, image by image, beside the features of a type."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import read_csv_table, write_csv_table

_COLUMNS = ("image", "num_masked")


def mask_counts_path(features_dir: Path, type_name: str) -> Path:
    """The table of a keypoints type in a feature folder (orphan layout)."""
    return features_dir / "local_features" / type_name / "masked.csv"


def write_mask_counts(features_dir: Path, type_name: str, counts: Mapping[str, int]) -> None:
    """Write the table: image that has a mask -> keypoints that it removed.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    rows = ((image, str(number)) for image, number in sorted(counts.items()))
    write_csv_table(mask_counts_path(features_dir, type_name), _COLUMNS, rows)


def read_mask_counts(features_dir: Path, type_name: str) -> dict[str, int]:
    """Read the table; empty where there is none.

    Raises
    ------
    DataError : broken table, or no number; names file and line.
    """
    path = mask_counts_path(features_dir, type_name)
    counts: dict[str, int] = {}
    if not path.is_file():
        return counts
    for line, row in read_csv_table(path, _COLUMNS):
        if not row["num_masked"].isdecimal():
            raise DataError(
                f"num_masked {row['num_masked']!r} is no number of keypoints", path=path, line=line
            )
        counts[row["image"]] = int(row["num_masked"])
    return counts
