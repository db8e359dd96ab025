"""The points of a structure-from-motion model, whatever file they came from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.text_lines import Block, Line, NumberRows, shown
from megloc_kapture.errors import DataError

MAX_FEATURE_ID = 2**31 - 1
# a float32 ends a little above
PIXEL_END = 2.0**127


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """Points of a model and where images see them.

    Parameters
    ----------
    xyz : float64 (P, 3) in the model's world.
    rgb : uint8 (P, 3).
    point_ids : int64 (O,), rows of ``xyz``; ascending in what the readers here return.
    image_ids : int32 (O,), positions in the model's list of images.
    feature_ids : int32 (O,), index of the feature in its image. Not dense: a model names only
        those of an image's features that see a point. One image may see a point twice.
    xy_px : float32 (O, 2), where in the image; the first pixel's centre is (0.5, 0.5).

    Raises
    ------
    ValueError : arrays of other shapes.
    """

    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    point_ids: NDArray[np.int64]
    image_ids: NDArray[np.int32]
    feature_ids: NDArray[np.int32]
    xy_px: NDArray[np.float32]

    def __post_init__(self) -> None:
        points, observations = len(self.xyz), len(self.point_ids)
        expected = {
            "xyz": (points, 3),
            "rgb": (points, 3),
            "point_ids": (observations,),
            "image_ids": (observations,),
            "feature_ids": (observations,),
            "xy_px": (observations, 2),
        }
        for name, shape in expected.items():
            found = getattr(self, name).shape
            if found != shape:
                raise ValueError(f"{name} has shape {found}, expected {shape}")

    def __len__(self) -> int:
        return len(self.xyz)

    @classmethod
    def none(cls) -> SparsePoints:
        """No points."""
        return cls.of_rows(np.empty((0, 6)), np.empty(0), np.empty((0, 2)))

    @classmethod
    def of_rows(
        cls, heads: NDArray[Any], lengths: NDArray[Any], observations: NDArray[Any]
    ) -> SparsePoints:
        """Points from the numbers of a file, in its order.

        Parameters
        ----------
        heads : (P, 6): X Y Z R G B.
        lengths : (P,), the number of observations of each.
        observations : (O, 2) or (O, 4): image, feature and, where the file says it, x y; else
            these are zeros.
        """
        xy_px = np.zeros((len(observations), 2), np.float32)
        if observations.shape[1] == 4:
            xy_px[:] = observations[:, 2:]
        return cls(
            heads[:, :3].copy(),
            heads[:, 3:].astype(np.uint8),
            np.repeat(np.arange(len(heads), dtype=np.int64), lengths.astype(np.int64)),
            observations[:, 0].astype(np.int32),
            observations[:, 1].astype(np.int32),
            xy_px,
        )

    @classmethod
    def joined(cls, parts: Sequence[SparsePoints]) -> SparsePoints:
        """The points of several models of one list of images, behind one another.

        An image that is in several models must have its features numbered the same in all.
        """
        firsts = np.cumsum([0, *(len(part) for part in parts)])
        moved = [
            replace(part, point_ids=part.point_ids + first)
            for part, first in zip(parts, firsts[:-1], strict=True)
        ] or [cls.none()]
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(part, n) for part in moved]) for n in names))

    def check_images(self, num_images: int) -> None:
        """Raise ValueError where ``image_ids`` do not count in a list of that many images."""
        ids = self.image_ids
        if len(ids) and (ids.min() < 0 or ids.max() >= num_images):
            raise ValueError(f"image_ids are out of range, there are {num_images} images")

    def sorted_by_point(self) -> SparsePoints:
        """The same with ``point_ids`` ascending, in the order they have among equals.

        Raises
        ------
        ValueError : observations of a point that there is not.
        """
        ids = self.point_ids
        if len(ids) and (ids.min() < 0 or ids.max() >= len(self.xyz)):
            raise ValueError("point_ids are out of range")
        if not (ids[1:] < ids[:-1]).any():
            return self
        order = np.argsort(ids, kind="stable")
        return replace(
            self,
            point_ids=ids[order],
            image_ids=self.image_ids[order],
            feature_ids=self.feature_ids[order],
            xy_px=self.xy_px[order],
        )


def read_points(
    blocks: Iterable[Block],
    parse: Callable[[NumberRows], SparsePoints | None],
    check: Callable[[Line], None],
) -> SparsePoints:
    """Read points of which each is a row of numbers.

    Parameters
    ----------
    parse : the points of many rows; None where one of them is no point.
    check : raises DataError where a line is no point.

    Raises
    ------
    DataError : a line is no point; names file and line.
    """
    parts = []
    for block in blocks:
        rows = block.numbers()
        found = None if rows is None else parse(rows)
        if found is None:
            for line in block.rows():
                check(line)
            raise DataError("not made of points", path=block.path, line=block.first_line)
        parts.append(found)
    return SparsePoints.joined(parts)


def are_counts(values: NDArray[np.float64], end: float) -> bool:
    """True where all are whole numbers from 0 to below ``end``."""
    return bool(((values >= 0) & (values < end) & (values == np.floor(values))).all())


def check_pixel(line: Line, texts: Sequence[str]) -> None:
    """Raise DataError where texts are no coordinates in an image, which a float32 can hold."""
    for text in texts:
        if abs(line.number_of(text, "image coordinate")) >= PIXEL_END:
            raise line.error(f"image coordinate {shown(text)} is out of range")


def image_order(image_ids: NDArray[np.int32]) -> NDArray[np.int64]:
    """Rows of observations sorted by image, in their own order within one; (O,).

    numpy sorts 16 bits by counting, which for many observations is ten times as fast as sorting
    whole numbers: twice 16 bits, lowest first, is the same order.
    """
    ids = np.asarray(image_ids, dtype=np.int64)
    order = np.argsort((ids & 0xFFFF).astype(np.uint16), kind="stable")
    if len(ids) and int(ids.max()) > 0xFFFF:
        order = order[np.argsort((ids[order] >> 16).astype(np.uint16), kind="stable")]
    return order
