"""``megloc localize``: maps of other tools, candidates, photographs, and queries that fail."""

from __future__ import annotations

import io
import re
import shutil
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from images import photograph
from kapture.io.csv import kapture_from_dir

from megloc_kapture.cli.common import cameras_of_text
from megloc_kapture.evaluation.evaluate import evaluate
from megloc_kapture.io.images import image_size, write_image
from megloc_kapture.io.kapture import ImagePair, KaptureFolder, write_pairs, write_sensors
from megloc_kapture.io.tables import read_status
from megloc_kapture.values import Camera, RigidTransform
from tests.cli.foreign import DESCRIPTORS, FOREIGN_MAPS, KEYPOINTS, rename_type
from tests.pipeline.runs import run_command
from tests.worlds import folder_bytes


def medians(result: Path, truth: Path) -> tuple[float, float, float]:
    """Share of localized queries, and their median errors in metres and degrees."""
    row = evaluate(result, truth).row()
    assert row.median_position_m is not None and row.median_angle_deg is not None
    return row.num_localized / row.num_queries, row.median_position_m, row.median_angle_deg


def localize(root: Path, output: Path) -> list[str | Path]:
    return ["localize", "-i", root / "map", "--query", root / "query", "-o", output]


def test_a_foreign_map_stays_unchanged_and_a_second_result_replaces_the_first(
    megloc: Any, foreign: Path, scene: Path
) -> None:
    rename_type(foreign)
    before = folder_bytes(foreign)
    times = {path: path.stat().st_mtime_ns for path in foreign.rglob("*")}
    result = foreign.parent / "localized"
    done = megloc(*localize(foreign, result), "--set", "query_pairs.top_k=5")
    assert done.out.startswith("4 of 4 queries localized in "), done
    assert re.search(r"^candidates: the 5 of 7 .* by global features AP-GeM-LM18$", done.err, re.M)
    share, median_m, median_deg = medians(result, scene / "query_gt")
    assert share == 1.0 and median_m < 0.01 and median_deg < 0.05
    assert folder_bytes(foreign) == before
    assert {path: path.stat().st_mtime_ns for path in foreign.rglob("*")} == times
    (result / "notes.txt").write_text("mine")
    rejected = (*localize(foreign, result), "--min-confidence", "1")
    assert megloc(*rejected).out.startswith("0 of 4 queries")
    assert not KaptureFolder(result).read().poses()
    assert (result / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("given", FOREIGN_MAPS)
@pytest.mark.parametrize("preset", ["modern", "megloc"])
def test_a_foreign_map_with_its_features_needs_no_weights(
    megloc: Any, request: pytest.FixtureRequest, tmp_path: Path, preset: str, given: str
) -> None:
    foreign = request.getfixturevalue(given)
    if given == "foreign_map":  # leave its queries too few keypoints for 100 matches
        foreign = shutil.copytree(foreign, tmp_path / "foreign", symlinks=True)
        for path, size in [(KEYPOINTS, 8), (DESCRIPTORS, 512)]:
            for file in (foreign / "query" / path).glob("*.jpg.*"):
                file.write_bytes(file.read_bytes()[: 110 * size])
    (local_type,) = KaptureFolder(foreign / "map").types("keypoints")
    result = tmp_path / "localized"
    done = megloc(*localize(foreign, result), "--preset", preset)
    assert done.out.startswith("4 of 4 queries localized in ")
    assert f"localized with {local_type}" in done.err
    _, median_m, median_deg = medians(result, foreign / "query_gt")
    assert median_m <= 0.010 and median_deg <= (0.16 if given == "virtual_gallery" else 0.05)
    # pairs with few matches would be extracted again, which needs the weights
    remarks = {"; ".join(row.remarks) for row in read_status(result / "status.csv").values()}
    skipped = (
        f"guided pyramid matching: the weights to extract {local_type} are missing "
        "(megloc weights list)"
    )
    assert remarks == {skipped if preset == "megloc" else ""}


def test_given_pairs_replace_retrieval(megloc: Any, foreign: Path) -> None:
    names = KaptureFolder(foreign / "query").read().image_names()
    chosen = ["0006.jpg", "0005.jpg", "0003.jpg"]
    ranked = [(image, 1.0 - 0.1 * rank) for rank, image in enumerate(chosen)]
    pairs = [ImagePair(query, *candidate) for query in names[1:] for candidate in ranked]
    write_pairs(foreign / "pairs.txt", pairs)
    (broken,) = (foreign / "query" / DESCRIPTORS).glob(f"{names[-1]}.*")
    content = broken.read_bytes()
    broken.unlink()
    broken.write_bytes(content[:-1])
    result = foreign / "localized"
    assert megloc(*localize(foreign, result), "--pairs", foreign / "pairs.txt").status == 0
    statuses = read_status(result / "status.csv")
    assert statuses[names[0]].reason == "no map image is a candidate"
    assert str(broken) in statuses[names[-1]].reason
    for name in names[1:-1]:
        assert set(statuses[name].candidates) <= set(chosen)
    assert max(len(s.candidates) for s in statuses.values()) > 1
    for first, second in (("q/1.jpg", "0003.jpg"), (names[1], "x.jpg")):
        write_pairs(foreign / "pairs.txt", [ImagePair(first, second, 1.0)])
        done = megloc(*localize(foreign, foreign / "none"), "--pairs", foreign / "pairs.txt")
        assert done.status == 2 and "pairs.txt: no row names both a query and" in done.err


def test_rigs_that_are_not_localized_jointly_are_mentioned(megloc: Any, foreign: Path) -> None:
    data = KaptureFolder(foreign / "query").read()
    (sensor,) = data.sensors.values()
    cameras = [f"camera{number}" for number in range(4)]
    data.sensors = dict.fromkeys(cameras, sensor)
    data.rigs = {"rig": dict.fromkeys(cameras, RigidTransform.identity())}
    records = zip(cameras, data.image_names(), strict=True)
    data.records_camera = {(1, camera): image for camera, image in records}
    write_sensors(foreign / "query", data)
    done = megloc(*localize(foreign, foreign / "localized"), "--set", "query_pairs.top_k=1")
    assert "--set localization.rigs=true localizes them jointly" in done.err


def test_without_shared_global_features_candidates_come_from_vlad(
    megloc: Any, foreign: Path
) -> None:
    shutil.rmtree(foreign / "query" / "reconstruction" / "global_features")
    done = megloc(*localize(foreign, foreign / "localized"), "--set", "query_pairs.top_k=5")
    assert done.out.startswith("4 of 4")
    described = r"^candidates: the 5 of 7 .* by VLAD over the map's descriptors$"
    assert re.search(described, done.err, re.MULTILINE)
    statuses = read_status(foreign / "localized" / "status.csv")
    assert {len(s.candidates) for s in statuses.values()} == {5}


def test_without_any_usable_image_the_command_stops(
    megloc: Any, finished: Path, dataset: Path, tmp_path: Path
) -> None:
    for image in (dataset / "query" / "sensors" / "records_data").iterdir():
        image.write_bytes(b"")
    command = ("localize", "-i", finished / "map", "--query", dataset / "query", "-o")
    megloc(*command, tmp_path / "localized").refused(r"records_data/0001\.jpg: not an image")
    (tmp_path / "phone").mkdir()
    (tmp_path / "phone" / "IMG_1.HEIC").write_bytes(b"")
    command = ("localize", "-i", finished / "map", "--images", tmp_path / "phone")
    megloc(*command).refused(r"no photograph can be used; the first is IMG_1\.HEIC: \.HEIC cannot")


def test_without_any_localized_query_a_warning_is_printed_and_a_fallback_marked(
    megloc: Any, finished: Path, dataset: Path, tmp_path: Path
) -> None:
    for place in (dataset / "query/sensors/records_data").iterdir():
        write_image(place, np.zeros((300, 400, 3), np.uint8))
    result = tmp_path / "localized"
    command = ("localize", "-i", finished / "map", "--query", dataset / "query", "-o", result)
    done = megloc(*command, "--set", "localization.fallback=retrieval")
    assert done.status == 0
    assert done.out.startswith("0 of 4 queries localized in ")
    assert ", 4 fallback poses; " in done.out
    assert "warning: no query was localized; reasons are in" in done.err
    statuses = read_status(result / "status.csv").values()
    assert {(s.status, s.fallback) for s in statuses} == {("failed", "retrieval")}
    map_poses = list(KaptureFolder(finished / "map").read().poses().values())
    poses = KaptureFolder(result).read().poses()
    assert len(poses) == 4 and all(pose in map_poses for pose in poses.values())


def test_a_map_whose_points_contradict_its_keypoints_is_refused_unless_forced(
    megloc: Any, foreign: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = foreign / "map" / "reconstruction" / "points3d.txt"
    table = np.loadtxt(path, delimiter=",")
    table[:, [1, 2]] = table[:, [2, 1]]
    np.savetxt(path, table, delimiter=", ", header="X, Y, Z, R, G, B")
    command = localize(foreign, tmp_path / "localized")
    assert "--force" in megloc(*command).refused("the points do not fit the keypoints")
    assert not (tmp_path / "localized").exists()
    assert re.search(r"FAULT +the points do not fit", megloc("info", foreign / "map").out)
    assert megloc(*command, "-f").status == 0
    assert "the poses may be wrong" in caplog.text
    assert len(read_status(tmp_path / "localized" / "status.csv")) == 4


@pytest.mark.parametrize("text", ["PINHOLE,640.0,480.0,51,52,32,24", "PINHOLE 640 480 51 52 32 24"])
def test_a_camera_is_read_as_in_a_list_of_cameras(text: str) -> None:
    assert cameras_of_text(text) == Camera("PINHOLE", 640, 480, (51, 52, 32, 24))


def test_a_camera_may_be_longer_than_a_file_name() -> None:
    """COLMAP writes 17 digits per parameter."""
    params = (*(1234.5678901234567,) * 4, *(-0.0012345678901234567,) * 8)
    text = ",".join(map(str, ("FULL_OPENCV", 4032, 3024, *params)))
    assert len(text) > 255 and cameras_of_text(text) == Camera("FULL_OPENCV", 4032, 3024, params)


# upright, and a camera held sideways, by EXIF
ORIENTATIONS = (1, 6)


@pytest.fixture(scope="module")
def localized(
    finished: Path, scene: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, str]:
    """Result and output of localizing rotated photographs, unusable files and a video."""
    root = tmp_path_factory.mktemp("photographs")
    query, place = KaptureFolder(scene / "query"), root / "photos"
    for orientation in ORIENTATIONS:
        path = place / f"my dir/{orientation}.jpg"
        focal = 0 if orientation == 1 else 26
        image = query.image_path("0004.jpg")
        photograph(image, path, orientation=orientation, focal_35mm=focal)
    content = (place / "my dir" / "1.jpg").read_bytes()
    (place / "cut.jpg").write_bytes(content[: len(content) // 2])
    (place / "empty.jpg").touch()
    (place / "phone.HEIC").write_bytes(b"x")
    write_image(place / "grey.png", np.full((300, 400), 128, np.uint8))
    size, film = (400, 298), str(place / "walk.avi")
    writer = cv2.VideoWriter(film, cv2.VideoWriter.fourcc(*"MJPG"), 10, size)
    for name in query.read().image_names()[:2]:
        for _ in range(16):
            writer.write(cv2.resize(cv2.imread(str(query.image_path(name))), size))
    writer.release()
    places = ["-i", finished / "map", "--images", place, "-o", root / "out", "--every", "16"]
    with redirect_stdout(io.StringIO()) as printed:
        run_command("localize", *places, "-q")
    return root / "out", printed.getvalue()


def test_usable_photographs_and_frames_are_localized(localized: tuple[Path, str]) -> None:
    out, printed = localized
    assert printed.startswith("4 of 8 queries localized in ")
    statuses = read_status(out / "status.csv")
    reasons = {name: row.reason for name, row in statuses.items() if row.status == "failed"}
    assert set(reasons) == {"cut.jpg", "empty.jpg", "phone.HEIC", "grey.png"}
    assert "broken" in reasons["cut.jpg"] and ".HEIC cannot be read" in reasons["phone.HEIC"]
    succeeded = [row for row in statuses.values() if row.num_inliers]
    assert all("focal length estimated" in row.remarks[0] for row in succeeded)


def test_the_result_has_upright_images_with_their_estimated_cameras(
    localized: tuple[Path, str], scene: Path
) -> None:
    out = KaptureFolder(localized[0])
    data = out.read()
    truth = KaptureFolder(scene / "query_gt").read().poses()["0004.jpg"]
    theirs = kapture_from_dir(str(out.root))
    assert len(theirs.records_camera.data_list()) == 6 == len(data.image_names())
    for orientation in ORIENTATIONS:
        name = f"my dir/{orientation}.jpg"
        assert np.linalg.norm(data.poses()[name].center() - truth.center()) < 0.05
        camera = data.camera_of(name)
        assert camera.params[0] == pytest.approx(300, rel=0.015)
        assert image_size(out.image_path(name)) == (camera.width, camera.height)
        assert out.image_path(name).is_symlink() == (orientation == 1)


@pytest.fixture(scope="module")
def facade(fountain: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    workspace = tmp_path_factory.mktemp("facade") / "workspace"
    places = ("--root", fountain, "--workspace", workspace)
    run_command("eval", "kapture", *places, "--until", "map", "--executor", "inline", "-q")
    return workspace / "map"


# The focal length is 1381 px, 32.4 mm of 35 mm film; the images are without distortion, but their
# principal point is 11 px off the middle, which is unknown to the command.
@pytest.mark.slow
@pytest.mark.parametrize("focal_35mm", [0, 32, 42], ids=["no EXIF", "true EXIF", "30 % too long"])
def test_real_photographs(
    megloc: Any, fountain: Path, facade: Path, focal_35mm: int, tmp_path: Path
) -> None:
    for path in (fountain / "query").rglob("*.jpg"):
        photograph(path, tmp_path / "photos" / path.name, focal_35mm=focal_35mm)
    out = tmp_path / "out"
    done = megloc("localize", "-i", facade, "--images", tmp_path / "photos", "-o", out)
    assert done.status == 0
    data = KaptureFolder(out).read()
    assert data.poses().keys() == set(data.image_names())
    for name in data.image_names():
        assert data.camera_of(name).params[0] == pytest.approx(1381, rel=0.015)
    _, median_m, median_deg = medians(out, fountain / "query_gt")
    assert median_m < 0.07 and median_deg < 0.15
