"""Views for stereo, plane sweep and its loops, and COLMAP's stereo, on two exact walls."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path

import cv2
import numpy as np
import pytest
from corner import CAMERA, WALLS, depth_m, pose_at, render
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, PluginError
from megloc_kapture.geometry.cameras import (
    bearing_rays,
    pixel_rays,
    project,
    px_from_cam,
    scaled_camera,
)
from megloc_kapture.io.colmap import MapImage
from megloc_kapture.io.colmap_mapping import has_cuda, map_path, read_map, write_workspace
from megloc_kapture.mvs.kernels import add_path, best_labels, correlate
from megloc_kapture.mvs.sweep import (
    ColmapStereo,
    Sweep,
    as_estimate,
    matching_deviations,
    planes_of,
    refine,
    stereo_image,
)
from megloc_kapture.mvs.views import (
    agreeing_views,
    choose_sources,
    confirmed,
    depth_range,
    relative_projection,
    stereo_view,
    with_pose_errors,
)
from megloc_kapture.plugins import DepthEstimate, DepthEstimator, StereoView
from megloc_kapture.values import Camera

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py


POSES = [pose_at((x, 0.1 * (-1) ** i, 0.0), 0.5 * i, 0.0) for i, x in enumerate((0, -0.5, 0.5))]
RANGE = (3.0, 9.0)
SIZE = 240


def view(number: int) -> StereoView:
    return stereo_view(render(POSES[number]), CAMERA, POSES[number], None, SIZE)


def truth(number: int) -> np.ndarray:
    exact = depth_m(POSES[number])
    return cv2.resize(exact, (240, 180), interpolation=cv2.INTER_NEAREST)


@pytest.fixture(scope="module")
def estimates() -> list[DepthEstimate]:
    """Estimates of the three views; the last uses a source of another size."""
    views = [view(number) for number in range(3)]
    image = cv2.resize(views[1].image, None, fx=0.8, fy=0.8, interpolation=cv2.INTER_AREA)
    smaller = replace(views[1], image=image, camera=scaled_camera(views[1].camera, 0.8))
    sweep: DepthEstimator = Sweep()
    return [
        sweep.estimate(views[0], views[1:], RANGE),
        sweep.estimate(views[1], [views[0], views[2]], RANGE),
        sweep.estimate(views[2], [views[0], smaller], RANGE),
    ]


def test_depth_sigma_and_normals_of_two_walls(estimates: list[DepthEstimate]) -> None:
    exact, result = truth(0), estimates[0]
    known = (result.depth_m > 0) & (exact > 0)
    assert known.mean() > 0.85
    error = np.abs(result.depth_m - exact)[known]
    assert np.median(error / exact[known]) < 0.002
    assert np.mean(error < 0.02 * exact[known]) > 0.97
    # rendered without noise, so most errors lie below the deviations of photographs
    assert np.mean(error < 2 * result.sigma_m[known]) > 0.9
    rotation = POSES[0].rotation_matrix()
    normals = [rotation @ np.cross([0.0, 1.0, 0.0], along) for _, along, _, _ in WALLS]
    cosines = np.max([np.abs(result.normals[known] @ normal) for normal in normals], axis=0)
    assert np.median(np.rad2deg(np.arccos(np.minimum(cosines, 1)))) < 4
    rays = pixel_rays(view(0).camera).reshape(*exact.shape, 3)
    assert ((result.normals * rays).sum(axis=-1)[known] < 0).all()  # towards the camera
    # windows at the border leave the image
    rim = np.ones(exact.shape, bool)
    rim[3:-3, 3:-3] = False
    at_rim = rim & (result.depth_m > 0) & (exact > 0)
    assert at_rim.sum() > 0.75 * (rim & (exact > 0)).sum()
    error = np.abs(result.depth_m - exact)[at_rim]
    assert np.mean(error < 0.02 * exact[at_rim]) > 0.95
    assert (result.sigma_m[at_rim] > 0).all()


def test_other_views_confirm_correct_depth(estimates: list[DepthEstimate]) -> None:
    views = [view(number) for number in range(3)]
    others = [(views[n], estimates[n].depth_m) for n in (1, 2)]
    kept = confirmed(views[0], estimates[0], others)
    exact = truth(0)
    known = kept.depth_m > 0
    assert known.mean() > 0.8
    assert np.mean(np.abs(kept.depth_m - exact)[known] < 0.02 * exact[known]) > 0.985
    assert (kept.sigma_m > 0).sum() == known.sum() == np.any(kept.normals != 0, axis=-1).sum()
    # a wrong surface in one view
    wrong = estimates[0].depth_m.copy()
    wrong[60:90, 60:90] *= 0.9
    assert not agreeing_views(views[0], wrong, others)[62:88, 62:88].any()


def test_sources_may_have_another_size(estimates: list[DepthEstimate]) -> None:
    exact, known = truth(2), estimates[2].depth_m > 0
    error = np.abs(estimates[2].depth_m - exact)[known]
    assert known.mean() > 0.8 and np.mean(error < 0.02 * exact[known]) > 0.95


def test_textureless_and_masked_pixels_are_unknown() -> None:
    images = [render(pose) for pose in POSES[:2]]
    for image in images:
        image[80:200, 40:160] = 128
    mask = np.ones(images[0].shape[:2], bool)
    mask[100:200, 250:350] = False
    first = stereo_view(images[0], CAMERA, POSES[0], mask, SIZE)
    second = stereo_view(images[1], CAMERA, POSES[1], None, SIZE)
    result = Sweep().estimate(first, [second], RANGE)
    assert not result.depth_m[55:112, 32:88].any()
    assert not result.depth_m[60:120, 150:210].any()
    assert (result.depth_m[:, 100:140] > 0).mean() > 0.6


def test_deviations_follow_the_noise_of_the_images() -> None:
    ratios, deviations = [], []
    exact = truth(0)
    limits = np.array([1 / RANGE[1], 1 / RANGE[0]])
    slopes = [cv2.Scharr(1 / exact, cv2.CV_32F, *axis) / 32 for axis in ((1, 0), (0, 1))]
    for noise in (4.0, 8.0):
        rng = np.random.default_rng(3)
        views = []
        for clean in (view(0), view(1)):
            noisy = np.clip(clean.image + rng.normal(0, noise, clean.image.shape), 0, 255)
            views.append(replace(clean, image=noisy.astype(np.uint8)))
        planes = np.stack([1 / exact, *slopes], axis=-1).astype(np.float64)
        deviation = refine(views[0], views[1:], planes, limits, 0.001, 2)
        known = (deviation > 0) & (np.abs(stereo_image(views[0])) < 1e9)
        error = np.abs(planes[..., 0] - 1 / exact)[known]
        ratios.append(np.percentile(error, 68) / np.median(deviation[known]))
        deviations.append(np.median(deviation[known]))
    assert 1.2 < deviations[1] / deviations[0] < 2.2
    assert 0.75 < ratios[1] / ratios[0] < 1.6


def test_repeating_a_source_does_not_change_the_deviation() -> None:
    exact = truth(0)
    planes = np.stack([1 / exact, 0 * exact, 0 * exact], axis=-1).astype(np.float64)
    once, thrice, other, both = (
        matching_deviations(view(0), [view(n) for n in sources], planes)
        for sources in ([1], [1, 1, 1], [2], [1, 2])
    )
    np.testing.assert_allclose(once, thrice, rtol=1e-6)
    seen = (once > 0) & (other > 0)
    assert seen.mean() > 0.7
    assert np.mean(both[seen] <= 1.001 * np.maximum(once, other)[seen]) == 1


def test_depth_is_unknown_if_its_deviation_is() -> None:
    planes = np.zeros((3, 4, 3))
    planes[..., 0] = 0.5
    result = as_estimate(
        scaled_camera(CAMERA, 0.01), planes, np.array([[0.01] * 4, [0.0] * 4, [0.02] * 4])
    )
    assert result.depth_m.tolist() == [[2.0] * 4, [0.0] * 4, [2.0] * 4]
    np.testing.assert_allclose(result.sigma_m, np.array([[0.04] * 4, [0] * 4, [0.08] * 4]))
    np.testing.assert_allclose(result.normals[0], [[0, 0, -1]] * 4)
    assert not result.normals[1].any()


LENS = Camera("OPENCV", 400, 300, (310.0, 305.0, 203.0, 147.0, -0.2, 0.05, 0.001, -0.002))


def _ramps(camera: Camera) -> NDArray[np.uint8]:
    y, x = np.mgrid[: camera.height, : camera.width]
    return np.stack([x / 2, y / 2, np.zeros_like(x)], axis=-1).astype(np.uint8)


def test_a_plane_is_carried_to_where_its_points_project() -> None:
    reference = StereoView(_ramps(CAMERA), CAMERA, pose_at((0.2, -0.1, 0.3), 5, -3))
    source = StereoView(_ramps(CAMERA), CAMERA, pose_at((-0.7, 0.2, 0.1), -2, 4))
    normal, distance = np.array([0.3, -0.2, 0.9]), 4.0  # of the plane, in the reference's frame
    px = np.random.default_rng(0).uniform(0, 300, (200, 2))
    rays = bearing_rays(CAMERA, px)
    inverse = rays @ normal / distance
    world = reference.cam_from_world.inverse().apply(rays / inverse[:, None])
    infinity, baseline = relative_projection(reference, source)
    pixels = np.column_stack([px - 0.5, np.ones(len(px))])
    path = pixels @ infinity.T + inverse[:, None] * baseline
    result = path[:, :2] / path[:, 2:] + 0.5
    np.testing.assert_allclose(result, project(CAMERA, source.cam_from_world, world), atol=1e-8)
    # as a homography: the plane's inverse depth is linear in the pixel
    covector = np.linalg.lstsq(pixels, inverse, rcond=None)[0]
    bent = pixels @ (infinity + np.outer(baseline, covector)).T
    np.testing.assert_allclose(bent[:, :2] / bent[:, 2:] + 0.5, result, atol=1e-8)


def test_distortion_is_undone() -> None:
    size = 200
    view = stereo_view(_ramps(LENS), LENS, pose_at((0, 0, 0), 0, 0), None, size)
    assert view.camera.model == "PINHOLE" and max(view.image.shape) <= size
    y, x = np.mgrid[10 : view.camera.height - 10 : 7, 10 : view.camera.width - 10 : 7]
    px = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
    expected = (px_from_cam(LENS, bearing_rays(view.camera, px)) - 0.5) / 2
    shown = view.image[y.ravel(), x.ravel(), :2].astype(float)
    assert np.abs(shown - expected).max() < 1.6  # grey levels; a pixel is half a level


def test_sources_share_points_under_an_angle() -> None:
    xyz = np.random.default_rng(2).uniform([-1, -1, 9], [1, 1, 11], (60, 3))
    # 0 is the reference; 1 is next to it, 2 at 11 degrees, 3 at 60 degrees, 4 shares no points
    centers = np.array([[0, 0, 0], [0.05, 0, 0], [2, 0, 0], [17, 0, 0], [2, 0.1, 0]], float)
    seen = [np.arange(40), np.arange(40), np.arange(20), np.arange(40), np.arange(40, 60)]
    ids = np.concatenate(seen)
    order = np.argsort(ids, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(ids, minlength=60))])
    images = np.repeat(np.arange(5), [len(points) for points in seen])[order]
    everybody = np.ones(5, bool)
    arguments = (xyz, seen, (starts, images), centers)
    assert choose_sources(0, everybody, *arguments, 4) == [2, 3, 1]
    assert choose_sources(0, everybody, *arguments, 1) == [2]
    others = np.array([True, True, False, True, True])
    assert choose_sources(0, others, *arguments, 4) == [3, 1]


def test_the_range_of_depth_ignores_outliers() -> None:
    depths = np.concatenate([np.linspace(5, 10, 200), [900.0, -4.0]])
    near, far = depth_range(depths) or (0.0, 0.0)
    assert 3.9 < near < 4.1 and 12.4 < far < 12.6
    assert depth_range(np.array([3.0, 4.0, -1.0])) is None


def test_a_pixel_of_error_moves_depth_as_the_baseline_says() -> None:
    blank = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    reference, near, far = (StereoView(blank, CAMERA, pose_at((x, 0, 0))) for x in (0, 0.5, 1))
    depth: NDArray[np.float32] = depth_m(reference.cam_from_world).astype(np.float32)
    depth[:10] = 0
    estimate = DepthEstimate(depth, 0.01 * depth, np.zeros((*depth.shape, 3), np.float32))
    focal = CAMERA.params[0]
    result = with_pose_errors(reference, [near], estimate, (2.0, 8.0), 0.5)
    # z = f b / d in a rectified pair, so that dz = z^2 / (f b) dd
    expected = np.hypot(0.01 * depth, 0.5 * depth.astype(float) ** 2 / (focal * 0.5))
    np.testing.assert_allclose(result.sigma_m, expected, rtol=0.02)
    assert not result.sigma_m[:10].any()
    both = with_pose_errors(reference, [near, far], estimate, (2.0, 8.0), 0.5)
    steps = np.array([1 / 0.5, 1 / 1.0]) / focal
    mixed = 0.5 * np.sqrt(np.mean(steps**2)) * depth.astype(float) ** 2
    np.testing.assert_allclose(both.sigma_m, np.hypot(0.01 * depth, mixed), rtol=0.02)
    np.testing.assert_array_equal(
        with_pose_errors(reference, [near], estimate, (2.0, 8.0), 0.0).sigma_m, estimate.sigma_m
    )


P1, P2, EDGE = 7.0, 40.0, 20.0


def least_costs(
    cost: NDArray[np.uint8], grey: NDArray[np.float32], path: list[tuple[int, int]]
) -> list[float]:
    """Least cost of all label sequences along a path, for each label of its last pixel."""
    least = [np.inf] * 3
    for labels in product(range(3), repeat=len(path)):
        total = float(sum(cost[pixel][label] for pixel, label in zip(path, labels, strict=True)))
        for (first, a), (second, b) in pairwise(zip(path, labels, strict=True)):
            step = abs(float(grey[first] - grey[second]))
            total += P1 * abs(a - b) if abs(a - b) <= 1 else max(P1, P2 * EDGE // (EDGE + step))
        least[labels[-1]] = min(least[labels[-1]], total)
    return least


@pytest.mark.parametrize("direction", [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, 1)])
def test_path_costs_equal_the_minimum_over_label_sequences(direction: tuple[int, int]) -> None:
    rng = np.random.default_rng(5)
    cost = rng.integers(0, 60, (4, 5, 3)).astype(np.uint8)
    grey = rng.uniform(0, 100, (4, 5)).astype(np.float32)
    total = np.zeros(cost.shape, np.uint16)
    dy, dx = direction
    add_path(cost, grey, P1, P2, EDGE, dy, dx, total)
    for y, x in np.ndindex(4, 5):
        steps = range(max(cost.shape))
        path = [(y - k * dy, x - k * dx) for k in steps]
        path = [(v, u) for v, u in path if 0 <= v < 4 and 0 <= u < 5][::-1]
        before = min(least_costs(cost, grey, path[:-1])) if len(path) > 1 else 0.0
        expected = [least - before for least in least_costs(cost, grey, path)]
        assert total[y, x].tolist() == expected


def test_the_best_label_is_the_minimum_of_the_parabola() -> None:
    truth = np.array([[0.0, 2.3, 5.0, 6.75, 8.0]])  # no parabola at the first and last label
    labels = np.arange(9)
    total = (100 * (labels - truth[..., None]) ** 2).round().astype(np.uint16)
    result = np.empty(truth.shape)
    best_labels(total, result)
    np.testing.assert_allclose(result, truth, atol=0.01)


def test_the_cost_is_the_mean_of_the_two_best_correlations() -> None:
    rng = np.random.default_rng(1)
    reference = rng.normal(size=(20, 24)).astype(np.float32)
    sources = np.stack(
        [reference * 3 + 10, reference + rng.normal(size=reference.shape), -reference]
    ).astype(np.float32)
    sources[0, :, 15:] = np.nan
    costs = np.empty(reference.shape, np.uint8)
    correlate(reference, sources, 3, costs)

    def zncc(source: int, y: int, x: int) -> float:
        window = np.s_[y - 3 : y + 4, x - 3 : x + 4]
        return float(np.corrcoef(reference[window].ravel(), sources[source][window].ravel())[0, 1])

    # windows with a NaN do not count, and neither does the third image
    assert costs[10, 8] == int(255 * (1 - (1 + zncc(1, 10, 8)) / 2))
    assert costs[10, 19] == min(255, int(255 * (1 - (zncc(1, 10, 19) - 1) / 2)))
    assert (costs[:3] == 255).all() and (costs[:, -3:] == 255).all()


SIDE_BY_SIDE = [pose_at((x, 0.0, 0.0), 0.0, 0.0) for x in (-0.3, 0.0, 0.3)]
NAMES = ["a/0.png", "a/1.png", "b/2.png"]


def _normals(number: int) -> np.ndarray:
    """Normals (H, W, 3) of the two walls, in the camera's frame, towards it."""
    rotation, exact = SIDE_BY_SIDE[number].rotation_matrix(), depth_m(SIDE_BY_SIDE[number])
    rays = pixel_rays(CAMERA).reshape(*exact.shape, 3)
    world = SIDE_BY_SIDE[number].inverse().apply((rays * exact[..., None]).reshape(-1, 3))
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


def test_colmap_fuses_the_maps_to_the_two_walls(tmp_path: Path) -> None:
    exact = depth_m(SIDE_BY_SIDE[1])
    y, x = np.mgrid[20:280:15, 20:380:15]
    px = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
    xyz = SIDE_BY_SIDE[1].inverse().apply(bearing_rays(CAMERA, px) * exact[y, x].reshape(-1, 1))
    rows = np.arange(len(xyz))
    images = [
        MapImage(name, CAMERA, pose, project(CAMERA, pose, xyz).astype(np.float32))
        for name, pose in zip(NAMES, SIDE_BY_SIDE, strict=True)
    ]
    pixels = [render(pose) for pose in SIDE_BY_SIDE]
    write_workspace(tmp_path, images, pixels, [(rows, rows)] * 3, xyz)
    for number, name in enumerate(NAMES):
        write_map(map_path(tmp_path, "depth", name), depth_m(SIDE_BY_SIDE[number]))
        write_map(map_path(tmp_path, "normal", name), _normals(number))
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = 2
    options.num_threads = 1
    kinds = {"input_type": "photometric", "output_type": "PLY"}
    ply = str(tmp_path / "fused.ply")
    model = pycolmap.stereo_fusion(ply, str(tmp_path), options=options, **kinds)
    fused = np.array([point.xyz for point in model.points3D.values()])
    assert len(fused) > 50_000
    distances = np.min(
        [np.abs((fused - o) @ np.cross(along, [0.0, 1.0, 0.0])) for o, along, _, _ in WALLS], axis=0
    )
    # its stereo has the centre of the first pixel at (0, 0): half a pixel is 1 cm here
    assert np.percentile(distances, 99) < 0.012


def test_maps_equal_colmap(tmp_path: Path) -> None:
    exact = depth_m(SIDE_BY_SIDE[0])
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
    exact, normals = depth_m(SIDE_BY_SIDE[0]), _normals(0)
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
