"""``megloc view``: a map, and a result in it, in 3D."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from megloc_kapture.cli.common import Common, Force, Linked, Output, opened_map
from megloc_kapture.errors import DataError, OptionError


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
        if self.gt is not None and self.result is None:
            raise OptionError("--gt needs a result to compare with it: megloc view MAP RESULT")
        if self.rendered is not None and self.result is None:
            raise OptionError("--rendered needs the result it is of: megloc view MAP RESULT")
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
