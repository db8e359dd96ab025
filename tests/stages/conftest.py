"""A corner of a room, rendered exactly: two textured walls, five map images and two queries."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corner import pose_at, write_kapture
from numpy.typing import NDArray

from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.features.vlad import VladOptions
from megloc_kapture.io.colmap import TriangulationOptions
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    ImagePair,
    KaptureFolder,
    write_sensors,
)
from megloc_kapture.io.kapture.features import ArrayKind
from megloc_kapture.matching.nearest_neighbours import NearestNeighbours
from megloc_kapture.matching.verification import KnownPoseOptions, TwoViewOptions
from megloc_kapture.pipeline.executors import single_threaded
from megloc_kapture.stages.global_features import extract_vlad
from megloc_kapture.stages.image_pairs import (
    MappingPairsOptions,
    QueryPairsOptions,
    Retrieval,
    pair_map_images,
    pair_queries,
)
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.map_points import triangulate_map
from megloc_kapture.stages.matches import match_pairs
from megloc_kapture.stages.query_poses import LocalizationOptions, localize_from_matches
from megloc_kapture.stages.work import HERE, Work
from megloc_kapture.values import Camera, Failure, Pose, RigidTransform
from tests.worlds import one_camera

EXTRACTOR = RootSift(RootSiftOptions(max_keypoints=800))
VLAD = VladOptions(num_clusters=8)
BY_VLAD = Retrieval(("vlad_rootsift",))

MAP_POSES = {
    "left/0.png": pose_at((-1.5, 0.0, 0.0), -4, 1),
    "left/1.png": pose_at((-0.8, 0.2, 0.4), -2, -2),
    "right/2.png": pose_at((0.0, -0.2, 0.1), 0, 2),
    "right/3.png": pose_at((0.7, 0.1, 0.3), 3, 0),
    "right/4.png": pose_at((1.4, -0.1, 0.0), 5, -1),
}
QUERY_POSES = {
    "query/a.png": pose_at((-0.4, 0.05, 0.2), -1, 1),
    "query/b.png": pose_at((0.5, -0.1, 0.6), 2, -1),
}


@dataclass(frozen=True)
class World:
    root: Path
    map_poses: dict[str, RigidTransform]
    query_poses: dict[str, RigidTransform]

    @property
    def features_dir(self) -> Path:
        return self.root / "features"

    def mapping(self) -> KaptureFolder:
        return KaptureFolder(self.root / "mapping", features_dirs=[self.features_dir])

    def query(self) -> KaptureFolder:
        return KaptureFolder(self.root / "query", features_dirs=[self.features_dir])

    def map(self) -> KaptureFolder:
        return KaptureFolder(self.root / "map", features_dirs=[self.features_dir])

    def query_pairs(self) -> list[ImagePair]:
        return pair_queries(self.mapping(), self.query(), QueryPairsOptions(), retrieval=BY_VLAD)

    def localized(self, work: Work = HERE) -> list[Pose | Failure]:
        query, pairs = self.with_matches("query"), self.query_pairs()
        options, types = LocalizationOptions(), ["rootsift"]
        return list(localize_from_matches(self.map(), query, pairs, types, options, work=work))

    def with_matches(self, kind: str) -> KaptureFolder:
        places = [self.features_dir, self.root / "matches" / kind]
        return KaptureFolder(self.root / kind, features_dirs=places)


@pytest.fixture(scope="session")
def images_only(tmp_path_factory: pytest.TempPathFactory) -> World:
    """Two kapture folders with images only."""
    root = tmp_path_factory.mktemp("corner")
    write_kapture(root / "mapping", MAP_POSES, with_poses=True)
    write_kapture(root / "query", QUERY_POSES, with_poses=False)
    return World(root, MAP_POSES, QUERY_POSES)


@pytest.fixture(scope="session")
def world(images_only: World) -> World:
    """The scene with features, pairs, matches and a map, written by the stages."""
    scene = images_only
    with single_threaded():
        extract_local_features([scene.mapping(), scene.query()], EXTRACTOR, scene.features_dir)
        extract_vlad(
            scene.mapping(), [scene.mapping(), scene.query()], "rootsift", scene.features_dir, VLAD
        )
        pairs = pair_map_images(scene.mapping(), MappingPairsOptions(), retrieval=BY_VLAD)
        for first, some, how, name in (
            (scene.mapping(), pairs, KnownPoseOptions(), "mapping"),
            (scene.query(), scene.query_pairs(), TwoViewOptions(), "query"),
        ):
            output = scene.root / "matches" / name
            match_pairs(first, scene.mapping(), some, "rootsift", NearestNeighbours(), how, output)
        triangulate_map(
            scene.with_matches("mapping"), ["rootsift"], scene.root / "map",
            TriangulationOptions(),
        )  # fmt: skip
    return scene


@pytest.fixture(scope="session")
def write_features() -> Callable[..., None]:
    """Function that writes arrays by image as features of a type."""

    def write(root: Path, kind: ArrayKind, name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        like = next(iter(arrays.values()))
        keypoints_type = name if kind == "descriptors" else None
        metric = None if kind == "keypoints" else "L2"
        config = FeatureConfig(name, like.dtype, like.shape[-1], keypoints_type, metric)
        writer = FeatureWriter(root, kind, name, config, orphan=True)
        for image, array in arrays.items():
            writer.write(image, array)

    return write


@pytest.fixture
def small_kapture(tmp_path: Path) -> Callable[..., KaptureFolder]:
    """Function that writes images of one size (arrays by name) as a kapture folder."""

    def make(
        images: dict[str, NDArray[np.uint8]],
        *,
        name: str = "small",
        poses: dict[str, RigidTransform] | None = None,
        camera: Camera | None = None,
    ) -> KaptureFolder:
        height, width = next(iter(images.values())).shape[:2]
        shared = camera or Camera("SIMPLE_PINHOLE", width, height, (300.0, width / 2, height / 2))
        root = tmp_path / name
        write_sensors(root, one_camera(list(images), poses, camera=shared))
        for image, pixels in images.items():
            write_image(root / "sensors" / "records_data" / image, pixels)
        return KaptureFolder(root, features_dirs=[tmp_path / "features"])

    return make
