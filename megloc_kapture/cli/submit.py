"""``megloc submit``: the pose file of a localized kapture."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from megloc_kapture.cli.common import Common, Force, Input, Output, side_tables_beside
from megloc_kapture.errors import OptionError


@dataclass(frozen=True, kw_only=True)
class Submit(Common):
    """Write the pose file of a localized kapture folder, and its provenance beside it."""

    dataset: tyro.conf.Positional[str]
    """Dataset whose rules for names hold: kapture, synthetic."""
    input: Input
    """Localized kapture folder."""
    output: Output
    """Pose file."""
    force: Force = False
    """Overwrite the pose file."""

    def run(self) -> int:
        """Run it."""
        from megloc_kapture.pipeline.datasets import DATASETS
        from megloc_kapture.pipeline.evaluation_plan import write_submission

        console = self.console()
        if self.dataset not in DATASETS:
            raise OptionError(f"unknown dataset {self.dataset!r}; known: {', '.join(DATASETS)}")
        if self.output.exists() and not self.force:
            raise OptionError(f"{self.output} exists; -f overwrites it")
        counts = write_submission(
            self.input,
            self.output,
            tables=side_tables_beside(self.input),
            provenance={"dataset": self.dataset},
        )
        console.result(f"{counts['poses']} poses of {counts['queries']} queries: {self.output}")
        return 0
