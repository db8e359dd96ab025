"""The tables of a workspace: views of :class:`~megloc_kapture.values.LocalizationResult`, others.

==================== =============================================================================
status.csv           outcome of every query, with the localized poses
clusters.csv         clusters of candidates in which every query was localized
covariance.csv       uncertainty of every localized pose
refinement.csv       outcome of refining each query's pose, step by step
map_consistency.csv  displacement of a map's own images by refinement, by coordinate frame
depth.csv            stereo depth of the map's images
match_counts.csv     matches and verified matches of each pair, with the matches of a type
==================== =============================================================================

Readers and writers take the file itself and keep its order, unless they say otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import (
    ImageName,
    Table,
    flag,
    list_of,
    number,
    or_empty,
    pose_text,
    read_csv_table,
    write_csv_table,
)
from megloc_kapture.io.files import named
from megloc_kapture.values import (
    Fallback,
    LocalizationResult,
    Pose,
    PoseRefinement,
    RigidTransform,
)

STATUS_FILE = "status.csv"
COVARIANCE_FILE = "covariance.csv"
POSES_FILE = "poses.csv"
CLUSTERS_FILE = "clusters.csv"
REFINEMENT_FILE = "refinement.csv"
CONSISTENCY_FILE = "map_consistency.csv"


def status_row(result: LocalizationResult) -> dict[str, Any]:
    """Return a result as a row of ``status.csv``.

    The columns are the parameters of :func:`_result_of_row`: a new one goes there as well.
    """
    return {
        "image": result.name,
        "status": result.status,
        "reason": result.reason,
        "num_matches": result.num_matches or 0,
        "num_inliers": result.num_inliers or 0,
        "confidence": result.confidence,
        "cluster": result.cluster,
        "fallback": result.fallback,
        "candidates": result.candidates,
        "refinement": "; ".join(
            f"{step.method}: {step.reason or 'accepted'}" for step in result.refinements
        ),
        "remarks": "; ".join(result.remarks),
    }


def _result_of_row(
    image: ImageName,
    status: Literal["localized", "failed"],
    reason: str = "",
    num_matches: int = 0,
    num_inliers: int = 0,
    confidence: Annotated[float | None, or_empty(number(".4f", most=1.0))] = None,
    cluster: int | None = None,
    fallback: Fallback = "none",
    candidates: tuple[str, ...] = (),
    refinement: str = "",
    remarks: str = "",
) -> LocalizationResult:
    if status == "failed":
        reason = reason or "no reason is given"
    return LocalizationResult(
        name=image,
        reason=reason if status == "failed" else "",
        num_matches=num_matches,
        num_inliers=num_inliers,
        confidence=confidence,
        cluster=cluster,
        fallback=fallback,
        candidates=candidates,
        remarks=tuple(remarks.split("; ")) if remarks else (),
    )


_STATUS = Table(_result_of_row, keys=[("image",)], later=("confidence", "remarks"))


def read_status(path: Path | str) -> dict[str, LocalizationResult]:
    """Read ``status.csv``: results by name, without poses and refinements."""
    return {row.name: row for row in sorted(_STATUS.read(path), key=lambda row: row.name)}


def write_status(path: Path | str, results: Iterable[LocalizationResult]) -> None:
    _STATUS.write(path, sorted(map(status_row, results), key=lambda row: str(row["image"])))


_UPPER = np.triu_indices(6)
_AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
_COVARIANCE_COLUMNS = ("image", *(f"{_AXES[i]}_{_AXES[j]}" for i, j in zip(*_UPPER, strict=True)))


def read_covariances(path: Path | str) -> dict[str, NDArray[np.float64]]:
    """Read covariances (6, 6) by image from their upper triangles ``rx_rx, rx_ry, ... tz_tz``."""
    found = {}
    for line, row in read_csv_table(path, _COVARIANCE_COLUMNS):
        with named(path, line):
            image, *texts = (row[name] for name in _COVARIANCE_COLUMNS)
            covariance = np.empty((6, 6))
            try:
                covariance[_UPPER] = covariance.T[_UPPER] = [float(text) for text in texts]
                if not np.isfinite(np.linalg.cholesky(covariance)).all():
                    raise ValueError
            except ValueError as error:  # LinAlgError is one
                raise DataError(f"{image!r} has no positive definite covariance") from error
            found[image] = covariance
    return found


def write_covariances(path: Path, results: Iterable[LocalizationResult]) -> None:
    """Write ``covariance.csv`` of the poses that have a covariance, sorted by image."""
    rows = [
        (pose.name, *map(repr, pose.covariance[_UPPER].tolist()))
        for pose in sorted(results, key=lambda result: result.name)
        if isinstance(pose, Pose) and pose.covariance is not None
    ]
    write_csv_table(path, _COVARIANCE_COLUMNS, rows)


def write_clusters(path: Path, results: Iterable[LocalizationResult]) -> None:
    """Write ``clusters.csv``: the clusters of each result, sorted by image, poses unrefined."""
    columns = ("image", "cluster", "chosen", "num_matches", "num_inliers", "score", "reason")
    rows = [
        (
            result.name,
            str(index),
            "yes" if index == result.cluster else "no",
            str(cluster.num_matches),
            str(cluster.num_inliers),
            "" if cluster.score is None else f"{cluster.score:.6g}",
            cluster.reason,
            ",".join(cluster.candidates),
            "" if cluster.cam_from_world is None else pose_text(cluster.cam_from_world),
        )
        for result in sorted(results, key=lambda result: result.name)
        for index, cluster in enumerate(result.clusters)
    ]
    write_csv_table(path, (*columns, "images", "cam_from_world"), rows)


def _refinement_row(
    image: str,
    method: str,
    accepted: Annotated[bool, flag("yes", "no")],
    reason: str,
    moved_m: Annotated[float, number(".6f")],
    turned_deg: Annotated[float, number(".6f")],
    measures: Annotated[tuple[str, ...], list_of(";")],
    before: RigidTransform,
) -> tuple[str, PoseRefinement]:
    named_values = (text.partition("=") for text in measures)
    return image, PoseRefinement(
        before,
        reason,
        {name: float(value) for name, _, value in named_values},
        method=method,
        before=before,
        moved_m=moved_m,
        turned_deg=turned_deg,
    )


_REFINEMENT = Table(_refinement_row)


def read_refinement(
    path: Path | str, refined: Mapping[str, RigidTransform]
) -> dict[str, tuple[PoseRefinement, ...]]:
    """Read ``refinement.csv``: steps by image, of which the last led to the ``refined`` pose."""
    by_image: dict[str, list[PoseRefinement]] = {}
    for image, step in _REFINEMENT.read(path):
        by_image.setdefault(image, []).append(step)
    found = {}
    for image, steps in by_image.items():
        ends = [*(step.cam_from_world for step in steps[1:]), refined.get(image)]
        found[image] = tuple(
            replace(step, cam_from_world=end) if step.accepted and end is not None else step
            for step, end in zip(steps, ends, strict=True)
        )
    return found


def write_refinement(path: Path, results: Iterable[LocalizationResult]) -> None:
    """Write ``refinement.csv`` sorted by image; the steps of an image stay in order."""
    rows = [
        {
            **vars(step),
            "image": result.name,
            "accepted": step.accepted,
            "measures": tuple(f"{name}={value:.6g}" for name, value in step.measures.items()),
        }
        for result in sorted(results, key=lambda result: result.name)
        for step in result.refinements
    ]
    _REFINEMENT.write(path, rows)


_Median = Annotated[float, or_empty(number(".6g"), math.nan)]


@dataclass(frozen=True)
class ConsistencyRow:
    """One row of ``map_consistency.csv``: a refiner's test of one coordinate frame of a map.

    The measures are medians of ``megloc_kapture.refinement.references.Displacement``; NaN if none.
    ``reason`` is set where query poses are not refined.
    """

    frame: str
    method: str
    images: int
    contradicting: int
    moved_m: _Median
    turned_deg: _Median
    moved_px: _Median
    claimed_m: _Median
    claimed_deg: _Median
    squared_distance: _Median
    reason: str


_CONSISTENCY = Table(ConsistencyRow)
read_consistency, write_consistency = _CONSISTENCY.read, _CONSISTENCY.write


@dataclass(frozen=True)
class DepthRow:
    """One row of ``reconstruction/depth.csv``: stereo depth of a map image.

    ``sources`` are the compared images, best first; ``fill`` is the share of pixels with depth.
    """

    image: str
    sources: tuple[str, ...]
    near_m: Annotated[float, number(".6g")]
    far_m: Annotated[float, number(".6g")]
    fill: Annotated[float, number(".4f")]
    reason: str


_DEPTH = Table(DepthRow)
read_depth_rows, write_depth_rows = _DEPTH.read, _DEPTH.write


@dataclass(frozen=True)
class PairCount:
    image: str
    other: str
    matches: int
    verified: int


_MATCH_COUNTS = Table(PairCount)


def match_counts_path(features_dir: Path, type_name: str) -> Path:
    return features_dir / "local_features" / type_name / "match_counts.csv"


def read_match_counts(
    features_dir: Path, type_name: str, *, missing_ok: bool = False
) -> list[PairCount]:
    path = match_counts_path(features_dir, type_name)
    return _MATCH_COUNTS.read_if_there(path) if missing_ok else _MATCH_COUNTS.read(path)


def append_match_count(features_dir: Path, type_name: str, count: PairCount) -> None:
    _MATCH_COUNTS.append(match_counts_path(features_dir, type_name), count)


def write_match_counts(features_dir: Path, type_name: str, counts: Iterable[PairCount]) -> None:
    _MATCH_COUNTS.write(match_counts_path(features_dir, type_name), counts)
