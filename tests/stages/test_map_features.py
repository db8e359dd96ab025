"""Maps without descriptors: their points are moved to features that are extracted again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.features.vlad import VladOptions
from megloc_kapture.io.files import link_images
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    KaptureFolder,
    Observations,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.stages.global_features import extract_vlad, read_vocabulary
from megloc_kapture.stages.map_features import (
    copy_features,
    move_points,
    rows_at_their_places,
    rows_found_again,
)

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
    with FeatureWriter(root, "keypoints", TYPE, config) as writer:
        for row, image in enumerate(seen.image_names):
            here = np.flatnonzero(seen.image_ids == row)
            used = rng.permutation(np.unique(seen.keypoint_ids[here]))
            for number, keypoint in enumerate(used.tolist()):
                numbers[here[seen.keypoint_ids[here] == keypoint]] = number
            writer.write(image, source.keypoints(TYPE).read(image)[used, :2])
    again = Observations(TYPE, seen.image_names, seen.point_ids, seen.image_ids, numbers)
    write_observations(root, {TYPE: again})
    return KaptureFolder(root)


def observed(folder: KaptureFolder) -> set[tuple[tuple[float, ...], str, tuple[float, ...]]]:
    """Return the point, image and keypoint coordinates of every observation."""
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
