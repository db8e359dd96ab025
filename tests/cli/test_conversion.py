"""``megloc export``: each format read back and compared with kapture's reading of the map."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from kapture import flatten
from kapture.io.csv import kapture_from_dir
from scipy.spatial.transform import Rotation


def poses(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return world_from_cam by image, as read by kapture: rotation (3, 3) and centre (3,)."""
    data = kapture_from_dir(str(folder))
    by_image = {}
    for timestamp, sensor, image in flatten(data.records_camera):
        if (timestamp, sensor) in data.trajectories:
            pose = data.trajectories[timestamp, sensor].inverse()
            w, x, y, z = pose.r_raw
            by_image[image] = (Rotation.from_quat([x, y, z, w]).as_matrix(), np.ravel(pose.t))
    return by_image


def sources(finished: Path) -> tuple[str | Path, ...]:
    return ("-i", finished / "map", "--query", finished / "localized")


def test_colmap_reads_an_exported_model(megloc: Any, finished: Path, tmp_path: Path) -> None:
    printed = megloc("export", "colmap", *sources(finished), "-o", tmp_path / "model").out
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    truth = poses(finished / "map") | poses(finished / "localized")
    assert printed.startswith(f"{len(truth)} images exported") and model.num_reg_images() == len(
        truth
    )
    for image in model.images.values():
        rotation, centre = truth[image.name]
        world_from_cam = image.cam_from_world().inverse()
        np.testing.assert_allclose(world_from_cam.rotation.matrix(), rotation, atol=1e-12)
        np.testing.assert_allclose(world_from_cam.translation, centre, atol=1e-12)
    given = kapture_from_dir(str(finished / "map"))
    assert model.num_points3D() == len(given.points3d)
    ordered = [model.points3D[i] for i in sorted(model.points3D)]
    xyz = np.array([point.xyz for point in ordered])
    np.testing.assert_array_equal(xyz, np.asarray(given.points3d)[:, :3])
    seen = [rows for of_type in given.observations.values() for rows in of_type.values()]
    assert model.compute_num_observations() == sum(map(len, seen))
    # keypoints, observations and cameras are consistent
    assert model.compute_mean_reprojection_error() < 1.0


def test_tum_rows_and_ply_vertices_are_those_of_the_poses_and_points(
    megloc: Any, finished: Path, tmp_path: Path
) -> None:
    for kind in ("tum", "ply"):
        assert megloc("export", kind, *sources(finished), "-o", tmp_path / kind).status == 0
    rows = np.loadtxt(tmp_path / "tum", ndmin=2)
    centres = [centre.tolist() for _, centre in poses(finished / "localized").values()]
    np.testing.assert_allclose(sorted(rows[:, 1:4].tolist()), sorted(centres), atol=1e-12)
    points = len(kapture_from_dir(str(finished / "map")).points3d)
    images = len(poses(finished / "map") | poses(finished / "localized"))
    header = (tmp_path / "ply").read_bytes().partition(b"end_header\n")[0].decode()
    assert f"element vertex {points + 5 * images}\n" in header
    assert f"element edge {8 * images}\n" in header


def test_nerfstudio_has_opengl_axes_and_paths_of_the_images(
    megloc: Any, finished: Path, tmp_path: Path
) -> None:
    out = tmp_path / "deep" / "nerf"
    megloc("export", "nerfstudio", *sources(finished), "-o", out)
    content = json.loads((out / "transforms.json").read_text())
    truth = poses(finished / "map") | poses(finished / "localized")
    assert len(content["frames"]) == len(truth)
    for frame in content["frames"]:
        path = (out / frame["file_path"]).resolve()
        assert path.is_file()
        rotation, centre = truth[path.name]
        matrix = np.array(frame["transform_matrix"])
        # looks along -z, y up
        np.testing.assert_allclose(-matrix[:3, 2], rotation[:, 2], atol=1e-12)
        np.testing.assert_allclose(-matrix[:3, 1], rotation[:, 1], atol=1e-12)
        np.testing.assert_allclose(matrix[:3, 3], centre, atol=1e-12)
        assert frame["w"] > frame["cx"] > 0 and frame["fl_x"] > 0
    assert (out / content["ply_file_path"]).is_file()
