"""PatchmatchNet: its checkpoint fits, its warp is the projection, and it finds two walls."""

from __future__ import annotations

import runpy
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from corner import CAMERA, depth_m, pose_at, render

from megloc_kapture.errors import DataError
from megloc_kapture.geometry.cameras import bearing_rays, project
from megloc_kapture.io.weights import find_weights, read_weights, sha256_of
from megloc_kapture.mvs.learned import LearnedStereo, LearnedStereoOptions
from megloc_kapture.mvs.views import relative_projection, stereo_view
from megloc_kapture.nets.patchmatchnet import (
    PatchmatchNet,
    _grid,
    _sampled,
    _warped,
    patchmatchnet_from,
)
from megloc_kapture.plugins import StereoView

POSES = [pose_at((x, 0.1 * (-1) ** i, 0.0), 0.5 * i, 0.0) for i, x in enumerate((0, -0.5, 0.5))]


@pytest.fixture(scope="module")
def checkpoint(shared_data: Path) -> Path:
    return shared_data / "weights" / "patchmatchnet" / "params_000007.ckpt"


def test_the_published_checkpoint_fits_strictly(checkpoint: Path) -> None:
    weights = find_weights(str(checkpoint))
    tensors = read_weights(weights)
    network = patchmatchnet_from(tensors, str(checkpoint))
    assert sum(values.numel() for values in network.parameters()) == 222_632
    assert not network.training
    assert sha256_of(weights).startswith("477b056c")
    del tensors["feature.inner1.bias"]
    with pytest.raises(DataError, match="feature.inner1.bias"):
        patchmatchnet_from(tensors, str(checkpoint))


def test_depth_is_the_authors() -> None:
    published = Path(__file__).parent / "data" / "patchmatchnet"
    script = runpy.run_path(str(published / "make_reference.py"))
    outputs = np.load(published / "reference.npz")
    network = PatchmatchNet().eval()
    shapes = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    network.load_state_dict(script["weights"](shapes), strict=True)
    images = [torch.from_numpy(one).permute(2, 0, 1)[None] / 255 for one in outputs["images"]]
    k, rotations, translations = (
        outputs[name] for name in ("intrinsics", "rotations", "translations")
    )
    projections = []
    for rotation, translation in zip(rotations[1:], translations[1:], strict=True):
        turned = rotation @ rotations[0].T
        moved = translation - turned @ translations[0]
        parts = k @ turned @ np.linalg.inv(k), k @ moved
        projections.append((torch.from_numpy(parts[0]), torch.from_numpy(parts[1])))

    def estimated(brightness: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        seen = [brightness * image for image in images]
        with torch.inference_mode():
            found = network(seen, projections, script["LIMITS"], seed=0)
        return found[0].numpy(), found[1].numpy()

    depth, confidence = estimated()
    near, far = np.quantile(outputs["depth"], [0.1, 0.9])
    low, high = np.quantile(outputs["confidence"], [0.1, 0.9])
    assert far > 1.5 * near and high > low + 0.1
    # hypotheses that differ in their last bits are scored a thousand times as far apart
    assert np.abs(depth - outputs["depth"]).max() < 0.02
    assert np.median(np.abs(depth - outputs["depth"])) < 2e-4
    # a confidence is that of the likeliest hypotheses: where others are as likely, last bits
    # choose, which differ between processors; brightness that changes as little tells where
    moved = [1 + sign * change for change in (1e-6, 3e-6, 1e-5) for sign in (1, -1)]
    own = np.max([np.abs(estimated(each)[1] - confidence) for each in moved], axis=0)
    assert np.count_nonzero(own > 0.005) < 0.01 * own.size
    assert np.abs(confidence - outputs["confidence"])[own <= 0.005].max() < 0.01


def test_features_are_warped_to_where_hypotheses_project() -> None:
    views = [StereoView(render(pose), CAMERA, pose) for pose in POSES[:2]]
    infinity, baseline = relative_projection(*views)
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    source = torch.tensor(np.stack([x, y]), dtype=torch.float32)[None]
    samples = torch.full((1, 2, CAMERA.height, CAMERA.width), 5.0)
    samples[:, 1] = 7.0
    projection = torch.from_numpy(infinity), torch.from_numpy(baseline)
    found = _warped(source, projection, samples).numpy()[0]
    px = np.array([[150.5, 100.5], [220.5, 160.5], [300.5, 200.5]])
    for number, depth in enumerate((5.0, 7.0)):
        world = POSES[0].inverse().apply(bearing_rays(CAMERA, px) * depth)
        expected = project(CAMERA, POSES[1], world) - 0.5
        columns, rows = px.astype(int).T
        np.testing.assert_allclose(found[:, number, rows, columns].T, expected, atol=2e-3)


def test_what_lies_behind_a_source_is_nothing() -> None:
    projection = torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0.0, -9.0])
    found = _warped(torch.ones(1, 1, 6, 8), projection, torch.full((1, 1, 6, 8), 5.0))
    assert not found.any()


def test_offsets_lead_to_neighbours() -> None:
    values = torch.arange(63, dtype=torch.float32).view(1, 1, 7, 9)
    learned = torch.zeros(1, 4, 7, 9)
    found = _sampled(values, _grid([(0, 0), (-1, 2)], learned))[0, 0]
    # read by the outer edges what is normalised by the outer centres: off by less than half
    assert (found[0] - values[0, 0]).abs().max() < 0.51 * 10
    middle = found[1, 3, 4] - values[0, 0, 3, 4]
    assert -9 + 2 - 1.5 < middle < -9 + 2 + 1.5
    moved = learned.clone()
    moved[:, 0] = 1.0  # one pixel to the right
    shifted = _sampled(values, _grid([(0, 0), (-1, 2)], moved))[0, 0, 0]
    assert 0.9 < float((shifted - found[0])[2:5, 2:6].mean()) < 1.3


def test_depth_of_two_walls_twice_the_same(checkpoint: Path) -> None:
    views = [stereo_view(render(pose), CAMERA, pose, None, 240) for pose in POSES]
    stereo = LearnedStereo(LearnedStereoOptions(weights=str(checkpoint)))
    found, again = (stereo.estimate(views[0], views[1:], (3.0, 9.0)) for _ in range(2))
    assert found.depth_m.tobytes() == again.depth_m.tobytes()
    exact = cv2.resize(depth_m(POSES[0]), (240, 180), interpolation=cv2.INTER_NEAREST)
    known = (found.depth_m > 0) & (exact > 0)
    assert known.mean() > 0.5
    error = np.abs(found.depth_m - exact)[known] / exact[known]
    assert np.median(error) < 0.02 and np.mean(error < 0.06) > 0.8


def test_random_weights_run_on_any_even_pyramid() -> None:
    network = PatchmatchNet().eval()
    images = [torch.rand(1, 3, 48, 64) for _ in range(2)]
    projection = torch.eye(3, dtype=torch.float64), torch.tensor([5.0, 0.0, 0.0])
    with torch.inference_mode():
        depth, confidence = network(images, [projection], (1.0, 4.0))
    assert depth.shape == (48, 64) and confidence.shape == (24, 32)
    assert ((confidence >= 0) & (confidence <= 1.001)).all()
