"""4Seasons' recordings on disk, and the challenges' relocalization files between them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.datasets.grammars.fourseasons_calibration import (
    CAMERA_FILES,
    STEREO_FILE,
    StereoCalibration,
    read_calibration,
)
from megloc_kapture.datasets.grammars.fourseasons_lines import timestamp_of_name
from megloc_kapture.datasets.grammars.fourseasons_relocalization import (
    RelocalizationRow,
    parse_relocalization_name,
    read_relocalization,
)
from megloc_kapture.datasets.kapture_form import is_kapture
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture_store import KaptureFolder

CAMERAS = ("cam0", "cam1")
CALIBRATION_FOLDERS = ("calibration", "Calibration")
GNSS_POSES, POSES, ACCURACY = "GNSSPoses.txt", "poses.txt", "keyframe_accuracy.txt"
TRANSFORMATIONS, TIMES, KEYFRAMES = "Transformations.txt", "times.txt", "KeyFrameData"

_IMAGES = "undistorted_images"
_KAPTURE_RECORDS = "records"
_MARKS = (_IMAGES, GNSS_POSES, POSES, TIMES)
_RELOCALIZATION_PLACES = ("", "RelocalizationFiles*", "*", "*/RelocalizationFiles*")


@dataclass(frozen=True)
class Recording:
    """One drive.

    Parameters
    ----------
    name : of its folder, which is also what relocalization files call it.
    folder : where its files lie; of a kapture folder its ``records_data``.
    kapture : has cameras and poses, where the recording was converted by kapture's importer.
    """

    name: str
    folder: Path
    kapture: KaptureFolder | None = None

    @property
    def has_poses(self) -> bool:
        """Whether poses of its keyframes are published and here.

        Raises
        ------
        DataError : a broken kapture folder.
        """
        if self.kapture is not None:
            return bool(self.kapture.read().trajectories)
        return (self.folder / GNSS_POSES).is_file() or (self.folder / POSES).is_file()

    def image(self, timestamp: int, camera: str) -> str:
        """Name of an image below the dataset's root."""
        return f"{self.name}/{_IMAGES}/{camera}/{timestamp}.png"

    def file_of(self, image: str) -> Path:
        """Where an image of this recording lies, by its name."""
        return self.folder / image.removeprefix(f"{self.name}/")

    def image_file(self, timestamp: int, camera: str) -> Path:
        """Where an image lies, if it is there."""
        return self.folder / _IMAGES / camera / f"{timestamp}.png"

    def keyframe_file(self, timestamp: int) -> Path:
        """Where a keyframe's point cloud lies, if it is there."""
        return self.folder / KEYFRAMES / f"KeyFrame_{timestamp}.txt"

    def times_on_disk(self, camera: str) -> list[int]:
        """Timestamps (ns) of a camera's undistorted images, sorted.

        Raises
        ------
        DataError : the folder cannot be read.
        """
        folder = self.folder / _IMAGES / camera
        try:
            names = os.listdir(folder) if folder.is_dir() else []
        except OSError as error:
            raise DataError(f"cannot read: {error.strerror}", path=folder) from error
        times = (timestamp_of_name(n.removesuffix(".png")) for n in names if n.endswith(".png"))
        return sorted(time for time in times if time is not None)

    def calibration(self, root: Path) -> StereoCalibration:
        """The cameras of its undistorted images.

        Raises
        ------
        DataError : broken, or there is none; names the file.
        """
        if self.kapture is None:
            return read_calibration(self.calibration_folder(root))
        data = self.kapture.read()
        path = self.kapture.root / "sensors"
        try:
            cam0, cam1 = (data.sensors[name].camera() for name in CAMERAS)
            car = next(members for members in data.rigs.values() if set(CAMERAS) <= set(members))
        except (KeyError, StopIteration):
            raise DataError(
                f"no cameras {' and '.join(CAMERAS)} on one rig, as kapture's importer of "
                "4Seasons writes them",
                path=path,
            ) from None
        except DataError as error:
            raise DataError(error.message, path=path) from error
        return StereoCalibration(cam0, cam1, car[CAMERAS[1]] @ car[CAMERAS[0]].inverse())

    def calibration_files(self, root: Path) -> list[Path]:
        """The files of :meth:`calibration`; raises what it raises where there are none."""
        if self.kapture is not None:
            return sorted((self.kapture.root / "sensors").glob("*.txt"))
        folder = self.calibration_folder(root)
        return [folder / name for name in (*CAMERA_FILES, STEREO_FILE)]

    def calibration_folder(self, root: Path) -> Path:
        """The folder of a calibration: its own, or the dataset's.

        Raises
        ------
        DataError : there is none.
        """
        for place in (self.folder, root):
            for name in CALIBRATION_FOLDERS:
                if (place / name).is_dir():
                    return place / name
        raise DataError(
            f"no folder {' or '.join(CALIBRATION_FOLDERS)} here or in {self.name}; it is a "
            "download of its own (calibration.zip)",
            path=root,
        )


@dataclass(frozen=True)
class RelocalizationFile:
    """A list of pairs that a challenge asks for.

    Parameters
    ----------
    path : of the file.
    source, target : recordings, of the map and of the queries.
    """

    path: Path
    source: str
    target: str

    @property
    def name(self) -> str:
        """Its name, and that of the file to hand in."""
        return self.path.name

    def rows(self) -> list[RelocalizationRow]:
        """Its pairs; raises DataError that names file and line."""
        return read_relocalization(self.path)


def find_recordings(root: Path) -> dict[str, Recording]:
    """The recordings below a dataset's root by name, sorted.

    Raises
    ------
    DataError : the root cannot be read, or has no recording.
    """
    found = {
        folder.name: Recording(folder.name, folder)
        for folder in _folders(root)
        if any((folder / mark).exists() for mark in _MARKS)
    } or _kapture_recordings(root)
    if not found:
        raise DataError(
            f"no recording here, a folder with {_IMAGES}/ and {GNSS_POSES} or {TIMES} in it",
            path=root,
        )
    return found


def _kapture_recordings(root: Path) -> dict[str, Recording]:
    """The recordings that kapture's importer has converted, below ``records/`` or the root."""
    records = root / _KAPTURE_RECORDS
    found = {}
    for folder in _folders(records if records.is_dir() else root):
        images = folder / "sensors" / "records_data"
        if is_kapture(folder) and (images / _IMAGES).is_dir():
            found[folder.name] = Recording(folder.name, images, KaptureFolder(folder))
    return found


def _folders(root: Path) -> list[Path]:
    if not root.is_dir():
        raise DataError("no such folder", path=root)
    try:
        return sorted(path for path in root.iterdir() if path.is_dir())
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror}", path=root) from error


def find_relocalization_files(root: Path, recordings: Iterable[str]) -> list[RelocalizationFile]:
    """The relocalization files below a dataset's root, sorted by source and name.

    A file whose name leaves out its source must lie in the source's folder.

    Raises
    ------
    DataError : two of them have one name, and so would the files to hand in.
    """
    known = set(recordings)
    found: dict[str, RelocalizationFile] = {}
    for place in _RELOCALIZATION_PLACES:
        for path in sorted(root.glob(f"{place}/reloc*.txt" if place else "reloc*.txt")):
            named = parse_relocalization_name(path.name)
            if named is None or not path.is_file():
                continue
            source, target = named
            owner = path.relative_to(root).parts[0]
            if source is None and owner in known:
                source = owner
            if source is None:
                raise DataError(
                    "the file's name does not say whose map it means; it belongs into the folder "
                    "of the reference recording",
                    path=path,
                )
            if path.name in found:
                raise DataError(f"the same name as {found[path.name].path}", path=path)
            found[path.name] = RelocalizationFile(path, source, target)
    return sorted(found.values(), key=lambda file: (file.source, file.name))
