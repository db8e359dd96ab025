"""How well the confidence of poses tells the right ones from the wrong.

Right is a pose within the coarsest threshold; a query of which it is known that it shows nothing of
the map has no right pose. Naeini et al., "Obtaining well calibrated probabilities using Bayesian
binning", AAAI 2015 (calibration error); Geifman and El-Yaniv, "Selective classification for deep
neural networks", NeurIPS 2017 (risk against coverage).
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
    """Poses of similar confidence.

    Attributes
    ----------
    low, high : the confidences that it holds, ``high`` included.
    num_poses, num_right : how many there are, and how many of them are right.
    mean_confidence : NaN where there is none.
    """

    low: float
    high: float
    num_poses: int
    num_right: int
    mean_confidence: float

    @property
    def share_right(self) -> float:
        """Of the poses; NaN where there is none."""
        return self.num_right / self.num_poses if self.num_poses else float("nan")


@dataclass(frozen=True, slots=True)
class Confidence:
    """The confidences of one result against the truth.

    Attributes
    ----------
    num_queries : all that count, with a pose or without.
    num_poses, num_wrong : poses with a confidence, and those beyond the coarsest threshold.
    wrong_low, wrong_high : 95 % confidence interval of the share of wrong ones among the poses.
    num_nowhere, num_nowhere_refused : queries that show nothing of the map, and those without a
        pose, which is what is right.
    bins : of the reliability diagram, by rising confidence.
    calibration_error : mean distance of a bin's confidence from its share of right poses, by poses.
    coverage, risk : (num_poses,) of all queries the share that is accepted, and of these the share
        that is wrong, as poses are accepted from the most confident on.
    area : under the curve of risk over the poses.
    least_area : what it would be if every right pose came before every wrong one.
    area_by_inliers : the same with the number of inliers instead; None where it is not known.
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
    """Judge the confidences of a result's poses; None where no pose has one and no query is known
    to show nothing of the map (``nowhere``, each pose of which is wrong)."""
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
    """Bins of equal width over confidences (N,) from 0 to 1, and which poses (N,) are right."""
    number = np.clip(np.ceil(confidences * NUM_BINS).astype(int) - 1, 0, NUM_BINS - 1)
    found = []
    for index in range(NUM_BINS):
        own = number == index
        count = int(own.sum())
        mean = float(confidences[own].mean()) if count else float("nan")
        edges = index / NUM_BINS, (index + 1) / NUM_BINS
        found.append(Bin(*edges, count, int(right[own].sum()), mean))
    return tuple(found)


def calibration_error(bins: Sequence[Bin]) -> float:
    """Expected calibration error: 0 where of poses of confidence p the share p is right."""
    filled = [one for one in bins if one.num_poses]
    total = sum(one.num_poses for one in filled)
    distances = (abs(one.share_right - one.mean_confidence) * one.num_poses for one in filled)
    return sum(distances) / total if total else 0.0


def risk_by_score(scores: NDArray[np.float64], right: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Share of wrong poses (N,) among the 1, 2, ... N best by score; ties count as their mean."""
    order = np.argsort(-scores, kind="stable")
    _, inverse, counts = np.unique(-scores, return_inverse=True, return_counts=True)
    wrong = np.bincount(inverse, weights=~right) / counts
    cumulated = np.cumsum(wrong[inverse][order])
    return np.asarray(cumulated / np.arange(1, len(scores) + 1))


def least_area(right: NDArray[np.bool_]) -> float:
    """Area under risk against coverage where every right pose comes first; 0 without poses."""
    if not len(right):
        return 0.0
    return float(risk_by_score(right.astype(np.float64), right).mean())
