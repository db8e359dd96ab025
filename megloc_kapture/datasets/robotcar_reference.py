"""The reference poses of RobotCar Seasons: one merged model, or one model per location."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from megloc_kapture.datasets.grammars.colmap_model import read_colmap_model
from megloc_kapture.datasets.grammars.nvm import NvmModel, read_nvm
from megloc_kapture.datasets.grammars.robotcar_files import ImageKey, parse_image
from megloc_kapture.datasets.grammars.sparse_points import SparsePoints
from megloc_kapture.datasets.official import Missing
from megloc_kapture.datasets.robotcar_layout import CAMERAS, Layout
from megloc_kapture.errors import DataError
from megloc_kapture.values import RigidTransform

ModelChoice = Literal["auto", "merged", "individual"]


@dataclass(frozen=True, eq=False)
class Reference:
    """Reference poses.

    Parameters
    ----------
    poses : image -> ``cam_from_world``, in the models' order.
    locations : image -> its location, for the images of the individual models that are there.
    merged : whether the poses are the merged model's.
    """

    poses: Mapping[ImageKey, RigidTransform]
    locations: Mapping[ImageKey, str]
    merged: bool


def read_reference(
    layout: Layout, model: ModelChoice, wanted: Sequence[str], missing: Missing
) -> Reference:
    """Read the poses of the reference images, and which location each is of.

    Of an image in several individual models the first counts; all share one world.

    Parameters
    ----------
    wanted : locations that have queries; their individual models are missing where the poses
        have to come from them.

    Raises
    ------
    DataError : a broken model, an image name that is none, two images of one camera and time.
    """
    individual = layout.individual_models()
    merged = model == "merged" or (
        model == "auto" and (layout.merged_model.is_file() or not individual)
    )
    locations: dict[ImageKey, str] = {}
    located_poses: dict[ImageKey, RigidTransform] = {}
    for location, folder in individual.items():
        model_images = read_colmap_model(folder, with_points=False).images
        keys = _keys([image.name for image in model_images], folder)
        for key, image in zip(keys, model_images, strict=True):
            locations.setdefault(key, location)
            located_poses.setdefault(key, image.cam_from_world)
    if not merged:
        for location in wanted:
            missing.require(layout.individual_model(location))
        poses = located_poses
    else:
        poses = {}
        if missing.require(layout.merged_model):
            nvm = _merged(layout, with_points=False)
            for index, key in enumerate(_keys(nvm.names, layout.merged_model)):
                poses[key] = nvm.cam_from_world(index)
    _check_times(poses, layout.merged_model if merged else layout.individual_model("").parent)
    return Reference(poses, locations, merged)


def read_points(layout: Layout, *, merged: bool) -> tuple[list[ImageKey], SparsePoints]:
    """The images and points of the merged model, or of all individual models behind one another.

    Raises
    ------
    DataError : a broken model.
    """
    if merged:
        nvm = _merged(layout, with_points=True)
        return _keys(nvm.names, layout.merged_model), nvm.points
    places: dict[ImageKey, int] = {}
    parts = []
    for folder in layout.individual_models().values():
        model = read_colmap_model(folder)
        images = _keys([image.name for image in model.images], folder)
        for image in images:
            places.setdefault(image, len(places))
        parts.append((model.points, [places[image] for image in images]))
    return list(places), SparsePoints.joined(parts)


def _merged(layout: Layout, *, with_points: bool) -> NvmModel:
    models = read_nvm(layout.merged_model, with_points=with_points)
    if len(models) != 1:
        raise DataError(
            f"{len(models)} models, expected one of all locations", path=layout.merged_model
        )
    return models[0]


def _keys(names: Sequence[str], path: Path) -> list[ImageKey]:
    """The images of a model, in its order."""
    keys: dict[ImageKey, str] = {}
    for name in names:  # each once, of which the models' readers take care
        image = parse_image(name)
        if image is None or not image.condition or image.camera not in CAMERAS:
            known = ", ".join(CAMERAS)
            raise DataError(
                f"image {name!r}; expected condition/camera/time.png, camera one of {known}",
                path=path,
            )
        if keys.setdefault(image, name) != name:
            raise DataError(f"{name!r} and {keys[image]!r} are one image", path=path)
    return list(keys)


def _check_times(poses: Mapping[ImageKey, RigidTransform], path: Path) -> None:
    taken: dict[tuple[str, int], ImageKey] = {}
    for image in poses:
        other = taken.setdefault((image.camera, image.timestamp), image)
        if other != image:
            raise DataError(f"{image.path} and {other.path} are of one camera and time", path=path)
