"""The plan of ``megloc eval``: from a dataset to a pose file and a recall table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.folders import evaluate_folders, results_without_truth
from megloc_kapture.evaluation.outputs import write_evaluation
from megloc_kapture.evaluation.provenance import package_versions
from megloc_kapture.evaluation.rules import read_rules
from megloc_kapture.evaluation.surroundings import surroundings_of
from megloc_kapture.evaluation.without_truth_outputs import write_without_truth
from megloc_kapture.io.kapture_store import ImagePair, KaptureFolder, read_pairs
from megloc_kapture.io.side_tables import SIDE_TABLES
from megloc_kapture.pipeline.datasets import DatasetChoice, with_model
from megloc_kapture.pipeline.image_plan import plan_images
from megloc_kapture.pipeline.map_plan import matched_images, plan_map
from megloc_kapture.pipeline.missing_weights import check_weights
from megloc_kapture.pipeline.plan import Stage
from megloc_kapture.pipeline.retrieval_plan import plan_global_features, plan_query_pairs
from megloc_kapture.pipeline.run import (
    EVALUATION,
    LOCALIZED,
    MAP,
    MAPPING,
    QUERY,
    QUERY_GT,
    QUERY_MATCHES,
    QUERY_PAIRS,
    QUERY_PYRAMID,
    REFINEMENT_TIMING,
    SUBMISSIONS,
    TIMING,
    UNREFINED_POSES,
    Run,
)
from megloc_kapture.pipeline.submission import write_submission
from megloc_kapture.plugins import weights_of
from megloc_kapture.stages.guided_pyramid import pyramid_queries
from megloc_kapture.stages.localized_folder import write_localized
from megloc_kapture.stages.matches import iterate_candidates
from megloc_kapture.stages.pose_refinement import refine_poses
from megloc_kapture.stages.query_poses import localize_from_matches
from megloc_kapture.values import RigidTransform


def plan_evaluation(run: Run) -> list[Stage]:
    """The stages of a run, in order.

    Raises
    ------
    MeglocError : the dataset or the options cannot be used; nothing has been written by then.
    """
    options = run.options
    check_weights(options)
    options.local_types()
    options.retrieval()
    given = options.uses_given_map()
    if given and options.changes_frames():
        raise OptionError(
            f"map = {options.map}: the given map's keypoints are in the original images; "
            "pre-processing may mask them, but not resize or undistort"
        )
    if options.matches_again() and options.verification == "none":
        raise OptionError(
            "guided pyramid matching counts verified matches; verification = none has none"
        )
    if given or options.pairs_by_points():
        run = replace(run, source=_with_model(run, given))
    dump = options.model_dump(mode="json")
    last = "refine_poses" if options.pose_refinement.refines() else "localization"
    stages = [
        *plan_images(run, dump),
        plan_global_features(run, dump),
        *plan_map(run, dump),
        *plan_query_pairs(run, dump),
        *(_pyramid_stages(run, dump) if options.matches_again() else ()),
        Stage(
            "localization",
            4,
            {
                "localization": dump["localization"],
                "weights": weights_of(options.localization.make_ranker()),
            },
            (
                "import",
                run.images_stage,
                "local_features",
                "map",
                "query_pairs",
                "query_matches",
                *(["query_pyramid"] if options.matches_again() else []),
            ),
            (run.first_poses, TIMING),
            lambda out: _localization(run, out),
        ),
        *(_refinement_stages(run, dump) if options.pose_refinement.refines() else ()),
        Stage(
            "submission",
            3,
            {"dataset": run.dataset, "preset": run.preset, "options": dump},
            ("import", last),
            (SUBMISSIONS,),
            lambda out: _submission(run, out),
        ),
        Stage(
            "evaluation",
            3,
            {
                "dataset": run.dataset,
                "preset": run.preset,
                "options": dump,
                "steps": [asdict(step) for step in run.steps],
            },
            ("import", last),
            (EVALUATION,),
            lambda out: _evaluation(run, out),
        ),
    ]
    return stages


def _with_model(run: Run, given: bool) -> DatasetChoice:
    try:
        return with_model(run.source, features=given)
    except OptionError as error:
        wanted = (
            f"map = {run.options.map} localizes in that model (megloc localize takes any kapture "
            "map)"
            if given
            else "mapping_pairs by covisibility or overlap need its points; "
            '--set \'mapping_pairs.by=["poses", "retrieval"]\' does without them'
        )
        raise OptionError(f"{error}: {wanted}") from error


def _pyramid_stages(run: Run, dump: Mapping[str, Any]) -> list[Stage]:
    return [
        Stage(
            "query_pyramid",
            1,
            {
                "guided_pyramid": dump["guided_pyramid"],
                "two_view": dump["query_verification"],
                "mask_margin_px": dump["mask_margin_px"],
            },
            (run.images_stage, "local_features", "map", "query_pairs", "query_matches"),
            (QUERY_PYRAMID,),
            lambda out: _query_pyramid(run, out),
        )
    ]


def _query_pyramid(run: Run, out: Path) -> dict[str, float]:
    counts: dict[str, float] = {}
    options = run.options
    pairs = read_pairs(run.workspace.path(QUERY_PAIRS))
    for extractor in options.query_extractors():
        mapping = matched_images(run, extractor.name)
        described = mapping.descriptors(extractor.name)
        found = pyramid_queries(
            run.workspace.folder(run.query, "", QUERY_MATCHES),
            mapping,
            [pair for pair in pairs if pair.map in described],
            extractor.name,
            extractor,
            options.make_matcher(extractor.name),
            options.query_verification,
            options.guided_pyramid,
            out / QUERY_PYRAMID,
            mask_margin_px=options.mask_margin_px,
            work=run.work,
        )
        counts |= {f"{extractor.name} {name}": count for name, count in found.items()}
    return counts


def _localization(run: Run, out: Path) -> dict[str, int]:
    query = run.workspace.folder(run.query, *run.query_features())
    pairs = read_pairs(run.workspace.path(QUERY_PAIRS))
    options = run.options.localization
    results = localize_from_matches(
        run.workspace.folder(MAP),
        query,
        query,
        pairs,
        run.options.query_types(),
        options,
        restrictions=run.restrictions(),
        work=run.work,
    )
    return write_localized(
        out / run.first_poses,
        run.workspace.folder(QUERY),  # as imported: the poses are theirs as well
        results,
        fallback=options.fallback,
        first_candidates=first_candidates(pairs, run.workspace.folder(MAPPING)),
        timing=out / TIMING,
    )


def _refinement_stages(run: Run, dump: Mapping[str, Any]) -> list[Stage]:
    chosen = run.options.pose_refinement
    weights = [weights_of(refiner) for refiner in chosen.make_refiners()]
    return [
        Stage(
            "refine_poses",
            2,
            {"pose_refinement": dump["pose_refinement"], "weights": weights},
            ("import", run.images_stage, "map", "localization"),
            (LOCALIZED, REFINEMENT_TIMING),
            lambda out: _refine_poses(run, out),
        )
    ]


def _refine_poses(run: Run, out: Path) -> dict[str, float]:
    return refine_poses(
        run.workspace.folder(MAP),
        run.workspace.folder(run.query),
        run.workspace.folder(UNREFINED_POSES),
        out / LOCALIZED,
        run.options.pose_refinement,
        restrictions=run.restrictions(),
        work=run.work,
        timing=out / REFINEMENT_TIMING,
    )


def first_candidates(
    pairs: Sequence[ImagePair], mapping: KaptureFolder
) -> dict[str, tuple[str, RigidTransform]]:
    """Query to its best retrieved map image and that image's pose."""
    poses = mapping.read().poses()
    best = {}
    for query, images in iterate_candidates(pairs):
        if images and images[0] in poses:
            best[query] = (images[0], poses[images[0]])
    return best


def _provenance(run: Run) -> dict[str, Any]:
    return {
        "dataset": run.dataset,
        "preset": run.preset,
        "options": run.options.model_dump(mode="json"),
    }


def _submission(run: Run, out: Path) -> dict[str, int]:
    tables = run.workspace.path(SIDE_TABLES)
    return write_submission(
        run.workspace.path(LOCALIZED),
        run.submission_below(out),
        tables=tables,
        provenance=_provenance(run),
    )


def _evaluation(run: Run, out: Path) -> dict[str, float]:
    """Recall where the true poses are known, else what can be known without them."""
    localized, truth = run.workspace.path(LOCALIZED), run.workspace.path(QUERY_GT)
    tables = run.workspace.path(SIDE_TABLES)
    label = f"{run.dataset}, {run.preset}"
    map_poses = run.workspace.folder(MAPPING).read().poses()
    provenance = _provenance(run) | {
        "steps": [asdict(step) for step in run.steps],
        "versions": package_versions(),
    }
    around = surroundings_of(localized)
    if not truth.is_dir():
        found = results_without_truth(
            [localized], read_rules(tables), map_poses=map_poses, labels=[label]
        )
        write_without_truth(
            out / EVALUATION, found, map_poses=map_poses, provenance=provenance, around=[around]
        )
        return {"queries_with_truth": 0}
    evaluation = evaluate_folders(
        localized, truth, side_tables=tables, label=label, mapping=run.workspace.path(MAPPING)
    )
    write_evaluation(
        out / EVALUATION, evaluation, map_poses=map_poses, provenance=provenance, around=around
    )
    row = evaluation.row()
    recall = {f"recall at {at.threshold}": round(at.recall, 4) for at in row.recall}
    return {"queries_with_truth": len(evaluation.queries), **recall}
