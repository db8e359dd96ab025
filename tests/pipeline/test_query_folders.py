"""Queries: kapture folders and photographs."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from megloc_kapture import KaptureMap, Localizer
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.images import image_size, read_image_rgb, read_photo, write_image
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.io.output_folders import claim_folder
from megloc_kapture.io.text_lines import read_cameras
from megloc_kapture.pipeline.plan import Workspace
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.query_folders import KaptureQueries, Photographs
from megloc_kapture.pipeline.results import Results
from megloc_kapture.preprocessing.frames import resized, scaled_camera
from megloc_kapture.values import Camera, Pose, RigidTransform
from tests.pipeline.runs import evaluated


def write(path: Path, *, width: int = 64, height: int = 48, focal_35mm: int = 0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if focal_35mm:
        exif.get_ifd(0x8769)[0xA405] = focal_35mm
    Image.new("RGB", (width, height), (90, 40, 200)).save(path, exif=exif)
    return path


def test_names_are_paths_below_the_given_folders(tmp_path: Path) -> None:
    for name in ("b.jpg", "a dir/c.PNG", ".hidden/d.jpg", "._b.jpg", "raw.NEF"):
        write(tmp_path / "in" / name) if name != "raw.NEF" else (tmp_path / "in" / name).touch()
    (tmp_path / "in" / "notes.txt").write_text("no image")
    other = write(tmp_path / "e.jpg")
    write(tmp_path / "in" / "f.jpg").rename(tmp_path / "in" / "frame_000007")
    photos = Photographs([tmp_path / "in", other, tmp_path / "in" / ".." / "e.jpg"])
    assert photos.names == ["a dir/c.PNG", "b.jpg", "e.jpg", "frame_000007"]
    assert list(photos.unreadable) == ["raw.NEF"]
    assert ".nef cannot be read" in photos.unreadable["raw.NEF"].lower()


def test_links_are_followed_once_and_our_folders_left_out(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    write(photos / "1.jpg")
    write(tmp_path / "elsewhere" / "3.jpg")
    (photos / "a link").symlink_to(tmp_path / "elsewhere")
    (photos / "loop").symlink_to(photos)
    claim_folder(photos / "map", kind="workspace")
    write(photos / "map" / "mapping" / "sensors" / "records_data" / "1.jpg")
    (photos / "kapture" / "sensors").mkdir(parents=True)
    (photos / "kapture" / "sensors" / "sensors.txt").touch()
    write(photos / "kapture" / "sensors" / "records_data" / "1.jpg")
    assert Photographs([photos]).names == ["1.jpg", "a link/3.jpg"]


def test_images_of_one_size_and_focal_length_share_a_camera(tmp_path: Path) -> None:
    write(tmp_path / "1.jpg", focal_35mm=28)
    write(tmp_path / "2.jpg", focal_35mm=28)
    write(tmp_path / "3.jpg", focal_35mm=50)
    write(tmp_path / "4.jpg", width=48, height=64, focal_35mm=28)
    data = Photographs([tmp_path]).data()
    sensors = [data.record_of(f"{n}.jpg")[1] for n in (1, 2, 3, 4)]
    assert sensors[0] == sensors[1] and len(set(sensors)) == 3


def test_rotated_photographs_are_turned_without_a_given_camera(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x112] = 6
    Image.new("RGB", (64, 48)).save(tmp_path / "1.jpg", exif=exif)
    write(tmp_path / "2.jpg", width=32)
    camera = Camera.pinhole(64, 48, 50)
    photos = Photographs([tmp_path], camera)
    assert photos.names == ["1.jpg"]
    assert photos.query("1.jpg").read_image().shape == (48, 64, 3)
    assert photos.unreadable == {"2.jpg": "the image is 32x48, its camera says 64x48"}
    upright = Photographs([tmp_path], Camera.pinhole(48, 64, 50))
    assert upright.unreadable["1.jpg"].endswith("as stored, before EXIF rotates them")
    (tmp_path / "3.jpg").write_bytes((tmp_path / "1.jpg").read_bytes()[:-20])
    photos = Photographs([tmp_path])
    assert photos.query("1.jpg").read_image().shape == (64, 48, 3)
    photos.write_images(tmp_path / "out")
    place = tmp_path / "out" / "sensors" / "records_data"
    assert image_size(place / "1.jpg") == (48, 64) and not (place / "1.jpg").is_symlink()
    assert (place / "2.jpg").readlink() == tmp_path / "2.jpg"
    assert (place / "3.jpg").readlink() == tmp_path / "3.jpg"  # truncated, as its readers report


def test_frames_of_a_video(tmp_path: Path) -> None:
    code = cv2.VideoWriter.fourcc(*"MJPG")
    film = cv2.VideoWriter(str(tmp_path / "walk.avi"), code, 10, (64, 48))
    for number in range(25):
        film.write(np.full((48, 64, 3), 5 * number, np.uint8))
    film.release()
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    photos = Photographs([tmp_path], every=10)
    assert photos.names == [f"walk.avi/{n:06}.jpg" for n in (0, 10, 20)]
    assert list(photos.unreadable) == ["broken.mp4"]
    for number in (0, 10, 20):
        image = photos.query(f"walk.avi/{number:06}.jpg").read_image()
        assert abs(int(image.mean()) - 5 * number) <= 2


def test_unusable_files_and_folders_are_refused(tmp_path: Path) -> None:
    one, two = write(tmp_path / "a" / "x.jpg"), write(tmp_path / "b" / "x.jpg")
    (tmp_path / "empty").mkdir()
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24")
    for paths, message in (
        ([one, two], "same image name"),
        ([tmp_path / "nowhere"], "no such file"),
        ([tmp_path / "empty"], "no image or video"),
        ([tmp_path / "cameras.txt"], "if it lists cameras, give it with --camera"),
        ([write(tmp_path / "Paris, Texas.jpg")], "rename the file"),
        ([write(tmp_path / "#1.jpg")], "rename the file"),
    ):
        with pytest.raises(DataError, match=message):
            Photographs(paths)
    with pytest.raises(OptionError, match=r"only localize\(\) takes arrays"):
        Photographs([np.zeros((8, 8, 3), np.uint8)])  # type: ignore[list-item]
    with pytest.raises(OptionError, match="no photographs are given"):
        Photographs([])


def test_a_list_has_the_camera_of_each_image(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("day/1.jpg", "day/2 b.jpg", "night/1.jpg", "other/3.jpg"):
        write(tmp_path / "query" / name)
    (tmp_path / "cameras.txt").write_text(
        "# NAME MODEL WIDTH HEIGHT PARAMS\n"
        "./query/day/1.jpg PINHOLE 64 48 51 51 32 24\n"
        "/data/query/night/1.jpg PINHOLE 64.0 48.0 52 52 32 24\n"
        "query/day/2 b.jpg, SIMPLE_RADIAL, 128, 96, 106, 64, 48, 0.1\n"
    )
    cameras = read_cameras(tmp_path / "cameras.txt")
    photos = Photographs([tmp_path / "query"], cameras)
    found = {name: photos.query(name).camera for name in photos.names}
    assert found["day/1.jpg"] == Camera("PINHOLE", 64, 48, (51, 51, 32, 24))
    assert found["night/1.jpg"].params[0] == 52
    # the image is half as large as its camera
    assert found["day/2 b.jpg"] == Camera("SIMPLE_RADIAL", 64, 48, (53, 32, 24, 0.1))
    assert photos.without_row == ["other/3.jpg"] and found["other/3.jpg"].focal_deviation > 0
    assert "1 images are not in the list of cameras" in caplog.text
    assert not photos.has_known_cameras()
    # the path distinguishes images of one name
    assert Photographs([tmp_path / "query" / "day"], cameras).query("1.jpg").camera.params[0] == 51
    with pytest.raises(OptionError, match=r"none of the images, for example 3\.jpg"):
        Photographs([tmp_path / "query" / "other"], cameras)
    # the only listed image is of another shape than its camera
    turned = {"day/1.jpg": Camera("PINHOLE", 48, 64, (51, 51, 24, 32))}
    assert list(Photographs([tmp_path / "query"], turned).unreadable) == ["day/1.jpg"]
    # COLMAP's cameras.txt with one camera
    (tmp_path / "cameras.txt").write_text("# Camera list\n1 PINHOLE 64 48 50 50 32 24\n")
    photos = Photographs([tmp_path / "query"], read_cameras(tmp_path / "cameras.txt"))
    assert photos.has_known_cameras() and photos.query("night/1.jpg").camera.params[0] == 50


def test_photographs_of_a_kapture_folder_have_its_cameras(tmp_path: Path) -> None:
    known = Camera.pinhole(64, 48, 51)
    unknown = Sensor("", "camera", ("UNKNOWN_CAMERA", "64", "48"))
    data = KaptureData(sensors={"a": Sensor.from_camera(known), "b": unknown})
    data.records_camera = {(0, "a"): "1.jpg", (1, "b"): "2.jpg"}
    write_sensors(tmp_path, data)
    for name in ("1.jpg", "2.jpg"):
        path = write(KaptureFolder(tmp_path).image_path(name), focal_35mm=28)
    photos = Photographs([tmp_path])
    assert photos.query("1.jpg").camera == known
    assert photos.query("2.jpg").camera == read_photo(path).camera
    write_sensors(tmp_path, replace(data, trajectories={(0, "a"): RigidTransform.identity()}))
    with pytest.raises(DataError, match="with poses: `megloc triangulate`"):
        Photographs([tmp_path])


FEW = "local_features.rootsift.options.max_keypoints=300"
PYRAMID = ("mode=all", "scales=[0.5]", "rotations_deg=[0]", "min_matches=100")


@pytest.fixture(scope="module")
def guided(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    options = options_of_preset(assignments=[FEW, *(f"guided_pyramid.{one}" for one in PYRAMID)])
    root = tmp_path_factory.mktemp("pyramid") / "workspace"
    return evaluated(root, scene, options, last="query_rematching")


@pytest.fixture
def queries(workspace: Path, tmp_path: Path) -> tuple[KaptureMap, KaptureFolder]:
    """A map, and a copy of its queries without features."""
    query = Path(shutil.copytree(workspace / "query", tmp_path / "query"))
    return KaptureMap.open(workspace / "map"), KaptureFolder(query)


@pytest.mark.parametrize("type_of_map", ["rootsift", "rootsift-pyramid"])
def test_features_with_and_without_pyramid_are_interchangeable(
    workspace: Path, guided: Workspace, tmp_path: Path, type_of_map: str
) -> None:
    query = tmp_path / "query"
    shutil.copytree(workspace / "query" / "sensors", query / "sensors", symlinks=True)
    (query / "sensors" / "records_data").unlink()  # without images nothing is extracted
    if type_of_map == "rootsift":
        place, features = workspace / "map", guided.path("pyramid/query")
    else:
        place, features = guided.path("map"), workspace
    folder, opened = KaptureFolder(query, features_dirs=[features]), KaptureMap.open(place)
    assert list(opened.keypoints) == [type_of_map]
    queries = KaptureQueries(folder, opened)
    assert queries.first_without_features(type_of_map) is None
    assert queries.first_without_features("superpoint") == queries.names[0]
    results = Results(Localizer(opened, options=options_of_preset(assignments=[FEW])), folder)
    assert all(results.values())


def test_the_focal_length_of_an_uncalibrated_camera_is_estimated(
    queries: tuple[KaptureMap, KaptureFolder], workspace: Path
) -> None:
    opened, folder = queries
    data = folder.read()
    first = data.image_names()[1]
    timestamp, sensor = data.record_of(first)
    known = data.camera_of(first)
    unknown = Sensor("", "camera", ("UNKNOWN_CAMERA", str(known.width), str(known.height)))
    del data.records_camera[timestamp, sensor]
    data.records_camera[timestamp, "unknown"] = first
    write_sensors(folder.root, replace(data, sensors={**data.sensors, "unknown": unknown}))
    folder = KaptureFolder(folder.root, features_dirs=[workspace])
    results = Results(Localizer(opened, options=options_of_preset(assignments=[FEW])), folder)
    found = results[first]
    assert isinstance(found, Pose) and found.camera is not None
    assert abs(found.camera.params[0] / known.params[0] - 1) < 0.05  # the guess is 480 px, not 300
    others = [one for name, one in results.items() if name != first]
    assert all(isinstance(one, Pose) and one.camera is None for one in others)
    counts = results.save(folder.root.parent / "out")
    assert counts["localized"] == len(results)
    saved = KaptureFolder(folder.root.parent / "out").read()
    np.testing.assert_allclose(saved.camera_of(first).params, found.camera.params)


def test_a_guessed_camera_fits_the_size_of_the_keypoints(
    queries: tuple[KaptureMap, KaptureFolder], workspace: Path
) -> None:
    opened, folder = queries
    data = folder.read()
    name = data.image_names()[0]
    (_, sensor), known = data.record_of(name), data.camera_of(name)
    half = ("UNKNOWN_CAMERA", str(known.width // 2), str(known.height // 2))
    write_sensors(
        folder.root, replace(data, sensors={**data.sensors, sensor: Sensor("", "camera", half)})
    )
    for features, part in (([workspace], 2), ([], 1)):  # without keypoints, the image's size
        found = KaptureQueries(KaptureFolder(folder.root, features_dirs=features), opened)
        camera = found.query(name).camera
        assert (camera.width, camera.height) == (known.width // part, known.height // part)


def test_cameras_are_scaled_to_smaller_images(
    queries: tuple[KaptureMap, KaptureFolder], caplog: pytest.LogCaptureFixture
) -> None:
    opened, folder = queries
    names, known = folder.read().image_names(), {}
    for name in names:
        camera, path = folder.read().camera_of(name), folder.image_path(name)
        known[name] = scaled_camera(camera, camera.width // 2, camera.height // 2)
        write_image(
            path.parent / "half.png",
            resized(read_image_rgb(path), camera.width // 2, camera.height // 2),
        )
        (path.parent / "half.png").replace(path)
    found = KaptureQueries(folder, opened)
    assert found.names == names and not found.unreadable
    for name in names:
        camera = found.query(name).camera
        assert (camera.width, camera.height) == (known[name].width, known[name].height)
        np.testing.assert_allclose(camera.params, opened.to_colmap(known[name]).params, atol=0.51)
        assert found.data().camera_of(name) == known[name]
    assert "scaled to their images" in caplog.text


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_keypoints_of_images_of_another_size_are_reported(
    queries: tuple[KaptureMap, KaptureFolder],
    workspace: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    scale: float,
) -> None:
    opened, folder = queries
    features = tmp_path / "features" / "local_features"
    shutil.copytree(workspace / "local_features" / "rootsift", features / "rootsift")
    for path in features.rglob("*.kpt"):
        (np.fromfile(path, np.float32) * np.float32(scale)).tofile(path)
    KaptureQueries(KaptureFolder(folder.root, features_dirs=[features.parent]), opened).check()
    assert ("extracted at another image size" in caplog.text) == (scale != 1.0)


def test_other_spellings_of_a_type_are_recognised(
    queries: tuple[KaptureMap, KaptureFolder], workspace: Path, tmp_path: Path
) -> None:
    opened, folder = queries
    source = workspace / "local_features" / "rootsift"
    shutil.copytree(source, tmp_path / "features" / "local_features" / "RootSIFT")
    folder = KaptureFolder(folder.root, features_dirs=[tmp_path / "features"])
    assert KaptureQueries(folder, opened).first_without_features("rootsift") is None
