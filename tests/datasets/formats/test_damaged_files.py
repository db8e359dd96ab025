"""Valid files of every format, and changed at random: a value or one clear error."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import EDITS, Edit, changed
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from kapture.converter.colmap.database import COLMAPDatabase

from megloc_kapture.datasets import robotcar
from megloc_kapture.datasets.aachen import read_query_list
from megloc_kapture.datasets.formats import fourseasons_files
from megloc_kapture.datasets.formats.colmap_database import ColmapDatabase
from megloc_kapture.datasets.formats.colmap_reading import read_colmap_model, read_colmap_rigs
from megloc_kapture.datasets.formats.sparse_models import read_nvm
from megloc_kapture.datasets.formats.text_lines import TextFile, read_rigid_matrix
from megloc_kapture.datasets.inloc import read_transformation, read_wrong_scans
from megloc_kapture.errors import DataError
from megloc_kapture.values import RigidTransform

import pycolmap  # isort: skip  after the package, see megloc_kapture/io/colmap.py

TIME = 1602074877390449152
POSE = "-0.06,0.05,-0.15,0,0.6,0,0.8"
MATRIX = "0 -1 0 5.0\n1 0 0 2.0\n0 0 1 -1e-1\n0 0 0 1\n"
TEXTS: dict[Callable[[Path], Any], str] = {
    fourseasons_files.read_pinhole: "Pinhole 501.5 502.5 421.8 167.7 0.0 0.0 0.0 0.0\n800 400\n"
    "crop\n800 400\n",
    read_rigid_matrix: MATRIX,
    fourseasons_files.read_gnss_poses: f"# header\n{TIME},{POSE},0.96,2\n{TIME + 1},{POSE},1,2,5\n",
    fourseasons_files.read_poses: f"{TIME},{POSE}\n{TIME + 1},{POSE}\n".replace(",", " "),
    fourseasons_files.read_keyframe_accuracy: f"{TIME}\n{TIME + 1}\n",
    fourseasons_files.read_times: f"{TIME} 1602074877.39 0.25\r\n{TIME + 1} 1602074877.39 0.25\r\n",
    fourseasons_files.read_relocalization: f"{TIME} 1\n{TIME} 2 {POSE.replace(',', ' ')}\n",
    fourseasons_files.read_transformations: f"# transform_S_AS: t, q\n{POSE}\n"
    f"# transform_w_gpsw: t\n{POSE}\n\n# transform_e_gpsw: t, q\n{POSE}\n# GNSS scale\n0.96\n",
    fourseasons_files.read_keyframe: f"# timestamp\n{TIME}\n\n# fx, fy\n1,1,1,1,8,4,1\n\n"
    f"# camToWorld:\n{POSE}\n\n# Exposure\n0.25\n\n# Point Cloud\n# u,v\n1.0,2.0,0.5,9,0,0,1\n"
    "1,2,3,4,5,6,7,8,\n",
    robotcar.read_intrinsics: "fx 400.0\nfy 400.0\ncx 508.2\ncy 498.187378\n",
    robotcar.read_query_location: "dawn/left/1418721355075498.jpg\ndawn/rear/14.jpg\n",
    robotcar.read_test_list: "rear/1418721355075498.png\nrear/1418721354984638.png\n",
    robotcar.read_train_poses: "dawn/rear/1.png 1 0 0 10.0 0 1 0 0.0 0 0 1 -2.0 0 0 0 1\n",
    read_query_list: "query/day/a.jpg SIMPLE_RADIAL 1600 1200 1469.2 800 600 -0.0353\r\n"
    "query/b.jpg PINHOLE 768 1024 971.838 384 512 -0.00177789",
    read_transformation: f"Before general icp:\n{MATRIX}\nAfter general icp:\n{MATRIX}",
    read_wrong_scans: "known wrong:\n\n008\nDUC_scan_12.ptx 31\r\n2017\n",
}

NVM = b"""NVM_V3

2
db/7.jpg 1000 1 0 0 0 2 0 -5 0.08 0
db/8.jpg 900.5 0.5 -0.5 0.5 0.5 1 2 3 -0.25 0

3
1.5 -2 30 255 0 7 3 0 2 10.5 20.25 1 3 30 40 0 0 11 21
4 5 6 1 2 3 1 1 1 100 0.5
-7 8 9 0 0 0 0

0
"""
MANY = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def outcome(read: Callable[[], Any], path: Path) -> Any:
    """The value, of finite poses, or the error's one line, which names the file."""
    try:
        value = read()
    except DataError as error:
        assert str(error).startswith(str(path)) and "\n" not in str(error)
        return str(error)
    for item in value if isinstance(value, list) else [value]:
        pose = getattr(item, "cam_from_world", item)
        if isinstance(pose, RigidTransform):
            assert np.isfinite([*pose.quat_wxyz, *pose.translation]).all()
            assert np.linalg.norm(pose.quat_wxyz) == pytest.approx(1, abs=1e-9)
    return value


@pytest.fixture(params=[64, 1 << 20], ids=["small blocks", "one block"])
def block_bytes(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let borders of blocks be everywhere, or nowhere."""
    monkeypatch.setitem(TextFile.__init__.__kwdefaults__, "block_bytes", request.param)


READERS = pytest.mark.parametrize("reader", TEXTS, ids=lambda reader: reader.__name__)


@READERS
def test_line_ends_and_blanks_do_not_matter(tmp_path: Path, reader: Callable[[Path], Any]) -> None:
    text, path = TEXTS[reader].replace("\r\n", "\n"), tmp_path / "file.txt"
    path.write_bytes(text.encode())
    expected = repr(reader(path))
    for other in (
        text.replace("\n", "\r\n"),
        text.rstrip("\n"),
        text + "\n \r\n",
        "\ufeff" + text,
        "".join(f" {line}\t\n" for line in text.split("\n")),
    ):
        path.write_bytes(other.encode())
        assert repr(reader(path)) == expected, other


@READERS
def test_what_is_no_such_file(tmp_path: Path, reader: Callable[[Path], Any]) -> None:
    path = tmp_path / "file.txt"
    for content in (b"", b"\n\r\n  \n", b"\xef\xbb\xbf"):
        path.write_bytes(content)
        if reader in (fourseasons_files.read_keyframe_accuracy, read_wrong_scans):
            assert not reader(path)
        else:
            with pytest.raises(DataError, match=r"file\.txt\b"):
                reader(path)
    path.write_bytes(b"1\n2 \xff")
    with pytest.raises(DataError, match=r"file\.txt:2: not a text file in UTF-8"):
        reader(path)
    path.unlink()
    with pytest.raises(DataError, match=r"file\.txt: file is missing"):
        reader(path)
    path.mkdir()
    with pytest.raises(DataError, match=r"file\.txt: not a plain file"):
        reader(path)


@READERS
@given(edits=EDITS)
@MANY
def test_texts(tmp_path: Path, reader: Callable[[Path], Any], edits: list[Edit]) -> None:
    path = tmp_path / "file.txt"
    path.write_bytes(changed(TEXTS[reader].encode(), edits))
    outcome(lambda: reader(path), path)


@given(EDITS)
@MANY
@pytest.mark.usefixtures("block_bytes")
def test_nvm(tmp_path: Path, edits: list[Edit]) -> None:
    path = tmp_path / "m.nvm"
    path.write_bytes(changed(NVM, edits))
    found = outcome(lambda: read_nvm(path), path)
    poses = outcome(lambda: read_nvm(path, with_points=False), path)
    if not isinstance(found, str):
        assert [model.names for model in found] == [model.names for model in poses]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """A model with rigs of three cameras as COLMAP writes it, in both forms."""
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 3, 2, 10
    made = pycolmap.synthesize_dataset(options)
    folder = tmp_path_factory.mktemp("model")
    made.write_text(folder)
    made.write_binary(folder)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("form", ["txt", "bin"])
@given(st.sampled_from(["cameras", "images", "points3D", "rigs", "frames"]), EDITS)
@MANY
@pytest.mark.usefixtures("block_bytes")
def test_colmap_models(
    tmp_path: Path, model: dict[str, bytes], form: str, name: str, edits: list[Edit]
) -> None:
    for file, content in model.items():
        if file.endswith(form):
            edited = changed(content, edits) if file == f"{name}.{form}" else content
            (tmp_path / file).write_bytes(edited)
    found = outcome(lambda: read_colmap_model(tmp_path), tmp_path)
    poses = outcome(lambda: read_colmap_model(tmp_path, with_points=False), tmp_path)
    if not isinstance(found, str):
        assert poses.images == found.images
    rigs = outcome(lambda: read_colmap_rigs(tmp_path, binary=form == "bin"), tmp_path)
    if not isinstance(rigs, str):
        for cams_from_rig in rigs.cams_from_rig.values():
            for pose in cams_from_rig.values():
                assert np.isfinite([*pose.quat_wxyz, *pose.translation]).all()


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("database") / "good.db"
    opened = COLMAPDatabase.connect(str(path))
    opened.create_tables()
    camera_id = opened.add_camera(2, 640, 480, np.array([500.0, 320, 240, 0.1]))
    for name in ("a.jpg", "b/c.jpg"):
        image_id = opened.add_image(name, camera_id)
        opened.add_keypoints(image_id, np.arange(24, dtype=np.float32).reshape(4, 6))
        opened.add_descriptors(image_id, np.arange(64, dtype=np.uint8).reshape(4, 16))
    opened.commit()
    opened.close()
    return path


@given(EDITS)
@MANY
def test_colmap_database(tmp_path: Path, database: Path, edits: list[Edit]) -> None:
    path = tmp_path / "d.db"
    path.write_bytes(changed(database.read_bytes(), edits))

    def read() -> Any:
        with ColmapDatabase(path) as opened:
            features = {
                name: (opened.keypoints(name), opened.descriptors(name)) for name in opened.images
            }
            return features, opened.feature_type()

    outcome(read, path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["d.db"]
