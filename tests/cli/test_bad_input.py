"""Bad input: one line that names the file, exit status 2, nothing written, nothing changed."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.io.images import write_image
from tests.cli.foreign import DESCRIPTORS, KEYPOINTS, rename_type

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
    "lengths differ": (
        cut(f"{DESCRIPTORS}/{FIRST}.desc", 128 * 4 * 799),
        r"0000\.jpg\.desc: 799 descriptors for 800 keypoints",
    ),
    "sensor column": (line("sensors/sensors.txt", 3, NO_COLUMN), r"sensors\.txt:3: "),
    "pose column": (line(TIMES, 4, NO_COLUMN), r"trajectories\.txt:4: .*columns"),
    "pose of nan": (line(TIMES, 3, NAN), r"trajectories\.txt:3: .*nan"),
    "pose not unit": (
        line(TIMES, 3, quaternion_times(1.002)),
        r"trajectories\.txt:3: .*unit quaternion",
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
    assert not any(new.glob("*"))
    assert contents(dataset) == before


def test_where_no_image_of_a_query_can_be_used_the_run_stops(megloc: Any, dataset: Path) -> None:
    for image in (dataset / "query/sensors/records_data").iterdir():
        image.write_bytes(b"")
    megloc(*eval_of(dataset, dataset.parent / "run")).refused(r"records_data/0001\.jpg: empty file")


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
