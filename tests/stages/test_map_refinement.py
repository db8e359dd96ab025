"""Map refinement on a wall with exact points, cameras and depth maps."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.dataset_tables import ImageGroup
from megloc_kapture.io.files import read_json_model
from megloc_kapture.io.images import write_depth_map
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    KaptureData,
    KaptureFolder,
    Observations,
    Sensor,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.io.kapture.points import read_point_covariances
from megloc_kapture.mapping.uncertainty import point_covariances
from megloc_kapture.stages.image_pairs import Restrictions
from megloc_kapture.stages.map_refinement import (
    MapRefinementOptions,
    RefinementReport,
    refine_map,
)
from megloc_kapture.values import Camera, RigidTransform

CAMERA = Camera("SIMPLE_RADIAL", 320, 240, (250.0, 160.0, 120.0, 0.02))
DEPTH_CAMERA = Camera("PINHOLE", 160, 120, (120.0, 120.0, 80.0, 60.0))
DEPTH_FROM_RIG = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.06, 0.01, 0.0))
WALL_M = 4.0
NUM_IMAGES, WITHOUT_DEPTH = 6, 5
ON_WALL, FLOATING, LIFTED, IN_HOLE = range(0, 40), range(40, 50), range(50, 60), range(60, 66)
NAMES = tuple(f"wall/{image}.png" for image in range(NUM_IMAGES))
UNCHECKED: dict[str, Any] = {"depth": {"max_sigmas": None}}
OFF = MapRefinementOptions.model_validate(UNCHECKED)


def pose(image: int) -> RigidTransform:
    return RigidTransform((1.0, 0.0, 0.0, 0.0), (-0.3 * image, 0.0, 0.0))


def write_wall(root: Path, *, unposed: Sequence[int] = ()) -> KaptureFolder:
    """Write six images in a row in front of a wall; each sees all points but the lifted ones.

    Points 60 to 65 float in front of a hole of the depth maps.
    """
    rng = np.random.default_rng(5)
    xyz = np.column_stack(
        [rng.uniform(-0.6, 2.1, 66), rng.uniform(-1.2, 1.2, 66), np.full(66, WALL_M)]
    )
    xyz[IN_HOLE.start :, 1] = rng.uniform(-0.1, 0.1, 6)
    floating = [*FLOATING, *IN_HOLE]
    xyz[floating] *= 0.5
    xyz[floating, 0] = rng.uniform(0.4, 1.1, 16)
    xyz[[*FLOATING], 1] = rng.uniform(0.3, 0.6, 10) * rng.choice([-1, 1], 10)
    data = KaptureData(
        sensors={
            "camera": Sensor.from_camera(CAMERA),
            "depth": Sensor.from_camera(DEPTH_CAMERA, sensor_type="depth"),
        },
        rigs={"rig": {"camera": RigidTransform.identity(), "depth": DEPTH_FROM_RIG}},
    )
    depth = np.full((120, 160), WALL_M, np.float32)
    depth[50:70] = 0.0
    keypoints = {}
    for image, name in enumerate(NAMES):
        data.records_camera[image, "camera"] = name
        if image not in unposed:
            data.trajectories[image, "rig"] = pose(image)
        if image != WITHOUT_DEPTH:
            data.records_depth[image, "depth"] = f"wall/{image}.depth"
            write_depth_map(root / "sensors" / "records_data" / f"wall/{image}.depth", depth)
        keypoints[name] = project(CAMERA, pose(image), xyz).astype(np.float32)
    write_sensors(root, data)
    # by type, pairs of a point and an image; the keypoint has the number of the point
    of_type: dict[str, list[tuple[int, int]]] = {"a": [], "b": []}
    for point in range(66):
        if point in LIFTED:
            of_type["b"].append((point, point % NUM_IMAGES))
        else:
            own, other = "ab" if point % 3 else "ba"
            of_type[own] += [(point, image) for image in range(NUM_IMAGES)]
            if point % 5 == 0:  # some points have both types
                of_type[other].append((point, 0))
    seen = {}
    for name, rows in of_type.items():
        with FeatureWriter(
            root, "keypoints", name, FeatureConfig(name, np.dtype(np.float32), 2)
        ) as writer:
            for image_name, pixels in keypoints.items():
                writer.write(image_name, pixels)
        points, images = np.array(rows).T
        ids = images.astype(np.int32), points.astype(np.int32)
        seen[name] = Observations(name, NAMES, points, *ids)
    write_points3d(root, np.column_stack([xyz, rng.integers(0, 256, (66, 3))]))
    write_observations(root, seen)
    return KaptureFolder(root)


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> KaptureFolder:
    """The wall, read only."""
    return write_wall(tmp_path_factory.mktemp("wall") / "map")


def rows_of(folder: KaptureFolder, points: Iterable[int] | None = None) -> set[tuple[float, ...]]:
    """Return points of a map (default: all) as tuples of coordinates and colours."""
    stored = folder.points3d()
    return set(map(tuple, stored if points is None else stored[[*points]]))


def contents(folder: KaptureFolder) -> dict[str, set[tuple[tuple[float, ...], str, int]]]:
    """Return observations by type: the point with its colour, the image, the keypoint."""
    points = folder.points3d()
    return {
        name: {
            (tuple(points[point].tolist()), seen.image_names[image], keypoint)
            for point, image, keypoint in np.stack(
                [seen.point_ids, seen.image_ids, seen.keypoint_ids], axis=1
            ).tolist()
        }
        for name, seen in folder.observations().items()
    }


def refined(
    wall: KaptureFolder, output: Path, **settings: Any
) -> tuple[KaptureFolder, RefinementReport]:
    counts = refine_map(wall, output, MapRefinementOptions.model_validate(settings))
    found = KaptureFolder(output)
    report = read_json_model(output / "reconstruction" / "refinement.json", RefinementReport)
    assert counts["points"] == report.points_after == len(found.points3d())
    assert report.observations_after == sum(map(len, contents(found).values()))
    return found, report


def test_points_in_front_of_the_wall_are_removed(wall: KaptureFolder, tmp_path: Path) -> None:
    folder, report = refined(wall, tmp_path / "out")
    kept = [*ON_WALL, *LIFTED, *IN_HOLE]
    np.testing.assert_array_equal(folder.points3d(), wall.points3d()[kept])
    (removed,) = report.filters
    assert (removed.name, removed.points) == ("depth", len(FLOATING))
    before, after, gone = contents(wall), contents(folder), rows_of(wall, FLOATING)
    for name, observed in before.items():
        assert after[name] == {row for row in observed if row[0] not in gone}
    assert removed.observations == sum(map(len, before.values())) - sum(map(len, after.values()))
    assert report.observations_before - removed.observations == report.observations_after
    folder.validate()


def test_without_filters_the_map_is_copied_or_linked(wall: KaptureFolder, tmp_path: Path) -> None:
    for name, links in (("copied", False), ("linked", True)):
        counts = refine_map(wall, tmp_path / name, OFF, link_features=links)
        assert counts == {"points": 66, "observations": sum(map(len, contents(wall).values()))}
        found = KaptureFolder(tmp_path / name)
        assert contents(found) == contents(wall)
        assert found.read().poses() == wall.read().poses()
        for kind in ("a", "b"):
            place = Path("reconstruction") / "keypoints" / kind / "wall" / "0.png.kpt"
            own, source = found.root / place, wall.root / place
            assert own.read_bytes() == source.read_bytes()
            assert os.path.samefile(own, source) == links
    write_sensors(tmp_path / "empty", wall.read())
    with pytest.raises(DataError, match="no map to refine"):
        refine_map(KaptureFolder(tmp_path / "empty"), tmp_path / "out", OFF)


def test_covariances_are_those_of_the_new_map(wall: KaptureFolder, tmp_path: Path) -> None:
    folder, report = refined(wall, tmp_path / "out", uncertainty={"max_robust_sigmas": 0.5})
    stored = read_point_covariances(tmp_path / "out", report.points_after)
    seen = list(folder.observations().values())
    point_ids = np.concatenate([s.point_ids for s in seen])
    image_ids = np.concatenate([s.image_ids for s in seen])  # all images, in the order of NAMES
    order = np.argsort(point_ids, kind="stable")
    poses = [pose(image) for image in range(NUM_IMAGES)]
    points = folder.points3d()
    expected = point_covariances(
        points[:, :3], point_ids[order], image_ids[order], [CAMERA] * NUM_IMAGES, poses
    )
    np.testing.assert_allclose(stored, expected, rtol=1e-9)
    lifted = np.isin(points[:, 0], wall.points3d()[[*LIFTED], 0])
    assert lifted.sum() == len(LIFTED) and (np.isnan(expected[:, 0]) == lifted).all()
    _, uncertainty = report.filters
    assert (uncertainty.name, uncertainty.checked) == ("uncertainty", 46)
    assert 0 < uncertainty.points < 23


def test_observations_of_an_image_without_pose_are_dropped(tmp_path: Path) -> None:
    wall = write_wall(tmp_path / "map", unposed=[3])
    folder, _ = refined(wall, tmp_path / "out", uncertainty={"max_robust_sigmas": 1.0})
    for observed in contents(folder).values():
        images = {image for _, image, _ in observed}
        assert images and "wall/3.png" not in images


def lifted_from(wall: KaptureFolder, shares: Sequence[float]) -> KaptureFolder:
    """Move the lifted points to shares of their distance from their image."""
    points = wall.points3d().copy()
    for point, share in zip(LIFTED, shares, strict=True):
        centre = pose(point % NUM_IMAGES).center()
        in_sight = np.array([0.5 + 0.05 * (point - LIFTED.start), 0.8, WALL_M])
        points[point, :3] = centre + share * (in_sight - centre)
    write_points3d(wall.root, points)
    return KaptureFolder(wall.root)


def test_lifted_points_are_compared_with_the_depth_of_other_images(tmp_path: Path) -> None:
    shares = [1.0] * 4 + [0.9] * 4 + [1.8] * 2  # on, in front of and behind the wall
    wall = lifted_from(write_wall(tmp_path / "map"), shares)
    # one image with wrong depth is outvoted
    depth = np.full((120, 160), 1.5 * WALL_M, np.float32)
    write_depth_map(wall.root / "sensors" / "records_data" / "wall/0.depth", depth)
    folder, report = refined(wall, tmp_path / "out")
    lifted = rows_of(wall, LIFTED)
    removed = rows_of(wall, LIFTED[4:8]) - rows_of(wall, [53, 59])  # their image has no depth
    assert lifted - rows_of(folder) == removed
    # points behind the wall are hidden and are not checked
    hidden = rows_of(wall, LIFTED[8:])
    assert hidden < rows_of(folder)
    # images of other frames are not compared
    alone = Restrictions({name: ImageGroup(frame=name) for name in NAMES})
    counts = refine_map(wall, tmp_path / "apart", MapRefinementOptions(), restrictions=alone)
    assert lifted <= rows_of(KaptureFolder(tmp_path / "apart"))
    assert counts["checked_by_depth"] < report.filters[0].checked
