"""Hypotheses undo the mistakes they are made of, exactly; and when one explains a file."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial.transform import Rotation

from megloc_kapture.evaluation.check.mistakes import (
    Hypothesis,
    Mistake,
    absolute_hypotheses,
    explain,
    relative_hypotheses,
    restore_absolute,
    restore_relative,
    undecided,
)
from megloc_kapture.io.dataset_tables import SimilarityTransform, World

ALL = np.ones((3, 10), dtype=bool)


def scores(*means: float, number: int = 10, spread: float = 0.2) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.array(means)[:, None] + rng.normal(0, spread, (len(means), number))


def test_a_clear_gain_explains() -> None:
    assert explain(scores(-5, -1, -5), ALL, [0, 1, 1]) == [1]
    # no gain does not
    assert not explain(scores(-1, -1, -5), ALL, [0, 1, 1])
    assert not explain(scores(-1, -0.6, -5), ALL, [0, 1, 1])
    # nor poses that do not fit where they are put
    fits = ALL.copy()
    fits[1, :6] = False
    assert not explain(scores(-5, -1, -5), fits, [0, 1, 1])
    # nor few poses
    given = scores(-5, -1, -5)
    assert not explain(given[:, :2], ALL[:, :2], [0, 1, 1])
    assert not explain(given[:, :0], ALL[:, :0], [0, 1, 1])
    assert explain(given[:, :3], ALL[:, :3], [0, 1, 1])


def test_a_gain_has_to_be_most_poses() -> None:
    given = scores(-5, -5, -5)
    given[1, :5] = 0.0
    assert not explain(given, ALL, [0, 1, 1])
    given[1, :7] = 0.0
    assert explain(given, ALL, [0, 1, 1])


def test_of_equals_both_are_told_and_the_simpler_comes_first() -> None:
    assert set(explain(scores(-5, -1.1, -1), ALL, [0, 1, 1])) == {1, 2}
    assert explain(scores(-5, -1.1, -1), ALL, [0, 1, 2]) == [1]
    assert explain(scores(-5, -3, -0.5), ALL, [0, 1, 2]) == [2]
    assert undecided(scores(-1, -1.1, -4)) == [1]
    assert undecided(scores(-1, -3, -4)) == []


def test_infinite_distances_are_no_numbers_to_trip_over() -> None:
    given = scores(-5, -1, -5)
    given[0, :4] = given[2, :4] = -np.inf
    assert explain(given, ALL, [0, 1, 1])[0] == 1
    assert not explain(np.full((3, 10), -np.inf), ~ALL, [0, 1, 1])


OPENGL = np.diag([1.0, -1.0, -1.0])
WORLD = World(
    official_from_local=SimilarityTransform(
        quat_wxyz=(0.5, 0.5, -0.5, 0.5), translation=(4e6, -3e5, 12.5), scale=2.5
    )
)
TURNS: list[Mistake] = [
    hypothesis.mistakes[0]
    for hypothesis in absolute_hypotheses(frames=False, floors=False)
    if hypothesis.kind == "world-axes"
]


def quats_of(rotations: np.ndarray) -> np.ndarray:
    return np.roll(Rotation.from_matrix(rotations).as_quat(), 1, axis=1)


def matrix_of(turn: Mistake) -> np.ndarray:
    return Rotation.from_quat(np.roll(turn.turn_wxyz, -1)).as_matrix()


def written(
    made: Hypothesis, rotations: np.ndarray, centers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows that somebody writes who makes these mistakes, by matrices."""
    world = WORLD.official_from_local
    if "frame" not in made:
        turn = Rotation.from_quat(np.roll(world.quat_wxyz, -1)).as_matrix()
        rotations = rotations @ turn.T
        centers = world.scale * centers @ turn.T + world.translation
    for mistake in made.mistakes:
        if mistake.kind == "world-axes":
            turn = matrix_of(mistake)
            rotations, centers = rotations @ turn.T, centers @ turn.T
    if "axes" in made:
        rotations = OPENGL @ rotations
    translations = -np.einsum("nij,nj->ni", rotations, centers)
    if "inverted" in made or "inverted-rotation" in made:
        rotations = rotations.transpose(0, 2, 1)
    if "inverted" in made or "centre" in made:
        translations = centers
    quats = Rotation.from_matrix(rotations).as_quat()
    return (quats if "xyzw" in made else np.roll(quats, 1, axis=1)), translations


def assert_restored(
    found: tuple[np.ndarray, np.ndarray], rotations: np.ndarray, centers: np.ndarray, said: str
) -> None:
    np.testing.assert_allclose(found[1], centers, atol=1e-7, err_msg=said)
    turned = Rotation.from_quat(np.roll(found[0], -1, axis=1)).as_matrix()
    np.testing.assert_allclose(turned, rotations, atol=1e-12, err_msg=said)


def test_every_hypothesis_undoes_its_mistakes() -> None:
    rng = np.random.default_rng(0)
    rotations = Rotation.random(6, random_state=0).as_matrix()
    centers = rng.normal(size=(6, 3)) * 30
    tried = absolute_hypotheses(frames=True, floors=False)
    assert len({str(hypothesis) for hypothesis in tried}) == len(tried) > 100
    for hypothesis in tried:
        rows = written(hypothesis, rotations, centers)
        found = restore_absolute(hypothesis, *rows, WORLD)
        assert_restored(found, rotations, centers, str(hypothesis))


def test_every_hypothesis_of_relative_poses_undoes_its_mistakes() -> None:
    rng = np.random.default_rng(0)
    world = World(official_from_local=SimilarityTransform(translation=(4e6, 1e6, 5e6), scale=1.5))
    references = Rotation.random(6, random_state=0).as_matrix()
    queries = Rotation.random(6, random_state=1).as_matrix()
    at, to = rng.normal(size=(2, 6, 3)) * 20
    tried = relative_hypotheses()
    assert not tried[0].kind and tried[0].cost == 0
    for made in tried:
        rotations = queries @ references.transpose(0, 2, 1)
        translations = 1.5 * np.einsum("nij,nj->ni", queries, at - to)
        if "absolute" in made:
            rotations = queries
            translations = -np.einsum("nij,nj->ni", queries, 1.5 * to + [4e6, 1e6, 5e6])
        if "axes" in made:
            rotations = OPENGL @ rotations
            if "absolute" not in made:
                rotations = rotations @ OPENGL
            translations = translations @ OPENGL
        back = -np.einsum("nji,nj->ni", rotations, translations)
        if "inverted" in made:
            rotations, translations = rotations.transpose(0, 2, 1), back
        if "centre" in made:
            translations = back
        quats = quats_of(rotations)
        rows = quats if "wxyz" in made else np.roll(quats, -1, axis=1)
        found = restore_relative(made, rows, translations, (quats_of(references), at), world)
        assert_restored(found, queries, to, str(made))


def test_the_right_reading_comes_first_and_says_nothing() -> None:
    first, *others = absolute_hypotheses(frames=True, floors=True)
    assert str(first) == first.kind == "" and first.cost == 0
    assert all(own.cost > 0 and own.kind and str(own) for own in others)
    costs = [own.cost for own in others]
    assert costs == sorted(costs)
    # frames and floors are tried where there are some
    for frames, floors in itertools.product((False, True), repeat=2):
        tried = absolute_hypotheses(frames=frames, floors=floors)
        assert any("frame" in own for own in tried) == frames
        assert any("floor" in own for own in tried) == floors


def test_the_turns_are_all_that_take_axes_to_axes() -> None:
    matrices = [np.eye(3), *(matrix_of(turn).round(12) for turn in TURNS)]
    assert len(matrices) == 24
    for a, b in itertools.combinations(matrices, 2):
        assert np.abs(a - b).max() == 1 or np.abs(a - b).max() == 2
    assert all(np.isin(np.abs(matrix), (0, 1)).all() for matrix in matrices)
    # and they are said as they are
    for turn in TURNS:
        said = turn.said.rsplit("map's ", 1)[1].split(", ")
        signs = [-1.0 if name[0] == "-" else 1.0 for name in said]
        expected = np.eye(3)[["xyz".index(name[-1]) for name in said]] * np.array(signs)[:, None]
        np.testing.assert_allclose(matrix_of(turn), expected, atol=1e-12, err_msg=turn.said)
