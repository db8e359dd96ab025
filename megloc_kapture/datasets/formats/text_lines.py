"""Lines of text files: their fields as names and numbers, with errors that name file and line.

CRLF line ends, blank lines, a byte order mark and a missing end of the last line are accepted in
every file. Small files are read whole, line by line. Large ones are a :class:`TextFile`, whose rows
of numbers become arrays block by block; where a block is not made of numbers, the format's reader
checks its lines one by one.
"""

from __future__ import annotations

import math
import os
import re
import stat
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import check_relative, named, read_text, reading
from megloc_kapture.io.kapture.format import BYTE_ORDER_MARK, FLOAT_PATTERN
from megloc_kapture.io.kapture.sensors import unit_quaternion
from megloc_kapture.values import RigidTransform

# larger distances are broken and would overflow further on; ECEF coordinates are below 1e7
MAX_DISTANCE_M = 1e9
# of R^T R from the identity; published matrices have six decimals
MAX_ROTATION_ERROR = 1e-3

_COUNT = re.compile(r"[0-9]{1,18}")
_BLANKS = " \t\r\v\f"
_BETWEEN_BLANKS = re.compile(f"[{_BLANKS}]+")
_SHOWN = 40
_BLOCK_BYTES = 1 << 23
# no row of any format here comes near it; a file without line breaks shall not fill the memory
_MAX_LINE_BYTES = 1 << 28


@dataclass(frozen=True)
class Line:
    """One line of a file: its number, and its text without blanks around it."""

    path: Path
    number: int
    text: str

    @cached_property
    def fields(self) -> list[str]:
        """The fields between blanks."""
        return _BETWEEN_BLANKS.split(self.text) if self.text else []

    @cached_property
    def comma_fields(self) -> list[str]:
        """The fields between commas, of which one may end the line; between blanks without any."""
        if "," not in self.text:
            return self.fields
        fields = [field.strip(_BLANKS) for field in self.text.split(",")]
        return fields[:-1] if fields[-1] == "" else fields

    def rest(self, index: int) -> str:
        """The text from a field on, with the blanks in it."""
        return _BETWEEN_BLANKS.split(self.text, maxsplit=index)[index]

    def error(self, message: str) -> DataError:
        """The error for this line."""
        return DataError(message, path=self.path, line=self.number)

    def named(self) -> AbstractContextManager[None]:
        """Let DataErrors that name no file name this line."""
        return named(self.path, self.number)

    def expect(self, fields: Sequence[str], counts: int | Iterable[int], form: str) -> None:
        """Raise DataError where there is another number of fields; ``form`` lists them."""
        expected = (counts,) if isinstance(counts, int) else tuple(counts)
        if len(fields) not in expected:
            raise self.error(
                f"expected {' or '.join(map(str, expected))} fields ({form}), got {len(fields)}"
            )

    def number_of(self, text: str, what: str) -> float:
        """A finite decimal number; DataError where the text is none."""
        value = float(text) if FLOAT_PATTERN.fullmatch(text) else math.nan
        if not math.isfinite(value):
            raise self.error(f"{what} {shown(text)} is not a finite number")
        return value

    def numbers_of(self, texts: Iterable[str], what: str) -> list[float]:
        """Finite decimal numbers; DataError where a text is none."""
        return [self.number_of(text, what) for text in texts]

    def count_of(self, text: str, what: str, limit: int = 1 << 62) -> int:
        """A whole number from 0 to below ``limit``; DataError where the text is none."""
        if not _COUNT.fullmatch(text):
            raise self.error(f"{what} {shown(text)} is not a whole number of at least 0")
        value = int(text)
        if value >= limit:
            raise self.error(f"{what} {value} is out of range, there are {limit}")
        return value

    def colour_of(self, texts: Sequence[str]) -> None:
        """Check R G B, from 0 to 255; DataError where they are none."""
        values = self.numbers_of(texts, "colour")
        if not all(value.is_integer() and 0 <= value <= 255 for value in values):
            raise self.error("a colour is not made of whole numbers from 0 to 255")

    def name_of(self, text: str) -> str:
        """An image's name, see :func:`image_name`."""
        with self.named():
            return image_name(text)

    def pose_of(self, texts: Sequence[str]) -> RigidTransform:
        """The transform of qw qx qy qz tx ty tz; DataError where they are none."""
        w, x, y, z, tx, ty, tz = self.numbers_of(texts, "pose")
        with self.named():
            return RigidTransform(unit_quaternion((w, x, y, z)), (tx, ty, tz))

    def rigid_transform(self, matrix: NDArray[np.float64]) -> RigidTransform:
        """The transform of a 4x4 matrix; DataError where it is none or leads beyond the earth."""
        rotation, position = matrix[:3, :3], matrix[:3, 3]
        # huge elements may overflow; what comes of it is not below the limit
        with np.errstate(over="ignore", invalid="ignore"):
            error = np.abs(rotation.T @ rotation - np.eye(3)).max()
            proper = error < MAX_ROTATION_ERROR and np.linalg.det(rotation) > 0
        if not proper:
            raise self.error("the upper left 3x3 of the matrix is no rotation matrix")
        if not np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() < MAX_ROTATION_ERROR:
            raise self.error(f"the matrix' last row is {_joined(matrix[3])}, expected 0 0 0 1")
        if not np.abs(position).max() <= MAX_DISTANCE_M:
            raise self.error(f"the position {_joined(position)} is nowhere on earth")
        return RigidTransform.from_matrix(rotation, position)


def read_lines(path: Path, *, blank: bool = False, comments: bool = False) -> list[Line]:
    """The lines of a text file.

    Parameters
    ----------
    blank : keeps the blank ones, except an empty last one.
    comments : leaves out those that begin with #.

    Raises
    ------
    DataError : missing, not readable or no UTF-8 text; names file and line.
    """
    check_plain(path)
    texts = [text.strip(_BLANKS) for text in read_text(path).split("\n")]
    if not texts[-1]:
        texts.pop()
    return [
        Line(path, number, text)
        for number, text in enumerate(texts, start=1)
        if (text or blank) and not (comments and text.startswith("#"))
    ]


def read_rigid_matrix(path: Path, *, comments: bool = False) -> RigidTransform:
    """The transform of a file with a 4x4 matrix, four lines of numbers between commas or blanks.

    DataError names file and line.
    """
    lines = read_lines(path, comments=comments)
    for index, line in enumerate(lines):
        if index == 4 or len(line.comma_fields) != 4:
            raise line.error(
                f"expected four lines of four numbers, got line {index + 1} with "
                f"{len(line.comma_fields)}"
            )
    if len(lines) != 4:
        number = lines[-1].number + 1 if lines else 1
        raise DataError(
            f"expected four lines of four numbers, got {len(lines)}", path=path, line=number
        )
    rows = [line.numbers_of(line.comma_fields, "matrix element") for line in lines]
    return lines[-1].rigid_transform(np.array(rows))


def image_name(text: str) -> str:
    """The name of an image, a plain path below the images' folder; without ``./`` before it.

    DataError, which does not name the file, where it is not UTF-8 or not plain.
    """
    try:
        text.encode()
    except UnicodeEncodeError:
        raise DataError("the image's name is not UTF-8") from None
    with named(about="the image's name"):
        return check_relative(text.removeprefix("./"))


def shown(text: str) -> str:
    """A text in quotes for an error, its beginning where it is long."""
    text = text.encode("utf-8", errors="replace").decode()
    return repr(text if len(text) <= _SHOWN else text[:_SHOWN] + "...")


def check_plain(path: Path) -> None:
    """Raise DataError where a file is missing or none: a pipe or a device might never end."""
    with reading(path):
        try:
            mode = os.stat(path).st_mode
        except FileNotFoundError as error:
            raise DataError("file is missing", path=path) from error
    if not stat.S_ISREG(mode):
        raise DataError("not a plain file", path=path)


# ------------------------------------------------------------------------------------ large files


class Block(NamedTuple):
    """Complete lines of a file, and the number of the first."""

    path: Path
    first_line: int
    content: bytes

    def rows(self) -> Iterator[Line]:
        """The lines that are not blank."""
        for number, content in enumerate(self.content.split(b"\n"), start=self.first_line):
            line = _decoded(self.path, number, content)
            if line.text:
                yield line

    def without_comments(self) -> Block:
        """The same with lines that begin with # blank."""
        if b"#" not in self.content:
            return self
        lines = self.content.split(b"\n")
        kept = (b"" if line.lstrip().startswith(b"#") else line for line in lines)
        return self._replace(content=b"\n".join(kept))

    def num_rows(self) -> int:
        """The number of lines that are not blank."""
        return sum(1 for line in self.content.split(b"\n") if line.strip())

    def numbers(self) -> NumberRows | None:
        """The numbers of all rows; None where anything else stands there, or what is infinite."""
        # a row ends with nan, which no row may have in it
        text = self.content.replace(b"\n", b" nan ")
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            try:
                values = np.fromstring(text, sep=" ")
            except (DeprecationWarning, ValueError):
                return None
        ends = np.flatnonzero(np.isnan(values))
        if len(ends) != self.content.count(b"\n") or np.isinf(values).any():
            return None
        starts = np.concatenate([[0], ends[:-1] + 1])
        filled = ends > starts
        return NumberRows(values, starts[filled], (ends - starts)[filled])


class NumberRows(NamedTuple):
    """Rows of numbers: where ``starts`` and ``lengths`` (R,) say, in ``values`` (N,)."""

    values: NDArray[np.float64]
    starts: NDArray[np.int64]
    lengths: NDArray[np.int64]

    def heads(self, count: int) -> NDArray[np.float64]:
        """The first numbers (R, count) of the rows, of which none is shorter."""
        return self.values[self.starts[:, None] + np.arange(count)]

    def tails(self, count: int) -> NDArray[np.float64]:
        """The numbers behind the heads, of all rows together."""
        steps = np.zeros(len(self.values) + 1, np.int8)
        steps[self.starts + count] += 1
        steps[self.starts + self.lengths] -= 1
        return self.values[np.cumsum(steps[:-1], dtype=np.int8).view(np.bool_)]


class TextFile(AbstractContextManager["TextFile"]):
    """A large text file that is read from its beginning to its end, in bounded memory.

    Use as a context manager.

    Attributes
    ----------
    last_line : number of the line read last.

    Raises
    ------
    DataError : missing, not readable, or not a plain file.
    """

    def __init__(self, path: Path, *, block_bytes: int = _BLOCK_BYTES) -> None:
        self.path = Path(path)
        self.last_line = 0
        self._block_bytes = block_bytes
        check_plain(self.path)
        with reading(self.path):
            self._file = open(self.path, "rb")  # noqa: SIM115
        if self._read(len(BYTE_ORDER_MARK)) != BYTE_ORDER_MARK:
            self._file.seek(0)

    def line(self) -> Line | None:
        """The next line, blank or not; None at the end."""
        content = self._rest_of_line()
        if not content:
            return None
        self.last_line += 1
        return _decoded(self.path, self.last_line, content)

    def row(self, *, comments: bool = False) -> Line | None:
        """The next line that is not blank, nor with ``comments`` one of these; None at the end."""
        while (line := self.line()) is not None:
            if line.text and not (comments and line.text.startswith("#")):
                return line
        return None

    def block(self, max_rows: int) -> Block | None:
        """The next lines, of which at most ``max_rows`` are not blank; None at the end."""
        begin = self._file.tell()
        content = self._read(self._block_bytes)
        if not content:
            return None
        if not content.endswith(b"\n"):
            content += self._rest_of_line()
        if not content.endswith(b"\n"):
            content += b"\n"
        if content.count(b"\n") > max_rows:
            content = content[: _end_of_rows(content, max_rows)]
            self._file.seek(begin + len(content))
        block = Block(self.path, self.last_line + 1, content)
        self.last_line += content.count(b"\n")
        return block

    def blocks(self, num_rows: int, what: str) -> Iterator[Block]:
        """Blocks of ``num_rows`` lines that are not blank; DataError where the file ends before."""
        left = num_rows
        while left:
            block = self.block(left)
            if block is None:
                raise self.ended(num_rows - left, num_rows, what)
            yield block
            left -= block.num_rows()

    def ended(self, found: int, expected: int, what: str) -> DataError:
        """The error where the file ends too early."""
        message = f"the file ends after {found} of {expected} {what}"
        return DataError(message, path=self.path, line=self.last_line)

    def __exit__(self, *raised: object) -> None:
        self._file.close()

    def _read(self, size: int) -> bytes:
        with reading(self.path):
            return self._file.read(size)

    def _rest_of_line(self) -> bytes:
        with reading(self.path):
            content = self._file.readline(_MAX_LINE_BYTES)
        if len(content) == _MAX_LINE_BYTES:
            message = f"a line of more than {_MAX_LINE_BYTES} bytes"
            raise DataError(message, path=self.path, line=self.last_line + 1)
        return content


def _decoded(path: Path, number: int, content: bytes) -> Line:
    text = content.decode("utf-8", errors="surrogateescape").rstrip("\n")
    return Line(path, number, text.strip(_BLANKS))


def _end_of_rows(content: bytes, count: int) -> int:
    """Offset behind the first ``count`` lines that are not blank."""
    end = 0
    for line in content.split(b"\n")[:-1]:
        end += len(line) + 1
        count -= bool(line.strip())
        if not count:
            break
    return end


def _joined(row: NDArray[np.float64]) -> str:
    return " ".join(f"{value:g}" for value in row)
