"""ASLFeat's network: the checkpoint's variables, and a second implementation of its layers."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
import torch
from torch.nn import functional

from megloc_kapture.errors import DataError
from megloc_kapture.nets.aslfeat import (
    AslFeatNet,
    aslfeat_from,
    aslfeat_state,
    conv_same,
    optimiser_variables,
)
from megloc_kapture.nets.deformable import deform_conv2d

KEYS = Path(__file__).parent / "keys"


def frozen_variables() -> dict[str, tuple[int, ...]]:
    """Variable -> shape, TensorFlow's names and layouts."""
    pairs = (row.split() for row in (KEYS / "aslfeat.txt").read_text().splitlines())
    return {key: () if s == "scalar" else tuple(map(int, s.split("x"))) for key, s in pairs}


def random_variables(seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    tensors = {}
    for name, shape in frozen_variables().items():
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


@pytest.mark.parametrize("size", [(40, 56), (37, 45), (38, 43)])
def test_maps_equal_the_layers_written_down(size: tuple[int, int]) -> None:
    variables = {name: values.double() for name, values in random_variables().items()}
    image = texture(*size).double()
    net = aslfeat_from(variables, "x").double()
    with torch.inference_mode():
        maps = net(image)
    expected_scores, expected_features = written_down(image, variables)
    assert maps.scores.shape == size
    assert maps.features.shape == expected_features.shape
    assert expected_features.std() > 0.1 and expected_scores.std() > 0.01
    # reading between float64 pixels: what is left is rounding
    assert (maps.features - expected_features).abs().max() < 1e-7
    assert (maps.scores - expected_scores).abs().max() < 1e-7


def written_down(
    image: torch.Tensor, variables: dict[str, torch.Tensor]
) -> tuple[torch.Tensor, torch.Tensor]:
    """The layer table of ASLFeat's graph, one operation after the other, TensorFlow's layouts."""
    height, width = image.shape[2:]

    def kernel(name: str) -> torch.Tensor:
        return variables[f"{name}/kernel"].permute(3, 2, 0, 1)

    def normal(x: torch.Tensor, name: str) -> torch.Tensor:
        mean, variance = (
            variables[f"{name}/bn/moving_{what}"][None, :, None, None]
            for what in ("mean", "variance")
        )
        return ((x - mean) / (variance + 1e-5).sqrt()).clamp(min=0)

    def strided(x: torch.Tensor, name: str) -> torch.Tensor:
        margins = []
        for side in (x.shape[3], x.shape[2]):
            margins += [0, 1] if side % 2 == 0 else [1, 1]
        return functional.conv2d(functional.pad(x, margins), kernel(name), stride=2)

    def deformable(x: torch.Tensor, name: str) -> torch.Tensor:
        scope = f"deform_param/{name}"
        offset, amplitude = (
            functional.conv2d(
                x, kernel(f"{scope}/{what}"), variables[f"{scope}/{what}/bias"], padding=1
            )
            for what in ("offset", "amplitude")
        )
        return deform_conv2d(x, offset, kernel(name), None, amplitude.sigmoid(), padding=1)

    def score(x: torch.Tensor, name: str, dilation: int) -> torch.Tensor:
        y = x / variables[f"tower/{name}/instance_max"]
        padded = functional.pad(y, [dilation] * 4, mode="reflect")
        ninth = torch.full((y.shape[1], 1, 3, 3), 1 / 9, dtype=y.dtype)
        mean = functional.conv2d(padded, ninth, dilation=dilation, groups=y.shape[1])
        alpha = torch.log1p(torch.exp(y - mean))
        beta = torch.log1p(torch.exp(y - y.mean(dim=1, keepdim=True)))
        small = (alpha * beta).amax(dim=1)[0]
        rows = torch.arange(height, dtype=y.dtype) * (small.shape[0] / height)
        columns = torch.arange(width, dtype=y.dtype) * (small.shape[1] / width)
        return torch.stack([torch.stack([at(small, r, c) for c in columns]) for r in rows])

    x = (image - image.mean()) / (image.var(correction=0) + 1e-5).sqrt()
    x = normal(functional.conv2d(x, kernel("conv0"), padding=1), "conv0")
    raw1 = functional.conv2d(x, kernel("conv1"), padding=1)
    x = normal(strided(normal(raw1, "conv1"), "conv2"), "conv2")
    raw3 = functional.conv2d(x, kernel("conv3"), padding=1)
    x = normal(strided(normal(raw3, "conv3"), "conv4"), "conv4")
    x = normal(functional.conv2d(x, kernel("conv5"), padding=1), "conv5")
    x = normal(deformable(x, "conv6_0"), "conv6_0")
    x = normal(deformable(x, "conv6_1"), "conv6_1")
    raw6 = deformable(x, "conv6")
    scores = score(raw1, "conv1", 3) + 2 * score(raw3, "conv3", 2) + 3 * score(raw6, "conv6", 1)
    return scores / 6, raw6[0]


def at(values: torch.Tensor, row: torch.Tensor, column: torch.Tensor) -> torch.Tensor:
    """Bilinear reading; beyond the last row or column it is that one."""
    top, left = int(row), int(column)
    below, right = min(top + 1, values.shape[0] - 1), min(left + 1, values.shape[1] - 1)
    v, u = row - top, column - left
    upper = values[top, left] * (1 - u) + values[top, right] * u
    lower = values[below, left] * (1 - u) + values[below, right] * u
    return upper * (1 - v) + lower * v


def test_brightness_and_contrast_change_nothing() -> None:
    net = aslfeat_from(random_variables(), "x")
    image = texture(40, 48)
    with torch.inference_mode():
        first, second = net(image), net(0.5 * image + 20)
    assert (first.scores - second.scores).abs().max() < 1e-3
