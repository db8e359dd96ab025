"""``status.csv``: what became of every query, written beside the localized poses."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError, model_validator

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import read_csv_table, write_csv_table
from megloc_kapture.io.json_model import first_problem
from megloc_kapture.io.paths import check_relative
from megloc_kapture.values import Options

STATUS_FILE = "status.csv"
STATUS_COLUMNS = (
    "image",
    "status",
    "reason",
    "num_matches",
    "num_inliers",
    "cluster",
    "fallback",
    "candidates",
    "refinement",
    "remarks",
)

Fallback = Literal["none", "retrieval", "rig"]

# between the candidates of one query; the one character that kapture allows in no image name
_CANDIDATE_SEPARATOR = ","


class QueryStatus(Options):
    """One row of ``status.csv``.

    Parameters
    ----------
    image : the query.
    status : ``localized``: the pose was estimated from the image; ``failed``: it was not.
    reason : why it failed; empty for a localized query.
    num_matches : 2D-3D matches the solver was given.
    num_inliers : those that agree with the pose.
    cluster : index of the candidate cluster the pose comes from; None without clusters.
    fallback : ``retrieval``: a failed query was given the pose of the best retrieved map image, a
        guess; ``rig``: it was given its pose through the rig, by another camera of its moment.
        Everything that counts poses says how many of them are fallbacks.
    candidates : the map images the pose comes from, best first.
    refinement : by method, whether a refined pose was accepted or why the one before it stays;
        empty where nothing was refined.
    remarks : steps that were left out because the query, or the map, lacks what they need.
    """

    image: str
    status: Literal["localized", "failed"]
    reason: str = ""
    num_matches: int = Field(default=0, ge=0)
    num_inliers: int = Field(default=0, ge=0)
    cluster: int | None = Field(default=None, ge=0)
    fallback: Fallback = "none"
    candidates: tuple[str, ...] = ()
    refinement: str = ""
    remarks: str = ""

    @model_validator(mode="after")
    def _consistent(self) -> QueryStatus:
        try:
            check_relative(self.image)
        except DataError as error:
            raise ValueError(error.message) from error
        if self.status == "localized" and self.fallback != "none":
            raise ValueError("a localized query has no fallback pose")
        if self.status == "localized" and self.reason:
            raise ValueError("a localized query has no reason to fail")
        if self.status == "failed" and not self.reason.strip():
            raise ValueError("a failed query needs a reason")
        if any(not name or _CANDIDATE_SEPARATOR in name for name in self.candidates):
            raise ValueError(f"a candidate is empty or holds a {_CANDIDATE_SEPARATOR!r}")
        return self


def read_status(path: Path | str) -> dict[str, QueryStatus]:
    """Read ``status.csv`` (the file itself): image -> status, sorted by image.

    Raises
    ------
    DataError : absent or broken table, a value that is not of its kind, an image named twice;
        names file and line.
    """
    statuses: dict[str, QueryStatus] = {}
    for line, row in read_csv_table(path, STATUS_COLUMNS):
        values: dict[str, object] = dict(row)
        values["cluster"] = row["cluster"] or None
        candidates = row["candidates"]
        values["candidates"] = candidates.split(_CANDIDATE_SEPARATOR) if candidates else ()
        try:
            status = QueryStatus.model_validate(values)
        except ValidationError as error:
            raise DataError(first_problem(error), path=path, line=line) from error
        if status.image in statuses:
            raise DataError(f"image {status.image!r} is named twice", path=path, line=line)
        statuses[status.image] = status
    return dict(sorted(statuses.items()))


def write_status(path: Path | str, statuses: Iterable[QueryStatus]) -> None:
    """Write ``status.csv`` (the file itself), sorted by image.

    Raises
    ------
    DataError : two rows for one image.
    OutputError : the file cannot be written.
    """
    rows: dict[str, tuple[str, ...]] = {}
    for s in statuses:
        if s.image in rows:
            raise DataError(f"two statuses for query {s.image!r}")
        rows[s.image] = (
            s.image,
            s.status,
            s.reason,
            str(s.num_matches),
            str(s.num_inliers),
            "" if s.cluster is None else str(s.cluster),
            s.fallback,
            _CANDIDATE_SEPARATOR.join(s.candidates),
            s.refinement,
            s.remarks,
        )
    write_csv_table(path, STATUS_COLUMNS, (rows[image] for image in sorted(rows)))
