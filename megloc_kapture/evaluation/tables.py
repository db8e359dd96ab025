"""The recall table as text, in the style of papers: ``89.8 / 96.1 / 99.4``."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence

from megloc_kapture.evaluation.evaluate import Evaluation
from megloc_kapture.evaluation.recall import RecallAt, RecallRow
from megloc_kapture.evaluation.thresholds import Threshold

NO_CONDITION = "(no condition)"
_MAX_NAME_WIDTH = 19
_NOTE_WIDTH = 92
_NAMES_SHOWN = 5
INTERVALS = "95 % confidence intervals of recall, queries taken as independent"


def format_percent(recall: float) -> str:
    """Recall as papers print it: percent with one decimal."""
    return f"{100.0 * recall:.1f}"


def format_recall(row: RecallRow) -> str:
    """Recall at all thresholds: ``89.8 / 96.1 / 99.4``."""
    return " / ".join(format_percent(at.recall) for at in row.recall)


def format_share(count: int, total: int) -> str:
    """A part of a whole in percent; ``-`` of nothing."""
    return format_percent(count / total) if total else "-"


def format_metres(position_m: float) -> str:
    """Metres down to a tenth of a millimetre where that is small, to a centimetre where not."""
    return f"{position_m:.4f}" if position_m < 1 else f"{position_m:.2f}"


def format_degrees(angle_deg: float) -> str:
    """Degrees to a thousandth below 1, to a hundredth above."""
    return f"{angle_deg:.3f}" if angle_deg < 1 else f"{angle_deg:.2f}"


def format_interval(at: RecallAt) -> str:
    """The confidence interval of a recall in percent: ``87.5-91.8``."""
    return f"{format_percent(at.low)}-{format_percent(at.high)}"


def format_p(p_value: float) -> str:
    """A p-value with as many digits as mean something."""
    return "p < 0.001" if p_value < 0.001 else f"p = {p_value:.2g}"


def criterion(thresholds: Sequence[Threshold], *, relative: bool = False) -> str:
    """How recall is counted, in one sentence."""
    with_angles = any(threshold.angle_deg is not None for threshold in thresholds)
    what = "Both errors" if with_angles else "Position error"
    if relative:
        what = "Error of the translation relative to the given reference"
    return f"{what} at or below (<=) the threshold; a query without a pose counts as a miss."


_GUESSES = {
    "retrieval": "of the best retrieved image",
    "rig": "that another camera of the rig gives them",
}


def notes(evaluation: Evaluation) -> list[str]:
    """What a reader must know beside the table: fallbacks, images without truth, no overlap."""
    row = evaluation.row()
    said = []
    kinds = {query.fallback for query in evaluation.queries} - {"none"}
    if row.num_fallback:
        whose = " or the one ".join(_GUESSES[kind] for kind in sorted(kinds))
        said.append(
            f"{counted(row.num_fallback, 'query', 'queries')} could not be localized and "
            f"{_verb(row.num_fallback, 'bears', 'bear')} the pose {whose} "
            "instead; recall and the median of all count it as any pose"
        )
    if row.num_missing == row.num_queries:
        said.append("no query has a pose")
    missing = evaluation.without_truth
    if missing:
        shown = ", ".join(missing[:_NAMES_SHOWN]) + (", ..." if missing[_NAMES_SHOWN:] else "")
        said.append(
            f"{counted(len(missing), 'image has', 'images have')} no true pose and "
            f"{_verb(len(missing), 'is', 'are')} not counted: {shown}"
        )
        if evaluation.truth_known_by:
            said.append(evaluation.truth_known_by.rstrip("."))
        if not evaluation.estimated and row.num_missing == row.num_queries:
            said.append("no estimated image is in the ground truth: do the names agree?")
    if evaluation.not_scored:
        said.append(
            f"{counted(len(evaluation.not_scored), 'image', 'images')} with a true pose "
            f"{_verb(len(evaluation.not_scored), 'is', 'are')} not scored by this benchmark"
        )
    return said


def recall_table(evaluation: Evaluation) -> str:
    """The whole table with its heading and notes, plain ASCII, ended by a newline.

    Conditions are rows; the row ``all`` stands below a line. At most 100 columns wide with the
    usual three or four thresholds. The confidence intervals follow in a table of their own, so
    that the first can be copied into a paper.
    """
    by_center = evaluation.by_center
    lines = [evaluation.label, ""] if evaluation.label else []
    lines += [f"recall (%) at {bounds(evaluation.thresholds)}"]
    lines += [*wrapped(criterion(evaluation.thresholds, relative=by_center is not None)), ""]
    lines += _table(evaluation)
    if by_center is not None:
        lines += ["", "the same by the distance of the camera centres", ""]
        lines += _table(by_center)
    lines += ["", f"{INTERVALS}, (%)", *interval_lines(evaluation.rows)]
    for note in notes(evaluation):
        lines += ["", *wrapped(f"Note: {note}.")]
    return "\n".join(lines) + "\n"


def bounds(thresholds: Sequence[Threshold]) -> str:
    """All thresholds, as a heading has them."""
    return " / ".join(str(threshold) for threshold in thresholds)


def wrapped(text: str) -> list[str]:
    """A sentence as lines that fit the tables."""
    return textwrap.wrap(text, width=_NOTE_WIDTH, break_long_words=False, break_on_hyphens=False)


def interval_lines(rows: Sequence[RecallRow]) -> list[str]:
    """The confidence intervals of a table's rows, one line each."""
    return triples(
        (shortened(display_name(row.name)), [format_interval(at) for at in row.recall])
        for row in rows
    )


def triples(rows: Iterable[tuple[str, Sequence[str]]]) -> list[str]:
    """Lines of a name and one cell per threshold: ``day  87.5-91.8 / 94.5-97.3``."""
    cells = [(name, *entries) for name, entries in rows]
    widths = [max(len(line[i]) for line in cells) for i in range(len(cells[0]))]
    lines = []
    for name, *entries in cells:
        padded = [entry.ljust(width) for entry, width in zip(entries, widths[1:], strict=True)]
        lines.append(f"{name.ljust(widths[0])}  {' / '.join(padded)}".rstrip())
    return lines


def _table(evaluation: Evaluation) -> list[str]:
    first = "condition" if evaluation.rows[1:] else ""
    above = ("", "", "", "", "median error (m, deg)", "")
    head = (first, "queries", "localized", "recall (%)", "of all", "of localized")
    body = [cells_of(row) for row in evaluation.rows]
    widths = [max(len(line[i]) for line in (head, *body)) for i in range(len(head))]
    rule = "-" * (sum(widths) + 2 * (len(widths) - 1))
    lines = [aligned(above, widths), aligned(head, widths), rule]
    lines += [aligned(cells, widths) for cells in body[:-1]]
    if body[:-1]:
        lines.append(rule)
    lines.append(aligned(body[-1], widths))
    if evaluation.row().num_fallback:
        lines.append("(+n): fallback poses")
    return lines


def cells_of(row: RecallRow) -> tuple[str, ...]:
    """One row of the recall table: name, queries, localized, recall, the two medians."""
    localized = str(row.num_localized)
    if row.num_fallback:
        localized += f" (+{row.num_fallback})"
    return (
        shortened(display_name(row.name)),
        str(row.num_queries),
        localized,
        format_recall(row),
        format_median(row.median_position_m, row.median_angle_deg),
        format_median(row.median_localized_position_m, row.median_localized_angle_deg)
        if row.num_localized
        else "-",
    )


def display_name(name: str) -> str:
    """A row's name, with a stand-in for the queries that have no condition."""
    return name or NO_CONDITION


def shortened(name: str, width: int = _MAX_NAME_WIDTH) -> str:
    """A name that leaves room for the other columns: names differ at either end."""
    if len(name) <= width:
        return name
    half = (width - 3) // 2
    return f"{name[:half]}...{name[-half:]}"


def format_median(position_m: float, angle_deg: float) -> str:
    """Two medians in one cell; ``inf`` where most queries have no pose."""
    if not math.isfinite(position_m):
        return "inf"
    return f"{format_metres(position_m)}, {format_degrees(angle_deg)}"


def aligned(cells: Sequence[str], widths: Sequence[int], right: Sequence[int] = (1, 2)) -> str:
    """One line of a table: the columns ``right`` (counts) to the right, all else to the left."""
    # a heading may reach over the next column
    padded = [
        cell.rjust(width) if i in right else cell.ljust(width)
        for i, (cell, width) in enumerate(zip(cells, widths, strict=True))
    ]
    return "  ".join(padded).rstrip()


def counted(number: int, one: str, many: str) -> str:
    """A number and the right form of its noun."""
    return f"{number} {one if number == 1 else many}"


def _verb(number: int, one: str, many: str) -> str:
    return one if number == 1 else many
