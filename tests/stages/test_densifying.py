"""Densified maps, against the exact depth of the rendered world, read by kapture itself."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
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

FAST = PluginChoice(name="sweep", options={"passes": 1, "max_planes": 64})
OPTIONS = DensifyOptions(mode="points", max_size_px=200, estimator=FAST)


@pytest.fixture(scope="module")
def densified(world: Any, tmp_path_factory: pytest.TempPathFactory) -> KaptureFolder:
    root = tmp_path_factory.mktemp("densified") / "map"
    counts = densify_map(world.map(), root, OPTIONS)
    assert counts["images"] == counts["images_with_depth"] == 5
    assert counts["share_with_depth"] > 0.5 and counts["points_lifted"] > 300
    return KaptureFolder(root, features_dirs=[world.features_dir])


def test_kapture_reads_the_depth_and_it_is_right(densified: KaptureFolder) -> None:
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
    assert len(keypoints) == len(seen)  # no keypoint twice: what had a point keeps it
    covariances = read_point_covariances(densified.root, len(after))
    assert covariances is not None
    assert np.isnan(covariances[: len(before)]).all()  # the map that was read had none
    deviations = point_deviations(covariances[len(before) :])
    assert np.isfinite(deviations).all() and (deviations[:, 0] > 0).all()
    # along the ray they are unsure, across it a pixel: z / f is 1.5 to 3 cm here
    assert np.median(deviations[:, 2] / deviations[:, 0]) > 1.2
    assert 0.01 < np.median(deviations[:, 0]) < 0.04


def test_depth_is_as_sure_and_as_fine_as_the_poses(
    world: Any, densified: KaptureFolder, tmp_path: Path
) -> None:
    options = OPTIONS.model_copy(update={"mode": "depth", "max_size_px": 400})
    exact = fitted_to_poses(world.map(), 400)
    assert (exact.max_size_px, exact.num_sources, exact.agreement) == (400, 4, Agreement())
    assert exact.error_px < 0.2
    doubtful = tmp_path / "doubtful"
    shutil.copytree(world.map().root, doubtful, symlinks=True)
    data = world.map().read()
    draw = np.random.default_rng(0)
    turns = {key: draw.normal(0, 0.004, 3) for key in data.trajectories}
    truth = data.poses()
    for key, turn in turns.items():
        rotation = Rotation.from_rotvec(turn).as_matrix()
        turned = RigidTransform.from_matrix(rotation, np.zeros(3)) @ data.trajectories[key]
        data.trajectories[key] = turned
    write_sensors(doubtful, data)
    source = KaptureFolder(doubtful, features_dirs=[world.features_dir])
    fitted = fitted_to_poses(source, 400)
    # the median distance between observations and points that the turned cameras see elsewhere
    distances, seen = [], source.observations()["rootsift"]
    for row, image in enumerate(seen.image_names):
        own = seen.image_ids == row
        points = source.points3d()[seen.point_ids[own], :3]
        keypoints = source.keypoints("rootsift").read(image)[seen.keypoint_ids[own], :2]
        at = project(CAMERA, source.read().poses()[image], points)
        distances.append(np.linalg.norm(at - keypoints, axis=1))
    median = np.median(np.concatenate(distances))
    assert median > 1
    assert fitted.max_size_px == pytest.approx(400 * 0.5 / np.sqrt(median**2 - 0.09), abs=2)
    assert fitted.error_px == pytest.approx(0.5, abs=0.01)
    assert fitted.num_sources == round(4 * 400 / fitted.max_size_px)
    assert fitted.agreement.max_error_px == pytest.approx(2.5, abs=0.05)
    densify_map(source, tmp_path / "out", options)
    found = KaptureFolder(tmp_path / "out")
    for image, record in depth_records(found.read()).items():
        camera = record.camera
        assert max(camera.width, camera.height) == fitted.max_size_px
        depth = read_depth(found, record)
        size = depth.shape[::-1]
        exact = cv2.resize(depth_m(truth[image]), size, interpolation=cv2.INTER_NEAREST)
        known = (depth > 0) & (exact > 0)
        sigma = read_beside(found.root, image, "sigma")
        assert sigma is not None and known.mean() > 0.25
        assert np.median(np.abs(depth[known] / exact[known] - 1)) < 0.04
        # the walls are 4 to 6 m away, the cameras 1 m apart: half a pixel is 2 to 4 % of the depth
        assert 0.02 < np.median(sigma[known] / depth[known]) < 0.08


def test_a_lifted_point_does_not_displace_a_triangulated_one(densified: KaptureFolder) -> None:
    index = index_map(densified, "rootsift")
    image, other = densified.read().image_names()[1:3]
    rows, points = index.observed(image)
    triangulated = rows[~index.seen_once[points]][0]
    rows, points = index.observed(other)
    lifted = rows[index.seen_once[points]][0]
    # both say the same query keypoint, the lifted one with the better score
    said = ((image, triangulated, 0.5), (other, lifted, 0.9))
    matches = [(name, np.array([[7, row]]), np.array([score])) for name, row, score in said]
    found = TypedMatches(index, np.zeros((8, 2), np.float32), matches).correspondences()
    assert found.keypoint_ids.tolist() == [7]
    assert not index.seen_once[found.point_ids[0]]


def test_images_that_have_depth_keep_it(densified: KaptureFolder, tmp_path: Path) -> None:
    data = KaptureFolder(densified.root).read()  # what the folder itself has read stays as it is
    first = data.image_names()[0]
    path = depth_records(data)[first].path
    kept = tmp_path / "kept"
    shutil.copytree(densified.root, kept)
    # a map with a depth sensor of its own that saw one of the images
    records = kept / "sensors" / "records_data"
    shutil.move(records / "mvs" / f"{first}.depth", records / "own.depth")
    shutil.rmtree(records / "mvs")
    sensor = next(key[1] for key, name in data.records_depth.items() if name == path)
    camera = sensor[: -len("_mvs")]
    data.sensors["sensor"] = data.sensors.pop(sensor)
    data.rigs = {"both": {camera: data.rigs[f"{camera}_with_mvs"][camera]}}
    data.rigs["both"]["sensor"] = data.rigs["both"][camera]
    stamp = data.record_of(first)[0]
    data.records_depth = {(stamp, "sensor"): "own.depth"}
    data.trajectories = {key: pose for key, pose in data.trajectories.items() if key[1] == camera}
    write_sensors(kept, data)
    counts = densify_map(KaptureFolder(kept), tmp_path / "out", OPTIONS)
    assert counts["images_with_depth"] == 4
    rows = {row.image: row for row in read_depth_rows(tmp_path / "out" / DEPTH_FILE)}
    assert rows[first].reason == "already has depth"
    out = KaptureFolder(tmp_path / "out")
    found = depth_records(out.read())[first]
    assert found.path == "own.depth" and read_depth(out, found).any()


def test_what_cannot_be_densified_is_refused_with_its_name(
    world: Any, densified: KaptureFolder, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match="no map to densify.*megloc triangulate") as refused:
        densify_map(world.mapping(), tmp_path / "a", OPTIONS)
    assert str(world.mapping().root) in str(refused.value)
    with pytest.raises(DataError, match="records_data/mvs"):
        densify_map(densified, tmp_path / "b", OPTIONS)
    with pytest.raises(DataError, match="no densified map"):
        fuse_depth(world.map(), tmp_path / "c.ply", Agreement())


def test_an_image_without_a_file_has_a_reason(world: Any, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(world.map().root, broken, symlinks=True)
    records = broken / "sensors/records_data"
    target = records.resolve()
    records.unlink()
    shutil.copytree(target, records)
    (records / "left/0.png").unlink()
    folder = KaptureFolder(broken, features_dirs=[world.features_dir])
    counts = densify_map(folder, tmp_path / "out", OPTIONS.model_copy(update={"mode": "depth"}))
    rows = {row.image: row for row in read_depth_rows(tmp_path / "out" / DEPTH_FILE)}
    assert counts["images_with_depth"] == 4 and counts["points_lifted"] == 0
    assert rows["left/0.png"].reason == "no image file"
    assert all("left/0.png" not in row.sources for row in rows.values())


def test_fused_points_are_fewer_than_pixels_with_depth(
    densified: KaptureFolder, tmp_path: Path
) -> None:
    count = fuse_depth(densified, tmp_path / "cloud.ply", Agreement())
    filled = sum(row.fill for row in read_depth_rows(densified.root / DEPTH_FILE)) * 200 * 150
    assert 0.2 * filled < count < 0.95 * filled  # surfaces that two images see are in it once
