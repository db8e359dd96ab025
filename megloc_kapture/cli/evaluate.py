"""Commands to evaluate, report, submit and check results."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from megloc_kapture.cli.common import Common, Force, Input, Inputs, Output, Overwrite
from megloc_kapture.errors import check_option, require
from megloc_kapture.evaluation.check import check_submission, read_reference
from megloc_kapture.evaluation.comparison import compare
from megloc_kapture.evaluation.evaluate import (
    benchmark_near,
    evaluate_results,
    results_without_truth,
)
from megloc_kapture.evaluation.metrics import Threshold
from megloc_kapture.evaluation.pose_files import provenance_path
from megloc_kapture.evaluation.report.reports import report_text, write_report
from megloc_kapture.evaluation.scoring import Reported
from megloc_kapture.io.dataset_tables import (
    PROTOCOL_FILE,
    SIDE_TABLES,
    Protocol,
    check_tables,
    read_protocol,
    tables_of,
)
from megloc_kapture.io.kapture import is_kapture
from megloc_kapture.io.output_folders import check_claim, check_new_file, staged_output
from megloc_kapture.pipeline.datasets import (
    TWIN_PREFIX,
    check_dataset,
    check_known,
    dataset_names,
)
from megloc_kapture.pipeline.submission import workspace_provenance, write_submission
from megloc_kapture.stages.paths import EVALUATION, MAPPING


@dataclass(frozen=True, kw_only=True)
class Evaluate(Common):
    """Compare localized queries (kapture folders, pose files, COLMAP models) with their true poses,
    and two or more results with each other."""

    input: Inputs = ()
    """Localized kapture folder, pose file or COLMAP model; may be repeated to compare results."""
    gt: Path | None = None
    """True poses: kapture folder, pose file or COLMAP model. If omitted, only statistics that need
    no true poses are computed."""
    dataset: str | None = None
    """Dataset whose thresholds and (pooled) conditions apply: aachen, robotcar, 4seasons, inloc,
    ...; if omitted, the workspace's protocol."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder for tables (text, JSON, CSV) and report.html."""
    thresholds: tuple[str, ...] = ()
    """Recall thresholds in metres and degrees, for example 0.25,2 0.5,5."""
    align: Literal["none", "se3", "sim3"] = "none"
    """Align the poses with the true poses first: sim3 with scale, for maps in an arbitrary frame
    and scale; se3 without scale. Unlike evo's, the alignment is robust to outliers."""
    side_tables: Path | None = None
    """The workspace's megloc/ folder (conditions, protocol); if omitted, the megloc/ folder next to
    the true poses or the results."""
    map: Path | None = None
    """Kapture folder of the map, for 4Seasons' relocalization pairs and the report; if omitted, the
    workspace's."""
    force: Force = False

    def run(self) -> None:
        check_option(self.input, "no result given; use -i")
        resolved = [path.resolve() for path in self.input]
        repeated = next((p for p in self.input if resolved.count(p.resolve()) > 1), None)
        check_option(repeated is None, f"{repeated} is given twice")
        benchmark = benchmark_near(
            [self.gt, *self.input],
            side_tables=self.side_tables,
            dataset=self.dataset,
            thresholds=[Threshold.parse(text) for text in self.thresholds],
        )
        reported: Reported
        if self.gt is None:
            reported = results_without_truth(self.input, benchmark, mapping=self.map)
        else:
            evaluations = evaluate_results(
                self.input, self.gt, benchmark, mapping=self.map, align=self.align
            )
            reported = compare(evaluations) if len(evaluations) > 1 else evaluations[0]
        if self.output is not None:
            with staged_output(self.output, kind=EVALUATION, force=self.force) as out:
                write_report(out, reported)
        print(report_text(reported))


@dataclass(frozen=True, kw_only=True)
class Submit(Common):
    """Write the pose file of a localized kapture folder, and a JSON file with its provenance."""

    dataset: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATASET")]
    """Dataset whose rules apply: aachen, robotcar, 4seasons, inloc, kapture, synthetic or
    synthetic-X, the rendered twin of X."""
    input: Input
    """Localized kapture folder."""
    output: Output
    """Pose file; for 4seasons a folder, with one file per relocalization file."""
    side_tables: Path | None = None
    """The megloc/ folder of the imported dataset; if omitted, the megloc/ folder next to the
    result."""
    from_rig: bool = False
    """Derive missing poses from another camera of the rig at the same timestamp."""
    force: Overwrite = False
    """Overwrite the pose file and its JSON file."""

    def run(self) -> None:
        if self.side_tables is not None:
            check_tables(self.side_tables)
        tables = self.side_tables or tables_of(self.input)
        rules = Protocol() if tables is None else read_protocol(tables)
        check_dataset(self.dataset, rules, tables=tables)
        if rules.pose_file == "mlad":
            check_claim(self.output, kind="submission", force=self.force)
        else:
            check_new_file(self.output, force=self.force)
        check_new_file(provenance_path(self.output), force=self.force)
        counts = write_submission(
            self.input,
            self.output,
            tables=None if tables is None else tables.resolve(),
            provenance={"dataset": self.dataset, **workspace_provenance(self.input)},
            from_rig=self.from_rig,
        )
        print(f"{summary(counts)}: {self.output}")


def summary(counts: Mapping[str, int]) -> str:
    text = f"{counts['poses']} poses of {counts['scored']} queries"
    if counts["scored"] != counts["queries"] and not counts["dummies"]:
        text += f" to be scored ({counts['queries']} in all)"
    parts = [
        f"{counts['missing']} missing" if counts["missing"] else "",
        "written as dummy poses" if counts["dummies"] else "",
        f"{counts['fallbacks']} fallback poses" if counts["fallbacks"] else "",
        f"{counts['from_rig']} from the rig" if counts["from_rig"] else "",
    ]
    return ", ".join([text, *filter(None, parts)])


# exit status if the check finds problems, as for user errors
PROBLEMS_FOUND = 2
_RUNS = Path("runs")


@dataclass(frozen=True, kw_only=True)
class Check(Common):
    """Check a pose file from any tool against the rules of its challenge and the map."""

    dataset: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATASET")]
    """Dataset whose rules apply: aachen, robotcar, 4seasons, inloc, kapture, synthetic or
    synthetic-X, the rendered twin of X."""
    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """Pose file; for 4seasons also the folder of all pose files."""
    data: Path | None = None
    """Imported dataset or workspace to compare with; if omitted, the workspace runs/DATASET-*, if
    it is the only one."""
    json: bool = False
    """Print the result as JSON."""

    def run(self) -> int:
        """Return 2 if there are problems."""
        check_known(self.dataset)
        require(self.file.exists(), "no such file", path=self.file)
        data = self.data or self._workspace()
        reference = None
        if data is not None:
            reference = read_reference(data)
            tables = data / SIDE_TABLES
            has_protocol = (tables / PROTOCOL_FILE).is_file()
            check_dataset(self.dataset, reference.protocol, tables=tables if has_protocol else None)
        report = check_submission(
            self.file, dataset=self.dataset.removeprefix(TWIN_PREFIX), reference=reference
        )
        if self.json:
            print(json.dumps(report.to_json(), indent=2, ensure_ascii=False))
        else:
            for line in report.lines():
                print(line)
        return PROBLEMS_FOUND if report.has_problems else 0

    def _workspace(self) -> Path | None:
        # runs/synthetic-aachen-classic, for example, is not a workspace of the dataset synthetic
        others = tuple(f"{n}-" for n in dataset_names() if n.startswith(f"{self.dataset}-"))
        workspaces = [
            path
            for path in sorted(_RUNS.glob(f"{self.dataset}-*"))
            if is_kapture(path / MAPPING) and not path.name.startswith(others)
        ]
        if len(workspaces) == 1:
            self.say(f"compared with {workspaces[0]}")
            return workspaces[0]
        if workspaces:
            names = ", ".join(map(str, workspaces))
            self.say(f"not compared with a workspace: choose one of {names} with --data")
        return None
