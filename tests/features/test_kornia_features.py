"""XFeat and DISK against kornia, from local files only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import kornia.core.download
import numpy as np
import pytest
import torch
from images import Image
from kornia.feature import DISK
from kornia.feature.xfeat import XFeat as KorniaXFeat

from megloc_kapture.features.kornia_features import Disk, DiskOptions, XFeat, XFeatOptions
from megloc_kapture.io.weights import find_weights, read_weights

ALL = 100_000


@pytest.fixture(scope="module")
def weights(shared_data: Path) -> str:
    return str(shared_data / "weights" / "xfeat" / "xfeat.pt")


@pytest.fixture(autouse=True)
def _no_download(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("kornia downloads")

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", refuse)
    monkeypatch.setattr(kornia.core.download, "load_state_dict_from_url", refuse)


def xfeat(weights: str, **options: object) -> XFeat:
    given = {"weights": weights, "max_keypoints": ALL, "device": "cpu", **options}
    return XFeat(XFeatOptions.model_validate(given))


def test_xfeat_equals_kornia_shifted_by_half_a_pixel(weights: str, photograph: Image) -> None:
    image = np.ascontiguousarray(photograph[300:428, 400:560])
    theirs = KorniaXFeat(top_k=ALL).eval()
    theirs.net.load_state_dict(read_weights(find_weights(weights)))
    tensor = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
    expected = {key: value.numpy() for key, value in theirs.detectAndCompute(tensor)[0].items()}
    result = xfeat(weights).extract(image)
    # theirs has the first pixel's centre at (0, 0)
    ours = np.lexsort(result.keypoints_px[:, :2].T)
    order = np.lexsort(expected["keypoints"].T)
    np.testing.assert_array_equal(result.keypoints_px[ours, :2] - 0.5, expected["keypoints"][order])
    np.testing.assert_allclose(result.descriptors[ours], expected["descriptors"][order], atol=1e-4)
    # the same weights as separate descriptor weights give the same descriptors
    again = xfeat(weights, descriptor_weights=weights).extract(image)
    np.testing.assert_allclose(again.descriptors, result.descriptors, atol=1e-4)


def test_keypoints_of_an_enlarged_image_keep_their_place(weights: str, photograph: Image) -> None:
    """OpenCV enlarges by 47 % in COLMAP's coordinates; XFeat resizes to multiples of 32."""
    small = np.ascontiguousarray(photograph[300:364, 200:264])
    large = cv2.resize(small, (94, 94), interpolation=cv2.INTER_LINEAR)
    a = xfeat(weights).extract(small).keypoints_px[:, :2]
    b = xfeat(weights).extract(np.asarray(large, np.uint8)).keypoints_px[:, :2] * 64 / 94
    distance = np.linalg.norm(a[:, None] - b, axis=2)
    result = distance.min(axis=1) < 1.5
    assert result.sum() > 20
    offset = (b[distance.argmin(axis=1)] - a)[result]
    # a missing half pixel would shift the median by (1 - 64 / 94) / 2 = 0.16
    assert np.abs(np.median(offset, axis=0)).max() < 1e-3
    assert np.abs(offset.mean(axis=0)).max() < 0.12


def test_disk_of_a_local_file_equals_kornia(tmp_path: Path, photograph: Image) -> None:
    torch.manual_seed(0)
    network = DISK().eval()
    torch.save({"extractor": network.state_dict()}, tmp_path / "depth-save.pth")
    options = {"weights": str(tmp_path / "depth-save.pth"), "max_keypoints": 10, "device": "cpu"}
    image = np.ascontiguousarray(photograph[300:364, 400:480])
    mask = np.ones(image.shape[:2], bool)
    mask[:, :40] = False
    result = Disk(DiskOptions.model_validate(options)).extract(image, mask)
    assert result.keypoints_px.shape == (10, 3) and result.descriptors.shape == (10, 128)
    assert result.keypoints_px[:, 0].min() > 40 and result.num_masked > 0
    tensor = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
    with torch.inference_mode():
        theirs = network(tensor, pad_if_not_divisible=True)[0]
    known = {tuple(xy) for xy in (theirs.keypoints.numpy() + 0.5).tolist()}
    assert {tuple(xy) for xy in result.keypoints_px[:, :2].tolist()} <= known
