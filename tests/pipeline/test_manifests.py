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
from megloc_kapture.pipeline.manifests import FileHashes, fingerprint, read_manifest
from tests.pipeline.runs import manifest

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
    made = manifest("s", options={"x": [1, None]}, inputs={"a": "1"}, counts={"images": 2.0})
    write_json_model(tmp_path / "s.json", made)
    assert read_manifest(tmp_path / "s.json") == made


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
    assert of("b", "a") == both != of("a")
    (tmp_path / "b").write_text("3")
    assert of("a", "b") != both
    (tmp_path / "b").write_text("2")
    assert of("a", "b") == both
    (tmp_path / "b").rename(tmp_path / "c")
    assert of("a", "c") != both
    with pytest.raises(DataError, match="b: cannot be read: No such file"):
        of("a", "b")


def test_what_is_remembered_is_read_again_when_it_has_changed(tmp_path: Path) -> None:
    file, memory = tmp_path / "a", tmp_path / "memory.json"
    file.write_text("1")
    hashes = FileHashes(memory)
    old = hashes.of_file(file)
    content = hashes.content()
    content[str(file)][4] = "remembered"
    memory.write_text(json.dumps(content))
    assert FileHashes(memory).of_file(file) == "remembered"
    # changed in place, whatever its times say
    before = file.stat()
    file.write_text("2")
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert FileHashes(memory).of_file(file) not in ("remembered", old)


@pytest.mark.parametrize("content", ["", "[]", "nonsense", '{"x": 1}'])
def test_a_broken_memory_is_forgotten(tmp_path: Path, content: str) -> None:
    (tmp_path / "a").write_text("1")
    (tmp_path / "memory.json").write_text(content)
    hashes = FileHashes(tmp_path / "memory.json")
    assert hashes.of_file(tmp_path / "a") == FileHashes(tmp_path / "none").of_file(tmp_path / "a")
