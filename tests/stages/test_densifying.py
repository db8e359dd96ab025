"""Densified maps, against the exact depth of the rendered world, read by kapture itself."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import kapture
import kapture.io.csv
import kapture.io.records
import numpy as np
import pytest
from corner import CAMERA, depth_m
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import project, scaled_camera
from megloc_kapture.io.kapture import KaptureFolder, read_point_covariances, write_sensors
from megloc_kapture.io.tables import read_depth_rows
from megloc_kapture.localization.map_index import TypedMatches
from megloc_kapture.mapping.uncertainty import point_deviations
from megloc_kapture.mvs.views import Agreement
from megloc_kapture.plugins import PluginChoice
from megloc_kapture.stages.densifying import (
    DEPTH_FILE,
    DensifyOptions,
    densify_map,
    fitted_to_poses,
    fuse_depth,
    read_beside,
    side_file,
)
from megloc_kapture.stages.scene import depth_records, index_map, read_depth
from megloc_kapture.values import RigidTransform

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
        sigma = read_beside(densified.root, image, "sigma")
        assert sigma is not None and ((sigma > 0) == (found > 0)).all()
        normals = np.load(side_file(densified.root, image, "normals"))
        lengths = np.linalg.norm(normals[found > 0].astype(float), axis=1)
        np.testing.assert_allclose(lengths, 127, atol=1.5)


def test_points_of_the_map_stay_and_lifted_ones_lie_on_the_walls(
    world: Any, densified: KaptureFolder, distance_to_walls: Any
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
    count = fuse_depth(densified, tmp_path / "cloud.ply", Agreement())
    filled = sum(row.fill for row in read_depth_rows(densified.root / DEPTH_FILE)) * 200 * 150
    assert 0.2 * filled < count < 0.95 * filled  # surfaces in two images are fused


def test_resolution_follows_the_accuracy_of_the_poses(world: Any, tmp_path: Path) -> None:
    exact = fitted_to_poses(world.map(), 400)
    assert (exact.max_size_px, exact.num_sources, exact.agreement) == (400, 4, Agreement())
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
    assert fitted.agreement.max_error_px == pytest.approx(2.5, abs=0.05)
    options = OPTIONS.model_copy(update={"mode": "depth", "max_size_px": 400})
    densify_map(folder, tmp_path / "out", options)
    out = KaptureFolder(tmp_path / "out")
    for image, record in depth_records(out.read()).items():
        depth, sigma = read_depth(out, record), read_beside(out.root, image, "sigma")
        assert max(depth.shape) == fitted.max_size_px and sigma is not None
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
    rows = {row.image: row for row in read_depth_rows(tmp_path / "out" / DEPTH_FILE)}
    assert rows[missing].reason == "no image file"
    assert rows[measured].reason == "already has depth"
    assert all(missing not in row.sources for row in rows.values())
    records_of_image = depth_records(KaptureFolder(tmp_path / "out").read())
    assert records_of_image[measured].path == "measured.depth"


def test_unsuitable_folders_are_refused(
    world: Any, densified: KaptureFolder, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match="no map to densify.*megloc triangulate"):
        densify_map(world.mapping(), tmp_path / "a", OPTIONS)
    with pytest.raises(DataError, match="records_data/mvs"):
        densify_map(densified, tmp_path / "b", OPTIONS)
    with pytest.raises(DataError, match="no densified map"):
        fuse_depth(world.map(), tmp_path / "c.ply", Agreement())


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
