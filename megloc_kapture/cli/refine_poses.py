"""``megloc refine-poses``: better poses of localized queries: ICP, rendering or a neural field."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from megloc_kapture.cli.common import Force, Input, Linked, Output
from megloc_kapture.cli.stage_command import StageCommand, restrictions_beside
from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.report.refinement import consistency_sentence
from megloc_kapture.io.tables import CONSISTENCY_FILE, read_consistency
from megloc_kapture.plugin_loading import plugin_names
from megloc_kapture.plugins import POSE_REFINERS
from megloc_kapture.stages.pose_refinement import refine_poses
from megloc_kapture.stages.stage import LOCALIZED


@dataclass(frozen=True, kw_only=True)
class RefinePoses(Linked, StageCommand):
    """Refine the poses of localized queries; a pose that gets no better stays, and says why."""

    uses = ("pose_refinement",)

    input: Input
    """Kapture map, with images and depth maps. Read only."""
    query: Path
    """Kapture folder with the queries' images, and their depth maps for icp."""
    poses: Path
    """Result of megloc localize or megloc eval: kapture folder with status.csv."""
    output: Output
    """Kapture folder of the refined result, with status.csv and the tables of refinement."""
    by: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """Pose refiner: icp, rendering or field; repeated, one after another; the preset's unless
    given."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        changes: dict[str, object] = {"pose_refinement": {"by": list(self.by)}} if self.by else {}
        options = self.options(changes).pose_refinement
        if self.by:  # in this order, with the options that --set gives them
            options = options.with_refiners(self.by)
        if not options.refines():
            names = ", ".join(plugin_names(POSE_REFINERS))
            raise OptionError(f"no pose refiner is chosen; --by takes: {names}")
        with self.staged(self.output, LOCALIZED, force=self.force) as (out, work):
            counts = refine_poses(
                self.kapture(self.input),
                self.kapture(self.query),
                self.kapture(self.poses),
                out,
                options,
                restrictions=restrictions_beside(self.query),
                work=work,
            )
        accepted = ", ".join(
            f"{count:g} accepted by {name.removeprefix('accepted_by_')}"
            for name, count in counts.items()
            if name.startswith("accepted_by_")
        )
        console.result(
            f"{counts['queries']:g} poses, {accepted}; status.csv and refinement.csv in "
            f"{self.output}"
        )
        if (table := self.output / CONSISTENCY_FILE).is_file():
            for row in read_consistency(table):
                console.result(consistency_sentence(row))
        return 0
