"""Each reading undoes the mistake it is named after, exactly."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from megloc_kapture.evaluation.check.readings import AXIS_TURNS, Reading, readings
from megloc_kapture.io.side_tables import SimilarityTransform, World

OPENGL = np.diag([1.0, -1.0, -1.0])
WORLD = World(
    official_from_local=SimilarityTransform(
        quat_wxyz=(0.5, 0.5, -0.5, 0.5), translation=(4e6, -3e5, 12.5), scale=2.5
    )
)


def written(
    reading: Reading, rotations: np.ndarray, centers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows that somebody writes who makes the reading's mistakes, by matrices."""
    world = WORLD.official_from_local
    if reading.frame == "official":
        turn = Rotation.from_quat(np.roll(world.quat_wxyz, -1)).as_matrix()
        rotations = rotations @ turn.T
        centers = world.scale * centers @ turn.T + world.translation
    turn = Rotation.from_quat(np.roll(AXIS_TURNS[reading.turn].quat_wxyz, -1)).as_matrix()
    rotations, centers = rotations @ turn.T, centers @ turn.T
    if reading.axes == "opengl":
        rotations = OPENGL @ rotations
    translations = -np.einsum("nij,nj->ni", rotations, centers)
    if reading.content in ("world_from_cam", "rotation_inverse"):
        rotations = rotations.transpose(0, 2, 1)
    if reading.content in ("world_from_cam", "centre"):
        translations = centers
    quats = Rotation.from_matrix(rotations).as_quat()
    return (quats if reading.order == "xyzw" else np.roll(quats, 1, axis=1)), translations


def test_every_reading_undoes_its_mistakes() -> None:
    rng = np.random.default_rng(0)
    rotations = Rotation.random(6, random_state=0).as_matrix()
    centers = rng.normal(size=(6, 3)) * 30
    tried = list(readings(frames=True, floors=False))
    assert len(set(tried)) == len(tried) > 100
    for reading in tried:
        quats, found = reading.cam_from_local(*written(reading, rotations, centers), WORLD)
        np.testing.assert_allclose(found, centers, atol=1e-7, err_msg=str(reading))
        turned = Rotation.from_quat(np.roll(quats, -1, axis=1)).as_matrix()
        np.testing.assert_allclose(turned, rotations, atol=1e-12, err_msg=str(reading))


def test_the_right_reading_comes_first_and_says_nothing() -> None:
    first, *others = readings(frames=True, floors=True)
    assert first == Reading() and str(first) == first.kind == "" and first.mistakes == 0
    assert all(reading.mistakes > 0 and reading.kind and str(reading) for reading in others)
    counts = [reading.mistakes for reading in others]
    assert counts == sorted(counts)


def test_frames_and_floors_are_tried_where_there_are_some() -> None:
    plain = set(readings(frames=False, floors=False))
    assert {reading.frame for reading in plain} == {"official"}
    assert {reading.floor for reading in plain} == {"own"}
    assert {r.frame for r in readings(frames=True, floors=False)} == {"official", "local"}
    assert {r.floor for r in readings(frames=False, floors=True)} == {"own", "other"}


def test_the_turns_are_all_that_take_axes_to_axes() -> None:
    assert len(AXIS_TURNS) == 24
    matrices = [
        Rotation.from_quat(np.roll(turn.quat_wxyz, -1)).as_matrix().round(12) for turn in AXIS_TURNS
    ]
    np.testing.assert_array_equal(matrices[0], np.eye(3))
    for a, b in itertools.combinations(matrices, 2):
        assert np.abs(a - b).max() == 1 or np.abs(a - b).max() == 2
    assert all(np.isin(np.abs(matrix), (0, 1)).all() for matrix in matrices)


@pytest.mark.parametrize("index", range(1, 24))
def test_turns_are_said_as_they_are(index: int) -> None:
    said = AXIS_TURNS[index].said.rsplit("map's ", 1)[1].split(", ")
    matrix = Rotation.from_quat(np.roll(AXIS_TURNS[index].quat_wxyz, -1)).as_matrix()
    for row, name in zip(matrix, said, strict=True):
        expected = np.zeros(3)
        expected["xyz".index(name[-1])] = -1 if name[0] == "-" else 1
        np.testing.assert_allclose(row, expected, atol=1e-12)
