"""Figures of errors as inline SVG with reproducible bytes: recall, errors against inliers."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from megloc_kapture.evaluation.confidence import Confidence
from megloc_kapture.evaluation.metrics import ALL, Threshold
from megloc_kapture.evaluation.report.tables import PALETTE, colors_of
from megloc_kapture.evaluation.report.wording import display_name
from megloc_kapture.evaluation.scoring import Evaluation

INK = "#1f2933"
MUTED = "#9aa5b1"
MISS = "#c0262d"

# above this many points a scatter is stored as pixels inside the SVG
RASTER_ABOVE = 3000

_STYLE: dict[Any, Any] = {
    "axes.edgecolor": "#cbd2d9",
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.prop_cycle": cycler(color=PALETTE),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "figure.constrained_layout.use": True,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9,
    "grid.color": "#e4e7eb",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.8,
    "svg.fonttype": "none",
    "svg.hashsalt": "megloc",
    "text.color": INK,
    "text.parse_math": False,  # a "$" in the name of a condition is a dollar
    "xtick.color": "#52606d",
    "ytick.color": "#52606d",
}


@contextmanager
def styled_figure(width: float, height: float) -> Iterator[Figure]:
    """A figure of ``width`` x ``height`` inches, with our style while the block lasts.

    It is bound to no window and no global state of pyplot.
    """
    # rc_context alone would inherit what a user's matplotlibrc says about everything else
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        figure = Figure(figsize=(width, height))
        FigureCanvasSVG(figure)
        yield figure


def to_svg(figure: Figure, prefix: str) -> Markup:
    """The figure as an ``<svg>`` element; call inside :func:`styled_figure`.

    ``prefix`` goes before every id, since several figures share one HTML page. The same figure
    gives the same text.
    """
    buffer = io.StringIO()
    with warnings.catch_warnings():
        # names in scripts that matplotlib's own font lacks are drawn by the browser
        warnings.filterwarnings("ignore", message="Glyph")
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    # inside tags only: the text of a label may look like anything
    ids = re.compile(r'(\sid="|href="#|url\(#)')
    return Markup(re.sub(r"<[^>]*>", lambda tag: ids.sub(rf"\g<1>{prefix}-", tag[0]), svg))


def _legend_label(name: str) -> str:
    """``name`` as matplotlib shows it: one that starts with an underscore would be left out."""
    return f" {name}" if name.startswith("_") else name


def _plain_ticks(axis: Axis) -> None:
    """Numbers as people write them (0.01, 100) on a logarithmic axis, at its powers of ten only."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _legend(figure: Figure, axes: Axes) -> None:
    """One legend below all panels; none of a single curve."""
    handles, labels = axes.get_legend_handles_labels()
    if len(labels) > 1:
        columns = 8 if sum(map(len, labels)) < 90 else 3
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=8)


# errors below these are drawn at them: a logarithmic axis has no zero
_SMALLEST_POSITION_M = 1e-4
_SMALLEST_ANGLE_DEG = 1e-3


@dataclass(frozen=True)
class Series:
    """One curve: errors (N,), infinite without a pose, and how it is drawn."""

    name: str
    errors: NDArray[np.float64]
    color: str
    style: str | tuple[int, tuple[int, int]] = "-"


def recall_curves(evaluation: Evaluation) -> Markup:
    """Share of all queries at or below an error, against that error, per condition.

    Left the position error, right the angle; each ignores the other. The curves end below 1
    where queries have no pose. The thresholds stand as dotted lines.
    """
    colors = _condition_colors(evaluation)
    conditions = np.array([query.condition for query in evaluation.queries])
    errors = evaluation.errors
    panels = []
    for values in (errors.position_m, errors.angle_deg):
        series = [
            Series(display_name(name), values[conditions == name], color)
            for name, color in colors.items()
        ]
        panels.append([*series, Series("all", values, INK, (0, (4, 2)) if colors else "-")])
    return _two_panels(panels, evaluation.thresholds)


def compared_curves(evaluations: Sequence[Evaluation]) -> Markup:
    """The curves of several results, over all queries; else as :func:`recall_curves`."""
    colors = colors_of([evaluation.label for evaluation in evaluations])
    panels = [
        [Series(e.label, getattr(e.errors, kind), colors[e.label]) for e in evaluations]
        for kind in ("position_m", "angle_deg")
    ]
    return _two_panels(panels, evaluations[0].thresholds)


def curves_by_row(evaluations: Sequence[Evaluation]) -> Markup | None:
    """A small panel of position error per condition or pool, several results in each.

    None where there are no conditions.
    """
    rows = [name for name in evaluations[0].members if name != ALL]
    if not rows:
        return None
    colors = colors_of([evaluation.label for evaluation in evaluations])
    bounds = [threshold.position_m for threshold in evaluations[0].thresholds]
    across = min(len(rows), 3)
    down = -(-len(rows) // across)
    every = np.concatenate([evaluation.errors.position_m for evaluation in evaluations])
    with styled_figure(10.5, 2.5 * down + 0.4) as figure:
        panels = figure.subplots(down, across, sharey=True, squeeze=False).ravel()
        for axes in panels[len(rows) :]:
            axes.set_axis_off()
        for name, axes in zip(rows, panels, strict=False):
            series = [
                Series(e.label, e.errors.position_m[e.members[name]], colors[e.label])
                for e in evaluations
            ]
            _draw_curves(axes, series, bounds, _SMALLEST_POSITION_M, span=every)
            axes.set_title(display_name(name))
        for axes in panels[max(len(rows) - across, 0) : len(rows)]:
            axes.set_xlabel("position error (m)")
        for axes in panels[::across]:
            axes.set_ylabel("queries (%)")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
        return to_svg(figure, "rows")


def _two_panels(panels: Sequence[Sequence[Series]], thresholds: Sequence[Threshold]) -> Markup:
    """Position errors on the left, angles on the right, one legend below both."""
    positions = [t.position_m for t in thresholds]
    angles = [t.angle_deg for t in thresholds if t.angle_deg is not None]
    with styled_figure(10.5, 3.9) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        _draw_curves(left, panels[0], positions, _SMALLEST_POSITION_M)
        left.set(xlabel="position error (m)", ylabel="share of queries (%)")
        _draw_curves(right, panels[1], angles, _SMALLEST_ANGLE_DEG)
        right.set(xlabel="rotation error (deg)")
        _legend(figure, left)
        return to_svg(figure, "curves")


def _draw_curves(
    axes: Axes,
    series: Sequence[Series],
    bounds: Sequence[float],
    smallest: float,
    *,
    span: NDArray[np.float64] | None = None,
) -> None:
    """Cumulative curves on a logarithmic axis that spans the errors (or those of ``span``)."""
    errors = np.concatenate([one.errors for one in series]) if span is None else span
    finite = np.clip(errors[np.isfinite(errors)], smallest, None)
    seen = np.concatenate([finite, np.clip(bounds, smallest, None)])
    low, high = (10.0 * smallest, 1.0) if not seen.size else (seen.min() / 1.5, seen.max() * 1.5)
    grid = np.unique(np.concatenate([np.geomspace(low, high, 400), bounds, [high]]))
    grid = grid[(grid >= low) & (grid <= high)]
    for one in series:
        within = np.searchsorted(np.sort(one.errors), grid, side="right")
        share = 100.0 * within / max(len(one.errors), 1)
        (line,) = axes.step(grid, share, where="post", color=one.color, linestyle=one.style)
        line.set_label(_legend_label(one.name))
    for bound in sorted(set(bounds)):
        axes.axvline(bound, color=MUTED, linewidth=0.9, linestyle=":", zorder=0)
    axes.set(xscale="log", xlim=(low, high), ylim=(0, 102))
    _plain_ticks(axes.xaxis)


def recall_intervals(evaluations: Sequence[Evaluation]) -> Markup:
    """Recall of several results with its confidence interval: a panel per threshold, a line per
    condition, pool and ``all``."""
    colors = colors_of([evaluation.label for evaluation in evaluations])
    rows = list(evaluations[0].members)
    thresholds = evaluations[0].thresholds
    number = len(evaluations)
    lowest = min(at.low for e in evaluations for row in e.rows for at in row.recall)
    left = 10.0 * np.floor(10.0 * lowest)
    height = len(rows) * max(0.34, 0.17 * number) + 1.2
    with styled_figure(10.5, height) as figure:
        panels = figure.subplots(1, len(thresholds), sharey=True, squeeze=False)[0]
        for index, (threshold, axes) in enumerate(zip(thresholds, panels, strict=True)):
            for order, evaluation in enumerate(evaluations):
                at = [row.recall[index] for row in evaluation.rows]
                recall = 100.0 * np.array([one.recall for one in at])
                ends = 100.0 * np.array([[one.low, one.high] for one in at])
                # between the lines of the grid, in the order of the legend from above
                y = np.arange(len(rows)) + (order - (number - 1) / 2) * 0.7 / number
                color = colors[evaluation.label]
                axes.hlines(y, ends[:, 0], ends[:, 1], color=color, linewidth=1.6, alpha=0.55)
                label = _legend_label(evaluation.label)
                axes.plot(recall, y, "o", color=color, markersize=4.5, label=label)
            axes.set(title=str(threshold), xlim=(left - 2, 102), xlabel="recall (%)")
            axes.grid(False, axis="y")
        panels[0].set_yticks(range(len(rows)), [display_name(name) for name in rows])
        panels[0].set_ylim(len(rows) - 0.5, -0.5)
        _legend(figure, panels[0])
        return to_svg(figure, "recall")


def errors_against_inliers(evaluation: Evaluation, *, prefix: str = "inliers") -> Markup | None:
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
            label = _legend_label(display_name(name)) if len(colors) > 1 else "localized"
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
        _plain_ticks(axes.xaxis)
        _plain_ticks(axes.yaxis)
        if len(colors) > 1 or guessed.any():
            # under the axes, where it hides no data
            axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=4, fontsize=8)
        return to_svg(figure, prefix)


def confidence_curves(confidence: Confidence) -> Markup:
    """The reliability diagram, and the risk against the coverage."""
    with styled_figure(10.5, 4.0) as figure:
        reliability, curve = figure.subplots(1, 2)
        reliability.plot([0, 100], [0, 100], color=MUTED, linewidth=0.9, linestyle=":")
        filled = [one for one in confidence.bins if one.num_poses]
        mean = 100 * np.array([one.mean_confidence for one in filled])
        share = 100 * np.array([one.share_right for one in filled])
        reliability.plot(mean, share, "o-", color=INK, markersize=5)
        for x, y, one in zip(mean, share, filled, strict=True):
            reliability.annotate(
                str(one.num_poses), (x, y), xytext=(0, 6), textcoords="offset points",
                ha="center", fontsize=7, color=MUTED,
            )  # fmt: skip
        reliability.set(
            xlabel="confidence (%)", ylabel="right poses (%)", xlim=(-2, 104), ylim=(-2, 110)
        )
        coverage, risk = 100 * np.array(confidence.coverage), 100 * np.array(confidence.risk)
        curve.step(coverage, risk, where="post", color=INK)
        curve.set(
            xlabel="queries answered (%)", ylabel="wrong among them (%)", xlim=(0, 102),
            ylim=(0, max(5.0, 1.1 * float(risk.max(initial=0.0)))),
        )  # fmt: skip
        return to_svg(figure, "confidence")


def _condition_colors(evaluation: Evaluation) -> dict[str, str]:
    """A colour for each condition, in the order of the table; empty where there is none."""
    present = {query.condition for query in evaluation.queries}
    if present == {""}:
        return {}
    return colors_of([row.name for row in evaluation.rows if row.name in present])
