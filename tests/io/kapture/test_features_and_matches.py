"""Arrays of images and matches of pairs, in folders and tars, in and beside a kapture."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.kapture.features import (
    DTYPES,
    SUFFIX,
    ArrayKind,
    FeatureConfig,
    FeatureReader,
    FeatureWriter,
    feature_folder,
    list_types,
    read_config,
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


@pytest.mark.parametrize("orphan", [False, True])
@pytest.mark.parametrize("kind", ["keypoints", "descriptors", "global_features"])
@pytest.mark.parametrize("dtype", list(DTYPES))
def test_arrays_come_back(tmp_path: Path, kind: ArrayKind, dtype: str, orphan: bool) -> None:
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
        read[...] = 0  # the caller's own


def test_the_layout_beside_a_kapture_is_kapture_localization_s(tmp_path: Path) -> None:
    """That in a kapture is read by kapture, see test_interop.py."""
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


def config_file(folder: Path, kind: ArrayKind, row: str) -> Path:
    path = folder / f"{kind}.txt"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"# kapture format: 1.1\n# header\n{row}\n")
    return path


@pytest.mark.parametrize(
    ("kind", "row", "match"),
    [
        ("keypoints", "n, float32", "expected 3 columns, got 2"),
        ("descriptors", "n, float32, 2, ../k, L2", "leads out"),
        ("keypoints", "n, float16, 2", "dtype 'float16' is not one of"),
        ("keypoints", "n, __import__('os').system('touch owned'), 2", "is not one of"),
        ("keypoints", "n, float32, 0", "dsize '0'"),
    ],
)
def test_bad_configurations_name_file_and_line(
    tmp_path: Path, kind: ArrayKind, row: str, match: str
) -> None:
    path = config_file(tmp_path, kind, row)
    with pytest.raises(DataError, match=match) as caught:
        read_config(path, kind)
    assert f"{path}:3: " in str(caught.value)
    with pytest.raises(DataError, match="no row"):
        read_config(config_file(tmp_path, kind, ""), kind)


@pytest.mark.parametrize(
    ("kind", "size", "expected"),
    [
        ("keypoints", 23, "whole rows"),
        ("global_features", 0, "exactly one row"),
        ("global_features", 128, "exactly one row"),
    ],
)
def test_truncated_arrays_are_refused_and_named(
    tmp_path: Path, kind: ArrayKind, size: int, expected: str
) -> None:
    config = {"keypoints": KEYPOINTS, "global_features": GLOBAL}[kind]
    with FeatureWriter(tmp_path, kind, "T", config) as writer:
        writer.put(f"a.jpg{SUFFIX[kind]}", bytes(size))
    features = reader(tmp_path, kind, "T")
    for read in (features.read, features.length):
        with pytest.raises(DataError, match=rf"a\.jpg\.\w+\]?: {size} bytes are not {expected}"):
            read("a.jpg")


def test_several_places_are_one_the_first_counts_and_they_must_agree(tmp_path: Path) -> None:
    values = {"map": {"a": 1.0, "both": 1.0}, "beside": {"b": 2.0, "both": 2.0}}
    for place, images in values.items():
        with FeatureWriter(tmp_path / place, "keypoints", "T", KEYPOINTS, orphan=True) as writer:
            for image, value in images.items():
                writer.write(image, np.full((1, 3), value))
    places = [feature_folder(tmp_path / p, "keypoints", "T", orphan=True) for p in values]
    features = FeatureReader("keypoints", "T", places)
    assert features.names == ["a", "b", "both"]
    assert [features.read(i)[0, 0] for i in features.names] == [1, 2, 1]
    config_file(places[1], "keypoints", "n, float32, 2")
    with pytest.raises(DataError, match=r"beside/.*keypoints\.txt: 2 x float32, but .*3 x float32"):
        FeatureReader("keypoints", "T", places)


def test_a_stopped_run_goes_on_and_another_configuration_is_refused(tmp_path: Path) -> None:
    with FeatureWriter(tmp_path, "keypoints", "T", KEYPOINTS) as writer:
        writer.write("a", np.zeros((1, 3)))
    with FeatureWriter(tmp_path, "keypoints", "T", KEYPOINTS) as writer:
        assert "a" in writer
        assert "b" not in writer
    with pytest.raises(OutputError, match="another configuration"):
        FeatureWriter(tmp_path, "keypoints", "T", FeatureConfig("n", np.dtype("float32"), 2))


def test_features_of_kapture_1_0_name_the_remedy(tmp_path: Path) -> None:
    config_file(tmp_path / "reconstruction/keypoints", "keypoints", "n, float32, 2")
    with pytest.raises(DataError, match="kapture_upgrade_1_0_to_1_1"):
        list_types(tmp_path, "keypoints", orphan=False)


# -------------------------------------------------------------------------------------- matches


INDICES = np.array([[0, 7], [3, 2], [2**24 + 1, 5]])
SCORES = np.array([0.5, 1 / 3, -1.0])


def matches_reader(root: Path, *, orphan: bool = False) -> MatchesReader:
    return MatchesReader("T", [feature_folder(root, "matches", "T", orphan=orphan)])


@pytest.mark.parametrize("orphan", [False, True])
@pytest.mark.parametrize("pair", [("a/x.jpg", "b.jpg"), ("b.jpg", "a/x.jpg")])
def test_matches_come_back_in_either_order(
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


def test_files_of_the_unordered_pair_are_found(tmp_path: Path) -> None:
    # what kapture's own writers make of ("b", "a")
    folder = tmp_path / "reconstruction/matches/T/b.overlapping"
    folder.mkdir(parents=True)
    np.c_[INDICES, SCORES].astype("<f8").tofile(folder / "a.matches")
    matches = matches_reader(tmp_path)
    assert matches.pairs == [("a", "b")]
    assert np.array_equal(matches.read("b", "a")[0], INDICES)
    assert np.array_equal(matches.read("a", "b")[0], INDICES[:, ::-1])


HEAD = "# kapture format: 1.1\n# query_image, map_image, score\n"


def test_pairs_come_back_in_their_order(tmp_path: Path) -> None:
    rows = [("q 2", "m/1", 1 / 3), ("q1", "m2", -1.0), ("q1", "m1", 2.0)]
    pairs = [ImagePair(*row) for row in rows]
    write_pairs(tmp_path / "pairs" / "query.txt", pairs)
    assert read_pairs(tmp_path / "pairs" / "query.txt") == pairs
    text = (tmp_path / "pairs" / "query.txt").read_text()
    assert text == HEAD + "q 2, m/1, 0.3333333333333333\nq1, m2, -1.0\nq1, m1, 2.0\n"


def test_a_repeated_pair_counts_once(tmp_path: Path) -> None:
    (tmp_path / "p.txt").write_text("a, b, 1\nb, a, 1\na, b, 2\n")
    assert read_pairs(tmp_path / "p.txt") == [ImagePair("a", "b", 1.0), ImagePair("b", "a", 1.0)]


@pytest.mark.parametrize(
    ("row", "match"),
    [
        ("a, b", "expected 3 columns, got 2"),
        ("a, b, c", "expected finite numbers score, got 'c'"),
        ("a, b, nan", "finite numbers"),
        ("a, ../b, 1", "leads out"),
        (", b, 1", "empty"),
    ],
)
def test_bad_rows_name_file_and_line(tmp_path: Path, row: str, match: str) -> None:
    (tmp_path / "p.txt").write_text(HEAD + f"a, b, 1\n{row}\n")
    with pytest.raises(DataError, match=r"p\.txt:4: .*" + match):
        read_pairs(tmp_path / "p.txt")
