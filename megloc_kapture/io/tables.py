"""The tables of a workspace: localization results, map quality and match counts.

==================== =============================================================================
status.csv           outcome of every query: reason, numbers of matches and inliers, confidence
poses.csv            every pose and its camera centre, written by ``stages/localized_folder.py``
clusters.csv         clusters of candidates that were tried for every query, and their poses
covariance.csv       covariance of every localized pose that has one
refinement.csv       outcome of refining each query's pose, step by step
map_consistency.csv  displacement of the map images when they are refined, per coordinate frame
depth.csv            stereo depth of the map's images
match_counts.csv     numbers of raw and verified matches of each pair, per feature type
==================== =============================================================================

Most functions below take the file's path; all keep the order of the rows unless noted.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.io.csv_table import (
    ImageName,
    Names,
    OrNan,
    OrNone,
    Parts,
    PoseCell,
    append_csv_rows,
    columns_of,
    read_csv_table,
    read_records,
    write_csv_table,
    write_records,
)
from megloc_kapture.io.files import reading
from megloc_kapture.values import Fallback, LocalizationResult, Pose, PoseRefinement, RigidTransform

STATUS_FILE = "status.csv"
COVARIANCE_FILE = "covariance.csv"
POSES_FILE = "poses.csv"
CLUSTERS_FILE = "clusters.csv"
REFINEMENT_FILE = "refinement.csv"
CONSISTENCY_FILE = "map_consistency.csv"


def status_row(result: LocalizationResult) -> dict[str, Any]:
    """Return a result as a row of ``status.csv``.

    The columns are the parameters of :func:`_result_of_row`; add new columns to both.
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
    confidence: Annotated[Annotated[float, Field(ge=0, le=1)] | None, OrNone] = None,
    cluster: Annotated[int | None, OrNone] = None,
    fallback: Fallback = "none",
    candidates: Names = (),
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


def read_status(path: Path | str) -> dict[str, LocalizationResult]:
    """Read ``status.csv``: results by name, sorted, without poses and refinements."""
    rows = read_records(path, _result_of_row, optional=("confidence", "remarks"))
    return {row.name: row for row in sorted(rows, key=lambda row: row.name)}


def write_status(path: Path | str, results: Iterable[LocalizationResult]) -> None:
    """Write ``status.csv``, sorted by name."""
    rows = []
    for result in sorted(results, key=lambda result: result.name):
        row = status_row(result)
        if result.confidence is not None:
            row["confidence"] = f"{result.confidence:.4f}"
        rows.append(row.values())
    write_csv_table(path, columns_of(_result_of_row), rows)


_UPPER = np.triu_indices(6)
_AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
_COVARIANCE_COLUMNS = ("image", *(f"{_AXES[i]}_{_AXES[j]}" for i, j in zip(*_UPPER, strict=True)))


def read_covariances(path: Path | str) -> dict[str, NDArray[np.float64]]:
    """Read covariances (6, 6) by image from their upper triangles ``rx_rx, rx_ry, ... tz_tz``."""
    by_image = {}
    with reading(path, "a table of covariances"):
        for _, row in read_csv_table(path, _COVARIANCE_COLUMNS):
            image, *texts = (row[name] for name in _COVARIANCE_COLUMNS)
            covariance = np.empty((6, 6))
            covariance[_UPPER] = covariance.T[_UPPER] = [float(text) for text in texts]
            by_image[image] = covariance
    return by_image


def write_covariances(path: Path, results: Iterable[LocalizationResult]) -> None:
    """Write ``covariance.csv`` of the poses that have a covariance, sorted by image."""
    rows = [
        (pose.name, *map(repr, pose.covariance[_UPPER].tolist()))
        for pose in sorted(results, key=lambda result: result.name)
        if isinstance(pose, Pose) and pose.covariance is not None
    ]
    write_csv_table(path, _COVARIANCE_COLUMNS, rows)


def write_clusters(path: Path, results: Iterable[LocalizationResult]) -> None:
    """Write ``clusters.csv``, sorted by image: each result's clusters with unrefined poses."""
    columns = ("image", "cluster", "chosen", "num_matches", "num_inliers", "score", "reason")
    rows = [
        (
            result.name,
            index,
            "yes" if index == result.cluster else "no",
            cluster.num_matches,
            cluster.num_inliers,
            None if cluster.score is None else f"{cluster.score:.6g}",
            cluster.reason,
            cluster.candidates,
            cluster.cam_from_world,
        )
        for result in sorted(results, key=lambda result: result.name)
        for index, cluster in enumerate(result.clusters)
    ]
    write_csv_table(path, (*columns, "images", "cam_from_world"), rows)


def _refinement_row(
    image: str,
    method: str,
    accepted: bool,
    reason: str,
    moved_m: float,
    turned_deg: float,
    measures: Parts,
    before: PoseCell,
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


def read_refinement(
    path: Path | str, refined: Mapping[str, RigidTransform]
) -> dict[str, tuple[PoseRefinement, ...]]:
    """Read ``refinement.csv``: steps by image; ``refined`` holds the poses after the last step."""
    by_image: dict[str, list[PoseRefinement]] = {}
    for image, step in read_records(path, _refinement_row):
        by_image.setdefault(image, []).append(step)
    refinements = {}
    for image, steps in by_image.items():
        ends = [*(step.cam_from_world for step in steps[1:]), refined.get(image)]
        refinements[image] = tuple(
            replace(step, cam_from_world=end) if step.accepted and end is not None else step
            for step, end in zip(steps, ends, strict=True)
        )
    return refinements


def write_refinement(path: Path, results: Iterable[LocalizationResult]) -> None:
    """Write ``refinement.csv`` sorted by image; the steps of an image stay in order."""
    rows = [
        (
            result.name,
            step.method,
            "yes" if step.accepted else "no",
            step.reason,
            f"{step.moved_m:.6f}",
            f"{step.turned_deg:.6f}",
            ";".join(f"{name}={value:.6g}" for name, value in step.measures.items()),
            step.before,
        )
        for result in sorted(results, key=lambda result: result.name)
        for step in result.refinements
    ]
    write_csv_table(path, columns_of(_refinement_row), rows)


@dataclass(frozen=True)
class ConsistencyRow:
    """One row of ``map_consistency.csv``: a refiner's check of one coordinate frame of a map.

    ``images`` is the number of held-out map images that were refined; ``contradicting`` of them
    moved by more than their uncertainty. ``moved_m`` to ``squared_distance`` are medians over these
    images, NaN without any; see ``megloc_kapture.refinement.references.DISPLACEMENT``. ``reason``
    says why query poses are not refined; it is empty if they are.
    """

    frame: str
    method: str
    images: int
    contradicting: int
    moved_m: OrNan
    turned_deg: OrNan
    moved_px: OrNan
    claimed_m: OrNan
    claimed_deg: OrNan
    squared_distance: OrNan
    reason: str


@dataclass(frozen=True)
class DepthRow:
    """One row of ``reconstruction/depth.csv``: stereo depth of a map image.

    ``sources`` are the images that the map image was compared with, best first; ``near_m`` and
    ``far_m`` limit the depths that were tried. ``fill`` is the fraction of pixels with depth.
    ``reason`` says why there is no depth; it is empty if there is.
    """

    image: str
    sources: Names
    near_m: float
    far_m: float
    fill: float
    reason: str


@dataclass(frozen=True)
class PairCount:
    image: str
    other: str
    matches: int
    verified: int


def match_counts_path(features_dir: Path, type_name: str) -> Path:
    return features_dir / "local_features" / type_name / "match_counts.csv"


def read_match_counts(
    features_dir: Path, type_name: str, *, missing_ok: bool = False
) -> dict[tuple[str, str], PairCount]:
    """Read the counts of all pairs, by image and other image."""
    path = match_counts_path(features_dir, type_name)
    rows = read_records(path, PairCount, missing_ok=missing_ok)
    return {(row.image, row.other): row for row in rows}


def append_match_counts(features_dir: Path, type_name: str, counts: Iterable[PairCount]) -> None:
    path = match_counts_path(features_dir, type_name)
    append_csv_rows(path, columns_of(PairCount), (vars(count).values() for count in counts))


def write_match_counts(features_dir: Path, type_name: str, counts: Iterable[PairCount]) -> None:
    path = match_counts_path(features_dir, type_name)
    write_records(path, PairCount, counts)
