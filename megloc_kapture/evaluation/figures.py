"""The report's figures, each as inline SVG: recall curves, errors against inliers, top view."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from numpy.typing import NDArray

from megloc_kapture.evaluation.evaluate import Evaluation
from megloc_kapture.evaluation.figure_style import (
    INK,
    MISS,
    MUTED,
    RASTER_ABOVE,
    colors_of,
    legend_below,
    legend_label,
    plain_ticks,
    styled_figure,
    to_svg,
)
from megloc_kapture.evaluation.tables import display_name
from megloc_kapture.evaluation.top_view import top_view
from megloc_kapture.geometry.poses import camera_centers, stack_poses
from megloc_kapture.values import RigidTransform

# errors below these are drawn at them: a logarithmic axis has no zero
_SMALLEST_POSITION_M = 1e-4
_SMALLEST_ANGLE_DEG = 1e-3


def recall_curves(evaluation: Evaluation) -> str:
    """Share of all queries at or below an error, against that error, per condition.

    Left the position error, right the angle; each ignores the other. The curves end below 1
    where queries have no pose. The thresholds stand as dotted lines.
    """
    positions = [t.position_m for t in evaluation.thresholds]
    angles = [t.angle_deg for t in evaluation.thresholds if t.angle_deg is not None]
    errors = evaluation.errors
    with styled_figure(10.5, 3.9) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        _curves(left, evaluation, errors.position_m, positions, _SMALLEST_POSITION_M)
        left.set(xlabel="position error (m)", ylabel="share of queries (%)")
        _curves(right, evaluation, errors.angle_deg, angles, _SMALLEST_ANGLE_DEG)
        right.set(xlabel="rotation error (deg)")
        handles, labels = left.get_legend_handles_labels()
        if len(labels) > 1:
            figure.legend(handles, labels, loc="outside lower center", ncols=8, fontsize=8)
        return to_svg(figure, "curves")


def _curves(
    axes: Axes,
    evaluation: Evaluation,
    errors: NDArray[np.float64],
    bounds: list[float],
    smallest: float,
) -> None:
    finite = np.clip(errors[np.isfinite(errors)], smallest, None)
    seen = np.concatenate([finite, np.clip(bounds, smallest, None)])
    low, high = (10.0 * smallest, 1.0) if not seen.size else (seen.min() / 1.5, seen.max() * 1.5)
    grid = np.unique(np.concatenate([np.geomspace(low, high, 400), bounds, [high]]))
    grid = grid[(grid >= low) & (grid <= high)]
    conditions = np.array([query.condition for query in evaluation.queries])
    colors = _condition_colors(evaluation)
    for name, color in colors.items():
        _curve(axes, errors[conditions == name], grid, display_name(name), color, "-")
    _curve(axes, errors, grid, "all", INK, (0, (4, 2)) if colors else "-")
    for bound in sorted(set(bounds)):
        axes.axvline(bound, color=MUTED, linewidth=0.9, linestyle=":", zorder=0)
    axes.set(xscale="log", xlim=(low, high), ylim=(0, 102))
    plain_ticks(axes.xaxis)


def _curve(
    axes: Axes,
    errors: NDArray[np.float64],
    grid: NDArray[np.float64],
    name: str,
    color: str,
    style: str | tuple[int, tuple[int, int]],
) -> None:
    within = np.searchsorted(np.sort(errors), grid, side="right")
    share = 100.0 * within / max(len(errors), 1)
    axes.step(grid, share, where="post", color=color, linestyle=style, label=legend_label(name))


def errors_against_inliers(evaluation: Evaluation) -> str | None:
    """Position error of every pose against the inliers it was estimated from.

    A good solver's errors fall to the right: many inliers and a large error are a wrong place
    believed in. None where no status table says how many inliers there were.
    """
    queries = [
        q for q in evaluation.queries if q.num_inliers is not None and np.isfinite(q.position_m)
    ]
    if not queries:
        return None
    inliers = np.array([q.num_inliers for q in queries], dtype=np.float64)
    errors = np.clip([q.position_m for q in queries], _SMALLEST_POSITION_M, None)
    guessed = np.array([q.outcome == "fallback" for q in queries])
    conditions = np.array([q.condition for q in queries])
    colors = _condition_colors(evaluation) or {"": INK}
    raster = len(queries) > RASTER_ABOVE
    with styled_figure(6.3, 4.3) as figure:
        axes = figure.subplots()
        for name, color in colors.items():
            mine = (conditions == name) & ~guessed
            label = legend_label(display_name(name)) if len(colors) > 1 else "localized"
            axes.scatter(
                inliers[mine], errors[mine], s=14, c=color, alpha=0.65, linewidths=0,
                label=label, rasterized=raster,
            )  # fmt: skip
        if guessed.any():
            axes.scatter(
                inliers[guessed], errors[guessed], s=22, c=MISS, marker="x", linewidths=1.2,
                label="fallback pose", rasterized=raster,
            )  # fmt: skip
        for bound in sorted({t.position_m for t in evaluation.thresholds}):
            axes.axhline(bound, color=MUTED, linewidth=0.9, linestyle=":", zorder=0)
        axes.set(xlabel="inliers", ylabel="position error (m)", yscale="log")
        axes.set_xscale("symlog", linthresh=10, linscale=0.4)
        axes.set_xlim(left=0)
        plain_ticks(axes.xaxis)
        plain_ticks(axes.yaxis)
        if len(colors) > 1 or guessed.any():
            legend_below(axes)
        return to_svg(figure, "inliers")


def map_from_above(
    evaluation: Evaluation, map_poses: Mapping[str, RigidTransform] | None = None
) -> tuple[str, int]:
    """Top view of map cameras, true and estimated centres, each error a line.

    The page spans the map and the truth; estimates beyond it are cut off.

    Returns
    -------
    svg : the figure.
    num_outside : estimates that lie outside the page.
    """
    truth_quats, truth_translations = stack_poses(evaluation.truth.values())
    truth = camera_centers(truth_quats, truth_translations)
    mapped_quats, mapped_translations = stack_poses((map_poses or {}).values())
    mapped = camera_centers(mapped_quats, mapped_translations)
    view = top_view(np.vstack([mapped_quats, truth_quats]), np.vstack([mapped, truth]))
    found = np.array([name in evaluation.estimated for name in evaluation.truth], dtype=bool)
    estimated = view.project(camera_centers(*stack_poses(evaluation.estimated.values())))
    mapped_2d, truth_2d = view.project(mapped), view.project(truth)
    low, high = _page(np.vstack([mapped_2d, truth_2d]))
    outside = ~((estimated >= low) & (estimated <= high)).all(axis=1)
    guessed = np.array([q.outcome == "fallback" for q in evaluation.queries], dtype=bool)[found]
    look = _Crowd(len(mapped) + len(truth))
    width, height = (high - low).tolist()
    with styled_figure(10.5, float(np.clip(10.0 * height / width, 3.0, 8.0)) + 0.6) as figure:
        axes = figure.subplots()
        if len(mapped_2d):
            look.dots(axes, mapped_2d, "map cameras", 10, c="#b8c4d0")
        lines = np.stack([truth_2d[found], estimated], axis=1)
        axes.add_collection(LineCollection(list(lines), colors=MISS, linewidths=1.0, alpha=0.8))
        look.dots(axes, truth_2d[found], "truth", 26, facecolors="none", edgecolors="#009e73")
        look.dots(axes, estimated[~guessed], "estimated", 7, c="#0072b2", linewidths=0)
        if guessed.any():
            look.dots(axes, estimated[guessed], "fallback pose", 20, c=MISS, marker="x")
        if not found.all():
            look.dots(axes, truth_2d[~found], "truth, no pose", 30, c=MISS, marker="+")
        axes.set_aspect("equal")
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.set(xlabel=f"{view.labels[0]} (m)", ylabel=f"{view.labels[1]} (m)")
        figure.legend(loc="outside lower center", ncols=5, fontsize=8)
        return to_svg(figure, "above"), int(outside.sum())


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


def _page(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower left and upper right corner around points (N, 2), with a margin; never flat."""
    low, high = points.min(axis=0), points.max(axis=0)
    size = max(float((high - low).max()), 1.0)
    # a path walked straight ahead would leave a page without height
    half = np.maximum((high - low) / 2, 0.12 * size) + 0.06 * size
    center = (low + high) / 2
    return center - half, center + half


def _condition_colors(evaluation: Evaluation) -> dict[str, str]:
    """A colour for each condition, in the order of the table; empty where there is none."""
    present = {query.condition for query in evaluation.queries}
    if present == {""}:
        return {}
    return colors_of([row.name for row in evaluation.rows if row.name in present])
