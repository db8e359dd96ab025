"""Whole checks: files alone, MLAD's files and folders, how they are told; names and pairs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.check.reading import (
    CheckReport,
    Finding,
    MapCameras,
    Reference,
    read_reference,
)
from megloc_kapture.evaluation.check.submission import (
    check_shape,
    check_submission,
    match_names,
    match_pairs,
)
from megloc_kapture.io.dataset_tables import ImageGroup, Protocol, RelocalizationPair

START = 1_600_000_000_000_000_000


@dataclass(frozen=True, eq=False)
class Drive:
    """A reference recording and a query recording along one road, and the pairs asked for."""

    reference: Reference
    rotations: np.ndarray  # query_from_reference
    translations: np.ndarray
    stamps: list[str]

    def lines(self, mistake: str = "") -> list[str]:
        rotations, translations = self.rotations, self.translations
        if mistake in ("inverted", "centre"):
            translations = -np.einsum("nji,nj->ni", rotations, translations)
        if mistake == "inverted":
            rotations = rotations.transpose(0, 2, 1)
        quats = Rotation.from_matrix(rotations).as_quat()
        if mistake == "wxyz":
            quats = np.roll(quats, 1, axis=1)
        return [
            " ".join([pair, *(repr(float(v)) for v in (*t, *q))]) + "\n"
            for pair, t, q in zip(self.stamps, translations, quats, strict=True)
        ]


def drive(number: int = 120) -> Drive:
    """Along a bend; the query drives in the other lane, its references some metres before it."""
    rng = np.random.default_rng(0)
    along = np.arange(0, 500, 1.0)

    def cameras(at: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
        heading = at / 120
        forward = np.stack([np.cos(heading), np.sin(heading), 0 * at], axis=1)
        down = np.tile([0.0, 0.0, -1.0], (len(at), 1))
        rotations = np.stack([np.cross(down, forward), down, forward], axis=1)
        path = 120 * np.stack([np.sin(heading), 1 - np.cos(heading), 0 * at], axis=1)
        return rotations, path + side * rotations[:, 0]

    map_rotations, map_centers = cameras(along, 0.0)
    chosen = np.sort(rng.choice(np.arange(20, 480), number, replace=False))
    references = np.clip(chosen + rng.integers(-6, 7, number), 0, 499)
    rotations, centers = cameras(chosen.astype(float), 2.0)
    relative = rotations @ map_rotations[references].transpose(0, 2, 1)
    translations = np.einsum("nij,nj->ni", rotations, map_centers[references] - centers)
    images = tuple(f"ref/cam0/{START + 10**8 * i}.png" for i in range(500))
    queries = [f"query/cam0/{START + 10**15 + 10**8 * int(i)}.png" for i in chosen]
    quats = np.roll(Rotation.from_matrix(map_rotations).as_quat(), 1, axis=1)
    pairs = [
        RelocalizationPair("reloc_a_to_b.txt", images[r], q)
        for r, q in zip(references, queries, strict=True)
    ]
    reference = Reference(
        folder="import",
        protocol=Protocol(dataset="4seasons", pose_file="mlad"),
        queries=frozenset(queries),
        pairs=tuple(pairs),
        cameras=MapCameras(images, quats, map_centers),
    )
    stamps = [f"{Path(p.reference).stem} {Path(p.query).stem}" for p in pairs]
    return Drive(reference, relative, translations, stamps)


DRIVE = drive()
Check = Callable[..., CheckReport]


@pytest.fixture
def check(tmp_path: Path) -> Check:
    def run(
        lines: Sequence[str],
        reference: Reference | None = DRIVE.reference,
        name: str = "reloc_a_to_b.txt",
        dataset: str = "4seasons",
    ) -> CheckReport:
        (tmp_path / name).write_text("".join(lines))
        return check_submission(tmp_path / name, dataset=dataset, reference=reference)

    return run


def told(report: CheckReport) -> list[tuple[str, str]]:
    return [(finding.severity, finding.kind) for finding in report.sorted_findings]


def test_mistakes_of_mlad_files(check: Check) -> None:
    right = check(DRIVE.lines())
    assert right.findings == () and (right.poses, right.expected) == (120, 120)
    assert right.lines() == ["120 poses of 120 queries: no problem found"]
    for mistake in ("inverted", "wxyz"):
        (error,) = check(DRIVE.lines(mistake)).findings
        assert error.severity == "error" and error.kind == mistake
    # between keyframes some metres apart a car hardly turns: what cannot be told apart is said
    (error,) = check(DRIVE.lines("centre")).findings
    assert "centre stands where the translation belongs" in error.message
    few = replace(DRIVE.reference, pairs=DRIVE.reference.pairs[:12])
    assert told(check(DRIVE.lines()[:12], few)) in ([], [("note", "undecided")])
    assert told(check(DRIVE.lines("wxyz")[:12], few)) == [("error", "wxyz")]


def test_absolute_poses_in_an_mlad_file(check: Check) -> None:
    cameras = DRIVE.reference.cameras
    quats = Rotation.from_quat(np.roll(cameras.quats, -1, axis=1))
    translations = -quats.apply(cameras.centers)
    images = DRIVE.reference.cameras.images
    chosen = [images.index(pair.reference) for pair in DRIVE.reference.pairs]
    rows = [
        f"{pair} {' '.join(repr(float(v)) for v in (*translations[i], *quats.as_quat()[i]))}\n"
        for pair, i in zip(DRIVE.stamps, chosen, strict=True)
    ]
    (error,) = check(rows).findings
    assert error.kind == "absolute"


def test_rows_of_an_mlad_file(check: Check) -> None:
    lines = DRIVE.lines()
    missing = check(lines[1:])
    assert told(missing) == [("error", "missing")] and missing.has_problems
    swapped = [" ".join([b, a, rest]) for a, b, rest in (line.split(" ", 2) for line in lines)]
    assert told(check(swapped)) == [("error", "swapped")]
    assert told(check(lines[::-1])) == [("note", "order")]
    named = check(lines, name="mine.txt")
    assert told(named) == [("error", "file-name")]
    assert "reloc_a_to_b.txt" in named.findings[0].message


def test_dummies_are_noted_and_prove_nothing(check: Check) -> None:
    lines = DRIVE.lines()
    lines[3:9] = [f"{pair} 0 0 0 0 0 0 1\n" for pair in DRIVE.stamps[3:9]]
    report = check(lines)
    assert told(report) == [("note", "dummies")] and len(report.findings[0].names) == 6
    allowed = check([f"{pair} 0 0 0 0 0 0 1\n" for pair in DRIVE.stamps])
    assert told(allowed) == [("note", "dummies")]


def test_a_folder_of_mlad_files(tmp_path: Path, check: Check) -> None:
    asked = DRIVE.reference.pairs
    second = [replace(pair, file="second.txt") for pair in asked[60:]]
    both = replace(DRIVE.reference, pairs=(*asked[:60], *second))
    folder = tmp_path / "submission"
    folder.mkdir()

    def with_file(name: str, lines: Sequence[str]) -> CheckReport:
        (folder / name).write_text("".join(lines))
        return check_submission(folder, dataset="4seasons", reference=both)

    report = with_file("reloc_a_to_b.txt", DRIVE.lines()[:60])
    assert told(report) == [("error", "missing-file")]
    report = with_file("second.txt", DRIVE.lines()[60:])
    assert not report.findings and report.poses == 120
    assert told(with_file("third.txt", [])) == [("warning", "unknown-file")]
    report = with_file("second.txt", ["1 2 3\n"])
    assert "error: second.txt:1: 3 columns instead of 9" in "\n".join(report.lines())
    (tmp_path / "empty").mkdir()
    for name, dataset, words in (
        ("empty", "4seasons", "no pose file"),
        ("empty", "kapture", "one file"),
        ("absent.txt", "kapture", "cannot read"),
    ):
        with pytest.raises(DataError, match=words):
            check_submission(tmp_path / name, dataset=dataset)
    with pytest.raises(DataError, match="no imported dataset"):
        read_reference(tmp_path)


def test_a_file_alone_or_empty(check: Check) -> None:
    report = check(DRIVE.lines(), None)
    assert told(report) == [("note", "not-checked")] * 2 and not report.has_problems
    report = check(["a.jpg 1 0 0 0 0 0 0\n"], None, dataset="robotcar")
    assert told(report) == [("error", "name-folder"), *[("note", "not-checked")] * 2]
    assert "give one with --data" in report.lines()[1]
    report = check(DRIVE.lines(), replace(DRIVE.reference, cameras=None))
    assert told(report) == [("note", "not-checked")]
    for content in ("", "\n\n"):
        assert ("error", "empty") in told(check([content]))
        assert ("error", "empty") in told(check([content], None, dataset="kapture"))


def test_reports_are_short_as_text_and_whole_as_json() -> None:
    findings = tuple(
        Finding("error", "columns", f"broken {line}", file="x.txt", line=line)
        for line in range(30, 0, -1)
    )
    note = Finding("note", "order", "in another order", file="x.txt")
    warning = Finding("warning", "far", "far away", file="x.txt", names=("a", "b"))
    told = {"dataset": "aachen", "file": "x.txt", "reference": "", "poses": 5, "expected": None}
    report = CheckReport(**told, findings=(note, *findings, warning))
    lines = report.lines()
    assert lines[0] == "error: x.txt:1: broken 1" and lines[9] == "error: x.txt:10: broken 10"
    assert lines[10:] == [
        "warning: x.txt: far away",
        "note: x.txt: in another order",
        "error: 20 more of kind 'columns'; --json lists all",
        "5 poses: 30 problems found, 1 warning",
    ]
    content = json.loads(json.dumps(report.to_json()))
    assert content["ok"] is False and len(content["findings"]) == 32
    assert content["findings"][0]["line"] == 1 and content["findings"][30]["names"] == ["a", "b"]


@given(st.binary(max_size=60), st.integers(0, 4000))
def test_random_damage_never_crashes(
    tmp_path_factory: pytest.TempPathFactory, junk: bytes, place: int
) -> None:
    path = tmp_path_factory.getbasetemp() / "reloc_a_to_b.txt"
    good = "".join(DRIVE.lines()[:20]).encode()
    path.write_bytes(good[:place] + junk + good[place:])
    try:
        report = check_submission(path, dataset="4seasons", reference=DRIVE.reference)
    except DataError as error:
        assert str(path) in str(error) and "\n" not in str(error)
    else:
        assert report.lines() and json.dumps(report.to_json(), allow_nan=False)


ROBOTCAR = {
    f"rear/{100 + i}.jpg": f"{c}/rear/{100 + i}.jpg" for i, c in enumerate(["dawn", "night"] * 3)
}
CAMERAS = [
    image.replace("/rear/", f"/{side}/")
    for image in ROBOTCAR.values()
    for side in ("left", "rear", "right")
]
AACHEN = {f"IMG_{i}.jpg": f"query/day/nexus4/IMG_{i}.jpg" for i in range(5)}


class NamedRows(NamedTuple):
    images: Mapping[str, str]
    findings: list[Finding]


def match(
    names: Sequence[str],
    expected: Mapping[str, str],
    *,
    queries: Sequence[str] = (),
    groups: Mapping[str, ImageGroup] | None = None,
    dataset: str = "aachen",
    listed: bool = True,
) -> NamedRows:
    named: dict[str, int] = {}
    for line, name in enumerate(names, start=1):
        named.setdefault(name, line)
    reference = Reference(
        folder="import",
        expected=expected,
        queries=frozenset(queries or expected.values()),
        groups=groups or {},
        names={image: name for name, image in expected.items()} if listed else {},
    )
    return NamedRows(*match_names(named, reference, dataset))


def kinds_of(found: NamedRows) -> list[tuple[str, str]]:
    return [(finding.severity, finding.kind) for finding in found.findings]


def only(found: NamedRows) -> Finding:
    (finding,) = found.findings
    return finding


def test_all_three_cameras_of_robotcar() -> None:
    names = [image.split("/", 1)[1] for image in CAMERAS]
    finding = only(match(names, ROBOTCAR, queries=CAMERAS, dataset="robotcar"))
    assert (finding.severity, finding.kind) == ("note", "not-scored")
    assert len(finding.names) == 12 and "left/100.jpg" in finding.message


@pytest.mark.parametrize(
    ("names", "expected", "kind", "words"),
    [
        (
            [name.removeprefix("rear/") for name in ROBOTCAR],
            ROBOTCAR,
            "name-folder",
            "6 names without the folder before them: 100.jpg should be rear/100.jpg; the server "
            "finds none of them, and every figure is zero",
        ),
        (AACHEN.values(), AACHEN, "name-path", "query/day/nexus4/IMG_0.jpg should be IMG_0.jpg"),
        ([f"./{name}" for name in AACHEN], AACHEN, "name-path", "./IMG_0.jpg should be IMG_0.jpg"),
        ([f"/{name}" for name in AACHEN], AACHEN, "name-path", "/IMG_0.jpg should be IMG_0.jpg"),
        (
            [f"{image.removesuffix('.jpg')}.PNG" for image in AACHEN.values()],
            AACHEN,
            "name-path",
            "more of the path than the list and ending in '.PNG' instead of '.jpg'",
        ),
        (
            [name.replace(".jpg", ".JPG") for name in AACHEN],
            AACHEN,
            "name-letters",
            "upper and lower case",
        ),
        (
            [f"phones/{name}" for name in AACHEN],
            {f"q/{name}": image for name, image in AACHEN.items()},
            "name-folders",
            "phones/IMG_0.jpg should be q/IMG_0.jpg",
        ),
    ],
    ids=["no folder", "path", "./", "/", "path and ending", "letters", "other folder"],
)
def test_names_that_are_wrong_in_one_way(
    names: Iterable[str], expected: Mapping[str, str], kind: str, words: str
) -> None:
    found = match(list(names), expected, queries=CAMERAS if expected is ROBOTCAR else ())
    finding = only(found)
    assert (finding.severity, finding.kind) == ("error", kind) and words in finding.message
    assert list(found.images.values()) == list(expected.values())


@pytest.mark.parametrize(("dataset", "severity"), [("robotcar", "warning"), ("aachen", "error")])
def test_the_other_ending(dataset: str, severity: str) -> None:
    names = [name.replace(".jpg", ".png") for name in ROBOTCAR]
    finding = only(match(names, ROBOTCAR, queries=CAMERAS, dataset=dataset))
    assert (finding.severity, finding.kind) == (severity, "name-ending")
    words = "ending in '.png' instead of '.jpg': rear/100.png should be rear/100.jpg"
    assert words in finding.message


def test_unknown_and_missing_names() -> None:
    found = match(["IMG_0.jpg", "else.jpg", "IMG_1.jpg", "more.jpg"], AACHEN)
    unknown = [finding for finding in found.findings if finding.kind == "unknown"]
    assert [(f.line, f.names, f.severity) for f in unknown] == [
        (2, ("else.jpg",), "error"),
        (4, ("more.jpg",), "error"),
    ]
    missing = found.findings[-1]
    assert (missing.severity, missing.kind) == ("warning", "missing")
    assert missing.message.startswith("3 of 5 queries have no row")
    assert missing.names == ("IMG_2.jpg", "IMG_3.jpg", "IMG_4.jpg")
    # a condition that is missing as a whole
    groups = {image: ImageGroup(condition=image.split("/")[0]) for image in ROBOTCAR.values()}
    names = [name for name, image in ROBOTCAR.items() if image.startswith("dawn")][:2]
    finding = only(match(names, ROBOTCAR, queries=CAMERAS, groups=groups, dataset="robotcar"))
    assert finding.message.endswith("there is no row at all of condition night")


def test_nothing_of_the_list() -> None:
    found = match(["x.jpg"], AACHEN)
    assert kinds_of(found) == [("error", "unknown"), ("error", "missing")]
    assert kinds_of(match([], AACHEN)) == [("error", "missing")]


def test_one_query_under_two_names() -> None:
    found = match([*AACHEN, "query/day/nexus4/IMG_3.jpg"], AACHEN)
    assert kinds_of(found) == [("error", "name-path"), ("error", "duplicate")]
    double = found.findings[1]
    assert double.line == 6 and "IMG_3.jpg (line 4)" in double.message


def test_order_is_a_note_and_only_where_there_is_one() -> None:
    right = match(list(AACHEN), AACHEN)
    assert right.images == AACHEN and not right.findings
    backwards = list(AACHEN)[::-1]
    assert kinds_of(match(backwards, AACHEN)) == [("note", "order")]
    assert not match(backwards, AACHEN, listed=False).findings


def test_a_stem_that_several_names_share_is_unknown() -> None:
    expected = {"a/1.jpg": "a/1.jpg", "b/1.jpg": "b/1.jpg"}
    assert kinds_of(match(["1.jpg"], expected))[0] == ("error", "unknown")
    assert match(["b/1.png"], expected).images == {"b/1.png": "b/1.jpg"}


@pytest.mark.parametrize(
    ("dataset", "name", "kinds"),
    [
        ("robotcar", "1418.jpg", ["name-folder"]),
        ("robotcar", "rear/1418.tif", ["name-ending"]),
        ("aachen", "query/IMG.jpg", ["name-path"]),
        ("inloc", "IMG_0801.jpg", ["name-ending"]),
        ("robotcar", "rear/1.png", []),
        ("aachen", "a.jpg", []),
        ("inloc", "A.JPG", []),
        ("kapture", "a/b.tif", []),
    ],
)
def test_what_names_alone_show(dataset: str, name: str, kinds: list[str]) -> None:
    assert [finding.kind for finding in check_shape({name: 1}, dataset)] == kinds


def test_pairs() -> None:
    pairs = ["1 10", "2 20", "3 30"]
    assert match_pairs({"1 10": 1, "2 20": 2, "3 30": 3}, pairs) == (False, [])
    swapped, findings = match_pairs({"10 1": 1, "20 2": 2, "30 3": 3}, pairs)
    assert swapped and [f.kind for f in findings] == ["swapped"]
    swapped, findings = match_pairs({"3 30": 1, "1 10": 2, "2 30": 3}, pairs)
    assert not swapped
    assert [(f.severity, f.kind, f.line) for f in findings] == [
        ("error", "unknown", 3),
        ("error", "missing", None),
        ("note", "order", None),
    ]
    assert findings[1].names == ("2 20",)
