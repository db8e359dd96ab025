"""The points of structure-from-motion models, whatever file they came from, and NVM files.

NVM (``NVM_V3``) is VisualSFM's format of models, as COLMAP exports and the challenges publish them.
The translation column of a camera is its centre, and the distortion has the other sign than
COLMAP's. Pixels are taken as they are: COLMAP's exporter writes them as COLMAP has them. Sizes of
images and principal points are not in the file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.text_lines import Block, Line, NumberRows, TextFile, shown
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture.sensors import unit_quaternion
from megloc_kapture.values import RigidTransform

MAX_FEATURE_ID = 2**31 - 1
# a float32 ends a little above
PIXEL_END = 2.0**127
HEADER = "NVM_V3"
FIXED_CALIBRATION = "FixedK"
_CAMERA_FIELDS = "name, focal length, quaternion, centre, distortion, 0"
_HEAD = 7  # fields of a point before its measurements


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


# --------------------------------------------------------------------------------------- NVM


@dataclass(frozen=True, eq=False)
class NvmModel:
    """One reconstructed model of an NVM file.

    Parameters
    ----------
    names : of the images, C of them, as in the file but without ``./`` before them.
    focal_px : float64 (C,).
    quat_wxyz : float64 (C, 4), unit length: rotation from world to camera.
    centers : float64 (C, 3), the cameras' centres in the world.
    k_colmap : float64 (C,), radial distortion with COLMAP's sign (SIMPLE_RADIAL).
    points : ``image_ids`` count in ``names``.
    """

    names: tuple[str, ...]
    focal_px: NDArray[np.float64]
    quat_wxyz: NDArray[np.float64]
    centers: NDArray[np.float64]
    k_colmap: NDArray[np.float64]
    points: SparsePoints

    def cam_from_world(self, index: int) -> RigidTransform:
        """Pose of the image at a position in ``names``."""
        w, x, y, z = self.quat_wxyz[index].tolist()
        rotation = RigidTransform((w, x, y, z), (0.0, 0.0, 0.0)).rotation_matrix()
        tx, ty, tz = (-rotation @ self.centers[index]).tolist()
        return RigidTransform((w, x, y, z), (tx, ty, tz))


def read_nvm(path: Path, *, with_points: bool = True) -> list[NvmModel]:
    """Read the models of an NVM file, in its order; there is at least one.

    A model without points after another one lists the images that were not registered; it is
    checked and left out. What follows the 0 after the last model is not looked at.

    Parameters
    ----------
    with_points : False passes over the points, unchecked but for their number.

    Raises
    ------
    DataError : the file is missing, broken, truncated or holds no model; names file and line.
    """
    models: list[NvmModel] = []
    with TextFile(path) as file:
        _check_header(file)
        while (line := file.row()) is not None:
            num_cameras = _single_count(
                line, "the number of cameras", " of the next model, or 0 at the end"
            )
            if num_cameras == 0:
                break
            names, rows = _read_cameras(file, num_cameras)
            line = file.row()
            if line is None:
                raise DataError(
                    "the file ends where the number of points was expected",
                    path=path,
                    line=file.last_line,
                )
            num_points = _single_count(line, "the number of points")
            points = _read_points(file, num_points, num_cameras, with_points=with_points)
            if num_points or not models:
                models.append(_model(names, rows, points))
    if not models:
        raise DataError("holds no model", path=path)
    return models


def read_single_nvm(path: Path, *, with_points: bool = True) -> NvmModel:
    """Read an NVM file of one model; raises DataError for others, see :func:`read_nvm`."""
    models = read_nvm(path, with_points=with_points)
    if len(models) != 1:
        raise DataError(f"{len(models)} models, expected one", path=path)
    return models[0]


def _check_header(file: TextFile) -> None:
    line = file.line()
    if line is None or line.fields[:1] != [HEADER]:
        raise DataError(
            "no NVM file: the first line must begin with NVM_V3", path=file.path, line=1
        )
    if line.fields[1:]:
        line.expect(line.fields, 6, "NVM_V3 FixedK fx cx fy cy")
        if line.fields[1] != FIXED_CALIBRATION:
            raise line.error("after NVM_V3 only FixedK fx cx fy cy may follow")
        line.numbers_of(line.fields[2:], "calibration")


def _single_count(line: Line, what: str, more: str = "") -> int:
    line.expect(line.fields, 1, what + more)
    return line.count_of(line.fields[0], what)


def _read_cameras(file: TextFile, count: int) -> tuple[list[str], list[tuple[Line, list[float]]]]:
    """Names, and the numbers behind them; whether these are poses shows in the number of points."""
    lines: dict[str, int] = {}
    rows: list[tuple[Line, list[float]]] = []
    while len(rows) < count:
        line = file.row()
        if line is None:
            raise file.ended(len(rows), count, "cameras")
        line.expect(line.fields, 11, _CAMERA_FIELDS)
        name = line.name_of(line.fields[0])
        if name in lines:
            raise line.error(f"image {name!r} is listed twice, first in line {lines[name]}")
        lines[name] = line.number
        rows.append((line, line.numbers_of(line.fields[1:], "camera parameter")))
    return list(lines), rows


def _model(
    names: list[str], rows: list[tuple[Line, list[float]]], points: SparsePoints
) -> NvmModel:
    for line, row in rows:
        with line.named():
            row[1:5] = unit_quaternion((row[1], row[2], row[3], row[4]))
    values = np.array([row for _, row in rows])
    return NvmModel(
        tuple(names),
        values[:, 0].copy(),
        values[:, 1:5].copy(),
        values[:, 5:8].copy(),
        0.0 - values[:, 8],  # and no minus zero
        points,
    )


def _read_points(file: TextFile, count: int, num_images: int, *, with_points: bool) -> SparsePoints:
    blocks = file.blocks(count, "points")
    if with_points:
        parse = partial(_parse_points, num_images=num_images)
        return read_points(blocks, parse, partial(_check_point, num_images=num_images))
    for _ in blocks:
        pass
    return SparsePoints.none()


def _parse_points(rows: NumberRows, num_images: int) -> SparsePoints | None:
    """The points of rows of numbers; None where one is no point."""
    if (rows.lengths < _HEAD).any():
        return None
    heads = rows.heads(_HEAD)
    lengths = heads[:, 6]
    if (rows.lengths != _HEAD + 4 * lengths).any() or not are_counts(heads[:, 3:6], 256):
        return None
    observations = rows.tails(_HEAD).reshape(-1, 4)
    good = (
        are_counts(observations[:, 0], num_images)
        and are_counts(observations[:, 1], MAX_FEATURE_ID + 1)
        and (np.abs(observations[:, 2:]) < PIXEL_END).all()
    )
    return SparsePoints.of_rows(heads[:, :6], lengths, observations) if good else None


def _check_point(line: Line, num_images: int) -> None:
    fields = line.fields
    if len(fields) < _HEAD:
        raise line.error(
            "expected a point (X Y Z R G B, number of measurements, measurements), "
            f"got {len(fields)} fields"
        )
    length = line.count_of(fields[6], "the number of measurements")
    if len(fields) != _HEAD + 4 * length:
        raise line.error(
            f"expected {_HEAD + 4 * length} fields for {length} measurements, got {len(fields)}"
        )
    line.numbers_of(fields[:3], "coordinate")
    line.colour_of(fields[3:6])
    for start in range(_HEAD, len(fields), 4):
        line.count_of(fields[start], "image index", num_images)
        line.count_of(fields[start + 1], "feature index", MAX_FEATURE_ID + 1)
        check_pixel(line, fields[start + 2 : start + 4])
