"""Tables of challenges whose pose files no rule can describe; in ``megloc/`` beside the others.

==================  ==============================================================================
names.csv           image, name: what each scored query is called in the pose file, in the order
                    of the challenge's list
relocalization.csv  file, reference, query: the pairs an MLAD challenge asks for, in its order;
                    ``file`` is the name of the pose file to hand in
==================  ==============================================================================

A table that is absent stands for an empty one: names follow the protocol's rule, no pairs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import read_csv_table, write_csv_table
from megloc_kapture.io.paths import check_relative

NAMES_FILE = "names.csv"
RELOCALIZATION_FILE = "relocalization.csv"

NAMES_COLUMNS = ("image", "name")
RELOCALIZATION_COLUMNS = ("file", "reference", "query")


@dataclass(frozen=True, slots=True)
class RelocalizationPair:
    """One row of an MLAD relocalization file: both images by their kapture names."""

    file: str
    reference: str
    query: str


def read_names(folder: Path | str) -> dict[str, str]:
    """Read ``names.csv``: image -> its name in the pose file, in the table's order.

    Raises
    ------
    DataError : broken table; an image or a name that is given twice, or holds white space.
    """
    path = Path(folder) / NAMES_FILE
    names: dict[str, str] = {}
    if not path.exists():
        return names
    taken: set[str] = set()
    for line, row in read_csv_table(path, NAMES_COLUMNS):
        image, name = _relative(row["image"], path, line), row["name"]
        if name.split() != [name]:
            raise DataError(f"a pose file cannot hold the name {name!r}", path=path, line=line)
        if image in names or name in taken:
            raise DataError(f"{image!r} or {name!r} is given twice", path=path, line=line)
        names[image] = name
        taken.add(name)
    return names


def write_names(folder: Path | str, names: Mapping[str, str]) -> None:
    """Write ``names.csv`` in the order of ``names``.

    Raises
    ------
    DataError : an image name is not a plain relative path.
    OutputError : the file cannot be written.
    """
    rows = ((check_relative(image), name) for image, name in names.items())
    write_csv_table(Path(folder) / NAMES_FILE, NAMES_COLUMNS, rows)


def read_relocalization(folder: Path | str) -> list[RelocalizationPair]:
    """Read ``relocalization.csv`` in its order.

    Raises
    ------
    DataError : broken table, a name that is no plain relative path.
    """
    path = Path(folder) / RELOCALIZATION_FILE
    if not path.exists():
        return []
    return [
        RelocalizationPair(*(_relative(row[column], path, line) for column in row))
        for line, row in read_csv_table(path, RELOCALIZATION_COLUMNS)
    ]


def write_relocalization(folder: Path | str, pairs: Iterable[RelocalizationPair]) -> None:
    """Write ``relocalization.csv`` in the order of ``pairs``.

    Raises
    ------
    DataError : a name is not a plain relative path.
    OutputError : the file cannot be written.
    """
    rows = (tuple(map(check_relative, (p.file, p.reference, p.query))) for p in pairs)
    write_csv_table(Path(folder) / RELOCALIZATION_FILE, RELOCALIZATION_COLUMNS, rows)


def _relative(text: str, path: Path, line: int) -> str:
    try:
        return check_relative(text)
    except DataError as error:
        raise DataError(error.message, path=path, line=line) from error
