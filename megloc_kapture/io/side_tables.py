"""What kapture cannot say about a dataset: the ``megloc/`` folder of a workspace.

==============  ==================================================================================
groups.csv      image, condition, frame, location, scored: one row per image
priors.csv      query, permitted: a group or map image the query may be matched with; several rows
                per query
world.json      ``official_from_local`` and the unit of the local frame
protocol.json   thresholds, the pose file's format and names, conditions and how they are pooled
==============  ==================================================================================

Two more tables, of challenges whose pose files are not what a rule can say, are read and written
by :mod:`megloc_kapture.io.challenge_tables`.

Written by datasets, read by stages and evaluation. A file that is absent stands for its default:
no groups, no priors, one metric frame without offset, the default protocol.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import read_csv_table, write_csv_table
from megloc_kapture.io.json_model import read_json_model, write_json_model
from megloc_kapture.io.paths import check_relative
from megloc_kapture.values import Options, RigidTransform

SIDE_TABLES = "megloc"
GROUPS_FILE = "groups.csv"
PRIORS_FILE = "priors.csv"
WORLD_FILE = "world.json"
PROTOCOL_FILE = "protocol.json"

GROUPS_COLUMNS = ("image", "condition", "frame", "location", "scored")
PRIORS_COLUMNS = ("query", "permitted")

# how far a quaternion may be off unit length before it is refused; below, it is normalised
MAX_QUATERNION_NORM_ERROR = 1e-3

PoseFileNames = Literal["full", "basename"]
PoseFileFormat = Literal["ltvl", "mlad"]


class ImageGroup(Options):
    """Where one image belongs; the empty string means "not said".

    Parameters
    ----------
    condition : what it is reported under (``day``, ``night-rain``).
    frame : the coordinate frame its pose stands in, where a dataset has several.
    location : the part of the map it belongs to.
    scored : whether the benchmark counts it as a query.
    """

    condition: str = ""
    frame: str = ""
    location: str = ""
    scored: bool = True


class SimilarityTransform(Options):
    """``x_a = scale * R x_b + t`` for a transform named ``a_from_b``."""

    quat_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = Field(default=1.0, gt=0.0, allow_inf_nan=False)

    @field_validator("quat_wxyz")
    @classmethod
    def _unit(cls, quat: tuple[float, ...]) -> tuple[float, ...]:
        norm = math.sqrt(sum(q * q for q in quat))
        if not abs(norm - 1.0) < MAX_QUATERNION_NORM_ERROR:
            raise ValueError(f"quaternion of length {norm:g}, not 1")
        return tuple(q / norm for q in quat) if abs(norm - 1.0) > 1e-12 else quat

    @field_validator("translation")
    @classmethod
    def _finite(cls, translation: tuple[float, ...]) -> tuple[float, ...]:
        if not all(math.isfinite(t) for t in translation):
            raise ValueError("translation must be finite")
        return translation


class World(Options):
    """The frame the workspace works in, and the way back to the dataset's official one.

    Dataset frames far from zero are recentred at import; poses are handed in, and compared with
    published ones, in the official frame.
    """

    official_from_local: SimilarityTransform = SimilarityTransform()
    unit: str = Field(default="m", min_length=1)

    def pose_in_official(self, cam_from_local: RigidTransform) -> RigidTransform:
        """``cam_from_official`` of a ``cam_from_local``; lengths become the official ones."""
        similarity = self.official_from_local
        local_from_official = RigidTransform(similarity.quat_wxyz, (0.0, 0.0, 0.0)).inverse()
        rotation = RigidTransform(cam_from_local.quat_wxyz, (0.0, 0.0, 0.0)) @ local_from_official
        scaled = similarity.scale * np.array(cam_from_local.translation)
        t = scaled - rotation.rotation_matrix() @ np.array(similarity.translation)
        return RigidTransform(rotation.quat_wxyz, (float(t[0]), float(t[1]), float(t[2])))

    def pose_in_local(self, cam_from_official: RigidTransform) -> RigidTransform:
        """``cam_from_local`` of a ``cam_from_official``; undoes :meth:`pose_in_official`."""
        similarity = self.official_from_local
        rotation_only = RigidTransform(similarity.quat_wxyz, (0.0, 0.0, 0.0))
        offset = cam_from_official.rotation_matrix() @ np.array(similarity.translation)
        t = (np.array(cam_from_official.translation) + offset) / similarity.scale
        rotation = RigidTransform(cam_from_official.quat_wxyz, (0.0, 0.0, 0.0)) @ rotation_only
        return RigidTransform(rotation.quat_wxyz, (float(t[0]), float(t[1]), float(t[2])))


class Protocol(Options):
    """How a dataset is scored.

    Parameters
    ----------
    dataset : its name, as on the command line.
    thresholds : pairs (position in metres, angle in degrees); a query counts when both of its
        errors are at or below. An angle of null leaves the rotation out.
    pose_file : ``ltvl``, one file of absolute poses (visuallocalization.net), or ``mlad``, one
        file per relocalization file with poses relative to reference keyframes.
    pose_file_names : how an image is called in the pose file: its whole path, or its last part;
        ``names.csv`` overrules it.
    pose_file_stem : what the pose file's own name begins with by the server's convention,
        ``STEM_eval_METHOD.txt``; empty where there is none, and ``dataset`` stands there.
    truth : who knows the true poses of the queries, where they are not published.
    conditions : in the order they are reported; conditions not listed follow, sorted.
    pools : name -> conditions that are pooled under it, as "day" pools dawn and noon.
    """

    dataset: str = Field(default="kapture", min_length=1)
    thresholds: tuple[tuple[float, float | None], ...] = (
        (0.05, 5.0),
        (0.25, 2.0),
        (0.5, 5.0),
        (5.0, 10.0),
    )
    pose_file: PoseFileFormat = "ltvl"
    pose_file_names: PoseFileNames = "full"
    pose_file_stem: str = Field(default="", pattern=r"^([A-Za-z0-9][A-Za-z0-9_.-]*)?$")
    truth: str = ""
    conditions: tuple[str, ...] = ()
    pools: dict[str, tuple[str, ...]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _usable(self) -> Protocol:
        if not self.thresholds:
            raise ValueError("at least one threshold is needed")
        for position_m, angle_deg in self.thresholds:
            for value in (position_m, 0.0 if angle_deg is None else angle_deg):
                if not (math.isfinite(value) and value >= 0):
                    raise ValueError(f"threshold {value} is not a number at or above 0")
        if len(set(self.conditions)) != len(self.conditions):
            raise ValueError("a condition is listed twice")
        return self


def read_groups(folder: Path | str) -> dict[str, ImageGroup]:
    """Read ``groups.csv``: image -> group, sorted by image; empty where the file is absent.

    Raises
    ------
    DataError : broken table, an image named twice or not a relative path, ``scored`` not 0 or 1.
    """
    path = Path(folder) / GROUPS_FILE
    groups: dict[str, ImageGroup] = {}
    if not path.exists():
        return groups
    for line, row in read_csv_table(path, GROUPS_COLUMNS):
        image = _checked_name(row["image"], path, line)
        if image in groups:
            raise DataError(f"image {image!r} is named twice", path=path, line=line)
        if row["scored"] not in ("0", "1"):
            raise DataError(f"scored is {row['scored']!r}, not 0 or 1", path=path, line=line)
        groups[image] = ImageGroup(
            condition=row["condition"],
            frame=row["frame"],
            location=row["location"],
            scored=row["scored"] == "1",
        )
    return dict(sorted(groups.items()))


def write_groups(folder: Path | str, groups: Mapping[str, ImageGroup]) -> None:
    """Write ``groups.csv``, sorted by image.

    Raises
    ------
    DataError : an image name is not a plain relative path.
    OutputError : the file cannot be written.
    """
    rows = (
        (check_relative(image), g.condition, g.frame, g.location, "1" if g.scored else "0")
        for image, g in sorted(groups.items())
    )
    write_csv_table(Path(folder) / GROUPS_FILE, GROUPS_COLUMNS, rows)


def read_priors(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """Read ``priors.csv``: query -> what it may be matched with, sorted; absent: empty.

    A query that is not in the table is not restricted.

    Raises
    ------
    DataError : broken table, an empty field, a row given twice.
    """
    path = Path(folder) / PRIORS_FILE
    if not path.exists():
        return {}
    permitted: dict[str, set[str]] = {}
    for line, row in read_csv_table(path, PRIORS_COLUMNS):
        query = _checked_name(row["query"], path, line)
        group = row["permitted"]
        if not group:
            raise DataError("permitted is empty", path=path, line=line)
        known = permitted.setdefault(query, set())
        if group in known:
            raise DataError(f"{query!r}, {group!r} is given twice", path=path, line=line)
        known.add(group)
    return {query: tuple(sorted(groups)) for query, groups in sorted(permitted.items())}


def write_priors(folder: Path | str, priors: Mapping[str, Sequence[str]]) -> None:
    """Write ``priors.csv``, sorted by query and permitted name.

    Raises
    ------
    DataError : a query is not a plain relative path, or has nothing (or "") permitted: the table
        cannot say "nothing", and a reader would take an absent row for "everything".
    OutputError : the file cannot be written.
    """
    rows: list[tuple[str, str]] = []
    for query, groups in sorted(priors.items()):
        if not groups or not all(groups):
            raise DataError(f"the prior of {query!r} permits nothing")
        rows.extend((check_relative(query), group) for group in sorted(set(groups)))
    write_csv_table(Path(folder) / PRIORS_FILE, PRIORS_COLUMNS, rows)


def read_world(folder: Path | str) -> World:
    """Read ``world.json``; absent: identity, metres. Raises DataError naming file and field."""
    path = Path(folder) / WORLD_FILE
    return read_json_model(path, World) if path.exists() else World()


def write_world(folder: Path | str, world: World) -> None:
    """Write ``world.json`` atomically."""
    write_json_model(Path(folder) / WORLD_FILE, world)


def read_protocol(folder: Path | str) -> Protocol:
    """Read ``protocol.json``; absent: the default. Raises DataError naming file and field."""
    path = Path(folder) / PROTOCOL_FILE
    return read_json_model(path, Protocol) if path.exists() else Protocol()


def write_protocol(folder: Path | str, protocol: Protocol) -> None:
    """Write ``protocol.json`` atomically."""
    write_json_model(Path(folder) / PROTOCOL_FILE, protocol)


def _checked_name(text: str, path: Path, line: int) -> str:
    try:
        return check_relative(text)
    except DataError as error:
        raise DataError(error.message, path=path, line=line) from error
