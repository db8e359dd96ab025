"""Plans run the stages that are not up to date; stopped runs continue inside long stages."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError, OptionError, OutputError
from megloc_kapture.io.files import temporary_name
from megloc_kapture.pipeline.datasets import choose_dataset
from megloc_kapture.pipeline.evaluation_plan import Run, plan_evaluation
from megloc_kapture.pipeline.plan import (
    StageReport,
    Workspace,
    all_kept,
    describe,
    read_manifest,
    run_plan,
)
from megloc_kapture.pipeline.presets import options_of_preset
from megloc_kapture.stages.stage import Stage, StageWork, files_fingerprint
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Options
from tests.worlds import folder_bytes


class Step(Stage):
    def __init__(
        self,
        name: str,
        reads: Sequence[str],
        writes: Sequence[str],
        do: Callable[[Path], Mapping[str, float]],
        *,
        version: int = 1,
        settings: dict[str, Any] | None = None,
        outside: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(Options())
        self.name, self.reads, self.writes, self._do = name, reads, writes, do
        self.version = version  # type: ignore[misc]
        self._settings, self._outside = settings or {}, outside or {}

    def settings(self) -> dict[str, Any]:
        return self._settings

    def external(self) -> Mapping[str, str]:
        return self._outside

    def run(self, work: StageWork) -> Mapping[str, float]:
        return self._do(work.out)


@dataclass
class Plan:
    """A plan of three stages; each writes its input and its letter."""

    workspace: Workspace
    options: dict[str, dict[str, Any]] = field(default_factory=lambda: {"a": {}, "b": {}, "c": {}})
    external: dict[str, str] = field(default_factory=lambda: {"data": "1"})
    version: int = 1
    log: list[str] = field(default_factory=list)

    def stages(self) -> list[Stage]:
        a, b, c = (self.options[name] for name in "abc")
        first: dict[str, Any] = {"version": self.version, "outside": self.external}
        return [
            Step("a", (), ("a.txt",), self.do("a"), settings=a, **first),
            Step("b", ("a.txt",), ("b",), self.do("b", "a.txt"), settings=b),
            Step("c", ("a.txt", "b/b.txt"), ("c.txt",), self.do("c", "b/b.txt"), settings=c),
        ]

    def do(self, name: str, reads: str | None = None) -> Callable[[Path], Mapping[str, float]]:
        def run(out: Path) -> Mapping[str, float]:
            self.log.append(name)
            text = "" if reads is None else self.workspace.path(reads).read_text()
            place = out / "b" / "b.txt" if name == "b" else out / f"{name}.txt"
            place.parent.mkdir(exist_ok=True)
            place.write_text(text + name + str(self.options[name].get("extra", "")))
            if self.options[name].get("worker_dies"):
                (place.parent / temporary_name()).write_text("half")
            if self.options[name].get("fails"):
                raise DataError("it fails")
            return {"letters": np.float32(len(text) + 1)}  # type: ignore[dict-item]

        return run

    def run(self, **how: Any) -> list[StageReport]:
        self.log.clear()
        return run_plan(self.stages(), self.workspace, **how)

    def result(self) -> str:
        return self.workspace.path("c.txt").read_text()


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    return Plan(Workspace(tmp_path / "plan"))


def test_all_stages_run_once(plan: Plan) -> None:
    reports = plan.run()
    assert [(r.name, r.state, r.why) for r in reports] == [
        (name, "run", "not done yet") for name in "abc"
    ]
    assert [r.counts["letters"] for r in reports] == [1.0, 2.0, 3.0]
    assert plan.result() == "abc"
    assert not all_kept(reports)
    again = plan.run()
    assert plan.log == [] and all_kept(again)
    assert [r.counts for r in again] == [r.counts for r in reports]


CHANGES: dict[str, tuple[Callable[[Plan], Any], list[str]]] = {
    "an option": (
        lambda plan: plan.options["b"].update(extra="!"),
        ["", "options changed: extra", "b changed"],
    ),
    "nested options": (
        lambda plan: plan.options["a"].update(deep={"x": 2, "y": [(0.5, None)]}, new=1),
        ["options changed: deep.x, new", "a changed", "a changed"],
    ),
    "values that are equal in Python, but not in JSON": (
        lambda plan: plan.options["a"].update(deep={"x": 1.0, "y": [(0.5, None)]}, new=None),
        ["options changed: deep.x, new", "a changed", "a changed"],
    ),
    "an input": (
        lambda plan: plan.external.update(data="2"),
        ["data changed", "a changed", "a changed"],
    ),
    "a version": (
        lambda plan: setattr(plan, "version", 2),
        ["a newer version of the stage", "a changed", "a changed"],
    ),
    "a removed output": (
        lambda plan: plan.workspace.path("a.txt").unlink(),
        ["a.txt is missing", "", ""],
    ),
    "no manifest": (
        lambda plan: plan.workspace.manifest_path("b").unlink(),
        ["", "not done yet", ""],
    ),
}


@pytest.mark.parametrize(("change", "why"), CHANGES.values(), ids=CHANGES)
def test_changed_stages_run_again(
    plan: Plan, change: Callable[[Plan], Any], why: list[str]
) -> None:
    plan.options["a"] = {"pair": (1, 2), "deep": {"x": 1, "y": [(0.5, None)]}}
    plan.run()
    change(plan)
    reports = plan.run()
    assert [report.why for report in reports] == why
    assert plan.log == [name for name, reason in zip("abc", why, strict=True) if reason]
    assert plan.result() == f"ab{plan.options['b'].get('extra', '')}c"
    plan.options["a"] = dict(reversed(plan.options["a"].items()))  # the order does not count
    assert all_kept(plan.run())


def test_an_output_of_another_stage_under_other_options_is_made_again(tmp_path: Path) -> None:
    workspace, output = Workspace(tmp_path / "w"), tmp_path / "w" / "images.txt"

    def write(name: str, text: str) -> Callable[[Path], Mapping[str, float]]:
        return lambda out: {"letters": float((out / name).write_text(text))}

    def run(resized: bool) -> list[StageReport]:
        """Import images, or import them to another file and resize them."""
        name = "imported.txt" if resized else "images.txt"
        stages = [Step("import", (), (name,), write(name, "large"))]
        if resized:
            resize = write("images.txt", "small")
            stages.append(Step("resize", ("imported.txt",), ("images.txt",), resize))
        return run_plan(stages, workspace)

    for resized in (False, True, False, True):
        assert not all_kept(run(resized))
        assert output.read_text() == ("small" if resized else "large")
        assert workspace.path("imported.txt").exists() == resized
    assert all_kept(run(resized=True))
    assert run(resized=False)[0].why == "imported.txt is no longer written"
    assert not workspace.manifest_path("resize").exists()


def test_a_failed_stage_leaves_the_old_output(plan: Plan) -> None:
    plan.run()
    plan.options["b"] = {"extra": "!", "fails": True}
    with pytest.raises(DataError, match="it fails"):
        plan.run()
    assert plan.workspace.path("b/b.txt").read_text() == "ab"
    assert list(plan.workspace.path(".partial").iterdir()) == []
    plan.options["b"] = {}
    assert all_kept(plan.run())


def test_files_of_killed_runs_and_workers_are_not_published(plan: Plan) -> None:
    rest = plan.workspace.path(".partial/b/b")
    rest.mkdir(parents=True)
    (rest / "rest.txt").write_text("half")
    plan.options["b"]["worker_dies"] = True
    with ThreadPoolExecutor(1) as executor:
        plan.run(work=Work(executor))
    assert [p.name for p in plan.workspace.path("b").iterdir()] == ["b.txt"]


def test_a_workspace_keeps_the_data_of_its_root(tmp_path: Path) -> None:
    first, other = roots = [tmp_path / name / "scene" for name in "ab"]

    def import_from(root: Path, *, force: bool = False) -> str:
        workspace = Workspace(tmp_path / "workspace", force=force)

        def write(out: Path) -> Mapping[str, float]:
            return {"letters": float((out / "a.txt").write_text(str(root)))}

        stage = Step("import", (), ("a.txt",), write, outside={"root": str(root.resolve())})
        stage.root = root
        with workspace.lock():
            run_plan([stage], workspace)
        return workspace.path("a.txt").read_text()

    for root in roots:
        root.mkdir(parents=True)
    assert import_from(first) == str(first)
    with pytest.raises(OptionError, match=f"was made from {first}; give another folder"):
        import_from(other)
    assert import_from(other, force=True) == str(other)
    other.rename(tmp_path / "moved")  # the only data that can be meant
    assert import_from(tmp_path / "moved") == str(tmp_path / "moved")


def test_first_and_last_stage(plan: Plan) -> None:
    with pytest.raises(OptionError, match="--from b needs stage a, which has not run"):
        plan.run(first="b")
    assert [r.name for r in plan.run(last="a")] == ["a"]
    reports = plan.run(first="b")
    assert [(r.name, r.state) for r in reports] == [("a", "skipped"), ("b", "run"), ("c", "run")]
    assert [r.why for r in reports] == ["", "requested", "follows b"]
    reports = plan.run(first="b", last="b")
    assert [(r.state, r.why) for r in reports] == [("skipped", ""), ("run", "requested")]
    assert [r.why for r in plan.run()] == ["", "", "not done yet"]
    with pytest.raises(OptionError, match="--until a comes before --from c"):
        plan.run(first="c", last="a")
    with pytest.raises(OptionError, match="--until b comes before --from c"):
        plan.run(first="c", last="b")


def test_a_dry_run_runs_nothing(plan: Plan) -> None:
    lines: list[str] = []
    reports = plan.run(dry_run=True, say=lines.append)
    assert [r.state for r in reports] == ["pending"] * 3
    assert lines == [f"{name}: would run (not done yet)" for name in "abc"]
    plan.run()
    plan.options["b"] = {"extra": "!"}
    reports = plan.run(dry_run=True)
    assert [r.state for r in reports] == ["kept", "pending", "pending"]
    assert plan.log == []
    plan.options["b"] = {}
    assert all_kept(plan.run())


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("keypoints", 33_485_000, "33,485,000 keypoints"),
        ("queries_with_truth", 1, "1 query with truth"),
        ("mean_reprojection_error_px", 0.74219, "mean reprojection error: 0.7422 px"),
        ("recall within 0.25 m and 2 deg percent", 87.5, "recall within 0.25 m and 2 deg: 87.5 %"),
    ],
)
def test_counts_read_as_english(name: str, value: float, text: str) -> None:
    assert describe(StageReport("a", "run", 0.04, {name: value}, "")) == f"a: {text}; 0.0 s"


def use(workspace: Workspace) -> None:
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
    with pytest.raises(OutputError, match="not an earlier output of this kind .workspace"):
        Workspace(tmp_path)
    use(Workspace(tmp_path, force=True))
    Workspace(tmp_path)
    assert (tmp_path / "thesis.txt").read_text() == "mine"


def test_a_workspace_has_one_run_at_a_time(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "w")
    use(workspace)
    with workspace.lock():
        other = Workspace(workspace.root).lock()
        with pytest.raises(OutputError, match="another run is using this workspace"):
            other.__enter__()


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


@pytest.mark.parametrize("content", [b"", b'{"stage": "s"}', b"\xff\xfe"])
def test_a_missing_or_damaged_manifest_is_ignored(tmp_path: Path, content: bytes) -> None:
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
        with pytest.raises(Stopped):
            self.run(stop_at=(label, number))
        (left,) = (self.root / ".partial").iterdir()
        return left


def contents(root: Path) -> dict[str, bytes]:
    hidden = ("stages/", "megloc/", "timing", ".")
    files = folder_bytes(root).items()
    return {name: content for name, content in files if not name.startswith(hidden)}


@pytest.fixture
def runs(package: Path, scene: Path, tmp_path: Path) -> Runs:
    return Runs(scene, tmp_path / "run")


def test_a_stopped_run_continues_inside_the_stage(runs: Runs) -> None:
    runs.stopped("corners", 4)
    runs.stopped("corners", 3)
    assert runs.progress["corners"] == (7, "corners features, 4 kept")
    assert runs.stopped("VLAD", 5).name == "global_features"
    runs.stopped("matching", 2)
    with ThreadPoolExecutor(2) as executor:
        reports = runs.run(executor=executor)
    assert [reports[f"{name}_features"].state for name in ("local", "global")] == ["kept"] * 2
    undisturbed = replace(runs, root=runs.root.with_name("undisturbed"), progress={})
    undisturbed.run()
    assert contents(runs.root) == contents(undisturbed.root)


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
