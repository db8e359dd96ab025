"""Aachen Day-Night's reference models: v1.0's NVM with a list of cameras, v1.1's COLMAP model."""

from __future__ import annotations

from dataclasses import dataclass

from megloc_kapture.datasets.aachen_layout import Layout, Version
from megloc_kapture.datasets.grammars.colmap_model import read_colmap_model
from megloc_kapture.datasets.grammars.nvm import NvmModel, read_nvm
from megloc_kapture.datasets.grammars.query_list import read_query_list
from megloc_kapture.datasets.grammars.sparse_points import SparsePoints
from megloc_kapture.datasets.official import Missing
from megloc_kapture.errors import DataError
from megloc_kapture.io.images import image_size
from megloc_kapture.values import Camera, RigidTransform


@dataclass(frozen=True, slots=True)
class MapImage:
    """One image of a model.

    Parameters
    ----------
    camera_id : of the camera that took it, which may have taken others; the same in every import.
    """

    name: str
    camera_id: int
    camera: Camera
    cam_from_world: RigidTransform


@dataclass(frozen=True, slots=True)
class QueryImage:
    """A query, and its number among those of its condition, in the order of the official list."""

    name: str
    condition: str
    position: int
    camera: Camera


def read_map_images(layout: Layout, version: Version, missing: Missing) -> dict[int, MapImage]:
    """The images of a version's model that are on disk, by their positions in the model.

    ``missing`` is told of images, and of v1.0's list of cameras, that are not there.

    Raises
    ------
    DataError : a broken model or list, an image of the model without a camera.
    """
    if version == "1.1":
        return _of_colmap_model(layout, missing)
    return _of_nvm(layout, missing)


def read_points(layout: Layout, version: Version) -> tuple[tuple[str, ...], SparsePoints]:
    """Names of all images of a version's model, and its points.

    Raises
    ------
    DataError : a broken model.
    """
    if version == "1.1":
        model = read_colmap_model(layout.colmap_model)
        return tuple(image.name for image in model.images), model.points
    nvm = _only_model(layout, with_points=True)
    return nvm.names, nvm.points


def _of_colmap_model(layout: Layout, missing: Missing) -> dict[int, MapImage]:
    model = read_colmap_model(layout.colmap_model, with_points=False)
    return {
        position: MapImage(
            image.name, image.camera_id, model.cameras[image.camera_id], image.cam_from_world
        )
        for position, image in enumerate(model.images)
        if missing.require(layout.images / image.name)
    }


def _of_nvm(layout: Layout, missing: Missing) -> dict[int, MapImage]:
    """Each image has a camera of its own, with the image's position as its id."""
    nvm = _only_model(layout, with_points=False)
    listed = None
    if missing.require(layout.database_intrinsics):
        listed = read_query_list(layout.database_intrinsics)
    images = {}
    for position, name in enumerate(nvm.names):
        if listed is not None and name not in listed:
            raise DataError(
                f"no line for {name!r}, an image of {layout.nvm.name}",
                path=layout.database_intrinsics,
            )
        if not missing.require(layout.images / name):
            continue
        camera = _centred(layout, nvm, position) if listed is None else listed[name]
        images[position] = MapImage(name, position, camera, nvm.cam_from_world(position))
    return images


def _centred(layout: Layout, nvm: NvmModel, position: int) -> Camera:
    """What the NVM knows of a camera, with the image's size and the principal point in its middle.

    The published list has the same cameras, as far as is known.
    """
    name = nvm.names[position]
    width, height = image_size(layout.images / name)
    focal, k = float(nvm.focal_px[position]), float(nvm.k_colmap[position])
    try:
        return Camera("SIMPLE_RADIAL", width, height, (focal, width / 2, height / 2, k))
    except DataError as error:
        raise DataError(f"image {name!r}: {error.message}", path=layout.nvm) from None


def _only_model(layout: Layout, *, with_points: bool) -> NvmModel:
    models = read_nvm(layout.nvm, with_points=with_points)
    if len(models) != 1:
        raise DataError(f"{len(models)} models, expected one", path=layout.nvm)
    return models[0]
