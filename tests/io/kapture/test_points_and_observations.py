"""3D points and their observations: what is written reads back, what is broken is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import points as observations
from megloc_kapture.io.kapture import write_ply
from megloc_kapture.io.kapture.points import (
    COVARIANCES_FILE,
    Observations,
    read_observations,
    read_point_covariances,
    read_points3d,
    write_observations,
    write_point_covariances,
    write_points3d,
)

VERSION = "# kapture format: 1.1\n"
POINTS = VERSION + "# X, Y, Z, R, G, B\n"
RNG = np.random.default_rng(0)


def file(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


# -------------------------------------------------------------------------------------- points


@pytest.mark.parametrize("columns", [3, 6])
def test_points_come_back_exactly(tmp_path: Path, columns: int) -> None:
    bits = RNG.integers(0, 2**63, (2000, columns)).view(np.float64)
    points = np.where(np.isfinite(bits), bits, 1 / 3)
    write_points3d(tmp_path, points)
    read = read_points3d(tmp_path / "reconstruction/points3d.txt")
    assert read.shape == (2000, 6) and read.dtype == np.float64
    assert np.array_equal(read[:, :columns], points)
    assert not read[:, columns:].any()


@pytest.mark.parametrize("content", ["", POINTS, POINTS + "\n\n# only comments"])
def test_no_points_are_none(tmp_path: Path, content: str) -> None:
    read = read_points3d(file(tmp_path / "p.txt", content))
    assert read.shape == (0, 6)


@pytest.mark.parametrize(
    ("row", "match"),
    [
        ("1,2,3,4,5", "not a table of 3 or 6 columns in all rows.*at row 21$"),
        ("1,2,3,4,5,", "could not convert string '' to float64 at row 20"),
        ("1,2,3,4,5,nan", "point 20 is not finite"),
        ("1,2,3,4,5,1e999", "not finite"),
        ("1,2,3,4,5,0x10", "could not convert"),
        ("1,2,3,4,5,6\0", "could not convert"),
        ("1,2,3,4,5,True", "could not convert"),
    ],
)
def test_bad_points_are_named(tmp_path: Path, row: str, match: str) -> None:
    path = file(tmp_path / "p.txt", POINTS + "1,2,3,4,5,6\n" * 20 + row + "\n1,2,3,4,5,6\n")
    with pytest.raises(DataError, match=rf"p\.txt:.*{match}"):
        read_points3d(path)
    with pytest.raises(DataError, match=r"p\.txt: expected 3 or 6 columns, got 4"):
        read_points3d(file(path, "1,2,3,4\n"))


VALUES = np.arange(18.0).reshape(3, 6)


def test_covariances_are_read_as_written_and_cannot_be_changed(tmp_path: Path) -> None:
    assert read_point_covariances(tmp_path, 3) is None
    values = VALUES.copy()
    values[1] = np.nan
    write_point_covariances(tmp_path, values)
    found = read_point_covariances(tmp_path, 3)
    assert found is not None and not found.flags.writeable
    np.testing.assert_array_equal(found, values)
    np.testing.assert_array_equal(np.load(tmp_path / COVARIANCES_FILE), values)


# ---------------------------------------------------------------------------------------------- PLY

XYZ = np.random.default_rng(0).normal(size=(100, 3))
COLOURS = np.random.default_rng(1).integers(0, 256, (100, 3)).astype(np.uint8)


def test_colmap_reads_what_was_written(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    write_ply(tmp_path / "points.ply", XYZ, COLOURS, deviation=np.arange(100))
    reconstruction = pycolmap.Reconstruction()
    reconstruction.import_PLY(str(tmp_path / "points.ply"))
    points = [reconstruction.points3D[number] for number in sorted(reconstruction.points3D)]
    # COLMAP keeps them in single precision
    np.testing.assert_allclose([point.xyz for point in points], XYZ, rtol=1e-6)
    np.testing.assert_array_equal([point.color for point in points], COLOURS)


# -------------------------------------------------------------------------------- observations

OBSERVATIONS = VERSION + "# point3d_id, keypoints_type, [image_path, feature_id]*\n"


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the reader meet the borders of blocks everywhere."""
    monkeypatch.setattr(observations, "_BLOCK_CHARACTERS", 50)


def plain(observations: dict[str, Observations]) -> dict[str, list[tuple[int, str, int]]]:
    """Observations as rows of point, image and keypoint."""
    found = {}
    for keypoints_type, of_type in observations.items():
        assert of_type.keypoints_type == keypoints_type
        assert list(of_type.image_names) == sorted(set(of_type.image_names))
        ids = (of_type.point_ids, of_type.image_ids, of_type.keypoint_ids)
        assert tuple(array.dtype for array in ids) == (np.int64, np.int32, np.int32)
        found[keypoints_type] = [
            (point, of_type.image_names[image], keypoint)
            for point, image, keypoint in zip(*(array.tolist() for array in ids), strict=True)
        ]
        assert {image for _, image, _ in found[keypoints_type]} == set(of_type.image_names)
    return found


def random_observations(count: int, keypoints_type: str = "T 1") -> Observations:
    names = tuple(sorted(f"séquence {i % 3}/{'x' * (i % 40)}{i}.jpg" for i in range(50)))
    return Observations(
        keypoints_type,
        names,
        np.sort(RNG.integers(0, count, count)),
        np.r_[np.arange(50), RNG.integers(0, 50, count - 50)].astype(np.int32),
        np.r_[RNG.integers(0, 2**31, count - 1), 2**31 - 1].astype(np.int32),
    )


def test_observations_come_back_exactly(tmp_path: Path) -> None:
    written = {name: random_observations(3000, name) for name in ("T 1", "sift")}
    write_observations(tmp_path, written)
    path = tmp_path / "reconstruction/observations.txt"
    read = read_observations(path)
    assert list(read) == ["T 1", "sift"]
    assert plain(read) == plain(written)


def test_the_layout_of_observations_is_kapture_s(tmp_path: Path) -> None:
    of_type = Observations("t", ("a", "b"), *np.array([[7, 0, 7], [1, 0, 0], [5, 6, 2]]))
    other = Observations("s", ("c",), *np.array([[7], [0], [3]]))
    write_observations(tmp_path, {"t": of_type, "s": other})
    text = (tmp_path / "reconstruction/observations.txt").read_text()
    assert text == OBSERVATIONS + "0, t, a, 6\n7, s, c, 3\n7, t, b, 5, a, 2\n"
    write_observations(tmp_path, {})
    assert (tmp_path / "reconstruction/observations.txt").read_text() == OBSERVATIONS


@pytest.mark.parametrize(
    ("row", "match"),
    [
        ("5", "expected point3d_id"),
        ("5, t, a", "expected point3d_id"),
        ("5, t, a, 1, b", "expected point3d_id"),
        ("x, t, a, 1", "expected point3d_id"),
        ("-1, t, a, 1", "ids from 0 on"),
        ("5, t, a, 1.5", "ids from 0 on"),
        ("5, t, a, -1", "ids from 0 on"),
        (f"5, t, a, {2**31}", "ids from 0 on"),
        ("5, , a, 1", "empty"),
        ("5, t/u, a, 1", "cannot be a type name"),
        ("5, t, , 1", "empty path"),
        ("5, t, ../a, 1", "leads out"),
        ("5, t, a\0, 1", "control character"),
    ],
)
@pytest.mark.usefixtures("small_blocks")
def test_bad_observations_name_the_file(tmp_path: Path, row: str, match: str) -> None:
    content = OBSERVATIONS + "0, t, a, 1, b, 2\n" * 20 + row + "\n3, t, a, 1\n"
    path = file(tmp_path / "o.txt", content)
    with pytest.raises(DataError, match=match) as caught:
        read_observations(path)
    assert str(path) in str(caught.value)
