"""Calibration of the confidences of poses.

A pose is right within the coarsest threshold; every pose of a query that shows nothing of the map
is wrong. Naeini et al., "Obtaining well calibrated probabilities using Bayesian binning", AAAI 2015
(calibration error); Geifman and El-Yaniv, "Selective classification for deep neural networks",
NeurIPS 2017 (risk against coverage).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.evaluation.metrics import confidence_interval

if TYPE_CHECKING:
    from megloc_kapture.evaluation.metrics import Threshold
    from megloc_kapture.evaluation.scoring import QueryResult

NUM_BINS = 10


@dataclass(frozen=True, slots=True)
class Bin:
    """Poses with a confidence above ``low``, up to ``high``; the mean is NaN without poses."""

    low: float
    high: float
    num_poses: int
    num_right: int
    mean_confidence: float

    @property
    def share_right(self) -> float:
        return self.num_right / self.num_poses if self.num_poses else float("nan")


@dataclass(frozen=True, slots=True)
class Confidence:
    """The confidences of one result against the truth.

    Attributes
    ----------
    num_poses, num_wrong : poses with a confidence, and those beyond the coarsest threshold.
    wrong_low, wrong_high : 95 % interval of the share of wrong poses.
    num_nowhere_refused : of the queries that show nothing of the map, those without a pose.
    calibration_error : mean distance of confidence and share of right poses, over bins.
    coverage, risk : (num_poses,) share of queries that are accepted, most confident first, and
        share of wrong poses among them.
    area, least_area, area_by_inliers : area under the risk; the same if every right pose came
        first; the same if ranked by inliers, None if unknown.
    """

    num_queries: int
    num_poses: int
    num_wrong: int
    wrong_low: float
    wrong_high: float
    num_nowhere: int
    num_nowhere_refused: int
    bins: tuple[Bin, ...]
    calibration_error: float
    coverage: tuple[float, ...]
    risk: tuple[float, ...]
    area: float
    least_area: float
    area_by_inliers: float | None


def confidence_of(
    queries: Sequence[QueryResult], coarsest: Threshold, nowhere: Sequence[QueryResult] = ()
) -> Confidence | None:
    """Judge the confidences of poses; None if no pose has one and ``nowhere`` is empty."""
    posed = [q for q in queries if q.outcome == "localized" and q.confidence is not None]
    strays = [q for q in nowhere if q.outcome == "localized"]
    posed += [q for q in strays if q.confidence is not None]
    if not posed and not nowhere:
        return None
    right = coarsest.holds([q.position_m for q in posed], [q.angle_deg for q in posed])
    values = np.array([q.confidence for q in posed], dtype=np.float64)
    num_queries, num_wrong = len(queries) + len(nowhere), int((~right).sum())
    lows, highs = confidence_interval(np.array([num_wrong]), max(len(posed), 1))
    risk = risk_by_score(values, right)
    inliers = [q.num_inliers for q in posed]
    by_inliers = None
    if posed and None not in inliers:
        by_inliers = float(risk_by_score(np.array(inliers, np.float64), right).mean())
    bins = reliability(values, right)
    return Confidence(
        num_queries=num_queries,
        num_poses=len(posed),
        num_wrong=num_wrong,
        wrong_low=float(lows[0]),
        wrong_high=float(highs[0]),
        num_nowhere=len(nowhere),
        num_nowhere_refused=len(nowhere) - len(strays),
        bins=bins,
        calibration_error=calibration_error(bins),
        coverage=tuple((np.arange(1, len(posed) + 1) / num_queries).tolist()),
        risk=tuple(risk.tolist()),
        area=float(risk.mean()) if posed else 0.0,
        least_area=least_area(right),
        area_by_inliers=by_inliers,
    )


def reliability(confidences: NDArray[np.float64], right: NDArray[np.bool_]) -> tuple[Bin, ...]:
    """Count right poses (N,) in ten bins of equal width over their confidences (N,)."""
    number = np.clip(np.ceil(confidences * NUM_BINS).astype(int) - 1, 0, NUM_BINS - 1)
    bins = []
    for index in range(NUM_BINS):
        members = number == index
        count = int(members.sum())
        mean = float(confidences[members].mean()) if count else float("nan")
        edges = index / NUM_BINS, (index + 1) / NUM_BINS
        bins.append(Bin(*edges, count, int(right[members].sum()), mean))
    return tuple(bins)


def calibration_error(bins: Sequence[Bin]) -> float:
    """Return the expected calibration error; 0 if the share p of poses of confidence p is right."""
    filled = [b for b in bins if b.num_poses]
    total = sum(b.num_poses for b in filled)
    distances = (abs(b.share_right - b.mean_confidence) * b.num_poses for b in filled)
    return sum(distances) / total if total else 0.0


def risk_by_score(scores: NDArray[np.float64], right: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the share of wrong poses (N,) among the 1 ... N best; ties count as their mean."""
    order = np.argsort(-scores, kind="stable")
    _, inverse, counts = np.unique(-scores, return_inverse=True, return_counts=True)
    wrong = np.bincount(inverse, weights=~right) / counts
    cumulated = np.cumsum(wrong[inverse][order])
    return np.asarray(cumulated / np.arange(1, len(scores) + 1))


def least_area(right: NDArray[np.bool_]) -> float:
    """Return the area under the risk if every right pose comes first; 0 without poses."""
    if not len(right):
        return 0.0
    return float(risk_by_score(right.astype(np.float64), right).mean())
