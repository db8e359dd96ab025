"""Pose errors, recall at thresholds with its confidence intervals, medians, and confidences.

To judge confidences, a pose is correct if it is within the coarsest threshold; every pose of a
query that shows nothing of the map is wrong.

Naeini et al., "Obtaining well calibrated probabilities using Bayesian binning", AAAI 2015
(calibration error); Geifman and El-Yaniv, "Selective classification for deep neural networks",
NeurIPS 2017 (risk-coverage curve).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from megloc_kapture.errors import OptionError, check_option
from megloc_kapture.geometry.poses import invert, rotation_angles_deg, stack_poses
from megloc_kapture.io.dataset_tables import Protocol
from megloc_kapture.values import Options, RigidTransform

if TYPE_CHECKING:
    from megloc_kapture.evaluation.scoring import QueryResult


class Threshold(Options):
    """Upper bounds (``<=``) for the error of a camera centre and of a rotation.

    ``angle_deg`` None ignores the rotation, as the MLAD challenges do.
    """

    position_m: float = Field(ge=0.0, allow_inf_nan=False)
    angle_deg: float | None = Field(default=None, ge=0.0, allow_inf_nan=False)

    @classmethod
    def parse(cls, text: str) -> Threshold:
        """Parse ``"0.25,2"`` (metres, degrees) or ``"0.25"`` (position only)."""
        parts = text.replace(",", " ").split()
        try:
            numbers = [float(part) for part in parts]
            # shells split "0.25, 2" into two arguments
            if len(numbers) not in (1, 2) or text.endswith(","):
                raise ValueError
            return cls(position_m=numbers[0], angle_deg=numbers[1] if len(numbers) == 2 else None)
        except ValueError as error:  # pydantic's errors are ValueErrors too
            raise OptionError(
                f"threshold {text!r} is not METRES,DEGREES or METRES, at or above 0, such as 0.25,2"
            ) from error

    def holds(self, position_m: ArrayLike, angle_deg: ArrayLike) -> NDArray[np.bool_]:
        inside = np.asarray(np.asarray(position_m) <= self.position_m)
        if self.angle_deg is None:
            return inside
        return inside & (np.asarray(angle_deg) <= self.angle_deg)

    def __str__(self) -> str:
        position = f"{self.position_m:g} m"
        return position if self.angle_deg is None else f"{position}, {self.angle_deg:g} deg"


def thresholds_from_pairs(pairs: Iterable[tuple[float, float | None]]) -> tuple[Threshold, ...]:
    return tuple(Threshold(position_m=p, angle_deg=a) for p, a in pairs)


def pairs_of_thresholds(thresholds: Iterable[Threshold]) -> tuple[tuple[float, float | None], ...]:
    """Return position (m) and angle (deg) of each threshold, as a protocol has them."""
    return tuple((threshold.position_m, threshold.angle_deg) for threshold in thresholds)


def from_fine_to_coarse(thresholds: Iterable[Threshold]) -> list[Threshold]:
    return sorted(
        thresholds, key=lambda t: (t.position_m, np.inf if t.angle_deg is None else t.angle_deg)
    )


@dataclass(frozen=True, eq=False, slots=True)
class PoseErrors:
    """Errors of the N queries ``names``.

    ``position_m`` (N,) are distances between estimated and true camera centres, ``angle_deg`` (N,)
    angles between estimated and true rotations. Both errors of a query without a pose are infinite:
    it is beyond every threshold and raises the median.
    """

    names: tuple[str, ...]
    position_m: NDArray[np.float64]
    angle_deg: NDArray[np.float64]

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        return np.isfinite(self.position_m)


def pose_errors(
    estimated: Mapping[str, RigidTransform],
    truth: Mapping[str, RigidTransform],
    names: Iterable[str] | None = None,
) -> PoseErrors:
    """Return the errors of ``names`` in their order; by default all images of ``truth``, sorted.

    Poses are ``cam_from_world`` in one frame, in metres.
    """
    listed = tuple(sorted(truth) if names is None else names)
    position_m, angle_deg = np.full((2, len(listed)), np.inf)
    posed = [i for i, name in enumerate(listed) if name in estimated]
    if posed:
        # compare world_from_cam by kapture's sequence of operations: errors then equal kapture's to
        # the last bit, and a query exactly on a threshold is counted the same way
        quats, centers = invert(*stack_poses(estimated[listed[i]] for i in posed))
        true_quats, true_centers = invert(*stack_poses(truth[listed[i]] for i in posed))
        position_m[posed] = np.linalg.norm(centers - true_centers, axis=1)
        angle_deg[posed] = rotation_angles_deg(quats, true_quats)
    return PoseErrors(listed, position_m, angle_deg)


LEVEL = 0.95


def confidence_interval(
    successes: ArrayLike, trials: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the exact (Clopper-Pearson) interval of a proportion; 0 to 1 without trials.

    It contains the true proportion with at least 95 % probability. Wilson's interval is narrower,
    but covers less near a recall of 1: 91 % for 98 queries and a true recall of 99.5 %. Queries
    are treated as independent draws, although those of one drive are not quite independent.
    """
    from scipy.special import betaincinv

    k, n = np.broadcast_arrays(
        np.asarray(successes, dtype=np.float64), np.asarray(trials, dtype=np.float64)
    )
    tail = (1.0 - LEVEL) / 2.0
    low, high = np.zeros(k.shape), np.ones(k.shape)
    some, not_all = k > 0, k < n
    low[some] = betaincinv(k[some], (n - k + 1.0)[some], tail)
    high[not_all] = betaincinv((k + 1.0)[not_all], (n - k)[not_all], 1.0 - tail)
    return low, high


ALL = "all"


@dataclass(frozen=True, slots=True)
class RecallAt:
    """Recall at one threshold: ``num_within / num_queries``, and its 95 % interval."""

    threshold: Threshold
    num_within: int
    recall: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class RecallRow:
    """Recall and medians of one condition, pool or ``"all"``.

    Fallback poses are guesses: they count in recall, but not as localized. ``median_position_m``
    and ``median_angle_deg`` are over all queries, with infinite errors where the pose is missing;
    ``median_localized_*`` are over the localized queries only.
    """

    name: str
    num_queries: int
    num_localized: int
    num_fallback: int
    num_missing: int
    recall: tuple[RecallAt, ...]
    median_position_m: float
    median_angle_deg: float
    median_localized_position_m: float
    median_localized_angle_deg: float


def within(errors: PoseErrors, threshold: Threshold) -> NDArray[np.bool_]:
    return threshold.holds(errors.position_m, errors.angle_deg)


def recall_row(
    name: str,
    errors: PoseErrors,
    thresholds: Sequence[Threshold],
    *,
    members: NDArray[np.bool_] | None = None,
    fallback: NDArray[np.bool_] | None = None,
) -> RecallRow:
    """Return recall and medians of the queries in the mask ``members`` (N,), by default all.

    ``fallback`` (N,) marks poses that are guesses.
    """
    chosen = np.ones(len(errors.names), bool) if members is None else members
    guessed = np.zeros(len(errors.names), bool) if fallback is None else fallback
    posed = errors.has_pose & chosen
    localized = posed & ~guessed
    num_queries = int(chosen.sum())
    counts = [int((within(errors, threshold) & chosen).sum()) for threshold in thresholds]
    lows, highs = confidence_interval(counts, num_queries)
    return RecallRow(
        name=name,
        num_queries=num_queries,
        num_localized=int(localized.sum()),
        num_fallback=int((posed & guessed).sum()),
        num_missing=num_queries - int(posed.sum()),
        recall=tuple(
            RecallAt(
                threshold=threshold,
                num_within=count,
                recall=count / num_queries if num_queries else 0.0,
                low=float(low),
                high=float(high),
            )
            for threshold, count, low, high in zip(thresholds, counts, lows, highs, strict=True)
        ),
        median_position_m=_median(errors.position_m[chosen]),
        median_angle_deg=_median(errors.angle_deg[chosen]),
        median_localized_position_m=_median(errors.position_m[localized]),
        median_localized_angle_deg=_median(errors.angle_deg[localized]),
    )


def row_members(conditions: Sequence[str], protocol: Protocol) -> dict[str, NDArray[np.bool_]]:
    """Return a mask (N,) of queries for each row of a recall table.

    One row per condition (in the protocol's order, queries without a condition last), then one per
    pool that has queries, then ``"all"``. A pool counts the queries of its conditions together; it
    is not the mean of their recalls.
    """
    order, pools = protocol.conditions, protocol.pools
    of_query = np.array(list(conditions), str)
    present = set(of_query.tolist())
    named = [c for c in order if c in present] + sorted(present - {""} - set(order))
    if named and "" in present:
        named.append("")
    rows = [(c, of_query == c) for c in named]
    pooled = ((pool, np.isin(of_query, list(parts))) for pool, parts in pools.items())
    rows += [(pool, members) for pool, members in pooled if members.any()]
    rows.append((ALL, np.ones(len(of_query), bool)))
    for name, number in Counter(name for name, _ in rows).items():
        check_option(
            number <= 1,
            f"two rows of the recall table would be called {name!r}; rename one of the conditions",
        )
    return dict(rows)


def _median(values: NDArray[np.float64]) -> float:
    return float(np.median(values)) if values.size else float("inf")


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
    """The confidences of one result compared with the truth.

    Attributes
    ----------
    num_poses, num_wrong : poses with a confidence, and those beyond the coarsest threshold.
    wrong_low, wrong_high : 95 % interval of the share of wrong poses.
    num_nowhere_refused : of the queries that show nothing of the map, those not localized (without
        a pose, or with a fallback pose).
    calibration_error : see :func:`calibration_error`.
    coverage, risk : (num_poses,) share of queries that are accepted, most confident first, and
        share of wrong poses among them.
    area, least_area, area_by_inliers : area under the risk curve; its minimum, with all correct
        poses first; and the area if ranked by inliers, None if unknown.
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
    low, high = confidence_interval(num_wrong, max(len(posed), 1))
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
        wrong_low=float(low),
        wrong_high=float(high),
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
    """Sort poses by confidence (N,) into ten equal-width bins; ``right`` marks correct ones."""
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
    """Return the expected calibration error.

    It is |mean confidence - share of correct poses|, averaged over bins, weighted by their poses.
    """
    filled = [b for b in bins if b.num_poses]
    total = sum(b.num_poses for b in filled)
    distances = (abs(b.share_right - b.mean_confidence) * b.num_poses for b in filled)
    return sum(distances) / total if total else 0.0


def risk_by_score(scores: NDArray[np.float64], right: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the share of wrong poses (N,) among the 1 ... N best; ties are averaged."""
    order = np.argsort(-scores, kind="stable")
    _, inverse, counts = np.unique(-scores, return_inverse=True, return_counts=True)
    wrong = np.bincount(inverse, weights=~right) / counts
    cumulated = np.cumsum(wrong[inverse][order])
    return np.asarray(cumulated / np.arange(1, len(scores) + 1))


def least_area(right: NDArray[np.bool_]) -> float:
    """Return the area under the risk curve if all correct poses come first; 0 without poses."""
    if not len(right):
        return 0.0
    return float(risk_by_score(right.astype(np.float64), right).mean())
