"""ASLFeat's detector against closed forms."""

from __future__ import annotations

import math

import pytest
import torch

from megloc_kapture.nets import aslfeat_detection
from megloc_kapture.nets.aslfeat_detection import on_no_edge, peakiness, resize_as_tensorflow_1

ONE = torch.tensor(1.0)


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
    monkeypatch.setitem(aslfeat_detection._VALUES_AT_ONCE, "cpu", 3 * 11 * 6)
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
