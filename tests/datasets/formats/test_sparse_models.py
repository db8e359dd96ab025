"""The arrays of a sparse model, and NVM with every quirk of the published files.

NVM is compared with kapture's own importer, and with what is written by hand.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import kapture
import kapture.io.csv
import numpy as np
import pytest
from kapture.io.records import TransferAction
from megloc_twins.model_files import write_nvm
from scipy.spatial.transform import Rotation

from megloc_kapture.datasets.formats.sparse_models import (
    NvmModel,
    SparsePoints,
    image_order,
    read_nvm,
)
from megloc_kapture.datasets.formats.text_lines import TextFile
from megloc_kapture.errors import DataError
from megloc_kapture.io.images import write_image

SAMPLE = "kapture_samples/Aachen-Day-Night"

CAMERA = "db/7.jpg 1000.0 1 0 0 0 2.0 0.0 -5.0 0.08 0"
TURNED = "db/8.jpg 900.5 0.5 -0.5 0.5 0.5 1 2 3 -0.25 0"
POINTS = [
    "1.5 -2 3e1 255 0 7 3 0 12 10.5 20.25 1 3 30.125 40 0 9 11 21",
    "4 5 6 1 2 3 1 1 2147483647 1e2 .5",
    "-7 8 9 0 0 0 0",
]
MODEL = ["2", CAMERA, TURNED, "", "3", *POINTS]
ARRAYS = ("xyz", "rgb", "point_ids", "image_ids", "feature_ids", "xy_px")


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let borders of blocks be everywhere."""
    monkeypatch.setitem(TextFile.__init__.__kwdefaults__, "block_bytes", 100)


def file(path: Path, lines: list[str], end: str = "\n") -> Path:
    path.write_bytes(end.join(["NVM_V3", "", *lines]).encode())
    return path


def check_model(model: NvmModel) -> None:
    """What the lines above say."""
    assert model.names == ("db/7.jpg", "db/8.jpg")
    assert model.focal_px.tolist() == [1000.0, 900.5]
    assert model.k_colmap.tolist() == [-0.08, 0.25]
    assert model.centers.tolist() == [[2, 0, -5], [1, 2, 3]]
    assert model.cam_from_world(0).translation == (-2.0, 0.0, 5.0)
    rotation = Rotation.from_quat([-0.5, 0.5, 0.5, 0.5])
    expected = -rotation.as_matrix() @ [1, 2, 3]
    assert model.cam_from_world(1).quat_wxyz == (0.5, -0.5, 0.5, 0.5)
    assert np.allclose(model.cam_from_world(1).translation, expected, atol=1e-14)
    points = model.points
    assert points.xyz.tolist() == [[1.5, -2, 30], [4, 5, 6], [-7, 8, 9]]
    assert points.rgb.tolist() == [[255, 0, 7], [1, 2, 3], [0, 0, 0]]
    assert points.point_ids.tolist() == [0, 0, 0, 1]
    assert points.image_ids.tolist() == [0, 1, 0, 1]
    assert points.feature_ids.tolist() == [12, 3, 9, 2147483647]
    assert points.xy_px.tolist() == [[10.5, 20.25], [30.125, 40], [11, 21], [100, 0.5]]
    dtypes = [getattr(points, name).dtype for name in ARRAYS]
    assert dtypes == [np.float64, np.uint8, np.int64, np.int32, np.int32, np.float32]


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.usefixtures("small_blocks")
def test_the_plain_form(tmp_path: Path, end: str) -> None:
    for tail in ([], [""], ["0"], ["", "0", "", "some PLY stuff"]):
        [model] = read_nvm(file(tmp_path / "m.nvm", MODEL + tail, end))
        check_model(model)
    # a file of cameras alone is a model too
    [model] = read_nvm(file(tmp_path / "m.nvm", ["1", CAMERA, "0", "0"], end))
    assert model.names == ("db/7.jpg",) and len(model.points) == 0


@pytest.mark.usefixtures("small_blocks")
def test_all_known_variants_of_the_layout(tmp_path: Path) -> None:
    lines = ["\ufeffNVM_V3 FixedK 1000 512 1000.5 384 ", " ", "\t", " 2  "]
    lines += ["./db/7.jpg\t1000.0 1 0 0 0  2.0 0.0 -5.0 0.08 0 ", "", TURNED.replace(" ", "\t")]
    lines += ["", "", "3 ", *(f"  {point} \n" for point in POINTS)]
    lines += ["1", "db/9.jpg 5 1 0 0 0 0 0 0 0 0", "1", "1 2 3 64.0 5 6 1 0 0 1 2"]
    unregistered = [f"unregistered/{k}.jpg 0 0 0 0 0 0 0 0 0 0" for k in (1, 2)]
    lines += ["2", *unregistered, "0", "0", "# what follows is not looked at: 1 2 three"]
    path = tmp_path / "m.nvm"
    path.write_bytes("\n".join(lines).encode() + b"\n\xff\x00\xfe")
    first, second = read_nvm(path)
    check_model(first)
    assert second.names == ("db/9.jpg",)
    assert second.points.rgb.tolist() == [[64, 5, 6]]
    assert second.points.point_ids.tolist() == [0]
    assert np.signbit(second.k_colmap).tolist() == [False]  # no minus zero
    models = read_nvm(path, with_points=False)
    assert [model.names for model in models] == [first.names, second.names]
    assert all(len(model.points) == 0 for model in models)
    assert np.array_equal(models[0].centers, first.centers)


def test_quaternions_are_normalised_or_refused(tmp_path: Path) -> None:
    camera = "a.jpg 1 0.5003 -0.5 0.5 0.5 0 0 0 0 0"
    [model] = read_nvm(file(tmp_path / "m.nvm", ["1", camera, "0"]))
    assert np.linalg.norm(model.quat_wxyz[0]) == pytest.approx(1, abs=1e-15)
    w, x, y, z = model.quat_wxyz[0]
    assert w / x == pytest.approx(-0.5003 / 0.5, rel=1e-12)
    assert (y, z) == (-x, -x)
    path = file(tmp_path / "m.nvm", ["2", camera.replace("0.5003", "0.503"), CAMERA, "0"])
    with pytest.raises(DataError, match=r"m\.nvm:4: .*not a unit quaternion"):
        read_nvm(path)


def import_with_kapture(nvm: Path, images: Path, output: Path) -> kapture.Kapture:
    from tools.kapture_import_nvm import import_nvm

    import_nvm(str(nvm), str(images), str(output), None, False, True, True, TransferAction.skip)
    return kapture.io.csv.kapture_from_dir(str(output))


def observed(data: kapture.Kapture, folder: Path) -> list[tuple[int, str, float, float]]:
    """(point, image, x, y) of every observation."""
    rows = []
    for point in data.observations:
        for image, keypoint in data.observations[point, "sift"]:
            path = kapture.io.features.get_keypoints_fullpath("sift", str(folder), image)
            keypoints = kapture.io.features.image_keypoints_from_file(path, np.float32, 2)
            rows.append((point, image, *keypoints[keypoint].tolist()))
    return sorted(rows)


def check_against_kapture(models: list[NvmModel], data: kapture.Kapture, folder: Path) -> None:
    """Poses, distortion, points and observations; kapture merges the models of a file."""
    merged = np.concatenate([np.hstack([m.points.xyz, m.points.rgb]) for m in models])
    assert np.allclose(merged, data.points3d.as_array(), atol=1e-9)
    first = 0
    rows: set[tuple[Any, ...]] = set()
    sensors = {name: (time, sensor) for time, sensor, name in kapture.flatten(data.records_camera)}
    for model in models:
        for index, name in enumerate(model.names):
            camera = data.sensors[sensors[name][1]]
            assert camera.camera_params[2] == model.focal_px[index]
            assert camera.camera_params[5] == model.k_colmap[index]
            theirs, ours = data.trajectories[sensors[name]], model.cam_from_world(index)
            # kapture keeps the length of the quaternion, which has six digits here
            assert np.allclose(ours.quat_wxyz, theirs.r_raw, atol=1e-6)
            assert np.allclose(ours.translation, theirs.t_raw, atol=1e-9)
        points = model.points
        for point, image, (x, y) in zip(
            points.point_ids, points.image_ids, points.xy_px.tolist(), strict=True
        ):
            rows.add((first + int(point), model.names[image], x, y))
        first += len(points)
    assert sorted(rows) == observed(data, folder)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["aachen_cvpr2018_db.nvm", "aachen_two_parts.nvm"])
def test_the_published_sample_reads_as_kapture_reads_it(
    shared_data: Path, tmp_path: Path, name: str
) -> None:
    nvm = shared_data / SAMPLE / "3D-models" / name
    models = read_nvm(nvm)
    assert len(models) == (2 if "two_parts" in name else 1)
    data = import_with_kapture(nvm, shared_data / SAMPLE / "images_upright", tmp_path)
    check_against_kapture(models, data, tmp_path)


def random_model(seed: int, num_images: int = 7, num_points: int = 60) -> NvmModel:
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(num_images, random_state=seed).as_quat()
    seen = rng.random((num_points, num_images)) < 0.4
    point_ids, image_ids = np.nonzero(seen)
    # an image sees a point twice, and features are not dense
    point_ids, image_ids = np.r_[point_ids, point_ids[:1]], np.r_[image_ids, image_ids[:1]]
    features = np.concatenate([rng.permutation(500)[: len(point_ids)]])
    points = SparsePoints(
        rng.normal(0, 1e3, (num_points, 3)),
        rng.integers(0, 256, (num_points, 3)).astype(np.uint8),
        point_ids.astype(np.int64),
        image_ids.astype(np.int32),
        features.astype(np.int32),
        rng.uniform(0, 1e3, (len(features), 2)).astype(np.float32),
    )
    return NvmModel(
        tuple(f"db/{i}.jpg" for i in rng.permutation(num_images)),
        rng.uniform(500, 1000, num_images),
        np.roll(rotations, 1, axis=1),
        rng.normal(0, 1e3, (num_images, 3)),
        rng.normal(0, 0.1, num_images),
        points.sorted_by_point(),
    )


@pytest.mark.usefixtures("small_blocks")
def test_what_is_written_comes_back_exactly_and_kapture_reads_it(tmp_path: Path) -> None:
    model, path = random_model(2), tmp_path / "m.nvm"
    write_nvm(path, model)
    [read] = read_nvm(path)
    assert read.names == model.names
    for name in ("focal_px", "centers", "k_colmap"):
        assert np.array_equal(getattr(read, name), getattr(model, name))
    assert np.allclose(read.quat_wxyz, model.quat_wxyz, rtol=0, atol=1e-15)
    for name in ARRAYS:
        ours, theirs = getattr(read.points, name), getattr(model.points, name)
        assert ours.dtype == theirs.dtype and np.array_equal(ours, theirs)
    # COLMAP's exporter leaves blanks in blank lines, which kapture does not take for blank
    text = path.read_text()
    assert text.startswith("NVM_V3 \n \n7  \n")
    path.write_text(text.replace("\n \n", "\n\n"))
    for name in model.names:
        write_image(tmp_path / "images" / name, np.zeros((48, 64, 3), np.uint8))
    data = import_with_kapture(path, tmp_path / "images", tmp_path / "kapture")
    check_against_kapture([model], data, tmp_path / "kapture")


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("1 2 3 4 5", "got 5 fields"),
        ("1 2 3 4 5 6 1 0 0 1", "expected 11 fields for 1 measurements, got 10"),
        ("1 2 3 4 5 6 1 0 0 1 2 3", "expected 11 fields for 1 measurements, got 12"),
        ("1 2 3 4 5 6 999999999999 0 0 1 2", "expected 4000000000003 fields"),
        ("1 2 3 4 5 6 -1", "'-1' is not a whole number"),
        ("nan 2 3 4 5 6 0", "coordinate 'nan' is not a finite number"),
        ("1 2 3\0 4 5 6 0", "is not a finite number"),
        ("1 2 3 256 5 6 0", "a colour is not made of whole numbers"),
        ("1 2 3 4 -5 6 0", "a colour is not made of whole numbers"),
        ("1 2 3 4 5 6.5 0", "a colour is not made of whole numbers"),
        ("1 2 3 4 5 6 1 2 0 1 2", "image index 2 is out of range, there are 2"),
        ("1 2 3 4 5 6 1 -1 0 1 2", "image index '-1' is not a whole number"),
        ("1 2 3 4 5 6 1 0 2147483648 1 2", "feature index 2147483648 is out of range"),
        ("1 2 3 4 5 6 1 0 1.5 1 2", "feature index '1.5' is not a whole number"),
        ("1 2 3 4 5 6 1 0 0 inf 2", "image coordinate 'inf' is not a finite number"),
        ("1 2 3 4 5 6 1 0 0 2e38 2", "image coordinate '2e38' is out of range"),
    ],
)
@pytest.mark.usefixtures("small_blocks")
def test_bad_points_name_file_and_line(tmp_path: Path, line: str, match: str) -> None:
    good = POINTS * 4
    lines = ["2", CAMERA, TURNED, "", "99", *good[:9], "", line, *good]
    path = file(tmp_path / "m.nvm", lines)
    with pytest.raises(DataError, match=match) as caught:
        read_nvm(path)
    assert str(caught.value).startswith(f"{path}:18: ")


@pytest.mark.parametrize(
    ("lines", "match"),
    [
        (["0"], r"m\.nvm: holds no model"),
        (["x"], r"m\.nvm:3: the number of cameras 'x' is not a whole number"),
        (["2 2"], r"m\.nvm:3: expected 1 fields \(the number of cameras"),
        (["2", CAMERA], r"m\.nvm:4: the file ends after 1 of 2 cameras"),
        (["99999999999999999", CAMERA], r"ends after 1 of 99999999999999999 cameras"),
        (["1", CAMERA], r"m\.nvm:4: the file ends where the number of points was expected"),
        (
            ["1", CAMERA, "99999999999999999"],
            "5: the file ends after 0 of 99999999999999999 points",
        ),
        (["1", CAMERA, "x"], r"m\.nvm:5: the number of points 'x'"),
        (["1", CAMERA, "1", "1 2 3 4 5 6 0", "1 2 3"], r"m\.nvm:7: expected 1 fields"),
        (["1", CAMERA + " 7", "0"], r"m\.nvm:4: expected 11 fields .*, got 12"),
        (["1", CAMERA.replace("1000.0", "NaN"), "0"], r"m\.nvm:4: camera parameter 'NaN'"),
        (["1", "../" + CAMERA, "0"], r"m\.nvm:4: .* leads out of its folder"),
        (["2", CAMERA, "./" + CAMERA, "0"], r"m\.nvm:5: image 'db/7.jpg' is listed twice, .* 4"),
    ],
)
def test_bad_structure_is_named(tmp_path: Path, lines: list[str], match: str) -> None:
    path = file(tmp_path / "m.nvm", lines)
    for with_points in (True, False):
        with pytest.raises(DataError, match=match):
            read_nvm(path, with_points=with_points)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "the first line must begin with NVM_V3"),
        (b"\n\n", "the first line must begin with NVM_V3"),
        (b"NVM_V3_R9T\n1\n", "the first line must begin with NVM_V3"),
        (b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 40, "the first line must begin with NVM_V3"),
        (b"NVM_V3\n\n", "holds no model"),
        (b"NVM_V3 FixedK 1 2 3\n", "expected 6 fields"),
        (b"NVM_V3 FixedX 1 2 3 4\n", "only FixedK"),
        (b"NVM_V3 FixedK 1 2 3 x\n", "calibration 'x'"),
        (b"NVM_V3\n1\n\xff.jpg 1 1 0 0 0 0 0 0 0 0\n0\n", "name is not UTF-8"),
    ],
)
def test_bad_content_is_named(tmp_path: Path, content: bytes, match: str) -> None:
    path = tmp_path / "m.nvm"
    path.write_bytes(content)
    with pytest.raises(DataError, match=match) as caught:
        read_nvm(path)
    assert str(caught.value).startswith(f"{path}:")


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"m\.nvm: file is missing"):
        read_nvm(tmp_path / "m.nvm")
    os.mkfifo(tmp_path / "m.nvm")
    for path in (tmp_path / "m.nvm", tmp_path):
        with pytest.raises(DataError, match="not a plain file"):
            read_nvm(path)


@pytest.mark.usefixtures("small_blocks")
def test_many_small_models_and_one_that_ends_within_a_block(tmp_path: Path) -> None:
    lines = []
    for k in range(40):
        points = POINTS[2:] * (k % 5 + 1)
        lines += ["1", f"{k}.jpg 1 1 0 0 0 0 0 0 0 0", str(len(points)), *points]
    models = read_nvm(file(tmp_path / "m.nvm", lines))
    assert [model.names for model in models] == [(f"{k}.jpg",) for k in range(40)]
    assert [len(model.points) for model in models] == [k % 5 + 1 for k in range(40)]
    # with one point less announced, the next line is no number of cameras
    lines[2 + 4 * 0] = "0"
    with pytest.raises(DataError, match=r"m\.nvm:6: expected 1 fields"):
        read_nvm(file(tmp_path / "m.nvm", lines))


# ---------------------------------------------------------------------------- sparse points


def sparse_points(num_points: int, rows: list[tuple[int, int, int]]) -> SparsePoints:
    table = np.array(rows, dtype=np.int64).reshape(-1, 3)
    return SparsePoints(
        np.arange(3.0 * num_points).reshape(-1, 3),
        np.full((num_points, 3), num_points, np.uint8),
        table[:, 0],
        table[:, 1].astype(np.int32),
        table[:, 2].astype(np.int32),
        table[:, 1:].astype(np.float32),
    )


@pytest.mark.parametrize("highest", [1, 5, 2**16 - 1, 2**16, 2**31 - 1])
def test_rows_are_grouped_by_image_in_their_order(highest: int) -> None:
    ids = np.random.default_rng(0).integers(0, highest, 5000, endpoint=True).astype(np.int32)
    ids[:2] = highest
    assert np.array_equal(image_order(ids), np.argsort(ids, kind="stable"))
    assert image_order(ids[:0]).tolist() == []


def test_models_are_joined_behind_one_another() -> None:
    first, second = (
        sparse_points(2, [(0, 0, 5), (1, 1, 6)]),
        sparse_points(3, [(0, 1, 7), (2, 0, 8)]),
    )
    joined = SparsePoints.joined([first, SparsePoints.none(), second])
    assert len(joined) == 5
    assert joined.rgb[:, 0].tolist() == [2, 2, 3, 3, 3]
    assert joined.point_ids.tolist() == [0, 1, 2, 4]
    assert joined.image_ids.tolist() == [0, 1, 1, 0]
    assert joined.feature_ids.tolist() == [5, 6, 7, 8]
    assert joined.xy_px.dtype == np.float32
    assert joined.image_ids.dtype == np.int32
    assert len(SparsePoints.joined([])) == 0


def test_sorting_by_point_keeps_the_order_of_equals() -> None:
    ordered = sparse_points(3, [(2, 0, 1), (0, 1, 2), (2, 1, 3), (0, 0, 4)]).sorted_by_point()
    assert ordered.point_ids.tolist() == [0, 0, 2, 2]
    assert ordered.xy_px.tolist() == [[1, 2], [0, 4], [0, 1], [1, 3]]
    for ids, column in ((ordered.image_ids, 0), (ordered.feature_ids, 1)):
        assert ids.tolist() == ordered.xy_px[:, column].tolist()
    assert ordered.sorted_by_point() is ordered
    for bad in (3, -1):
        with pytest.raises(ValueError, match="point_ids are out of range"):
            sparse_points(3, [(bad, 0, 0)]).sorted_by_point()


def test_image_ids_are_checked() -> None:
    model = sparse_points(1, [(0, 0, 0), (0, 4, 0)])
    model.check_images(5)
    SparsePoints.none().check_images(0)
    with pytest.raises(ValueError, match="there are 4 images"):
        model.check_images(4)
    with pytest.raises(ValueError, match="out of range"):
        sparse_points(1, [(0, -1, 0)]).check_images(4)


@pytest.mark.parametrize("name", ["rgb", "image_ids", "feature_ids", "xy_px"])
def test_arrays_must_fit_together(name: str) -> None:
    good = sparse_points(2, [(0, 0, 5)])
    arrays = {key: getattr(good, key) for key in vars(good)}
    arrays[name] = arrays[name][:0]
    with pytest.raises(ValueError, match=f"{name} has shape"):
        SparsePoints(**arrays)
