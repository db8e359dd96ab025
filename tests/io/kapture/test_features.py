"""Keypoints, descriptors and global features, in folders and tars, in and beside a kapture."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.kapture.features import (
    DTYPES,
    ArrayKind,
    FeatureConfig,
    FeatureReader,
    FeatureWriter,
    feature_folder,
    list_types,
    read_config,
)

KEYPOINTS = FeatureConfig("name inside", np.dtype("float32"), 3)
DESCRIPTORS = FeatureConfig("d", np.dtype("uint8"), 128, "T 1", "L2")
GLOBAL = FeatureConfig("g", np.dtype("float32"), 16, None, "L2")
FORMS = [(tar, orphan) for tar in (False, True) for orphan in (False, True)]


def reader(root: Path, kind: ArrayKind, type_name: str, *, orphan: bool = False) -> FeatureReader:
    folder = feature_folder(root, kind, type_name, orphan=orphan)
    return FeatureReader(kind, type_name, [(root, folder)])


@pytest.mark.parametrize(("tar", "orphan"), FORMS)
@pytest.mark.parametrize("kind", ["keypoints", "descriptors", "global_features"])
@pytest.mark.parametrize("dtype", list(DTYPES))
def test_arrays_come_back(
    tmp_path: Path, kind: ArrayKind, dtype: str, tar: bool, orphan: bool
) -> None:
    rng = np.random.default_rng(0)
    config = FeatureConfig("f", np.dtype(dtype), 4, "k" if kind == "descriptors" else None, "L2")
    if kind == "keypoints":
        config = FeatureConfig("f", np.dtype(dtype), 4)
    shapes = [(4,), (4,)] if kind == "global_features" else [(5, 4), (0, 4)]
    arrays = {
        name: (rng.normal(0, 50, shape) + 100).astype(dtype)
        for name, shape in zip(["b/x 1.jpg", "a.jpg"], shapes, strict=True)
    }
    with FeatureWriter(tmp_path, kind, "T", config, tar=tar, orphan=orphan) as writer:
        for image, array in arrays.items():
            assert image not in writer
            writer.write(image, array)
            assert image in writer
    features = reader(tmp_path, kind, "T", orphan=orphan)
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


def test_the_layout_is_kapture_s(tmp_path: Path) -> None:
    zeros = np.zeros((2, 3), np.float32)
    for orphan in (False, True):
        with FeatureWriter(tmp_path, "keypoints", "T 1", KEYPOINTS, orphan=orphan) as writer:
            writer.write("a/b.jpg", zeros)
        with FeatureWriter(tmp_path, "descriptors", "T 1", DESCRIPTORS, orphan=orphan) as writer:
            writer.write("a/b.jpg", np.zeros((2, 128), np.uint8))
        with FeatureWriter(tmp_path, "global_features", "G", GLOBAL, orphan=orphan) as writer:
            writer.write("a/b.jpg", np.zeros((1, 16)))
    files = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file())
    assert files == [
        "global_features/G/global_features/a/b.jpg.gfeat",
        "global_features/G/global_features/global_features.txt",
        "local_features/T 1/descriptors/a/b.jpg.desc",
        "local_features/T 1/descriptors/descriptors.txt",
        "local_features/T 1/keypoints/a/b.jpg.kpt",
        "local_features/T 1/keypoints/keypoints.txt",
        "reconstruction/descriptors/T 1/a/b.jpg.desc",
        "reconstruction/descriptors/T 1/descriptors.txt",
        "reconstruction/global_features/G/a/b.jpg.gfeat",
        "reconstruction/global_features/G/global_features.txt",
        "reconstruction/keypoints/T 1/a/b.jpg.kpt",
        "reconstruction/keypoints/T 1/keypoints.txt",
    ]
    text = (tmp_path / "reconstruction/descriptors/T 1/descriptors.txt").read_text()
    assert text == (
        "# kapture format: 1.1\n"
        "# name, dtype, dsize, keypoints_type, metric_type\n"
        "d, uint8, 128, T 1, L2\n"
    )


def test_arrays_are_stored_little_endian_and_row_major(tmp_path: Path) -> None:
    array = np.arange(6, dtype=">f4").reshape(3, 2).T
    with FeatureWriter(tmp_path, "keypoints", "T", KEYPOINTS) as writer:
        writer.write("a", array)
    stored = (tmp_path / "reconstruction/keypoints/T/a.kpt").read_bytes()
    assert stored == np.array([[0, 2, 4], [1, 3, 5]], "<f4").tobytes()


def config_file(folder: Path, kind: ArrayKind, row: str) -> Path:
    path = folder / f"{kind}.txt"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"# kapture format: 1.1\n# header\n{row}\n")
    return path


@pytest.mark.parametrize(
    ("kind", "row", "match"),
    [
        ("keypoints", "n, float32", "expected 3 columns, got 2"),
        ("keypoints", "n, float32, 2, L2", "expected 3 columns, got 4"),
        ("descriptors", "n, float32, 2", "expected 5 columns, got 3"),
        ("descriptors", "n, float32, 2, ../k, L2", "leads out"),
        ("global_features", "n, float32, 2", "expected 4 columns"),
        ("keypoints", "n, float16, 2", "dtype 'float16' is not one of"),
        ("keypoints", "n, numpy.float32, 2", "is not one of"),
        ("keypoints", "n, __import__('os').system('touch owned'), 2", "is not one of"),
        ("keypoints", "n, , 2", "is not one of"),
        ("keypoints", "n, float32, 0", "dsize '0'"),
        ("keypoints", "n, float32, -2", "dsize '-2'"),
        ("keypoints", "n, float32, 2.0", "dsize '2.0'"),
        ("keypoints", "n, float32, 99999999999999", "dsize"),
    ],
)
def test_bad_configurations_name_file_and_line(
    tmp_path: Path, kind: ArrayKind, row: str, match: str
) -> None:
    path = config_file(tmp_path, kind, row)
    with pytest.raises(DataError, match=match) as caught:
        read_config(path, kind)
    assert f"{path}:3: " in str(caught.value)


def test_a_configuration_has_one_row(tmp_path: Path) -> None:
    for rows in ("", "n, float32, 2\nn, float32, 2"):
        with pytest.raises(DataError, match="expected one row"):
            read_config(config_file(tmp_path, "keypoints", rows), "keypoints")


@pytest.mark.parametrize("tar", [False, True])
def test_truncated_arrays_are_refused_and_named(tmp_path: Path, tar: bool) -> None:
    config_file(tmp_path / "reconstruction/keypoints/T", "keypoints", "n, float32, 3")
    config = FeatureConfig("n", np.dtype("uint8"), 1)
    with FeatureWriter(tmp_path / "x", "keypoints", "T", config, tar=tar) as writer:
        writer.write("a.jpg", np.zeros((23, 1), np.uint8))  # 23 bytes are no rows of 12
    made = tmp_path / "x/reconstruction/keypoints/T"
    name = "keypoints.tar" if tar else "a.jpg.kpt"
    (made / name).rename(tmp_path / "reconstruction/keypoints/T" / name)
    features = reader(tmp_path, "keypoints", "T")
    for read in (features.read, features.length):
        with pytest.raises(DataError, match=r"a\.jpg\.kpt\]?: 23 bytes"):
            read("a.jpg")


def test_a_global_feature_is_exactly_one_row(tmp_path: Path) -> None:
    with FeatureWriter(tmp_path, "global_features", "G", GLOBAL) as writer:
        writer.write("a", np.zeros(16))
    path = tmp_path / "reconstruction/global_features/G/a.gfeat"
    for size in (0, 128):
        path.write_bytes(bytes(size))
        with pytest.raises(DataError, match="exactly one row"):
            reader(tmp_path, "global_features", "G").read("a")


def test_absent_images_are_named(tmp_path: Path) -> None:
    with FeatureWriter(tmp_path, "keypoints", "T", KEYPOINTS) as writer:
        writer.write("a.jpg", np.zeros((1, 3)))
    features = reader(tmp_path, "keypoints", "T")
    for image in ("b.jpg", "../keypoints/T/a.jpg", "/etc/passwd", "x" * 300, "a\0"):
        assert image not in features
        with pytest.raises(DataError, match="no keypoints of type 'T' for image"):
            features.read(image)


def test_several_places_are_one_and_the_first_counts(tmp_path: Path) -> None:
    values = {"map": {"a": 1.0, "both": 1.0}, "beside": {"b": 2.0, "both": 2.0}}
    for place, images in values.items():
        with FeatureWriter(tmp_path / place, "keypoints", "T", KEYPOINTS, orphan=True) as writer:
            for image, value in images.items():
                writer.write(image, np.full((1, 3), value))
    places = [
        (tmp_path / p, feature_folder(tmp_path / p, "keypoints", "T", orphan=True)) for p in values
    ]
    features = FeatureReader("keypoints", "T", places)
    assert features.names == ["a", "b", "both"]
    assert [features.read(i)[0, 0] for i in features.names] == [1, 2, 1]


def test_places_must_agree(tmp_path: Path) -> None:
    for place, dsize in (("one", 2), ("two", 3)):
        config_file(tmp_path / place, "keypoints", f"n, float32, {dsize}")
    with pytest.raises(DataError, match="two/keypoints.txt: 3 x float32, but .*2 x float32"):
        FeatureReader("keypoints", "T", [(tmp_path, tmp_path / p) for p in ("one", "two")])


def test_a_stopped_run_goes_on_and_another_configuration_is_refused(tmp_path: Path) -> None:
    with FeatureWriter(tmp_path, "keypoints", "T", KEYPOINTS) as writer:
        writer.write("a", np.zeros((1, 3)))
    with FeatureWriter(tmp_path, "keypoints", "T", KEYPOINTS) as writer:
        assert "a" in writer
        assert "b" not in writer
    with pytest.raises(OutputError, match="another configuration"):
        FeatureWriter(tmp_path, "keypoints", "T", FeatureConfig("n", np.dtype("float32"), 2))


@pytest.mark.parametrize(
    "array",
    [np.zeros(3), np.zeros((2, 4)), np.zeros((1, 2, 3)), np.zeros((2, 3), complex), [["a"] * 3]],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path: Path, array: np.ndarray) -> None:
    with (
        FeatureWriter(tmp_path, "keypoints", "T", KEYPOINTS) as writer,
        pytest.raises(ValueError, match="expected shape|cannot store"),
    ):
        writer.write("a", array)


def test_floats_are_not_cut_to_integers(tmp_path: Path) -> None:
    with (
        FeatureWriter(tmp_path, "descriptors", "T", DESCRIPTORS) as writer,
        pytest.raises(ValueError, match="cannot store float64 as uint8"),
    ):
        writer.write("a", np.full((1, 128), 0.5))


@pytest.mark.parametrize("tar", [False, True])
@pytest.mark.parametrize("image", ["../a", "/a", "", "a,b", " a", "a\0"])
def test_names_that_lead_elsewhere_are_not_written(tmp_path: Path, image: str, tar: bool) -> None:
    with (
        FeatureWriter(tmp_path, "keypoints", "T", KEYPOINTS, tar=tar) as writer,
        pytest.raises(DataError),
    ):
        writer.write(image, np.zeros((1, 3)))


@pytest.mark.parametrize("type_name", ["", "..", "a/b", "a,b", "a\\b"])
def test_type_names_that_lead_elsewhere_are_refused(tmp_path: Path, type_name: str) -> None:
    with pytest.raises(DataError):
        FeatureWriter(tmp_path, "keypoints", type_name, KEYPOINTS)
    assert list(tmp_path.iterdir()) == []


def test_configurations_are_checked() -> None:
    assert FeatureConfig("f", np.dtype(">f4"), 2).dtype == np.dtype("<f4")
    with pytest.raises(DataError, match="float16"):
        FeatureConfig("f", np.dtype("float16"), 2)
    with pytest.raises(DataError, match="dsize"):
        FeatureConfig("f", np.dtype("float32"), 0)


@pytest.mark.parametrize("tar", [False, True])
def test_readers_go_to_other_processes(tmp_path: Path, tar: bool) -> None:
    with FeatureWriter(tmp_path, "keypoints", "T", KEYPOINTS, tar=tar) as writer:
        writer.write("a", np.ones((2, 3)))
    features = pickle.loads(pickle.dumps(reader(tmp_path, "keypoints", "T")))
    assert np.array_equal(features.read("a"), np.ones((2, 3)))
