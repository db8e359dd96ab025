"""Bad input: one line that names the file, exit status 2, nothing written, nothing changed."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.io.images import write_image
from tests.cli.foreign import DESCRIPTORS, GLOBAL, KEYPOINTS, rename_type

Contents = Callable[[Path], dict[str, bytes]]
Spoil = Callable[[Path], Any]

TIMES = "sensors/trajectories.txt"
RECORDS = "sensors/records_camera.txt"
FIRST, QUERY = "0000.jpg", "0001.jpg"


def cut(name: str, size: int = -2) -> Spoil:
    """Leave only so many bytes of a file."""
    return lambda root: (root / name).write_bytes((root / name).read_bytes()[:size])


def remove(name: str) -> Spoil:
    return lambda root: (root / name).unlink()


def line(name: str, number: int, change: Callable[[str], str]) -> Spoil:
    """Change one line of a text file, counted from 1."""

    def spoil(root: Path) -> None:
        lines = (root / name).read_text().splitlines(keepends=True)
        lines[number - 1] = change(lines[number - 1])
        (root / name).write_text("".join(lines))

    return spoil


def fields(change: Callable[[list[str]], list[str]]) -> Callable[[str], str]:
    return lambda text: ", ".join(change([f.strip() for f in text.split(",")])) + "\n"


def quaternion_times(factor: float) -> Callable[[str], str]:
    return fields(lambda f: [*f[:2], *(repr(factor * float(q)) for q in f[2:6]), *f[6:]])


def again(number: int) -> Callable[[Path], Any]:
    """Repeat a line of the trajectories."""
    return line(TIMES, number, lambda text: text + text)


def point_past(root: Path) -> None:
    """The first point that is not there is observed."""
    rows = (root / "reconstruction/points3d.txt").read_text().splitlines()
    number = sum(not row.startswith("#") for row in rows)
    change = fields(lambda f: [str(number), *f[1:]])
    line("reconstruction/observations.txt", 9, change)(root)


NO_COLUMN = fields(lambda f: f[:-1])
NAN = fields(lambda f: [*f[:-1], "nan"])
UPWARDS = fields(lambda f: [*f[:2], "../../" + f[2]])
PAST = fields(lambda f: [*f[:-1], "800"])

# of the map: how to spoil it, and what the message has to say
MAPS: dict[str, tuple[Spoil, str]] = {
    "no sensors.txt": (remove("sensors/sensors.txt"), r"map/sensors/sensors\.txt: "),
    "keypoints cut": (cut(f"{KEYPOINTS}/{FIRST}.kpt"), r"0000\.jpg\.kpt: .*truncated"),
    "keypoints missing": (
        remove(f"{KEYPOINTS}/{FIRST}.kpt"),
        r"observations\.txt: points are observed in '.*0000\.jpg', which has no keypoints",
    ),
    "descriptors cut": (cut(f"{DESCRIPTORS}/{FIRST}.desc"), r"0000\.jpg\.desc: .*truncated"),
    "global cut": (cut(f"{GLOBAL}/{FIRST}.gfeat"), r"0000\.jpg\.gfeat: .*truncated"),
    "lengths differ": (
        cut(f"{DESCRIPTORS}/{FIRST}.desc", 128 * 4 * 799),
        r"0000\.jpg\.desc: 799 descriptors for 800 keypoints",
    ),
    "sensor column": (line("sensors/sensors.txt", 3, NO_COLUMN), r"sensors\.txt:3: "),
    "pose column": (line(TIMES, 4, NO_COLUMN), r"trajectories\.txt:4: .*columns"),
    "record column": (line(RECORDS, 5, NO_COLUMN), r"records_camera\.txt:5: .*columns"),
    "point column": (
        line("reconstruction/points3d.txt", 10, NO_COLUMN),
        r"points3d\.txt:10: .*columns",
    ),
    "observation column": (
        line("reconstruction/observations.txt", 7, NO_COLUMN),
        r"observations\.txt:7: ",
    ),
    "config column": (line(f"{KEYPOINTS}/keypoints.txt", 3, NO_COLUMN), r"keypoints\.txt:3: "),
    "pose of nan": (line(TIMES, 3, NAN), r"trajectories\.txt:3: .*nan"),
    "pose not unit": (
        line(TIMES, 3, quaternion_times(1.002)),
        r"trajectories\.txt:3: .*unit quaternion",
    ),
    "pose twice": (again(4), r"trajectories\.txt:5: .*listed twice"),
    "record twice": (
        line(RECORDS, 4, lambda text: text + text.replace(".jpg", "_b.jpg")),
        r"records_camera\.txt:5: timestamp .*listed twice",
    ),
    "path upwards": (line(RECORDS, 3, UPWARDS), r"records_camera\.txt:3: .*'\.\.'"),
    "keypoint past the end": (
        line("reconstruction/observations.txt", 9, PAST),
        r"observations\.txt: point \d+, keypoint 800 of .* and 800 keypoints of type",
    ),
    "point past the end": (
        point_past,
        r"observations\.txt: point (\d+), keypoint .*: there are \1 points",
    ),
}


def localize(foreign: Path) -> list[str | Path]:
    places: list[str | Path] = ["-i", foreign / "map", "--query", foreign / "query"]
    return ["localize", *places, "-o", foreign.parent / "new" / "localized"]


@pytest.mark.parametrize(("spoil", "message"), MAPS.values(), ids=MAPS)
def test_localize_refuses_a_bad_map_and_info_finds_the_same_fault(
    megloc: Any, foreign: Path, contents: Contents, spoil: Spoil, message: str
) -> None:
    spoil(foreign / "map")
    before = contents(foreign)
    megloc(*localize(foreign)).refused(message)
    assert not (foreign.parent / "new").exists()
    done = megloc("info", foreign / "map")
    assert done.status == 2
    if "no keypoints" in message:
        message = r"0000\.jpg\.desc: image .* has descriptors but no keypoints"
    assert re.fullmatch(f"megloc: .*{message}.*\n", done.err)
    assert contents(foreign) == before


QUERIES: dict[str, tuple[Spoil, str]] = {
    "no records": (remove(RECORDS), r"query: there are no query images"),
    "no features of one": (
        remove(f"{KEYPOINTS}/{QUERY}.kpt"),
        r"the weights r2d2_WASF_N16 are missing.*megloc weights fetch r2d2_WASF_N16",
    ),
    "other descriptors": (
        line(f"{DESCRIPTORS}/descriptors.txt", 3, lambda text: text.replace("128", "64")),
        r"00\d+\.jpg\.desc: .*descriptors for|64 values, the map's 128",
    ),
    "path upwards": (line(RECORDS, 3, UPWARDS), r"records_camera\.txt:3: .*'\.\.'"),
    "camera": (line("sensors/sensors.txt", 3, NO_COLUMN), r"sensors\.txt:3: "),
}


@pytest.mark.parametrize(("spoil", "message"), QUERIES.values(), ids=QUERIES)
def test_localize_refuses_bad_queries(
    megloc: Any, foreign: Path, spoil: Spoil, message: str
) -> None:
    spoil(foreign / "query")
    megloc(*localize(foreign)).refused(message)
    assert not (foreign.parent / "new").exists()


def test_features_that_nobody_can_extract(megloc: Any, foreign: Path) -> None:
    rename_type(foreign)
    told = megloc("info", foreign / "map").out
    assert "must be given in kapture: no extractor for orb_800" in told
    keypoints = foreign / "query" / "reconstruction" / "keypoints" / "orb_800" / f"{QUERY}.kpt"
    keypoints.unlink()
    message = r"image '.*0001\.jpg': features of type 'orb_800' are missing and no extractor"
    megloc(*localize(foreign)).refused(message)
    # nor those of the map again
    shutil.rmtree(foreign / "map" / "reconstruction" / "descriptors")
    megloc(*localize(foreign)).refused(r"/map: .*'orb_800'", "no extractor")
    assert not (foreign.parent / "new").exists()
    told = megloc("info", foreign / "map").out
    assert re.search("map descriptors .*no extractor .*not possible", told)


def test_quaternions_almost_of_unit_length_are_normalised(
    megloc: Any, foreign: Path, contents: Contents
) -> None:
    megloc(*localize(foreign))
    place = foreign.parent / "new" / "localized"
    expected = contents(place / "sensors")["trajectories.txt"]
    line(TIMES, 3, quaternion_times(1.0009))(foreign / "map")
    assert megloc(*localize(foreign)).status == 0
    assert contents(place / "sensors")["trajectories.txt"] == expected


SPECIAL: dict[str, tuple[list[str], str]] = {
    "no map": (["-i", "{}/nowhere"], r"/nowhere: no such kapture folder"),
    "no queries": (["--query", "{}/nowhere"], r"/nowhere: no such kapture folder"),
    "no features folder": (["--features-dir", "{}/nowhere"], r"/nowhere: no such folder"),
    "no pairs": (["--pairs", "{}/nowhere"], r"/nowhere: "),
    "strange pairs": (["--pairs", "{}/pairs.txt"], r"nowhere\.jpg, which is no image of the map"),
    "not a map": (["-i", "{}/query"], r"/query: no map to localize in"),
    "no such type": (["--keypoints-type", "sift"], r"'sift'; there are: r2d2_800"),
    "bad value": (["--set", "localization.fallback=guess"], r"option localization\.fallback"),
    "no workers": (["--workers", "0"], r"0 workers"),
}


@pytest.mark.parametrize(("change", "message"), SPECIAL.values(), ids=SPECIAL)
def test_arguments_that_cannot_be(
    megloc: Any, foreign: Path, change: list[str], message: str
) -> None:
    header = "# query_image, map_image, score\n"
    (foreign / "pairs.txt").write_text(f"{header}{QUERY}, nowhere.jpg, 1.0\n")
    megloc(*localize(foreign), *(text.format(foreign) for text in change)).refused(message)
    assert not (foreign.parent / "new").exists()


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_localize_leaves_what_others_wrote(megloc: Any, foreign: Path, kind: str) -> None:
    place = foreign.parent / "new" / "localized"
    place.parent.mkdir()
    if kind == "file":
        place.write_text("mine")
    else:
        place.mkdir()
        (place / "thesis.txt").write_text("mine")
    megloc(*localize(foreign)).refused(str(place))
    left = [str(p.relative_to(place.parent)) for p in place.parent.rglob("*")]
    assert left == (["localized"] if kind == "file" else ["localized", "localized/thesis.txt"])


# ------------------------------------------------------------------ megloc eval kapture


def eval_of(dataset: Path, run: Path) -> list[str | Path]:
    flags = ["--executor", "inline", "--quiet"]
    return ["eval", "kapture", "--root", dataset, "--workspace", run, *flags]


IMAGE = "mapping/sensors/records_data/0005.jpg"


def not_an_image(root: Path) -> None:
    (root / IMAGE).write_text("GIF? no.\n")


def other_size(root: Path) -> None:
    write_image(root / IMAGE, np.zeros((100, 200, 3), np.uint8))


DATASETS: dict[str, tuple[Spoil, str]] = {
    "no query": (remove("query/sensors/sensors.txt"), r"dataset: query/sensors/sensors\.txt"),
    "image missing": (remove(IMAGE), r"mapping/sensors/records_data/0005\.jpg: "),
    "not an image": (not_an_image, r"records_data/0005\.jpg: not an image"),
    "other size": (other_size, r"records_data/0005\.jpg: .*200x100.*400x300"),
    "pose column": (line(f"mapping/{TIMES}", 4, NO_COLUMN), r"mapping/.*trajectories\.txt:4: "),
    "true pose column": (line(f"query_gt/{TIMES}", 4, NO_COLUMN), r"query_gt/.*txt:4: "),
    "pose of nan": (line(f"mapping/{TIMES}", 3, NAN), r"mapping/.*trajectories\.txt:3: .*nan"),
    "pose not unit": (
        line(f"mapping/{TIMES}", 3, quaternion_times(0.998)),
        r"trajectories\.txt:3: .*unit quaternion",
    ),
    "record twice": (
        line(f"mapping/{RECORDS}", 4, lambda text: text + text.replace(".jpg", "_b.jpg")),
        r"records_camera\.txt:5: timestamp .*listed twice",
    ),
    "path upwards": (
        line(f"query/{RECORDS}", 3, fields(lambda f: [*f[:2], "a/../../" + f[2]])),
        r"records_camera\.txt:3: .*'\.\.'",
    ),
    "no poses": (remove(f"mapping/{TIMES}"), r"mapping: no mapping image has a pose"),
}


@pytest.mark.parametrize(("spoil", "message"), DATASETS.values(), ids=DATASETS)
@pytest.mark.parametrize("command", ["eval", "import"])
def test_a_bad_dataset_is_refused(
    megloc: Any, dataset: Path, contents: Contents, command: str, spoil: Spoil, message: str
) -> None:
    spoil(dataset)
    before = contents(dataset)
    new = dataset.parent / "new"
    arguments = {
        "eval": eval_of(dataset, new / "run"),
        "import": ["import", "kapture", dataset, "-o", new / "imported"],
    }[command]
    megloc(*arguments).refused(message)
    assert not new.exists()
    assert contents(dataset) == before


def test_a_truncated_image_of_the_map_stops_the_run_where_it_is_read(
    megloc: Any, dataset: Path
) -> None:
    cut(IMAGE, 20_000)(dataset)
    run = dataset.parent / "run"
    megloc(*eval_of(dataset, run)).refused(r"records_data/0005\.jpg: .*(broken|truncated)")
    assert not (run / "local_features").exists()
    assert [path.name for path in (run / "stages").glob("[a-z]*.json")] == ["import.json"]


def test_where_no_image_of_a_query_can_be_used_the_run_stops(megloc: Any, dataset: Path) -> None:
    for image in (dataset / "query/sensors/records_data").iterdir():
        image.write_bytes(b"")
    megloc(*eval_of(dataset, dataset.parent / "run")).refused(r"records_data/0001\.jpg: empty file")


EVALUATION: dict[str, tuple[list[str], str]] = {
    "no root": (["kapture"], r"dataset kapture needs --root"),
    "no such root": (["kapture", "--root", "{}/nowhere"], r"/nowhere: no such folder"),
    "no such dataset": (["venice"], r"unknown dataset 'venice'; known: kapture"),
    "no such stage": (["--from", "lunch"], r"no stage 'lunch'"),
    "not done": (["--from", "localization"], r"needs stage import, which has not run"),
    "no such plugin": (
        ["--set", "local_features.name=orb"],
        r"no plugin 'orb' .*registered: .*rootsift",
    ),
    "plugin's option": (
        ["--set", "local_features.options.max_keypoints=many"],
        r"'rootsift' refuses its options: .*max_keypoints",
    ),
    "no config": (["--config", "{}/x"], r"/x: "),
    "threshold": (["--thresholds", "near"], r"'near'"),
    "share": (["--fail-below", "60"], r"between 0 and 1"),
    "never judged": (
        ["--fail-below", "0.5", "--until", "import"],
        r"--fail-below needs stage evaluation",
    ),
    "prefix": (["--query-prefix", "../up"], r"'\.\.'"),
    "workers": (["--workers", "-1"], r"-1 workers"),
}


@pytest.mark.parametrize(("arguments", "message"), EVALUATION.values(), ids=EVALUATION)
def test_eval_that_cannot_be(
    megloc: Any, scene: Path, tmp_path: Path, arguments: list[str], message: str
) -> None:
    of_scene = ["kapture", "--root", "{}"] if arguments[0].startswith("--") else []
    given = [argument.format(scene) for argument in (*of_scene, *arguments)]
    megloc("eval", *given, "--workspace", tmp_path / "a" / "b", "--quiet").refused(message)
    assert list(tmp_path.iterdir()) == []


def test_fail_below_without_truth_is_refused_before_the_work(megloc: Any, dataset: Path) -> None:
    shutil.rmtree(dataset / "query_gt")
    run = dataset.parent / "run"
    arguments = ["--root", dataset, "--workspace", run, "--fail-below", "0.5"]
    megloc("eval", "kapture", *arguments).refused(r"dataset/query_gt is missing")
    assert not run.exists()


@pytest.mark.parametrize(
    "command",
    [
        "evaluate --gt {}/nowhere -i {}/query_gt",
        "evaluate --gt {}/query_gt -i {}/nowhere",
        "submit kapture -i {}/nowhere -o {}/new/poses.txt",
        "extract-local -i {}/nowhere -o {}/new",
        "extract-global -i {}/nowhere -o {}/new",
        "pairs-mapping -i {}/nowhere -o {}/new/pairs.txt",
        "pairs-query -i {}/mapping --query {}/nowhere -o {}/new/pairs.txt",
        "match -i {}/nowhere --pairs {}/pairs.txt -o {}/new",
        "triangulate -i {}/nowhere -o {}/new",
        "info {}/nowhere",
    ],
)
def test_every_command_names_what_is_missing(megloc: Any, dataset: Path, command: str) -> None:
    words = [word.replace("{}", str(dataset)) for word in command.split()]
    megloc(*words).refused("/nowhere|/mapping")
    assert not (dataset / "new").exists()


def test_a_folder_that_is_closed_to_us_is_told_in_one_line(
    megloc: Any, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def closed(path: Any, **how: Any) -> Any:
        if not isinstance(path, int) and Path(path).is_relative_to(dataset / "query"):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return real(path, **how)

    real = os.stat  # whoever runs the tests may be allowed everything
    monkeypatch.setattr(os, "stat", closed)
    arguments = ["--root", dataset, "--workspace", tmp_path / "run"]
    megloc("eval", "kapture", *arguments).refused(f"{dataset}/query.*: Permission denied")
