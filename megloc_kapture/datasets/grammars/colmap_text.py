"""COLMAP's text models: cameras.txt, images.txt and points3D.txt.

``images.txt`` has two lines per image, and the second one, its features, may be empty: it is taken
by its place. Comments and blank lines may stand where an image's first line is expected.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.grammars.colmap_values import (
    MAX_IMAGE_ID,
    UNKNOWN_ERROR_PX,
    ColmapImage,
    ColmapModel,
    ImageTable,
    TrackedFeatures,
    check_writable,
    features_for_writing,
)
from megloc_kapture.datasets.grammars.fields import MAX_FEATURE_ID, Fields
from megloc_kapture.datasets.grammars.model_lines import LARGE_BYTES, Line, ModelLines, is_large
from megloc_kapture.datasets.grammars.sparse_points import SparsePoints
from megloc_kapture.datasets.grammars.track_rows import (
    ALL_ROWS,
    Row,
    RowFormat,
    TrackArrays,
    read_tracks,
)
from megloc_kapture.errors import DataError
from megloc_kapture.io.atomic import atomic_write
from megloc_kapture.io.kapture_sensors import unit_quaternion
from megloc_kapture.values import Camera, RigidTransform

CAMERAS, IMAGES, POINTS = "cameras.txt", "images.txt", "points3D.txt"
FILES = (CAMERAS, IMAGES, POINTS)
_ID_END = 2**32 - 1
_SIZE_END = 2**31


def read_colmap_text(
    folder: Path, *, with_points: bool = True, large_bytes: int = LARGE_BYTES
) -> ColmapModel:
    """Read a text model; see :func:`~megloc_kapture.datasets.grammars.colmap_model`.

    Raises
    ------
    DataError : a file is missing or broken; names file and line.
    """
    cameras = _read_cameras(folder / CAMERAS)
    if not with_points:
        images = _read_images(folder / IMAGES, cameras, None, large_bytes)
        return ColmapModel(cameras, images, SparsePoints.none())
    features = TrackedFeatures(_read_points(folder / POINTS, large_bytes))
    images = _read_images(folder / IMAGES, cameras, features, large_bytes)
    features.resolve(images, folder / POINTS)
    return ColmapModel(cameras, images, features.points())


def _read_cameras(path: Path) -> dict[int, Camera]:
    cameras: dict[int, Camera] = {}
    lines = ModelLines(path)
    while (line := _row(lines)) is not None:
        fields = Fields(path, line)
        if len(fields.all) < 5:
            raise fields.error(
                "expected a camera (CAMERA_ID MODEL WIDTH HEIGHT PARAMS), "
                f"got {len(fields.all)} fields"
            )
        camera_id = fields.count(0, "camera id", _ID_END)
        if camera_id in cameras:
            raise fields.error(f"camera {camera_id} is listed twice")
        model = fields.all[1].decode("ascii", errors="replace")
        width = fields.count(2, "width", _SIZE_END)
        height = fields.count(3, "height", _SIZE_END)
        params = fields.numbers(4, len(fields.all), "camera parameter")
        try:
            cameras[camera_id] = Camera(model, width, height, tuple(params))
        except DataError as error:
            raise fields.error(error.message) from None
    return cameras


def _read_images(
    path: Path, cameras: dict[int, Camera], features: TrackedFeatures | None, large_bytes: int
) -> tuple[ColmapImage, ...]:
    table = ImageTable(cameras)
    lines = ModelLines(path)
    compiled = is_large(path, large_bytes)
    while (line := _row(lines)) is not None:
        image = _parse_image(Fields(path, line))
        try:
            table.add(image)
        except DataError as error:
            raise DataError(error.message, path=path, line=line.number) from None
        of_image = lines.line()  # the last one may be missing: then it is empty
        if features is None:
            continue
        xy_px = np.empty((0, 2))
        number = line.number
        if of_image is not None:
            number = of_image.number
            xy_px = _parse_features(path, of_image, compiled=compiled)
        try:
            features.place(image.image_id, xy_px)
        except DataError as error:
            raise DataError(error.message, path=path, line=number) from None
    return table.sorted()


def _parse_image(fields: Fields) -> ColmapImage:
    if len(fields.all) < 10:
        raise fields.error(
            "expected an image (IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME), "
            f"got {len(fields.all)} fields"
        )
    name = fields.line.content.split(maxsplit=9)[9].rstrip()
    w, x, y, z, tx, ty, tz = fields.numbers(1, 8, "pose")
    try:
        pose = RigidTransform(unit_quaternion((w, x, y, z)), (tx, ty, tz))
    except DataError as error:
        raise fields.error(error.message) from None
    return ColmapImage(
        fields.count(0, "image id", MAX_IMAGE_ID + 1),
        fields.image_name(name),
        fields.count(8, "camera id", _ID_END),
        pose,
    )


def _parse_features(path: Path, line: Line, *, compiled: bool) -> NDArray[np.float64]:
    """Where the features of an image lie, (M, 2)."""
    if compiled:
        from megloc_kapture.datasets.grammars import track_kernels as kernels

        bits = np.empty(2 * (len(line.content) // 6 + 1), np.uint64)
        read = int(kernels.parse_model_features(line.chunk.text, line.begin, bits))
        if read >= 0:
            return bits[: 2 * read].view(np.float64).reshape(-1, 2)
    fields = Fields(path, line)
    if len(fields.all) % 3:
        raise fields.error(
            "expected features (X Y POINT3D_ID, repeated) or a blank line, "
            f"got {len(fields.all)} fields"
        )
    xy_px = []
    for index in range(0, len(fields.all), 3):
        xy_px.append((fields.pixel(index), fields.pixel(index + 1)))
        if fields.all[index + 2] != b"-1":
            fields.count(index + 2, "point id")
    return np.array(xy_px, dtype=np.float64).reshape(-1, 2)


def _read_points(path: Path, large_bytes: int) -> TrackArrays:
    lines = ModelLines(path)
    row_format = RowFormat(
        lambda line: _parse_point(Fields(path, line)),
        "parse_colmap_points",
        MAX_IMAGE_ID + 1,
        row_bytes=16,
        observation_bytes=4,
        with_xy=False,
    )
    return read_tracks(lines, ALL_ROWS, row_format, compiled=is_large(path, large_bytes))


def _parse_point(fields: Fields) -> Row | None:
    if fields.all[0].startswith(b"#"):
        return None
    if len(fields.all) < 8 or len(fields.all) % 2:
        raise fields.error(
            "expected a point (POINT3D_ID X Y Z R G B ERROR and pairs of IMAGE_ID POINT2D_IDX), "
            f"got {len(fields.all)} fields"
        )
    fields.count(0, "point id")
    fields.number(7, "reprojection error")
    return Row(
        fields.numbers(1, 4, "coordinate"),
        fields.colour(4),
        [
            (
                fields.count(k, "image id", MAX_IMAGE_ID + 1),
                fields.count(k + 1, "feature index", MAX_FEATURE_ID + 1),
            )
            for k in range(8, len(fields.all), 2)
        ],
        [],
    )


def _row(lines: ModelLines) -> Line | None:
    """The next line that is neither blank nor a comment."""
    while (line := lines.row()) is not None:
        if not line.content.lstrip().startswith(b"#"):
            return line
    return None


# ------------------------------------------------------------------------------------ writing


def write_colmap_text(folder: Path, model: ColmapModel) -> None:
    """Write ``cameras.txt``, ``images.txt`` and ``points3D.txt``; points get the ids 1, 2, ...

    Numbers are the shortest texts that read back the same.

    Raises
    ------
    ValueError : ids, names or tracks that a COLMAP model cannot hold.
    OutputError : cannot be written.
    """
    check_writable(model)
    points = model.points.sorted_by_point()
    with atomic_write(folder / CAMERAS) as file:
        file.write(b"# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n")
        for camera_id, camera in sorted(model.cameras.items()):
            params = " ".join(map(repr, camera.params))
            row = f"{camera_id} {camera.model} {camera.width} {camera.height} {params}\n"
            file.write(row.encode())
    with atomic_write(folder / IMAGES) as file:
        file.write(
            b"# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n# POINTS2D[] as X Y POINT3D_ID\n"
        )
        for image, xy_px, seen in features_for_writing(model):
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
    with atomic_write(folder / POINTS) as file:
        file.write(b"# POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX\n")
        for row_number, (xyz, rgb) in enumerate(
            zip(points.xyz.tolist(), points.rgb.tolist(), strict=True)
        ):
            numbers = " ".join([*map(repr, xyz), *map(str, rgb), repr(UNKNOWN_ERROR_PX)])
            track = "".join(elements[ends[row_number] : ends[row_number + 1]])
            file.write(f"{row_number + 1} {numbers}{track}\n".encode())
