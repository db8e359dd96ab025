"""The view from above as inline SVG: map cameras, truth and estimates, errors as lines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from numpy.typing import NDArray

from megloc_kapture.evaluation.evaluate import Evaluation
from megloc_kapture.evaluation.figure_style import (
    MISS,
    RASTER_ABOVE,
    styled_figure,
    to_svg,
)
from megloc_kapture.evaluation.top_view import top_view
from megloc_kapture.evaluation.without_truth import ResultWithoutTruth
from megloc_kapture.geometry.poses import camera_centers, stack_poses
from megloc_kapture.values import RigidTransform

Poses = Mapping[str, RigidTransform]


@dataclass(frozen=True, slots=True)
class Placed:
    """One query on the page.

    Parameters
    ----------
    anchor : where its line starts: the true pose; without truth, that of its first candidate.
    estimate : its pose; None: it has none.
    guessed : whether that is a fallback.
    """

    anchor: RigidTransform | None
    estimate: RigidTransform | None
    guessed: bool = False


@dataclass(frozen=True, slots=True)
class AboveView:
    """One page of the view.

    Parameters
    ----------
    frame : the coordinate frame, where a dataset has several.
    svg : the figure.
    num_outside : estimates that lie outside the page.
    """

    frame: str
    svg: Markup
    num_outside: int


def views_of_evaluation(
    evaluation: Evaluation,
    map_poses: Poses | None = None,
    frames: Mapping[str, str] | None = None,
    *,
    prefix: str = "above",
) -> list[AboveView]:
    """The views of a result, one per coordinate frame; see :func:`views_from_above`."""
    placed = {
        query.image: Placed(
            evaluation.truth[query.image],
            evaluation.estimated.get(query.image),
            query.outcome == "fallback",
        )
        for query in evaluation.queries
    }
    of_query = {
        query.image: (frames or {}).get(evaluation.image(query.image), query.condition)
        for query in evaluation.queries
    }
    return views_from_above(placed, map_poses or {}, {**(frames or {}), **of_query}, prefix=prefix)


def views_without_truth(
    result: ResultWithoutTruth,
    map_poses: Poses,
    frames: Mapping[str, str] | None = None,
    *,
    prefix: str = "above",
) -> list[AboveView]:
    """The views of a result without truth; lines lead from the first candidate to the pose."""
    placed, of_query = {}, dict(frames or {})
    for query in result.queries:
        first = next((c for c in query.candidates if c in map_poses), "")
        placed[query.image] = Placed(
            map_poses.get(first), result.poses.get(query.image), query.outcome == "fallback"
        )
        # a pose stands in the frame of the images it was estimated from
        if first in of_query:
            of_query[query.image] = of_query[first]
    if not any(one.estimate for one in placed.values()):
        return []
    return views_from_above(placed, map_poses, of_query, prefix=prefix, with_truth=False)


def views_from_above(
    placed: Mapping[str, Placed],
    map_poses: Poses,
    frames: Mapping[str, str],
    *,
    prefix: str = "above",
    with_truth: bool = True,
) -> list[AboveView]:
    """Draw queries among the map's cameras, each coordinate frame on a page of its own.

    Parameters
    ----------
    frames : image -> frame, of queries and map images; queries of a frame without map images are
        drawn on the page of all that have none.
    prefix : of the figures' ids, different for each call on one HTML page.
    """
    of_map = {image: frames.get(image, "") for image in map_poses}
    known = set(of_map.values()) or {""}
    of_query = {image: frames.get(image, "") for image in placed}
    of_query = {i: frame if frame in known else min(known) for i, frame in of_query.items()}
    views = []
    for number, frame in enumerate(sorted(known)):
        mine = [one for image, one in placed.items() if of_query[image] == frame]
        if not mine:
            continue
        mapped = [pose for image, pose in map_poses.items() if of_map[image] == frame]
        name = prefix if len(known) == 1 else f"{prefix}{number}"
        svg, num_outside = _draw(mine, mapped, name, with_truth=with_truth)
        views.append(AboveView(frame if len(known) > 1 else "", Markup(svg), num_outside))
    return views


def _draw(
    placed: list[Placed], map_poses: list[RigidTransform], prefix: str, *, with_truth: bool
) -> tuple[str, int]:
    """The figure, and how many estimates lie outside its page.

    The page spans the map and the truth (without truth, and without a map, the estimates).
    """
    anchors = [one.anchor for one in placed if one.anchor is not None]
    estimates = [one.estimate for one in placed if one.estimate is not None]
    spanning = map_poses + (anchors if with_truth else []) or estimates
    quats, translations = stack_poses(spanning)
    view = top_view(quats, camera_centers(quats, translations))

    def seen(poses: list[RigidTransform]) -> NDArray[np.float64]:
        return view.project(camera_centers(*stack_poses(poses)))

    low, high = _page(seen(spanning))
    guessed = np.array([one.guessed for one in placed if one.estimate is not None], dtype=bool)
    estimated = seen(estimates)
    outside = ~((estimated >= low) & (estimated <= high)).all(axis=1)
    joined = [one for one in placed if one.anchor is not None and one.estimate is not None]
    starts = seen([one.anchor for one in joined if one.anchor is not None])
    ends = seen([one.estimate for one in joined if one.estimate is not None])
    lines = np.stack([starts, ends], axis=1)
    look = _Crowd(len(map_poses) + len(placed))
    width, height = (high - low).tolist()
    with styled_figure(10.5, float(np.clip(10.0 * height / width, 3.0, 6.5)) + 0.6) as figure:
        axes = figure.subplots()
        if map_poses:
            look.dots(axes, seen(map_poses), "map cameras", 10, c="#b8c4d0")
        look.lines(axes, lines, MISS if with_truth else "#9aa5b1")
        if with_truth:
            found = [one.anchor for one in placed if one.anchor and one.estimate is not None]
            lost = [one.anchor for one in placed if one.anchor and one.estimate is None]
            look.dots(axes, seen(found), "truth", 26, facecolors="none", edgecolors="#009e73")
        look.dots(axes, estimated[~guessed], "estimated", 7, c="#0072b2", linewidths=0)
        if guessed.any():
            look.dots(axes, estimated[guessed], "fallback pose", 20, c=MISS, marker="x")
        if with_truth and lost:
            look.dots(axes, seen(lost), "truth, no pose", 30, c=MISS, marker="+")
        axes.set_aspect("equal")
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.set(xlabel=f"{view.labels[0]} (m)", ylabel=f"{view.labels[1]} (m)")
        figure.legend(loc="outside lower center", ncols=5, fontsize=8)
        return to_svg(figure, prefix), int(outside.sum())


class _Crowd:
    """How dots are drawn where there are ``count`` of them: smaller, and as pixels, in a crowd."""

    def __init__(self, count: int) -> None:
        self.shrink = float(np.clip(np.sqrt(800 / max(count, 1)), 0.3, 1.0))
        self.raster = count > RASTER_ABOVE

    def dots(
        self, axes: Axes, points: NDArray[np.float64], label: str, size: float, **look: Any
    ) -> None:
        look = {"linewidths": 1.3 * self.shrink, "rasterized": self.raster} | look
        axes.scatter(points[:, 0], points[:, 1], s=size * self.shrink, label=label, **look)

    def lines(self, axes: Axes, ends: NDArray[np.float64], color: str) -> None:
        """Lines (N, 2, 2) from one point to another."""
        axes.add_collection(
            LineCollection(
                list(ends),
                colors=color,
                linewidths=max(self.shrink, 0.5),
                alpha=0.3 if self.raster else 0.8,
                rasterized=self.raster,
            )
        )


def _page(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower left and upper right corner around points (N, 2), with a margin; never flat."""
    low, high = points.min(axis=0), points.max(axis=0)
    size = max(float((high - low).max()), 1.0)
    # a path walked straight ahead would leave a page without height
    half = np.maximum((high - low) / 2, 0.12 * size) + 0.06 * size
    center = (low + high) / 2
    return center - half, center + half
