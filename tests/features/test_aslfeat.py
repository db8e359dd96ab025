"""ASLFeat against TensorFlow, and keypoints of hand-made score maps."""

from __future__ import annotations

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
    AslFeatOptions,
    aslfeat_from,
    on_no_edge,
    peakiness,
)

# written by TensorFlow, see tests/nets/data/README.md
TENSORFLOW = Path(__file__).parent.parent / "nets" / "data" / "aslfeat"


def extractor(weights: Path, **options: object) -> AslFeat:
    given = {"weights": str(weights), "device": "cpu", **options}
    return AslFeat(AslFeatOptions.model_validate(given))


@pytest.mark.parametrize("image", ["even", "odd"])
def test_keypoints_equal_tensorflow(image: str, tmp_path: Path) -> None:
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


def test_keypoints_of_all_scales_have_coordinates_of_the_image(
    monkeypatch: pytest.MonkeyPatch, aslfeat_weights: Path
) -> None:
    # the score is the brightness, so the spot is detected on every scale
    def net(gray: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        features = torch.ones(1, 128, -(-gray.shape[2] // 4), -(-gray.shape[3] // 4))
        return gray[:, 0] / 255, features

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


def test_conversion_ignores_the_state_of_the_optimiser() -> None:
    variables = tensorflows_variables()
    slots = {
        "conv0/kernel/Momentum": variables["conv0/kernel"],
        "deform_param/conv6/offset/bias/Adam_1": np.zeros(18),
    }
    assert aslfeat_state(variables | slots).keys() == converted().keys()


def test_unsuitable_weights_are_named() -> None:
    state = converted()
    state["conv7.weight"] = state.pop("conv6_0.weight")
    with pytest.raises(DataError, match=r"model\.ckpt: .*conv6_0\.weight.*conv7\.weight"):
        aslfeat_from(state, "model.ckpt")


def test_strips_give_the_same_peakiness(monkeypatch: pytest.MonkeyPatch) -> None:
    features = torch.randn(6, 20, 11, generator=torch.Generator().manual_seed(1))
    whole = peakiness(features, 3, torch.tensor(1.0))
    monkeypatch.setitem(aslfeat._VALUES_AT_ONCE, "cpu", 3 * 11 * 6)
    torch.testing.assert_close(peakiness(features, 3, torch.tensor(1.0)), whole, rtol=0, atol=1e-6)


ROWS, COLUMNS = torch.meshgrid(*[torch.arange(41.0, dtype=torch.float64) - 20] * 2, indexing="ij")
CENTRE = torch.tensor([[20, 20]])


@pytest.mark.parametrize(
    ("length_px", "max_ratio", "kept"),
    [(4.0, 10.0, True), (9.0, 10.0, True), (30.0, 10.0, False), (9.0, 2.0, False)],
)
def test_long_blobs_are_edges(length_px: float, max_ratio: float, kept: bool) -> None:
    blob = torch.exp(-((COLUMNS / 4) ** 2 + (ROWS / length_px) ** 2) / 2)
    assert on_no_edge(blob, CENTRE, max_ratio).tolist() == [kept]


def test_saddles_and_flat_regions_are_rejected() -> None:
    for scores in (COLUMNS**2 - ROWS**2, torch.ones(41, 41)):
        assert not on_no_edge(scores, CENTRE, 10.0).any()
