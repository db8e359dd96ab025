"""Whose folder a workspace is, who may work in it, and how finished work is known again."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.files import write_json_model
from megloc_kapture.pipeline.plan import Workspace, fingerprint, read_manifest
from megloc_kapture.stages.stage import files_fingerprint
from tests.pipeline.runs import manifest


def use(workspace: Workspace) -> None:
    """Leave what a finished stage leaves."""
    with workspace.lock(), workspace.staging("a", "1") as out:
        (out / "a.txt").write_text("a")
        workspace.publish(out, ("a.txt",))


def test_a_used_workspace_is_known_again_and_an_unused_one_is_taken_away(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "runs" / "w")
    with workspace.lock(), workspace.staging("a", "1") as out:
        (out / "a.txt").write_text("a")
    assert list((tmp_path / "runs").iterdir()) == []
    use(Workspace(tmp_path / "w"))
    for _ in range(2):  # cut off before its manifest: still ours
        with Workspace(tmp_path / "w").lock():
            assert (tmp_path / "w" / "a.txt").read_text() == "a"
    assert (tmp_path / "w" / "a.txt").read_text() == "a"


def test_a_folder_of_somebody_else(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(OutputError, match="not a workspace of megloc"):
        Workspace(tmp_path)
    with Workspace(tmp_path, force=True).lock():
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
    use(Workspace(tmp_path, force=True))
    Workspace(tmp_path)
    assert (tmp_path / "thesis.txt").read_text() == "mine"


def test_one_run_at_a_time_also_of_two_processes(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "w")
    use(workspace)
    code = (
        "import sys\nfrom pathlib import Path\n"
        "from megloc_kapture.errors import OutputError\n"
        "from megloc_kapture.pipeline.plan import Workspace\n"
        "try:\n    with Workspace(Path(sys.argv[1])).lock(): print('free')\n"
        "except OutputError as error: print(error)\n"
    )

    def other() -> str:
        command = [sys.executable, "-c", code, str(workspace.root)]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    with workspace.lock():
        assert "another run is using this workspace" in other()
    assert other() == "free\n"


def test_publishing_replaces_and_takes_away_but_no_link_of_the_users(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "w")
    outputs = ("sub/folder", "file.txt", "other.txt")
    for number in "12":
        with workspace.lock(), workspace.staging("a", "1") as out:
            (out / "sub" / "folder").mkdir(parents=True)
            (out / "sub" / "folder" / number).touch()
            (out / ("file.txt" if number == "1" else "other.txt")).write_text(number)
            workspace.publish(out, outputs)
    assert [p.name for p in (workspace.root / "sub" / "folder").iterdir()] == ["2"]
    assert not (workspace.root / "file.txt").exists()
    assert (workspace.root / "other.txt").read_text() == "2"

    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "file").touch()
    (workspace.root / "folder").symlink_to(mine)
    with workspace.lock(), workspace.staging("a", "1") as out:
        (out / "folder").mkdir()
        workspace.publish(out, ("folder",))
    assert [p.name for p in mine.iterdir()] == ["file"]


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


def test_a_fingerprint_of_files_follows_names_sizes_and_times(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / name).write_text(name)
    before = files_fingerprint(tmp_path, [tmp_path / "a", tmp_path / "b"])
    assert files_fingerprint(tmp_path, [tmp_path / "b", tmp_path / "a"]) == before
    assert files_fingerprint(tmp_path, [tmp_path / "a"]) != before
    os.utime(tmp_path / "b", ns=(1, 1))
    assert files_fingerprint(tmp_path, [tmp_path / "a", tmp_path / "b"]) != before
    with pytest.raises(DataError, match="gone: cannot be read"):
        files_fingerprint(tmp_path, [tmp_path / "gone"])
