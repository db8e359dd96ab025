"""Query folders: kapture folders with optional features, and plain photographs and videos."""

from __future__ import annotations

import logging
import os
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from megloc_kapture.datasets.kapture_folders import (
    check_image_size,
    fitted_camera,
    warn_of_scaled,
    with_cameras_of_images,
)
from megloc_kapture.errors import DataError, OptionError, check_option, require
from megloc_kapture.io.files import TEMPORARY, check_relative, hard_link, link_file, link_images
from megloc_kapture.io.images import (
    UNREAD_SUFFIXES,
    VIDEO_SUFFIXES,
    WRITABLE_SUFFIXES,
    Photo,
    extract_frames,
    guessed_camera,
    image_size,
    is_image,
    read_image_rgb,
    read_photo,
    turned_upright,
    write_image,
)
from megloc_kapture.io.kapture import (
    KaptureData,
    KaptureFolder,
    Sensor,
    is_kapture,
    writable_name,
)
from megloc_kapture.io.output_folders import MARKER
from megloc_kapture.io.text_lines import find_camera
from megloc_kapture.matching.guided_pyramid import base_type
from megloc_kapture.pipeline.kapture_map import KaptureMap, MapKeypoints, plain_name
from megloc_kapture.pipeline.queries import Query
from megloc_kapture.preprocessing.frames import scaled_camera
from megloc_kapture.stages import scene
from megloc_kapture.stages.local_features import check_lengths, mask_path, warn_of_other_size
from megloc_kapture.stages.scene import depth_of
from megloc_kapture.values import Camera, LocalFeatures, RigidTransform, check_camera

_log = logging.getLogger(__name__)

FRAMES_EVERY = 30
# number of queries whose keypoints are compared with the image size
_QUERIES_COMPARED = 10
_LIST_SUFFIXES = (".txt", ".csv")
_NOTHING = np.zeros((0, 2), np.float32)
_NO_FEATURES = LocalFeatures(_NOTHING, _NOTHING[:, 0], _NOTHING)


class Queries(ABC):
    """Query images, read one at a time.

    ``unreadable`` maps the names of unusable images to the reason. ``faults`` does so for images
    with unusable features; it is filled when queries are read.
    """

    def __init__(self) -> None:
        self.names: list[str] = []
        self.unreadable: dict[str, str] = {}
        self.faults: dict[str, str] = {}

    def check(self) -> None:  # noqa: B027  # the constructor of Photographs has checked already
        """Check images and cameras; move unusable images from ``names`` to ``unreadable``."""

    def first_without_features(self, local_type: str) -> str | None:
        """Return the first image without features of a type, or None if all have them."""
        return next(iter(self.names), None)

    def shared_global_types(self) -> list[str]:
        """Return the global-feature types shared by all queries and the map."""
        return []

    def units(self, *, rigs: bool) -> list[scene.Unit]:
        """Return the units, the sets of images that are localized jointly.

        A unit lists (name, ``cam_from_rig``) of a rig's images at one timestamp, or of one image.
        """
        units = scene.query_units(self.data(), rigs=rigs)
        usable = (tuple(pair for pair in unit if pair[0] not in self.unreadable) for unit in units)
        return [unit for unit in usable if unit]

    @abstractmethod
    def query(self, name: str) -> Query:
        """Return a query by name; pixels are read lazily."""

    @abstractmethod
    def data(self) -> KaptureData:
        """Return sensors, rigs and records; the cameras keep the pixel origin of the input."""

    @abstractmethod
    def write_images(self, output: Path) -> None:
        """Write the images into a kapture folder; unchanged images are linked."""


class KaptureQueries(Queries):
    """Queries of a kapture folder, with the features in it if there are any.

    Cameras and keypoints are assumed to follow the map's conventions. The focal length of an
    uncalibrated camera comes from EXIF or a guess, and is estimated with the pose.
    """

    def __init__(self, folder: KaptureFolder, kapture_map: KaptureMap) -> None:
        super().__init__()
        self._folder, self._map = folder, kapture_map
        self.names = folder.read().image_names()
        types = set(folder.types("keypoints")).intersection(folder.types("descriptors"))
        self._local: dict[str, MapKeypoints] = {}
        for stored in kapture_map.folder.types("keypoints"):
            base = base_type(stored)
            plain = plain_name(base)
            usable = [name for name in types if plain_name(base_type(name)) == plain]
            if usable and base not in self._local:
                # a type and its guided-pyramid type can be matched with each other
                name = min(usable, key=lambda name: (name != base, name != base_type(name), name))
                of_map = kapture_map.keypoints_of(stored)
                self._local[base] = replace(of_map, folder=folder, name=name)
        self._data = folder.read() if self._local else with_cameras_of_images(folder)
        self._globals = {
            name: folder.global_features(name)
            for name in kapture_map.global_types
            if name in folder.types("global_features")
        }

    def first_without_features(self, local_type: str) -> str | None:
        local = self._local.get(base_type(local_type))
        return next((name for name in self.names if local is None or name not in local), None)

    def check(self) -> None:
        self._map.folder.check_features_apart(self._folder)
        require(self.names, "there are no query images", path=self._folder.root)
        self._check_dimensions()
        for local in self._local.values():
            self._warn_of_image_size(local)
        errors = []
        for name in self.names:
            if any(name in local for local in self._local.values()):
                continue
            try:
                if self._is_unknown(name):
                    read_photo(self._folder.image_path(name))
                else:
                    check_camera(self._data.camera_of(name))
                    check_image_size(self._folder.image_path(name), self._data.camera_of(name))
            except DataError as error:
                self.unreadable[name] = error.message
                errors.append(error)
        self.names = [name for name in self.names if name not in self.unreadable]
        if not self.names:
            raise errors[0]

    def units(self, *, rigs: bool) -> list[scene.Unit]:
        units: list[scene.Unit] = []
        for unit in super().units(rigs=rigs):
            if any(self._is_unknown(name) for name, _ in unit):  # a rig needs calibrated cameras
                units += [((name, RigidTransform.identity()),) for name, _ in unit]
            else:
                units.append(unit)
        return units

    def data(self) -> KaptureData:
        return self._data

    def _is_unknown(self, name: str) -> bool:
        return self._sensor(name).is_unknown

    def _sensor(self, name: str) -> Sensor:
        return self._data.sensors[self._data.record_of(name)[1]]

    def _camera(self, name: str) -> Camera:
        if not self._is_unknown(name):
            return self._map.to_colmap(self._data.camera_of(name))
        width, height = map(int, self._sensor(name).params[1:])
        try:
            camera = read_photo(self._folder.image_path(name)).camera
        except DataError:  # the query can be localized from its features
            return guessed_camera(width, height)
        # stored keypoints are in pixels of the sensor's image size
        differs = min(width, height) > 0 and (width, height) != (camera.width, camera.height)
        has_features = any(name in local for local in self._local.values())
        return scaled_camera(camera, width, height) if differs and has_features else camera

    def write_images(self, output: Path) -> None:
        link_images(self._folder.root, output)

    def _check_dimensions(self) -> None:
        pairs = [
            (vectors, self._map.folder.global_features(name))
            for name, vectors in self._globals.items()
        ]
        pairs += [
            (self._local[base_type(name)].stored_descriptors, self._map.folder.descriptors(name))
            for name in self._map.folder.types("descriptors")
            if base_type(name) in self._local
        ]
        for reader, other in pairs:
            require(
                reader.config.dsize == other.config.dsize,
                f"{reader.kind} of type {reader.type_name!r} have dimension {reader.config.dsize}, "
                f"but those of the map {other.config.dsize}; extract both with the same network",
                path=self._folder.root,
            )

    def _warn_of_image_size(self, local: MapKeypoints) -> None:
        spans = []
        for name in [name for name in self.names if name in local][:_QUERIES_COMPARED]:
            with suppress(DataError):  # a broken file fails only its own query
                spans.append((local.keypoints_px(name), self._sensor(name).params[1:3]))
        warn_of_other_size(spans, local.name, self._folder.root)

    def shared_global_types(self) -> list[str]:
        return [
            name
            for name, vectors in self._globals.items()
            if all(image in vectors for image in self.names)
        ]

    def query(self, name: str) -> Query:
        candidates: tuple[str, ...] | None = None
        try:
            features = {
                base: _stored_features(stored, name)
                for base, stored in self._local.items()
                if name in stored
            }
            global_features = {
                t: reader.read(name) for t, reader in self._globals.items() if name in reader
            }
        except DataError as error:
            self.faults[name] = str(error)
            # no candidates, so that the query fails; empty features, so that none are extracted
            features = dict.fromkeys(self._local, _NO_FEATURES)
            global_features, candidates = {}, ()
        return Query(
            camera=self._camera(name),
            image=self._folder.image_path(name),
            name=name,
            features=features,
            global_features=global_features,
            prior=self._priors[name] if name in self._map.tables.priors else None,
            candidates=candidates,
            mask=mask_path(self._folder, name),
            depth=partial(depth_of, self._folder, name) if self._data.records_depth else None,
        )

    @cached_property
    def _priors(self) -> dict[str, tuple[str, ...]]:
        images = self._map.images
        prior_of = {}
        for positions, permitted in self._map.tables.pools(self.names, images):
            prior = tuple(images[position] for position in permitted)
            prior_of.update(dict.fromkeys((self.names[at] for at in positions), prior))
        return prior_of


def _stored_features(stored: MapKeypoints, image: str) -> LocalFeatures:
    check_lengths(stored.stored_keypoints, stored.stored_descriptors, image)
    keypoints_px = stored.keypoints_px(image)
    scores = np.zeros(len(keypoints_px), np.float32)
    return LocalFeatures(keypoints_px, scores, stored.descriptors(image))


class Photographs(Queries):
    """Photographs and videos, as queries or as input for a map.

    Without a given camera, images are rotated upright by their EXIF orientation, and the camera
    describes the upright image. Its focal length starts from EXIF or a guess, and is always
    estimated with the pose. A given camera describes the stored pixels, and is scaled to images of
    a different size but the same aspect ratio. Photographs of the same make, model, size and focal
    length share a camera, as do the frames of a video.

    Parameters
    ----------
    paths : image and video files, and folders, which are searched recursively, also through links;
        hidden files, nested kapture folders and megloc outputs are skipped. The name of an image is
        its path below the given folder, or its file name; a frame is ``walk.mp4/000120.jpg``. A
        given kapture folder contributes its images and calibrated cameras.
    camera : camera of all images, or cameras by image name; replaces EXIF and kapture cameras.
    every : take every n-th frame of a video; 30 by default.
    """

    def __init__(
        self,
        paths: Sequence[Path | str],
        camera: Camera | Mapping[str, Camera] | None = None,
        *,
        every: int | None = None,
    ) -> None:
        super().__init__()
        if every is not None and every < 1:
            raise OptionError(f"every is {every}; give 1 or more")
        check_option(paths, "no photographs are given; name image files or folders")
        for each in camera.values() if isinstance(camera, Mapping) else (camera,):
            if each is not None:
                check_camera(each)
        check_option(
            all(isinstance(path, str | Path) for path in paths),
            "give photographs as files or folders; only localize() takes arrays, one at a time",
        )
        roots = [Path(path) for path in paths]
        files = _named_files(roots)
        self.root = roots[0] if roots[0].is_dir() else roots[0].parent
        self.without_row: list[str] = []
        self._given, self._every = camera, every or FRAMES_EVERY
        self._calibrated = {k: v for root in roots for k, v in _calibrated(root).items()}
        self._scaled: list[tuple[Camera, Camera]] = []
        self._paths: dict[str, Path] = {}
        self._photos: dict[str, Photo] = {}
        self._frames: tempfile.TemporaryDirectory[str] | None = None
        for name, path in files.items():
            try:
                if path.suffix.lower() in VIDEO_SUFFIXES:
                    self._add_video(name, path)
                else:
                    self._add(name, path)
            except DataError as error:
                self.unreadable[name] = error.message
        self.names = sorted(self._photos)
        warn_of_scaled(roots[0], self._scaled)
        if self.names and len(self.without_row) == len(self._photos) + len(self.unreadable):
            raise OptionError(
                f"the list of cameras contains none of the images, for example {self.names[0]}; "
                "the first field of each row must be the name of an image"
            )
        if self.without_row:
            shown, more = ", ".join(self.without_row[:5]), ", ..." if self.without_row[5:] else ""
            message = "%d images are not in the list of cameras; their cameras are estimated: %s%s"
            _log.warning(message, len(self.without_row), shown, more)

    def has_known_cameras(self) -> bool:
        return all(photo.camera.focal_deviation == 0 for photo in self._photos.values())

    def query(self, name: str) -> Query:
        photo, path = self._photos[name], self._paths[name]
        return Query(photo.upright_camera, path, name, orientation=photo.orientation)

    def gps(self) -> dict[str, tuple[float, float, float]]:
        return {name: photo.gps for name, photo in self._photos.items() if photo.gps is not None}

    def files(self) -> dict[str, Path]:
        return {name: self._paths[name] for name in self.names}

    def data(self) -> KaptureData:
        data = KaptureData()
        sensor_ids: dict[tuple[str, Camera], str] = {}
        for timestamp, name in enumerate(self.names):
            photo = self._photos[name]
            camera = photo.upright_camera
            # frames of a video share a camera; so do photographs of one size without EXIF
            made_by = name.rpartition("/")[0] if self._is_frame(name) else photo.make
            sensor_id = sensor_ids.setdefault((made_by, camera), f"camera{len(sensor_ids)}")
            title = made_by.replace(",", " ")
            data.sensors[sensor_id] = Sensor.from_camera(camera, name=title)
            data.records_camera[timestamp, sensor_id] = name
        return data

    def write_images(self, output: Path) -> None:
        for name, photo in self._photos.items():
            path = self._paths[name]
            target = Path(output) / "sensors" / "records_data" / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if self._is_frame(name):
                hard_link(path, target)
            elif photo.orientation == 1:
                link_file(path, target)
            else:
                try:
                    pixels = read_image_rgb(path)
                except DataError:  # the stage that reads the linked image reports the error
                    link_file(path, target)
                else:
                    write_image(target, turned_upright(pixels, photo.orientation))

    def _is_frame(self, name: str) -> bool:
        """Return whether an image is a video frame, stored in the temporary folder."""
        return self._frames is not None and self._paths[name].is_relative_to(self._frames.name)

    def _add(self, name: str, path: Path) -> None:
        given = self._given
        camera = given if isinstance(given, Camera) else self._calibrated.get(name)
        if isinstance(given, Mapping):
            camera = find_camera(given, name, path)
        if camera is None:
            if given is not None:
                self.without_row.append(name)
            self._photos[name], self._paths[name] = read_photo(path), path
            return
        fitted = fitted_camera(camera, image_size(path))
        if fitted != camera:
            self._scaled.append((camera, fitted))
        check_image_size(path, fitted)
        self._photos[name], self._paths[name] = Photo(fitted), path

    def _add_video(self, name: str, path: Path) -> None:
        if self._frames is None:
            self._frames = tempfile.TemporaryDirectory(prefix=TEMPORARY)
        folder = Path(self._frames.name) / name
        for frame in extract_frames(path, folder, self._every):
            self._add(f"{name}/{frame}", folder / frame)


def _calibrated(root: Path) -> dict[str, Camera]:
    if not is_kapture(root):
        return {}
    data, cameras = KaptureFolder(root).read(), {}
    for name in data.image_names():
        with suppress(DataError):
            cameras[name] = data.camera_of(name)
    return cameras


def _named_files(paths: Sequence[Path]) -> dict[str, Path]:
    by_name: dict[str, Path] = {}
    for path in paths:
        if is_kapture(path):
            files = _images_of_kapture(KaptureFolder(path))
        elif path.is_dir():
            files = {str(file.relative_to(path)): file for file in _images_below(path)}
            require(files, "no image or video in this folder", path=path)
        elif path.exists():
            require(
                path.suffix.lower() not in _LIST_SUFFIXES,
                "not an image; if it lists cameras, give it with --camera",
                path=path,
            )
            files = {path.name: path}
        else:
            raise DataError("no such file or folder", path=path)
        for name, file in files.items():
            if name in by_name and by_name[name].resolve() != file.resolve():
                raise DataError(
                    f"{by_name[name]} would have the same image name; give a common parent folder",
                    path=file,
                )
            _check_name(name, file)
            by_name[name] = file
    return dict(sorted(by_name.items()))


def _images_of_kapture(folder: KaptureFolder) -> dict[str, Path]:
    data = folder.read()
    require(
        not data.poses(),
        "is a kapture folder with poses: `megloc triangulate` makes a map of its images, "
        "`megloc localize --query` localizes them",
        path=folder.root,
    )
    return {name: folder.image_path(name) for name in data.image_names()}


def _images_below(folder: Path) -> list[Path]:
    paths, seen = list[Path](), set[str]()
    for place, folders, files in os.walk(folder, followlinks=True):
        here, real = Path(place), os.path.realpath(place)
        is_output = (here / MARKER).is_file() or is_kapture(here)
        if real in seen or (is_output and here != folder):  # visited already, or not photographs
            folders.clear()
            continue
        seen.add(real)
        # visit real folders first, so that links to them are the duplicates
        visible = (name for name in folders if not name.startswith("."))
        folders[:] = sorted(visible, key=lambda name: ((here / name).is_symlink(), name))
        paths += [here / name for name in files if not name.startswith(".")]
    suffixes = {*WRITABLE_SUFFIXES, *UNREAD_SUFFIXES, *VIDEO_SUFFIXES}
    return sorted(path for path in paths if path.suffix.lower() in suffixes or is_image(path))


def _check_name(name: str, path: Path) -> None:
    try:
        check_relative(name)
    except DataError as error:
        raise DataError(f"{error.message}; rename the file", path=path) from error
    require(
        name == writable_name(name),
        f"kapture's tables cannot hold the name {name!r} (a comma, a leading or trailing space, or "
        "a leading #); rename the file",
        path=path,
    )
