"""Reports of results: their text, JSON, CSV tables and page as one document each."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from markupsafe import Markup

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.metrics import ALL
from megloc_kapture.evaluation.report import tables
from megloc_kapture.evaluation.report.document import (
    Block,
    Document,
    Items,
    Paragraph,
    Section,
    render_html,
    render_text,
    write_document,
)
from megloc_kapture.evaluation.report.queries import StoredInliers, shown_queries
from megloc_kapture.evaluation.report.wording import (
    CONFIDENT,
    INTERVALS,
    agreement_sentence,
    bounds,
    comparison_sentences,
    confidence_sentences,
    covariance_sentence,
    criterion,
    method_sentence,
    notes,
    retrieval_note,
)
from megloc_kapture.evaluation.results import Poses, first_map_poses
from megloc_kapture.evaluation.scoring import Evaluation
from megloc_kapture.evaluation.statistics import Comparison, MedianDifference, PairedTest, Seeds
from megloc_kapture.evaluation.without_truth import CAUTION, ResultWithoutTruth, WithoutTruth
from megloc_kapture.values import MIN_CONFIDENCE

RECALL_JSON, RECALL_TEXT = "recall.json", "recall.txt"
VIEW_HTML = "view.html"
AGREEMENT_TEXT = "agreement.txt"
PER_QUERY_CSV, DIFFERENCES_CSV = "per_query.csv", "differences.csv"

AnyReported = Evaluation | Comparison | Seeds | WithoutTruth


def report_text(reported: AnyReported) -> str:
    """The report as plain text, ASCII but for labels, ended by a newline."""
    return render_text(_text_sections(reported))


def report_of(
    reported: AnyReported,
    *,
    map_poses: Poses | None = None,
    provenance: Mapping[str, Any] | None = None,
    view: bool = False,
) -> Document:
    """The report of one result, of several, of runs with seeds, or of results without truth.

    Parameters
    ----------
    map_poses : ``cam_from_world`` of the map's images, for the view from above; by default those
        of the first result that has a map.
    provenance : options, preset, inputs: plain JSON data, shown at the end with the versions.
    view : add the 3D view of a single result, a file beside the page that leads to it.

    Raises
    ------
    DataError : a map is broken.
    """
    # matplotlib loads with them, which those who want the text need not wait for
    from megloc_kapture.evaluation.report import pages

    if isinstance(reported, Evaluation):
        results: Sequence[Evaluation] | Sequence[ResultWithoutTruth] = (reported,)
    else:
        results = reported.results if isinstance(reported, WithoutTruth) else reported.evaluations
    title = " and ".join(result.label for result in results)
    if map_poses is None:
        map_poses = first_map_poses(own.context for own in results)
    # the gallery and the view show the same inliers
    stored = StoredInliers(results[0].context)
    if isinstance(reported, Evaluation):
        title = title or "Evaluation"
        page = pages.evaluation_page(reported, map_poses, stored)
    elif isinstance(reported, Comparison):
        page = pages.comparison_page(reported, map_poses)
    elif isinstance(reported, Seeds):
        title = f"{len(results)} runs of one method"
        page = pages.seeds_page(reported, map_poses)
    else:
        title = title or "Without truth"
        page = pages.without_truth_page(reported, map_poses, stored)
    beside = _view(results[0], stored, title) if view and len(results) == 1 else {}
    if beside:
        link = Markup('<a class="view" href="{}">See it in 3D</a>').format(VIEW_HTML)
        told = " The map's points and cameras, and the queries: coloured by their error or "
        page = (*page[:1], _lines(Paragraph(link + f"{told}confidence.")), *page[1:])
    csv_tables = {PER_QUERY_CSV: reported.per_query()}
    if isinstance(reported, Comparison):
        csv_tables[DIFFERENCES_CSV] = reported.differences()
    return Document(
        name="agreement" if isinstance(reported, WithoutTruth) else "recall",
        title=title,
        text=tuple(_text_sections(reported)),
        page=page,
        data=report_data(reported),
        tables=csv_tables,
        provenance=provenance or {},
        beside=beside,
    )


def _view(
    result: Evaluation | ResultWithoutTruth, stored: StoredInliers, title: str
) -> dict[str, str]:
    """The page of the view by its name; none where no camera has a pose, or the map is broken."""
    from megloc_kapture.evaluation.report.scene import render_view, scene_of

    # a report without a view is better than none; `megloc view` says what is broken
    with contextlib.suppress(DataError):
        scene = scene_of(title, stored, shown_queries(result))
        if scene is not None:
            return {VIEW_HTML: render_view(scene)}
    return {}


def write_report(folder: Path | str, reported: AnyReported, **options: Any) -> dict[str, Path]:
    """Write the report's files, each atomically; returns name -> path. ``options`` as of
    :func:`report_of`.

    With truth these are recall.json, recall.txt, per_query.csv and report.html, of a comparison
    also differences.csv; without truth agreement.json and agreement.txt take the place of recall's.
    Of a single result the 3D view stands beside them, view.html.

    Raises
    ------
    DataError : a map is broken.
    OutputError : a file cannot be written.
    """
    return write_document(folder, report_of(reported, view=True, **options))


def render_report(reported: AnyReported, **options: Any) -> str:
    """The page alone; the same arguments give the same text. ``options`` as :func:`report_of`."""
    return render_html(report_of(reported, **options))


def report_data(reported: AnyReported) -> dict[str, Any]:
    """The data of the report's JSON; see :class:`Document`."""
    if isinstance(reported, Evaluation):
        return _recall_data(reported)
    if isinstance(reported, WithoutTruth):
        labels = [result.label for result in reported.results]
        return {
            "statement": reported.statement,
            "caution": CAUTION,
            "results": [
                {"label": result.label, "rows": [asdict(row) for row in result.rows]}
                for result in reported.results
            ],
            "agreement": [
                {**asdict(row), "first": labels[row.first], "second": labels[row.second]}
                for row in reported.agreement
            ],
        }
    results = [_recall_data(evaluation) for evaluation in reported.evaluations]
    if isinstance(reported, Seeds):
        return {"results": results, "seeds": [asdict(row) for row in reported.rows]}
    return {"results": results, "comparison": _comparison_data(reported)}


def _text_sections(reported: AnyReported) -> list[Section]:
    if isinstance(reported, Seeds):
        return _seeds_text(reported)
    if isinstance(reported, WithoutTruth):
        return _without_truth_text(reported)
    several = isinstance(reported, Comparison)
    evaluations = reported.evaluations if isinstance(reported, Comparison) else (reported,)
    sections = []
    if not several and evaluations[0].label:
        sections.append(_lines(_line(evaluations[0].label)))
    sections += _recall_sections(evaluations)
    for evaluation in evaluations:
        whose = f" of {evaluation.label}" if several else ""
        if (confident := tables.confident_table(evaluation)) is not None:
            sections.append(_lines(_line(f"{CONFIDENT} (%)"), confident))
        if (confidence := evaluation.confidence) is not None:
            said = "; ".join(confidence_sentences(confidence, evaluation.thresholds[-1]))
            sections.append(_lines(Paragraph(f"Confidence{whose}: {said}.")))
        if evaluation.covariance is not None:
            said = covariance_sentence(evaluation.covariance)
            sections.append(_lines(Paragraph(f"Covariance{whose}: {said}.")))
    if isinstance(reported, Comparison):
        sections.append(_lines(Items(tuple(comparison_sentences(reported)))))
        sections.append(_lines(Paragraph(method_sentence(reported))))
    for evaluation in evaluations:
        on = f" on {evaluation.label}" if several else ""
        sections += [_lines(Paragraph(f"Note{on}: {note}.")) for note in notes(evaluation)]
    return sections


def _recall_sections(evaluations: Sequence[Evaluation]) -> list[Section]:
    by_center = [e.by_center for e in evaluations if e.by_center is not None]
    sections = [
        _lines(
            _line(f"recall (%) at {bounds(evaluations[0].thresholds)}"),
            Paragraph(criterion(evaluations[0])),
        ),
        _lines(tables.recall_table(evaluations)),
    ]
    if len(by_center) == len(evaluations):
        sections.append(_lines(_line("the same by the distance of the camera centres")))
        sections.append(_lines(tables.recall_table(by_center)))
    intervals = tables.interval_table(evaluations)
    return [*sections, _lines(_line(f"{INTERVALS}, (%)"), intervals)]


def _seeds_text(seeds: Seeds) -> list[Section]:
    first = seeds.evaluations[0]
    labels = ", ".join(evaluation.label for evaluation in seeds.evaluations)
    told = f"recall (%) at {bounds(first.thresholds)}, mean +- standard deviation of a run"
    found = "queries found by all / by some / by none of the runs"
    return [
        _lines(_line(f"{len(seeds.evaluations)} runs of one method: {labels}")),
        _lines(_line(told), Paragraph(criterion(first))),
        _lines(tables.seeds_table(seeds)),
        _lines(_line("smallest and largest of the runs (%)"), tables.seed_ranges(seeds)),
        _lines(_line(found), tables.found_table(seeds)),
    ]


def _without_truth_text(found: WithoutTruth) -> list[Section]:
    sections = [_lines(Paragraph(f"No recall: {found.statement}"), Paragraph(CAUTION))]
    for result in found.results:
        sections.append(_lines(_line(result.label)))
        sections.append(_lines(tables.result_table(result), Paragraph(retrieval_note(result))))
    for pair in dict.fromkeys((row.first, row.second) for row in found.agreement):
        rows = [row for row in found.agreement if (row.first, row.second) == pair]
        whole = next(row for row in rows if row.name == ALL)
        first, second = (found.results[index].label for index in pair)
        told = (
            "% of all queries where both have a pose and the two are at most "
            f"{bounds(found.thresholds)} apart"
        )
        table = tables.agreement_table(found, rows)
        sections += [
            _lines(Paragraph(f"agreement of {first} and {second}"), Paragraph(told)),
            _lines(table, Paragraph(agreement_sentence(whole, found))),
        ]
    return sections


def _lines(*blocks: Block) -> Section:
    return Section(blocks)


def _line(text: str) -> Paragraph:
    return Paragraph(text, wrap=False)


def _recall_data(evaluation: Evaluation) -> dict[str, Any]:
    confidence, by_center = evaluation.confidence, evaluation.by_center
    covariance = evaluation.covariance
    return {
        "label": evaluation.label,
        "criterion": criterion(evaluation),
        "thresholds": evaluation.thresholds,
        "rows": evaluation.rows,
        "notes": notes(evaluation),
        **({} if confidence is None else {"confidence": asdict(confidence)}),
        "rows_above_min_confidence": evaluation.rows_above(MIN_CONFIDENCE),
        **({} if covariance is None else {"covariance": asdict(covariance)}),
        "without_truth": evaluation.without_truth,
        "not_scored": evaluation.not_scored,
        **({} if by_center is None else {"rows_by_center": by_center.rows}),
    }


def _comparison_data(comparison: Comparison) -> dict[str, Any]:
    labels = [evaluation.label for evaluation in comparison.evaluations]

    def named(test: PairedTest | MedianDifference) -> dict[str, Any]:
        pair = {"first": labels[test.first], "second": labels[test.second]}
        return {**asdict(test), **pair, "real": test.is_real}

    return {
        "method": method_sentence(comparison),
        "sentences": [sentence for sentence, _ in comparison_sentences(comparison)],
        "tests": [named(test) for test in comparison.tests],
        "tests_by_condition": [named(test) for test in comparison.tests_by_row],
        "medians": [named(median) for median in comparison.medians],
    }
