"""A map of points lifted from depth maps, against the exact walls of the rendered scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corner import CAMERA, write_kapture

from megloc_kapture.errors import DataError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.io.kapture import KaptureFolder, write_sensors
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.map_points import lift_map
from megloc_kapture.stages.scene import depth_records, index_map
from megloc_kapture.values import RigidTransform

IMAGES = ("left/0.png", "right/2.png", "right/4.png")


@pytest.fixture(scope="module")
def mapping(images_only: Any, tmp_path_factory: pytest.TempPathFactory) -> KaptureFolder:
    """Three images with depth maps and features."""
    root = tmp_path_factory.mktemp("lifting")
    poses = {image: images_only.map_poses[image] for image in IMAGES}
    write_kapture(root / "mapping", poses, with_poses=True, with_depth=True)
    folder = KaptureFolder(root / "mapping", features_dirs=[root])
    extract_local_features([folder], RootSift(RootSiftOptions(max_keypoints=200)), root)
    return folder


def test_lifted_points_project_to_their_keypoints_and_lie_on_the_walls(
    mapping: KaptureFolder, tmp_path: Path, distance_to_walls: Any
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    counts = lift_map(mapping, ["rootsift"], tmp_path)
    assert counts["images_with_depth"] == counts["images"] == 3
    folder = KaptureFolder(tmp_path)
    points, seen = folder.points3d()[:, :3], folder.observations()["rootsift"]
    assert len(seen) == len(points) == len(index_map(folder, "rootsift").xyz) > 400
    distances = distance_to_walls(points)
    assert np.median(distances) < 1e-3 and np.mean(distances < 0.05) > 0.95
    camera = pycolmap.Camera(
        model=CAMERA.model, width=CAMERA.width, height=CAMERA.height, params=CAMERA.params
    )
    for row, image in enumerate(seen.image_names):
        rows = seen.image_ids == row
        in_cam = folder.read().poses()[image].apply(points[seen.point_ids[rows]])
        keypoints = folder.keypoints("rootsift").read(image)[seen.keypoint_ids[rows], :2]
        np.testing.assert_allclose(camera.img_from_cam(in_cam), keypoints, atol=2e-3)


@pytest.mark.parametrize("offset_m", [0.0, 0.02])
def test_images_take_the_depth_of_their_moment_and_rig(
    mapping: KaptureFolder, offset_m: float
) -> None:
    data = mapping.read()
    offset = RigidTransform((1.0, 0.0, 0.0, 0.0), (offset_m, 0.0, 0.0))
    rigs = {"both": {"cam": RigidTransform.identity(), "depth": offset}}
    records = depth_records(replace(data, rigs=rigs))
    assert set(records) == set(IMAGES)
    for image, record in records.items():
        assert (record.path, record.camera) == (f"{image}.depth", CAMERA)
        np.testing.assert_allclose(record.image_from_depth.translation, [-offset_m, 0, 0])


def test_a_map_without_depth_is_refused(mapping: KaptureFolder, tmp_path: Path) -> None:
    write_sensors(tmp_path, replace(mapping.read(), records_depth={}))
    with pytest.raises(DataError, match="no mapping image has a pose and a depth map"):
        lift_map(KaptureFolder(tmp_path), ["rootsift"], tmp_path / "map")
