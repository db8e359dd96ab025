"""All rendered datasets: their options, and their import against their truth."""

from __future__ import annotations

import shutil
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import kapture
import numpy as np
import pytest
from kapture.io.csv import kapture_from_dir
from kapture.io.features import get_keypoints_fullpath, image_keypoints_from_file
from megloc_twins.options import SyntheticDataset
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.nvm import read_nvm
from megloc_kapture.datasets.official import write_official
from megloc_kapture.io.images import image_size
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.plugin_loading import load_plugin
from megloc_kapture.plugins import DATASETS
from megloc_kapture.values import RigidTransform

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py

LAYOUTS = ("aachen", "robotcar", "4seasons", "inloc")
COUNTS = {
    "synthetic": {"places": 2, "mapping images": 36, "query images": 4},
    "aachen": {"places": 2, "mapping images": 36, "query images": 8},
    "robotcar": {"places": 2, "mapping images": 16, "query images": 36},
    "4seasons": {"places": 2, "mapping images": 24, "query images": 20},
    "inloc": {"floors": 2, "scans": 6, "mapping images": 216, "query images": 5},
}
Rendered = Callable[[str], Path]


@pytest.mark.parametrize(
    ("name", "options"), [*((name, {}) for name in LAYOUTS), ("robotcar", {"model": "individual"})]
)
def test_the_import_is_the_truth(
    name: str, options: dict[str, Any], rendered: Rendered, imported: Rendered, tmp_path: Path
) -> None:
    """Poses, cameras and sizes, in the official coordinates, as kapture reads them."""
    root, folder = rendered(name), tmp_path
    dataset = load_plugin(DATASETS, name, options).read(root)
    assert dataset.missing is not None and dataset.missing.files == []
    if options:
        write_official(dataset, folder)
    else:
        folder = imported(name)
    assert not KaptureFolder(folder / "query").read().trajectories
    for part, truth_part in (("mapping", "mapping"), ("query_gt", "query")):
        result, cameras = read(folder / part)
        truth, true_cameras = read(root / "ground_truth" / truth_part)
        assert result.keys() == truth.keys()
        assert len(result) == COUNTS[name][f"{part.removesuffix('_gt')} images"]
        for image, pose in result.items():
            assert np.linalg.norm(pose.center()) < 5000
            assert_same(dataset.world.pose_in_official(pose), truth[image])
            model, width, height, *params = cameras[image]
            true = true_cameras[image]
            assert (model, width, height) == tuple(true[:3])
            # InLoc computes its focal length from an angle
            assert [*map(float, params)] == pytest.approx([*map(float, true[3:])], rel=1e-12)
            path = KaptureFolder(folder / part.removesuffix("_gt")).image_path(image)
            assert image_size(path) == (int(width), int(height))


@pytest.mark.parametrize(
    ("name", "published", "count"),
    [("robotcar", "", 6), ("4seasons", "recording_2021-01-15_13-04-17/", 12)],
)
def test_published_poses_are_the_truth(
    name: str, published: str, count: int, rendered: Rendered, tmp_path: Path
) -> None:
    """The truth next to the data is not needed."""
    root = rendered(name)
    for entry in root.iterdir():
        if entry.name != "ground_truth":
            (tmp_path / entry.name).symlink_to(entry)
    dataset = load_plugin(DATASETS, name).read(tmp_path)
    truth, _ = read(root / "ground_truth/query")
    poses = dataset.query_gt.poses()
    assert len(poses) == count
    assert all(image.startswith(published) for image in poses)
    if name == "4seasons":  # the whole recording
        assert set(poses) == {image for image in truth if image.startswith(published)}
    if name == "robotcar":
        assert count == len((root / "robotcar_v2_train.txt").read_text().splitlines())
    for image, pose in poses.items():
        assert_same(dataset.world.pose_in_official(pose), truth[image])


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("aachen", {"version": "1.0"}),
        ("aachen", {"version": "1.1"}),
        ("robotcar", {"model": "merged"}),
        ("robotcar", {"model": "individual"}),
    ],
)
def test_points_of_the_reference_model_reproject(
    name: str, options: dict[str, Any], rendered: Rendered, tmp_path: Path
) -> None:
    """By kapture's readers and poses, and COLMAP's cameras."""
    adapter = load_plugin(DATASETS, name, {**options, "reference_model": True})
    dataset = adapter.read(rendered(name))
    assert dataset.missing is not None and dataset.missing.files == []
    write_official(dataset, tmp_path)
    folder = str(tmp_path / "reference")
    data = kapture_from_dir(folder)
    points = data.points3d.as_array()[:, :3]
    assert len(points) > (200 if name == "aachen" else 0)
    seen: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for point_id in range(len(points)):
        track = data.observations[point_id, "sift"]
        assert len(track) >= 2
        for image, keypoint_id in track:
            seen[image].append((point_id, keypoint_id))
    worst = 0.0
    for timestamp, sensor, image in kapture.flatten(data.records_camera):
        model, width, height, *params = data.sensors[sensor].sensor_params
        size = {"width": int(width), "height": int(height)}
        camera = pycolmap.Camera(model=model, params=[*map(float, params)], **size)
        path = get_keypoints_fullpath("sift", folder, image)
        keypoints = image_keypoints_from_file(path, np.float32, 2)
        of_point, of_keypoint = np.array(seen[image]).T
        in_camera = data.trajectories[timestamp, sensor].transform_points(points[of_point])
        error = np.linalg.norm(camera.img_from_cam(in_camera) - keypoints[of_keypoint], axis=1)
        worst = max(worst, float(error.max()))
        assert len(error) > 5
    assert 0 < worst < 1e-3
    assert sum(map(len, seen.values())) > 500


def test_robotcars_models_share_a_database(rendered: Rendered, tmp_path: Path) -> None:
    """The merged and the individual models give the same map, with the database's features."""
    root, models = tmp_path / "root", tmp_path / "root/3D-models"
    shutil.copytree(rendered("robotcar"), root, symlinks=True)
    nvm = read_nvm(models / "all-merged/all.nvm")
    database = pycolmap.Database.open(str(models / "overcast-reference.db"))
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=96, height=96, params=[58.0, 48, 48])
    camera_id = database.write_camera(camera)
    for index, name in enumerate(nvm.names):
        rows = nvm.points.image_ids == index
        keypoints = np.zeros((int(nvm.points.feature_ids[rows].max()) + 1, 4), np.float32)
        keypoints[nvm.points.feature_ids[rows], :2] = nvm.points.xy_px[rows]
        image_id = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
        database.write_keypoints(image_id, keypoints)
        descriptors = np.full((len(keypoints), 128), index, np.uint8)
        kind = pycolmap.FeatureExtractorType.SIFT
        database.write_descriptors(image_id, pycolmap.FeatureDescriptors(kind, descriptors))
    database.close()
    observations = []
    for model in ("merged", "individual"):
        dataset = load_plugin(DATASETS, "robotcar", {"model": model, "reference_model": True})
        write_official(dataset.read(root), tmp_path / model)
        reference = KaptureFolder(tmp_path / model / "reference")
        # features and models fit each other, or the import would refuse them
        reference.validate()
        assert reference.types("descriptors") == ["sift"]
        seen = reference.observations()["sift"]
        observations.append((seen.point_ids, seen.image_ids, seen.keypoint_ids))
        assert len(seen) > 300
    np.testing.assert_array_equal(observations[0], observations[1])


def assert_same(result: RigidTransform, expected: RigidTransform) -> None:
    """To 1e-6 m and 1e-6 deg, by scipy."""
    assert np.linalg.norm(result.center() - expected.center()) < 1e-6
    rotations = [Rotation.from_quat(p.quat_wxyz, scalar_first=True) for p in (result, expected)]
    assert np.degrees((rotations[0] * rotations[1].inv()).magnitude()) < 1e-6


def read(folder: Path) -> tuple[dict[str, Any], dict[str, list[str]]]:
    """Poses by ours and camera parameters by kapture's reader, by image."""
    theirs = kapture_from_dir(str(folder))
    cameras = {
        image: theirs.sensors[sensor].sensor_params
        for _, sensor, image in kapture.flatten(theirs.records_camera)
    }
    return KaptureFolder(folder).read().poses(), cameras


def test_wrong_options_are_refused(small: dict[str, SyntheticDataset[Any]]) -> None:
    for name, wrong in (("synthetic", {"colour": "red"}), ("inloc", {"modules": 21})):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            small[name].Options(**wrong)
