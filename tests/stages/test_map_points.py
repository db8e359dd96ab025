"""The lifted map, against the exact depth of the rendered world it comes from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from megloc_twins.options import SyntheticWorldOptions
from megloc_twins.synthetic_kapture import SyntheticKapture

from megloc_kapture.errors import DataError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.geometry.cameras import px_from_cam
from megloc_kapture.io.kapture import KaptureFolder, write_sensors
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.map_points import lift_map
from megloc_kapture.stages.scene import depth_records, index_map, read_depth
from megloc_kapture.values import RigidTransform


@pytest.fixture(scope="module")
def lifted(tmp_path_factory: pytest.TempPathFactory) -> tuple[KaptureFolder, KaptureFolder]:
    """A mapping folder with depth and features, and the map made of it."""
    root = tmp_path_factory.mktemp("lifting")
    options = SyntheticWorldOptions(
        num_places=1, stations_per_place=3, day_queries=0, night_queries=0,
        width=320, height=240, moving_objects=0, depth=True,
    )  # fmt: skip
    SyntheticKapture(options).write(root)
    mapping = KaptureFolder(root / "mapping", features_dirs=[root])
    extract_local_features([mapping], RootSift(RootSiftOptions(max_keypoints=300)), root)
    counts = lift_map(mapping, ["rootsift"], root / "map")
    assert counts["images_with_depth"] == counts["images"] == 9
    return mapping, KaptureFolder(root / "map")


def test_points_reproject_onto_their_keypoints(lifted: Any) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    _, folder = lifted
    data, seen = folder.read(), folder.observations()["rootsift"]
    assert len(seen) == len(folder.points3d()) == len(index_map(folder, "rootsift").xyz) > 1000
    for row, image in enumerate(seen.image_names):
        own = seen.image_ids == row
        assert own.sum() > 50
        camera = data.camera_of(image)
        colmap = pycolmap.Camera(
            model=camera.model, width=camera.width, height=camera.height, params=camera.params
        )
        points = data.poses()[image].apply(folder.points3d()[seen.point_ids[own], :3])
        keypoints = folder.keypoints("rootsift").read(image)[seen.keypoint_ids[own], :2]
        np.testing.assert_allclose(colmap.img_from_cam(points), keypoints, atol=2e-3)


def test_points_of_one_image_lie_where_another_sees_a_surface(lifted: Any) -> None:
    mapping, folder = lifted
    data, seen = mapping.read(), folder.observations()["rootsift"]
    agreeing = visible = 0
    for row, image in enumerate(seen.image_names):
        others = folder.points3d()[seen.point_ids[seen.image_ids != row], :3]
        in_cam = data.poses()[image].apply(others)
        in_cam = in_cam[in_cam[:, 2] > 0.5]
        depth = read_depth(mapping, depth_records(data)[image])
        column, line = px_from_cam(data.camera_of(image), in_cam).T.astype(int)
        inside = (column >= 0) & (column < 320) & (line >= 0) & (line < 240)
        z = in_cam[inside, 2]
        off = np.abs(z - depth[line[inside], column[inside]])
        near = off < 0.3 * z  # neither hidden nor hiding
        visible += int(near.sum())
        agreeing += int((off < 0.02 * z).sum())
    assert visible > 1000
    assert agreeing > 0.9 * visible


@pytest.mark.parametrize("beside_m", [0.0, 0.02])
def test_depth_is_that_of_the_sensor_of_the_moment_on_the_rig(lifted: Any, beside_m: float) -> None:
    data = lifted[0].read()
    offset = RigidTransform((1.0, 0.0, 0.0, 0.0), (beside_m, 0.0, 0.0))
    rigs = {
        rig: {s: offset @ p if s.endswith("_depth") else p for s, p in members.items()}
        for rig, members in data.rigs.items()
    }
    records = depth_records(replace(data, rigs=rigs))
    assert set(records) == set(data.image_names())
    for image, record in records.items():
        assert record.path == f"depth/{image.rsplit('.', 1)[0]}.depth"
        translation = record.image_from_depth.translation
        np.testing.assert_allclose(translation, [-beside_m, 0, 0], atol=1e-12)
        assert record.camera == data.camera_of(image)


def test_a_map_without_depth_is_refused(lifted: Any, tmp_path: Path) -> None:
    write_sensors(tmp_path, replace(lifted[0].read(), records_depth={}))
    with pytest.raises(DataError, match="no mapping image has a pose and a depth map"):
        lift_map(KaptureFolder(tmp_path), ["rootsift"], tmp_path / "map")
