"""``megloc localize`` and ``megloc info``: queries into a map of any tool, which stays as it is."""

from __future__ import annotations

import hashlib
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.evaluation.evaluate import evaluate
from megloc_kapture.geometry.cameras import focal_px, scale_focal
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import (
    ImagePair,
    KaptureFolder,
    Sensor,
    write_pairs,
    write_sensors,
)
from megloc_kapture.io.tables import read_status
from tests.cli.foreign import DESCRIPTORS, FOREIGN_MAPS, KEYPOINTS, rename_type


def medians(result: Path, truth: Path) -> tuple[float, float, float]:
    """Share of localized queries, and their median errors in metres and degrees."""
    row = evaluate(result, truth).row()
    assert row.median_position_m is not None and row.median_angle_deg is not None
    return row.num_localized / row.num_queries, row.median_position_m, row.median_angle_deg


def state(root: Path) -> dict[str, tuple[str, int]]:
    """SHA-256 and time of change of every file."""
    return {
        str(path.relative_to(root)): (
            hashlib.sha256(path.read_bytes()).hexdigest(),
            path.stat().st_mtime_ns,
        )
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def queries_of(root: Path, output: Path) -> list[str | Path]:
    """Arguments: localize the queries of a folder in the map beside them."""
    return ["localize", "-i", root / "map", "--query", root / "query", "-o", output]


def test_a_map_of_another_tool_stays_as_it_is(megloc: Any, foreign: Path, scene: Path) -> None:
    rename_type(foreign)
    before = state(foreign)
    result = foreign.parent / "localized"
    done = megloc(*queries_of(foreign, result))
    assert done.out.startswith("4 of 4 queries localized in "), done
    share, median_m, median_deg = medians(result, scene / "query_gt")
    assert share == 1.0 and median_m < 0.01 and median_deg < 0.05
    assert state(foreign) == before
    assert "no extractor for orb_800" in megloc("info", foreign / "map").out


def test_a_second_result_in_the_same_folder_has_no_pose_of_the_first(
    megloc: Any, foreign: Path, scene: Path
) -> None:
    result = foreign.parent / "localized"
    command = queries_of(foreign, result)
    assert megloc(*command).out.startswith("4 of 4 queries")
    (result / "notes.txt").write_text("mine")
    assert megloc(*command, "--min-confidence", "1").out.startswith("0 of 4 queries")
    assert evaluate(result, scene / "query_gt").row().num_localized == 0
    assert not KaptureFolder(result).read().poses()
    assert (result / "notes.txt").read_text() == "mine"


def test_a_wrong_focal_length_is_the_reason(megloc: Any, foreign: Path) -> None:
    query, result = foreign / "query", foreign.parent / "localized"
    data = KaptureFolder(query).read()
    cameras = {name: sensor.camera() for name, sensor in data.sensors.items()}
    wrong = {name: Sensor.from_camera(scale_focal(c, 1.2)) for name, c in cameras.items()}
    write_sensors(query, replace(data, sensors=wrong))
    done = megloc(*queries_of(foreign, result))
    assert "the given focal length does not fit in 4 queries: see the remarks in" in done.err
    for image, status in read_status(result / "status.csv").items():
        assert status.status == "failed" and status.reason.endswith(status.remarks[0])
        (named, deviation) = re.findall(r"fit: (\d+) \+- (\d+) px would", status.remarks[0])[0]
        right_px = focal_px(data.camera_of(image))
        assert abs(float(named) - right_px) <= 3 * float(deviation)
        assert float(deviation) < 0.1 * right_px


@pytest.mark.parametrize("given", FOREIGN_MAPS)
@pytest.mark.parametrize("preset", ["modern", "megloc"])
def test_the_foreign_map_needs_no_weights_of_ours(
    megloc: Any, request: pytest.FixtureRequest, tmp_path: Path, preset: str, given: str
) -> None:
    """It brings its own R2D2 and AP-GeM, and so do its queries."""
    foreign = request.getfixturevalue(given)
    if given == "foreign_map":  # leave its queries too few keypoints for 100 matches
        foreign = shutil.copytree(foreign, tmp_path / "foreign", symlinks=True)
        for path, size in [(KEYPOINTS, 8), (DESCRIPTORS, 512)]:
            for file in (foreign / "query" / path).glob("*.jpg.*"):
                file.write_bytes(file.read_bytes()[: 110 * size])
    (local_type,) = KaptureFolder(foreign / "map").types("keypoints")
    result = tmp_path / "localized"
    command = [*queries_of(foreign, result), "--preset", preset]
    done = megloc(*command)
    assert done.out.startswith("4 of 4 queries localized in ")
    assert f"localizing with {local_type}" in done.err
    _, median_m, median_deg = medians(result, foreign / "query_gt")
    assert median_m <= 0.010 and median_deg <= (0.16 if given == "virtual_gallery" else 0.05)
    # what could not be done is said: pairs with few matches would be extracted again
    remarks = {"; ".join(row.remarks) for row in read_status(result / "status.csv").values()}
    if preset == "megloc":
        assert remarks == {
            f"guided pyramid matching: the weights that extract {local_type} are missing "
            "(megloc weights list)"
        }
        assert "skipped for 4 queries: guided pyramid matching" in done.err
    else:
        assert remarks == {""}


@pytest.mark.parametrize("given", FOREIGN_MAPS)
def test_proxy_folders_of_kapture_localization(
    megloc: Any, request: pytest.FixtureRequest, tmp_path: Path, given: str
) -> None:
    """Its normal intermediate: a kapture folder whose parts are links."""
    symlink = pytest.importorskip("kapture_localization.utils.symlink")
    foreign = request.getfixturevalue(given)
    local, vectors = KaptureFolder(foreign / "map").types("keypoints"), ["AP-GeM-LM18"]
    for part in ("map", "query"):
        data = foreign / part / "reconstruction"
        parts = (f"keypoints/{local[0]}", f"descriptors/{local[0]}", "global_features/AP-GeM-LM18")
        folders = [str(tmp_path / part), str(foreign / part)]
        linked = [[str(data / name)] for name in parts]
        symlink.create_kapture_proxy(*folders, *linked, None, local, local, vectors, force=True)
    for points in ("points3d.txt", "observations.txt"):
        link = tmp_path / "map" / "reconstruction" / points
        link.symlink_to((foreign / "map" / "reconstruction" / points).resolve())
    command = queries_of(tmp_path, tmp_path / "localized")
    done = megloc(*command)
    assert done.out.startswith("4 of 4"), done
    assert megloc(*queries_of(foreign, tmp_path / "expected")).status == 0
    for name in ("status.csv", "sensors/trajectories.txt"):
        expected = (tmp_path / "expected" / name).read_bytes()
        assert (tmp_path / "localized" / name).read_bytes() == expected
    number = len(KaptureFolder(foreign / "map").points3d())
    assert re.search(f"^points +{number}$", megloc("info", tmp_path / "map").out, re.MULTILINE)


def test_given_pairs_take_the_place_of_retrieval(megloc: Any, foreign: Path) -> None:
    names = KaptureFolder(foreign / "query").read().image_names()
    chosen = ["0006.jpg", "0005.jpg", "0003.jpg"]
    ranked = [(image, 1.0 - 0.1 * rank) for rank, image in enumerate(chosen)]
    pairs = [ImagePair(query, *one) for query in names[1:] for one in ranked]
    write_pairs(foreign / "pairs.txt", pairs)
    command = [*queries_of(foreign, foreign / "localized"), "--pairs", foreign / "pairs.txt"]
    assert megloc(*command).status == 0
    statuses = read_status(foreign / "localized" / "status.csv")
    assert statuses[names[0]].reason == "no map image is a candidate"
    for name in names[1:]:
        assert set(statuses[name].candidates) <= set(chosen)
    assert max(len(s.candidates) for s in statuses.values()) > 1
    # they may name map images without a pose, which are left out
    trajectories = foreign / "map" / "sensors" / "trajectories.txt"
    rows = trajectories.read_text().splitlines(keepends=True)
    trajectories.write_text("".join(row for row in rows if not re.match(r" *0, ", row)))
    images = KaptureFolder(foreign / "map").read().image_names()
    pairs = [ImagePair(query, image, 1.0) for query in names for image in images]
    write_pairs(foreign / "pairs.txt", pairs)
    assert megloc(*command).out.startswith("4 of 4")
    statuses = read_status(foreign / "localized" / "status.csv")
    used = {image for status in statuses.values() for image in status.candidates}
    assert used == set(images) - {"0000.jpg"}


@pytest.mark.parametrize("by", ["AP-GeM-LM18", "VLAD over the map's descriptors"])
def test_retrieval_by_what_both_bring_else_by_our_own(megloc: Any, foreign: Path, by: str) -> None:
    if by.startswith("VLAD"):
        shutil.rmtree(foreign / "query" / "reconstruction" / "global_features")
    command = queries_of(foreign, foreign / "localized")
    done = megloc(*command, "--set", "query_pairs.top_k=5")
    assert done.out.startswith("4 of 4")
    described = rf"^candidates: the 5 of 7 .* by (global features )?{by}$"
    assert re.search(described, done.err, re.MULTILINE)
    statuses = read_status(foreign / "localized" / "status.csv")
    assert {len(s.candidates) for s in statuses.values()} == {5}


def test_images_that_cannot_be_used_fail_their_query_alone(
    megloc: Any, finished: Path, dataset: Path, tmp_path: Path
) -> None:
    images = dataset / "query" / "sensors" / "records_data"
    names = KaptureFolder(dataset / "query").read().image_names()
    absent, small, cut, whole = names
    (images / absent).unlink()
    write_image(images / small, np.full((9, 16, 3), 90, np.uint8))
    (images / cut).write_bytes((images / cut).read_bytes()[:-2000])
    output = tmp_path / "localized"
    fallback = ("--set", "localization.fallback=retrieval")
    asked = ("localize", "-i", finished / "map", "--query", dataset / "query", *fallback)
    done = megloc(*asked, "-o", output)
    assert done.out.startswith("1 of 4"), done
    status = read_status(output / "status.csv")
    assert [status[name].status for name in names] == ["failed"] * 3 + ["localized"]
    for name, words in ((absent, "no such"), (small, "16x9"), (cut, "broken")):
        assert status[name].reason.startswith("the image cannot be used: "), name
        assert words in status[name].reason, status[name].reason
    # where none is left there is nothing to do
    (images / whole).unlink()
    write_image(images / cut, np.full((9, 16, 3), 90, np.uint8))
    megloc(*asked, "-o", tmp_path / "none").refused(f"{images / absent}: no such")


@pytest.fixture
def namesake(dataset: Path) -> Path:
    """The dataset with a query that has the name of a map image, and shows something else."""
    query = dataset / "query" / "sensors"
    (query / "records_data" / "0001.jpg").rename(query / "records_data" / "0000.jpg")
    records = query / "records_camera.txt"
    records.write_text(records.read_text().replace("0001.jpg", "0000.jpg"))
    return dataset


def test_an_image_is_not_given_the_features_of_another_of_its_name(
    megloc: Any, finished: Path, namesake: Path, tmp_path: Path
) -> None:
    told = (
        "rootsift/keypoints/0000.jpg.kpt: 0000.jpg is another image in .* than in .*/query, and "
        "both would get these keypoints; give each its own --features-dir"
    )
    output = ["-o", tmp_path / "new", "--features-dir", finished]
    query = ["--query", namesake / "query"]
    megloc("localize", "-i", finished / "map", *query, *output).refused(told)
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("0000.jpg, 0002.jpg, 1\n")
    for command in (["match", "--pairs", pairs], ["pairs-query"]):
        megloc(*command, "-i", finished / "mapping", *query, *output).refused(told)
    assert not (tmp_path / "new").exists()
    # with features of its own it is localized, whatever its name
    extracted = tmp_path / "features"
    small = ["--set", "local_features.options.max_keypoints=800", "--executor", "inline"]
    assert megloc("extract-local", "-i", namesake / "query", "-o", extracted, *small).status == 0
    output = ["-o", tmp_path / "new", "--features-dir", extracted]
    done = megloc("localize", "-i", finished / "map", *query, *output)
    assert done.out.startswith("4 of 4"), done


def test_no_query_localized_is_no_error_and_a_fallback_is_marked(
    megloc: Any, finished: Path, dataset: Path, tmp_path: Path
) -> None:
    for place in (dataset / "query/sensors/records_data").iterdir():
        write_image(place, np.zeros((300, 400, 3), np.uint8))
    places = ["-i", finished / "map", "--query", dataset / "query", "-o", tmp_path / "localized"]
    done = megloc("localize", *places)
    assert done.status == 0
    assert done.out.startswith("0 of 4 queries localized in ")
    assert "warning: no query was localized; reasons are in" in done.err
    assert KaptureFolder(tmp_path / "localized").read().poses() == {}
    done = megloc("localize", *places, "--set", "localization.fallback=retrieval")
    assert done.out.rstrip().endswith(", 4 fallback poses")
    statuses = read_status(tmp_path / "localized" / "status.csv").values()
    assert {(s.status, s.fallback) for s in statuses} == {("failed", "retrieval")}
    map_poses = list(KaptureFolder(finished / "map").read().poses().values())
    poses = KaptureFolder(tmp_path / "localized").read().poses()
    assert len(poses) == 4 and all(pose in map_poses for pose in poses.values())


def test_a_map_that_contradicts_itself_is_not_localized_in_silently(
    megloc: Any, foreign: Path, scene: Path, tmp_path: Path
) -> None:
    path = foreign / "map" / "reconstruction" / "points3d.txt"
    table = np.loadtxt(path, delimiter=",")
    table[:, [1, 2]] = table[:, [2, 1]]
    np.savetxt(path, table, delimiter=", ", header="X, Y, Z, R, G, B")
    command = queries_of(foreign, tmp_path / "localized")
    text = megloc(*command).refused("the points do not fit the keypoints")
    assert "--force" in text
    assert not (tmp_path / "localized").exists()
    out = megloc("info", foreign / "map").out
    assert re.search(r"FAULT +the points do not fit", out)
    # who insists gets poses that are right in that world, or reasons
    assert megloc(*command, "-f").status == 0
    assert len(read_status(tmp_path / "localized" / "status.csv")) == 4


def test_strangers_are_refused_and_that_is_right(
    megloc: Any, dataset: Path, tmp_path: Path
) -> None:
    """A query that shows nothing of the map: refused, counted as right, with every pose wanted."""
    query = dataset / "query"
    data = KaptureFolder(query).read()
    camera = data.camera_of(data.image_names()[0])
    time, sensor = data.record_of(data.image_names()[0])
    size = (camera.height // 8 + 1, camera.width // 8 + 1, 3)
    coarse = np.random.default_rng(0).integers(0, 255, size, dtype=np.uint8)
    noise = np.kron(coarse, np.ones((8, 8, 1), np.uint8))[: camera.height, : camera.width]
    write_image(query / "sensors" / "records_data" / "stranger.png", noise)
    with (query / "sensors" / "records_camera.txt").open("a") as file:
        file.write(f"{int(time) + 1000}, {sensor}, stranger.png\n")
    (dataset / "query_gt" / "nowhere.txt").write_text("stranger.png\n")
    workspace = tmp_path / "workspace"
    done = megloc(
        "eval", "kapture", "--root", dataset, "-w", workspace, "--executor", "inline",
        "--set", "local_features.options.max_keypoints=800",
    )  # fmt: skip
    assert done.status == 0
    text = " ".join((workspace / "evaluation" / "recall.txt").read_text().split())
    assert "1 query shows nothing of the map: 1 refused, 0 given a pose" in text
    assert (workspace / "query_gt" / "nowhere.txt").read_text() == "stranger.png\n"
    rows = read_status(workspace / "localized" / "status.csv")
    assert rows["stranger.png"].status == "failed"
    assert all(row.confidence is not None for row in rows.values() if row.status == "localized")
