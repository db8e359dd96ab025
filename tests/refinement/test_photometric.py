"""Photometric alignment: its derivatives, its steps, its minimum and its covariance."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import bearing_rays, project
from megloc_kapture.refinement.photometric import Alignment, LevelProblem, perturbed
from megloc_kapture.refinement.photometric_points import ChosenPoints
from megloc_kapture.refinement.photometric_pyramid import Level
from megloc_kapture.values import Camera, RigidTransform

Array = NDArray[np.float64]
F, CX, CY = 500.0, 321.0, 238.5
PARAMS = {
    "SIMPLE_PINHOLE": (F, CX, CY),
    "PINHOLE": (F, 510.0, CX, CY),
    "SIMPLE_RADIAL": (F, CX, CY, -0.05),
    "OPENCV": (F, 510.0, CX, CY, -0.05, 0.01, 1e-3, -2e-3),
    "OPENCV_FISHEYE": (F, 510.0, CX, CY, 0.02, -0.01, 3e-3, -1e-3),
    "FOV": (F, 510.0, CX, CY, 0.9),
    "THIN_PRISM_FISHEYE": (F, 510.0, CX, CY, 0.02, -0.01, 1e-3, -1e-3, 1e-3, 0.0, 1e-3, -1e-3),
}
CAMERAS = {model: Camera(model, 640, 480, params) for model, params in PARAMS.items()}
WIDTH, HEIGHT = 160, 120


def random_pose(rng: np.random.Generator) -> RigidTransform:
    return RigidTransform.from_matrix(Rotation.random(rng=rng).as_matrix(), 5 * rng.normal(size=3))


def texture(rng: np.random.Generator, channels: int, deviation_px: float = 1.5) -> Array:
    noise = rng.normal(size=(HEIGHT, WIDTH, channels))
    smooth = cv2.GaussianBlur(noise, (0, 0), deviation_px).reshape(noise.shape)
    return np.asarray(smooth / smooth.std())


def bilinear(values: Array, x: Array, y: Array) -> Array:
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    a, b = (x - column)[:, None], (y - row)[:, None]
    top = (1 - a) * values[row, column] + a * values[row, column + 1]
    low = (1 - a) * values[row + 1, column] + a * values[row + 1, column + 1]
    return np.asarray((1 - b) * top + b * low)


def problem(
    model: str = "PINHOLE",
    *,
    channels: int = 1,
    count: int = 400,
    noise: float = 0.0,
    wrong: float = 0.0,
    seed: int = 0,
) -> tuple[LevelProblem, RigidTransform]:
    """Points whose values are what the query shows at the true pose, up to gain and bias."""
    rng = np.random.default_rng(seed)
    camera, pose = CAMERAS[model], random_pose(rng)
    image = texture(rng, channels)
    px = rng.uniform((20, 20), (camera.width - 20, camera.height - 20), (count, 2))
    points = pose.inverse().apply(bearing_rays(camera, px) * rng.uniform(2.0, 9.0, (count, 1)))
    scale = WIDTH / camera.width
    # as float32, as the level has it
    values = bilinear(image.astype(np.float32).astype(float), *(scale * px.T - 0.5))
    groups = rng.integers(0, 2, count)
    values = np.array([0.7, 1.3])[groups, None] * values + np.array([0.2, -0.4])[groups, None]
    outliers = rng.random(count) < wrong
    values[outliers] += rng.normal(size=(outliers.sum(), channels)) * 3
    # a level's noise is blurred as the level is
    query = (image + noise * texture(rng, channels, 0.8)).astype(np.float32)
    level = Level(query, np.ones((HEIGHT, WIDTH), bool), scale, scale)
    chosen = ChosenPoints(points, values, groups)
    return LevelProblem(chosen, level, camera, pose), pose


def start_from(pose: RigidTransform, seed: int, m: float, deg: float) -> RigidTransform:
    rng = np.random.default_rng(seed)
    turn, shift = rng.normal(size=3), rng.normal(size=3)
    turn *= np.radians(deg) / np.linalg.norm(turn)
    return perturbed(pose, np.concatenate([turn, m * shift / np.linalg.norm(shift)]))


def error_vector(found: RigidTransform, truth: RigidTransform) -> Array:
    true_from_found = truth @ found.inverse()
    vector = Rotation.from_matrix(true_from_found.rotation_matrix()).as_rotvec()
    return np.concatenate([vector, true_from_found.translation])


@given(st.lists(st.floats(-2, 2), min_size=6, max_size=6))
def test_a_perturbation_is_the_exponential_of_its_rotation(step: list[float]) -> None:
    pose = random_pose(np.random.default_rng(1))
    x, y, z = step[:3]
    turn = expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    moved = perturbed(pose, np.array(step))
    np.testing.assert_allclose(moved.rotation_matrix(), turn @ pose.rotation_matrix(), atol=1e-12)
    np.testing.assert_allclose(moved.translation, turn @ pose.translation + step[3:], atol=1e-12)


@pytest.mark.parametrize("model", CAMERAS)
def test_derivatives_equal_differences(model: str) -> None:
    aligned, truth = problem(model, channels=2)
    pose = start_from(truth, 3, 0.02, 0.3)
    gains, biases = np.array([[0.8, 1.1], [1.4, 0.9]]), np.array([[0.1, 0.0], [0.3, -0.2]])
    rows = aligned.rows(pose, gains, biases)
    # bilinear interpolation has a kink at the pixels' centres: stay clear of it
    px = project(aligned.camera, pose, aligned.chosen.points) * aligned.level.scale_x - 0.5
    clear = (np.abs(px - np.round(px)) > 1e-3).all(1) & ~np.isnan(rows[:, 0, 0])
    assert clear.sum() > 300
    for i in range(6):
        step = np.zeros(6)
        step[i] = 1e-6
        above = aligned.rows(perturbed(pose, step), gains, biases)[..., 0]
        below = aligned.rows(perturbed(pose, -step), gains, biases)[..., 0]
        size = np.abs(rows[clear, :, 1 + i]).max()
        difference = (above - below)[clear] / 2e-6 - rows[clear, :, 1 + i]
        assert np.abs(difference).max() < 1e-6 * size


def objective(
    aligned: LevelProblem,
    pose: RigidTransform,
    step: torch.Tensor,
    gains: torch.Tensor,
    biases: torch.Tensor,
    squared_scale: float,
) -> torch.Tensor:
    """The sum of Geman and McClure's losses for SIMPLE_RADIAL, written plainly."""
    chosen, level, (f, cx, cy, k) = aligned.chosen, aligned.level, aligned.camera.params
    x, y, z = step[:3]
    zero = torch.zeros((), dtype=torch.float64)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    turn = torch.linalg.matrix_exp(skew)
    in_camera = torch.from_numpy(pose.apply(chosen.points)) @ turn.T + step[3:]
    uv = in_camera[:, :2] / in_camera[:, 2:]
    uv = uv * (1 + k * (uv**2).sum(1, keepdim=True))
    centre = torch.tensor([cx, cy], dtype=torch.float64)
    xy = (f * uv + centre) * level.scale_x - 0.5
    corner = xy.detach().floor().long()
    inside = ((corner >= 0) & (corner < torch.tensor([WIDTH - 1, HEIGHT - 1]))).all(1)
    xy, corner = xy[inside], corner[inside]
    (a, b), (j, i) = (xy - corner).T[..., None], corner.T
    image = torch.from_numpy(level.values.astype(np.float64))
    query = (1 - a) * (1 - b) * image[i, j] + a * (1 - b) * image[i, j + 1]
    query = query + (1 - a) * b * image[i + 1, j] + a * b * image[i + 1, j + 1]
    group = torch.from_numpy(chosen.groups)[inside]
    residuals = gains[group] * query + biases[group] - torch.from_numpy(chosen.values)[inside]
    squared = (residuals**2).mean(1)
    return (0.5 * squared_scale * squared / (squared_scale + squared)).sum()


@pytest.mark.parametrize("channels", [1, 3])
def test_gradient_equals_autograd(channels: int) -> None:
    aligned, truth = problem("SIMPLE_RADIAL", channels=channels, wrong=0.2)
    pose = start_from(truth, 5, 0.05, 0.5)
    rng = np.random.default_rng(2)
    at = Alignment(pose, rng.uniform(0.5, 1.5, (2, channels)), rng.normal(size=(2, channels)), 1.0)
    system = aligned.system_at(at, 0.49)
    step = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    gains, biases = (torch.tensor(each, requires_grad=True) for each in (at.gains, at.biases))
    cost = objective(aligned, pose, step, gains, biases, 0.49)
    cost.backward()
    assert step.grad is not None and gains.grad is not None and biases.grad is not None
    assert system.mean_cost * system.count == pytest.approx(cost.item(), rel=1e-12)
    np.testing.assert_allclose(system.pose_gradient, step.grad.numpy(), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(system.own_gradient[..., 0], gains.grad.numpy(), rtol=1e-6)
    np.testing.assert_allclose(system.own_gradient[..., 1], biases.grad.numpy(), rtol=1e-6)


def test_a_step_solves_the_whole_system() -> None:
    aligned, truth = problem(channels=2, wrong=0.1)
    at = aligned.nuisance_at(start_from(truth, 4, 0.02, 0.2))
    rows = aligned.rows(at.cam_from_world, at.gains, at.biases)
    seen = ~np.isnan(rows[:, 0, 0])
    rows, groups = rows[seen], aligned.chosen.groups[seen]
    scale2 = 4.0 * at.deviation**2
    weights = (1 + (rows[..., 0] ** 2).mean(1) / scale2) ** -2 / 2
    # unknowns: the pose, then gain and bias of reference 0 channel 0, of reference 0 channel 1 ...
    jacobian = np.zeros((len(rows), 2, 6 + 8))
    jacobian[..., :6] = rows[..., 1:7]
    for c in range(2):
        first = 6 + 2 * (2 * groups + c)
        jacobian[np.arange(len(rows)), c, first] = rows[:, c, 7]
        jacobian[np.arange(len(rows)), c, first + 1] = 1
    matrix = np.einsum("n,nci,ncj->ij", weights, jacobian, jacobian)
    gradient = np.einsum("n,nci,nc->i", weights, jacobian, rows[..., 0])
    expected = np.linalg.solve(matrix, -gradient)
    step = aligned.system_at(at, scale2).step(0.0)
    assert step is not None
    pose_step, gains, biases = step
    np.testing.assert_allclose(pose_step, expected[:6], rtol=1e-5)
    own = np.stack([gains, biases], axis=-1).ravel()
    np.testing.assert_allclose(own, expected[6:], rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("channels", [1, 3])
def test_the_true_pose_is_found_with_gains_and_biases_among_outliers(channels: int) -> None:
    aligned, truth = problem("OPENCV", channels=channels, count=1500, wrong=0.3)
    found = aligned.minimised(
        aligned.nuisance_at(start_from(truth, 7, 0.01, 0.1)), last_step_px=1e-4
    )
    assert np.abs(error_vector(found.cam_from_world, truth)).max() < 1e-4
    np.testing.assert_allclose(found.gains, [[0.7] * channels, [1.3] * channels], atol=1e-3)
    np.testing.assert_allclose(found.biases, [[0.2] * channels, [-0.4] * channels], atol=1e-3)


def test_a_lens_that_folds_back_does_not_show_what_is_outside() -> None:
    # r (1 - 0.3 r^2) turns at r = 1.05 and is back in the middle at r = 1.83
    camera = Camera("SIMPLE_RADIAL", 640, 480, (F, 320.0, 240.0, -0.3))
    chosen = ChosenPoints(
        np.array([[1.8, 0.0, 1.0], [0.1, 0.0, 1.0]]), np.zeros((2, 1)), np.zeros(2, np.int64)
    )
    level = Level(np.ones((480, 640, 1), np.float32), np.ones((480, 640), bool), 1.0, 1.0)
    aligned = LevelProblem(chosen, level, camera, RigidTransform.identity())
    rows = aligned.rows(RigidTransform.identity(), np.ones((1, 1)), np.zeros((1, 1)))
    np.testing.assert_array_equal(np.isnan(rows[:, 0, 0]), [True, False])


def test_covariance_is_that_of_the_errors() -> None:
    errors, claimed = [], []
    for seed in range(60):
        aligned, truth = problem(count=3000, noise=0.3, seed=seed)
        found = aligned.minimised(aligned.nuisance_at(truth), last_step_px=1e-3)
        covariance = aligned.covariance(found)
        assert covariance is not None
        np.testing.assert_allclose(covariance, covariance.T)
        vector = error_vector(found.cam_from_world, truth)
        errors.append(vector @ np.linalg.solve(covariance, vector) / 6)
        claimed.append(np.sqrt(np.diagonal(covariance)))
    # one where it is right; a few dozen cells estimate a covariance itself only roughly
    assert 0.6 < np.mean(errors) < 2.0
    assert np.min(claimed) > 0 and np.max(claimed) < 0.02


def test_a_flat_query_determines_nothing() -> None:
    aligned, truth = problem()
    flat = Level(np.ones((HEIGHT, WIDTH, 1), np.float32), aligned.level.valid, 0.25, 0.25)
    empty = LevelProblem(aligned.chosen, flat, aligned.camera, truth)
    assert empty.covariance(empty.nuisance_at(truth)) is None
