"""Queries of a kapture folder, with the features that it brings."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from megloc_kapture.datasets.kapture_folders import check_image
from megloc_kapture.errors import DataError
from megloc_kapture.io.files import link_images
from megloc_kapture.io.kapture import FeatureReader, KaptureData, KaptureFolder
from megloc_kapture.matching.guided_pyramid import equivalent_types
from megloc_kapture.pipeline.kapture_map import KaptureMap, check_lengths
from megloc_kapture.pipeline.queries import Query
from megloc_kapture.stages.local_features import (
    mask_path,
)
from megloc_kapture.stages.ranking_scene import depth_of
from megloc_kapture.stages.rigs import query_units
from megloc_kapture.values import LocalFeatures, RigidTransform

Unit = tuple[tuple[Query, RigidTransform], ...]
"""Queries that are localized together, with the ``cam_from_rig`` of each."""


class KaptureQueries:
    """The images of a kapture folder as queries, with the features it brings; read one by one.

    Its cameras and keypoints are taken to be described as the map describes its own.

    Attributes
    ----------
    names : of the images that can be used, sorted; iterating yields the queries in this order.
    unreadable : names of images that are needed and absent, broken or not of their camera's size,
        to the reason; known after :meth:`check`, so far as headers say it.
    faults : why the features that a query brings cannot be used, known when they have been read;
        such a query has neither features nor candidates.
    """

    def __init__(self, folder: KaptureFolder, kapture_map: KaptureMap) -> None:
        self._folder, self._map = folder, kapture_map
        self._data = folder.read()
        self.names = self._data.image_names()
        self.unreadable: dict[str, str] = {}
        self.faults: dict[str, str] = {}
        stored = kapture_map.stored_types()
        self._stored = stored
        wanted = {other for name in stored for other in equivalent_types(name)}
        brought = set(folder.types("keypoints")).intersection(folder.types("descriptors"))
        self._local: dict[str, tuple[FeatureReader, FeatureReader]] = {
            name: (folder.keypoints(name), folder.descriptors(name))
            for name in sorted(wanted & brought)
        }
        # what the map says of keypoints of each type; looked up here, not for every query
        self._like = {
            name: kapture_map.keypoints_of(
                next(other for other in equivalent_types(name) if other in stored)
            )
            for name in self._local
        }
        self._globals = {
            name: folder.global_features(name)
            for name in kapture_map.global_types()
            if name in folder.types("global_features")
        }

    def lacking(self, local_type: str) -> str | None:
        """The first image without features that serve a type; None where all bring them."""
        types = [name for name in equivalent_types(local_type) if name in self._local]
        return next(
            (name for name in self.names if not any(name in self._local[t][0] for t in types)), None
        )

    def check(self) -> None:
        """Check all that can be checked without reading features or pixels.

        Raises
        ------
        DataError : there are no images, or none that can be used; features are not as wide as the
            map's, or would be taken for those of a map image.
        """
        self._map.folder.check_features_apart(self._folder)
        if not self.names:
            raise DataError("there are no query images", path=self._folder.root)
        self._check_widths()
        first: DataError | None = None
        for name in self.names:
            if any(name in keypoints for keypoints, _ in self._local.values()):
                continue
            try:
                check_image(self._folder, name)
            except DataError as error:
                self.unreadable[name] = error.message
                first = first or error
        self.names = [name for name in self.names if name not in self.unreadable]
        if first is not None and not self.names:
            raise first

    def data(self) -> KaptureData:
        """Sensors, rigs and records."""
        return self._data

    def write_images(self, output: Path) -> None:
        """Make the images and masks of a kapture folder links to these."""
        link_images(self._folder.root, output)

    def _check_widths(self) -> None:
        pairs = [
            (vectors, self._map.folder.global_features(name))
            for name, vectors in self._globals.items()
        ]
        for name, (_, descriptors) in self._local.items():
            described = self._map.folder.types("descriptors")
            theirs = next((other for other in equivalent_types(name) if other in described), None)
            if theirs is not None:
                pairs.append((descriptors, self._map.folder.descriptors(theirs)))
        for own, other in pairs:
            if own.config.dsize != other.config.dsize:
                raise DataError(
                    f"{own.kind} of type {own.type_name!r} have {own.config.dsize} values, "
                    f"the map's {other.config.dsize}",
                    path=self._folder.root,
                )

    def types_of_all(self) -> list[str]:
        """Global-feature types that all queries bring and the map has."""
        return [
            name
            for name, vectors in self._globals.items()
            if all(image in vectors for image in self.names)
        ]

    def units(self, *, rigs: bool) -> list[tuple[str, ...]]:
        """Names of the images that are localized together.

        Parameters
        ----------
        rigs : whether cameras of one rig and one moment are; else every image by itself.
        """
        return [tuple(image for image, _ in unit) for unit in self._units(rigs=rigs)]

    def read_units(self, *, rigs: bool) -> Iterator[Unit]:
        """The queries of :meth:`units`, read one after another."""
        for unit in self._units(rigs=rigs):
            yield tuple((self.query(image), cam_from_rig) for image, cam_from_rig in unit)

    def _units(self, *, rigs: bool) -> Iterator[tuple[tuple[str, RigidTransform], ...]]:
        for unit in query_units(self._data, rigs=rigs):
            if usable := tuple(one for one in unit if one[0] not in self.unreadable):
                yield usable

    def __iter__(self) -> Iterator[Query]:
        return map(self.query, self.names)

    def query(self, name: str) -> Query:
        """The query of a name."""
        candidates: tuple[str, ...] | None = None
        try:
            features = self._features(name)
            of_image = {t: one.read(name) for t, one in self._globals.items() if name in one}
        except DataError as error:
            self.faults[name] = str(error)
            features, of_image, candidates = self._no_features(), {}, ()
        return Query(
            camera=self._map.to_colmap(self._data.camera_of(name)),
            image=self._folder.image_path(name),
            name=name,
            features=features,
            global_features=of_image,
            prior=self._prior(name),
            candidates=candidates,
            mask=mask_path(self._folder, name),
            depth=partial(depth_of, self._folder, name) if self._data.records_depth else None,
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

    def _features(self, name: str) -> dict[str, LocalFeatures]:
        found = {}
        for needed in self._stored:
            serving = (one for one in equivalent_types(needed) if one in self._local)
            local_type = next((one for one in serving if name in self._local[one][0]), None)
            if local_type is None or local_type in found:
                continue
            keypoints, descriptors = self._local[local_type]
            check_lengths(keypoints, descriptors, name)
            stored = keypoints.read(name)
            found[local_type] = LocalFeatures(
                self._like[local_type].to_colmap(stored),
                np.zeros(len(stored), np.float32),
                descriptors.read(name),
            )
        return found

    def _no_features(self) -> dict[str, LocalFeatures]:
        return {
            local_type: LocalFeatures(
                np.zeros((0, 2), np.float32),
                np.zeros(0, np.float32),
                np.zeros((0, descriptors.config.dsize), descriptors.config.dtype),
            )
            for local_type, (_, descriptors) in self._local.items()
        }
