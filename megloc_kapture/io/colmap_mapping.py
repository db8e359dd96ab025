"""COLMAP's SIFT, structure from motion and dense stereo, through pycolmap.

The mappers are COLMAP's incremental one (Schoenberger and Frahm, CVPR 2016) and GLOMAP (Pan et al.,
ECCV 2024). A stereo workspace holds undistorted ``images/NAME``, a model with PINHOLE cameras in
``sparse/``, and maps in ``stereo/{depth_maps,normal_maps}/NAME.KIND.bin``: the text ``W&H&C&``,
then float32 channel by channel.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from megloc_kapture.errors import DataError
from megloc_kapture.io.colmap import (
    NEVER,
    MapImage,
    database_folder,
    load_pycolmap,
    numbered_cameras,
    quiet_stderr,
    write_database,
    write_model,
)
from megloc_kapture.io.files import reading, write_bytes
from megloc_kapture.io.images import write_image
from megloc_kapture.values import Camera, RigidTransform

Mapper = Literal["incremental", "global"]
_FOLDERS = {"depth": "depth_maps", "normal": "normal_maps"}
MIN_IMAGES = 3
# points that two images must share to be connected, and that a model must have: fewer may be chance
# inliers of RANSAC, and COLMAP needs as many inliers to register an image
_MIN_POINTS = 30
# a photograph was taken at a different zoom, or is a crop, if its separately estimated focal length
# differs from the median by more than _OTHER_ZOOM (difference of logarithms) and its reprojection
# error falls below _SMALLER_ERROR times that with the shared camera
_OTHER_ZOOM, _SMALLER_ERROR = 0.08, 0.95
# two images are identical if the median motion of their matches is smaller
_SAME_PX = 0.5


def extract_sift(
    image: NDArray[np.uint8],
    *,
    max_keypoints: int = 8192,
    first_octave: int = -1,
    peak_threshold: float = 0.02 / 3,
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Extract SIFT with COLMAP on the CPU from an RGB image, uint8 (H, W, 3).

    COLMAP keeps whole scale levels, coarsest first, up to the one that exceeds ``max_keypoints``.
    Return keypoints float32 (N, 4): x, y (first pixel's centre at (0.5, 0.5)), scale in px and
    orientation in radians, fine scales first; and RootSIFT descriptors uint8 (N, 128), scaled by
    512.
    """
    pycolmap = load_pycolmap()
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.sift.max_num_features = max_keypoints
    options.sift.first_octave = first_octave
    options.sift.peak_threshold = peak_threshold
    bitmap = pycolmap.Bitmap.from_array(np.ascontiguousarray(image)).clone_as_grey()
    # not cached, because threads would share the pyramid of the extractor
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    detected, descriptors = extractor.extract(bitmap)
    rows = [(k.x, k.y, k.compute_scale(), k.compute_orientation()) for k in detected]
    keypoints = np.array(rows, dtype=np.float32).reshape(-1, 4)
    return keypoints, np.array(descriptors.data, dtype=np.uint8).reshape(-1, 128)


# ----------------------------------------------------------------------------------- mappers


@dataclass(frozen=True, eq=False)
class Photograph:
    """An image without a pose; images of one sensor share an estimated camera.

    The first pixel's centre is at (0.5, 0.5). A ``doubtful`` image was assigned to its sensor by
    its size alone.
    """

    name: str
    sensor: str
    camera: Camera
    keypoints_px: NDArray[np.float32]
    doubtful: bool = False


@dataclass(frozen=True, eq=False)
class Model:
    """A connected reconstruction in its own world frame, of unknown scale.

    ``sensors`` maps images to the names in ``cameras``. Images whose camera differs from that of
    their sensor share a new camera, named after the first of these images.
    """

    cameras: dict[str, Camera]
    sensors: dict[str, str]
    poses: dict[str, RigidTransform]
    num_points: int
    error_px: float


def reconstruct(
    photographs: Sequence[Photograph],
    matches: Mapping[tuple[int, int], NDArray[np.integer[Any]]],
    mapper: Mapper = "incremental",
    *,
    known_cameras: bool = False,
    seed: int = 0,
    scratch: Path | None = None,
) -> list[Model]:
    """Estimate poses and cameras from matches; return connected models, the largest first.

    ``matches`` maps pairs (i, j) of photographs to keypoint rows (M, 2). Two images are connected
    if they share at least 30 points. Doubtful images with a different focal length get new cameras,
    and the reconstruction is repeated. COLMAP runs in one thread to be deterministic.
    """
    pycolmap = load_pycolmap()
    sensors = sorted({photograph.sensor for photograph in photographs})
    of_sensor = {photograph.sensor: photograph.camera for photograph in photographs}
    cameras = numbered_cameras(of_sensor[sensor] for sensor in sensors)
    for camera in cameras:
        camera.has_prior_focal_length = known_cameras
    images = [(p.name, sensors.index(p.sensor) + 1, p.keypoints_px) for p in photographs]
    seen: list[tuple[Any, float]] = []

    def geometry(i: int, j: int, rows: NDArray[np.uint32]) -> Any:
        points = [np.asarray(photographs[at].keypoints_px[:, :2], np.float64) for at in (i, j)]
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = seed
        first, second = (cameras[images[at][1] - 1] for at in (i, j))
        two_view = pycolmap.estimate_two_view_geometry(
            first, points[0], second, points[1], rows, options
        )
        if len(inliers := two_view.inlier_matches):
            apart = points[0][inliers[:, 0]] - points[1][inliers[:, 1]]
            seen.append((two_view.config, float(np.median(np.linalg.norm(apart, axis=1)))))
        return two_view

    sizes = [len(photograph.keypoints_px) for photograph in photographs]
    with database_folder(scratch, sizes, matches) as folder, quiet_stderr():
        database = Path(folder) / "database.db"
        write_database(database, cameras, images, matches, geometry)
        if mapper == "global" and seen and not known_cameras:
            calibration = pycolmap.ViewGraphCalibrationOptions()
            calibration.random_seed = seed
            pycolmap.calibrate_view_graph(str(database), calibration)
        (Path(folder) / "result").mkdir()
        run = pycolmap.incremental_mapping if mapper == "incremental" else pycolmap.global_mapping
        made = _options(mapper, cameras, seed, known_cameras)
        results = run(str(database), folder, str(Path(folder) / "result"), made) if seen else {}
    doubtful = {p.name for p in photographs if p.doubtful} if not known_cameras else set()
    others: dict[str, str] = {}
    for _, result in sorted(results.items()):
        others |= _other_cameras(result, doubtful)
    if others:
        again = [
            replace(p, sensor=others.get(p.name, p.sensor), doubtful=False) for p in photographs
        ]
        return reconstruct(again, matches, mapper, seed=seed, scratch=scratch)
    models = [
        model
        for _, result in sorted(results.items())
        for model in connected_models(result, sensors)
    ]
    models = [m for m in models if len(m.poses) >= MIN_IMAGES and m.num_points >= _MIN_POINTS]
    if not models:
        raise DataError(_why_none(seen))
    return sorted(models, key=lambda model: (-len(model.poses), -model.num_points))


def _options(mapper: Mapper, cameras: Sequence[Any], seed: int, known_cameras: bool) -> Any:
    pycolmap = load_pycolmap()
    if mapper == "global":
        options = pycolmap.GlobalPipelineOptions()
        inner, bundle = options.mapper, options.mapper.bundle_adjustment
        parts = [options, inner, inner.rotation_averaging, inner.global_positioning]
        parts.append(inner.retriangulation)
        options.num_threads = inner.num_threads = bundle.ceres.solver_options.num_threads = 1
        bundle.ceres.min_num_residuals_for_cpu_multi_threading = NEVER
        bundle.refine_focal_length = bundle.refine_extra_params = not known_cameras
    else:
        options = pycolmap.IncrementalPipelineOptions()
        parts = [options, options.mapper, options.triangulation]
        options.num_threads = options.mapper.num_threads = 1
        options.ba_min_num_residuals_for_cpu_multi_threading = NEVER
        options.min_model_size = MIN_IMAGES
        options.extract_colors = False
        # this fallback takes minutes if photographs of two scenes are mixed
        options.structure_less_registration_fallback = False
        if known_cameras:
            options.constant_cameras = {camera.camera_id for camera in cameras}
    for part in parts:
        part.random_seed = seed
    return options


def _other_cameras(reconstruction: Any, doubtful: Collection[str]) -> dict[str, str]:
    """Map doubtful images with a different focal length to the first image of their group.

    Poses and points absorb the error of a shared camera; bundle adjustment with a separate camera
    per image reveals it.
    """
    pycolmap = load_pycolmap()
    images = [reconstruction.images[number] for number in sorted(reconstruction.reg_image_ids())]
    sharing = Counter(image.camera_id for image in images if image.name in doubtful)
    if max(sharing.values(), default=0) < 2:
        return {}
    apart = pycolmap.Reconstruction()
    for image in images:
        camera = pycolmap.Camera(reconstruction.cameras[image.camera_id].todict())
        camera.camera_id = image.image_id
        apart.add_camera_with_trivial_rig(camera)
        keypoints = np.array([point.xy for point in image.points2D], dtype=np.float64)
        entry = pycolmap.Image(
            image_id=image.image_id,
            name=image.name,
            camera_id=image.image_id,
            keypoints=keypoints.reshape(-1, 2),
        )
        apart.add_image_with_trivial_frame(entry, image.cam_from_world())
    for _, point in sorted(reconstruction.points3D.items()):
        apart.add_point3D(point.xyz, pycolmap.Track(point.track.elements), point.color)
    before = _errors_px(apart)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    options.ceres.min_num_residuals_for_cpu_multi_threading = NEVER
    with quiet_stderr():
        pycolmap.bundle_adjustment(apart, options)
    after = _errors_px(apart)
    camera_of: dict[str, str] = {}
    for camera_id in sorted(camera_id for camera_id, number in sharing.items() if number > 1):
        members = [image for image in images if image.camera_id == camera_id]
        focal = np.array([apart.cameras[image.image_id].mean_focal_length() for image in members])
        zooms = np.log(focal / np.median(focal)).tolist()
        others = sorted(
            (zoom, image.name)
            for zoom, image in zip(zooms, members, strict=True)
            if abs(zoom) > _OTHER_ZOOM
            and image.name in doubtful
            and after[image.image_id] < _SMALLER_ERROR * before[image.image_id]
        )
        group: list[str] = []
        for (zoom, name), (next_zoom, _) in pairwise([*others, (math.inf, "")]):
            group.append(name)
            if next_zoom - zoom > _OTHER_ZOOM:
                camera_of |= dict.fromkeys(group, min(group))
                group = []
    return camera_of


def _errors_px(reconstruction: Any) -> dict[int, float]:
    reconstruction.update_point_3d_errors()
    errors: dict[int, list[float]] = {number: [] for number in reconstruction.reg_image_ids()}
    for _, point in sorted(reconstruction.points3D.items()):
        for element in point.track.elements:
            errors[element.image_id].append(point.error)
    return {number: float(np.mean(values)) if values else 0.0 for number, values in errors.items()}


def connected_models(reconstruction: Any, sensors: Sequence[str]) -> list[Model]:
    """Split a reconstruction into models whose images are connected by 30 or more shared points.

    The mappers join unrelated parts even by a few wrong matches. ``sensors`` are in the order
    of the camera ids of the pycolmap.Reconstruction.
    """
    reconstruction.update_point_3d_errors()  # the global mapper stores errors of rays, not pixels
    points = [point for _, point in sorted(reconstruction.points3D.items())]
    images = [reconstruction.images[number] for number in sorted(reconstruction.reg_image_ids())]
    if not images or not points:
        return []
    row_of = {image.image_id: row for row, image in enumerate(images)}
    tracks = [sorted({row_of[at.image_id] for at in point.track.elements}) for point in points]
    seen = csr_array(
        (
            np.ones(sum(map(len, tracks)), np.int64),
            np.concatenate([np.array(track, np.int64) for track in tracks]),
            np.cumsum([0, *map(len, tracks)]),
        ),
        shape=(len(points), len(images)),
    )
    shared = (seen.T @ seen).toarray()
    num_parts, part_of = connected_components(shared >= _MIN_POINTS, directed=False)
    models = []
    for part in range(num_parts):
        inside = part_of == part
        kept = np.flatnonzero(seen @ inside.astype(np.int64) >= 2)
        if not len(kept):
            continue
        cameras, poses, of_image = {}, {}, {}
        for image in (images[row] for row in np.flatnonzero(inside)):
            camera = reconstruction.cameras[image.camera_id]
            of_image[image.name] = sensors[image.camera_id - 1]
            cameras[of_image[image.name]] = Camera.from_colmap(camera)
            pose = image.cam_from_world()
            poses[image.name] = RigidTransform.from_matrix(
                pose.rotation.matrix(), np.asarray(pose.translation)
            )
        error_px = float(np.mean([points[row].error for row in kept]))
        models.append(Model(cameras, of_image, poses, len(kept), error_px))
    return models


def _why_none(seen: Sequence[tuple[Any, float]]) -> str:
    """Explain the failure by the two-view geometries and median motions of verified pairs."""
    if not seen:
        return "no two photographs show enough of the same things to be matched"
    if all(moved_px < _SAME_PX for _, moved_px in seen):
        return "the photographs are identical; take some from other places"
    kinds = load_pycolmap().TwoViewGeometryConfiguration
    flat = (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC)
    configs = Counter(config for config, _ in seen)
    if 2 * sum(configs[kind] for kind in flat) > len(seen):
        return (
            "the photographs were taken from one place, or show nothing but a plane: distances "
            "cannot be estimated; walk sideways between photographs"
        )
    return (
        f"{len(seen)} pairs of photographs match, but no {MIN_IMAGES} of them are connected; take "
        "more, with more overlap and from more places"
    )


# ------------------------------------------------------------------------------------------- stereo


def has_cuda() -> bool:
    """Return whether the installed pycolmap can run COLMAP's stereo."""
    return bool(load_pycolmap().has_cuda)


def write_workspace(
    root: Path,
    images: Sequence[MapImage],
    pixels: Sequence[NDArray[np.uint8]],
    observed: Sequence[tuple[NDArray[np.integer[Any]], NDArray[np.integer[Any]]]],
    xyz: NDArray[np.float64],
) -> None:
    """Write images and model of a stereo workspace (PINHOLE cameras) to the empty folder ``root``.

    The model has points, because COLMAP's fusion selects neighbours of an image by shared points.
    """
    for image, shown in zip(images, pixels, strict=True):
        path = root / "images" / image.name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, shown)
    write_model(root / "sparse", images, observed, xyz, np.zeros_like(xyz))
    for name in (*_FOLDERS.values(), "consistency_graphs"):
        (root / "stereo" / name).mkdir(parents=True)
    names = "".join(f"{image.name}\n" for image in images)
    write_bytes(root / "stereo" / "fusion.cfg", names.encode())


def run_patch_match(
    root: Path, name: str, sources: Sequence[str], depth_range_m: tuple[float, float]
) -> None:
    """Estimate the depth of one image of a workspace from its ``sources``; needs CUDA."""
    pycolmap = load_pycolmap()
    text = f"{name}\n{', '.join(sources)}\n"
    write_bytes(root / "stereo" / "patch-match.cfg", text.encode())
    options = pycolmap.PatchMatchOptions()
    # the stage checks geometric consistency later, for all estimators alike
    options.geom_consistency = False
    options.depth_min, options.depth_max = depth_range_m
    pycolmap.patch_match_stereo(str(root), options=options)


def map_path(root: Path, kind: Literal["depth", "normal"], name: str) -> Path:
    return root / "stereo" / _FOLDERS[kind] / f"{name}.photometric.bin"


def read_map(path: Path) -> NDArray[np.float32]:
    """Read depth (H, W), 0 where unknown, or normals (H, W, 3) in the camera frame."""
    with reading(path, "a map of COLMAP's stereo"):
        *sizes, values = path.read_bytes().split(b"&", 3)
        width, height, channels = (int(size) for size in sizes)
        pixels = np.frombuffer(values, "<f4").astype(np.float32).reshape(channels, height, width)
    return pixels[0] if channels == 1 else np.ascontiguousarray(pixels.transpose(1, 2, 0))
