"""``megloc evaluate``: recall tables and reports of localized kapture and pose files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from megloc_kapture.cli.common import Common, Force, existing
from megloc_kapture.cli.stages import Inputs
from megloc_kapture.errors import OptionError
from megloc_kapture.io.outputs import staged_output

if TYPE_CHECKING:
    from megloc_kapture.evaluation.rules import Rules
    from megloc_kapture.evaluation.surroundings import Surroundings
    from megloc_kapture.evaluation.thresholds import Threshold
    from megloc_kapture.values import RigidTransform

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
        # they import matplotlib, which the other commands need not wait for
        from megloc_kapture.evaluation.rules import read_rules
        from megloc_kapture.evaluation.surroundings import side_tables_near, surroundings_of
        from megloc_kapture.evaluation.thresholds import Threshold

        console = self.console()
        self._check()
        tables = self.side_tables
        places = [self.gt, *self.input] if self.gt is not None else list(self.input)
        for place in places:
            tables = tables or side_tables_near(place)
        rules = read_rules(tables, self.dataset)
        thresholds = [Threshold.parse(text) for text in self.thresholds] or rules.thresholds()
        around = [surroundings_of(result, mapping=self.map) for result in self.input]
        if self.gt is None:
            console.result(self._without_truth(rules, thresholds, around))
        else:
            console.result(self._with_truth(self.gt, rules, thresholds, around))
        return 0

    def _check(self) -> None:
        if not self.input:
            raise OptionError("no result given; use -i")
        resolved = [place.resolve() for place in self.input]
        twice = next((p for p in self.input if resolved.count(p.resolve()) > 1), None)
        if twice is not None:
            raise OptionError(f"{twice} is given twice")
        if self.seeds and len(self.input) < 2:
            raise OptionError("--seeds needs at least two results (-i)")
        if self.seeds and self.gt is None:
            raise OptionError("--seeds needs true poses (--gt)")
        existing([place for place in (self.side_tables, self.map) if place is not None])

    def _with_truth(
        self,
        truth: Path,
        rules: Rules,
        thresholds: Sequence[Threshold],
        around: Sequence[Surroundings],
    ) -> str:
        from megloc_kapture.evaluation.comparison import compare
        from megloc_kapture.evaluation.comparison_outputs import write_comparison, write_seeds
        from megloc_kapture.evaluation.comparison_text import comparison_text, seeds_text
        from megloc_kapture.evaluation.folders import evaluate_results
        from megloc_kapture.evaluation.outputs import write_evaluation
        from megloc_kapture.evaluation.seeds import over_seeds
        from megloc_kapture.evaluation.tables import recall_table

        evaluations = evaluate_results(
            self.input, truth, rules, thresholds=thresholds, mapping=self.map
        )
        poses = _map_poses(around) if self.output is not None else {}
        if self.seeds:
            seeds = over_seeds(evaluations)
            if self.output is not None:
                with staged_output(self.output, kind=EVALUATION, force=self.force) as out:
                    write_seeds(out, seeds, map_poses=poses, around=around)
            return seeds_text(seeds)
        if len(evaluations) > 1:
            comparison = compare(evaluations)
            if self.output is not None:
                with staged_output(self.output, kind=EVALUATION, force=self.force) as out:
                    write_comparison(out, comparison, map_poses=poses, around=around)
            return comparison_text(comparison)
        if self.output is not None:
            with staged_output(self.output, kind=EVALUATION, force=self.force) as out:
                write_evaluation(out, evaluations[0], map_poses=poses, around=around[0])
        return recall_table(evaluations[0])

    def _without_truth(
        self,
        rules: Rules,
        thresholds: Sequence[Threshold],
        around: Sequence[Surroundings],
    ) -> str:
        from megloc_kapture.evaluation.folders import results_without_truth
        from megloc_kapture.evaluation.without_truth_outputs import write_without_truth
        from megloc_kapture.evaluation.without_truth_text import without_truth_text

        poses = _map_poses(around)
        found = results_without_truth(self.input, rules, thresholds=thresholds, map_poses=poses)
        if self.output is not None:
            with staged_output(self.output, kind=EVALUATION, force=self.force) as out:
                write_without_truth(out, found, map_poses=poses, around=around)
        return without_truth_text(found)


def _map_poses(around: Sequence[Surroundings]) -> dict[str, RigidTransform]:
    """Of the first result that has a map."""
    return next((poses for place in around if (poses := place.map_poses())), {})
