"""COLMAP through pycolmap: cameras, databases, models, triangulation with known poses.

Only the modules of ``io`` deal with pycolmap's changing names and pitfalls (docs/architecture.md).
"""

from __future__ import annotations

import os
import signal
import tempfile
import threading
import zlib  # noqa: F401  pycolmap 4.1.1 to 4.2.1 corrupt the heap when imported before zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from shutil import disk_usage, rmtree
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError, OutputError, require
from megloc_kapture.io.files import TEMPORARY, output_error
from megloc_kapture.values import Camera, Options, RigidTransform

# minimum number of residuals for multithreading, so high that COLMAP always uses a single thread
NEVER = 2**31 - 1
_STDERR = threading.Lock()


@lru_cache(maxsize=1)
def load_pycolmap() -> Any:
    """Import pycolmap on first use; for the modules of ``io`` only."""
    before = signal.getsignal(signal.SIGTERM)
    import pycolmap

    # importing pycolmap replaces the SIGTERM handler; a terminated run would print a stack trace
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    pycolmap.logging.minloglevel = 2  # hide INFO and WARNING lines
    return pycolmap


@contextmanager
def quiet_stderr() -> Iterator[None]:
    # COLMAP writes progress to file descriptor 2 at every log level
    with _STDERR:  # the last of several threads would restore what another has silenced
        saved = os.dup(2)
        null = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(null, 2)
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            os.close(null)


# ------------------------------------------------------------------------------------ cameras


def new_colmap_camera(camera: Camera) -> Any:
    return load_pycolmap().Camera(
        model=camera.model, width=camera.width, height=camera.height, params=list(camera.params)
    )


colmap_camera = lru_cache(maxsize=4096)(new_colmap_camera)


def new_colmap_pose(pose: RigidTransform) -> Any:
    pycolmap = load_pycolmap()
    w, x, y, z = pose.quat_wxyz
    rotation = pycolmap.Rotation3d(np.array([x, y, z, w]))
    return pycolmap.Rigid3d(rotation, np.array(pose.translation))


def normalized_from_px(camera: Camera, points_px: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Undistort pixels (N, 2) to normalised image coordinates (x/z, y/z), float64 (N, 2)."""
    points = np.ascontiguousarray(points_px, dtype=np.float64).reshape(-1, 2)
    if len(points) == 0:
        return np.zeros((0, 2))
    return np.asarray(colmap_camera(camera).cam_from_img(points), dtype=np.float64)


def px_from_cam(camera: Camera, points_in_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project points (N, 3) in the camera frame to pixels (N, 2); NaN behind the camera."""
    points = np.ascontiguousarray(points_in_cam, dtype=np.float64).reshape(-1, 3)
    out = np.full((len(points), 2), np.nan)
    front = points[:, 2] > 0
    if front.any():
        out[front] = colmap_camera(camera).img_from_cam(points[front])
    return out


def undistorted_pinhole(camera: Camera) -> Camera:
    """Return the PINHOLE camera of COLMAP's undistorted image, with the same focal lengths.

    All its pixels lie inside the distorted image.
    """
    pycolmap = load_pycolmap()
    options = pycolmap.UndistortCameraOptions()  # by default without blank pixels
    pinhole = pycolmap.undistort_camera(options, colmap_camera(camera))
    return replace(Camera.from_colmap(pinhole), focal_deviation=camera.focal_deviation)


def focal_from_exif(jpeg: bytes) -> float | None:
    """Return the focal length in pixels that COLMAP infers from a JPEG file's EXIF, or None."""
    pycolmap = load_pycolmap()
    with tempfile.TemporaryDirectory(prefix=TEMPORARY) as folder:
        path = Path(folder) / "blank.jpg"
        path.write_bytes(jpeg)
        camera = pycolmap.infer_camera_from_image(str(path))
    return float(camera.mean_focal_length()) if camera.has_prior_focal_length else None


def focal_from_matches(
    points_px: NDArray[np.float64],
    points: NDArray[np.float64],
    camera: Camera,
    max_error_px: float,
    seed: int,
) -> float | None:
    """Estimate the focal length in pixels of an otherwise known camera by P4Pf in RANSAC.

    Matches of ``points_px`` (N, 2) and ``points`` (N, 3) that are not finite are ignored. Return
    None if no pose has enough inliers.
    """
    usable = np.isfinite(points_px).all(axis=1) & np.isfinite(points).all(axis=1)
    if np.count_nonzero(usable) < 4:
        return None
    pycolmap = load_pycolmap()
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.estimate_focal_length = True
    options.ransac.max_error = max_error_px
    options.ransac.random_seed = seed
    changed = new_colmap_camera(camera)
    estimate = pycolmap.estimate_absolute_pose(points_px[usable], points[usable], changed, options)
    return None if estimate is None else float(changed.mean_focal_length())


# ------------------------------------------------------------------------------- triangulation


# bundle adjustment ends if the cost decreases by a smaller fraction; with COLMAP's 0, triangulation
# takes 1.4 times as long on redkitchen_rgbd, and 99 % of the points differ by at most 1 mm
_FUNCTION_TOLERANCE = 1e-4


class TriangulationOptions(Options):
    """Options for COLMAP's triangulation with known poses."""

    two_view_tracks: bool = Field(
        default=False, description="keep points that only two images observe"
    )


@dataclass(frozen=True, eq=False)
class MapImage:
    """A mapping image; keypoints (N, 2), the first pixel's centre at (0.5, 0.5)."""

    name: str
    camera: Camera
    cam_from_world: RigidTransform
    keypoints_px: NDArray[np.floating]


def triangulate(
    images: Sequence[MapImage],
    matches: Mapping[tuple[int, int], NDArray[np.integer[Any]]],
    options: TriangulationOptions | None = None,
    *,
    num_threads: int = 1,
    scratch: Path | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Triangulate verified matches between images with fixed poses and cameras.

    Return points (N, 3) in the world frame, their mean reprojection errors in pixels (N,), and
    their observations (O, 3): rows of a point, an image and a keypoint of this image, sorted.

    ``matches`` maps pairs (i, j) of images to keypoint rows (M, 2). The world is centred on the
    cameras while COLMAP works, so that maps far from the origin (ECEF) lose no digits.
    """
    options = options or TriangulationOptions()
    if not images:
        return np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3), np.int64)
    for (i, j), pairs in matches.items():
        both = np.array([len(images[i].keypoints_px), len(images[j].keypoints_px)])
        require(
            not (np.asarray(pairs).reshape(-1, 2) >= both).any(),
            f"matches between {images[i].name} and {images[j].name} refer to keypoints "
            f"that the images do not have ({both[0]} and {both[1]})",
        )
    pycolmap = load_pycolmap()
    sizes = [len(image.keypoints_px) for image in images]
    offset = np.mean([image.cam_from_world.center() for image in images], axis=0)
    with database_folder(scratch, sizes, matches) as folder, quiet_stderr():
        database_path = Path(folder) / "database.db"
        cameras, camera_ids = _cameras_of(images)
        named = [(i.name, k, i.keypoints_px) for i, k in zip(images, camera_ids, strict=True)]
        write_database(database_path, cameras, named, matches)
        recentre = RigidTransform((1.0, 0.0, 0.0, 0.0), (offset[0], offset[1], offset[2]))
        recentred = [replace(i, cam_from_world=i.cam_from_world @ recentre) for i in images]
        reconstruction = _posed_reconstruction(recentred, cameras, camera_ids)
        pipeline = pycolmap.IncrementalPipelineOptions()
        pipeline.num_threads = num_threads
        # several threads sum residuals in varying order, which changes the last bits
        pipeline.ba_min_num_residuals_for_cpu_multi_threading = NEVER
        # COLMAP uses the seeds for long tracks only, without a known effect on points
        pipeline.random_seed = pipeline.triangulation.random_seed = 0
        pipeline.triangulation.ignore_two_view_tracks = not options.two_view_tracks
        pipeline.ba_global_function_tolerance = _FUNCTION_TOLERANCE
        result_path = Path(folder) / "result"
        result_path.mkdir()
        result = pycolmap.triangulate_points(
            reconstruction, str(database_path), folder, str(result_path), True, pipeline
        )
    return _collect(result, offset)


@contextmanager
def database_folder(
    scratch: Path | None,
    num_keypoints: Sequence[int],
    matches: Mapping[tuple[int, int], NDArray[np.integer[Any]]],
) -> Iterator[str]:
    """Yield a folder for a database; OutputError without enough space, where COLMAP would abort."""
    place = tempfile.gettempdir() if scratch is None else scratch
    # matches are written twice, keypoints as float32; the rest is SQLite and its journal
    needed = 16 * sum(map(len, matches.values())) + 8 * sum(num_keypoints)
    needed = 2 * needed + 2048 * (len(num_keypoints) + len(matches)) + (1 << 20)
    try:
        Path(place).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(
            prefix=TEMPORARY, dir=place, ignore_cleanup_errors=True
        ) as folder:
            free = disk_usage(folder).free
            if free < needed:
                raise OutputError(
                    f"{place}: {free >> 20} MB are free, but COLMAP's database needs "
                    f"{needed >> 20} MB"
                )
            yield folder
    except OSError as error:
        raise output_error(place, error) from error
    except RuntimeError as error:
        raise OutputError(f"{place}: COLMAP cannot work here: {error}") from error


def _cameras_of(images: Sequence[MapImage]) -> tuple[list[Any], list[int]]:
    """Return the distinct COLMAP cameras and the camera id of each image."""
    numbers: dict[Camera, int] = {}
    camera_ids = [numbers.setdefault(image.camera, len(numbers) + 1) for image in images]
    return numbered_cameras(numbers), camera_ids


def numbered_cameras(cameras: Iterable[Camera]) -> list[Any]:
    """Convert cameras to COLMAP's, numbered from 1."""
    numbered = [new_colmap_camera(camera) for camera in cameras]
    for camera_id, camera in enumerate(numbered, start=1):
        camera.camera_id = camera_id
    return numbered


def write_database(
    path: Path,
    cameras: Sequence[Any],
    images: Sequence[tuple[str, int, NDArray[np.floating[Any]]]],
    matches: Mapping[tuple[int, int], NDArray[np.integer[Any]]],
    geometry: Callable[[int, int, NDArray[np.uint32]], Any] | None = None,
) -> None:
    """Write a COLMAP database in which every camera is its own rig.

    ``images`` are name, camera id and keypoints (N, 2); their ids count from 1. ``matches`` maps
    pairs (i, j) of indices into ``images`` to keypoint rows (M, 2), which are stored as inliers
    unless ``geometry`` verifies them.
    """
    pycolmap = load_pycolmap()
    database = pycolmap.Database.open(str(path))
    with pycolmap.DatabaseTransaction(database):
        for camera in cameras:
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=camera.camera_id)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for image_id, (name, camera_id, keypoints_px) in enumerate(images, start=1):
            keypoints = np.ascontiguousarray(keypoints_px[:, :2], dtype=np.float32)
            entry = pycolmap.Image(image_id=image_id, name=name, camera_id=camera_id)
            entry.frame_id = image_id
            frame = pycolmap.Frame()
            frame.frame_id = image_id
            frame.rig_id = camera_id
            frame.add_data_id(entry.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_image(entry, use_image_id=True)
            database.write_keypoints(image_id, keypoints)
        for (i, j), pairs in matches.items():
            if len(pairs) == 0:
                continue
            rows = np.ascontiguousarray(pairs, dtype=np.uint32)
            database.write_matches(i + 1, j + 1, rows)
            if geometry is None:
                two_view = pycolmap.TwoViewGeometry()
                two_view.inlier_matches = rows
                # with UNDEFINED, pycolmap 4.2 silently triangulates nothing
                two_view.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            else:
                two_view = geometry(i, j, rows)
            database.write_two_view_geometry(i + 1, j + 1, two_view)
    database.close()


def _posed_reconstruction(
    images: Sequence[MapImage], cameras: Sequence[Any], camera_ids: Sequence[int]
) -> Any:
    pycolmap = load_pycolmap()
    reconstruction = pycolmap.Reconstruction()
    for camera in cameras:
        reconstruction.add_camera_with_trivial_rig(camera)
    for image_id, (image, camera_id) in enumerate(zip(images, camera_ids, strict=True), start=1):
        keypoints = np.ascontiguousarray(image.keypoints_px[:, :2], dtype=np.float64)
        entry = pycolmap.Image(
            image_id=image_id, name=image.name, camera_id=camera_id, keypoints=keypoints
        )
        reconstruction.add_image_with_trivial_frame(entry, new_colmap_pose(image.cam_from_world))
    return reconstruction


def _collect(
    reconstruction: Any, offset: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    # sorted by track, because COLMAP's order of points depends on its threads
    tracks = [
        (sorted((e.image_id - 1, e.point2D_idx) for e in point.track.elements), point)
        for _, point in sorted(reconstruction.points3D.items())
    ]
    tracks.sort(key=lambda pair: pair[0])
    lengths = np.array([len(track) for track, _ in tracks], dtype=np.int64)
    point_ids = np.repeat(np.arange(len(tracks)), lengths)
    flat = np.array([e for track, _ in tracks for e in track], dtype=np.int64).reshape(-1, 2)
    xyz = np.array([p.xyz for _, p in tracks], dtype=np.float64).reshape(-1, 3) + offset
    errors_px = np.array([p.error for _, p in tracks], dtype=np.float64)
    return xyz, errors_px, np.column_stack([point_ids, flat])


def write_model(
    output: Path,
    images: Sequence[MapImage],
    observed: Sequence[tuple[NDArray[np.integer[Any]], NDArray[np.integer[Any]]]],
    xyz: NDArray[np.float64],
    colours: NDArray[np.floating],
) -> None:
    """Write a binary COLMAP model in which every camera is its own rig; ids count from 1.

    ``observed`` holds, for each image, the rows of its keypoints and of the points they observe.
    Unobserved points are written too. If a keypoint observes several points, as kapture
    permits, only the first is kept.
    """
    pycolmap = load_pycolmap()
    model = _posed_reconstruction(images, *_cameras_of(images))
    tracks: list[list[Any]] = [[] for _ in xyz]
    for number, (rows, points) in enumerate(observed, start=1):
        rows, first = np.unique(rows, return_index=True)
        for row, point in zip(rows.tolist(), points[first].tolist(), strict=True):
            tracks[point].append(pycolmap.TrackElement(number, row))
    rgb = np.clip(np.rint(colours), 0, 255).astype(np.uint8)
    for point, elements, colour in zip(xyz, tracks, rgb, strict=True):
        model.add_point3D(point, pycolmap.Track(elements), colour)
    model.update_point_3d_errors()
    try:
        output.mkdir(parents=True, exist_ok=True)
        model.write(str(output))
    except (OSError, RuntimeError, ValueError) as error:
        raise OutputError(f"{output}: COLMAP cannot write its model: {error}") from error


def undistort_model(model: Path, images: Path, output: Path) -> None:
    """Undistort a model with its keypoints into ``sparse/0`` and its images into ``images/``."""
    pycolmap = load_pycolmap()
    try:
        with quiet_stderr():
            pycolmap.undistort_images(str(output), str(model), str(images))
        rmtree(output / "stereo")
        for script in output.glob("run-colmap-*.sh"):
            script.unlink()
        (output / "sparse").rename(output / "0")
        (output / "sparse").mkdir()
        (output / "0").rename(output / "sparse" / "0")
    except (OSError, RuntimeError, ValueError) as error:
        raise OutputError(f"{output}: COLMAP cannot undistort the images: {error}") from error
    for image in images.iterdir():
        if not (output / "images" / image.name).is_file():
            raise DataError("COLMAP cannot read the image", path=image.resolve())
