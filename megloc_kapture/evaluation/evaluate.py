"""Evaluation of results on disk or in memory, with or without true poses."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from megloc_kapture.errors import DataError, OptionError, check_option, require
from megloc_kapture.evaluation.comparison import WithoutTruth, evaluate_without_truth
from megloc_kapture.evaluation.metrics import Threshold, pairs_of_thresholds, pose_errors
from megloc_kapture.evaluation.pose_files import poses_by_image
from megloc_kapture.evaluation.protocols import benchmark_of
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
    with_names_of,
)
from megloc_kapture.evaluation.scoring import Evaluation, evaluate_pairs, evaluate_poses
from megloc_kapture.geometry.poses import (
    READINGS,
    align_poses,
    better_conventions,
    camera_centers,
    stack_poses,
)
from megloc_kapture.io.dataset_tables import (
    METRES,
    SideTables,
    SimilarityTransform,
    World,
    check_tables,
    read_nowhere,
    unit_of,
)
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.values import Failure, Pose, RigidTransform

_log = logging.getLogger(__name__)

Align = Literal["none", "se3", "sim3"]
# a similarity transform always fits two camera centres exactly, so two poses that agree prove
# nothing
_MIN_AGREEING = 4
# largest number of poses sampled to find out whether an alignment would fit
_MOST_COMPARED = 500
# a pose fits the truth in a convention if its errors are at most these: position error as a share
# of the extent of the true camera centres, rotation error in degrees
_NEAR_SHARE, _NEAR_DEG = 0.1, 10.0

Localized = Path | str | Mapping[str, Pose | Failure] | Mapping[str, RigidTransform]


def evaluate(
    estimated: Localized,
    truth: Path | str | Poses,
    *,
    dataset: str | None = None,
    side_tables: Path | str | None = None,
    thresholds: Sequence[Threshold | tuple[float, float] | str] | None = None,
    mapping: Path | str | None = None,
    label: str | None = None,
    align: Align = "none",
) -> Evaluation:
    """Evaluate poses against true poses by the rules of a benchmark.

    The result prints as the recall table with confidence intervals; ``.html(path)`` writes the
    report, ``.compare(other)`` tests the difference from another result, ``.to_pandas()`` returns a
    table of the queries.

    Parameters
    ----------
    estimated, truth : kapture folder, pose file, COLMAP model, or image -> ``cam_from_world`` in
        metres. A folder of results may have a ``status.csv``. A folder of true poses may have a
        ``nowhere.txt``, one query per line: images that do not show the map, for which no pose is
        correct.
    dataset : name of the dataset whose thresholds, conditions and pools apply; by default those of
        the side tables.
    side_tables : ``megloc/`` folder of a workspace; by default that of the workspace of ``truth``,
        else of ``estimated``.
    thresholds : recall thresholds (metres, degrees) instead of the protocol's.
    mapping : kapture folder of the map, for MLAD's pairs and for pictures; by default that of the
        workspace of ``estimated``.
    label : name of the result in tables; by default its path.
    align : align the poses with the truth first, robustly; ``sim3`` with scale, ``se3`` without.
    """
    check_option(align in get_args(Align), f"align is {align!r}; give none, se3 or sim3")
    for poses in (estimated, truth):
        check_option(
            isinstance(poses, Path | str | Mapping),
            "poses are a kapture folder, a pose file, a COLMAP model, or image -> cam_from_world, "
            f"got {type(poses).__name__}",
        )
    given = () if thresholds is None else thresholds
    bounds = [_threshold(each) for each in ([given] if isinstance(given, str) else given)]
    benchmark = benchmark_near(
        [truth, estimated], side_tables=side_tables, dataset=dataset, thresholds=bounds
    )
    labels = None if label is None else [label]
    return evaluate_results(
        [estimated], truth, benchmark, mapping=mapping, labels=labels, align=align
    )[0]


def _threshold(given: Any) -> Threshold:
    if isinstance(given, Threshold):
        return given
    check_option(np.iterable(given), f"thresholds must be (metres, degrees) pairs, got {given}")
    return Threshold.parse(given if isinstance(given, str) else ", ".join(map(str, given)))


def benchmark_near(
    paths: Sequence[object],
    *,
    side_tables: Path | str | None = None,
    dataset: str | None = None,
    thresholds: Sequence[Threshold] = (),
) -> SideTables:
    """Return the benchmark of ``side_tables``, or of the first path that is in a workspace.

    ``thresholds``, if any, replace those of its protocol.
    """
    if side_tables is not None:
        check_tables(side_tables)
    for path in paths:
        if isinstance(path, Path | str):
            side_tables = side_tables or side_tables_near(path)
    benchmark = benchmark_of(side_tables, dataset)
    if not thresholds:
        return benchmark
    update = {"thresholds": pairs_of_thresholds(thresholds)}
    return replace(benchmark, protocol=benchmark.protocol.model_copy(update=update))


def evaluate_results(
    results: Sequence[Localized],
    truth: Path | str | Poses,
    benchmark: SideTables,
    *,
    mapping: Path | str | None = None,
    labels: Sequence[str] | None = None,
    align: Align = "none",
) -> list[Evaluation]:
    """Evaluate several results in their order; see :func:`evaluate`.

    If the benchmark has MLAD pairs, the relative poses of the pairs are evaluated by MLAD's metric.
    """
    if isinstance(truth, Mapping):
        true_poses: Poses = result_in_memory(truth).poses
    else:
        true_poses = read_poses(Path(truth))
        require(true_poses, "has no poses, but true poses are needed", path=truth)
    nowhere = () if isinstance(truth, Mapping) else read_nowhere(truth)
    contexts = [_context(source, mapping) for source in results]
    relative = benchmark.protocol.pose_file == "mlad" and bool(benchmark.relocalization)
    if align == "none":
        _warn_of_unit(contexts)
    elif relative:
        raise OptionError("--align: the challenge compares relative poses, which need no alignment")
    references = first_map_poses(contexts) if relative else {}
    require(
        not relative or references,
        f"the {len(benchmark.relocalization)} pairs to relocalize need the poses of their "
        "reference images: give the map with --map",
    )
    read = _read(results, benchmark, contexts, labels, true_poses, references)
    if not isinstance(truth, Mapping) and side_tables_near(truth) is None:
        true_poses = _in_local_frame(true_poses, read, benchmark.world, truth)
    if relative:
        return [evaluate_pairs(result, true_poses, benchmark, references) for result in read]
    true_poses, read = _by_common_names(true_poses, read, {*nowhere, *benchmark.names})
    evaluations = []
    for result in read:
        aligned, note = _aligned(result, true_poses, align)
        evaluation = evaluate_poses(aligned, true_poses, benchmark, nowhere=nowhere)
        evaluations.append(replace(evaluation, alignment=note))
    return evaluations


def results_without_truth(
    results: Sequence[Localized],
    benchmark: SideTables,
    *,
    mapping: Path | str | None = None,
    labels: Sequence[str] | None = None,
) -> WithoutTruth:
    """Evaluate results without true poses; see :func:`evaluate`.

    The queries are those of the challenge's list or pairs, else the scored images of the results
    and of their workspaces.
    """
    contexts = [_context(source, mapping) for source in results]
    if len(contexts) > 1:
        _warn_of_unit(contexts)
    map_poses = first_map_poses(contexts) if benchmark.relocalization else {}
    known = {image for context in contexts for image in context.query_images()}
    read = _read(results, benchmark, contexts, labels, known, map_poses)
    for first, other in pairwise(result for result in read if result.images):
        require(
            not {*first.images}.isdisjoint(other.images),
            f"no query in common: {first.label} has {first.images[0]!r}, {other.label} has "
            f"{other.images[0]!r}",
        )
    queries = set(benchmark.names) or {pair.query for pair in benchmark.relocalization}
    if not queries:
        of_results = {image for result in read for image in result.images}
        queries = benchmark.scored(known | of_results)
    return evaluate_without_truth(read, benchmark, queries=queries)


def _read(
    results: Sequence[Localized],
    benchmark: SideTables,
    contexts: Sequence[ResultContext],
    labels: Sequence[str] | None,
    images: Collection[str],
    references: Poses,
) -> list[Result]:
    read: list[Result] = []
    for source, label, context in zip(results, labels or _labels(results), contexts, strict=True):
        if isinstance(source, Mapping):
            result = result_in_memory(source, label=label)
        else:
            # without known names, use the first result's: pose files may spell them differently
            names = images or (read[0].images if read else ())
            result = read_result(
                source, benchmark, images=names, references=references, label=label
            )
        read.append(replace(result, context=context))
    return read


def _by_common_names(
    true_poses: Poses, results: Sequence[Result], known: Collection[str]
) -> tuple[Poses, list[Result]]:
    """Rename images so that results and truth match, even if their leading folders differ.

    True poses are renamed if no result shares a name with them, then each result that shares none.
    """
    images = {image for result in results for image in result.images}
    if not images & true_poses.keys():
        true_poses = poses_by_image(true_poses, images)
    results = [with_names_of(result, true_poses.keys() | known) for result in results]
    for result in results:
        # queries that failed are in status.csv only
        names = {*result.images, *result.statuses}
        if result.poses and not (true_poses.keys() | known) & names:
            raise DataError(
                f"no name fits: the result has {min(result.images)!r}, the truth "
                f"{min(true_poses, default='nothing')!r}"
                + (f" ({result.label})" if result.label else "")
            )
    return true_poses, results


def _in_local_frame(
    true_poses: Poses, results: Sequence[Result], world: World, truth: Path | str
) -> Poses:
    """Transform true poses from the official to the local frame, if necessary.

    They are taken to be in the official frame if the transform brings the true camera centres a
    thousand times closer to the estimated ones.
    """
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
    _log.warning(
        "%s is in the dataset's official frame, and is transformed to the frame of the map", truth
    )
    return {image: world.pose_in_local(pose) for image, pose in true_poses.items()}


def _context(source: Localized, mapping: Path | str | None) -> ResultContext:
    require(mapping is None or Path(mapping).is_dir(), "no such folder", path=mapping)
    if not isinstance(source, Mapping):
        return context_of(source, mapping=mapping)
    poses = {image: pose for image, pose in source.items() if isinstance(pose, Pose)}
    return ResultContext(
        mapping=None if mapping is None else KaptureFolder(mapping),
        unit=METRES if mapping is None else unit_of(mapping),
        localized=poses,
        cameras={image: pose.camera for image, pose in poses.items() if pose.camera is not None},
    )


def _warn_of_unit(contexts: Sequence[ResultContext]) -> None:
    if any(context.unit != METRES for context in contexts):
        _log.warning(
            "the poses are in units of a map of unknown scale, which are treated as metres"
        )


def _aligned(result: Result, true_poses: Poses, align: Align) -> tuple[Result, str]:
    """Return the result, aligned if requested, and a note on the alignment (may be empty)."""
    images = sorted(result.poses.keys() & true_poses.keys())
    if align == "none":  # a sample is enough for a note; time grows with the square of its size
        images = images[:: -(-len(images) // _MOST_COMPARED) or 1]
        if note := _convention_note(result.poses, true_poses, images):
            return result, note
    estimated = stack_poses(result.poses[image] for image in images)
    true = stack_poses(true_poses[image] for image in images)
    try:
        alignment = align_poses(estimated, true, with_scale=align != "se3")
    except DataError:
        if align == "none":
            return result, ""
        raise
    number = int(alignment.agrees.sum())
    kind = "a rigid transform" if align == "se3" else f"a similarity of scale {alignment.scale:.6g}"
    if align == "none":
        fits = number >= _MIN_AGREEING and 2 * number > len(images)
        if not fits or 2 * alignment.agreed_before.sum() > number:
            return result, ""
        note = f"the results fit the truth after {kind}; use --align sim3"
        return result, f"{note} ({number} of {len(images)} poses agree)"
    target_from_source = alignment.target_from_source
    similarity = SimilarityTransform(
        quat_wxyz=target_from_source.quat_wxyz,
        translation=target_from_source.translation,
        scale=alignment.scale,
    )
    world = World(official_from_local=similarity)
    moved = {image: world.pose_in_official(pose) for image, pose in result.poses.items()}
    note = f"aligned with the truth by {kind}, with which {number} of {len(images)} poses agree"
    return replace(result, poses=moved), note


def _convention_note(estimated: Poses, true: Poses, images: Sequence[str]) -> str:
    """Name the pose conventions in which the results, or the true poses, would fit, if any."""
    if len(images) < _MIN_AGREEING:
        return ""
    extent_m = np.ptp(camera_centers(*stack_poses(true[image] for image in images)), axis=0).max()
    sides = {"results": (estimated, true), "true poses": (true, estimated)}
    for whose, (poses, others) in sides.items():
        shares = []
        for read in READINGS:
            errors = pose_errors({image: read(poses[image]) for image in images}, others, images)
            near = errors.position_m <= _NEAR_SHARE * extent_m
            shares.append(float((near & (errors.angle_deg <= _NEAR_DEG)).mean()))
        if better := better_conventions(shares):
            return (
                f"{shares[0]:.0%} of the poses fit the truth, but {max(shares):.0%} with the "
                f"{whose} in another convention: {' or '.join(better)}. Convert them to "
                "cam_from_world with x right, y down, z forward"
            )
    return ""


def _labels(results: Sequence[Localized]) -> list[str]:
    paths = [Path(source) for source in results if not isinstance(source, Mapping)]
    if len(paths) == len(results):
        return distinct_labels(paths)
    return [
        (f"result {number}" if results[1:] else "") if isinstance(source, Mapping) else str(source)
        for number, source in enumerate(results, start=1)
    ]
