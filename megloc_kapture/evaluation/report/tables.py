"""The tables of reports."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Protocol, TypeVar

from megloc_kapture.evaluation.metrics import ALL, RecallAt, RecallRow, Threshold
from megloc_kapture.evaluation.report.document import Cell, Column, Table, column
from megloc_kapture.evaluation.report.wording import (
    display_name,
    format_interval,
    format_median,
    format_percent,
    format_share,
    format_spread,
    shortened,
)
from megloc_kapture.evaluation.scoring import Evaluation
from megloc_kapture.evaluation.statistics import Seeds, SeedsRow, Spread
from megloc_kapture.evaluation.without_truth import (
    PRIOR_DISTANCES_M,
    AgreementRow,
    PriorAgreement,
    ResultWithoutTruth,
    RowWithoutTruth,
    WithoutTruth,
)
from megloc_kapture.io.dataset_tables import METRES

_MAX_LABEL_WIDTH = 22
# Okabe and Ito's palette: told apart with any colour vision, in print too; then four more, for
# RobotCar has nine conditions
PALETTE = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"),
    *("#7a5195", "#8c6d31", "#5f6b7a", "#9a1750"),
)


class _Counted(Protocol):
    @property
    def num_queries(self) -> int: ...


Row = TypeVar("Row", bound=_Counted)


def colors_of(names: Sequence[str]) -> dict[str, str]:
    """A colour for each name, in order; they come again where there are more than ten."""
    return {name: PALETTE[i % len(PALETTE)] for i, name in enumerate(names)}


def recall_table(evaluations: Sequence[Evaluation]) -> Table:
    """Recall and medians of one result, or of several beside each other.

    Conditions are rows; in text at most 100 columns wide with the usual three or four thresholds.
    Several results follow each other in each condition; of one, ``all`` stands below a line.
    """
    size, several = len(evaluations), len(evaluations) > 1
    groups = list(zip(*(evaluation.rows for evaluation in evaluations), strict=True))
    rows = [row for group in groups for row in group]
    first = [index % size == 0 for index in range(len(rows))]
    colors = colors_of([evaluation.label for evaluation in evaluations])
    labels = [
        Cell(shortened(label, _MAX_LABEL_WIDTH), page=label, color=color)
        for label, color in colors.items()
    ]
    fallbacks = any(row.num_fallback for row in rows)

    def localized(row: RecallRow) -> Cell:
        if not row.num_fallback:
            return Cell(str(row.num_localized))
        page = f"{row.num_localized} +{row.num_fallback}" if several else str(row.num_localized)
        return Cell(f"{row.num_localized} (+{row.num_fallback})", page=page)

    def of_localized(row: RecallRow) -> Cell:
        medians = row.median_localized_position_m, row.median_localized_angle_deg
        return _median_cell(*medians) if row.num_localized else Cell("-")

    columns = [
        Column(
            "condition" if several or rows[1:] else "",
            tuple(
                _name_cell(row.name) if own else Cell("")
                for row, own in zip(rows, first, strict=True)
            ),
        ),
        *([Column("result", tuple(labels * len(groups)))] if several else []),
        column("queries", rows, lambda row: row.num_queries, kind="count"),
        column("localized", rows, localized, kind="count"),
    ]
    if fallbacks and not several:
        shown = column("fallback", rows, lambda row: row.num_fallback, kind="count", medium="page")
        columns.append(shown)
    columns += [
        column("no\npose", rows, lambda row: row.num_missing, kind="count", medium="page"),
        *_recall_columns("recall (%)", rows, lambda row: row.recall),
        column(
            "median\nof all",
            rows,
            lambda row: _median_cell(row.median_position_m, row.median_angle_deg),
            kind="figures",
            text_heading="of all",
            above="median error (m, deg)",
        ),
        column(
            "median\nof localized",
            rows,
            of_localized,
            kind="figures",
            medium="text" if several else "both",
            text_heading="of localized",
        ),
    ]
    # of a group the first has a line above it, all but the last none below
    styles = [
        ("group " if i == 0 else "") + ("within" if i < size - 1 else "") for i in range(size)
    ]
    return Table(
        tuple(columns),
        styles=tuple(styles * len(groups)) if several else _total_last(rows),
        rules=tuple(range(0, len(rows), size)) if several else (0, len(rows) - 1),
        footnote="(+n): fallback poses" if fallbacks else "",
    )


def interval_table(evaluations: Sequence[Evaluation]) -> Table:
    """The confidence intervals of recall, apart from the table that can be copied into a paper."""
    names, cells = [], []
    for group in zip(*(evaluation.rows for evaluation in evaluations), strict=True):
        for evaluation, row in zip(evaluations, group, strict=True):
            label = shortened(evaluation.label, _MAX_LABEL_WIDTH)
            name = display_name(row.name)
            names.append(f"{name}, {label}" if evaluations[1:] else shortened(name))
            cells.append([format_interval(at) for at in row.recall])
    return _slashed(names, cells)


def seeds_table(seeds: Seeds) -> Table:
    """Mean and spread of recall over the runs."""
    rows = seeds.rows

    def localized(row: SeedsRow) -> Cell:
        own = row.num_localized
        text = f"{own.mean:.1f} +- {own.deviation:.1f}"
        return Cell(text, page=f"{own.mean:.1f}", below=f"{own.smallest:g}-{own.largest:g}")

    def median(row: SeedsRow) -> Cell:
        text = format_spread(row.median_position_m)
        return Cell(text, page=text.replace("+-", "±"))

    def recalls(row: SeedsRow) -> list[str]:
        return [format_spread(at.recall, percent=True) for at in row.recall]

    def recall(row: SeedsRow, index: int) -> Cell:
        return Cell(
            recalls(row)[index].replace("+-", "±"), below=_range_text(row.recall[index].recall)
        )

    columns = (
        column(
            "condition" if rows[1:] else "",
            rows,
            lambda row: _name_cell(row.name),
            text_heading="condition",
        ),
        column("queries", rows, lambda row: row.num_queries, kind="count"),
        column("localized", rows, localized, kind="count"),
        column("recall (%)", rows, lambda row: " / ".join(recalls(row)), medium="text"),
        *(
            column(
                _threshold_heading(at.threshold),
                rows,
                partial(recall, index=index),
                kind="count",
                medium="page",
            )
            for index, at in enumerate(rows[0].recall)
        ),
        column("median\nerror (m)", rows, median, kind="figures", text_heading="median error (m)"),
    )
    return Table(columns, styles=_total_last(rows))


def seed_ranges(seeds: Seeds) -> Table:
    """Smallest and largest recall of the runs, as text."""
    cells = [[_range_text(at.recall) for at in row.recall] for row in seeds.rows]
    return _slashed([display_name(row.name) for row in seeds.rows], cells)


def found_table(seeds: Seeds) -> Table:
    """Queries within each threshold in all, some or none of the runs."""
    every = seeds.rows[-1].recall
    counts = [[str(n) for n in (at.always, at.sometimes, at.never)] for at in every]
    headings = ("threshold", "by every run", "by some runs", "by none")
    return _slashed([str(at.threshold) for at in every], counts, headings)


def result_table(result: ResultWithoutTruth) -> Table:
    """Localized share, inliers and agreement with retrieval of a result without truth."""
    rows = result.rows
    distances = " / ".join(f"{distance:g}" for distance in PRIOR_DISTANCES_M) + " m"
    fallbacks = rows[-1].num_fallback

    def localized(row: RowWithoutTruth) -> Cell:
        added = f" (+{row.num_fallback})" if row.num_fallback else ""
        return Cell(f"{row.num_localized}{added}", page=str(row.num_localized))

    def quartiles(row: RowWithoutTruth) -> str:
        return " / ".join(f"{value:.0f}" for value in row.inliers_quartiles or ()) or "-"

    def facing(row: RowWithoutTruth) -> str:
        own = row.first_candidate
        return format_share(own.num_same_direction, own.num_compared) if own else "-"

    def share(row: RowWithoutTruth) -> str:
        return format_share(row.num_localized, row.num_queries)

    columns = [
        column("condition" if rows[1:] else "", rows, lambda row: _name_cell(row.name)),
        column("queries", rows, lambda row: row.num_queries, kind="count"),
        column("localized", rows, localized, kind="count"),
        column("%", rows, share, kind="count"),
        column("fallback", rows, lambda row: row.num_fallback, kind="count", medium="page"),
        column(
            "inliers,\nquartiles",
            rows,
            quartiles,
            kind="figures",
            text_heading="quartiles",
            above="inliers",
        ),
        column(
            f"% within {distances}\nof the first candidate",
            rows,
            lambda row: _within_text(row.first_candidate),
            kind="figures",
            text_heading="of first",
            above=f"% within {distances}",
        ),
        column(
            "of the\nnearest candidate",
            rows,
            lambda row: _within_text(row.nearest_candidate),
            kind="figures",
            text_heading="of nearest",
        ),
        column("% in its\ndirection", rows, facing, kind="count", text_heading="facing"),
    ]
    if result.context.unit != METRES:
        columns = [own for own in columns if "candidate" not in own.heading]
    return Table(
        tuple(own for own in columns if fallbacks or own.heading != "fallback"),
        styles=_total_last(rows),
        rules=(0, len(rows) - 1),
        footnote="(+n): fallback poses; no figure but this one counts them" if fallbacks else "",
    )


def agreement_table(found: WithoutTruth, rows: Sequence[AgreementRow]) -> Table:
    """Share of queries whose poses in two results agree, by condition."""
    labels = [result.label for result in found.results]

    def median(row: AgreementRow) -> str:
        return format_median(row.median_m, row.median_deg).replace("inf", "-")

    columns = (
        column(
            "results", rows, lambda row: f"{labels[row.first]}, {labels[row.second]}", medium="page"
        ),
        column(
            "condition",
            rows,
            lambda row: _name_cell(row.name),
            text_heading="condition" if rows[1:] else "",
        ),
        column("queries", rows, lambda row: row.num_queries, kind="count"),
        column(
            "both have\na pose", rows, lambda row: row.num_both, kind="count", text_heading="both"
        ),
        *_recall_columns("agree (%)", rows, lambda row: row.within),
        column(
            "median,\nwhere both have",
            rows,
            median,
            kind="figures",
            text_heading="median (m, deg)",
        ),
    )
    return Table(columns, styles=tuple("total" if row.name == ALL else "" for row in rows))


def seconds_table(seconds: Mapping[str, float]) -> Table:
    """Seconds of each stage of a run, and of all."""
    rows = [*seconds.items(), (ALL, sum(seconds.values()))]
    columns = (
        column("stage", rows, lambda row: row[0]),
        column("seconds", rows, lambda row: f"{row[1]:.1f}", kind="count"),
    )
    return Table(columns, styles=_total_last(rows))


def _recall_columns(
    heading: str, rows: Sequence[Row], recall_of: Callable[[Row], Sequence[RecallAt]]
) -> list[Column]:
    """Shares at all thresholds: in text in one cell, as papers print them; on the page a column
    per threshold, each share with its interval below it."""

    def joined(row: Row) -> str:
        return " / ".join(format_percent(at.recall) for at in recall_of(row))

    def at_threshold(row: Row, index: int) -> Cell:
        at = recall_of(row)[index]
        title = f"{at.num_within} of {row.num_queries}"
        return Cell(format_percent(at.recall), below=format_interval(at), title=title)

    return [
        column(heading, rows, joined, medium="text"),
        *(
            column(
                _threshold_heading(at.threshold),
                rows,
                partial(at_threshold, index=index),
                kind="count",
                medium="page",
            )
            for index, at in enumerate(recall_of(rows[0]))
        ),
    ]


def _slashed(
    names: Sequence[str], rows: Sequence[Sequence[str]], headings: Sequence[str] = ()
) -> Table:
    """Lines of a name and one cell per threshold: ``day  87.5-91.8 / 94.5-97.3``."""
    headings = headings or [""] * (1 + len(rows[0]))
    columns = [column(headings[0], names, str)]
    for index, cells in enumerate(zip(*rows, strict=True)):
        before = " / " if index else "  "
        columns.append(column(headings[1 + index], cells, str, kind="figures", before=before))
    return Table(tuple(columns), headed=False)


def _name_cell(name: str) -> Cell:
    """The name of a row, cut short in text."""
    return Cell(shortened(display_name(name)), page=display_name(name))


def _total_last(rows: Sequence[object]) -> tuple[str, ...]:
    return (*[""] * (len(rows) - 1), "total")


def _threshold_heading(threshold: Threshold) -> str:
    angle = threshold.angle_deg
    return f"{threshold.position_m:g} m" + ("" if angle is None else f"\n{angle:g} deg")


def _median_cell(position_m: float, angle_deg: float) -> Cell:
    text = format_median(position_m, angle_deg)
    if not math.isfinite(position_m):
        return Cell(text, page="-")
    metres, degrees = text.split(", ")
    return Cell(text, page=f"{metres} m", below=f"{degrees} deg")


def _within_text(prior: PriorAgreement | None) -> str:
    """Percent of the compared queries within each distance of their candidate."""
    if prior is None:
        return "-"
    return " / ".join(f"{100.0 * at.share:.0f}" for at in prior.within)


def _range_text(spread: Spread) -> str:
    return f"{format_percent(spread.smallest)}-{format_percent(spread.largest)}"
