"""The map as a stage writes it: right, complete, and readable by kapture itself."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import kapture.io.csv
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import project, px_from_cam
from megloc_kapture.io.colmap import TriangulationOptions
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    ImagePair,
    KaptureData,
    KaptureFolder,
    MatchesWriter,
    Sensor,
    write_sensors,
)
from megloc_kapture.matching.nearest_neighbours import NearestNeighbours
from megloc_kapture.matching.verification import KnownPoseOptions
from megloc_kapture.stages import triangulation
from megloc_kapture.stages.matches import match_pairs
from megloc_kapture.stages.triangulation import triangulate_map
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Camera, RigidTransform


def test_points_lie_on_the_walls(world: Any, distance_to_walls: Callable[..., Any]) -> None:
    distance = distance_to_walls(world.map().points3d()[:, :3])
    assert len(distance) > 300
    assert np.median(distance) < 0.005
    assert (distance < 0.05).mean() > 0.98


def test_observations_are_of_these_points(world: Any) -> None:
    folder = world.map()
    data = folder.read()
    xyz = folder.points3d()[:, :3]
    observations = folder.observations()["rootsift"]
    assert observations.image_names == tuple(sorted(world.map_poses))
    # COLMAP makes points of three images at least, and may take one of them out again
    lengths = np.bincount(observations.point_ids, minlength=len(xyz))
    assert lengths.min() >= 2 and (lengths >= 3).mean() > 0.95
    for image_id, image in enumerate(observations.image_names):
        here = observations.image_ids == image_id
        keypoints = folder.keypoints("rootsift").read(image)
        pixels = project(
            data.camera_of(image), world.map_poses[image], xyz[observations.point_ids[here]]
        )
        errors = np.linalg.norm(pixels - keypoints[observations.keypoint_ids[here]], axis=1)
        assert errors.max() < 4.5 and np.median(errors) < 0.5


def test_the_map_stands_alone(world: Any) -> None:
    """Everything that localizing needs is in it: images, features, vocabulary, no other folder."""
    folder = KaptureFolder(world.root / "map")
    folder.validate(deep=True)
    assert folder.read().poses().keys() == world.map_poses.keys()
    for kind in ("keypoints", "descriptors"):
        reader = getattr(folder, kind)("rootsift")
        assert reader.names == sorted(world.map_poses)  # and nothing of the queries
        for image in reader.names:
            expected = getattr(world.mapping(), kind)("rootsift").read(image)
            np.testing.assert_array_equal(reader.read(image), expected)
    assert folder.global_features("vlad_rootsift").names == sorted(world.map_poses)
    place = world.root / "map" / "reconstruction" / "global_features" / "vlad_rootsift"
    assert (place / "vocabulary.npy").is_file() and (place / "vlad.json").is_file()


def test_kapture_reads_the_map(world: Any) -> None:
    theirs = kapture.io.csv.kapture_from_dir(str(world.root / "map"))
    ours = world.map()
    np.testing.assert_array_equal(theirs.points3d.as_array(), ours.points3d())
    observations = ours.observations()["rootsift"]
    expected: dict[int, list[tuple[str, int]]] = {}
    for point, image, keypoint in zip(
        observations.point_ids.tolist(),
        observations.image_ids.tolist(),
        observations.keypoint_ids.tolist(),
        strict=True,
    ):
        expected.setdefault(point, []).append((observations.image_names[image], keypoint))
    assert {point: theirs.observations[point, "rootsift"] for point in expected} == expected
    assert len(theirs.observations) == len(expected)
    assert set(theirs.keypoints["rootsift"]) == set(world.map_poses)
    assert set(theirs.descriptors["rootsift"]) == set(world.map_poses)
    assert set(theirs.global_features["vlad_rootsift"]) == set(world.map_poses)
    for (_, image), (timestamp, sensor) in (
        ((None, image), ours.read().record_of(image)) for image in world.map_poses
    ):
        pose = theirs.trajectories[timestamp, sensor]
        np.testing.assert_allclose(pose.t_raw, world.map_poses[image].translation, atol=1e-12)


def test_images_are_linked(world: Any) -> None:
    link = world.root / "map" / "sensors" / "records_data"
    assert link.is_symlink()
    assert link.resolve() == (world.root / "mapping" / "sensors" / "records_data").resolve()


def test_two_runs_write_the_same_bytes(
    world: Any, tmp_path: Path, folder_bytes: Callable[[Path], dict[str, bytes]]
) -> None:
    for name, threads in (("one", 1), ("two", 2)):
        counts = triangulate_map(
            world.mapping(), world.with_matches("mapping"), "rootsift", tmp_path / name,
            TriangulationOptions(), num_threads=threads,
        )  # fmt: skip
        assert counts["images"] == 5 and counts["pairs"] == 10
        assert counts["points"] == len(world.map().points3d())
        assert counts["mean_track_length"] >= 3
        assert 0 < counts["mean_reprojection_error_px"] < 1
    assert folder_bytes(tmp_path / "one") == folder_bytes(tmp_path / "two")
    written = folder_bytes(tmp_path / "one" / "reconstruction")
    assert written == folder_bytes(world.root / "map" / "reconstruction")


def test_only_the_pairs_asked_for_are_used(world: Any, tmp_path: Path) -> None:
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


def test_parts_that_no_match_connects_give_the_map_of_the_whole(
    world: Any, tmp_path: Path, two_processes: Executor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two copies of the world in one map, whose images are matched across without any match."""
    source, reader = world.mapping(), world.with_matches("mapping").matches("rootsift")
    data = KaptureData(sensors=dict(source.read().sensors))
    for number, (image, pose) in enumerate(sorted(world.map_poses.items())):
        for copy in ("a", "b"):
            camera = source.read().record_of(image)[1]
            data.records_camera[number, camera + copy] = f"{copy}/{image}"
            data.sensors[camera + copy] = source.read().sensors[camera]
            data.trajectories[number, camera + copy] = pose
    write_sensors(tmp_path / "twice", data)
    features = tmp_path / "features"
    for kind in ("keypoints", "descriptors"):
        of_kind = getattr(source, kind)("rootsift")
        with FeatureWriter(features, kind, "rootsift", of_kind.config, orphan=True) as writer:  # type: ignore[arg-type]
            for image in world.map_poses:
                for copy in ("a", "b"):
                    writer.write(f"{copy}/{image}", of_kind.read(image))
    with MatchesWriter(features, "rootsift", orphan=True) as matches:
        for a, b in reader.pairs:
            for copy in ("a", "b"):
                matches.write(f"{copy}/{a}", f"{copy}/{b}", *reader.read(a, b))
            matches.write(f"a/{a}", f"b/{b}", np.zeros((0, 2), np.int64), np.zeros(0))
    twice = KaptureFolder(tmp_path / "twice", features_dirs=[features])
    options = TriangulationOptions()
    found = {}
    for name, at_once, executor in (("whole", 10, None), ("a", 5, None), ("b", 5, two_processes)):
        monkeypatch.setattr(triangulation, "_IMAGES_AT_ONCE", at_once)
        counts = triangulate_map(
            twice, twice, "rootsift", tmp_path / name, options, work=Work(executor)
        )
        found[name] = KaptureFolder(tmp_path / name)
        assert counts["images"] == 10 and counts["pairs"] == 2 * len(reader.pairs)
    parts = found["a"].points3d()
    num_points = len(world.map().points3d())
    assert len(parts) == 2 * num_points
    # each part is what the world alone gives, bit by bit
    np.testing.assert_array_equal(parts[:num_points], world.map().points3d())
    np.testing.assert_array_equal(parts[num_points:], world.map().points3d())
    np.testing.assert_array_equal(parts, found["b"].points3d())
    np.testing.assert_allclose(parts, found["whole"].points3d(), atol=1e-4)
    ours, whole = (found[name].observations()["rootsift"] for name in ("a", "whole"))
    assert ours.image_names == whole.image_names
    for rows in ("point_ids", "image_ids", "keypoint_ids"):
        np.testing.assert_array_equal(getattr(ours, rows), getattr(whole, rows))
    found["a"].validate()


def test_a_map_without_poses_is_refused(world: Any, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no mapping image has a pose"):
        triangulate_map(
            world.query(), world.with_matches("query"), "rootsift", tmp_path, TriangulationOptions()
        )
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("tar", [False, True])
def test_features_of_the_mapping_itself_are_copied_too(
    world: Any, tmp_path: Path, tar: bool
) -> None:
    """A mapping that brings its own features has them in ``reconstruction/``, perhaps as tar."""
    whole = tmp_path / "whole"
    source = world.mapping()
    write_sensors(whole, source.read())
    (whole / "sensors" / "records_data").symlink_to(source.root / "sensors" / "records_data")
    for kind in ("keypoints", "descriptors"):
        reader = getattr(source, kind)("rootsift")
        with FeatureWriter(whole, kind, "rootsift", reader.config, tar=tar) as writer:  # type: ignore[arg-type]
            for image in world.map_poses:
                writer.write(image, reader.read(image))
    counts = triangulate_map(
        KaptureFolder(whole), world.with_matches("mapping"), "rootsift", tmp_path / "map",
        TriangulationOptions(),
    )  # fmt: skip
    assert counts["points"] == len(world.map().points3d())
    found = KaptureFolder(tmp_path / "map")
    found.validate(deep=True)
    for kind in ("keypoints", "descriptors"):
        reader = getattr(found, kind)("rootsift")
        assert reader.names == sorted(world.map_poses)
        for image in reader.names:
            np.testing.assert_array_equal(
                reader.read(image), getattr(source, kind)("rootsift").read(image)
            )
    assert found.types("global_features") == []


def test_the_kaptures_own_features_come_before_those_beside_it(world: Any, tmp_path: Path) -> None:
    """Observations index what was triangulated, so the map must hold the same keypoints."""
    mapping = tmp_path / "mapping"
    source = world.mapping()
    write_sensors(mapping, source.read())
    (mapping / "sensors" / "records_data").symlink_to(source.root / "sensors" / "records_data")
    config = source.keypoints("rootsift").config
    image = "right/2.png"
    own = source.keypoints("rootsift").read(image)[::-1].copy()
    with FeatureWriter(mapping, "keypoints", "rootsift", config) as writer:
        writer.write(image, own)
    both = KaptureFolder(mapping, features_dirs=[world.features_dir])
    triangulate_map(
        both, world.with_matches("mapping"), "rootsift", tmp_path / "map", TriangulationOptions()
    )
    found = KaptureFolder(tmp_path / "map").keypoints("rootsift")
    np.testing.assert_array_equal(found.read(image), own)
    others = found.read("left/0.png")
    np.testing.assert_array_equal(others, source.keypoints("rootsift").read("left/0.png"))


def test_features_are_linked_and_not_written_twice(world: Any) -> None:
    kind = "local_features/rootsift/keypoints/left/0.png.kpt"
    linked = world.root / "map/reconstruction/keypoints/rootsift/left/0.png.kpt"
    assert linked.samefile(world.features_dir / kind)


def test_poses_and_intrinsics_are_exactly_those_given(world: Any) -> None:
    ours, given = world.map().read(), world.mapping().read()
    assert ours.sensors == given.sensors
    assert ours.trajectories == given.trajectories and len(ours.trajectories) == 5


def copy_type(source: KaptureFolder, name: str, output: Path, keep: slice) -> None:
    """Features of ``rootsift`` under another name, part of the keypoints only."""
    kinds: tuple[Any, ...] = ("keypoints", "descriptors")
    for kind in kinds:
        reader = getattr(source, kind)("rootsift")
        changes = {"name": name, "keypoints_type": name if kind == "descriptors" else None}
        config = replace(reader.config, **changes)
        with FeatureWriter(output, kind, name, config, orphan=True) as writer:
            for image in reader.names:
                writer.write(image, reader.read(image)[keep])


def test_each_of_several_types_has_points_of_its_own(
    world: Any, tmp_path: Path, folder_bytes: Callable[[Path], dict[str, bytes]]
) -> None:
    features = tmp_path / "features"
    copy_type(world.mapping(), "half", features, slice(None, None, 2))
    mapping = KaptureFolder(world.root / "mapping", features_dirs=[world.features_dir, features])
    reader = world.with_matches("mapping").matches("rootsift")
    with MatchesWriter(features, "half", orphan=True) as writer:
        for a, b in reader.pairs:
            rows, scores = reader.read(a, b)
            even = (rows % 2 == 0).all(axis=1)
            writer.write(a, b, rows[even] // 2, scores[even].astype(np.float32))
    places = [world.root / "matches" / "mapping", features]
    matches = KaptureFolder(world.root / "mapping", features_dirs=places)
    both, alone = tmp_path / "both", tmp_path / "alone"
    options = TriangulationOptions()
    counts = triangulate_map(mapping, matches, ["rootsift", "half", "half"], both, options)
    half = triangulate_map(mapping, matches, "half", alone, options)
    found, own = KaptureFolder(both), KaptureFolder(alone)
    found.validate(deep=True)
    num_first, num_second = len(world.map().points3d()), len(own.points3d())
    assert num_second > 30
    np.testing.assert_array_equal(
        found.points3d(), np.concatenate([world.map().points3d(), own.points3d()])
    )
    for name, folder, offset in (("rootsift", world.map(), 0), ("half", own, num_first)):
        ours, expected = found.observations()[name], folder.observations()[name]
        assert ours.image_names == expected.image_names
        np.testing.assert_array_equal(ours.point_ids, expected.point_ids + offset)
        np.testing.assert_array_equal(ours.image_ids, expected.image_ids)
        np.testing.assert_array_equal(ours.keypoint_ids, expected.keypoint_ids)
    assert found.types("keypoints") == found.types("descriptors") == ["half", "rootsift"]
    assert counts["points_rootsift"] == num_first and counts["points_half"] == num_second
    assert counts["points"] == num_first + num_second
    assert counts["observations"] == counts["observations_rootsift"] + half["observations"]
    assert counts["observations_half"] == half["observations"]
    assert counts["pairs"] == 20 and "points_half" not in half
    theirs = kapture.io.csv.kapture_from_dir(str(both))
    types = {key[1] for key in theirs.observations.key_pairs()}
    assert types == {"rootsift", "half"}
    again = tmp_path / "again"
    triangulate_map(mapping, matches, ["rootsift", "half"], again, options, num_threads=3)
    assert folder_bytes(both) == folder_bytes(again)


def test_a_type_that_is_not_there_is_named(world: Any, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no matches of type 'r2d2'"):
        triangulate_map(
            world.mapping(), world.with_matches("mapping"), ["rootsift", "r2d2"],
            tmp_path / "map", TriangulationOptions(),
        )  # fmt: skip
    assert not any(tmp_path.iterdir())


def assert_same_map(a: Path, b: Path, within: float) -> int:
    """Check that two maps have the same points and observations; the number of points."""
    ours, theirs = KaptureFolder(a), KaptureFolder(b)
    np.testing.assert_allclose(ours.points3d(), theirs.points3d(), atol=within)
    (name,) = ours.observations()
    first, second = ours.observations()[name], theirs.observations()[name]
    assert first.image_names == second.image_names
    for rows in ("point_ids", "image_ids", "keypoint_ids"):
        np.testing.assert_array_equal(getattr(first, rows), getattr(second, rows))
    return len(ours.points3d())


def per_camera(data: KaptureData) -> KaptureData:
    """The same poses, given for each camera instead of for the rig."""
    trajectories = {}
    for (timestamp, rig), rig_from_world in data.trajectories.items():
        for camera, camera_from_rig in data.rigs[rig].items():
            if (timestamp, camera) in data.records_camera:
                trajectories[timestamp, camera] = camera_from_rig @ rig_from_world
    return replace(data, rigs={}, trajectories=trajectories)


def test_a_rig_gives_the_points_that_its_cameras_give(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    xyz = rng.uniform((-4, -2, 6), (4, 2, 10), (300, 3))
    intrinsics = {
        "left": Camera("PINHOLE", 640, 480, (400.0, 402.0, 320.0, 240.0)),
        "right": Camera("OPENCV", 640, 480, (380.0, 379.0, 320.0, 240.0, -0.1, 0.02, 1e-3, 0.0)),
    }
    rig = {
        "left": RigidTransform((1.0, 0.0, 0.0, 0.0), (0.25, 0.0, 0.0)),
        "right": RigidTransform((0.995, 0.0, 0.0998749, 0.0), (-0.25, 0.01, 0.1)),
    }
    given = KaptureData(
        sensors={name: Sensor.from_camera(camera) for name, camera in intrinsics.items()},
        rigs={"car": rig},
    )
    for timestamp in range(4):
        turn = Rotation.from_rotvec([0.01, 0.05 * (timestamp - 2), 0.02]).as_matrix()
        pose = RigidTransform.from_matrix(turn, np.array([0.8 * (1.5 - timestamp), 0.05, 0.1]))
        given.trajectories[timestamp, "car"] = pose
        for name in rig:
            given.records_camera[timestamp, name] = f"{name}/{timestamp}.png"
    features = tmp_path / "features"
    config = FeatureConfig("dots", np.dtype("float32"), 2)
    shown: dict[str, Any] = {}
    with FeatureWriter(features, "keypoints", "dots", config, orphan=True) as writer:
        for (timestamp, name), image in given.records_camera.items():
            in_rig = given.trajectories[timestamp, "car"].apply(xyz)
            pixels = px_from_cam(intrinsics[name], rig[name].apply(in_rig))
            shown[image] = np.flatnonzero(((pixels > 0) & (pixels < (640, 480))).all(axis=1))
            writer.write(image, pixels[shown[image]].astype(np.float32))
    with MatchesWriter(features, "dots", orphan=True) as writer_of_matches:
        for a, b in combinations(sorted(shown), 2):
            _, rows_a, rows_b = np.intersect1d(shown[a], shown[b], return_indices=True)
            rows = np.stack([rows_a, rows_b], axis=1)
            writer_of_matches.write(a, b, rows, np.ones(len(rows), np.float32))
    for name, data in (("rig", given), ("camera", per_camera(given))):
        write_sensors(tmp_path / name, data)
        (tmp_path / name / "sensors" / "records_data").mkdir()
        folder = KaptureFolder(tmp_path / name, features_dirs=[features])
        options = TriangulationOptions()
        triangulate_map(folder, folder, "dots", tmp_path / f"{name}_map", options)
    assert assert_same_map(tmp_path / "rig_map", tmp_path / "camera_map", 1e-5) > 200
    # the rig stays a rig, and the points are where they were put
    rig_map = KaptureFolder(tmp_path / "rig_map")
    given_again = KaptureFolder(tmp_path / "rig").read()
    assert (
        rig_map.read().rigs == given_again.rigs and rig_map.read().rigs["car"].keys() == rig.keys()
    )
    assert rig_map.read().trajectories == given_again.trajectories
    distance, _ = cKDTree(xyz).query(rig_map.points3d()[:, :3])
    assert distance.max() < 1e-3


def test_virtual_gallery_given_per_rig_and_per_camera(shared_data: Path, tmp_path: Path) -> None:
    gallery = shared_data / "foreign_maps" / "virtual_gallery"
    for name, sensors in (("rig", gallery / "mapping_rig"), ("camera", gallery / "map")):
        whole = tmp_path / name
        ignored = shutil.ignore_patterns("records_data")
        shutil.copytree(sensors / "sensors", whole / "sensors", ignore=ignored)
        (whole / "sensors" / "records_data").mkdir()
        for kind in ("keypoints", "descriptors"):
            place = Path("reconstruction", kind)
            shutil.copytree(gallery / "map" / place, whole / place)
        folder = KaptureFolder(whole)
        pairs = [ImagePair(a, b, 1.0) for a, b in combinations(folder.read().image_names(), 2)]
        found = tmp_path / f"{name}_matches"
        match_pairs(
            folder, folder, pairs, "r2d2_500", NearestNeighbours(), KnownPoseOptions(), found
        )
        matches = KaptureFolder(whole, features_dirs=[found])
        options = TriangulationOptions()
        triangulate_map(folder, matches, "r2d2_500", tmp_path / f"{name}_map", options)
    assert not KaptureFolder(gallery / "map").read().rigs
    assert KaptureFolder(gallery / "mapping_rig").read().rigs
    # the two write the same poses with other digits
    assert assert_same_map(tmp_path / "rig_map", tmp_path / "camera_map", 1e-5) > 200
