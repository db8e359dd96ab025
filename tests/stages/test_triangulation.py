"""The map as a stage writes it: right, complete, and readable by kapture itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import kapture.io.csv
import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.colmap import TriangulationOptions
from megloc_kapture.io.kapture_store import (
    FeatureWriter,
    ImagePair,
    KaptureFolder,
    write_sensors,
)
from megloc_kapture.stages.triangulation import triangulate_map


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
