"""The plan of ``megloc eval``: from a dataset to a pose file and a recall table."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.folders import evaluate_folders, results_without_truth
from megloc_kapture.evaluation.outputs import write_evaluation
from megloc_kapture.evaluation.provenance import package_versions
from megloc_kapture.evaluation.rules import read_rules
from megloc_kapture.evaluation.surroundings import surroundings_of
from megloc_kapture.evaluation.without_truth_outputs import write_without_truth
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.kapture_store import ImagePair, KaptureFolder, read_pairs, write_pairs
from megloc_kapture.io.side_tables import SIDE_TABLES, Protocol
from megloc_kapture.pipeline.datasets import ProtocolChange, with_model
from megloc_kapture.pipeline.manifests import FileHashes
from megloc_kapture.pipeline.map_plan import check_given, map_images, matched_images, plan_map
from megloc_kapture.pipeline.plan import Stage
from megloc_kapture.pipeline.run import (
    EVALUATION,
    LOCALIZED,
    MAP,
    MAPPING,
    QUERY,
    QUERY_GT,
    QUERY_MATCHES,
    QUERY_PAIRS,
    REFERENCE,
    SUBMISSIONS,
    TIMING,
    Run,
)
from megloc_kapture.pipeline.submission import write_submission
from megloc_kapture.pipeline.workspace import HASHES
from megloc_kapture.plugins import LocalFeatureExtractor
from megloc_kapture.stages.given_map import has_descriptors
from megloc_kapture.stages.global_vlad import extract_vlad, vlad_type
from megloc_kapture.stages.image_pairs import pair_queries
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.localized_folder import write_localized
from megloc_kapture.stages.matches import iterate_candidates, match_pairs
from megloc_kapture.stages.query_poses import localize_from_matches
from megloc_kapture.values import RigidTransform


def plan_evaluation(run: Run) -> list[Stage]:
    """The stages of a run, in order.

    Raises
    ------
    MeglocError : the dataset or the options cannot be used; nothing has been written by then.
    """
    options = run.options
    options.make_matcher()
    options.localization.make_ranker()
    given = options.uses_given_map()
    if given:
        run = replace(run, source=with_model(run.source))
    dump = options.model_dump(mode="json")
    stages = [
        *_dataset_stages(run),
        Stage(
            "local_features",
            1,
            _features_used(run, dump),
            ("import",),
            ("local_features",),
            lambda out: _local_features(run, out),
        ),
        Stage(
            "global_features",
            1,
            {"vlad": dump["vlad"], "local_type": options.main_type()},
            ("local_features",),
            ("global_features",),
            lambda out: _global_features(run, out),
        ),
        *plan_map(run, dump),
        Stage(
            "query_pairs",
            2,
            {"query_pairs": dump["query_pairs"]},
            ("import", "global_features"),
            (QUERY_PAIRS,),
            lambda out: _query_pairs(run, out),
        ),
        Stage(
            "query_matches",
            2,
            {
                "local_types": options.local_types(),
                "matching": dump["matching"],
                "verification": dump["verification"],
                "two_view": dump["query_verification"],
            },
            ("import", "local_features", "query_pairs", *(["map"] if given else [])),
            (QUERY_MATCHES,),
            lambda out: _query_matches(run, out),
        ),
        Stage(
            "localization",
            3,
            {"localization": dump["localization"]},
            ("import", "local_features", "map", "query_pairs", "query_matches"),
            (LOCALIZED, TIMING),
            lambda out: _localization(run, out),
        ),
        Stage(
            "submission",
            2,
            {"dataset": run.dataset, "preset": run.preset, "options": dump},
            ("import", "localization"),
            (SUBMISSIONS,),
            lambda out: _submission(run, out),
        ),
        Stage(
            "evaluation",
            2,
            {"dataset": run.dataset, "preset": run.preset, "options": dump},
            ("import", "localization"),
            (EVALUATION,),
            lambda out: _evaluation(run, out),
        ),
    ]
    return stages


def _features_used(run: Run, dump: Mapping[str, Any]) -> dict[str, Any]:
    """Options of the features that are extracted at all."""
    used = {"local_features": dump["local_features"]} if run.options.makes_points() else {}
    if run.options.uses_given_map():
        used["given_features"] = dump["given_features"]
    return used


def _dataset_stages(run: Run) -> list[Stage]:
    """Import, behind rendering where the dataset is made rather than given."""

    def change(given: Protocol) -> Protocol:
        if given.dataset == Protocol().dataset:
            given = given.model_copy(update={"dataset": run.dataset})
        return given if run.benchmark is None else run.benchmark.change(given)

    source = run.source
    outputs = (MAPPING, QUERY, QUERY_GT, SIDE_TABLES, REFERENCE)
    wanted = None if run.benchmark is None else run.benchmark.change(Protocol())
    settings = {**source.settings(), "protocol": wanted and wanted.model_dump(mode="json")}
    render = source.renderer(run.executor, run.track)
    if render is not None:
        world = run.workspace.path("world")
        return [
            Stage("render", 1, source.render_options(), (), ("world",), render),
            Stage(
                "import",
                2,
                settings,
                ("render",),
                outputs,
                lambda out: _import(run, world, out, change),
            ),
        ]
    if source.root is None:
        raise ValueError("a run needs a root or something that renders one")
    source.check()
    root = source.root.resolve()
    remembered = run.workspace.path(HASHES)
    hashes = FileHashes(remembered)
    content = hashes.of_files(root, source.input_files(root))
    write_bytes(remembered, (json.dumps(hashes.content()) + "\n").encode())
    external = {"dataset files": content, "dataset root": str(root)}
    return [
        Stage(
            "import",
            2,
            settings,
            (),
            outputs,
            lambda out: _import(run, root, out, change),
            external,
        )
    ]


def _import(run: Run, root: Path, out: Path, change: ProtocolChange) -> dict[str, float]:
    counts = run.source.import_to(root, out, change)
    if not counts["queries"]:
        raise DataError("no query image is left to localize", path=root)
    return counts


def _local_features(run: Run, out: Path) -> dict[str, int]:
    mapping, query = run.workspace.folder(MAPPING), run.workspace.folder(QUERY)
    work: list[tuple[LocalFeatureExtractor, list[KaptureFolder]]] = []
    if run.options.makes_points():
        work.append((run.options.make_extractor(), [mapping, query]))
    if run.options.uses_given_map():
        check_given(run)
        described = has_descriptors(run.workspace.folder(REFERENCE))
        folders = [query] if described else [mapping, query]
        work.append((run.options.make_given_extractor(), folders))
    counts: Counter[str] = Counter()
    for extractor, folders in work:
        found = extract_local_features(
            folders, extractor, out, executor=run.executor, track=run.track
        )
        counts.update(found)
    return counts


def _global_features(run: Run, out: Path) -> dict[str, int]:
    local_type = run.options.main_type()
    mapping = map_images(run, local_type)
    return extract_vlad(
        mapping,
        [mapping, run.workspace.folder(QUERY, "")],
        local_type,
        out,
        run.options.vlad,
        executor=run.executor,
        track=run.track,
    )


def _query_pairs(run: Run, out: Path) -> dict[str, int]:
    local_type = run.options.main_type()
    pairs = pair_queries(
        map_images(run, local_type),
        run.workspace.folder(QUERY, ""),
        run.options.query_pairs,
        global_type=vlad_type(local_type),
        restrictions=run.restrictions(),
    )
    write_pairs(out / QUERY_PAIRS, pairs)
    return {"pairs": len(pairs)}


def _query_matches(run: Run, out: Path) -> dict[str, int]:
    counts: Counter[str] = Counter()
    pairs = read_pairs(run.workspace.path(QUERY_PAIRS))
    for local_type in run.options.local_types():
        mapping = matched_images(run, local_type)
        described = mapping.descriptors(local_type)
        found = match_pairs(
            run.workspace.folder(QUERY, ""),
            mapping,
            [pair for pair in pairs if pair.map in described],
            local_type,
            run.options.make_matcher(),
            run.options.verify_queries(),
            out / QUERY_MATCHES,
            executor=run.executor,
            track=run.track,
        )
        counts.update(found)
    return counts


def _localization(run: Run, out: Path) -> dict[str, int]:
    query = run.workspace.folder(QUERY, "")
    pairs = read_pairs(run.workspace.path(QUERY_PAIRS))
    options = run.options.localization
    results = localize_from_matches(
        run.workspace.folder(MAP),
        query,
        run.workspace.folder(QUERY, QUERY_MATCHES),
        pairs,
        run.options.local_types(),
        options,
        restrictions=run.restrictions(),
        executor=run.executor,
        track=run.track,
    )
    return write_localized(
        out / LOCALIZED,
        query,
        results,
        fallback=options.fallback,
        first_candidates=first_candidates(pairs, run.workspace.folder(MAPPING)),
        timing=out / TIMING,
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
    provenance = _provenance(run) | {"versions": package_versions()}
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
