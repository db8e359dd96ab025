"""Mistakes in data: one line that names the file, exit status 2, nothing written or changed."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.io.images import write_image
from tests.cli.foreign import DESCRIPTORS, rename_type
from tests.worlds import folder_bytes

Damage = Callable[[Path], Any]

POSES = "mapping/sensors/trajectories.txt"
IMAGE = "mapping/sensors/records_data/0005.jpg"


def keep_first_bytes(path: Path, size: int) -> None:
    path.write_bytes(path.read_bytes()[:size])


def pose_without_its_last_column(root: Path) -> None:
    rows = (root / POSES).read_text().splitlines()
    rows[3] = rows[3].rpartition(",")[0]
    (root / POSES).write_text("\n".join(rows) + "\n")


def image_of_another_size(root: Path) -> None:
    write_image(root / IMAGE, np.zeros((100, 200, 3), np.uint8))


DATASETS: dict[str, tuple[Damage, str]] = {
    "missing image": (lambda root: (root / IMAGE).unlink(), r"records_data/0005\.jpg: "),
    "image of another size": (image_of_another_size, r"records_data/0005\.jpg: .*200x100.*400x300"),
    "wrong column count": (pose_without_its_last_column, r"mapping/.*trajectories\.txt:4: "),
}


@pytest.mark.parametrize(("damage", "message"), DATASETS.values(), ids=DATASETS)
def test_a_damaged_dataset_is_refused(
    megloc: Any, dataset: Path, damage: Damage, message: str
) -> None:
    damage(dataset)
    before = folder_bytes(dataset)
    new = dataset.parent / "new"
    megloc("import", "kapture", dataset, "-o", new / "imported").refused(message)
    assert not any(new.glob("*"))
    assert folder_bytes(dataset) == before


def test_a_truncated_map_image_is_refused_when_it_is_read(megloc: Any, dataset: Path) -> None:
    keep_first_bytes(dataset / IMAGE, 2000)
    run = ("-w", dataset.parent / "run", "--executor", "inline", "-q")
    megloc("eval", "kapture", "--root", dataset, *run).refused(r"0005\.jpg: .*broken")


def test_localize_and_info_refuse_a_damaged_map(megloc: Any, foreign: Path) -> None:
    keep_first_bytes(foreign / "map" / DESCRIPTORS / "0000.jpg.desc", 128 * 4 * 799)
    places = ("-i", foreign / "map", "--query", foreign / "query")
    message = r"0000\.jpg\.desc: 799 descriptors for 800 keypoints"
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
