"""What each step of a pipeline adds: the same run, each time without one of them."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from megloc_kapture.evaluation.metrics import Threshold
from megloc_kapture.evaluation.report.reports import RECALL_JSON
from megloc_kapture.io.csv_table import write_csv_table
from megloc_kapture.io.files import hard_link, output_error
from megloc_kapture.pipeline.manifests import read_manifest
from megloc_kapture.pipeline.workspace import LOCK, PARTIAL, Workspace
from megloc_kapture.stages.options import PipelineOptions
from megloc_kapture.stages.stage import EVALUATION, Stage

ABLATION, TABLE = "ablation", "ablation/ablation.csv"

# of a run's stages, those that take time whatever the steps
_BESIDE = frozenset({"import", "submission", "evaluation"})


@dataclass(frozen=True)
class Variant:
    """A run without one step.

    Attributes
    ----------
    name : of the step, in words; ``slug`` is its folder below ``ablation/``.
    """

    name: str
    options: PipelineOptions

    @property
    def slug(self) -> str:
        """The name of its folder."""
        return "without_" + self.name.replace(" ", "_")


@dataclass(frozen=True)
class Outcome:
    """What a run came to.

    Attributes
    ----------
    recall : text of each threshold to recall, 0 to 1.
    seconds : of all its stages, from import and evaluation apart.
    """

    name: str
    recall: dict[str, float]
    median_position_m: float
    median_angle_deg: float
    seconds: float


def variants(options: PipelineOptions) -> list[Variant]:
    """The runs without one of the steps that these options have, in the pipeline's order."""
    found = []
    for name, has, without in _STEPS:
        if has(options):
            found.append(Variant(name, without(options)))
    for position, chosen in enumerate(options.pose_refinement.by):
        by = options.pose_refinement.by
        rest = {"by": by[:position] + by[position + 1 :]}
        changed = options.pose_refinement.model_copy(update=rest)
        found.append(Variant(chosen.name, _with(options, pose_refinement=changed)))
    return found


def _with(options: PipelineOptions, **changes: object) -> PipelineOptions:
    return options.model_copy(update=changes)


def _plain_ranking(options: PipelineOptions) -> PipelineOptions:
    rank = options.localization.rank.model_copy(update={"name": "inliers", "options": {}})
    return _with(options, localization=options.localization.model_copy(update={"rank": rank}))


def _one_cluster(options: PipelineOptions) -> PipelineOptions:
    clusters = options.localization.clusters.model_copy(update={"by": "none"})
    return _with(
        options, localization=options.localization.model_copy(update={"clusters": clusters})
    )


def _unranked(options: PipelineOptions) -> PipelineOptions:
    # as many images, the first that retrieval finds
    pairs = options.query_pairs.model_copy(update={"top_k": options.reranking.keep})
    reranking = options.reranking.model_copy(update={"by": "none"})
    return _with(options, query_pairs=pairs, reranking=reranking)


def _nothing_rejected(options: PipelineOptions) -> PipelineOptions:
    depth = options.refinement.depth.model_copy(update={"max_sigmas": None})
    kind = type(options.refinement)
    return _with(options, refinement=kind(depth=depth, ply=options.refinement.ply))


_STEPS: tuple[
    tuple[str, Callable[[PipelineOptions], bool], Callable[[PipelineOptions], PipelineOptions]], ...
] = (
    (
        "masks",
        lambda o: o.preprocessing.masks != type(o.preprocessing.masks)(),
        lambda o: _with(
            o,
            preprocessing=o.preprocessing.model_copy(
                update={"masks": type(o.preprocessing.masks)()}
            ),
        ),
    ),
    (
        "second local features",
        lambda o: len(o.local_features) > 1,
        lambda o: _with(o, local_features=o.local_features[:1]),
    ),
    (
        "fusion",
        lambda o: len(o.global_features) > 1,
        lambda o: _with(o, global_features=o.global_features[:1]),
    ),
    ("map refinement", lambda o: o != _nothing_rejected(o), _nothing_rejected),
    ("reranking", lambda o: o.reranking.reranks(), _unranked),
    (
        "guided pyramid",
        lambda o: o.matches_again(),
        lambda o: _with(o, guided_pyramid=o.guided_pyramid.model_copy(update={"mode": "off"})),
    ),
    ("clusters", lambda o: o.localization.clusters.by != "none", _one_cluster),
    ("pose ranking", lambda o: o.localization.rank.name != "inliers", _plain_ranking),
)


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
    manifests = [read_manifest(workspace.manifest_path(s.name)) for s in stages]
    return Outcome(
        name=name,
        recall={str(Threshold(**at["threshold"])): float(at["recall"]) for at in row["recall"]},
        median_position_m=_number(row["median_position_m"]),
        median_angle_deg=_number(row["median_angle_deg"]),
        seconds=sum(m.seconds for m in manifests if m is not None and m.stage not in _BESIDE),
    )


def _number(value: float | None) -> float:
    """JSON knows no infinity: a median over queries without a pose is written as null."""
    return float("inf") if value is None else float(value)


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
    lines = [
        f"recall (%) at {' / '.join(thresholds)}; median error; seconds of all stages",
        "",
    ]
    for one in outcomes:
        recall = " / ".join(f"{100 * value:5.1f}" for value in one.recall.values())
        lines.append(
            f"{one.name:{width}s}  {recall}  {one.median_position_m:8.4f} m "
            f"{one.median_angle_deg:7.3f} deg  {one.seconds:7.1f} s"
        )
    return "\n".join(lines) + "\n"
