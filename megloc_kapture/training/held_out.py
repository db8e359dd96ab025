"""A matcher on held-out pairs: loss, precision and recall of matches, AUC of the relative pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.geometry.cameras import bearing_rays, focal_px
from megloc_kapture.geometry.poses import rotation_angles_deg
from megloc_kapture.matching.verification import TwoViewOptions, relative_pose
from megloc_kapture.training.labels import IGNORED, Labels
from megloc_kapture.training.networks import PairModel, PreparedPair
from megloc_kapture.values import RigidTransform

AUC_DEG = (5, 10, 20)
_TWO_VIEWS = TwoViewOptions(max_error_px=2.0, min_matches=6)
_SAME_CENTRE = 1e-9


@dataclass(frozen=True)
class HeldOutResult:
    """What a matcher does on pairs.

    Attributes
    ----------
    loss : mean over the pairs.
    precision : share of right ones among all matches whose keypoints are labelled.
    recall : share of the labelled matches that are found.
    auc : area under the curve of the relative pose's error up to 5, 10 and 20 degrees, in [0, 1].
    """

    pairs: int
    loss: float
    precision: float
    recall: float
    auc: tuple[float, ...]


def held_out_result(model: PairModel, pairs: Sequence[PreparedPair]) -> HeldOutResult:
    """Match pairs with a model that is set to evaluate."""
    right = told = labelled = 0
    losses, errors = [], []
    for pair in pairs:
        matches, loss = model.match(pair)
        good, known = judged(matches, pair.labels)
        right, told = right + int(good.sum()), told + int(known.sum())
        labelled += len(pair.labels.matches())
        losses.append(loss)
        if pair.pair.views is not None:
            errors.append(pose_error_deg(pair, matches))
    return HeldOutResult(
        len(pairs),
        float(np.mean(losses)) if losses else 0.0,
        right / max(told, 1),
        right / max(labelled, 1),
        pose_auc(errors),
    )


def judged(
    matches: NDArray[np.int64], labels: Labels
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Matches (K, 2) that are right, and those of which a label tells it, bool (K,) both."""
    a, b = labels.partner_a[matches[:, 0]], labels.partner_b[matches[:, 1]]
    return a == matches[:, 1], (a != IGNORED) | (b != IGNORED)


def pose_error_deg(pair: PreparedPair, matches: NDArray[np.int64]) -> float:
    """The larger of the angles of rotation and translation, degrees; infinite without a pose.

    The translation's sign is left open, as SuperGlue's evaluation does; between views of one centre
    only the rotation counts.
    """
    views, truth = pair.pair.views, pair.pair.b_from_a
    assert views is not None and truth is not None  # who calls has asked
    rays = [
        bearing_rays(view.camera, features.keypoints_px[matches[:, side], :2])
        for side, (view, features) in enumerate(zip(views, pair.features, strict=True))
    ]
    usable = np.isfinite(rays[0]).all(axis=1) & np.isfinite(rays[1]).all(axis=1)
    focal = 0.5 * (focal_px(views[0].camera) + focal_px(views[1].camera))
    found = relative_pose(rays[0][usable], rays[1][usable], focal, _TWO_VIEWS)
    return np.inf if found is None else relative_pose_error_deg(found, truth)


def relative_pose_error_deg(found: RigidTransform, truth: RigidTransform) -> float:
    """See :func:`pose_error_deg`."""
    rotation = rotation_angles_deg(np.array(found.quat_wxyz), np.array(truth.quat_wxyz))
    a, b = np.array(found.translation), np.array(truth.translation)
    lengths = np.linalg.norm(a) * np.linalg.norm(b)
    if np.linalg.norm(b) < _SAME_CENTRE or lengths == 0:
        return float(rotation)
    translation = np.degrees(np.arccos(min(1.0, abs(a @ b) / lengths)))
    return float(max(rotation, translation))


def pose_auc(errors_deg: Sequence[float] | NDArray[Any]) -> tuple[float, ...]:
    """Area under the curve of recall over the error, up to each of AUC_DEG, over that bound."""
    ascending = np.sort(np.asarray(errors_deg, np.float64))
    if not len(ascending):
        return (0.0,) * len(AUC_DEG)
    recall = np.arange(1, len(ascending) + 1) / len(ascending)
    areas = []
    for bound in AUC_DEG:
        inside = np.searchsorted(ascending, bound)
        x = np.concatenate([[0.0], ascending[:inside], [bound]])
        y = np.concatenate([[0.0], recall[:inside], recall[inside - 1 : inside] if inside else [0]])
        areas.append(float(np.trapezoid(y, x) / bound))
    return tuple(areas)
