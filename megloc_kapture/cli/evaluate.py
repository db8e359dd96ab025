"""``megloc evaluate``: recall tables and reports of localized kapture and pose files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from megloc_kapture.cli.common import Common, Force, existing
from megloc_kapture.cli.stages import Inputs
from megloc_kapture.errors import OptionError
from megloc_kapture.io.output_folders import staged_output

EVALUATION = "evaluation"


@dataclass(frozen=True, kw_only=True)
class Evaluate(Common):
    """Compare localized queries (kapture folders or pose files) with their true poses, and two or
    more results with each other."""

    input: Inputs = ()
    """Localized kapture folder, or pose file; may be repeated to compare results."""
    gt: Path | None = None
    """Kapture folder with the true poses; without it, says what can be known without truth."""
    dataset: str | None = None
    """Dataset whose thresholds, conditions and pools hold: aachen, robotcar, 4seasons, inloc, ...;
    the workspace's protocol unless given."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder for tables (text, JSON, CSV) and report.html."""
    thresholds: tuple[str, ...] = ()
    """Recall thresholds, metres and degrees: 0.25,2 0.5,5."""
    seeds: bool = False
    """The results are runs of one method with different seeds: report mean and spread."""
    side_tables: Path | None = None
    """The workspace's megloc/ folder (conditions, protocol); found beside truth or results by
    itself."""
    map: Path | None = None
    """Kapture folder of the map, for the report; found in the workspace by itself."""
    force: Force = False
    """Write into a folder that has other things in it."""

    def run(self) -> int:
        """Run it."""
        # only this command waits for them
        from megloc_kapture.evaluation.evaluate import (
            benchmark_beside,
            evaluate_results,
            results_without_truth,
        )
        from megloc_kapture.evaluation.metrics import Threshold
        from megloc_kapture.evaluation.report.reports import AnyReported, report_text, write_report
        from megloc_kapture.evaluation.statistics import compare, over_seeds

        console = self.console()
        self._check()
        benchmark = benchmark_beside(
            [self.gt, *self.input], side_tables=self.side_tables, dataset=self.dataset
        )
        thresholds = [Threshold.parse(text) for text in self.thresholds] or None
        found: AnyReported
        if self.gt is None:
            found = results_without_truth(
                self.input, benchmark, thresholds=thresholds, mapping=self.map
            )
        else:
            evaluations = evaluate_results(
                self.input, self.gt, benchmark, thresholds=thresholds, mapping=self.map
            )
            found = evaluations[0]
            if self.seeds:
                found = over_seeds(evaluations)
            elif len(evaluations) > 1:
                found = compare(evaluations)
        if self.output is not None:
            with staged_output(self.output, kind=EVALUATION, force=self.force) as out:
                write_report(out, found)
        console.result(report_text(found))
        return 0

    def _check(self) -> None:
        if not self.input:
            raise OptionError("no result given; use -i")
        resolved = [path.resolve() for path in self.input]
        twice = next((p for p in self.input if resolved.count(p.resolve()) > 1), None)
        if twice is not None:
            raise OptionError(f"{twice} is given twice")
        if self.seeds and len(self.input) < 2:
            raise OptionError("--seeds needs at least two results (-i)")
        if self.seeds and self.gt is None:
            raise OptionError("--seeds needs true poses (--gt)")
        existing([path for path in (self.side_tables, self.map) if path is not None])
