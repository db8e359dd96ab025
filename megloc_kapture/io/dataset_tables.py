"""The ``megloc/`` folder of a workspace: facts about a dataset that kapture has no tables for.

==================  ================================================================================
groups.csv          image, condition, frame, location, scored: one row per image
priors.csv          query, permitted: map image, location or frame to match the query with
names.csv           image, name: names of scored queries in the pose file, in the challenge's order
relocalization.csv  file, reference, query: pairs of an MLAD challenge; ``file`` names the pose file
unreadable.csv      image, reason: queries left out because their image cannot be used
unregistered.csv    image, reason: photographs that the mapper did not register
world.json          ``official_from_local``, unit and position on earth of the local frame
protocol.json       thresholds, format and names of the pose file, conditions and their pools
==================  ================================================================================

Imports of datasets and the mapping of photographs write these files; stages and evaluation read
them. A missing table has no rows. Without world.json, the local frame is the official frame, in
metres. Without protocol.json, the defaults of :class:`Protocol` hold.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat, field_validator

from megloc_kapture.errors import DataError, require
from megloc_kapture.io.csv_table import ImageName, columns_of, read_records, write_csv_table
from megloc_kapture.io.files import (
    ModelT,
    check_relative,
    read_json_model,
    write_bytes,
    write_json_model,
)
from megloc_kapture.io.kapture.sensors import unit_quaternion
from megloc_kapture.io.text_lines import reading_lines
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
NOWHERE_FILE = "nowhere.txt"
# units of the local frame; NO_METRES is used for maps of unknown scale
METRES, NO_METRES = "m", "units"

PoseFileNames = Literal["full", "basename"]
PoseFileFormat = Literal["ltvl", "mlad"]


class ImageGroup(Options):
    """Condition in reports (``day``, ``night-rain``), coordinate frame and location of one image.

    Queries that are not ``scored`` are omitted from the pose file and from the recall.
    """

    condition: str = ""
    frame: str = ""
    location: str = ""
    scored: bool = True


class SimilarityTransform(Options):
    """``x_a = scale * R x_b + t`` for a transform named ``a_from_b``."""

    quat_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    translation: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = (0.0, 0.0, 0.0)
    scale: float = Field(default=1.0, gt=0.0, allow_inf_nan=False)

    @field_validator("quat_wxyz")
    @classmethod
    def _unit(cls, quat: tuple[float, float, float, float]) -> tuple[float, ...]:
        try:
            return unit_quaternion(quat)
        except DataError as error:
            raise ValueError(error.message) from error

    def rigid(self) -> RigidTransform:
        """Return the transform without its scale."""
        return RigidTransform(self.quat_wxyz, self.translation)


class World(Options):
    """The local frame of a workspace and its relation to the dataset's official frame.

    The import recentres datasets whose official coordinates are far from zero. Poses are submitted
    and evaluated in the official frame.
    """

    official_from_local: SimilarityTransform = SimilarityTransform()
    unit: str = Field(default=METRES, min_length=1)
    geo_origin: tuple[float, float, float] | None = Field(
        default=None,
        description="latitude and longitude in degrees and height in metres of the local frame's "
        "origin, where its axes are East, North and Up",
    )

    def pose_in_official(self, cam_from_local: RigidTransform) -> RigidTransform:
        """Convert ``cam_from_local`` to ``cam_from_official``, with lengths in official units."""
        similarity = self.official_from_local
        return cam_from_local.scaled(similarity.scale) @ similarity.rigid().inverse()

    def pose_in_local(self, cam_from_official: RigidTransform) -> RigidTransform:
        """Convert ``cam_from_official`` to ``cam_from_local``; inverts :meth:`pose_in_official`."""
        similarity = self.official_from_local
        return (cam_from_official @ similarity.rigid()).scaled(1 / similarity.scale)


_Limit = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Protocol(Options):
    """The evaluation rules of a dataset.

    Parameters
    ----------
    thresholds : pairs (position in metres, angle in degrees or null): upper limits of the errors.
    pose_file : ``ltvl``, one file of absolute poses (visuallocalization.net), or ``mlad``, one
        file per relocalization file with poses relative to reference keyframes.
    pose_file_names : the pose file has ``full`` image names, or ``basename`` without folders.
    pose_file_stem : STEM of the server's ``STEM_eval_METHOD.txt``; if empty, the value of
        ``dataset``.
    truth : note on true poses that are not published; else empty.
    conditions : order of the conditions in reports.
    pools : name -> conditions that are reported together, for example "day" for dawn and noon.
    """

    dataset: str = Field(default="kapture", min_length=1)
    thresholds: Annotated[tuple[tuple[_Limit, _Limit | None], ...], Field(min_length=1)] = (
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


@dataclass(frozen=True, slots=True)
class RelocalizationPair:
    """One row of an MLAD relocalization file, with kapture's image names."""

    file: ImageName
    reference: ImageName
    query: ImageName


# the parameters of these functions are the columns of the tables, in this order


def _group(
    image: ImageName, condition: str, frame: str, location: str, scored: bool
) -> tuple[str, ImageGroup]:
    return image, ImageGroup(condition=condition, frame=frame, location=location, scored=scored)


def _prior(query: ImageName, permitted: str) -> tuple[str, str]:
    return query, permitted


def _name(
    image: ImageName,
    name: Annotated[str, Field(pattern=r"^\S+$")],  # a field of the blank-separated pose file
) -> tuple[str, str]:
    return image, name


def _unreadable(image: ImageName, reason: str) -> tuple[str, str]:
    return image, reason


@dataclass(frozen=True, eq=False, kw_only=True)
class SideTables:
    """The tables that describe a dataset, and the rules of its evaluation.

    An empty table has no file.

    ``priors`` maps a query to the permitted map images, locations or frames; a query without an
    entry is unrestricted. ``world`` transforms between the local frame (of the map and the true
    poses) and the official frame (of pose files). ``names`` is the challenge's list, image -> name
    in a pose file; ``relocalization`` has the image pairs of an MLAD challenge.
    """

    protocol: Protocol = Protocol()
    groups: Mapping[str, ImageGroup] = field(default_factory=dict)
    priors: Mapping[str, Sequence[str]] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    relocalization: Sequence[RelocalizationPair] = ()
    world: World = World()

    def scored(self, images: Iterable[str]) -> set[str]:
        """Return the images that count towards recall and belong in the pose file."""
        return {i for i in images if i not in self.groups or self.groups[i].scored}

    def conditions(self, images: Iterable[str]) -> dict[str, str]:
        """Return image -> condition, from the groups.

        Without groups, a folder named like a condition defines it (``query/night/x.jpg``).
        """
        if self.groups:
            return {i: self.groups[i].condition for i in images if i in self.groups}
        known = set(self.protocol.conditions)
        folders = {i: [f for f in PurePosixPath(i).parts[:-1] if f in known] for i in images}
        return {image: names[0] for image, names in folders.items() if len(names) == 1}

    def frame(self, image: str) -> str:
        """Return the coordinate frame of a map image; ``""`` if there is only one."""
        group = self.groups.get(image)
        return "" if group is None else group.frame

    def frames(self, images: Sequence[str]) -> list[NDArray[np.int64]]:
        """Return the indices into ``images`` of each frame; frames are sorted by name."""
        members: dict[str, list[int]] = {}
        for position, image in enumerate(images):
            members.setdefault(self.frame(image), []).append(position)
        return [np.array(members[name], np.int64) for name in sorted(members)]

    def pools(
        self, queries: Sequence[str], images: Sequence[str]
    ) -> Iterator[tuple[list[int], NDArray[np.int64]]]:
        """Group queries by their permitted map images.

        Yield indices into ``queries`` and sorted indices into ``images``, int64 (M,); M may be 0.
        """
        together: dict[tuple[str, ...] | None, list[int]] = {}
        for position, query in enumerate(queries):
            prior = self.priors.get(query)
            together.setdefault(None if prior is None else tuple(prior), []).append(position)
        members = self._members(images) if set(together) != {None} else {}
        for permitted, positions in together.items():
            if permitted is None:
                yield positions, np.arange(len(images))
                continue
            allowed = [position for name in permitted for position in members.get(name, ())]
            yield positions, np.unique(np.array(allowed, dtype=np.int64))

    def _members(self, images: Sequence[str]) -> dict[str, list[int]]:
        members: dict[str, list[int]] = {}
        for position, image in enumerate(images):
            group = self.groups.get(image, ImageGroup())
            for name in {image, group.location, group.frame} - {""}:
                members.setdefault(name, []).append(position)
        return members


NO_TABLES = SideTables()


def check_tables(folder: Path | str) -> None:
    """Raise DataError unless the folder, which the user gave, has tables."""
    place = Path(folder)
    require(place.is_dir(), "no such folder", path=place)
    require(
        any((place / name).is_file() for name in (PROTOCOL_FILE, GROUPS_FILE)),
        f"found neither {PROTOCOL_FILE} nor {GROUPS_FILE}; give the folder {SIDE_TABLES}/",
        path=place,
    )


def read_side_tables(folder: Path | str) -> SideTables:
    folder = Path(folder)
    permitted: dict[str, tuple[str, ...]] = {}
    for query, name in sorted(set(read_records(folder / PRIORS_FILE, _prior, missing_ok=True))):
        permitted[query] = (*permitted.get(query, ()), name)
    groups = dict(read_records(folder / GROUPS_FILE, _group, missing_ok=True))
    pairs = folder / RELOCALIZATION_FILE
    return SideTables(
        protocol=read_protocol(folder),
        groups=dict(sorted(groups.items())),
        priors=permitted,
        names=dict(read_records(folder / NAMES_FILE, _name, missing_ok=True)),
        relocalization=read_records(pairs, RelocalizationPair, missing_ok=True),
        world=read_world(folder),
    )


def write_side_tables(folder: Path, tables: SideTables) -> None:
    write_protocol(folder, tables.protocol)
    if tables.world != World():
        write_world(folder, tables.world)
    groups = [
        (image, group.condition, group.frame, group.location, int(group.scored))
        for image, group in sorted(tables.groups.items())
    ]
    priors = {(query, name) for query, names in tables.priors.items() for name in names}
    pairs = [(pair.file, pair.reference, pair.query) for pair in tables.relocalization]
    contents: list[tuple[str, Callable[..., Any], Collection[tuple[object, ...]]]] = [
        (GROUPS_FILE, _group, groups),
        (PRIORS_FILE, _prior, sorted(priors)),
        (NAMES_FILE, _name, tables.names.items()),
        (RELOCALIZATION_FILE, RelocalizationPair, pairs),
    ]
    for name, record, rows in contents:
        if rows:
            write_csv_table(Path(folder) / name, columns_of(record), rows)


def read_unreadable(folder: Path | str, name: str = UNREADABLE_FILE) -> dict[str, str]:
    return dict(sorted(read_records(Path(folder) / name, _unreadable, missing_ok=True)))


def write_unreadable(
    folder: Path | str, reasons: Mapping[str, str], name: str = UNREADABLE_FILE
) -> None:
    write_csv_table(Path(folder) / name, columns_of(_unreadable), sorted(reasons.items()))


def tables_of(root: Path | str) -> Path | None:
    """Return the ``megloc/`` folder in a kapture folder or its parent; None if neither has it."""
    root = Path(root)
    for folder in (root, root.resolve().parent):
        if (folder / SIDE_TABLES / PROTOCOL_FILE).is_file():
            return folder / SIDE_TABLES
    return None


def read_tables_of(root: Path | str) -> SideTables:
    """Read the tables in a kapture folder or its parent; empty tables if neither has any."""
    tables = tables_of(root)
    return NO_TABLES if tables is None else read_side_tables(tables)


def write_unit(root: Path, unit: str) -> None:
    """Write the tables that state the unit of a kapture folder, if it is not metres."""
    if unit != METRES:
        write_side_tables(root / SIDE_TABLES, SideTables(world=World(unit=unit)))


def unit_of(root: Path | str) -> str:
    """Return the unit of a map, or of results localized in a map: m or :data:`NO_METRES`."""
    tables = tables_of(root)
    return METRES if tables is None else read_world(tables).unit


def read_world(folder: Path | str) -> World:
    """Read the world alone, since the tables of a large dataset take a second."""
    return _read_model(Path(folder) / WORLD_FILE, World)


def write_world(folder: Path | str, world: World) -> None:
    write_json_model(Path(folder) / WORLD_FILE, world)


def read_protocol(folder: Path | str) -> Protocol:
    """Read the protocol alone; see :func:`read_world`."""
    return _read_model(Path(folder) / PROTOCOL_FILE, Protocol)


def write_protocol(folder: Path | str, protocol: Protocol) -> None:
    write_json_model(Path(folder) / PROTOCOL_FILE, protocol)


def _read_model(path: Path, model: type[ModelT]) -> ModelT:
    return read_json_model(path, model) if path.exists() else model()


def read_nowhere(truth: Path | str) -> tuple[str, ...]:
    """Read ``nowhere.txt`` next to the true poses: queries that show nothing of the map."""
    path = Path(truth) / NOWHERE_FILE
    if not path.is_file():
        return ()
    with reading_lines(path, comments=True) as lines:
        return tuple(sorted(set(map(check_relative, lines))))


def write_nowhere(truth: Path, names: Iterable[str]) -> None:
    write_bytes(truth / NOWHERE_FILE, "".join(f"{name}\n" for name in names).encode("utf-8"))
