"""CSV tables with a header row, read as records.

The header names the columns in any order, so a table edited in a spreadsheet stays readable.
pydantic converts the cells to the types of the record's parameters.
"""

from __future__ import annotations

import csv
import inspect
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BeforeValidator, TypeAdapter, ValidationError
from pydantic_core import ArgsKwargs

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

RecordT = TypeVar("RecordT")


def read_csv_table(
    path: Path | str, columns: Sequence[str], *, optional: Sequence[str] = ()
) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield ``(line, row)`` for each non-empty row; ``optional`` columns may be missing."""
    reader = csv.reader(io.StringIO(read_text(path), newline=""), strict=True)
    try:
        header = next(reader, [])
        if len(set(header)) != len(header) or not (
            set(columns).difference(optional) <= set(header) <= set(columns)
        ):
            expected, actual = ",".join(columns), " ".join(",".join(header).split())
            message = f"the columns should be {expected}; the header reads {actual!r}"
            raise DataError(message, path=path, line=1)
        for fields in filter(None, reader):
            if len(fields) != len(header):
                message = f"{len(fields)} fields, but the header names {len(header)}"
                raise DataError(message, path=path, line=reader.line_num)
            yield reader.line_num, dict(zip(header, fields, strict=True))
    except csv.Error as error:
        raise DataError(f"broken CSV: {error}", path=path, line=reader.line_num) from error


def write_csv_table(
    path: Path | str, columns: Sequence[str], rows: Iterable[Iterable[object]]
) -> None:
    """Write rows of text, numbers, poses and tuples of text; None and NaN give empty cells."""
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(map(_cell, row) for row in rows)
    write_bytes(path, out.getvalue().encode("utf-8"))


def append_csv_rows(path: Path, columns: Sequence[str], rows: Iterable[Iterable[object]]) -> None:
    """Append rows to a provisional table, which :func:`write_csv_table` replaces later."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "a", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            if not file.tell():
                writer.writerow(columns)
            writer.writerows(map(_cell, row) for row in rows)


def _cell(value: object) -> str:
    if value is None or value != value:
        return ""
    if isinstance(value, RigidTransform):
        return " ".join(repr(float(v)) for v in (*value.quat_wxyz, *value.translation))
    # a comma is a safe separator, because kapture forbids it in image names
    return ",".join(value) if isinstance(value, tuple) else str(value)


# ------------------------------------------------------------------------------------ records


def _split(separator: str) -> BeforeValidator:
    return BeforeValidator(lambda text: tuple(text.split(separator)) if text else ())


def _pose(text: str) -> RigidTransform:
    w, x, y, z, *translation = map(float, text.split(" "))
    tx, ty, tz = translation
    return RigidTransform((w, x, y, z), (tx, ty, tz))


ImageName = Annotated[str, AfterValidator(check_relative)]
Names = Annotated[tuple[str, ...], _split(",")]
Parts = Annotated[tuple[str, ...], _split(";")]
PoseCell = Annotated[RigidTransform, BeforeValidator(_pose)]
# types of cells that may be empty
OrNone = BeforeValidator(lambda text: text or None)
OrNan = Annotated[float, BeforeValidator(lambda text: text or "nan")]


@lru_cache
def columns_of(record: Callable[..., Any]) -> tuple[str, ...]:
    return tuple(inspect.signature(record).parameters)


def write_records(path: Path | str, record: Callable[..., Any], rows: Iterable[object]) -> None:
    """Write records of a dataclass, floats with six digits; :func:`read_records` reads them."""
    cells = (
        [f"{v:.6g}" if isinstance(v, float) and v == v else v for v in vars(row).values()]
        for row in rows
    )
    write_csv_table(path, columns_of(record), cells)


_validator = lru_cache(TypeAdapter)


def read_records(
    path: Path | str,
    record: Callable[..., RecordT],
    *,
    optional: Sequence[str] = (),
    missing_ok: bool = False,
) -> list[RecordT]:
    """Read a table whose columns are the parameters of ``record``, a dataclass or a function.

    Older files may lack the ``optional`` columns. With ``missing_ok``, a missing file has no rows.
    """
    if missing_ok and not Path(path).exists():
        return []
    validator = _validator(record)
    records = []
    for line, cells in read_csv_table(path, columns_of(record), optional=optional):
        with named(path, line):
            try:
                values = cells if isinstance(record, type) else ArgsKwargs((), cells)
                records.append(validator.validate_python(values))
            except ValidationError as error:
                raise DataError(first_problem(error)) from error
    return records
