"""``megloc localize``: queries into any kapture map; the map stays as it is."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from megloc_kapture.cli.common import (
    Common,
    Deciding,
    Force,
    Input,
    Output,
    Reading,
    camera_of_text,
    check_consistent,
    existing,
    idle_for_types,
    opened_map,
    refuse_idle,
)
from megloc_kapture.errors import OptionError
from megloc_kapture.io.dataset_tables import METRES
from megloc_kapture.io.kapture import KaptureFolder, read_pairs
from megloc_kapture.io.output_folders import staged_output
from megloc_kapture.io.tables import STATUS_FILE
from megloc_kapture.pipeline.executors import available_cores
from megloc_kapture.pipeline.kapture_map import KaptureMap, PixelOriginChoice
from megloc_kapture.pipeline.kapture_queries import KaptureQueries
from megloc_kapture.pipeline.localizer import LOCALIZING, Localizer
from megloc_kapture.pipeline.photographs import Photographs
from megloc_kapture.pipeline.presets import DEFAULT_PRESET, assigned, options_of_preset
from megloc_kapture.pipeline.results import Results
from megloc_kapture.stages.matches import iterate_candidates
from megloc_kapture.stages.stage import LOCALIZED


@dataclass(frozen=True, kw_only=True)
class Localize(Reading, Deciding, Common):
    """Localize photographs, or the images of a kapture folder, in a kapture map."""

    input: Input
    """Kapture map: keypoints, points3d and observations; or a COLMAP model. Read only."""
    query: Path | None = None
    """Kapture folder with the queries, and their features where the map's cannot be extracted."""
    images: tuple[Path, ...] = ()
    """Instead of --query: photographs and videos, or folders of them. Their focal lengths are taken
    from EXIF or guessed, and estimated with the poses."""
    camera: str | None = None
    """Camera of all --images, whose pixels are then taken as they are stored:
    MODEL,WIDTH,HEIGHT,PARAMETERS as COLMAP has them."""
    every: int | None = None
    """Of videos among --images every so many frames one is taken; 30 unless given."""
    output: Output = Path("localized")
    """Kapture folder with the queries' poses, and status.csv."""
    pairs: Path | None = None
    """Candidates of each query, instead of retrieval."""
    keypoints_type: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Keypoints type to localize with; may be repeated; all that have points unless given."""
    pixel_origin: PixelOriginChoice = "auto"
    """Where the map's intrinsics put the pixel origin; auto finds it out."""
    workers: int | None = None
    """Number of threads; all cores unless given."""
    force: Force = False
    """Write into a folder that has other things in it, and localize in a map that contradicts
    itself."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        self._check_queries()
        workers = available_cores() if self.workers is None else self.workers
        kapture_map = KaptureMap.open(
            opened_map(self.input, console),
            keypoints_types=self.keypoints_type,
            features_dirs=existing(self.features_dir),
            pixel_origin=self.pixel_origin,
            allow_links_below=existing(self.allow_links_below),
        )
        check_consistent(kapture_map, self.input, force=self.force)
        options = options_of_preset(
            self.preset or DEFAULT_PRESET, assignments=self.assignments(), used=LOCALIZING
        )
        folder: KaptureFolder | Photographs
        if self.query is None:
            camera = None if self.camera is None else camera_of_text(self.camera)
            folder = Photographs(self.images, camera, every=self.every)
        else:
            folder = self.kapture(self.query)
        given = None if self.pairs is None else dict(iterate_candidates(read_pairs(self.pairs)))
        # what is wrong is found before the first query, and before anything is written
        localizer = Localizer(kapture_map, options=options)
        results = Results(localizer, folder, workers=workers, candidates=given, track=console.track)
        queries = results.queries
        check_acted_on(assigned(self.assignments()), localizer, queries, pairs=given is not None)
        with staged_output(self.output, kind=LOCALIZED, force=self.force) as out:
            started = time.perf_counter()
            named = list(results.items())
            seconds = time.perf_counter() - started
            counts = results.write_to(out)
        how = "as given"
        if given is None:
            how = localizer.describe_retrieval(queries.types_of_all())
        console.say(f"localizing with {', '.join(local.name for local in localizer.types)}")
        console.say(f"candidates: {how}")
        console.say(f"pixel origin: {kapture_map.pixel_origin.intrinsics}")
        remarks = Counter(remark for _, result in named for remark in result.remarks)
        focal = {remark for remark in remarks if "focal length" in remark}
        for remark in sorted(remarks.keys() - focal):
            console.say(f"left out of {remarks[remark]} queries: {remark}")
        if kapture_map.unit != METRES:
            console.say(f"positions are in {kapture_map.unit} of the map, whose scale is not known")
        if focal:
            number = sum(remarks[remark] for remark in focal)
            console.say(f"focal length: {number} remarks in {STATUS_FILE}")
        console.result(
            f"{counts['localized']} of {counts['queries']} queries localized in {seconds:.1f} s; "
            f"poses and status.csv in {self.output}"
            + (f", {counts['fallbacks']} fallback poses" if counts["fallbacks"] else "")
        )
        if counts["queries"] and not counts["localized"]:
            console.say(f"warning: no query was localized; reasons are in {self.output}/status.csv")
        return 0

    def _check_queries(self) -> None:
        """Raise OptionError unless the queries are given, in one way."""
        if (self.query is None) == (not self.images):
            raise OptionError("give the queries: either --query, a kapture folder, or --images")
        if self.query is not None:
            for name, given in (("--camera", self.camera), ("--every", self.every)):
                if given is not None:
                    raise OptionError(f"{name} changes nothing: it is of --images")


def check_acted_on(
    typed: Mapping[str, Any],
    localizer: Localizer,
    queries: KaptureQueries | Photographs,
    *,
    pairs: bool,
) -> None:
    """Refuse options that were typed and change nothing for this map and these queries.

    Parameters
    ----------
    typed : nested tables of ``--set``.
    pairs : whether the candidates are given.

    Raises
    ------
    OptionError : names the option, and why it changes nothing.
    """
    idle = idle_for_types(typed, localizer.types, localizer.options)
    brought = ", ".join(local.name for local in localizer.types)
    if all(queries.lacking(local.name) is None for local in localizer.types):
        idle |= dict.fromkeys(
            ("preprocessing", "mask_margin_px"),
            f"the queries bring their local features ({brought}), nothing is extracted",
        )
    shared = queries.types_of_all()
    if pairs:
        names = ("query_pairs", "global_features", "fusion")
        idle |= dict.fromkeys(names, "--pairs gives the candidates")
    elif shared and not localizer.compares_as_asked(shared):
        idle["global_features"] = f"map and queries bring {', '.join(shared)}, which is compared"
    localization = typed.get("localization", {})
    if not queries.data().rigs:
        if localization.get("rigs"):
            idle["localization"] = "rigs: the queries have none"
        elif localization.get("fallback") == "rig":
            idle["localization"] = "fallback = rig: the queries have none"
    refuse_idle(typed, idle)
