"""ASLFeat keypoints: hand-made score maps, random weights, and TensorFlow's keypoints."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from convert_weights import aslfeat_state
from safetensors.torch import save_file

from megloc_kapture.errors import DataError
from megloc_kapture.features import aslfeat
from megloc_kapture.features.aslfeat import (
    AslFeat,
    AslFeatMaps,
    AslFeatOptions,
    aslfeat_from,
    on_no_edge,
    peakiness,
)
from megloc_kapture.values import LocalFeatures

# what make_reference.py of it has written
TENSORFLOW = Path(__file__).parent.parent / "nets" / "data" / "aslfeat"
OnMaps = Callable[..., LocalFeatures]


def extractor(weights: Path, **options: object) -> AslFeat:
    given = {"weights": str(weights), "device": "cpu", **options}
    return AslFeat(AslFeatOptions.model_validate(given))


@pytest.fixture
def on_maps(monkeypatch: pytest.MonkeyPatch, aslfeat_weights: Path) -> OnMaps:
    """Extracts where the network answers with given maps."""

    def extracted(scores: torch.Tensor, features: torch.Tensor | None = None) -> LocalFeatures:
        height, width = scores.shape
        if features is None:
            features = torch.ones(128, -(-height // 4), -(-width // 4))
        given = (lambda _: [AslFeatMaps(scores, features)]), torch.device("cpu")
        monkeypatch.setattr(aslfeat.AslFeat, "network", lambda *_: given)
        image = np.zeros((height, width, 3), np.uint8)
        image[0] = 255  # an image without any contrast is not looked at
        return extractor(aslfeat_weights).extract(image)

    return extracted


def blobs(centres: list[tuple[float, float]], heights: list[float]) -> torch.Tensor:
    """Score map of 60 x 80 with round peaks of 2 px around (x, y), integers at pixel centres."""
    rows, columns = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    scores = torch.full((60, 80), 0.1)
    for (x, y), height in zip(centres, heights, strict=True):
        scores += (height - 0.1) * torch.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 8)
    return scores


def test_the_centre_of_a_blob(on_maps: OnMaps) -> None:
    # a blob on a pixel's centre lies a half further in COLMAP's coordinates
    centres = [(20.0, 30.0), (50.3, 20.0), (60.25, 45.6)]
    result = on_maps(blobs(centres, [2.0, 1.5, 1.0]))
    assert len(result.scores) == 3
    expected = np.array(centres) + 0.5
    assert np.abs(result.keypoints_px[:, :2] - expected).max() < 0.05
    np.testing.assert_allclose(result.keypoints_px[0, :2], [20.5, 30.5], atol=1e-4)
    np.testing.assert_allclose(result.scores[0], 2.0, atol=1e-3)


def test_weak_peaks_and_peaks_at_the_border_are_left_out(on_maps: OnMaps) -> None:
    centres = [(4.0, 30.0), (5.0, 45.0), (75.0, 20.0), (74.0, 40.0), (40.0, 30.0)]
    scores = blobs(centres, [2.0, 1.5, 2.0, 1.2, 0.4])
    result = on_maps(scores)
    np.testing.assert_allclose(result.keypoints_px[:, :2], [[5.5, 45.5], [74.5, 40.5]], atol=0.01)


@pytest.mark.parametrize("image", ["even", "odd"])
def test_keypoints_are_tensorflows(image: str, tmp_path: Path) -> None:
    outputs = np.load(TENSORFLOW / "reference.npz")
    gray = outputs[f"{image}/image"]
    save_file(converted(), tmp_path / "aslfeat.safetensors")
    result = extractor(tmp_path / "aslfeat.safetensors").extract(np.repeat(gray[..., None], 3, 2))
    assert len(result.scores) > 40
    # the published network puts the first pixel's centre at (0, 0)
    np.testing.assert_allclose(
        result.keypoints_px[:, :2] - 0.5, outputs[f"{image}/keypoints"], rtol=0, atol=1e-4
    )
    np.testing.assert_allclose(result.scores, outputs[f"{image}/scores"], rtol=0, atol=1e-5)
    np.testing.assert_allclose(
        result.descriptors, outputs[f"{image}/descriptors"], rtol=0, atol=1e-5
    )


def test_keypoints_of_small_scales_lie_where_they_are_in_the_image(
    monkeypatch: pytest.MonkeyPatch, aslfeat_weights: Path
) -> None:
    # the network marks the brightest pixel of its input: the spot is detected on every scale
    def net(gray: torch.Tensor) -> list[AslFeatMaps]:
        features = torch.ones(128, -(-gray.shape[2] // 4), -(-gray.shape[3] // 4))
        return [AslFeatMaps(gray[0, 0] / 255, features)]

    monkeypatch.setattr(aslfeat.AslFeat, "network", lambda *_: (net, torch.device("cpu")))
    y, x = np.mgrid[:500, :1000] + 0.5
    spot = 250 * np.exp(-((x - 700.5) ** 2 + (y - 300.5) ** 2) / (2 * 5.0**2))
    image = np.repeat(spot.round().astype(np.uint8)[..., None], 3, axis=2)
    result = extractor(aslfeat_weights, multi_scale=True, threshold=0.4).extract(image)
    assert len(result.scores) == 3
    np.testing.assert_allclose(result.keypoints_px[:, :2], [[700.5, 300.5]] * 3, atol=0.1)


def tensorflows_variables() -> dict[str, np.ndarray]:
    with np.load(TENSORFLOW / "variables.npz") as written:
        return dict(written)


def converted() -> dict[str, torch.Tensor]:
    return aslfeat_state(tensorflows_variables())


def test_optimiser_state_is_left_out() -> None:
    variables = tensorflows_variables()
    slots = {
        "conv0/kernel/Momentum": variables["conv0/kernel"],
        "deform_param/conv6/offset/bias/Adam_1": np.zeros(18),
    }
    assert aslfeat_state(variables | slots).keys() == converted().keys()


def test_mismatched_weights_are_named() -> None:
    state = converted()
    for scale in (0.0, -1.0, math.inf):
        with pytest.raises(DataError, match="tower/conv1/instance_max"):
            aslfeat_from(state | {"tower.conv1.instance_max": torch.tensor(scale)}, "x")
    state["conv7.weight"] = state.pop("conv6_0.weight")
    state["conv3.weight"] = torch.zeros(32, 64, 3, 3)
    with pytest.raises(DataError) as caught:
        aslfeat_from(state, "model.ckpt")
    for part in ("model.ckpt", "conv6_0.weight", "conv7.weight", "conv3.weight is (32, 64, 3, 3)"):
        assert part in str(caught.value)


@pytest.mark.parametrize("image", ["even", "odd"])
@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 1e-5)], ids=["64", "32"]
)
def test_maps_are_tensorflows(image: str, dtype: torch.dtype, tolerance: float) -> None:
    outputs = np.load(TENSORFLOW / "reference.npz")
    net = aslfeat_from(converted(), "aslfeat").to(dtype)
    gray = torch.from_numpy(outputs[f"{image}/image"]).to(dtype)
    with torch.inference_mode():
        maps = net(gray[None, None])[0]
    scores = torch.from_numpy(outputs[f"{image}/score_map"]).to(dtype)
    features = torch.from_numpy(outputs[f"{image}/features"]).to(dtype).permute(2, 0, 1)
    assert scores.std() > 0.1 and features.std() > 0.5  # the comparison says something
    torch.testing.assert_close(maps.scores, scores, rtol=0, atol=tolerance)
    torch.testing.assert_close(maps.features, features, rtol=0, atol=10 * tolerance)


def test_strips_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    features = torch.randn(6, 20, 11, generator=torch.Generator().manual_seed(1))
    whole = peakiness(features, 3, torch.tensor(1.0))
    monkeypatch.setitem(aslfeat._VALUES_AT_ONCE, "cpu", 3 * 11 * 6)
    torch.testing.assert_close(peakiness(features, 3, torch.tensor(1.0)), whole, rtol=0, atol=1e-6)


ROWS, COLUMNS = torch.meshgrid(*[torch.arange(41.0, dtype=torch.float64) - 20] * 2, indexing="ij")
CENTRE = torch.tensor([[20, 20]])


@pytest.mark.parametrize(
    ("length_px", "max_ratio", "stays"),
    [(4.0, 10.0, True), (9.0, 10.0, True), (30.0, 10.0, False), (9.0, 2.0, False)],
)
def test_a_round_blob_is_no_edge_and_a_long_one_is(
    length_px: float, max_ratio: float, stays: bool
) -> None:
    blob = torch.exp(-((COLUMNS / 4) ** 2 + (ROWS / length_px) ** 2) / 2)
    assert on_no_edge(blob, CENTRE, max_ratio).tolist() == [stays]


def test_a_saddle_and_flat_ground_are_refused() -> None:
    for scores in (COLUMNS**2 - ROWS**2, torch.ones(41, 41)):
        assert not on_no_edge(scores, CENTRE, 10.0).any()
