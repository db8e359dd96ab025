"""Global features read many at once are those read one by one, whatever they lie in."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import FeatureConfig, FeatureReader, FeatureWriter, KaptureVectors
from megloc_kapture.io.kapture import vectors as module

FOLDER = Path("reconstruction/global_features/G")
NAMES = [f"{camera}/{k:02d}.jpg" for camera in ("left", "right/up") for k in range(20)] + ["x.jpg"]


def vectors(dtype: str = "float32", count: int = len(NAMES)) -> NDArray[np.float64]:
    rows = np.random.default_rng(0).normal(0, 50, (count, 5))
    return np.abs(rows).astype(dtype) if dtype == "uint8" else rows.astype(dtype)


def write(root: Path, names: list[str], rows: NDArray[np.float64], *, tar: bool) -> FeatureReader:
    config = FeatureConfig("g", rows.dtype, rows.shape[1], None, "L2")
    with FeatureWriter(root, "global_features", "G", config, tar=tar) as writer:
        for name, row in zip(names, rows, strict=True):
            writer.write(name, row)
    return reader(root)


def reader(*roots: Path) -> FeatureReader:
    return FeatureReader("global_features", "G", [(root, root / FOLDER) for root in roots])


def read_vectors(features: FeatureReader, images: list[str]) -> NDArray[np.float32]:
    stored = np.empty((len(images), 5), features.config.dtype)
    module.read_stored(features, images, stored)
    return stored.astype(np.float32)


@pytest.fixture(params=[8, 40, 1 << 20], autouse=True)
def chunk_bytes(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_CHUNK_BYTES", request.param)


@pytest.mark.parametrize("tar", [False, True])
@pytest.mark.parametrize("dtype", ["float32", "float64", "int32", "uint8"])
def test_rows_are_those_read_one_by_one(tmp_path: Path, tar: bool, dtype: str) -> None:
    features = write(tmp_path, NAMES, vectors(dtype), tar=tar)
    # any order, and one twice
    images = [NAMES[k] for k in np.random.default_rng(1).permutation(len(NAMES))] + NAMES[:1]
    expected = np.array([features.read(image) for image in images], dtype=np.float32)
    found = read_vectors(features, images)
    np.testing.assert_array_equal(found, expected)
    blocks = KaptureVectors(features, images)
    assert len(blocks) == len(images) and blocks.dimension == 5
    unit = expected / np.linalg.norm(expected, axis=1)[:, None]
    out = np.empty((9, 5), dtype=np.float32)
    assert blocks.read(3, 12, out=out) is out
    np.testing.assert_allclose(out, unit[3:12], atol=1e-6)
    np.testing.assert_allclose(blocks.read(0, len(images)), unit, atol=1e-6)


def test_of_several_places_the_first_counts(tmp_path: Path) -> None:
    rows = vectors()
    write(tmp_path / "a", NAMES[:10], rows[:10], tar=True)
    write(tmp_path / "a", NAMES[5:20], -rows[5:20], tar=False)
    write(tmp_path / "b", NAMES[15:], 2 * rows[15:], tar=True)
    found = read_vectors(reader(tmp_path / "a", tmp_path / "b"), NAMES)
    np.testing.assert_array_equal(found, np.concatenate([rows[:10], -rows[10:20], 2 * rows[20:]]))


@pytest.mark.parametrize("tar", [False, True])
def test_missing_images_are_named(
    tmp_path: Path, tar: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    features = write(tmp_path, NAMES, vectors(), tar=tar)
    monkeypatch.setattr(module, "_CHUNK_BYTES", 1 << 20)
    images = [NAMES[0], "no.jpg", "left/no.jpg", "no/0.jpg"]
    with pytest.raises(DataError, match=r"3 images have no .* type G, the first is no\.jpg"):
        read_vectors(features, images)


@pytest.mark.parametrize("tar", [False, True])
@pytest.mark.parametrize("change", [-1, 1, 20])
def test_vectors_of_another_size_are_named(tmp_path: Path, tar: bool, change: int) -> None:
    config = FeatureConfig("g", np.dtype("f4"), 5)
    with FeatureWriter(tmp_path, "global_features", "G", config, tar=tar) as writer:
        writer.write("a.jpg", np.ones(5, dtype=np.float32))
        writer.put("b.jpg.gfeat", bytes(20 + change))
    with pytest.raises(DataError, match=rf"b\.jpg\.gfeat.*: {20 + change} bytes are not exactly"):
        read_vectors(reader(tmp_path), ["a.jpg", "b.jpg"])


def unit(count: int = len(NAMES)) -> NDArray[np.float32]:
    rows = vectors(count=count)
    return (rows / np.linalg.norm(rows, axis=1)[:, None]).astype(np.float32)


def test_unit_rows_of_a_tar_are_not_copied(tmp_path: Path) -> None:
    rows = unit()
    features = write(tmp_path, NAMES, rows, tar=True)
    out = np.zeros((10, 5), dtype=np.float32)
    found = KaptureVectors(features, NAMES).read(7, 17, out=out)
    np.testing.assert_array_equal(found, rows[7:17])
    every_other = KaptureVectors(features, NAMES[::2]).read(0, 10, out=out)
    np.testing.assert_array_equal(every_other, rows[:20:2])
    assert not found.flags.writeable and not out.any()
    # in another order, or of other lengths, they are copied
    longer = write(tmp_path / "2", NAMES, 2 * rows, tar=True)
    for copied, images, expected in (
        (features, NAMES[::-1], rows[::-1][:10]),
        (longer, NAMES, rows[:10]),
    ):
        assert KaptureVectors(copied, images).read(0, 10, out=out) is out
        np.testing.assert_allclose(out, expected, atol=1e-6)


def test_beyond_the_end_of_a_tar_cut_after_it_was_indexed_nothing_is_touched(
    tmp_path: Path,
) -> None:
    features = write(tmp_path, NAMES, unit(), tar=True)
    os.truncate(tmp_path / FOLDER / "global_features.tar", 20 * 1024)
    blocks = KaptureVectors(features, NAMES)
    for read in (lambda: read_vectors(features, NAMES), lambda: blocks.read(0, len(NAMES))):
        with pytest.raises(DataError, match=r"global_features\.tar: truncated"):
            read()
    np.testing.assert_array_equal(blocks.read(0, 20), unit()[:20])


def test_reads_that_stop_short_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = vectors()
    features = {tar: write(tmp_path / str(tar), NAMES, rows, tar=tar) for tar in (False, True)}
    whole = os.preadv
    monkeypatch.setattr(os, "preadv", lambda fd, buffers, at: whole(fd, [buffers[0][:7]], at))
    for tar in (False, True):
        np.testing.assert_array_equal(read_vectors(features[tar], NAMES), rows)


def test_only_plain_files_below_the_folder_are_read(tmp_path: Path) -> None:
    rows = vectors(count=2)
    features = write(tmp_path / "in", ["a.jpg", "b/b.jpg"], rows, tar=False)
    folder, outside = tmp_path / "in" / FOLDER, tmp_path / "outside"
    outside.mkdir()
    (outside / "c.jpg.gfeat").write_bytes(bytes(20))
    (folder / "folder.jpg.gfeat").mkdir()
    os.mkfifo(folder / "pipe.jpg.gfeat")
    for link, target in (
        ("link.jpg.gfeat", folder / "a.jpg.gfeat"),
        ("gone.jpg.gfeat", folder / "nothing"),
        ("out.jpg.gfeat", outside / "c.jpg.gfeat"),
        ("c", outside),
    ):
        (folder / link).symlink_to(target)
    np.testing.assert_array_equal(read_vectors(features, ["link.jpg", "a.jpg"]), rows[[0, 0]])
    refused = dict.fromkeys(("gone.jpg", "folder.jpg", "pipe.jpg", "a.jpg.gfeat/x"), "have no")
    refused |= dict.fromkeys(("out.jpg", "c/c.jpg"), "link")
    for image, told in (refused | dict.fromkeys(("../a.jpg", "/a.jpg"), "path")).items():
        with pytest.raises(DataError, match=told):
            read_vectors(features, [image])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_named(tmp_path: Path, bad: float) -> None:
    rows = vectors(count=3)
    rows[1, 2] = bad
    blocks = KaptureVectors(write(tmp_path, NAMES[:3], rows, tar=True), NAMES[:3])
    with pytest.raises(DataError, match=rf"{NAMES[1]}.* not all values are finite"):
        blocks.read(0, 3)
    np.testing.assert_allclose(np.linalg.norm(blocks.read(2, 3)), 1, atol=1e-6)


@pytest.mark.parametrize("scale", [0.0, 1e-44, 1e-30, 1e-12, 1.0, 1e12, 1e30, 1e37])
def test_unit_length_whatever_the_length_was(tmp_path: Path, scale: float) -> None:
    rows = np.array([[3, 4], [0, 0], [1, 0]]) * scale
    features = write(tmp_path, NAMES[:3], rows.astype(np.float32), tar=True)
    found = KaptureVectors(features, NAMES[:3]).read(0, 3)
    expected = [[0.6, 0.8], [0, 0], [1, 0]] if scale else np.zeros((3, 2))
    # the least numbers have few digits
    np.testing.assert_allclose(found, expected, atol=0.1 if scale == 1e-44 else 1e-6)


def test_many_threads_read_at_once(tmp_path: Path) -> None:
    rows = vectors()
    features = write(tmp_path, NAMES, rows, tar=True)
    starts = [k % 4 for k in range(80)]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda k: read_vectors(features, NAMES[k:]), starts))
    for k, part in zip(starts, found, strict=True):
        np.testing.assert_array_equal(part, rows[k:])
