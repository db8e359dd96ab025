"""Are the names of a pose file those of the challenge's list, and if not, what happened to them?"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from megloc_kapture.evaluation.check.findings import Finding, Severity, plural, some
from megloc_kapture.io.side_tables import ImageGroup

# datasets whose server is known to take either of two endings
_ENDINGS_DO_NOT_MATTER = ("robotcar",)


@dataclass(frozen=True)
class NamedRows:
    """What the names of a file stand for.

    Parameters
    ----------
    images : name -> the query, also where the name is wrong in a way that can be told.
    findings : unknown, wrong, missing and double names.
    """

    images: Mapping[str, str]
    findings: tuple[Finding, ...]


@dataclass(frozen=True, slots=True)
class _Difference:
    """How a name differs from the one it should be."""

    folders: str = ""  # "lacks", "besides" or "others"
    ending: tuple[str, str] | None = None
    letters: bool = False

    def __str__(self) -> str:
        parts = []
        if self.folders == "lacks":
            parts.append("without the folder before them")
        elif self.folders == "besides":
            parts.append("with more of the path than the list")
        elif self.folders == "others":
            parts.append("with other folders than the list")
        if self.ending:
            parts.append(f"ending in {self.ending[0]!r} instead of {self.ending[1]!r}")
        if self.letters:
            parts.append("with other upper and lower case letters")
        return " and ".join(parts)

    @property
    def kind(self) -> str:
        if self.folders:
            return {"lacks": "name-folder", "besides": "name-path"}.get(
                self.folders, "name-folders"
            )
        return "name-ending" if self.ending else "name-letters"


def match_names(
    named: Mapping[str, int],
    expected: Mapping[str, str],
    *,
    queries: Collection[str],
    groups: Mapping[str, ImageGroup],
    listed: bool,
    dataset: str,
) -> NamedRows:
    """Find what each name stands for.

    Parameters
    ----------
    named : names of the file -> line.
    expected : names of the list -> query, in its order.
    queries : all query images, also those that are not scored.
    groups : of the queries; conditions are named where a whole one is missing.
    listed : whether the list's order is the challenge's, and not only ours.
    """
    by_stem: dict[str, list[str]] = {}
    for name in expected:
        by_stem.setdefault(_stem(name), []).append(name)
    scored = set(expected.values())
    unscored: dict[str, list[str]] = {}
    for image in queries:
        if image not in scored:
            unscored.setdefault(_stem(image), []).append(image)
    images: dict[str, str] = {}
    wrong: dict[_Difference, list[tuple[str, str]]] = {}
    not_scored, unknown, findings = [], [], []
    for name, line in named.items():
        if name in expected:
            images[name] = expected[name]
            continue
        found = _closest(name, by_stem.get(_stem(name), ()))
        if found is not None and found[1].folders != "others":
            wrong.setdefault(found[1], []).append((name, found[0]))
            images[name] = expected[found[0]]
        elif _ends_alike(name, unscored.get(_stem(name), ())):
            not_scored.append(name)
        elif found is not None:
            wrong.setdefault(found[1], []).append((name, found[0]))
            images[name] = expected[found[0]]
        else:
            unknown.append(name)
            findings.append(
                Finding(
                    "error", "unknown", f"{name} is no name of the list", line=line, names=(name,)
                )
            )
    findings += [
        _wrong_names(difference, pairs, len(named), dataset) for difference, pairs in wrong.items()
    ]
    if not_scored:
        findings.append(
            Finding(
                "note",
                "not-scored",
                f"{plural(len(not_scored), 'row')} of images that are not scored and will be "
                f"ignored: {some(not_scored)}",
                names=tuple(not_scored),
            )
        )
    findings += _doubles(images, named)
    findings += missing_names(expected, set(images.values()), groups)
    if listed and not in_order(named, expected):
        findings.append(
            Finding("note", "order", "the rows are not in the order of the challenge's list")
        )
    return NamedRows(images, tuple(findings))


def missing_names(
    expected: Mapping[str, str], given: Collection[str], groups: Mapping[str, ImageGroup]
) -> list[Finding]:
    """Queries without a row, and the conditions of which there is none at all."""
    missing = [name for name, image in expected.items() if image not in given]
    if not missing:
        return []
    if len(missing) == len(expected):
        message = f"none of the {plural(len(expected), 'name')} of the list is in the file"
        return [Finding("error", "missing", message, names=tuple(missing))]
    rows: dict[str, list[bool]] = {}
    for image in expected.values():
        rows.setdefault(groups.get(image, ImageGroup()).condition, []).append(image in given)
    empty = [condition for condition, found in sorted(rows.items()) if condition and not any(found)]
    message = (
        f"{len(missing)} of {len(expected)} queries have no row, and count as not localized: "
        f"{some(missing)}"
    )
    if empty:
        message += f"; there is no row at all of condition {', '.join(empty)}"
    return [Finding("warning", "missing", message, names=tuple(missing))]


def check_shape(named: Mapping[str, int], dataset: str) -> list[Finding]:
    """What the names alone can show, where there is no list to compare with."""
    rules: dict[str, tuple[bool, Sequence[str]]] = {
        "aachen": (False, (".jpg",)),
        "inloc": (False, (".JPG",)),
        "robotcar": (True, (".jpg", ".png")),
    }
    if dataset not in rules:
        return []
    with_folder, endings = rules[dataset]
    findings = []
    flat = [name for name in named if ("/" in name) != with_folder]
    if flat:
        message = (
            f"{plural(len(flat), 'name')} without the camera's folder: {some(flat)}; the server "
            "looks for rear/..., and finds none of them"
            if with_folder
            else f"{plural(len(flat), 'name')} with a folder: {some(flat)}; the server looks for "
            "the last part of the path alone"
        )
        kind = "name-folder" if with_folder else "name-path"
        findings.append(Finding("error", kind, message, names=tuple(flat)))
    others = [name for name in named if not name.endswith(tuple(endings))]
    if others:
        message = (
            f"{plural(len(others), 'name')} not ending in {' or '.join(endings)}: {some(others)}"
        )
        findings.append(Finding("error", "name-ending", message, names=tuple(others)))
    return findings


def _wrong_names(
    difference: _Difference, pairs: Sequence[tuple[str, str]], total: int, dataset: str
) -> Finding:
    name, right = pairs[0]
    message = f"{plural(len(pairs), 'name')} {difference}: {name} should be {right}"
    severity: Severity = "error"
    if difference.kind == "name-ending" and dataset in _ENDINGS_DO_NOT_MATTER:
        severity = "warning"
        message += " (the server is said to take either)"
    elif len(pairs) == total:
        message += "; the server finds none of them, and every figure is zero"
    return Finding(severity, difference.kind, message, names=tuple(name for name, _ in pairs))


def _doubles(images: Mapping[str, str], named: Mapping[str, int]) -> list[Finding]:
    first: dict[str, str] = {}
    findings = []
    for name, image in images.items():
        other = first.setdefault(image, name)
        if other != name:
            message = f"{name} and {other} (line {named[other]}) are the same query"
            findings.append(
                Finding("error", "duplicate", message, line=named[name], names=(other, name))
            )
    return findings


def _closest(name: str, candidates: Sequence[str]) -> tuple[str, _Difference] | None:
    """The name of the list that ``name`` was meant to be, of those with its stem; None: unclear."""
    compared = [(right, _compare(name, right)) for right in candidates]
    for group in (
        [pair for pair in compared if pair[1].folders != "others"],
        compared,
    ):
        if len(group) == 1:
            return group[0]
    return None


def _compare(name: str, right: str) -> _Difference:
    given, wanted = PurePosixPath(name), PurePosixPath(right)
    own, other = given.parts[:-1], wanted.parts[:-1]
    own = tuple(part for part in own if part != "/")
    folders = ""
    if own != other:
        if other[len(other) - len(own) :] == own:
            folders = "lacks"
        elif own[len(own) - len(other) :] == other:
            folders = "besides"
        else:
            folders = "others"
    elif "/".join((*own, given.name)) != name:
        folders = "besides"  # "./x.jpg", "/x.jpg"
    differs = given.suffix.lower() != wanted.suffix.lower()
    return _Difference(
        folders=folders,
        ending=(given.suffix, wanted.suffix) if differs else None,
        letters=not differs and given.name != wanted.name,
    )


def _ends_alike(name: str, images: Sequence[str]) -> bool:
    """Whether ``name`` is the last parts of one of ``images``, whatever its ending."""
    given = PurePosixPath(name)
    own = (*given.parts[:-1], given.stem)
    for image in images:
        path = PurePosixPath(image)
        if (*path.parts[:-1], path.stem)[-len(own) :] == own:
            return True
    return False


def in_order(named: Mapping[str, int], expected: Mapping[str, object]) -> bool:
    """Whether the names that are expected stand in the expected order."""
    position = {name: number for number, name in enumerate(expected)}
    places = [position[name] for name in named if name in position]
    return all(a < b for a, b in zip(places, places[1:], strict=False))


def _stem(name: str) -> str:
    return PurePosixPath(name).stem.lower()
