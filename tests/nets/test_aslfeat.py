"""ASLFeat's network: the checkpoint's variables, and TensorFlow's outputs on the same weights."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from published import published_shapes, random_tensors

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.nets import aslfeat
from megloc_kapture.nets.aslfeat import (
    aslfeat_from,
    aslfeat_state,
    conv_same,
    on_no_edge,
    optimiser_variables,
    peakiness,
    resize_as_tensorflow_1,
)

TENSORFLOW = Path(__file__).parent / "data" / "aslfeat"  # what make_reference.py of it has written


def tensorflows_variables() -> dict[str, torch.Tensor]:
    return read_weights(find_weights(str(TENSORFLOW / "aslfeat.tar.gz")))


def test_the_variables_are_the_published_ones_and_may_be_converted() -> None:
    variables = tensorflows_variables()
    assert variables.pop("global_step") == 380_000
    shapes = {name: tuple(values.shape) for name, values in variables.items()}
    assert shapes == published_shapes("aslfeat")
    net = aslfeat_from(variables, "x")
    assert len(net.state_dict()) == 40 and not net.training
    assert sum(p.numel() for p in net.parameters()) == 821_745
    again = aslfeat_state(net.state_dict())
    assert all(torch.equal(again[key], value) for key, value in net.state_dict().items())


def test_what_an_optimiser_keeps_is_left_out_and_named(caplog: pytest.LogCaptureFixture) -> None:
    variables = random_tensors("aslfeat")
    slots = {
        "conv0/kernel/Momentum": variables["conv0/kernel"],
        "deform_param/conv6/offset/bias/Adam_1": torch.zeros(18),
        "global_step": torch.tensor(380_000),
    }
    for layer in (1, 3, 6):
        variables[f"tower/conv{layer}/instance_max"] = torch.tensor(3.0)
    assert optimiser_variables([*variables, *slots]) == sorted(slots)
    with caplog.at_level(logging.INFO):
        aslfeat_from({**variables, **slots}, "model.ckpt")
    assert all(name in caplog.text for name in slots)
    caplog.clear()
    aslfeat_from(variables, "model.ckpt")
    assert not caplog.text


def test_what_does_not_fit_is_named() -> None:
    variables = tensorflows_variables()
    for scale in (0.0, -1.0, math.inf):
        with pytest.raises(DataError, match="tower/conv1/instance_max"):
            aslfeat_from(variables | {"tower/conv1/instance_max": torch.tensor(scale)}, "x")
    variables["conv7/kernel"] = variables.pop("conv6_0/kernel")
    variables["conv3/kernel"] = torch.zeros(3, 3, 64, 32)
    with pytest.raises(DataError) as caught:
        aslfeat_from(variables, "model.ckpt")
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
    net = aslfeat_from(tensorflows_variables(), "aslfeat.tar.gz").to(dtype)
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
