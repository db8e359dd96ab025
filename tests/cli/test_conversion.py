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


def test_tum_rows_are_the_times_centres_and_rotations(
    megloc: Any, finished: Path, tmp_path: Path
) -> None:
    truth = poses(finished / "localized")
    tum = tmp_path / "a.tum"
    megloc("export", "tum", *sources(finished), "-o", tum)
    rows = np.loadtxt(tum, ndmin=2)
    assert rows.shape == (len(truth), 8)
    by_time = dict(zip(rows[:, 0].astype(int).tolist(), rows[:, 1:], strict=True))
    data = kapture_from_dir(str(finished / "localized"))
    for timestamp, _, image in flatten(data.records_camera):
        rotation, centre = truth[image]
        row = by_time[timestamp]
        np.testing.assert_allclose(row[:3], centre, atol=1e-12)
        exported = Rotation.from_quat(row[3:]).as_matrix()
        np.testing.assert_allclose(exported, rotation, atol=1e-12)


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


def test_a_ply_has_points_and_frusta(megloc: Any, finished: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.ply"
    megloc("export", "ply", *sources(finished), "-o", out)
    header, _, body = out.read_bytes().partition(b"end_header\n")
    truth = poses(finished / "map") | poses(finished / "localized")
    points = np.asarray(kapture_from_dir(str(finished / "map")).points3d)
    count = len(points) + 5 * len(truth)
    assert f"element vertex {count}\n".encode() in header
    assert f"element edge {8 * len(truth)}\n".encode() in header
    kind = [("xyz", "<f8", 3), ("rgb", "u1", 3)]
    vertices = np.frombuffer(body, dtype=kind, count=count)
    np.testing.assert_array_equal(vertices["xyz"][: len(points)], points[:, :3])
    edges = np.frombuffer(body[vertices.nbytes :], dtype="<i4").reshape(-1, 2)
    assert len(edges) == 8 * len(truth) and edges.min() == len(points) and edges.max() == count - 1
    centres = vertices["xyz"][len(points) :: 5]
    np.testing.assert_allclose(
        sorted(map(tuple, centres)), sorted(tuple(c) for _, c in truth.values()), atol=1e-9
    )
