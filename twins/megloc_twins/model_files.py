"""Writers of the files that official layouts are made of: COLMAP's and NVM's models, lists of
images with cameras, InLoc's transformations. Numbers are the shortest texts that read back the
same.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.formats.colmap_model import (
    BINARY_FEATURE,
    BINARY_FILES,
    BINARY_POINT,
    MAX_IMAGE_ID,
    TEXT_FILES,
    ColmapImage,
    ColmapModel,
)
from megloc_kapture.datasets.formats.sparse_models import NvmModel, SparsePoints, image_order
from megloc_kapture.errors import DataError
from megloc_kapture.io.files import atomic_write, check_relative, write_bytes
from megloc_kapture.values import CAMERA_MODEL_NUM_PARAMS, Camera, RigidTransform

_NO_POINT = -1
_UNKNOWN_ERROR_PX = -1.0
_POINTS_AT_ONCE = 1 << 14


def write_colmap_text(folder: Path, model: ColmapModel) -> None:
    """Write ``cameras.txt``, ``images.txt`` and ``points3D.txt``; points get the ids 1, 2, ...

    Numbers are the shortest texts that read back the same.

    Raises
    ------
    ValueError : ids, names or tracks that a COLMAP model cannot hold.
    OutputError : cannot be written.
    """
    _check_writable(model)
    points = model.points.sorted_by_point()
    with atomic_write(folder / TEXT_FILES[0]) as file:
        file.write(b"# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n")
        for camera_id, camera in sorted(model.cameras.items()):
            params = " ".join(map(repr, camera.params))
            row = f"{camera_id} {camera.model} {camera.width} {camera.height} {params}\n"
            file.write(row.encode())
    with atomic_write(folder / TEXT_FILES[1]) as file:
        file.write(
            b"# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n# POINTS2D[] as X Y POINT3D_ID\n"
        )
        for image, xy_px, seen in _features(model):
            pose = (*image.cam_from_world.quat_wxyz, *image.cam_from_world.translation)
            numbers = " ".join(repr(float(value)) for value in pose)
            features = " ".join(
                f"{x} {y} {point + 1 if point >= 0 else -1}"
                for (x, y), point in zip(xy_px.astype(str).tolist(), seen.tolist(), strict=True)
            )
            row = f"{image.image_id} {numbers} {image.camera_id} {image.name}\n{features}\n"
            file.write(row.encode())
    ids = np.array([image.image_id for image in model.images], dtype=np.int64)
    image_ids = ids[points.image_ids].tolist() if len(ids) else []
    ends = np.searchsorted(points.point_ids, np.arange(len(points) + 1)).tolist()
    elements = [
        f" {image_id} {feature}"
        for image_id, feature in zip(image_ids, points.feature_ids.tolist(), strict=True)
    ]
    with atomic_write(folder / TEXT_FILES[2]) as file:
        file.write(b"# POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX\n")
        for row_number, (xyz, rgb) in enumerate(
            zip(points.xyz.tolist(), points.rgb.tolist(), strict=True)
        ):
            numbers = " ".join([*map(repr, xyz), *map(str, rgb), repr(_UNKNOWN_ERROR_PX)])
            track = "".join(elements[ends[row_number] : ends[row_number + 1]])
            file.write(f"{row_number + 1} {numbers}{track}\n".encode())


def write_colmap_binary(folder: Path, model: ColmapModel) -> None:
    """Write ``cameras.bin``, ``images.bin`` and ``points3D.bin``; points get the ids 1, 2, ...

    Raises
    ------
    ValueError : ids, names or tracks that a COLMAP model cannot hold.
    OutputError : cannot be written.
    """
    _check_writable(model)
    points = model.points.sorted_by_point()
    with atomic_write(folder / BINARY_FILES[0]) as file:
        file.write(struct.pack("<Q", len(model.cameras)))
        for camera_id, camera in sorted(model.cameras.items()):
            model_id = list(CAMERA_MODEL_NUM_PARAMS).index(camera.model)
            file.write(struct.pack("<IiQQ", camera_id, model_id, camera.width, camera.height))
            file.write(struct.pack(f"<{len(camera.params)}d", *camera.params))
    with atomic_write(folder / BINARY_FILES[1]) as file:
        file.write(struct.pack("<Q", len(model.images)))
        for image, xy_px, seen in _features(model):
            pose = (*image.cam_from_world.quat_wxyz, *image.cam_from_world.translation)
            file.write(struct.pack("<I7dI", image.image_id, *pose, image.camera_id))
            file.write(image.name.encode() + b"\0" + struct.pack("<Q", len(seen)))
            features = np.empty(len(seen), BINARY_FEATURE)
            features["xy"] = xy_px
            features["point"] = np.where(seen >= 0, seen + 1, _NO_POINT)
            file.write(features.tobytes())
    ids = np.array([image.image_id for image in model.images], dtype="<i4")
    pairs = np.empty((len(points.image_ids), 2), "<i4")
    pairs[:, 0] = ids[points.image_ids] if len(ids) else 0
    pairs[:, 1] = points.feature_ids
    ends = np.searchsorted(points.point_ids, np.arange(len(points) + 1)).tolist()
    heads = np.empty(len(points), BINARY_POINT)
    heads["id"] = np.arange(1, len(points) + 1)
    heads["xyz"], heads["rgb"], heads["error"] = points.xyz, points.rgb, _UNKNOWN_ERROR_PX
    heads["length"] = np.diff(ends)
    with atomic_write(folder / BINARY_FILES[2]) as file:
        file.write(struct.pack("<Q", len(points)))
        for row, head in enumerate(heads):
            file.write(head.tobytes() + pairs[ends[row] : ends[row + 1]].tobytes())


def _features(
    model: ColmapModel,
) -> Iterator[tuple[ColmapImage, NDArray[np.float32], NDArray[np.int64]]]:
    """Each image with the features a file lists: where (M, 2), and the row of the point or -1.

    Features that the model does not know, because no point needs them, stand at (0, 0): their
    rows keep the others' indices.

    Raises
    ------
    ValueError : a feature sees two points, which no COLMAP model can say.
    """
    points = model.points
    points.check_images(len(model.images))
    order = image_order(points.image_ids)
    ends = np.searchsorted(points.image_ids[order], np.arange(len(model.images) + 1)).tolist()
    for position, image in enumerate(model.images):
        rows = order[ends[position] : ends[position + 1]]
        ids = points.feature_ids[rows]
        if len(np.unique(ids)) != len(ids) or (len(ids) and ids.min() < 0):
            raise ValueError(f"a feature of image {image.name!r} is negative or in two tracks")
        size = int(ids.max()) + 1 if len(ids) else 0
        xy_px = np.zeros((size, 2), np.float32)
        seen = np.full(size, _NO_POINT, np.int64)
        xy_px[ids] = points.xy_px[rows]
        seen[ids] = points.point_ids[rows]
        yield image, xy_px, seen


def _check_writable(model: ColmapModel) -> None:
    """Raise ValueError where ids or names are not fit for a model's files."""
    ids = [image.image_id for image in model.images]
    if len(set(ids)) != len(ids) or not all(0 <= i <= MAX_IMAGE_ID for i in ids):
        raise ValueError("image ids are out of range or not unique")
    for image in model.images:
        if image.camera_id not in model.cameras:
            raise ValueError(f"image {image.name!r} has the unknown camera {image.camera_id}")
        if not image.name or image.name.split() != [image.name] or "\0" in image.name:
            raise ValueError(f"image name {image.name!r} has blanks, as COLMAP cannot read it")


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
    for (x, y, z), (r, g, b), begin, end in zip(xyz, rgb, offsets[:-1], offsets[1:], strict=True):
        lines.append(
            f"{x!r} {y!r} {z!r} {r} {g} {b} {end - begin}{''.join(measurements[begin:end])}\n"
        )
    return "".join(lines)


def write_query_list(
    path: Path, cameras: Mapping[str, Camera], *, last_line_ends: bool = True
) -> None:
    """Write a list in the order of ``cameras``; numbers as short as they read back the same.

    Parameters
    ----------
    last_line_ends : False leaves the last line without its end, as in published lists.

    Raises
    ------
    DataError : a name with white space in it, or that is no plain relative path.
    OutputError : the file cannot be written.
    """
    lines = []
    for name, camera in cameras.items():
        if check_relative(name).split() != [name]:
            raise DataError(f"a list of images cannot hold the name {name!r}")
        size = (str(camera.width), str(camera.height))
        lines.append(" ".join((name, camera.model, *size, *map(_shortest, camera.params))))
    write_bytes(path, ("\n".join(lines) + "\n" * last_line_ends).encode())


def _shortest(value: float) -> str:
    """Shortest text that reads back as the same float64; whole numbers without a point."""
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)


def write_transformation(path: Path | str, before: RigidTransform, after: RigidTransform) -> None:
    """Write a transformation file as published: both matrices, each under its heading."""
    lines = []
    for heading, pose in (("Before general icp:", before), ("After general icp:", after)):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = pose.rotation_matrix(), pose.translation
        lines += [heading, *(" ".join(f"{value:13.9f}" for value in row) for row in matrix), ""]
    write_bytes(path, "\n".join(lines).encode())
