"""``megloc eval``: everything, from a dataset to a pose file and a recall table; resumable."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from megloc_kapture.cli.common import Common, Deciding, Force, Working
from megloc_kapture.cli.console import Console
from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.metrics import Threshold
from megloc_kapture.evaluation.report.document import REPORT_HTML
from megloc_kapture.evaluation.report.reports import (
    AGREEMENT_TEXT,
    RECALL_JSON,
    RECALL_TEXT,
)
from megloc_kapture.io.tables import STATUS_FILE, read_status
from megloc_kapture.pipeline.ablation import (
    fresh_copy,
    outcome,
    outcomes_text,
    variants,
    write_outcomes,
)
from megloc_kapture.pipeline.benchmarks import BenchmarkFile
from megloc_kapture.pipeline.datasets import (
    DatasetChoice,
)
from megloc_kapture.pipeline.evaluation_plan import plan_evaluation
from megloc_kapture.pipeline.executors import available_cores, single_threaded
from megloc_kapture.pipeline.paper_steps import (
    steps_text,
)
from megloc_kapture.pipeline.plan import all_kept, describe, run_plan
from megloc_kapture.pipeline.run import RunChoice, choose_run
from megloc_kapture.pipeline.submissions_folder import FOLDER, keep_submission
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.stages.layout import EVALUATION, LOCALIZED
from megloc_kapture.stages.stage import Stage
from megloc_kapture.stages.work import Work

BELOW_RECALL = 3


@dataclass(frozen=True, kw_only=True)
class Eval(Deciding, Working, Common):
    """Run all stages on a dataset; what is done and still true is kept."""

    dataset: tyro.conf.Positional[str] = "synthetic-aachen"
    """aachen, robotcar, 4seasons, inloc; synthetic-X: a rendered twin of one of them; kapture: any
    pair of kapture folders; synthetic: the rendered world as plain kapture."""
    root: Path | None = None
    """Folder of the dataset as it is published; looked for below MEGLOC_DATA unless given."""
    allow_missing: bool = False
    """Go on with what is there of a partial download."""
    workspace: Annotated[Path | None, tyro.conf.arg(aliases=["-w"])] = None
    """Where everything is kept; runs/DATASET-PRESET unless given."""
    submissions: Path | None = None
    """Folder that gets a copy of the pose file and its provenance, and overwrites none of another
    result; submissions/ unless --workspace is given."""
    config: Path | None = None
    """A benchmark file (TOML) with this dataset's options, instead of the one that we bring."""
    thresholds: tuple[str, ...] = ()
    """Recall thresholds, metres and degrees: 0.25,2 0.5,5."""
    query_prefix: str = ""
    """Put the queries into a folder of this name, where they share names with the map."""
    from_stage: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """Run this stage again, and what follows; take those before it as they are."""
    until: str | None = None
    """Stop behind this stage."""
    dry_run: bool = False
    """Say which stages would run, and why."""
    verify: bool = False
    """Compare the content of all files in the workspace with what stages wrote, not only their
    sizes and times; a stage whose files have changed runs again."""
    explain: bool = False
    """List the steps of the paper, which of them this run does and why; nothing is run."""
    ablate: bool = False
    """Run again without each of the steps in turn, in ablation/, and print what each adds."""
    fail_below: float | None = None
    """Exit with 3 when the share of queries at the last threshold is lower (0 to 1)."""
    force: Force = False
    """Use a workspace folder that has other things in it."""

    def run(self) -> int:
        """Run it; returns the exit status."""
        console = self.console()
        choice = choose_run(
            self.dataset,
            self.root,
            preset=self.preset,
            assignments=self.assignments(),
            config=self.config,
            query_prefix=self.query_prefix,
            allow_missing=self.allow_missing,
            find_root=not self.explain,
        )
        if self.explain:
            console.result(steps_text(choice.steps()))
            return 0
        if self.thresholds:
            parsed = [Threshold.parse(text) for text in self.thresholds]
            pairs = tuple((t.position_m, t.angle_deg) for t in parsed)
            wanted = choice.benchmark.model_copy(update={"thresholds": pairs})
            choice = replace(choice, benchmark=wanted)
        self._check_judging(choice.source)
        self._check_ablation(choice.source)
        place = self.workspace or Path("runs") / f"{self.dataset}-{choice.preset}"
        submissions = self.submissions or (None if self.workspace else Path(FOLDER))
        workspace = Workspace(place, force=self.force)
        with (
            workspace.lock(),
            single_threaded(),
            self.open_executor(workspace.root) as executor,
        ):
            run = choice.run_in(workspace)
            work = Work(executor, console.track, self.workers or available_cores())
            stages = plan_evaluation(run)
            reports = run_plan(
                stages,
                workspace,
                work,
                first=self.from_stage,
                last=self.until,
                dry_run=self.dry_run,
                verify=self.verify,
                on_start=console.say,
                on_report=lambda report: console.say(describe(report)),
            )
            if self.ablate and not self.dry_run:
                self._ablate(console, choice, work, workspace, stages)
        if self.dry_run:
            return 0
        if all_kept(reports):
            console.say("nothing to do: every stage is up to date")
        done = {report.name for report in reports}
        status = self._conclude(console, workspace, choice.benchmark) if "evaluation" in done else 0
        if "submission" in done:
            self._hand_in(console, run.submission_below(workspace.root), submissions)
        report = workspace.path(EVALUATION) / REPORT_HTML
        if "evaluation" in done and report.is_file():
            console.result(f"report     {shown(report)}")
        return status

    def _ablate(
        self,
        console: Console,
        choice: RunChoice,
        work: Work,
        whole: Workspace,
        stages: Sequence[Stage],
    ) -> None:
        outcomes = [outcome("all steps", whole, stages)]
        for variant in variants(choice.options):
            console.say(f"ablation: without {variant.name}")
            workspace = fresh_copy(whole, variant.slug)
            changed = choice.with_options(variant.options).run_in(workspace)
            with workspace.lock():
                planned = plan_evaluation(changed)
                run_plan(
                    planned,
                    workspace,
                    work,
                    on_start=console.say,
                    on_report=lambda report: console.say(describe(report)),
                )
            outcomes.append(outcome(f"without {variant.name}", workspace, planned))
        path = write_outcomes(whole, outcomes)
        console.result(outcomes_text(outcomes))
        console.result(f"ablation   {shown(path)}")

    def _check_ablation(self, choice: DatasetChoice) -> None:
        if not self.ablate:
            return
        if self.until not in (None, "evaluation"):
            raise OptionError(f"--ablate needs stage evaluation; --until {self.until} skips it")
        if not choice.has_truth():
            raise OptionError(f"--ablate needs true poses: {choice.root}/query_gt is missing")

    def _check_judging(self, choice: DatasetChoice) -> None:
        if self.fail_below is None:
            return
        if not 0.0 <= self.fail_below <= 1.0:
            raise OptionError(f"--fail-below is a share between 0 and 1, got {self.fail_below:g}")
        if self.until not in (None, "evaluation"):
            raise OptionError(f"--fail-below needs stage evaluation; --until {self.until} skips it")
        if not choice.has_truth():
            raise OptionError(f"--fail-below needs true poses: {choice.root}/query_gt is missing")

    def _hand_in(self, console: Console, pose_file: Path, submissions: Path | None) -> None:
        """Say where the pose file is, and put it among the others where that is wanted."""
        if submissions is not None:
            kept = keep_submission(pose_file, submissions)
            if kept.name != pose_file.name:
                console.say(
                    f"{shown(submissions / pose_file.name)} is of another result and stays as it is"
                )
            pose_file = kept
        console.result(f"pose file  {shown(pose_file)}")

    def _conclude(self, console: Console, workspace: Workspace, benchmark: BenchmarkFile) -> int:
        evaluation = workspace.path(EVALUATION)
        statuses = read_status(workspace.path(LOCALIZED) / STATUS_FILE)
        if statuses and all(status.status == "failed" for status in statuses.values()):
            console.say("warning: no query was localized; reasons are in localized/status.csv")
        if (evaluation / RECALL_TEXT).is_file():
            console.result((evaluation / RECALL_TEXT).read_text(encoding="utf-8"))
        elif (evaluation / AGREEMENT_TEXT).is_file():
            console.result((evaluation / AGREEMENT_TEXT).read_text(encoding="utf-8"))
        for text in published_results(benchmark):
            console.result(text)
        if self.fail_below is not None:
            return self._judge(console, evaluation)
        return 0

    def _judge(self, console: Console, evaluation: Path) -> int:
        rows = json.loads((evaluation / RECALL_JSON).read_text(encoding="utf-8"))["rows"]
        recall = next(row for row in rows if row["name"] == "all")["recall"][-1]["recall"]
        if self.fail_below is not None and recall < self.fail_below:
            console.say(f"recall {recall:.3f} is below {self.fail_below:.3f}")
            return BELOW_RECALL
        return 0


def published_results(benchmark: BenchmarkFile) -> list[str]:
    """Lines about what others have reached on the dataset; empty where nothing is known."""
    if not benchmark.published:
        return []
    width = max(len(result.method) for result in benchmark.published)
    lines = ["published (percent, on the official data):"]
    for result in benchmark.published:
        recall = "   ".join(f"{name} {figures}" for name, figures in result.recall.items())
        lines.append(f"  {result.method:{width}s}  {recall}   [{result.source}]")
    return [*lines, ""]


def shown(path: Path) -> str:
    """A path as short as it can be typed from here."""
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)
