"""``megloc export`` and ``megloc view``: maps and poses for other tools, and for people."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from megloc_kapture.cli.common import Common, Force, Linked, Output, opened_map
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.pipeline.export import ExportFormat, GeoOrigin, export


@dataclass(frozen=True, kw_only=True)
class Export(Common):
    """Write a map, localized queries or both for COLMAP, nerfstudio, evo and viewers."""

    format: tyro.conf.Positional[ExportFormat]
    """colmap: a model; nerfstudio: transforms.json; tum, kitti: a trajectory, as evo reads it; ply:
    points and camera frusta; geojson: camera centres on earth."""
    input: Annotated[Path | None, tyro.conf.arg(aliases=["-i"])] = None
    """Kapture map, or a kapture folder of images with poses."""
    query: Path | None = None
    """Kapture folder of localized queries; trajectories are of these alone where given."""
    output: Output
    """Folder for colmap and nerfstudio, else a file."""
    sensor: str | None = None
    """Images of this camera only; several cameras of one moment are no trajectory."""
    geo_origin: str | None = None
    """Of geojson: latitude,longitude[,height] of the world's origin, whose axes are East, North
    and Up there."""
    force: Force = False
    """Overwrite, or write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        number = export(
            self.format,
            self.output,
            map=self.input,
            query=self.query,
            sensor=self.sensor,
            origin=None if self.geo_origin is None else _origin(self.geo_origin),
            force=self.force,
        )
        console.result(f"{number} images exported: {self.output}")
        return 0


def _origin(text: str) -> GeoOrigin:
    try:
        values = [float(part) for part in text.split(",")]
        if not 2 <= len(values) <= 3:
            raise ValueError
    except ValueError:
        raise OptionError(f"--geo-origin takes latitude,longitude[,height], got {text!r}") from None
    return GeoOrigin(*values)


@dataclass(frozen=True, kw_only=True)
class View(Linked, Common):
    """Write a page that shows a map in 3D, and the queries of a result in it; it needs no
    network."""

    map: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP")]
    """Kapture folder: a map with points, or images with poses; or a COLMAP model."""
    result: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="RESULT")] = None
    """Localized kapture folder, or pose file."""
    gt: Path | None = None
    """Kapture folder with the true poses: queries are coloured by their error, and joined to it."""
    rendered: Path | None = None
    """Kapture folder of `megloc render --along RESULT`: shown beside the queries' photographs."""
    output: Output = Path("view.html")
    """File to write."""
    rerun: Annotated[Path | None, tyro.conf.arg(metavar="FILE.rrd")] = None
    """Write the same, with the images, for Rerun's viewer as well: `rerun FILE.rrd` shows it."""
    open: bool = False
    """Show it in the browser."""
    force: Force = False
    """Overwrite a file that is no view."""

    def run(self) -> int:
        """Run it."""
        # only this command waits for it
        from megloc_kapture.evaluation.view import write_view

        console = self.console()
        for path in (self.result, self.gt, self.rendered):
            if path is not None and not path.exists():
                raise DataError("no such file or folder", path=path)
        for needs, given in (
            ("--gt needs a result to compare with it", self.gt),
            ("--rendered needs the result it is of", self.rendered),
        ):
            if given is not None and self.result is None:
                raise OptionError(f"{needs}: megloc view MAP RESULT")
        folder = self.kapture(opened_map(self.map, console))
        left_out = write_view(
            self.output,
            folder,
            self.result,
            self.gt,
            force=self.force,
            rerun=self.rerun,
            rendered=None if self.rendered is None else self.kapture(self.rendered),
        )
        if left_out:
            console.say(left_out)
        console.result(f"view: {self.output}")
        if self.rerun is not None:
            console.result(f"recording: {self.rerun}")
        if self.open:
            import webbrowser

            if not webbrowser.open(self.output.resolve().as_uri()):
                console.say("no browser could be started; open the file in one")
        return 0
