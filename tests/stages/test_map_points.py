"""Triangulated and lifted maps: accurate, complete and read by kapture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import kapture.io.csv
import numpy as np
import pytest
from corner import CAMERA, write_kapture

from megloc_kapture.errors import DataError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.io.colmap import TriangulationOptions
from megloc_kapture.io.kapture import (
    ImagePair,
    KaptureFolder,
    MatchesWriter,
    write_sensors,
)
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.map_points import lift_map, triangulate_map
from megloc_kapture.stages.scene import depth_records, index_map
from megloc_kapture.values import RigidTransform

IMAGES = ("left/0.png", "right/2.png", "right/4.png")


@pytest.fixture(scope="module")
def mapping(images_only: Any, tmp_path_factory: pytest.TempPathFactory) -> KaptureFolder:
    """Three images with depth maps and features."""
    root = tmp_path_factory.mktemp("lifting")
    poses = {image: images_only.map_poses[image] for image in IMAGES}
    write_kapture(root / "mapping", poses, with_poses=True, with_depth=True)
    folder = KaptureFolder(root / "mapping", features_dirs=[root])
    extract_local_features([folder], RootSift(RootSiftOptions(max_keypoints=200)), root)
    return folder


def test_lifted_points_project_to_their_keypoints_and_lie_on_the_walls(
    mapping: KaptureFolder, tmp_path: Path, distance_to_walls: Any
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    counts = lift_map(mapping, ["rootsift"], tmp_path)
    assert counts["images_with_depth"] == counts["images"] == 3
    folder = KaptureFolder(tmp_path)
    points, seen = folder.points3d()[:, :3], folder.observations()["rootsift"]
    assert len(seen) == len(points) == len(index_map(folder, "rootsift").xyz) > 400
    distances = distance_to_walls(points)
    assert np.median(distances) < 1e-3 and np.mean(distances < 0.05) > 0.95
    camera = pycolmap.Camera(
        model=CAMERA.model, width=CAMERA.width, height=CAMERA.height, params=CAMERA.params
    )
    for row, image in enumerate(seen.image_names):
        rows = seen.image_ids == row
        in_cam = folder.read().poses()[image].apply(points[seen.point_ids[rows]])
        keypoints = folder.keypoints("rootsift").read(image)[seen.keypoint_ids[rows], :2]
        np.testing.assert_allclose(camera.img_from_cam(in_cam), keypoints, atol=2e-3)


@pytest.mark.parametrize("offset_m", [0.0, 0.02])
def test_images_take_the_depth_of_their_moment_and_rig(
    mapping: KaptureFolder, offset_m: float
) -> None:
    data = mapping.read()
    offset = RigidTransform((1.0, 0.0, 0.0, 0.0), (offset_m, 0.0, 0.0))
    rigs = {"both": {"cam": RigidTransform.identity(), "depth": offset}}
    records = depth_records(replace(data, rigs=rigs))
    assert set(records) == set(IMAGES)
    for image, record in records.items():
        assert (record.path, record.camera) == (f"{image}.depth", CAMERA)
        np.testing.assert_allclose(record.image_from_depth.translation, [-offset_m, 0, 0])


KINDS = ("keypoints", "descriptors")


def arrays(folder: KaptureFolder, kind: str) -> dict[str, Any]:
    """The features of the type ``rootsift`` by image."""
    reader = getattr(folder, kind)("rootsift")
    return {image: reader.read(image) for image in reader.names}


def test_the_map_contains_everything_for_localization(world: Any) -> None:
    folder = KaptureFolder(world.root / "map")
    folder.validate(deep=True)
    assert folder.read().poses().keys() == world.map_poses.keys()
    ours, given = folder.read(), world.mapping().read()
    assert ours.sensors == given.sensors and ours.trajectories == given.trajectories
    for kind in KINDS:
        features, extracted = arrays(folder, kind), arrays(world.mapping(), kind)
        assert features.keys() == world.map_poses.keys()  # without the queries
        for image, array in features.items():
            np.testing.assert_array_equal(array, extracted[image])
    # features and images are links
    file = "keypoints/left/0.png.kpt"
    linked = folder.root / "reconstruction" / file.replace("/", "/rootsift/", 1)
    assert linked.samefile(world.features_dir / "local_features" / "rootsift" / file)
    link, source = (one.root / "sensors" / "records_data" for one in (folder, world.mapping()))
    assert link.is_symlink() and link.resolve() == source.resolve()
    assert folder.global_features("vlad_rootsift").names == sorted(world.map_poses)
    place = world.root / "map" / "reconstruction" / "global_features" / "vlad_rootsift"
    assert (place / "vocabulary.npy").is_file() and (place / "vlad.json").is_file()


def test_kapture_reads_the_map(world: Any) -> None:
    theirs = kapture.io.csv.kapture_from_dir(str(world.root / "map"))
    ours = world.map()
    np.testing.assert_array_equal(theirs.points3d.as_array(), ours.points3d())
    observations = ours.observations()["rootsift"]
    expected: dict[int, list[tuple[str, int]]] = {}
    columns = observations.point_ids, observations.image_ids, observations.keypoint_ids
    for point, image, keypoint in np.stack(columns, axis=1).tolist():
        expected.setdefault(point, []).append((observations.image_names[image], keypoint))
    assert {point: theirs.observations[point, "rootsift"] for point in expected} == expected
    assert len(theirs.observations) == len(expected)
    assert set(theirs.keypoints["rootsift"]) == set(world.map_poses)
    assert set(theirs.descriptors["rootsift"]) == set(world.map_poses)
    keypoints, descriptors = theirs.keypoints["rootsift"], theirs.descriptors["rootsift"]
    assert (keypoints.type_name, keypoints.dtype, keypoints.dsize) == ("rootsift", np.float32, 2)
    assert (descriptors.dsize, descriptors.metric_type) == (128, "L2")
    assert descriptors.keypoints_type == "rootsift"
    assert set(theirs.global_features["vlad_rootsift"]) == set(world.map_poses)
    for image, expected_pose in world.map_poses.items():
        pose = theirs.trajectories[ours.read().record_of(image)]
        np.testing.assert_allclose(pose.t_raw, expected_pose.translation, atol=1e-12)


def test_only_given_pairs_are_triangulated(world: Any, tmp_path: Path) -> None:
    pairs = [
        ImagePair("right/2.png", "left/0.png", 1.0),
        ImagePair("left/0.png", "left/1.png", 1.0),
    ]
    counts = triangulate_map(
        world.mapping(), world.with_matches("mapping"), "rootsift", tmp_path,
        TriangulationOptions(two_view_tracks=True), pairs=pairs,
    )  # fmt: skip
    assert counts["pairs"] == 2 and counts["points"] > 100
    observations = KaptureFolder(tmp_path).observations()["rootsift"]
    assert {observations.image_names[i] for i in set(observations.image_ids.tolist())} == {
        "left/0.png",
        "left/1.png",
        "right/2.png",
    }


def test_missing_poses_matches_and_depth_are_refused(
    world: Any, mapping: KaptureFolder, tmp_path: Path
) -> None:
    write_sensors(tmp_path / "no depth", replace(mapping.read(), records_depth={}))
    with pytest.raises(DataError, match="no mapping image has a pose and a depth map"):
        lift_map(KaptureFolder(tmp_path / "no depth"), ["rootsift"], tmp_path / "map")
    matches, options = world.with_matches("mapping"), TriangulationOptions()
    with pytest.raises(DataError, match="no mapping image has a pose"):
        triangulate_map(world.query(), matches, "rootsift", tmp_path / "map", options)
    with pytest.raises(DataError, match="no matches of type 'r2d2'"):
        triangulate_map(world.mapping(), matches, ["rootsift", "r2d2"], tmp_path / "map", options)
    assert not (tmp_path / "map").exists()


def test_each_local_type_has_its_points(world: Any, write_features: Any, tmp_path: Path) -> None:
    # a second type with every other feature
    features = tmp_path / "features"
    for kind in KINDS:
        half = {image: rows[::2] for image, rows in arrays(world.map(), kind).items()}
        write_features(features, kind, "half", half)
    reader = world.with_matches("mapping").matches("rootsift")
    with MatchesWriter(features, "half", orphan=True) as writer:
        for a, b in reader.pairs:
            rows, scores = reader.read(a, b)
            even = (rows % 2 == 0).all(axis=1)
            writer.write(a, b, rows[even] // 2, scores[even].astype(np.float32))
    mapping = KaptureFolder(world.root / "mapping", features_dirs=[world.features_dir, features])
    matches = mapping.with_features([world.root / "matches" / "mapping", features])
    both, alone, options = tmp_path / "both", tmp_path / "alone", TriangulationOptions()
    counts = triangulate_map(mapping, matches, ["rootsift", "half"], both, options, num_threads=3)
    half_counts = triangulate_map(mapping, matches, "half", alone, options)
    found, first, second = KaptureFolder(both), world.map(), KaptureFolder(alone)
    found.validate(deep=True)
    points = np.concatenate([first.points3d(), second.points3d()])
    np.testing.assert_array_equal(found.points3d(), points)
    assert observed(found, "rootsift") == observed(first, "rootsift")
    assert observed(found, "half", len(first.points3d())) == observed(second, "half")
    assert counts["points_half"] == len(second.points3d()) > 30
    assert counts["observations_half"] == half_counts["observations"] and counts["pairs"] == 20


def observed(folder: KaptureFolder, name: str, offset: int = 0) -> list[Any]:
    """Return the image names, points, image rows and keypoints of a type."""
    seen = folder.observations()[name]
    columns = seen.point_ids - offset, seen.image_ids, seen.keypoint_ids
    return [seen.image_names, *(column.tolist() for column in columns)]
