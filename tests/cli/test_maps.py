"""``megloc map``, ``refine-map``, ``refine-poses``, ``info`` and ``import colmap``."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from colmap_workspace import write_workspace
from kapture.io.csv import kapture_from_dir

from megloc_kapture.evaluation.evaluate import evaluate
from megloc_kapture.io.dataset_tables import unit_of
from megloc_kapture.io.kapture import KaptureFolder, write_sensors
from megloc_kapture.io.tables import read_status
from megloc_kapture.pipeline.kapture_map import KaptureMap
from megloc_kapture.service.server import map_overview
from tests.pipeline.runs import run_command

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


FEW = ("--set", "local_features.options.max_keypoints=700", "--executor", "inline")


@pytest.fixture(scope="module")
def unposed(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``photos/``, and ``map``, the workspace made of them."""
    root: Path = tmp_path_factory.mktemp("unposed")
    (root / "photos").mkdir()
    for image in (scene / "mapping" / "sensors" / "records_data").iterdir():
        shutil.copyfile(image, root / "photos" / image.name)
    run_command("map", root / "photos", "-o", root / "map", *FEW)
    return root


def test_a_second_run_keeps_the_map(megloc: Any, unposed: Path) -> None:
    done = megloc("map", unposed / "photos", "-o", unposed / "map", *FEW)
    assert done.out.startswith(f"map of 7 of 7 photographs: {unposed / 'map' / 'map'}\n")
    assert done.err.count("up to date") == 9


def test_positions_in_a_map_of_unknown_scale_are_in_units_of_the_map(
    megloc: Any, unposed: Path, scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    workspace, localized = unposed / "map", tmp_path / "localized"
    assert "unit              units of the map" in megloc("info", workspace).out
    query = scene / "query" / "sensors" / "records_data"
    done = megloc("localize", "-i", workspace, "--images", query, "-o", localized)
    assert done.status == 0 and "4 of 4 queries" in done.out
    assert "positions are in units of the map" in done.err
    truth = ("--gt", scene / "query_gt")
    done = megloc("evaluate", "-i", localized, *truth)
    assert "0.0 / 0.0" in done.out and "after a similarity of scale" in done.out
    assert "units of a map of unknown scale" in caplog.text
    # of a pose file alone, the map has the unit
    caplog.clear()
    shutil.copyfile(localized / "poses.csv", tmp_path / "poses.csv")
    megloc("evaluate", "-i", tmp_path / "poses.csv", *truth, "--map", workspace / "map")
    assert "units of a map of unknown scale" in caplog.text
    done = megloc("evaluate", "-i", localized, *truth, "--align", "sim3")
    assert "4 of 4 poses" in done.out and "100.0" in done.out
    assert json.loads(map_overview(KaptureMap.open(workspace / "map")))["unit"] == "units"
    # maps that are made of it elsewhere keep its unit
    for command in ("refine-map", "preprocess"):
        done = megloc(command, "-i", workspace / "map", "-o", tmp_path / command)
        assert done.status == 0 and unit_of(tmp_path / command) == "units"


def test_a_given_camera_is_kept_fixed(megloc: Any, unposed: Path, tmp_path: Path) -> None:
    camera = "PINHOLE,400,300,300,302,200,150"
    (tmp_path / "photos").mkdir()
    for photo in sorted((unposed / "photos").iterdir())[:4]:
        shutil.copyfile(photo, tmp_path / "photos" / photo.name)
    done = megloc("map", tmp_path / "photos", "-o", tmp_path / "map", "--camera", camera, *FEW)
    assert done.status == 0, done.err
    actual = KaptureMap.open(tmp_path / "map" / "map").camera("0000.jpg")
    assert (actual.model, actual.params) == ("PINHOLE", (300.0, 302.0, 200.0, 150.0))


def counts_of(text: str) -> dict[str, tuple[int, int]]:
    """Return the points and observations of each row of the printed table."""
    rows = re.findall(r"(before|after|[a-z]+(?: [a-z]+)?) +(-?\d+) +(-?\d+)$", text, re.MULTILINE)
    return {name: (int(points), int(observations)) for name, points, observations in rows}


def test_a_refined_foreign_map_loses_uncertain_points_and_is_localized_in(
    megloc: Any, foreign_map: Path, tmp_path: Path
) -> None:
    refined = tmp_path / "refined"
    keep = ("--set", "refinement.uncertainty.max_robust_sigmas=1")
    done = megloc("refine-map", "-i", foreign_map / "map", "-o", refined, *keep)
    assert done.status == 0
    counts = counts_of(done.err)
    printed = megloc("info", refined).out
    assert counts == counts_of(printed)
    assert list(counts) == ["before", "uncertainty", "after"]
    old, new = KaptureFolder(foreign_map / "map"), KaptureFolder(refined)
    for name, folder in (("before", old), ("after", new)):
        observations = sum(map(len, folder.observations().values()))
        assert counts[name] == (len(folder.points3d()), observations)
    left, given = (set(map(tuple, folder.points3d().tolist())) for folder in (new, old))
    assert left < given
    assert re.search(r"known for \d+ points", printed)
    assert len(kapture_from_dir(str(refined)).points3d) == len(new.points3d())
    command = ("localize", "-i", refined, "--query", foreign_map / "query")
    done = megloc(*command, "-o", tmp_path / "poses")
    assert done.out.startswith("4 of 4 queries localized in ")


def test_the_file_of_a_point_cloud_is_checked_before_the_work(
    megloc: Any, finished: Path, tmp_path: Path
) -> None:
    command = ("densify", "-i", finished / "map", "-o", tmp_path / "dense", "--fuse")
    megloc(*command, tmp_path, "-f").refused("is a folder; give the name of a file")
    (tmp_path / "cloud.ply").touch()
    megloc(*command, tmp_path / "cloud.ply").refused("cloud.ply: exists; -f overwrites it")


def test_poses_without_depth_are_kept_with_the_reason(
    megloc: Any, finished: Path, tmp_path: Path
) -> None:
    refined, poses = tmp_path / "refined", finished / "localized"
    places = ("-i", finished / "map", "--query", finished / "query", "--poses", poses)
    by = ("--by", "icp", "--by", "rendering", "--executor", "inline", "-q")
    done = megloc("refine-poses", *places, "-o", refined, *by)
    assert (done.status, done.err) == (0, "")
    assert done.out.startswith("4 queries, 0 accepted by icp, 0 accepted by rendering, ")
    before, after = (KaptureFolder(place).read().poses() for place in (poses, refined))
    assert before == after
    assert {row.status for row in read_status(refined / "status.csv").values()} == {"localized"}
    for text in pandas.read_csv(refined / "status.csv")["refinement"]:
        first, second = text.split("; ")[-2:]
        assert first.startswith("icp: ") and second.startswith("rendering: ") and "depth" in text


def test_missing_and_unusable_refiners_are_refused(
    megloc: Any, finished: Path, tmp_path: Path
) -> None:
    places = ("-i", finished / "map", "--query", finished / "query", "-o", tmp_path / "out")
    command = ("refine-poses", *places, "--poses", finished / "localized")
    megloc(*command).refused("no pose refiner is chosen; give --by: field, icp, rendering")
    megloc(*command, "--by", "field").refused("train-field")
    assert not (tmp_path / "out").exists()


def described(out: str) -> dict[str, str]:
    """Return the first column of each line with the rest of the line."""
    return dict(re.findall(r"^(\w[\w ]*?)  +(.*)$", out, re.MULTILINE))


@pytest.mark.parametrize(
    ("given", "images", "origin"),
    [
        ("foreign_map", 7, "corner"),
        pytest.param("virtual_gallery", 12, "centre", marks=pytest.mark.slow),
    ],
)
def test_the_content_and_possible_uses_of_a_foreign_map_are_listed(
    megloc: Any, request: pytest.FixtureRequest, given: str, images: int, origin: str
) -> None:
    place = request.getfixturevalue(given) / "map"
    done = megloc("info", place)
    assert (done.status, done.err) == (0, "")
    listed = described(done.out)
    assert listed["images"] == f"{images} ({images} PINHOLE), {images} with a pose"
    assert listed["points"] == str(len(KaptureFolder(place).points3d()))
    assert listed["pixel origin"].startswith(f"{origin}: ")
    assert listed["map descriptors"] == "present"
    # R2D2 has an extractor, but its weights are missing
    assert listed["query features"].startswith(
        "must be in the query's kapture folder; plugin r2d2 could extract"
    )
    assert "megloc weights fetch r2d2_WASF_N16" in listed["query features"]
    # the few images are all matched; global features of queries need missing weights
    every = f"all {images} map images"
    assert listed["retrieval"] == f"{every}, not ranked"
    ranked = f"if queries have AP-GeM-LM18: {every}, ranked by global features AP-GeM-LM18"
    assert ranked in done.out
    errors = re.search(r"origin: corner ([\d.]+) px, centre ([\d.]+) px", done.out)
    assert errors is not None
    of_other, of_origin = sorted(map(float, errors.groups()), reverse=True)
    assert of_origin < 0.9 * of_other and float(errors[1 + (origin == "centre")]) == of_origin


def test_our_own_map_is_checked_completely_on_demand(megloc: Any, finished: Path) -> None:
    listed = described(megloc("info", finished / "map", "--deep").out)
    assert listed["checked"] == "all files and images: no fault found"
    assert listed["pixel origin"].startswith("corner: ")
    assert listed["query features"].startswith("extracted by plugin rootsift")
    assert listed["map descriptors"] == "present"


def test_a_folder_of_queries_is_no_map_and_may_have_unknown_cameras(
    megloc: Any, scene: Path, tmp_path: Path
) -> None:
    listed = described(megloc("info", scene / "query").out)
    assert listed["images"] == "4 (4 PINHOLE), 0 with a pose"
    assert listed["localizing"] == "not possible: no points3d and observations"
    data = KaptureFolder(scene / "query").read()
    for name, sensor in data.sensors.items():
        data.sensors[name] = replace(sensor, params=("UNKNOWN_CAMERA", *sensor.params[1:3]))
    write_sensors(tmp_path, data)
    listed = described(megloc("info", tmp_path).out)
    assert listed["images"].startswith("4 (4 UNKNOWN_CAMERA)")
    assert listed["missing files"] == f"4 of the images, such as {data.image_names()[0]}"


def check(result: Path, scene: Path) -> None:
    row = evaluate(result, scene / "query_gt").row()
    assert row.num_localized == row.num_queries > 0
    assert row.median_position_m is not None and row.median_position_m < 0.01


def test_an_imported_model_is_localized_in(
    megloc: Any, colmap_room: Path, scene: Path, tmp_path: Path
) -> None:
    done = megloc("import", "colmap", colmap_room, "-o", tmp_path / "map", "--unit", "m")
    assert done.status == 0 and "observations" in done.out, done
    assert f"database: {colmap_room}/database.db" in done.err
    assert "unit              metres" in megloc("info", tmp_path / "map").out
    queries = ("--query", scene / "query", "-o", tmp_path / "localized")
    done = megloc("localize", "-i", tmp_path / "map", *queries)
    assert done.out.startswith("4 of 4 queries localized"), done
    check(tmp_path / "localized", scene)


def test_a_model_is_imported_to_the_cache_where_a_map_is_expected(
    megloc: Any, colmap_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    model = colmap_room / "sparse" / "0"
    done = megloc("info", model)
    assert f"{model}: a COLMAP model, imported as kapture to {tmp_path}/cache/" in done.err
    assert "7 (7 PINHOLE), 7 with a pose" in done.out and "extracted by plugin sift" in done.out
    assert "unit              units of the map" in done.out


def test_a_model_and_photographs_are_never_written_into(
    megloc: Any, colmap_room: Path, scene: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    photos = scene / "query" / "sensors" / "records_data"
    for output in (colmap_room, photos):
        done = megloc("localize", "-i", colmap_room, "--images", photos, "-o", output, "-f")
        assert done.status == 2 and f"{output}: is or contains an input" in done.err
    done = megloc("import", "colmap", colmap_room, "-o", colmap_room, "-f")
    assert done.status == 2 and "contains an input" in done.err


def test_a_model_of_poses_alone_without_images_is_imported_as_poses(
    megloc: Any, colmap_room: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model = pycolmap.Reconstruction(str(colmap_room / "sparse" / "0"))
    for point in list(model.points3D):
        model.delete_point3D(point)
    model.write_text(str(tmp_path))
    done = megloc("import", "colmap", tmp_path, "-o", tmp_path / "poses")
    assert done.status == 0 and "kapture folder of poses, not a map" in caplog.text
    poses = KaptureFolder(tmp_path / "poses").read().poses()
    for image in model.images.values():
        expected = image.cam_from_world().matrix()
        np.testing.assert_allclose(poses[image.name].matrix()[:3], expected, atol=1e-9)


@pytest.mark.slow
def test_a_model_of_surveyed_photographs_is_localized_in(
    megloc: Any, fountain: Path, tmp_path: Path
) -> None:
    write_workspace(tmp_path / "ws", fountain)
    run_command("import", "colmap", tmp_path / "ws", "-o", tmp_path / "map")
    places = ("-i", tmp_path / "map", "--query", fountain / "query", "-o", tmp_path / "localized")
    done = megloc("localize", *places)
    assert "localized with sift" in done.err
    check(tmp_path / "localized", fountain)
