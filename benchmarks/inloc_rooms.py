"""The twin of InLoc with more rooms that are alike, mapped and matched as ``megloc eval`` does it.

Two floors alike, of rooms that repeat, each floor with a coordinate frame of its own. On the twin
as it is by default counting inliers finds the right room of every query. With more modules a
query's candidates are divided among more rooms that all fit, and smaller images have fewer
keypoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from mapped_scene import Query, Scene, errors, hypotheses
from megloc_twins.indoor_rooms import MODULE_M
from scenes import megloc

from megloc_kapture.pipeline.datasets import find_benchmark
from megloc_kapture.plugins import PoseHypothesis
from megloc_kapture.stages.query_poses import LocalizationOptions

DATASET = "inloc"
HARDER = (
    "modules=5",
    "cutout_width=240",
    "cutout_height=180",
    "query_width=320",
    "query_height=240",
)
_SAME_ROOM_M, _SAME_ROOM_DEG = MODULE_M / 2, 90.0


@dataclass(frozen=True)
class InLocRooms:
    """Twins of InLoc, one per seed.

    Attributes
    ----------
    settings : options of the twin, ``key=value``.
    top_k : candidates of a query; counting inliers is right with all forty.
    """

    settings: Sequence[str] = HARDER
    top_k: int = 10
    thresholds = ((0.25, 10.0), (0.5, 10.0), (1.0, 10.0))

    def told(self) -> str:
        """What they are, in words."""
        return f"the twin of InLoc, {' '.join(self.settings)}, {self.top_k} candidates"

    @cached_property
    def localization(self) -> LocalizationOptions:
        """How InLoc's benchmark file localizes."""
        benchmark = find_benchmark(DATASET)
        return LocalizationOptions.model_validate(benchmark.options["localization"])

    def run(self, workspace: Path, seed: int) -> Path:
        """Render, map and match the twin of a seed, as far as that is not done yet."""
        folder = workspace / "-".join([DATASET, *sorted(self.settings), f"seed={seed}"])
        twin, run = folder / "twin", folder / "run"
        if not twin.is_dir():
            settings = [part for setting in self.settings for part in ("--set", setting)]
            chosen = ("--seed", str(seed), *settings, "--executor", "inline")
            # a twin that was cut short is not taken for a whole one
            unfinished = folder / "unfinished"
            megloc("synth", DATASET, "-o", str(unfinished), "-f", *chosen)
            unfinished.rename(twin)
        where = ("--root", str(twin), "--workspace", str(run), "--executor", "inline")
        megloc("eval", DATASET, *where, "--until", "query_matches")
        return run

    def hypotheses(self, scene: Scene, query: Query) -> Sequence[PoseHypothesis]:
        """The poses of a query's clusters."""
        options = self.localization
        return hypotheses(scene, query.best(self.top_k), options.clusters, options.pose)

    def judged(self, scene: Scene, query: Query, found: PoseHypothesis | None) -> list[float]:
        """1 or 0 for each threshold, and for the right room of the right floor."""
        floor = scene.restrictions.groups[query.view.name].condition
        if found is None or scene.restrictions.frame(found.images[0]) != floor:
            return [0.0] * (len(self.thresholds) + 1)
        metres, degrees = errors(found.views[0].cam_from_world, query.truth)
        limits = (*self.thresholds, (_SAME_ROOM_M, _SAME_ROOM_DEG))
        return [float(metres <= m and degrees <= deg) for m, deg in limits]
