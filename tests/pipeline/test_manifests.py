"""Fingerprints: the same for the same work, another for any other; hashes remembered safely."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import write_json_model
from megloc_kapture.pipeline.manifests import FileHashes, Manifest, fingerprint, read_manifest

scalars = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
trees = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)
options = st.dictionaries(st.text(), trees, max_size=4)


@given(options)
def test_order_does_not_matter_and_content_does(given_options: dict[str, Any]) -> None:
    mark = fingerprint("s", 1, given_options, {"a": "1"})
    turned = dict(reversed(given_options.items()))
    assert fingerprint("s", 1, turned, {"a": "1"}) == mark
    # what a manifest gives back
    assert fingerprint("s", 1, json.loads(json.dumps(given_options)), {"a": "1"}) == mark
    changed = [
        fingerprint("t", 1, given_options, {"a": "1"}),
        fingerprint("s", 2, given_options, {"a": "1"}),
        fingerprint("s", 1, given_options | {"\0": 1}, {"a": "1"}),
        fingerprint("s", 1, given_options, {"a": "2"}),
        fingerprint("s", 1, given_options, {"b": "1"}),
    ]
    assert mark not in changed and len(set(changed)) == 5


def test_a_manifest_is_read_back(tmp_path: Path) -> None:
    manifest = Manifest(
        stage="s",
        version=1,
        options={"x": [1, None]},
        inputs={"a": "1"},
        fingerprint="f",
        outputs=("map",),
        counts={"images": 2.0},
        seconds=1.5,
        started="2026-01-01T00:00:00+00:00",
        versions={"numpy": "2"},
    )
    write_json_model(tmp_path / "s.json", manifest)
    assert read_manifest(tmp_path / "s.json") == manifest


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"stage": "s"}', b"\xff\xfe"])
def test_a_broken_manifest_is_none(tmp_path: Path, content: bytes) -> None:
    assert read_manifest(tmp_path / "s.json") is None
    (tmp_path / "s.json").write_bytes(content)
    assert read_manifest(tmp_path / "s.json") is None


def test_hashes_follow_names_and_contents(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("1")
    (tmp_path / "b").write_text("2")

    def of(*names: str) -> str:
        return FileHashes(tmp_path / "none").of_files(tmp_path, [tmp_path / n for n in names])

    both = of("a", "b")
    assert of("b", "a") == both
    assert of("a") != both
    (tmp_path / "b").write_text("3")
    assert of("a", "b") != both
    (tmp_path / "b").write_text("2")
    assert of("a", "b") == both
    (tmp_path / "b").rename(tmp_path / "c")
    assert of("a", "c") != both


def remembered(path: Path, file: Path) -> FileHashes:
    hashes = FileHashes(path)
    hashes.of_file(file)
    path.write_text(json.dumps(hashes.content()))
    return FileHashes(path)


def test_what_is_remembered_is_not_read_again(tmp_path: Path) -> None:
    file, memory = tmp_path / "a", tmp_path / "memory.json"
    file.write_text("1")
    remembered(memory, file)
    content = json.loads(memory.read_text())
    content[str(file)][4] = "remembered"
    memory.write_text(json.dumps(content))
    assert FileHashes(memory).of_file(file) == "remembered"


def test_a_file_changed_in_place_is_read_again_whatever_its_times_say(tmp_path: Path) -> None:
    file, memory = tmp_path / "a", tmp_path / "memory.json"
    file.write_text("1")
    hashes = remembered(memory, file)
    old = hashes.of_file(file)
    before = file.stat()
    file.write_text("2")
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert hashes.of_file(file) != old


@pytest.mark.parametrize("content", ["", "[]", "nonsense", '{"x": 1}'])
def test_a_broken_memory_is_forgotten(tmp_path: Path, content: str) -> None:
    (tmp_path / "a").write_text("1")
    (tmp_path / "memory.json").write_text(content)
    hashes = FileHashes(tmp_path / "memory.json")
    assert hashes.of_file(tmp_path / "a") == FileHashes(tmp_path / "none").of_file(tmp_path / "a")


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="a.jpg: cannot be read: No such file"):
        FileHashes(tmp_path / "none").of_file(tmp_path / "a.jpg")
