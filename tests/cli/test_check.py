"""``megloc check`` as its users meet it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.evaluation.pose_files import write_pose_file
from megloc_kapture.io.dataset_tables import Protocol, write_protocol
from megloc_kapture.io.kapture import KaptureFolder, write_sensors
from megloc_kapture.values import RigidTransform


@pytest.fixture
def poses(scene: Path) -> dict[str, RigidTransform]:
    return KaptureFolder(scene / "query_gt").read().poses()


@pytest.fixture
def imported(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The one workspace of dataset aachen below runs/, with the scene's map."""
    monkeypatch.chdir(tmp_path)
    root = tmp_path / "runs" / "aachen-classic"
    for part in ("mapping", "query"):
        write_sensors(root / part, KaptureFolder(scene / part).read())
    write_protocol(root / "megloc", Protocol(dataset="aachen", pose_file_names="basename"))
    return root


def test_a_right_file(
    megloc: Any, imported: Path, poses: dict[str, RigidTransform], tmp_path: Path
) -> None:
    place = tmp_path / "poses.txt"
    write_pose_file(place, poses)
    done = megloc("check", "aachen", place)
    assert (done.status, done.out) == (0, "4 poses of 4 queries: no problem found\n")
    assert done.err == "compared with runs/aachen-classic\n"
    assert megloc("check", "aachen", place, "-q").err == ""
    assert megloc("check", "synthetic-aachen", place, "--data", imported).status == 0


def test_a_wrong_file(
    megloc: Any, imported: Path, poses: dict[str, RigidTransform], tmp_path: Path
) -> None:
    place = tmp_path / "poses.txt"
    write_pose_file(place, {name: pose.inverse() for name, pose in poses.items()})
    with place.open("a") as file:
        file.write("stranger.jpg 1 0 0\n0001.png 1 1 0 0 0 0 0\n")
    done = megloc("check", "aachen", place)
    assert (done.status, "compared" in done.err) == (2, True)
    first, *others, outcome = done.out.splitlines()
    assert "0001.png should be 0001.jpg" in others[0]
    assert first.startswith("error: poses.txt: the poses are inverted: they are world_from_cam")
    assert any("poses.txt:5: 4 columns instead of 8" in line for line in others)
    assert any("stranger.jpg is no name of the list" in line for line in others)
    assert "quaternion of length 1.41421, not 1" in done.out
    assert outcome.startswith("5 poses of 4 queries: ") and "problems found" in outcome
    done = megloc("check", "aachen", place, "--json")
    content = json.loads(done.out)
    assert done.status == 2 and content["ok"] is False
    assert content["findings"][0]["kind"] == "inverted"


def test_without_data_the_file_alone_is_checked(
    megloc: Any, imported: Path, poses: dict[str, RigidTransform], tmp_path: Path
) -> None:
    place = tmp_path / "poses.txt"
    write_pose_file(place, poses)
    done = megloc("check", "inloc", place)
    assert done.status == 2 and "not ending in .JPG" in done.out
    assert "the poses are not checked" in done.out
    done = megloc("check", "kapture", place)
    assert done.status == 0 and done.out.endswith("4 poses: no problem found\n")
    # a twin's run is none of the rendered world
    write_sensors(
        tmp_path / "runs" / "synthetic-aachen-classic" / "mapping",
        KaptureFolder(imported / "mapping").read(),
    )
    assert "compared" not in megloc("check", "synthetic", place).err
    (imported.parent / "aachen-megloc").mkdir()
    (imported / "mapping").rename(imported.parent / "aachen-megloc" / "mapping")
    write_sensors(imported / "mapping", KaptureFolder(imported / "query").read())
    done = megloc("check", "aachen", place)
    assert done.err.startswith("compared with none of runs/aachen-classic, runs/aachen-megloc")


def test_refusals(
    megloc: Any, imported: Path, poses: dict[str, RigidTransform], tmp_path: Path
) -> None:
    place = tmp_path / "poses.txt"
    megloc("check", "aachen", place).refused(r"poses\.txt: no such file")
    write_pose_file(place, poses)
    megloc("check", "aahcen", place).refused("unknown dataset 'aahcen'")
    megloc("check", "robotcar", place, "--data", imported).refused("is of dataset aachen")
    megloc("check", "aachen", place, "--data", tmp_path).refused("no imported dataset")
    (imported / "megloc" / "protocol.json").unlink()
    megloc("check", "aachen", place, "-q").refused("rules of aachen", "--data")
    megloc("check", "aachen", tmp_path, "--data", imported, "-q").refused("rules of aachen")
    place.write_bytes(b"\xff\xfe")
    megloc("check", "kapture", place, "-q").refused(r"poses\.txt:1: not a text file in UTF-8")
