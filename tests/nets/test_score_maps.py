"""Dense maps: suppression, selection, bilinear readings, deformable convolution by definition."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from torch.nn import functional

from megloc_kapture.errors import DataError
from megloc_kapture.nets import score_maps
from megloc_kapture.nets.score_maps import (
    corners_around,
    deform_conv2d,
    parabola_peak,
    pixel_table,
    read_bilinear,
    select_keypoints,
    select_pixels,
    soft_argmax,
    suppress_non_maxima,
    window_maximum,
)

Scores = NDArray[np.float32]
XY = np.array([[3.5, 1.5], [0.5, 1.5], [2.5, 0.5], [1.5, 2.5]], np.float32)
SCORES = np.array([0.5, 0.5, 0.9, 0.5], np.float32)
SIZE = (3, 4)
torch_double = torch.float64


def random_scores(seed: int, shape: tuple[int, int]) -> Scores:
    return np.random.default_rng(seed).uniform(0.01, 1, shape).astype(np.float32)


def by_definition(scores: Scores, radius: int, rounds: int) -> Scores:
    """The suppression as SuperGlue's authors describe it, with scipy's filters."""

    def largest(values: Scores) -> Scores:
        return maximum_filter(values, size=2 * radius + 1, mode="constant", cval=-1)

    kept = scores == largest(scores)
    for _ in range(rounds):
        struck = largest(kept.astype(np.float32)) > 0
        rest = np.where(struck, 0, scores)
        kept |= (rest == largest(rest)) & ~struck
    return np.where(kept, scores, 0)


@given(
    height=st.integers(1, 24),
    width=st.integers(1, 24),
    radius=st.integers(0, 9),
    seed=st.integers(0, 99),
)
def test_window_maximum_is_scipys(height: int, width: int, radius: int, seed: int) -> None:
    values = random_scores(seed, (height, width))
    expected = maximum_filter(values, size=2 * radius + 1, mode="constant", cval=-1)
    found = window_maximum(torch.from_numpy(values), radius)
    np.testing.assert_array_equal(found.numpy(), expected)
    bits = values > 0.9
    expected = maximum_filter(bits, size=2 * radius + 1, mode="constant", cval=False)
    found = window_maximum(torch.from_numpy(bits), radius)
    assert found.dtype == torch.bool
    np.testing.assert_array_equal(found.numpy(), expected)


@pytest.mark.parametrize("rounds", [0, 1, 2])
@pytest.mark.parametrize("radius", [0, 1, 3, 4])
def test_suppression_is_its_definition(radius: int, rounds: int) -> None:
    scores = random_scores(radius, (47, 62))
    scores[10:14, 20:30] = 0.99  # equal neighbours
    found = suppress_non_maxima(torch.from_numpy(scores)[None], radius, rounds=rounds)
    np.testing.assert_array_equal(found[0].numpy(), by_definition(scores, radius, rounds))


@given(seed=st.integers(0, 99), radius=st.integers(1, 5))
def test_what_stays_is_far_apart_and_stays_again(seed: int, radius: int) -> None:
    scores = torch.from_numpy(random_scores(seed, (40, 40)))
    once = suppress_non_maxima(scores, radius)
    torch.testing.assert_close(suppress_non_maxima(once, radius), once, rtol=0, atol=0)
    yx = torch.nonzero(once)
    distance = (yx[:, None] - yx).abs().amax(dim=2) + 1000 * torch.eye(len(yx))
    assert distance.min() > radius


def test_isolated_maxima_are_those_of_a_greedy_search() -> None:
    rng = np.random.default_rng(5)
    radius, scores = 4, np.zeros((80, 90), np.float32)
    for y in range(8, 80, 16):  # peaks of a few pixels, further apart than any two windows
        for x in range(8, 90, 16):
            scores[y - 1 : y + 2, x - 1 : x + 2] = rng.uniform(0.1, 1, (3, 3))
    greedy, rest = np.zeros_like(scores), scores.copy()
    while rest.max() > 0:
        y, x = np.unravel_index(rest.argmax(), rest.shape)
        greedy[y, x] = rest[y, x]
        rest[y - radius : y + radius + 1, x - radius : x + radius + 1] = 0
    found = suppress_non_maxima(torch.from_numpy(scores), radius)
    np.testing.assert_array_equal(found.numpy(), greedy)
    assert np.count_nonzero(greedy) == 30  # one of each peak


def test_the_best_come_first_and_ties_by_y_then_x() -> None:
    scores = torch.zeros(6, 7)
    scores[4, 1] = scores[2, 5] = scores[2, 3] = 0.5
    scores[5, 6] = 0.9
    scores[0, 0] = 0.1
    found = select_pixels(scores, threshold=0.1)  # the threshold itself is too little
    assert found.xy.tolist() == [[6, 5], [3, 2], [5, 2], [1, 4]]
    assert found.scores.tolist() == pytest.approx([0.9, 0.5, 0.5, 0.5])
    assert select_pixels(scores, threshold=0.1, max_keypoints=2).xy.tolist() == [[6, 5], [3, 2]]


def test_borders_hold_no_keypoints() -> None:
    found = select_pixels(torch.ones(9, 7), threshold=0.0, border=3)
    assert found.xy.tolist() == [[3, 3], [3, 4], [3, 5]]
    assert len(select_pixels(torch.ones(9, 7), threshold=0.0, border=4).xy) == 0


def test_the_mask_comes_before_the_choice_of_the_best() -> None:
    scores = torch.from_numpy(random_scores(1, (8, 8)))
    mask = np.ones((11, 10), bool)  # of an image that is not a multiple of 8
    best = select_pixels(scores, threshold=0.5, mask=mask, max_keypoints=6)
    assert best.num_masked == 0
    for x, y in best.xy[:4].tolist():
        mask[y, x] = False
    mask[8:], mask[:, 8:] = False, False  # holds no scores
    found = select_pixels(scores, threshold=0.5, mask=mask, max_keypoints=6)
    assert found.num_masked == 4
    everything = select_pixels(scores, threshold=0.5)
    assert found.xy.tolist() == everything.xy[4:10].tolist()


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


def test_best_first_and_ties_by_y_then_x() -> None:
    rows, num_masked = select_keypoints(XY, SCORES, size=SIZE, mask=None, max_keypoints=10)
    assert rows.tolist() == [2, 1, 0, 3] and num_masked == 0
    rows, _ = select_keypoints(XY, SCORES, size=SIZE, mask=None, max_keypoints=2)
    assert rows.tolist() == [2, 1]


def test_the_mask_comes_before_the_limit() -> None:
    mask = np.ones(SIZE, bool)
    mask[0, 2] = mask[1, 0] = False
    rows, num_masked = select_keypoints(XY, SCORES, size=SIZE, mask=mask, max_keypoints=1)
    assert rows.tolist() == [0] and num_masked == 2


def test_a_keypoint_stands_in_the_pixel_that_holds_it() -> None:
    # (2, 1) begins the pixel of column 2 and row 1; the image's far edge belongs to its last pixel
    xy = np.array([[1.99, 0.99], [2.0, 1.0], [4.0, 3.0]], np.float32)
    scores = np.array([0.3, 0.2, 0.1], np.float32)
    for row, pixel in enumerate([(0, 1), (1, 2), (2, 3)]):
        mask = np.zeros(SIZE, bool)
        mask[pixel] = True
        rows, num_masked = select_keypoints(xy, scores, size=SIZE, mask=mask, max_keypoints=9)
        assert rows.tolist() == [row] and num_masked == 2


def test_nothing_to_select_from() -> None:
    none = np.zeros((0, 2), np.float32)
    mask = np.zeros(SIZE, bool)
    rows, num_masked = select_keypoints(none, SCORES[:0], size=SIZE, mask=mask, max_keypoints=9)
    assert len(rows) == 0 and num_masked == 0


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


def deformed_by_definition(
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
    expected = deformed_by_definition(**given, **how)
    assert found.shape == expected.shape
    assert (found - expected).abs().max() < 1e-12


def test_without_bias_and_amplitudes() -> None:
    given = case()
    found = deform_conv2d(given["x"], given["offset"], given["weight"], padding=1)
    given["mask"] = torch.ones_like(given["mask"])
    given["bias"] = torch.zeros_like(given["bias"])
    expected = deformed_by_definition(**given, stride=1, padding=1, dilation=1)
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
    monkeypatch.setitem(score_maps._VALUES_AT_ONCE, "cpu", 3 * 5 * 9 * 3)  # three rows
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
