"""One kapture folder: lazy reading and the checks across its files."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.images import write_image
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    KaptureFolder,
    MatchesWriter,
    Observations,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.values import RigidTransform
from tests.worlds import one_camera

FLOAT = np.dtype("float32")
IMAGES = ("a.jpg", "b/c.jpg")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A complete small kapture: 2 images with 5 keypoints each, 3 points."""
    root = tmp_path / "map"
    write_sensors(root, one_camera(IMAGES, RigidTransform.identity()))
    for image in IMAGES:
        write_image(root / "sensors/records_data" / image, np.full((6, 8, 3), 100, np.uint8))
    keypoints = FeatureWriter(root, "keypoints", "T", FeatureConfig("k", FLOAT, 2))
    descriptors = FeatureWriter(root, "descriptors", "T", FeatureConfig("d", FLOAT, 4, "T"))
    features = FeatureWriter(root, "global_features", "G", FeatureConfig("g", FLOAT, 3))
    matches = MatchesWriter(root, "T")
    for image in IMAGES:
        keypoints.write(image, np.ones((5, 2)))
        descriptors.write(image, np.ones((5, 4)))
        features.write(image, np.ones(3))
    matches.write(*IMAGES, np.array([[0, 4], [3, 1]]), np.ones(2))
    write_points3d(root, np.ones((3, 3)))
    write_points(root)
    return root


def write_points(root: Path, *extra: tuple[int, int, int]) -> None:
    """Observations: two good ones and the given (point, image, keypoint)."""
    points, images, keypoints = np.array([(0, 0, 0), (2, 1, 4), *extra]).T
    write_observations(root, {"T": Observations(IMAGES, points, images, keypoints)})


def test_a_complete_kapture_is_valid_and_its_parts_are_listed(root: Path) -> None:
    folder = KaptureFolder(root)
    folder.validate()
    folder.validate(deep=True)
    assert folder.read() is folder.read()
    assert folder.image_path("b/c.jpg") == root / "sensors/records_data/b/c.jpg"
    kinds = ("keypoints", "descriptors", "global_features", "matches")
    assert [folder.types(kind) for kind in kinds] == [["T"], ["T"], ["G"], ["T"]]
    assert folder.keypoints("T").length("a.jpg") == 5
    assert folder.matches("T").pairs == [IMAGES]
    assert folder.has_points()
    assert folder.points3d().tolist() == [[1, 1, 1, 0, 0, 0]] * 3
    assert len(folder.observations()["T"]) == 2
    assert not KaptureFolder(root / "sensors").has_points()


def test_arrays_that_readers_share_are_read_only(root: Path) -> None:
    folder = KaptureFolder(root)
    shared = folder.observations()["T"]
    for array in (folder.points3d(), shared.point_ids, shared.keypoint_ids):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_an_unknown_type_is_refused_with_the_known_types(root: Path) -> None:
    folder = KaptureFolder(root)
    reads = (folder.keypoints, folder.descriptors, folder.global_features, folder.matches)
    for read, present in zip(reads, "TTGT", strict=True):
        for name in ("X", "T/../T", ""):
            with pytest.raises(DataError, match=f"there are: {present} .--features-dir FOLDER"):
                read(name)


def test_paths_of_images_and_depth_maps_stay_inside_the_folder(root: Path) -> None:
    folder = KaptureFolder(root)
    for path_of in (folder.image_path, folder.depth_path):
        for name in ("../../sensors.txt", "/etc/passwd", "a/../b", ""):
            with pytest.raises(DataError):
                path_of(name)


def test_features_of_additional_folders_are_added(root: Path, tmp_path: Path) -> None:
    additional = tmp_path / "additional"
    config = FeatureConfig("k", FLOAT, 2)
    writer = FeatureWriter(additional, "keypoints", "T", config, orphan=True)
    writer.write("query.jpg", np.zeros((1, 2)))
    writer.write("a.jpg", np.zeros((9, 2)))
    matches = MatchesWriter(additional, "U", orphan=True)
    matches.write("a.jpg", "query.jpg", np.array([[0, 0]]), np.ones(1))
    folder = KaptureFolder(root, features_dirs=[additional, tmp_path / "absent"])
    keypoints = folder.keypoints("T")
    assert keypoints.names == ["a.jpg", "b/c.jpg", "query.jpg"]
    assert keypoints.length("a.jpg") == 5  # those in the kapture take precedence
    assert folder.types("matches") == ["T", "U"]
    assert len(folder.matches("U").read("query.jpg", "a.jpg")[0]) == 1


def test_parts_and_the_root_may_be_links(root: Path, tmp_path: Path) -> None:
    outside = tmp_path / "photos"
    (root / "sensors/records_data").rename(outside)
    (root / "sensors/records_data").symlink_to(outside)
    (outside / "a.jpg").rename(tmp_path / "moved.jpg")
    (outside / "a.jpg").symlink_to(tmp_path / "moved.jpg")
    for name in ("sensors/trajectories.txt", "reconstruction/matches/T"):
        moved = tmp_path / name.replace("/", "_")
        (root / name).rename(moved)
        (root / name).symlink_to(moved)
    (tmp_path / "link").symlink_to(root)
    KaptureFolder(tmp_path / "link").validate(deep=True)


@pytest.mark.parametrize(
    ("name", "share", "match"),
    [
        ("descriptors/T/a.jpg.desc", 0.8, r"a\.jpg\.desc: 4 descriptors for 5 keypoints"),
        ("keypoints/T/a.jpg.kpt", 0.9, r"a\.jpg\.kpt: .*truncated"),
        ("keypoints/T/a.jpg.kpt", None, r"'a\.jpg' has descriptors but no keypoints of type 'T'"),
        ("points3d.txt", None, r"points3d\.txt: cannot read: the file is missing"),
    ],
)
def test_damaged_files_are_named(root: Path, name: str, share: float | None, match: str) -> None:
    path = root / "reconstruction" / name
    content = path.read_bytes()
    path.unlink()
    if share is not None:
        path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DataError, match=match):
        KaptureFolder(root).validate()


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ((1, 1, 5), r"point 1, keypoint 5 of 'b/c\.jpg': .* 5 keypoints of type 'T'"),
        ((3, 0, 0), r"point 3, keypoint 0 of 'a\.jpg': there are 3 points"),
    ],
)
def test_observations_of_unknown_ids_are_named(root: Path, observation: Any, message: str) -> None:
    write_points(root, observation)
    with pytest.raises(DataError, match=rf"observations\.txt: {message}"):
        KaptureFolder(root).validate()


def test_observations_of_removed_images_are_ignored(root: Path) -> None:
    write_points(root, (1, 1, 4))
    for path in (root / "reconstruction").rglob("c.jpg.*"):
        path.unlink()
    KaptureFolder(root).validate()


def test_features_shared_by_two_images_of_one_name_are_refused(root: Path, tmp_path: Path) -> None:
    features = root / "reconstruction"
    for name in ("keypoints", "descriptors"):
        shutil.copytree(features / name / "T", tmp_path / "shared/local_features/T" / name)
    query = tmp_path / "query"
    shutil.copytree(root / "sensors", query / "sensors")
    shared = [KaptureFolder(place, features_dirs=[tmp_path / "shared"]) for place in (root, query)]
    shared[0].check_features_apart(shared[1])
    write_image(query / "sensors/records_data/a.jpg", np.full((6, 8, 3), 50, np.uint8))
    message = r"a\.jpg\.kpt: a\.jpg is a different image in .*--features-dir"
    with pytest.raises(DataError, match=message):
        shared[0].check_features_apart(shared[1])
