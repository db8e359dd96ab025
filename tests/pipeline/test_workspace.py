"""Whose folder a workspace is, and who may work in it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from megloc_kapture.errors import OutputError
from megloc_kapture.pipeline.workspace import Workspace


def use(workspace: Workspace) -> None:
    """Leave what a finished stage leaves."""
    with workspace.lock(), workspace.staging("a") as out:
        (out / "a.txt").write_text("a")
        workspace.publish(out, ("a.txt",))


def test_a_used_workspace_is_known_again_and_an_unused_one_is_taken_away(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "runs" / "w")
    with workspace.lock(), workspace.staging("a") as out:
        (out / "a.txt").write_text("a")
    assert list(tmp_path.iterdir()) == []
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
        "from megloc_kapture.pipeline.workspace import Workspace\n"
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
        with workspace.lock(), workspace.staging("a") as out:
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
    with (
        pytest.raises(OutputError, match="folder: is a link or a file"),
        workspace.lock(),
        workspace.staging("a") as out,
    ):
        (out / "folder").mkdir()
        workspace.publish(out, ("folder",))
    assert [p.name for p in mine.iterdir()] == ["file"]
