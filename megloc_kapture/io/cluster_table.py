"""``clusters.csv``: the clusters of candidates every query was tried in, beside ``status.csv``."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import read_csv_table, write_csv_table
from megloc_kapture.io.json_model import first_problem
from megloc_kapture.io.pose_cells import pose_cell, read_pose_cell
from megloc_kapture.values import ClusterPose, Options, RigidTransform

CLUSTERS_FILE = "clusters.csv"
CLUSTERS_COLUMNS = (
    "image",
    "cluster",
    "chosen",
    "num_matches",
    "num_inliers",
    "score",
    "reason",
    "images",
    "cam_from_world",
)
# as in status.csv: the one character that kapture allows in no image name
_SEPARATOR = ","


class ClusterRow(Options):
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
    cluster: int = Field(ge=0)
    chosen: Literal["yes", "no"]
    num_matches: int = Field(ge=0)
    num_inliers: int = Field(ge=0)
    score: float | None
    reason: str
    images: tuple[str, ...]
    cam_from_world: RigidTransform | None


def write_clusters(
    path: Path, rows: Iterable[tuple[str, tuple[ClusterPose, ...], int | None]]
) -> None:
    """Write the clusters of every query: (image, its clusters, number of the chosen one).

    Raises
    ------
    OutputError : the file cannot be written.
    """
    cells = (
        (
            image,
            str(number),
            "yes" if number == chosen else "no",
            str(cluster.num_matches),
            str(cluster.num_inliers),
            "" if cluster.score is None else f"{cluster.score:.6g}",
            cluster.reason,
            _SEPARATOR.join(cluster.images),
            pose_cell(cluster.cam_from_world),
        )
        for image, clusters, chosen in sorted(rows, key=lambda row: row[0])
        for number, cluster in enumerate(clusters)
    )
    write_csv_table(path, CLUSTERS_COLUMNS, cells)


def read_clusters(path: Path | str) -> dict[str, list[ClusterRow]]:
    """Read ``clusters.csv`` (the file itself): query -> its clusters.

    Raises
    ------
    DataError : absent or broken table, a value that is not of its kind; names file and line.
    """
    clusters: dict[str, list[ClusterRow]] = {}
    for line, row in read_csv_table(path, CLUSTERS_COLUMNS):
        values: dict[str, object] = dict(row)
        values["score"] = row["score"] or None
        values["images"] = tuple(row["images"].split(_SEPARATOR)) if row["images"] else ()
        values["cam_from_world"] = read_pose_cell(
            row["cam_from_world"], "cam_from_world", path=path, line=line
        )
        try:
            found = ClusterRow.model_validate(values)
        except ValidationError as error:
            raise DataError(first_problem(error), path=path, line=line) from error
        clusters.setdefault(found.image, []).append(found)
    return clusters
