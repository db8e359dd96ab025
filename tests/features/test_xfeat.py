"""XFeat against kornia's extractor and its ONNX export, and where keypoints are."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest
import torch
from images import Image
from kornia.feature.xfeat import InterpolateSparse2d
from kornia.feature.xfeat import XFeat as KorniaXFeat
from numpy.typing import NDArray
from PIL import Image as PillowImage
from published import random_tensors

from megloc_kapture.features.xfeat import (
    XFeat,
    XFeatNetwork,
    XFeatOptions,
    load_xfeat,
    sample_at_pixels,
)
from megloc_kapture.io.weights import find_weights, read_weights

ALL = 100_000


@pytest.fixture(scope="module")
def weights(shared_data: Path) -> str:
    return str(shared_data / "weights" / "xfeat" / "xfeat.onnx")


def extractor(weights: str, **options: object) -> XFeat:
    given = {"weights": weights, "max_keypoints": ALL, "device": "cpu", **options}
    return XFeat(XFeatOptions.model_validate(given))


def test_keypoints_scores_and_descriptors_are_kornias(weights: str, photograph: Image) -> None:
    image = np.ascontiguousarray(photograph[:512, :640])
    theirs = KorniaXFeat(top_k=ALL).eval()
    theirs.net.load_state_dict(read_weights(find_weights(weights)), strict=False)
    tensor = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
    expected = {key: value.numpy() for key, value in theirs.detectAndCompute(tensor)[0].items()}
    found = extractor(weights).extract(image)

    # theirs has the first pixel's centre at (0, 0), and none on the two pixels of the rim
    xy = expected["keypoints"] + np.float32(0.5)
    order = np.lexsort(xy.T)
    ours = np.lexsort(found.keypoints_px[:, :2].T)
    inner = (found.keypoints_px[ours, :2] > 2).all(axis=1)
    ours = ours[inner & (found.keypoints_px[ours, :2] < (638, 510)).all(axis=1)]
    np.testing.assert_array_equal(found.keypoints_px[ours, :2], xy[order])
    np.testing.assert_allclose(found.scores[ours], expected["scores"][order], atol=1e-5)
    # bicubic sampling of a map with steep edges: 1e-4
    np.testing.assert_allclose(found.descriptors[ours], expected["descriptors"][order], atol=5e-4)


@pytest.mark.parametrize(("x", "y"), [(200, 300), (600, 200), (900, 600)])
def test_keypoints_of_an_image_that_is_resized_are_where_they_are(
    weights: str, photograph: Image, x: int, y: int
) -> None:
    """OpenCV enlarges as COLMAP counts, by 47 %; XFeat makes multiples of 32 of it again."""
    small = np.ascontiguousarray(photograph[y : y + 64, x : x + 64])
    large = cv2.resize(small, (94, 94), interpolation=cv2.INTER_LINEAR)
    a = extractor(weights).extract(small).keypoints_px[:, :2]
    b = extractor(weights).extract(np.asarray(large, np.uint8)).keypoints_px[:, :2] * 64 / 94
    distance = np.linalg.norm(a[:, None] - b, axis=2)
    found = distance.min(axis=1) < 1.5
    assert found.sum() > 20
    offset = (b[distance.argmin(axis=1)] - a)[found]
    # without the half pixel of the resizing, (1 - 64 / 94) / 2 = 0.16, a median would be off too
    assert np.abs(np.median(offset, axis=0)).max() < 1e-3
    assert np.abs(offset.mean(axis=0)).max() < 0.12


def test_the_threshold_and_the_window_of_suppression(weights: str, photograph: Image) -> None:
    image = np.ascontiguousarray(photograph[:256, :320])
    default = extractor(weights).extract(image)
    strict = extractor(weights, threshold=0.4).extract(image)
    assert 0 < len(strict.scores) < len(default.scores)
    assert {*map(tuple, strict.keypoints_px)} <= {*map(tuple, default.keypoints_px)}
    gap = np.abs(default.keypoints_px[:, None, :2] - default.keypoints_px[:, :2]).max(axis=2)
    assert gap[~np.eye(len(gap), dtype=bool)].min() > 2


@pytest.fixture(scope="module")
def normalised(shared_data: Path) -> NDArray[np.float32]:
    """A real image, grey, (1, 1, 1024, 1280), of mean 0 and variance 1.

    onnxruntime's own normalisation of a grey image loses three digits to a variance in one pass;
    of an image that is normalised already it does not.
    """
    folder = shared_data / "scenes" / "fountain_p11" / "mapping" / "sensors" / "records_data"
    grey = np.asarray(PillowImage.open(folder / "0003.jpg").convert("L"))[:1024, :1280]
    return ((grey - grey.mean()) / grey.std()).astype(np.float32)[None, None]


def test_a_fine_matcher_and_counters_are_no_fault() -> None:
    tensors = random_tensors("xfeat")
    matcher = {"fine_matcher.0.weight": torch.zeros(512, 128)}
    counters = {
        key: torch.tensor(7)
        for key in XFeatNetwork().state_dict()
        if key.endswith("num_batches_tracked")
    }
    state = load_xfeat(tensors | matcher | counters, "xfeat.pt").state_dict()
    for key, value in (tensors | counters).items():
        torch.testing.assert_close(state[key], value)


def test_the_maps_are_those_of_the_onnx_file(
    shared_data: Path, normalised: NDArray[np.float32]
) -> None:
    file = shared_data / "weights" / "xfeat" / "xfeat.onnx"
    published = read_weights(find_weights(str(file)))
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    expected = session.run(None, {"l_x_": normalised})
    with torch.inference_mode():
        found = load_xfeat(published, "xfeat.onnx")(torch.from_numpy(normalised))
    # features to 7, logits to 25, reliability to 1
    for ours, theirs, tolerance in zip(found, expected, (2e-3, 2e-3, 1e-4), strict=True):
        assert ours.shape == theirs.shape
        np.testing.assert_allclose(ours.numpy(), theirs, atol=tolerance, rtol=0)


def test_the_maps_are_kornias_for_any_size_and_for_colour() -> None:
    tensors = random_tensors("xfeat", 1)
    theirs = KorniaXFeat().eval()
    counters = ("num_batches_tracked", "fine_matcher")
    missing, unexpected = theirs.net.load_state_dict(tensors, strict=False)
    assert not unexpected and all(any(word in key for word in counters) for key in missing)
    image = torch.rand(2, 3, 96, 160, generator=torch.Generator().manual_seed(2))
    with torch.inference_mode():
        expected = theirs.net(image)
        found = load_xfeat(tensors, "x")(image)
    for ours, other in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, other, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
def test_sampling_is_kornias(mode: str) -> None:
    generator = torch.Generator().manual_seed(3)
    values = torch.rand(1, 5, 12, 16, generator=generator)
    xy = torch.stack(
        [
            torch.randint(0, 128, (200,), generator=generator),
            torch.randint(0, 96, (200,), generator=generator),
        ],
        dim=1,
    )
    expected = InterpolateSparse2d(mode)(values, xy[None], H=96, W=128)[0]
    torch.testing.assert_close(sample_at_pixels(values, xy, (96, 128), mode=mode), expected)
