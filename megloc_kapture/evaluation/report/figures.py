"""Figures of reports as SVG."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from megloc_kapture.evaluation.metrics import Confidence
from megloc_kapture.evaluation.report.queries import frame_of_query, top_view
from megloc_kapture.evaluation.results import Poses
from megloc_kapture.evaluation.scoring import Evaluation, QueryResult
from megloc_kapture.geometry.poses import camera_centers, stack_poses
from megloc_kapture.values import RigidTransform

_INK, _MUTED, _MISS = "#1f2933", "#9aa5b1", "#c0262d"
# six colours of Okabe and Ito's colour-blind-safe palette, and four more for RobotCar's conditions
_PALETTE = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"),
    *("#7a5195", "#8c6d31", "#5f6b7a", "#9a1750"),
)
# scatter plots with more points are rasterized inside the SVG
_RASTER_ABOVE = 3000
# smaller errors are clipped to these, because a logarithmic axis has no zero
_SMALLEST_POSITION_M, _SMALLEST_ANGLE_DEG = 1e-4, 1e-3

_STYLE: dict[Any, Any] = {
    "axes.edgecolor": "#cbd2d9",
    "axes.grid": True,
    "axes.prop_cycle": cycler(color=_PALETTE),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "figure.constrained_layout.use": True,
    "font.size": 9,
    "grid.color": "#e4e7eb",
    "grid.linewidth": 0.6,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "megloc",  # reproducible bytes
    "text.parse_math": False,  # a "$" in the name of a condition is a dollar
}


@contextmanager
def _figure(width: float, height: float) -> Iterator[Figure]:
    with matplotlib.rc_context(rc=matplotlib.rcParamsDefault), warnings.catch_warnings():
        # names may have characters that matplotlib's font lacks
        warnings.filterwarnings("ignore", message="Glyph")
        matplotlib.rcParams.update(_STYLE)
        figure = Figure(figsize=(width, height))
        FigureCanvasSVG(figure)
        yield figure


def _svg(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def _label(name: str) -> str:
    return f" {name}" if name.startswith("_") else name or "(no condition)"


def _plain_ticks(axes: Axes) -> None:
    for axis, scale in ((axes.xaxis, axes.get_xscale()), (axes.yaxis, axes.get_yscale())):
        if scale != "linear":
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())


def error_curves(evaluations: Sequence[Evaluation]) -> bytes:
    """Plot the share of queries at or below an error, per condition or per result."""
    first = evaluations[0]
    thresholds = first.thresholds
    angles = [t.angle_deg for t in thresholds if t.angle_deg is not None]
    with _figure(10.5, 3.9) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        for axes, kind, bounds, smallest in (
            (left, "position_m", [t.position_m for t in thresholds], _SMALLEST_POSITION_M),
            (right, "angle_deg", angles, _SMALLEST_ANGLE_DEG),
        ):
            curves = {e.label: getattr(e.errors, kind) for e in evaluations}
            if not evaluations[1:]:
                errors = getattr(first.errors, kind)
                curves = {name: errors[rows] for name, rows in first.members.items()}
            pooled = np.concatenate([*curves.values(), bounds]).clip(smallest)
            finite = pooled[np.isfinite(pooled)]
            low, high = (
                (smallest, 1.0) if not finite.size else (finite.min() / 1.5, finite.max() * 1.5)
            )
            for name, errors in curves.items():
                total = len(curves) > 1 and name == "all"
                values = np.sort(errors[np.isfinite(errors)].clip(smallest))
                share = 100.0 * np.arange(len(values) + 1) / max(len(errors), 1)
                axes.step(
                    [low, *values, high],
                    [*share, share[-1]],
                    where="post",
                    label=_label(name),
                    **({"color": _INK, "linestyle": "--"} if total else {}),
                )
            for bound in bounds:
                axes.axvline(bound, color=_MUTED, linewidth=0.9, linestyle=":", zorder=0)
            axes.set(xscale="log", xlim=(low, high), ylim=(0, 102))
            _plain_ticks(axes)
        left.set(xlabel="position error (m)", ylabel="share of queries (%)")
        right.set(xlabel="rotation error (deg)")
        handles, labels = left.get_legend_handles_labels()
        if len(labels) > 1:
            columns = 8 if sum(map(len, labels)) < 90 else 3
            figure.legend(handles, labels, loc="outside lower center", ncols=columns)
        return _svg(figure)


def errors_against_inliers(evaluation: Evaluation) -> bytes | None:
    """Plot position errors against inliers; return None if no inliers are known."""
    known = [
        q for q in evaluation.queries if q.num_inliers is not None and np.isfinite(q.position_m)
    ]
    if not known:
        return None
    with _figure(6.3, 4.0) as figure:
        axes = figure.subplots()
        for outcome, color, marker in (("localized", _PALETTE[0], "."), ("fallback", _MISS, "x")):
            chosen = [q for q in known if q.outcome == outcome]
            axes.scatter(
                [q.num_inliers or 0 for q in chosen],
                np.clip([q.position_m for q in chosen], _SMALLEST_POSITION_M, None),
                c=color,
                marker=marker,
                alpha=0.65,
                label=f"{outcome} pose",
                rasterized=len(known) > _RASTER_ABOVE,
            )
        for threshold in evaluation.thresholds:
            axes.axhline(threshold.position_m, color=_MUTED, linewidth=0.9, linestyle=":")
        axes.set(xlabel="inliers", ylabel="position error (m)", yscale="log")
        axes.set_xscale("symlog", linthresh=10, linscale=0.4)
        axes.set_xlim(left=0)
        _plain_ticks(axes)
        if any(q.outcome == "fallback" for q in known):
            axes.legend()
        return _svg(figure)


def confidence_curves(confidence: Confidence) -> bytes:
    with _figure(10.5, 4.0) as figure:
        reliability, curve = figure.subplots(1, 2)
        reliability.plot([0, 100], [0, 100], color=_MUTED, linewidth=0.9, linestyle=":")
        filled = [b for b in confidence.bins if b.num_poses]
        mean = 100 * np.array([b.mean_confidence for b in filled])
        share = 100 * np.array([b.share_right for b in filled])
        reliability.plot(mean, share, "o-", color=_INK, markersize=5)
        for x, y, b in zip(mean, share, filled, strict=True):
            where: dict[str, Any] = {"xytext": (0, 6), "textcoords": "offset points"}
            reliability.annotate(str(b.num_poses), (x, y), ha="center", fontsize=7, **where)
        reliability.set(xlabel="confidence (%)", ylabel="correct poses (%)")
        reliability.set(xlim=(-2, 104), ylim=(-2, 110))
        coverage, risk = 100 * np.array(confidence.coverage), 100 * np.array(confidence.risk)
        curve.step(coverage, risk, where="post", color=_INK)
        curve.set(
            xlabel="queries with an accepted pose (%)",
            ylabel="wrong poses among them (%)",
            xlim=(0, 102),
        )
        curve.set(ylim=(0, max(5.0, 1.1 * float(risk.max(initial=0.0)))))
        return _svg(figure)


def views_from_above(
    queries: Sequence[QueryResult], map_poses: Poses, frames: Mapping[str, str], unit: str
) -> dict[str, bytes]:
    """Plot map cameras, true and estimated positions from above, per coordinate frame.

    ``frames`` maps images to frames, if the dataset has several.
    """

    figures = {}
    mapped = {name: frames.get(name, "") for name in map_poses}
    names = sorted(set(mapped.values())) or [""]
    of_query = [frame_of_query(query, frames) for query in queries]
    of_query = [frame if frame in names else names[0] for frame in of_query]
    for name in names:
        in_frame = [query for query, frame in zip(queries, of_query, strict=True) if frame == name]
        poses = [map_poses[image] for image, frame in mapped.items() if frame == name]
        if any(query.cam_from_world or query.truth for query in in_frame):
            figures[name] = _from_above(in_frame, poses, unit)
    return figures


def _from_above(queries: Sequence[QueryResult], mapped: list[RigidTransform], unit: str) -> bytes:
    true = [query.truth for query in queries if query.truth is not None]
    posed = [query for query in queries if query.cam_from_world is not None]
    # a wrong estimate must not shrink the map to a dot
    spanning = mapped + true or [query.cam_from_world for query in posed if query.cam_from_world]
    quats, translations = stack_poses(spanning)
    axes_of_page, labels = top_view(quats, camera_centers(quats, translations))

    def page_xy(poses: Sequence[RigidTransform | None]) -> NDArray[np.float64]:
        return camera_centers(*stack_poses([pose for pose in poses if pose])) @ axes_of_page.T

    points = page_xy(spanning)
    low, high = points.min(axis=0), points.max(axis=0)
    size = max(float((high - low).max()), 1.0)
    # a straight path must not give a figure of zero height
    half = np.maximum((high - low) / 2, 0.12 * size) + 0.06 * size
    low, high = (low + high) / 2 - half, (low + high) / 2 + half
    number = len(mapped) + len(queries)
    shrink, raster = float(np.clip(np.sqrt(800 / number), 0.3, 1.0)), number > _RASTER_ABOVE

    def dots(poses: Sequence[RigidTransform | None], size: float, label: str, **style: Any) -> None:
        if len(poses):
            xy = page_xy(poses)
            style = {"linewidths": 1.3 * shrink, "rasterized": raster, **style}
            axes.scatter(xy[:, 0], xy[:, 1], s=size * shrink, label=label, **style)

    width, height = (high - low).tolist()
    with _figure(10.5, float(np.clip(10.0 * height / width, 3.0, 6.5)) + 0.6) as figure:
        axes = figure.subplots()
        dots(mapped, 10, "map cameras", c="#b8c4d0")
        joined = [query for query in posed if query.truth is not None]
        ends = [page_xy([getattr(q, kind) for q in joined]) for kind in ("truth", "cam_from_world")]
        segments = list(np.stack(ends, axis=1))
        axes.add_collection(LineCollection(segments, colors=_MISS, rasterized=raster, alpha=0.6))
        green: dict[str, Any] = {"facecolors": "none", "edgecolors": "#009e73"}
        dots([query.truth for query in joined], 26, "truth", **green)
        localized = [q.cam_from_world for q in posed if q.outcome == "localized"]
        guessed = [q.cam_from_world for q in posed if q.outcome == "fallback"]
        lost = [q.truth for q in queries if q.cam_from_world is None and q.truth is not None]
        dots(localized, 7, "estimated", c=_PALETTE[0], linewidths=0)
        dots(guessed, 20, "fallback pose", c=_MISS, marker="x")
        dots(lost, 30, "truth, no pose", c=_MISS, marker="+")
        axes.set_aspect("equal")
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.set(xlabel=f"{labels[0]} ({unit})", ylabel=f"{labels[1]} ({unit})")
        figure.legend(loc="outside lower center", ncols=5)
        return _svg(figure)
