"""A COLMAP model as a kapture map: cameras, rigs, poses, points, features; images are linked.

A model names all features of its images by numbers. With the database that it was made of the map
has these features, with their descriptors. Without one COLMAP's SIFT is extracted again from the
images, which finds most of what a model of SIFT was made of, and the observations move to it.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.datasets.formats.colmap_database import ColmapDatabase
from megloc_kapture.datasets.formats.colmap_model import (
    BINARY_FILES,
    TEXT_FILES,
    ColmapModel,
)
from megloc_kapture.datasets.formats.colmap_reading import (
    colmap_model_files,
    is_binary,
    read_colmap_model,
)
from megloc_kapture.datasets.formats.colmap_rigs import ColmapRigs, read_colmap_rigs, rig_files
from megloc_kapture.datasets.reference_map import write_reference_map
from megloc_kapture.errors import DataError
from megloc_kapture.io.files import link_records
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.plugins import LOCAL_FEATURES, load_plugin
from megloc_kapture.stages.given_map import given_map
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.work import HERE, Work

SPARSE, IMAGES, DATABASE = "sparse", "images", "database.db"
_SIFT = "sift"


@dataclass(frozen=True)
class ColmapFolders:
    """Where the parts of a COLMAP reconstruction are.

    Attributes
    ----------
    model : folder of the cameras, images and points.
    images : folder that the images' names are relative to; None: there is none.
    database : with the features; None: there is none.
    """

    model: Path
    images: Path | None
    database: Path | None

    def files(self) -> Iterator[Path]:
        """The files that an import reads, images apart."""
        yield from colmap_model_files(self.model)
        yield from rig_files(self.model, binary=is_binary(self.model))
        if self.database is not None:
            yield self.database


def is_colmap(path: Path) -> bool:
    """Whether a folder is a COLMAP model, or one of COLMAP's workspaces, and no kapture."""
    path = Path(path)
    return not (path / "sensors" / "sensors.txt").is_file() and bool(_models(path))


def find_colmap(
    path: Path, *, images: Path | None = None, database: Path | None = None
) -> ColmapFolders:
    """The parts of a reconstruction by the folder of its model, or the workspace around it.

    A workspace has ``sparse/0`` or ``sparse``, ``images`` and ``database.db``. The latter two are
    looked for beside the model and in the folder above, of ``sparse/0`` in the one above that.

    Parameters
    ----------
    path : folder of the model, or the workspace.
    images, database : instead of those that would be found.

    Raises
    ------
    DataError : no model, or several; no such folder of images, no such database.
    """
    models = _models(path)
    if not models:
        raise DataError(
            f"no COLMAP model: neither {BINARY_FILES[1]} nor {TEXT_FILES[1]} is here, in sparse/ "
            "or in sparse/0",
            path=path,
        )
    if len(models) > 1:
        told = ", ".join(str(model.relative_to(path)) for model in models)
        raise DataError(f"there are several models, give one of them: {told}", path=path)
    model = models[0]
    if images is not None and not images.is_dir():
        raise DataError("no such folder of images", path=images)
    if database is not None and not database.is_file():
        raise DataError("no such database", path=database)
    around = [Path(os.path.abspath(model))]
    around += around[0].parents[: 2 if around[0].parent.name == SPARSE else 1]
    found_images = (folder / IMAGES for folder in around if (folder / IMAGES).is_dir())
    found_databases = (folder / DATABASE for folder in around if (folder / DATABASE).is_file())
    return ColmapFolders(
        model, images or next(found_images, None), database or next(found_databases, None)
    )


def _models(path: Path) -> list[Path]:
    """The models of a folder: itself, else that of its ``sparse``, else those in there."""
    for places in ([path], [path / SPARSE], sorted((path / SPARSE).glob("*"))):
        found = [place for place in places if _holds_model(place)]
        if found:
            return found
    return []


def _holds_model(folder: Path) -> bool:
    # one file may be missing: then that is said
    return any(sum((folder / n).is_file() for n in ns) > 1 for ns in (BINARY_FILES, TEXT_FILES))


def import_colmap(source: ColmapFolders, output: Path, *, work: Work = HERE) -> dict[str, float]:
    """Write a COLMAP reconstruction as a kapture map; ``output`` is empty.

    Poses are those of the images; rigs of several cameras are kept beside them, and the images of a
    frame share a timestamp, the frame's id. Elsewhere the timestamp is the image's id.

    Returns
    -------
    Counts for the log; without descriptors in a database ``found_again``, the share of the
    observations whose keypoints were found again.

    Raises
    ------
    DataError : something is missing or broken, a camera model that kapture does not have, names of
        images that kapture cannot hold; or there is no database, and the model is not made of SIFT.
    """
    binary = is_binary(source.model)
    model = read_colmap_model(source.model)
    if not len(model.points):
        raise DataError("the model has no points to localize with", path=source.model)
    names = kapture_names(model, source.model)
    data = kapture_data(model, names, read_colmap_rigs(source.model, binary=binary))
    renamed = {new: old for old, new in names.items() if new != old}
    links = _links(source, names, renamed)
    database = source.database
    local_type = None
    if database is not None:
        with ColmapDatabase(database) as opened:
            found = opened.feature_type()
            local_type = None if found is None else found.name
    ordered = [names[image.name] for image in model.images]
    if local_type is not None:
        counts: dict[str, float] = dict(
            write_reference_map(
                output,
                data,
                links,
                ordered,
                model.points,
                keypoints_type=local_type,
                database=database,
                database_names=renamed,
            )
        )
        _check_descriptors(KaptureFolder(output), local_type, source)
        return counts
    if source.images is None:
        raise DataError(
            "there are no descriptors to match queries with: give the database that the model was "
            "made of (--database), or the images to extract them from (--images)",
            path=source.model,
        )
    with tempfile.TemporaryDirectory(prefix=".megloc-", dir=output) as scratch:
        reference, images, features = (Path(scratch) / n for n in ("reference", "images", "sift"))
        write_reference_map(reference, data, links, ordered, model.points, keypoints_type=_SIFT)
        # a folder of its own: the model's keypoints would come before the extracted ones
        write_sensors(images, data)
        link_records(images, links)
        mapping = KaptureFolder(images, features_dirs=[features])
        extract_local_features([mapping], load_plugin(LOCAL_FEATURES, _SIFT), features, work=work)
        try:
            counts = given_map(KaptureFolder(reference), mapping, output)
        except DataError as error:
            if error.path != reference:
                raise
            raise DataError(
                f"{error.message.replace('given map', 'model')}; give the database that it was "
                "made of (--database)",
                path=source.model,
            ) from None
    # what was linked to was the scratch folder
    (output / "sensors" / "records_data").unlink()
    link_records(output, links)
    return counts


def kapture_names(model: ColmapModel, folder: Path) -> dict[str, str]:
    """The name in kapture of each image of a model, by its name there.

    kapture separates fields by commas and blanks: a comma, a blank at either end and a # at the
    beginning become ``_``.

    Raises
    ------
    DataError : two images would have one name.
    """
    names: dict[str, str] = {}
    taken: dict[str, str] = {}
    for image in model.images:
        name = image.name.replace(",", "_")
        middle = name.strip()
        left = len(name) - len(name.lstrip())
        name = "_" * left + middle + "_" * (len(name) - left - len(middle))
        name = f"_{name[1:]}" if name.startswith("#") else name
        if name in taken:
            raise DataError(
                f"images {taken[name]!r} and {image.name!r} would both be {name!r} in kapture, "
                "which cannot hold commas in names",
                path=folder,
            )
        taken[name] = image.name
        names[image.name] = name
    return names


def kapture_data(model: ColmapModel, names: dict[str, str], rigs: ColmapRigs) -> KaptureData:
    """Sensors, rigs, records and poses of a model.

    Parameters
    ----------
    names : of the images in kapture, by those in the model.
    rigs : those of one camera say nothing, and are left out.
    """
    data = KaptureData()
    sensor_of = {camera_id: f"cam{camera_id}" for camera_id in sorted(model.cameras)}
    for camera_id, camera in model.cameras.items():
        data.sensors[sensor_of[camera_id]] = Sensor.from_camera(camera)
    records = {image.image_id: image for image in model.images}
    times = {image_id: rigs.frames.get(image_id, image_id) for image_id in records}
    shared = {(times[image_id], image.camera_id) for image_id, image in records.items()}
    if len(shared) < len(records) or not records.keys() <= rigs.frames.keys():
        times = {image_id: image_id for image_id in records}  # no moments, or several of one
    for rig_id, cams_from_rig in rigs.cams_from_rig.items():
        members = {sensor_of[k]: v for k, v in cams_from_rig.items() if k in sensor_of}
        if len(members) > 1:
            data.rigs[f"rig{rig_id}"] = members
    for image_id, image in records.items():
        record = times[image_id], sensor_of[image.camera_id]
        data.records_camera[record] = names[image.name]
        data.trajectories[record] = image.cam_from_world
    return data


def _links(
    source: ColmapFolders, names: dict[str, str], renamed: dict[str, str]
) -> dict[str, Path]:
    """Links to the images, to each where some have other names in kapture."""
    if source.images is None:
        return {}
    missing = sorted(name for name in names if not (source.images / name).is_file())
    if missing:
        raise DataError(
            f"{len(missing)} of the model's {len(names)} images are not here, the first is "
            f"{missing[0]}; --images names their folder",
            path=source.images,
        )
    if not renamed:
        return {"": source.images}
    return {new: source.images / old for old, new in names.items()}


def _check_descriptors(folder: KaptureFolder, local_type: str, source: ColmapFolders) -> None:
    descriptors = folder.descriptors(local_type)
    for image in folder.keypoints(local_type).names:
        if image not in descriptors:
            raise DataError(f"image {image!r} has no descriptors", path=source.database)
