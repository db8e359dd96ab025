"""Workspaces: ownership, locks, published outputs, manifests and fingerprints."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.files import write_json_model
from megloc_kapture.pipeline.plan import Workspace, fingerprint, read_manifest
from megloc_kapture.stages.stage import files_fingerprint
from tests.pipeline.runs import manifest


def use(workspace: Workspace) -> None:
    """Publish the output of a stage."""
    with workspace.lock(), workspace.staging("a", "1") as out:
        (out / "a.txt").write_text("a")
        workspace.publish(out, ("a.txt",))


def test_a_workspace_is_reused_and_an_empty_one_removed(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "runs" / "w")
    with workspace.lock(), workspace.staging("a", "1") as out:
        (out / "a.txt").write_text("a")
    assert list((tmp_path / "runs").iterdir()) == []
    use(Workspace(tmp_path / "w"))
    with Workspace(tmp_path / "w").lock():
        pass
    assert (tmp_path / "w" / "a.txt").read_text() == "a"


def test_other_folders_are_used_only_by_force(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(OutputError, match="not a workspace of megloc"):
        Workspace(tmp_path)
    use(Workspace(tmp_path, force=True))
    Workspace(tmp_path)
    assert (tmp_path / "thesis.txt").read_text() == "mine"


def test_a_workspace_has_one_run_at_a_time(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "w")
    use(workspace)
    code = (
        "import sys\nfrom pathlib import Path\n"
        "from megloc_kapture.pipeline.plan import Workspace\n"
        "with Workspace(Path(sys.argv[1])).lock(): pass\n"
    )
    with workspace.lock():
        command = [sys.executable, "-c", code, str(workspace.root)]
        other = subprocess.run(command, capture_output=True, text=True, check=False)
    assert other.returncode != 0 and "another run is using this workspace" in other.stderr


def test_publishing_replaces_outputs_and_keeps_linked_folders(tmp_path: Path) -> None:
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


def test_a_fingerprint_depends_on_content_and_not_on_order() -> None:
    options = {"pair": (1, 2), "text": "x", "deep": {"a": 0.5, "b": [None, True]}}
    mark = fingerprint("s", 1, options, {"a": "1"})
    assert fingerprint("s", 1, dict(reversed(options.items())), {"a": "1"}) == mark
    # as read from a manifest
    assert fingerprint("s", 1, json.loads(json.dumps(options)), {"a": "1"}) == mark
    changed = {
        fingerprint("t", 1, options, {"a": "1"}),
        fingerprint("s", 2, options, {"a": "1"}),
        fingerprint("s", 1, options | {"pair": (2, 1)}, {"a": "1"}),
        fingerprint("s", 1, options, {"a": "2"}),
        fingerprint("s", 1, options, {"b": "1"}),
    }
    assert mark not in changed and len(changed) == 5


def test_a_manifest_is_read_back(tmp_path: Path) -> None:
    made = manifest("s", options={"x": [1, None]}, inputs={"a": "1"}, counts={"images": 2.0})
    write_json_model(tmp_path / "s.json", made)
    assert read_manifest(tmp_path / "s.json") == made


@pytest.mark.parametrize("content", [b"", b'{"stage": "s"}', b"\xff\xfe"])
def test_a_damaged_manifest_is_ignored(tmp_path: Path, content: bytes) -> None:
    assert read_manifest(tmp_path / "s.json") is None
    (tmp_path / "s.json").write_bytes(content)
    assert read_manifest(tmp_path / "s.json") is None


def test_a_fingerprint_of_files_depends_on_names_sizes_and_times(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / name).write_text(name)
    before = files_fingerprint(tmp_path, [tmp_path / "a", tmp_path / "b"])
    assert files_fingerprint(tmp_path, [tmp_path / "b", tmp_path / "a"]) == before
    assert files_fingerprint(tmp_path, [tmp_path / "a"]) != before
    os.utime(tmp_path / "b", ns=(1, 1))
    assert files_fingerprint(tmp_path, [tmp_path / "a", tmp_path / "b"]) != before
    with pytest.raises(DataError, match="gone: cannot be read"):
        files_fingerprint(tmp_path, [tmp_path / "gone"])
