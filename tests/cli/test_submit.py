"""``megloc submit`` as its users meet it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.evaluation.pose_files import read_pose_file
from megloc_kapture.io.dataset_tables import (
    Protocol,
    RelocalizationPair,
    write_protocol,
    write_relocalization,
)
from megloc_kapture.io.kapture import KaptureFolder, write_sensors
from megloc_kapture.io.tables import QueryStatus, write_status


@pytest.fixture
def imported(scene: Path, tmp_path: Path) -> Path:
    """An imported scene and a result in it: the true poses of all but one query."""
    root = tmp_path / "imported"
    for part in ("mapping", "query"):
        write_sensors(root / part, KaptureFolder(scene / part).read())
    truth = KaptureFolder(scene / "query_gt").read()
    images = truth.image_names()
    truth.trajectories.pop(truth.record_of(images[0]))
    write_sensors(root / "localized", truth)
    failed = {"status": "failed", "reason": "no matches"}
    rows = [
        QueryStatus(image=images[0], **failed),
        QueryStatus(image=images[1], fallback="retrieval", **failed),
        *(QueryStatus(image=image, status="localized") for image in images[2:]),
    ]
    write_status(root / "localized" / "status.csv", rows)
    write_protocol(root / "megloc", Protocol(dataset="aachen", pose_file_names="basename"))
    return root


def test_what_is_told(megloc: Any, imported: Path, tmp_path: Path) -> None:
    place = tmp_path / "poses.txt"
    done = megloc("submit", "aachen", "-i", imported / "localized", "-o", place)
    assert (done.status, done.err) == (0, "")
    assert done.out == f"3 poses of 4 queries, 1 missing, 1 of the poses guessed: {place}\n"
    assert len(read_pose_file(place)) == 3
    beside = json.loads(place.with_name("poses.txt.json").read_text())
    assert beside["dataset"] == "aachen" and beside["counts"]["missing"] == 1
    megloc("submit", "aachen", "-i", imported / "localized", "-o", place).refused("exists; -f")
    again = megloc("submit", "synthetic-aachen", "-i", imported / "localized", "-o", place, "-f")
    assert again.status == 0


def test_side_tables_of_elsewhere(megloc: Any, imported: Path, tmp_path: Path) -> None:
    result = tmp_path / "elsewhere" / "result"
    shutil.copytree(imported / "localized", result, symlinks=True)
    command = ["submit", "aachen", "-i", result, "-o", tmp_path / "poses.txt"]
    megloc(*command).refused("rules of aachen stand in the megloc/ folder", "--side-tables")
    done = megloc(*command, "--side-tables", imported / "megloc")
    assert done.out.startswith("3 poses of 4 queries")
    megloc(*command, "--side-tables", tmp_path / "nowhere").refused("nowhere: no such folder")
    assert megloc("submit", "kapture", *command[2:], "-f").out.startswith("3 poses of 4 queries")


def test_refusals(megloc: Any, imported: Path, tmp_path: Path) -> None:
    result, place = imported / "localized", tmp_path / "poses.txt"
    megloc("submit", "robotcar", "-i", result, "-o", place).refused(
        "dataset robotcar is asked for", "protocol.json is of dataset aachen"
    )
    megloc("submit", "cambridge", "-i", result, "-o", place).refused(
        "unknown dataset 'cambridge'; known: kapture"
    )
    megloc("submit", "aachen", "-i", result, "-o", place, "--from-rig").refused("rigs.txt")
    megloc("submit", "aachen", "-i", result, "-o", tmp_path).refused("is not what is to be written")
    assert not place.exists()


def test_mlad_goes_to_a_folder(megloc: Any, imported: Path, tmp_path: Path) -> None:
    write_protocol(imported / "megloc", Protocol(dataset="4seasons", pose_file="mlad"))
    mapping = KaptureFolder(imported / "mapping").read()
    for part in ("mapping", "query", "localized"):
        data = KaptureFolder(imported / part).read()
        data.records_camera = {
            key: f"{int(name.removesuffix('.jpg')) + 1}.png"
            for key, name in data.records_camera.items()
        }
        write_sensors(imported / part, data)
    (imported / "localized" / "status.csv").unlink()
    reference = KaptureFolder(imported / "mapping").read().image_names()[0]
    queries = KaptureFolder(imported / "query").read().image_names()
    assert len(mapping.records_camera) == 7
    pairs = [RelocalizationPair("a_to_b.txt", reference, query) for query in queries]
    write_relocalization(imported / "megloc", pairs)
    place = tmp_path / "submission"
    command = ["submit", "4seasons", "-i", imported / "localized", "-o", place]
    done = megloc(*command)
    assert done.out == f"3 poses of 4 queries, 1 missing, dummies in their place: {place}\n"
    assert sorted(path.name for path in tmp_path.glob("submission*")) == [
        "submission",
        "submission.json",
    ]
    assert [path.name for path in place.iterdir()] == ["a_to_b.txt"]
    megloc(*command).refused("exists; -f")
    assert megloc(*command, "-f").status == 0
    (tmp_path / "file").write_text("")
    megloc(*command[:-1], tmp_path / "file").refused("a folder, one file per relocalization file")
