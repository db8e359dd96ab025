"""ASLFeat's network: the checkpoint's variables, and TensorFlow's outputs on the same weights."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from published import published_shapes
from torch.nn import functional

from megloc_kapture.errors import DataError
from megloc_kapture.io.weights import find_weights, read_weights
from megloc_kapture.nets import aslfeat
from megloc_kapture.nets.aslfeat import (
    AslFeatNet,
    aslfeat_from,
    aslfeat_state,
    conv_same,
    on_no_edge,
    optimiser_variables,
    peakiness,
    resize_as_tensorflow_1,
)

TENSORFLOW = Path(__file__).parent / "data" / "aslfeat"  # what make_reference.py of it has written
ONE = torch.tensor(1.0)


def tensorflows_variables() -> dict[str, torch.Tensor]:
    return read_weights(find_weights(str(TENSORFLOW / "aslfeat.tar.gz")))


def random_variables(seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    tensors = {}
    for name, shape in published_shapes("aslfeat").items():
        values = torch.randn(shape, generator=generator)
        if name.startswith("deform_param"):
            values = values * (0.03 if name.endswith("kernel") else 0.3)
        elif name.endswith("kernel"):
            values = values * (2 / (9 * shape[2])) ** 0.5
        elif name.endswith("moving_mean"):
            values = values * 0.1
        elif name.endswith("moving_variance"):
            values = values.abs() * 0.5 + 0.5
        else:
            values = values.abs() + 3
        tensors[name] = values
    return tensors


def texture(height: int, width: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 1, height // 6 + 2, width // 6 + 2, generator=generator)
    return 255 * functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1)


def test_variables_and_numbers() -> None:
    variables = random_variables()
    net = aslfeat_from(variables, "x")
    assert len(variables) == len(net.state_dict()) == 40
    assert sum(p.numel() for p in net.parameters()) == 821_745
    assert net.state_dict()["tower.conv3.instance_max"] == variables["tower/conv3/instance_max"]
    assert not net.training


def test_layouts_are_turned() -> None:
    variables = random_variables()
    state = aslfeat_state(variables)
    assert set(state) == set(AslFeatNet().state_dict())
    kernel = variables["deform_param/conv6_1/offset/kernel"]  # rows, columns, in, out
    assert state["deform_param.conv6_1.offset.weight"][5, 7, 0, 2] == kernel[0, 2, 7, 5]
    assert state["conv2.weight"].shape == (64, 32, 3, 3)
    assert torch.equal(state["conv4.bn.running_var"], variables["conv4/bn/moving_variance"])
    assert torch.equal(aslfeat_state(state)["conv0.weight"], state["conv0.weight"])


def test_what_an_optimiser_keeps_is_left_out_and_named(caplog: pytest.LogCaptureFixture) -> None:
    variables = random_variables()
    slots = {
        "conv0/kernel/Momentum": variables["conv0/kernel"],
        "deform_param/conv6/offset/bias/Adam_1": torch.zeros(18),
        "global_step": torch.tensor(380_000),
    }
    assert optimiser_variables([*variables, *slots]) == sorted(slots)
    with caplog.at_level(logging.INFO):
        aslfeat_from({**variables, **slots}, "model.ckpt")
    assert all(name in caplog.text for name in slots)
    caplog.clear()
    aslfeat_from(variables, "model.ckpt")
    assert not caplog.text


def test_what_is_missing_unknown_or_of_another_shape_is_named() -> None:
    variables = random_variables()
    variables["conv7/kernel"] = variables.pop("conv6_0/kernel")
    variables["conv3/kernel"] = torch.zeros(3, 3, 64, 32)
    with pytest.raises(DataError) as caught:
        aslfeat_from(variables, "model.ckpt")
    for part in ("model.ckpt", "conv6_0.weight", "conv7.weight", "conv3.weight is (32, 64, 3, 3)"):
        assert part in str(caught.value)


def test_a_scale_of_zero_is_refused() -> None:
    variables = random_variables()
    variables["tower/conv1/instance_max"] = torch.tensor(0.0)
    with pytest.raises(DataError, match="tower/conv1/instance_max"):
        aslfeat_from(variables, "model.ckpt")


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


def test_the_checkpoint_that_tensorflow_wrote_has_the_published_variables() -> None:
    variables = tensorflows_variables()
    assert variables.pop("global_step") == 380_000
    assert {name: tuple(values.shape) for name, values in variables.items()} == published_shapes(
        "aslfeat"
    )


def test_brightness_and_contrast_change_nothing() -> None:
    net = aslfeat_from(random_variables(), "x")
    image = texture(40, 48)
    with torch.inference_mode():
        first, second = net(image)[0], net(0.5 * image + 20)[0]
    assert (first.scores - second.scores).abs().max() < 1e-3


def softplus(value: float) -> float:
    return math.log1p(math.exp(value))


def test_peakiness_of_one_peak() -> None:
    features = torch.zeros(4, 9, 9)
    features[2, 4, 5] = 3.0
    found = peakiness(features, 2, ONE)
    at_peak = softplus(3.0 - 3.0 / 9) * softplus(3.0 - 3.0 / 4)
    assert found[4, 5] == pytest.approx(at_peak, rel=1e-6)
    # two pixels away the peak is one of the neighbours: of its channel, and not of the others
    assert found[2, 5] == pytest.approx(softplus(0.0) * softplus(0.0), rel=1e-6)
    assert found[3, 5] == pytest.approx(softplus(0.0) ** 2, rel=1e-6)
    # in the peak's own pixel the other channels do not stand out
    assert (found == found.max()).sum() == 1


def test_peakiness_divides_by_the_scale() -> None:
    features = torch.randn(5, 8, 9, generator=torch.Generator().manual_seed(0))
    scaled = peakiness(features * 7, 1, torch.tensor(7.0))
    torch.testing.assert_close(scaled, peakiness(features, 1, ONE))


@pytest.mark.parametrize("dilation", [1, 2, 3])
def test_the_border_is_reflected(dilation: int) -> None:
    # a linear ramp: its mean over the neighbourhood is itself inside; at the reflected border
    # the outer third lies `dilation` to the inside instead of the outside
    ramp = torch.arange(10.0, dtype=torch.float64).repeat(12, 1)[None]
    found = peakiness(ramp, dilation, ONE.double())
    inside = found[:, dilation:-dilation]
    torch.testing.assert_close(inside, torch.full_like(inside, math.log(2) ** 2))
    assert float(found[5, 0]) == pytest.approx(softplus(-2 * dilation / 3) * math.log(2))
    assert float(found[5, -1]) == pytest.approx(softplus(2 * dilation / 3) * math.log(2))


def test_strips_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    features = torch.randn(6, 20, 11, generator=torch.Generator().manual_seed(1))
    whole = peakiness(features, 3, ONE)
    monkeypatch.setitem(aslfeat._VALUES_AT_ONCE, "cpu", 3 * 11 * 6)
    torch.testing.assert_close(peakiness(features, 3, ONE), whole, rtol=0, atol=1e-6)


def test_resizing_has_no_half_pixels() -> None:
    # a linear function of the small map's pixels, read at i * (small / large)
    rows, columns = torch.meshgrid(torch.arange(5.0), torch.arange(4.0), indexing="ij")
    found = resize_as_tensorflow_1(3 * rows - 2 * columns, (19, 13))
    r = (torch.arange(19.0) * (5 / 19)).clamp(max=4)[:, None]
    c = (torch.arange(13.0) * (4 / 13)).clamp(max=3)
    torch.testing.assert_close(found, 3 * r - 2 * c)


def test_resizing_to_the_same_size_changes_nothing() -> None:
    values = torch.randn(5, 7)
    assert resize_as_tensorflow_1(values, (5, 7)) is values


def test_resizing_by_a_whole_factor_keeps_the_pixels() -> None:
    values = torch.randn(5, 7)
    assert torch.equal(resize_as_tensorflow_1(values, (20, 28))[::4, ::4], values)


def ridge(angle_deg: float, sigma_px: float) -> torch.Tensor:
    rows, columns = torch.meshgrid(
        torch.arange(41, dtype=torch.float64) - 20,
        torch.arange(41, dtype=torch.float64) - 20,
        indexing="ij",
    )
    angle = math.radians(angle_deg)
    across = columns * math.cos(angle) + rows * math.sin(angle)
    return torch.exp(-(across**2) / (2 * sigma_px**2))


# the differences reach over three pixels; along a diagonal they see the ridge of a wide one only
@pytest.mark.parametrize(
    ("angle_deg", "sigma_px"), [(0.0, 2.0), (90.0, 2.0), (45.0, 12.0), (135.0, 12.0)]
)
def test_a_straight_edge_has_no_keypoint(angle_deg: float, sigma_px: float) -> None:
    scores = ridge(angle_deg, sigma_px)
    y, x = torch.nonzero(scores[5:-5, 5:-5] > scores.max() - 1e-9).unbind(1)
    crest = torch.stack([x, y], dim=1) + 5
    assert len(crest) == 31
    assert not on_no_edge(scores, crest, 10.0).any()


def test_a_round_blob_is_no_edge_and_a_long_one_is() -> None:
    rows, columns = torch.meshgrid(torch.arange(41.0), torch.arange(41.0), indexing="ij")
    centre = torch.tensor([[20, 20]])

    def blob(sigma_x: float, sigma_y: float) -> torch.Tensor:
        u, v = (columns - 20) / sigma_x, (rows - 20) / sigma_y
        return torch.exp(-(u * u + v * v) / 2)

    assert on_no_edge(blob(4, 4), centre, 10.0).all()
    assert on_no_edge(blob(4, 9), centre, 10.0).all()
    assert not on_no_edge(blob(4, 30), centre, 10.0).any()
    assert not on_no_edge(blob(4, 9), centre, 2.0).any()


def test_a_saddle_and_flat_ground_are_refused() -> None:
    rows, columns = torch.meshgrid(torch.arange(21.0), torch.arange(21.0), indexing="ij")
    centre = torch.tensor([[10, 10]])
    saddle = (columns - 10) ** 2 - (rows - 10) ** 2
    assert not on_no_edge(saddle, centre, 10.0).any()
    assert not on_no_edge(torch.ones(21, 21), centre, 10.0).any()
