"""Map refinement on a wall whose points, cameras and depth maps are exact."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import median_abs_deviation

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


def write_wall(root: Path, *, shift_px: float = 0.0, unposed: Sequence[int] = ()) -> KaptureFolder:
    """Six images in a row before a wall; everything sees all but the lifted points.

    Points 60 to 65 float where the depth maps have a hole.
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
        keypoints[name] = (project(CAMERA, pose(image), xyz) + shift_px).astype(np.float32)
    write_sensors(root, data)
    # of each type points and the images that see them, as keypoints of the points' numbers
    of_type: dict[str, list[tuple[int, int]]] = {"a": [], "b": []}
    for point in range(66):
        if point in LIFTED:
            of_type["b"].append((point, point % NUM_IMAGES))
        else:
            own, other = "ab" if point % 3 else "ba"
            of_type[own] += [(point, image) for image in range(NUM_IMAGES)]
            if point % 5 == 0:  # and now and then one of the other type as well
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
    """The wall, not to be written to."""
    return write_wall(tmp_path_factory.mktemp("wall") / "map")


def rows_of(folder: KaptureFolder, points: Iterable[int] | None = None) -> set[tuple[float, ...]]:
    """Some of the points of a map, or all, by their coordinates and colours."""
    stored = folder.points3d()
    return set(map(tuple, stored if points is None else stored[[*points]]))


def contents(folder: KaptureFolder) -> dict[str, set[tuple[tuple[float, ...], str, int]]]:
    """By type, what is observed: the point with its colour, image and keypoint."""
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


def test_depth_takes_out_what_floats_before_the_wall(wall: KaptureFolder, tmp_path: Path) -> None:
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


def test_depth_maps_that_are_not_there_count_as_none(tmp_path: Path) -> None:
    without = write_wall(tmp_path / "map")
    for path in (without.root / "sensors" / "records_data").rglob("*.depth"):
        path.unlink()
    folder, report = refined(without, tmp_path / "without")
    assert report.filters == () and contents(folder) == contents(without)


def test_nothing_is_lost_where_nothing_is_asked_for(wall: KaptureFolder, tmp_path: Path) -> None:
    for name, links in (("copied", False), ("linked", True)):
        counts = refine_map(wall, tmp_path / name, OFF, link_features=links)
        assert counts == {"points": 66, "observations": sum(map(len, contents(wall).values()))}
        found = KaptureFolder(tmp_path / name)
        assert contents(found) == contents(wall)
        assert found.read().poses() == wall.read().poses()
        # features are linked where they may be
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
    assert stored is not None
    seen = list(folder.observations().values())
    point_ids = np.concatenate([s.point_ids for s in seen])
    order = np.argsort(point_ids, kind="stable")
    images = np.concatenate(
        [np.array([NAMES.index(n) for n in s.image_names])[s.image_ids] for s in seen]
    )
    xyz, poses = folder.points3d()[:, :3], [pose(image) for image in range(NUM_IMAGES)]
    expected = point_covariances(
        xyz, point_ids[order], images[order].astype(np.int32), [CAMERA] * NUM_IMAGES, poses
    )
    np.testing.assert_allclose(stored, expected, rtol=1e-9)
    lifted = np.isin(folder.points3d()[:, 0], wall.points3d()[[*LIFTED], 0])
    assert lifted.sum() == len(LIFTED)
    assert np.isnan(stored[lifted]).all() and np.isfinite(stored[~lifted]).all()
    _, uncertainty = report.filters
    assert (uncertainty.name, uncertainty.checked) == ("uncertainty", 46)
    assert 0 < uncertainty.points < 23


def test_a_point_is_as_uncertain_as_in_its_worst_direction(
    wall: KaptureFolder, tmp_path: Path
) -> None:
    # seen in a row from afar: depth is far less sure than the two directions across
    refined(wall, tmp_path / "all", **UNCHECKED)
    stored = read_point_covariances(tmp_path / "all", len(wall.points3d()))
    assert stored is not None
    known = np.isfinite(stored[:, 0])
    square = stored[known][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    worst = np.sqrt(np.linalg.eigvalsh(square)[:, 2]) / wall.points3d()[known, 2]
    usual, spread = np.median(np.log(worst)), median_abs_deviation(np.log(worst), scale="normal")
    sure = ~known  # lifted points
    sure[known] = np.log(worst) <= usual + spread
    folder, _ = refined(wall, tmp_path / "out", **UNCHECKED, uncertainty={"max_robust_sigmas": 1.0})
    np.testing.assert_array_equal(folder.points3d(), wall.points3d()[sure])


def test_observations_of_an_image_without_pose_are_dropped(tmp_path: Path) -> None:
    wall = write_wall(tmp_path / "map", unposed=[3])
    folder, _ = refined(wall, tmp_path / "out", uncertainty={"max_robust_sigmas": 1.0})
    for observed in contents(folder).values():
        images = {image for _, image, _ in observed}
        assert images and "wall/3.png" not in images


def lifted_from(wall: KaptureFolder, shares: Sequence[float]) -> KaptureFolder:
    """Put the lifted points at shares of their distance from the image that sees them."""
    points = wall.points3d().copy()
    for point, share in zip(LIFTED, shares, strict=True):
        centre = pose(point % NUM_IMAGES).center()
        in_sight = np.array([0.5 + 0.05 * (point - LIFTED.start), 0.8, WALL_M])
        points[point, :3] = centre + share * (in_sight - centre)
    write_points3d(wall.root, points)
    return KaptureFolder(wall.root)


def test_lifted_points_are_compared_with_the_depth_of_other_images(tmp_path: Path) -> None:
    before, behind = 0.9, 1.8
    shares = [1.0] * 4 + [before] * 4 + [behind] * 2
    wall = lifted_from(write_wall(tmp_path / "map"), shares)
    # an image whose depth is wrong has one vote of many
    depth = np.full((120, 160), 1.5 * WALL_M, np.float32)
    write_depth_map(wall.root / "sensors" / "records_data" / "wall/0.depth", depth)
    folder, report = refined(wall, tmp_path / "out")
    lifted = rows_of(wall, LIFTED)
    removed = rows_of(wall, LIFTED[4:8]) - rows_of(wall, [53, 59])  # whose image has no depth
    assert lifted - rows_of(folder) == removed
    # others see the wall before what lies behind it: it may be there, and is not judged
    hidden = rows_of(wall, LIFTED[8:])
    assert hidden < rows_of(folder)
    # within one image's frame, or from one centre, there is nothing to compare with
    alone = Restrictions({name: ImageGroup(frame=name) for name in NAMES})
    counts = refine_map(wall, tmp_path / "apart", MapRefinementOptions(), restrictions=alone)
    assert lifted <= rows_of(KaptureFolder(tmp_path / "apart"))
    assert counts["checked_by_depth"] < report.filters[0].checked
    data = wall.read()
    data.trajectories = dict.fromkeys(data.trajectories, pose(0))
    write_sensors(wall.root, data)
    folder, _ = refined(KaptureFolder(wall.root), tmp_path / "one")
    assert lifted <= rows_of(folder)
