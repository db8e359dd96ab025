"""Plain photographs and videos: their cameras are read out of EXIF or guessed."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.datasets.kapture_folders import check_image_size
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.files import check_relative, hard_link, link_file, owned_name
from megloc_kapture.io.images import (
    UNREAD_SUFFIXES,
    VIDEO_SUFFIXES,
    WRITABLE_SUFFIXES,
    extract_frames,
    read_image_rgb,
    read_photo,
    turned_upright,
    write_image,
)
from megloc_kapture.io.kapture import KaptureData, Sensor, writable_name
from megloc_kapture.pipeline.queries import Query, Unit
from megloc_kapture.values import Camera, RigidTransform

FRAMES_EVERY = 30
_ALONE = RigidTransform.identity()


@dataclass(frozen=True)
class _Image:
    path: Path
    camera: Camera
    orientation: int
    make: str
    is_frame: bool
    gps: tuple[float, float, float] | None = None


class Photographs:
    """Image files, folders of them, and videos, as the queries of a run, or to make a map of.

    Without a camera an image is turned upright by its EXIF orientation, its camera is of the turned
    image, and its focal length is EXIF's or a guess, estimated with the pose in any case. A given
    camera is of the pixels as they are stored. Images of one size, make and focal length share a
    camera.

    Parameters
    ----------
    paths : files and folders. An image is named by its path below the folder that was given, a
        file that was given by its own name, a frame by its video and number:
        ``walk.mp4/000120.jpg``. Of a folder images and videos are taken, hidden files are not.
    camera : of all images; EXIF is not looked at then.
    every : of a video, every n-th frame; 30 unless given.

    Attributes
    ----------
    names : of the images that can be read, sorted.
    unreadable : names of the others to the reason; known so far from their headers.
    faults : none: nothing brings features.

    Raises
    ------
    DataError : a file or folder is not there, there is no image, two have the same name, or kapture
        cannot hold a name.
    OptionError : ``every`` is not positive, or there is no video.
    """

    def __init__(
        self, paths: Sequence[Path | str], camera: Camera | None = None, *, every: int | None = None
    ) -> None:
        if every is not None and every < 1:
            raise OptionError(f"every {every}th frame cannot be taken; give 1 or more")
        files = _named_files([Path(path) for path in paths])
        videos = [name for name in files if Path(name).suffix.lower() in VIDEO_SUFFIXES]
        if every is not None and not videos:
            raise OptionError("--every changes nothing: there is no video among the images")
        self.unreadable: dict[str, str] = {}
        self.faults: dict[str, str] = {}
        self._images: dict[str, _Image] = {}
        self._frames: tempfile.TemporaryDirectory[str] | None = None
        for name, path in files.items():
            try:
                if name in videos:
                    self._add_video(name, path, camera, every or FRAMES_EVERY)
                else:
                    self._add(name, path, camera)
            except DataError as error:
                self.unreadable[name] = error.message
        self.names = sorted(self._images)

    def check(self) -> None:
        """Nothing more is known without reading pixels."""

    def lacking(self, local_type: str) -> str | None:
        """The first image without features of a type: none brings any."""
        return next(iter(self.names), None)

    def types_of_all(self) -> list[str]:
        """Global-feature types that all bring: none."""
        return []

    def units(self, *, rigs: bool) -> list[tuple[str, ...]]:
        """Names of the images that are localized together: each is by itself."""
        return [(name,) for name in self.names]

    def read_units(self, *, rigs: bool) -> Iterator[Unit]:
        """The queries of :meth:`units`; pixels are read when they are needed."""
        for name in self.names:
            yield ((self.query(name), _ALONE),)

    def query(self, name: str) -> Query:
        """The query of a name."""
        image = self._images[name]
        return Query(image.camera, image.path, name, orientation=image.orientation)

    def gps(self) -> dict[str, tuple[float, float, float]]:
        """Latitude, longitude and height of the images whose EXIF has them."""
        return {name: one.gps for name, one in self._images.items() if one.gps is not None}

    def files(self) -> dict[str, Path]:
        """The files of the images that can be read; of frames those that were taken out."""
        return {name: self._images[name].path for name in self.names}

    def data(self) -> KaptureData:
        """Cameras and records, the cameras as they were before the run."""
        data = KaptureData()
        sensor_ids: dict[tuple[str, Camera], str] = {}
        for timestamp, name in enumerate(self.names):
            image = self._images[name]
            key = image.make, image.camera
            sensor_id = sensor_ids.setdefault(key, f"camera{len(sensor_ids)}")
            title = image.make.replace(",", " ")
            data.sensors[sensor_id] = Sensor.from_camera(image.camera, name=title)
            data.records_camera[timestamp, sensor_id] = name
        return data

    def write_images(self, output: Path) -> None:
        """Put the images into a kapture folder: links, and copies of those that were turned."""
        for name, image in self._images.items():
            place = Path(output) / "sensors" / "records_data" / name
            place.parent.mkdir(parents=True, exist_ok=True)
            if image.is_frame:
                hard_link(image.path, place)
            elif image.orientation == 1:
                link_file(image.path, place)
            else:
                try:
                    pixels = read_image_rgb(image.path)
                except DataError:  # its row in status.csv says so
                    continue
                write_image(place, turned_upright(pixels, image.orientation))

    def _add(self, name: str, path: Path, camera: Camera | None, *, is_frame: bool = False) -> None:
        if camera is None:
            photo = read_photo(path)
            self._images[name] = _Image(
                path, photo.upright_camera, photo.orientation, photo.make, is_frame, photo.gps
            )
            return
        check_image_size(path, camera)
        self._images[name] = _Image(path, camera, 1, "", is_frame)

    def _add_video(self, name: str, path: Path, camera: Camera | None, every: int) -> None:
        if self._frames is None:
            self._frames = tempfile.TemporaryDirectory(prefix=f".{owned_name()}")
        folder = Path(self._frames.name) / name
        for frame in extract_frames(path, folder, every):
            self._add(f"{name}/{frame}", folder / frame, camera, is_frame=True)


def _named_files(paths: Sequence[Path]) -> dict[str, Path]:
    """Name to path of all files that were given, sorted by name."""
    found: dict[str, Path] = {}
    for path in paths:
        if (path / "sensors" / "sensors.txt").is_file():
            raise DataError("a kapture folder is no folder of plain images: --query", path=path)
        if path.is_dir():
            files = {str(file.relative_to(path)): file for file in _images_below(path)}
            if not files:
                raise DataError("no image or video in this folder", path=path)
        elif path.exists():
            files = {path.name: path}
        else:
            raise DataError("no such file or folder", path=path)
        for name, file in files.items():
            if name in found:
                raise DataError(
                    f"{found[name]} has the same name below the folder that was given; give the "
                    "folder that holds both",
                    path=file,
                )
            _check_name(name, file)
            found[name] = file
    return dict(sorted(found.items()))


def _images_below(folder: Path) -> Iterable[Path]:
    wanted = {*WRITABLE_SUFFIXES, *UNREAD_SUFFIXES, *VIDEO_SUFFIXES}
    for path in sorted(folder.rglob("*")):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if path.suffix.lower() in wanted and not hidden and not path.is_dir():
            yield path


def _check_name(name: str, path: Path) -> None:
    """Refuse names that kapture's tables cannot hold; raises DataError."""
    try:
        check_relative(name)
    except DataError as error:
        raise DataError(f"{error.message}; rename the file", path=path) from error
    if name != writable_name(name):
        raise DataError(
            f"kapture's tables cannot hold the name {name!r} (a comma, a space at an end, or # at "
            "its beginning); rename the file",
            path=path,
        )
