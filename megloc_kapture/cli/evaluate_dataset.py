"""``megloc eval``: resumable run from a dataset to a pose file and a recall table."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from megloc_kapture.cli.common import Localizing, Overwrite, Texts, Working
from megloc_kapture.errors import OptionError, check_option
from megloc_kapture.evaluation.metrics import Threshold, pairs_of_thresholds
from megloc_kapture.evaluation.report.reports import AGREEMENT_TEXT, RECALL_TEXT, REPORT_HTML
from megloc_kapture.io.dataset_tables import SIDE_TABLES
from megloc_kapture.io.tables import STATUS_FILE, read_status
from megloc_kapture.localization.focal_length import misfits_text
from megloc_kapture.pipeline.datasets import BenchmarkFile, DatasetChoice
from megloc_kapture.pipeline.evaluation_plan import (
    choose_run,
    explain,
    explanation_table,
    plan_evaluation,
    recall_rows,
)
from megloc_kapture.pipeline.plan import Workspace, all_kept, run_plan
from megloc_kapture.pipeline.presets import parse_assignments
from megloc_kapture.pipeline.submission import FOLDER, keep_submission
from megloc_kapture.stages.paths import EVALUATION, LOCALIZED

# exit status if the recall is below --fail-below
RECALL_TOO_LOW = 3


@dataclass(frozen=True, kw_only=True)
class Eval(Localizing, Working):
    """Run all stages on a dataset, except those whose results are up to date."""

    dataset: tyro.conf.Positional[str] = "synthetic-aachen"
    """aachen, robotcar, 4seasons, inloc; synthetic-X: a rendered twin of one of them; kapture: any
    kapture folders mapping/ and query/; synthetic: a rendered world as such folders."""
    root: Path | None = None
    """Folder of the dataset in its published layout; if omitted, it is searched for below
    MEGLOC_DATA."""
    allow_missing: bool = False
    """Accept a partial download."""
    workspace: Annotated[Path | None, tyro.conf.arg(aliases=["-w"])] = None
    """Workspace folder; if omitted, runs/DATASET-PRESET, for kapture folders
    runs/kapture-ROOT-PRESET."""
    submissions: Path | None = None
    """Folder for a copy of the pose file and its provenance; the files of another result are not
    overwritten. If omitted, submissions/; with --workspace no copy is made."""
    import_option: Texts = ()
    """An option of the dataset, as for megloc import --set: key=value (version=1.0,
    location_prior=false); may be repeated."""
    config: Path | None = None
    """Benchmark file (TOML) with this dataset's options, instead of the built-in one."""
    thresholds: tuple[str, ...] = ()
    """Recall thresholds in metres and degrees, for example 0.25,2 0.5,5."""
    query_prefix: str = ""
    """Folder to put the queries into; needed if they share names with map images."""
    from_stage: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """Run this stage and its dependents again; use the results of earlier stages as they are."""
    until: str | None = None
    """Stop after this stage."""
    dry_run: bool = False
    """List the stages that would run, and why."""
    explain: bool = False
    """List all stages, on or off, with the options that decide this; run nothing."""
    fail_below: float | None = None
    """Exit with status 3 if the recall (0 to 1) at the last threshold is lower."""
    force: Overwrite = False
    """Use a non-empty workspace, or one made from another root; accept map poses that contradict
    the matches of their images."""

    def run(self) -> int:
        run = choose_run(
            self.dataset,
            self.root,
            preset=self.preset,
            assignments=self.assignments(),
            import_options=parse_assignments(self.import_option, flag="--import-option"),
            config=self.config,
            query_prefix=self.query_prefix,
            allow_missing=self.allow_missing,
            find_root=not self.explain,
        )
        if self.explain:
            print(explanation_table(explain(run.options)))
            return 0
        if self.thresholds:
            parsed = [Threshold.parse(text) for text in self.thresholds]
            update = {"thresholds": pairs_of_thresholds(parsed)}
            benchmark = run.benchmark.model_copy(update=update)
            run = replace(run, benchmark=benchmark)
        self._check_fail_below(run.source)
        root = self.workspace or run.default_workspace
        submissions = self.submissions or (None if self.workspace else Path(FOLDER))
        is_file = submissions is not None and submissions.is_file()
        check_option(not is_file, f"--submissions: {submissions} is a file; give a folder")
        workspace = Workspace(root, force=self.force)
        with self.working_in(workspace) as work:
            work = replace(work, force=self.force)
            stages = plan_evaluation(run)
            reports = run_plan(
                stages,
                workspace,
                work,
                first=self.from_stage,
                last=self.until,
                dry_run=self.dry_run,
                say=self.say,
            )
        if self.dry_run:
            return 0
        if all_kept(reports):
            self.say("nothing to do: every stage is up to date")
        done = {report.name: report for report in reports}
        status = self._print_recall(workspace, run.benchmark) if "evaluation" in done else 0
        if "submission" in done:
            pose_file = run.submission_below(workspace.root, workspace.path(SIDE_TABLES))
            self._copy_pose_file(pose_file, submissions)
            doubtful = done["submission"].counts.get("doubtful", 0)
            # only datasets with an adapter have an evaluation server
            if doubtful and run.source.adapter is not None:
                self.say(
                    f"{doubtful:,} poses are not in the pose file, as their confidence is too low; "
                    "a server counts a missing pose as wrong: --set localization.min_confidence=0 "
                    "keeps every pose"
                )
        report = workspace.path(EVALUATION) / REPORT_HTML
        if "evaluation" in done and report.is_file():
            print(f"report     {shown(report)}")
        return status

    def _check_fail_below(self, choice: DatasetChoice) -> None:
        if self.fail_below is not None and not 0.0 <= self.fail_below <= 1.0:
            raise OptionError(f"--fail-below must be a recall from 0 to 1, got {self.fail_below:g}")
        if self.fail_below is None:
            return
        if self.until not in (None, "evaluation"):
            raise OptionError(f"--fail-below needs stage evaluation; --until {self.until} skips it")
        check_option(
            choice.has_truth(), f"--fail-below needs true poses: {choice.root}/query_gt is missing"
        )

    def _copy_pose_file(self, pose_file: Path, submissions: Path | None) -> None:
        """Copy the pose file to the folder of submissions, if given, and print its path."""
        if submissions is not None:
            kept = keep_submission(pose_file, submissions)
            if kept.name != pose_file.name:
                self.say(
                    f"{shown(submissions / pose_file.name)} belongs to another result and is kept"
                )
            pose_file = kept
        print(f"pose file  {shown(pose_file)}")

    def _print_recall(self, workspace: Workspace, benchmark: BenchmarkFile) -> int:
        """Print the recall or agreement, and return the exit status."""
        evaluation = workspace.path(EVALUATION)
        statuses = read_status(workspace.path(LOCALIZED) / STATUS_FILE)
        if statuses and all(status.status == "failed" for status in statuses.values()):
            self.say("warning: no query was localized; reasons are in localized/status.csv")
        if misfits := misfits_text(statuses.values(), f"{LOCALIZED}/{STATUS_FILE}"):
            self.say(misfits)
        for text in (RECALL_TEXT, AGREEMENT_TEXT):
            if (evaluation / text).is_file():
                print((evaluation / text).read_text(encoding="utf-8"))
                break
        if benchmark.published:
            print("published recall (percent, on the official data):")
        for text in benchmark.published:
            print(f"  {text}")
        if self.fail_below is None:
            return 0
        recall = recall_rows(workspace.root)["all"]["recall"][-1]["recall"]
        if recall >= self.fail_below:
            return 0
        self.say(f"recall {recall:.3f} is below {self.fail_below:.3f}")
        return RECALL_TOO_LOW


def shown(path: Path) -> str:
    """Return the path, relative to the current folder if it lies below it."""
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)
