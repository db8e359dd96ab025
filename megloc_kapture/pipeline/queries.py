"""Queries of the localizer: an image, or features that somebody else extracted."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.datasets.kapture_folders import check_image
from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture_store import FeatureReader, KaptureFolder
from megloc_kapture.pipeline.kapture_map import KaptureMap, check_lengths
from megloc_kapture.plugins import LOCAL_FEATURES, load_plugin
from megloc_kapture.stages.local_features import read_image_of, read_mask
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
    prior : names of the map images it may be matched with; None: all.
    candidates : names of the map images it is matched with, best first, instead of retrieval.
    mask : bool (H, W), True = use, or the path of a mask image (0 = ignore), which may be absent;
        for the extraction of features.
    """

    camera: Camera
    image: Path | str | NDArray[np.uint8] | None = None
    name: str = "query"
    features: LocalFeatures | None = None
    global_features: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    prior: tuple[str, ...] | None = None
    candidates: tuple[str, ...] | None = None
    mask: Path | NDArray[np.bool_] | None = None

    def read_mask(self) -> NDArray[np.bool_] | None:
        """The mask, bool (H, W), True = use; None where there is none. Raises DataError."""
        shape = (self.camera.height, self.camera.width)
        if isinstance(self.mask, Path):
            return read_mask(self.mask, shape)
        if self.mask is None:
            return None
        mask = np.asarray(self.mask)
        if mask.dtype != np.bool_ or mask.shape != shape:
            raise DataError(
                f"query {self.name}: a mask is bool {shape}, got {mask.dtype} {mask.shape}"
            )
        return mask

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


class KaptureQueries:
    """The images of a kapture folder as queries, with the features it brings; read one by one.

    Its cameras and keypoints are taken to be described as the map describes its own.

    Attributes
    ----------
    names : of the images, sorted; iterating yields the queries in this order.
    """

    def __init__(self, folder: KaptureFolder, kapture_map: KaptureMap) -> None:
        self._folder, self._map = folder, kapture_map
        self._data = folder.read()
        self.names = self._data.image_names()
        local_type = kapture_map.local_type
        self._keypoints: FeatureReader | None = None
        self._descriptors: FeatureReader | None = None
        if all(local_type in folder.types(kind) for kind in ("keypoints", "descriptors")):
            self._keypoints = folder.keypoints(local_type)
            self._descriptors = folder.descriptors(local_type)
        self._globals = {
            name: folder.global_features(name)
            for name in kapture_map.global_types()
            if name in folder.types("global_features")
        }

    def check(self) -> None:
        """Check all that can be checked without reading features or pixels.

        Raises
        ------
        DataError : there are no images; an image is needed and absent, broken or not of its
            camera's size; features are truncated, of different length, or not as wide as the
            map's; or they are absent and there is no extractor for their type, or not its weights.
        PluginError : the extractor cannot be loaded.
        """
        if not self.names:
            raise DataError("there are no query images", path=self._folder.root)
        self._check_widths()
        extractor = self._map.extractor()
        loads = False
        for name in self.names:
            if self._has_features(name):
                if self._keypoints is not None and self._descriptors is not None:
                    check_lengths(self._keypoints, self._descriptors, name)
            elif extractor is None:
                raise DataError(
                    f"image {name!r} has no features of type {self._map.local_type!r}, and no "
                    "extractor for them is installed; give them with --features-dir, or in the "
                    "kapture folder",
                    path=self._folder.root,
                )
            else:
                if not loads:  # looking a plugin up is too slow to do it for every query
                    load_plugin(LOCAL_FEATURES, extractor.name, extractor.options)
                    loads = True
                check_image(self._folder, name)
            for vectors in self._globals.values():
                if name in vectors:
                    vectors.length(name)

    def _check_widths(self) -> None:
        pairs = [
            (vectors, self._map.folder.global_features(name))
            for name, vectors in self._globals.items()
        ]
        if self._descriptors is not None and self._map.has_descriptors():
            local_type = self._map.local_type
            pairs.append((self._descriptors, self._map.folder.descriptors(local_type)))
        for ours, theirs in pairs:
            if ours.config.dsize != theirs.config.dsize:
                raise DataError(
                    f"{ours.kind} of type {ours.type_name!r} have {ours.config.dsize} values, "
                    f"the map's {theirs.config.dsize}",
                    path=self._folder.root,
                )

    def types_of_all(self) -> list[str]:
        """Global-feature types that all queries bring and the map has."""
        return [
            name
            for name, vectors in self._globals.items()
            if all(image in vectors for image in self.names)
        ]

    def __iter__(self) -> Iterator[Query]:
        return map(self.query, self.names)

    def query(self, name: str) -> Query:
        """The query of a name."""
        vectors = {t: reader.read(name) for t, reader in self._globals.items() if name in reader}
        return Query(
            camera=self._map.to_colmap(self._data.camera_of(name)),
            image=self._folder.image_path(name),
            name=name,
            features=self._features(name),
            global_features=vectors,
            prior=self._prior(name),
            mask=self._folder.root / "sensors" / "masks" / f"{name}.png",
        )

    def _prior(self, name: str) -> tuple[str, ...] | None:
        if name not in self._map.restrictions.priors:
            return None
        return self._priors[name]

    @cached_property
    def _priors(self) -> dict[str, tuple[str, ...]]:
        """What the map's dataset permits; queries of one pool share their tuple."""
        images = self._map.images
        found = {}
        for positions, permitted in self._map.restrictions.pools(self.names, images):
            prior = tuple(images[position] for position in permitted)
            found.update(dict.fromkeys((self.names[at] for at in positions), prior))
        return found

    def _has_features(self, name: str) -> bool:
        return self._keypoints is not None and name in self._keypoints

    def _features(self, name: str) -> LocalFeatures | None:
        if self._keypoints is None or self._descriptors is None or name not in self._keypoints:
            return None
        check_lengths(self._keypoints, self._descriptors, name)
        keypoints = self._keypoints.read(name)
        return LocalFeatures(
            self._map.keypoints_to_colmap(keypoints),
            np.zeros(len(keypoints), np.float32),
            self._descriptors.read(name),
        )
