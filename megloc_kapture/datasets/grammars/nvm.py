"""NVM files (``NVM_V3``), VisualSFM's models, as COLMAP exports and the challenges publish them.

The translation column of a camera is its centre, and the distortion has the other sign than
COLMAP's. Pixels are taken as they are: COLMAP's exporter writes them as COLMAP has them. Sizes of
images and principal points are not in the file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.grammars.fields import MAX_FEATURE_ID, Fields
from megloc_kapture.datasets.grammars.model_lines import LARGE_BYTES, Line, ModelLines, is_large
from megloc_kapture.datasets.grammars.sparse_points import SparsePoints
from megloc_kapture.datasets.grammars.track_rows import Row, RowFormat, read_tracks
from megloc_kapture.errors import DataError
from megloc_kapture.io.atomic import atomic_write
from megloc_kapture.io.kapture_sensors import unit_quaternion
from megloc_kapture.values import RigidTransform

HEADER = b"NVM_V3"
FIXED_CALIBRATION = b"FixedK"
_CAMERA_FIELDS = "name, focal length, quaternion, centre, distortion, 0"
_POINTS_AT_ONCE = 1 << 14


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


def read_nvm(
    path: Path, *, with_points: bool = True, large_bytes: int = LARGE_BYTES
) -> list[NvmModel]:
    """Read the models of an NVM file, in its order; there is at least one.

    A model without points after another one lists the images that were not registered; it is
    checked and left out. What follows the 0 after the last model is not looked at.

    Parameters
    ----------
    with_points : False passes over the points, unchecked but for their number.
    large_bytes : files from this size on are read by compiled loops.

    Raises
    ------
    DataError : the file is missing, broken, truncated or holds no model; names file and line.
    """
    lines = ModelLines(path)
    compiled = is_large(lines.path, large_bytes)
    _read_header(lines)
    models: list[NvmModel] = []
    while (row := lines.row()) is not None:
        fields = Fields(lines.path, row)
        fields.expect(1, "the number of cameras of the next model, or 0 at the end")
        num_cameras = fields.count(0, "the number of cameras")
        if num_cameras == 0:
            break
        cameras = _read_cameras(lines, num_cameras)
        num_points = _read_number_of_points(lines)
        if with_points:
            points = _read_points(lines, num_points, num_cameras, compiled=compiled)
        else:
            points = SparsePoints.none()
            _skip_points(lines, num_points, compiled=compiled)
        if num_points or not models:
            models.append(cameras.model(lines.path, points))
    if not models:
        raise DataError("holds no model", path=path)
    return models


def _read_header(lines: ModelLines) -> None:
    line = lines.line()
    words = line.content.split() if line is not None else []
    fields = Fields(lines.path, line) if line is not None else None
    if fields is None or words[:1] != [HEADER]:
        raise DataError(
            "no NVM file: the first line must begin with NVM_V3", path=lines.path, line=1
        )
    if words[1:]:
        fields.expect(6, "NVM_V3 FixedK fx cx fy cy")
        if words[1] != FIXED_CALIBRATION:
            raise fields.error("after NVM_V3 only FixedK fx cx fy cy may follow")
        fields.numbers(2, 6, "calibration")


@dataclass(frozen=True)
class _Cameras:
    """The rows of a model's cameras; whether they are poses shows in the number of points."""

    names: list[str]
    rows: list[list[float]]
    line_numbers: list[int]

    def model(self, path: Path, points: SparsePoints) -> NvmModel:
        for row, line in zip(self.rows, self.line_numbers, strict=True):
            try:
                row[1:5] = unit_quaternion((row[1], row[2], row[3], row[4]))
            except DataError as error:
                raise DataError(error.message, path=path, line=line) from None
        values = np.array(self.rows, dtype=np.float64)
        return NvmModel(
            tuple(self.names),
            values[:, 0].copy(),
            values[:, 1:5].copy(),
            values[:, 5:8].copy(),
            0.0 - values[:, 8],  # and no minus zero
            points,
        )


def _read_cameras(lines: ModelLines, count: int) -> _Cameras:
    cameras = _Cameras([], [], [])
    seen: dict[str, int] = {}
    while len(cameras.names) < count:
        line = lines.row()
        if line is None:
            raise _truncated(lines, count, "cameras", len(cameras.names))
        fields = Fields(lines.path, line)
        fields.expect(11, _CAMERA_FIELDS)
        name = fields.image_name(fields.all[0])
        if name in seen:
            raise fields.error(f"image {name!r} is listed twice, first in line {seen[name]}")
        seen[name] = line.number
        cameras.names.append(name)
        cameras.rows.append(fields.numbers(1, 11, "camera parameter"))
        cameras.line_numbers.append(line.number)
    return cameras


def _read_number_of_points(lines: ModelLines) -> int:
    line = lines.row()
    if line is None:
        raise DataError(
            "the file ends where the number of points was expected",
            path=lines.path,
            line=lines.last_line,
        )
    fields = Fields(lines.path, line)
    fields.expect(1, "the number of points")
    return fields.count(0, "the number of points")


def _read_points(lines: ModelLines, count: int, num_images: int, *, compiled: bool) -> SparsePoints:
    def parse(line: Line) -> Row:
        return _parse_point(Fields(lines.path, line), num_images)

    row_format = RowFormat(
        parse,
        "parse_nvm_points",
        num_images,
        row_bytes=14,
        observation_bytes=8,
        with_xy=True,
    )
    found = read_tracks(lines, count, row_format, compiled=compiled)
    if len(found.lengths) < count:
        raise _truncated(lines, count, "points", len(found.lengths))
    return SparsePoints(
        found.xyz,
        found.rgb,
        found.point_ids(),
        found.image_ids,
        found.feature_ids,
        found.xy_px,
    )


def _parse_point(fields: Fields, num_images: int) -> Row:
    if len(fields.all) < 7:
        raise fields.error(
            "expected a point (X Y Z R G B, number of measurements, measurements), "
            f"got {len(fields.all)} fields"
        )
    length = fields.count(6, "the number of measurements")
    if len(fields.all) != 7 + 4 * length:
        raise fields.error(
            f"expected {7 + 4 * length} fields for {length} measurements, got {len(fields.all)}"
        )
    starts = range(7, 7 + 4 * length, 4)
    return Row(
        fields.numbers(0, 3, "coordinate"),
        fields.colour(3),
        [
            (
                fields.count(k, "image index", num_images),
                fields.count(k + 1, "feature index", MAX_FEATURE_ID + 1),
            )
            for k in starts
        ],
        [(fields.pixel(k + 2), fields.pixel(k + 3)) for k in starts],
    )


def _skip_points(lines: ModelLines, count: int, *, compiled: bool) -> None:
    left = count
    while left:
        if compiled:
            from megloc_kapture.datasets.grammars import track_kernels as kernels

            chunk = lines.chunk()
            if chunk is not None:
                position, passed = kernels.skip_rows(chunk.text, chunk.begin, chunk.end, left)
                lines.advance(int(position))
                left -= int(passed)
                continue
        elif lines.row() is not None:
            left -= 1
            continue
        raise _truncated(lines, count, "points", count - left)


def _truncated(lines: ModelLines, expected: int, what: str, found: int) -> DataError:
    return DataError(
        f"the file ends after {found} of {expected} {what}", path=lines.path, line=lines.last_line
    )


def write_nvm(path: Path, model: NvmModel) -> None:
    """Write one model as COLMAP's exporter does: k with NVM's sign, pixels as they are.

    Numbers are the shortest texts that read back the same.

    Raises
    ------
    ValueError : a name with blanks in it, or observations of no image or point.
    OutputError : cannot be written.
    """
    for name in model.names:
        if not name or name.split() != [name]:
            raise ValueError(f"image name {name!r} has blanks and cannot stand in an NVM file")
    points = model.points.sorted_by_point()
    points.check_images(len(model.names))
    cameras = np.column_stack(
        [model.focal_px, model.quat_wxyz, model.centers, 0.0 - model.k_colmap]
    )
    with atomic_write(path) as file:
        file.write(f"NVM_V3 \n \n{len(model.names)}  \n".encode())
        for name, row in zip(model.names, cameras.tolist(), strict=True):
            file.write(f"{name} {' '.join(map(repr, row))} 0\n".encode())
        file.write(f"\n{len(points)}\n".encode())
        for start in range(0, len(points), _POINTS_AT_ONCE):
            file.write(_point_lines(points, start, start + _POINTS_AT_ONCE).encode())


def _point_lines(points: SparsePoints, start: int, stop: int) -> str:
    xyz, rgb = points.xyz[start:stop].tolist(), points.rgb[start:stop].tolist()
    ends = np.searchsorted(points.point_ids, np.arange(start, start + len(xyz) + 1))
    rows = slice(int(ends[0]), int(ends[-1]))
    measurements = [
        f" {image} {feature} {x} {y}"
        for image, feature, (x, y) in zip(
            points.image_ids[rows].tolist(),
            points.feature_ids[rows].tolist(),
            points.xy_px[rows].astype(str).tolist(),
            strict=True,
        )
    ]
    lines = []
    offsets = (ends - ends[0]).tolist()
    for place, colour, begin, end in zip(xyz, rgb, offsets[:-1], offsets[1:], strict=True):
        x, y, z = place
        r, g, b = colour
        lines.append(
            f"{x!r} {y!r} {z!r} {r} {g} {b} {end - begin}{''.join(measurements[begin:end])}\n"
        )
    return "".join(lines)
