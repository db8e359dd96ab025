"""Localization of images in a kapture map from Python: see :class:`Localizer`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.live_source import LiveSource, MapMatching
from megloc_kapture.pipeline.local_types import local_types_of
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.queries import (
    Preprocessor,
    Query,
    QueryImage,
    QueryImages,
    Unit,
)
from megloc_kapture.pipeline.query_folders import KaptureQueries
from megloc_kapture.stages.localized_folder import unreadable_image
from megloc_kapture.stages.matches import FeatureCache
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.pose_refinement import MapRefiners
from megloc_kapture.stages.query_poses import localize_query
from megloc_kapture.stages.scene import KaptureScene
from megloc_kapture.stages.work import ordered_map
from megloc_kapture.values import Camera, Device, Failure, Pose, Precision, RigidTransform

_ALONE = RigidTransform.identity()


class Localizer:
    """Estimates camera poses in a map of any tool, as ``megloc eval`` does with the same options.

    Matches of all keypoints types form one pose problem. Query features are given, or extracted if
    the map's type has an extractor plugin. Candidates are ranked by global features; small maps
    use all images. Networks load on first use. ``options`` replaces preset, device (auto, cpu,
    cuda, cuda:N) and precision (full, half).

    Examples
    --------
    >>> localizer = Localizer(KaptureMap.open("map"))             # doctest: +SKIP
    >>> found = localizer.localize("query.jpg", camera)           # doctest: +SKIP
    >>> found.cam_from_world if found else found.reason           # doctest: +SKIP
    """

    def __init__(
        self,
        kapture_map: KaptureMap,
        preset: str = "classic",
        *,
        options: PipelineOptions | None = None,
        device: Device = "auto",
        precision: Precision = "full",
    ) -> None:
        self.map = kapture_map
        self._key = uuid4().hex  # distinguishes maps of the same name in workers
        if options is not None and (device, precision) != ("auto", "full"):
            raise OptionError("give the device and the precision in the options")
        where = {"device": device, "precision": precision}
        self.options = options or options_of_preset(preset, changes=[where])
        self._ranker = self.options.localization.make_ranker(self.options.placement)
        self._preprocessor = Preprocessor(self.options)
        self.refiners = MapRefiners(
            kapture_map.folder,
            kapture_map.restrictions,
            self.options.pose_refinement,
            self.options.placement,
        )
        self.types = local_types_of(kapture_map, self.options, FeatureCache())
        for local in self.types:
            local.prepare()
        self.matching = MapMatching(kapture_map, self.options, self.types, self._preprocessor)

    def __reduce__(self) -> tuple[Any, ...]:
        return _made_again, (self._key, *self.map.__reduce__(), self.options.model_dump_json())

    def localize(
        self,
        image: Path | str | NDArray[np.uint8],
        camera: Camera,
        *,
        prior: Sequence[str] | None = None,
    ) -> Pose | Failure:
        """Localize one image; a Failure is falsy and has a reason.

        Parameters
        ----------
        image : path of an image file, or uint8 (H, W, 3) RGB.
        camera : intrinsics with COLMAP's models and pixel origin.
        prior : names of map images that may be matched.
        """
        permitted = None if prior is None else tuple(prior)
        return self.localize_query(replace(_query_of(image, camera), prior=permitted))

    def localize_many(
        self,
        queries: Iterable[Query | tuple[Path | str | NDArray[np.uint8], Camera]],
        executor: Executor | None = None,
        *,
        candidates: Mapping[str, Sequence[str]] | None = None,
    ) -> Iterator[Pose | Failure]:
        """Localize each query separately and lazily, in order.

        ``executor`` may hold threads, which share the map, or processes, which open it again;
        ``candidates`` are map images by query name, used instead of retrieval.
        """
        wrapped = (q if isinstance(q, Query) else _query_of(*q) for q in queries)
        units = (((query, _ALONE),) for query in wrapped)
        for results in self.localize_units(units, executor, candidates=candidates):
            yield from results

    def localize_kapture(
        self, folder: KaptureFolder | Path | str, executor: Executor | None = None
    ) -> Iterator[tuple[str, Pose | Failure]]:
        """Yield (name, result) of a kapture folder's images, sorted by name or grouped by rig."""
        opened = folder if isinstance(folder, KaptureFolder) else KaptureFolder(folder)
        queries = KaptureQueries(opened, self.map)
        units = queries.units(rigs=self.options.localization.rigs)
        results = self.localize_units(map(queries.read, units), executor)
        for unit, found in zip(units, results, strict=True):
            yield from zip((name for name, _ in unit), found, strict=True)

    def localize_units(
        self,
        units: Iterable[Unit],
        executor: Executor | None = None,
        *,
        candidates: Mapping[str, Sequence[str]] | None = None,
    ) -> Iterator[list[Pose | Failure]]:
        """Localize images or rigs and yield one result per camera for each unit.

        A rig without a pose is tried camera by camera. An undecodable image file fails its unit.
        """
        if candidates is not None:
            known = candidates
            units = (
                tuple((replace(q, candidates=tuple(known.get(q.name, ()))), at) for q, at in unit)
                for unit in units
            )
        return ordered_map(self._localize_readable, units, executor)

    def localize_query(self, query: Query) -> Pose | Failure:
        return self._localize_unit(((query, _ALONE),))[0]

    def localize_rig(self, views: Sequence[tuple[Query, RigidTransform]]) -> Pose | Failure:
        """Localize cameras, given as (query, ``cam_from_rig``), together.

        The pose's ``cam_from_world`` is ``rig_from_world``.
        """
        if self.refiners.refiners:
            raise OptionError(
                "pose_refinement refines the poses of cameras, not of rigs: use localize_units"
            )
        with single_threaded():
            images = self._images(views)
            (found,), _ = self._solve(views, images, self._scene(images), as_rig=True)
            return found

    def _localize_readable(self, unit: Unit) -> list[Pose | Failure]:
        try:
            return self._localize_unit(unit)
        except DataError as error:
            if error.path is None or error.path not in [query.image for query, _ in unit]:
                raise
            return [unreadable_image(query.name, error.message) for query, _ in unit]

    def _localize_unit(self, unit: Unit) -> list[Pose | Failure]:
        with single_threaded():
            images = self._images(unit)
            scene = self._scene(images)
            results, sources = self._solve(unit, images, scene)
            found = []
            for (query, _), source, result in zip(unit, sources, results, strict=True):
                image = source.image
                if isinstance(result, Pose):
                    intrinsics = result.camera or image.camera
                    result = self.refiners.refine(image.query.name, intrinsics, result, scene)
                    result = image.in_original(result)
                found.append(
                    replace(
                        result,
                        name=query.name,
                        remarks=(*result.remarks, *source.remarks),
                        seconds={**source.clock.seconds, **result.seconds},
                    )
                )
            return found

    def _solve(
        self,
        unit: Sequence[tuple[Query, RigidTransform]],
        images: Sequence[QueryImage],
        scene: KaptureScene,
        *,
        as_rig: bool = False,
    ) -> tuple[list[Pose | Failure], list[LiveSource]]:
        """Return a result per camera, and the sources of their matches."""
        sources = [
            LiveSource(self.matching, image, cam_from_rig)
            for image, (_, cam_from_rig) in zip(images, unit, strict=True)
        ]
        results = localize_query(
            sources,
            self.options.localization,
            frame_of=self.map.restrictions.frame,
            centers=self._centers,
            ranker=self._ranker,
            scene=scene,
            as_rig=as_rig,
        )
        return results, sources

    def _images(self, unit: Sequence[tuple[Query, RigidTransform]]) -> list[QueryImage]:
        """Return the images of a unit under unique names, by which their pixels are looked up."""
        named = Counter(query.name for query, _ in unit)
        return [
            self._preprocessor.of(
                query if named[query.name] == 1 else replace(query, name=f"{query.name} ({number})")
            )
            for number, (query, _) in enumerate(unit, 1)
        ]

    def _scene(self, images: Iterable[QueryImage]) -> KaptureScene:
        return KaptureScene(self.map.folder, QueryImages(images), map_camera=self.map.camera)

    @cached_property
    def _centers(self) -> dict[str, NDArray[np.float64]]:
        return {image: pose.center() for image, pose in self.map.poses.items()}

    def ranked(self, query: Query) -> list[str]:
        """Return the most similar map images of a query, best first, with reranking if enabled."""
        return self.matching.ranked(self._preprocessor.of(query))

    def describe_retrieval(self, global_types: Collection[str]) -> str:
        options = self.options.query_pairs
        if options.by == "exhaustive" or len(self.map.images) <= options.top_k:
            return f"all {len(self.map.images)} map images"
        return self.matching.describe(global_types)


def _query_of(image: Path | str | NDArray[np.uint8], camera: Camera) -> Query:
    return Query(camera, image, Path(image).name if isinstance(image, str | Path) else "query")


@lru_cache(maxsize=2)
def _made_again(
    key: str, opened: Callable[..., KaptureMap], of_map: tuple[Any, ...], options: str
) -> Localizer:
    return Localizer(opened(*of_map), options=PipelineOptions.model_validate_json(options))
