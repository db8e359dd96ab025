"""``megloc map``, ``refine-map`` and ``refine-poses`` as their users meet them."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from kapture.io.csv import kapture_from_dir

from megloc_kapture.cli.main import main
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.kapture.points import read_point_covariances
from megloc_kapture.io.tables import read_status
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.service.server import map_overview
from tests.cli.foreign import FOREIGN_MAPS

FEW = ("--set", "local_features.options.max_keypoints=700", "--executor", "inline")


@pytest.fixture(scope="module")
def unposed(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``photos/``, and ``map``, the workspace made of them."""
    root: Path = tmp_path_factory.mktemp("unposed")
    (root / "photos").mkdir()
    for image in (scene / "mapping" / "sensors" / "records_data").iterdir():
        shutil.copyfile(image, root / "photos" / image.name)
    with pytest.raises(SystemExit) as end:
        main(["map", str(root / "photos"), "-o", str(root / "map"), *FEW])
    assert end.value.code == 0
    return root


def test_what_is_done_is_kept(megloc: Any, unposed: Path) -> None:
    done = megloc("map", unposed / "photos", "-o", unposed / "map", *FEW)
    assert done.status == 0
    assert done.out.splitlines() == [
        f"map of 7 of 7 photographs: {unposed / 'map' / 'map'}",
        "the map is in arbitrary units, not metres; --scale IMAGE IMAGE METRES sets the scale",
    ]
    assert done.err.count("up to date") == 9


def test_a_workspace_stands_for_its_map(megloc: Any, unposed: Path, tmp_path: Path) -> None:
    for name, place in (("workspace", unposed / "map"), ("map", unposed / "map" / "map")):
        done = megloc("refine-map", "-i", place, "-o", tmp_path / name)
        assert done.status == 0, done.err
    for part in ("points3d.txt", "observations.txt"):
        one, other = (tmp_path / n / "reconstruction" / part for n in ("workspace", "map"))
        assert one.read_bytes() == other.read_bytes()


def test_every_command_says_units(
    megloc: Any, unposed: Path, scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    workspace, localized = unposed / "map", tmp_path / "localized"
    assert "unit              units of the map" in megloc("info", workspace).out
    query = scene / "query" / "sensors" / "records_data"
    done = megloc("localize", "-i", workspace, "--images", query, "-o", localized)
    assert done.status == 0 and "4 of 4 queries" in done.out
    assert "positions are in units of the map" in done.err
    done = megloc("evaluate", "-i", localized, "-o", tmp_path / "report")
    assert done.status == 0 and " m\n" not in done.out
    truth = ("--gt", scene / "query_gt")
    done = megloc("evaluate", "-i", localized, *truth)
    assert "0.0 / 0.0" in done.out and "after a similarity of scale" in done.out
    assert "units of a map of unknown scale" in caplog.text
    done = megloc("evaluate", "-i", localized, *truth, "--align", "sim3")
    assert "4 of 4 poses" in done.out and "100.0" in done.out
    assert json.loads(map_overview(KaptureMap.open(workspace / "map")))["unit"] == "units"


def test_a_model_of_unknown_scale(megloc: Any, colmap_room: Path, tmp_path: Path) -> None:
    for unit, told in (((), "units of the map"), (("--unit", "m"), "metres")):
        folder = tmp_path / told
        assert megloc("import", "colmap", colmap_room, "-o", folder, *unit).status == 0
        assert f"unit              {told}" in megloc("info", folder).out


def test_a_known_camera_stays(megloc: Any, unposed: Path, tmp_path: Path) -> None:
    camera = "PINHOLE,400,300,300,302,200,150"
    done = megloc("map", unposed / "photos", "-o", tmp_path / "map", "--camera", camera, *FEW)
    assert done.status == 0, done.err
    found = KaptureMap.open(tmp_path / "map" / "map").camera("0000.jpg")
    assert (found.model, found.params) == ("PINHOLE", (300.0, 302.0, 200.0, 150.0))


def rows_of(text: str) -> dict[str, tuple[int, int]]:
    """The table's rows: points and observations by name."""
    found = re.findall(r"(before|after|[a-z]+(?: [a-z]+)?) +(-?\d+) +(-?\d+)$", text, re.MULTILINE)
    return {name: (int(points), int(seen)) for name, points, seen in found}


@pytest.mark.parametrize("given", FOREIGN_MAPS)
def test_a_foreign_map_is_refined_and_localized_in(
    megloc: Any,
    request: pytest.FixtureRequest,
    tmp_path: Path,
    contents: Callable[[Path], Any],
    given: str,
) -> None:
    place = request.getfixturevalue(given)
    before = contents(place)
    out = tmp_path / "refined"
    keep = ("--set", "refinement.uncertainty.max_robust_sigmas=1")
    told = megloc("info", place / "map").out
    assert "refinement" not in told and "uncertainty" not in told
    done = megloc("refine-map", "-i", place / "map", "-o", out, *keep)
    assert done.status == 0
    assert contents(place) == before
    told = megloc("info", out).out
    rows = rows_of(told)
    assert rows == rows_of(done.err)
    assert list(rows) == ["before", "uncertainty", "after"]
    sums = np.array(list(rows.values()))
    np.testing.assert_array_equal(sums[:-1].sum(axis=0), sums[-1])
    assert (sums[1:-1] < 0).any(axis=0).all()
    old, new = KaptureFolder(place / "map"), KaptureFolder(out)
    assert rows["before"] == (len(old.points3d()), sum(map(len, old.observations().values())))
    assert rows["after"] == (len(new.points3d()), sum(map(len, new.observations().values())))
    left = {tuple(row) for row in new.points3d().tolist()}
    assert left < {tuple(row) for row in old.points3d().tolist()}
    covariances = read_point_covariances(out, len(new.points3d()))
    assert covariances is not None
    known = int(np.isfinite(covariances).all(axis=1).sum())
    assert f"known for {known} points" in told
    theirs = kapture_from_dir(str(out))
    assert len(theirs.points3d) == len(new.points3d())
    localized = megloc("localize", "-i", out, "--query", place / "query", "-o", tmp_path / "poses")
    assert localized.out.startswith("4 of 4 queries localized in ")


def refine_poses(finished: Path, poses: Path, output: Path) -> list[Any]:
    places = ["-i", finished / "map", "--query", finished / "query", "--poses", poses]
    return ["refine-poses", *places, "-o", output, "--executor", "inline"]


def test_poses_without_depth_stay_and_say_so(megloc: Any, finished: Path, tmp_path: Path) -> None:
    out, poses = tmp_path / "refined", finished / "localized"
    done = megloc(*refine_poses(finished, poses, out), "--by", "icp", "-q")
    assert (done.status, done.err) == (0, "")
    assert done.out.startswith("4 queries, 0 accepted by icp; status.csv and refinement.csv in")
    before, after = (KaptureFolder(place).read().poses() for place in (poses, out))
    assert before == after
    assert {row.status for row in read_status(out / "status.csv").values()} == {"localized"}
    for text in pandas.read_csv(out / "status.csv")["refinement"]:
        assert text.startswith("icp: ") and "depth" in text
    # the result is one to refine again, by one refiner after another
    both = ("--by", "icp", "--by", "rendering")
    done = megloc(*refine_poses(finished, out, tmp_path / "again"), *both, "-q")
    assert done.out.startswith("4 queries, 0 accepted by icp, 0 accepted by rendering, ")
    for text in pandas.read_csv(tmp_path / "again" / "status.csv")["refinement"]:
        first, second = text.split("; ")[-2:]
        assert first.startswith("icp: ") and second.startswith("rendering: ")
    command = refine_poses(finished, poses, tmp_path / "none")
    for by, words in (
        ((), "no pose refiner is chosen; give --by: field, icp, rendering"),
        (
            ("--by", "magic"),
            "no plugin 'magic' in megloc_kapture.pose_refiners; registered: field, icp, rendering",
        ),
        (("--by", "field"), "train-field"),
    ):
        megloc(*command, *by).refused(words)
    bare = refine_poses(finished, finished / "query", tmp_path / "none")
    megloc(*bare, "--by", "icp").refused(r"status\.csv")
    assert not (tmp_path / "none").exists()
