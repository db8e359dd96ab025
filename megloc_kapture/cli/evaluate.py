"""``megloc evaluate``: recall tables and reports of localized kapture and pose files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from megloc_kapture.cli.common import Common, Force, side_tables_beside
from megloc_kapture.cli.stages import Inputs
from megloc_kapture.errors import OptionError
from megloc_kapture.io.outputs import staged_output

EVALUATION = "evaluation"


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
