"""Sections of HTML pages: of one result, of several, of runs with seeds, and without truth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from markupsafe import Markup

from megloc_kapture.evaluation.metrics import ALL
from megloc_kapture.evaluation.report import figures, tables
from megloc_kapture.evaluation.report.document import (
    Block,
    Figure,
    Heading,
    Items,
    Numbers,
    Paragraph,
    Pictures,
    Section,
)
from megloc_kapture.evaluation.report.gallery import (
    AGREES,
    DISAGREES,
    QueryPictures,
    gallery_blocks,
    query_pictures,
    query_table,
)
from megloc_kapture.evaluation.report.map_view import views_of
from megloc_kapture.evaluation.report.pictures import depth_blocks, mask_blocks
from megloc_kapture.evaluation.report.queries import (
    StoredInliers,
    disputed_queries,
    doubtful_queries,
    shown_queries,
    worst_queries,
)
from megloc_kapture.evaluation.report.refinement import refinement_blocks
from megloc_kapture.evaluation.report.wording import (
    CONFIDENT,
    FEW,
    INTERVALS,
    agreement_sentence,
    comparison_sentences,
    confidence_sentences,
    covariance_sentence,
    criterion,
    format_degrees,
    format_interval,
    format_metres,
    format_percent,
    method_sentence,
    no_retrieval,
    notes,
)
from megloc_kapture.evaluation.results import Poses, ResultContext, are_ranked
from megloc_kapture.evaluation.scoring import Evaluation
from megloc_kapture.evaluation.statistics import Comparison, Seeds
from megloc_kapture.evaluation.without_truth import (
    CAUTION,
    PRIOR_ANGLE_DEG,
    ResultWithoutTruth,
    WithoutTruth,
)

_BELOW = f"Below each recall: its {INTERVALS.replace('intervals of recall', 'interval')}."
_DEPTH = "Depth of map images"
_ERRORS, _INLIERS, _WHERE = "How large the errors are", "Error against inliers", "Where they are"
_FROM_ABOVE = "Camera centres from above, each error a red line from the truth to the estimate."
_CURVES = "Share of all queries at or below an error, each error by itself. Dotted: the thresholds."


def evaluation_page(
    evaluation: Evaluation, map_poses: Poses, stored: StoredInliers
) -> tuple[Section, ...]:
    """Recall, errors, views and single queries of one result.

    Parameters
    ----------
    map_poses : ``cam_from_world`` of the map's images, for the view from above.
    stored : the inliers of the queries, and their context: images, masks and matches.
    """
    context, overall = stored.context, evaluation.row()
    head = f"{overall.num_localized} of {overall.num_queries} queries localized"
    if overall.num_fallback:
        head += f", {overall.num_fallback} more with a fallback pose"
    lost = ""
    if overall.num_missing:
        head += f", {overall.num_missing} without a pose"
        lost = " Queries without a pose keep the curves below 100 %."
    recall = [tables.recall_table([evaluation]), _soft(_BELOW), *_notes(evaluation)]
    sections = [
        Section((Paragraph(f"{head}. {criterion(evaluation)}"), _numbers(evaluation))),
        *_section(_recall_heading(evaluation), recall),
    ]
    if evaluation.by_center is not None:
        by_center = [tables.recall_table([evaluation.by_center]), _soft(_BELOW)]
        sections += _section("The same by the distance of the camera centres", by_center)
    curves = [Paragraph(f"{_CURVES}{lost}"), Figure(figures.recall_curves(evaluation))]
    views = views_of(evaluation, map_poses, context.frames)
    sections += _section(_ERRORS, curves)
    sections += _section(_WHERE, [Paragraph(_FROM_ABOVE), *views])
    inliers = figures.errors_against_inliers(evaluation)
    if inliers is not None:
        explained = (
            Paragraph(
                "Each dot is a pose. Errors should fall towards the right. Many inliers with a "
                "large error mean a wrong place believed in: repeated structure, or a map that is "
                "off. A small error from few inliers may not come again with another seed."
            ),
            Paragraph("Dotted: the thresholds. Queries without a pose are not shown."),
        )
        beside = Section(explained, "How to read it")
        sections.append(Section((Figure(inliers),), _INLIERS, beside=beside))
    sections += _section("Does it know when it does not know?", _confidence(evaluation))
    sections += _section("Queries", gallery_blocks(stored, shown_queries(evaluation)))
    sections += _pictured(
        "The worst queries, beside what they match",
        "Left the query, right the candidate with most matches. ",
        query_pictures(worst_queries(evaluation), context, map_poses),
    )
    if not evaluation.pairs:  # a query that is called by its pair may be there several times
        of_result = evaluation.estimated, evaluation.truth, evaluation.thresholds
        sections += _section("What refinement changed", refinement_blocks(context, *of_result))
    sections += _section("What masks hide", mask_blocks(context.masked))
    sections += _section(_DEPTH, depth_blocks(context)) + _seconds(context)
    table, num_hidden = query_table(evaluation)
    told = "A filled dot is a threshold met, in the order of the table above."
    if num_hidden:
        told += (
            f" {num_hidden} better ones are left out here; the CSV table beside this report has "
            "them all."
        )
    return (*sections, *_section("Queries, the worst first", [Paragraph(told), table]))


def comparison_page(comparison: Comparison, map_poses: Poses) -> tuple[Section, ...]:
    """The differences of several results on the same queries, then each of them."""
    items = tuple(
        # a p-value is not broken over two lines
        (text.replace("p = ", "p\u00a0=\u00a0").replace("p < ", "p\u00a0<\u00a0"), real)
        for text, real in comparison_sentences(comparison)
    )
    first = _section("Is the difference real?", [Items(items), _soft(method_sentence(comparison))])
    below = (
        f"{_BELOW} Intervals of two results may overlap although the paired test above finds them "
        "different: it looks at the same queries."
    )
    return _several(comparison.evaluations, first, below, map_poses)


def seeds_page(seeds: Seeds, map_poses: Poses) -> tuple[Section, ...]:
    """Mean and spread over runs of one method, then each of them."""
    told = (
        "Recall in percent: mean and standard deviation of a run; below it the smallest and the "
        "largest."
    )
    found = [Heading("How often a query is found"), tables.found_table(seeds)]
    first = _section("Mean and spread", [Paragraph(told), tables.seeds_table(seeds), *found])
    return _several(seeds.evaluations, first, _BELOW, map_poses)


def without_truth_page(
    found: WithoutTruth, map_poses: Poses, stored: StoredInliers
) -> tuple[Section, ...]:
    """Localized shares, agreement with retrieval and between results, and doubtful queries."""
    sections = [Section((Paragraph(f"No recall: {found.statement} {CAUTION}", "note"),))]
    for number, result in enumerate(found.results):
        views = views_of(result, map_poses, result.context.frames, prefix=f"above{number}-")
        said = "Camera centres from above"
        if are_ranked(query.candidates for query in result.queries):
            said += ", a grey line from the first candidate to the pose"
        blocks: list[Block] = [tables.result_table(result), _soft(_retrieval_note(result))]
        if views:
            blocks += [Heading(_WHERE), Paragraph(f"{said}."), *views]
        sections += _section(result.label, blocks)
    if found.agreement:
        told = (
            "Share of all queries in percent where both results have a pose and the two are no "
            "further apart; below it the 95\u00a0% confidence interval."
        )
        whole = [agreement_sentence(row, found) for row in found.agreement if row.name == ALL]
        table = tables.agreement_table(found, found.agreement)
        sections += _section("Do they agree?", [Paragraph(told), table, *map(Paragraph, whole)])
    if len(found.results) == 1:
        sections += _section("Queries", gallery_blocks(stored, shown_queries(found.results[0])))
    for result in found.results:
        sections += _pictured(
            f"{result.label}: localized, but least sure",
            "Far from every candidate, or from few inliers. Left the query, right the candidate "
            "with most matches. ",
            query_pictures(doubtful_queries(result), result.context, map_poses),
            "estimated",
        )
    if len(found.results) == 1:
        sections += _seconds(stored.context)
    for result in found.results:
        changed = refinement_blocks(result.context, result.poses)
        sections += _section(f"{result.label}: what refinement changed", changed)
    for result in found.results:
        masked = mask_blocks(result.context.masked)
        sections += _section(f"{result.label}: what masks hide", masked)
    # of one map or of several: the first shows what stereo makes of such images
    sections += _section(_DEPTH, depth_blocks(stored.context))
    return tuple(sections)


def _several(
    evaluations: Sequence[Evaluation],
    first: list[Section],
    below: str,
    map_poses: Poses,
) -> tuple[Section, ...]:
    colors = tables.colors_of([evaluation.label for evaluation in evaluations])
    number = evaluations[0].row().num_queries
    told = f"{number} queries, the same for all. {criterion(evaluations[0])}"
    recall = [
        tables.recall_table(evaluations),
        _soft(below),
        Figure(figures.recall_intervals(evaluations)),
    ]
    curves: list[Block] = [Paragraph(_CURVES), Figure(figures.compared_curves(evaluations))]
    if (by_row := figures.curves_by_row(evaluations)) is not None:
        curves += [Heading("By condition"), Figure(by_row)]
    sections = [
        Section((Paragraph(told),)),
        *first,
        *_section(_recall_heading(evaluations[0]), recall),
        *_section(_ERRORS, curves),
    ]
    pictures = [QueryPictures(evaluation.context, map_poses) for evaluation in evaluations]
    sections += _pictured(
        "Queries to look at",
        "First those the results disagree about, then those that are worst in all of them. Left "
        "the query, right the candidate with most matches, of the result that does worst on it. ",
        [pictures[worst].of(chosen) for worst, chosen in disputed_queries(evaluations)],
    )
    for number, evaluation in enumerate(evaluations):
        frames, prefix = evaluation.context.frames, f"above{number}-"
        inliers = figures.errors_against_inliers(evaluation, prefix=f"inliers{number}")
        views = views_of(evaluation, map_poses, frames, prefix=prefix)
        blocks = [*_notes(evaluation), Heading(_WHERE), Paragraph(_FROM_ABOVE), *views]
        if inliers is not None:
            blocks += [Heading(_INLIERS), Figure(inliers, narrow=True)]
        sections.append(Section(tuple(blocks), evaluation.label, color=colors[evaluation.label]))
    return tuple(sections)


def _section(heading: str, blocks: Iterable[Block]) -> list[Section]:
    """A section of these blocks; none where there are none."""
    shown = tuple(blocks)
    return [Section(shown, heading)] if shown else []


def _soft(text: str) -> Paragraph:
    return Paragraph(text, "soft small")


def _pictured(
    heading: str, intro: str, pictures: Sequence[Pictures], pose_name: str = "true"
) -> list[Section]:
    """A section of queries with matches; none where no query's image can be shown."""
    if not any(one.main for one in pictures):
        return []
    line = Markup('<span class="keep"><span class="line" style="background:{}"></span>{}</span>')
    key = Markup("Lines are matches: {} {} (more than 8 pixels beside its epipolar line).").format(
        line.format(AGREES, f"agrees with the {pose_name} pose,"),
        line.format(DISAGREES, "does not"),
    )
    return _section(heading, [Paragraph(Markup("{}{}").format(intro, key)), *pictures])


def _confidence(evaluation: Evaluation) -> list[Block]:
    """The worth of a result's confidences and covariances; empty where it brings none."""
    confidence, said = evaluation.confidence, []
    if confidence is not None:
        said += confidence_sentences(confidence, evaluation.thresholds[-1])
    if evaluation.covariance is not None:
        said.append(covariance_sentence(evaluation.covariance))
    blocks: list[Block] = [Paragraph(_as_sentence(one)) for one in said]
    if confidence is None:
        return blocks
    if (confident := tables.confident_table(evaluation)) is not None:
        blocks += [Paragraph(f"{CONFIDENT}:"), confident]
    if confidence.num_poses < FEW:
        return [*blocks, Paragraph(f"Too few poses ({confidence.num_poses}) for a diagram.")]
    told = (
        "Left: poses by their confidence; where it can be trusted, the dots lie on the dotted "
        "line. Right: poses are accepted from the most confident on."
    )
    return [*blocks, Paragraph(told), Figure(figures.confidence_curves(confidence))]


def _seconds(context: ResultContext) -> list[Section]:
    # a run's own report has none: two runs give the same bytes
    if not context.seconds:
        return []
    told = "Each stage when it last ran. timing.csv of the run has seconds per query and step."
    return _section("How long it took", [Paragraph(told), tables.seconds_table(context.seconds)])


def _numbers(evaluation: Evaluation) -> Numbers:
    """Recall at each threshold and the median error, as large figures."""
    overall = evaluation.row()
    shown = []
    for at in overall.recall:
        below = (f"within {at.threshold}", f"95 % interval {format_interval(at)}")
        shown.append((format_percent(at.recall), "%", below))
    if overall.num_missing * 2 > overall.num_queries:
        return Numbers((*shown, ("none", "", ("median: most lack a pose",))))
    median = f"median, {format_degrees(overall.median_angle_deg)} deg"
    return Numbers((*shown, (format_metres(overall.median_position_m), "m", (median,))))


def _notes(evaluation: Evaluation) -> list[Block]:
    return [Paragraph(_as_sentence(note), "note") for note in notes(evaluation)]


def _as_sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


def _recall_heading(evaluation: Evaluation) -> str:
    relative = evaluation.by_center is not None
    return "Recall" + (" by the translation relative to the reference" if relative else "")


def _retrieval_note(result: ResultWithoutTruth) -> str:
    first = result.rows[-1].first_candidate
    if (unknown := no_retrieval(result)) or first is None:
        return _as_sentence(unknown)
    return (
        f"Of {first.num_compared} localized queries with candidates in the map; in its direction: "
        f"within {PRIOR_ANGLE_DEG:g} degrees of the first candidate's. Fallback poses are in no "
        "figure but their own."
    )
