"""The ``megloc/`` folder of a workspace: what kapture cannot say about a dataset.

==================  ================================================================================
groups.csv          image, condition, frame, location, scored: one row per image
priors.csv          query, permitted: a group or map image the query may be matched with; several
                    rows per query
names.csv           image, name: what each scored query is called in the pose file, in the order of
                    the challenge's list, where no rule says it
relocalization.csv  file, reference, query: the pairs an MLAD challenge asks for, in its order;
                    ``file`` is the name of the pose file to hand in
unreadable.csv      image, reason: queries whose image cannot be used, which were left out
unregistered.csv    image, reason: photographs that are not in the map made of them
world.json          ``official_from_local``, the unit of the local frame, where it lies on earth
protocol.json       thresholds, the pose file's format and names, conditions and how they are pooled
==================  ================================================================================

Written by datasets, read by stages and evaluation. A file that is absent stands for its default:
no groups, no priors, names by the protocol's rule, no pairs, one metric frame without offset, the
default protocol.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field, field_validator, model_validator

from megloc_kapture.errors import DataError
from megloc_kapture.io.csv_table import Column, ImageName, Table, flag
from megloc_kapture.io.files import (
    ModelT,
    check_relative,
    named,
    read_json_model,
    read_text,
    write_bytes,
    write_json_model,
)
from megloc_kapture.values import Options, RigidTransform

SIDE_TABLES = "megloc"
GROUPS_FILE = "groups.csv"
PRIORS_FILE = "priors.csv"
WORLD_FILE = "world.json"
PROTOCOL_FILE = "protocol.json"
NAMES_FILE = "names.csv"
RELOCALIZATION_FILE = "relocalization.csv"
UNREADABLE_FILE = "unreadable.csv"
UNREGISTERED_FILE = "unregistered.csv"
# in the folder of the true poses
NOWHERE_FILE = "nowhere.txt"
# units of the local frame: a map that nobody knows the scale of has units of its own
METRES, NO_METRES = "m", "units"

# how far a quaternion may be off unit length before it is refused; below, it is normalised
MAX_QUATERNION_NORM_ERROR = 1e-3

PoseFileNames = Literal["full", "basename"]
PoseFileFormat = Literal["ltvl", "mlad"]


class ImageGroup(Options):
    """Condition, frame and location of one image; the empty string means "not said".

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

    def rotation(self) -> RigidTransform:
        """The rotation alone."""
        return RigidTransform(self.quat_wxyz, (0.0, 0.0, 0.0))


class World(Options):
    """The frame the workspace works in, and the way back to the dataset's official one.

    Dataset frames far from zero are recentred at import; poses are handed in, and compared with
    published ones, in the official frame.
    """

    official_from_local: SimilarityTransform = SimilarityTransform()
    unit: str = Field(default=METRES, min_length=1)
    geo_origin: tuple[float, float, float] | None = Field(
        default=None,
        description="latitude and longitude in degrees and height in metres of the local frame's "
        "origin, where its axes are East, North and Up",
    )

    def pose_in_official(self, cam_from_local: RigidTransform) -> RigidTransform:
        """``cam_from_official`` of a ``cam_from_local``; lengths become the official ones."""
        similarity = self.official_from_local
        local_from_official = similarity.rotation().inverse()
        rotation = RigidTransform(cam_from_local.quat_wxyz, (0.0, 0.0, 0.0)) @ local_from_official
        scaled = similarity.scale * np.array(cam_from_local.translation)
        t = scaled - rotation.rotation_matrix() @ np.array(similarity.translation)
        return RigidTransform(rotation.quat_wxyz, (float(t[0]), float(t[1]), float(t[2])))

    def pose_in_local(self, cam_from_official: RigidTransform) -> RigidTransform:
        """``cam_from_local`` of a ``cam_from_official``; undoes :meth:`pose_in_official`."""
        similarity = self.official_from_local
        offset = cam_from_official.rotation_matrix() @ np.array(similarity.translation)
        t = (np.array(cam_from_official.translation) + offset) / similarity.scale
        rotation = RigidTransform(cam_from_official.quat_wxyz, (0.0, 0.0, 0.0))
        rotation = rotation @ similarity.rotation()
        return RigidTransform(rotation.quat_wxyz, (float(t[0]), float(t[1]), float(t[2])))


class Protocol(Options):
    """The rules by which a dataset is scored.

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


def _word(text: str) -> str:
    if text.split() != [text]:
        raise DataError(f"a pose file cannot hold the name {text!r}")
    return text


def _not_empty(text: str) -> str:
    if not text:
        raise DataError("permitted is empty")
    return text


class _GroupRow(NamedTuple):
    image: ImageName
    condition: str
    frame: str
    location: str
    scored: Annotated[bool, flag("1", "0")]


class _PriorRow(NamedTuple):
    query: ImageName
    permitted: Annotated[str, Column("a group or an image", _not_empty)]


class _NameRow(NamedTuple):
    image: ImageName
    name: Annotated[str, Column("one word", _word)]


class _UnreadableRow(NamedTuple):
    image: ImageName
    reason: str


@dataclass(frozen=True, slots=True)
class RelocalizationPair:
    """One row of an MLAD relocalization file: both images by their kapture names."""

    file: ImageName
    reference: ImageName
    query: ImageName


_GROUPS = Table(_GroupRow, keys=[("image",)])
_PRIORS = Table(_PriorRow, keys=[("query", "permitted")])
_NAMES = Table(_NameRow, keys=[("image",), ("name",)])
_UNREADABLE = Table(_UnreadableRow, keys=[("image",)])
_RELOCALIZATION = Table(RelocalizationPair)


@dataclass(frozen=True, eq=False, kw_only=True)
class SideTables:
    """The tables that describe a dataset; an empty one has no file.

    Parameters
    ----------
    groups : of all images, the queries' and the map's.
    priors : query -> map images or groups (``location`` of map images) it may be matched with.
    names : scored query -> its name in the pose file, in the order of the challenge's list; empty
        where the protocol's rule says it all.
    relocalization : the pairs of an MLAD challenge, in order.
    world : None: nothing is said of the frame.
    """

    protocol: Protocol
    groups: Mapping[str, ImageGroup] = field(default_factory=dict)
    priors: Mapping[str, Sequence[str]] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    relocalization: Sequence[RelocalizationPair] = ()
    world: World | None = None


def read_side_tables(folder: Path) -> SideTables:
    """Read all tables that describe a dataset."""
    return SideTables(
        protocol=read_protocol(folder),
        groups=read_groups(folder),
        priors=read_priors(folder),
        names=read_names(folder),
        relocalization=read_relocalization(folder),
        world=read_world(folder) if (folder / WORLD_FILE).is_file() else None,
    )


def write_side_tables(folder: Path, tables: SideTables) -> None:
    """Write the tables that have anything to say."""
    write_protocol(folder, tables.protocol)
    if tables.world is not None:
        write_world(folder, tables.world)
    if tables.groups:
        write_groups(folder, tables.groups)
    if tables.priors:
        write_priors(folder, tables.priors)
    if tables.names:
        write_names(folder, tables.names)
    if tables.relocalization:
        write_relocalization(folder, tables.relocalization)


def table_path(folder: Path | str, name: str) -> Path:
    """The path of a table, which need not exist."""
    return Path(folder) / name


def read_groups(folder: Path | str) -> dict[str, ImageGroup]:
    """Read ``groups.csv``: image -> group, sorted by image."""
    names = tuple(ImageGroup.model_fields)
    return {
        row.image: ImageGroup(**{name: getattr(row, name) for name in names})
        for row in sorted(_GROUPS.read_if_there(Path(folder) / GROUPS_FILE))
    }


def write_groups(folder: Path | str, groups: Mapping[str, ImageGroup]) -> None:
    """Write ``groups.csv``, sorted by image."""
    rows = [_GroupRow(image, **group.model_dump()) for image, group in sorted(groups.items())]
    _GROUPS.write(Path(folder) / GROUPS_FILE, rows)


def read_priors(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """Read ``priors.csv``: query -> what it may be matched with, both sorted.

    A query that is not in the table is not restricted.
    """
    permitted: dict[str, tuple[str, ...]] = {}
    for query, group in sorted(_PRIORS.read_if_there(Path(folder) / PRIORS_FILE)):
        permitted[query] = (*permitted.get(query, ()), group)
    return permitted


def write_priors(folder: Path | str, priors: Mapping[str, Sequence[str]]) -> None:
    """Write ``priors.csv``, sorted by query and permitted name.

    A query with nothing permitted is refused: without a row everything is permitted.
    """
    for query, groups in priors.items():
        if not groups or not all(groups):
            raise DataError(f"the prior of {query!r} permits nothing")
    rows = sorted({_PriorRow(query, group) for query in priors for group in priors[query]})
    _PRIORS.write(Path(folder) / PRIORS_FILE, rows)


def read_names(folder: Path | str) -> dict[str, str]:
    """Read ``names.csv``: image -> its name in the pose file, in the table's order."""
    return dict(_NAMES.read_if_there(Path(folder) / NAMES_FILE))


def write_names(folder: Path | str, names: Mapping[str, str]) -> None:
    """Write ``names.csv`` in the order of ``names``."""
    _NAMES.write(Path(folder) / NAMES_FILE, [_NameRow(*item) for item in names.items()])


def read_unreadable(folder: Path | str, name: str = UNREADABLE_FILE) -> dict[str, str]:
    """Read ``unreadable.csv``, or another such table: image -> reason, sorted by image."""
    return dict(sorted(_UNREADABLE.read_if_there(Path(folder) / name)))


def write_unreadable(
    folder: Path | str, reasons: Mapping[str, str], name: str = UNREADABLE_FILE
) -> None:
    """Write ``unreadable.csv``, or another such table, sorted by image."""
    rows = [_UnreadableRow(*row) for row in sorted(reasons.items())]
    _UNREADABLE.write(Path(folder) / name, rows)


def tables_of(root: Path | str) -> Path | None:
    """The tables of a kapture folder: its own, else those of the workspace that it lies in."""
    root = Path(root)
    for folder in (root, root.resolve().parent):
        if (folder / SIDE_TABLES / PROTOCOL_FILE).is_file():
            return folder / SIDE_TABLES
    return None


def write_unit(root: Path, unit: str) -> None:
    """Say in tables of its own that a kapture folder is in another unit than metres."""
    write_protocol(root / SIDE_TABLES, Protocol())
    write_world(root / SIDE_TABLES, World(unit=unit))


def unit_of(root: Path | str) -> str:
    """The unit of a map, or of results in it: m, or :data:`NO_METRES`."""
    tables = tables_of(root)
    return METRES if tables is None else read_world(tables).unit


def read_relocalization(folder: Path | str) -> list[RelocalizationPair]:
    """Read ``relocalization.csv`` in its order."""
    return _RELOCALIZATION.read_if_there(Path(folder) / RELOCALIZATION_FILE)


def write_relocalization(folder: Path | str, pairs: Iterable[RelocalizationPair]) -> None:
    """Write ``relocalization.csv`` in the order of ``pairs``."""
    _RELOCALIZATION.write(Path(folder) / RELOCALIZATION_FILE, pairs)


def read_world(folder: Path | str) -> World:
    """Read ``world.json``."""
    return _read_model(folder, WORLD_FILE, World)


def write_world(folder: Path | str, world: World) -> None:
    """Write ``world.json`` atomically."""
    write_json_model(Path(folder) / WORLD_FILE, world)


def read_protocol(folder: Path | str) -> Protocol:
    """Read ``protocol.json``."""
    return _read_model(folder, PROTOCOL_FILE, Protocol)


def _read_model(folder: Path | str, name: str, model: type[ModelT]) -> ModelT:
    path = Path(folder) / name
    return read_json_model(path, model) if path.exists() else model()


def write_protocol(folder: Path | str, protocol: Protocol) -> None:
    """Write ``protocol.json`` atomically."""
    write_json_model(Path(folder) / PROTOCOL_FILE, protocol)


def read_nowhere(truth: Path | str) -> tuple[str, ...]:
    """Queries that show nothing of the map, one a line in ``nowhere.txt`` beside the true poses."""
    path = Path(truth) / NOWHERE_FILE
    if not path.is_file():
        return ()
    names: set[str] = set()
    for line, text in enumerate(read_text(path).splitlines(), start=1):
        name = text.strip()
        if name and not name.startswith("#"):
            with named(path, line):
                names.add(check_relative(name))
    return tuple(sorted(names))


def write_nowhere(truth: Path, names: Iterable[str]) -> None:
    """Write ``nowhere.txt`` of a folder of true poses."""
    write_bytes(truth / NOWHERE_FILE, "".join(f"{name}\n" for name in names).encode("utf-8"))
