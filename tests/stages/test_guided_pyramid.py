"""Guided pyramid matching as a stage: rotated queries, stored features, pairs that are retried."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from itertools import combinations, product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.poses import movement
from megloc_kapture.io.colmap import TriangulationOptions
from megloc_kapture.io.images import read_image_rgb, write_image
from megloc_kapture.io.kapture import ImagePair, KaptureData, KaptureFolder, Sensor, write_sensors
from megloc_kapture.matching.guided_pyramid import GuidedPyramidOptions, ImageVariant
from megloc_kapture.matching.nearest_neighbours import NearestNeighbours
from megloc_kapture.matching.verification import KnownPoseOptions, TwoViewOptions
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.stages.guided_pyramid import PyramidMethod, pyramid_mapping, pyramid_queries
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.map_points import triangulate_map
from megloc_kapture.stages.matches import match_pairs
from megloc_kapture.stages.query_poses import LocalizationOptions, localize_from_matches
from megloc_kapture.values import Camera, ImageFeatures, LocalFeatures, Pose, RigidTransform

MAP_IMAGES = ("left/1.png", "right/2.png", "right/3.png")
QUERIES = ("query/a.png", "query/b.png")
TURNS = (0, 90, 270)  # one map image and the queries of ``turned`` are rotated
ALL = GuidedPyramidOptions(mode="all", scales=(0.5, 1.0), rotations_deg=TURNS)
MAX = GuidedPyramidOptions(mode="max", scales=(0.5, 1.0), rotations_deg=TURNS)
# counter-clockwise: the right side of the image becomes its top
TURN = RigidTransform.from_matrix(
    np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3)
)


class Upright:
    """Corners of one size whose descriptors are not invariant to rotation."""

    name = "upright"

    def __init__(self, most: int = 1000) -> None:
        self.calls, self.most = 0, most

    def extract(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> LocalFeatures:
        self.calls += 1
        assert self.calls <= self.most, "extracted again without need"
        if min(image.shape[:2]) < 100:
            raise DataError("smaller than 100 pixels")
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        wanted = None if mask is None else mask.astype(np.uint8)
        corners = cv2.goodFeaturesToTrack(gray, 500, 0.005, 4, mask=wanted)
        corners = np.zeros((0, 1, 2), np.float32) if corners is None else corners
        keypoints = [cv2.KeyPoint(float(x), float(y), 7.0, 0.0) for x, y in corners[:, 0]]
        keypoints, found = cv2.SIFT.create().compute(gray, keypoints)
        xy = np.array([keypoint.pt for keypoint in keypoints], np.float32).reshape(-1, 2)
        values = np.zeros((0, 128), np.float32) if found is None else found / 512.0
        return LocalFeatures(xy + np.float32(0.5), np.ones(len(xy), np.float32), values)


NEVER = Upright(most=0)


class Scene:
    """A map of the corner and its queries, rotated or not, matched by upright features."""

    def __init__(self, root: Path, world: Any) -> None:
        self.root, self.world = root, world

    def folder(self, name: str, *more: str) -> KaptureFolder:
        folders = [self.root / each for each in ("features", f"{name}_matches", *more)]
        return KaptureFolder(self.root / name, features_dirs=folders)

    def mapping(self) -> KaptureFolder:
        return self.folder("mapping")

    def pairs(self, name: str) -> list[ImagePair]:
        if name == "mapping":
            return [ImagePair(*pair, 1.0) for pair in combinations(MAP_IMAGES, 2)]
        queries = self.folder(name).read().image_names()
        return [ImagePair(*pair, 1.0) for pair in product(queries, MAP_IMAGES)]

    def retry(
        self,
        name: str,
        output: Path,
        *,
        mapping: KaptureFolder | None = None,
        query: KaptureFolder | None = None,
        pairs: list[ImagePair] | None = None,
        num_found: dict[tuple[str, str], int] | None = None,
        **more: Any,
    ) -> dict[str, float]:
        mapping, pairs = mapping or self.mapping(), pairs or self.pairs(name)
        num_found = num_found or Counter()
        with single_threaded():
            if name == "mapping":
                how = method(**{"verification": KnownPoseOptions()} | more)
                return pyramid_mapping(mapping, pairs, "upright", how, output, num_found=num_found)
            query = query or self.folder(name)
            how = method(**more)
            return pyramid_queries(
                query, mapping, pairs, "upright", how, output, num_found=num_found
            )


def method(**more: Any) -> PyramidMethod:
    how = {"extractor": Upright(), "matcher": NearestNeighbours()}
    return PyramidMethod(**how | {"verification": TwoViewOptions(), "options": ALL} | more)


def write_images(
    root: Path,
    source: KaptureFolder,
    poses: dict[str, RigidTransform],
    turned: Collection[str],
    prefix: str = "",
) -> None:
    data = KaptureData()
    for number, (image, pose) in enumerate(sorted(poses.items())):
        camera = source.read().camera_of(image)
        pixels = read_image_rgb(source.image_path(image))
        if image in turned:
            fx, fy, cx, cy = camera.params
            camera = Camera("PINHOLE", camera.height, camera.width, (fy, fx, cy, camera.width - cx))
            pixels = ImageVariant(1.0, 90).of_image(pixels)
            pose = TURN @ pose
        name = prefix + image
        data.sensors[f"cam{number}"] = Sensor.from_camera(camera)
        data.records_camera[number, f"cam{number}"] = name
        data.trajectories[number, f"cam{number}"] = pose
        write_image(root / "sensors" / "records_data" / name, pixels)
    write_sensors(root, data)


@pytest.fixture(scope="module")
def scene(images_only: Any, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    root = tmp_path_factory.mktemp("pyramid")
    made = Scene(root, images_only)
    map_poses = {image: images_only.map_poses[image] for image in MAP_IMAGES}
    write_images(root / "mapping", images_only.mapping(), map_poses, {"right/3.png"})
    queries = images_only.query_poses
    write_images(root / "turned", images_only.query(), queries, queries, "turned_")
    write_images(root / "easy", images_only.query(), queries, set())
    with single_threaded():
        folders = [made.mapping(), made.folder("turned"), made.folder("easy")]
        extract_local_features(folders, Upright(), root / "features")
        for name in ("mapping", "turned", "easy"):
            how = KnownPoseOptions() if name == "mapping" else TwoViewOptions()
            match_pairs(
                made.folder(name), made.mapping(), made.pairs(name), "upright",
                NearestNeighbours(), how, root / f"{name}_matches",
            )  # fmt: skip
    for name in ("turned", "mapping"):
        made.retry(name, root / f"{name}_all")
    return made


def recall(map_folder: KaptureFolder, query: KaptureFolder) -> float:
    truth = query.read().poses()
    pairs = [ImagePair(image, other, 1.0) for image in truth for other in MAP_IMAGES[:2]]
    types, options = ["upright-pyramid"], LocalizationOptions()
    with single_threaded():
        results = list(localize_from_matches(map_folder, query, pairs, types, options))
    near = [
        isinstance(found, Pose) and movement(truth[found.name], found.cam_from_world)[0] < 0.2
        for found in results
    ]
    return float(np.mean(near))


def test_rotated_queries_gain_matches_and_are_localized(scene: Scene, tmp_path: Path) -> None:
    places = [scene.root / "mapping_all"]
    mapping = KaptureFolder(scene.root / "mapping", features_dirs=places)
    with single_threaded():
        how, made = TriangulationOptions(), tmp_path / "map"
        with pytest.raises(DataError, match="no point could be triangulated"):
            triangulate_map(scene.mapping(), ["upright"], tmp_path / "base", how)
        counts = triangulate_map(mapping, ["upright-pyramid"], made, how)
        off = scene.retry("turned", tmp_path / "off", options=GuidedPyramidOptions())
        more = scene.retry("turned", tmp_path / "max", options=MAX)
    assert counts["observations"] > 100 and counts["mean_reprojection_error_px"] < 1.0
    assert off["pairs_tried"] == off["images_extracted_again"] == 0
    assert more["pairs_gained"] == 4
    found = {}
    for folder in (tmp_path / "off", tmp_path / "max", scene.root / "turned_all"):
        query = KaptureFolder(scene.root / "turned", features_dirs=[folder])
        found[folder.name] = recall(KaptureFolder(tmp_path / "map"), query)
    assert found["turned_all"] == found["max"] == 1.0 > found["off"]


def test_queries_are_matched_with_keypoints_added_to_the_map(scene: Scene, tmp_path: Path) -> None:
    larger = scene.folder("mapping", "mapping_all")
    seen: set[int] = set()

    class Watched(NearestNeighbours):
        def match(self, a: ImageFeatures, b: ImageFeatures) -> Any:
            seen.add(len(b.descriptors))
            return super().match(a, b)

    counts = scene.retry("turned", tmp_path / "out", mapping=larger, matcher=Watched())
    assert counts["pairs_gained"] >= 4
    keypoints = larger.keypoints("upright-pyramid")
    assert seen <= {keypoints.length(image) for image in MAP_IMAGES}
    base = scene.mapping().keypoints("upright")
    assert not seen <= {base.length(image) for image in MAP_IMAGES}


def test_masks_apply_to_variants_and_small_variants_are_skipped(
    scene: Scene, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = tmp_path / "masked"
    write_images(root, scene.world.query(), scene.world.query_poses, QUERIES, "turned_")
    for image in scene.folder("turned").read().image_names():
        mask = np.full((400, 300), 255, np.uint8)
        mask[:, :100] = 0
        write_image(root / "sensors" / "masks" / f"{image}.png", mask)
    query = KaptureFolder(root, features_dirs=scene.folder("turned").features_dirs)
    options = GuidedPyramidOptions(mode="all", scales=(0.2, 0.5, 1.0), rotations_deg=TURNS)
    scene.retry("turned", tmp_path / "out", query=query, mask_margin_px=10.0, options=options)
    larger = KaptureFolder(root, features_dirs=[tmp_path / "out"]).keypoints("upright-pyramid")
    for image in query.read().image_names():
        added = larger.read(image)[query.keypoints("upright").length(image) :]
        assert len(added) > 20
        assert (added[:, 0] >= 110).all()
    assert "0.2@0 0.2@90 0.2@270: smaller than 100 pixels" in caplog.text


def test_easy_pairs_are_not_retried(scene: Scene, tmp_path: Path) -> None:
    options = GuidedPyramidOptions(mode="all", min_matches=40)
    pairs = [pair for pair in scene.pairs("easy") if pair.map != "right/3.png"]
    easy = scene.retry("easy", tmp_path / "easy", pairs=pairs, extractor=NEVER, options=options)
    assert easy["pairs"] == 4 and easy["pairs_tried"] == 0
    found = KaptureFolder(scene.root / "easy", features_dirs=[tmp_path / "easy"])
    before, after = scene.folder("easy").keypoints("upright"), found.keypoints("upright-pyramid")
    for image in QUERIES:
        np.testing.assert_array_equal(after.read(image), before.read(image))


def test_pairs_are_retried_by_the_matches_that_are_counted(scene: Scene, tmp_path: Path) -> None:
    stored = scene.folder("turned").matches("upright")
    # all pairs but one have 100 matches before verification
    found = {(p.query, p.map): 100 for p in scene.pairs("turned")}
    hard = {pair for pair in found if len(stored.read(*pair)[0]) < 100}
    few = max(hard)
    found[few] = 99
    for count, expected in (("matches", {few}), ("verified", hard)):
        options = GuidedPyramidOptions(
            mode="all", scales=(0.5,), rotations_deg=(0,), min_matches=100, count=count
        )
        counts = scene.retry("turned", tmp_path / count, options=options, num_found=found)
        assert counts["pairs_tried"] == len(expected)
    assert len(hard) > 1
