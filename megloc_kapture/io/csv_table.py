"""CSV tables with a header row, mapped to records.

The header names the columns in any order, so a table edited in a spreadsheet stays readable. A
:class:`Table` takes its columns from the annotations of a record type, or from a dictionary.
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

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import (
    check_relative,
    first_problem,
    named,
    read_text,
    write_bytes,
    writing,
)
from megloc_kapture.values import RigidTransform

RowT = TypeVar("RowT")
_MAX_UNIT_ERROR = 1e-6  # of a quaternion's norm


def read_csv_table(
    path: Path | str, columns: Sequence[str], *, optional: Sequence[str] = ()
) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield ``(line, row)`` for each non-empty row, without missing ``optional`` columns."""
    reader = csv.reader(io.StringIO(read_text(path), newline=""), strict=True)
    try:
        header = next(reader, [])
        if len(set(header)) != len(header) or not (
            set(columns).difference(optional) <= set(header) <= set(columns)
        ):
            expected, found = ",".join(columns), " ".join(",".join(header).split())
            message = f"the header must name the columns {expected}; it reads {found!r}"
            raise DataError(message, path=path, line=1)
        for fields in filter(None, reader):
            if len(fields) != len(header):
                message = f"{len(fields)} fields, but the header names {len(header)}"
                raise DataError(message, path=path, line=reader.line_num)
            yield reader.line_num, dict(zip(header, fields, strict=True))
    except csv.Error as error:
        raise DataError(f"broken CSV: {error}", path=path, line=reader.line_num) from error


def write_csv_table(
    path: Path | str, columns: Sequence[str], rows: Iterable[Sequence[str]]
) -> None:
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    write_bytes(path, out.getvalue().encode("utf-8"))


# ------------------------------------------------------------------------------------ columns


class Column(NamedTuple):
    """Text format of one field; ``read`` raises ValueError for an invalid cell."""

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


def pose_text(pose: RigidTransform) -> str:
    return " ".join(repr(float(value)) for value in (*pose.quat_wxyz, *pose.translation))


def flag(yes: str, no: str) -> Column:
    return _choice({no: False, yes: True}, lambda value: yes if value else no)


def _choice(values: Mapping[str, Any], write: Callable[[Any], str] = str) -> Column:
    def read(text: str) -> Any:
        if text not in values:
            raise ValueError
        return values[text]

    return Column(" or ".join(values), read, write)


def list_of(separator: str) -> Column:
    """Return a column of tuples of strings, which must not contain the separator."""
    return Column(
        f"a list separated by {separator!r}",
        lambda text: tuple(text.split(separator)) if text else (),
        separator.join,
    )


def number(format_spec: str, most: float = math.inf) -> Column:
    """Return a column of numbers; ``most`` restricts them to the range from 0 to it."""

    def read(text: str) -> float:
        value = float(text)
        if most < math.inf and not 0 <= value <= most:
            raise ValueError
        return value

    expected = f"a number from 0 to {most:g}" if most < math.inf else "a number"
    return Column(expected, read, lambda value: format(value, format_spec))


def or_empty(column: Column, empty: Any = None) -> Column:
    """Return the column with ``empty`` (None or NaN) as empty cells."""
    return Column(
        f"{column.expected}, or empty",
        lambda text: column.read(text) if text else empty,
        lambda value: "" if value is None or value != value else column.write(value),
    )


ImageName = Annotated[str, Column("a plain relative path", check_relative, check_relative)]
_BY_TYPE: dict[Any, Column] = {
    str: Column("text"),
    int: Column("a whole number, 0 or more", _count),
    # kapture forbids the comma in image names
    tuple[str, ...]: list_of(","),
    RigidTransform: Column(
        "a pose qw qx qy qz tx ty tz: a unit quaternion and finite numbers", _pose, pose_text
    ),
}


def _column(hint: Any) -> Column:
    if isinstance(hint, Column):
        return hint
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
    """A CSV table whose rows are records of one type, or tuples for columns from a dictionary.

    ``keys`` are groups of columns that must be unique; ``later`` columns may be absent, as in
    older files, and then have the record's defaults.
    """

    def __init__(
        self,
        row: Callable[..., RowT] | Mapping[str, Any],
        *,
        keys: Sequence[tuple[str, ...]] = (),
        later: Sequence[str] = (),
    ) -> None:
        self._keys, self._later = keys, later
        if isinstance(row, Mapping):
            self._row, hints = _as_tuple, row
        else:
            known = get_type_hints(row, include_extras=True)
            self._row, hints = row, {n: known[n] for n in inspect.signature(row).parameters}
        self._columns = {name: _column(hint) for name, hint in hints.items()}

    def read(self, path: Path | str) -> list[RowT]:
        known: set[tuple[tuple[str, ...], ...]] = set()
        rows = []
        for line, cells in read_csv_table(path, tuple(self._columns), optional=self._later):
            with named(path, line):
                values = {n: self._value(n, cells[n]) for n in self._columns if n in cells}
                try:
                    rows.append(self._row(**values))
                except ValidationError as error:
                    raise DataError(first_problem(error)) from error
                self._check_keys(cells, known)
        return rows

    def read_if_there(self, path: Path) -> list[RowT]:
        """Read the records of a file; return an empty list if it is absent."""
        return self.read(path) if path.exists() else []

    def write(self, path: Path | str, rows: Iterable[Any]) -> None:
        """Write records, objects with their attributes, mappings or tuples, in the given order."""
        known: set[tuple[tuple[str, ...], ...]] = set()
        lines = []
        for row in rows:
            cells = self._cells(row)
            self._check_keys(cells, known)
            lines.append(tuple(cells.values()))
        write_csv_table(path, tuple(self._columns), lines)

    def append(self, path: Path | str, row: Any) -> None:
        """Append a record to a table that grows until :meth:`write` replaces it."""
        with writing(path):
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            with open(path, "a", encoding="utf-8", newline="") as file:
                rows = [] if file.tell() else [tuple(self._columns)]
                csv.writer(file, lineterminator="\n").writerows([*rows, self._cells(row).values()])

    def _cells(self, row: Any) -> dict[str, str]:
        if type(row) is tuple:
            values = row
        elif isinstance(row, Mapping):
            values = tuple(row[name] for name in self._columns)
        else:
            values = tuple(getattr(row, name) for name in self._columns)
        columns = zip(self._columns.items(), values, strict=True)
        return {name: column.write(value) for (name, column), value in columns}

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


def _as_tuple(**values: Any) -> Any:
    return tuple(values.values())
