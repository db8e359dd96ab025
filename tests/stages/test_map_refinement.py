"""Maps densified and refined, against exact depth of the rendered world and of a wall."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import kapture
import kapture.io.csv
import kapture.io.records
import numpy as np
import pytest
from corner import CAMERA, depth_m, distance_to_walls
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError, PluginError
from megloc_kapture.geometry.cameras import project, scaled_camera
from megloc_kapture.io.csv_table import read_records
from megloc_kapture.io.dataset_tables import ImageGroup, SideTables
from megloc_kapture.io.images import write_depth_map
from megloc_kapture.io.kapture import (
    FeatureConfig,
    FeatureWriter,
    KaptureData,
    KaptureFolder,
    Observations,
    Sensor,
    read_point_covariances,
    write_observations,
    write_points3d,
    write_sensors,
)
from megloc_kapture.io.tables import DepthRow
from megloc_kapture.localization.map_index import TypedMatches
from megloc_kapture.mapping.uncertainty import point_covariances, point_deviations
from megloc_kapture.mvs.sweep import Sweep
from megloc_kapture.plugins import PluginChoice
from megloc_kapture.stages.densifying import DensifyOptions, densify_map, fitted_to_poses
from megloc_kapture.stages.map_refinement import MapRefinementOptions, refine_map
from megloc_kapture.stages.scene import depth_of, depth_records, index_map
from megloc_kapture.stages.stereo_depth import DEPTH_FILE, fuse_depth, side_file
from megloc_kapture.values import Camera, RigidTransform

FAST = PluginChoice(name="sweep", options={"passes": 1, "max_planes": 48})
OPTIONS = DensifyOptions(mode="points", max_size_px=200, estimator=FAST)


@pytest.fixture(scope="module")
def densified(world: Any, tmp_path_factory: pytest.TempPathFactory) -> KaptureFolder:
    root = tmp_path_factory.mktemp("densified") / "map"
    counts = densify_map(world.map(), root, OPTIONS)
    assert counts["images"] == counts["images_with_depth"] == 5
    assert counts["share_with_depth"] > 0.5 and counts["points_lifted"] > 300
    return KaptureFolder(root, features_dirs=[world.features_dir])


def test_kapture_reads_accurate_depth_maps(densified: KaptureFolder) -> None:
    read = kapture.io.csv.kapture_from_dir(str(densified.root))
    poses = densified.read().poses()
    names = {
        (timestamp, sensor[: -len("_mvs")]): (sensor, path)
        for timestamp, sensor, path in kapture.flatten(read.records_depth)
    }
    camera = scaled_camera(CAMERA, 0.5)
    assert len(names) == 5
    for timestamp, sensor, image in kapture.flatten(read.records_camera):
        depth_sensor, path = names[timestamp, sensor]
        assert read.sensors[depth_sensor].camera_params == [200, 150, *camera.params]
        file = kapture.io.records.get_depth_map_fullpath(str(densified.root), path)
        found = kapture.io.records.depth_map_from_file(file, (200, 150))
        exact = depth_m(poses[image])[::2, ::2]
        known = (found > 0) & (exact > 0)
        assert known.mean() > 0.4
        assert np.mean(np.abs(found - exact)[known] < 0.02 * exact[known]) > 0.95
        assert not found[exact == 0].any() or np.mean(found[exact == 0] > 0) < 0.1
        sigma = np.load(side_file(densified.root, image, "sigma"))
        assert ((sigma > 0) == (found > 0)).all()
        normals = np.load(side_file(densified.root, image, "normals"))
        lengths = np.linalg.norm(normals[found > 0].astype(float), axis=1)
        np.testing.assert_allclose(lengths, 127, atol=1.5)


def test_points_of_the_map_stay_and_lifted_ones_lie_on_the_walls(
    world: Any, densified: KaptureFolder
) -> None:
    before, after = world.map().points3d(), densified.points3d()
    np.testing.assert_array_equal(after[: len(before)], before)
    distances = distance_to_walls(after[len(before) :, :3])
    assert np.median(distances) < 0.02 and np.mean(distances < 0.1) > 0.95
    seen, old = densified.observations()["rootsift"], world.map().observations()["rootsift"]
    assert len(seen) - len(old) == len(after) - len(before)
    keypoints = {
        (seen.image_names[i], k) for i, k in zip(seen.image_ids, seen.keypoint_ids, strict=True)
    }
    assert len(keypoints) == len(seen)  # each keypoint has one point
    covariances = read_point_covariances(densified.root, len(after))
    assert covariances is not None
    assert np.isnan(covariances[: len(before)]).all()  # the map before had no covariances
    deviations = point_deviations(covariances[len(before) :])
    assert np.isfinite(deviations).all() and (deviations[:, 0] > 0).all()
    # uncertain along the ray, a pixel across it: z / f is 1.5 to 3 cm here
    assert np.median(deviations[:, 2] / deviations[:, 0]) > 1.2
    assert 0.01 < np.median(deviations[:, 0]) < 0.04


def test_fused_points_are_fewer_than_pixels_with_depth(
    densified: KaptureFolder, tmp_path: Path
) -> None:
    count = fuse_depth(densified, tmp_path / "cloud.ply")
    rows = read_records(densified.root / DEPTH_FILE, DepthRow)
    filled = sum(row.fill for row in rows) * 200 * 150
    assert 0.2 * filled < count < 0.95 * filled  # surfaces in two images are fused


def test_resolution_follows_the_accuracy_of_the_poses(world: Any, tmp_path: Path) -> None:
    exact = fitted_to_poses(world.map(), 400)
    assert (exact.max_size_px, exact.num_sources, exact.tolerance_px) == (400, 4, 1.0)
    assert exact.error_px < 0.2
    rotated = Path(shutil.copytree(world.map().root, tmp_path / "rotated", symlinks=True))
    data, rng = world.map().read(), np.random.default_rng(0)
    for key, pose in data.trajectories.items():
        rotation = Rotation.from_rotvec(rng.normal(0, 0.004, 3)).as_matrix()
        data.trajectories[key] = RigidTransform.from_matrix(rotation, np.zeros(3)) @ pose
    write_sensors(rotated, data)
    folder = KaptureFolder(rotated, features_dirs=[world.features_dir])

    fitted = fitted_to_poses(folder, 400)

    median = median_reprojection_error_px(folder)
    assert median > 1
    assert fitted.max_size_px == pytest.approx(400 * 0.5 / np.sqrt(median**2 - 0.09), abs=2)
    assert fitted.error_px == pytest.approx(0.5, abs=0.01)
    assert fitted.num_sources == round(4 * 400 / fitted.max_size_px)
    assert fitted.tolerance_px == pytest.approx(2.5, abs=0.05)
    options = OPTIONS.model_copy(update={"mode": "depth", "max_size_px": 400})
    densify_map(folder, tmp_path / "out", options)
    out = KaptureFolder(tmp_path / "out")
    for image in depth_records(out.read()):
        view, sigma = depth_of(out, image), np.load(side_file(out.root, image, "sigma"))
        assert view is not None
        depth = view.depth_m
        assert max(depth.shape) == fitted.max_size_px
        # half a pixel at 4 to 6 m with a baseline of 1 m is 2 to 4 % of the depth
        assert 0.02 < np.median(sigma[depth > 0] / depth[depth > 0]) < 0.08


def median_reprojection_error_px(folder: KaptureFolder) -> float:
    distances, seen = [], folder.observations()["rootsift"]
    for row, image in enumerate(seen.image_names):
        rows = seen.image_ids == row
        points = folder.points3d()[seen.point_ids[rows], :3]
        keypoints = folder.keypoints("rootsift").read(image)[seen.keypoint_ids[rows], :2]
        projected = project(CAMERA, folder.read().poses()[image], points)
        distances.append(np.linalg.norm(projected - keypoints, axis=1))
    return float(np.median(np.concatenate(distances)))


def test_images_with_depth_keep_it_and_missing_files_have_a_reason(
    world: Any, densified: KaptureFolder, tmp_path: Path
) -> None:
    root = Path(shutil.copytree(world.map().root, tmp_path / "map", symlinks=True))
    records = root / "sensors" / "records_data"
    target = records.resolve()
    records.unlink()
    shutil.copytree(target, records)
    missing, measured = "left/0.png", "right/4.png"
    (records / missing).unlink()
    shutil.copy(densified.depth_path(f"mvs/{measured}.depth"), records / "measured.depth")
    data = world.map().read()
    timestamp, camera = data.record_of(measured)
    mvs_sensor = densified.read().sensors[f"{camera}_mvs"]
    data = replace(data, sensors={**data.sensors, "depth": mvs_sensor})
    data.rigs = {"rig": dict.fromkeys((camera, "depth"), RigidTransform.identity())}
    data.records_depth = {(timestamp, "depth"): "measured.depth"}
    write_sensors(root, data)
    options = OPTIONS.model_copy(update={"mode": "depth", "max_size_px": 100})

    counts = densify_map(KaptureFolder(root), tmp_path / "out", options)

    assert counts["images_with_depth"] == 3 and counts["points_lifted"] == 0
    rows = {row.image: row for row in read_records(tmp_path / "out" / DEPTH_FILE, DepthRow)}
    assert rows[missing].reason == "no image file"
    assert rows[measured].reason == "already has depth"
    assert all(missing not in row.sources for row in rows.values())
    records_of_image = depth_records(KaptureFolder(tmp_path / "out").read())
    assert records_of_image[measured].path == "measured.depth"


def test_unsuitable_folders_are_refused(
    world: Any, densified: KaptureFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(DataError, match="no map to densify.*megloc triangulate"):
        densify_map(world.mapping(), tmp_path / "a", OPTIONS)
    with pytest.raises(DataError, match="records_data/mvs"):
        densify_map(densified, tmp_path / "b", OPTIONS)
    write_sensors(tmp_path / "blind", world.map().read())
    shutil.copytree(world.map().root / "reconstruction", tmp_path / "blind" / "reconstruction")
    with pytest.raises(DataError, match="records_data: the images of the map are missing"):
        densify_map(KaptureFolder(tmp_path / "blind"), tmp_path / "b", OPTIONS)
    with pytest.raises(DataError, match="no densified map"):
        fuse_depth(world.map(), tmp_path / "c.ply")
    monkeypatch.setattr(Sweep, "estimate", lambda *_: None)
    with pytest.raises(PluginError, match="Sweep on image .*: returned NoneType, not DepthEs"):
        densify_map(world.map(), tmp_path / "d", OPTIONS)


def test_triangulated_points_precede_lifted_ones(densified: KaptureFolder) -> None:
    index = index_map(densified, "rootsift")
    image, other = densified.read().image_names()[1:3]
    rows, points = index.observed(image)
    triangulated = rows[~index.seen_once[points]][0]
    rows, points = index.observed(other)
    lifted = rows[index.seen_once[points]][0]
    # both match query keypoint 7, the lifted point with the better score
    pairs = ((image, triangulated, 0.5), (other, lifted, 0.9))
    matches = [(name, np.array([[7, row]]), np.array([score])) for name, row, score in pairs]
    found = TypedMatches(index, np.zeros((8, 2), np.float32), matches).correspondences()
    assert found.keypoint_ids.tolist() == [7]
    assert not index.seen_once[found.point_ids[0]]


WALL_CAMERA = Camera("SIMPLE_RADIAL", 320, 240, (250.0, 160.0, 120.0, 0.02))
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
            "camera": Sensor.from_camera(WALL_CAMERA),
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
        keypoints[name] = project(WALL_CAMERA, pose(image), xyz).astype(np.float32)
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
        writer = FeatureWriter(
            root, "keypoints", name, FeatureConfig(name, np.dtype(np.float32), 2)
        )
        for image_name, pixels in keypoints.items():
            writer.write(image_name, pixels)
        points, images = np.array(rows).T
        ids = images.astype(np.int32), points.astype(np.int32)
        seen[name] = Observations(NAMES, points, *ids)
    write_points3d(root, np.column_stack([xyz, rng.integers(0, 256, (66, 3))]))
    write_observations(root, seen)
    return KaptureFolder(root)


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> KaptureFolder:
    return write_wall(tmp_path_factory.mktemp("wall") / "map")


def rows_of(folder: KaptureFolder, points: Iterable[int] | None = None) -> set[tuple[float, ...]]:
    stored = folder.points3d()
    return set(map(tuple, stored if points is None else stored[[*points]]))


def contents(folder: KaptureFolder) -> dict[str, set[tuple[tuple[float, ...], str, int]]]:
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
) -> tuple[KaptureFolder, dict[str, Any]]:
    counts = refine_map(wall, output, MapRefinementOptions.model_validate(settings))
    found = KaptureFolder(output)
    report = json.loads((output / "reconstruction" / "refinement.json").read_text())
    assert counts["points"] == report["points_after"] == len(found.points3d())
    assert report["observations_after"] == sum(map(len, contents(found).values()))
    return found, report


def test_points_in_front_of_the_wall_are_removed(wall: KaptureFolder, tmp_path: Path) -> None:
    folder, report = refined(wall, tmp_path / "out")
    kept = [*ON_WALL, *LIFTED, *IN_HOLE]
    np.testing.assert_array_equal(folder.points3d(), wall.points3d()[kept])
    (removed,) = report["filters"]
    assert (removed["name"], removed["points"]) == ("depth", len(FLOATING))
    before, after, gone = contents(wall), contents(folder), rows_of(wall, FLOATING)
    for name, observed in before.items():
        assert after[name] == {row for row in observed if row[0] not in gone}
    assert removed["observations"] == sum(map(len, before.values())) - sum(map(len, after.values()))
    assert report["observations_before"] - removed["observations"] == report["observations_after"]
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
    stored = read_point_covariances(tmp_path / "out", report["points_after"])
    seen = list(folder.observations().values())
    point_ids = np.concatenate([s.point_ids for s in seen])
    image_ids = np.concatenate([s.image_ids for s in seen])  # all images, in the order of NAMES
    order = np.argsort(point_ids, kind="stable")
    poses = [pose(image) for image in range(NUM_IMAGES)]
    points = folder.points3d()
    expected = point_covariances(
        points[:, :3], point_ids[order], image_ids[order], [WALL_CAMERA] * NUM_IMAGES, poses
    )
    np.testing.assert_allclose(stored, expected, rtol=1e-9)
    lifted = np.isin(points[:, 0], wall.points3d()[[*LIFTED], 0])
    assert lifted.sum() == len(LIFTED) and (np.isnan(expected[:, 0]) == lifted).all()
    _, uncertainty = report["filters"]
    assert (uncertainty["name"], uncertainty["checked"]) == ("uncertainty", 46)
    assert 0 < uncertainty["points"] < 23


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
    alone = SideTables(groups={name: ImageGroup(frame=name) for name in NAMES})
    counts = refine_map(wall, tmp_path / "apart", MapRefinementOptions(), tables=alone)
    assert lifted <= rows_of(KaptureFolder(tmp_path / "apart"))
    assert counts["checked_by_depth"] < report["filters"][0]["checked"]
