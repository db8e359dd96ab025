"""Stages of images: pre-processing and masks, local and global features, rejected inputs."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import kapture.io.csv
import numpy as np
import pytest
from images import texture
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, MeglocError, OptionError, OutputError, PluginError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.features.vlad import VladOptions, Vocabulary, aggregate
from megloc_kapture.io.images import (
    image_size,
    read_depth_map,
    read_image_rgb,
    write_depth_map,
    write_image,
)
from megloc_kapture.io.kapture import KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.plugins import PluginChoice
from megloc_kapture.preprocessing.masks import FixedMask
from megloc_kapture.stages import work as devices
from megloc_kapture.stages.global_features import (
    describe_images,
    extract_global_features,
    extract_vlad,
    read_vocabulary,
    write_vocabulary,
)
from megloc_kapture.stages.local_features import extract_local_features, mask_path, read_mask
from megloc_kapture.stages.preprocessing import MaskOptions, PreprocessingOptions, preprocess_images
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Camera, LocalFeatures, RigidTransform
from tests.worlds import folder_bytes

Image = NDArray[np.uint8]
FISHEYE = Camera("OPENCV_FISHEYE", 240, 180, (120.0, 121.0, 119.0, 92.0, -0.02, 0.004, 0.0, 0.0))


class Halves:
    """A segmenter: sky above, a car at the bottom left and a road right; or given labels."""

    name = "halves"
    classes = ("road", "sky", "car")
    dynamic = frozenset({"car"})

    def __init__(self, labels: Any = None) -> None:
        self.labels = labels

    def segment(self, image: Image) -> Any:
        if self.labels is not None:
            return self.labels
        labels = np.zeros(image.shape[:2], np.uint8)
        labels[: len(labels) // 2] = 1
        labels[len(labels) // 2 :, : labels.shape[1] // 2] = 2
        return labels


@pytest.fixture
def street(tmp_path: Path) -> KaptureFolder:
    """Two cameras on a rig, one a fisheye, with poses, depth and a mask of one image."""
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
        write_image(records / "front" / f"{t}.png", texture(200, 320, t))
        write_image(records / "side" / f"{t}.jpg", texture(180, 240, 10 + t))
        write_depth_map(records / "depth" / f"{t}.depth", np.full((48, 64), 2.0 + t, np.float32))
    mask = np.full((200, 320), 255, np.uint8)
    mask[:, :80] = 0
    write_image(root / "sensors" / "masks" / "front/1.png.png", mask)
    write_sensors(root, data)
    return KaptureFolder(root)


def run(
    folder: KaptureFolder, output: Path, masks: dict[str, Any] | None = None, **options: Any
) -> tuple[KaptureFolder, dict[str, float]]:
    """Pre-process with options; sequences go to the stage, a segmenter replaces a plugin."""
    sequences, segmenter = options.pop("sequences", ()), options.pop("segmenter", None)
    plugin = {} if segmenter is None else {"segmenter": PluginChoice(name="replaced")}
    chosen = PreprocessingOptions(masks=MaskOptions(**plugin, **masks or {}), **options)
    with pytest.MonkeyPatch.context() as patch:
        if segmenter is not None:
            loaded = "megloc_kapture.stages.preprocessing.load_chosen"
            patch.setattr(loaded, lambda *_: segmenter)
        counts = preprocess_images(folder, output, chosen, sequences=sequences)
    return KaptureFolder(output), counts


def mask_of(folder: KaptureFolder, image: str) -> NDArray[np.bool_] | None:
    camera = folder.read().camera_of(image)
    return read_mask(mask_path(folder, image), (camera.height, camera.width))


def test_by_default_images_are_linked_and_originals_stay(
    street: KaptureFolder, tmp_path: Path
) -> None:
    before = folder_bytes(street.root)
    new, counts = run(street, tmp_path / "new")
    place, original = (root / "sensors" / "records_data" for root in (new.root, street.root))
    assert place.is_symlink() and place.resolve() == original.resolve()
    for name in ("sensors.txt", "rigs.txt", "trajectories.txt", "records_camera.txt"):
        there = (new.root / "sensors" / name).read_bytes()
        assert there == (street.root / "sensors" / name).read_bytes()
    # masks of the kapture are kept
    expected = mask_of(street, "front/1.png")
    assert expected is not None
    np.testing.assert_array_equal(mask_of(new, "front/1.png"), expected)
    assert mask_of(new, "front/0.png") is None
    share = pytest.approx(0.25 / 6)
    expected = {"images": 6, "images_changed": 0, "images_masked": 1}
    assert counts == {**expected, "masked_all": share, "masked_own": share}
    smaller, _ = run(street, tmp_path / "smaller", max_size_px=160)
    assert image_size(smaller.image_path("front/0.png")) == (160, 96)
    for place in (street.root, street.root / "sensors"):
        with pytest.raises(OutputError, match="is inside the input kapture folder"):
            run(street, place)
    assert folder_bytes(street.root) == before


def test_kapture_reads_the_output_and_only_changed_images_are_written(
    street: KaptureFolder, tmp_path: Path
) -> None:
    undistorted, counts = run(street, tmp_path / "undistorted", undistort=True)
    assert undistorted.image_path("front/0.png").is_symlink()
    assert not undistorted.image_path("side/0.jpg").is_symlink()
    assert counts["images_changed"] == 3
    new, _ = run(street, tmp_path / "new", max_size_px=160, undistort=True, segmenter=Halves())
    new.validate(deep=True)
    theirs = kapture.io.csv.kapture_from_dir(str(new.root))
    assert theirs.sensors["front"].sensor_params[:3] == ["PINHOLE", "160", "96"]
    assert theirs.sensors["side"].sensor_params[0] == "PINHOLE"
    assert theirs.sensors["front"].name == "the front" and "gps" in theirs.sensors
    for _, _, image in kapture.flatten(theirs.records_camera):
        path = kapture.io.records.get_image_fullpath(str(new.root), image)
        params = theirs.sensors[image.split("/")[0]].sensor_params
        assert image_size(path) == (int(params[1]), int(params[2]))
    before, after = street.read(), new.read()
    assert after.poses() == before.poses() and len(after.poses()) == 6
    assert after.rigs == before.rigs and after.records_depth == before.records_depth
    place = new.depth_path("depth/2.depth")
    assert place.is_symlink()
    assert (read_depth_map(place, width=64, height=48) == 4.0).all()


def test_png_is_exact_and_grey_images_stay_grey(small_kapture: Any, tmp_path: Path) -> None:
    grey = np.repeat(texture(180, 240, 0)[..., :1], 3, axis=2)
    folder = small_kapture({"colour.png": texture(180, 240, 0), "grey.png": grey, "grey.jpg": grey})
    cropped, _ = run(folder, tmp_path / "cropped", max_size_px=240)
    pixels = read_image_rgb(cropped.image_path("colour.png"))
    np.testing.assert_array_equal(pixels, texture(180, 240, 0)[:176])
    smaller, _ = run(folder, tmp_path / "smaller", max_size_px=200)
    for image in ("grey.png", "grey.jpg"):
        stored = cv2.imread(str(smaller.image_path(image)), cv2.IMREAD_UNCHANGED)
        assert stored.ndim == 2


def test_all_masks_are_combined(street: KaptureFolder, tmp_path: Path) -> None:
    user = tmp_path / "user"
    top = np.full((200, 320), 255, np.uint8)
    top[:20] = 0
    write_image(user / "front/1.png.png", top)
    new, counts = run(
        street,
        tmp_path / "new",
        {
            "user_masks": user,
            "fixed": (FixedMask(camera="front", polygon=((0, 0.9), (1, 0.9), (1, 1), (0, 1))),),
        },
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


def test_the_ego_vehicle_region_is_found_with_map_images(
    small_kapture: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def drive(name: str, count: int, seed: int) -> KaptureFolder:
        images = {f"{t}.png": texture(180, 240, seed + t) for t in range(count)}
        for image in images.values():
            image[150:] = texture(180, 240, 7)[150:]
        folder: KaptureFolder = small_kapture(images, name=name)
        return folder

    mapping, query = drive("mapping", 12, 100), drive("query", 2, 200)
    few = "camera cam: it has 2 images; at least 10 of a sequence are needed"
    with pytest.raises(OptionError, match=few):
        run(query, tmp_path / "few", {"unchanging": True})
    # a fallback for cameras without a region
    strip = {"unchanging": True, "fixed": ({"camera": "*", "bottom_share": 0.5, "fallback": True},)}
    for masks, sequences, first, last, remarks in (
        ({"unchanging": True}, [mapping], 140, 150, []),
        (strip, [], 90, 90, [few]),
    ):
        caplog.clear()
        new, _ = run(query, tmp_path / f"new{first}", masks, sequences=sequences)
        mask = mask_of(new, "1.png")
        assert mask is not None and not mask[last:].any() and mask[:first].all()
        assert caplog.messages == remarks


def test_damaged_files_are_named(street: KaptureFolder, tmp_path: Path) -> None:
    mask = street.root / "sensors" / "masks" / "front/1.png.png"
    image, small = street.image_path("side/1.jpg"), tmp_path / "small.png"
    write_image(small, texture(90, 120, 0))
    for message, path, content in (
        ("mask is 120x90, its image 320x200", mask, small.read_bytes()),
        ("image is 120x90, its camera says 240x180", image, small.read_bytes()),
        ("broken", image, image.read_bytes()[:-100]),
    ):
        before = path.read_bytes()
        path.write_bytes(content)
        with pytest.raises(DataError, match=message) as error:
            run(street, tmp_path / "new", undistort=True)
        assert path.name in str(error.value)
        path.write_bytes(before)


UNKNOWN_LABEL = Halves(np.full((200, 320), 3, np.uint8))


@pytest.mark.parametrize(
    ("masks", "segmenter", "message"),
    [
        ({"fixed": ({"camera": "side", "file": "x.png"},)}, None, "no such mask"),
        ({"user_masks": "absent"}, None, "no such folder of masks"),
        ({"user_masks": "."}, None, "no mask of any image.*front/0.png.png"),
        ({"dynamic": ("bicycle",)}, Halves(), "no class 'bicycle'; it has: road, sky, car"),
        ({}, UNKNOWN_LABEL, "'halves' on image front/0.png: .*label 3"),
    ],
)
def test_unusable_masks_are_refused(
    street: KaptureFolder,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    masks: dict[str, Any],
    segmenter: Any,
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(MeglocError, match=message):
        run(street, tmp_path / "new", masks, segmenter=segmenter)


def test_only_calibrated_cameras_are_undistorted(street: KaptureFolder, tmp_path: Path) -> None:
    data = street.read()
    data.sensors["side"] = Sensor("", "camera", ("UNKNOWN_CAMERA", "240", "180"))
    write_sensors(street.root, data)
    with pytest.raises(DataError, match="'side' of image 'side/0.jpg': camera is not calibrated"):
        run(KaptureFolder(street.root), tmp_path / "new", undistort=True)


EXTRACTOR = RootSift(RootSiftOptions(max_keypoints=800))


def noise(height: int = 120, width: int = 160, seed: int = 0) -> Image:
    coarse = np.random.default_rng(seed).integers(0, 256, (height // 8, width // 8, 3))
    return np.repeat(np.repeat(coarse, 8, axis=0), 8, axis=1).astype(np.uint8)


def test_masks_with_a_margin_remove_keypoints(small_kapture: Any, tmp_path: Path) -> None:
    folder = small_kapture({"a.png": noise(), "b.png": noise()})
    mask = np.zeros((120, 160, 3), dtype=np.uint8)
    mask[:, 80:] = 255
    write_image(folder.root / "sensors" / "masks" / "a.png.png", mask)
    output = tmp_path / "features"
    counts = extract_local_features([folder], EXTRACTOR, output)
    found = KaptureFolder(folder.root, features_dirs=[output]).keypoints("rootsift")
    masked, free = found.read("a.png"), found.read("b.png")
    assert len(masked) > 10 and masked[:, 0].min() >= 80
    assert free[:, 0].min() < 40
    unmasked = EXTRACTOR.extract(read_image_rgb(folder.image_path("a.png"))).keypoints_px
    removed = int((unmasked[:, 0] < 80).sum())
    assert removed > 10
    assert (counts["images_with_mask"], counts["keypoints_masked"]) == (1, removed)
    extract_local_features([folder], EXTRACTOR, tmp_path / "margin", mask_margin_px=10)
    strict = KaptureFolder(folder.root, features_dirs=[tmp_path / "margin"]).keypoints("rootsift")
    near = masked[:, 0] < 90
    assert near.any()
    np.testing.assert_array_equal(strict.read("a.png"), masked[~near])


def test_damaged_inputs_are_refused(small_kapture: Any, tmp_path: Path) -> None:
    def refused(message: str, *folders: KaptureFolder) -> DataError:
        with pytest.raises(DataError, match=message) as caught:
            extract_local_features(folders, EXTRACTOR, tmp_path / "features")
        assert not (tmp_path / "features").exists()
        return caught.value

    folder = small_kapture({"a.png": noise()})
    other = small_kapture({"a.png": noise()}, name="other")
    refused(r"image a\.png is in two kapture folders", folder, other)
    mask = folder.root / "sensors" / "masks" / "a.png.png"
    write_image(mask, np.zeros((60, 80, 3), dtype=np.uint8))
    assert refused("mask is 80x60, its image 160x120", folder).path == mask
    mask.unlink()
    folder.image_path("a.png").unlink()
    refused(r"a\.png", folder)
    camera = Camera("SIMPLE_PINHOLE", 320, 240, (300.0, 160.0, 120.0))
    larger = small_kapture({"a.png": noise()}, name="larger", camera=camera)
    refused(r"a.png: the image is 160x120, its camera says 320x240", larger)


OUTSIDE = "keypoints are not x, y within 160x120 pixels"


@pytest.mark.parametrize(
    ("keypoints", "descriptors", "message"),
    [
        ([(1, 1)] * 3, 2, r"got float32 \(2, 4\), expected .*3, N"),
        ([(20, 150)], 1, OUTSIDE),  # y, x
        ([(-9, 5)], 1, OUTSIDE),
        ([(7,)], 1, OUTSIDE),
    ],
)
def test_wrong_features_of_a_plugin_are_refused(
    small_kapture: Any, tmp_path: Path, keypoints: Any, descriptors: int, message: str
) -> None:
    class Mistaken:
        name = "mistaken"

        def extract(self, image: Image, mask: NDArray[np.bool_] | None = None) -> LocalFeatures:
            scores, values = np.ones(len(keypoints)), np.ones((descriptors, 4))
            return LocalFeatures(*map(np.float32, (keypoints, scores, values)))

    folder = small_kapture({"a.png": noise()})
    with pytest.raises(PluginError, match=rf"'mistaken' on image a\.png: .*{message}"):
        extract_local_features([folder], Mistaken(), tmp_path / "features")


class Colours:
    """Mean, deviation and first pixel of the colours: cheap and distinct."""

    name = "colours"

    def describe(self, image: np.ndarray) -> np.ndarray:
        flat = image.reshape(-1, 3).astype(np.float32)
        found = np.concatenate([flat.mean(axis=0), flat.std(axis=0), flat[0]])
        return np.asarray(found / np.linalg.norm(found), dtype=np.float32)


class ManyColours(Colours):
    name = "many_colours"

    def __init__(self) -> None:
        self.seen: list[int] = []

    def describe_many(self, images: Sequence[np.ndarray]) -> np.ndarray:
        self.seen.append(len(images))
        assert len({image.shape for image in images}) == 1
        return np.stack([self.describe(image) for image in images])


def read(folder: Path, name: str) -> dict[str, np.ndarray]:
    reader = KaptureFolder(folder, features_dirs=[folder]).global_features(name)
    return {image: reader.read(image).reshape(-1) for image in reader.names}


def test_images_are_described_alone_or_in_batches(
    world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(devices, "BATCH", 4)
    folders, many = [world.mapping(), world.query()], ManyColours()
    count = extract_global_features(folders, Colours(), tmp_path)
    extract_global_features(folders, many, tmp_path)
    singly, together = read(tmp_path, "colours"), read(tmp_path, "many_colours")
    assert singly.keys() == together.keys() == {**world.map_poses, **world.query_poses}.keys()
    assert count == len(singly) and max(many.seen) == 4
    for image, vector in singly.items():
        np.testing.assert_array_equal(vector, together[image])
    with ThreadPoolExecutor(3) as executor:
        extract_global_features(folders, Colours(), tmp_path / "threads", work=Work(executor))
    place = Path("global_features", "colours")
    assert folder_bytes(tmp_path / "threads" / place) == folder_bytes(tmp_path / place)


def test_wrong_vectors_of_a_plugin_are_refused() -> None:
    class Wrong:
        name = "wrong"

        def describe(self, image: np.ndarray) -> Any:
            return np.array([3, 4], np.float32)

    message = "'wrong' on image a.png: .*a vector of length 5, expected 1"
    with pytest.raises(PluginError, match=message):
        describe_images(Wrong(), [np.zeros((4, 4, 3), np.uint8)], ["a.png"])


VLAD = VladOptions(num_clusters=8)


PLACE = Path("global_features", "vlad_rootsift")


def assert_described_by(root: Path, folders: list[KaptureFolder], options: VladOptions) -> None:
    found = read_vocabulary(root / PLACE)
    assert found is not None
    vocabulary, settings = found
    assert (settings.local_type, settings.options) == ("rootsift", options)
    assert vocabulary.centres.shape == (8, 128)
    for folder in folders:
        stored = folder.with_features([root]).global_features("vlad_rootsift")
        for image in folder.read().image_names():
            expected = aggregate(folder.descriptors("rootsift").read(image), vocabulary)
            np.testing.assert_allclose(stored.read(image), expected, atol=1e-5)


def test_the_vocabulary_does_not_depend_on_the_queries(world: Any, tmp_path: Path) -> None:
    assert_described_by(world.features_dir, [world.mapping(), world.query()], VLAD)
    with single_threaded():
        extract_vlad(world.mapping(), [world.mapping()], "rootsift", tmp_path, VLAD)
    alone, both = folder_bytes(tmp_path / PLACE), folder_bytes(world.features_dir / PLACE)
    assert set(both) - set(alone) == {f"global_features/{q}.gfeat" for q in world.query_poses}
    assert all(both[name] == content for name, content in alone.items())


def test_vectors_of_descriptors_need_no_calibrated_camera(world: Any, tmp_path: Path) -> None:
    data = world.query().read()
    unknown = {name: Sensor("", "camera", ("UNKNOWN_CAMERA", "9", "9")) for name in data.sensors}
    write_sensors(tmp_path / "query", replace(data, sensors=unknown))
    query = KaptureFolder(tmp_path / "query", features_dirs=[world.features_dir])
    extract_vlad(world.mapping(), [query], "rootsift", tmp_path, VLAD)
    vectors = query.with_features([tmp_path]).global_features("vlad_rootsift")
    assert vectors.names == sorted(world.query_poses)


def test_a_map_without_descriptors_is_refused(
    world: Any, write_features: Any, tmp_path: Path
) -> None:
    few = dict.fromkeys(world.map_poses, np.zeros((0, 4), np.float32))
    write_features(tmp_path, "descriptors", "rootsift", few)
    folder = world.mapping().with_features([tmp_path])
    with pytest.raises(DataError, match="no descriptors of type rootsift"):
        extract_vlad(folder, [folder], "rootsift", tmp_path / "out", VLAD)


def test_a_stored_vocabulary_is_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    mean, projection, centres = (
        rng.normal(size=size).astype(np.float32) for size in (15, (4, 15), (3, 5))
    )
    vocabulary = Vocabulary(centres, mean, projection)
    write_vocabulary(tmp_path, vocabulary, "r2d2", VladOptions(num_clusters=3, dimensions=4))
    stored, settings = read_vocabulary(tmp_path) or pytest.fail("no vocabulary")
    assert (settings.local_type, settings.options.num_clusters) == ("r2d2", 3)
    np.testing.assert_array_equal(stored.centres, centres)
    np.testing.assert_array_equal(stored.mean, mean)
    np.testing.assert_array_equal(stored.projection, projection)
