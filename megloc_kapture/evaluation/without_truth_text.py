"""What can be known without truth, as text."""

from __future__ import annotations

import math
from collections.abc import Sequence

from megloc_kapture.evaluation.recall import ALL
from megloc_kapture.evaluation.tables import (
    aligned,
    bounds,
    counted,
    display_name,
    format_degrees,
    format_metres,
    format_percent,
    format_share,
    shortened,
    wrapped,
)
from megloc_kapture.evaluation.without_truth import (
    PRIOR_ANGLE_DEG,
    PRIOR_DISTANCES_M,
    AgreementRow,
    PriorAgreement,
    ResultWithoutTruth,
    RowWithoutTruth,
    WithoutTruth,
)

CAUTION = (
    "None of these figures is accuracy: retrieval may look in the wrong place, and results that "
    "share a mistake agree."
)


def without_truth_text(found: WithoutTruth) -> str:
    """All figures as tables, plain ASCII but for labels, ended by a newline."""
    lines = [*wrapped(f"No recall: {found.statement}"), *wrapped(CAUTION)]
    for result in found.results:
        lines += ["", result.label, "", *_result_table(result)]
    labels = [result.label for result in found.results]
    for pair in dict.fromkeys((row.first, row.second) for row in found.agreement):
        rows = [row for row in found.agreement if (row.first, row.second) == pair]
        lines += ["", *_agreement_table(found, rows, labels)]
    return "\n".join(lines) + "\n"


def prior_heading() -> str:
    """The distances to a candidate that are reported, in metres: ``5 / 10 / 25 m``."""
    return " / ".join(f"{distance:g}" for distance in PRIOR_DISTANCES_M) + " m"


def format_within(prior: PriorAgreement | None) -> str:
    """Percent of the compared queries within each distance of their candidate."""
    if prior is None:
        return "-"
    return " / ".join(f"{100.0 * count / prior.num_compared:.0f}" for count in prior.within)


def format_quartiles(row: RowWithoutTruth) -> str:
    """The quartiles of the inliers, as whole numbers."""
    return "-" if row.inliers is None else " / ".join(f"{value:.0f}" for value in row.inliers)


def _result_table(result: ResultWithoutTruth) -> list[str]:
    within = prior_heading()
    above = ("", "", "", "", "inliers", f"% within {within}", "", "")
    first = "condition" if result.rows[1:] else ""
    head = (first, "queries", "localized", "%", "quartiles", "of first", "of nearest", "facing")
    body = [_cells(row) for row in result.rows]
    widths = [max(len(line[i]) for line in (head, *body)) for i in range(len(head))]
    rule = "-" * (sum(widths) + 2 * (len(widths) - 1))
    right = (1, 2, 3, 7)
    lines = [aligned(above, widths, right), aligned(head, widths, right), rule]
    lines += [aligned(cells, widths, right) for cells in body[:-1]]
    lines += [rule] if body[:-1] else []
    lines.append(aligned(body[-1], widths, right))
    whole = result.rows[-1]
    if whole.num_fallback:
        lines.append("(+n): fallback poses; no figure but this one counts them")
    if whole.first is None:
        said = (
            "no map or no candidates are known, so nothing is said about agreement with retrieval"
        )
    else:
        said = (
            "first, nearest: the candidate map image that is ranked first, or lies nearest to the "
            f"pose; facing: % that look within {PRIOR_ANGLE_DEG:g} degrees of the first; "
            f"of {counted(whole.first.num_compared, 'localized query', 'localized queries')} with "
            "candidates"
        )
    return [*lines, *wrapped(said)]


def _cells(row: RowWithoutTruth) -> tuple[str, ...]:
    localized = str(row.num_localized) + (f" (+{row.num_fallback})" if row.num_fallback else "")
    return (
        shortened(display_name(row.name)),
        str(row.num_queries),
        localized,
        format_share(row.num_localized, row.num_queries),
        format_quartiles(row),
        format_within(row.first),
        format_within(row.nearest),
        "-"
        if row.first is None
        else format_share(row.first.num_same_direction, row.first.num_compared),
    )


def _agreement_table(
    found: WithoutTruth, rows: Sequence[AgreementRow], labels: Sequence[str]
) -> list[str]:
    first, second = labels[rows[0].first], labels[rows[0].second]
    head = ("condition" if rows[1:] else "", "queries", "both", "agree (%)", "median (m, deg)")
    body = [
        (
            shortened(display_name(row.name)),
            str(row.num_queries),
            str(row.num_both),
            " / ".join(format_percent(at.recall) for at in row.within),
            format_apart(row),
        )
        for row in rows
    ]
    widths = [max(len(line[i]) for line in (head, *body)) for i in range(len(head))]
    rule = "-" * (sum(widths) + 2 * (len(widths) - 1))
    return [
        *wrapped(f"agreement of {first} and {second}"),
        *wrapped(
            "% of all queries where both have a pose and the two are at most "
            f"{bounds(found.thresholds)} apart"
        ),
        "",
        aligned(head, widths),
        rule,
        *(aligned(cells, widths) for cells in body),
        *wrapped(agreement_sentence(next(r for r in rows if r.name == ALL), first, second)),
    ]


def agreement_sentence(row: AgreementRow, first: str, second: str) -> str:
    """Which of two results has a pose where the other has none."""
    if not row.num_only_first and not row.num_only_second:
        return "The same queries have a pose in both."
    return (
        f"Only {first} has a pose for {counted(row.num_only_first, 'query', 'queries')}, "
        f"only {second} for {row.num_only_second}."
    )


def format_apart(row: AgreementRow) -> str:
    """Median difference of two results' poses, where both have one."""
    if not math.isfinite(row.median_m):
        return "-"
    return f"{format_metres(row.median_m)}, {format_degrees(row.median_deg)}"
