"""Pairs files, as kapture-localization writes them: query image, map image, score."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.errors import DataError
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.kapture_csv import format_table, parse_float, read_rows
from megloc_kapture.io.paths import check_relative

PAIRS_HEADER = "# query_image, map_image, score"


@dataclass(frozen=True, order=True, slots=True)
class ImagePair:
    """Two images worth matching; the higher the score, the sooner."""

    query: str
    map: str
    score: float


def read_pairs(path: Path | str) -> list[ImagePair]:
    """Read a pairs file, in the order of the file; a repeated pair counts once, where it is first.

    Raises
    ------
    DataError : names file and line.
    """
    path = Path(path)
    pairs: list[ImagePair] = []
    seen: set[tuple[str, str]] = set()
    for line, fields in read_rows(path):
        if len(fields) != 3:
            raise DataError(f"expected 3 columns, got {len(fields)}", path=path, line=line)
        query, map_image = fields[:2]
        try:
            check_relative(query)
            check_relative(map_image)
        except DataError as error:
            raise DataError(error.message, path=path, line=line) from None
        score = parse_float(fields[2], "score", path, line)
        if (query, map_image) not in seen:
            seen.add((query, map_image))
            pairs.append(ImagePair(query, map_image, score))
    return pairs


def write_pairs(path: Path | str, pairs: Iterable[ImagePair]) -> None:
    """Write a pairs file in the given order, atomically.

    Raises
    ------
    DataError : a name that is no plain relative path, or a score that is not finite.
    OutputError : cannot be written.
    """
    rows = []
    for pair in pairs:
        score = float(pair.score)
        if not -float("inf") < score < float("inf"):
            raise DataError(f"score of {pair.query!r}, {pair.map!r} is not finite")
        rows.append([check_relative(pair.query), check_relative(pair.map), repr(score)])
    write_bytes(path, format_table(PAIRS_HEADER, rows))
