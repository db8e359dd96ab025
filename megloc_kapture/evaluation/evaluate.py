"""Evaluation of results on disk or in memory: against true poses, or without them."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.evaluation.metrics import Threshold
from megloc_kapture.evaluation.pose_files import poses_by_image
from megloc_kapture.evaluation.protocols import Benchmark, benchmark_of
from megloc_kapture.evaluation.results import (
    Poses,
    Result,
    ResultContext,
    context_of,
    distinct_labels,
    first_map_poses,
    read_poses,
    read_result,
    result_in_memory,
    side_tables_near,
)
from megloc_kapture.evaluation.scoring import Evaluation, evaluate_pairs, evaluate_poses
from megloc_kapture.evaluation.without_truth import WithoutTruth, evaluate_without_truth
from megloc_kapture.geometry.poses import align_poses, stack_poses
from megloc_kapture.io.dataset_tables import (
    METRES,
    SimilarityTransform,
    World,
    read_nowhere,
    unit_of,
)
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import Failure, Pose, RigidTransform

_log = logging.getLogger(__name__)

Align = Literal["none", "se3", "sim3"]
# a similarity agrees with two poses' centres by construction
_MIN_AGREEING = 4
_MOST_COMPARED = 500

Localized = Path | str | Mapping[str, Pose | Failure] | Mapping[str, RigidTransform]


def evaluate(
    estimated: Localized,
    truth: Path | str | Poses,
    *,
    dataset: str | None = None,
    side_tables: Path | str | None = None,
    thresholds: Sequence[Threshold] | None = None,
    mapping: Path | str | None = None,
    label: str | None = None,
    align: Align = "none",
) -> Evaluation:
    """Evaluate poses against true ones, by a benchmark's rules.

    The result prints as the recall table with its confidence intervals; ``.html(path)`` writes the
    report, ``.compare(other)`` tests the difference from another result, ``.to_pandas()`` is a
    table of the queries.

    Parameters
    ----------
    estimated : a kapture folder with trajectories (and perhaps ``status.csv``), a pose file, a
        COLMAP model, or image -> pose; poses in memory are ``cam_from_world`` in the frame of the
        truth, metres.
    truth : a kapture folder, a pose file, a COLMAP model, or image -> ``cam_from_world``. Queries
        that show nothing of the map are in the kapture folder's ``nowhere.txt``, one a line: they
        are right without a pose.
    dataset : whose thresholds, conditions and pools hold; by default those of the side tables.
    side_tables : the workspace's ``megloc/`` folder: conditions, which images are scored, the
        protocol, and the world a pose file has to be brought back from; found beside truth or
        result by itself.
    thresholds : instead of the protocol's.
    mapping : kapture folder of the map, for MLAD's pairs and for the report's pictures; found in
        the workspace of ``estimated`` by itself.
    label : what the result is called in tables; by default its path.
    align : sim3 and se3: align the poses with the truth first, robustly, with and without scale.
    """
    benchmark = benchmark_beside([truth, estimated], side_tables=side_tables, dataset=dataset)
    labels = None if label is None else [label]
    return evaluate_results(
        [estimated],
        truth,
        benchmark,
        thresholds=thresholds,
        mapping=mapping,
        labels=labels,
        align=align,
    )[0]


def benchmark_beside(
    beside: Sequence[object],
    *,
    side_tables: Path | str | None = None,
    dataset: str | None = None,
) -> Benchmark:
    """The benchmark of side tables, by default of the first workspace that contains a path."""
    for path in beside:
        if isinstance(path, Path | str):
            side_tables = side_tables or side_tables_near(path)
    return benchmark_of(side_tables, dataset)


def evaluate_results(
    results: Sequence[Localized],
    truth: Path | str | Poses,
    benchmark: Benchmark,
    *,
    thresholds: Sequence[Threshold] | None = None,
    mapping: Path | str | None = None,
    labels: Sequence[str] | None = None,
    align: Align = "none",
) -> list[Evaluation]:
    """Evaluate several results against one truth, by one benchmark; in their order.

    Where the benchmark has MLAD's pairs, these are what counts, by MLAD's metric.

    The other parameters are those of :func:`evaluate`; labels are by default the results' paths,
    without the folders that all of them share.
    """
    if isinstance(truth, Mapping):
        true_poses: Poses = result_in_memory(truth).poses
    else:
        true_poses = read_poses(Path(truth))
    nowhere = () if isinstance(truth, Mapping) else read_nowhere(truth)
    contexts = [_context(source, mapping) for source in results]
    relative = benchmark.protocol.pose_file == "mlad" and bool(benchmark.pairs)
    if align == "none":
        _warn_of_unit(contexts)
    elif relative:
        raise OptionError("--align: the challenge compares relative poses, which need none")
    references = first_map_poses(contexts) if relative else {}
    if relative and not references:
        raise DataError(
            f"the {len(benchmark.pairs)} pairs to relocalize need the poses of their references, "
            "which are the map's: give it with --map"
        )
    limits = thresholds or benchmark.thresholds()
    evaluations = []
    read = _read(results, benchmark, contexts, labels, true_poses, references)
    if not isinstance(truth, Mapping) and side_tables_near(truth) is None:
        true_poses = _in_local_frame(true_poses, read, benchmark.world, truth)
    if not relative:
        true_poses = _by_names_of_results(true_poses, read, {*nowhere, *benchmark.names})
    for result in read:
        found, alignment = (result, "") if relative else _aligned(result, true_poses, align)
        if relative:
            evaluation = evaluate_pairs(
                found.poses_of_pairs(benchmark.pairs),
                true_poses,
                benchmark.pairs,
                references,
                thresholds=limits,
                statuses=found.statuses,
                label=found.label,
            )
        else:
            known = {*true_poses, *found.poses, *nowhere}
            evaluation = evaluate_poses(
                found.poses,
                true_poses,
                conditions=benchmark.conditions(known),
                thresholds=limits,
                scored=benchmark.scored(known),
                statuses=found.statuses,
                condition_order=benchmark.protocol.conditions,
                pools=benchmark.protocol.pools,
                label=found.label,
                nowhere=nowhere,
                confidences=found.confidences,
                covariances=found.covariances,
            )
        known_by = benchmark.protocol.truth
        evaluation = replace(evaluation, truth_known_by=known_by, context=found.context)
        evaluations.append(replace(evaluation, alignment=alignment))
    return evaluations


def results_without_truth(
    results: Sequence[Localized],
    benchmark: Benchmark,
    *,
    thresholds: Sequence[Threshold] | None = None,
    mapping: Path | str | None = None,
    labels: Sequence[str] | None = None,
) -> WithoutTruth:
    """Evaluate results without true poses.

    The queries are those of the challenge's list; without one, those that the results are about.
    The parameters are those of :func:`evaluate_results`.
    """
    contexts = [_context(source, mapping) for source in results]
    if len(contexts) > 1:
        _warn_of_unit(contexts)
    map_poses = first_map_poses(contexts) if benchmark.pairs else {}
    known = {image for context in contexts for image in context.query_images()}
    found = _read(results, benchmark, contexts, labels, known, map_poses)
    queries = set(benchmark.names) or {pair.query for pair in benchmark.pairs}
    if not queries:
        of_results = {image for result in found for image in result.images}
        queries = benchmark.scored(known | of_results)
    return evaluate_without_truth(
        found,
        queries=sorted(queries),
        conditions=benchmark.conditions(queries),
        thresholds=thresholds or benchmark.thresholds(),
        condition_order=benchmark.protocol.conditions,
        pools=benchmark.protocol.pools,
        statement=benchmark.protocol.truth,
    )


def _read(
    results: Sequence[Localized],
    benchmark: Benchmark,
    contexts: Sequence[ResultContext],
    labels: Sequence[str] | None,
    images: Collection[str],
    references: Poses,
) -> list[Result]:
    found = []
    for source, label, context in zip(results, labels or _labels(results), contexts, strict=True):
        if isinstance(source, Mapping):
            result = result_in_memory(source, label=label)
        else:
            result = read_result(
                source, benchmark, images=images, references=references, label=label
            )
        found.append(replace(result, context=context))
    return found


def _by_names_of_results(
    true_poses: Poses, results: Sequence[Result], known: Collection[str]
) -> Poses:
    """True poses by the images' names in the results, where these have other folders."""
    images = {image for result in results for image in result.images}
    if not images & true_poses.keys():
        true_poses = poses_by_image(true_poses, images)
    for result in results:
        if result.poses and not (true_poses.keys() | known) & set(result.images):
            raise DataError(
                f"no name fits: the result has {min(result.images)!r}, the truth "
                f"{min(true_poses, default='nothing')!r}"
                + (f" ({result.label})" if result.label else "")
            )
    return true_poses


def _in_local_frame(
    true_poses: Poses, results: Sequence[Result], world: World, truth: Path | str
) -> Poses:
    """True poses as they came, or, where they fit the results a thousand times as well from the
    official frame, as a dataset's owner has them, brought to the results' local one."""
    pairs = [
        (true_poses[i], pose) for r in results for i, pose in r.poses.items() if i in true_poses
    ]
    if world == World() or not pairs:
        return true_poses

    def median_m(poses: Iterable[RigidTransform]) -> float:
        centres = ((a.center(), b.center()) for a, (_, b) in zip(poses, pairs, strict=True))
        return float(np.median([np.linalg.norm(a - b) for a, b in centres]))

    as_they_are = median_m(true for true, _ in pairs)
    if 1000 * median_m(world.pose_in_local(true) for true, _ in pairs) >= as_they_are:
        return true_poses
    _log.warning("%s is in the dataset's official frame, and is brought to that of the map", truth)
    return {image: world.pose_in_local(pose) for image, pose in true_poses.items()}


def _context(source: Localized, mapping: Path | str | None) -> ResultContext:
    if not isinstance(source, Mapping):
        return context_of(source, mapping=mapping)
    poses = {image: found for image, found in source.items() if isinstance(found, Pose)}
    return ResultContext(
        mapping=None if mapping is None else KaptureFolder(mapping),
        unit=METRES if mapping is None else unit_of(mapping),
        localized=poses,
        cameras={image: pose.camera for image, pose in poses.items() if pose.camera is not None},
    )


def _warn_of_unit(contexts: Sequence[ResultContext]) -> None:
    if any(context.unit != METRES for context in contexts):
        _log.warning("the poses are in units of a map of unknown scale, which count as metres")


def _aligned(result: Result, true_poses: Poses, align: Align) -> tuple[Result, str]:
    """The result, aligned if asked for, and a sentence on the alignment, which may be empty."""
    images = sorted(result.poses.keys() & true_poses.keys())
    if align == "none":  # a remark needs no more, and time grows with the square of their number
        images = images[:: -(-len(images) // _MOST_COMPARED) or 1]
    estimated = stack_poses(result.poses[image] for image in images)
    true = stack_poses(true_poses[image] for image in images)
    try:
        found = align_poses(estimated, true, with_scale=align != "se3")
    except DataError:
        if align == "none":
            return result, ""
        raise
    number = int(found.agrees.sum())
    kind = "a rigid transform" if align == "se3" else f"a similarity of scale {found.scale:.6g}"
    if align == "none":
        fits = number >= _MIN_AGREEING and 2 * number > len(images)
        if not fits or 2 * found.agreed_before.sum() > number:
            return result, ""
        told = f"the results fit the truth after {kind}: --align sim3"
        return result, f"{told} ({number} of {len(images)} poses agree)"
    target_from_source = found.target_from_source
    similarity = SimilarityTransform(
        quat_wxyz=target_from_source.quat_wxyz,
        translation=target_from_source.translation,
        scale=found.scale,
    )
    world = World(official_from_local=similarity)
    moved = {image: world.pose_in_official(pose) for image, pose in result.poses.items()}
    told = f"aligned with the truth by {kind}, with which {number} of {len(images)} poses agree"
    return replace(result, poses=moved), told


def _labels(results: Sequence[Localized]) -> list[str]:
    paths = [Path(source) for source in results if not isinstance(source, Mapping)]
    if len(paths) == len(results):
        return distinct_labels(paths)
    return [
        (f"result {number}" if results[1:] else "") if isinstance(source, Mapping) else str(source)
        for number, source in enumerate(results, start=1)
    ]
