"""The lifted map, against the exact depth of the rendered world it comes from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from megloc_twins.options import SyntheticWorldOptions
from megloc_twins.synthetic_kapture import SyntheticKapture

from megloc_kapture.errors import DataError
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from megloc_kapture.geometry.cameras import px_from_cam
from megloc_kapture.io.images import read_depth_map
from megloc_kapture.io.kapture import KaptureFolder, write_sensors
from megloc_kapture.mapping.depth import LiftingOptions
from megloc_kapture.stages.local_features import extract_local_features
from megloc_kapture.stages.map_points import lift_map
from megloc_kapture.stages.rigs import depth_records
from megloc_kapture.stages.shared_index import index_map
from megloc_kapture.values import RigidTransform

OPTIONS = SyntheticWorldOptions(
    num_places=1,
    stations_per_place=3,
    day_queries=0,
    night_queries=0,
    width=320,
    height=240,
    moving_objects=0,
    depth=True,
)


@pytest.fixture(scope="module")
def lifted(tmp_path_factory: pytest.TempPathFactory) -> tuple[KaptureFolder, Path]:
    """A mapping folder with depth and features, and the map made of it."""
    root = tmp_path_factory.mktemp("lifting")
    SyntheticKapture(OPTIONS).write(root)
    mapping = KaptureFolder(root / "mapping", features_dirs=[root])
    extract_local_features([mapping], RootSift(RootSiftOptions(max_keypoints=300)), root)
    counts = lift_map(mapping, ["rootsift"], root / "map", LiftingOptions())
    assert counts["images_with_depth"] == counts["images"] == 9
    return mapping, root / "map"


def test_points_reproject_onto_their_keypoints(lifted: tuple[KaptureFolder, Path]) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    folder = KaptureFolder(lifted[1])
    data, seen = folder.read(), folder.observations()["rootsift"]
    assert len(seen) == len(folder.points3d()) > 1000
    poses = data.poses()
    for row, image in enumerate(seen.image_names):
        own = seen.image_ids == row
        assert own.sum() > 50
        camera = data.camera_of(image)
        colmap = pycolmap.Camera(
            model=camera.model, width=camera.width, height=camera.height, params=camera.params
        )
        points = poses[image].apply(folder.points3d()[seen.point_ids[own], :3])
        keypoints = folder.keypoints("rootsift").read(image)[seen.keypoint_ids[own], :2]
        np.testing.assert_allclose(colmap.img_from_cam(points), keypoints, atol=2e-3)


def test_points_of_one_image_lie_where_another_sees_a_surface(
    lifted: tuple[KaptureFolder, Path],
) -> None:
    folder, mapping = KaptureFolder(lifted[1]), lifted[0]
    data, seen = mapping.read(), folder.observations()["rootsift"]
    agreeing = visible = 0
    for row, image in enumerate(seen.image_names):
        others = folder.points3d()[seen.point_ids[seen.image_ids != row], :3]
        in_cam = data.poses()[image].apply(others)
        camera, record = data.camera_of(image), depth_records(data)[image]
        depth = read_depth_map(
            mapping.image_path(record.path), width=camera.width, height=camera.height
        )
        column, line = px_from_cam(camera, in_cam[in_cam[:, 2] > 0.5]).T.astype(int)
        z = in_cam[in_cam[:, 2] > 0.5, 2]
        inside = (column >= 0) & (column < 320) & (line >= 0) & (line < 240)
        sensed = depth[line[inside], column[inside]]
        near = np.abs(z[inside] - sensed) < 0.3 * z[inside]  # neither hidden nor hiding
        visible += int(near.sum())
        agreeing += int((np.abs(z[inside] - sensed)[near] < 0.02 * z[inside][near]).sum())
    assert visible > 1000
    assert agreeing > 0.9 * visible


def test_the_map_can_be_localized_in(lifted: tuple[KaptureFolder, Path]) -> None:
    index = index_map(KaptureFolder(lifted[1]), "rootsift")
    assert len(index.xyz) > 1000


def test_depth_is_that_of_the_nearest_sensor_of_the_moment(
    lifted: tuple[KaptureFolder, Path],
) -> None:
    data = lifted[0].read()
    records = depth_records(data)
    assert set(records) == set(data.image_names())
    for image, record in records.items():
        assert record.path == f"depth/{image.rsplit('.', 1)[0]}.depth"
        np.testing.assert_allclose(record.image_from_depth.translation, 0, atol=1e-12)
        assert record.camera == data.camera_of(image)


def test_depth_beside_the_camera_is_found_through_the_rig(
    lifted: tuple[KaptureFolder, Path],
) -> None:
    data = lifted[0].read()
    offset = RigidTransform((1.0, 0.0, 0.0, 0.0), (0.02, 0.0, 0.0))
    rigs = {
        rig: {s: offset @ p if s.endswith("_depth") else p for s, p in members.items()}
        for rig, members in data.rigs.items()
    }
    data.rigs, kept = rigs, data.rigs
    try:
        for record in depth_records(data).values():
            np.testing.assert_allclose(
                record.image_from_depth.translation, [-0.02, 0, 0], atol=1e-12
            )
    finally:
        data.rigs = kept


def test_a_map_without_depth_is_refused(lifted: tuple[KaptureFolder, Path], tmp_path: Path) -> None:
    data = lifted[0].read()
    records, data.records_depth = data.records_depth, {}
    write_sensors(tmp_path, data)
    data.records_depth = records
    with pytest.raises(DataError, match="no mapping image has a pose and a depth map"):
        lift_map(KaptureFolder(tmp_path), ["rootsift"], tmp_path / "map", LiftingOptions())
