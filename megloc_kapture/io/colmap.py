"""COLMAP through pycolmap: triangulation with known poses, databases, models, SIFT."""

from __future__ import annotations

import os
import tempfile
import zlib  # noqa: F401  pycolmap 4.1.1 to 4.2.1 corrupt the heap when imported before zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import disk_usage
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.colmap_cameras import colmap_camera, load_pycolmap, new_colmap_camera
from megloc_kapture.io.files import output_error, owned_name
from megloc_kapture.values import Camera, Options, RigidTransform

if TYPE_CHECKING:
    from collections.abc import Iterator


NEVER = 2**31 - 1


class TriangulationOptions(Options):
    """Options of COLMAP's triangulation with known poses; defaults are COLMAP's but where said."""

    max_reprojection_error_px: float = Field(
        default=4.0, gt=0, description="of an observation; one that is farther off is left out"
    )
    min_angle_deg: float = Field(
        default=1.5, ge=0, description="between the rays of a point; narrower ones make none"
    )
    two_view_tracks: bool = Field(
        default=False, description="keep points that only two images observe"
    )


@dataclass(frozen=True, eq=False)
class MapImage:
    """One mapping image as triangulation needs it; keypoints are (N, 2), first pixel (0.5, 0.5)."""

    name: str
    camera: Camera
    cam_from_world: RigidTransform
    keypoints_px: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class TriangulatedPoints:
    """Points and their observations, in arrays.

    Attributes
    ----------
    xyz : float64 (N, 3) in the world frame.
    errors_px : float64 (N,), mean reprojection error.
    point_ids, image_ids, keypoint_ids : int64 (O,) rows of ``xyz``, indices into the images
        given, rows of their keypoints; sorted by point, then image, then keypoint.
    """

    xyz: NDArray[np.float64]
    errors_px: NDArray[np.float64]
    point_ids: NDArray[np.int64]
    image_ids: NDArray[np.int64]
    keypoint_ids: NDArray[np.int64]


@contextmanager
def quiet_stderr() -> Iterator[None]:
    # COLMAP writes progress to the file descriptor whatever its log level says
    if os.environ.get("MEGLOC_COLMAP_LOG"):
        yield
        return
    saved = os.dup(2)
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)


def triangulate(
    images: Sequence[MapImage],
    matches: Mapping[tuple[int, int], NDArray[np.integer[Any]]],
    options: TriangulationOptions | None = None,
    *,
    num_threads: int = 1,
    scratch: Path | None = None,
) -> TriangulatedPoints:
    """Triangulate verified matches between images of known pose; poses and cameras stay fixed.

    The world is recentred on the cameras' mean while COLMAP works, so that maps far from the
    origin (ECEF) lose no digits.

    Parameters
    ----------
    images : the mapping images.
    matches : (M, 2) keypoint rows for pairs (i, j) of indices into ``images``.
    scratch : folder for COLMAP's database meanwhile, the system's unless given.

    Raises
    ------
    DataError : a match refers past the keypoints of its image.
    OutputError : no room for the database.
    """
    options = options or TriangulationOptions()
    empty = np.zeros(0, dtype=np.int64)
    if not images:
        return TriangulatedPoints(np.zeros((0, 3)), np.zeros(0), empty, empty, empty)
    for (i, j), pairs in matches.items():
        if i == j or (j, i) in matches:
            raise DataError(
                f"images {images[i].name} and {images[j].name} are matched twice or are the same"
            )
        both = np.array([len(images[i].keypoints_px), len(images[j].keypoints_px)])
        if len(pairs) and ((np.asarray(pairs) >= both).any() or (np.asarray(pairs) < 0).any()):
            raise DataError(
                f"matches between {images[i].name} and {images[j].name} refer to keypoints "
                f"that the images do not have ({both[0]} and {both[1]})"
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
        # with many residuals its threads add them up in whatever order they come: other last bits
        pipeline.ba_min_num_residuals_for_cpu_multi_threading = NEVER
        # drawn from in tracks of many images only, and never seen to change a point
        pipeline.random_seed = pipeline.triangulation.random_seed = 0
        pipeline.triangulation.ignore_two_view_tracks = not options.two_view_tracks
        pipeline.triangulation.min_angle = options.min_angle_deg
        pipeline.triangulation.merge_max_reproj_error = options.max_reprojection_error_px
        pipeline.triangulation.complete_max_reproj_error = options.max_reprojection_error_px
        pipeline.mapper.filter_max_reproj_error = options.max_reprojection_error_px
        pipeline.mapper.filter_min_tri_angle = options.min_angle_deg
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
    """A folder for a database; with too little room COLMAP would end the process, so it is asked.

    Raises OutputError: too little room, or COLMAP could not write.
    """
    place = tempfile.gettempdir() if scratch is None else scratch
    # matches are written twice, keypoints as float32; the rest is what SQLite and its journal take
    needed = 16 * sum(map(len, matches.values())) + 8 * sum(num_keypoints)
    needed = 2 * needed + 2048 * (len(num_keypoints) + len(matches)) + (1 << 20)
    try:
        Path(place).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(
            prefix=f".{owned_name()}", dir=place, ignore_cleanup_errors=True
        ) as folder:
            free = disk_usage(folder).free
            if free < needed:
                raise OutputError(
                    f"{place}: {free >> 20} MB are free, COLMAP's database takes {needed >> 20} MB"
                )
            yield folder
    except OSError as error:
        raise output_error(place, error) from error
    except RuntimeError as error:
        raise OutputError(f"{place}: COLMAP cannot work here: {error}") from error


def _cameras_of(images: Sequence[MapImage]) -> tuple[list[Any], list[int]]:
    """COLMAP's cameras, equal ones once, and the number of each image's."""
    numbers: dict[Camera, int] = {}
    camera_ids = [numbers.setdefault(image.camera, len(numbers) + 1) for image in images]
    return numbered_cameras(numbers), camera_ids


def numbered_cameras(cameras: Iterable[Camera]) -> list[Any]:
    """COLMAP's cameras, numbered from 1 on."""
    found = [new_colmap_camera(camera) for camera in cameras]
    for camera_id, camera in enumerate(found, start=1):
        camera.camera_id = camera_id
    return found


def write_database(
    path: Path,
    cameras: Sequence[Any],
    images: Sequence[tuple[str, int, NDArray[np.floating[Any]]]],
    matches: Mapping[tuple[int, int], NDArray[np.integer[Any]]],
    geometry: Callable[[int, int, NDArray[np.uint32]], Any] | None = None,
) -> None:
    """Write COLMAP's database; every camera is a rig of its own.

    Parameters
    ----------
    cameras : COLMAP's, with their numbers.
    images : name, number of the camera and keypoints (N, 2) of each; they are numbered from 1 on.
    matches : (M, 2) keypoint rows of pairs (i, j) of indices into ``images``.
    geometry : COLMAP's two-view geometry of a pair; a verified one unless given.
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
                found = pycolmap.TwoViewGeometry()
                found.inlier_matches = rows
                # left UNDEFINED, pycolmap 4.2 triangulates nothing, silently
                found.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            else:
                found = geometry(i, j, rows)
            database.write_two_view_geometry(i + 1, j + 1, found)
    database.close()


def _posed_reconstruction(
    images: Sequence[MapImage], cameras: Sequence[Any], camera_ids: Sequence[int]
) -> Any:
    """The reconstruction of the poses, without points; images are numbered from 1 on."""
    pycolmap = load_pycolmap()
    reconstruction = pycolmap.Reconstruction()
    for camera in cameras:
        reconstruction.add_camera_with_trivial_rig(camera)
    for image_id, (image, camera_id) in enumerate(zip(images, camera_ids, strict=True), start=1):
        keypoints = np.ascontiguousarray(image.keypoints_px[:, :2], dtype=np.float64)
        entry = pycolmap.Image(
            image_id=image_id, name=image.name, camera_id=camera_id, keypoints=keypoints
        )
        w, x, y, z = image.cam_from_world.quat_wxyz
        rotation = pycolmap.Rotation3d(np.array([x, y, z, w]))
        pose = pycolmap.Rigid3d(rotation, np.array(image.cam_from_world.translation))
        reconstruction.add_image_with_trivial_frame(entry, pose)
    return reconstruction


def _collect(reconstruction: Any, offset: NDArray[np.float64]) -> TriangulatedPoints:
    # COLMAP numbers points in an order that depends on its threads; order them by their tracks
    found = [
        (sorted((e.image_id - 1, e.point2D_idx) for e in point.track.elements), point)
        for _, point in sorted(reconstruction.points3D.items())
    ]
    found.sort(key=lambda pair: pair[0])
    lengths = np.array([len(track) for track, _ in found], dtype=np.int64)
    flat = np.array([e for track, _ in found for e in track], dtype=np.int64).reshape(-1, 2)
    return TriangulatedPoints(
        xyz=np.array([p.xyz for _, p in found], dtype=np.float64).reshape(-1, 3) + offset,
        errors_px=np.array([p.error for _, p in found], dtype=np.float64),
        point_ids=np.repeat(np.arange(len(found), dtype=np.int64), lengths),
        image_ids=flat[:, 0],
        keypoint_ids=flat[:, 1],
    )


def write_model(
    output: Path,
    images: Sequence[MapImage],
    observed: Sequence[tuple[NDArray[np.integer[Any]], NDArray[np.integer[Any]]]],
    xyz: NDArray[np.float64],
    colours: NDArray[np.floating],
) -> None:
    """Write a model in COLMAP's binary format; every camera is a rig of its own.

    Images, cameras and points have the numbers of their rows, from 1 on.

    Parameters
    ----------
    observed : of each image rows of its keypoints and of the points that they observe.
    xyz, colours : (N, 3), the latter from 0 to 255. A point that no image observes is written too.

    Raises
    ------
    OutputError : the folder cannot be written to.
    """
    pycolmap = load_pycolmap()
    model = _posed_reconstruction(images, *_cameras_of(images))
    tracks: list[list[Any]] = [[] for _ in xyz]
    for number, (rows, points) in enumerate(observed, start=1):
        for row, point in zip(rows.tolist(), points.tolist(), strict=True):
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


def extract_sift(
    image: NDArray[np.uint8],
    *,
    max_keypoints: int = 8192,
    first_octave: int = -1,
    peak_threshold: float = 0.02 / 3,
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """COLMAP's SIFT on the CPU, all else at its defaults, in its order (fine scales first).

    Parameters
    ----------
    image : uint8 (H, W, 3), RGB; made grey as COLMAP does when it reads a file.
    max_keypoints : COLMAP keeps whole scale levels, the coarsest first, up to and with the one that
        exceeds this number; so there may be half as many again.

    Returns
    -------
    keypoints : float32 (N, 4): x, y (the first pixel's centre is (0.5, 0.5)), scale in px,
        orientation in radians.
    descriptors : uint8 (N, 128): 512 times the square roots of the L1-normalised histograms.
    """
    pycolmap = load_pycolmap()
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.sift.max_num_features = max_keypoints
    options.sift.first_octave = first_octave
    options.sift.peak_threshold = peak_threshold
    bitmap = pycolmap.Bitmap.from_array(np.ascontiguousarray(image)).clone_as_grey()
    # made anew each time: one has a pyramid of its own, which two threads would share
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    found, descriptors = extractor.extract(bitmap)
    rows = [(k.x, k.y, k.compute_scale(), k.compute_orientation()) for k in found]
    keypoints = np.array(rows, dtype=np.float32).reshape(-1, 4)
    return keypoints, np.array(descriptors.data, dtype=np.uint8).reshape(-1, 128)


@dataclass(frozen=True, eq=False)
class DatabaseFeatures:
    """One image of a COLMAP database: keypoints float32 (N, 2 or 4), descriptors uint8 (N, 128)."""

    name: str
    camera: Camera
    keypoints_px: NDArray[np.float32]
    descriptors: NDArray[np.uint8]


def write_feature_database(path: Path, images: Iterable[DatabaseFeatures]) -> None:
    """Write COLMAP's database of images with SIFT features; equal cameras are one.

    Raises OutputError: ``path`` is there already, or cannot be written.
    """
    pycolmap = load_pycolmap()
    path = Path(path)
    if path.exists():
        raise OutputError(f"{path}: is there already")
    camera_ids: dict[Camera, int] = {}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        database = pycolmap.Database.open(str(path))
        with pycolmap.DatabaseTransaction(database):
            for image in images:
                if image.camera not in camera_ids:
                    camera = colmap_camera(image.camera)
                    camera_ids[image.camera] = database.write_camera(camera)
                entry = pycolmap.Image(name=image.name, camera_id=camera_ids[image.camera])
                image_id = database.write_image(entry)
                database.write_keypoints(image_id, np.ascontiguousarray(image.keypoints_px))
                kind = pycolmap.FeatureExtractorType.SIFT
                rows = pycolmap.FeatureDescriptors(kind, np.ascontiguousarray(image.descriptors))
                database.write_descriptors(image_id, rows)
        database.close()
    except (OSError, RuntimeError) as error:
        raise OutputError(f"{path}: cannot be written: {error}") from error
