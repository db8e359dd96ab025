"""``megloc localize``: queries into any kapture map; the map stays as it is."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.cli.common import Choosing, Common, Force, Input, Output, existing
from megloc_kapture.cli.stage_command import FeaturesDirs
from megloc_kapture.errors import OptionError
from megloc_kapture.io.kapture_store import KaptureFolder, read_pairs
from megloc_kapture.io.outputs import staged_output
from megloc_kapture.pipeline.executors import available_cores
from megloc_kapture.pipeline.kapture_map import KaptureMap, PixelOriginChoice
from megloc_kapture.pipeline.localizer import Localizer
from megloc_kapture.pipeline.presets import DEFAULT_PRESET, options_of_preset
from megloc_kapture.pipeline.queries import KaptureQueries, Query
from megloc_kapture.stages.localized_folder import write_localized
from megloc_kapture.stages.matches import iterate_candidates
from megloc_kapture.values import RigidTransform

LOCALIZED = "localized"


@dataclass(frozen=True, kw_only=True)
class Localize(Choosing, Common):
    """Localize the images of a kapture folder in a kapture map."""

    input: Input
    """Kapture map: keypoints, points3d and observations of one type. Read only."""
    query: Path
    """Kapture folder with the queries, and their features where the map's cannot be extracted."""
    output: Output = Path("localized")
    """Kapture folder with the queries' poses, and status.csv."""
    features_dir: FeaturesDirs = ()
    """Features folder of map or queries; may be repeated."""
    pairs: Path | None = None
    """Candidates of each query, instead of retrieval."""
    keypoints_type: str | None = None
    """Needed where the map has points of several types."""
    pixel_origin: PixelOriginChoice = "auto"
    """Where the map's intrinsics put the pixel origin; auto finds it out."""
    workers: int | None = None
    """Number of threads; all cores unless given."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        workers = available_cores() if self.workers is None else self.workers
        if workers < 1:
            raise OptionError(f"{workers} workers cannot work; give 1 or more")
        kapture_map = KaptureMap.open(
            self.input,
            keypoints_type=self.keypoints_type,
            features_dirs=existing(self.features_dir),
            pixel_origin=self.pixel_origin,
        )
        options = options_of_preset(self.preset or DEFAULT_PRESET, assignments=self.set)
        folder = KaptureFolder(self.query, features_dirs=existing(self.features_dir))
        queries = KaptureQueries(folder, kapture_map)
        given = None if self.pairs is None else dict(iterate_candidates(read_pairs(self.pairs)))
        # what is wrong is found before the first query, and before anything is written
        kapture_map.check()
        queries.check()
        with staged_output(self.output, kind=LOCALIZED, force=self.force) as out:
            localizer = Localizer(kapture_map, options=options)
            with ThreadPoolExecutor(workers) as executor:
                started = time.perf_counter()
                results = localizer.localize_many(queries, executor, candidates=given)
                tracked = console.track(results, len(queries.names), "localizing")
                named = list(zip(queries.names, tracked, strict=True))
                seconds = time.perf_counter() - started
            fallback = options.localization.fallback
            best = {}
            if fallback == "retrieval":
                failed = [name for name, result in named if not result]
                best = best_candidates(localizer, map(queries.query, failed), given)
            counts = write_localized(
                out,
                folder,
                named,
                fallback=fallback,
                first_candidates=best,
            )
        how = "as given"
        if given is None:
            how = localizer.describe_retrieval(queries.types_of_all())
        console.say(f"candidates: {how}")
        console.say(f"pixel origin: {kapture_map.pixel_origin.intrinsics}")
        console.result(
            f"{counts['localized']} of {counts['queries']} queries localized in {seconds:.1f} s; "
            f"poses and status.csv in {self.output}"
            + (f", {counts['fallbacks']} fallback poses" if counts["fallbacks"] else "")
        )
        if counts["queries"] and not counts["localized"]:
            console.say(f"warning: no query was localized; reasons are in {self.output}/status.csv")
        return 0


def best_candidates(
    localizer: Localizer,
    queries: Iterable[Query],
    given: Mapping[str, Sequence[str]] | None,
) -> dict[str, tuple[str, RigidTransform]]:
    """Query to its best candidate and that image's pose; nothing for a query without any."""
    poses = localizer.map.poses
    best = {}
    for query in queries:
        ranked = localizer.ranked(query) if given is None else given.get(query.name, ())
        first = next((image for image in ranked if image in poses), None)
        if first is not None:
            best[query.name] = (first, poses[first])
    return best
