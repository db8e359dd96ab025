"""The plan of ``megloc eval``: from a dataset to a pose file and a recall table."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from megloc_kapture.datasets.kapture_folders import (
    MAPPING,
    QUERY,
    QUERY_GT,
    SIDE_TABLES,
    check_root,
    import_kapture_folders,
    input_files,
)
from megloc_kapture.evaluation.folders import evaluate_folders, load_poses, load_statuses
from megloc_kapture.evaluation.outputs import write_evaluation
from megloc_kapture.evaluation.pose_file import write_pose_file
from megloc_kapture.evaluation.provenance import package_versions, write_provenance
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.kapture_store import ImagePair, KaptureFolder, read_pairs, write_pairs
from megloc_kapture.io.side_tables import Protocol, read_protocol, read_world
from megloc_kapture.pipeline.manifests import FileHashes
from megloc_kapture.pipeline.plan import Stage
from megloc_kapture.pipeline.presets import PipelineOptions
from megloc_kapture.pipeline.workspace import HASHES, Workspace
from megloc_kapture.stages.global_vlad import extract_vlad, vlad_type
from megloc_kapture.stages.image_pairs import pair_map_images, pair_queries
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.matches import iterate_candidates, match_pairs
from megloc_kapture.stages.parallel import Track, untracked
from megloc_kapture.stages.query_poses import localize_from_matches, write_localized
from megloc_kapture.stages.triangulation import triangulate_map
from megloc_kapture.values import RigidTransform

MAPPING_PAIRS, QUERY_PAIRS = "pairs/mapping.txt", "pairs/query.txt"
MAPPING_MATCHES, QUERY_MATCHES = "matches/mapping", "matches/query"
MAP, LOCALIZED, SUBMISSIONS, EVALUATION = "map", "localized", "submissions", "evaluation"
TIMING = "timing.csv"


@dataclass(frozen=True)
class Run:
    """What a run works on and with.

    Attributes
    ----------
    root : the pair of kapture folders; None when ``render`` makes it inside the workspace.
    render : writes the dataset to the folder it is given (rendered worlds); with its options.
    """

    dataset: str
    preset: str
    options: PipelineOptions
    workspace: Workspace
    root: Path | None = None
    render: Callable[[Path], Mapping[str, float]] | None = None
    render_options: Mapping[str, Any] | None = None
    query_prefix: str = ""
    thresholds: tuple[tuple[float, float | None], ...] | None = None
    executor: Executor | None = None
    track: Track = untracked
    num_threads: int = 1

    @property
    def pose_file(self) -> str:
        """Name of the pose file, below the workspace."""
        return f"{SUBMISSIONS}/{self.dataset}_eval_megloc-{self.preset}.txt"


def plan_evaluation(run: Run) -> list[Stage]:
    """The stages of a run, in order.

    Raises
    ------
    MeglocError : the dataset or the options cannot be used; nothing has been written by then.
    """
    options, local_type = run.options, run.options.make_extractor().name
    run.options.make_matcher()
    dump = options.model_dump(mode="json")
    verification = dump["verification"]
    stages = _dataset_stages(run)
    stages += [
        Stage(
            "local_features",
            1,
            {"local_features": dump["local_features"]},
            ("import",),
            ("local_features",),
            lambda out: _local_features(run, out),
        ),
        Stage(
            "global_features",
            1,
            {"vlad": dump["vlad"], "local_type": local_type},
            ("local_features",),
            ("global_features",),
            lambda out: _global_features(run, out, local_type),
        ),
        Stage(
            "mapping_pairs",
            1,
            {"mapping_pairs": dump["mapping_pairs"]},
            ("import", "global_features"),
            (MAPPING_PAIRS,),
            lambda out: _mapping_pairs(run, out, local_type),
        ),
        Stage(
            "mapping_matches",
            1,
            {
                "matching": dump["matching"],
                "verification": verification,
                "known_poses": dump["mapping_verification"],
            },
            ("import", "local_features", "mapping_pairs"),
            (MAPPING_MATCHES,),
            lambda out: _matches(run, out, local_type, for_queries=False),
        ),
        Stage(
            "triangulation",
            1,
            {"triangulation": dump["triangulation"]},
            ("import", "local_features", "global_features", "mapping_matches"),
            (MAP,),
            lambda out: _triangulation(run, out, local_type),
        ),
        Stage(
            "query_pairs",
            1,
            {"query_pairs": dump["query_pairs"]},
            ("import", "global_features"),
            (QUERY_PAIRS,),
            lambda out: _query_pairs(run, out, local_type),
        ),
        Stage(
            "query_matches",
            1,
            {
                "matching": dump["matching"],
                "verification": verification,
                "two_view": dump["query_verification"],
            },
            ("import", "local_features", "query_pairs"),
            (QUERY_MATCHES,),
            lambda out: _matches(run, out, local_type, for_queries=True),
        ),
        Stage(
            "localization",
            1,
            {"localization": dump["localization"]},
            ("import", "local_features", "triangulation", "query_pairs", "query_matches"),
            (LOCALIZED, TIMING),
            lambda out: _localization(run, out, local_type),
        ),
        Stage(
            "submission",
            1,
            {"dataset": run.dataset, "preset": run.preset, "options": dump},
            ("import", "localization"),
            (SUBMISSIONS,),
            lambda out: _submission(run, out),
        ),
        Stage(
            "evaluation",
            1,
            {"dataset": run.dataset, "preset": run.preset, "options": dump},
            ("import", "localization"),
            (EVALUATION,),
            lambda out: _evaluation(run, out),
        ),
    ]
    return stages


def _dataset_stages(run: Run) -> list[Stage]:
    """Import, behind rendering where the dataset is made rather than given."""
    protocol = {"thresholds": run.thresholds, "query_prefix": run.query_prefix}

    def change(given: Protocol) -> Protocol:
        dataset = run.dataset if given.dataset == Protocol().dataset else given.dataset
        changes: dict[str, Any] = {"dataset": dataset}
        if run.thresholds is not None:
            changes["thresholds"] = run.thresholds
        return given.model_copy(update=changes)

    def import_from(root: Path) -> Callable[[Path], Mapping[str, float]]:
        return lambda out: import_kapture_folders(
            root, out, query_prefix=run.query_prefix, protocol_change=change
        )

    outputs = (MAPPING, QUERY, QUERY_GT, SIDE_TABLES)
    settings = {"dataset": run.dataset, **protocol}
    if run.render is not None:
        world = run.workspace.path("world")
        return [
            Stage("render", 1, dict(run.render_options or {}), (), ("world",), run.render),
            Stage("import", 1, settings, ("render",), outputs, import_from(world)),
        ]
    if run.root is None:
        raise ValueError("a run needs a root or something that renders one")
    root = check_root(run.root).resolve()
    remembered = run.workspace.path(HASHES)
    hashes = FileHashes(remembered)
    content = hashes.of_files(root, input_files(root))
    write_bytes(remembered, (json.dumps(hashes.content()) + "\n").encode())
    external = {"dataset files": content, "dataset root": str(root)}
    return [Stage("import", 1, settings, (), outputs, import_from(root), external)]


def _local_features(run: Run, out: Path) -> dict[str, int]:
    folders = [run.workspace.folder(MAPPING), run.workspace.folder(QUERY)]
    return extract_local_features(
        folders, run.options.make_extractor(), out, executor=run.executor, track=run.track
    )


def _global_features(run: Run, out: Path, local_type: str) -> dict[str, int]:
    mapping, query = run.workspace.folder(MAPPING, ""), run.workspace.folder(QUERY, "")
    return extract_vlad(
        mapping,
        [mapping, query],
        local_type,
        out,
        run.options.vlad,
        executor=run.executor,
        track=run.track,
    )


def _mapping_pairs(run: Run, out: Path, local_type: str) -> dict[str, int]:
    pairs = pair_map_images(
        run.workspace.folder(MAPPING, ""),
        run.options.mapping_pairs,
        global_type=vlad_type(local_type),
    )
    write_pairs(out / MAPPING_PAIRS, pairs)
    return {"pairs": len(pairs)}


def _query_pairs(run: Run, out: Path, local_type: str) -> dict[str, int]:
    pairs = pair_queries(
        run.workspace.folder(MAPPING, ""),
        run.workspace.folder(QUERY, ""),
        run.options.query_pairs,
        global_type=vlad_type(local_type),
    )
    write_pairs(out / QUERY_PAIRS, pairs)
    return {"pairs": len(pairs)}


def _matches(run: Run, out: Path, local_type: str, *, for_queries: bool) -> dict[str, int]:
    mapping = run.workspace.folder(MAPPING, "")
    first = run.workspace.folder(QUERY, "") if for_queries else mapping
    options = run.options
    return match_pairs(
        first,
        mapping,
        read_pairs(run.workspace.path(QUERY_PAIRS if for_queries else MAPPING_PAIRS)),
        local_type,
        options.make_matcher(),
        options.verify_queries() if for_queries else options.verify_mapping(),
        out / (QUERY_MATCHES if for_queries else MAPPING_MATCHES),
        executor=run.executor,
        track=run.track,
    )


def _triangulation(run: Run, out: Path, local_type: str) -> dict[str, float]:
    return triangulate_map(
        run.workspace.folder(MAPPING, ""),
        run.workspace.folder(MAPPING, MAPPING_MATCHES),
        local_type,
        out / MAP,
        run.options.triangulation,
        num_threads=run.num_threads,
    )


def _localization(run: Run, out: Path, local_type: str) -> dict[str, int]:
    query = run.workspace.folder(QUERY, "")
    pairs = read_pairs(run.workspace.path(QUERY_PAIRS))
    options = run.options.localization
    results = localize_from_matches(
        run.workspace.folder(MAP),
        query,
        run.workspace.folder(QUERY, QUERY_MATCHES),
        pairs,
        local_type,
        options,
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
    localized = run.workspace.path(LOCALIZED)
    tables = run.workspace.path(SIDE_TABLES)
    return write_submission(
        localized, out / run.pose_file, tables=tables, provenance=_provenance(run)
    )


def write_submission(
    localized: Path, place: Path, *, tables: Path | None, provenance: Mapping[str, Any]
) -> dict[str, int]:
    """Write the pose file of a localized kapture, in the official frame, and its provenance."""
    poses = load_poses(localized)
    rule = Protocol() if tables is None else read_protocol(tables)
    if tables is not None:
        world = read_world(tables)
        poses = {image: world.pose_in_official(pose) for image, pose in poses.items()}
    statuses = load_statuses(localized) or {}
    write_pose_file(place, poses, names=rule.pose_file_names)
    counts = {
        "queries": len(KaptureFolder(localized).read().image_names()),
        "poses": len(poses),
        "fallbacks": sum(status.fallback != "none" for status in statuses.values()),
    }
    write_provenance(place, provenance, counts=counts)
    return counts


def _evaluation(run: Run, out: Path) -> dict[str, float]:
    truth = run.workspace.path(QUERY_GT)
    if not truth.is_dir():
        return {"queries_with_truth": 0}
    evaluation = evaluate_folders(
        run.workspace.path(LOCALIZED),
        truth,
        side_tables=run.workspace.path(SIDE_TABLES),
        label=f"{run.dataset}, {run.preset}",
    )
    write_evaluation(
        out / EVALUATION,
        evaluation,
        map_poses=run.workspace.folder(MAPPING).read().poses(),
        provenance=_provenance(run) | {"versions": package_versions()},
    )
    row = evaluation.row()
    recall = {f"recall at {at.threshold}": round(at.recall, 4) for at in row.recall}
    return {"queries_with_truth": len(evaluation.queries), **recall}


__all__ = ["Run", "plan_evaluation", "write_submission"]
