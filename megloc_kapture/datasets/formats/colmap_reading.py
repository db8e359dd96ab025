"""Readers of COLMAP's sparse models; here those of text: ``cameras.txt``, ...

Of a folder the cameras, images and points3D files are read; rigs and frames, which COLMAP writes
since version 4, say nothing of poses that the images' do not (see colmap_rigs). In ``images.txt``
an image has two lines, of which the second, its features, may be empty: it is taken by its
position.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.colmap_binary import (
    add_binary_images,
    read_binary_cameras,
    read_binary_points,
)
from megloc_kapture.datasets.formats.colmap_model import (
    BINARY_FILES,
    MAX_IMAGE_ID,
    MAX_SIZE,
    TEXT_FILES,
    ColmapImage,
    ColmapModel,
    ImageTable,
    camera_of,
)
from megloc_kapture.datasets.formats.sparse_points import (
    MAX_FEATURE_ID,
    PIXEL_END,
    Tracks,
    are_counts,
    check_pixel,
    read_tracks,
)
from megloc_kapture.datasets.formats.text_lines import (
    Block,
    Line,
    NumberRows,
    TextFile,
    read_lines,
)
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture.sensors import unit_quaternion
from megloc_kapture.values import Camera, RigidTransform

_ID_END = 2**32 - 1
_ALL_ROWS = 1 << 62
_HEAD = 8  # numbers of a point's line before its track


def colmap_model_files(folder: Path, *, with_points: bool = True) -> tuple[Path, ...]:
    """The files of a folder that hold its model: the binary ones where there are any.

    Parameters
    ----------
    with_points : False leaves the points' file out.

    Raises
    ------
    DataError : the folder holds no model.
    """
    names = BINARY_FILES if is_binary(folder) else TEXT_FILES
    return tuple(Path(folder) / name for name in (names if with_points else names[:2]))


def read_colmap_model(folder: Path, *, with_points: bool = True) -> ColmapModel:
    """Read the model of a folder; the binary files count where there are both.

    Parameters
    ----------
    with_points : False reads cameras and poses only; the points' file need not exist.

    Raises
    ------
    DataError : no model, or a broken one; names the file and the line or byte.
    """
    binary = is_binary(folder)
    cameras_file, images_file, points_file = (
        Path(folder) / name for name in (BINARY_FILES if binary else TEXT_FILES)
    )
    cameras = read_binary_cameras(cameras_file) if binary else _text_cameras(cameras_file)
    tracks = None
    if with_points:
        tracks = read_binary_points(points_file) if binary else _text_points(points_file)
    images = ImageTable(cameras, tracks)
    (add_binary_images if binary else _add_text_images)(images_file, images)
    return images.model(points_file)


def is_binary(folder: Path) -> bool:
    """Whether the binary files of a folder count; raises DataError where it holds no model."""
    if (Path(folder) / BINARY_FILES[1]).exists():
        return True
    if (Path(folder) / TEXT_FILES[1]).exists():
        return False
    raise DataError(
        f"no COLMAP model: neither {BINARY_FILES[1]} nor {TEXT_FILES[1]} is here", path=folder
    )


# ------------------------------------------------------------------------------------ text


def _text_cameras(path: Path) -> dict[int, Camera]:
    cameras: dict[int, Camera] = {}
    for line in read_lines(path, comments=True):
        fields = line.fields
        if len(fields) < 5:
            raise line.error(
                f"expected a camera (CAMERA_ID MODEL WIDTH HEIGHT PARAMS), got {len(fields)} fields"
            )
        camera_id = line.count_of(fields[0], "camera id", _ID_END)
        if camera_id in cameras:
            raise line.error(f"camera {camera_id} is listed twice")
        width = line.count_of(fields[2], "width", MAX_SIZE + 1)
        height = line.count_of(fields[3], "height", MAX_SIZE + 1)
        params = line.numbers_of(fields[4:], "camera parameter")
        try:
            cameras[camera_id] = camera_of(fields[1], width, height, params)
        except DataError as error:
            raise line.error(error.message) from None
    return cameras


def _add_text_images(path: Path, images: ImageTable) -> None:
    with TextFile(path) as file:
        while (line := file.row(comments=True)) is not None:
            image = _parse_image(line)
            try:
                images.add(image)
                # the last one may be missing: then it is empty
                features = file.line() or Line(path, line.number, "")
                if images.tracks is not None:
                    xy_px = _parse_features(features)
                    line = features
                    images.add_features(image.image_id, xy_px)
            except DataError as error:
                if error.path is not None:
                    raise
                raise line.error(error.message) from None


def _parse_image(line: Line) -> ColmapImage:
    fields = line.fields
    if len(fields) < 10:
        raise line.error(
            "expected an image (IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME), "
            f"got {len(fields)} fields"
        )
    w, x, y, z, tx, ty, tz = line.numbers_of(fields[1:8], "pose")
    try:
        pose = RigidTransform(unit_quaternion((w, x, y, z)), (tx, ty, tz))
    except DataError as error:
        raise line.error(error.message) from None
    return ColmapImage(
        line.count_of(fields[0], "image id", MAX_IMAGE_ID + 1),
        # a name may have blanks in it
        line.name_of(line.rest(9)),
        line.count_of(fields[8], "camera id", _ID_END),
        pose,
    )


def _parse_features(line: Line) -> NDArray[np.float64]:
    """Positions of the features of an image, (M, 2)."""
    content = line.text.encode(errors="surrogateescape") + b"\n"
    rows = Block(line.path, line.number, content).numbers()
    if rows is not None and (rows.lengths % 3 == 0).all():
        features = rows.tails(0).reshape(-1, 3)
        if (np.abs(features[:, :2]) < PIXEL_END).all() and are_counts(features[:, 2] + 1, 2**62):
            return features[:, :2]
    fields = line.fields
    if len(fields) % 3:
        raise line.error(
            "expected features (X Y POINT3D_ID, repeated) or a blank line, "
            f"got {len(fields)} fields"
        )
    for start in range(0, len(fields), 3):
        check_pixel(line, fields[start : start + 2])
        if fields[start + 2] != "-1":
            line.count_of(fields[start + 2], "point id")
    raise line.error("not made of features")


def _text_points(path: Path) -> Tracks:
    with TextFile(path) as file:
        return read_tracks(_blocks(file), _parse_points, _check_point)


def _blocks(file: TextFile) -> Iterator[Block]:
    while (block := file.block(_ALL_ROWS)) is not None:
        yield block.without_comments()


def _parse_points(rows: NumberRows) -> Tracks | None:
    """The points of rows of numbers; None where one is no point."""
    if (rows.lengths < _HEAD).any() or (rows.lengths % 2).any():
        return None
    heads, track = rows.heads(_HEAD), rows.tails(_HEAD).reshape(-1, 2)
    good = (
        are_counts(heads[:, 0], 2**62)
        and are_counts(heads[:, 4:7], 256)
        and are_counts(track[:, 0], MAX_IMAGE_ID + 1)
        and are_counts(track[:, 1], MAX_FEATURE_ID + 1)
    )
    return Tracks.of_rows(heads[:, 1:7], (rows.lengths - _HEAD) // 2, track) if good else None


def _check_point(line: Line) -> None:
    fields = line.fields
    if len(fields) < _HEAD or len(fields) % 2:
        raise line.error(
            "expected a point (POINT3D_ID X Y Z R G B ERROR and pairs of IMAGE_ID POINT2D_IDX), "
            f"got {len(fields)} fields"
        )
    line.count_of(fields[0], "point id")
    line.numbers_of(fields[1:4], "coordinate")
    line.colour_of(fields[4:7])
    line.number_of(fields[7], "reprojection error")
    for start in range(_HEAD, len(fields), 2):
        line.count_of(fields[start], "image id", MAX_IMAGE_ID + 1)
        line.count_of(fields[start + 1], "feature index", MAX_FEATURE_ID + 1)
