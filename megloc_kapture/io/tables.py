"""The tables of a workspace as records: one type, one reader and one writer each.

==================== =============================================================================
status.csv           the outcome of every query, beside the localized poses
clusters.csv         the clusters of candidates that every query was tried in
covariance.csv       how uncertain every localized pose is, beside the poses
refinement.csv       the outcome of refining each query's pose, step by step
map_consistency.csv  how far a map's own images would move, by coordinate frame
depth.csv            depth of the map's images by stereo
match_counts.csv     matches of each pair, found and verified, beside the matches of a type
masked.csv           keypoints that masks removed, by image, beside the features of a type
==================== =============================================================================

Readers and writers take the file itself and keep its order, unless they say otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

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
    image : the query.
    status : ``localized``: the pose was estimated from the image; ``failed``: it was not.
    reason : why it failed; empty for a localized query.
    num_matches, num_inliers : 2D-3D matches of the solver, and those that agree with the pose.
    confidence : probability that the pose is right, or that the rejected pose of a failed query
        was; None without one.
    cluster : index of the candidate cluster the pose comes from; None without clusters.
    fallback : ``retrieval``: a failed query was given the pose of the best retrieved map image, a
        guess; ``rig``: its pose comes through the rig from another camera.
    candidates : the map images the pose comes from, best first.
    refinement : by method, whether a refined pose was accepted or why not; may be empty.
    remarks : steps that were skipped because the query or the map lacks what they need.
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
    """Read ``status.csv``: image -> status, sorted by image."""
    return {row.image: row for row in sorted(_STATUS.read(path), key=lambda row: row.image)}


def write_status(path: Path | str, statuses: Iterable[QueryStatus]) -> None:
    """Write ``status.csv``, sorted by image."""
    ordered = sorted(statuses, key=lambda status: status.image)
    _STATUS.write(path, ordered)


_UPPER = np.triu_indices(6)
_AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
_COVARIANCE_COLUMNS = ("image", *(f"{_AXES[i]}_{_AXES[j]}" for i, j in zip(*_UPPER, strict=True)))


def read_covariances(path: Path | str) -> dict[str, NDArray[np.float64]]:
    """Read ``covariance.csv``: image -> covariance (6, 6), as ``Pose`` has it.

    A row has the upper triangle: ``rx_rx, rx_ry, ... tz_tz``.
    """
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
    """Write ``covariance.csv`` of the poses that have a covariance, by image."""
    rows = [
        (image, *map(repr, pose.covariance[_UPPER].tolist()))
        for image, pose in sorted(poses.items())
        if pose.covariance is not None
    ]
    write_csv_table(path, _COVARIANCE_COLUMNS, rows)


@dataclass(frozen=True)
class ClusterRow:
    """One row of ``clusters.csv``.

    Parameters
    ----------
    image : the query.
    cluster : its number; ``status.csv`` names the one a pose comes from.
    chosen : ``yes``: the pose comes from this one.
    score : of the ranking; None without a pose, ``reason`` then says why.
    images : map images of the cluster that match the query, best first.
    cam_from_world : its pose before the final refinement; None without one.
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
    """Read ``clusters.csv``: query -> its clusters."""
    clusters: dict[str, list[ClusterRow]] = {}
    for row in _CLUSTERS.read(path):
        clusters.setdefault(row.image, []).append(row)
    return clusters


def write_clusters(
    path: Path, rows: Iterable[tuple[str, tuple[ClusterPose, ...], int | None]]
) -> None:
    """Write the clusters of every query: (image, its clusters, number of the chosen one)."""
    records = [
        ClusterRow(image, index, "yes" if index == chosen else "no", **vars(cluster))
        for image, clusters, chosen in sorted(rows, key=lambda row: row[0])
        for index, cluster in enumerate(clusters)
    ]
    _CLUSTERS.write(path, records)


@dataclass(frozen=True)
class _RefinementRecord:
    image: str
    method: str
    accepted: Annotated[bool, flag("yes", "no")]
    reason: str
    moved_m: Annotated[float, number(".6f")]
    turned_deg: Annotated[float, number(".6f")]
    measures: Annotated[tuple[str, ...], list_of(";")]
    before: RigidTransform


_REFINEMENT = Table(_RefinementRecord)


def refinement_text(rows: Sequence[RefinementRow]) -> str:
    """The outcome of refining a query's pose, as ``status.csv`` has it."""
    return "; ".join(f"{row.method}: {'accepted' if row.accepted else row.reason}" for row in rows)


def read_refinement(path: Path | str) -> list[RefinementRow]:
    """Read ``refinement.csv``; a row is accepted if it has no reason."""
    return [
        RefinementRow(r.image, r.method, r.reason, r.moved_m, r.turned_deg, r.measures, r.before)
        for r in _REFINEMENT.read(path)
    ]


def write_refinement(path: Path, rows: Iterable[RefinementRow]) -> None:
    """Write ``refinement.csv`` by image; the steps of one stay in order."""
    ordered = sorted(rows, key=lambda row: row.image)
    _REFINEMENT.write(path, ordered)


_Median = Annotated[float, or_empty(number(".6g"), math.nan)]


@dataclass(frozen=True)
class ConsistencyRow:
    """One row of ``map_consistency.csv``: a refiner's test of one coordinate frame of a map.

    Attributes
    ----------
    images, contradicting : map images whose displacement is known, and those that contradict.
    moved_m, turned_deg, moved_px, claimed_m, claimed_deg, squared_distance : their medians, as of
        ``megloc_kapture.refinement.references.Displacement``; NaN where there is none.
    reason : why poses of queries are not refined there; empty where they are.
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
    """One row of ``reconstruction/depth.csv``: depth of a map image by stereo.

    Attributes
    ----------
    sources : the images it was compared with, best first.
    near_m, far_m : depths that were looked at.
    fill : share of the pixels that have depth.
    reason : why there is none; empty where there is.
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
    """One row of ``match_counts.csv``: matches that were found, and that verification left."""

    image: str
    other: str
    matches: int
    verified: int


_MATCH_COUNTS = Table(PairCount)


def match_counts_path(features_dir: Path, type_name: str) -> Path:
    """``match_counts.csv`` of a keypoints type in a features folder (orphan layout)."""
    return features_dir / "local_features" / type_name / "match_counts.csv"


def read_match_counts(features_dir: Path, type_name: str) -> list[PairCount]:
    """Read ``match_counts.csv`` of a keypoints type, in its order."""
    return _MATCH_COUNTS.read(match_counts_path(features_dir, type_name))


def write_match_counts(features_dir: Path, type_name: str, counts: Iterable[PairCount]) -> None:
    """Write ``match_counts.csv`` of a keypoints type, in the order given."""
    _MATCH_COUNTS.write(match_counts_path(features_dir, type_name), counts)


class MaskCount(NamedTuple):
    """One row of ``masked.csv``."""

    image: str
    num_masked: int


_MASK_COUNTS = Table(MaskCount)


def mask_counts_path(features_dir: Path, type_name: str) -> Path:
    """``masked.csv`` of a keypoints type in a feature folder (orphan layout)."""
    return features_dir / "local_features" / type_name / "masked.csv"


def read_mask_counts(features_dir: Path, type_name: str) -> dict[str, int]:
    """Read ``masked.csv`` of a keypoints type: image -> keypoints; empty where there is none."""
    path = mask_counts_path(features_dir, type_name)
    return dict(_MASK_COUNTS.read_if_there(path))


def write_mask_counts(features_dir: Path, type_name: str, counts: Mapping[str, int]) -> None:
    """Write ``masked.csv`` of a keypoints type: image that has a mask -> keypoints it removed."""
    rows = (MaskCount(*row) for row in sorted(counts.items()))
    _MASK_COUNTS.write(mask_counts_path(features_dir, type_name), rows)
