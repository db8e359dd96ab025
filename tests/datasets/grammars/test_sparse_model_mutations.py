"""Valid sparse models changed at random: a value or a DataError comes out, and nothing else.

The two readers of a text, in Python and compiled, must agree on which, to the last digit.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from kapture.converter.colmap.database import COLMAPDatabase

from megloc_kapture.datasets.grammars.colmap_binary import read_colmap_binary
from megloc_kapture.datasets.grammars.colmap_database import ColmapDatabase
from megloc_kapture.datasets.grammars.colmap_model import (
    ColmapImage,
    ColmapModel,
    write_colmap_binary,
    write_colmap_text,
)
from megloc_kapture.datasets.grammars.colmap_text import read_colmap_text
from megloc_kapture.datasets.grammars.model_lines import ModelLines
from megloc_kapture.datasets.grammars.nvm import NvmModel, read_nvm, write_nvm
from megloc_kapture.datasets.grammars.sparse_points import SparsePoints
from megloc_kapture.errors import DataError
from megloc_kapture.values import Camera, RigidTransform

pytestmark = pytest.mark.fuzz

PLAIN, COMPILED = 1 << 62, 0
MANY = settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])

POINTS = SparsePoints(
    np.array([[1.5, -2.0, 30.0], [4.0, 5.0, 6.0], [-7.0, 8.0, 9.0]]),
    np.array([[255, 0, 7], [1, 2, 3], [0, 0, 0]], dtype=np.uint8),
    np.array([0, 0, 0, 1]),
    np.array([0, 1, 0, 1], dtype=np.int32),
    np.array([2, 3, 0, 1], dtype=np.int32),
    np.array([[10.5, 20.25], [30, 40], [11, 21], [100, 0.5]], dtype=np.float32),
)
NVM = NvmModel(
    ("db/7.jpg", "db/8.jpg"),
    np.array([1000.0, 900.5]),
    np.array([[1.0, 0, 0, 0], [0.5, -0.5, 0.5, 0.5]]),
    np.array([[2.0, 0, -5], [1, 2, 3]]),
    np.array([-0.08, 0.25]),
    POINTS,
)
COLMAP = ColmapModel(
    {1: Camera("SIMPLE_RADIAL", 640, 480, (500, 320, 240, 0.1))},
    (
        ColmapImage(1, "db/7.jpg", 1, RigidTransform((1.0, 0.0, 0.0, 0.0), (0.5, 0.0, 2.0))),
        ColmapImage(4, "db/8.jpg", 1, RigidTransform((0.5, 0.5, 0.5, 0.5), (0.5, 0.0, 2.0))),
    ),
    POINTS,
)

TOKENS = st.sampled_from(
    [b"nan", b"-inf", b"1e999", b"-1", b"0", b"1", b"2", b"99999999999", b"18446744073709551616"]
    + [b"1_0", b"0x1", b".5", b"5.", b"-.5e-3", b"+7", b"1e", b"#", b"\xff", b"\0", b"\n", b"\r\n"]
    + [b" ", b"\t", b"\x0b", b"\x1c", b"\xc2\xa0", b"\xd9\xa1", b"../x", b"256", b"2147483648"]
    + [b"179769313486231570000e290", b"8.5070591730234615e37", b"1.7014118346046923e38", b"-0.0"]
)
PLACES = st.integers(0, 1 << 16)
EDITS = st.lists(
    st.one_of(
        st.tuples(st.just("insert"), PLACES, TOKENS),
        st.tuples(st.just("token"), PLACES, TOKENS),
        st.tuples(st.just("delete"), PLACES, st.integers(1, 40)),
        st.tuples(st.just("double"), PLACES, st.integers(1, 80)),
        st.tuples(st.just("byte"), PLACES, st.integers(0, 255)),
        st.tuples(st.just("cut"), PLACES, st.none()),
    ),
    min_size=1,
    max_size=4,
)


def changed(content: bytes, edits: list[tuple[str, int, Any]]) -> bytes:
    """Apply edits; places wrap around the length."""
    for kind, place, value in edits:
        k = place % (len(content) + 1)
        if kind == "insert":
            content = content[:k] + value + content[k:]
        elif kind == "token":  # in the place of a field
            end = min((e for e in (content.find(c, k) for c in b" \n") if e >= 0), default=k)
            begin = max(content.rfind(b" ", 0, end), content.rfind(b"\n", 0, end)) + 1
            content = content[:begin] + value + content[end:]
        elif kind == "delete":
            content = content[:k] + content[k + value :]
        elif kind == "double":
            content = content[: k + value] + content[k:]
        elif kind == "byte":
            content = content[:k] + bytes([value]) + content[k + 1 :]
        else:
            content = content[:k]
    return content


def outcome(read: Callable[[], Any]) -> Any:
    """The value as something comparable, or the error's one line."""
    try:
        value = read()
    except DataError as error:
        assert "\n" not in str(error)
        return str(error)
    return plain(value)


def plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.dtype.name, value.shape, value.tobytes()
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, NvmModel | ColmapModel | SparsePoints):
        return {name: plain(item) for name, item in vars(value).items()}
    return value


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the compiled reader meet chunk borders everywhere."""
    monkeypatch.setitem(ModelLines.__init__.__kwdefaults__, "chunk_bytes", 64)


@given(EDITS)
@MANY
@pytest.mark.usefixtures("small_chunks")
def test_nvm(tmp_path: Path, edits: list[tuple[str, int, Any]]) -> None:
    path = tmp_path / "m.nvm"
    write_nvm(path, NVM)
    path.write_bytes(changed(path.read_bytes(), edits))
    found = outcome(lambda: read_nvm(path, large_bytes=PLAIN))
    assert outcome(lambda: read_nvm(path, large_bytes=COMPILED)) == found
    poses = outcome(lambda: read_nvm(path, large_bytes=PLAIN, with_points=False))
    assert outcome(lambda: read_nvm(path, large_bytes=COMPILED, with_points=False)) == poses
    if not isinstance(found, str):
        assert [model["names"] for model in found] == [model["names"] for model in poses]


@given(st.sampled_from(["cameras.txt", "images.txt", "points3D.txt"]), EDITS)
@MANY
@pytest.mark.usefixtures("small_chunks")
def test_colmap_text(tmp_path: Path, name: str, edits: list[tuple[str, int, Any]]) -> None:
    write_colmap_text(tmp_path, COLMAP)
    (tmp_path / name).write_bytes(changed((tmp_path / name).read_bytes(), edits))
    found = outcome(lambda: read_colmap_text(tmp_path, large_bytes=PLAIN))
    assert outcome(lambda: read_colmap_text(tmp_path, large_bytes=COMPILED)) == found
    poses = outcome(lambda: read_colmap_text(tmp_path, with_points=False))
    if not isinstance(found, str):
        assert poses["images"] == found["images"]


@given(st.sampled_from(["cameras.bin", "images.bin", "points3D.bin"]), EDITS)
@MANY
def test_colmap_binary(tmp_path: Path, name: str, edits: list[tuple[str, int, Any]]) -> None:
    write_colmap_binary(tmp_path, COLMAP)
    (tmp_path / name).write_bytes(changed((tmp_path / name).read_bytes(), edits))
    found = outcome(lambda: read_colmap_binary(tmp_path))
    poses = outcome(lambda: read_colmap_binary(tmp_path, with_points=False))
    if not isinstance(found, str):
        assert poses["images"] == found["images"]
    else:
        assert str(tmp_path) in found


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
def test_colmap_database(tmp_path: Path, database: Path, edits: list[tuple[str, int, Any]]) -> None:
    path = tmp_path / "d.db"
    shutil.copy(database, path)
    path.write_bytes(changed(path.read_bytes(), edits))

    def read() -> Any:
        with ColmapDatabase(path) as opened:
            features = {
                name: (opened.keypoints(name), opened.descriptors(name)) for name in opened.images
            }
            return opened.cameras(), features

    outcome(read)
    assert [entry.name for entry in tmp_path.iterdir()] == ["d.db"]
