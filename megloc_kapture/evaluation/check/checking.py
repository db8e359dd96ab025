"""Check one submission: its rows, its names, its poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path, PurePosixPath

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.check.comparison import compare_poses, compare_relative
from megloc_kapture.evaluation.check.findings import CheckReport, Finding, plural, some
from megloc_kapture.evaluation.check.names import check_shape, match_names
from megloc_kapture.evaluation.check.pairs import match_pairs
from megloc_kapture.evaluation.check.reference import Reference
from megloc_kapture.evaluation.check.rows import Rows, read_rows
from megloc_kapture.io.challenge_tables import RelocalizationPair

_MLAD_DATASETS = ("4seasons",)


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
        mlad = dataset in _MLAD_DATASETS
    else:
        mlad = reference.protocol.pose_file == "mlad"
    if mlad:
        return _check_mlad(path, dataset, reference)
    if path.is_dir():
        raise DataError("a folder; the pose file of this challenge is one file", path=path)
    rows = read_rows(path, "ltvl")
    findings: list[Finding] = []
    expected: int | None = None
    images: dict[str, str] = {}
    if not rows.named:
        findings.append(Finding("error", "empty", "there is no pose in the file"))
    if reference is None or not reference.expected:
        findings += check_shape(rows.named, dataset)
        findings.append(_not_checked("names", reference))
    else:
        expected = len(reference.expected)
        matched = match_names(
            rows.named,
            reference.expected,
            queries=reference.queries or (),
            groups=reference.groups,
            listed=reference.listed,
            dataset=dataset,
        )
        images.update(matched.images)
        findings += matched.findings
    if reference is None or reference.cameras is None:
        findings.append(_not_checked("poses", reference))
    else:
        queries = [images.get(key) for key in rows.keys]
        of_map = compare_poses(rows.keys, rows.quats, rows.translations, queries, reference)
        # what is wrong with the whole file is told first
        findings = of_map + findings
    findings += rows.findings
    return CheckReport(
        dataset=dataset,
        file=str(path),
        reference="" if reference is None else reference.place,
        poses=len(rows.keys),
        expected=expected,
        findings=tuple(_in_file(finding, path.name) for finding in findings),
    )


def _check_mlad(path: Path, dataset: str, reference: Reference | None) -> CheckReport:
    wanted: dict[str, list[RelocalizationPair]] = {}
    for pair in () if reference is None else reference.relocalization:
        wanted.setdefault(pair.file, []).append(pair)
    findings: list[Finding] = []
    files: dict[str, Path] = {}
    if path.is_dir():
        there = {str(p.relative_to(path)): p for p in sorted(path.rglob("*.txt"))}
        files = {name: there[name] for name in wanted if name in there} if wanted else there
        absent = [name for name in wanted if name not in there]
        if absent:
            message = f"{plural(len(absent), 'file')} missing: {some(absent)}"
            findings.append(Finding("error", "missing-file", message, names=tuple(absent)))
        others = [name for name in there if name not in files]
        if others:
            message = f"{plural(len(others), 'file')} that no relocalization file asks for"
            findings.append(
                Finding(
                    "warning", "unknown-file", f"{message}: {some(others)}", names=tuple(others)
                )
            )
        if not files and not absent:
            raise DataError("there is no pose file (*.txt) in the folder", path=path)
    else:
        name = path.name
        fitting = [own for own in wanted if PurePosixPath(own).name == name]
        if wanted and not fitting:
            message = f"the file must be called as its relocalization file is: {some(wanted)}"
            findings.append(Finding("error", "file-name", message))
            fitting = list(wanted) if len(wanted) == 1 else []
        files = {fitting[0] if len(fitting) == 1 else name: path}
    poses = 0
    for name, place in files.items():
        rows = read_rows(place, "mlad")
        poses += len(rows.keys)
        found = list(rows.findings)
        if not rows.named:
            found.append(Finding("error", "empty", "there is no pose in the file"))
        found += _check_pairs(rows, wanted.get(name), reference)
        findings += [_in_file(finding, name) for finding in found]
    if not wanted:
        findings.append(_not_checked("pairs", reference))
    if reference is None or reference.cameras is None:
        findings.append(_not_checked("poses", reference))
    return CheckReport(
        dataset=dataset,
        file=str(path),
        reference="" if reference is None else reference.place,
        poses=poses,
        expected=sum(map(len, wanted.values())) if wanted else None,
        findings=tuple(findings),
    )


def _check_pairs(
    rows: Rows, pairs: list[RelocalizationPair] | None, reference: Reference | None
) -> list[Finding]:
    findings: list[Finding] = []
    images: dict[tuple[str, str], tuple[str, str | None]] = {}
    swapped = False
    if pairs is not None:
        for pair in pairs:
            stems = (PurePosixPath(pair.reference).stem, PurePosixPath(pair.query).stem)
            images[stems] = (pair.reference, pair.query)
        swapped, findings = match_pairs(rows.named, images)
    # a dummy is no pose, and says nothing about how the others are meant
    is_dummy = (abs(abs(rows.quats) - [0, 0, 0, 1]).max(axis=1) < 1e-12) & ~rows.translations.any(1)
    if is_dummy.any():
        dummies = tuple(key for key, dummy in zip(rows.keys, is_dummy, strict=True) if dummy)
        message = f"{plural(len(dummies), 'row')} hold the identity, a dummy that is no pose"
        findings.append(Finding("note", "dummies", f"{message}: {some(dummies)}", names=dummies))
    if reference is None or reference.cameras is None or swapped:
        return findings
    by_stem = {PurePosixPath(image).stem: image for image in reference.cameras.images}
    chosen, named = [], []
    for number, key in enumerate(rows.keys):
        stem, query = key.split(" ")
        image = images.get((stem, query), (by_stem.get(stem, ""), None))
        if not is_dummy[number]:
            chosen.append(number)
            named.append(image)
    keys = [rows.keys[number] for number in chosen]
    findings += compare_relative(
        keys, rows.quats[chosen], rows.translations[chosen], named, reference
    )
    return findings


def _not_checked(what: str, reference: Reference | None) -> Finding:
    if reference is None:
        why = "no imported dataset to compare with; give one with --data"
    else:
        why = f"{reference.place} does not have what they are compared with"
    return Finding("note", "not-checked", f"the {what} are not checked: {why}")


def _in_file(finding: Finding, name: str) -> Finding:
    return replace(finding, file=name)
