"""The tables of a workspace as records: one type, one reader and one writer each.

==================== =============================================================================
status.csv           outcome of every query, with the localized poses
clusters.csv         clusters of candidates in which every query was localized
covariance.csv       uncertainty of every localized pose
refinement.csv       outcome of refining each query's pose, step by step
map_consistency.csv  displacement of a map's own images by refinement, by coordinate frame
depth.csv            stereo depth of the map's images
match_counts.csv     matches and verified matches of each pair, with the matches of a type
masked.csv           keypoints removed by masks, by image, with the features of a type
==================== =============================================================================

Readers and writers take the file itself and keep its order, unless they say otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import (
    ImageName,
    Table,
    flag,
    list_of,
    number,
    or_empty,
    read_csv_table,
    write_csv_table,
)
from megloc_kapture.io.files import named
from megloc_kapture.values import ClusterPose, Options, Pose, RefinementRow, RigidTransform

STATUS_FILE = "status.csv"
COVARIANCE_FILE = "covariance.csv"
POSES_FILE = "poses.csv"
CLUSTERS_FILE = "clusters.csv"
REFINEMENT_FILE = "refinement.csv"
CONSISTENCY_FILE = "map_consistency.csv"

Fallback = Literal["none", "retrieval", "rig"]


class QueryStatus(Options):
    """One row of ``status.csv``.

    Parameters
    ----------
    num_matches, num_inliers : 2D-3D matches of the solver and inliers of the pose.
    confidence : probability that the pose, or the rejected pose of a failed query, is right.
    cluster : index of the candidate cluster of the pose; None without clusters.
    fallback : pose of a failed query: ``retrieval``, that of the best retrieved map image, a guess;
        ``rig``, that of another camera through the rig.
    candidates : map images that the pose comes from, best first.
    refinement : acceptance or rejection of the refined pose, by method.
    remarks : skipped steps for which the query or the map lacks data.
    """

    image: ImageName
    status: Literal["localized", "failed"]
    reason: str = ""
    num_matches: int = Field(default=0, ge=0)
    num_inliers: int = Field(default=0, ge=0)
    confidence: Annotated[float | None, or_empty(number(".4f")), Field(ge=0, le=1)] = None
    cluster: int | None = Field(default=None, ge=0)
    fallback: Fallback = "none"
    candidates: tuple[str, ...] = ()
    refinement: str = ""
    remarks: str = ""


_STATUS = Table(QueryStatus, keys=[("image",)], later=("confidence", "remarks"))


def read_status(path: Path | str) -> dict[str, QueryStatus]:
    return {row.image: row for row in sorted(_STATUS.read(path), key=lambda row: row.image)}


def write_status(path: Path | str, statuses: Iterable[QueryStatus]) -> None:
    ordered = sorted(statuses, key=lambda status: status.image)
    _STATUS.write(path, ordered)


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


def write_covariances(path: Path, poses: Mapping[str, Pose]) -> None:
    """Write ``covariance.csv`` of the poses that have a covariance, sorted by image."""
    rows = [
        (image, *map(repr, pose.covariance[_UPPER].tolist()))
        for image, pose in sorted(poses.items())
        if pose.covariance is not None
    ]
    write_csv_table(path, _COVARIANCE_COLUMNS, rows)


@dataclass(frozen=True)
class ClusterRow:
    """One row of ``clusters.csv``; the pose is that before the final refinement.

    ``images`` are the cluster's map images that match the query, best first.
    """

    image: str
    cluster: int
    chosen: Literal["yes", "no"]
    num_matches: int
    num_inliers: int
    score: Annotated[float | None, or_empty(number(".6g"))]
    reason: str
    images: tuple[str, ...]
    cam_from_world: RigidTransform | None


_CLUSTERS = Table(ClusterRow)


def read_clusters(path: Path | str) -> dict[str, list[ClusterRow]]:
    clusters: dict[str, list[ClusterRow]] = {}
    for row in _CLUSTERS.read(path):
        clusters.setdefault(row.image, []).append(row)
    return clusters


def write_clusters(
    path: Path, rows: Iterable[tuple[str, tuple[ClusterPose, ...], int | None]]
) -> None:
    """Write ``clusters.csv`` from rows (image, its clusters, number of the chosen one)."""
    records = [
        ClusterRow(image, index, "yes" if index == chosen else "no", **vars(cluster))
        for image, clusters, chosen in sorted(rows, key=lambda row: row[0])
        for index, cluster in enumerate(clusters)
    ]
    _CLUSTERS.write(path, records)


_REFINEMENT: Table[Any] = Table(
    {
        **{"image": str, "method": str, "accepted": flag("yes", "no"), "reason": str},
        **{"moved_m": number(".6f"), "turned_deg": number(".6f")},
        **{"measures": list_of(";"), "before": RigidTransform},
    }
)


def refinement_text(rows: Sequence[RefinementRow]) -> str:
    return "; ".join(f"{row.method}: {'accepted' if row.accepted else row.reason}" for row in rows)


def read_refinement(path: Path | str) -> list[RefinementRow]:
    """Read ``refinement.csv``; a row without a reason is accepted."""
    return [RefinementRow(*row[:2], *row[3:]) for row in _REFINEMENT.read(path)]


def write_refinement(path: Path, rows: Iterable[RefinementRow]) -> None:
    """Write ``refinement.csv`` sorted by image; the steps of an image stay in order."""
    ordered = sorted(rows, key=lambda row: row.image)
    _REFINEMENT.write(path, ordered)


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


def read_match_counts(features_dir: Path, type_name: str) -> list[PairCount]:
    return _MATCH_COUNTS.read(match_counts_path(features_dir, type_name))


def write_match_counts(features_dir: Path, type_name: str, counts: Iterable[PairCount]) -> None:
    _MATCH_COUNTS.write(match_counts_path(features_dir, type_name), counts)


def mask_counts_path(features_dir: Path, type_name: str) -> Path:
    return features_dir / "local_features" / type_name / "masked.csv"


def write_mask_counts(features_dir: Path, type_name: str, counts: Mapping[str, int]) -> None:
    """Write ``masked.csv``: image with a mask -> removed keypoints."""
    rows = [(image, str(count)) for image, count in sorted(counts.items())]
    write_csv_table(mask_counts_path(features_dir, type_name), ("image", "num_masked"), rows)
