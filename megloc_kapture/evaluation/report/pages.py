"""Sections of HTML pages: of one result, of several, of runs with seeds, and without truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from markupsafe import Markup

from megloc_kapture.evaluation.metrics import ALL
from megloc_kapture.evaluation.report import figures, tables
from megloc_kapture.evaluation.report.depth import depth_blocks
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
from megloc_kapture.evaluation.report.gallery import gallery_blocks, query_table
from megloc_kapture.evaluation.report.map_view import views_of_evaluation, views_without_truth
from megloc_kapture.evaluation.report.masks import mask_blocks
from megloc_kapture.evaluation.report.pictures import AGREES, DISAGREES
from megloc_kapture.evaluation.report.queries import (
    QueryPictures,
    disputed_queries,
    doubtful_queries,
    query_pictures,
    worst_queries,
)
from megloc_kapture.evaluation.report.refinement import refinement_blocks
from megloc_kapture.evaluation.report.shown_queries import StoredInliers, shown_queries
from megloc_kapture.evaluation.report.wording import (
    FEW,
    INTERVALS,
    agreement_sentence,
    comparison_sentences,
    confidence_sentences,
    criterion,
    format_degrees,
    format_interval,
    format_metres,
    format_percent,
    method_sentence,
    notes,
)
from megloc_kapture.evaluation.results import ResultContext, are_ranked
from megloc_kapture.evaluation.scoring import Evaluation
from megloc_kapture.evaluation.statistics import Comparison, Seeds
from megloc_kapture.evaluation.without_truth import (
    CAUTION,
    PRIOR_ANGLE_DEG,
    ResultWithoutTruth,
    WithoutTruth,
)
from megloc_kapture.io.dataset_tables import METRES
from megloc_kapture.values import RigidTransform

Poses = Mapping[str, RigidTransform]

_BELOW = f"Below each recall: its {INTERVALS.replace('intervals of recall', 'interval')}."
_DEPTH = "Depth of map images"
_FROM_ABOVE = "Camera centres from above, each error a red line from the truth to the estimate."


def evaluation_page(
    evaluation: Evaluation, map_poses: Poses, stored: StoredInliers
) -> tuple[Section, ...]:
    """Recall, errors, views and single queries of one result.

    Parameters
    ----------
    map_poses : ``cam_from_world`` of the map's images, for the view from above.
    stored : the inliers of the queries, and their context: images, masks and matches.
    """
    context = stored.context
    overall = evaluation.row()
    by_center = evaluation.by_center
    fallbacks = (
        f", {overall.num_fallback} more with a fallback pose" if overall.num_fallback else ""
    )
    missing = f", {overall.num_missing} without a pose" if overall.num_missing else ""
    lost = " Queries without a pose keep the curves below 100 %." if overall.num_missing else ""
    inliers = figures.errors_against_inliers(evaluation)
    # a query that is called by its pair may be there several times
    refined = (
        ()
        if evaluation.pairs
        else refinement_blocks(
            context, evaluation.estimated, evaluation.truth, evaluation.thresholds
        )
    )
    sections = [
        Section(
            (
                Paragraph(
                    f"{overall.num_localized} of {overall.num_queries} queries localized"
                    f"{fallbacks}{missing}. {criterion(evaluation)}"
                ),
                _numbers(evaluation),
            )
        ),
        Section(
            (
                tables.recall_table([evaluation]),
                Paragraph(_BELOW, "soft small"),
                *_notes(evaluation),
            ),
            _recall_heading(evaluation),
        ),
    ]
    if by_center is not None:
        sections.append(
            Section(
                (tables.recall_table([by_center]), Paragraph(_BELOW, "soft small")),
                "The same by the distance of the camera centres",
            )
        )
    sections += [
        Section(
            (
                Paragraph(
                    "Share of all queries at or below an error, each error by itself. Dotted: the "
                    f"thresholds.{lost}"
                ),
                Figure(Markup(figures.recall_curves(evaluation))),
            ),
            "How large the errors are",
        ),
        Section(
            (Paragraph(_FROM_ABOVE), *views_of_evaluation(evaluation, map_poses, context.frames)),
            "Where they are",
        ),
    ]
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
        sections.append(Section((Figure(Markup(inliers)),), "Error against inliers", beside=beside))
    confidence = evaluation.confidence
    if confidence is not None:
        worth: list[Block] = [
            Paragraph(f"{sentence[0].upper()}{sentence[1:]}.")
            for sentence in confidence_sentences(confidence, evaluation.thresholds[-1])
        ]
        if confidence.num_poses < FEW:
            worth.append(Paragraph(f"Too few poses ({confidence.num_poses}) for a diagram."))
        else:
            worth += [
                Paragraph(
                    "Left: poses by their confidence; where it can be trusted, the dots lie on the "
                    "dotted line. Right: poses are accepted from the most confident on."
                ),
                Figure(Markup(figures.confidence_curves(confidence))),
            ]
        sections.append(Section(tuple(worth), "Does it know when it does not know?"))
    sections += _unless_empty("Queries", gallery_blocks(stored, shown_queries(evaluation)))
    sections += _pictured(
        "The worst queries, beside what they match",
        "Left the query, right the candidate with most matches. ",
        query_pictures(worst_queries(evaluation), context, map_poses),
    )
    sections += _unless_empty("What refinement changed", refined)
    sections += _unless_empty("What masks hide", mask_blocks(context.masked))
    sections += _unless_empty(_DEPTH, depth_blocks(context))
    sections += _seconds(context)
    table, num_hidden = query_table(evaluation)
    hidden = (
        f" {num_hidden} better ones are left out here; the CSV table beside this report has them "
        "all."
        if num_hidden
        else ""
    )
    told = f"A filled dot is a threshold met, in the order of the table above.{hidden}"
    sections.append(Section((Paragraph(told), table), "Queries, the worst first"))
    return tuple(sections)


def comparison_page(
    comparison: Comparison, map_poses: Poses, contexts: Sequence[ResultContext]
) -> tuple[Section, ...]:
    """The differences of several results on the same queries, then each of them."""
    items = tuple(
        # a p-value is not broken over two lines
        (text.replace("p = ", "p\u00a0=\u00a0").replace("p < ", "p\u00a0<\u00a0"), real)
        for text, real in comparison_sentences(comparison)
    )
    first = Section(
        (Items(items), Paragraph(method_sentence(comparison), "soft small")),
        "Is the difference real?",
    )
    below = (
        f"{_BELOW} Intervals of two results may overlap although the paired test above finds them "
        "different: it looks at the same queries."
    )
    return _several(comparison.evaluations, first, below, map_poses, contexts)


def seeds_page(
    seeds: Seeds, map_poses: Poses, contexts: Sequence[ResultContext]
) -> tuple[Section, ...]:
    """Mean and spread over runs of one method, then each of them."""
    first = Section(
        (
            Paragraph(
                "Recall in percent: mean and standard deviation of a run; below it the smallest "
                "and the largest."
            ),
            tables.seeds_table(seeds),
            Heading("How often a query is found"),
            tables.found_table(seeds),
        ),
        "Mean and spread",
    )
    return _several(seeds.evaluations, first, _BELOW, map_poses, contexts)


def without_truth_page(
    found: WithoutTruth,
    map_poses: Poses,
    contexts: Sequence[ResultContext],
    stored: StoredInliers,
) -> tuple[Section, ...]:
    """Localized shares, agreement with retrieval and between results, and doubtful queries."""
    sections = [Section((Paragraph(f"No recall: {found.statement} {CAUTION}", "note"),))]
    for number, (result, context) in enumerate(zip(found.results, contexts, strict=True)):
        views = views_without_truth(result, map_poses, context.frames, prefix=f"above{number}-")
        said = "Camera centres from above"
        if are_ranked(query.candidates for query in result.queries):
            said += ", a grey line from the first candidate to the pose"
        blocks: list[Block] = [
            tables.result_table(result),
            Paragraph(_retrieval_note(result), "soft small"),
        ]
        if views:
            blocks += [Heading("Where they are"), Paragraph(f"{said}."), *views]
        sections.append(Section(tuple(blocks), result.label))
    if found.agreement:
        told = (
            "Share of all queries in percent where both results have a pose and the two are no "
            "further apart; below it the 95\u00a0% confidence interval."
        )
        whole = [row for row in found.agreement if row.name == ALL]
        sections.append(
            Section(
                (
                    Paragraph(told),
                    tables.agreement_table(found, found.agreement),
                    *(Paragraph(agreement_sentence(row, found)) for row in whole),
                ),
                "Do they agree?",
            )
        )
    several = list(zip(found.results, contexts, strict=True))
    if len(several) == 1:
        gallery = gallery_blocks(stored, shown_queries(found.results[0]))
        sections += _unless_empty("Queries", gallery)
    for result, context in several:
        sections += _pictured(
            f"{result.label}: localized, but least sure",
            "Far from every candidate, or from few inliers. Left the query, right the candidate "
            "with most matches. ",
            query_pictures(doubtful_queries(result), context, map_poses),
            "estimated",
        )
    if len(several) == 1:
        sections += _seconds(contexts[0])
    for result, context in several:
        blocks_of_result = refinement_blocks(context, result.poses)
        sections += _unless_empty(f"{result.label}: what refinement changed", blocks_of_result)
    for result, context in several:
        sections += _unless_empty(f"{result.label}: what masks hide", mask_blocks(context.masked))
    # of one map or of several: the first shows what stereo makes of such images
    sections += _unless_empty(_DEPTH, depth_blocks(contexts[0]) if contexts else ())
    return tuple(sections)


def _several(
    evaluations: Sequence[Evaluation],
    first: Section,
    below: str,
    map_poses: Poses,
    contexts: Sequence[ResultContext],
) -> tuple[Section, ...]:
    colors = tables.colors_of([evaluation.label for evaluation in evaluations])
    by_row = figures.curves_by_row(evaluations)
    number = evaluations[0].row().num_queries
    sections = [
        Section((Paragraph(f"{number} queries, the same for all. {criterion(evaluations[0])}"),)),
        first,
        Section(
            (
                tables.recall_table(evaluations),
                Paragraph(below, "soft small"),
                Figure(Markup(figures.recall_intervals(evaluations))),
            ),
            _recall_heading(evaluations[0]),
        ),
        Section(
            (
                Paragraph(
                    "Share of all queries at or below an error, each error by itself. Dotted: the "
                    "thresholds."
                ),
                Figure(Markup(figures.compared_curves(evaluations))),
                *((Heading("By condition"), Figure(Markup(by_row))) if by_row else ()),
            ),
            "How large the errors are",
        ),
    ]
    pictures = [QueryPictures(context, map_poses) for context in contexts]
    sections += _pictured(
        "Queries to look at",
        "First those the results disagree about, then those that are worst in all of them. Left "
        "the query, right the candidate with most matches, of the result that does worst on it. ",
        [pictures[worst].of(chosen) for worst, chosen in disputed_queries(evaluations)],
    )
    for number, (evaluation, context) in enumerate(zip(evaluations, contexts, strict=True)):
        inliers = figures.errors_against_inliers(evaluation, prefix=f"inliers{number}")
        views = views_of_evaluation(evaluation, map_poses, context.frames, prefix=f"above{number}-")
        blocks: list[Block] = [
            *_notes(evaluation),
            Heading("Where they are"),
            Paragraph(_FROM_ABOVE),
            *views,
        ]
        if inliers is not None:
            blocks += [Heading("Error against inliers"), Figure(Markup(inliers), narrow=True)]
        sections.append(Section(tuple(blocks), evaluation.label, color=colors[evaluation.label]))
    return tuple(sections)


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
    return [Section((Paragraph(Markup("{}{}").format(intro, key)), *pictures), heading)]


def _seconds(context: ResultContext) -> list[Section]:
    # a run's own report has none: two runs give the same bytes
    if not context.seconds:
        return []
    told = "Each stage when it last ran. timing.csv of the run has seconds per query and step."
    return [Section((Paragraph(told), tables.seconds_table(context.seconds)), "How long it took")]


def _unless_empty(heading: str, blocks: tuple[Block, ...]) -> list[Section]:
    return [Section(blocks, heading)] if blocks else []


def _numbers(evaluation: Evaluation) -> Numbers:
    """Recall at each threshold and the median error, as large figures."""
    overall = evaluation.row()
    shown = [
        (
            format_percent(at.recall),
            "%",
            (f"within {at.threshold}", f"95 % interval {format_interval(at)}"),
        )
        for at in overall.recall
    ]
    if overall.num_missing * 2 > overall.num_queries:
        return Numbers((*shown, ("none", "", ("median: most lack a pose",))))
    below = f"median, {format_degrees(overall.median_angle_deg)} deg"
    return Numbers((*shown, (format_metres(overall.median_position_m), "m", (below,))))


def _notes(evaluation: Evaluation) -> list[Paragraph]:
    return [Paragraph(f"{note[0].upper()}{note[1:]}.", "note") for note in notes(evaluation)]


def _recall_heading(evaluation: Evaluation) -> str:
    relative = evaluation.by_center is not None
    return "Recall" + (" by the translation relative to the reference" if relative else "")


def _retrieval_note(result: ResultWithoutTruth) -> str:
    first, unit = result.rows[-1].first_candidate, result.context.unit
    if unit != METRES:
        return f"The map is in {unit} of its own, so nothing is said about distances."
    if first is None:
        return (
            "No map or no ranked candidates are known, so nothing is said about agreement with "
            "retrieval."
        )
    return (
        f"Of {first.num_compared} localized queries with candidates in the map; in its direction: "
        f"within {PRIOR_ANGLE_DEG:g} degrees of the first candidate's. Fallback poses are in no "
        "figure but their own."
    )
