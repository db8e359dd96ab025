"""CSV tables with a header row, as MegLoc keeps beside kapture: records in, records out.

Comma separated, UTF-8, a header row that names the columns, fields quoted where they hold a comma,
a quote or a line end. A reader takes the columns in any order, so that a table edited by hand in a
spreadsheet still reads. A :class:`Table` joins a record type with its columns; what is wrong with a
file is told by file, line, column and what was expected.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from pydantic import ValidationError

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.files import first_problem, read_text, write_bytes
from megloc_kapture.io.paths import check_relative
from megloc_kapture.values import RigidTransform

RowT = TypeVar("RowT")
_MAX_BYTES = 1 << 31
_MAX_UNIT_ERROR = 1e-6  # of the length of a quaternion that is written with every digit


def read_csv_table(
    path: Path | str, columns: Sequence[str], *, optional: Sequence[str] = ()
) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield ``(line, row)`` for each row of the table; ``row`` maps every column to its text.

    ``line`` is the 1-based line on which the row ends. Empty lines are passed over. Those of the
    columns that are ``optional`` may be absent, and are in no row then.

    Raises
    ------
    DataError : the file cannot be read, its header is not made of ``columns``, a row has too many
        or too few fields, or a quote is left open; names file and line.
    """
    reader = csv.reader(io.StringIO(read_text(path, _MAX_BYTES), newline=""), strict=True)
    header: list[str] | None = None
    try:
        for fields in reader:
            if not fields:
                continue
            problem = None
            if header is None:
                header = fields
                needed = set(columns).difference(optional)
                unique = len(set(header)) == len(header)
                if unique and needed <= set(header) <= set(columns):
                    continue
                problem = (
                    f"the header must name the columns {','.join(columns)}; "
                    f"it reads {' '.join(','.join(header).split())}"
                )
            elif len(fields) != len(header):
                problem = f"{len(fields)} fields where the header names {len(header)}"
            if problem:
                raise DataError(problem, path=path, line=reader.line_num)
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


class Column(NamedTuple):
    """The text of one field of a record; ``read`` raises ValueError where a cell is no such."""

    expected: str
    read: Callable[[str], Any] = str
    write: Callable[[Any], str] = str


class Table(Generic[RowT]):
    """A CSV table whose rows are records of one type.

    Parameters
    ----------
    row : makes a record of the values by column: a dataclass, a named tuple or a pydantic model.
    columns : by the name of the column, which is that of the record's attribute.
    keys : groups of columns; no two rows may have the same in all columns of one.
    later : columns that older files lack; the record's own defaults stand for them.
    """

    def __init__(
        self,
        row: Callable[..., RowT],
        columns: Mapping[str, Column],
        *,
        keys: Sequence[tuple[str, ...]] = (),
        later: Sequence[str] = (),
    ) -> None:
        self._row, self._columns, self._keys, self._later = row, columns, keys, later

    def read(self, path: Path | str) -> Iterator[RowT]:
        """The records of a file, in its order.

        Raises
        ------
        DataError : absent or broken table, a value that is not of its kind, a key given twice;
            names file, line and column.
        """
        known: set[tuple[tuple[str, ...], ...]] = set()
        for line, cells in read_csv_table(path, tuple(self._columns), optional=self._later):
            try:
                row = self._row(**{name: self._value(name, text) for name, text in cells.items()})
                self._check_keys(cells, known)
            except ValidationError as error:
                raise DataError(first_problem(error), path=path, line=line) from error
            except DataError as error:
                raise DataError(error.message, path=path, line=line) from error
            yield row

    def read_if_there(self, path: Path) -> Iterator[RowT]:
        """The records of a file, none of one that is absent; see :meth:`read`."""
        if path.exists():
            yield from self.read(path)

    def write(self, path: Path | str, rows: Iterable[RowT]) -> None:
        """Write the records in the order given.

        Raises
        ------
        DataError : a key given twice, or a name that cannot stand in the table.
        OutputError : the file cannot be written.
        """
        known: set[tuple[tuple[str, ...], ...]] = set()
        lines = []
        for row in rows:
            cells = {
                name: column.write(getattr(row, name)) for name, column in self._columns.items()
            }
            self._check_keys(cells, known)
            lines.append(tuple(cells.values()))
        write_csv_table(path, tuple(self._columns), lines)

    def _check_keys(
        self, cells: Mapping[str, str], known: set[tuple[tuple[str, ...], ...]]
    ) -> None:
        for key in self._keys:
            value = tuple(cells[name] for name in key)
            if (key, value) in known:
                raise DataError(f"{', '.join(key)} {', '.join(map(repr, value))} is given twice")
            known.add((key, value))

    def _value(self, name: str, text: str) -> Any:
        column = self._columns[name]
        try:
            return column.read(text)
        except ValueError as error:
            raise DataError(f"{name} {text!r} is not {column.expected}") from error


def _count(text: str) -> int:
    if not text.isdecimal():
        raise ValueError
    return int(text)


def _pose(text: str) -> RigidTransform:
    w, x, y, z, a, b, c = (float(value) for value in text.split(" "))
    if not math.isfinite(a + b + c) or not abs(math.hypot(w, x, y, z) - 1.0) < _MAX_UNIT_ERROR:
        raise ValueError
    return RigidTransform((w, x, y, z), (a, b, c))


def _pose_text(pose: RigidTransform) -> str:
    """Quaternion, w first, and translation; every digit, so that it reads back the same."""
    return " ".join(repr(float(value)) for value in (*pose.quat_wxyz, *pose.translation))


def flag(yes: str, no: str) -> Column:
    """A bool by its two texts."""

    def read(text: str) -> bool:
        if text not in (yes, no):
            raise ValueError
        return text == yes

    return Column(f"{no} or {yes}", read, lambda value: yes if value else no)


def one_of(*texts: str) -> Column:
    """One of some texts."""

    def read(text: str) -> str:
        if text not in texts:
            raise ValueError
        return text

    return Column(" or ".join(texts), read)


def list_of(separator: str) -> Column:
    """A tuple of texts in one cell, which must not hold the separator."""
    return Column(
        f"a list separated by {separator!r}",
        lambda text: tuple(text.split(separator)) if text else (),
        separator.join,
    )


def number(format_spec: str) -> Column:
    """A float, written as the format says."""
    return Column("a number", float, lambda value: format(value, format_spec))


def or_empty(column: Column, empty: Any = None) -> Column:
    """The same, or nothing: an empty cell stands for ``empty`` (None or NaN)."""
    return Column(
        f"{column.expected}, or empty",
        lambda text: column.read(text) if text else empty,
        lambda value: "" if value is None or value != value else column.write(value),
    )


TEXT = Column("text")
IMAGE = Column("a plain relative path", check_relative, check_relative)
COUNT = Column("a whole number from 0 on", _count)
ZERO_ONE, YES_NO = flag("1", "0"), flag("yes", "no")
# the comma is the one character that kapture allows in no image name
IMAGES = list_of(",")
POSE = Column(
    "a pose qw qx qy qz tx ty tz: a unit quaternion and finite numbers", _pose, _pose_text
)
