"""ASLFeat keypoints: hand-made score maps, random weights, and TensorFlow's keypoints."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from convert_weights import aslfeat_state
from images import random_image, texture
from safetensors.torch import save_file

from megloc_kapture.errors import DataError
from megloc_kapture.features import aslfeat
from megloc_kapture.features.aslfeat import (
    AslFeat,
    AslFeatMaps,
    AslFeatOptions,
    aslfeat_from,
    conv_same,
    on_no_edge,
    peakiness,
    resize_as_tensorflow_1,
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
    found = on_maps(blobs(centres, [2.0, 1.5, 1.0]))
    assert len(found.scores) == 3
    expected = np.array(centres) + 0.5
    assert np.abs(found.keypoints_px[:, :2] - expected).max() < 0.05
    np.testing.assert_allclose(found.keypoints_px[0, :2], [20.5, 30.5], atol=1e-4)
    np.testing.assert_allclose(found.scores[0], 2.0, atol=1e-3)


def test_weak_peaks_and_peaks_at_the_border_are_left_out(on_maps: OnMaps) -> None:
    centres = [(4.0, 30.0), (5.0, 45.0), (75.0, 20.0), (74.0, 40.0), (40.0, 30.0)]
    scores = blobs(centres, [2.0, 1.5, 2.0, 1.2, 0.4])
    found = on_maps(scores)
    np.testing.assert_allclose(found.keypoints_px[:, :2], [[5.5, 45.5], [74.5, 40.5]], atol=0.01)


def test_a_descriptor_is_read_at_a_quarter_of_the_pixel(on_maps: OnMaps) -> None:
    rows, columns = torch.meshgrid(torch.arange(15.0), torch.arange(20.0), indexing="ij")
    features = torch.zeros(128, 15, 20)
    features[0], features[1], features[2] = rows, columns, 1.0
    x, y = 41.2, 22.3
    found = on_maps(blobs([(x, y)], [2.0]), features)
    descriptor = found.descriptors[0]
    assert np.linalg.norm(descriptor) == pytest.approx(1, abs=1e-6)
    at = found.keypoints_px[0, :2] - 0.5
    np.testing.assert_allclose(descriptor[:2] / descriptor[2], at[::-1] / 4, atol=1e-4)


def test_several_scales_add_keypoints_inside_the_border(aslfeat_weights: Path) -> None:
    image = texture(180, 300)  # on two scales
    one = extractor(aslfeat_weights, max_keypoints=100_000).extract(image)
    several = extractor(aslfeat_weights, max_keypoints=100_000, multi_scale=True).extract(image)
    assert len(several.scores) > len(one.scores) > 20
    # those of the whole image are among them, unchanged
    known = {tuple(row) for row in several.keypoints_px.tolist()}
    assert {tuple(row) for row in one.keypoints_px.tolist()} <= known
    xy = one.keypoints_px[:, :2]
    assert xy.min() > 4.5 and (xy < (300 - 4.5, 180 - 4.5)).all() and one.scores.min() > 0.5


@pytest.mark.parametrize("image", ["even", "odd"])
def test_keypoints_are_tensorflows(image: str, tmp_path: Path) -> None:
    outputs = np.load(TENSORFLOW / "reference.npz")
    gray = outputs[f"{image}/image"]
    save_file(converted(), tmp_path / "aslfeat.safetensors")
    found = extractor(tmp_path / "aslfeat.safetensors").extract(np.repeat(gray[..., None], 3, 2))
    assert len(found.scores) > 40
    # the published network puts the first pixel's centre at (0, 0)
    np.testing.assert_allclose(
        found.keypoints_px[:, :2] - 0.5, outputs[f"{image}/keypoints"], rtol=0, atol=1e-4
    )
    np.testing.assert_allclose(found.scores, outputs[f"{image}/scores"], rtol=0, atol=1e-5)
    np.testing.assert_allclose(
        found.descriptors, outputs[f"{image}/descriptors"], rtol=0, atol=1e-5
    )


def test_keypoints_of_small_scales_lie_where_they_are_in_the_image(
    monkeypatch: pytest.MonkeyPatch, aslfeat_weights: Path
) -> None:
    # the network marks the brightest pixel of what it is given: a spot is found on every scale
    def net(gray: torch.Tensor) -> list[AslFeatMaps]:
        features = torch.ones(128, -(-gray.shape[2] // 4), -(-gray.shape[3] // 4))
        return [AslFeatMaps(gray[0, 0] / 255, features)]

    monkeypatch.setattr(aslfeat.AslFeat, "network", lambda *_: (net, torch.device("cpu")))
    y, x = np.mgrid[:500, :1000] + 0.5
    spot = 250 * np.exp(-((x - 700.5) ** 2 + (y - 300.5) ** 2) / (2 * 5.0**2))
    image = np.repeat(spot.round().astype(np.uint8)[..., None], 3, axis=2)
    found = extractor(aslfeat_weights, multi_scale=True, threshold=0.4).extract(image)
    assert len(found.scores) == 3
    np.testing.assert_allclose(found.keypoints_px[:, :2], [[700.5, 300.5]] * 3, atol=0.1)


@pytest.mark.parametrize("size", [(8, 30), (11, 11), (11, 200), (13, 12)])
def test_the_smallest_images(aslfeat_weights: Path, size: tuple[int, int]) -> None:
    features = extractor(aslfeat_weights, threshold=0.0).extract(random_image(*size))
    assert features.keypoints_px.shape == (len(features.scores), 3)


def tensorflows_variables() -> dict[str, np.ndarray]:
    with np.load(TENSORFLOW / "variables.npz") as written:
        return dict(written)


def converted() -> dict[str, torch.Tensor]:
    return aslfeat_state(tensorflows_variables())


def test_what_an_optimiser_keeps_is_left_out() -> None:
    variables = tensorflows_variables()
    slots = {
        "conv0/kernel/Momentum": variables["conv0/kernel"],
        "deform_param/conv6/offset/bias/Adam_1": np.zeros(18),
    }
    assert aslfeat_state(variables | slots).keys() == converted().keys()


def test_what_does_not_fit_is_named() -> None:
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


# size, stride: size of the result, and the rows that the middle of the kernel stands on
# (tf.nn.conv2d's documentation of SAME: ceil(size / stride); of an odd sum of margins the larger
# one is at the end)
SAME = [
    (8, 1, 8, [0, 1, 2, 3, 4, 5, 6, 7]),
    (7, 1, 7, [0, 1, 2, 3, 4, 5, 6]),
    (8, 2, 4, [1, 3, 5, 7]),
    (7, 2, 4, [0, 2, 4, 6]),
    (2, 2, 1, [1]),
    (1, 2, 1, [0]),
]


@pytest.mark.parametrize(("size", "stride", "expected", "middles"), SAME)
def test_padding_is_tensorflows_same(
    size: int, stride: int, expected: int, middles: list[int]
) -> None:
    image = torch.arange(1.0, size + 1).repeat(5, 1)
    identity = torch.zeros(1, 1, 3, 3)
    identity[0, 0, 1, 1] = 1
    across = conv_same(image[None, None], identity, None, stride)[0, 0]
    assert across.shape == (-(-5 // stride), expected)
    assert across[0].tolist() == [m + 1 for m in middles]
    down = conv_same(image.T[None, None], identity, None, stride)[0, 0]
    assert down[:, 0].tolist() == [m + 1 for m in middles]


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


@pytest.mark.parametrize("dilation", [1, 2, 3])
def test_the_border_is_reflected(dilation: int) -> None:
    # a linear ramp: its mean over the neighbourhood is itself inside; at the reflected border
    # the outer third lies `dilation` to the inside instead of the outside
    ramp = torch.arange(10.0, dtype=torch.float64).repeat(12, 1)[None]
    found = peakiness(ramp, dilation, torch.tensor(1.0).double())
    inside = found[:, dilation:-dilation]
    torch.testing.assert_close(inside, torch.full_like(inside, math.log(2) ** 2))
    for column, outwards in ((0, -1), (-1, 1)):
        softplus = math.log1p(math.exp(outwards * 2 * dilation / 3))
        assert float(found[5, column]) == pytest.approx(softplus * math.log(2))


def test_strips_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    features = torch.randn(6, 20, 11, generator=torch.Generator().manual_seed(1))
    whole = peakiness(features, 3, torch.tensor(1.0))
    monkeypatch.setitem(aslfeat._VALUES_AT_ONCE, "cpu", 3 * 11 * 6)
    torch.testing.assert_close(peakiness(features, 3, torch.tensor(1.0)), whole, rtol=0, atol=1e-6)


def test_resizing_has_no_half_pixels() -> None:
    # a linear function of the small map's pixels, read at i * (small / large)
    rows, columns = torch.meshgrid(torch.arange(5.0), torch.arange(4.0), indexing="ij")
    found = resize_as_tensorflow_1(3 * rows - 2 * columns, (19, 13))
    r = (torch.arange(19.0) * (5 / 19)).clamp(max=4)[:, None]
    c = (torch.arange(13.0) * (4 / 13)).clamp(max=3)
    torch.testing.assert_close(found, 3 * r - 2 * c)


ROWS, COLUMNS = torch.meshgrid(*[torch.arange(41.0, dtype=torch.float64) - 20] * 2, indexing="ij")
CENTRE = torch.tensor([[20, 20]])


# the differences reach over three pixels; along a diagonal they see the ridge of a wide one only
@pytest.mark.parametrize(
    ("angle_deg", "sigma_px"), [(0.0, 2.0), (90.0, 2.0), (45.0, 12.0), (135.0, 12.0)]
)
def test_a_straight_edge_has_no_keypoint(angle_deg: float, sigma_px: float) -> None:
    angle = math.radians(angle_deg)
    across = COLUMNS * math.cos(angle) + ROWS * math.sin(angle)
    scores = torch.exp(-(across**2) / (2 * sigma_px**2))
    y, x = torch.nonzero(scores[5:-5, 5:-5] > scores.max() - 1e-9).unbind(1)
    crest = torch.stack([x, y], dim=1) + 5
    assert len(crest) == 31
    assert not on_no_edge(scores, crest, 10.0).any()


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
