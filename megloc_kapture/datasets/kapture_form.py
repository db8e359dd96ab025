"""Challenge datasets as naver's kapture distributes them: the official images in kapture folders.

kapture's downloader unpacks an archive per part, ``mapping/`` and ``query/`` (Aachen's queries by
day and at night apart, RobotCar's locations each in a folder of its own); its importers write the
same. Images keep their official names, and the queries have no poses. An adapter asks
the functions here for the parts of its dataset and makes of their images what it makes of the
official files.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.datasets.kapture_folders import MAPPING, check_image
from megloc_kapture.datasets.official import Missing
from megloc_kapture.errors import OptionError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import Camera, RigidTransform

SENSORS = "sensors/sensors.txt"
# below the root; kapture's guide to converting Aachen puts them beside the official files
_PARENTS = ("", "kapture")


@dataclass(frozen=True, slots=True)
class KaptureImage:
    """One image of a kapture folder.

    Parameters
    ----------
    name : below ``records_data``.
    file : it, or the link to it.
    sensor_id : of its camera in the folder's ``sensors.txt``.
    cam_from_world : None where the folder has no pose for it.
    """

    name: str
    file: Path
    timestamp: int
    sensor_id: str
    camera: Camera
    cam_from_world: RigidTransform | None


def kapture_parent(root: Path, part: str = MAPPING) -> Path | None:
    """The folder, ``root`` or one in it, that has ``part`` as a kapture folder; else None.

    Parameters
    ----------
    part : path of a kapture folder below it.
    """
    return next((parent for parent in parents(root) if is_kapture(parent / part)), None)


def parents(root: Path) -> tuple[Path, ...]:
    """The folders in which the parts of a dataset may lie, the root first."""
    return tuple(Path(root) / name for name in _PARENTS)


def without_model(root: Path) -> OptionError:
    """The error where a dataset's own model is asked for and kapture folders are there."""
    return OptionError(
        f"the reference model is read from the official layout, and {root} has kapture folders; "
        "in a kapture map megloc localize localizes"
    )


def is_kapture(folder: Path) -> bool:
    """True where a folder is a kapture."""
    return (folder / SENSORS).is_file()


def read_images(folder: Path, missing: Missing) -> list[KaptureImage]:
    """Read the camera images of a kapture folder in the order of their times.

    Of images at one time the order is that of their sensors' ids. An image that is not on disk
    is left out and noted in ``missing``; of each camera the first image's size is checked.

    Raises
    ------
    DataError : broken tables, an uncalibrated camera, an image of another size than its camera's.
    """
    kapture = KaptureFolder(folder)
    data = kapture.read()
    images = []
    checked: set[str] = set()
    for (timestamp, sensor_id), name in sorted(data.records_camera.items()):
        file = kapture.image_path(name)
        if not missing.require(file):
            continue
        if sensor_id not in checked:
            check_image(kapture, name)
            checked.add(sensor_id)
        pose = data.device_from_world(timestamp, sensor_id)
        camera = data.camera_of(name)
        images.append(KaptureImage(name, file, timestamp, sensor_id, camera, pose))
    return images


def image_files(images: Iterable[KaptureImage]) -> dict[str, Path]:
    """Image -> the file it is linked to."""
    return {image.name: image.file for image in images}


def input_files(folders: Iterable[Path]) -> Iterator[Path]:
    """Every file that the images of these kapture folders come from: tables and images."""
    for folder in folders:
        yield from sorted((folder / "sensors").glob("*.txt"))
        kapture = KaptureFolder(folder)
        for name in kapture.read().image_names():
            if kapture.image_path(name).exists():
                yield kapture.image_path(name)
