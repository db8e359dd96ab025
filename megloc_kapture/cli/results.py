"""``megloc evaluate`` and ``megloc submit``: recall tables and pose files of localized kapture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from megloc_kapture.cli.common import Common, Force, Input, Output
from megloc_kapture.cli.stages import Inputs
from megloc_kapture.errors import OptionError
from megloc_kapture.io.outputs import staged_output
from megloc_kapture.io.side_tables import PROTOCOL_FILE

EVALUATION, SIDE_TABLES = "evaluation", "megloc"


def side_tables_beside(result: Path) -> Path | None:
    """The workspace's side tables, where a result lies in a workspace."""
    place = result.resolve().parent / SIDE_TABLES
    return place if (place / PROTOCOL_FILE).is_file() else None


@dataclass(frozen=True, kw_only=True)
class Evaluate(Common):
    """Compare localized queries (kapture folders or pose files) with their true poses."""

    gt: Path
    """Kapture folder with the true poses."""
    input: Inputs = ()
    """Localized kapture folder, or pose file; may be repeated."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder for recall.json, recall.txt, per_query.csv and report.html."""
    thresholds: tuple[str, ...] = ()
    """Recall thresholds, metres and degrees: 0.25,2 0.5,5."""
    side_tables: Path | None = None
    """The workspace's megloc/ folder (conditions, protocol); found beside a result by itself."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        # they import matplotlib, which the other commands need not wait for
        from megloc_kapture.evaluation.folders import evaluate_folders
        from megloc_kapture.evaluation.outputs import write_evaluation
        from megloc_kapture.evaluation.tables import recall_table
        from megloc_kapture.evaluation.thresholds import Threshold

        console = self.console()
        if not self.input:
            raise OptionError("no result given; use -i")
        thresholds = [Threshold.parse(text) for text in self.thresholds] or None
        evaluations = [
            evaluate_folders(
                result,
                self.gt,
                side_tables=self.side_tables or side_tables_beside(result),
                thresholds=thresholds,
                label=str(result),
            )
            for result in self.input
        ]
        if self.output is not None:
            with staged_output(self.output, kind=EVALUATION, force=self.force) as out:
                for number, evaluation in enumerate(evaluations):
                    place = out if len(evaluations) == 1 else out / f"{number + 1}"
                    write_evaluation(place, evaluation)
        for evaluation in evaluations:
            console.result(recall_table(evaluation))
        return 0


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
