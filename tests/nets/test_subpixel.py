"""Sub-pixel places of peaks whose centres are known."""

from __future__ import annotations

import pytest
import torch

from megloc_kapture.nets.subpixel import parabola_peak, soft_argmax


def blob(x: float, y: float, sigma_px: float, size: tuple[int, int] = (21, 25)) -> torch.Tensor:
    rows, columns = torch.meshgrid(
        torch.arange(size[0], dtype=torch.float64),
        torch.arange(size[1], dtype=torch.float64),
        indexing="ij",
    )
    return torch.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma_px**2))


@pytest.mark.parametrize("sigma_px", [1.5, 2.0, 4.0])
@pytest.mark.parametrize(("dx", "dy"), [(0.0, 0.0), (0.3, -0.4), (-0.45, 0.1), (0.25, 0.25)])
def test_the_parabola_finds_the_centre_of_a_blob(dx: float, dy: float, sigma_px: float) -> None:
    found = parabola_peak(blob(12 + dx, 10 + dy, sigma_px), torch.tensor([[12, 10]]))
    assert (found - torch.tensor([[12 + dx, 10 + dy]])).abs().max() < 0.05


def test_the_parabola_is_exact_on_a_tilted_paraboloid() -> None:
    rows, columns = torch.meshgrid(
        torch.arange(9, dtype=torch.float64), torch.arange(9, dtype=torch.float64), indexing="ij"
    )
    u, v = columns - 4.2, rows - 3.9
    found = parabola_peak(5 - u * u - 2 * v * v + 0.7 * u * v, torch.tensor([[4, 4]]))
    torch.testing.assert_close(found, torch.tensor([[4.2, 3.9]], dtype=torch.float64))


def test_the_parabola_goes_half_a_pixel_at_most_and_stays_on_flat_ground() -> None:
    slope = torch.arange(9, dtype=torch.float64).repeat(9, 1) ** 2 * 0.1
    slope = slope + slope.T * 0.5
    found = parabola_peak(slope, torch.tensor([[4, 4]]))
    assert (found - 4).abs().max() <= 0.5
    flat = parabola_peak(torch.ones(9, 9), torch.tensor([[4, 4]]))
    assert flat.tolist() == [[4.0, 4.0]]


def test_soft_argmax_by_hand() -> None:
    scores = torch.zeros(7, 8, dtype=torch.float64)
    scores[3, 4], scores[3, 5], scores[2, 4] = 0.5, 0.3, 0.2
    e = torch.exp(scores[2:5, 3:6] / 0.1)
    expected_x = 4 + float((e[:, 2] - e[:, 0]).sum() / e.sum())
    expected_y = 3 + float((e[2] - e[0]).sum() / e.sum())
    found = soft_argmax(scores, torch.tensor([[4, 3]]), 1, 0.1)
    torch.testing.assert_close(found, torch.tensor([[expected_x, expected_y]], dtype=torch.float64))
    assert expected_x > 4 > 3 > expected_y


def test_soft_argmax_of_a_symmetrical_peak_is_its_pixel() -> None:
    found = soft_argmax(blob(12, 10, 1.0), torch.tensor([[12, 10]]), 2, 0.1)
    assert (found - torch.tensor([[12.0, 10.0]])).abs().max() < 1e-12


def test_no_pixels() -> None:
    none = torch.zeros(0, 2, dtype=torch.int64)
    assert soft_argmax(torch.ones(5, 5), none, 2, 0.1).shape == (0, 2)
    assert parabola_peak(torch.ones(5, 5), none).shape == (0, 2)
