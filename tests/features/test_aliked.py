"""ALIKED keypoints: kornia's, hand-made score maps, and the geometry of real scenes."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from images import Image

from megloc_kapture.features import aliked
from megloc_kapture.features.aliked import Aliked, AlikedOptions
from megloc_kapture.geometry.cameras import bearing_rays
from megloc_kapture.io.images import read_image_rgb
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.matching.nearest_neighbours import match_nearest
from megloc_kapture.matching.verification import ray_slopes, sampson_error_px
from megloc_kapture.nets.aliked import _VALUES_AT_ONCE


@pytest.fixture(autouse=True)
def weights(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(shared_data / "weights"))


def extractor(**options: object) -> Aliked:
    return Aliked(AlikedOptions.model_validate({"device": "cpu", **options}))


@pytest.fixture
def cropped(photograph: Image) -> Image:
    return np.ascontiguousarray(photograph[300:540, 400:720])


@pytest.mark.parametrize("variant", ["aliked-t16", "aliked-n16", "aliked-n16rot", "aliked-n32"])
def test_keypoints_are_kornias(cropped: Image, shared_data: Path, variant: str) -> None:
    feature = pytest.importorskip("kornia.feature")
    net = feature.ALIKED(variant, max_num_keypoints=20_000)
    file = shared_data / "weights" / "aliked" / f"{variant}.pth"
    net.load_state_dict(torch.load(file, weights_only=True, map_location="cpu"), strict=False)
    image = cropped[:195, :262]  # no multiples of 32
    planes = torch.from_numpy(image.transpose(2, 0, 1).astype(np.float32) / 255)
    with torch.inference_mode():
        theirs = net.eval()(planes[None])[0]
    own = extractor(weights=variant, max_keypoints=20_000)
    ours = own.extract(image)
    assert own.name == variant and own.descriptor_size == ours.descriptors.shape[1]
    assert theirs.n > 80
    expected = theirs.keypoints.numpy() + 0.5  # kornia's pixel centres are integers
    distance = np.linalg.norm(expected[:, None] - ours.keypoints_px[None, :, :2], axis=2)
    row = distance.argmin(axis=1)
    assert len(set(row.tolist())) == theirs.n
    assert distance.min(axis=1).max() < 1e-3
    np.testing.assert_allclose(ours.scores[row], theirs.keypoint_scores.numpy(), atol=1e-4)
    np.testing.assert_allclose(ours.descriptors[row], theirs.descriptors.numpy(), atol=1e-4)
    # kornia keeps the strict maxima only; the authors' suppression, and ours, adds to them what
    # these do not suppress
    assert theirs.n <= len(ours.scores) <= 1.2 * theirs.n


def test_a_peak_of_the_score_map_lies_at_its_pixels_centre(monkeypatch: pytest.MonkeyPatch) -> None:
    scores = torch.full((40, 50), 0.01)
    for x, y, score in ((20, 10, 0.9), (35, 30, 0.6), (1, 20, 0.8), (30, 5, 0.15)):
        scores[y - 1 : y + 2, x - 1 : x + 2] = score / 2
        scores[y, x] = score
    maps = SimpleNamespace(scores=scores)

    class Net:
        def __call__(self, image: torch.Tensor) -> list[SimpleNamespace]:
            return [maps]

        def desc_head(self, _: object, xy: torch.Tensor) -> torch.Tensor:
            return torch.ones(len(xy), 128)

    monkeypatch.setattr(aliked.Aliked, "network", lambda *_: (Net(), torch.device("cpu")))
    found = extractor().extract(np.zeros((40, 50, 3), np.uint8))
    # the one at x = 1 is within two pixels of the border, the last one is too weak
    np.testing.assert_allclose(
        found.keypoints_px, [[20.5, 10.5, 0.9], [35.5, 30.5, 0.6]], atol=1e-5
    )


@pytest.mark.parametrize(
    ("scene", "step", "keypoints", "least"),
    [("fountain_p11", 1, 1500, 0.6), ("redkitchen_rgbd", 5, 500, 0.6)],
)
def test_matches_of_real_images_lie_on_epipolar_lines(
    shared_data: Path, scene: str, step: int, keypoints: int, least: float
) -> None:
    folder = KaptureFolder(shared_data / "scenes" / scene / "mapping")
    data = folder.read()
    names = sorted(data.poses())[: step + 1 : step]
    features = [extractor().extract(read_image_rgb(folder.image_path(name))) for name in names]
    # the large one has as many as the default keeps
    assert all(keypoints <= len(found.scores) <= 1500 for found in features)
    for (a, of_a), (b, of_b) in pairwise(zip(names, features, strict=True)):
        matches, _ = match_nearest(of_a.descriptors, of_b.descriptors)
        sides = []
        for name, of, rows in ((a, of_a, matches[:, 0]), (b, of_b, matches[:, 1])):
            px, camera = of.keypoints_px[rows, :2], data.camera_of(name)
            rays = bearing_rays(camera, px)
            sides += [rays, ray_slopes(camera, px, rays)]
        pose_a, pose_b = data.cam_from_world(a), data.cam_from_world(b)
        assert pose_a is not None and pose_b is not None
        error = sampson_error_px(*sides, pose_b @ pose_a.inverse())
        assert len(matches) > 200
        assert (error < 2).mean() > least


def test_many_keypoints_are_described_in_parts(
    cropped: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = extractor().extract(cropped)
    monkeypatch.setitem(_VALUES_AT_ONCE, "cpu", 4 * 16 * 128 * 7)
    parts = extractor().extract(cropped)
    np.testing.assert_array_equal(whole.keypoints_px, parts.keypoints_px)
    np.testing.assert_allclose(whole.descriptors, parts.descriptors, atol=1e-5)
