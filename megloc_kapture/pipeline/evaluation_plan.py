"""The plan of ``megloc eval``: from a dataset to a pose file and a recall table."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from megloc_kapture.datasets.kapture_folders import (
    MAPPING,
    QUERY,
    QUERY_GT,
)
from megloc_kapture.datasets.official import REFERENCE
from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.folders import evaluate_folders, results_without_truth
from megloc_kapture.evaluation.outputs import write_evaluation
from megloc_kapture.evaluation.provenance import package_versions
from megloc_kapture.evaluation.rules import read_rules
from megloc_kapture.evaluation.surroundings import surroundings_of
from megloc_kapture.evaluation.without_truth_outputs import write_without_truth
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.kapture_store import ImagePair, KaptureFolder, read_pairs, write_pairs
from megloc_kapture.io.side_tables import SIDE_TABLES, Protocol, read_protocol
from megloc_kapture.pipeline.benchmarks import BenchmarkFile
from megloc_kapture.pipeline.datasets import DatasetChoice, ProtocolChange
from megloc_kapture.pipeline.manifests import FileHashes
from megloc_kapture.pipeline.plan import Stage
from megloc_kapture.pipeline.presets import PipelineOptions
from megloc_kapture.pipeline.submission import place_of, write_submission
from megloc_kapture.pipeline.workspace import HASHES, Workspace
from megloc_kapture.stages.global_vlad import extract_vlad, vlad_type
from megloc_kapture.stages.image_pairs import pair_map_images, pair_queries
from megloc_kapture.stages.lifting import lift_map
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.matches import iterate_candidates, match_pairs
from megloc_kapture.stages.parallel import Track, untracked
from megloc_kapture.stages.query_poses import localize_from_matches, write_localized
from megloc_kapture.stages.restrictions import Restrictions
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
    benchmark : what it wants different in the dataset's protocol.
    """

    source: DatasetChoice
    preset: str
    options: PipelineOptions
    workspace: Workspace
    benchmark: BenchmarkFile | None = None
    executor: Executor | None = None
    track: Track = untracked
    num_threads: int = 1

    @property
    def dataset(self) -> str:
        """The dataset's name."""
        return self.source.name

    def submission_below(self, folder: Path) -> Path:
        """Where, below ``folder``, the pose file stands; a folder where it is several files."""
        protocol = read_protocol(self.workspace.path(SIDE_TABLES))
        stem = f"{self.dataset}_eval_megloc-{self.preset}"
        return place_of(folder / SUBMISSIONS, stem, protocol)

    def restrictions(self) -> Restrictions:
        """What the dataset's side tables permit."""
        return Restrictions.read(self.workspace.path(SIDE_TABLES))


def plan_evaluation(run: Run) -> list[Stage]:
    """The stages of a run, in order.

    Raises
    ------
    MeglocError : the dataset or the options cannot be used; nothing has been written by then.
    """
    options, local_type = run.options, run.options.make_extractor().name
    run.options.make_matcher()
    dump = options.model_dump(mode="json")
    stages = [
        *_dataset_stages(run),
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
        *_map_stages(run, dump, local_type),
        Stage(
            "query_pairs",
            2,
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
                "verification": dump["verification"],
                "two_view": dump["query_verification"],
            },
            ("import", "local_features", "query_pairs"),
            (QUERY_MATCHES,),
            lambda out: _matches(run, out, local_type, for_queries=True),
        ),
        Stage(
            "localization",
            2,
            {"localization": dump["localization"]},
            ("import", "local_features", "map", "query_pairs", "query_matches"),
            (LOCALIZED, TIMING),
            lambda out: _localization(run, out, local_type),
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


def _map_stages(run: Run, dump: Mapping[str, Any], local_type: str) -> list[Stage]:
    """How the map gets its points; the last of them is called ``map``."""
    if run.options.map == "lift":
        return [
            Stage(
                "map",
                1,
                {"by": "lift", "lifting": dump["lifting"]},
                ("import", "local_features", "global_features"),
                (MAP,),
                lambda out: lift_map(
                    run.workspace.folder(MAPPING, ""),
                    local_type,
                    out / MAP,
                    run.options.lifting,
                    executor=run.executor,
                    track=run.track,
                ),
            )
        ]
    return [
        Stage(
            "mapping_pairs",
            2,
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
                "verification": dump["verification"],
                "known_poses": dump["mapping_verification"],
            },
            ("import", "local_features", "mapping_pairs"),
            (MAPPING_MATCHES,),
            lambda out: _matches(run, out, local_type, for_queries=False),
        ),
        Stage(
            "map",
            1,
            {"by": "triangulate", "triangulation": dump["triangulation"]},
            ("import", "local_features", "global_features", "mapping_matches"),
            (MAP,),
            lambda out: _triangulation(run, out, local_type),
        ),
    ]


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
        restrictions=run.restrictions(),
    )
    write_pairs(out / MAPPING_PAIRS, pairs)
    return {"pairs": len(pairs)}


def _query_pairs(run: Run, out: Path, local_type: str) -> dict[str, int]:
    pairs = pair_queries(
        run.workspace.folder(MAPPING, ""),
        run.workspace.folder(QUERY, ""),
        run.options.query_pairs,
        global_type=vlad_type(local_type),
        restrictions=run.restrictions(),
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
