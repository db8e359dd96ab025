"""Mistakes in data: one line that names the file, exit status 2, nothing written or changed."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.io.images import write_image
from tests.cli.foreign import DESCRIPTORS, KEYPOINTS, rename_type

Contents = Callable[[Path], dict[str, bytes]]
Damage = Callable[[Path], Any]

SENSORS = "mapping/sensors/sensors.txt"
POSES = "mapping/sensors/trajectories.txt"
RECORDS = "query/sensors/records_camera.txt"
IMAGE = "mapping/sensors/records_data/0005.jpg"


def cut(name: str, size: int = -2) -> Damage:
    """Keep only the first bytes of a file."""
    return lambda root: (root / name).write_bytes((root / name).read_bytes()[:size])


def remove(name: str) -> Damage:
    return lambda root: (root / name).unlink()


def row(name: str, number: int, change: Callable[[list[str]], list[str]]) -> Damage:
    """Change the fields of one row of a text file; the first row is 1."""

    def damage(root: Path) -> None:
        rows = (root / name).read_text().splitlines()
        fields = [field.strip() for field in rows[number - 1].split(",")]
        rows[number - 1] = ", ".join(change(fields))
        (root / name).write_text("\n".join(rows) + "\n")

    return damage


def text_instead_of_an_image(root: Path) -> None:
    (root / IMAGE).write_text("GIF? no.\n")


def image_of_another_size(root: Path) -> None:
    write_image(root / IMAGE, np.zeros((100, 200, 3), np.uint8))


def newer_version(root: Path) -> None:
    path = root / SENSORS
    path.write_text(path.read_text().replace("# kapture format: 1.1", "# kapture format: 2.0"))


DATASETS: dict[str, tuple[Damage, str]] = {
    "missing file": (remove("query/sensors/sensors.txt"), r"dataset: query/sensors/sensors\.txt"),
    "missing image": (remove(IMAGE), r"mapping/sensors/records_data/0005\.jpg: "),
    "text instead of an image": (text_instead_of_an_image, r"records_data/0005\.jpg: not an image"),
    "image of another size": (image_of_another_size, r"records_data/0005\.jpg: .*200x100.*400x300"),
    "wrong column count": (row(POSES, 4, lambda f: f[:-1]), r"mapping/.*trajectories\.txt:4: "),
    "NaN pose": (row(POSES, 3, lambda f: [*f[:-1], "nan"]), r"trajectories\.txt:3: .*nan"),
    "zero quaternion": (
        row(POSES, 3, lambda f: [*f[:2], "0", "0", "0", "0", *f[6:]]),
        r"trajectories\.txt:3: .*unit quaternion",
    ),
    "path out of the root": (
        row(RECORDS, 3, lambda f: [*f[:2], "a/../../" + f[2]]),
        r"records_camera\.txt:3: .*'\.\.'",
    ),
    "unknown camera": (
        row(SENSORS, 3, lambda f: [*f[:3], "PINHOLLOW", *f[4:]]),
        r"sensors\.txt:3: .*'PINHOLLOW'",
    ),
    "newer version": (newer_version, r"sensors\.txt:1: .*2\.0 is not supported"),
    "no poses": (remove(POSES), r"mapping: no mapping image has a pose"),
}


@pytest.mark.parametrize(("damage", "message"), DATASETS.values(), ids=DATASETS)
def test_a_damaged_dataset_is_refused(
    megloc: Any, dataset: Path, contents: Contents, damage: Damage, message: str
) -> None:
    damage(dataset)
    before = contents(dataset)
    new = dataset.parent / "new"
    megloc("import", "kapture", dataset, "-o", new / "imported").refused(message)
    assert not any(new.glob("*"))
    assert contents(dataset) == before


def test_a_truncated_map_image_is_refused_when_it_is_read(megloc: Any, dataset: Path) -> None:
    cut(IMAGE, 2000)(dataset)
    run = ("-w", dataset.parent / "run", "--executor", "inline", "-q")
    megloc("eval", "kapture", "--root", dataset, *run).refused(r"0005\.jpg: .*broken")


MAPS: dict[str, tuple[Damage, str]] = {
    "truncated keypoints": (cut(f"{KEYPOINTS}/0000.jpg.kpt"), r"0000\.jpg\.kpt: .*truncated"),
    "fewer descriptors than keypoints": (
        cut(f"{DESCRIPTORS}/0000.jpg.desc", 128 * 4 * 799),
        r"0000\.jpg\.desc: 799 descriptors for 800 keypoints",
    ),
    "observed keypoint past the end": (
        row("reconstruction/observations.txt", 9, lambda f: [*f[:-1], "800"]),
        r"observations\.txt: point \d+, keypoint 800 of .* and 800 keypoints of type",
    ),
}


@pytest.mark.parametrize(("damage", "message"), MAPS.values(), ids=MAPS)
def test_localize_and_info_refuse_a_damaged_map(
    megloc: Any, foreign: Path, damage: Damage, message: str
) -> None:
    damage(foreign / "map")
    places = ("-i", foreign / "map", "--query", foreign / "query")
    megloc("localize", *places, "-o", foreign.parent / "localized").refused(message)
    assert not (foreign.parent / "localized").exists()
    assert megloc("info", foreign / "map").status == 2


def test_missing_features_that_no_plugin_extracts_are_named(megloc: Any, foreign: Path) -> None:
    rename_type(foreign)
    output = foreign.parent / "localized"
    localize = ("localize", "-i", foreign / "map", "--query", foreign / "query", "-o", output)
    assert "no extractor for orb_800" in megloc("info", foreign / "map").out
    (foreign / "query/reconstruction/keypoints/orb_800/0001.jpg.kpt").unlink()
    message = r"image '.*0001\.jpg': features of type 'orb_800' are missing and no extractor"
    megloc(*localize).refused(message)
    shutil.rmtree(foreign / "map" / "reconstruction" / "descriptors")
    megloc(*localize).refused(r"/map: .*'orb_800'", "no extractor")
    assert not output.exists()


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
def test_every_command_names_a_missing_folder(megloc: Any, dataset: Path, command: str) -> None:
    words = [word.replace("{}", str(dataset)) for word in command.split()]
    megloc(*words).refused("/nowhere|/mapping")
    assert not (dataset / "new").exists()
