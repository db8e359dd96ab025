"""A COLMAP model as a kapture map: cameras, rigs, poses, points, features; images are linked.

Keypoints and descriptors come from the model's database. Without descriptors there, SIFT is
extracted from the images, and observations are assigned to the new keypoints.
"""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

from megloc_kapture.datasets.kapture_folders import cameras_of_images, warn_of_scaled
from megloc_kapture.datasets.reference_map import UNDEFINED, ColmapDatabase, write_reference_map
from megloc_kapture.errors import DataError, require
from megloc_kapture.io.colmap_model import (
    BINARY_FILES,
    TEXT_FILES,
    ColmapModel,
    colmap_model_files,
    read_colmap_model,
)
from megloc_kapture.io.files import link_as_text, link_records, similar_name
from megloc_kapture.io.kapture import (
    KaptureData,
    KaptureFolder,
    Sensor,
    is_kapture,
    writable_name,
    write_sensors,
)
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import LOCAL_FEATURES
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.map_features import move_points
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Camera

SPARSE, IMAGES, DATABASE = "sparse", "images", "database.db"
_log = logging.getLogger(__name__)
_OTHER_DATABASE = (
    "give the database of this model with `megloc import colmap --database`, or rename this one: "
    "SIFT is then extracted from the images"
)
_MAPPED_AGAIN = "%s: %s; its images are mapped again with its poses"

_SIFT = "sift"


@dataclass(frozen=True)
class ColmapFolders:
    """The parts of a COLMAP reconstruction; ``images`` and ``database`` are None if missing."""

    model: Path
    images: Path | None
    database: Path | None

    def files(self) -> Iterator[Path]:
        yield from colmap_model_files(self.model)
        if self.database is not None:
            yield self.database


def is_colmap(path: Path) -> bool:
    """Return whether a folder is a COLMAP model or workspace and not a kapture folder."""
    path = Path(path)
    return not is_kapture(path) and bool(_models(path))


def find_colmap(
    path: Path, *, images: Path | None = None, database: Path | None = None
) -> ColmapFolders:
    """Find the parts of a reconstruction, given the folder of its model or its workspace.

    A workspace has ``sparse/0`` or ``sparse``, ``images`` and ``database.db``; ``images`` and
    ``database.db`` may also lie in or next to the model's folder. The arguments ``images`` and
    ``database`` replace the search.
    """
    require(path.is_dir(), "no such folder; give the folder of a COLMAP model", path=path)
    models = _models(path)
    if not models:
        deeper = sorted([*path.rglob(BINARY_FILES[1]), *path.rglob(TEXT_FILES[1])])
        other = f"; there is one in {deeper[0].parent}" if deeper else ""
        raise DataError(
            f"no COLMAP model: neither {BINARY_FILES[1]} nor {TEXT_FILES[1]} is here, in sparse/ "
            f"or in sparse/0{other}",
            path=path,
        )
    if len(models) > 1:
        choices = ", ".join(str(model.relative_to(path)) for model in models)
        raise DataError(f"there are several models, give one of them: {choices}", path=path)
    model = models[0]
    require(images is None or images.is_dir(), "no such folder of images", path=images)
    require(database is None or database.is_file(), "no such database", path=database)
    around = [Path(os.path.abspath(model))]
    around += around[0].parents[: 2 if around[0].parent.name == SPARSE else 1]
    if images is None:
        remarks = "".join(link_as_text(folder / IMAGES) for folder in around)
        require(not remarks, f"the folder of its images is missing{remarks}", path=path)
    found_images = (folder / IMAGES for folder in around if (folder / IMAGES).is_dir())
    found_databases = (folder / DATABASE for folder in around if (folder / DATABASE).is_file())
    return ColmapFolders(
        model, images or next(found_images, None), database or next(found_databases, None)
    )


def _models(path: Path) -> list[Path]:
    around = path if os.path.basename(os.path.abspath(path)) == SPARSE else path / SPARSE
    for places in ([path], [around], sorted(around.glob("*"))):
        folders = [place for place in places if _holds_model(place)]
        if folders:
            return folders
    return []


def _holds_model(folder: Path) -> bool:
    # two of the three files suffice here; a missing file is reported later
    return any(sum((folder / n).is_file() for n in ns) > 1 for ns in (BINARY_FILES, TEXT_FILES))


@dataclass(frozen=True, eq=False)
class ColmapReconstruction:
    """A COLMAP reconstruction and its kapture data.

    Attributes
    ----------
    data : sensors, rigs, records and poses. Timestamps are frame ids, or image ids if the model
        has no frames or a frame has two images of a camera.
    names : name in the model -> name in kapture.
    scales : name in kapture -> (x, y) scale, for images whose size differs from the model's.
    """

    source: ColmapFolders
    model: ColmapModel
    data: KaptureData
    names: dict[str, str]
    scales: dict[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def read(cls, source: ColmapFolders) -> ColmapReconstruction:
        model = read_colmap_model(source.model)
        names = kapture_names(model, source.model)
        if source.images is not None:
            missing = sorted(name for name in names if not (source.images / name).is_file())
            if missing:
                message = (
                    f"{len(missing)} of the model's {len(names)} images are not here, the first "
                    f"is {missing[0]}"
                )
                remark = similar_name(source.images / missing[0])
                # often in a subfolder, or converted to another format
                alike = next(source.images.rglob(f"{PurePosixPath(missing[0]).stem}.*"), None)
                if not remark and alike is not None:
                    remark = f" (but {alike.relative_to(source.images)} is)"
                message += remark
                if source.database is None:
                    raise DataError(
                        f"{message}; give their folder with `megloc import colmap --images`",
                        path=source.images,
                    )
                # with a database, images are not needed for features
                _log.warning("%s: %s", source.images, message)
        scaled = _scaled_cameras(source, model)
        scales = {
            names[image.name]: (new.width / old.width, new.height / old.height)
            for image in model.images
            if (new := scaled.get(image.camera_id)) and (old := model.cameras[image.camera_id])
        }
        as_images = replace(model, cameras={**model.cameras, **scaled})
        return cls(source, model, kapture_data(as_images, names), names, scales)

    @property
    def renamed(self) -> dict[str, str]:
        """Return name in kapture -> name in the model, for names that differ."""
        return {new: old for old, new in self.names.items() if new != old}

    def write_images(self, output: Path) -> None:
        write_sensors(output, self.data)
        self.link_images(output)

    def link_images(self, output: Path) -> None:
        """Replace the image links of a kapture folder."""
        link = output / "sensors" / "records_data"
        if link.is_symlink():
            link.unlink()
        link_records(output, self._links())

    def write_map(self, output: Path, *, work: Work = HERE) -> dict[str, float] | None:
        """Write the map into the empty folder ``output`` and return counts for the log.

        Without descriptors in a database, the count ``share_found_again`` is the fraction of
        observations with a newly extracted keypoint. Return None, with a warning, if the model has
        no points or its keypoints are not found again.
        """
        source = self.source
        local_type = None
        if source.database is not None:
            with ColmapDatabase(source.database) as opened:
                feature_type = opened.feature_type()
                local_type = None if feature_type is None else feature_type[0]
        if not len(self.model.points.image_ids):
            what = "points without tracks" if len(self.model.points) else "no points"
            hint = "to triangulate new ones, give its images with `megloc import colmap --images`"
            require(source.images, f"the model has {what}; {hint}", path=source.model)
            _log.warning(_MAPPED_AGAIN, source.model, f"the model has {what}")
            return None
        if local_type is None and source.images is None:
            _log.warning(
                "%s has no descriptors or images: it can be viewed and exported; to localize in "
                "it, `megloc import colmap` needs its database (--database) or images (--images)",
                source.model,
            )
            return self._write_reference(output, keypoints_type=UNDEFINED)
        if local_type is None:
            return self._write_with_sift(output, work)
        try:
            counts = self._write_reference(
                output,
                keypoints_type=local_type,
                database=source.database,
                database_names=self.renamed,
            )
            folder = KaptureFolder(output)
            descriptors = folder.descriptors(local_type)
            for image in folder.keypoints(local_type).names:
                require(
                    image in descriptors,
                    f"image {image!r} has no descriptors",
                    path=source.database,
                )
        except DataError as error:
            if error.path != source.database:
                raise
            raise DataError(f"{error.message}; {_OTHER_DATABASE}", path=error.path) from error
        return counts

    def _write_with_sift(self, output: Path, work: Work) -> dict[str, float] | None:
        with tempfile.TemporaryDirectory(prefix=".megloc-", dir=output) as scratch:
            reference, images, sift = (Path(scratch) / n for n in ("reference", "images", _SIFT))
            self._write_reference(reference, keypoints_type=_SIFT)
            # a separate folder: in the reference, the model's keypoints would take precedence
            self.write_images(images)
            mapping = KaptureFolder(images, features_dirs=[sift])
            extractor = load_plugin(LOCAL_FEATURES, _SIFT)
            with naming_lasting_files(output, self.source.model):
                extract_local_features([mapping], extractor, sift, work=work)
            try:
                counts = move_points(KaptureFolder(reference), mapping, _SIFT, output)
            except DataError as error:
                if error.path != reference:
                    raise
                _log.warning(_MAPPED_AGAIN, self.source.model, error.message)
                return None
        self.link_images(output)  # the links point to the scratch folder, which is gone
        return counts

    def _write_reference(self, output: Path, **features: Any) -> dict[str, float]:
        ordered = [self.names[image.name] for image in self.model.images]
        points = self.model.points
        return dict(
            write_reference_map(
                output, self.data, self._links(), ordered, points, scales=self.scales, **features
            )
        )

    def _links(self) -> dict[str, Path]:
        images = self.source.images
        if images is None:
            return {}
        if not self.renamed:
            return {"": images}
        return {new: images / old for old, new in self.names.items()}


@contextmanager
def naming_lasting_files(temporary: Path, model: Path) -> Iterator[None]:
    """In errors about a temporary file, name the file that it links to, or else the model."""
    try:
        yield
    except DataError as error:
        file = Path(error.path or temporary).resolve()
        lasts = not file.is_relative_to(temporary.resolve())
        raise DataError(error.message, path=file if lasts else model) from error


def _scaled_cameras(source: ColmapFolders, model: ColmapModel) -> dict[int, Camera]:
    if source.images is None:
        return {}
    files = ((image.camera_id, source.images / image.name) for image in model.images)
    scaled, errors = cameras_of_images(model.cameras, files)
    if errors:
        raise DataError(
            f"{errors[0].message}; give the folder of the model's original images with `megloc "
            "import colmap --images`",
            path=errors[0].path,
        )
    warn_of_scaled(source.images, [(model.cameras[key], new) for key, new in scaled.items()])
    return scaled


def kapture_names(model: ColmapModel, folder: Path) -> dict[str, str]:
    """Return name in the model -> name in kapture; reserved characters become ``_``."""
    names: dict[str, str] = {}
    taken: dict[str, str] = {}
    for image in model.images:
        name = writable_name(image.name)
        if name in taken:
            raise DataError(
                f"images {taken[name]!r} and {image.name!r} would both be {name!r} in kapture, "
                "whose names cannot have commas, outer spaces or a leading #",
                path=folder,
            )
        taken[name] = image.name
        names[image.name] = name
    return names


def kapture_data(model: ColmapModel, names: dict[str, str]) -> KaptureData:
    """Return sensors, multi-camera rigs, records and poses; ``names`` maps to kapture names."""
    data = KaptureData()
    sensor_of = {camera_id: f"cam{camera_id}" for camera_id in sorted(model.cameras)}
    for camera_id, camera in model.cameras.items():
        data.sensors[sensor_of[camera_id]] = Sensor.from_camera(camera)
    records = {image.image_id: image for image in model.images}
    times = {image_id: model.frames.get(image_id, image_id) for image_id in records}
    shared = {(times[image_id], image.camera_id) for image_id, image in records.items()}
    if len(shared) < len(records):
        times = {image_id: image_id for image_id in records}  # two images of a camera per frame
    for rig_id, cams_from_rig in model.cams_from_rig.items():
        members = {sensor_of[k]: v for k, v in cams_from_rig.items() if k in sensor_of}
        if len(members) > 1:
            data.rigs[f"rig{rig_id}"] = members
    for image_id, image in records.items():
        record = times[image_id], sensor_of[image.camera_id]
        data.records_camera[record] = names[image.name]
        data.trajectories[record] = image.cam_from_world
    return data
