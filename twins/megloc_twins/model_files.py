"""Writers of the official layouts' files: COLMAP and NVM models, camera lists and InLoc's
transformations. Numbers are written with the fewest digits that preserve their value."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.nvm import NvmModel
from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap_model import (
    BINARY_FILES,
    TEXT_FILES,
    ColmapImage,
    ColmapModel,
    SparsePoints,
)
from megloc_kapture.io.files import check_relative, write_bytes
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, RigidTransform
from megloc_twins.options import write_lines

# record of a feature in images.bin
BINARY_FEATURE = np.dtype([("xy", "<f8", (2,)), ("point", "<i8")])
_NO_POINT = -1
_UNKNOWN_ERROR_PX = -1.0


def write_colmap_text(folder: Path, model: ColmapModel) -> None:
    """Write ``cameras.txt``, ``images.txt`` and ``points3D.txt``; points get the ids 1, 2, ...

    Raises OutputError if a file cannot be written.
    """
    cameras = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    for camera_id, camera in sorted(model.cameras.items()):
        params = " ".join(map(repr, camera.params))
        cameras.append(f"{camera_id} {camera.model} {camera.width} {camera.height} {params}")
    images = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# POINTS2D[] as X Y POINT3D_ID"]
    for image, xy_px, seen in _features(model):
        pose = " ".join(repr(float(value)) for value in _pose(image))
        rows = zip(xy_px.astype(str).tolist(), seen.tolist(), strict=True)
        features = " ".join(f"{x} {y} {point}" for (x, y), point in rows)
        images += [f"{image.image_id} {pose} {image.camera_id} {image.name}", features]
    points = ["# POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX"]
    elements = _elements(model)
    for number, (xyz, rgb, track) in enumerate(_tracks(model.points), start=1):
        numbers = (number, *xyz, *rgb, _UNKNOWN_ERROR_PX, *elements[track].ravel().tolist())
        points.append(" ".join(map(repr, numbers)))
    for name, lines in zip(TEXT_FILES, (cameras, images, points), strict=True):
        write_lines(folder / name, lines)


def write_colmap_binary(folder: Path, model: ColmapModel) -> None:
    """Write ``cameras.bin``, ``images.bin`` and ``points3D.bin``; points get the ids 1, 2, ...

    Raises OutputError if a file cannot be written.
    """
    cameras = [struct.pack("<Q", len(model.cameras))]
    for camera_id, camera in sorted(model.cameras.items()):
        model_id = list(CAMERA_MODEL_NUM_PARAMS).index(camera.model)
        cameras.append(struct.pack("<IiQQ", camera_id, model_id, camera.width, camera.height))
        cameras.append(struct.pack(f"<{len(camera.params)}d", *camera.params))
    images = [struct.pack("<Q", len(model.images))]
    for image, xy_px, seen in _features(model):
        images.append(struct.pack("<I7dI", image.image_id, *_pose(image), image.camera_id))
        images.append(image.name.encode() + b"\0" + struct.pack("<Q", len(seen)))
        features = np.empty(len(seen), BINARY_FEATURE)
        features["xy"], features["point"] = xy_px, seen
        images.append(features.tobytes())
    points, elements = [struct.pack("<Q", len(model.points))], _elements(model)
    for number, (xyz, rgb, track) in enumerate(_tracks(model.points), start=1):
        numbers = (number, *xyz, *rgb, _UNKNOWN_ERROR_PX, len(elements[track]))
        points.append(struct.pack("<Q3d3BdQ", *numbers) + elements[track].tobytes())
    for name, parts in zip(BINARY_FILES, (cameras, images, points), strict=True):
        write_bytes(folder / name, b"".join(parts))


def _pose(image: ColmapImage) -> tuple[float, ...]:
    return (*image.cam_from_world.quat_wxyz, *image.cam_from_world.translation)


def _features(
    model: ColmapModel,
) -> Iterator[tuple[ColmapImage, NDArray[np.float32], NDArray[np.int64]]]:
    """Yield each image with its features: positions (M, 2), and point ids or -1.

    Features without a point are at (0, 0); their rows are needed for the indices of the others.
    """
    points = model.points
    for position, image in enumerate(model.images):
        rows = points.image_ids == position
        ids = points.feature_ids[rows]
        size = int(ids.max(initial=-1)) + 1
        xy_px = np.zeros((size, 2), np.float32)
        seen = np.full(size, _NO_POINT, np.int64)
        xy_px[ids] = points.xy_px[rows]
        seen[ids] = points.point_ids[rows] + 1
        yield image, xy_px, seen


def _elements(model: ColmapModel) -> NDArray[np.int32]:
    """Return image id and feature of each observation, (O, 2)."""
    image_ids = np.array([image.image_id for image in model.images], "<i4")
    elements = [image_ids[model.points.image_ids], model.points.feature_ids]
    return np.stack(elements, axis=1).astype("<i4")


def _tracks(points: SparsePoints) -> Iterator[tuple[list[float], list[int], slice]]:
    """Yield position, colour and observation rows of each point."""
    ends = np.searchsorted(points.point_ids, np.arange(len(points) + 1)).tolist()
    tracks = map(slice, ends[:-1], ends[1:])
    return zip(points.xyz.tolist(), points.rgb.tolist(), tracks, strict=True)


def write_nvm(path: Path, model: NvmModel) -> None:
    """Write one model as COLMAP's exporter does: k with NVM's sign, pixels unchanged.

    Raises OutputError if the file cannot be written.
    """
    points = model.points
    cameras = np.column_stack(
        [model.focal_px, model.quat_wxyz, model.centers, 0.0 - model.k_colmap]
    )
    lines = ["NVM_V3 ", " ", f"{len(model.names)}  "]
    for name, row in zip(model.names, cameras.tolist(), strict=True):
        lines.append(f"{name} {' '.join(map(repr, row))} 0")
    lines += ["", str(len(points))]
    columns = points.image_ids.tolist(), points.feature_ids.tolist(), points.xy_px.astype(str)
    seen = [f" {image} {feature} {x} {y}" for image, feature, (x, y) in zip(*columns, strict=True)]
    for xyz, rgb, track in _tracks(points):
        numbers = " ".join(map(repr, (*xyz, *rgb, len(seen[track]))))
        lines.append(numbers + "".join(seen[track]))
    write_lines(path, lines)


def write_query_list(
    path: Path, cameras: Mapping[str, Camera], *, last_line_ends: bool = True
) -> None:
    """Write a camera list in the order of ``cameras``.

    Parameters
    ----------
    last_line_ends : False omits the last line break, as in published lists.

    Raises
    ------
    DataError : a name contains white space or is not a plain relative path.
    OutputError : the file cannot be written.
    """
    lines = []
    for name, camera in cameras.items():
        if check_relative(name).split() != [name]:
            raise DataError(f"a list of images cannot hold the name {name!r}")
        size = (str(camera.width), str(camera.height))
        lines.append(" ".join((name, camera.model, *size, *map(_shortest, camera.params))))
    write_lines(path, lines, last_line_ends=last_line_ends)


def _shortest(value: float) -> str:
    """Format with the fewest digits that preserve the float64; whole numbers without a point."""
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)


def write_transformation(path: Path, before: RigidTransform, after: RigidTransform) -> None:
    """Write a transformation file in the published form: both matrices, each under its heading."""
    lines = []
    for heading, pose in (("Before general icp:", before), ("After general icp:", after)):
        rows = (" ".join(f"{value:13.9f}" for value in row) for row in pose.matrix())
        lines += [heading, *rows, ""]
    write_lines(path, lines, last_line_ends=False)
