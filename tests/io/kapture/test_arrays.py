"""Arrays of images, matches of pairs, and points, in folders and tars, in and beside a kapture."""

from __future__ import annotations

import pickle
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.colmap import load_pycolmap
from megloc_kapture.io.kapture.features import (
    SUFFIX,
    FeatureConfig,
    FeatureReader,
    FeatureWriter,
    KaptureVectors,
    feature_folder,
    find_blob,
    list_blobs,
    list_types,
    open_folders,
)
from megloc_kapture.io.kapture.matches import (
    ImagePair,
    MatchesReader,
    MatchesWriter,
    read_pairs,
)
from megloc_kapture.io.kapture.points import (
    COVARIANCES_FILE,
    read_point_covariances,
    read_points3d,
    write_ply,
    write_point_covariances,
)

KEYPOINTS = FeatureConfig("name inside", np.dtype("float32"), 3)
DESCRIPTORS = FeatureConfig("d", np.dtype("uint8"), 4, "k", "L2")
GLOBAL = FeatureConfig("g", np.dtype("float32"), 16, None, "L2")


@pytest.mark.parametrize(
    ("kind", "config", "place"),
    [
        ("keypoints", KEYPOINTS, "local_features/T 1/keypoints"),
        ("descriptors", DESCRIPTORS, "local_features/T 1/descriptors"),
        ("global_features", GLOBAL, "global_features/T 1/global_features"),
    ],
)
def test_orphan_arrays_read_back(tmp_path: Path, kind: Any, config: Any, place: str) -> None:
    """test_interop.py reads the layout inside a kapture with kapture itself."""
    shape = (config.dsize,) if kind == "global_features" else (5, config.dsize)
    array = (np.random.default_rng(0).normal(100, 50, shape)).astype(config.dtype)
    writer = FeatureWriter(tmp_path, kind, "T 1", config, orphan=True)
    assert "b/x 1.jpg" not in writer
    writer.write("b/x 1.jpg", array)
    assert "b/x 1.jpg" in writer
    written = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert written == {f"{place}/{kind}.txt", f"{place}/b/x 1.jpg{SUFFIX[kind]}"}
    assert list_types(tmp_path, kind, orphan=True) == ["T 1"]
    assert list_types(tmp_path, kind, orphan=False) == []
    folder = feature_folder(tmp_path, kind, "T 1", orphan=True)
    features = pickle.loads(pickle.dumps(FeatureReader(kind, "T 1", [folder])))
    assert features.config == config and features.names == ["b/x 1.jpg"]
    read = features.read("b/x 1.jpg")
    assert read.dtype == array.dtype and np.array_equal(read, array)
    assert features.length("b/x 1.jpg") == (1 if kind == "global_features" else 5)
    read[...] = 0  # a copy that the caller may change


def test_the_first_folder_is_used_and_all_configurations_must_agree(tmp_path: Path) -> None:
    values = {"map": {"a": 1.0, "both": 1.0}, "query": {"b": 2.0, "both": 2.0}}
    for part, images in values.items():
        writer = FeatureWriter(tmp_path / part, "keypoints", "T", KEYPOINTS, orphan=True)
        for image, value in images.items():
            writer.write(image, np.full((1, 3), value))
    folders = [feature_folder(tmp_path / p, "keypoints", "T", orphan=True) for p in values]
    features = FeatureReader("keypoints", "T", folders)
    assert features.names == ["a", "b", "both"]
    assert [features.read(i)[0, 0] for i in features.names] == [1, 2, 1]
    (folders[1] / "keypoints.txt").write_text("# kapture format: 1.1\nn, float32, 2\n")
    with pytest.raises(DataError, match=r"query/.*\.txt: rows are 2 x float32, but .*3 x float32"):
        FeatureReader("keypoints", "T", folders)


def test_a_writer_continues_a_folder_of_the_same_configuration_only(tmp_path: Path) -> None:
    writer = FeatureWriter(tmp_path, "keypoints", "T", KEYPOINTS)
    writer.write("a", np.zeros((1, 3)))
    writer = FeatureWriter(tmp_path, "keypoints", "T", KEYPOINTS)
    assert "a" in writer
    assert "b" not in writer
    with pytest.raises(OutputError, match="different configuration"):
        FeatureWriter(tmp_path, "keypoints", "T", FeatureConfig("n", np.dtype("float32"), 2))
    with pytest.raises(DataError, match="image b: 6 columns, but 3 in the keypoints of other"):
        writer.write("b", np.zeros((1, 6)))
    assert "b" not in writer
    config = FeatureConfig("n", np.dtype("uint8"), 3, "T")
    descriptors = FeatureWriter(tmp_path, "descriptors", "T", config)
    descriptors.write("empty", np.zeros((0, 3)))
    # the values would be cut off to whole numbers
    with pytest.raises(DataError, match="image b: float32, but uint8 in the descriptors of other"):
        descriptors.write("b", np.full((1, 3), 0.5, np.float32))


def test_members_of_a_tar_of_the_current_folder_are_read_by_name(tmp_path: Path) -> None:
    contents = {"a.kpt": b"x" * 1000, "deep/er/b.kpt": b"", "é ü.kpt": b"y" * 512}
    for name, content in contents.items():
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "in" / name).write_bytes(content)
    folder = tmp_path / "T"
    folder.mkdir()
    for kind in ("keypoints", "descriptors"):
        with tarfile.open(folder / f"{kind}.tar", "w") as file:
            file.add(tmp_path / "in", ".")
    folders = pickle.loads(pickle.dumps(open_folders([folder], "keypoints")))
    assert list_blobs(folders, "keypoints").keys() == contents.keys()
    blobs = {name: find_blob(folders, name) for name in contents}
    assert {name: blob and blob.read() for name, blob in blobs.items()} == contents
    assert find_blob(folders, "a") is None and find_blob(folders, "a", "a.kpt") == blobs["a.kpt"]
    assert list_blobs(open_folders([folder], "descriptors"), "descriptors") == {}


INDICES = np.array([[0, 7], [3, 2], [2**24 + 1, 5]])
SCORES = np.array([0.5, 1 / 3, -1.0])


def matches_reader(root: Path, *, orphan: bool = False) -> MatchesReader:
    return MatchesReader("T", [feature_folder(root, "matches", "T", orphan=orphan)])


@pytest.mark.parametrize(
    ("pair", "orphan"), [(("a/x.jpg", "b.jpg"), False), (("b.jpg", "a/x.jpg"), True)]
)
def test_matches_read_back_either_way(tmp_path: Path, pair: tuple[str, str], orphan: bool) -> None:
    writer = MatchesWriter(tmp_path, "T", orphan=orphan)
    assert pair not in writer
    writer.write(*pair, INDICES, SCORES)
    assert pair in writer and pair[::-1] in writer
    writer.write("c", "b.jpg", [], [])
    matches = matches_reader(tmp_path, orphan=orphan)
    assert matches.pairs == [("a/x.jpg", "b.jpg"), ("b.jpg", "c")]
    assert pair in matches and pair[::-1] in matches and ("a/x.jpg", "c") not in matches
    for asked, expected in ((pair, INDICES), (pair[::-1], INDICES[:, ::-1])):
        indices, scores = matches.read(*asked)
        assert indices.dtype == np.int64 and scores.dtype == np.float64
        assert np.array_equal(indices, expected)
        assert np.array_equal(scores, SCORES)
    assert matches.read("b.jpg", "c")[0].shape == (0, 2)


def test_files_named_in_the_other_order_are_read(tmp_path: Path) -> None:
    # kapture's writers do not sort the pair
    folder = tmp_path / "reconstruction/matches/T/b.overlapping"
    folder.mkdir(parents=True)
    np.c_[INDICES, SCORES].astype("<f8").tofile(folder / "a.matches")
    matches = matches_reader(tmp_path)
    assert matches.pairs == [("a", "b")]
    assert np.array_equal(matches.read("b", "a")[0], INDICES)
    assert np.array_equal(matches.read("a", "b")[0], INDICES[:, ::-1])


def test_pairs_without_scores_are_in_the_order_of_their_rank(tmp_path: Path) -> None:
    for text in ("q1 m2\nq1 m1\n", "q1, m2\nq1, m1\n"):  # hloc's, and without a score
        (tmp_path / "pairs.txt").write_text(text)
        best_first = [ImagePair("q1", "m2", 0.0), ImagePair("q1", "m1", -1.0)]
        assert read_pairs(tmp_path / "pairs.txt") == best_first


FOLDER = Path("reconstruction/global_features/G")
NAMES = [f"{k % 3}/{k:03d}.jpg" for k in range(40)]


def write(root: Path, rows: NDArray[np.floating]) -> FeatureReader:
    config = FeatureConfig("g", rows.dtype, rows.shape[1], None, "L2")
    writer = FeatureWriter(root, "global_features", "G", config)
    for name, row in zip(NAMES, rows, strict=False):
        writer.write(name, row)
    return FeatureReader("global_features", "G", [root / FOLDER])


def test_blocks_hold_unit_rows_in_the_order_of_the_images(tmp_path: Path) -> None:
    rows = np.random.default_rng(0).normal(0, 50, (len(NAMES), 5))
    features = write(tmp_path, rows)
    images = [NAMES[k] for k in np.random.default_rng(1).permutation(len(NAMES))] + NAMES[:1]
    expected = np.array([features.read(image) for image in images], dtype=np.float32)
    unit = expected / np.linalg.norm(expected, axis=1)[:, None]
    blocks = KaptureVectors(features, images)
    assert blocks.shape == (len(images), 5)
    np.testing.assert_allclose(blocks[:], unit, atol=1e-6)
    np.testing.assert_allclose(blocks[3:12], unit[3:12], atol=1e-6)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1.0, 1e37])
def test_rows_have_unit_length_at_any_scale(tmp_path: Path, scale: float) -> None:
    rows = np.array([[3, 4], [0, 0], [1, 0]]) * scale
    read = KaptureVectors(write(tmp_path, rows.astype(np.float32)), NAMES[:3])[:3]
    expected = [[0.6, 0.8], [0, 0], [1, 0]] if scale else np.zeros((3, 2))
    np.testing.assert_allclose(read, expected, atol=1e-6)


def test_images_without_a_usable_vector_are_named(tmp_path: Path) -> None:
    rows = np.ones((3, 5))
    rows[1, 2] = np.nan
    features = write(tmp_path, rows)
    with pytest.raises(DataError, match=rf"{NAMES[1]}.* not all values are finite"):
        KaptureVectors(features, NAMES[:3])[:3]
    with pytest.raises(DataError, match=r"no global_features of type 'G' for image 'no\.jpg'"):
        KaptureVectors(features, ["no.jpg"])[:1]


@pytest.mark.parametrize("content", ["", "# kapture format: 1.1\n# X, Y, Z, R, G, B\n\n\n# note"])
def test_a_file_without_rows_has_no_points(tmp_path: Path, content: str) -> None:
    (tmp_path / "p.txt").write_text(content)
    assert read_points3d(tmp_path / "p.txt").shape == (0, 6)


def test_covariances_read_back_and_are_read_only(tmp_path: Path) -> None:
    assert read_point_covariances(tmp_path, 3) is None
    values = np.arange(18.0).reshape(3, 6)
    values[1] = np.nan
    write_point_covariances(tmp_path, values)
    actual = read_point_covariances(tmp_path, 3)
    assert actual is not None and not actual.flags.writeable
    np.testing.assert_array_equal(actual, values)
    np.testing.assert_array_equal(np.load(tmp_path / COVARIANCES_FILE), values)


XYZ = np.random.default_rng(0).normal(size=(20, 3))
COLOURS = np.random.default_rng(1).integers(0, 256, (20, 3)).astype(np.uint8)


def test_colmap_reads_the_ply(tmp_path: Path) -> None:
    pycolmap = load_pycolmap()
    write_ply(tmp_path / "points.ply", XYZ, COLOURS, deviation=np.arange(20))
    reconstruction = pycolmap.Reconstruction()
    reconstruction.import_PLY(str(tmp_path / "points.ply"))
    points = [reconstruction.points3D[number] for number in sorted(reconstruction.points3D)]
    # COLMAP keeps them in single precision
    np.testing.assert_allclose([point.xyz for point in points], XYZ, rtol=1e-6)
    np.testing.assert_array_equal([point.color for point in points], COLOURS)
