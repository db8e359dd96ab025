"""Cameras from above as inline SVG: the map, truth and estimates, errors as lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.collections import LineCollection
from numpy.typing import NDArray

from megloc_kapture.evaluation.report.document import Block, Figure, Heading, Paragraph
from megloc_kapture.evaluation.report.figures import (
    MISS,
    MUTED,
    RASTER_ABOVE,
    styled_figure,
    to_svg,
)
from megloc_kapture.evaluation.results import Poses, are_ranked
from megloc_kapture.evaluation.scoring import Evaluation
from megloc_kapture.evaluation.without_truth import ResultWithoutTruth
from megloc_kapture.geometry.poses import camera_centers, invert_quats, rotate, stack_poses
from megloc_kapture.io.dataset_tables import METRES
from megloc_kapture.values import RigidTransform

# below this length of the mean "down" of unit vectors, cameras agree on no vertical
_MIN_AGREEMENT = 0.5
# a vertical this close to a world axis is that axis: labels can then say x, y and z
_AXIS_COSINE = float(np.cos(np.deg2rad(15.0)))


@dataclass(frozen=True, eq=False, slots=True)
class TopView:
    """Two directions of the world spanning the ground, seen from above.

    Parameters
    ----------
    right, up : float64 (3,), what points right and up on the page; orthonormal.
    labels : what to write at the two axes, without unit.
    """

    right: NDArray[np.float64]
    up: NDArray[np.float64]
    labels: tuple[str, str]

    def project(self, centers: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) of the world on the page (N, 2)."""
        return np.stack([centers @ self.right, centers @ self.up], axis=1)


def top_view(quats_wxyz: NDArray[np.float64], centers: NDArray[np.float64]) -> TopView:
    """Look down on cameras ``cam_from_world`` (N, 4) with centres (N, 3), N at least 1.

    Vertical is the mean direction in which the cameras' images point down, for people hold
    cameras upright; where the cameras do not agree on one, it is the direction in which their
    centres spread least. A vertical close to a world axis is taken to be that axis.
    """
    down = rotate(invert_quats(quats_wxyz), np.array([0.0, 1.0, 0.0])).mean(axis=0)
    length = float(np.linalg.norm(down))
    spread = centers - centers.mean(axis=0)
    axes = np.linalg.svd(spread, full_matrices=True)[2] if len(centers) <= 3 else _axes(spread)
    upward = -down / length if length >= _MIN_AGREEMENT else _signed(axes[2])
    nearest = int(np.argmax(np.abs(upward)))
    if abs(upward[nearest]) >= _AXIS_COSINE:
        return _along_axes(nearest, positive=bool(upward[nearest] > 0))
    right = axes[0] - (axes[0] @ upward) * upward
    if np.linalg.norm(right) < 1e-6:  # the cameras stand on one vertical line
        right = np.eye(3)[int(np.argmin(np.abs(upward)))]
        right = right - (right @ upward) * upward
    right = _signed(right / np.linalg.norm(right))
    return TopView(right, np.cross(upward, right), ("along the map", "across the map"))


def _axes(spread: NDArray[np.float64]) -> NDArray[np.float64]:
    """Principal directions (3, 3) as rows, widest first."""
    return np.asarray(np.linalg.eigh(spread.T @ spread)[1].T[::-1], dtype=np.float64)


def _signed(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same line with its largest component positive, for a reproducible page."""
    return direction if direction[int(np.argmax(np.abs(direction)))] > 0 else -direction


def _along_axes(vertical: int, *, positive: bool) -> TopView:
    """The page spanned by the two other world axes, not mirrored."""
    first, second = ((1, 2), (2, 0), (0, 1))[vertical]
    names = "xyz"
    if not positive:  # seen from the other side: swap to keep the page right-handed
        first, second = second, first
    world = np.eye(3)
    return TopView(world[first], world[second], (names[first], names[second]))


@dataclass(frozen=True, slots=True)
class DrawnQuery:
    """One query in the view.

    Parameters
    ----------
    anchor : where its line starts: the true pose; without truth, that of its first candidate.
    estimate : its pose; None: it has none.
    guessed : whether that is a fallback.
    frame : the coordinate frame that it stands in.
    """

    anchor: RigidTransform | None
    estimate: RigidTransform | None
    guessed: bool = False
    frame: str = ""


def views_of(
    result: Evaluation | ResultWithoutTruth,
    map_poses: Poses,
    frames: Mapping[str, str],
    *,
    prefix: str = "above",
) -> list[Block]:
    """The views of a result, one per coordinate frame; see :func:`views_from_above`.

    Without truth lines lead from the first candidate to the pose, where candidates were ranked,
    and there is no view without poses.
    """
    drawn = []
    if isinstance(result, Evaluation):
        for query in result.queries:
            name, guessed = query.image, query.outcome == "fallback"
            frame = frames.get(result.image(name), query.condition)
            poses = result.truth[name], result.estimated.get(name)
            drawn.append(DrawnQuery(*poses, guessed, frame))
        return views_from_above(drawn, map_poses, frames, prefix=prefix)
    ranked = are_ranked(query.candidates for query in result.queries)
    for query in result.queries:
        name, guessed = query.image, query.outcome == "fallback"
        first = next((c for c in query.candidates if c in map_poses), "")
        anchor = map_poses.get(first) if ranked else None
        # a pose stands in the frame of the images it was estimated from
        frame = frames.get(first, frames.get(name, ""))
        drawn.append(DrawnQuery(anchor, result.poses.get(name), guessed, frame))
    if not any(one.estimate for one in drawn):
        return []
    unit = result.context.unit
    return views_from_above(drawn, map_poses, frames, prefix=prefix, with_truth=False, unit=unit)


def views_from_above(
    drawn: Sequence[DrawnQuery],
    map_poses: Poses,
    frames: Mapping[str, str],
    *,
    prefix: str = "above",
    with_truth: bool = True,
    unit: str = METRES,
) -> list[Block]:
    """Draw queries among the map's cameras, each coordinate frame on a page of its own.

    Parameters
    ----------
    drawn : those of a frame without map images are drawn on the page of all that have none.
    frames : map image -> frame.
    prefix : of the figures' ids, different for each call on one HTML page.
    """
    known = sorted({frames.get(image, "") for image in map_poses} or {""})
    blocks: list[Block] = []
    for number, frame in enumerate(known):
        mine = [one for one in drawn if (one.frame if one.frame in known else known[0]) == frame]
        if not mine:
            continue
        mapped = [pose for image, pose in map_poses.items() if frames.get(image, "") == frame]
        name = prefix if len(known) == 1 else f"{prefix}{number}"
        svg, num_outside = _draw(mine, mapped, name, with_truth=with_truth, unit=unit)
        if len(known) > 1 and frame:
            blocks.append(Heading(frame))
        if num_outside:
            lie = "estimate lies" if num_outside == 1 else "estimates lie"
            blocks.append(Paragraph(f"{num_outside} {lie} outside the page."))
        blocks.append(Figure(svg))
    return blocks


def _draw(
    drawn: list[DrawnQuery],
    map_poses: list[RigidTransform],
    prefix: str,
    *,
    with_truth: bool,
    unit: str,
) -> tuple[Markup, int]:
    """The figure, and how many estimates lie outside its page.

    The page spans the map and the truth (without truth, and without a map, the estimates).
    """
    anchors = [one.anchor for one in drawn if one.anchor is not None]
    estimates = [one.estimate for one in drawn if one.estimate is not None]
    spanning = map_poses + (anchors if with_truth else []) or estimates
    quats, translations = stack_poses(spanning)
    view = top_view(quats, camera_centers(quats, translations))

    def seen(poses: list[RigidTransform]) -> NDArray[np.float64]:
        return view.project(camera_centers(*stack_poses(poses)))

    low, high = _page(seen(spanning))
    guessed = np.array([one.guessed for one in drawn if one.estimate is not None], dtype=bool)
    estimated = seen(estimates)
    outside = ~((estimated >= low) & (estimated <= high)).all(axis=1)
    joined = [(one.anchor, one.estimate) for one in drawn if one.anchor and one.estimate]
    starts, ends = (seen([both[side] for both in joined]) for side in (0, 1))
    lost = [one.anchor for one in drawn if one.anchor and not one.estimate]
    # in a crowd dots are smaller, and pixels
    number = len(map_poses) + len(drawn)
    shrink, raster = float(np.clip(np.sqrt(800 / max(number, 1)), 0.3, 1.0)), number > RASTER_ABOVE

    def dots(points: NDArray[np.float64], label: str, size: float, **look: Any) -> None:
        look = {"linewidths": 1.3 * shrink, "rasterized": raster} | look
        axes.scatter(points[:, 0], points[:, 1], s=size * shrink, label=label, **look)

    width, height = (high - low).tolist()
    with styled_figure(10.5, float(np.clip(10.0 * height / width, 3.0, 6.5)) + 0.6) as figure:
        axes = figure.subplots()
        if map_poses:
            dots(seen(map_poses), "map cameras", 10, c="#b8c4d0")
        axes.add_collection(
            LineCollection(
                list(np.stack([starts, ends], axis=1)),
                colors=MISS if with_truth else MUTED,
                linewidths=max(shrink, 0.5),
                alpha=0.3 if raster else 0.8,
                rasterized=raster,
            )
        )
        if with_truth:
            dots(starts, "truth", 26, facecolors="none", edgecolors="#009e73")
        dots(estimated[~guessed], "estimated", 7, c="#0072b2", linewidths=0)
        if guessed.any():
            dots(estimated[guessed], "fallback pose", 20, c=MISS, marker="x")
        if with_truth and lost:
            dots(seen(lost), "truth, no pose", 30, c=MISS, marker="+")
        axes.set_aspect("equal")
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.set(xlabel=f"{view.labels[0]} ({unit})", ylabel=f"{view.labels[1]} ({unit})")
        figure.legend(loc="outside lower center", ncols=5, fontsize=8)
        return to_svg(figure, prefix), int(outside.sum())


def _page(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower left and upper right corner around points (N, 2), with a margin; never flat."""
    low, high = points.min(axis=0), points.max(axis=0)
    size = max(float((high - low).max()), 1.0)
    # a path walked straight ahead would leave a page without height
    half = np.maximum((high - low) / 2, 0.12 * size) + 0.06 * size
    center = (low + high) / 2
    return center - half, center + half
