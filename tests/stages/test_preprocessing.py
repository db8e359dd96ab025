"""Pre-processing as a stage: what is written and linked, what masks say, what is refused."""

from __future__ import annotations

import itertools
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import kapture.io.csv
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from megloc_kapture.errors import DataError, OptionError, OutputError, PluginError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.io.images import (
    image_size,
    read_depth_map,
    read_image_rgb,
    write_depth_map,
    write_image,
)
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.preprocessing.frames import carry_points
from megloc_kapture.preprocessing.masks import FixedMask
from megloc_kapture.stages.local_features import extract_local_features, mask_path, read_mask
from megloc_kapture.stages.preprocessing import (
    MaskOptions,
    PreprocessingOptions,
    preprocess_images,
)
from megloc_kapture.values import Camera, RigidTransform

Image = NDArray[np.uint8]
FISHEYE = Camera("OPENCV_FISHEYE", 240, 180, (120.0, 121.0, 119.0, 92.0, -0.02, 0.004, 0.0, 0.0))


def cloudy(seed: int, height: int = 180, width: int = 240) -> Image:
    rough = np.random.default_rng(seed).normal(size=(height, width, 3))
    smooth = cv2.GaussianBlur(rough, (0, 0), 2.5)
    return np.clip(128 + 45 * smooth / smooth.std(), 0, 255).astype(np.uint8)


class Halves:
    """A segmenter: sky above, then a car left and a road right; or what it is told."""

    name = "halves"
    classes = ("road", "sky", "car")
    dynamic = frozenset({"car"})

    def __init__(self, *told: Any) -> None:
        self.told = told

    def segment(self, image: Image) -> Any:
        if self.told:
            return self.told[0]
        labels = np.zeros(image.shape[:2], np.uint8)
        labels[: len(labels) // 2] = 1
        labels[len(labels) // 2 :, : labels.shape[1] // 2] = 2
        return labels


@pytest.fixture
def street(tmp_path: Path) -> KaptureFolder:
    """Two cameras on a rig, one of them a fisheye, with poses, depth and a mask of its own."""
    root = tmp_path / "street"
    front = Camera("PINHOLE", 320, 200, (250.0, 251.0, 160.0, 99.0))
    depth = Camera("SIMPLE_PINHOLE", 64, 48, (60.0, 32.0, 24.0))
    data = KaptureData(
        sensors={
            "front": Sensor.from_camera(front, name="the front"),
            "side": Sensor.from_camera(FISHEYE),
            "depth": Sensor.from_camera(depth, sensor_type="depth"),
            "gps": Sensor("", "gnss", ("EPSG:4326",)),
        },
        rigs={"car": dict.fromkeys(("front", "depth"), RigidTransform.identity())},
    )
    data.rigs["car"]["side"] = RigidTransform((0.0, 0.0, 1.0, 0.0), (0.1, 0.2, 0.3))
    records = root / "sensors" / "records_data"
    for t in range(3):
        data.records_camera[t, "front"] = f"front/{t}.png"
        data.records_camera[t, "side"] = f"side/{t}.jpg"
        data.records_depth[t, "depth"] = f"depth/{t}.depth"
        data.trajectories[t, "car"] = RigidTransform((1.0, 0.0, 0.0, 0.0), (float(t), 0.5, 0.0))
        write_image(records / "front" / f"{t}.png", cloudy(t, 200, 320))
        write_image(records / "side" / f"{t}.jpg", cloudy(10 + t))
        write_depth_map(records / "depth" / f"{t}.depth", np.full((48, 64), 2.0 + t, np.float32))
    own = np.full((200, 320), 255, np.uint8)
    own[:, :80] = 0
    write_image(root / "sensors" / "masks" / "front/1.png.png", own)
    write_sensors(root, data)
    return KaptureFolder(root)


def run(
    folder: KaptureFolder, output: Path, masks: dict[str, Any] | None = None, **options: Any
) -> tuple[KaptureFolder, dict[str, float]]:
    """Pre-process; keyword arguments that are no options go to the stage."""
    stage = {
        name: options.pop(name) for name in ("segmenter", "sequences", "work") if name in options
    }
    chosen = PreprocessingOptions(masks=MaskOptions(**masks or {}), **options)
    counts = preprocess_images(folder, output, chosen, **stage)
    return KaptureFolder(output), counts


def mask_of(folder: KaptureFolder, image: str) -> NDArray[np.bool_] | None:
    camera = folder.read().camera_of(image)
    return read_mask(mask_path(folder, image), (camera.height, camera.width))


def contents(root: Path) -> dict[Path, tuple[bytes, int]]:
    return {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in root.rglob("*.*")}


def test_by_default_everything_is_linked_and_the_original_is_never_touched(
    street: KaptureFolder, tmp_path: Path
) -> None:
    before = contents(street.root)
    new, counts = run(street, tmp_path / "new")
    place, original = (root / "sensors" / "records_data" for root in (new.root, street.root))
    assert place.is_symlink() and place.resolve() == original.resolve()
    for name in ("sensors.txt", "rigs.txt", "trajectories.txt", "records_camera.txt"):
        there = (new.root / "sensors" / name).read_bytes()
        assert there == (street.root / "sensors" / name).read_bytes()
    # the kapture's own mask is there again
    expected = mask_of(street, "front/1.png")
    assert expected is not None
    np.testing.assert_array_equal(mask_of(new, "front/1.png"), expected)
    assert mask_of(new, "front/0.png") is None
    share = pytest.approx(0.25 / 6)
    expected = {"images": 6, "images_changed": 0, "images_masked": 1}
    assert counts == {**expected, "masked_all": share, "masked_own": share}
    # the second run writes images where the first left a link to the originals
    new, _ = run(street, tmp_path / "new", max_size_px=160)
    assert image_size(new.image_path("front/0.png")) == (160, 96)
    for place in (street.root, street.root / "sensors"):
        with pytest.raises(OutputError, match="is inside the input kapture folder"):
            run(street, place)
    assert contents(street.root) == before


def test_kapture_reads_what_is_written(street: KaptureFolder, tmp_path: Path) -> None:
    new, counts = run(street, tmp_path / "new", max_size_px=160, undistort=True, segmenter=Halves())
    theirs = kapture.io.csv.kapture_from_dir(str(new.root))
    assert {len(theirs.records_camera), len(theirs.records_depth), len(theirs.trajectories)} == {3}
    assert theirs.sensors["front"].sensor_params[:3] == ["PINHOLE", "160", "96"]
    assert theirs.sensors["side"].sensor_params[0] == "PINHOLE"
    assert theirs.sensors["front"].name == "the front"
    assert "gps" in theirs.sensors
    for _, _, image in kapture.flatten(theirs.records_camera):
        path = kapture.io.records.get_image_fullpath(str(new.root), image)
        params = theirs.sensors[image.split("/")[0]].sensor_params
        assert image_size(path) == (int(params[1]), int(params[2]))
    # poses, rigs and depth stay
    before, after = street.read(), new.read()
    assert after.poses() == before.poses() and len(after.poses()) == 6
    assert after.rigs == before.rigs and after.records_depth == before.records_depth
    assert after.sensors["depth"] == before.sensors["depth"]
    place = new.depth_path("depth/2.depth")
    assert place.is_symlink()
    assert (read_depth_map(place, width=64, height=48) == 4.0).all()


def test_only_images_that_change_are_written(street: KaptureFolder, tmp_path: Path) -> None:
    new, counts = run(street, tmp_path / "new", undistort=True)
    assert new.image_path("front/0.png").is_symlink()
    assert not new.image_path("side/0.jpg").is_symlink()
    assert counts["images_changed"] == 3
    assert new.read().sensors["front"] == street.read().sensors["front"]
    assert new.read().camera_of("side/0.jpg").model == "PINHOLE"
    new.validate(deep=True)


def test_how_images_are_stored(small_kapture: Any, tmp_path: Path) -> None:
    """PNG keeps the very pixels, a JPEG loses next to nothing, and grey images stay grey."""
    picture, grey = cloudy(0), np.repeat(cloudy(0)[..., :1], 3, axis=2)
    folder = small_kapture({"a.jpg": picture, "gray.jpg": grey, "b.png": grey, "gray.png": grey})
    # what the JPEG holds
    write_image(folder.image_path("b.png"), read_image_rgb(folder.image_path("a.jpg")))
    cropped, _ = run(folder, tmp_path / "cropped", max_size_px=240)
    found, original = (read_image_rgb(where.image_path("b.png")) for where in (cropped, folder))
    np.testing.assert_array_equal(found, original[:176])
    new, _ = run(folder, tmp_path / "new", max_size_px=200)
    lossy, lossless = (
        cv2.cvtColor(read_image_rgb(new.image_path(image)), cv2.COLOR_RGB2GRAY)
        for image in ("a.jpg", "b.png")
    )
    assert cv2.PSNR(lossy, lossless) > 45
    for image in ("gray.png", "gray.jpg"):
        assert cv2.imread(str(new.image_path(image)), cv2.IMREAD_UNCHANGED).ndim == 2
    pixels = read_image_rgb(new.image_path("gray.png"))
    np.testing.assert_array_equal(pixels[..., 0], pixels[..., 2])


@pytest.mark.slow
def test_real_photographs_keep_their_geometry(shared_data: Path, tmp_path: Path) -> None:
    """A point at a keypoint's ray is seen at the keypoint carried over: no pose can move."""
    folder = KaptureFolder(shared_data / "scenes" / "fountain_p11" / "query")
    new, _ = run(folder, tmp_path / "new", max_size_px=1000)
    extractor = RootSift(RootSiftOptions(max_keypoints=1500))
    image = folder.read().image_names()[0]
    original, processed = (where.read().camera_of(image) for where in (folder, new))
    assert (original.width, original.height) == (1536, 1024)
    assert (processed.width, processed.height) == (1000, 664)
    old, found = (
        extractor.extract(read_image_rgb(where.image_path(image))).keypoints_px
        for where in (folder, new)
    )
    carried = carry_points(processed, original, found)
    distances, rows = cKDTree(old).query(carried)
    close = distances < 1.0
    assert close.mean() > 0.4
    # half a pixel's error would be 0.27 px here
    np.testing.assert_allclose((carried - old[rows])[close].mean(axis=0), 0, atol=0.03)


def test_all_masks_are_combined(
    street: KaptureFolder, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    user = tmp_path / "user"
    top = np.full((200, 320), 255, np.uint8)
    top[:20] = 0
    write_image(user / "front/1.png.png", top)
    new, counts = run(
        street,
        tmp_path / "new",
        {"user_masks": user, "fixed": (FixedMask(camera="front", bottom_share=0.1),)},
        segmenter=Halves(),
    )
    expected = np.ones((200, 320), bool)
    expected[100:, :160] = False
    expected[180:] = False
    np.testing.assert_array_equal(mask_of(new, "front/0.png"), expected)
    expected[:20] = False
    expected[:, :80] = False
    np.testing.assert_array_equal(mask_of(new, "front/1.png"), expected)
    side = mask_of(new, "side/0.jpg")
    assert side is not None and side[90:, :120].sum() == 0 and side[:90].all()
    assert counts["masked_user"] == pytest.approx(0.1 / 6)
    assert counts["masked_own"] == pytest.approx(0.25 / 6)
    assert counts["masked_fixed"] == pytest.approx(0.1 / 2)
    assert counts["masked_classes"] == pytest.approx(0.25)
    assert counts["images_masked"] == 6
    # a mask that was drawn, of a pattern of images
    drawn = np.full((180, 240), 255, np.uint8)
    drawn[:, 200:] = 0
    write_image(tmp_path / "drawn" / "side.png", drawn)
    fixed = (
        FixedMask(camera="side/[01].jpg", file=tmp_path / "drawn" / "side.png"),
        FixedMask(camera="rear", bottom_share=0.5),
    )
    new, counts = run(street, tmp_path / "of_pattern", {"fixed": fixed})
    np.testing.assert_array_equal(mask_of(new, "side/0.jpg"), drawn > 0)
    assert mask_of(new, "side/2.jpg") is None and mask_of(new, "front/0.png") is None
    assert caplog.messages == ["a fixed mask matches no image: rear"]


def test_masks_are_8_bit_and_0_is_ignored(street: KaptureFolder, tmp_path: Path) -> None:
    """COLMAP's convention; and the features' stage obeys what this one wrote."""
    fixed = (FixedMask(camera="front", polygon=((0, 0), (0.5, 0), (0.5, 1), (0, 1))),)
    new, _ = run(street, tmp_path / "new", {"fixed": fixed}, max_size_px=160)
    path = new.root / "sensors" / "masks" / "front/0.png.png"
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint8 and stored.shape == (96, 160)
    assert (stored[:, :80] == 0).all() and (stored[:, 80:] == 255).all()
    extractor = RootSift(RootSiftOptions(max_keypoints=200))
    extract_local_features([new], extractor, tmp_path / "features")
    seen = KaptureFolder(new.root, features_dirs=[tmp_path / "features"]).keypoints("rootsift")
    assert seen.read("front/0.png")[:, 0].min() >= 80
    assert seen.read("side/0.jpg")[:, 0].min() < 80


def test_classes_are_kept_for_reports(street: KaptureFolder, tmp_path: Path) -> None:
    new, _ = run(street, tmp_path / "new", {"dynamic": ("sky",)}, segmenter=Halves())
    folder = new.root / "sensors" / "classes"
    labels = cv2.imread(str(folder / "side/1.jpg.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(labels, Halves().segment(cloudy(0)))
    mask = mask_of(new, "side/1.jpg")
    np.testing.assert_array_equal(mask, labels != 1)
    named = json.loads((folder / "classes.json").read_text())
    assert tuple(named["classes"]) == Halves.classes and named["dynamic"] == ["sky"]


def test_a_bonnet_is_found_with_the_maps_images(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Two queries are too few; with the map's images of the same camera there are enough."""

    def drive(name: str, count: int, seed: int, bonnet_px: int = 30) -> KaptureFolder:
        root = tmp_path / name
        camera = Camera("PINHOLE", 240, 180, (200.0, 200.0, 120.0, 90.0))
        data = KaptureData(sensors={"cam": Sensor.from_camera(camera)})
        for t in range(count):
            image = cloudy(seed + t)
            image[180 - bonnet_px :] = cloudy(7)[180 - bonnet_px :]
            data.records_camera[t, "cam"] = f"{t}.png"
            write_image(root / "sensors" / "records_data" / f"{t}.png", image)
        write_sensors(root, data)
        return KaptureFolder(root)

    mapping, query = drive("mapping", 12, 100), drive("query", 2, 200)
    few = "camera cam: it has 2 images; at least 10 of a sequence are needed"
    with pytest.raises(OptionError, match=few):
        run(query, tmp_path / "few", {"unchanging": True})
    # a strip that stands in where no region is found
    strip = {"unchanging": True, "fixed": ({"camera": "*", "bottom_share": 0.5, "fallback": True},)}
    for name, masks, sequences, first, last, remarks in (
        ("new", {"unchanging": True}, [mapping], 140, 150, ()),
        ("strip", strip, [], 90, 90, (few,)),
        ("found", strip, [mapping], 140, 150, ()),
    ):
        new, counts = run(query, tmp_path / name, masks, sequences=sequences)
        mask = mask_of(new, "1.png")
        assert mask is not None and not mask[last:].any() and mask[:first].all()
        assert tuple(caplog.messages) == remarks
        caplog.clear()
        if name == "new":
            assert counts["masked_unchanging"] == pytest.approx(1 - mask.mean())
    new, counts = run(drive("without", 11, 0, bonnet_px=0), tmp_path / "none", {"unchanging": True})
    assert counts["images_masked"] == 0
    assert not (new.root / "sensors" / "masks").exists()
    assert "no static region" in caplog.text


def test_broken_inputs_are_named(street: KaptureFolder, tmp_path: Path) -> None:
    numbers = itertools.count()

    def refused(message: str, masks: dict[str, Any] | None = None, **options: Any) -> DataError:
        with pytest.raises(DataError, match=message) as caught:
            run(street, tmp_path / f"new{next(numbers)}", masks, **options)
        return caught.value

    mask = street.root / "sensors" / "masks" / "front/1.png.png"
    content = mask.read_bytes()
    write_image(mask, np.zeros((10, 20), np.uint8))
    assert refused("mask is 20x10, its image 320x200").path == mask
    mask.write_bytes(content[: len(content) // 2])
    assert refused("not an image").path == mask
    mask.write_bytes(content)
    assert refused("no such mask", {"fixed": (FixedMask(camera="side", file="x.png"),)}).path
    assert refused("no such folder of masks", {"user_masks": tmp_path / "absent"}).path
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "front/0.png.png" in str(refused("no mask of any image", {"user_masks": empty}))
    image = street.image_path("side/1.jpg")
    picture = image.read_bytes()
    image.write_bytes(picture[:-100])
    assert refused("broken", undistort=True).path == image
    write_image(image, cloudy(0, 90, 120))
    for options in ({}, {"undistort": True}):
        assert refused("image is 120x90, its camera expects 240x180", **options).path == image
    os.unlink(image)
    assert refused("no such image").path == image
    image.write_bytes(picture)
    # an image that changes keeps its name, whatever its suffix
    data = street.read()
    gif = {**data.records_camera, (0, "front"): "front/0.gif"}
    write_sensors(street.root, replace(data, records_camera=gif))
    street.image_path("front/0.png").rename(street.image_path("front/0.gif"))
    street = KaptureFolder(street.root)
    run(street, tmp_path / "linked", undistort=True)
    run(street, tmp_path / "smaller", max_size_px=160)
    assert image_size(tmp_path / "smaller" / "sensors" / "records_data" / "front/0.gif")[0] == 160
    os.unlink(street.depth_path("depth/1.depth"))
    assert "depth/1.depth" in str(refused("no such depth map", undistort=True))
    data = street.read()
    data.sensors["side"] = Sensor("", "camera", ("UNKNOWN_CAMERA", "240", "180"))
    write_sensors(street.root, data)
    street = KaptureFolder(street.root)
    refused("'side' of image 'side/0.jpg': camera is not calibrated", undistort=True)


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (np.zeros((4, 4), np.uint8), r"got uint8 \(4, 4\), expected uint8 \(200, 320\)"),
        (np.full((200, 320), 3, np.uint8), "label 3, but there are 3 classes"),
    ],
)
def test_what_a_segmenter_must_not_return(
    street: KaptureFolder, tmp_path: Path, labels: Any, message: str
) -> None:
    with pytest.raises(PluginError, match=rf"'halves' on image front/0\.png: .*{message}"):
        run(street, tmp_path / "new", segmenter=Halves(labels))


def test_classes_that_nobody_knows(street: KaptureFolder, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="no class 'bicycle'; it has: road, sky, car"):
        run(street, tmp_path / "new", {"dynamic": ("car", "bicycle")}, segmenter=Halves())
    with pytest.raises(PluginError, match="no plugin 'nobody'"):
        run(street, tmp_path / "new", {"segmenter": {"name": "nobody"}})
