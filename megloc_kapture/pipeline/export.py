"""Export of maps and localized queries to the formats of other tools.

colmap      model in COLMAP's format
nerfstudio  ``transforms.json`` and ``sparse_pc.ply``
tum         ``seconds tx ty tz qx qy qz qw``, for evo
ply         points and camera frusta, for mesh viewers

Trajectories hold ``world_from_cam`` in the camera axes of COLMAP and kapture: x right, y down,
z forward. nerfstudio uses OpenGL's axes: x right, y up, z back.
"""

from __future__ import annotations

import json
import logging
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.kapture_folders import cameras_of_folder, warn_of_scaled
from megloc_kapture.errors import (
    DataError,
    OptionError,
    check_option,
    require,
    suggestion,
)
from megloc_kapture.evaluation.view import corner_rays
from megloc_kapture.geometry.cameras import principal_point_px
from megloc_kapture.io.colmap import MapImage, undistort_model, write_model
from megloc_kapture.io.files import similar_name, write_bytes
from megloc_kapture.io.images import image_size
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.kapture.points import write_ply
from megloc_kapture.io.output_folders import check_new_file, staged_output
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.map_making import kapture_of
from megloc_kapture.preprocessing.frames import scaled_camera
from megloc_kapture.stages.local_features import check_size
from megloc_kapture.values import ONE_FOCAL_MODELS, Camera, RigidTransform

_log = logging.getLogger(__name__)

Points = NDArray[np.float64]
"""Exported points (N, 6) as X Y Z R G B."""

_MAP_COLOUR, _QUERY_COLOUR = (120, 120, 120), (220, 50, 32)
# fx fy cx cy and distortion, in COLMAP's parameter order
_NERFSTUDIO: dict[str, tuple[str, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": ("OPENCV", ()),
    "PINHOLE": ("OPENCV", ()),
    "SIMPLE_RADIAL": ("OPENCV", ("k1",)),
    "RADIAL": ("OPENCV", ("k1", "k2")),
    "OPENCV": ("OPENCV", ("k1", "k2", "p1", "p2")),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1",)),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2")),
    "OPENCV_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}
_UNDISTORT = "nerfstudio can read the output of `megloc export colmap --undistort`"


@dataclass(frozen=True, eq=False, kw_only=True)
class ExportedImage(MapImage):
    """An exported image with its observations.

    Observation i joins keypoint ``rows[i]`` to the exported point ``points[i]``; both arrays are
    int (M,).
    """

    path: Path
    timestamp: int
    sensor: str
    is_query: bool
    rows: NDArray[np.integer]
    points: NDArray[np.integer]


def export_colmap(images: Sequence[ExportedImage], points: Points, output: Path) -> None:
    """Write a binary COLMAP model with one rig per camera; queries have no observations."""
    names = [image.name for image in images]
    if len(set(names)) != len(names):
        twice = min(name for name in names if names.count(name) > 1)
        raise DataError(
            f"two images are named {twice!r}: a map image and a query, or names that differ only "
            "in / and _; COLMAP needs unique names"
        )
    observed = [(image.rows, image.points) for image in images]
    write_model(output, images, observed, points[:, :3], points[:, 3:])


def export_undistorted(images: Sequence[ExportedImage], points: Points, output: Path) -> None:
    """Write PINHOLE cameras, ``images/`` and ``sparse/0`` for Gaussian splatting.

    ``/`` in image names becomes ``_``, as the original Gaussian splatting code ignores folders.
    """
    images = [replace(image, name=image.name.replace("/", "_")) for image in images]
    for image in images:
        path = _file_of(image, "undistorting")
        check_size(image_size(path), image.camera, path)
    with tempfile.TemporaryDirectory(prefix=".megloc-", dir=output) as scratch:
        model, links = Path(scratch) / "model", Path(scratch) / "images"
        export_colmap(images, points, model)
        links.mkdir()
        for image in images:
            (links / image.name).symlink_to(image.path.resolve())
        undistort_model(model, links, output)


def export_nerfstudio(
    images: Sequence[ExportedImage], points: Points, output: Path, *, final: Path | None = None
) -> None:
    """Write ``transforms.json`` and ``sparse_pc.ply`` into ``output``.

    Image paths are relative to ``final``, the folder to which ``output`` is moved later.
    """
    frames = []
    for image in images:
        path = _file_of(image, "nerfstudio")
        world_from_cam = image.cam_from_world.inverse().matrix()
        file = os.path.relpath(path.resolve(), (final or output).resolve())
        frames.append(
            {
                "file_path": Path(file).as_posix(),
                **_nerfstudio_camera(image.camera),
                "transform_matrix": (world_from_cam @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist(),
            }
        )
    # nerfstudio reads one model for all cameras here; without it, it assumes perspective cameras
    models = sorted({_nerfstudio_model(image.camera)[0] for image in images})
    require(
        len(models) < 2,
        f"nerfstudio needs cameras of one model, but these are {' and '.join(models)}: choose one "
        f"with --sensor, or undistort: {_UNDISTORT}",
    )
    content: dict[str, Any] = {"camera_model": models[0], "frames": frames}
    if len(points):
        write_ply(output / "sparse_pc.ply", points[:, :3], points[:, 3:])
        content["ply_file_path"] = "sparse_pc.ply"
    write_bytes(output / "transforms.json", (json.dumps(content, indent=1) + "\n").encode())


def _file_of(image: ExportedImage, who: str) -> Path:
    require(
        image.path.is_file(),
        f"{who} needs the file of {image.name!r}{similar_name(image.path)}; the images of a "
        "COLMAP model are looked for in images/ next to sparse/",
        path=image.path.resolve(),
    )
    return image.path


def export_tum(images: Sequence[ExportedImage], output: Path) -> None:
    rows = []
    for image in sorted(images, key=lambda record: record.timestamp):
        world_from_cam = image.cam_from_world.inverse()
        w, *vector = world_from_cam.quat_wxyz
        numbers = (*world_from_cam.translation, *vector, w)
        rows.append((image.timestamp, " ".join(f"{value:.17g}" for value in numbers)))
    stamps = [stamp for stamp, _ in rows]
    if len(set(stamps)) != len(stamps):
        raise DataError(
            "several images share a timestamp; choose one camera with --sensor: "
            f"{', '.join(sorted({image.sensor for image in images}))}"
        )
    exponent = _exponent_of_seconds(max(stamps))
    text = "".join(f"{Decimal(stamp).scaleb(exponent):f} {row}\n" for stamp, row in rows)
    write_bytes(output, text.encode())


def _exponent_of_seconds(timestamp: int) -> int:
    """Return the power of ten that converts a timestamp to seconds.

    Milli-, micro- and nanoseconds since 1970 are recognized by their magnitude. The limits hold for
    dates from 1973 to 5138.
    """
    limits = ((10**17, -9), (10**14, -6), (10**11, -3))
    return next((exponent for limit, exponent in limits if timestamp >= limit), 0)


def export_ply(images: Sequence[ExportedImage], points: Points, output: Path) -> None:
    """Write the points and the camera frusta, whose depth is a twentieth of the median depth."""
    depths = [
        float(np.median(image.cam_from_world.apply(points[image.points, :3])[:, 2]))
        for image in images
        if len(image.points)
    ]
    centres = np.array([image.cam_from_world.center() for image in images]).reshape(-1, 3)
    extent = float(np.ptp(centres, axis=0).max()) if len(centres) > 1 else 1.0
    depth = 0.05 * (float(np.median(depths)) if depths else extent or 1.0)
    vertices, colours = [points[:, :3]], [points[:, 3:]]
    edges: list[tuple[int, int]] = []
    for image in images:
        first = sum(len(part) for part in vertices)
        vertices.append(frustum(image.camera, image.cam_from_world, depth))
        colours.append(np.tile(_QUERY_COLOUR if image.is_query else _MAP_COLOUR, (5, 1)))
        edges += [(first, first + k) for k in (1, 2, 3, 4)]
        edges += [(first + k, first + k % 4 + 1) for k in (1, 2, 3, 4)]
    write_ply(output, np.concatenate(vertices), np.concatenate(colours), edges=edges)


def frustum(camera: Camera, cam_from_world: RigidTransform, depth: float) -> NDArray[np.float64]:
    """Return a camera's centre and its image corners at a depth, (5, 3), in the world frame."""
    rays = np.concatenate([np.zeros((1, 3)), depth * corner_rays(camera)])
    return cam_from_world.inverse().apply(rays)


def _nerfstudio_model(camera: Camera) -> tuple[str, tuple[str, ...]]:
    require(
        camera.model in _NERFSTUDIO,
        f"nerfstudio has no camera model {camera.model}; undistort first: {_UNDISTORT}",
    )
    return _NERFSTUDIO[camera.model]


def _nerfstudio_camera(camera: Camera) -> Mapping[str, Any]:
    _, names = _nerfstudio_model(camera)
    cx, cy = principal_point_px(camera)
    fx, fy = camera.params[0], camera.params[0 if camera.model in ONE_FOCAL_MODELS else 1]
    distortion = camera.params[len(camera.params) - len(names) :]
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
        **dict(zip(names, distortion, strict=True)),
    }


ExportFormat = Literal["colmap", "nerfstudio", "tum", "ply"]
_NO_ROWS = np.zeros(0, np.int64)


def export(
    name: ExportFormat,
    output: Path | str,
    *,
    map: KaptureMap | Path | str | None = None,
    query: Path | str | None = None,
    sensor: str | None = None,
    undistort: bool = False,
    force: bool = False,
) -> int:
    """Write a map, localized queries, or both in another tool's format; return the image count.

    Parameters
    ----------
    name : colmap and nerfstudio write folders, tum and ply files.
    map : kapture map, or a kapture folder of posed images.
    query : kapture folder of localized queries; a tum trajectory then has only the queries.
    sensor : export only images of this camera.
    undistort : write undistorted images and PINHOLE cameras for Gaussian splatting; colmap only.
    """
    if name not in get_args(ExportFormat):
        raise OptionError(f"unknown format {name!r}; {suggestion(name, get_args(ExportFormat))}")
    if map is None and query is None:
        raise OptionError("nothing to export: give a map, or localized queries")
    check_option(
        isinstance(map, KaptureMap | Path | str | None) and isinstance(query, Path | str | None),
        "give map=m.kapture_map for a Map m, and query=FOLDER for the folder of saved Results",
    )
    check_option(
        not undistort or name == "colmap", f"--undistort is an option of colmap, not of {name}"
    )
    only_queries = name == "tum" and query is not None
    images, points = _read(None if only_queries else map, query, sensor)
    require(images, (f"camera {sensor!r}: " if sensor else "") + "no image has a pose")
    output = Path(output)
    if name in ("colmap", "nerfstudio"):
        inputs = (map.folder.root if isinstance(map, KaptureMap) else map, query)
        with staged_output(output, kind="export", force=force, inputs=inputs) as out:
            if undistort:
                export_undistorted(images, points, out)
            elif name == "colmap":
                _hint_at_undistort(images)
                export_colmap(images, points, out)
            else:
                export_nerfstudio(images, points, out, final=output)
        return len(images)
    check_new_file(output, force=force)
    if name == "tum":
        export_tum(images, output)
    else:
        export_ply(images, points, output)
    return len(images)


def _hint_at_undistort(images: Sequence[ExportedImage]) -> None:
    models = {image.camera.model for image in images}
    if distorted := sorted(models - {"PINHOLE", "SIMPLE_PINHOLE"}):
        _log.warning(
            "programs for Gaussian splatting do not support %s cameras; --undistort writes PINHOLE "
            "cameras and images/ for them",
            distorted[0],
        )


def _read(
    given: KaptureMap | Path | str | None, query: Path | str | None, sensor: str | None
) -> tuple[list[ExportedImage], Points]:
    opened: KaptureMap | None = None
    images: list[ExportedImage] = []
    if given is not None:
        if isinstance(given, KaptureMap):
            folder, opened = given.folder, given
        else:
            folder = KaptureFolder(kapture_of(given))
            opened = KaptureMap.open(folder.root) if folder.has_points() else None
        images += _posed_images(folder, opened, sensor, is_query=False)
    if query is not None:
        queries = _posed_images(KaptureFolder(query), opened, sensor, is_query=True)
        if not queries:
            _log.warning("%s: no query with a pose; give the output of `megloc localize`", query)
        images += queries
    points = np.zeros((0, 6)) if opened is None else opened.folder.points3d()
    return images, points


def _posed_images(
    folder: KaptureFolder, opened: KaptureMap | None, sensor: str | None, *, is_query: bool
) -> list[ExportedImage]:
    data, (scaled, errors) = folder.read(), cameras_of_folder(folder)
    if errors:
        raise errors[0]
    pairs = [(data.sensors[key].camera(), camera) for key, camera in scaled.items()]
    warn_of_scaled(folder.root, pairs)
    posed = []
    for image, pose in sorted(data.poses().items()):
        timestamp, device = data.record_of(image)
        if sensor not in (None, device):
            continue
        camera = data.camera_of(image)
        camera = camera if opened is None else opened.to_colmap(camera)
        keypoints, rows, points = np.zeros((0, 2)), _NO_ROWS, _NO_ROWS
        if opened is not None and not is_query:
            keypoints, rows, points = _observed(opened, image)
        if device in scaled:
            width, height = scaled[device].width, scaled[device].height
            keypoints = keypoints * (width / camera.width, height / camera.height)
            camera = scaled_camera(camera, width, height)
        posed.append(
            ExportedImage(
                name=image,
                path=folder.image_path(image),
                camera=camera,
                cam_from_world=pose,
                timestamp=timestamp,
                sensor=device,
                is_query=is_query,
                keypoints_px=keypoints,
                rows=rows,
                points=points,
            )
        )
    return posed


def _observed(
    opened: KaptureMap, image: str
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Return keypoints (K, 2) of all types, and the observations as rows of keypoints and points.

    Both arrays of rows are (M,).
    """
    keypoints, rows, points = [np.zeros((0, 2))], [_NO_ROWS], [_NO_ROWS]
    for typed in opened.keypoints.values():
        if image in typed:
            before = sum(map(len, keypoints))
            keypoints.append(typed.keypoints_px(image)[:, :2].astype(np.float64))
            own_rows, own_points = typed.index.observed(image)
            rows.append(own_rows.astype(np.int64) + before)
            points.append(own_points.astype(np.int64))
    return np.concatenate(keypoints), np.concatenate(rows), np.concatenate(points)
