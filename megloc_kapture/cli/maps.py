"""Commands that make and refine maps, and refine poses with a map."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import tyro

from megloc_kapture.cli.common import (
    AllowedLinks,
    Choosing,
    Force,
    Input,
    Output,
    Overwrite,
    Reading,
    Texts,
    Working,
    cameras_of_text,
    kapture_map,
)
from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.report.content import consistency_sentence
from megloc_kapture.io.colmap_mapping import Mapper
from megloc_kapture.io.csv_table import read_records
from megloc_kapture.io.dataset_tables import read_tables_of, unit_of, write_unit
from megloc_kapture.io.files import reading
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.output_folders import check_new_file
from megloc_kapture.io.tables import CONSISTENCY_FILE, ConsistencyRow
from megloc_kapture.pipeline.map_making import (
    describe_map,
    options_of_photographs,
    plan_photographs,
)
from megloc_kapture.pipeline.plan import Workspace, run_plan
from megloc_kapture.pipeline.presets import DEFAULT_PRESET
from megloc_kapture.pipeline.query_folders import Photographs
from megloc_kapture.plugin_loading import plugin_names
from megloc_kapture.plugins import POSE_REFINERS
from megloc_kapture.stages.densifying import densify_map, fitted_to_poses
from megloc_kapture.stages.map_refinement import REPORT_FILE, refine_map
from megloc_kapture.stages.paths import LOCALIZED, MAP
from megloc_kapture.stages.pose_refinement import refine_poses
from megloc_kapture.stages.stage import counts_text
from megloc_kapture.stages.stereo_depth import fuse_depth


@dataclass(frozen=True, kw_only=True)
class MapPhotographs(Choosing, Working):
    """Make a map from photographs without poses; results that are up to date are kept."""

    images: tyro.conf.Positional[tuple[Path, ...]]
    """Photographs, videos, or folders of them; or a kapture folder of images without poses."""
    output: Output
    """Workspace; all commands accept it as a map. Its folder map/ is the kapture map."""
    mapper: Mapper = "incremental"
    """COLMAP's mapper."""
    scale: tuple[str, ...] = ()
    """Source of the scale. gps: positions in EXIF; IMAGE IMAGE METRES: two photographs and the
    distance between their cameras. If omitted, the scale is arbitrary."""
    camera: str | None = None
    """Fixed camera of all images, which are then not rotated by EXIF: MODEL,WIDTH,HEIGHT,PARAMETERS
    as in COLMAP; or a file with a row NAME MODEL WIDTH HEIGHT PARAMETERS per image."""
    every: int | None = None
    """Use every N-th frame of videos; if omitted, 30."""
    force: Force = False

    def run(self) -> None:
        options = options_of_photographs(self.preset or DEFAULT_PRESET, self.assignments())
        photographs = Photographs(self.images, cameras_of_text(self.camera), every=self.every)
        stages = plan_photographs(photographs, options, self.mapper, self.scale)
        workspace = Workspace(self.output, force=self.force)
        with self.working_in(workspace) as work:
            run_plan(stages, workspace, work, say=self.say)
        for line in describe_map(self.output, photographs):
            print(line)


@dataclass(frozen=True, kw_only=True)
class RefineMap(Reading, Choosing, Working):
    """Remove points and observations that a map's depth maps contradict.

    --set refinement.uncertainty.max_robust_sigmas=2.5 also rejects uncertain points; if it is
    omitted, the preset decides.
    """

    input: Input
    """Kapture folder of the map; not modified."""
    output: Output
    """Kapture folder of the refined map."""
    force: Force = False

    def run(self) -> None:
        options = self.options().refinement
        source = self.kapture_map(self.input)
        with self.staged(self.output, MAP, force=self.force) as (out, work):
            refine_map(source, out, options, tables=read_tables_of(source.root), work=work)
            write_unit(out, unit_of(source.root))
        for row in report_lines(self.output):
            self.say(row)


def report_lines(root: Path) -> list[str]:
    """Tabulate the points and observations that refinement removed; empty without refinement."""
    path = root / "reconstruction" / REPORT_FILE
    if not path.is_file():
        return []
    with reading(path, "a report of map refinement"):
        report = json.loads(path.read_text())
        rows: list[tuple[str, object, object]] = [
            ("", "points", "observations"),
            ("before", report["points_before"], report["observations_before"]),
            *(
                (step["name"].replace("_", " "), f"-{step['points']}", f"-{step['observations']}")
                for step in report["filters"]
            ),
            ("after", report["points_after"], report["observations_after"]),
        ]
    return [f"{name:22s}{points!s:>10s}{seen!s:>14s}" for name, points, seen in rows]


@dataclass(frozen=True, kw_only=True)
class Densify(Reading, Choosing, Working):
    """Estimate depth of map images without depth, by multi-view stereo.

    The depth maps are kapture depth records; verification, perceptual ranking and refinement by
    rendering use them like those of a depth sensor.
    """

    input: Input
    """Kapture folder of the map, with points; not modified."""
    output: Output
    """Kapture folder of the map with depth."""
    by: str | None = None
    """Estimator: sweep, colmap or a plugin; if omitted, sweep."""
    points: bool = False
    """Also create 3D points, with uncertainty, from the depth of keypoints without a point."""
    fuse: Path | None = None
    """Write the fused point cloud to this PLY file."""
    force: Overwrite = False
    """Write into a non-empty folder, and overwrite the PLY file."""

    def run(self) -> None:
        if self.fuse is not None:
            check_new_file(self.fuse, force=self.force)
        chosen: dict[str, object] = {"mode": "points" if self.points else "depth"}
        if self.by is not None:
            chosen["estimator"] = {"name": self.by}
        options = self.options({"mvs": chosen}).mvs
        source = self.kapture_map(self.input)
        with self.staged(self.output, MAP, force=self.force) as (out, work):
            counts = densify_map(
                source, out, options, tables=read_tables_of(source.root), work=work
            )
            write_unit(out, unit_of(source.root))
            self.say(counts_text(counts))
            if self.fuse is not None:
                tolerance_px = fitted_to_poses(source, options.max_size_px).tolerance_px
                fused = fuse_depth(KaptureFolder(out), self.fuse, tolerance_px, work=work)
                self.say(f"{fused} points in {self.fuse}")


@dataclass(frozen=True, kw_only=True)
class RefinePoses(Choosing, Working):
    """Refine the poses of localized queries; a refined pose that is no better is rejected, and
    the reason recorded."""

    allow_links_below: AllowedLinks = ()
    input: Input
    """Kapture map, with images and depth maps. Read only."""
    query: Path
    """Kapture folder with the queries' images, and their depth maps for icp."""
    poses: Path
    """Result of megloc localize or megloc eval: kapture folder with status.csv."""
    output: Output
    """Kapture folder of the refined result, with status.csv and the tables of refinement."""
    by: Texts = ()
    """Pose refiner: icp, rendering or field; repeat to apply several in order; if omitted,
    the preset's."""
    force: Force = False

    def run(self) -> None:
        changes: dict[str, object] = {"pose_refinement": {"by": list(self.by)}} if self.by else {}
        options = self.options(changes).pose_refinement
        if self.by:  # in the order of --by, with options from --set
            options = options.with_refiners(self.by)
        if not options.refines():
            names = ", ".join(plugin_names(POSE_REFINERS))
            raise OptionError(f"no pose refiner is chosen; give --by: {names}")
        with self.staged(self.output, LOCALIZED, force=self.force) as (out, work):
            counts = refine_poses(
                kapture_map(self.input),
                KaptureFolder(self.query),
                KaptureFolder(self.poses),
                out,
                options,
                tables=read_tables_of(self.query),
                work=work,
            )
        print(f"{counts_text(counts)}; status.csv and refinement.csv in {self.output}")
        if (table := self.output / CONSISTENCY_FILE).is_file():
            for row in read_records(table, ConsistencyRow):
                print(consistency_sentence(row))
