"""Stopped runs continue inside long stages; changed plugins run again."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.pipeline.datasets import choose_dataset
from megloc_kapture.pipeline.evaluation_plan import Run, plan_evaluation
from megloc_kapture.pipeline.plan import StageReport, Workspace, run_plan
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.stages.work import Work
from tests.worlds import folder_bytes

PLUGINS = """
from megloc_kapture.features.rootsift import RootSift, RootSiftOptions
from patches.size import SIZE


class Corners(RootSift):
    name = "corners"

    def __init__(self, options=None):
        super().__init__(RootSiftOptions(max_keypoints=SIZE))
"""
ENTRIES = """
[megloc_kapture.local_features]
corners = patches.plugins:Corners
"""
OPTIONS = ("local_features=corners", "global_features.options.num_clusters=4")


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The installed package of the plugins."""
    site = tmp_path / "site"
    info = site / "patches-1.2.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: patches\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(ENTRIES)
    folder = site / "patches"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "size.py").write_text("SIZE = 60\n")
    (folder / "plugins.py").write_text(PLUGINS)
    monkeypatch.syspath_prepend(site)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield folder
    forget_modules()


def forget_modules() -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "patches"]:
        del sys.modules[name]


class Stopped(BaseException):
    """A signal that ends a run."""


@dataclass
class Runs:
    """Runs of a scene in a workspace, until the queries are matched."""

    scene: Path
    root: Path
    options: tuple[str, ...] = OPTIONS
    last: str = "query_matches"
    progress: dict[str, tuple[int, str]] = field(default_factory=dict)
    """Number of items and label, by the first word of the label."""

    def run(
        self,
        *,
        stop_at: tuple[str, int] | None = None,
        executor: Executor | None = None,
        **how: Any,
    ) -> dict[str, StageReport]:
        self.progress.clear()
        forget_modules()

        def track(items: Iterable[Any], total: int, label: str) -> Iterator[Any]:
            self.progress[re.split("[ ,]", label)[0]] = total, label
            for number, item in enumerate(items):
                if stop_at == (re.split("[ ,]", label)[0], number):
                    raise Stopped
                yield item

        workspace = Workspace(self.root)
        options = options_of_preset(assignments=self.options)
        run = Run(choose_dataset("kapture", self.scene), "classic", options)
        with workspace.lock():
            work = Work(executor, track)
            reports = run_plan(plan_evaluation(run), workspace, work, **{"last": self.last, **how})
        assert list(workspace.path(".partial").iterdir()) == []
        return {report.name: report for report in reports}

    def stopped(self, label: str, number: int) -> Path:
        """Stop a run; return the stage's unfinished folder."""
        with pytest.raises(Stopped):
            self.run(stop_at=(label, number))
        (left,) = (self.root / ".partial").iterdir()
        return left

    def check_undisturbed(self) -> None:
        """Compare the outputs with those of a new run without interruptions."""
        fresh = replace(self, root=self.root.with_name("undisturbed"), progress={})
        shutil.rmtree(fresh.root, ignore_errors=True)
        fresh.run()
        assert contents(self.root) == contents(fresh.root)


def contents(root: Path) -> dict[str, bytes]:
    """Return the outputs of stages, by path."""
    hidden = ("stages/", "megloc/", "timing", ".")
    files = folder_bytes(root).items()
    return {name: content for name, content in files if not name.startswith(hidden)}


@pytest.fixture
def runs(package: Path, scene: Path, tmp_path: Path) -> Runs:
    copy = shutil.copytree(scene, tmp_path / "dataset", symlinks=True)
    return Runs(copy, tmp_path / "run")


def test_a_stopped_run_continues_inside_the_stage(runs: Runs) -> None:
    runs.stopped("corners", 4)
    runs.stopped("corners", 3)
    assert runs.progress["corners"] == (7, "corners features, 4 kept")
    assert runs.stopped("VLAD", 5).name == "global_features"
    runs.stopped("matching", 2)
    with ThreadPoolExecutor(2) as executor:
        reports = runs.run(executor=executor)
    assert [reports[f"{name}_features"].state for name in ("local", "global")] == ["kept"] * 2
    runs.check_undisturbed()


def test_a_changed_plugin_runs_again(runs: Runs, package: Path) -> None:
    before = runs.run()
    assert before["local_features"].why == "not done yet"
    with open(package / "plugins.py", "a") as file:
        file.write("# better explained\n")
    reports = runs.run()
    assert reports["local_features"].why == "code of patches.plugins.Corners changed"
    assert reports["mapping_matches"].why == "local_features changed"
    # another module of the package
    (package / "size.py").write_text("SIZE = 61\n")
    assert runs.run(last="local_features")["local_features"].why.startswith("code of patches")
    # a new release
    metadata = package.parent / "patches-1.2.dist-info" / "METADATA"
    metadata.write_text(metadata.read_text().replace("1.2", "1.3"))
    again = runs.run(last="local_features")["local_features"]
    assert again.why == "code of patches.plugins.Corners changed"
