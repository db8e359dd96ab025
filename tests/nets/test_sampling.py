"""Bilinear sampling and deformable convolution against their definitions."""

from __future__ import annotations

import math

import pytest
import torch
from torch.nn import functional

from megloc_kapture.errors import DataError
from megloc_kapture.nets import sampling
from megloc_kapture.nets.score_maps import corners_around, deform_conv2d, pixel_table, read_bilinear

torch_double = torch.float64


def test_equals_grid_sample_inside_and_outside() -> None:
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(3, 7, 9, generator=generator, dtype=torch.float64)
    x = torch.rand(500, generator=generator, dtype=torch.float64) * 14 - 3
    y = torch.rand(500, generator=generator, dtype=torch.float64) * 12 - 3
    grid = torch.stack([2 * x / 8 - 1, 2 * y / 6 - 1], dim=1)[None, None]
    expected = functional.grid_sample(values[None], grid, align_corners=True)[0, :, 0].T
    found = read_bilinear(pixel_table(values), y, x, (7, 9))
    assert (found - expected).abs().max() < 1e-12


def test_a_linear_map_is_read_exactly() -> None:
    row, column = torch.meshgrid(torch.arange(6.0), torch.arange(8.0), indexing="ij")
    values = (2 * row - 3 * column + 1)[None]
    y, x = torch.tensor([0.0, 1.25, 5.0]), torch.tensor([7.0, 2.5, 0.125])
    found = read_bilinear(pixel_table(values), y, x, (6, 8))
    torch.testing.assert_close(found[:, 0], 2 * y - 3 * x + 1)


def test_amplitudes_multiply() -> None:
    table = torch.arange(12.0)[:, None]
    y, x = torch.tensor([1.5]), torch.tensor([2.0])
    plain = read_bilinear(table, y, x, (3, 4))
    assert plain == 8.0
    assert read_bilinear(table, y, x, (3, 4), torch.tensor([0.25])) == 2.0


def test_indices_are_always_those_of_pixels() -> None:
    far = torch.tensor([-1e30, -2.0, -0.5, 3.5, 4.0, 1e30])
    indices, weights = corners_around(far, far.flip(0), (4, 4))
    assert indices.min() >= 0 and indices.max() < 16
    assert (weights[0] == 0).all() and (weights[-1] == 0).all()


def test_no_places() -> None:
    nowhere = torch.zeros(0)
    assert read_bilinear(torch.ones(4, 5), nowhere, nowhere, (2, 2)).shape == (0, 5)


def case(
    *,
    batch: int = 2,
    channels: int = 3,
    out: int = 4,
    size: tuple[int, int] = (6, 7),
    kernel: tuple[int, int] = (3, 3),
    sigma_px: float = 3.0,
    stride: int = 1,
    padding: int = 1,
    dilation: int = 1,
    seed: int = 0,
) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch_double)

    height, width = (
        (side + 2 * padding - dilation * (k - 1) - 1) // stride + 1
        for side, k in zip(size, kernel, strict=True)
    )
    taps = kernel[0] * kernel[1]
    return {
        "x": normal(batch, channels, *size),
        # far beyond the map for some taps
        "offset": sigma_px * normal(batch, 2 * taps, height, width),
        "weight": normal(out, channels, *kernel),
        "bias": normal(out),
        "mask": normal(batch, taps, height, width).sigmoid(),
    }


def at(values: torch.Tensor, row: int, column: int) -> float:
    inside = 0 <= row < values.shape[0] and 0 <= column < values.shape[1]
    return float(values[row, column]) if inside else 0.0


def by_definition(
    x: torch.Tensor,
    offset: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor,
    mask: torch.Tensor,
    *,
    stride: int,
    padding: int,
    dilation: int,
) -> torch.Tensor:
    """One number after the other: the sum over taps and channels, four neighbours each."""
    result = torch.zeros(len(x), len(weight), *offset.shape[2:], dtype=x.dtype)
    for b, d, i, j in torch.cartesian_prod(*(torch.arange(n) for n in result.shape)).tolist():
        total = float(bias[d])
        for tap in range(weight.shape[2] * weight.shape[3]):
            row, column = divmod(tap, weight.shape[3])
            y = i * stride - padding + row * dilation + float(offset[b, 2 * tap, i, j])
            u = j * stride - padding + column * dilation + float(offset[b, 2 * tap + 1, i, j])
            top, left = math.floor(y), math.floor(u)
            for c in range(x.shape[1]):
                read = sum(
                    at(x[b, c], r, q) * (1 - abs(y - r)) * (1 - abs(u - q))
                    for r in (top, top + 1)
                    for q in (left, left + 1)
                )
                total += read * float(weight[d, c, row, column]) * float(mask[b, tap, i, j])
        result[b, d, i, j] = total
    return result


@pytest.mark.parametrize(
    ("kernel", "stride", "padding", "dilation"),
    [((3, 3), 1, 1, 1), ((3, 3), 2, 0, 1), ((3, 3), 1, 2, 2), ((1, 2), 3, 1, 1)],
)
def test_equals_its_definition(
    kernel: tuple[int, int], stride: int, padding: int, dilation: int
) -> None:
    how = {"stride": stride, "padding": padding, "dilation": dilation}
    given = case(kernel=kernel, **how)
    found = deform_conv2d(**given, **how)
    expected = by_definition(**given, **how)
    assert found.shape == expected.shape
    assert (found - expected).abs().max() < 1e-12


def test_without_bias_and_amplitudes() -> None:
    given = case()
    found = deform_conv2d(given["x"], given["offset"], given["weight"], padding=1)
    given["mask"] = torch.ones_like(given["mask"])
    given["bias"] = torch.zeros_like(given["bias"])
    expected = by_definition(**given, stride=1, padding=1, dilation=1)
    assert (found - expected).abs().max() < 1e-12


def test_gradients_fit_finite_differences() -> None:
    given = case(batch=1, channels=2, out=2, size=(3, 4), sigma_px=1.0)
    leaves = [values.requires_grad_() for values in given.values()]
    assert torch.autograd.gradcheck(lambda *given: deform_conv2d(*given, padding=1), leaves)


@pytest.mark.parametrize(("stride", "padding", "dilation"), [(1, 1, 1), (2, 1, 1), (1, 0, 2)])
def test_without_offsets_it_is_a_convolution(stride: int, padding: int, dilation: int) -> None:
    how = {"stride": stride, "padding": padding, "dilation": dilation}
    given = case(size=(9, 8), **how)
    offset = torch.zeros_like(given["offset"])
    found = deform_conv2d(given["x"], offset, given["weight"], given["bias"], **how)
    expected = functional.conv2d(given["x"], given["weight"], given["bias"], **how)
    assert (found - expected).abs().max() < 1e-12


def test_a_whole_offset_moves_the_image() -> None:
    given = case(size=(8, 9))
    offset = torch.zeros_like(given["offset"])
    offset[:, 0::2] = 1.0  # every tap one row down
    found = deform_conv2d(given["x"], offset, given["weight"], padding=1)
    moved = functional.pad(given["x"], (0, 0, 0, 1))[:, :, 1:]
    expected = functional.conv2d(moved, given["weight"], padding=1)
    # the first row reads the original first row where the convolution reads zeros
    assert (found - expected)[:, :, 1:].abs().max() < 1e-12
    assert (found - expected)[:, :, 0].abs().max() > 1e-3


def test_agrees_with_kornia() -> None:
    kornia = pytest.importorskip("kornia.feature.aliked.deform_conv2d")
    given = case(channels=8, out=5, size=(20, 30))
    theirs = kornia.deform_conv2d(
        given["x"], given["offset"], given["weight"], given["bias"], 1, 1, 1, given["mask"]
    )
    assert (deform_conv2d(**given, padding=1) - theirs).abs().max() < 1e-12


def test_strips_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    given = case(size=(11, 5))
    whole = deform_conv2d(**given, padding=1)
    monkeypatch.setitem(sampling._VALUES_AT_ONCE, "cpu", 3 * 5 * 9 * 3)  # three rows
    assert (deform_conv2d(**given, padding=1) - whole).abs().max() < 1e-12


def test_channels_last_in_and_out() -> None:
    given = {name: values.float() for name, values in case(size=(10, 12)).items()}
    expected = deform_conv2d(**given, padding=1)
    given["x"] = given["x"].contiguous(memory_format=torch.channels_last)
    found = deform_conv2d(**given, padding=1)
    assert found.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(found, expected)


def test_offsets_beyond_all_bounds_read_zeros() -> None:
    given = case(size=(5, 5))
    offset = torch.full_like(given["offset"], 1e30)
    found = deform_conv2d(given["x"], offset, given["weight"], padding=1)
    assert (found == 0).all()


@pytest.mark.parametrize("name", ["weight", "offset", "mask"])
def test_shapes_that_do_not_fit_are_refused(name: str) -> None:
    given = case()
    given[name] = given[name][:, :-1]
    with pytest.raises(DataError, match=name):
        deform_conv2d(**given, padding=1)
