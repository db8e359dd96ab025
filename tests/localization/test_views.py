"""Views: what they refuse, and how results are taken apart again."""

from __future__ import annotations

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.localization.views import View, split_by_view, stack_views
from megloc_kapture.values import Camera, RigidTransform

PINHOLE = Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.5, 239.0))
AT_ORIGIN = RigidTransform.identity()


@pytest.mark.parametrize(
    "pixels, points, covariances",
    [((3, 3), (3, 3), None), ((3, 2), (4, 3), None), ((3, 2), (3, 2), None), ((3, 2), (3, 3), 5)],
)
def test_arrays_that_do_not_belong_together_are_refused(
    pixels: tuple[int, int], points: tuple[int, int], covariances: int | None
) -> None:
    with pytest.raises(DataError):
        View(
            PINHOLE,
            AT_ORIGIN,
            np.zeros(pixels),
            np.zeros(points),
            None if covariances is None else np.zeros((3, covariances)),
        )


def test_what_runs_over_all_views_is_taken_apart() -> None:
    views = [View(PINHOLE, AT_ORIGIN, np.zeros((n, 2)), np.zeros((n, 3))) for n in (2, 0, 3)]
    parts = split_by_view(views, np.array([True, False, False, True, True]))
    assert [part.tolist() for part in parts] == [[True, False], [], [False, True, True]]


def test_views_with_and_without_covariances_together() -> None:
    points = np.arange(6.0).reshape(2, 3)
    covariances = np.arange(12.0).reshape(2, 6)
    known = View(PINHOLE, AT_ORIGIN, np.zeros((2, 2)), points, covariances)
    unknown = View(PINHOLE, AT_ORIGIN, np.zeros((1, 2)), np.zeros((1, 3)))
    stacked = stack_views([unknown, known])
    np.testing.assert_array_equal(stacked.covariances, [[0] * 6, *covariances])
    np.testing.assert_array_equal(stacked.points[1:] + stacked.offset, points)
    assert len(stack_views([unknown]).covariances) == 0


def test_points_that_are_not_finite_do_not_move_the_origin() -> None:
    points = np.full((200, 3), 5e6)
    points[::2] = np.nan
    points[3] = 1e300
    view = View(PINHOLE, AT_ORIGIN, np.zeros((200, 2)), points)
    assert np.abs(stack_views([view]).offset).max() <= 5e6
