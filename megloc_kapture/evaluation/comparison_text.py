"""Several results as text: one recall table for all, the comparison in sentences, seeds."""

from __future__ import annotations

import math

from megloc_kapture.evaluation.comparison import Comparison
from megloc_kapture.evaluation.evaluate import Evaluation
from megloc_kapture.evaluation.seeds import Seeds, SeedsRow, Spread
from megloc_kapture.evaluation.sentences import comparison_sentences, method_sentence
from megloc_kapture.evaluation.tables import (
    INTERVALS,
    aligned,
    bounds,
    cells_of,
    criterion,
    display_name,
    format_interval,
    format_metres,
    format_percent,
    notes,
    shortened,
    triples,
    wrapped,
)

_MAX_LABEL_WIDTH = 22


def comparison_text(comparison: Comparison) -> str:
    """Recall of all results in one table, then what differs; plain ASCII but for labels."""
    evaluations = comparison.evaluations
    first = evaluations[0]
    lines = [f"recall (%) at {bounds(first.thresholds)}"]
    lines += [*wrapped(criterion(first.thresholds, relative=first.by_center is not None)), ""]
    lines += _table(evaluations)
    if all(evaluation.by_center is not None for evaluation in evaluations):
        lines += ["", "the same by the distance of the camera centres", ""]
        lines += _table([e.by_center for e in evaluations if e.by_center is not None])
    lines += ["", f"{INTERVALS}, (%)"]
    lines += triples(
        (
            f"{display_name(row.name)}, {_short_label(evaluation.label)}",
            [format_interval(at) for at in row.recall],
        )
        for rows in zip(*(e.rows for e in evaluations), strict=True)
        for evaluation, row in zip(evaluations, rows, strict=True)
    )
    lines.append("")
    for sentence, _ in comparison_sentences(comparison):
        lines += wrapped(sentence)
    lines += ["", *wrapped(method_sentence(comparison))]
    for evaluation in evaluations:
        for note in notes(evaluation):
            lines += ["", *wrapped(f"Note on {evaluation.label}: {note}.")]
    return "\n".join(lines) + "\n"


def _table(evaluations: list[Evaluation] | tuple[Evaluation, ...]) -> list[str]:
    above = ("", "", "", "", "", "median error (m, deg)", "")
    head = ("condition", "result", "queries", "localized", "recall (%)", "of all", "of localized")
    groups = []
    for rows in zip(*(evaluation.rows for evaluation in evaluations), strict=True):
        group: list[tuple[str, ...]] = []
        for evaluation, row in zip(evaluations, rows, strict=True):
            name, *cells = cells_of(row)
            group.append((name if not group else "", _short_label(evaluation.label), *cells))
        groups.append(group)
    body = [cells for group in groups for cells in group]
    widths = [max(len(line[i]) for line in (head, *body)) for i in range(len(head))]
    rule = "-" * (sum(widths) + 2 * (len(widths) - 1))
    lines = [aligned(above, widths, (2, 3)), aligned(head, widths, (2, 3))]
    for group in groups:
        lines += [rule, *(aligned(cells, widths, (2, 3)) for cells in group)]
    if any(evaluation.row().num_fallback for evaluation in evaluations):
        lines.append("(+n): fallback poses")
    return lines


def seeds_text(seeds: Seeds) -> str:
    """Mean and spread of the runs' recall."""
    first = seeds.evaluations[0]
    number = len(seeds.evaluations)
    lines = [
        f"{number} runs of one method: {', '.join(e.label for e in seeds.evaluations)}",
        "",
        f"recall (%) at {bounds(first.thresholds)}, mean +- standard deviation of a run",
        *wrapped(criterion(first.thresholds, relative=first.by_center is not None)),
        "",
    ]
    head = ("condition", "queries", "localized", "recall (%)", "median error (m)")
    body = [_seeds_cells(row) for row in seeds.rows]
    widths = [max(len(line[i]) for line in (head, *body)) for i in range(len(head))]
    rule = "-" * (sum(widths) + 2 * (len(widths) - 1))
    lines += [aligned(head, widths), rule, *(aligned(cells, widths) for cells in body)]
    lines += ["", "smallest and largest of the runs (%)"]
    lines += triples(
        (
            display_name(row.name),
            [
                f"{format_percent(at.recall.smallest)}-{format_percent(at.recall.largest)}"
                for at in row.recall
            ],
        )
        for row in seeds.rows
    )
    lines += ["", "queries found by all / by some / by none of the runs"]
    lines += triples(
        (str(at.threshold), [str(at.always), str(at.sometimes), str(at.never)])
        for at in seeds.rows[-1].recall
    )
    return "\n".join(lines) + "\n"


def format_spread(spread: Spread, *, percent: bool = False) -> str:
    """``89.8 +- 0.3``; ``inf`` where a run has no such figure."""
    if not math.isfinite(spread.mean):
        return "inf"
    if percent:
        return f"{format_percent(spread.mean)} +- {format_percent(spread.deviation)}"
    return f"{format_metres(spread.mean)} +- {format_metres(spread.deviation)}"


def _seeds_cells(row: SeedsRow) -> tuple[str, ...]:
    return (
        shortened(display_name(row.name)),
        str(row.num_queries),
        f"{row.num_localized.mean:.1f} +- {row.num_localized.deviation:.1f}",
        " / ".join(format_spread(at.recall, percent=True) for at in row.recall),
        format_spread(row.median_position_m),
    )


def _short_label(label: str) -> str:
    return shortened(label, _MAX_LABEL_WIDTH)
