"""Commands to import, render, export and view data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from megloc_kapture.cli.common import (
    AllowedLinks,
    Common,
    Force,
    Output,
    Overwrite,
    Texts,
    Working,
    print_counts,
)
from megloc_kapture.datasets.colmap_map import find_colmap
from megloc_kapture.datasets.megadepth import MegaDepthOptions, import_megadepth
from megloc_kapture.errors import check_option
from megloc_kapture.io.dataset_tables import NO_METRES, SIDE_TABLES
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.output_folders import staged_output
from megloc_kapture.pipeline.datasets import (
    KAPTURE,
    SUMMARY_FILE,
    SYNTHETIC,
    TWIN_PREFIX,
    choose_dataset,
    twin_of,
)
from megloc_kapture.pipeline.executors import open_executor
from megloc_kapture.pipeline.export import ExportFormat, export
from megloc_kapture.pipeline.map_making import import_colmap
from megloc_kapture.pipeline.presets import options_with, parse_assignments
from megloc_kapture.stages.localized_folder import set_aside_unreadable
from megloc_kapture.stages.paths import MAP, QUERY
from megloc_kapture.stages.work import Work

DATASET, COLMAP, MEGADEPTH = "dataset", "colmap", "megadepth"


@dataclass(frozen=True, kw_only=True)
class Import(Common):
    """Import a dataset into DIR/{mapping,query,query_gt,megloc}, or a COLMAP model as a map.

    Images are linked, not copied.
    """

    dataset: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATASET")]
    """aachen, robotcar, 4seasons, inloc; kapture: any pair of kapture folders; colmap: a model;
    megadepth: training data, a folder DIR/SCENE per scene."""
    folder: Annotated[
        tyro.conf.Positional[Path | None],
        tyro.conf.arg(metavar="ROOT", help_behavior_hint="(required)"),
    ] = None
    """Folder of the dataset in its published layout; for colmap the model (sparse/0), or the
    workspace that contains it."""
    root: Path | None = None
    """The same as ROOT, as in megloc eval."""
    output: Output
    """Output folder."""
    images: Path | None = None
    """For colmap: folder of the images; if omitted, images/ next to the model or in a parent
    folder."""
    database: Path | None = None
    """For colmap: database of the features; if omitted, database.db next to the model or in a
    parent folder."""
    unit: Literal["m", "units"] = "units"
    """For colmap: m if the model is in metres; if omitted, unknown scale."""
    allow_missing: bool = False
    """Accept a partial download."""
    set: Texts = ()
    """An option of the dataset: key=value (version=1.0, reference_model=true); may be repeated."""
    query_prefix: str = ""
    """Folder to put the queries into; needed if they share names with map images."""
    force: Overwrite = False
    """Write into a non-empty folder; for colmap: accept poses that contradict the matches of their
    images."""

    def run(self) -> None:
        name = self.dataset.removeprefix(TWIN_PREFIX)
        given = [path for path in (self.folder, self.root) if path is not None]
        check_option(len(given) == 1, "give one folder: megloc import DATASET ROOT -o OUTPUT")
        [root] = given
        if name == COLMAP:
            self._import_colmap(root)
            return
        if name == MEGADEPTH:
            self._import_megadepth(root)
            return
        choice = choose_dataset(
            KAPTURE if name == SYNTHETIC else name,
            root,
            import_options=parse_assignments(self.set),
            query_prefix=self.query_prefix,
            allow_missing=self.allow_missing,
        )
        choice.check()
        with staged_output(self.output, kind=DATASET, force=self.force, inputs=[root]) as out:
            counts = choice.import_to(root, out)
            work = Work(track=self.track)
            unreadable = set_aside_unreadable(out / QUERY, out / SIDE_TABLES, work)
        print_counts(counts)
        for name, reason in unreadable.items():
            self.say(f"warning: query {name} cannot be used and will fail: {reason}")
        if (summary := self.output / SUMMARY_FILE).is_file():
            print(summary.read_text(encoding="utf-8").rstrip())

    def _import_colmap(self, root: Path) -> None:
        source = find_colmap(root, images=self.images, database=self.database)
        with (
            staged_output(self.output, kind=MAP, force=self.force, inputs=[root]) as out,
            open_executor("processes") as executor,
        ):
            work = Work(executor, self.track, force=self.force)
            counts = import_colmap(source, out, unit=self.unit, work=work)
        for what, path in (("images", source.images), ("database", source.database)):
            self.say(f"{what}: {path or 'none'}")
        print_counts(counts)
        if self.unit == NO_METRES:
            self.say("unit: unknown scale; use --unit m if the map is in metres")

    def _import_megadepth(self, root: Path) -> None:
        options = options_with(MegaDepthOptions, self.set)
        with staged_output(self.output, kind=MEGADEPTH, force=self.force) as out:
            work = Work(track=self.track)
            counts = import_megadepth(root, out, options.scenes, work=work)
        print_counts(counts)


@dataclass(frozen=True, kw_only=True)
class Synth(Working):
    """Render a dataset: a synthetic world as kapture, or a small twin of a public dataset."""

    dataset: tyro.conf.Positional[str] = SYNTHETIC
    """synthetic: a world as kapture folders; aachen, robotcar, 4seasons, inloc: a twin of this
    dataset in its official layout."""
    output: Output
    """Output folder."""
    seed: int = 0
    """Seed of the world."""
    set: Texts = ()
    """An option of the world: key=value; may be repeated."""
    force: Force = False

    def run(self) -> None:
        changes = {"seed": self.seed, **parse_assignments(self.set)}
        twin = twin_of(self.dataset.removeprefix(TWIN_PREFIX), **changes)
        with self.staged(self.output, DATASET, force=self.force) as (out, work):
            counts = twin.write(out, work)
        print_counts(counts)
        print(f"rendered: {self.output}")


@dataclass(frozen=True, kw_only=True)
class Export(Common):
    """Write a map, localized queries or both for COLMAP, nerfstudio, evo and viewers."""

    format: tyro.conf.Positional[ExportFormat]
    """colmap: a model; nerfstudio: transforms.json; tum: a trajectory, for evo; ply: points and
    camera frusta."""
    input: Annotated[Path | None, tyro.conf.arg(aliases=["-i"])] = None
    """Kapture map, or a kapture folder of images with poses."""
    query: Path | None = None
    """Kapture folder of localized queries; a tum trajectory then contains only these."""
    output: Output
    """Folder for colmap and nerfstudio, else a file."""
    sensor: str | None = None
    """Export only the images of this camera; required for tum if cameras share timestamps."""
    undistort: bool = False
    """For colmap: write undistorted images/ and their model with PINHOLE cameras to sparse/0, the
    layout that programs for Gaussian splatting read."""
    force: Overwrite = False
    """Overwrite, or write into a non-empty folder."""

    def run(self) -> None:
        number = export(
            self.format,
            self.output,
            map=self.input,
            query=self.query,
            sensor=self.sensor,
            undistort=self.undistort,
            force=self.force,
        )
        print(f"{number} images exported: {self.output}")


@dataclass(frozen=True, kw_only=True)
class View(Common):
    """Write a page that shows a map and localized queries in 3D; it works offline."""

    allow_links_below: AllowedLinks = ()
    map: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP")]
    """Kapture folder: a map with points, or images with poses; or a COLMAP model."""
    result: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="RESULT")] = None
    """Localized kapture folder, pose file or COLMAP model."""
    gt: Path | None = None
    """True poses, in the same formats as RESULT. Queries are then coloured by their error and
    joined to their true poses."""
    output: Output = Path("view.html")
    """File to write."""
    open: bool = False
    """Open the page in a browser."""
    force: Overwrite = False
    """Overwrite a file that is not a view."""

    def run(self) -> None:
        # slow import
        from megloc_kapture.evaluation.view import write_view

        folder = KaptureFolder(self.opened_map(self.map))
        left_out = write_view(self.output, folder, self.result, self.gt, force=self.force)
        if left_out:
            self.say(left_out)
        print(f"view: {self.output}")
        if self.open:
            import webbrowser

            if not webbrowser.open(self.output.resolve().as_uri()):
                self.say("no browser could be started; open the file manually")
