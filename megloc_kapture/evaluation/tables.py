"""The recall table as text, in the style of papers: ``89.8 / 96.1 / 99.4``."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

from megloc_kapture.evaluation.evaluate import Evaluation
from megloc_kapture.evaluation.recall import RecallRow
from megloc_kapture.evaluation.thresholds import Threshold

NO_CONDITION = "(no condition)"
_MAX_NAME_WIDTH = 16
_NOTE_WIDTH = 92
_NAMES_SHOWN = 5


def format_percent(recall: float) -> str:
    """Recall as papers print it: percent with one decimal."""
    return f"{100.0 * recall:.1f}"


def format_recall(row: RecallRow) -> str:
    """Recall at all thresholds: ``89.8 / 96.1 / 99.4``."""
    return " / ".join(format_percent(at.recall) for at in row.recall)


def format_metres(position_m: float) -> str:
    """Metres down to a tenth of a millimetre where that is small, to a centimetre where not."""
    return f"{position_m:.4f}" if position_m < 1 else f"{position_m:.2f}"


def format_degrees(angle_deg: float) -> str:
    """Degrees to a thousandth below 1, to a hundredth above."""
    return f"{angle_deg:.3f}" if angle_deg < 1 else f"{angle_deg:.2f}"


def criterion(thresholds: Sequence[Threshold]) -> str:
    """How recall is counted, in one sentence."""
    with_angles = any(threshold.angle_deg is not None for threshold in thresholds)
    what = "Both errors" if with_angles else "Position error"
    return f"{what} at or below (<=) the threshold; a query without a pose counts as a miss."


def notes(evaluation: Evaluation) -> list[str]:
    """What a reader must know beside the table: fallbacks, images without truth, no overlap."""
    row = evaluation.row()
    said = []
    if row.num_fallback:
        said.append(
            f"{_count(row.num_fallback, 'query', 'queries')} could not be localized and "
            f"{_verb(row.num_fallback, 'bears', 'bear')} the pose of the best retrieved image "
            "instead; recall and the median of all count it as any pose"
        )
    if row.num_missing == row.num_queries:
        said.append("no query has a pose")
    missing = evaluation.without_truth
    if missing:
        shown = ", ".join(missing[:_NAMES_SHOWN]) + (", ..." if missing[_NAMES_SHOWN:] else "")
        said.append(
            f"{_count(len(missing), 'image has', 'images have')} no true pose and "
            f"{_verb(len(missing), 'is', 'are')} not counted: {shown}"
        )
        if not evaluation.estimated and row.num_missing == row.num_queries:
            said.append("no estimated image is in the ground truth: do the names agree?")
    if evaluation.not_scored:
        said.append(
            f"{_count(len(evaluation.not_scored), 'image', 'images')} with a true pose "
            f"{_verb(len(evaluation.not_scored), 'is', 'are')} not scored by this benchmark"
        )
    return said


def recall_table(evaluation: Evaluation) -> str:
    """The whole table with its heading and notes, plain ASCII, ended by a newline.

    Conditions are rows; the row ``all`` stands below a line. At most 100 columns wide with the
    usual three or four thresholds.
    """
    first = "condition" if evaluation.rows[1:] else ""
    above = ("", "", "", "", "median error (m, deg)", "")
    head = (first, "queries", "localized", "recall (%)", "of all", "of localized")
    body = [_cells(row) for row in evaluation.rows]
    widths = [max(len(line[i]) for line in (head, *body)) for i in range(len(head))]
    rule = "-" * (sum(widths) + 2 * (len(widths) - 1))
    bounds = " / ".join(str(threshold) for threshold in evaluation.thresholds)
    lines = [evaluation.label, ""] if evaluation.label else []
    lines += [f"recall (%) at {bounds}", criterion(evaluation.thresholds), ""]
    lines += [_line(above, widths), _line(head, widths), rule]
    lines += [_line(cells, widths) for cells in body[:-1]]
    if body[:-1]:
        lines.append(rule)
    lines.append(_line(body[-1], widths))
    if body[-1][2] != str(evaluation.row().num_localized):
        lines.append("(+n): fallback poses")
    for note in notes(evaluation):
        lines += ["", *textwrap.wrap(f"Note: {note}.", width=_NOTE_WIDTH, break_long_words=False)]
    return "\n".join(lines) + "\n"


def _cells(row: RecallRow) -> tuple[str, ...]:
    localized = str(row.num_localized)
    if row.num_fallback:
        localized += f" (+{row.num_fallback})"
    return (
        _shortened(display_name(row.name)),
        str(row.num_queries),
        localized,
        format_recall(row),
        _median(row.median_position_m, row.median_angle_deg),
        _median(row.median_localized_position_m, row.median_localized_angle_deg)
        if row.num_localized
        else "-",
    )


def display_name(name: str) -> str:
    """A row's name, with a stand-in for the queries that have no condition."""
    return name or NO_CONDITION


def _shortened(name: str) -> str:
    return name if len(name) <= _MAX_NAME_WIDTH else f"{name[: _MAX_NAME_WIDTH - 3]}..."


def _median(position_m: float, angle_deg: float) -> str:
    if not math.isfinite(position_m):
        return "inf"
    return f"{format_metres(position_m)}, {format_degrees(angle_deg)}"


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    # counts to the right, all else to the left; a heading may reach over the next column
    aligned = [
        cell.rjust(width) if i in (1, 2) else cell.ljust(width)
        for i, (cell, width) in enumerate(zip(cells, widths, strict=True))
    ]
    return "  ".join(aligned).rstrip()


def _count(number: int, one: str, many: str) -> str:
    return f"{number} {one if number == 1 else many}"


def _verb(number: int, one: str, many: str) -> str:
    return one if number == 1 else many
