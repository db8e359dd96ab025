"""A pair of kapture folders as a dataset: mapping/, query/, optional query_gt/ and megloc/."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.dataset_tables import (
    SIDE_TABLES,
    ImageGroup,
    Protocol,
    SideTables,
    read_nowhere,
    read_side_tables,
    write_nowhere,
    write_side_tables,
)
from megloc_kapture.io.files import check_relative, link_images
from megloc_kapture.io.images import image_size
from megloc_kapture.io.kapture import (
    KaptureData,
    KaptureFolder,
    Sensor,
    is_kapture,
    write_sensors,
)
from megloc_kapture.io.output_folders import files_below
from megloc_kapture.preprocessing.frames import scaled_camera
from megloc_kapture.stages.paths import MAPPING, QUERY, QUERY_GT
from megloc_kapture.values import Camera, RigidTransform

_log = logging.getLogger(__name__)
Key = TypeVar("Key")

_NO_POSE = (
    "no image has a pose: sensors/trajectories.txt is missing, or its timestamps or sensors are "
    "not those of records_camera.txt"
)


def check_root(root: Path) -> Path:
    """Check that ``root`` has kapture folders mapping/ and query/, and return it."""
    root = Path(root)
    require(root.is_dir(), "no such folder", path=root)
    for part in (MAPPING, QUERY):
        require(
            is_kapture(root / part),
            f"{part}/sensors/sensors.txt is missing; a dataset of kapture folders has mapping/ and "
            "query/, and query_gt/ if true poses are known",
            path=root,
        )
    return root


def input_files(root: Path) -> Iterator[Path]:
    """Yield every file that an import of kapture folders depends on."""
    parts = [root / part / "sensors" for part in (MAPPING, QUERY)]
    yield from files_below(*parts, root / QUERY_GT, root / SIDE_TABLES)


def tell_of_truth_without_query(folder: Path, images: Sequence[str]) -> None:
    """Warn about true poses of unknown queries: the image names may be wrong."""
    message = "%s: true poses of %d images that are not queries are left out, the first is %s"
    _log.warning(message, folder, len(images), images[0])


def checked_folders(
    root: Path, query_prefix: str = ""
) -> tuple[KaptureFolder, KaptureData, KaptureFolder, KaptureData]:
    """Return the checked folders of map and queries, with cameras scaled to the image sizes."""
    root = check_root(root)
    mapping, query = KaptureFolder(root / MAPPING), KaptureFolder(root / QUERY)
    map_data, query_data = with_cameras_of_images(mapping), with_cameras_of_images(query)
    check_images(mapping, map_data)
    _map_poses(mapping)
    require(query_data.records_camera, "there are no query images", path=query.root)
    photographs = query.root / "sensors" / "records_data"
    require(photographs.is_dir(), "no such folder; it must contain the images", path=photographs)
    renamed = map(prefixed(query_prefix), query_data.image_names())
    shared = sorted(set(map_data.image_names()) & set(renamed))
    if shared:
        raise DataError(
            f"{len(shared)} images have the same name in map and query, the first is "
            f"{shared[0]}; give the queries a separate folder with --query-prefix",
            path=root,
        )
    if is_kapture(root / QUERY_GT):
        _check_truth(root / QUERY_GT, query_data.image_names())
    return mapping, map_data, query, query_data


def _check_truth(folder: Path, queries: Sequence[str]) -> None:
    true_poses = KaptureFolder(folder).read().poses()
    require(true_poses, f"{_NO_POSE}; delete the folder if true poses are unknown", path=folder)
    require(
        not true_poses.keys().isdisjoint(queries),
        f"none of its {len(true_poses)} images with poses (such as {min(true_poses)!r}) is a query "
        f"(such as {queries[0]!r})",
        path=folder,
    )


def import_kapture_folders(root: Path, output: Path, *, query_prefix: str = "") -> dict[str, float]:
    """Check the folders of ``root``, rewrite them below ``output``, and link the images.

    ``query_prefix`` is prepended to all query names, so that map and queries share no names.
    """
    mapping, map_data, query, query_data = checked_folders(root, query_prefix)
    rename = prefixed(query_prefix)
    write_sensors(output / MAPPING, map_data)
    link_images(mapping.root, output / MAPPING)
    # written without poses, which the stages must not see
    write_sensors(output / QUERY, replace(_renamed(query_data, rename), trajectories={}))
    link_images(query.root, output / QUERY, below=query_prefix)
    truth = 0
    if is_kapture(root / QUERY_GT):
        truth_data = KaptureFolder(root / QUERY_GT).read()
        queries = set(query_data.image_names())
        strange = sorted(truth_data.poses().keys() - queries)
        truth = len(truth_data.poses()) - len(strange)
        if strange:
            tell_of_truth_without_query(root / QUERY_GT, strange)
        records = {key: name for key, name in truth_data.records_camera.items() if name in queries}
        of_queries = replace(truth_data, records_camera=records, records_depth={})
        write_sensors(output / QUERY_GT, _renamed(of_queries, rename))
        if nowhere := [rename(name) for name in read_nowhere(root / QUERY_GT)]:
            write_nowhere(output / QUERY_GT, nowhere)
    elif query_data.trajectories:
        _log.warning("%s: its poses are ignored; true poses belong in query_gt/", query.root)
    tables = _renamed_tables(read_side_tables(root / SIDE_TABLES), rename, map_data, query_data)
    write_side_tables(output / SIDE_TABLES, tables)
    return {
        "map_images": len(map_data.image_names()),
        "map_images_with_pose": len(map_data.poses()),
        "queries": len(query_data.image_names()),
        "queries_with_truth": truth,
    }


def import_mapping(mapping: KaptureFolder, output: Path) -> dict[str, float]:
    """Import a mapping folder without queries; see :func:`import_kapture_folders`."""
    poses, data = _map_poses(mapping), with_cameras_of_images(mapping)
    check_images(mapping, data)
    write_sensors(output / MAPPING, data)
    link_images(mapping.root, output / MAPPING)
    names = set(data.image_names())
    all_groups = read_side_tables(_tables_beside(mapping)).groups
    groups = {name: group for name, group in all_groups.items() if name in names}
    write_side_tables(output / SIDE_TABLES, SideTables(protocol=Protocol(), groups=groups))
    return {"map_images": len(names), "map_images_with_pose": len(poses)}


def mapping_files(mapping: KaptureFolder) -> Iterator[Path]:
    yield from files_below(mapping.root / "sensors", _tables_beside(mapping))


def _tables_beside(mapping: KaptureFolder) -> Path:
    return mapping.root.resolve().parent / SIDE_TABLES


def _map_poses(mapping: KaptureFolder) -> dict[str, RigidTransform]:
    poses = mapping.read().poses()
    require(poses, _NO_POSE, path=mapping.root)
    return poses


def check_images(folder: KaptureFolder, data: KaptureData) -> None:
    for image in data.image_names():
        check_image_size(folder.image_path(image), data.camera_of(image))


def check_image_size(path: Path, camera: Camera) -> None:
    """Raise DataError if an image is unreadable or its size differs from its camera's."""
    size = image_size(path)
    if size != (camera.width, camera.height):
        raise _other_size(path, size, camera)


def _other_size(path: Path, size: tuple[int, int], camera: Camera) -> DataError:
    turned = size == (camera.height, camera.width)
    hint = "; cameras describe the pixels as stored, before EXIF rotates them" if turned else ""
    return DataError(
        f"the image is {size[0]}x{size[1]}, its camera says {camera.width}x{camera.height}{hint}",
        path=path,
    )


def cameras_of_images(
    cameras: Mapping[Key, Camera], images: Iterable[tuple[Key, Path]]
) -> tuple[dict[Key, Camera], list[DataError]]:
    """Compare cameras with the image sizes in the files' headers; unreadable files are skipped.

    Return the scaled cameras and the errors. A camera is scaled if exactly one of the sizes of its
    images has its aspect ratio, up to rounding. Every image of a different size gives an error.
    """
    of_camera: dict[Key, dict[tuple[int, int], list[Path]]] = {}
    for key, path in images:
        with suppress(DataError):
            of_camera.setdefault(key, {}).setdefault(image_size(path), []).append(path)
    scaled, errors = {}, []
    for key, sizes in of_camera.items():
        camera = cameras[key]
        fitting = [size for size in sizes if is_scaled(camera, size)]
        if len(fitting) == 1 and fitting[0] != (camera.width, camera.height):
            scaled[key] = camera = scaled_camera(camera, *fitting[0])
        errors += [
            _other_size(path, size, camera)
            for size, paths in sizes.items()
            if size != (camera.width, camera.height)
            for path in paths
        ]
    return scaled, errors


def is_scaled(camera: Camera, size: tuple[int, int]) -> bool:
    """Return whether an image has the camera's aspect ratio, up to rounding of its size."""
    width, height = size
    difference = abs(width * camera.height - height * camera.width)
    return difference <= max(width, height, camera.width, camera.height)


def fitted_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """Scale a camera to an image of a different size, if it has the same aspect ratio."""
    is_other = size != (camera.width, camera.height)
    return scaled_camera(camera, *size) if is_other and is_scaled(camera, size) else camera


def cameras_of_folder(folder: KaptureFolder) -> tuple[dict[str, Camera], list[DataError]]:
    data = folder.read()
    taken = {sensor_id for _, sensor_id in data.records_camera}
    known = {
        sensor_id: data.sensors[sensor_id].camera()
        for sensor_id in taken
        if not data.sensors[sensor_id].is_unknown
    }
    images = (
        (sensor_id, folder.image_path(name))
        for (_, sensor_id), name in data.records_camera.items()
        if sensor_id in known
    )
    return cameras_of_images(known, images)


def with_cameras_of_images(folder: KaptureFolder) -> KaptureData:
    """Read a folder and scale its cameras to its images, with a warning."""
    data, (scaled, _) = folder.read(), cameras_of_folder(folder)
    warn_of_scaled(
        folder.root, [(data.sensors[key].camera(), scale) for key, scale in scaled.items()]
    )
    sensors = {
        key: Sensor.from_camera(camera, name=data.sensors[key].name)
        for key, camera in scaled.items()
    }
    return replace(data, sensors={**data.sensors, **sensors})


def warn_of_scaled(place: Path, cameras: Sequence[tuple[Camera, Camera]]) -> None:
    if cameras:
        stored, scaled = cameras[0]
        message = "%s: %d cameras are scaled to their images, the first from %dx%d to %dx%d"
        sizes = (stored.width, stored.height, scaled.width, scaled.height)
        _log.warning(message, place, len(cameras), *sizes)


def prefixed(prefix: str) -> Callable[[str], str]:
    """Return a function that prepends a folder to image names; ``""`` leaves them unchanged."""
    if not prefix:
        return lambda name: name
    folder = check_relative(prefix.rstrip("/"))
    return lambda name: f"{folder}/{name}"


def _renamed(data: KaptureData, rename: Callable[[str], str]) -> KaptureData:
    return replace(
        data,
        records_camera={key: rename(name) for key, name in data.records_camera.items()},
        records_depth={key: rename(name) for key, name in data.records_depth.items()},
    )


def _renamed_tables(
    tables: SideTables, rename: Callable[[str], str], map_data: KaptureData, query_data: KaptureData
) -> SideTables:
    of_map, of_query = set(map_data.image_names()), set(query_data.image_names())
    groups: dict[str, ImageGroup] = {}
    for name, group in tables.groups.items():
        if name in of_query:
            groups[rename(name)] = group
        # if map and queries share an image name, both get its group
        if name in of_map or name not in of_query:
            groups[name] = group
    return replace(
        tables,
        groups=groups,
        priors={rename(query): permitted for query, permitted in tables.priors.items()},
        names={rename(query): name for query, name in tables.names.items()},
        relocalization=[replace(pair, query=rename(pair.query)) for pair in tables.relocalization],
    )
