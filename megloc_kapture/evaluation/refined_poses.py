"""What refinement changed: how many poses, by how much, and what it looks like."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.evaluation.pose_errors import pose_errors
from megloc_kapture.evaluation.recall import within
from megloc_kapture.evaluation.refined_views import RefinedView, refined_views
from megloc_kapture.evaluation.surroundings import Surroundings
from megloc_kapture.evaluation.tables import (
    format_degrees,
    format_metres,
    format_percent,
)
from megloc_kapture.evaluation.thresholds import Threshold
from megloc_kapture.io.consistency_table import ConsistencyRow
from megloc_kapture.values import RefinementRow, RigidTransform

Poses = Mapping[str, RigidTransform]

_REASONS_TOLD = 4
_NUMBER = re.compile(r"-?\d+(\.\d+)?")


@dataclass(frozen=True)
class RefinerSummary:
    """One step of the refinement over all queries, as text.

    Attributes
    ----------
    moved : medians of the accepted poses; empty where none is.
    before, after : median errors of the accepted poses; empty where the truth is not known.
    nearer : how many of them came nearer to the truth.
    kept : why the other poses stay, the most frequent reason first.
    """

    name: str
    tried: int
    accepted: int
    moved: str
    before: str
    after: str
    nearer: str
    kept: tuple[str, ...]


@dataclass(frozen=True)
class RefinedPoses:
    """The section about refinement; without ``steps`` there was none.

    Attributes
    ----------
    recall : of all queries, before and after; empty where the truth is not known.
    maps : what the map's own images say of each coordinate frame, where a step asked them.
    """

    steps: tuple[RefinerSummary, ...] = ()
    recall: str = ""
    maps: tuple[str, ...] = ()
    views: tuple[RefinedView, ...] = ()


def refined_poses(
    around: Surroundings | None,
    estimated: Poses,
    truth: Poses | None = None,
    thresholds: Sequence[Threshold] = (),
) -> RefinedPoses:
    """What the section about refinement says and shows.

    Parameters
    ----------
    estimated, truth : ``cam_from_world`` of the queries by image, after all refinement.
    thresholds : of the recall that is told, where there is truth.
    """
    if around is None:
        return RefinedPoses()
    refinements = {i: rows for i, rows in around.refinements.items() if rows and i in estimated}
    if not refinements:
        return RefinedPoses()
    truth = truth or {}
    # the same refiners for every query, in one order
    chains = [_steps(rows, estimated[image]) for image, rows in sorted(refinements.items())]
    steps = [[c[k] for c in chains if k < len(c)] for k in range(max(map(len, chains)))]
    return RefinedPoses(
        tuple(_summary(of_all, truth) for of_all in steps),
        _recall(refinements, estimated, truth, thresholds),
        tuple(told_of_map(row) for row in around.consistency),
        tuple(refined_views(around, refinements, estimated, truth)),
    )


def told_of_map(row: ConsistencyRow) -> str:
    """A sentence about the test of a map's own images."""
    frame = f" in {row.frame}" if row.frame else ""
    told = f"{row.method}{frame} is {f'not used: {row.reason}' if row.reason else 'used'}"
    if row.reason:
        return told
    return (
        f"{told}; {row.images} map images held out move by {format_metres(row.moved_m)} m, "
        f"{format_degrees(row.turned_deg)} deg, {row.moved_px:.1f} px (medians; claimed "
        f"to {format_metres(row.claimed_m)} m, {format_degrees(row.claimed_deg)} deg)"
    )


@dataclass(frozen=True)
class _Step:
    """A row of ``refinement.csv`` and the pose it ended with."""

    row: RefinementRow
    after: RigidTransform


def _steps(rows: Sequence[RefinementRow], last: RigidTransform) -> list[_Step]:
    """The steps of one query; each ends with what the next begins with."""
    ends = [*(row.before for row in rows[1:]), last]
    return [_Step(row, end) for row, end in zip(rows, ends, strict=True)]


def _summary(steps: Sequence[_Step], truth: Poses) -> RefinerSummary:
    """Of one step over all queries."""
    accepted = [step for step in steps if step.row.accepted]
    known = [step.row.image for step in accepted if step.row.image in truth]
    before, after, nearer = "", "", ""
    if known:
        old = pose_errors({step.row.image: step.row.before for step in accepted}, truth, known)
        new = pose_errors({step.row.image: step.after for step in accepted}, truth, known)
        before, after = (_medians(each.position_m, each.angle_deg) for each in (old, new))
        nearer = f"{int((new.position_m < old.position_m).sum())} of {len(known)}"
    moved = ""
    if accepted:
        moved = _medians(
            np.array([step.row.moved_m for step in accepted]),
            np.array([step.row.turned_deg for step in accepted]),
        )
    return RefinerSummary(
        name=steps[0].row.method,
        tried=len(steps),
        accepted=len(accepted),
        moved=moved,
        before=before,
        after=after,
        nearer=nearer,
        kept=_reasons([step.row.reason for step in steps if not step.row.accepted]),
    )


def _reasons(reasons: Sequence[str]) -> tuple[str, ...]:
    """How often each, numbers aside, the most frequent first."""
    counts = Counter(_NUMBER.sub("…", reason) for reason in reasons)
    told = counts.most_common(_REASONS_TOLD)
    rest = len(reasons) - sum(count for _, count in told)
    return (
        *(f"{count} x {reason}" for reason, count in told),
        *([f"{rest} x something else"] if rest else []),
    )


def _medians(position_m: NDArray[np.float64], angle_deg: NDArray[np.float64]) -> str:
    metres, degrees = float(np.median(position_m)), float(np.median(angle_deg))
    return f"{format_metres(metres)} m, {format_degrees(degrees)} deg"


def _recall(
    refinements: Mapping[str, Sequence[RefinementRow]],
    estimated: Poses,
    truth: Poses,
    thresholds: Sequence[Threshold],
) -> str:
    if not truth or not thresholds:
        return ""
    first = {image: rows[0].before for image, rows in refinements.items()}
    told = []
    for poses in ({**estimated, **first}, estimated):
        errors = pose_errors(poses, truth)
        shares = [float(within(errors, threshold).mean()) for threshold in thresholds]
        told.append(" / ".join(format_percent(share) for share in shares))
    return f"Recall (%) of all queries: {told[0]} before, {told[1]} after."
