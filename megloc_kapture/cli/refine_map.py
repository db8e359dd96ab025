"""``megloc refine-map``: a map without the points that do it no good."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.cli.common import Force, Input, Output, Reading
from megloc_kapture.cli.stage_command import StageCommand
from megloc_kapture.cli.stages import MAP
from megloc_kapture.io.files import read_json_model
from megloc_kapture.stages.map_refinement import RefinementReport, refine_map
from megloc_kapture.stages.preprocessing import REPORT_FILE


@dataclass(frozen=True, kw_only=True)
class RefineMap(Reading, StageCommand):
    """Take points and observations out of a map that its images, or depth maps, contradict.

    What is rejected is chosen with --set refinement.uncertainty.max_relative_deviation=0.02 and
    its like; without, by the preset.
    """

    uses = ("refinement",)

    input: Input
    """Kapture folder of the map; it stays as it is."""
    output: Output
    """Kapture folder of the refined map."""
    ply: bool = False
    """Write the kept and the rejected points as PLY files, coloured by uncertainty."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        changes: dict[str, object] = {"refinement": {"ply": True}} if self.ply else {}
        options = self.options(changes).refinement
        source = self.kapture(self.input)
        with self.staged(self.output, MAP, force=self.force) as (out, work):
            refine_map(source, out, options, work=work)
        for row in report_lines(self.output):
            console.say(row)
        return 0


def report_lines(root: Path) -> list[str]:
    """What the refinement of a map removed, as a table; empty where it was not refined.

    Raises
    ------
    DataError : the report is broken.
    """
    path = root / "reconstruction" / REPORT_FILE
    if not path.is_file():
        return []
    report = read_json_model(path, RefinementReport)
    rows = [
        ("", "points", "observations"),
        ("before", str(report.points_before), str(report.observations_before)),
        *(
            (removed.name.replace("_", " "), f"-{removed.points}", f"-{removed.observations}")
            for removed in report.filters
        ),
        ("after", str(report.points_after), str(report.observations_after)),
    ]
    return [f"{name:22s}{points:>10s}{seen:>14s}" for name, points, seen in rows]
