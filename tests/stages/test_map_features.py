"""A model without descriptors as a map: its points are moved to features extracted again."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.features.rootsift import (
    RootSift,
    RootSiftOptions,
)
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
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.map_features import (
    copy_features,
    move_points,
    rows_at_their_places,
    rows_found_again,
)

TYPE = "rootsift"


def published(source: KaptureFolder, root: Path, *, shift_px: float = 0.0) -> KaptureFolder:
    """A map as a model is published that names only what sees points: fewer keypoints with other
    numbers, in another order, and no descriptors."""
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
            places = source.keypoints(TYPE).read(image)[used, :2]
            writer.write(image, places + np.float32(shift_px))
    again = Observations(TYPE, seen.image_names, seen.point_ids, seen.image_ids, numbers)
    write_observations(root, {TYPE: again})
    return KaptureFolder(root)


def triples(folder: KaptureFolder, local_type: str = TYPE) -> set[tuple[int, str, int]]:
    """Point, image, keypoint of every observation."""
    seen = folder.observations()[local_type]
    columns = np.stack([seen.point_ids, seen.image_ids, seen.keypoint_ids], axis=1)
    return {(point, seen.image_names[row], keypoint) for point, row, keypoint in columns.tolist()}


def place(folder: KaptureFolder, image: str, keypoint: int) -> tuple[float, ...]:
    """Where a keypoint is."""
    return tuple(_stored(folder, image)[keypoint].tolist())


@lru_cache(maxsize=20)
def _stored(folder: KaptureFolder, image: str) -> Any:
    return folder.keypoints(TYPE).read(image)


def test_the_vocabulary_and_its_whitening_are_copied(world: Any, tmp_path: Path) -> None:
    options = VladOptions(num_clusters=8, dimensions=3)
    extract_vlad(world.mapping(), [world.mapping()], TYPE, tmp_path, options)
    copy_features(world.mapping().with_features([tmp_path]), tmp_path / "map")
    copy = read_vocabulary(tmp_path / "map/reconstruction/global_features/vlad_rootsift")
    assert copy is not None and copy[0].size == 3 and copy[1].options == options


def test_without_descriptors_the_observations_move_to_the_features_extracted_anew(
    world, tmp_path: Path, folder_bytes: Any
) -> None:
    truth = world.map()
    reference = published(truth, tmp_path / "reference")
    counts = move_points(reference, world.mapping(), TYPE, tmp_path / "map")
    assert counts["share_found_again"] == 1.0
    made = KaptureFolder(tmp_path / "map")
    made.validate()
    assert made.types("descriptors") == [TYPE]
    np.testing.assert_array_equal(made.points3d(), truth.points3d())
    # the features that see points, as they were extracted: each one's number there
    number: dict[tuple[str, int], int] = {}
    for image in made.keypoints(TYPE).names:
        both = [
            np.hstack([folder.keypoints(TYPE).read(image), folder.descriptors(TYPE).read(image)])
            for folder in (truth, made)
        ]
        row_of = {row.tobytes(): index for index, row in enumerate(both[0])}
        assert len(row_of) == len(both[0]) > len(both[1])
        number |= {(image, index): row_of[row.tobytes()] for index, row in enumerate(both[1])}
    expected = triples(truth)
    found = {(point, image, number[image, keypoint]) for point, image, keypoint in triples(made)}
    assert expected <= found
    # what is more are other orientations of the same places
    where: dict[tuple[int, str], list[tuple[float, ...]]] = {}
    for point, image, keypoint in expected:
        where.setdefault((point, image), []).append(place(truth, image, keypoint))
    extra = found - expected
    assert 0 < len(extra) < 0.5 * len(expected)
    for point, image, keypoint in extra:
        off = np.array(where[point, image]) - place(truth, image, keypoint)
        assert np.linalg.norm(off, axis=1).min() < 0.1


def fewer(world: Any, root: Path, max_keypoints: int) -> KaptureFolder:
    """The mapping images with fewer features than the map was made of."""
    extractor = RootSift(RootSiftOptions(max_keypoints=max_keypoints))
    extract_local_features([world.mapping()], extractor, root)
    return world.mapping().with_features([root])


def test_what_is_not_found_again_is_left_out(world: Any, tmp_path: Path) -> None:
    truth = world.map()
    reference = published(truth, tmp_path / "reference")
    some = fewer(world, tmp_path / "features", 450)
    counts = move_points(reference, some, TYPE, tmp_path / "map")
    made = KaptureFolder(tmp_path / "map")
    made.validate()
    keypoints = some.keypoints(TYPE)
    kept = {name: set(map(tuple, keypoints.read(name).tolist())) for name in keypoints.names}
    seen = triples(truth)
    there = [(p, image) for p, image, k in seen if place(truth, image, k) in kept[image]]
    assert 0.5 < counts["share_found_again"] < 1
    assert counts["share_found_again"] == pytest.approx(len(there) / len(seen), abs=0.02)
    # points are numbered anew, without those that nothing sees any more
    points = made.points3d()
    assert counts["points"] == len(points) < len(truth.points3d())
    assert set(made.observations()[TYPE].point_ids.tolist()) == set(range(len(points)))
    # by coordinates, as their numbers are others
    expected = {(tuple(truth.points3d()[point].tolist()), image) for point, image in there}
    found = {(tuple(points[point].tolist()), image) for point, image, _ in triples(made)}
    assert found >= expected
    assert len(found) < 1.05 * len(expected)


def test_a_map_of_other_features_is_refused(world: Any, tmp_path: Path) -> None:
    reference = published(world.map(), tmp_path / "reference")
    some = fewer(world, tmp_path / "features", 100)
    with pytest.raises(DataError, match=r"extracting rootsift again finds keypoints of only \d+%"):
        move_points(reference, some, TYPE, tmp_path / "map")
    assert not (tmp_path / "map").exists()


# ---------------------------------------------------------------------------- keypoints by place


NOWHERE = np.zeros((0, 2), np.float32)


@pytest.mark.parametrize(
    ("stored", "extracted", "rows"),
    [
        ([(1, 1), (5, 5), (9, 9)], [(9, 9.01), (1, 1), (7, 7), (20, 20)], [1, -1, 0]),
        ([(1, 1), (5, 5)], [(1, 1), (5, 5)], [0, 1]),
        # those at one place are joined in order
        ([(1, 1), (1, 1), (2, 2), (1, 1)], [(2, 2), (1, 1), (3, 3), (1, 1)], [1, 3, 0, -1]),
        ([(1, 1)], NOWHERE, [-1]),
        (NOWHERE, [(1, 1)], []),
        (NOWHERE, NOWHERE, []),
    ],
)
def test_rows_are_found_by_place(stored: Any, extracted: Any, rows: list[int]) -> None:
    found = rows_found_again(*(np.array(one, np.float32) for one in (stored, extracted)))
    assert found.dtype == np.int64 and found.tolist() == rows


def at_places(stored: Any, extracted: Any, shift: float) -> list[tuple[int, int]]:
    arrays = (np.array(one, np.float32) for one in (stored, extracted))
    of, rows = rows_at_their_places(*arrays, shift)
    assert of.dtype == rows.dtype == np.int64
    return list(zip(of.tolist(), rows.tolist(), strict=True))


def test_all_orientations_of_the_nearest_place_are_found() -> None:
    stored = [(1, 1), (30, 30), (9, 9)]
    extracted = [(9, 9), (1.3, 1), (9.05, 9), (1.9, 1), (1.3, 1.02)]
    # (1.9, 1) is near enough, but another place
    assert at_places(stored, extracted, 1.0) == [(0, 1), (0, 4), (2, 0), (2, 2)]
    assert at_places(stored, extracted, 0.2) == [(2, 0), (2, 2)]
    assert at_places([(30, 30)], extracted, 0.2) == []
    assert at_places(NOWHERE, [(1, 1)], 1.0) == at_places([(1, 1)], NOWHERE, 1.0) == []
