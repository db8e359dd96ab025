"""What a comparison found, in plain sentences; the text file and the report say the same."""

from __future__ import annotations

import math
from collections.abc import Sequence

from megloc_kapture.evaluation.comparison import (
    SIGNIFICANCE,
    Comparison,
    MedianDifference,
    PairedTest,
)
from megloc_kapture.evaluation.recall import ALL
from megloc_kapture.evaluation.tables import counted, display_name, format_metres, format_p


def threshold_sentence(test: PairedTest, labels: Sequence[str]) -> str:
    """Which of two results finds what the other misses, and whether that is more than chance."""
    first, second = labels[test.first], labels[test.second]
    where = f"At {test.threshold}"
    if test.row != ALL:
        where = f"{display_name(test.row)}, at {test.threshold}"
    only_first, only_second = len(test.only_first), len(test.only_second)
    if not only_first and not only_second:
        if not test.num_both:
            return f"{where} neither {first} nor {second} finds a query."
        return f"{where} {first} and {second} find the same {_queries(test.num_both)}."
    return (
        f"{where} {first} finds {_queries(only_first)} that {second} misses and {second} finds "
        f"{only_second or 'none'} that {first} misses: {_verdict(test)}."
    )


def _verdict(test: PairedTest) -> str:
    p = format_p(test.p_adjusted)
    if test.is_real:
        return f"the difference is real ({p})"
    # the most uneven split of so few would not do either
    if 2.0 * 0.5 ** (len(test.only_first) + len(test.only_second)) > SIGNIFICANCE:
        return f"too few queries differ to tell it from chance ({p})"
    return f"the difference could be chance ({p})"


def median_sentence(difference: MedianDifference, labels: Sequence[str]) -> str:
    """The medians of two results, and whether they differ by more than chance."""
    pair = (labels[difference.first], labels[difference.second])
    medians = (difference.first_m, difference.second_m)
    lost = [label for label, value in zip(pair, medians, strict=True) if math.isinf(value)]
    if lost:
        return f"Most queries of {' and of '.join(lost)} have no pose, so there is no median."
    apart = medians[0] - medians[1]
    verdict = "the difference is real" if difference.is_real else "the difference could be chance"
    interval = f"{_signed(difference.low_m)} to {_signed(difference.high_m)}"
    return (
        f"The median position error is {format_metres(medians[0])} m for {pair[0]} and "
        f"{format_metres(medians[1])} m for {pair[1]}: {_signed(apart)} m, 95 % interval "
        f"{interval} m; {verdict}."
    )


def comparison_sentences(comparison: Comparison) -> list[tuple[str, bool]]:
    """All that is to say of all queries together, then what is real in single conditions; each
    sentence with whether it tells of a real difference."""
    labels = [evaluation.label for evaluation in comparison.evaluations]
    said = [(threshold_sentence(test, labels), test.is_real) for test in comparison.tests]
    said += [(median_sentence(median, labels), median.is_real) for median in comparison.medians]
    real = [test for test in comparison.tests_by_row if test.is_real]
    said += [(threshold_sentence(test, labels), True) for test in real]
    if comparison.tests_by_row and not real:
        said.append(("In no single condition can a difference be told from chance.", False))
    return said


def method_sentence(comparison: Comparison) -> str:
    """How the tests were made."""
    text = (
        "Exact McNemar test on the same queries, taken as independent, two-sided; real: p at or "
        "below 0.05"
    )
    families = [f"{len(comparison.tests)} tests of all queries"]
    if comparison.tests_by_row:
        families.append(f"{len(comparison.tests_by_row)} of the conditions")
    if len(comparison.tests) > 1 or comparison.tests_by_row:
        text += f", after Holm's correction (for the {' and for the '.join(families)})"
    return f"{text}. Intervals of medians: 2000 resamples of the queries."


def _queries(number: int) -> str:
    return "no query" if number == 0 else counted(number, "query", "queries")


def _signed(metres: float) -> str:
    if math.isinf(metres):
        return "-inf" if metres < 0 else "+inf"
    return f"{'-' if metres < 0 else '+'}{format_metres(abs(metres))}"
