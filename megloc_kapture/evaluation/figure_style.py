"""How the report's figures look, and their way into HTML: inline SVG with reproducible bytes."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

# Okabe and Ito's palette: told apart with any colour vision, in print too; then four more, for
# RobotCar has nine conditions
PALETTE = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"),
    *("#7a5195", "#8c6d31", "#5f6b7a", "#9a1750"),
)
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


def to_svg(figure: Figure, prefix: str) -> str:
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
    return re.sub(r"<[^>]*>", lambda tag: _prefix_ids(tag[0], prefix), svg)


def _prefix_ids(tag: str, prefix: str) -> str:
    return re.sub(r'(\sid="|href="#|url\(#)', rf"\g<1>{prefix}-", tag)


def legend_label(name: str) -> str:
    """``name`` as matplotlib shows it: one that starts with an underscore would be left out."""
    return f" {name}" if name.startswith("_") else name


def colors_of(names: Sequence[str]) -> dict[str, str]:
    """A colour for each name, in order; they come again where there are more than ten."""
    return {name: PALETTE[i % len(PALETTE)] for i, name in enumerate(names)}


def plain_ticks(axis: Axis) -> None:
    """Numbers as people write them (0.01, 100) on a logarithmic axis, at its powers of ten only."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def legend_below(axes: Axes, columns: int = 4) -> None:
    """A legend under the axes, where it hides no data."""
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=columns, fontsize=8)
