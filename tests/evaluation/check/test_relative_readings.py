"""Readings of MLAD rows undo their mistakes; the path of the queries tells them apart."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from megloc_kapture.evaluation.check.relative_readings import (
    RelativeReading,
    path_scores,
    relative_readings,
)
from megloc_kapture.io.side_tables import SimilarityTransform, World

OPENGL = np.diag([1.0, -1.0, -1.0])
WORLD = World(official_from_local=SimilarityTransform(translation=(4e6, 1e6, 5e6), scale=1.5))


def quats_of(rotations: np.ndarray) -> np.ndarray:
    return np.roll(Rotation.from_matrix(rotations).as_quat(), 1, axis=1)


def test_every_reading_undoes_its_mistakes() -> None:
    rng = np.random.default_rng(0)
    references = Rotation.random(6, random_state=0).as_matrix()
    queries = Rotation.random(6, random_state=1).as_matrix()
    at, to = rng.normal(size=(2, 6, 3)) * 20
    tried = list(relative_readings())
    assert tried[0] == RelativeReading() and not tried[0].kind and tried[0].mistakes == 0
    for reading in tried:
        rotations = queries @ references.transpose(0, 2, 1)
        translations = 1.5 * np.einsum("nij,nj->ni", queries, at - to)
        if reading.content == "absolute":
            rotations = queries
            translations = -np.einsum("nij,nj->ni", queries, 1.5 * to + [4e6, 1e6, 5e6])
        if reading.opengl:
            rotations = OPENGL @ rotations
            if reading.content != "absolute":
                rotations = rotations @ OPENGL
            translations = translations @ OPENGL
        back = -np.einsum("nji,nj->ni", rotations, translations)
        if reading.content == "inverted":
            rotations, translations = rotations.transpose(0, 2, 1), back
        if reading.content == "centre":
            translations = back
        quats = quats_of(rotations)
        rows = quats if reading.wxyz else np.roll(quats, -1, axis=1)
        found, centers = reading.cam_from_local(
            rows, translations, (quats_of(references), at), WORLD
        )
        np.testing.assert_allclose(centers, to, atol=1e-7, err_msg=str(reading))
        turned = Rotation.from_quat(np.roll(found, -1, axis=1)).as_matrix()
        np.testing.assert_allclose(turned, queries, atol=1e-12, err_msg=str(reading))


def test_a_straight_path_is_best_in_any_order() -> None:
    times = np.array([3.0, 0.0, 1.0, 7.0])
    centers = times[:, None] * [1.0, -2.0, 0.5]
    np.testing.assert_allclose(path_scores(centers, times, np.ones(4)), 0.0, atol=1e-12)
    centers[2] += [0.0, 0.0, 3.0]
    scores = path_scores(centers, times, np.full(4, 2.0))
    # the ends have no neighbours on both sides
    np.testing.assert_allclose(scores[[1, 2, 3]], [0.0, -np.log1p(1.5), 0.0])
    assert scores[0] < 0


def test_equal_times_and_few_rows_say_nothing() -> None:
    centers = np.random.default_rng(0).normal(size=(4, 3))
    assert not path_scores(centers, np.zeros(4), np.ones(4)).any()
    assert not path_scores(centers[:2], np.arange(2.0), np.ones(2)).any()
