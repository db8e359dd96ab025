"""``megloc export``: maps and poses for other tools."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from megloc_kapture.cli.common import Common, Force, Output
from megloc_kapture.errors import OptionError
from megloc_kapture.pipeline.export import ExportFormat, export
from megloc_kapture.pipeline.export_formats import GeoOrigin


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
