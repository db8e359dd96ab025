"""Reports of results: text, JSON, a CSV table and an HTML page."""

from __future__ import annotations

import base64
import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import groupby
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from pydantic import BaseModel

from megloc_kapture.errors import DataError
from megloc_kapture.evaluation.pose_files import package_versions
from megloc_kapture.evaluation.report import tables
from megloc_kapture.evaluation.report.queries import (
    ShownQuery,
    StoredInliers,
    shown_queries,
    worst_queries,
)
from megloc_kapture.evaluation.report.wording import (
    CONFIDENT,
    FEW,
    INTERVALS,
    agreement_sentence,
    bounds,
    comparison_sentences,
    confidence_sentences,
    consistency_sentence,
    covariance_sentence,
    criterion,
    format_degrees,
    format_interval,
    format_metres,
    format_percent,
    method_sentence,
    notes,
)
from megloc_kapture.evaluation.results import Poses, first_map_poses
from megloc_kapture.evaluation.scoring import Evaluation
from megloc_kapture.evaluation.statistics import Comparison, MedianDifference, PairedTest
from megloc_kapture.evaluation.without_truth import CAUTION, ResultWithoutTruth, WithoutTruth
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
# more rows than anybody reads; the CSV beside the report has them all
_MAX_ROWS = 500

AnyReported = Evaluation | Comparison | WithoutTruth
_Results = Sequence[Evaluation] | Sequence[ResultWithoutTruth]


def write_report(
    folder: Path | str,
    reported: AnyReported,
    *,
    map_poses: Poses | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> dict[str, Path]:
    """Write the files of a report, each atomically; returns name -> path.

    With truth these are recall.json, recall.txt, per_query.csv and report.html; without truth
    agreement.json and agreement.txt take the place of recall's. A single result has the 3D view
    beside them, view.html.

    Parameters
    ----------
    map_poses : ``cam_from_world`` of the map's images, for the view from above; by default those
        of the first result that has a map.
    provenance : options, preset, inputs: plain JSON data, shown at the end with the versions.
    """
    name = "agreement" if isinstance(reported, WithoutTruth) else "recall"
    view = _view(reported)
    page = render_report(
        reported, map_poses=map_poses, provenance=provenance, has_view=view is not None
    )
    texts = {f"{name}.txt": report_text(reported), REPORT_HTML: page}
    if view is not None:
        texts[VIEW_HTML] = view
    # pandas reads back the very floats; what is infinite is an empty cell
    table = reported.to_pandas().replace([np.inf, -np.inf], np.nan)
    texts[PER_QUERY_CSV] = table.to_csv(lineterminator="\n")
    paths = {file: Path(folder) / file for file in (*texts, f"{name}.json")}
    for file, text in texts.items():
        write_bytes(paths[file], text.encode("utf-8"))
    write_json(paths[f"{name}.json"], plain(report_data(reported)))
    return paths


def report_text(reported: AnyReported) -> str:
    parts = _text_without_truth(reported) if isinstance(reported, WithoutTruth) else _text(reported)
    return "\n\n".join(parts) + "\n"


def _text(reported: Evaluation | Comparison) -> list[str]:
    several = isinstance(reported, Comparison)
    evaluations = reported.evaluations if isinstance(reported, Comparison) else (reported,)
    parts = [] if several or not evaluations[0].label else [evaluations[0].label]
    thresholds = bounds(evaluations[0].thresholds)
    parts.append(f"recall (%) at {thresholds}\n{_wrapped(criterion(evaluations[0]))}")
    parts.append(tables.as_text(tables.recall_table(evaluations)))
    if by_center := [e.by_center for e in evaluations if e.by_center is not None]:
        table = tables.as_text(tables.recall_table(by_center))
        parts.append(f"the same by the distance of the camera centres\n{table}")
    parts.append(f"{INTERVALS}\n{tables.as_text(tables.interval_table(evaluations))}")
    for evaluation in evaluations:
        whose = f" of {evaluation.label}" if several else ""
        if (confident := tables.confident_table(evaluation)) is not None:
            parts.append(f"{CONFIDENT}{whose}\n{tables.as_text(confident)}")
        if (confidence := evaluation.confidence) is not None:
            found = "; ".join(confidence_sentences(confidence, evaluation.thresholds[-1]))
            parts.append(_wrapped(f"Confidence{whose}: {found}."))
        if evaluation.covariance is not None:
            found = covariance_sentence(evaluation.covariance)
            parts.append(_wrapped(f"Covariance{whose}: {found}."))
    if isinstance(reported, Comparison):
        parts.append("\n".join(_wrapped(text) for text, _ in comparison_sentences(reported)))
        parts.append(_wrapped(method_sentence(reported)))
    for evaluation in evaluations:
        on = f" on {evaluation.label}" if several else ""
        parts += [_wrapped(f"Note{on}: {note}.") for note in notes(evaluation)]
    return parts


def _text_without_truth(found: WithoutTruth) -> list[str]:
    parts = [f"{_wrapped(f'No recall: {found.statement}')}\n{_wrapped(CAUTION)}"]
    for result in found.results:
        parts.append(f"{result.label}\n{tables.as_text(tables.result_table(result))}")
    for _, group in groupby(found.agreement, key=lambda row: (row.first, row.second)):
        rows = list(group)
        what = (
            "% of all queries where both have a pose and the two are at most "
            f"{bounds(found.thresholds)} apart"
        )
        table = tables.as_text(tables.agreement_table(found, rows))
        parts.append(f"{_wrapped(what)}\n{table}\n{agreement_sentence(rows[-1], found)}")
    return parts


def _wrapped(text: str) -> str:
    return fill(text, _WIDTH, break_long_words=False, break_on_hyphens=False)


def report_data(reported: AnyReported) -> dict[str, Any]:
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
    labels = [evaluation.label for evaluation in reported.evaluations]

    def named(test: PairedTest | MedianDifference) -> dict[str, Any]:
        pair = {"first": labels[test.first], "second": labels[test.second]}
        return {**asdict(test), **pair, "real": test.is_real}

    return {
        "results": [_recall_data(evaluation) for evaluation in reported.evaluations],
        "comparison": {
            "method": method_sentence(reported),
            "sentences": [sentence for sentence, _ in comparison_sentences(reported)],
            "tests": [named(test) for test in reported.tests],
            "medians": [named(median) for median in reported.medians],
        },
    }


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


def plain(data: Any) -> Any:
    """Data for JSON: models as mappings, and None for numbers that are not finite."""
    if isinstance(data, BaseModel):
        return data.model_dump(mode="json")
    if isinstance(data, Mapping):
        return {key: plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [plain(value) for value in data]
    return None if isinstance(data, float) and not np.isfinite(data) else data


@dataclass
class Section:
    """A card of the page: paragraphs, then tables and figures in their order, then pictures."""

    heading: str
    paragraphs: list[str] = field(default_factory=list)
    body: list[Markup] = field(default_factory=list)
    pictures: Sequence[Picture] = ()

    def table(self, frame: DataFrame | None) -> None:
        if frame is not None:
            import pandas as pd

            with pd.option_context("display.max_colwidth", None):
                html = frame.to_html(index=False, border=0, justify="left")
            self.body.append(Markup('<div class="scroll">{}</div>').format(Markup(html)))

    def figure(self, svg: bytes | None) -> None:
        if svg is not None:
            data = base64.b64encode(svg).decode("ascii")
            self.body.append(Markup('<img src="data:image/svg+xml;base64,{}">').format(data))


def render_report(
    reported: AnyReported,
    *,
    map_poses: Poses | None = None,
    provenance: Mapping[str, Any] | None = None,
    has_view: bool = False,
) -> str:
    """Render the page alone; it is self-contained, and the same arguments give the same text."""
    results = _results(reported)
    if map_poses is None:
        map_poses = first_map_poses(result.context for result in results)
    if isinstance(reported, WithoutTruth):
        sections = _sections_without_truth(reported)
    else:
        sections = _sections(reported)
    for result in results:
        sections += _sections_of(result, map_poses, several=len(results) > 1)
    # only a report with images waits for what reads them
    from megloc_kapture.evaluation.report.gallery import depth_pictures, mask_pictures

    context, shown = results[0].context, "What masks hide is shaded."
    sections += [
        Section("Masks", [shown], pictures=mask_pictures(context.masked)),
        Section(
            "Depth of map images by stereo",
            ["Yellow is near, purple is far, dark is unknown."],
            pictures=depth_pictures(context.mapping),
        ),
    ]
    values = dict(provenance or {})
    return template("report.html").render(
        title=" and ".join(result.label for result in results) or "Evaluation",
        numbers=_numbers(reported) if isinstance(reported, Evaluation) else [],
        view=VIEW_HTML if has_view else "",
        steps=values.pop("steps", []),
        sections=[s for s in sections if s.body or s.pictures or not s.heading],
        versions=package_versions(),
        provenance=json.dumps(values, indent=2, ensure_ascii=False) if values else "",
    )


def template(name: str) -> Template:
    """A template of pages; values are escaped, and a missing value is an error."""
    from jinja2 import Environment, PackageLoader, StrictUndefined  # only a page waits for it

    environment = Environment(
        loader=PackageLoader("megloc_kapture.evaluation.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def _results(reported: AnyReported) -> _Results:
    if isinstance(reported, Evaluation):
        return (reported,)
    return reported.results if isinstance(reported, WithoutTruth) else reported.evaluations


def _numbers(evaluation: Evaluation) -> list[tuple[str, str, str]]:
    overall = evaluation.row()
    shown = [
        (
            f"{format_percent(at.recall)} %",
            f"within {at.threshold}",
            f"95 % interval {format_interval(at)}",
        )
        for at in overall.recall
    ]
    if not np.isfinite(overall.median_position_m):
        return [*shown, ("none", "median", "most queries lack a pose")]
    degrees = f"{format_degrees(overall.median_angle_deg)} deg"
    return [*shown, (f"{format_metres(overall.median_position_m)} m", "median", degrees)]


def _sections(reported: Evaluation | Comparison) -> list[Section]:
    from megloc_kapture.evaluation.report import figures  # loads matplotlib

    several = isinstance(reported, Comparison)
    evaluations = reported.evaluations if isinstance(reported, Comparison) else (reported,)
    overall = evaluations[0].row()
    head = f"{overall.num_queries} queries. {criterion(evaluations[0])}"
    sections = [Section("", [head])]
    if isinstance(reported, Comparison):
        sentences = comparison_sentences(reported)
        item = Markup('<li class="{}">{}</li>')
        items = (item.format("real" if real else "", text) for text, real in sentences)
        listed = Markup('<ul class="said">{}</ul>').format(Markup("").join(items))
        real = Section("Is the difference real?", [method_sentence(reported)], [listed])
        sections.append(real)
    recall = Section("Recall", [f"At {bounds(evaluations[0].thresholds)}."])
    recall.table(tables.recall_table(evaluations))
    if by_center := [e.by_center for e in evaluations if e.by_center is not None]:
        recall.body.append(Markup("<p>The same by the distance of the camera centres:</p>"))
        recall.table(tables.recall_table(by_center))
    recall.body.append(Markup("<p>{}:</p>").format(INTERVALS))
    recall.table(tables.interval_table(evaluations))
    for evaluation in evaluations:
        on = f"{evaluation.label}: " if several else ""
        note = Markup('<p class="note">{}</p>')
        recall.body += [note.format(_sentence(on + text)) for text in notes(evaluation)]
    curves = (
        "Share of all queries at or below an error, each error by itself; queries without a pose "
        "keep the curves below 100 %. Dotted: the thresholds."
    )
    errors = Section("How large the errors are", [curves])
    errors.figure(figures.error_curves(evaluations))
    return [*sections, recall, errors]


def _sections_without_truth(found: WithoutTruth) -> list[Section]:
    sections = [Section("", [f"No recall: {found.statement} {CAUTION}"])]
    for result in found.results:
        sections.append(Section(result.label))
        sections[-1].table(tables.result_table(result))
    if found.agreement:
        what = (
            "Share of all queries where both results have a pose and the two are at most "
            f"{bounds(found.thresholds)} apart."
        )
        whole = [agreement_sentence(row, found) for row in found.agreement if row.name == "all"]
        sections.append(Section("Do they agree?", [what, *whole]))
        sections[-1].table(tables.agreement_table(found, found.agreement))
    return sections


def _sections_of(
    result: Evaluation | ResultWithoutTruth, map_poses: Poses, *, several: bool
) -> list[Section]:
    from megloc_kapture.evaluation.report import figures, gallery

    whose = f"{result.label}: " if several else ""
    context, queries = result.context, shown_queries(result)
    evaluation = result if isinstance(result, Evaluation) else None
    views = figures.views_from_above(queries, map_poses, context.frames, context.unit)
    above = Section(f"{whose}From above")
    if evaluation is not None:
        above.paragraphs.append("Red lines lead from the true camera centre to the estimate.")
    for frame, svg in views.items():
        above.body += [Markup("<h3>{}</h3>").format(frame)] if frame else []
        above.figure(svg)
    found = [above]
    if evaluation is not None:
        inliers = Section(
            f"{whose}Error against inliers",
            ["Errors should fall to the right: many inliers with a large error are a wrong place."],
        )
        inliers.figure(figures.errors_against_inliers(evaluation))
        found += [inliers, _confidence(evaluation, whose)]
    refined = Section(f"{whose}What refinement changed", ["Of accepted poses; medians."])
    refined.paragraphs += [_sentence(consistency_sentence(row)) for row in context.consistency]
    refined.table(tables.refinement_table(result))
    which = "estimated" if evaluation is None else "true"
    lines = (
        f"Left the query, right the candidate with most matches. Green matches agree with the "
        f"{which} pose, red ones are more than 8 pixels off their epipolar line."
    )
    pictures = gallery.worst_pictures(worst_queries(queries), context, map_poses)
    found += [refined, Section(f"{whose}The worst queries", [lines], pictures=pictures)]
    if evaluation is not None and not several:
        found.append(_query_list(evaluation, queries))
    return found


def _query_list(evaluation: Evaluation, queries: Sequence[ShownQuery]) -> Section:
    section = Section("Queries, the worst first")
    if len(queries) > _MAX_ROWS:
        section.paragraphs.append(f"The worst {_MAX_ROWS} of {len(queries)}.")
    section.table(tables.query_table(evaluation, queries[:_MAX_ROWS]))
    return section


def _confidence(evaluation: Evaluation, whose: str) -> Section:
    from megloc_kapture.evaluation.report import figures

    section = Section(f"{whose}Confidence")
    confidence = evaluation.confidence
    if confidence is not None:
        sentences = confidence_sentences(confidence, evaluation.thresholds[-1])
        section.paragraphs += map(_sentence, sentences)
    if evaluation.covariance is not None:
        section.paragraphs.append(_sentence(covariance_sentence(evaluation.covariance)))
    if (confident := tables.confident_table(evaluation)) is not None:
        section.body.append(Markup("<p>{}:</p>").format(CONFIDENT))
        section.table(confident)
    if confidence is not None and confidence.num_poses >= FEW:
        explained = (
            "Left: where confidences can be trusted, the dots are on the dotted line. Right: poses "
            "are accepted from the most confident on."
        )
        section.body.append(Markup("<p>{}</p>").format(explained))
        section.figure(figures.confidence_curves(confidence))
    return section


def _view(reported: AnyReported) -> str | None:
    from megloc_kapture.evaluation.report.scene import render_view, scene_of

    results = _results(reported)
    if len(results) > 1:
        return None
    # a report without a view is better than none; `megloc view` says what is broken
    with contextlib.suppress(DataError):
        stored = StoredInliers(results[0].context)
        scene = scene_of(results[0].label or "Evaluation", stored, shown_queries(results[0]))
        return None if scene is None else render_view(scene)
    return None


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."
