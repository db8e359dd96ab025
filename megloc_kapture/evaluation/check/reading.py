"""Data of a check: rows of a pose file, however broken, and the import they are compared with."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation import pose_files
from megloc_kapture.evaluation.check.findings import Finding, Severity, plural
from megloc_kapture.evaluation.pose_files import names_in_pose_file
from megloc_kapture.geometry.poses import camera_centers, stack_poses
from megloc_kapture.io.dataset_tables import (
    MAX_QUATERNION_NORM_ERROR,
    SIDE_TABLES,
    ImageGroup,
    PoseFileFormat,
    Protocol,
    RelocalizationPair,
    World,
    read_groups,
    read_names,
    read_priors,
    read_protocol,
    read_relocalization,
    read_world,
)
from megloc_kapture.io.files import read_text
from megloc_kapture.io.kapture import KaptureFolder

_MAPPING, _QUERY = "mapping", "query"
_KEYS: dict[PoseFileFormat, int] = {"ltvl": 1, "mlad": 2}
_COLUMNS = {"ltvl": pose_files.COLUMNS, "mlad": pose_files.MLAD_COLUMNS}
# where the quaternion begins among the seven numbers
_QUATERNION_AT: dict[PoseFileFormat, int] = {"ltvl": 0, "mlad": 3}


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of one pose file that have a name and a pose.

    Parameters
    ----------
    keys : per row its name, or its two timestamps with a blank between.
    quats : float64 (N, 4), unit length, in the order of the file's columns.
    translations : float64 (N, 3).
    named : keys of all rows with the line of their first, those without a usable pose included.
    findings : what is wrong with the rows.
    """

    keys: tuple[str, ...]
    quats: NDArray[np.float64]
    translations: NDArray[np.float64]
    named: dict[str, int]
    findings: tuple[Finding, ...]


def read_rows(path: Path, kind: PoseFileFormat) -> Rows:
    """Read what can be read of a pose file.

    Raises
    ------
    DataError : it cannot be read at all, or is no text in UTF-8; names file and line.
    """
    scan = _Scan(kind)
    lines = read_text(path).split("\n")
    if lines[-1] and kind == "ltvl":
        message = "the last line is not ended: the file may be cut short"
        scan.problem(len(lines), "cut", message, severity="warning")
    for number, line in enumerate(lines, start=1):
        if line.strip():
            scan.add(number, line)
    return scan.result()


class _Scan:
    """Collects rows and problems; numbers are looked at together at the end."""

    def __init__(self, kind: PoseFileFormat) -> None:
        self.kind = kind
        self.num_keys = _KEYS[kind]
        self.keys: list[str] = []
        self.numbers: list[list[float]] = []
        self.named: dict[str, int] = {}
        self.findings: list[Finding] = []

    def problem(self, line: int, kind: str, message: str, severity: Severity = "error") -> None:
        self.findings.append(Finding(severity, kind, message, line=line))

    def add(self, number: int, line: str) -> None:
        """Take one line."""
        fields = line.split()
        wanted = self.num_keys + 7
        if "," in line and len(fields) != wanted or any(field.endswith(",") for field in fields):
            separated = [field.strip() for field in line.split(",")]
            if len(separated) != wanted:
                separated = line.replace(",", " ").split()
            if len(separated) == wanted:
                self.problem(number, "separator", "commas; the format has single spaces")
                fields = separated
        if len(fields) != wanted:
            if line.lstrip().startswith("#"):
                self.problem(number, "comment", "a comment; the format has none, and no header")
                return
            message = f"{plural(len(fields), 'column')} instead of {wanted} ({_COLUMNS[self.kind]})"
            self.problem(number, "columns", message)
            if len(fields) < self.num_keys:
                return
            fields = fields[: self.num_keys]
        key = " ".join(fields[: self.num_keys])
        try:
            for stamp in fields[:2] if self.kind == "mlad" else ():
                pose_files.parse_timestamp(stamp)
        except DataError:
            message = f"{key} are not two timestamps (whole numbers)"
            self.problem(number, "timestamp", message)
            return
        if key in self.named:
            message = f"{key} is given twice, first on line {self.named[key]}"
            self.problem(number, "duplicate", message)
            return
        self.named[key] = number
        if len(fields) == wanted:
            self._take(number, key, fields[self.num_keys :])

    def _take(self, number: int, key: str, fields: Sequence[str]) -> None:
        try:
            values = [pose_files.parse_number(field) for field in fields]
        except DataError as error:
            self.problem(number, "number", f"{key}: {error.message}")
            return
        if not all(math.isfinite(value) for value in values):
            self.problem(number, "not-finite", f"{key}: the pose is not finite")
            return
        self.keys.append(key)
        self.numbers.append(values)

    def result(self) -> Rows:
        """The rows whose quaternion is one."""
        numbers = np.array(self.numbers, dtype=np.float64).reshape(-1, 7)
        at = _QUATERNION_AT[self.kind]
        norms, off = _norms(numbers[:, at : at + 4])
        other = 3 - at
        if len(numbers) and off.mean() > 0.5:
            other_norms, other_off = _norms(numbers[:, other : other + 4])
            if (~other_off).mean() > 0.5:
                there, first = ("translation", "quaternion")[:: -1 if at else 1]
                message = (
                    f"the {there} stands before the {first} in {plural(int(off.sum()), 'row')}; "
                    f"the columns are {_COLUMNS[self.kind]}"
                )
                self.findings.append(Finding("error", "column-order", message))
                at, norms, off = other, other_norms, other_off
        for position in np.flatnonzero(off).tolist():
            length = f"quaternion of length {norms[position]:g}, not 1"
            key = self.keys[position]
            self.problem(self.named[key], "quaternion", f"{key}: {length}")
        usable = np.isfinite(norms) & (norms > 1e-6)
        return Rows(
            keys=tuple(key for key, good in zip(self.keys, usable, strict=True) if good),
            quats=numbers[usable, at : at + 4] / norms[usable, None],
            translations=numbers[usable][:, (4, 5, 6) if at == 0 else (0, 1, 2)],
            named=self.named,
            findings=tuple(self.findings),
        )


def _norms(quats: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Lengths (N,), and whether each is off 1."""
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(quats, axis=1)
    return norms, np.abs(norms - 1.0) >= MAX_QUATERNION_NORM_ERROR


@dataclass(frozen=True, eq=False)
class MapCameras:
    """The map's images that have a pose, in the workspace's local frame.

    Parameters
    ----------
    images : names, sorted.
    quats : float64 (M, 4), w x y z, of ``cam_from_local``.
    centers : float64 (M, 3).
    """

    images: tuple[str, ...]
    quats: NDArray[np.float64]
    centers: NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Reference:
    """An imported dataset, which a pose file is compared with.

    Parameters
    ----------
    folder : its path, as it is told to people.
    expected : what each scored query is called in the pose file -> the query; in the order of the
        challenge's list where it has one (``listed``).
    queries : all query images, also those that are not scored; None where they are not known.
    relocalization : the pairs of an MLAD challenge.
    cameras : of the map; None where there is no map.
    """

    folder: str
    protocol: Protocol = field(default_factory=Protocol)
    world: World = field(default_factory=World)
    groups: Mapping[str, ImageGroup] = field(default_factory=dict)
    priors: Mapping[str, Sequence[str]] = field(default_factory=dict)
    expected: Mapping[str, str] = field(default_factory=dict)
    listed: bool = False
    queries: frozenset[str] | None = None
    relocalization: Sequence[RelocalizationPair] = ()
    cameras: MapCameras | None = None


def read_reference(folder: Path) -> Reference:
    """Read what is there of an import or workspace: ``mapping/``, ``query/``, ``megloc/``.

    Raises
    ------
    DataError : none of the three is there, or one is broken.
    """
    tables = folder / SIDE_TABLES
    parts = [folder / name for name in (_MAPPING, _QUERY)]
    there = [part for part in parts if (part / "sensors" / "sensors.txt").is_file()]
    if not there and not tables.is_dir():
        raise DataError(
            "no imported dataset: it has none of mapping/, query/ and megloc/", path=folder
        )
    protocol, groups, names = read_protocol(tables), read_groups(tables), read_names(tables)
    listed = bool(names)
    queries: frozenset[str] | None = None
    if folder / _QUERY in there:
        queries = frozenset(KaptureFolder(folder / _QUERY).read().records_camera.values())
        if not listed:
            scored = [image for image in queries if groups.get(image, ImageGroup()).scored]
            names = names_in_pose_file(scored, protocol.pose_file_names)
    cameras = None
    if folder / _MAPPING in there and (poses := KaptureFolder(folder / _MAPPING).read().poses()):
        quats, translations = stack_poses(poses.values())
        cameras = MapCameras(tuple(poses), quats, camera_centers(quats, translations))
    return Reference(
        folder=str(folder),
        protocol=protocol,
        world=read_world(tables),
        groups=groups,
        priors=read_priors(tables),
        expected={name: image for image, name in names.items()},
        listed=listed,
        queries=queries,
        relocalization=read_relocalization(tables),
        cameras=cameras,
    )
