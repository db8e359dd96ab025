"""CSV tables with a header row, as MegLoc keeps beside kapture: records in, records out.

Comma separated, UTF-8, a header row that names the columns, fields quoted where they hold a comma,
a quote or a line end. A reader takes the columns in any order, so that a table edited by hand in a
spreadsheet still reads. A :class:`Table` takes its columns from the annotations of a record type.

Readers raise DataError, which names file, line, column and what was expected; writers OutputError
where the file cannot be written.
"""

from __future__ import annotations

import csv
import inspect
import io
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Generic,
    Literal,
    NamedTuple,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

from pydantic import ValidationError

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.files import check_relative, first_problem, named, read_text, write_bytes
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

    Raises DataError: the file cannot be read, its header is not made of ``columns``, a row has too
    many or too few fields, or a quote is left open; names file and line.
    """
    reader = csv.reader(io.StringIO(read_text(path, _MAX_BYTES), newline=""), strict=True)
    header: list[str] | None = None
    try:
        for fields in filter(None, reader):
            with named(path, reader.line_num):
                if header is None:
                    header = fields
                    _check_header(header, columns, optional)
                    continue
                if len(fields) != len(header):
                    raise DataError(f"{len(fields)} fields where the header names {len(header)}")
            yield reader.line_num, dict(zip(header, fields, strict=True))
    except csv.Error as error:
        raise DataError(f"broken CSV: {error}", path=path, line=reader.line_num) from error
    if header is None:
        raise DataError(f"empty; expected the header {','.join(columns)}", path=path)


def _check_header(header: list[str], columns: Sequence[str], optional: Sequence[str]) -> None:
    needed = set(columns).difference(optional)
    if len(set(header)) != len(header) or not needed <= set(header) <= set(columns):
        raise DataError(
            f"the header must name the columns {','.join(columns)}; "
            f"it reads {' '.join(','.join(header).split())}"
        )


def write_csv_table(
    path: Path | str, columns: Sequence[str], rows: Iterable[Sequence[str]]
) -> None:
    """Write header and rows, atomically, with ``\\n`` line ends.

    Raises OutputError where the file cannot be written, or a field is longer than a CSV reader
    takes.
    """
    longest = csv.field_size_limit()
    lines = [",".join(map(_quoted, columns))]
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


# ------------------------------------------------------------------------------------ columns


class Column(NamedTuple):
    """The text of one field of a record; ``read`` raises ValueError where a cell is no such."""

    expected: str
    read: Callable[[str], Any] = str
    write: Callable[[Any], str] = str


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
    return _choice({no: False, yes: True}, lambda value: yes if value else no)


def _choice(values: Mapping[str, Any], write: Callable[[Any], str] = str) -> Column:
    def read(text: str) -> Any:
        if text not in values:
            raise ValueError
        return values[text]

    return Column(" or ".join(values), read, write)


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
POSE = Column(
    "a pose qw qx qy qz tx ty tz: a unit quaternion and finite numbers", _pose, _pose_text
)
ImageName = Annotated[str, Column("a plain relative path", check_relative, check_relative)]
_BY_TYPE: dict[Any, Column] = {
    str: TEXT,
    int: Column("a whole number from 0 on", _count),
    # the comma is the one character that kapture allows in no image name
    tuple[str, ...]: list_of(","),
    RigidTransform: POSE,
}


def _column(hint: Any) -> Column:
    """The column that stands in the annotation of a field, else that of its type."""
    arguments = get_args(hint)
    if get_origin(hint) is Annotated:
        columns = [part for part in arguments if isinstance(part, Column)]
        return columns[0] if columns else _column(arguments[0])
    if get_origin(hint) is Literal:
        return _choice({text: text for text in arguments})
    if type(None) in arguments:
        return or_empty(_column(arguments[0]))
    return _BY_TYPE[hint]


class Table(Generic[RowT]):
    """A CSV table whose rows are records of one type.

    Parameters
    ----------
    row : makes a record of the values by column: a dataclass, a named tuple or a pydantic model.
    columns : by the name of the column, which is that of the record's attribute; without them a
        field's column is in its annotation, or follows from its type.
    keys : groups of columns; no two rows may have the same in all columns of one.
    later : columns that older files lack; the record's own defaults stand for them.
    """

    def __init__(
        self,
        row: Callable[..., RowT],
        columns: Mapping[str, Column] | None = None,
        *,
        keys: Sequence[tuple[str, ...]] = (),
        later: Sequence[str] = (),
    ) -> None:
        self._row, self._keys, self._later = row, keys, later
        if columns is None:
            hints = get_type_hints(row, include_extras=True)
            columns = {name: _column(hints[name]) for name in inspect.signature(row).parameters}
        self._columns = columns

    def read(self, path: Path | str) -> list[RowT]:
        """The records of a file, in its order.

        Raises DataError: absent or broken table, a value that is not of its kind, a key given
        twice; names file, line and column.
        """
        known: set[tuple[tuple[str, ...], ...]] = set()
        rows = []
        for line, cells in read_csv_table(path, tuple(self._columns), optional=self._later):
            # no context is entered for each of a benchmark's tens of thousands of rows
            try:
                values = {name: self._value(name, text) for name, text in cells.items()}
                rows.append(self._row(**values))
                self._check_keys(cells, known)
            except ValidationError as error:
                raise DataError(first_problem(error), path=path, line=line) from error
            except DataError:
                with named(path, line):
                    raise
        return rows

    def read_if_there(self, path: Path) -> list[RowT]:
        """The records of a file, none of one that is absent; see :meth:`read`."""
        return self.read(path) if path.exists() else []

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
        try:
            return self._columns[name].read(text)
        except ValueError as error:
            raise DataError(f"{name} {text!r} is not {self._columns[name].expected}") from error
