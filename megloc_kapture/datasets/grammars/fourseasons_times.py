"""4Seasons' ``times.txt``: the frames of a recording, whether or not their images are published."""

from __future__ import annotations

from pathlib import Path

from megloc_kapture.datasets.grammars.fourseasons_lines import data_lines, parse_timestamp
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture_csv import parse_float


def read_times(path: Path) -> list[int]:
    """Read the timestamps (ns) of a recording's frames, in the file's order.

    The time in seconds and the exposure that follow are checked and left: a float of seconds has
    lost the last digits of the nanoseconds.

    Raises
    ------
    DataError : a line other than ``timestamp seconds [exposure_ms]``, a timestamp given twice, or
        no frame; names file and line.
    """
    times: dict[int, None] = {}
    for number, fields in data_lines(path):
        if len(fields) not in (2, 3):
            raise DataError(
                f"expected 'timestamp seconds exposure', got {len(fields)} fields",
                path=path,
                line=number,
            )
        timestamp = parse_timestamp(fields[0], path, number)
        for field in fields[1:]:
            parse_float(field, "time or exposure", path, number)
        if timestamp in times:
            raise DataError(f"timestamp {timestamp} is given twice", path=path, line=number)
        times[timestamp] = None
    if not times:
        raise DataError("no frame in the file", path=path)
    return list(times)
