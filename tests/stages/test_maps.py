"""Triangulated and lifted maps, and maps whose points move to features extracted again."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import kapture.io.csv
import numpy as np
import pytest
from corner import CAMERA, distance_to_walls, write_kapture

from megloc_kapture.errors import DataError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.features.vlad import VladOptions
from megloc_kapture.io.colmap import TriangulationOptions
from megloc_kapture.io.files import link_images
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    ImagePair,
    KaptureFolder,
    MatchesWriter,
    Observations,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.stages.global_features import extract_vlad, read_vocabulary
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.map_features import (
    copy_features,
    move_points,
    rows_at_their_places,
    rows_found_again,
)
from megloc_kapture.stages.map_points import lift_map, triangulate_map
from megloc_kapture.stages.scene import depth_records, index_map
from megloc_kapture.values import RigidTransform

IMAGES = ("left/0.png", "right/2.png", "right/4.png")


@pytest.fixture(scope="module")
def mapping(images_only: Any, tmp_path_factory: pytest.TempPathFactory) -> KaptureFolder:
    root = tmp_path_factory.mktemp("lifting")
    poses = {image: images_only.map_poses[image] for image in IMAGES}
    write_kapture(root / "mapping", poses, with_poses=True, with_depth=True)
    folder = KaptureFolder(root / "mapping", features_dirs=[root])
    extract_local_features([folder], RootSift(RootSiftOptions(max_keypoints=200)), root)
    return folder


def test_lifted_points_project_to_their_keypoints_and_lie_on_the_walls(
    mapping: KaptureFolder, tmp_path: Path
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
        world.with_matches("mapping"), ["rootsift"], tmp_path,
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
        triangulate_map(world.query(), ["rootsift"], tmp_path / "map", options)
    first = dict(sorted(mapping.read().trajectories.items())[:1])
    write_sensors(tmp_path / "one", replace(mapping.read(), trajectories=first))
    with pytest.raises(DataError, match="one: points need two or more images with poses"):
        triangulate_map(KaptureFolder(tmp_path / "one"), ["rootsift"], tmp_path, options)
    with pytest.raises(DataError, match="no matches of type 'r2d2'"):
        triangulate_map(matches, ["rootsift", "r2d2"], tmp_path / "map", options)
    assert not (tmp_path / "map").exists()


def test_keypoints_of_larger_images_are_reported(
    world: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    matches = world.with_matches("mapping")
    data = matches.read()
    halved = {
        key: replace(sensor, params=(model, *(f"{float(number) / 2:g}" for number in numbers)))
        for key, sensor in data.sensors.items()
        for model, *numbers in [sensor.params]
        if sensor.sensor_type == "camera"
    }
    write_sensors(tmp_path / "small", replace(data, sensors=halved, records_depth={}))
    small = KaptureFolder(tmp_path / "small", features_dirs=matches.features_dirs)
    with suppress(DataError):  # there may be no points
        triangulate_map(small, ["rootsift"], tmp_path / "map", TriangulationOptions())
    assert "keypoints of type 'rootsift' extend to 19" in caplog.text


def test_each_local_type_has_its_points(world: Any, write_features: Any, tmp_path: Path) -> None:
    # a second type with every other feature
    features = tmp_path / "features"
    for kind in ("keypoints", "descriptors"):
        whole = getattr(world.map(), kind)("rootsift")
        half = {image: whole.read(image)[::2] for image in whole.names}
        write_features(features, kind, "half", half)
    reader = world.with_matches("mapping").matches("rootsift")
    writer = MatchesWriter(features, "half", orphan=True)
    for a, b in reader.pairs:
        rows, scores = reader.read(a, b)
        even = (rows % 2 == 0).all(axis=1)
        writer.write(a, b, rows[even] // 2, scores[even].astype(np.float32))
    mapping = world.with_matches("mapping")
    mapping = mapping.with_features([*mapping.features_dirs, features])
    both, alone, options = tmp_path / "both", tmp_path / "alone", TriangulationOptions()
    counts = triangulate_map(mapping, ["rootsift", "half"], both, options, num_threads=3)
    half_counts = triangulate_map(mapping, ["half"], alone, options)
    found, first, second = KaptureFolder(both), world.map(), KaptureFolder(alone)
    found.validate(deep=True)
    points = np.concatenate([first.points3d(), second.points3d()])
    np.testing.assert_array_equal(found.points3d(), points)
    assert observations_of(found, "rootsift") == observations_of(first, "rootsift")
    assert observations_of(found, "half", len(first.points3d())) == observations_of(second, "half")
    assert counts["points_half"] == len(second.points3d()) > 30
    assert counts["observations_half"] == half_counts["observations"] and counts["pairs"] == 20


def observations_of(folder: KaptureFolder, name: str, offset: int = 0) -> list[Any]:
    seen = folder.observations()[name]
    columns = seen.point_ids - offset, seen.image_ids, seen.keypoint_ids
    return [seen.image_names, *(column.tolist() for column in columns)]


TYPE = "rootsift"


def published(source: KaptureFolder, root: Path) -> KaptureFolder:
    """Write a map without descriptors: only observed keypoints, in another order."""
    seen = source.observations()[TYPE]
    write_sensors(root, source.read())
    link_images(source.root, root)
    write_points3d(root, source.points3d())
    numbers = np.zeros(len(seen), np.int32)
    rng = np.random.default_rng(0)
    config = FeatureConfig("published", np.dtype(np.float32), 2)
    writer = FeatureWriter(root, "keypoints", TYPE, config)
    for row, image in enumerate(seen.image_names):
        here = np.flatnonzero(seen.image_ids == row)
        used = rng.permutation(np.unique(seen.keypoint_ids[here]))
        for number, keypoint in enumerate(used.tolist()):
            numbers[here[seen.keypoint_ids[here] == keypoint]] = number
        writer.write(image, source.keypoints(TYPE).read(image)[used, :2])
    again = Observations(seen.image_names, seen.point_ids, seen.image_ids, numbers)
    write_observations(root, {TYPE: again})
    return KaptureFolder(root)


def observed(folder: KaptureFolder) -> set[tuple[tuple[float, ...], str, tuple[float, ...]]]:
    seen, points = folder.observations()[TYPE], folder.points3d()
    found = set()
    for row, image in enumerate(seen.image_names):
        keypoints = folder.keypoints(TYPE).read(image)
        rows = seen.image_ids == row
        for point, keypoint in zip(seen.point_ids[rows], seen.keypoint_ids[rows], strict=True):
            found.add((tuple(points[point].tolist()), image, tuple(keypoints[keypoint].tolist())))
    return found


def test_the_vocabulary_and_its_whitening_are_copied(world: Any, tmp_path: Path) -> None:
    options = VladOptions(num_clusters=8, dimensions=3)
    extract_vlad(world.mapping(), [world.mapping()], TYPE, tmp_path, options)
    copy_features(world.mapping().with_features([tmp_path]), tmp_path / "map")
    copy = read_vocabulary(tmp_path / "map/reconstruction/global_features/vlad_rootsift")
    assert copy is not None and copy[0].size == 3 and copy[1].options == options


def test_observations_move_to_extracted_features(world: Any, tmp_path: Path) -> None:
    truth, reference = world.map(), published(world.map(), tmp_path / "reference")
    counts = move_points(reference, world.mapping(), TYPE, tmp_path / "map")
    made = KaptureFolder(tmp_path / "map")
    made.validate()
    assert counts["share_found_again"] == 1.0
    np.testing.assert_array_equal(made.points3d(), truth.points3d())
    # further keypoints at almost equal coordinates are other orientations
    assert observed(made) >= observed(truth)
    assert len(observed(made)) < 1.01 * len(observed(truth))
    for image in made.descriptors(TYPE).names:
        stored, extracted = (
            np.hstack([folder.keypoints(TYPE).read(image), folder.descriptors(TYPE).read(image)])
            for folder in (made, truth)
        )
        # observed keypoints only, as they were extracted
        assert set(map(tuple, stored)) < set(map(tuple, extracted))


def test_observations_without_a_feature_are_left_out(
    world: Any, write_features: Any, tmp_path: Path
) -> None:
    truth, reference = world.map(), published(world.map(), tmp_path / "reference")
    for kind in ("keypoints", "descriptors"):
        reader = getattr(world.mapping(), kind)(TYPE)
        first = {image: reader.read(image)[:600] for image in reader.names}
        write_features(tmp_path / "features", kind, TYPE, first)
    some = world.mapping().with_features([tmp_path / "features"])
    counts = move_points(reference, some, TYPE, tmp_path / "map")
    made = KaptureFolder(tmp_path / "map")
    made.validate()
    keypoints = some.keypoints(TYPE)
    kept = {name: set(map(tuple, keypoints.read(name).tolist())) for name in keypoints.names}
    expected = {row for row in observed(truth) if row[2] in kept[row[1]]}
    assert observed(made) >= expected and len(observed(made)) < 1.05 * len(expected)
    share = len(expected) / len(observed(truth))
    assert counts["share_found_again"] == pytest.approx(share, abs=0.02) and 0.5 < share < 1
    # points without observations are removed and the others numbered again
    points = made.points3d()
    assert counts["points"] == len(points) < len(truth.points3d())
    assert set(made.observations()[TYPE].point_ids.tolist()) == set(range(len(points)))


NONE = np.zeros((0, 2), np.float32)


@pytest.mark.parametrize(
    ("stored", "extracted", "rows"),
    [
        ([(1, 1), (5, 5), (9, 9)], [(9, 9.01), (1, 1), (7, 7), (20, 20)], [1, -1, 0]),
        # keypoints at equal coordinates are joined in order
        ([(1, 1), (1, 1), (2, 2), (1, 1)], [(2, 2), (1, 1), (3, 3), (1, 1)], [1, 3, 0, -1]),
        ([(1, 1)], NONE, [-1]),
    ],
)
def test_keypoints_are_found_by_coordinates(stored: Any, extracted: Any, rows: list[int]) -> None:
    found = rows_found_again(*(np.array(one, np.float32) for one in (stored, extracted)))
    assert found.dtype == np.int64 and found.tolist() == rows


def at_places(stored: Any, extracted: Any, shift: float) -> list[tuple[int, int]]:
    arrays = (np.array(one, np.float32) for one in (stored, extracted))
    of, rows = rows_at_their_places(*arrays, shift)
    assert of.dtype == rows.dtype == np.int64
    return list(zip(of.tolist(), rows.tolist(), strict=True))


def test_all_orientations_of_the_nearest_keypoint_are_found() -> None:
    stored = [(1, 1), (30, 30), (9, 9)]
    extracted = [(9, 9), (1.3, 1), (9.05, 9), (1.9, 1), (1.3, 1.02)]
    # (1.9, 1) is within the limit, but is another keypoint
    assert at_places(stored, extracted, 1.0) == [(0, 1), (0, 4), (2, 0), (2, 2)]
    assert at_places(stored, extracted, 0.2) == [(2, 0), (2, 2)]
    assert at_places([(30, 30)], extracted, 0.2) == []
    assert at_places([(1, 1)], NONE, 1.0) == []
