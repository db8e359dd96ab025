"""Reports of results: text, JSON, a CSV table and an HTML page."""

from __future__ import annotations

import base64
import contextlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from itertools import groupby
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from pydantic import BaseModel

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.comparison import (
    CAUTION,
    Comparison,
    WithoutTruth,
    inliers_quartiles,
)
from megloc_kapture.evaluation.metrics import from_fine_to_coarse
from megloc_kapture.evaluation.pose_files import package_versions
from megloc_kapture.evaluation.report import content
from megloc_kapture.evaluation.report.queries import shown_queries, worst_queries
from megloc_kapture.evaluation.results import Poses, first_map_poses
from megloc_kapture.evaluation.scoring import Evaluation, Reported
from megloc_kapture.io.files import write_bytes, write_json
from megloc_kapture.values import MIN_CONFIDENCE

if TYPE_CHECKING:
    from jinja2 import Template
    from pandas import DataFrame

    from megloc_kapture.evaluation.report.gallery import Picture

RECALL_JSON, RECALL_TEXT = "recall.json", "recall.txt"
AGREEMENT_TEXT = "agreement.txt"
PER_QUERY_CSV = "per_query.csv"
REPORT_HTML, VIEW_HTML = "report.html", "view.html"
_WIDTH = 92
# largest number of rows in the page's list of queries; per_query.csv has all queries
_MAX_ROWS = 500


def write_report(
    folder: Path | str,
    reported: Reported,
    *,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write the files of a report.

    They are recall.json and recall.txt (without truth agreement.json and agreement.txt),
    per_query.csv, report.html, and view.html for a single result. ``provenance`` is JSON data,
    shown at the end of the page; its ``steps``, a table of the stages, are near the top.
    """
    name = "agreement" if isinstance(reported, WithoutTruth) else "recall"
    view = _view(reported)
    page = render_report(reported, provenance=provenance, has_view=view is not None)
    # pandas writes floats that read back exactly; infinite ones become empty cells
    table = reported.to_pandas().replace([np.inf, -np.inf], np.nan)
    texts = {
        f"{name}.txt": report_text(reported),
        REPORT_HTML: page,
        PER_QUERY_CSV: table.to_csv(lineterminator="\n"),
    }
    if view is not None:
        texts[VIEW_HTML] = view
    for file, text in texts.items():
        write_bytes(Path(folder) / file, text.encode("utf-8"))
    write_json(Path(folder) / f"{name}.json", plain(report_data(reported)))


def report_text(reported: Reported) -> str:
    has_label = isinstance(reported, Evaluation) and reported.label
    parts = [reported.evaluations[0].label] if has_label else []
    for text, table in _facts(reported):
        lines = [
            fill(line, _WIDTH, break_long_words=False, break_on_hyphens=False)
            for line in text.splitlines()
        ]
        parts.append("\n".join(lines if table is None else [*lines, content.as_text(table)]))
    return "\n\n".join(parts) + "\n"


# a text (may be empty) and a table (may be None); the page adds figures and pictures
_Fact = tuple[str, "DataFrame | None"]


def _facts(reported: Reported) -> list[_Fact]:
    if isinstance(reported, WithoutTruth):
        return _facts_without_truth(reported)
    evaluations, several = reported.evaluations, isinstance(reported, Comparison)
    facts: list[_Fact] = []
    thresholds, criterion = evaluations[0].thresholds, content.criterion(evaluations[0])
    facts.append((f"recall (%) at {content.bounds(thresholds)}\n{criterion}", None))
    facts.append(("", content.recall_table(evaluations)))
    if by_center := [e.by_center for e in evaluations if e.by_center is not None]:
        text = "the same, by the distance between estimated and true camera centres"
        facts.append((text, content.recall_table(by_center)))
    facts.append((content.INTERVALS, content.interval_table(evaluations)))
    for evaluation in evaluations:
        whose = f" of {evaluation.label}" if several else ""
        if (confident := content.confident_table(evaluation)) is not None:
            facts.append((f"{content.CONFIDENT}{whose}", confident))
        if (confidence := evaluation.confidence) is not None:
            sentences = content.confidence_sentences(
                confidence, from_fine_to_coarse(thresholds)[-1]
            )
            facts.append((f"Confidence{whose}: {'; '.join(sentences)}.", None))
        if (check := evaluation.covariance) is not None:
            errors = content.counted(check["num_poses"], "error lies", "errors lie")
            sentence = (
                f"{check['num_within']} of {errors} within the estimated 95 % region, which "
                "does not cover errors of map poses and calibration."
            )
            facts.append((f"Covariance{whose}: {sentence}", None))
    if isinstance(reported, Comparison):
        sentences = content.comparison_sentences(reported)
        facts += [("\n".join(sentences), None), (content.method_sentence(reported), None)]
    for evaluation in evaluations:
        on = f" on {evaluation.label}" if several else ""
        facts += [(f"Note{on}: {note}.", None) for note in content.notes(evaluation)]
    return facts


def _facts_without_truth(reported: WithoutTruth) -> list[_Fact]:
    facts: list[_Fact] = [(f"No recall: {reported.statement}\n{CAUTION}", None)]
    facts += [(e.label, content.result_table(e)) for e in reported.evaluations]
    for _, group in groupby(reported.agreement, key=lambda row: (row.first, row.second)):
        rows = list(group)
        heading = (
            "% of all queries whose poses in both results are at most "
            f"{content.bounds(reported.thresholds)} apart"
        )
        facts.append((heading, content.agreement_table(rows)))
        facts.append((content.agreement_sentence(rows[-1]), None))
    return facts


def report_data(reported: Reported) -> dict[str, Any]:
    if isinstance(reported, Evaluation):
        return _recall_data(reported)
    if isinstance(reported, WithoutTruth):
        return {
            "statement": reported.statement,
            "caution": CAUTION,
            "results": [
                {"label": evaluation.label, "rows": _counts(evaluation)}
                for evaluation in reported.evaluations
            ],
            "agreement": reported.agreement,
        }
    assert isinstance(reported, Comparison)
    return {
        "results": [_recall_data(evaluation) for evaluation in reported.evaluations],
        "comparison": {
            "method": content.method_sentence(reported),
            "sentences": content.comparison_sentences(reported),
            "tests": [{**asdict(test), "real": test.is_real} for test in reported.tests],
            "medians": [{**asdict(median), "real": median.is_real} for median in reported.medians],
        },
    }


def _counts(evaluation: Evaluation) -> list[dict[str, Any]]:
    return [
        {
            "name": row.name,
            "num_queries": row.num_queries,
            "num_localized": row.num_localized,
            "num_fallback": row.num_fallback,
            "num_missing": row.num_missing,
            "inliers_quartiles": inliers_quartiles(evaluation, row.name),
        }
        for row in evaluation.rows
    ]


def _recall_data(evaluation: Evaluation) -> dict[str, Any]:
    by_center = evaluation.by_center
    data = {
        "label": evaluation.label,
        "criterion": content.criterion(evaluation),
        "thresholds": evaluation.thresholds,
        "rows": evaluation.rows,
        "notes": content.notes(evaluation),
        "confidence": evaluation.confidence,
        "rows_above_min_confidence": evaluation.rows_above(MIN_CONFIDENCE),
        "covariance": evaluation.covariance,
        "without_truth": evaluation.without_truth,
        "not_scored": evaluation.not_scored,
        "rows_by_center": None if by_center is None else by_center.rows,
    }
    return {name: value for name, value in data.items() if value is not None}


def plain(data: Any) -> Any:
    """Convert data for JSON; numbers that are not finite become None."""
    if isinstance(data, BaseModel):
        return data.model_dump(mode="json")
    if is_dataclass(data) and not isinstance(data, type):
        return plain(asdict(data))
    if isinstance(data, Mapping):
        return {key: plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [plain(value) for value in data]
    return None if isinstance(data, float) and not np.isfinite(data) else data


def _section(
    heading: str,
    paragraphs: Sequence[str] = (),
    body: Iterable[Markup | None] = (),
    pictures: Sequence[Picture] = (),
) -> dict[str, Any]:
    """Return a card of the page; parts of the body that are None are left out."""
    parts = [part for part in body if part is not None]
    return {"heading": heading, "paragraphs": paragraphs, "body": parts, "pictures": pictures}


def _table(frame: DataFrame | None) -> Markup | None:
    if frame is None:
        return None
    import pandas as pd

    with pd.option_context("display.max_colwidth", None):
        html = frame.to_html(index=False, border=0, justify="left")
    return Markup('<div class="scroll">{}</div>').format(Markup(html))


def _figure(svg: bytes | None) -> Markup | None:
    if svg is None:
        return None
    data = base64.b64encode(svg).decode("ascii")
    return Markup('<img src="data:image/svg+xml;base64,{}">').format(data)


def render_report(
    reported: Reported,
    *,
    provenance: Mapping[str, Any] | None = None,
    has_view: bool = False,
) -> str:
    """Render the page; it is self-contained and deterministic."""
    evaluations = reported.evaluations
    map_poses = first_map_poses(evaluation.context for evaluation in evaluations)
    sections = [_summary(reported)]
    if not isinstance(reported, WithoutTruth):
        sections.append(_error_curves(evaluations))
    for evaluation in evaluations:
        sections += _sections_of(evaluation, map_poses, several=len(evaluations) > 1)
    values = dict(provenance or {})
    return template("report.html").render(
        title=" and ".join(evaluation.label for evaluation in evaluations) or "Evaluation",
        view=VIEW_HTML if has_view else "",
        steps=values.pop("steps", []),
        sections=[section for section in sections if section["body"] or section["pictures"]],
        versions=package_versions(),
        provenance=json.dumps(values, indent=2, ensure_ascii=False) if values else "",
    )


def template(name: str) -> Template:
    from jinja2 import Environment, PackageLoader, StrictUndefined  # slow import

    environment = Environment(
        loader=PackageLoader("megloc_kapture.evaluation.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def _summary(reported: Reported) -> dict[str, Any]:
    body: list[Markup | None] = []
    for text, table in _facts(reported):
        body += [Markup("<p>{}</p>").format(line) for line in text.splitlines()]
        body.append(_table(table))
    return _section("Summary" if isinstance(reported, WithoutTruth) else "Recall", body=body)


def _error_curves(evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    from megloc_kapture.evaluation.report import figures  # loads matplotlib

    explanation = (
        "Share of all queries at or below an error, separately for position and rotation; queries "
        "without a pose keep the curves below 100 %. Dotted: the thresholds."
    )
    return _section("Errors", [explanation], [_figure(figures.error_curves(evaluations))])


def _sections_of(
    evaluation: Evaluation, map_poses: Poses, *, several: bool
) -> Iterator[dict[str, Any]]:
    from megloc_kapture.evaluation.report import figures, gallery

    whose = f"{evaluation.label}: " if several else ""
    context, has_truth = evaluation.context, evaluation.has_truth
    queries = shown_queries(evaluation)
    above: list[Markup | None] = []
    views = figures.views_from_above(queries, map_poses, context.frames, context.unit)
    for frame, svg in views.items():
        above += [Markup("<h3>{}</h3>").format(frame)] if frame else []
        above.append(_figure(svg))
    lines = "Red lines lead from the true camera centre to the estimate."
    yield _section(f"{whose}From above", [lines] if has_truth else [], above)
    if has_truth:
        explanation = (
            "Errors should decrease to the right. A pose with many inliers and a large error is "
            "typically in a wrong but similar location."
        )
        inliers = _figure(figures.errors_against_inliers(evaluation))
        yield _section(f"{whose}Error against inliers", [explanation], [inliers])
        explanation = (
            "Left: where confidences can be trusted, the dots are on the dotted line. Right: poses "
            "are accepted in order of decreasing confidence."
        )
        confidence, curves = evaluation.confidence, None
        if confidence is not None and confidence.num_poses >= content.FEW:
            curves = _figure(figures.confidence_curves(confidence))
        yield _section(f"{whose}Confidence", [explanation], [curves])
    checks = [_sentence(content.consistency_sentence(row)) for row in context.consistency]
    yield _section(
        f"{whose}Changes by refinement",
        ["Medians over the accepted poses.", *checks],
        [_table(content.refinement_table(evaluation))],
    )
    explanation = (
        "Left: the query; right: the candidate with the most matches. Green matches agree with the "
        f"{'true' if has_truth else 'estimated'} pose, red ones are more than 8 pixels from their "
        "epipolar line."
    )
    pictures = gallery.worst_pictures(worst_queries(queries), context, map_poses)
    yield _section(f"{whose}The worst queries", [explanation], pictures=pictures)
    if has_truth and not several:
        omitted = f"The worst {_MAX_ROWS} of {len(queries)}."
        yield _section(
            "Queries, the worst first",
            [omitted] if len(queries) > _MAX_ROWS else [],
            [_table(content.query_table(evaluation, queries[:_MAX_ROWS]))],
        )


def _view(reported: Reported) -> str | None:
    from megloc_kapture.evaluation.view import render_view, view_data

    if len(reported.evaluations) > 1:
        return None
    (evaluation,) = reported.evaluations
    # a report without a view is better than none; `megloc view` reports the error
    with contextlib.suppress(DataError):
        queries = shown_queries(evaluation)
        data, notes = view_data(evaluation.context, queries)
        return render_view(evaluation.label or "Evaluation", data, queries, notes)
    return None


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."
