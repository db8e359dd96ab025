"""Which keypoints are kept: the mask first, then the best, ties by y and x."""

from __future__ import annotations

import numpy as np

from megloc_kapture.features.keypoint_selection import select_keypoints

XY = np.array([[3.5, 1.5], [0.5, 1.5], [2.5, 0.5], [1.5, 2.5]], np.float32)
SCORES = np.array([0.5, 0.5, 0.9, 0.5], np.float32)
SIZE = (3, 4)


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
