"""Queries of kapture folders, and plain photographs: what is read of them, and what is refused."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from megloc_kapture import KaptureMap, Localizer
from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.io.images import image_size, read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.io.output_folders import claim_folder
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.pipeline.query_folders import KaptureQueries, Photographs
from megloc_kapture.pipeline.results import Results
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.values import Camera
from tests.pipeline.runs import evaluated


def write(path: Path, *, width: int = 64, height: int = 48, focal_35mm: int = 0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if focal_35mm:
        exif.get_ifd(0x8769)[0xA405] = focal_35mm
    Image.new("RGB", (width, height), (90, 40, 200)).save(path, exif=exif)
    return path


def test_names_are_paths_below_what_was_given(tmp_path: Path) -> None:
    for name in ("b.jpg", "a dir/c.PNG", ".hidden/d.jpg", "._b.jpg", "raw.NEF"):
        write(tmp_path / "in" / name) if name != "raw.NEF" else (tmp_path / "in" / name).touch()
    (tmp_path / "in" / "notes.txt").write_text("no image")
    other = write(tmp_path / "e.jpg")
    photos = Photographs([tmp_path / "in", other])
    assert photos.names == ["a dir/c.PNG", "b.jpg", "e.jpg"]
    assert list(photos.unreadable) == ["raw.NEF"]
    assert ".nef cannot be read" in photos.unreadable["raw.NEF"].lower()


def test_links_are_followed_and_what_we_have_written_is_left_out(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    write(photos / "1.jpg")
    write(photos / "real" / "2.jpg")
    write(tmp_path / "elsewhere" / "3.jpg")
    (photos / "a link").symlink_to(tmp_path / "elsewhere")
    (photos / "again").symlink_to(photos / "real")
    (photos / "real" / "loop").symlink_to(photos)
    # a map of them, made below them
    claim_folder(photos / "map", kind="workspace")
    write(photos / "map" / "mapping" / "sensors" / "records_data" / "1.jpg")
    (photos / "kapture" / "sensors").mkdir(parents=True)
    (photos / "kapture" / "sensors" / "sensors.txt").touch()
    write(photos / "kapture" / "sensors" / "records_data" / "1.jpg")
    assert Photographs([photos]).names == ["1.jpg", "a link/3.jpg", "real/2.jpg"]


def test_images_of_one_size_and_focal_length_share_a_camera(tmp_path: Path) -> None:
    write(tmp_path / "1.jpg", focal_35mm=28)
    write(tmp_path / "2.jpg", focal_35mm=28)
    write(tmp_path / "3.jpg", focal_35mm=50)
    write(tmp_path / "4.jpg", width=48, height=64, focal_35mm=28)
    data = Photographs([tmp_path]).data()
    sensors = [data.record_of(f"{n}.jpg")[1] for n in (1, 2, 3, 4)]
    assert sensors[0] == sensors[1] and len(set(sensors)) == 3


def test_a_given_camera_is_of_the_stored_pixels(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x112] = 6
    Image.new("RGB", (64, 48)).save(tmp_path / "1.jpg", exif=exif)
    write(tmp_path / "2.jpg", width=32)
    camera = Camera.pinhole(64, 48, 50)
    photos = Photographs([tmp_path], camera)
    assert photos.names == ["1.jpg"]
    assert photos.query("1.jpg").read_image().shape == (48, 64, 3)
    assert photos.unreadable == {"2.jpg": "the image is 32x48, its camera says 64x48"}
    # without one it is turned, and what is written is
    photos = Photographs([tmp_path])
    assert photos.query("1.jpg").read_image().shape == (64, 48, 3)
    photos.write_images(tmp_path / "out")
    place = tmp_path / "out" / "sensors" / "records_data"
    assert image_size(place / "1.jpg") == (48, 64) and not (place / "1.jpg").is_symlink()
    assert (place / "2.jpg").readlink() == tmp_path / "2.jpg"


def test_frames_of_a_video(tmp_path: Path) -> None:
    film = cv2.VideoWriter(
        str(tmp_path / "walk.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48)
    )
    for number in range(25):
        film.write(np.full((48, 64, 3), 5 * number, np.uint8))
    film.release()
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    photos = Photographs([tmp_path], every=10)
    assert photos.names == [f"walk.avi/{n:06}.jpg" for n in (0, 10, 20)]
    assert list(photos.unreadable) == ["broken.mp4"]
    photos.write_images(tmp_path / "out")
    for number in (0, 10, 20):
        name = f"walk.avi/{number:06}.jpg"
        stored = read_image_rgb(tmp_path / "out" / "sensors" / "records_data" / name)
        assert (stored == photos.query(name).read_image()).all()
        assert abs(int(stored.mean()) - 5 * number) <= 2


@pytest.mark.parametrize("name", ["Paris, Texas.jpg", " x.jpg", "#1.jpg", "a\tb.jpg", "a\\b.jpg"])
def test_a_name_that_kapture_cannot_hold_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(DataError, match="rename the file"):
        Photographs([write(tmp_path / name)])


def test_refused(tmp_path: Path) -> None:
    one, two = write(tmp_path / "a" / "x.jpg"), write(tmp_path / "b" / "x.jpg")
    (tmp_path / "empty").mkdir()
    (tmp_path / "k" / "sensors").mkdir(parents=True)
    (tmp_path / "k" / "sensors" / "sensors.txt").touch()
    for paths, words in (
        ([one, two], "same name"),
        ([tmp_path / "nowhere"], "no such file"),
        ([tmp_path / "empty"], "no image or video"),
        ([tmp_path / "k"], "--query"),
    ):
        with pytest.raises(DataError, match=words):
            Photographs(paths)
    for every, words in ((3, "no video"), (0, "give 1 or more")):
        with pytest.raises(OptionError, match=words):
            Photographs([one], every=every)


FEW = "local_features.rootsift.options.max_keypoints=300"
PYRAMID = ("guided_pyramid.mode=all", "guided_pyramid.scales=[0.5,1.0]")
TYPES = ("rootsift", "rootsift-pyramid")


@pytest.fixture(scope="module")
def workspaces(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Workspace]:
    """A run without and one with guided pyramids, by the type that their maps are of."""
    root = tmp_path_factory.mktemp("pyramids")
    plain, guided = (options_of_preset(assignments=[FEW, *more]) for more in ((), PYRAMID))
    return {
        "rootsift": evaluated(root / "rootsift", scene, plain, last="map"),
        "rootsift-pyramid": evaluated(root / "pyramid", scene, guided, last="localization"),
    }


@pytest.mark.parametrize("of_map", TYPES)
@pytest.mark.parametrize("brought", TYPES)
def test_either_type_serves_the_other(
    workspaces: dict[str, Workspace], tmp_path: Path, of_map: str, brought: str
) -> None:
    place = workspaces["rootsift-pyramid"]
    query = tmp_path / "query"
    shutil.copytree(place.path("query") / "sensors", query / "sensors", symlinks=True)
    (query / "sensors" / "records_data").unlink()  # nothing can be extracted
    features = place.root if brought == "rootsift" else place.path("pyramid/query")
    folder = KaptureFolder(query, features_dirs=[features])
    opened = KaptureMap.open(workspaces[of_map].path("map"))
    assert list(opened.keypoints) == [of_map]
    queries = KaptureQueries(folder, opened)
    assert queries.lacking(of_map) is None
    assert queries.lacking("superpoint") == queries.names[0]
    queries.check()
    assert all(list(one.features) == [brought] for one in queries)
    results = Results(Localizer(opened, options=options_of_preset(assignments=[FEW])), folder)
    assert all(results.values())


def test_of_both_the_fitting_type_is_read_and_an_image_without_either_is_named(
    workspaces: dict[str, Workspace], tmp_path: Path
) -> None:
    place = workspaces["rootsift-pyramid"]
    both = place.folder("query", "", "pyramid/query")
    for of_map, expected in (("rootsift", TYPES[:1]), ("rootsift-pyramid", TYPES)):
        opened = KaptureMap.open(workspaces[of_map].path("map"))
        assert tuple(opened.stored_types()) == expected
        assert all(tuple(one.features) == expected for one in KaptureQueries(both, opened))
    features = Path(shutil.copytree(place.path("pyramid/query"), tmp_path / "features"))
    name = both.read().image_names()[2]
    for suffix in ("kpt", "desc"):
        (found,) = features.rglob(f"{name}.{suffix}")
        found.unlink()
    queries = KaptureQueries(KaptureFolder(place.path("query"), features_dirs=[features]), opened)
    assert queries.lacking("rootsift") == name
