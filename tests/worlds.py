"""Small kapture data that tests of several folders build upon."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from megloc_kapture.io.kapture import KaptureData, Sensor
from megloc_kapture.values import Camera, RigidTransform

SMALL_CAMERA = Camera("SIMPLE_PINHOLE", 8, 6, (10.0, 4.0, 3.0))


def one_camera(
    names: Sequence[str],
    poses: Mapping[str, RigidTransform] | RigidTransform | None = None,
    *,
    camera: Camera = SMALL_CAMERA,
) -> KaptureData:
    """Return records of the sensor ``cam``, an image per timestamp from 0 on.

    ``poses`` are those of some images by name, or a single pose for all images.
    """
    data = KaptureData(sensors={"cam": Sensor.from_camera(camera)})
    if isinstance(poses, RigidTransform):
        poses = dict.fromkeys(names, poses)
    for timestamp, name in enumerate(names):
        data.records_camera[timestamp, "cam"] = name
        if poses is not None and name in poses:
            data.trajectories[timestamp, "cam"] = poses[name]
    return data


def folder_bytes(folder: Path) -> dict[str, bytes]:
    """Return the content of files and the targets of links below a folder, by relative path."""
    return {
        str(path.relative_to(folder)): bytes(path.readlink())
        if path.is_symlink()
        else path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_symlink() or path.is_file()
    }
