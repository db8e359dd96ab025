"""Relocalization files of the MLAD challenges: which keyframe is asked for in which map.

The three challenges name them differently:

====  ==============================================================================
2020  ``relocalizationFile_<target>[_easy|_moderate|_hard].txt``, in the source's folder
2021  ``relocalizationFile_<source>_to_<target>.txt``
2022  ``reloc_<source>_to_<target>.txt``
====  ==============================================================================
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.datasets.grammars.fourseasons_lines import (
    data_lines,
    parse_timestamp,
    parse_transform,
)
from megloc_kapture.errors import DataError
from megloc_kapture.values import RigidTransform

_NAMES = (
    re.compile(r"relocalizationFile_(?P<source>.+)_to_(?P<target>.+)\.txt"),
    re.compile(r"relocalizationFile_(?P<target>.+?)(?:_(?:easy|moderate|hard))?\.txt"),
    re.compile(r"reloc_(?P<source>.+)_to_(?P<target>.+)\.txt"),
)


@dataclass(frozen=True, slots=True)
class RelocalizationRow:
    """A pair of keyframes.

    Parameters
    ----------
    reference, query : timestamps, ns.
    query_from_reference : between their left cameras, metres; None where it is withheld.
    """

    reference: int
    query: int
    query_from_reference: RigidTransform | None


def parse_relocalization_name(name: str) -> tuple[str | None, str] | None:
    """Source (None where the name leaves it out) and target recording of a file's name.

    None for a name that is none of a relocalization file.
    """
    for pattern in _NAMES:
        found = pattern.fullmatch(name)
        if found is not None:
            parts = found.groupdict()
            return parts.get("source"), parts["target"]
    return None


def read_relocalization(path: Path) -> list[RelocalizationRow]:
    """Read the pairs of a relocalization file, in its order.

    Raises
    ------
    DataError : a line other than ``reference query [tx ty tz qx qy qz qw]``, or no pair; names
        file and line.
    """
    rows = []
    for number, fields in data_lines(path):
        if len(fields) not in (2, 9):
            raise DataError(
                "expected 'reference query' or 'reference query tx ty tz qx qy qz qw', got "
                f"{len(fields)} fields",
                path=path,
                line=number,
            )
        reference, query = (parse_timestamp(field, path, number) for field in fields[:2])
        pose = parse_transform(fields[2:], path, number) if len(fields) == 9 else None
        rows.append(RelocalizationRow(reference, query, pose))
    if not rows:
        raise DataError("no pair in the file", path=path)
    return rows
