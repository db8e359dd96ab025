"""Checkpoints that do not fit a network, and images made smaller for one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from megloc_kapture.errors import DataError
from megloc_kapture.nets.runtime import load_strictly, sized_tensor, without_tf32

CPU = torch.device("cpu")


def test_checkpoints_load_completely_or_not_at_all() -> None:
    net, other = nn.Linear(3, 2), nn.Linear(3, 2)
    whole = dict(other.state_dict())
    assert load_strictly(net, whole, "w.pth") is net
    assert torch.equal(net.weight, other.weight) and torch.equal(net.bias, other.bias)
    for tensors, message in (
        ({"bias": whole["bias"]}, "1 missing keys: weight"),
        (whole | {"extra": torch.ones(1)}, "1 unexpected keys: extra"),
        (whole | {"bias": torch.ones(3)}, r"1 keys with another shape: bias is \(3,\), not \(2,\)"),
        (
            {f"k{number}": torch.ones(1) for number in range(7)},
            "2 missing keys: bias, weight; 7 unexpected keys: k0, k1, k2, k3, k4 and 2 more",
        ),
    ):
        with pytest.raises(DataError, match=rf"^w\.pth: .*does not fit Linear; {message}$"):
            load_strictly(net, tensors, "w.pth")
    load_strictly(net, {"bias": torch.ones(2)}, "w.pth", may_lack={"weight"})
    assert torch.equal(net.weight, other.weight) and net.bias.tolist() == [1, 1]


@pytest.mark.parametrize("most", [9, 100, None])
def test_an_image_that_is_small_enough_stays(most: int | None) -> None:
    image = np.random.default_rng(0).integers(0, 256, (6, 9, 3), dtype=np.uint8)
    result = sized_tensor(image, most, CPU)
    assert result.shape == (1, 3, 6, 9) and result.dtype == torch.float32
    np.testing.assert_allclose(result[0].numpy() * 255, image.transpose(2, 0, 1), atol=1e-4)


def test_half_the_size_is_the_mean_of_four() -> None:
    image = np.random.default_rng(0).integers(0, 256, (8, 12, 3), dtype=np.uint8)
    result = sized_tensor(image, 6, CPU)[0].permute(1, 2, 0).numpy() * 255
    expected = image.reshape(4, 2, 6, 2, 3).astype(float).mean(axis=(1, 3))
    np.testing.assert_allclose(result, expected, atol=1e-3)
    assert np.abs(expected - expected.round()).max() > 0.2  # fractions are kept


@pytest.mark.parametrize(
    ("height", "width", "most", "size"),
    [(480, 640, 320, (240, 320)), (1000, 601, 500, (500, 300)), (1500, 999, 1024, (1024, 682))]
    + [(3, 2000, 100, (1, 100))],
)
def test_sizes(height: int, width: int, most: int, size: tuple[int, int]) -> None:
    image = np.zeros((height, width, 3), np.uint8)
    assert sized_tensor(image, most, CPU).shape == (1, 3, *size)


def test_tf32_is_off_only_during_inference() -> None:
    newer = hasattr(torch.backends.cuda.matmul, "fp32_precision")  # torch 2.9
    name, enabled, exact = (
        ("fp32_precision", "tf32", "ieee") if newer else ("allow_tf32", True, False)
    )
    setting: Any = torch.backends.cuda.matmul
    before = getattr(setting, name)
    setattr(setting, name, enabled)
    try:
        with without_tf32(torch.device("cuda")):
            assert getattr(setting, name) == exact
        assert getattr(setting, name) == enabled
    finally:
        setattr(setting, name, before)
