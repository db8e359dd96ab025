"""The fields of a line of a text model: bytes between blanks to names and numbers, strictly."""

from __future__ import annotations

import math
import re
from pathlib import Path

from megloc_kapture.datasets.grammars.model_lines import Line
from megloc_kapture.errors import DataError
from megloc_kapture.io.paths import check_relative

# float() and int() take more ("1_0", "nan", digits of other scripts) than the grammars
_NUMBER = re.compile(rb"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_COUNT = re.compile(rb"[0-9]{1,18}")
_SHOWN = 40
MAX_FEATURE_ID = 2**31 - 1
# a float32 ends a little above; the compiled loops have the same limit
PIXEL_END = 2.0**127


class Fields:
    """Takes the fields of one line apart; every error names the file and the line."""

    def __init__(self, path: Path, line: Line) -> None:
        self.path = path
        self.line = line
        self.all = line.content.split()

    def error(self, message: str) -> DataError:
        """The error for this line."""
        return DataError(message, path=self.path, line=self.line.number)

    def expect(self, count: int, what: str) -> None:
        """Refuse a line of another number of fields; ``what`` lists them."""
        if len(self.all) != count:
            raise self.error(f"expected {count} fields ({what}), got {len(self.all)}")

    def number(self, index: int, what: str) -> float:
        """A finite decimal number."""
        text = self.all[index]
        value = float(text) if _NUMBER.fullmatch(text) else math.nan
        if not math.isfinite(value):
            raise self.error(f"{what} {_shown(text)} is not a finite number")
        return value

    def numbers(self, start: int, stop: int, what: str) -> list[float]:
        """Finite decimal numbers, of the fields from ``start`` to before ``stop``."""
        return [self.number(index, what) for index in range(start, stop)]

    def pixel(self, index: int) -> float:
        """A coordinate in an image, which a float32 can hold."""
        value = self.number(index, "image coordinate")
        if abs(value) >= PIXEL_END:
            raise self.error(f"image coordinate {_shown(self.all[index])} is out of range")
        return value

    def count(self, index: int, what: str, limit: int = 1 << 62) -> int:
        """An integer from 0 to below ``limit``."""
        text = self.all[index]
        if not _COUNT.fullmatch(text):
            raise self.error(f"{what} {_shown(text)} is not a whole number of at least 0")
        value = int(text)
        if value >= limit:
            raise self.error(f"{what} {value} is out of range, there are {limit}")
        return value

    def image_name(self, text: bytes) -> str:
        """See :func:`image_name`."""
        try:
            return image_name(text)
        except DataError as error:
            raise self.error(error.message) from None

    def colour(self, index: int) -> list[int]:
        """R G B, from 0 to 255."""
        values = [self.number(k, "colour") for k in range(index, index + 3)]
        if not all(value.is_integer() and 0 <= value <= 255 for value in values):
            raise self.error("a colour is not made of whole numbers from 0 to 255")
        return [int(value) for value in values]


def image_name(text: bytes) -> str:
    """The name of an image, a plain path below the images' folder; without ``./`` before it.

    Raises
    ------
    DataError : not UTF-8, or a path that is not plain; does not name the place.
    """
    try:
        return check_relative(text.decode("utf-8").removeprefix("./"))
    except UnicodeDecodeError:
        raise DataError("the image's name is not UTF-8") from None
    except DataError as error:
        raise DataError(f"the image's name: {error.message}") from None


def _shown(text: bytes) -> str:
    shown = text.decode("utf-8", errors="replace")
    return repr(shown if len(shown) <= _SHOWN else shown[:_SHOWN] + "...")
