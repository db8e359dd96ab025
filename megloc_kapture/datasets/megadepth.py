"""MegaDepth as kapture folders with depth, one per scene, for training.

The layout is that of the published archives and of D2-Net's ``megadepth_utils``::

    phoenix/S6/zl548/MegaDepth_v1/SCENE/dense0/depths/NAME.h5    depth of the undistorted images
    depth_undistorted/SCENE/NAME.h5                              the same, as in glue-factory
    Undistorted_SfM/SCENE/{images,sparse or sparse-txt}          by COLMAP's image_undistorter
    scene_info/SCENE.npz                                         paths, intrinsics, poses

Cameras and poses come from the undistorted model, else from ``scene_info``. Pickled object arrays
are not read; docs/training.md shows how to convert them to plain arrays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.colmap_model import read_colmap_model
from megloc_kapture.io.files import check_component, link_records, reading, safe_join
from megloc_kapture.io.images import image_size, write_depth_map
from megloc_kapture.io.kapture import KaptureData, Sensor, write_sensors
from megloc_kapture.preprocessing.frames import scaled_camera
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Camera, Options, RigidTransform

_DEPTHS = ("phoenix/S6/zl548/MegaDepth_v1/{}/dense0/depths", "depth_undistorted/{}")
_UNDISTORTED, _SCENE_INFO = "Undistorted_SfM", "scene_info"
_MODELS = ("sparse/0", "sparse", "sparse-txt")
_ARRAYS = ("image_paths", "intrinsics", "poses")
_IDENTITY = RigidTransform.identity()


def _texts(value: Any) -> tuple[str, ...]:
    return tuple(map(str, value if isinstance(value, list | tuple) else (value,)))


class MegaDepthOptions(Options):
    """Options for importing MegaDepth."""

    # the command line parses 5001 as a number
    scenes: Annotated[tuple[str, ...], BeforeValidator(_texts)] = Field(
        default=(), description="numbers of the scenes to import; if empty, all"
    )


# image file, depth file if any, camera and ``cam_from_world``
_Image = tuple[Path, Path | None, Camera, RigidTransform]


def import_megadepth(
    root: Path, output: Path, scenes: Sequence[str] = (), *, work: Work = HERE
) -> dict[str, int]:
    """Write scenes (default: all) as ``output/SCENE``; skip images with ordinal or no depth."""
    scenes = list(map(check_component, scenes)) or _scenes(root)
    require(
        scenes, f"found neither {_UNDISTORTED}/<scene> nor {_SCENE_INFO}/<scene>.npz", path=root
    )
    counts = {"scenes": 0, "images": 0, "without_depth": 0}
    for scene in scenes:
        images = list(_images(root, scene))
        written = _write_scene(output / scene, work.track(images, len(images), scene))
        require(written, f"scene {scene} has no image with depth", path=root)
        counts["scenes"] += 1
        counts["images"] += written
        counts["without_depth"] += len(images) - written
    return counts


def read_megadepth_depth(path: Path) -> NDArray[np.float32] | None:
    """Read a depth map (H, W), 0 where unknown; return None if it is ordinal or all unknown."""
    import h5py

    with reading(path, "an HDF5 file with 'depth'"), h5py.File(path, "r") as file:
        depth_m = np.asarray(file["depth"], np.float32)
    # ordinal depth has negative labels
    if (depth_m < 0).any():
        return None
    depth_m[~np.isfinite(depth_m)] = 0.0
    return depth_m if depth_m.any() else None


def _scenes(root: Path) -> list[str]:
    models = {path.name for path in (root / _UNDISTORTED).glob("*") if path.is_dir()}
    return sorted(models | {path.stem for path in (root / _SCENE_INFO).glob("*.npz")})


def _images(root: Path, scene: str) -> Iterator[_Image]:
    folder = root / _UNDISTORTED / scene
    model = next((folder / name for name in _MODELS if (folder / name).is_dir()), None)
    table = root / _SCENE_INFO / f"{scene}.npz"
    if model is not None:
        yield from _of_model(root, scene, model, folder / "images")
    elif table.is_file():
        yield from _of_table(root, scene, table)
    else:
        raise DataError(f"no {' or '.join(_MODELS)} in {folder}, and no {table}", path=root)


def _of_model(root: Path, scene: str, model: Path, folder: Path) -> Iterator[_Image]:
    reconstruction = read_colmap_model(model, with_points=False)
    for image in sorted(reconstruction.images, key=lambda image: image.name):
        path = safe_join(folder, image.name)
        if path.is_file():
            depth = _depth_of(root, scene, image.name)
            yield path, depth, reconstruction.cameras[image.camera_id], image.cam_from_world


def _depth_of(root: Path, scene: str, image: str) -> Path | None:
    name = str(PurePosixPath(image).with_suffix(".h5"))
    paths = (safe_join(root / folder.format(scene), name) for folder in _DEPTHS)
    return next((path for path in paths if path.is_file()), None)


def _of_table(root: Path, scene: str, table: Path) -> Iterator[_Image]:
    what = "a file of plain arrays (docs/training.md shows how to convert Python objects to these)"
    with reading(table, what), np.load(table, allow_pickle=False) as file:
        images, intrinsics, poses = (file[name] for name in _ARRAYS)
    for row in np.argsort(images):
        path = safe_join(root, str(images[row]))
        if not path.is_file():
            continue
        depth = _depth_of(root, scene, path.name)
        k = intrinsics[row]
        camera = Camera("PINHOLE", *image_size(path), (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
        pose = poses[row]
        yield path, depth, camera, RigidTransform.from_matrix(pose[:3, :3], pose[:3, 3])


def _write_scene(output: Path, images: Sequence[_Image] | Iterator[_Image]) -> int:
    data, links = KaptureData(), {}
    for number, (path, depth, camera, cam_from_world) in enumerate(images):
        depth_m = None if depth is None else read_megadepth_depth(depth)
        if depth_m is None:
            continue
        name = f"images/{path.name}"
        require(name not in links, "the scene has two images with this name", path=path)
        links[name] = path
        sensor, depth_sensor, rig = f"{number}", f"{number}_depth", f"{number}_rig"
        depth_camera = scaled_camera(camera, depth_m.shape[1], depth_m.shape[0])
        data.sensors[sensor] = Sensor.from_camera(camera)
        data.sensors[depth_sensor] = Sensor.from_camera(depth_camera, sensor_type="depth")
        data.rigs[rig] = {sensor: _IDENTITY, depth_sensor: _IDENTITY}
        data.trajectories[number, rig] = cam_from_world
        data.records_camera[number, sensor] = name
        record = f"depth/{path.stem}.depth"
        data.records_depth[number, depth_sensor] = record
        write_depth_map(output / "sensors" / "records_data" / record, depth_m)
    write_sensors(output, data)
    link_records(output, links)
    return len(links)
