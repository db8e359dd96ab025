"""Results of relocalization pairs against true poses, by MLAD's metric.

The MLAD challenges hand out pairs of a reference and a query and score ``|t - t_true|`` of
``query_from_reference``, without the rotation. That length mixes the error of the camera's centre
with the error of its rotation times the distance of the two cameras, so the distance of the
centres is reported beside it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.metrics import (
    PoseErrors,
    Threshold,
)
from megloc_kapture.evaluation.scoring import Evaluation, evaluate_poses
from megloc_kapture.geometry.poses import compose, invert, stack_poses
from megloc_kapture.io.dataset_tables import RelocalizationPair
from megloc_kapture.io.tables import QueryStatus
from megloc_kapture.values import RigidTransform


def relative_translation_errors(
    estimated: tuple[NDArray[np.float64], NDArray[np.float64]],
    truth: tuple[NDArray[np.float64], NDArray[np.float64]],
    references: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """``|t - t_true|`` (N,) of ``query_from_reference``, in metres.

    Parameters
    ----------
    estimated, truth, references : ``cam_from_world`` of the queries, and of the reference each is
        paired with, in one frame: quaternions (N, 4), w first, and translations (N, 3).
    """
    world_from_reference = invert(*references)
    _, found = compose(*estimated, *world_from_reference)
    _, true = compose(*truth, *world_from_reference)
    return np.asarray(np.linalg.norm(found - true, axis=1), dtype=np.float64)


def pair_names(pairs: Sequence[RelocalizationPair]) -> list[str]:
    """Names of the pairs in tables: the query; with file and reference where one query
    stands in several pairs."""
    times = Counter(pair.query for pair in pairs)
    return [
        pair.query if times[pair.query] == 1 else f"{pair.query} from {pair.reference}, {pair.file}"
        for pair in pairs
    ]


def evaluate_pairs(
    estimated: Mapping[RelocalizationPair, RigidTransform],
    truth: Mapping[str, RigidTransform],
    pairs: Sequence[RelocalizationPair],
    references: Mapping[str, RigidTransform],
    *,
    thresholds: Sequence[Threshold],
    scored: Collection[str] | None = None,
    statuses: Mapping[str, QueryStatus] | None = None,
    label: str = "",
) -> Evaluation:
    """Evaluate by MLAD's metric: every pair counts once, and each file is a condition.

    Parameters
    ----------
    estimated : ``cam_from_world`` of a pair's query; pairs may be absent.
    truth : ``cam_from_world`` of queries by image name, in the same frame, metres.
    pairs : what the challenge asks for.
    references : ``cam_from_world`` of the reference images, in the same frame.
    scored : the images that count; pairs of others are left out.
    statuses : rows of ``status.csv`` by image.

    Returns
    -------
    The errors' position is the relative translation's; ``by_center`` has the distances of the
    centres. Pairs whose query has no true pose are named in ``without_truth``.

    Raises
    ------
    DataError : a reference has no pose, a pair is listed twice, or no pair can be counted.
    OptionError : there is no threshold.
    """
    absent = next((pair for pair in pairs if pair.reference not in references), None)
    if absent is not None:
        raise DataError(f"reference {absent.reference!r} of {absent.file!r} has no pose in the map")
    named = dict(zip(pair_names(pairs), pairs, strict=True))
    if len(named) != len(pairs):
        raise DataError("a pair of reference and query is listed twice in one file")
    called = _conditions(dict.fromkeys(pair.file for pair in pairs))
    asked = {n: p for n, p in named.items() if scored is None or p.query in scored}
    by_center = evaluate_poses(
        {n: estimated[p] for n, p in asked.items() if p in estimated},
        {n: truth[p.query] for n, p in asked.items() if p.query in truth},
        conditions={n: called[p.file] for n, p in asked.items()} if len(called) > 1 else None,
        thresholds=thresholds,
        scored=asked.keys(),
        statuses=_statuses_of_pairs(asked, statuses),
        condition_order=list(called.values()),
        label=label,
    )
    names = by_center.errors.names
    found = by_center.errors.has_pose
    posed = [name for name, has in zip(names, found, strict=True) if has]
    position_m = np.full(len(names), np.inf)
    position_m[found] = relative_translation_errors(
        stack_poses(estimated[named[name]] for name in posed),
        stack_poses(truth[named[name].query] for name in posed),
        stack_poses(references[named[name].reference] for name in posed),
    )
    relative = evaluate_poses(
        by_center.estimated,
        by_center.truth,
        conditions={query.image: query.condition for query in by_center.queries},
        thresholds=thresholds,
        statuses=_statuses_of_pairs(asked, statuses),
        condition_order=list(by_center.members),
        label=label,
        errors=PoseErrors(names, position_m, by_center.errors.angle_deg),
    )
    return replace(
        relative,
        without_truth=by_center.without_truth,
        pairs={name: asked[name] for name in names},
        by_center=by_center,
    )


def _conditions(files: Iterable[str]) -> dict[str, str]:
    """Relocalization file -> what it is called as a condition: the recording it is about."""
    whole = {file: PurePosixPath(file).stem for file in files}
    short = {}
    for file, stem in whole.items():
        target = stem.rsplit("_to_", 1)[-1]
        for prefix in ("relocalizationFile_", "reloc_", "recording_"):
            target = target.removeprefix(prefix)
        short[file] = target
    return short if len(set(short.values())) == len(short) else whole


def _statuses_of_pairs(
    asked: Mapping[str, RelocalizationPair], statuses: Mapping[str, QueryStatus] | None
) -> dict[str, QueryStatus] | None:
    if statuses is None:
        return None
    return {name: statuses[p.query] for name, p in asked.items() if p.query in statuses}
