"""Arrays of images and matches of pairs, in folders and tars, in and beside a kapture."""

from __future__ import annotations

import pickle
import tarfile
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.kapture.features import (
    ArrayKind,
    FeatureConfig,
    FeatureReader,
    FeatureWriter,
    TarBlobs,
    feature_folder,
    list_types,
)
from megloc_kapture.io.kapture.matches import (
    ImagePair,
    MatchesReader,
    MatchesWriter,
    read_pairs,
    write_pairs,
)

KEYPOINTS = FeatureConfig("name inside", np.dtype("float32"), 3)
GLOBAL = FeatureConfig("g", np.dtype("float32"), 16, None, "L2")


def reader(root: Path, kind: ArrayKind, type_name: str, *, orphan: bool = False) -> FeatureReader:
    folder = feature_folder(root, kind, type_name, orphan=orphan)
    return FeatureReader(kind, type_name, [folder])


@pytest.mark.parametrize(
    ("kind", "dtype", "orphan"),
    [
        ("keypoints", "float32", False),
        ("descriptors", "uint8", True),
        ("global_features", "float64", True),
    ],
)
def test_arrays_read_back_equal(tmp_path: Path, kind: ArrayKind, dtype: str, orphan: bool) -> None:
    rng = np.random.default_rng(0)
    config = FeatureConfig("f", np.dtype(dtype), 4, "k" if kind == "descriptors" else None, "L2")
    if kind == "keypoints":
        config = FeatureConfig("f", np.dtype(dtype), 4)
    shapes = [(4,), (4,)] if kind == "global_features" else [(5, 4), (0, 4)]
    arrays = {
        name: (rng.normal(0, 50, shape) + 100).astype(dtype)
        for name, shape in zip(["b/x 1.jpg", "a.jpg"], shapes, strict=True)
    }
    with FeatureWriter(tmp_path, kind, "T", config, orphan=orphan) as writer:
        for image, array in arrays.items():
            assert image not in writer
            writer.write(image, array)
            assert image in writer
    features = pickle.loads(pickle.dumps(reader(tmp_path, kind, "T", orphan=orphan)))
    assert features.config == config
    assert features.names == ["a.jpg", "b/x 1.jpg"]
    assert list_types(tmp_path, kind, orphan=orphan) == ["T"]
    assert list_types(tmp_path, kind, orphan=not orphan) == []
    for image, array in arrays.items():
        read = features.read(image)
        assert read.dtype == array.dtype and read.shape == array.shape
        assert np.array_equal(read, array)
        assert features.length(image) == (1 if kind == "global_features" else len(array))
        read[...] = 0  # a copy that the caller may change


def test_features_outside_a_kapture_have_the_layout_of_kapture_localization(tmp_path: Path) -> None:
    """test_interop.py reads the layout inside a kapture with kapture itself."""
    with FeatureWriter(tmp_path, "keypoints", "T 1", KEYPOINTS, orphan=True) as writer:
        writer.write("a/b.jpg", np.zeros((2, 3), np.float32))
    with FeatureWriter(tmp_path, "global_features", "G", GLOBAL, orphan=True) as writer:
        writer.write("a/b.jpg", np.zeros((1, 16)))
    files = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file())
    assert files == [
        "global_features/G/global_features/a/b.jpg.gfeat",
        "global_features/G/global_features/global_features.txt",
        "local_features/T 1/keypoints/a/b.jpg.kpt",
        "local_features/T 1/keypoints/keypoints.txt",
    ]


def test_the_first_of_several_folders_is_used_and_their_configurations_must_agree(
    tmp_path: Path,
) -> None:
    values = {"map": {"a": 1.0, "both": 1.0}, "query": {"b": 2.0, "both": 2.0}}
    for part, images in values.items():
        with FeatureWriter(tmp_path / part, "keypoints", "T", KEYPOINTS, orphan=True) as writer:
            for image, value in images.items():
                writer.write(image, np.full((1, 3), value))
    folders = [feature_folder(tmp_path / p, "keypoints", "T", orphan=True) for p in values]
    features = FeatureReader("keypoints", "T", folders)
    assert features.names == ["a", "b", "both"]
    assert [features.read(i)[0, 0] for i in features.names] == [1, 2, 1]
    (folders[1] / "keypoints.txt").write_text("# kapture format: 1.1\nn, float32, 2\n")
    with pytest.raises(DataError, match=r"query/.*keypoints\.txt: 2 x float32, but .*3 x float32"):
        FeatureReader("keypoints", "T", folders)


def test_a_writer_continues_a_folder_of_the_same_configuration_only(tmp_path: Path) -> None:
    with FeatureWriter(tmp_path, "keypoints", "T", KEYPOINTS) as writer:
        writer.write("a", np.zeros((1, 3)))
    with FeatureWriter(tmp_path, "keypoints", "T", KEYPOINTS) as writer:
        assert "a" in writer
        assert "b" not in writer
    with pytest.raises(OutputError, match="another configuration"):
        FeatureWriter(tmp_path, "keypoints", "T", FeatureConfig("n", np.dtype("float32"), 2))


def test_members_of_a_tar_of_the_current_folder_are_read_by_name(tmp_path: Path) -> None:
    contents = {"a.kpt": b"x" * 1000, "deep/er/b.kpt": b"", "é ü.kpt": b"y" * 512}
    for name, content in contents.items():
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "in" / name).write_bytes(content)
    with tarfile.open(tmp_path / "x.tar", "w") as file:
        file.add(tmp_path / "in", ".")
    blobs = pickle.loads(pickle.dumps(TarBlobs(tmp_path / "x.tar", ".kpt")))
    assert blobs.names() == sorted(contents)
    assert {name: blobs.read(name) for name in contents} == contents
    assert blobs.size("a.kpt") == 1000 and "a" not in blobs
    assert TarBlobs(tmp_path / "x.tar", ".desc").names() == []


# -------------------------------------------------------------------------------------- matches


INDICES = np.array([[0, 7], [3, 2], [2**24 + 1, 5]])
SCORES = np.array([0.5, 1 / 3, -1.0])


def matches_reader(root: Path, *, orphan: bool = False) -> MatchesReader:
    return MatchesReader("T", [feature_folder(root, "matches", "T", orphan=orphan)])


@pytest.mark.parametrize("orphan", [False, True])
@pytest.mark.parametrize("pair", [("a/x.jpg", "b.jpg"), ("b.jpg", "a/x.jpg")])
def test_matches_read_back_in_either_order(
    tmp_path: Path, pair: tuple[str, str], orphan: bool
) -> None:
    with MatchesWriter(tmp_path, "T", orphan=orphan) as writer:
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


def test_pairs_read_back_in_their_order_without_repetitions(tmp_path: Path) -> None:
    pairs = [ImagePair("q 2", "m/1", 1 / 3), ImagePair("q1", "m2", -1.0), ImagePair("m2", "q1", 2)]
    write_pairs(tmp_path / "pairs.txt", [*pairs, ImagePair("q1", "m2", 5.0)])
    assert read_pairs(tmp_path / "pairs.txt") == pairs
