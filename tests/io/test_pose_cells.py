from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from megloc_kapture.errors import DataError
from megloc_kapture.io.pose_cells import pose_cell, read_pose_cell
from megloc_kapture.values import RigidTransform

angles = st.floats(-math.pi, math.pi)
metres = st.floats(-1e7, 1e7)


@given(st.tuples(angles, angles, angles), st.tuples(metres, metres, metres))
def test_a_pose_reads_back_with_every_digit(
    vector: tuple[float, float, float], translation: tuple[float, float, float]
) -> None:
    x, y, z, w = Rotation.from_rotvec(vector).as_quat().tolist()
    pose = RigidTransform((w, x, y, z), translation)
    assert read_pose_cell(pose_cell(pose), "before", path="t.csv", line=2) == pose


def test_no_pose_is_an_empty_cell() -> None:
    assert pose_cell(None) == ""
    assert read_pose_cell("", "before", path="t.csv", line=2) is None


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1 0 0 0 1 2", "qw qx qy qz tx ty tz"),
        ("1 0 0 0 1 2 3 4", "qw qx qy qz tx ty tz"),
        ("1 0 0 zero 1 2 3", "qw qx qy qz tx ty tz"),
        ("0 0 0 0 1 2 3", "unit quaternion"),
        ("2 0 0 0 1 2 3", "unit quaternion"),
        ("nan 0 0 0 1 2 3", "unit quaternion"),
        ("1 0 0 0 1 inf 3", "finite translation"),
    ],
)
def test_what_is_no_pose_is_named_with_its_line(text: str, expected: str) -> None:
    with pytest.raises(DataError, match=expected) as raised:
        read_pose_cell(text, "before", path="t.csv", line=7)
    assert "t.csv" in str(raised.value) and "7" in str(raised.value)
