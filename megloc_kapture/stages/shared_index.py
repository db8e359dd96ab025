"""Map index: parsed from kapture once and shared by workers as memory-mapped arrays."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import focal_px
from megloc_kapture.io.files import atomic_write, output_error, owned_name, write_bytes
from megloc_kapture.io.kapture import KaptureFolder, Observations
from megloc_kapture.io.kapture.points import read_point_covariances
from megloc_kapture.localization.map_index import MapIndex
from megloc_kapture.mapping.map_check import ObservedKeypoints

_ARRAYS = ("xyz", "offsets", "keypoint_ids", "point_ids", "covariances")
_SAMPLED_IMAGES = 32


def index_map(folder: KaptureFolder, local_type: str) -> MapIndex:
    """Read points, uncertainties and observations of one keypoints type.

    A type with keypoints but no triangulated point gives an empty index.
    """
    observations = folder.observations().get(local_type)
    if observations is None:
        if local_type not in folder.types("keypoints"):
            raise DataError(f"the map has no observations of type {local_type!r}", path=folder.root)
        nothing = np.zeros(0, np.int32)
        observations = Observations(local_type, (), nothing.astype(np.int64), nothing, nothing)
    points = folder.points3d()
    index = MapIndex.build(
        points[:, :3],
        observations.image_names,
        observations.image_ids,
        observations.keypoint_ids,
        observations.point_ids,
        read_point_covariances(folder.root, len(points)),
    )
    return replace(index, local_type=local_type)


def observed_keypoints(
    folder: KaptureFolder, index: MapIndex, images: Iterable[str]
) -> list[ObservedKeypoints]:
    """Read stored keypoints of posed images.

    Points lifted from a single keypoint fit it exactly and are left out if the map has others.
    """
    data, keypoints = folder.read(), folder.keypoints(index.local_type)
    poses = data.poses()
    lifted = index.seen_once
    telling = lifted if lifted[index.point_ids].all() else ~lifted
    found = []
    for image in images:
        rows, points = index.observed(image)
        told = telling[points]
        pixels = keypoints.read(image)[:, :2]
        camera, pose = data.camera_of(image), poses[image]
        found.append(ObservedKeypoints(image, camera, pose, pixels, rows[told], points[told]))
    return found


def with_noise(folder: KaptureFolder, index: MapIndex) -> MapIndex:
    """Add the median angle and distance between observations and points, from a sample of images.

    Points lifted from the one keypoint that observes them give none, as they fit exactly.
    """
    if index.seen_once[index.point_ids].all() or index.local_type not in folder.types("keypoints"):
        return index
    keypoints, poses = folder.keypoints(index.local_type), folder.read().poses()
    images = [image for image in index.row_of_image if image in keypoints and image in poses]
    sample = images[:: max(1, len(images) // _SAMPLED_IMAGES)]
    errors_rad, errors_px = [np.zeros(0)], [np.zeros(0)]
    for image in observed_keypoints(folder, index, sample):
        errors_px.append(image.errors_px(index.xyz))
        errors_rad.append(errors_px[-1] / focal_px(image.camera))
    noise_rad, noise_px = _finite_median(errors_rad), _finite_median(errors_px)
    return replace(index, noise_rad=noise_rad, noise_px=noise_px)


def _finite_median(parts: Sequence[NDArray[np.float64]]) -> float:
    values = np.concatenate(parts)
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else math.nan


def write_index(index: MapIndex, folder: Path) -> None:
    arrays = [name for name in _ARRAYS if getattr(index, name) is not None]
    for name in arrays:
        write_array(folder / f"{name}.npy", getattr(index, name))
    names = sorted(index.row_of_image, key=index.row_of_image.__getitem__)
    noise = {"noise_rad": index.noise_rad, "noise_px": index.noise_px}
    content = [arrays, names, {"local_type": index.local_type, **noise}]
    write_bytes(folder / "index.json", json.dumps(content).encode())


def open_index(folder: Path) -> MapIndex:
    try:
        names, images, others = json.loads((folder / "index.json").read_bytes())
        files = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in names}
    except (OSError, ValueError) as error:
        raise DataError(f"cannot read a map's index: {error}", path=folder) from error
    # compiled loops need plain arrays
    arrays: dict[str, Any] = {name: np.asarray(array) for name, array in files.items()}
    rows = {name: row for row, name in enumerate(images)}
    return MapIndex(row_of_image=rows, **arrays, **others)


@contextmanager
def shared_index(
    indices: Mapping[str, MapIndex], scratch: Path | None = None
) -> Iterator[dict[str, Path]]:
    """Share indices by keypoints type as temporary folders; open indices stay valid afterwards."""
    where = tempfile.gettempdir() if scratch is None else scratch
    try:
        place = tempfile.TemporaryDirectory(
            prefix=f".{owned_name()}", dir=where, ignore_cleanup_errors=True
        )
    except OSError as error:
        raise output_error(where, error) from error
    with place as name:
        folders = {}
        for number, (keypoints_type, index) in enumerate(indices.items()):
            folders[keypoints_type] = Path(name) / str(number)
            write_index(index, folders[keypoints_type])
        yield folders


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write an array as npy, atomically and reproducibly."""
    with atomic_write(path) as file:
        np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)
