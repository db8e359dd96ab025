"""Commands to import, render, export and view data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from megloc_kapture.cli.common import (
    Common,
    Console,
    Force,
    Linked,
    Output,
    Overwrite,
    Texts,
    Working,
    opened_map,
)
from megloc_kapture.datasets.colmap_map import find_colmap
from megloc_kapture.datasets.kapture_folders import QUERY
from megloc_kapture.datasets.megadepth import MegaDepthOptions, import_megadepth
from megloc_kapture.io.dataset_tables import NO_METRES, SIDE_TABLES
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
from megloc_kapture.pipeline.presets import assigned, options_with
from megloc_kapture.stages.localized_folder import set_aside_unreadable
from megloc_kapture.stages.stage import MAP
from megloc_kapture.stages.work import Work

DATASET, COLMAP, MEGADEPTH = "dataset", "colmap", "megadepth"


@dataclass(frozen=True, kw_only=True)
class Import(Common):
    """Bring a dataset into DIR/{mapping,query,query_gt,megloc}, or a COLMAP model into a map.

    Images are linked, not copied."""

    dataset: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATASET")]
    """aachen, robotcar, 4seasons, inloc, kapture: any pair of kapture folders; colmap: a model;
    megadepth: to train on, DIR/SCENE each."""
    root: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="ROOT")]
    """Folder of the dataset, laid out as it is published; of colmap the model (sparse/0), or the
    workspace around it."""
    output: Output
    """Where to."""
    images: Path | None = None
    """Of colmap: folder of the images; images/ beside the model or around it unless given."""
    database: Path | None = None
    """Of colmap: the features; database.db beside the model or around it unless given."""
    unit: Literal["m", "units"] = "units"
    """Of colmap: m says that the model is in metres; its scale is unknown unless given."""
    allow_missing: bool = False
    """Import what is there of a partial download."""
    set: Texts = ()
    """An option of the dataset: key=value (version=1.0, reference_model=true); may be repeated."""
    query_prefix: str = ""
    """Put the queries into a folder of this name, where they share names with the map."""
    force: Overwrite = False
    """Write into a folder that has other things in it; of colmap: map poses that contradict the
    matches of their images."""

    def run(self, console: Console) -> None:
        name = self.dataset.removeprefix(TWIN_PREFIX)
        if name == COLMAP:
            self._import_colmap(console)
            return
        if name == MEGADEPTH:
            self._import_megadepth(console)
            return
        choice = choose_dataset(
            KAPTURE if name == SYNTHETIC else name,
            self.root,
            import_options=assigned(self.set),
            query_prefix=self.query_prefix,
            allow_missing=self.allow_missing,
        )
        choice.check()
        with staged_output(self.output, kind=DATASET, force=self.force) as out:
            counts = choice.import_to(self.root, out)
            work = Work(track=console.track)
            unreadable = set_aside_unreadable(out / QUERY, out / SIDE_TABLES, work)
            summary = out / SUMMARY_FILE
            text = summary.read_text(encoding="utf-8") if summary.is_file() else ""
        console.counts(counts)
        for name, reason in unreadable.items():
            console.say(f"warning: query {name} cannot be used and will fail: {reason}")
        if text:
            console.result(text.rstrip())

    def _import_colmap(self, console: Console) -> None:
        source = find_colmap(self.root, images=self.images, database=self.database)
        with (
            staged_output(self.output, kind=MAP, force=self.force) as out,
            open_executor("processes") as executor,
        ):
            work = Work(executor, console.track, force=self.force)
            counts = import_colmap(source, out, unit=self.unit, work=work)
        for what, found in (("images", source.images), ("database", source.database)):
            console.say(f"{what}: {found or 'none'}")
        console.counts(counts)
        if self.unit == NO_METRES:
            console.say("unit: units of the map, whose scale is not known; --unit m if in metres")

    def _import_megadepth(self, console: Console) -> None:
        options = options_with(MegaDepthOptions, self.set)
        with staged_output(self.output, kind=MEGADEPTH, force=self.force) as out:
            work = Work(track=console.track)
            counts = import_megadepth(self.root, out, options, work=work)
        console.counts(counts)


@dataclass(frozen=True, kw_only=True)
class Synth(Working):
    """Render a dataset: the synthetic world as kapture, or a small twin in an official layout."""

    dataset: tyro.conf.Positional[str] = SYNTHETIC
    """synthetic: the world as plain kapture; aachen, robotcar, 4seasons, inloc: its twin."""
    output: Output
    """Where to."""
    seed: int = 0
    """Another seed is another world."""
    set: Texts = ()
    """An option of the world: key=value; may be repeated."""
    force: Force = False

    def run(self, console: Console) -> None:
        changes = {"seed": self.seed, **assigned(self.set)}
        twin = twin_of(self.dataset.removeprefix(TWIN_PREFIX), **changes)
        with (
            staged_output(self.output, kind=DATASET, force=self.force) as out,
            self.open_executor(out) as executor,
        ):
            counts = twin.write(out, Work(executor, console.track))
        console.counts(counts)
        console.result(f"rendered: {self.output}")


@dataclass(frozen=True, kw_only=True)
class Export(Common):
    """Write a map, localized queries or both for COLMAP, nerfstudio, evo and viewers."""

    format: tyro.conf.Positional[ExportFormat]
    """colmap: a model; nerfstudio: transforms.json; tum: a trajectory, as evo reads it; ply: points
    and camera frusta."""
    input: Annotated[Path | None, tyro.conf.arg(aliases=["-i"])] = None
    """Kapture map, or a kapture folder of images with poses."""
    query: Path | None = None
    """Kapture folder of localized queries; trajectories are of these alone where given."""
    output: Output
    """Folder for colmap and nerfstudio, else a file."""
    sensor: str | None = None
    """Images of this camera only; several cameras of one moment are no trajectory."""
    undistort: bool = False
    """Of colmap: also write images/, undistorted, and the model of these in sparse/0, with PINHOLE
    cameras, as programs for Gaussian splatting read them."""
    force: Overwrite = False
    """Overwrite, or write into a folder that has other things in it."""

    def run(self, console: Console) -> None:
        number = export(
            self.format,
            self.output,
            map=self.input,
            query=self.query,
            sensor=self.sensor,
            undistort=self.undistort,
            force=self.force,
        )
        console.result(f"{number} images exported: {self.output}")


@dataclass(frozen=True, kw_only=True)
class View(Linked, Common):
    """Write a page that shows a map in 3D, and the queries of a result in it; it needs no
    network."""

    map: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP")]
    """Kapture folder: a map with points, or images with poses; or a COLMAP model."""
    result: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="RESULT")] = None
    """Localized kapture folder, pose file or COLMAP model."""
    gt: Path | None = None
    """The true poses, likewise: queries are coloured by their error, and joined to it."""
    output: Output = Path("view.html")
    """File to write."""
    open: bool = False
    """Show it in the browser."""
    force: Overwrite = False
    """Overwrite a file that is no view."""

    def run(self, console: Console) -> None:
        # slow import
        from megloc_kapture.evaluation.view import write_view

        folder = self.kapture(opened_map(self.map, console))
        left_out = write_view(self.output, folder, self.result, self.gt, force=self.force)
        if left_out:
            console.say(left_out)
        console.result(f"view: {self.output}")
        if self.open:
            import webbrowser

            if not webbrowser.open(self.output.resolve().as_uri()):
                console.say("no browser could be started; open the file in one")
