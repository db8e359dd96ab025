"""``megloc submit``: the pose files of a localized kapture, as its challenge takes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import tyro

from megloc_kapture.cli.common import Common, Force, Input, Output, side_tables_beside
from megloc_kapture.errors import DataError, OptionError


@dataclass(frozen=True, kw_only=True)
class Submit(Common):
    """Write the pose file of a localized kapture folder, and its provenance beside it."""

    dataset: tyro.conf.Positional[str]
    """Dataset whose rules hold: aachen, robotcar, 4seasons, inloc, kapture, synthetic or a twin."""
    input: Input
    """Localized kapture folder."""
    output: Output
    """Pose file; for 4seasons the folder that gets one per relocalization file."""
    side_tables: Path | None = None
    """The megloc/ folder of the imported dataset; found beside the result by itself."""
    from_rig: bool = False
    """Queries without a pose get one through the rig, from another camera of their moment."""
    force: Force = False
    """Overwrite the pose file."""

    def run(self) -> int:
        """Run it."""
        from megloc_kapture.io.dataset_tables import Protocol, read_protocol
        from megloc_kapture.pipeline.submission import (
            check_dataset,
            workspace_provenance,
            write_submission,
        )

        console = self.console()
        if self.side_tables is not None and not self.side_tables.is_dir():
            raise DataError("no such folder", path=self.side_tables)
        tables = self.side_tables or side_tables_beside(self.input)
        rules = Protocol() if tables is None else read_protocol(tables)
        check_dataset(self.dataset, rules, tables=tables)
        self._check_output(folder=rules.pose_file == "mlad")
        counts = write_submission(
            self.input,
            self.output,
            tables=None if tables is None else tables.resolve(),
            provenance={"dataset": self.dataset, **workspace_provenance(self.input)},
            from_rig=self.from_rig,
        )
        console.result(f"{summary(counts)}: {self.output}")
        return 0

    def _check_output(self, *, folder: bool) -> None:
        place = self.output
        if place.is_dir() != folder and place.exists():
            kind = "folder, one file per relocalization file" if folder else "file"
            raise OptionError(f"{place} exists and is not what is to be written, a {kind}")
        if place.exists() and not self.force and (not folder or any(place.iterdir())):
            raise OptionError(f"{place} exists; -f overwrites it")


def summary(counts: Mapping[str, int]) -> str:
    """What has been written, in one line."""
    text = f"{counts['poses']} poses of {counts['scored']} queries"
    if counts["scored"] != counts["queries"] and not counts["dummies"]:
        text += f" that are scored ({counts['queries']} in all)"
    parts = [
        f"{counts['missing']} missing" if counts["missing"] else "",
        "dummies in their place" if counts["dummies"] else "",
        f"{counts['fallbacks']} of the poses guessed" if counts["fallbacks"] else "",
        f"{counts['from_rig']} from the rig" if counts["from_rig"] else "",
    ]
    return ", ".join([text, *filter(None, parts)])
