"""Pose errors, recall at thresholds with its confidence intervals, and medians."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BeforeValidator, Field, PlainSerializer

from megloc_kapture.errors import OptionError
from megloc_kapture.geometry.poses import invert, rotation_angles_deg, stack_poses
from megloc_kapture.io.dataset_tables import Protocol
from megloc_kapture.values import Options, RigidTransform


class Threshold(Options):
    """A query counts when both of its errors are at or below (``<=``).

    Parameters
    ----------
    position_m : bound on the distance of the camera centres, metres.
    angle_deg : bound on the rotation angle, degrees; None leaves the rotation out, as the MLAD
        challenges do.
    """

    position_m: float = Field(ge=0.0, allow_inf_nan=False)
    angle_deg: float | None = Field(default=None, ge=0.0, allow_inf_nan=False)

    @classmethod
    def parse(cls, text: str) -> Threshold:
        """From ``"0.25,2"`` (metres, degrees) or ``"0.25"`` (position only); else OptionError."""
        parts = text.replace(",", " ").split()
        try:
            numbers = [float(part) for part in parts]
            if len(numbers) not in (1, 2):
                raise ValueError
            return cls(position_m=numbers[0], angle_deg=numbers[1] if len(numbers) == 2 else None)
        except ValueError as error:  # pydantic's errors are ValueErrors too
            raise OptionError(
                f"threshold {text!r} is not METRES,DEGREES (both at or above 0), such as 0.25,2"
            ) from error

    def holds(self, position_m: ArrayLike, angle_deg: ArrayLike) -> NDArray[np.bool_]:
        """Whether errors (...) lie at or below (``<=``) both bounds; infinite ones do not."""
        inside = np.asarray(np.asarray(position_m) <= self.position_m)
        if self.angle_deg is None:
            return inside
        return inside & (np.asarray(angle_deg) <= self.angle_deg)

    def __str__(self) -> str:
        position = f"{self.position_m:g} m"
        return position if self.angle_deg is None else f"{position}, {self.angle_deg:g} deg"


def thresholds_from_pairs(pairs: Iterable[tuple[float, float | None]]) -> tuple[Threshold, ...]:
    """Thresholds of (metres, degrees or None) pairs, as a protocol keeps them."""
    return tuple(Threshold(position_m=p, angle_deg=a) for p, a in pairs)


DEFAULT_THRESHOLDS = thresholds_from_pairs(Protocol().thresholds)


@dataclass(frozen=True, eq=False, slots=True)
class PoseErrors:
    """Errors of N queries, in the order of ``names``.

    A query without an estimated pose has infinite errors, both of them: it lies beyond every
    threshold, sorts last, and raises a median instead of leaving it. Neither array holds NaN.

    Parameters
    ----------
    names : the queries.
    position_m : float64 (N,), distance between the camera centres, metres.
    angle_deg : float64 (N,), angle of the rotation between the two, degrees in [0, 180].
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
    """Errors of ``estimated`` for the queries ``names``, by default all of ``truth``, sorted.

    Parameters
    ----------
    estimated, truth : ``cam_from_world`` by image name, in one frame, metres. Estimates of images
        that are not asked for are left alone.
    names : must all be in ``truth``.
    """
    listed = tuple(sorted(truth) if names is None else names)
    position_m = np.full(len(listed), np.inf)
    angle_deg = np.full(len(listed), np.inf)
    found = [i for i, name in enumerate(listed) if name in estimated]
    if found:
        # compared as world_from_cam, step by step as kapture does: figures then agree to the last
        # bit, and so do the queries that lie exactly on a threshold
        quats, centers = invert(*stack_poses(estimated[listed[i]] for i in found))
        true_quats, true_centers = invert(*stack_poses(truth[listed[i]] for i in found))
        position_m[found] = np.linalg.norm(centers - true_centers, axis=1)
        angle_deg[found] = rotation_angles_deg(quats, true_quats)
    return PoseErrors(listed, position_m, angle_deg)


LEVEL = 0.95


def confidence_interval(
    successes: ArrayLike, trials: ArrayLike, *, level: float = LEVEL
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Exact (Clopper-Pearson) confidence interval of a share; 0 to 1 where there was no trial.

    It holds the true share with at least ``level`` probability, whatever the share and the number
    of trials. Wilson's interval is a little narrower but does so on average only: with 98 queries
    its 95 % are 91 % where recall is near 99 %, which is where papers compare. Queries count as
    independent draws; those of one drive are not quite, which makes the interval too narrow.

    Parameters
    ----------
    successes, trials : whole numbers (...), ``0 <= successes <= trials``; shapes broadcast.
    level : confidence, above 0 and below 1.
    """
    from scipy.special import betaincinv

    k, n = np.broadcast_arrays(
        np.asarray(successes, dtype=np.float64), np.asarray(trials, dtype=np.float64)
    )
    tail = (1.0 - level) / 2.0
    low, high = np.zeros(k.shape), np.ones(k.shape)
    some, not_all = k > 0, k < n
    low[some] = betaincinv(k[some], (n - k + 1.0)[some], tail)
    high[not_all] = betaincinv((k + 1.0)[not_all], (n - k)[not_all], 1.0 - tail)
    return low, high


ALL = "all"

# JSON has no infinity: an infinite median ("most queries have no pose") is null there
MaybeInfinite = Annotated[
    float,
    BeforeValidator(lambda value: np.inf if value is None else value),
    PlainSerializer(lambda value: value if np.isfinite(value) else None, when_used="json"),
]


class RecallAt(Options):
    """Recall at one threshold.

    Parameters
    ----------
    num_within : queries within the threshold, of the row's ``num_queries``.
    recall : their ratio; ``low``, ``high``: its 95 % :func:`confidence_interval`.
    """

    threshold: Threshold
    num_within: int
    recall: float
    low: float
    high: float


class RecallRow(Options):
    """Recall and medians of one group of queries.

    Parameters
    ----------
    name : the condition, or the name of a pool.
    num_queries : every query of the group: the denominator of recall.
    num_localized : queries whose pose was estimated.
    num_fallback : queries whose pose is a fallback, a guess; they count in recall as any pose
        does, but not as localized.
    num_missing : queries without a pose.
    recall : one entry per threshold, in the order of the thresholds.
    median_position_m, median_angle_deg : over all queries, a missing pose counting as infinite.
    median_localized_position_m, median_localized_angle_deg : over the localized queries only;
        infinite if there are none.
    """

    name: str
    num_queries: int
    num_localized: int
    num_fallback: int
    num_missing: int
    recall: tuple[RecallAt, ...]
    median_position_m: MaybeInfinite
    median_angle_deg: MaybeInfinite
    median_localized_position_m: MaybeInfinite
    median_localized_angle_deg: MaybeInfinite


def within(errors: PoseErrors, threshold: Threshold) -> NDArray[np.bool_]:
    """(N,) whether each query is at or below (``<=``) both bounds; one without a pose never is."""
    return threshold.holds(errors.position_m, errors.angle_deg)


def recall_row(
    name: str,
    errors: PoseErrors,
    thresholds: Sequence[Threshold],
    *,
    members: NDArray[np.bool_] | None = None,
    fallback: NDArray[np.bool_] | None = None,
) -> RecallRow:
    """Recall and medians of the queries ``members`` (N,), by default all; ``fallback`` (N,) says
    whether a query's pose is one, by default none is."""
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


def row_members(
    conditions: Sequence[str],
    *,
    order: Sequence[str] = (),
    pools: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, NDArray[np.bool_]]:
    """The rows of a recall table and the queries they count, bool (N,): one row per condition, then
    one per pool, then ``"all"``.

    A pool counts the queries of its conditions together; it is not the mean of their recalls.

    Parameters
    ----------
    conditions : the condition of each of the N queries, ``""`` for none. Where no query has one,
        there is only the row ``"all"``.
    order : conditions in the order to report them; others follow, sorted, those without last.
    pools : name -> conditions; a pool without queries is left out.
    """
    of_query = np.array(list(conditions), str)
    present = set(of_query.tolist())
    named = [c for c in order if c in present] + sorted(present - {""} - set(order))
    if named and "" in present:
        named.append("")
    members: dict[str, NDArray[np.bool_]] = {c: of_query == c for c in named}
    for pool, parts in (pools or {}).items():
        _check_free(pool, members)
        pooled = np.isin(of_query, list(parts))
        if pooled.any():
            members[pool] = pooled
    _check_free(ALL, members)
    return {**members, ALL: np.ones(len(of_query), bool)}


def _check_free(name: str, taken: Mapping[str, object]) -> None:
    if name in taken:
        raise OptionError(f"two rows of the recall table would be called {name!r}; rename one")


def _median(values: NDArray[np.float64]) -> float:
    return float(np.median(values)) if values.size else float("inf")
