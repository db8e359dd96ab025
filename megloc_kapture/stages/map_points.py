"""Stage: the points of the map: triangulated, lifted through depth, or of a given model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.stages.given_map import given_map, given_type, has_descriptors, join_maps
from megloc_kapture.stages.layout import (
    FEATURES,
    GLOBAL_FEATURES,
    LOCAL_FEATURES,
    MAP,
    REFERENCE,
    UNREFINED,
)
from megloc_kapture.stages.lifting import lift_map
from megloc_kapture.stages.stage import LOCAL_TYPES, PipelineStage, StageWork
from megloc_kapture.stages.triangulation import triangulate_map

if TYPE_CHECKING:
    from megloc_kapture.stages.options import PipelineOptions


def check_given_type(reference: KaptureFolder, expected: str) -> None:
    """Check that a given map is of the keypoints type that is extracted for it.

    Raises
    ------
    DataError : it is of another one, or no map.
    """
    found = given_type(reference)
    if found != expected:
        raise DataError(
            f"the given map is of keypoints type {found!r}, given_features extracts {expected!r}",
            path=reference.root,
        )


def is_given(stage: PipelineStage, local_type: str) -> bool:
    """Whether points of a keypoints type are those of the given map."""
    options = stage.options
    return options.uses_given_map() and local_type == options.make_given_extractor().name


def described_images(work: StageWork, stage: PipelineStage, local_type: str) -> KaptureFolder:
    """The map's images with their features of a type, before there is a map."""
    # descriptors of its own: those that were extracted for it lie in the workspace
    if is_given(stage, local_type) and has_descriptors(work.folder(REFERENCE)):
        return work.folder(REFERENCE, FEATURES)
    return work.folder(stage.layout.mapping, FEATURES)


def matched_images(work: StageWork, stage: PipelineStage, local_type: str) -> KaptureFolder:
    """The map's images with the features of a type that queries are matched with.

    A given map has keypoints of its own, which are not all that its images' extraction gives.
    """
    if is_given(stage, local_type):
        return work.folder(MAP)
    return work.folder(stage.layout.mapping, FEATURES, *stage.layout.mapping_matches)


class GivenMap(PipelineStage):
    """Take the points of the model that the dataset comes with."""

    name = "points"
    uses = ("map", "given_features")
    writes = (UNREFINED,)

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        return (REFERENCE, self.layout.mapping, LOCAL_FEATURES, GLOBAL_FEATURES)

    @classmethod
    def is_wanted(cls, options: PipelineOptions) -> bool:
        return options.map == "given"

    def run(self, work: StageWork) -> Mapping[str, float]:
        return write_given_map(work, self, work.out / UNREFINED)


def write_given_map(work: StageWork, stage: PipelineStage, output: Path) -> dict[str, float]:
    """Write the given map of a run; see :func:`given_map`."""
    reference = work.folder(REFERENCE)
    check_given_type(reference, stage.options.make_given_extractor().name)
    return given_map(reference, work.folder(stage.layout.mapping, FEATURES), output)


class LiftPoints(PipelineStage):
    """Make the map's points of keypoints, by the depth of its images."""

    name = "points"
    uses = ("map", "lifting", "local_features.name", "local_features.options")
    writes = (UNREFINED,)

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        return (self.layout.mapping, LOCAL_FEATURES, GLOBAL_FEATURES)

    @classmethod
    def is_wanted(cls, options: PipelineOptions) -> bool:
        return options.map == "lift"

    def run(self, work: StageWork) -> Mapping[str, float]:
        mapping = work.folder(self.layout.mapping, FEATURES)
        types = self.options.own_types()
        return lift_map(mapping, types, work.out / UNREFINED, self.options.lifting, work=work)


class TriangulatePoints(PipelineStage):
    """Triangulate the map's points, beside those of a given map where both are wanted."""

    name = "points"
    version = 2
    uses = ("triangulation", "guided_pyramid.mode", *LOCAL_TYPES)
    writes = (UNREFINED,)

    @property
    def reads(self) -> Sequence[str]:  # type: ignore[override]
        features = (LOCAL_FEATURES, GLOBAL_FEATURES)
        return (
            self.layout.mapping,
            *features,
            *self.layout.mapping_matches,
            *self.layout.reference,
        )

    @classmethod
    def is_wanted(cls, options: PipelineOptions) -> bool:
        return options.triangulates()

    def run(self, work: StageWork) -> Mapping[str, float]:
        joined = self.options.uses_given_map()
        mapping = work.folder(self.layout.mapping, FEATURES, *self.layout.mapping_matches)
        own = work.out / ("map_own" if joined else UNREFINED)
        counts = triangulate_map(
            mapping,
            mapping,
            self.options.point_types(),
            own,
            self.options.triangulation,
            num_threads=work.num_threads,
            work=work,
        )
        if not joined:
            return counts
        given = work.out / "map_given"
        write_given_map(work, self, given)
        both = join_maps(KaptureFolder(own), KaptureFolder(given), work.out / UNREFINED)
        return {**both, "points_triangulated": counts["points"]}
