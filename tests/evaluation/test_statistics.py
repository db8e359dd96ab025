"""Paired tests of results, and the spread over seeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scored import evaluate_poses, shifted

from megloc_kapture.errors import OptionError
from megloc_kapture.evaluation.comparison import (
    _resampled_medians,
    compare,
    difference_interval,
    holm,
    mcnemar,
)
from megloc_kapture.evaluation.metrics import Threshold
from megloc_kapture.evaluation.scoring import Evaluation
from megloc_kapture.values import RigidTransform

HERE = RigidTransform.identity()
METRE = Threshold(position_m=1.0)


def result(label: str, errors_m: Sequence[float], **options: Any) -> Evaluation:
    """A result whose queries are off by these metres; infinite: no pose."""
    names = [f"{i:04d}.jpg" for i in range(len(errors_m))]
    estimated = {
        name: shifted(error)
        for name, error in zip(names, errors_m, strict=True)
        if np.isfinite(error)
    }
    options = {"thresholds": [METRE]} | options
    return evaluate_poses(estimated, dict.fromkeys(names, HERE), label=label, **options)


def test_equal_to_scipys_binomial_test() -> None:
    assert mcnemar(0, 0) == 1.0
    for only_first, only_second in ((0, 1), (3, 3), (4, 3), (12, 0), (2, 17), (150, 190)):
        theirs = stats.binomtest(only_first, only_first + only_second, 0.5).pvalue
        assert mcnemar(only_first, only_second) == pytest.approx(theirs, rel=1e-9)


def test_holm_by_hand() -> None:
    # smallest times 4, then 3, 2, 1, never falling, never above 1
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.9]).tolist() == [1.0, 1.0]
    assert holm([0.02]).tolist() == [0.02]
    assert holm([]).tolist() == []


def test_a_large_paired_difference_is_real_although_intervals_overlap() -> None:
    rng = np.random.default_rng(0)
    errors = np.where(rng.random(200) < 0.8, 0.1, 9.0)
    worse = errors.copy()
    worse[np.flatnonzero(errors < 1)[:12]] = 9.0
    better, other = result("A", errors.tolist()), result("B", worse.tolist())
    (test,) = compare([better, other]).tests
    assert test.is_real
    assert test.p_value == pytest.approx(2 * 0.5**12)
    assert other.row().recall[0].high > better.row().recall[0].low


def test_tests_of_all_thresholds_and_pairs_are_corrected() -> None:
    rng = np.random.default_rng(1)
    thresholds = [METRE, Threshold(position_m=5.0, angle_deg=10.0)]
    results = [result(x, 10 ** rng.normal(0, 1, 60), thresholds=thresholds) for x in "ABC"]
    actual = compare(results)
    assert len(actual.tests) == 3 * 2
    expected = holm([test.p_value for test in actual.tests])
    assert [test.p_adjusted for test in actual.tests] == pytest.approx(expected.tolist())
    for test in actual.tests:
        assert len(test.only_first) + len(test.only_second) + test.both + test.neither == 60
    assert [(m.first, m.second) for m in actual.medians] == [("A", "B"), ("A", "C"), ("B", "C")]


def test_the_interval_of_a_median_difference_covers_the_true_one() -> None:
    rng = np.random.default_rng(3)
    num_runs, held = 40, 0
    # log-normal errors: medians 0.1 and 0.13
    for _ in range(num_runs):
        shared = rng.normal(0, 0.7, 90)
        first = 0.10 * np.exp(shared + rng.normal(0, 0.5, 90))
        second = 0.13 * np.exp(shared + rng.normal(0, 0.5, 90))
        low, high = difference_interval(_resampled_medians(first), _resampled_medians(second))
        held += low <= -0.03 <= high
    assert 0.95 - 3.5 * np.sqrt(0.05 * 0.95 / num_runs) <= held / num_runs < 1.0


def test_medians_with_missing_poses() -> None:
    values = np.array([0.1] * 40 + [np.inf] * 60)
    medians = _resampled_medians(values)
    assert np.isinf(np.median(medians)) and np.isfinite(medians.min())
    assert difference_interval(medians, medians) == (0.0, 0.0)
    low, high = difference_interval(_resampled_medians(np.full(100, 0.1)), medians)
    assert low == -np.inf and high <= 0.0


def test_incomparable_results_are_refused() -> None:
    first, same = result("A", [0.1, 0.2]), [0.1, 0.3]
    for others, words in (
        ([], "at least two"),
        ([result("A", same)], "two results are called 'A'"),
        ([result("B", same, thresholds=[Threshold(position_m=2.0)])], "different thresholds"),
        ([result("B", [*same, 0.2])], "A and B have different queries"),
        ([result("B", same, conditions={"0000.jpg": "night"})], "different conditions"),
    ):
        with pytest.raises(OptionError, match=words):
            compare([first, *others])
