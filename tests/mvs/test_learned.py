"""PatchmatchNet: the authors' depth, and that of two walls."""

from __future__ import annotations

import runpy
from pathlib import Path

import cv2
import numpy as np
import torch
from corner import CAMERA, depth_m, pose_at, render
from published import shapes_of

from megloc_kapture.mvs.learned import (
    LearnedStereo,
    LearnedStereoOptions,
    PatchmatchNet,
    _warped,
)
from megloc_kapture.mvs.views import stereo_view

POSES = [pose_at((x, 0.1 * (-1) ** i, 0.0), 0.5 * i, 0.0) for i, x in enumerate((0, -0.5, 0.5))]


def test_depth_is_the_authors() -> None:
    published = Path(__file__).parent.parent / "nets" / "data" / "patchmatchnet"
    script = runpy.run_path(str(published / "make_reference.py"))
    outputs = np.load(published / "reference.npz")
    network = PatchmatchNet().eval()
    network.load_state_dict(script["weights"](shapes_of(network)), strict=True)
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

    with torch.inference_mode():
        found = network(images, projections, script["LIMITS"], seed=0)
    near, far = np.quantile(outputs["depth"], [0.1, 0.9])
    low, high = np.quantile(outputs["confidence"], [0.1, 0.9])
    assert far > 1.5 * near and high > low + 0.1
    # where hypotheses are as likely as each other, in some pixels of a thousand, last bits choose,
    # which differ between processors
    depth, confidence = (
        np.abs(values.numpy() - outputs[name])
        for name, values in zip(("depth", "confidence"), found, strict=True)
    )
    assert np.median(depth) < 2e-4 and np.mean(depth > 0.005) < 0.01
    assert np.mean(depth > 0.01) < 0.005 and depth.max() < 0.05
    assert np.median(confidence) < 2e-4 and np.mean(confidence > 0.005) < 0.004


def test_what_lies_behind_a_source_is_nothing() -> None:
    behind = torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0.0, -9.0])
    assert not _warped(torch.ones(1, 1, 6, 8), behind, torch.full((1, 1, 6, 8), 5.0)).any()


def test_depth_of_two_walls_twice_the_same(shared_data: Path) -> None:
    views = [stereo_view(render(pose), CAMERA, pose, None, 240) for pose in POSES]
    checkpoint = shared_data / "weights" / "patchmatchnet" / "params_000007.ckpt"
    stereo = LearnedStereo(LearnedStereoOptions(weights=str(checkpoint)))
    found, again = (stereo.estimate(views[0], views[1:], (3.0, 9.0)) for _ in range(2))
    assert found.depth_m.tobytes() == again.depth_m.tobytes()
    exact = cv2.resize(depth_m(POSES[0]), (240, 180), interpolation=cv2.INTER_NEAREST)
    known = (found.depth_m > 0) & (exact > 0)
    assert known.mean() > 0.5
    error = np.abs(found.depth_m - exact)[known] / exact[known]
    assert np.median(error) < 0.02 and np.mean(error < 0.06) > 0.8
