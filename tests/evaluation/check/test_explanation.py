"""When a reading counts as explaining a file."""

from __future__ import annotations

import numpy as np

from megloc_kapture.evaluation.check.explanation import explain, undecided

ALL = np.ones((3, 10), dtype=bool)


def scores(*means: float, number: int = 10, spread: float = 0.2) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.array(means)[:, None] + rng.normal(0, spread, (len(means), number))


def test_a_clear_gain_explains() -> None:
    found = explain(scores(-5, -1, -5), ALL, [0, 1, 1])
    assert found is not None and found.reading == 1 and found.as_good == ()
    assert (found.fitting, found.fitting_as_is) == (1.0, 1.0)


def test_no_gain_explains_nothing() -> None:
    assert explain(scores(-1, -1, -5), ALL, [0, 1, 1]) is None
    assert explain(scores(-1, -0.6, -5), ALL, [0, 1, 1]) is None


def test_a_gain_has_to_be_most_poses() -> None:
    given = scores(-5, -5, -5)
    given[1, :5] = 0.0
    assert explain(given, ALL, [0, 1, 1]) is None
    given[1, :7] = 0.0
    assert explain(given, ALL, [0, 1, 1]) is not None


def test_poses_have_to_fit_where_they_are_put() -> None:
    fits = ALL.copy()
    fits[1, :6] = False
    assert explain(scores(-5, -1, -5), fits, [0, 1, 1]) is None


def test_of_equals_both_are_told_and_the_simpler_comes_first() -> None:
    found = explain(scores(-5, -1.1, -1), ALL, [0, 1, 1])
    assert found is not None and {found.reading, *found.as_good} == {1, 2}
    found = explain(scores(-5, -1.1, -1), ALL, [0, 1, 2])
    assert found is not None and (found.reading, found.as_good) == (1, ())
    found = explain(scores(-5, -3, -0.5), ALL, [0, 1, 2])
    assert found is not None and (found.reading, found.as_good) == (2, ())


def test_few_poses_say_nothing() -> None:
    given = scores(-5, -1, -5)
    assert explain(given[:, :2], ALL[:, :2], [0, 1, 1]) is None
    assert explain(given[:, :0], ALL[:, :0], [0, 1, 1]) is None
    assert explain(given[:, :3], ALL[:, :3], [0, 1, 1]) is not None


def test_infinite_distances_are_no_numbers_to_trip_over() -> None:
    given = scores(-5, -1, -5)
    given[0, :4] = given[2, :4] = -np.inf
    found = explain(given, ALL, [0, 1, 1])
    assert found is not None and found.reading == 1
    assert explain(np.full((3, 10), -np.inf), ~ALL, [0, 1, 1]) is None


def test_what_is_not_ruled_out() -> None:
    assert undecided(scores(-1, -1.1, -4)) == [1]
    assert undecided(scores(-1, -3, -4)) == []
