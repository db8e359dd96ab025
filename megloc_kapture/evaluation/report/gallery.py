"""The queries of a report one by one: small pictures with their inliers, and the table."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence

from markupsafe import Markup

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.metrics import within
from megloc_kapture.evaluation.report.document import (
    Block,
    Card,
    Cards,
    Cell,
    Paragraph,
    Table,
    column,
)
from megloc_kapture.evaluation.report.pictures import dotted, read_small
from megloc_kapture.evaluation.report.queries import order_of_badness
from megloc_kapture.evaluation.report.shown_queries import ShownQuery, StoredInliers, spread
from megloc_kapture.evaluation.report.wording import format_degrees, format_metres
from megloc_kapture.evaluation.scoring import Evaluation

# a picture takes about 10 kB and, of a large photograph, 50 ms
MAX_PICTURES = 120
_SIZE = (200, 150)
_MAX_DOTS = 120
_DOT = "#3dff7c"
# more rows than anybody reads; the CSV beside the report has them all
_MAX_ROWS = 500
# of the best, of the typical and of the worst, which come first
_EACH = 3


def gallery_blocks(stored: StoredInliers, queries: Sequence[ShownQuery]) -> tuple[Block, ...]:
    """The pictures of queries; nothing where no image can be shown.

    Three of the best, of the typical and of the worst stand first, then the others, the worst
    first. Of more than 120 queries these nine, the worst half of the others, and some of the rest.

    Parameters
    ----------
    stored : their images and inliers.
    queries : worst first.
    """
    folder = stored.context.queries
    if folder is None or not queries:
        return ()
    first, others = _first(queries)
    shown = first + [(query, "") for query in _some(others, MAX_PICTURES - len(first))]
    cards = []
    for query, role in shown:
        picture = None
        with contextlib.suppress(DataError):
            path = folder.image_path(query.image)
            picture = read_small(path, width=_SIZE[0], height=_SIZE[1])
        if picture is None:
            continue
        pixels = stored.of(query)[0]
        pixels = pixels[spread(len(pixels), _MAX_DOTS)]
        element = dotted(picture, pixels, _DOT, query.name)
        outcome = "no pose" if query.estimated is None else query.outcome
        sort = {
            "error": query.position_m,
            "inliers": query.num_inliers,
            "confidence": query.confidence,
        }
        known = {name: float(value) for name, value in sort.items() if value is not None}
        cards.append(
            Card(query.name, element, tuple(query.facts()), role, query.condition, outcome, known)
        )
    if not cards:
        return ()
    told = "The best, typical and worst ones first. " if first else "The worst first. "
    if len(queries) > len(shown):
        told += f"{len(shown)} of {len(queries)} queries; the table below has more. "
    dots = any("<path" in card.element for card in cards)
    if dots:
        told += "Dots: inliers, matches whose point lies within 12 pixels under the estimated pose."
    return Paragraph(told.strip()), Cards(tuple(cards))


def _first(
    queries: Sequence[ShownQuery],
) -> tuple[list[tuple[ShownQuery, str]], list[ShownQuery]]:
    """The best, the typical and the worst with what each is, and the other queries."""
    number = len(queries)
    if number < 4 * _EACH:
        return [], list(queries)
    middle = (number - _EACH) // 2
    chosen = {
        **{number - 1 - k: "best" for k in range(_EACH)},
        **{middle + k: "typical" for k in range(_EACH)},
        **{k: "worst" for k in range(_EACH)},
    }
    others = [query for at, query in enumerate(queries) if at not in chosen]
    return [(queries[at], role) for at, role in chosen.items()], others


def _some(queries: Sequence[ShownQuery], most: int) -> list[ShownQuery]:
    """The worst, up to half of what there is room for, and some of the rest evenly spread."""
    if len(queries) <= most:
        return list(queries)
    worst = most // 2
    rest = queries[worst:]
    return [*queries[:worst], *(rest[at] for at in spread(len(rest), most - worst))]


def query_table(evaluation: Evaluation) -> tuple[Table, int]:
    """The worst 500 queries, those without a pose first, then by falling error, then by name.

    Returns
    -------
    The table, and the number of queries that are left out.
    """
    by_center = evaluation.by_center
    met = [within(evaluation.errors, threshold) for threshold in evaluation.thresholds]
    centers_m = (by_center or evaluation).errors.position_m.tolist()
    queries = evaluation.queries
    ranked = sorted(range(len(queries)), key=lambda i: order_of_badness(queries[i]))[:_MAX_ROWS]
    rows = [queries[i] for i in ranked]
    outcomes = {"missing": "no pose"}

    def dots(index: int) -> Cell:
        marks = ("●" if own[index] else Markup("<i>○</i>") for own in met)
        return Cell("", page=Markup("").join(marks), style="c dots")

    columns = [
        column("#", range(len(rows)), lambda n: Cell(str(n + 1), style="soft"), kind="count"),
        column("image", rows, lambda row: Cell(row.image, style="name")),
        column("condition", rows, lambda row: row.condition),
        column(
            "outcome",
            rows,
            lambda row: Cell(outcomes.get(row.outcome, row.outcome), style=row.outcome),
        ),
        column("met", ranked, dots),
        column(
            "position (m)" if by_center is None else "relative (m)",
            rows,
            lambda row: _if_finite(row.position_m, format_metres),
            kind="count",
        ),
        column(
            "centre (m)",
            ranked,
            lambda index: _if_finite(centers_m[index], format_metres),
            kind="count",
        ),
        column(
            "angle (deg)",
            rows,
            lambda row: _if_finite(row.angle_deg, format_degrees),
            kind="count",
        ),
        column("inliers", rows, lambda row: _if_known(row.num_inliers), kind="count"),
        column("matches", rows, lambda row: _if_known(row.num_matches), kind="count"),
        column("confidence", rows, lambda row: _if_confident(row.confidence), kind="count"),
        column("reason", rows, lambda row: row.reason),
    ]
    empty = set() if any(query.condition for query in queries) else {"condition"}
    if by_center is None:
        empty.add("centre (m)")
    if all(query.num_inliers is None for query in queries):
        empty |= {"inliers", "matches"}
    if all(query.confidence is None for query in queries):
        empty.add("confidence")
    shown = tuple(own for own in columns if own.heading not in empty)
    return Table(shown, tall=True), max(len(queries) - _MAX_ROWS, 0)


def _if_finite(value: float, form: Callable[[float], str]) -> str:
    return form(value) if math.isfinite(value) else ""


def _if_known(count: int | None) -> str:
    return "" if count is None else str(count)


def _if_confident(confidence: float | None) -> str:
    return "" if confidence is None else f"{confidence:.2f}"
