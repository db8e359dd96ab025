"""What each step of a pipeline adds: the same run, each time without one of them."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from megloc_kapture.evaluation.metrics import Threshold
from megloc_kapture.evaluation.report.reports import RECALL_JSON
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.files import hard_link, output_error
from megloc_kapture.pipeline.evaluation_plan import plan_evaluation
from megloc_kapture.pipeline.plan import run_plan
from megloc_kapture.pipeline.run import RunChoice
from megloc_kapture.pipeline.workspace import LOCK, PARTIAL, Workspace
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.stage import EVALUATION, Stage
from megloc_kapture.stages.work import Work

ABLATION, TABLE = "ablation", "ablation/ablation.csv"

# of a run's stages, those that take time whatever the steps
_BESIDE = frozenset({"import", "submission", "evaluation"})


@dataclass(frozen=True)
class Variant:
    """A run without one step, which is named in words."""

    name: str
    options: PipelineOptions

    @property
    def slug(self) -> str:
        """Its folder below ``ablation/``."""
        return "without_" + self.name.replace(" ", "_")


@dataclass(frozen=True)
class Outcome:
    """What a run came to."""

    name: str
    recall: dict[str, float]  # 0 to 1, by the text of the threshold
    median_position_m: float
    median_angle_deg: float
    seconds: float  # of all its stages, from import and evaluation apart


def variants(options: PipelineOptions) -> list[Variant]:
    """The runs without one of the steps that these options have, in the pipeline's order."""
    no_masks = type(options.preprocessing.masks)()
    depth = options.refinement.depth.model_copy(update={"max_sigmas": None})
    nothing_rejected = type(options.refinement)(depth=depth, ply=options.refinement.ply)
    # as many images, the first that retrieval finds
    unranked = _changed(options, "query_pairs", top_k=options.reranking.keep)
    localization = options.localization
    steps: list[tuple[str, bool, PipelineOptions]] = [
        (
            "masks",
            options.preprocessing.masks != no_masks,
            _changed(options, "preprocessing", masks=no_masks),
        ),
        (
            "second local features",
            len(options.local_features) > 1,
            _changed(options, local_features=options.local_features[:1]),
        ),
        (
            "fusion",
            len(options.global_features) > 1,
            _changed(options, global_features=options.global_features[:1]),
        ),
        (
            "map refinement",
            options.refinement != nothing_rejected,
            _changed(options, refinement=nothing_rejected),
        ),
        ("reranking", options.reranking.reranks(), _changed(unranked, "reranking", by="none")),
        (
            "guided pyramid",
            options.matches_again(),
            _changed(options, "guided_pyramid", mode="off"),
        ),
        (
            "clusters",
            localization.clusters.by != "none",
            _changed(options, "localization.clusters", by="none"),
        ),
        (
            "pose ranking",
            localization.rank.name != "inliers",
            _changed(options, "localization.rank", name="inliers", options={}),
        ),
    ]
    refiners = options.pose_refinement.by
    for at, chosen in enumerate(refiners):
        without = _changed(options, "pose_refinement", by=refiners[:at] + refiners[at + 1 :])
        steps.append((chosen.name, True, without))
    return [Variant(name, without) for name, has, without in steps if has]


def _changed(model: Any, path: str = "", **values: object) -> Any:
    """A model with other values in the model at a path in it."""
    if path:
        name, _, below = path.partition(".")
        values = {name: _changed(getattr(model, name), below, **values)}
    return model.model_copy(update=values)


def ablate(
    choice: RunChoice,
    whole: Workspace,
    stages: Sequence[Stage],
    work: Work,
    say: Callable[[str], None] = lambda text: None,
) -> list[Outcome]:
    """Run again without each of the steps in turn; what the whole run and these came to."""
    outcomes = [outcome("all steps", whole, stages)]
    for variant in variants(choice.options):
        say(f"ablation: without {variant.name}")
        workspace = fresh_copy(whole, variant.slug)
        changed = choice.with_options(variant.options).run_in(workspace)
        with workspace.lock():
            planned = plan_evaluation(changed)
            run_plan(planned, workspace, work, say=say)
        outcomes.append(outcome(f"without {variant.name}", workspace, planned))
    return outcomes


def fresh_copy(source: Workspace, slug: str) -> Workspace:
    """A workspace below another with all that is in it: files are linked, none is copied.

    Stages replace what they write, so the files of the one are never changed by the other.

    Raises
    ------
    OutputError : cannot be written.
    """
    place = source.path(ABLATION) / slug
    try:
        if place.exists():
            shutil.rmtree(place)
        for folder, names, files in os.walk(source.root):
            inside = Path(folder).relative_to(source.root)
            if inside == Path():
                names[:] = sorted(set(names) - {ABLATION, PARTIAL})
                files = sorted(set(files) - {LOCK})
            for name in sorted([*files, *(n for n in names if (Path(folder) / n).is_symlink())]):
                old, new = Path(folder) / name, place / inside / name
                if old.is_symlink():
                    new.parent.mkdir(parents=True, exist_ok=True)
                    new.symlink_to(os.readlink(old))
                else:
                    hard_link(old, new)
    except OSError as error:
        raise output_error(place, error) from error
    return Workspace(place, force=True)


def outcome(name: str, workspace: Workspace, stages: Sequence[Stage]) -> Outcome:
    """Read what a run came to; raises DataError where it has no recall."""
    path = workspace.path(EVALUATION) / RECALL_JSON
    rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
    row = next(row for row in rows if row["name"] == "all")
    # JSON knows no infinity: a median over queries without a pose is written as null
    medians = (row["median_position_m"], row["median_angle_deg"])
    position_m, angle_deg = (float("inf" if value is None else value) for value in medians)
    manifests = [workspace.manifest(s.name) for s in stages]
    return Outcome(
        name=name,
        recall={str(Threshold(**at["threshold"])): float(at["recall"]) for at in row["recall"]},
        median_position_m=position_m,
        median_angle_deg=angle_deg,
        seconds=sum(m.seconds for m in manifests if m is not None and m.stage not in _BESIDE),
    )


def write_outcomes(workspace: Workspace, outcomes: Sequence[Outcome]) -> Path:
    """Write the table ``ablation/ablation.csv``; raises OutputError."""
    path = workspace.path(TABLE)
    thresholds = (threshold.replace(", ", " ") for threshold in outcomes[0].recall)
    columns = ("run", *thresholds, "median_m", "median_deg", "seconds")
    rows = (
        (
            one.name,
            *(f"{recall:.6f}" for recall in one.recall.values()),
            f"{one.median_position_m:.6f}",
            f"{one.median_angle_deg:.6f}",
            f"{one.seconds:.1f}",
        )
        for one in outcomes
    )
    write_csv_table(path, columns, rows)
    return path


def outcomes_text(outcomes: Sequence[Outcome]) -> str:
    """The table as text: recall in percent, medians over all queries, seconds of the stages."""
    thresholds = list(outcomes[0].recall)
    width = max(len(one.name) for one in outcomes)
    lines = [f"recall (%) at {' / '.join(thresholds)}; median error; seconds of all stages", ""]
    for one in outcomes:
        recall = " / ".join(f"{100 * value:5.1f}" for value in one.recall.values())
        lines.append(
            f"{one.name:{width}s}  {recall}  {one.median_position_m:8.4f} m "
            f"{one.median_angle_deg:7.3f} deg  {one.seconds:7.1f} s"
        )
    return "\n".join(lines) + "\n"
