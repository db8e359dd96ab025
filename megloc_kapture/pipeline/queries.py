"""Queries of the localizer: an image, or features that somebody else extracted."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture_store import KaptureFolder
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.stages.local_features import read_image_of
from megloc_kapture.values import Camera, LocalFeatures


@dataclass(frozen=True, eq=False)
class Query:
    """One image to localize.

    Parameters
    ----------
    camera : in COLMAP's convention.
    image : uint8 (H, W, 3) RGB or the path of an image file; may be absent where the features
        are given.
    name : what to call it.
    features : local features of the map's type, keypoints in COLMAP's convention.
    global_features : type name to vector, of the map's types.
    prior : names of the map images that may be matched with; None: all.
    """

    camera: Camera
    image: Path | str | NDArray[np.uint8] | None = None
    name: str = "query"
    features: LocalFeatures | None = None
    global_features: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    prior: tuple[str, ...] | None = None

    def read_image(self) -> NDArray[np.uint8]:
        """The image as uint8 (H, W, 3) RGB; raises DataError when there is none or it is broken."""
        if self.image is None:
            raise DataError(
                f"query {self.name} has neither features of the map's type nor an image"
            )
        if isinstance(self.image, str | Path):
            return read_image_of(Path(self.image), self.camera)
        image = np.asarray(self.image)
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise DataError(
                f"query {self.name}: an image is uint8 (H, W, 3), got {image.dtype} {image.shape}"
            )
        if image.shape[:2] != (self.camera.height, self.camera.width):
            raise DataError(
                f"query {self.name}: the image is {image.shape[1]}x{image.shape[0]}, its camera "
                f"says {self.camera.width}x{self.camera.height}"
            )
        return image


def queries_of_kapture(folder: KaptureFolder, kapture_map: KaptureMap) -> Iterator[Query]:
    """The images of a kapture folder as queries, sorted by name, with what features it brings.

    Its cameras and keypoints are taken to be described as the map describes its own.
    """
    data = folder.read()
    local_type = kapture_map.local_type
    has_local = local_type in folder.types("keypoints") and local_type in folder.types(
        "descriptors"
    )
    global_types = sorted(set(folder.types("global_features")) & set(kapture_map.global_types()))
    for name in data.image_names():
        features = None
        if has_local and name in folder.keypoints(local_type):
            keypoints = folder.keypoints(local_type).read(name)
            descriptors = folder.descriptors(local_type).read(name)
            if len(keypoints) != len(descriptors):
                raise DataError(
                    f"{name} has {len(keypoints)} keypoints and {len(descriptors)} descriptors "
                    f"of type {local_type}",
                    path=folder.root,
                )
            features = LocalFeatures(
                kapture_map.keypoints_to_colmap(keypoints),
                np.zeros(len(keypoints), np.float32),
                descriptors,
            )
        yield Query(
            camera=kapture_map.to_colmap(data.camera_of(name)),
            image=folder.image_path(name),
            name=name,
            features=features,
            global_features={
                t: folder.global_features(t).read(name)
                for t in global_types
                if name in folder.global_features(t)
            },
        )
