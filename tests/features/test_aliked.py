"""ALIKED keypoints: kornia's, hand-made score maps, and the geometry of real scenes."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from images import Image
from published import Tensors, random_tensors

from megloc_kapture.features import aliked
from megloc_kapture.features.aliked import (
    _VALUES_AT_ONCE,
    Aliked,
    AlikedNet,
    AlikedOptions,
    aliked_from,
)


@pytest.fixture
def weights(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(shared_data / "weights"))


def extractor(**options: object) -> Aliked:
    return Aliked(AlikedOptions.model_validate({"device": "cpu", **options}))


@pytest.fixture
def cropped(photograph: Image) -> Image:
    return np.ascontiguousarray(photograph[300:540, 400:720])


@pytest.mark.usefixtures("weights")
@pytest.mark.parametrize("variant", ["aliked-t16", "aliked-n16", "aliked-n16rot", "aliked-n32"])
def test_keypoints_are_kornias(cropped: Image, shared_data: Path, variant: str) -> None:
    feature = pytest.importorskip("kornia.feature")
    net = feature.ALIKED(variant, max_num_keypoints=20_000)
    file = shared_data / "weights" / "aliked" / f"{variant}.pth"
    net.load_state_dict(torch.load(file, weights_only=True, map_location="cpu"), strict=False)
    image = cropped[:163, :198]  # no multiples of 32
    planes = torch.from_numpy(image.transpose(2, 0, 1).astype(np.float32) / 255)
    with torch.inference_mode():
        theirs = net.eval()(planes[None])[0]
    plugin = extractor(weights=variant, max_keypoints=20_000)
    ours = plugin.extract(image)
    assert plugin.name == variant and plugin.descriptor_size == ours.descriptors.shape[1]
    assert theirs.n > 50
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


@pytest.mark.usefixtures("weights")
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
    result = extractor().extract(np.zeros((40, 50, 3), np.uint8))
    # the one at x = 1 is within two pixels of the border, the last one is too weak
    np.testing.assert_allclose(
        result.keypoints_px, [[20.5, 10.5, 0.9], [35.5, 30.5, 0.6]], atol=1e-5
    )


@pytest.mark.usefixtures("weights")
def test_many_keypoints_are_described_in_parts(
    cropped: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    cropped = cropped[:120, :160]
    whole = extractor().extract(cropped)
    monkeypatch.setitem(_VALUES_AT_ONCE, "cpu", 4 * 16 * 128 * 7)
    parts = extractor().extract(cropped)
    np.testing.assert_array_equal(whole.keypoints_px, parts.keypoints_px)
    np.testing.assert_allclose(whole.descriptors, parts.descriptors, atol=1e-5)


def calm_tensors(variant: str) -> Tensors:
    """Random ones that magnify rounding less."""
    tensors = random_tensors(variant)
    for key, values in tensors.items():
        if values.ndim > 1:
            values *= 0.5**0.5
        elif key.endswith(("running_var", "weight")):
            values *= 0.5
            values += 0.25
        if "offset_conv" in key:
            values *= 3  # readings some pixels away
    return tensors


def kornias(variant: str, tensors: Tensors, **options: Any) -> torch.nn.Module:
    feature = pytest.importorskip("kornia.feature")
    net = feature.ALIKED(variant, **options)
    missing, unexpected = net.load_state_dict(tensors, strict=False)
    assert missing == ["dkd.hw_grid"] and not unexpected
    return net.eval()


def texture(height: int, width: int, seed: int = 0) -> torch.Tensor:
    """Colours that change smoothly, with edges; (1, 3, H, W) in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, height // 6 + 2, width // 6 + 2, generator=generator)
    fine = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)
    return torch.where(fine > 0.5, fine, fine * 0.5)


def dense_features(net: AlikedNet, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Score map (H, W) and all features (D, H, W)."""
    maps = net(image)[0]
    height, width = maps.scores.shape
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    features = maps.features_at(rows.reshape(-1), columns.reshape(-1))
    return maps.scores, features.T.reshape(-1, height, width)


@pytest.mark.parametrize("variant", ["aliked-t16", "aliked-n32"])
def test_random_weights_give_kornias_maps(variant: str) -> None:
    tensors = calm_tensors(variant)
    image = texture(59, 75)  # no multiples of 32
    with torch.inference_mode():
        features, scores = kornias(variant, tensors).extract_dense_map(image)
        our_scores, our_features = dense_features(aliked_from(tensors, variant), image)
    assert scores.std() > 1e-3  # the weights say something
    # readings some pixels off in maps of this size: 1e-4 is what float32 leaves of them
    assert (our_scores - scores[0, 0]).abs().max() < 1e-4
    assert (our_features - features[0]).abs().max() < 1e-4
