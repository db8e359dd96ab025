"""The test of a map by images of its own, held out, before a refiner is trusted in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

from megloc_kapture.io.tables import ConsistencyRow
from megloc_kapture.refinement.consistency import (
    Consistency,
    Displacement,
    HoldsOut,
    judge_consistency,
    spread_names,
)
from megloc_kapture.refinement.references import ReferenceImages
from megloc_kapture.stages.ranking_scene import KaptureScene
from megloc_kapture.stages.work import HERE, FolderSpec, Work, ordered_map

# images under way at once: of those, what comes behind the last that is needed is thrown away
_WINDOW = 4


@dataclass(frozen=True)
class _Job:
    map: FolderSpec
    refiner: HoldsOut
    image: str
    images: ReferenceImages


def map_consistency(
    mapping: FolderSpec,
    by_frame: Mapping[str, ReferenceImages],
    refiner: HoldsOut,
    *,
    work: Work = HERE,
) -> dict[str, Consistency]:
    """The verdict on each coordinate frame of a map, by a bounded sample of its images.

    Parameters
    ----------
    by_frame : the images of each frame.

    Raises
    ------
    DataError : an image or a depth map cannot be read.
    """
    return {
        frame: judge_consistency(
            ordered_map(
                _hold_out,
                (_Job(mapping, refiner, image, images) for image in spread_names(images.names)),
                work.executor,
                window=_WINDOW,
            )
        )
        for frame, images in by_frame.items()
    }


def consistency_row(frame: str, method: str, found: Consistency) -> ConsistencyRow:
    """The row of one verdict."""
    median = found.median or Displacement(*[float("nan")] * len(fields(Displacement)))
    counts = (found.images, found.contradicting)
    return ConsistencyRow(frame, method, *counts, **vars(median), reason=found.reason)


def _hold_out(job: _Job) -> Displacement | None:
    return job.refiner.hold_out(job.image, job.images, KaptureScene(job.map.open()))
