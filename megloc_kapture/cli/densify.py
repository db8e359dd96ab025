"""``megloc densify``: a map with depth of its images, by multi-view stereo."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.cli.common import Force, Input, Output, Reading
from megloc_kapture.cli.stage_command import StageCommand, restrictions_beside
from megloc_kapture.cli.stages import MAP
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.stages.densifying import densify_map, fitted_to_poses
from megloc_kapture.stages.stereo_depth import fuse_depth


@dataclass(frozen=True, kw_only=True)
class Densify(Reading, StageCommand):
    """Estimate depth of a map's images that have none, by multi-view stereo.

    The depth maps are kapture depth records; what a map with depth allows (verification, ranking
    by looks, refinement by rendering) works as with a depth sensor's.
    """

    uses = ("mvs",)

    input: Input
    """Kapture folder of the map, with points; it stays as it is."""
    output: Output
    """Kapture folder of the map with depth."""
    by: str | None = None
    """Estimator: sweep, patchmatchnet, colmap or a plugin; sweep unless given."""
    points: bool = False
    """Lift keypoints that have no point through the depth, with their uncertainty."""
    fuse: Path | None = None
    """Write all depth as one cloud to this PLY file."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        chosen: dict[str, object] = {"mode": "points" if self.points else "depth"}
        if self.by is not None:
            chosen["estimator"] = {"name": self.by}
        options = self.options({"mvs": chosen}).mvs
        source = self.kapture(self.input)
        with self.staged(self.output, MAP, force=self.force) as (out, work):
            counts = densify_map(
                source, out, options, restrictions=restrictions_beside(self.input), work=work
            )
            console.say(
                f"depth of {counts['images_with_depth']} of {counts['images']} images, on "
                f"{100 * counts['fill']:.0f} % of their pixels"
                + (f"; {counts['points_lifted']} keypoints lifted" if self.points else "")
            )
            if self.fuse is not None:
                agreement = fitted_to_poses(source, options)[0].agreement
                fused = fuse_depth(KaptureFolder(out), self.fuse, agreement, work=work)
                console.say(f"{fused} points in {self.fuse}")
        return 0
