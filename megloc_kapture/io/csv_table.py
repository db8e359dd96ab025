"""CSV tables with a header row, as MegLoc keeps beside kapture (not kapture's own tables).

Comma separated, UTF-8, fields quoted where they hold a comma, a quote or a line end. The header
row names the columns; a reader takes them in any order, so that a table edited by hand in a
spreadsheet still reads.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.text import read_text


def read_csv_table(
    path: Path | str, columns: Sequence[str]
) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield ``(line, row)`` for each row of the table; ``row`` maps every column to its text.

    ``line`` is the 1-based line on which the row ends. Empty lines are passed over.

    Raises
    ------
    DataError : the file cannot be read, its header is not made of ``columns``, a row has too many
        or too few fields, or a quote is left open; names file and line.
    """
    reader = csv.reader(io.StringIO(read_text(path), newline=""), strict=True)
    header: list[str] | None = None
    try:
        for fields in reader:
            if not fields:
                continue
            if header is None:
                header = fields
                if sorted(header) != sorted(columns):
                    raise DataError(
                        f"the header must name the columns {','.join(columns)}; "
                        f"it reads {','.join(header)}",
                        path=path,
                        line=reader.line_num,
                    )
                continue
            if len(fields) != len(header):
                raise DataError(
                    f"{len(fields)} fields where the header names {len(header)}",
                    path=path,
                    line=reader.line_num,
                )
            yield reader.line_num, dict(zip(header, fields, strict=True))
    except csv.Error as error:
        raise DataError(f"broken CSV: {error}", path=path, line=reader.line_num) from error
    if header is None:
        raise DataError(f"empty; expected the header {','.join(columns)}", path=path)


def write_csv_table(
    path: Path | str, columns: Sequence[str], rows: Iterable[Sequence[str]]
) -> None:
    """Write header and rows, atomically, with ``\\n`` line ends.

    Raises
    ------
    OutputError : the file cannot be written, or a field is longer than a CSV reader takes.
    """
    longest = csv.field_size_limit()
    lines = [",".join(columns)]
    for row in rows:
        for column, field in zip(columns, row, strict=True):
            if len(field) > longest:
                raise OutputError(
                    f"{path}: column {column} has a field of {len(field)} characters; "
                    f"CSV readers take {longest}"
                )
        lines.append(",".join(map(_quoted, row)))
    write_bytes(path, "".join(f"{line}\n" for line in lines).encode("utf-8"))


def _quoted(field: str) -> str:
    # python's csv.writer leaves a lone carriage return bare, and its reader ends the row there
    if any(c in field for c in ',"\r\n'):
        return '"' + field.replace('"', '""') + '"'
    return field
