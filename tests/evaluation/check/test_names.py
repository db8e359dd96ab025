"""Names and pairs of a pose file against those of the challenge: what is wrong is told."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import pytest

from megloc_kapture.evaluation.check.reading import Finding, Reference
from megloc_kapture.evaluation.check.submission import check_shape, match_names, match_pairs
from megloc_kapture.io.dataset_tables import ImageGroup

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
        listed=listed,
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
