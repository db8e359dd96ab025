"""Localization of images in a kapture map from Python: see :class:`Localizer`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OptionError, check_option
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.pipeline.live_source import LiveSource, MapMatching
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.queries import Query, Unit, check_image
from megloc_kapture.stages.localized_folder import unreadable_image
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.pose_refinement import MapRefiners
from megloc_kapture.stages.query_poses import localize_query
from megloc_kapture.stages.scene import KaptureScene
from megloc_kapture.stages.work import ordered_map
from megloc_kapture.values import Camera, Device, Failure, Pose, Precision, RigidTransform

_ALONE = RigidTransform.identity()


class Localizer:
    """Estimates camera poses in a map made by any tool, with the steps of ``megloc eval``.

    Matches of all keypoints types form one pose problem. Query features are given, or extracted if
    an extractor plugin for the map's type is installed. Candidates are ranked by global features;
    in small maps all images are candidates. Networks load on first use. ``options`` replaces
    preset, device (auto, cpu, cuda, cuda:N) and precision (full, half).

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
        check_option(
            isinstance(kapture_map, KaptureMap), "a Localizer needs a map: KaptureMap.open(folder)"
        )
        self.map = kapture_map
        if options is not None and (device, precision) != ("auto", "full"):
            raise OptionError("give the device and the precision in the options")
        where = {"device": device, "precision": precision}
        self.options = options or options_of_preset(preset, changes=[where])
        self._ranker = self.options.localization.make_ranker(self.options.placement)
        self.refiners = MapRefiners(
            kapture_map.folder,
            kapture_map.tables,
            self.options.pose_refinement,
            self.options.placement,
        )
        self.matching = MapMatching(kapture_map, self.options)
        self.types = self.matching.types
        for local in self.types:
            local.prepare()

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
        return self.localize_query(replace(_query_of(image, camera), prior=prior))

    def localize_many(
        self,
        queries: Iterable[Query | tuple[Path | str | NDArray[np.uint8], Camera]],
        executor: Executor | None = None,
    ) -> Iterator[Pose | Failure]:
        """Localize each query separately and lazily, in order.

        ``executor`` must be a thread pool, as the workers share the map.
        """
        wrapped = (q if isinstance(q, Query) else _query_of(*q) for q in queries)
        units = (((query, _ALONE),) for query in wrapped)
        for results in self.localize_units(units, executor):
            yield from results

    def localize_units(
        self, units: Iterable[Unit], executor: Executor | None = None
    ) -> Iterator[list[Pose | Failure]]:
        """Localize images or rigs (units), and yield one result per camera for each unit.

        A rig without a joint pose is localized camera by camera. If an image file cannot be
        decoded, all images of its unit fail.
        """
        return ordered_map(self._localize_readable, units, executor)

    def localize_query(self, query: Query) -> Pose | Failure:
        return self._localize_unit(((query, _ALONE),))[0]

    def _localize_readable(self, unit: Unit) -> list[Pose | Failure]:
        try:
            return self._localize_unit(unit)
        except DataError as error:
            paths = [str(query.image) for query, _ in unit if isinstance(query.image, str | Path)]
            if error.path is None or str(error.path) not in paths:
                raise
            return [unreadable_image(query.name, str(error)) for query, _ in unit]

    def _localize_unit(self, unit: Unit) -> list[Pose | Failure]:
        with single_threaded():
            sources = [
                LiveSource(self.matching, self.matching.image(query), cam_from_rig)
                for query, cam_from_rig in unit
            ]
            by_name = {source.image.query.name: source.image for source in sources}
            scene = KaptureScene(self.map.folder, by_name, map_camera=self.map.camera)
            results = localize_query(
                sources,
                self.options.localization,
                frame_of=self.map.tables.frame,
                centers=self._centers,
                ranker=self._ranker,
                scene=scene,
            )
            finished = []
            for source, result in zip(sources, results, strict=True):
                image, name = source.image, source.image.query.name
                if isinstance(result, Pose):
                    intrinsics = result.camera or image.camera
                    result = self.refiners.refine(name, intrinsics, result, scene)
                    result = image.in_original(result)
                finished.append(
                    replace(
                        result,
                        name=name,
                        remarks=(*result.remarks, *source.remarks),
                        seconds={**source.clock.seconds, **result.seconds},
                    )
                )
            return finished

    @cached_property
    def _centers(self) -> dict[str, NDArray[np.float64]]:
        return {image: pose.center() for image, pose in self.map.poses.items()}

    def ranked(self, query: Query) -> list[str]:
        """Return the given candidates of a query, or the most similar map images, best first.

        The latter are reranked if reranking is enabled.
        """
        return self.matching.ranked(self.matching.image(query))


def _query_of(image: Path | str | NDArray[np.uint8], camera: Camera) -> Query:
    check_image(image)
    return Query(camera, image, Path(image).name if isinstance(image, str | Path) else "query")
