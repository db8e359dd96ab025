"""Blobs in a tar, as tarfile writes it; kapture's own tars are in test_interop.py."""

from __future__ import annotations

import pickle
import tarfile
from pathlib import Path

import pytest

from megloc_kapture.io.kapture.features import TarBlobs

CONTENTS = {"a.kpt": b"x" * 1000, "deep/er/b.kpt": b"", "é ü.kpt": b"y" * 512}


@pytest.fixture
def tar(tmp_path: Path) -> Path:
    """A tar of the current folder, as ``tar cf x.tar .`` makes it."""
    for name, content in CONTENTS.items():
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "in" / name).write_bytes(content)
    with tarfile.open(tmp_path / "x.tar", "w") as file:
        file.add(tmp_path / "in", ".")
    return tmp_path / "x.tar"


def test_members_are_read_by_name(tar: Path) -> None:
    blobs = pickle.loads(pickle.dumps(TarBlobs(tar, ".kpt")))
    assert blobs.names() == sorted(CONTENTS)
    assert {name: blobs.read(name) for name in CONTENTS} == CONTENTS
    assert blobs.size("a.kpt") == 1000 and "a" not in blobs
    assert TarBlobs(tar, ".desc").names() == []


def test_an_empty_file_is_an_empty_tar(tmp_path: Path) -> None:
    (tmp_path / "x.tar").touch()
    assert TarBlobs(tmp_path / "x.tar", ".kpt").names() == []
