"""ALIKED against kornia, and peaks of hand-made score maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from images import Image
from kornia.feature import ALIKED
from published import Tensors, random_tensors

from megloc_kapture.features.aliked import _VALUES_AT_ONCE, Aliked, AlikedOptions, aliked_from


@pytest.fixture
def weights(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MEGLOC_WEIGHTS", str(shared_data / "weights"))


def extractor(**options: object) -> Aliked:
    return Aliked(AlikedOptions.model_validate({"device": "cpu", **options}))


@pytest.mark.usefixtures("weights")
def test_keypoints_equal_kornia(
    photograph: Image, shared_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    net = ALIKED("aliked-n16", max_num_keypoints=20_000)
    file = shared_data / "weights" / "aliked" / "aliked-n16.pth"
    net.load_state_dict(torch.load(file, weights_only=True, map_location="cpu"), strict=False)
    image = np.ascontiguousarray(photograph[300:399, 400:531])  # no multiples of 32
    planes = torch.from_numpy(image.transpose(2, 0, 1).astype(np.float32) / 255)
    with torch.inference_mode():
        theirs = net.eval()(planes[None])[0]
    monkeypatch.setitem(_VALUES_AT_ONCE, "cpu", 4 * 16 * 128 * 7)  # described in parts
    ours = extractor(weights="aliked-n16", max_keypoints=20_000).extract(image)
    assert theirs.n > 30
    expected = theirs.keypoints.numpy() + 0.5  # kornia's pixel centres are integers
    distance = np.linalg.norm(expected[:, None] - ours.keypoints_px[None, :, :2], axis=2)
    row = distance.argmin(axis=1)
    assert len(set(row.tolist())) == theirs.n
    assert distance.min(axis=1).max() < 1e-3
    np.testing.assert_allclose(ours.scores[row], theirs.keypoint_scores.numpy(), atol=1e-4)
    np.testing.assert_allclose(ours.descriptors[row], theirs.descriptors.numpy(), atol=1e-4)
    # the authors' suppression keeps a few maxima that kornia drops
    assert theirs.n <= len(ours.scores) <= 1.2 * theirs.n


def calm_tensors(variant: str) -> Tensors:
    """Random weights that amplify rounding little."""
    tensors = random_tensors(variant)
    for key, values in tensors.items():
        if values.ndim > 1:
            values *= 0.5**0.5
        elif key.endswith(("running_var", "weight")):
            values *= 0.5
            values += 0.25
        if "offset_conv" in key:
            values *= 3  # offsets of some pixels
    return tensors


def texture(height: int, width: int, seed: int = 0) -> torch.Tensor:
    """Colours that change smoothly, with edges; (1, 3, H, W) in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, height // 6 + 2, width // 6 + 2, generator=generator)
    fine = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)
    return torch.where(fine > 0.5, fine, fine * 0.5)


@pytest.mark.parametrize("variant", ["aliked-t16", "aliked-n32"])
def test_maps_equal_kornia(variant: str) -> None:
    tensors = calm_tensors(variant)
    image = texture(43, 59)  # no multiples of 32
    kornia_net = ALIKED(variant)
    assert kornia_net.load_state_dict(tensors, strict=False).missing_keys == ["dkd.hw_grid"]
    with torch.inference_mode():
        features, scores = kornia_net.eval().extract_dense_map(image)
        maps = aliked_from(tensors, variant)(image)[0]
        rows, columns = torch.meshgrid(torch.arange(43), torch.arange(59), indexing="ij")
        ours = maps.features_at(rows.reshape(-1), columns.reshape(-1))
    assert scores.std() > 1e-3
    # float32 leaves 1e-4 of offsets of some pixels
    assert (maps.scores - scores[0, 0]).abs().max() < 1e-4
    assert (ours.T.reshape(-1, 43, 59) - features[0]).abs().max() < 1e-4
