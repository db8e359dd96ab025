"""A margin around what a mask ignores."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from megloc_kapture.preprocessing.mask_margin import with_margin

MASKS = arrays(np.bool_, st.tuples(st.integers(1, 12), st.integers(1, 12)))


@given(MASKS, st.floats(0, 6))
def test_pixels_within_the_margin_of_an_ignored_one_go(mask: np.ndarray, margin_px: float) -> None:
    rows, columns = np.nonzero(~mask)
    y, x = np.indices(mask.shape)
    expected = np.ones(mask.shape, bool)
    for row, column in zip(rows, columns, strict=True):
        # the library's distances are float32
        expected &= np.float32(np.hypot(y - row, x - column)) > np.float32(margin_px)
    found = with_margin(mask, margin_px)
    assert found.dtype == np.bool_
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("margin_px", [0.0, -1.0])
def test_without_a_margin_the_mask_stays(margin_px: float) -> None:
    mask = np.eye(5, dtype=bool)
    np.testing.assert_array_equal(with_margin(mask, margin_px), mask)


def test_the_border_of_the_image_is_no_edge_of_the_mask() -> None:
    assert with_margin(np.ones((6, 7), bool), 3.0).all()
