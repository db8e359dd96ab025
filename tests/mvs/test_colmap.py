"""COLMAP's dense workspace: maps against pycolmap, and fusion by COLMAP."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from corner import CAMERA, WALLS, depth_m, pose_at, render

from megloc_kapture.errors import DataError, PluginError
from megloc_kapture.geometry.cameras import bearing_rays, project
from megloc_kapture.io.colmap import MapImage
from megloc_kapture.io.colmap_mapping import has_cuda, map_path, read_map, write_workspace
from megloc_kapture.mvs.sweep import ColmapStereo, as_estimate, planes_of

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py

POSES = [pose_at((x, 0.0, 0.0), 0.0, 0.0) for x in (-0.3, 0.0, 0.3)]
NAMES = ["a/0.png", "a/1.png", "b/2.png"]


def _normals(number: int) -> np.ndarray:
    """Normals (H, W, 3) of the two walls, in the camera's frame, towards it."""
    rotation, exact = POSES[number].rotation_matrix(), depth_m(POSES[number])
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    rays = bearing_rays(CAMERA, np.stack([x.ravel(), y.ravel()], axis=1)).reshape(*exact.shape, 3)
    world = POSES[number].inverse().apply((rays * exact[..., None]).reshape(-1, 3))
    result = np.zeros((exact.size, 3))
    for origin, along, _, _ in WALLS:
        normal = np.cross(along, [0.0, 1.0, 0.0])
        on_wall = np.abs((world - origin) @ normal) < 1e-4
        result[on_wall] = rotation @ normal
    result = result.reshape(rays.shape)
    result[(result * rays).sum(-1) > 0] *= -1
    return result


def write_map(path: Path, array: np.ndarray) -> None:
    """Write depth (H, W) or normals (H, W, 3) as COLMAP does."""
    values = np.asarray(array, "<f4")
    values = values[..., None] if values.ndim == 2 else values
    height, width, channels = values.shape
    head = f"{width}&{height}&{channels}&".encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(head + np.ascontiguousarray(values.transpose(2, 0, 1)).tobytes())


def fuse(root: Path) -> np.ndarray:
    """Fuse the maps of a workspace by COLMAP; points (N, 3) in the world."""
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = 2
    options.num_threads = 1
    fused = pycolmap.stereo_fusion(
        str(root / "fused.ply"),
        str(root),
        input_type="photometric",
        options=options,
        output_type="PLY",
    )
    return np.array([point.xyz for point in fused.points3D.values()])


def _workspace(root: Path) -> None:
    exact = depth_m(POSES[1])
    y, x = np.mgrid[20:280:15, 20:380:15]
    px = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
    xyz = POSES[1].inverse().apply(bearing_rays(CAMERA, px) * exact[y, x].reshape(-1, 1))
    rows = np.arange(len(xyz))
    images = [
        MapImage(name, CAMERA, pose, project(CAMERA, pose, xyz).astype(np.float32))
        for name, pose in zip(NAMES, POSES, strict=True)
    ]
    pixels = [render(pose) for pose in POSES]
    write_workspace(root, images, pixels, [(rows, rows)] * 3, xyz)
    for number, name in enumerate(NAMES):
        write_map(map_path(root, "depth", name), depth_m(POSES[number]))
        write_map(map_path(root, "normal", name), _normals(number))


def test_colmap_fuses_the_maps_to_the_two_walls(tmp_path: Path) -> None:
    _workspace(tmp_path)
    fused = fuse(tmp_path)
    assert len(fused) > 50_000
    distances = np.min(
        [np.abs((fused - o) @ np.cross(along, [0.0, 1.0, 0.0])) for o, along, _, _ in WALLS], axis=0
    )
    # its stereo has the centre of the first pixel at (0, 0): half a pixel is 1 cm here
    assert np.percentile(distances, 99) < 0.012


def test_maps_equal_colmap(tmp_path: Path) -> None:
    exact = depth_m(POSES[0])
    ours, theirs = tmp_path / "ours.bin", tmp_path / "theirs.bin"
    write_map(ours, exact)
    pycolmap.DepthMap.from_array(exact, 1.0, 9.0).write(str(theirs))
    assert ours.read_bytes() == theirs.read_bytes()
    np.testing.assert_array_equal(read_map(theirs), exact)
    normals = _normals(0).astype(np.float32)
    write_map(ours, normals)
    np.testing.assert_array_equal(read_map(ours), normals)
    # as COLMAP's script reads them (pycolmap's NormalMap swaps axes)
    values = np.frombuffer(ours.read_bytes().split(b"&", 3)[3], np.float32)
    as_colmap = values.reshape((CAMERA.width, CAMERA.height, 3), order="F").transpose(1, 0, 2)
    np.testing.assert_array_equal(as_colmap, normals)
    ours.write_bytes(ours.read_bytes()[:-3])
    with pytest.raises(DataError, match="ours.bin.*not a map of COLMAP's stereo"):
        read_map(ours)


def test_planes_equal_depth_and_normals() -> None:
    exact, normals = depth_m(POSES[0]), _normals(0)
    known = exact > 0
    planes = planes_of(CAMERA, np.where(known, exact, 1), normals)
    again = as_estimate(CAMERA, planes, known.astype(float))
    np.testing.assert_allclose(again.depth_m, exact, rtol=1e-5)
    inner = known & (np.abs(normals).sum(-1) > 0)
    assert (again.normals[inner] * normals[inner]).sum(-1).min() > 0.9999
    # a plane's inverse depth at the next pixel is the wall's
    same = (normals[:, 1:] == normals[:, :-1]).all(-1) & known[:, 1:] & known[:, :-1]
    step = planes[:, :-1, 0] + planes[:, :-1, 1]
    np.testing.assert_allclose(step[same], 1 / exact[:, 1:][same], rtol=1e-4)


@pytest.mark.skipif(has_cuda(), reason="this pycolmap has CUDA")
def test_without_cuda_stereo_is_refused_with_the_remedy() -> None:
    with pytest.raises(PluginError, match="no CUDA.*pycolmap-cuda12.*sweep"):
        ColmapStereo()
