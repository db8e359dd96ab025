"""``megloc map``: photographs without poses become a map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from megloc_kapture.cli.common import Choosing, Common, Force, Output, Working, camera_of_text
from megloc_kapture.io.colmap_mapping import Mapper
from megloc_kapture.pipeline.executors import available_cores, single_threaded
from megloc_kapture.pipeline.photograph_maps import (
    MAPPING_OPTIONS,
    describe_map,
    options_of_photographs,
    plan_photographs,
    structure_options,
)
from megloc_kapture.pipeline.photographs import Photographs
from megloc_kapture.pipeline.plan import describe, run_plan
from megloc_kapture.pipeline.presets import DEFAULT_PRESET
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.stages.work import Work


@dataclass(frozen=True, kw_only=True)
class MapPhotographs(Choosing, Working, Common):
    """Make a map of photographs without poses; what is done and still true is kept."""

    images: tyro.conf.Positional[tuple[Path, ...]]
    """Photographs and videos, or folders of them."""
    output: Output
    """Workspace, a map for all commands: the kapture map is its folder map/."""
    mapper: Mapper = "incremental"
    """COLMAP's mapper."""
    scale: tuple[str, ...] = ()
    """What tells metres: gps, the positions in EXIF; or IMAGE IMAGE METRES, two photographs and
    the distance of their cameras. Without it the map has units of its own."""
    camera: str | None = None
    """Camera of all images, whose pixels are then taken as they are stored:
    MODEL,WIDTH,HEIGHT,PARAMETERS as COLMAP has them. It stays as it is."""
    every: int | None = None
    """Of videos every so many frames one is taken; 30 unless given."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        options = options_of_photographs(
            self.preset or DEFAULT_PRESET, self.assignments(), used=MAPPING_OPTIONS
        )
        camera = None if self.camera is None else camera_of_text(self.camera)
        photographs = Photographs(self.images, camera, every=self.every)
        structure = structure_options(
            photographs, self.mapper, self.scale, known_cameras=camera is not None
        )

        stages = plan_photographs(photographs, options, structure)
        workspace = Workspace(self.output, force=self.force)
        with (
            workspace.lock(),
            single_threaded(),
            self.open_executor(workspace.root) as executor,
        ):
            run_plan(
                stages,
                workspace,
                Work(executor, console.track, self.workers or available_cores()),
                on_start=console.say,
                on_report=lambda report: console.say(describe(report)),
            )
        for line in describe_map(self.output, photographs):
            console.result(line)
        return 0
