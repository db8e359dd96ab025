"""Lines and fields of small text files, with errors that name file and line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.files import named, read_text
from megloc_kapture.values import RigidTransform

# of R^T R - I; published matrices have six decimals
MAX_ROTATION_ERROR = 1e-3

_SHOWN = 40


@dataclass(frozen=True)
class Line:
    path: Path
    number: int
    text: str

    @cached_property
    def fields(self) -> list[str]:
        return self.text.split()

    @cached_property
    def comma_fields(self) -> list[str]:
        """Return comma-separated fields; blank-separated fields in lines without commas."""
        if "," not in self.text:
            return self.fields
        return [field.strip() for field in self.text.removesuffix(",").split(",")]

    def error(self, message: str) -> DataError:
        return DataError(message, path=self.path, line=self.number)

    def require(self, condition: object, message: str) -> None:
        """Raise DataError with file and line unless the condition is true."""
        require(condition, message, path=self.path, line=self.number)

    def named(self) -> AbstractContextManager[None]:
        """Add this line to DataErrors that name no file."""
        return named(self.path, self.number)

    def expect(self, fields: Sequence[str], counts: int | Iterable[int], form: str) -> None:
        """Raise DataError for another number of fields; ``form`` lists their names."""
        expected = (counts,) if isinstance(counts, int) else tuple(counts)
        self.require(
            len(fields) in expected,
            f"expected {' or '.join(map(str, expected))} fields ({form}), got {len(fields)}",
        )

    def number_of(self, text: str, what: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        self.require(math.isfinite(value), f"{what} {shown(text)} is not a finite number")
        return value

    def numbers_of(self, texts: Iterable[str], what: str) -> list[float]:
        return [self.number_of(text, what) for text in texts]

    def count_of(self, text: str, what: str) -> int:
        whole = re.fullmatch("[0-9]{1,18}", text)
        self.require(whole, f"{what} {shown(text)} is not a whole number of at least 0")
        return int(text)

    def rigid_transform(self, matrix: NDArray[np.float64]) -> RigidTransform:
        rotation, position = matrix[:3, :3], matrix[:3, 3]
        error = np.abs(rotation.T @ rotation - np.eye(3)).max()
        if not (error < MAX_ROTATION_ERROR and np.linalg.det(rotation) > 0):
            raise self.error("the upper left 3x3 of the matrix is not a rotation matrix")
        last_row_error = np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max()
        self.require(
            last_row_error < MAX_ROTATION_ERROR, "the last row of the matrix is not 0 0 0 1"
        )
        return RigidTransform.from_matrix(rotation, position)


def read_lines(path: Path, *, comments: bool = False) -> list[Line]:
    """Read stripped lines that are not blank; ``comments`` drops # lines."""
    texts = (text.strip() for text in read_text(path).split("\n"))
    return [
        Line(path, number, text)
        for number, text in enumerate(texts, start=1)
        if text and not (comments and text.startswith("#"))
    ]


def read_rigid_matrix(path: Path, *, comments: bool = False) -> RigidTransform:
    """Read a 4x4 matrix of comma- or blank-separated numbers as a transform."""
    lines = read_lines(path, comments=comments)
    if [len(line.comma_fields) for line in lines] != [4] * 4:
        raise DataError("expected four lines of four numbers", path=path)
    rows = [line.numbers_of(line.comma_fields, "matrix element") for line in lines]
    return lines[-1].rigid_transform(np.array(rows))


def shown(text: str) -> str:
    return repr(text if len(text) <= _SHOWN else text[:_SHOWN] + "...")
