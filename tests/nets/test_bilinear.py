"""Bilinear reading against torch's grid_sample and linear functions."""

from __future__ import annotations

import torch
from torch.nn import functional

from megloc_kapture.nets.bilinear import corners_around, pixel_table, read_bilinear


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
