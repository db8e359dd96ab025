"""Covariances beside a map's points: read as written, and refused for another map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.point_covariances import (
    COVARIANCES_FILE,
    read_point_covariances,
    write_point_covariances,
)

VALUES = np.arange(18.0).reshape(3, 6)


def test_they_are_read_as_written_and_cannot_be_changed(tmp_path: Path) -> None:
    values = VALUES.copy()
    values[1] = np.nan
    write_point_covariances(tmp_path, values)
    found = read_point_covariances(tmp_path, 3)
    assert found is not None and not found.flags.writeable
    np.testing.assert_array_equal(found, values)
    np.testing.assert_array_equal(np.load(tmp_path / COVARIANCES_FILE), values)


def test_a_map_without_has_none(tmp_path: Path) -> None:
    assert read_point_covariances(tmp_path, 3) is None


@pytest.mark.parametrize("values", [VALUES[:2], VALUES[:, :5], VALUES.astype(np.float32)])
def test_those_of_another_map_are_refused(tmp_path: Path, values: np.ndarray) -> None:
    path = tmp_path / COVARIANCES_FILE
    path.parent.mkdir()
    np.save(path, values)
    with pytest.raises(DataError, match=r"expected float64 \(3, 6\)"):
        read_point_covariances(tmp_path, 3)


@pytest.mark.parametrize("content", [b"", b"no array", b"\x93NUMPY\x01\x00"])
def test_what_is_no_array_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / COVARIANCES_FILE
    path.parent.mkdir()
    path.write_bytes(content)
    with pytest.raises(DataError, match="no array"):
        read_point_covariances(tmp_path, 3)


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    path = tmp_path / COVARIANCES_FILE
    path.parent.mkdir()
    np.save(path, np.array([object()] * 3), allow_pickle=True)
    with pytest.raises(DataError):
        read_point_covariances(tmp_path, 3)
