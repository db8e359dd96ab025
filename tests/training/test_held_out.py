"""Figures of held-out pairs: their definitions, written out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from corner import pose_at
from scipy.spatial.transform import Rotation

from megloc_kapture.geometry.cameras import project
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.training.labels import IGNORED, UNMATCHED, Labels
from megloc_kapture.training.networks import (
    PreparedPair,
    judged,
    pose_auc,
    pose_error_deg,
    relative_pose_error_deg,
)
from megloc_kapture.training.pairs import PairOptions, PosedPairs
from megloc_kapture.values import ImageFeatures, RigidTransform


def test_matches_are_judged_by_labels_of_both_images() -> None:
    labels = Labels(np.array([1, UNMATCHED, IGNORED, IGNORED]), np.array([IGNORED, 0, UNMATCHED]))
    matches = np.array([[0, 1], [1, 0], [2, 0], [3, 2]])
    right, told = judged(matches, labels)
    assert right.tolist() == [True, False, False, False]
    assert told.tolist() == [True, True, False, True]


def test_auc_is_the_area() -> None:
    # half of the poses are perfect
    assert pose_auc([0.0, np.inf]) == pytest.approx((0.5, 0.5, 0.5))
    assert pose_auc([]) == (0.0, 0.0, 0.0)
    assert pose_auc([90.0]) == (0.0, 0.0, 0.0)
    # errors spread evenly over 0 to 20 degrees: recall is the line error / 20
    even = np.linspace(0, 20, 20001)
    assert pose_auc(even) == pytest.approx((0.125, 0.25, 0.5), abs=1e-3)


def test_the_error_of_a_relative_pose_is_the_larger_angle() -> None:
    truth = pose_at((1.0, 0, 0), 0, 0)
    turned = RigidTransform.from_matrix(
        Rotation.from_euler("z", 7, degrees=True).as_matrix(), np.array(truth.translation)
    )
    assert relative_pose_error_deg(turned, truth) == pytest.approx(7)
    sideways = RigidTransform((1.0, 0.0, 0.0, 0.0), (-1.0, 0.2, 0.0))
    expected = np.degrees(np.arctan(0.2))
    assert relative_pose_error_deg(sideways, truth) == pytest.approx(expected)
    # its sign is left open; of one centre there is no translation
    away = RigidTransform((1.0, 0.0, 0.0, 0.0), (1.0, 0.2, 0.0))
    assert relative_pose_error_deg(away, truth) == pytest.approx(expected)
    still = RigidTransform.identity()
    assert relative_pose_error_deg(turned, still) == pytest.approx(7)


def test_true_matches_give_the_true_pose(walk: Path) -> None:
    pair = PosedPairs(KaptureFolder(walk), PairOptions()).draw(np.random.default_rng(0))
    assert pair.views is not None
    points = np.random.default_rng(1).uniform((-3, -2, 4), (1, 2, 6), (200, 3))
    sides = []
    for view in pair.views:
        px = project(view.camera, view.cam_from_world, points).astype(np.float32)
        sides.append(ImageFeatures(px, np.zeros((200, 8), np.float32), 400, 300))
    inside = np.all([(s.keypoints_px > 0) & (s.keypoints_px < (400, 300)) for s in sides], (0, 2))
    rows = np.flatnonzero(inside)
    nothing = Labels(np.zeros(200, np.int64), np.zeros(200, np.int64))
    prepared = PreparedPair(pair, (sides[0], sides[1]), nothing)
    assert len(rows) > 20
    assert pose_error_deg(prepared, np.stack([rows, rows], 1)) < 0.2
    shuffled = np.stack([rows, np.roll(rows, 7)], 1)
    assert pose_error_deg(prepared, shuffled) > 2
    assert pose_error_deg(prepared, np.zeros((0, 2), np.int64)) == np.inf
