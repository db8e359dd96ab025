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
from megloc_kapture.evaluation.statistics import Seeds, SeedsAt, SeedsRow
from megloc_kapture.evaluation.without_truth import (
    PRIOR_DISTANCES_M,
    AgreementRow,
    PriorAgreement,
    ResultWithoutTruth,
    RowWithoutTruth,
    WithoutTruth,
)
from megloc_kapture.io.dataset_tables import METRES
from megloc_kapture.values import MIN_CONFIDENCE

_MAX_LABEL_WIDTH = 22
# Okabe and Ito's palette: told apart with any colour vision, in print too; then four more, for
# RobotCar has nine conditions
PALETTE = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"),
    *("#7a5195", "#8c6d31", "#5f6b7a", "#9a1750"),
)


class _Named(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def num_queries(self) -> int: ...


Row = TypeVar("Row", bound=_Named)
# a column whose cells stand to the right
_count = partial(column, kind="count")


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
    fallbacks = any(row.num_fallback for row in rows)

    def name(at: int) -> Cell:
        return Cell("") if at % size else _name_cell(rows[at])

    def localized(row: RecallRow) -> Cell:
        return _localized_cell(row, several=several)

    def of_all(row: RecallRow) -> Cell:
        return _median_cell(row.median_position_m, row.median_angle_deg)

    def of_localized(row: RecallRow) -> Cell:
        medians = row.median_localized_position_m, row.median_localized_angle_deg
        return _median_cell(*medians) if row.num_localized else Cell("-")

    columns = [column("condition" if several or rows[1:] else "", range(len(rows)), name)]
    if several:
        labels = [
            Cell(shortened(label, _MAX_LABEL_WIDTH), page=label, color=color)
            for label, color in colors_of([e.label for e in evaluations]).items()
        ]
        columns.append(Column("result", tuple(labels * len(groups))))
    columns += [_count("queries", rows, _queries), _count("localized", rows, localized)]
    if fallbacks and not several:
        columns.append(_count("fallback", rows, lambda row: row.num_fallback, medium="page"))
    columns += [
        _count("no\npose", rows, lambda row: row.num_missing, medium="page"),
        *_recall_columns("recall (%)", rows, lambda row: row.recall),
        column(
            "median\nof all",
            rows,
            of_all,
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


def confident_table(evaluation: Evaluation) -> Table | None:
    """Recall when poses below the usual confidence count as misses; None without confidences."""
    rows = evaluation.rows_above(MIN_CONFIDENCE)
    if not rows:
        return None
    columns = (
        column("condition" if rows[1:] else "", rows, _name_cell),
        _count("queries", rows, _queries),
        _count("accepted", rows, _localized_cell),
        *_recall_columns("recall (%)", rows, lambda row: row.recall),
    )
    return Table(columns, styles=_total_last(rows), rules=(0, len(rows) - 1))


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

    def recalls(row: SeedsRow) -> str:
        return " / ".join(format_spread(at, percent=True) for at in row.recall)

    def recall(row: SeedsRow, index: int) -> Cell:
        at = row.recall[index]
        return Cell(format_spread(at, percent=True).replace("+-", "±"), below=_range_text(at))

    heading = "condition" if rows[1:] else ""
    columns = (
        column(heading, rows, _name_cell, text_heading="condition"),
        _count("queries", rows, _queries),
        _count("localized", rows, localized),
        column("recall (%)", rows, recalls, medium="text"),
        *_by_threshold([at.threshold for at in rows[0].recall], rows, recall),
        column("median\nerror (m)", rows, median, kind="figures", text_heading="median error (m)"),
    )
    return Table(columns, styles=_total_last(rows))


def seed_ranges(seeds: Seeds) -> Table:
    """Smallest and largest recall of the runs, as text."""
    cells = [[_range_text(at) for at in row.recall] for row in seeds.rows]
    return _slashed([display_name(row.name) for row in seeds.rows], cells)


def found_table(seeds: Seeds) -> Table:
    """Queries within each threshold in all, some or none of the runs."""
    every = seeds.rows[-1].recall
    counts = [(at.found_always, at.found_sometimes, at.found_never) for at in every]
    headings = ("threshold", "by every run", "by some runs", "by none")
    cells = [[str(count) for count in of_threshold] for of_threshold in counts]
    return _slashed([str(at.threshold) for at in every], cells, headings)


def result_table(result: ResultWithoutTruth) -> Table:
    """Localized share, inliers and agreement with retrieval of a result without truth."""
    rows = result.rows
    distances = " / ".join(f"{distance:g}" for distance in PRIOR_DISTANCES_M) + " m"
    fallbacks = rows[-1].num_fallback

    def share(row: RowWithoutTruth) -> str:
        return format_share(row.num_localized, row.num_queries)

    def quartiles(row: RowWithoutTruth) -> str:
        return " / ".join(f"{value:.0f}" for value in row.inliers_quartiles or ()) or "-"

    def facing(row: RowWithoutTruth) -> str:
        own = row.first_candidate
        return format_share(own.num_same_direction, own.num_compared) if own else "-"

    def within(prior: PriorAgreement | None) -> str:
        shares = () if prior is None else prior.within
        return " / ".join(f"{100.0 * at.share:.0f}" for at in shares) or "-"

    columns = [
        column("condition" if rows[1:] else "", rows, _name_cell),
        _count("queries", rows, _queries),
        _count("localized", rows, _localized_cell),
        _count("%", rows, share),
    ]
    if fallbacks:
        columns.append(_count("fallback", rows, lambda row: row.num_fallback, medium="page"))
    inliers = {"text_heading": "quartiles", "above": "inliers"}
    columns.append(column("inliers,\nquartiles", rows, quartiles, kind="figures", **inliers))
    if result.context.unit == METRES:
        columns += [
            column(
                f"% within {distances}\nof the first candidate",
                rows,
                lambda row: within(row.first_candidate),
                kind="figures",
                text_heading="of first",
                above=f"% within {distances}",
            ),
            column(
                "of the\nnearest candidate",
                rows,
                lambda row: within(row.nearest_candidate),
                kind="figures",
                text_heading="of nearest",
            ),
        ]
    columns.append(_count("% in its\ndirection", rows, facing, text_heading="facing"))
    return Table(
        tuple(columns),
        styles=_total_last(rows),
        rules=(0, len(rows) - 1),
        footnote="(+n): fallback poses; no figure but this one counts them" if fallbacks else "",
    )


def agreement_table(found: WithoutTruth, rows: Sequence[AgreementRow]) -> Table:
    """Share of queries whose poses in two results agree, by condition."""
    labels = [result.label for result in found.results]

    def pair(row: AgreementRow) -> str:
        return f"{labels[row.first]}, {labels[row.second]}"

    def median(row: AgreementRow) -> str:
        return format_median(row.median_m, row.median_deg).replace("inf", "-")

    text_heading = "condition" if rows[1:] else ""
    median_heading = "median,\nwhere both have"
    columns = (
        column("results", rows, pair, medium="page"),
        column("condition", rows, _name_cell, text_heading=text_heading),
        _count("queries", rows, _queries),
        _count("both have\na pose", rows, lambda row: row.num_both, text_heading="both"),
        *_recall_columns("agree (%)", rows, lambda row: row.within),
        column(median_heading, rows, median, kind="figures", text_heading="median (m, deg)"),
    )
    return Table(columns, styles=tuple("total" if row.name == ALL else "" for row in rows))


def seconds_table(seconds: Mapping[str, float]) -> Table:
    """Seconds of each stage of a run, and of all."""
    rows = [*seconds.items(), (ALL, sum(seconds.values()))]
    columns = (
        column("stage", rows, lambda row: row[0]),
        _count("seconds", rows, lambda row: f"{row[1]:.1f}"),
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

    thresholds = [at.threshold for at in recall_of(rows[0])]
    shares = column(heading, rows, joined, medium="text")
    return [shares, *_by_threshold(thresholds, rows, at_threshold)]


def _by_threshold(
    thresholds: Sequence[Threshold], rows: Sequence[Row], cell_of: Callable[[Row, int], Cell]
) -> list[Column]:
    """A column of the page per threshold."""

    def cell(index: int, row: Row) -> Cell:
        return cell_of(row, index)

    columns = []
    for index, threshold in enumerate(thresholds):
        angle = "" if threshold.angle_deg is None else f"\n{threshold.angle_deg:g} deg"
        heading = f"{threshold.position_m:g} m{angle}"
        columns.append(_count(heading, rows, partial(cell, index), medium="page"))
    return columns


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


def _queries(row: _Named) -> int:
    return row.num_queries


def _name_cell(row: _Named) -> Cell:
    """The name of a row, cut short in text."""
    return Cell(shortened(display_name(row.name)), page=display_name(row.name))


def _localized_cell(row: RecallRow | RowWithoutTruth, *, several: bool = False) -> Cell:
    """A number of queries; with that of fallback poses, which otherwise have a column."""
    number, added = row.num_localized, row.num_fallback
    if not added:
        return Cell(str(number))
    return Cell(f"{number} (+{added})", page=f"{number} +{added}" if several else str(number))


def _total_last(rows: Sequence[object]) -> tuple[str, ...]:
    return (*[""] * (len(rows) - 1), "total")


def _median_cell(position_m: float, angle_deg: float) -> Cell:
    text = format_median(position_m, angle_deg)
    if not math.isfinite(position_m):
        return Cell(text, page="-")
    metres, degrees = text.split(", ")
    return Cell(text, page=f"{metres} m", below=f"{degrees} deg")


def _range_text(spread: SeedsAt) -> str:
    return f"{format_percent(spread.smallest)}-{format_percent(spread.largest)}"
