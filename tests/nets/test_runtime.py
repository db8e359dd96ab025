"""Strict loading of checkpoints, image sizes, and TF32."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from megloc_kapture.errors import DataError
from megloc_kapture.nets.runtime import load_strictly, sized_tensor, without_tf32

CPU = torch.device("cpu")


def test_checkpoints_load_strictly() -> None:
    net, other = nn.Linear(3, 2), nn.Linear(3, 2)
    whole = dict(other.state_dict())
    assert load_strictly(net, whole, "w.pth") is net
    assert torch.equal(net.weight, other.weight) and torch.equal(net.bias, other.bias)
    for tensors, message in (
        ({"bias": whole["bias"]}, "1 missing keys: weight"),
        (whole | {"extra": torch.ones(1)}, "1 unexpected keys: extra"),
        (whole | {"bias": torch.ones(3)}, r"1 keys with another shape: bias is \(3,\), not \(2,\)"),
    ):
        with pytest.raises(DataError, match=rf"^w\.pth: .*does not fit Linear; {message}$"):
            load_strictly(net, tensors, "w.pth")
    load_strictly(net, {"bias": torch.ones(2)}, "w.pth", may_lack={"weight"})
    assert torch.equal(net.weight, other.weight) and net.bias.tolist() == [1, 1]


@pytest.mark.parametrize(
    ("height", "width", "most", "size"),
    [(6, 9, 9, (6, 9)), (6, 9, None, (6, 9)), (150, 99, 102, (102, 67)), (3, 2000, 100, (1, 100))],
)
def test_images_are_reduced_to_the_limit(
    height: int, width: int, most: int | None, size: tuple[int, int]
) -> None:
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    result = sized_tensor(image, most, CPU)
    assert result.shape == (1, 3, *size) and result.dtype == torch.float32
    if size == (height, width):
        np.testing.assert_allclose(result[0].numpy() * 255, image.transpose(2, 0, 1), atol=1e-4)


def test_half_the_size_is_the_unrounded_mean_of_four_pixels() -> None:
    image = np.random.default_rng(0).integers(0, 256, (8, 12, 3), dtype=np.uint8)
    result = sized_tensor(image, 6, CPU)[0].permute(1, 2, 0).numpy() * 255
    expected = image.reshape(4, 2, 6, 2, 3).astype(float).mean(axis=(1, 3))
    np.testing.assert_allclose(result, expected, atol=1e-3)


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
