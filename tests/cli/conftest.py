"""A small scene, a finished run of it, and the command."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from megloc_kapture.cli.main import main
from tests.cli.foreign import write_foreign
from tests.pipeline.runs import run_command

# enough to localize all queries of the small scene
SMALL = ("--set", "local_features.options.max_keypoints=800")


@dataclass(frozen=True)
class Done:
    status: int
    out: str
    err: str

    def refused(self, *patterns: str) -> str:
        """Check that a user error is printed in a single line that matches all patterns."""
        assert self.status == 2, self
        assert self.out == "", self.out
        lines = self.err.splitlines()
        assert len(lines) == 1, self.err
        assert lines[0].startswith("megloc: ")
        for pattern in patterns:
            assert re.search(pattern, lines[0]), f"{pattern!r} is not in {lines[0]!r}"
        return lines[0]


Command = Callable[..., Done]


@pytest.fixture
def megloc(capsys: pytest.CaptureFixture[str]) -> Command:
    def run(*arguments: str | Path) -> Done:
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        assert isinstance(end.value.code, int)
        return Done(end.value.code, out, err)

    return run


@pytest.fixture(scope="session")
def finished(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Workspace of a finished run in this process; read only."""
    workspace = tmp_path_factory.mktemp("finished") / "workspace"
    places = ("--root", scene, "--workspace", workspace)
    run_command("eval", "kapture", *places, *SMALL, "--executor", "inline", "--quiet")
    return workspace


@pytest.fixture
def dataset(scene: Path, tmp_path: Path) -> Path:
    """A copy of the scene that a test may change."""
    return Path(shutil.copytree(scene, tmp_path / "dataset", symlinks=True))


@pytest.fixture
def workspace(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished workspace that a test may change."""
    return Path(shutil.copytree(finished, tmp_path / "workspace", symlinks=True))


@pytest.fixture(scope="session")
def foreign_map(finished: Path, scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small scene as the map of another tool: map/, query/, query_gt/; read only."""
    root = tmp_path_factory.mktemp("foreign")
    write_foreign(root, finished, scene)
    return root


@pytest.fixture
def foreign(foreign_map: Path, tmp_path: Path) -> Path:
    """A copy of the foreign map, with links to its images."""
    return Path(shutil.copytree(foreign_map, tmp_path / "foreign", symlinks=True))
