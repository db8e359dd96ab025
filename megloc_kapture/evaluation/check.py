"""Check of pose files: rows, names or pairs, and poses against the cameras of the map."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from megloc_kapture.errors import DataError, require
from megloc_kapture.evaluation import pose_files
from megloc_kapture.evaluation.pose_files import parse_pose, parse_timestamp
from megloc_kapture.evaluation.protocols import PROTOCOLS, benchmark_of
from megloc_kapture.evaluation.report.content import counted
from megloc_kapture.geometry.poses import (
    READINGS,
    better_conventions,
    camera_centers,
    rotation_matrices,
    stack_poses,
)
from megloc_kapture.io.dataset_tables import SIDE_TABLES, PoseFileFormat, Protocol, SideTables
from megloc_kapture.io.files import read_text
from megloc_kapture.io.kapture import KaptureFolder, is_kapture
from megloc_kapture.stages.paths import MAPPING, QUERY
from megloc_kapture.values import RigidTransform

# error: the server would reject the file or give wrong results for it; warning: probably a
# mistake in the file; note: for information
Severity = Literal["error", "warning", "note"]
_SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
# largest number of printed findings of one kind; the JSON lists all
_SHOWN_OF_A_KIND = 10
_NAMES_SHOWN = 3

# the server accepts names with .jpg and with .png for this dataset
_ANY_ENDING = "robotcar"
# dataset -> (number of folders in a name, valid endings)
_SHAPES: dict[str, tuple[int, tuple[str, ...]]] = {
    "aachen": (0, (".jpg",)),
    "inloc": (0, (".JPG",)),
    "robotcar": (1, (".jpg", ".png")),
}

# with fewer poses or cameras, any convention may fit by chance
_MIN_POSES = 3
# largest number of poses compared in each convention, evenly spread over the file
_SAMPLE = 500
# a pose is near the map if its distance (see _frames) is at most _NEAR times the median in the best
# convention, or at most _LEAST times the map's extent (about a degree if only directions differ)
_NEAR, _LEAST = 2.0, 0.02


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding; ``kind`` is a stable identifier such as ``convention`` or ``missing``."""

    severity: Severity
    kind: str
    message: str
    file: str = ""
    line: int | None = None
    names: tuple[str, ...] = ()

    def __str__(self) -> str:
        where = self.file if self.line is None else f"{self.file or 'line'}:{self.line}"
        return f"{self.severity}: {where}{': ' if where else ''}{self.message}"


@dataclass(frozen=True, kw_only=True)
class CheckReport:
    """Result of a check.

    Findings are sorted by severity, those without a line first, then by file and line.
    """

    dataset: str
    file: str
    reference: str
    poses: int
    expected: int | None
    findings: tuple[Finding, ...]

    @property
    def has_problems(self) -> bool:
        return any(finding.severity == "error" for finding in self.findings)

    def lines(self) -> list[str]:
        """Format the report, one finding per line; the last line is the outcome."""
        counts: Counter[tuple[str, str]] = Counter()
        shown = []
        for finding in self.findings:
            counts[finding.severity, finding.kind] += 1
            if counts[finding.severity, finding.kind] <= _SHOWN_OF_A_KIND:
                shown.append(str(finding))
        shown += [
            f"{severity}: {count - _SHOWN_OF_A_KIND} more of kind {kind!r}; --json lists all"
            for (severity, kind), count in counts.items()
            if count > _SHOWN_OF_A_KIND
        ]
        of_severity = Counter(finding.severity for finding in self.findings)
        outcome = "no problem found"
        if of_severity["error"]:
            outcome = f"{counted(of_severity['error'], 'problem')} found"
        if of_severity["warning"]:
            outcome += f", {counted(of_severity['warning'], 'warning')}"
        of = "" if self.expected is None else f" of {self.expected} queries"
        return [*shown, f"{self.poses} poses{of}: {outcome}"]

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "reference": self.reference or None, "ok": not self.has_problems}


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference(SideTables):
    """Imported dataset and the rules of its benchmark.

    ``expected`` maps names in the pose file to scored queries; ``map_poses`` are ``cam_from_world``
    in the local frame.
    """

    folder: str = ""
    expected: Mapping[str, str] = field(default_factory=dict)
    queries: frozenset[str] = frozenset()
    map_poses: Mapping[str, RigidTransform] = field(default_factory=dict)


def read_reference(folder: Path) -> Reference:
    """Read ``mapping/``, ``query/`` and ``megloc/`` of an imported dataset or workspace."""
    tables = folder / SIDE_TABLES
    mapping, query = (
        KaptureFolder(path) if is_kapture(path) else None
        for path in (folder / MAPPING, folder / QUERY)
    )
    require(
        mapping is not None or query is not None or tables.is_dir(),
        "no imported dataset: mapping/, query/ and megloc/ are missing",
        path=folder,
    )
    rules = benchmark_of(tables)
    queries = frozenset() if query is None else frozenset(query.read().image_names())
    names = rules.names or pose_files.names_in_pose_file(
        rules.scored(queries), rules.protocol.pose_file_names
    )
    return Reference(
        **vars(rules),
        folder=str(folder),
        expected={name: image for image, name in names.items()},
        queries=queries,
        map_poses={} if mapping is None else mapping.read().poses(),
    )


def check_submission(
    path: Path, *, dataset: str, reference: Reference | None = None
) -> CheckReport:
    """Check a pose file, or the folder of pose files of an MLAD challenge.

    Without a reference, only the format is checked.
    """
    if reference is None:
        reference = Reference(protocol=PROTOCOLS.get(dataset, Protocol()))
    if reference.protocol.pose_file == "mlad":
        poses, findings = _check_mlad(path, reference)
        expected = len(reference.relocalization)
    else:
        poses, findings = _check_file(path, dataset, reference)
        expected = len(reference.expected)
    if not reference.map_poses:
        findings.append(_not_checked("poses", reference))
    findings.sort(
        key=lambda f: (_SEVERITIES.index(f.severity), f.line is not None, f.file, f.line or 0)
    )
    return CheckReport(
        dataset=dataset,
        file=str(path),
        reference=reference.folder,
        poses=poses,
        expected=expected or None,
        findings=tuple(findings),
    )


def _check_file(path: Path, dataset: str, reference: Reference) -> tuple[int, list[Finding]]:
    require(not path.is_dir(), "is a folder; this challenge takes a single pose file", path=path)
    lines, poses, of_rows = _read_rows(path, "ltvl")
    world = reference.world
    findings = _check_poses(poses, reference, lambda _, pose: world.pose_in_local(pose))
    if reference.expected:
        findings += _check_names(lines, reference, dataset)
    else:
        findings += [*_check_shape(lines, dataset), _not_checked("names", reference)]
    return len(poses), [replace(f, file=path.name) for f in [*findings, *of_rows]]


def _check_mlad(path: Path, reference: Reference) -> tuple[int, list[Finding]]:
    wanted: dict[str, dict[str, str]] = defaultdict(dict)  # file -> timestamps -> reference
    for pair in reference.relocalization:
        stamps = f"{PurePosixPath(pair.reference).stem} {PurePosixPath(pair.query).stem}"
        wanted[pair.file][stamps] = pair.reference
    findings, num_poses = list[Finding](), 0
    if path.is_dir():
        files = {str(p.relative_to(path)): p for p in sorted(path.rglob("*.txt"))}
        if absent := [name for name in wanted if name not in files]:
            findings.append(_about("error", "missing-file", absent, "file", "missing"))
        elif not files:
            raise DataError("there is no pose file (*.txt) in the folder", path=path)
    else:
        fitting = [name for name in wanted if PurePosixPath(name).name == path.name]
        files = {fitting[0] if fitting else path.name: path}
    for name, file in files.items():
        lines, poses, of_file = _read_rows(file, "mlad")
        num_poses += len(poses)
        if wanted and name not in wanted:
            message = f"must be named like its relocalization file: {_some(wanted)}"
            of_file.append(Finding("error", "file-name", message))
        elif wanted:
            of_file += _check_pairs(lines, poses, wanted[name], reference)
        findings += [replace(finding, file=name) for finding in of_file]
    if not wanted:
        findings.append(_not_checked("pairs", reference))
    return num_poses, findings


def _read_rows(
    path: Path, kind: PoseFileFormat
) -> tuple[dict[str, int], dict[str, RigidTransform], list[Finding]]:
    """Return line numbers and valid poses, and a finding for each wrong row.

    Both dictionaries are keyed by name, or by the two timestamps of an MLAD row.
    """
    text = read_text(path)
    require(
        not pose_files.is_colmap_images(text),
        "this is COLMAP's images.txt, not a pose file; convert it with `megloc import "
        "colmap` and `megloc submit`",
        path=path,
    )
    is_mlad = kind == "mlad"
    num_keys, columns = (2, pose_files.MLAD_COLUMNS) if is_mlad else (1, pose_files.COLUMNS)
    lines, poses, findings = dict[str, int](), dict[str, RigidTransform](), list[Finding]()
    rows = text.split("\n")
    if rows[-1] and not is_mlad:
        message = "the last line has no newline: the file may be cut off"
        findings.append(Finding("warning", "cut", message, line=len(rows)))
    for number, line in enumerate(rows, start=1):
        fields = line.split()
        if not fields:
            continue

        def problem(kind: str, message: str, line: int = number) -> None:
            findings.append(Finding("error", kind, message, line=line))

        if fields[0].startswith("#"):
            problem("comment", "a comment; the format has no comments and no header")
            continue
        if len(fields) != num_keys + 7:
            message = f"{counted(len(fields), 'column')} instead of {num_keys + 7} ({columns})"
            problem("columns", message + "; separated by spaces, not commas" * ("," in line))
            if len(fields) < num_keys or "," in fields[0]:
                continue
        key = " ".join(fields[:num_keys])
        if key in lines:
            problem("duplicate", f"{key} is given twice, first on line {lines[key]}")
            continue
        try:
            for stamp in fields[:num_keys] if is_mlad else ():
                parse_timestamp(stamp)
            lines[key] = number
            if len(fields) == num_keys + 7:
                poses[key] = parse_pose(fields[num_keys:], kind, key)
        except DataError as error:
            problem("pose", f"{error.message}; the columns are {columns}")
    if not lines:
        findings.append(Finding("error", "empty", "there is no pose in the file"))
    return lines, poses, findings


def _check_names(lines: Mapping[str, int], reference: Reference, dataset: str) -> list[Finding]:
    expected, findings = reference.expected, list[Finding]()
    by_stem, unscored = defaultdict(list), defaultdict(list)
    for name in expected:
        by_stem[_stem(name)].append(name)
    for image in reference.queries - set(expected.values()):
        unscored[_stem(image)].append(image)
    names: dict[str, str] = {}  # query -> name
    wrong, not_scored = dict[str, str](), []
    for name, line in lines.items():
        right = name
        if name not in expected:
            candidates = by_stem[_stem(name)]
            alike = [c for c in candidates if _ends_alike(name, c)]
            if not alike and any(_ends_alike(name, image) for image in unscored[_stem(name)]):
                not_scored.append(name)
                continue
            likely = alike or candidates
            if len(likely) != 1:
                message = f"{name} is not a known query"
                findings.append(Finding("error", "unknown", message, line=line, names=(name,)))
                continue
            right = wrong[name] = likely[0]
        if (other := names.setdefault(expected[right], name)) != name:
            message = f"{name} and {other} (line {lines[other]}) are the same query"
            findings.append(Finding("error", "duplicate", message, line=line, names=(other, name)))
    if wrong:
        first = next(iter(wrong))
        message = (
            f"{counted(len(wrong), 'name')} not in the challenge's list: {first} should be "
            f"{wrong[first]}"
        )
        only_endings = all(n.rpartition(".")[0] == r.rpartition(".")[0] for n, r in wrong.items())
        severity: Severity = "error"
        if only_endings and dataset == _ANY_ENDING:
            severity, message = "warning", f"{message} (the server accepts either)"
        elif len(wrong) == len(lines):
            message += "; the server matches none of them, so every recall is zero"
        findings.append(Finding(severity, "name", message, names=tuple(wrong)))
    if not_scored:
        note = "of images that are not scored, which the server ignores"
        findings.append(_about("note", "not-scored", not_scored, "row", note))
    if missing := [name for name, image in expected.items() if image not in names]:
        what = f"of {len(expected)} without a row, which count as not localized"
        severity = "error" if len(missing) == len(expected) else "warning"
        findings.append(_about(severity, "missing", missing, "query", what))
    return findings


def _check_shape(names: Iterable[str], dataset: str) -> list[Finding]:
    if dataset not in _SHAPES:
        return []
    folders, endings = _SHAPES[dataset]
    names, findings = list(names), []
    if shaped := [name for name in names if name.count("/") != folders]:
        what = "that differ from rear/TIMESTAMP" if folders else "with a folder"
        findings.append(_about("error", "name", shaped, "name", what))
    if others := [name for name in names if not name.endswith(endings)]:
        what = f"not ending in {' or '.join(endings)}"
        findings.append(_about("error", "name", others, "name", what))
    return findings


def _check_pairs(
    lines: Mapping[str, int],
    read: Mapping[str, RigidTransform],
    wanted: Mapping[str, str],
    reference: Reference,
) -> list[Finding]:
    unknown = [key for key in lines if key not in wanted]
    swapped = [key for key in unknown if " ".join(reversed(key.split(" "))) in wanted]
    if 2 * len(swapped) > len(lines):
        what = "with the two timestamps swapped: the reference comes first, then the query"
        return [_about("error", "swapped", swapped, "row", what)]
    findings = [
        Finding(
            "error", "unknown", f"pair {key} is not in the relocalization files", line=lines[key]
        )
        for key in unknown
    ]
    if missing := [key for key in wanted if key not in lines]:
        what = f"of {len(wanted)} without a row (every pair needs one)"
        findings.append(_about("error", "missing", missing, "pair", what))
    # the identity is a placeholder for a missing pose, so it is not compared with the map
    identity = RigidTransform.identity()
    if dummies := [key for key, pose in read.items() if pose == identity]:
        findings.append(
            _about("note", "dummies", dummies, "row", "with the identity as a placeholder")
        )
    map_poses, scale = reference.map_poses, reference.world.official_from_local.scale
    poses = {
        key: pose for key, pose in read.items() if pose != identity and wanted.get(key) in map_poses
    }
    if scale == 1.0:  # otherwise the poses and the map have different units
        in_local = lambda key, pose: pose @ map_poses[wanted[key]]  # noqa: E731
        findings += _check_poses(poses, reference, in_local)
    return findings


def _check_poses(
    poses: Mapping[str, RigidTransform],
    reference: Reference,
    in_local: Callable[[str, RigidTransform], RigidTransform],
) -> list[Finding]:
    map_poses, unit = list(reference.map_poses.values()), reference.world.unit
    if min(len(map_poses), len(poses)) < _MIN_POSES:
        message = f"{counted(len(poses), 'pose')} and {counted(len(map_poses), 'map camera')}: too "
        return [Finding("note", "too-few", f"{message}few to compare")] if map_poses else []
    extent = float(np.ptp(_centers(map_poses), axis=0).max()) or 1.0
    # a wrong direction counts as much as a camera at the other end of the map
    tree = cKDTree(_frames(map_poses, extent))
    names = list(poses)
    sample = names[:: -(-len(names) // _SAMPLE)]
    distances = [
        tree.query(_frames([in_local(n, read(poses[n])) for n in sample], extent))[0]
        for read in READINGS
    ]
    near = max(_NEAR * min(float(np.median(d)) for d in distances), _LEAST * extent)
    shares = [float((d <= near).mean()) for d in distances]
    if better := better_conventions(shares):
        message = (
            f"{' or '.join(better)}: with this convention, {max(shares):.0%} of the poses are near "
            f"the map's cameras, but only {shares[0]:.0%} as they are in the file; the format "
            "requires cam_from_world with x right, y down, z forward"
        )
        return [Finding("error", "convention", message)]
    centers = _centers([in_local(name, pose) for name, pose in poses.items()])
    distance = cKDTree(_centers(map_poses)).query(centers)[0]
    # all queries may have been taken at some distance from the map's cameras
    limit = max(extent, min(4 * float(np.median(distance)), 3 * extent))
    order = np.argsort(-distance, kind="stable")
    far = order[distance[order] > limit].tolist()
    if not far:
        return []
    shown = _some(f"{names[i]} ({distance[i]:.4g} {unit})" for i in far)
    far_names = tuple(names[i] for i in far)
    if 2 * len(far) > len(names):
        message = (
            f"{len(far)} of {len(names)} poses are far from every map camera, and no usual "
            f"convention explains it; are they in a different frame or scale? {shown}"
        )
        return [Finding("error", "far", message, names=far_names)]
    message = f"{counted(len(far), 'pose')} far from every map camera: {shown}"
    return [Finding("warning", "far", message, names=far_names)]


def _centers(poses: Sequence[RigidTransform]) -> NDArray[np.float64]:
    return camera_centers(*stack_poses(poses))


def _frames(poses: Sequence[RigidTransform], length: float) -> NDArray[np.float64]:
    """Return the centre and the ends of the x and z axes of each camera, (N, 9).

    The distance between two rows grows with the distance and the angle between the two cameras.
    ``length`` is the length of the axes.
    """
    centers = _centers(poses)
    axes = length * rotation_matrices(stack_poses(poses)[0])  # rows: camera's x, y, z in the world
    return np.hstack([centers, centers + axes[:, 0], centers + axes[:, 2]])


def _stem(name: str) -> str:
    return PurePosixPath(name).stem.lower()


def _ends_alike(name: str, other: str) -> bool:
    a, b = (f"/{text.lstrip('./').rpartition('.')[0].lower()}" for text in (name, other))
    return a.endswith(b) or b.endswith(a)


def _not_checked(things: str, reference: Reference) -> Finding:
    why = "no imported dataset to compare with; give one with --data"
    if reference.folder:
        why = f"{reference.folder} lacks the data to compare them with"
    return Finding("note", "not-checked", f"the {things} are not checked: {why}")


def _some(names: Iterable[str]) -> str:
    listed = list(names)
    text = ", ".join(listed[:_NAMES_SHOWN])
    return text if len(listed) <= _NAMES_SHOWN else f"{text} and {len(listed) - _NAMES_SHOWN} more"


def _about(severity: Severity, kind: str, names: Sequence[str], noun: str, what: str) -> Finding:
    message = f"{counted(len(names), noun)} {what}: {_some(names)}"
    return Finding(severity, kind, message, names=tuple(names))
