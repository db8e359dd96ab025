"""Lines and numbers of small text files, with errors that name file and line."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.files import named, read_text
from megloc_kapture.values import RigidTransform

# of R^T R - I; published matrices have six decimals
MAX_ROTATION_ERROR = 1e-3


@contextlib.contextmanager
def reading_lines(path: Path, *, comments: bool = False) -> Iterator[Iterator[str]]:
    """Yield an iterator of the stripped lines that are not blank; ``comments`` drops # lines.

    Errors of the block get file and line; a ValueError, as of ``float``, becomes a DataError.
    """
    texts = read_text(path).split("\n")
    number: int | None = None

    def lines() -> Iterator[str]:
        nonlocal number
        for number, text in enumerate(texts, start=1):  # noqa: B007  of the message below
            if text.strip() and not (comments and text.strip().startswith("#")):
                yield text.strip()
        number = None

    try:
        yield lines()
    except (DataError, ValueError) as error:
        with named(path, number):
            raise error if isinstance(error, DataError) else DataError(str(error)) from error


def fields_of(text: str) -> list[str]:
    """Split a line at commas and blanks."""
    return text.replace(",", " ").split()


def numbers_of(fields: Sequence[str], form: str) -> list[float]:
    """Parse finite numbers, as many as the blank-separated names in ``form``."""
    try:
        values = list(map(float, fields))
    except ValueError:
        values = []
    require(
        len(values) == len(form.split()) and all(map(math.isfinite, values)),
        f"expected finite numbers {form}, got {' '.join(fields)!r}",
    )
    return values


def transform_of(elements: Sequence[str]) -> RigidTransform:
    """Parse the 16 elements of a 4x4 matrix, row by row."""
    require(len(elements) == 16, f"expected the 16 elements of a matrix, got {len(elements)}")
    matrix = np.array(list(map(float, elements))).reshape(4, 4)
    rotation = matrix[:3, :3]
    require(
        np.isfinite(matrix).all()
        and np.allclose(rotation.T @ rotation, np.eye(3), rtol=0, atol=MAX_ROTATION_ERROR)
        and np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), rtol=0, atol=MAX_ROTATION_ERROR)
        and np.linalg.det(rotation) > 0,
        "not a rotation and a translation, with the last row 0 0 0 1",
    )
    return RigidTransform.from_matrix(rotation, matrix[:3, 3])


def read_transform(path: Path, *, comments: bool = False) -> RigidTransform:
    """Read a 4x4 matrix of comma- or blank-separated numbers."""
    with reading_lines(path, comments=comments) as lines:
        return transform_of([field for line in lines for field in fields_of(line)])
