"""The check of one submission: its rows, its names or pairs, its poses."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.check.comparison import compare_poses, compare_relative
from megloc_kapture.evaluation.check.reading import (
    CheckReport,
    Finding,
    Reference,
    Rows,
    Severity,
    about,
    plural,
    read_rows,
    some,
)
from megloc_kapture.evaluation.protocols import PROTOCOLS
from megloc_kapture.io.dataset_tables import ImageGroup, Protocol, RelocalizationPair

# datasets whose server is known to take either of two endings
_ENDINGS_DO_NOT_MATTER = ("robotcar",)
# whether names hold a folder, and their endings
_SHAPES: dict[str, tuple[bool, tuple[str, ...]]] = {
    "aachen": (False, (".jpg",)),
    "inloc": (False, (".JPG",)),
    "robotcar": (True, (".jpg", ".png")),
}
# how the folders of a name differ from those of the list
_NO_FOLDER = "name-folder", "without the folder before them"
_MORE_FOLDERS = "name-path", "with more of the path than the list"
_OTHER_FOLDERS = "name-folders", "with other folders than the list"


def check_submission(
    path: Path, *, dataset: str, reference: Reference | None = None
) -> CheckReport:
    """Check a pose file, or an MLAD challenge's folder of pose files, ours or foreign.

    Parameters
    ----------
    dataset : whose rules hold, by its name without ``synthetic-``.
    reference : the imported dataset; None: only what the file alone can show is checked.

    Raises
    ------
    DataError : the file cannot be read, is no text, or is a folder where a file is asked for.
    """
    if reference is None:
        reference = Reference(protocol=PROTOCOLS.get(dataset, Protocol()))
    if reference.protocol.pose_file == "mlad":
        poses, expected, findings = _check_mlad(path, reference)
    else:
        poses, expected, findings = _check_file(path, dataset, reference)
    return CheckReport(
        dataset=dataset,
        file=str(path),
        reference=reference.folder,
        poses=poses,
        expected=expected or None,
        findings=tuple(findings),
    )


def _check_file(path: Path, dataset: str, reference: Reference) -> tuple[int, int, list[Finding]]:
    """Poses, queries that count, and findings of a file of absolute poses."""
    if path.is_dir():
        raise DataError("a folder; the pose file of this challenge is one file", path=path)
    rows = read_rows(path, "ltvl")
    if reference.expected:
        images, of_names = match_names(rows.named, reference, dataset)
    else:
        images = {}
        of_names = [*check_shape(rows.named, dataset), *_not_checked("names", reference)]
    # what is wrong with the whole file is told first
    findings = compare_poses(rows, [images.get(key) for key in rows.keys], reference)
    findings += [*_empty(rows), *of_names, *rows.findings]
    if reference.cameras is None:
        findings += _not_checked("poses", reference)
    return len(rows.keys), len(reference.expected), _in_file(path.name, findings)


def _check_mlad(path: Path, reference: Reference) -> tuple[int, int, list[Finding]]:
    """Poses, pairs that are asked for, and findings of the files of an MLAD challenge."""
    wanted: dict[str, list[RelocalizationPair]] = {}
    for pair in reference.pairs:
        wanted.setdefault(pair.file, []).append(pair)
    findings: list[Finding] = []
    if path.is_dir():
        there = {str(p.relative_to(path)): p for p in sorted(path.rglob("*.txt"))}
        files = {name: there[name] for name in wanted if name in there} if wanted else there
        absent = [name for name in wanted if name not in there]
        others = [name for name in there if name not in files]
        if absent:
            findings.append(about("error", "missing-file", absent, "file", "missing"))
        if others:
            said = "that no relocalization file asks for"
            findings.append(about("warning", "unknown-file", others, "file", said))
        if not files and not absent:
            raise DataError("there is no pose file (*.txt) in the folder", path=path)
    else:
        fitting = [own for own in wanted if PurePosixPath(own).name == path.name]
        if wanted and not fitting:
            message = f"the file must be called as its relocalization file is: {some(wanted)}"
            findings.append(Finding("error", "file-name", message))
            fitting = list(wanted) if len(wanted) == 1 else []
        files = {fitting[0] if len(fitting) == 1 else path.name: path}
    poses = 0
    for name, file in files.items():
        rows = read_rows(file, "mlad")
        poses += len(rows.keys)
        of_pairs = _check_pairs(rows, wanted.get(name), reference)
        findings += _in_file(name, [*rows.findings, *_empty(rows), *of_pairs])
    if not wanted:
        findings += _not_checked("pairs", reference)
    if reference.cameras is None:
        findings += _not_checked("poses", reference)
    return poses, len(reference.pairs), findings


def _check_pairs(
    rows: Rows, pairs: Sequence[RelocalizationPair] | None, reference: Reference
) -> list[Finding]:
    findings: list[Finding] = []
    images: dict[str, tuple[str, str | None]] = {
        " ".join(map(_stem, (pair.reference, pair.query))): (pair.reference, pair.query)
        for pair in pairs or ()
    }
    swapped = False
    if pairs is not None:
        swapped, findings = match_pairs(rows.named, images)
    # a dummy is no pose, and says nothing about how the others are meant
    is_dummy = (abs(abs(rows.quats) - [0, 0, 0, 1]).max(axis=1) < 1e-12) & ~rows.translations.any(1)
    if is_dummy.any():
        dummies = rows.only(np.flatnonzero(is_dummy)).keys
        said = "hold the identity, a dummy that is no pose"
        findings.append(about("note", "dummies", dummies, "row", said))
    if reference.cameras is None or swapped:
        return findings
    by_stem = {_stem(image): image for image in reference.cameras.images}
    rows = rows.only(np.flatnonzero(~is_dummy))
    named = [images.get(key, (by_stem.get(key.split(" ")[0], ""), None)) for key in rows.keys]
    return findings + compare_relative(rows, named, reference)


def match_pairs(named: Mapping[str, int], expected: Collection[str]) -> tuple[bool, list[Finding]]:
    """Whether the two timestamps of an MLAD file's rows are swapped, and what is wrong with them.

    Parameters
    ----------
    named : keys (two timestamps with a blank between) -> line.
    expected : the keys of the relocalization file, in its order.
    """
    wanted = dict.fromkeys(expected)
    unknown = [key for key in named if key not in wanted]
    turned = [key for key in unknown if " ".join(reversed(key.split(" "))) in wanted]
    if len(turned) > 0.5 * len(named):
        message = (
            f"the two timestamps are swapped in {plural(len(turned), 'row')}: the reference "
            "stands first, then the query"
        )
        return True, [Finding("error", "swapped", message, names=tuple(turned))]
    findings = [
        Finding("error", "unknown", f"pair {key} is not asked for", line=named[key], names=(key,))
        for key in unknown
    ]
    missing = tuple(key for key in wanted if key not in named)
    if missing:
        message = (
            f"{len(missing)} of {len(wanted)} pairs have no row, and every one is asked for: "
            f"{some(missing)}"
        )
        findings.append(Finding("error", "missing", message, names=missing))
    return False, findings + _order(named, wanted, "relocalization file")


def match_names(
    named: Mapping[str, int], reference: Reference, dataset: str
) -> tuple[Mapping[str, str], list[Finding]]:
    """Find the query that each name of a file (-> line) stands for.

    Returns
    -------
    Name -> the query, also where the name is wrong in a way that can be told; and findings about
    unknown, wrong, missing and double names.
    """
    expected = reference.expected
    by_stem = _by_stem(expected)
    unscored = _by_stem(sorted(reference.queries - set(expected.values())))
    images: dict[str, str] = {}
    # kind and words of a difference -> names and the right ones
    wrong: dict[tuple[str, str], list[tuple[str, str]]] = {}
    not_scored, findings = [], []
    for name, line in named.items():
        if name in expected:
            images[name] = expected[name]
            continue
        found = _closest(name, by_stem.get(_stem(name), ()))
        elsewhere = found is None or found[1][0] == _OTHER_FOLDERS[0]
        if elsewhere and _ends_alike(name, unscored.get(_stem(name), ())):
            not_scored.append(name)
        elif found is not None:
            wrong.setdefault(found[1], []).append((name, found[0]))
            images[name] = expected[found[0]]
        else:
            message = f"{name} is no name of the list"
            findings.append(Finding("error", "unknown", message, line=line, names=(name,)))
    for (kind, said), pairs in wrong.items():
        message = f"{plural(len(pairs), 'name')} {said}: {pairs[0][0]} should be {pairs[0][1]}"
        severity: Severity = "error"
        if kind == "name-ending" and dataset in _ENDINGS_DO_NOT_MATTER:
            severity = "warning"
            message += " (the server is said to take either)"
        elif len(pairs) == len(named):
            message += "; the server finds none of them, and every figure is zero"
        findings.append(Finding(severity, kind, message, names=tuple(name for name, _ in pairs)))
    if not_scored:
        said = "of images that are not scored and will be ignored"
        findings.append(about("note", "not-scored", not_scored, "row", said))
    first: dict[str, str] = {}
    for name, image in images.items():
        other = first.setdefault(image, name)
        if other != name:
            message = f"{name} and {other} (line {named[other]}) are the same query"
            names = (other, name)
            findings.append(Finding("error", "duplicate", message, line=named[name], names=names))
    findings += _missing_names(expected, set(images.values()), reference.groups)
    if reference.names:
        findings += _order(named, expected, "challenge's list")
    return images, findings


def check_shape(named: Iterable[str], dataset: str) -> list[Finding]:
    """Findings that the names alone can show, where there is no list to compare with."""
    if dataset not in _SHAPES:
        return []
    with_folder, endings = _SHAPES[dataset]
    findings = []
    if flat := [name for name in named if ("/" in name) != with_folder]:
        kind, problem = "name-path", "with a folder"
        advice = "; the server looks for the last part of the path alone"
        if with_folder:
            kind, problem = "name-folder", "without the camera's folder"
            advice = "; the server looks for rear/..., and finds none of them"
        findings.append(about("error", kind, flat, "name", problem, advice))
    if others := [name for name in named if not name.endswith(endings)]:
        said = f"not ending in {' or '.join(endings)}"
        findings.append(about("error", "name-ending", others, "name", said))
    return findings


def _missing_names(
    expected: Mapping[str, str], given: Collection[str], groups: Mapping[str, ImageGroup]
) -> list[Finding]:
    """Queries without a row, and the conditions of which there is none at all."""
    missing = tuple(name for name, image in expected.items() if image not in given)
    if not missing:
        return []
    if len(missing) == len(expected):
        message = f"none of the {plural(len(expected), 'name')} of the list is in the file"
        return [Finding("error", "missing", message, names=missing)]
    conditions, there = (
        {groups.get(image, ImageGroup()).condition for image in images}
        for images in (expected.values(), given)
    )
    message = (
        f"{len(missing)} of {len(expected)} queries have no row, and count as not localized: "
        f"{some(missing)}"
    )
    if empty := sorted(conditions - there - {""}):
        message += f"; there is no row at all of condition {', '.join(empty)}"
    return [Finding("warning", "missing", message, names=missing)]


def _order(named: Iterable[str], expected: Iterable[str], of: str) -> list[Finding]:
    """A note where the names that are expected do not stand in the expected order."""
    position = {name: number for number, name in enumerate(expected)}
    found = [position[name] for name in named if name in position]
    if found == sorted(found):
        return []
    return [Finding("note", "order", f"the rows are not in the order of the {of}")]


def _closest(name: str, candidates: Sequence[str]) -> tuple[str, tuple[str, str]] | None:
    """The name of the list that ``name`` was meant to be, of those with its stem, and kind and
    words of the difference; None: unclear."""
    compared = [(right, _difference(name, right)) for right in candidates]
    likely = [pair for pair in compared if pair[1][0] != _OTHER_FOLDERS[0]]
    return next((group[0] for group in (likely, compared) if len(group) == 1), None)


def _difference(name: str, right: str) -> tuple[str, str]:
    """Kind and words of how a name differs from the one it should be."""
    given, wanted = PurePosixPath(name), PurePosixPath(right)
    own = tuple(part for part in given.parts[:-1] if part != "/")
    other = wanted.parts[:-1]
    differences = []
    if own == other:
        if "/".join((*own, given.name)) != name:  # "./x.jpg", "/x.jpg"
            differences.append(_MORE_FOLDERS)
    elif other[len(other) - len(own) :] == own:
        differences.append(_NO_FOLDER)
    elif own[len(own) - len(other) :] == other:
        differences.append(_MORE_FOLDERS)
    else:
        differences.append(_OTHER_FOLDERS)
    if given.suffix.lower() != wanted.suffix.lower():
        said = f"ending in {given.suffix!r} instead of {wanted.suffix!r}"
        differences.append(("name-ending", said))
    elif given.name != wanted.name or not differences:
        differences.append(("name-letters", "with other upper and lower case letters"))
    return differences[0][0], " and ".join(said for _, said in differences)


def _ends_alike(name: str, images: Iterable[str]) -> bool:
    """True where ``name`` is the last parts of one of ``images``, whatever its ending."""

    def parts(path: PurePosixPath) -> tuple[str, ...]:
        return (*path.parts[:-1], path.stem)

    own = parts(PurePosixPath(name))
    return any(parts(PurePosixPath(image))[-len(own) :] == own for image in images)


def _by_stem(names: Iterable[str]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = defaultdict(list)
    for name in names:
        found[_stem(name)].append(name)
    return found


def _stem(name: str) -> str:
    return PurePosixPath(name).stem.lower()


def _empty(rows: Rows) -> list[Finding]:
    return [] if rows.named else [Finding("error", "empty", "there is no pose in the file")]


def _not_checked(things: str, reference: Reference) -> list[Finding]:
    why = "no imported dataset to compare with; give one with --data"
    if reference.folder:
        why = f"{reference.folder} does not have what they are compared with"
    return [Finding("note", "not-checked", f"the {things} are not checked: {why}")]


def _in_file(name: str, findings: Iterable[Finding]) -> list[Finding]:
    return [replace(finding, file=name) for finding in findings]
