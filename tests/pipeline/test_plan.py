"""Plans run the stages that are not up to date; failed stages leave the old outputs."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.pipeline.plan import StageReport, Workspace, all_kept, describe, run_plan
from megloc_kapture.stages.stage import Stage, StageWork
from megloc_kapture.stages.work import Work
from megloc_kapture.values import Options


class Step(Stage):
    """A stage with given inputs, outputs and function."""

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
class Kitchen:
    """A plan of three stages; each writes its input and its letter."""

    workspace: Workspace
    options: dict[str, dict[str, Any]] = field(default_factory=lambda: {"a": {}, "b": {}, "c": {}})
    external: dict[str, str] = field(default_factory=lambda: {"flour": "1"})
    version: int = 1
    log: list[str] = field(default_factory=list)

    def stages(self) -> list[Stage]:
        a, b, c = (self.options[name] for name in "abc")
        first: dict[str, Any] = {"version": self.version, "outside": self.external}
        return [
            Step("a", (), ("a.txt",), self.do("a"), settings=a, **first),
            Step("b", ("a.txt",), ("b", "b.csv"), self.do("b", "a.txt"), settings=b),
            Step("c", ("a.txt", "b/b.txt"), ("c.txt",), self.do("c", "b/b.txt"), settings=c),
        ]

    def do(self, name: str, reads: str | None = None) -> Callable[[Path], Mapping[str, float]]:
        def run(out: Path) -> Mapping[str, float]:
            self.log.append(name)
            text = "" if reads is None else self.workspace.path(reads).read_text()
            place = out / "b" / "b.txt" if name == "b" else out / f"{name}.txt"
            place.parent.mkdir(exist_ok=True)
            place.write_text(text + name + str(self.options[name].get("extra", "")))
            if self.options[name].get("csv"):
                (out / "b.csv").write_text("table")
            if command := self.options[name].get("killed"):
                assert subprocess.run([*command, str(place)], check=False).returncode == 9
                assert len(list(place.parent.iterdir())) == 2
            if self.options[name].get("burns"):
                raise DataError("burnt")
            return {"letters": float(len(text) + 1)}

        return run

    def cook(self, **how: Any) -> list[StageReport]:
        self.log.clear()
        return run_plan(self.stages(), self.workspace, **how)

    def meal(self) -> str:
        return self.workspace.path("c.txt").read_text()


@pytest.fixture
def kitchen(tmp_path: Path) -> Kitchen:
    return Kitchen(Workspace(tmp_path / "kitchen"))


def test_all_stages_run_once(kitchen: Kitchen) -> None:
    reports = kitchen.cook()
    assert [(r.name, r.state, r.why) for r in reports] == [
        (name, "run", "not done yet") for name in "abc"
    ]
    assert [r.counts["letters"] for r in reports] == [1.0, 2.0, 3.0]
    assert kitchen.meal() == "abc"
    assert not all_kept(reports)
    again = kitchen.cook()
    assert kitchen.log == [] and all_kept(again)
    assert [r.counts for r in again] == [r.counts for r in reports]


CHANGES: dict[str, tuple[Callable[[Kitchen], Any], list[str]]] = {
    "an option": (
        lambda k: k.options["b"].update(extra="!"),
        ["", "options changed: extra", "b changed"],
    ),
    "nested options": (
        lambda k: k.options["a"].update(deep={"x": 2, "y": [(0.5, None)]}, new=1),
        ["options changed: deep.x, new", "a changed", "a changed"],
    ),
    "an input": (
        lambda k: k.external.update(flour="2"),
        ["flour changed", "a changed", "a changed"],
    ),
    "a version": (
        lambda k: setattr(k, "version", 2),
        ["a newer version of the stage", "a changed", "a changed"],
    ),
    "a removed output": (lambda k: k.workspace.path("a.txt").unlink(), ["a.txt is gone", "", ""]),
    "no manifest": (lambda k: k.workspace.manifest_path("b").unlink(), ["", "not done yet", ""]),
}


@pytest.mark.parametrize(("change", "why"), CHANGES.values(), ids=CHANGES)
def test_changed_stages_run_again(
    kitchen: Kitchen, change: Callable[[Kitchen], Any], why: list[str]
) -> None:
    kitchen.options["a"] = {"pair": (1, 2), "deep": {"x": 1, "y": [(0.5, None)]}}
    kitchen.cook()
    change(kitchen)
    reports = kitchen.cook()
    assert [report.why for report in reports] == why
    assert kitchen.log == [name for name, reason in zip("abc", why, strict=True) if reason]
    assert kitchen.meal() == f"ab{kitchen.options['b'].get('extra', '')}c"
    assert all_kept(kitchen.cook())


def test_an_output_that_is_no_longer_written_is_removed(kitchen: Kitchen) -> None:
    kitchen.options["b"] = {"csv": True}
    kitchen.cook()
    assert kitchen.workspace.path("b.csv").is_file()
    assert all_kept(kitchen.cook())
    kitchen.options["b"] = {}
    kitchen.cook()
    assert not kitchen.workspace.path("b.csv").exists()
    assert all_kept(kitchen.cook())


def test_an_output_of_another_stage_under_other_options_is_made_again(tmp_path: Path) -> None:
    workspace, output = Workspace(tmp_path / "w"), tmp_path / "w" / "soup.txt"

    def write(name: str, text: str) -> Callable[[Path], Mapping[str, float]]:
        return lambda out: {"letters": float((out / name).write_text(text))}

    def cook(seasoned: bool) -> list[StageReport]:
        """Write the soup, or a plain soup first and the seasoned one from it."""
        if not seasoned:
            return run_plan([Step("cook", (), ("soup.txt",), write("soup.txt", "soup"))], workspace)
        plain = Step("cook", (), ("plain.txt",), write("plain.txt", "soup"))
        salted = write("soup.txt", "soup, salted")
        season = Step("season", ("plain.txt",), ("soup.txt",), salted)
        return run_plan([plain, season], workspace)

    for seasoned in (False, True, False, True):
        assert not all_kept(cook(seasoned))
        assert output.read_text() == ("soup, salted" if seasoned else "soup")
        assert workspace.path("plain.txt").exists() == seasoned
    assert all_kept(cook(seasoned=True))
    assert cook(seasoned=False)[0].why == "plain.txt is no longer written"
    assert not workspace.manifest_path("season").exists()


def test_a_failed_stage_leaves_the_old_output(kitchen: Kitchen) -> None:
    kitchen.cook()
    kitchen.options["b"] = {"extra": "!", "burns": True}
    with pytest.raises(DataError, match="burnt"):
        kitchen.cook()
    assert kitchen.workspace.path("b/b.txt").read_text() == "ab"
    assert list(kitchen.workspace.path(".partial").iterdir()) == []
    kitchen.options["b"] = {}
    assert all_kept(kitchen.cook())


def test_files_of_killed_runs_and_workers_are_not_published(kitchen: Kitchen) -> None:
    rest = kitchen.workspace.path(".partial/b/b")
    rest.mkdir(parents=True)
    (rest / "rest.txt").write_text("half")
    dying = "from megloc_kapture.io.files import *; import os, sys\n"
    dying += "with atomic_write(sys.argv[1]) as file: file.write(b'half'); os._exit(9)"
    kitchen.options["b"]["killed"] = [sys.executable, "-c", dying]
    with ThreadPoolExecutor(1) as executor:
        kitchen.cook(work=Work(executor))
    assert [p.name for p in kitchen.workspace.path("b").iterdir()] == ["b.txt"]


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
    with pytest.raises(OptionError, match=f"was made of {first}; give another folder"):
        import_from(other)
    assert import_from(other, force=True) == str(other)
    other.rename(tmp_path / "moved")  # the only data that can be meant
    assert import_from(tmp_path / "moved") == str(tmp_path / "moved")


def test_first_and_last_stage(kitchen: Kitchen) -> None:
    with pytest.raises(OptionError, match="--from b needs stage a, which has not run"):
        kitchen.cook(first="b")
    assert [r.name for r in kitchen.cook(last="a")] == ["a"]
    reports = kitchen.cook(first="b")
    assert [(r.name, r.state) for r in reports] == [("a", "skipped"), ("b", "run"), ("c", "run")]
    assert [r.why for r in reports] == ["", "asked for", "follows b"]
    reports = kitchen.cook(first="b", last="b")
    assert [(r.state, r.why) for r in reports] == [("skipped", ""), ("run", "asked for")]
    assert [r.why for r in kitchen.cook()] == ["", "", "not done yet"]
    with pytest.raises(OptionError, match="--until a comes before --from c"):
        kitchen.cook(first="c", last="a")


def test_stages_before_the_first_are_not_checked(kitchen: Kitchen) -> None:
    kitchen.cook()
    kitchen.options["a"] = {"extra": "?"}
    kitchen.cook(first="c")
    assert kitchen.log == ["c"] and kitchen.meal() == "abc"
    kitchen.cook()
    assert kitchen.log == ["a", "b", "c"] and kitchen.meal() == "a?bc"
    # a stage that does not read the new output is kept
    stages = kitchen.stages()
    stages[2].reads = ("a.txt",)
    run_plan(stages, kitchen.workspace)
    reports = run_plan(stages, kitchen.workspace, first="b")
    assert [r.state for r in reports] == ["skipped", "run", "kept"]


def test_a_dry_run_runs_nothing(kitchen: Kitchen) -> None:
    lines: list[str] = []
    reports = kitchen.cook(dry_run=True, say=lines.append)
    assert [r.state for r in reports] == ["pending"] * 3
    assert lines == [f"{name}: would run (not done yet)" for name in "abc"]
    kitchen.cook()
    kitchen.options["b"] = {"extra": "!"}
    reports = kitchen.cook(dry_run=True)
    assert [r.state for r in reports] == ["kept", "pending", "pending"]
    reports = kitchen.cook(dry_run=True, first="b")
    assert kitchen.log == []
    kitchen.options["b"] = {}
    assert all_kept(kitchen.cook())


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("keypoints", 33_485_000, "33,485,000 keypoints"),
        ("queries_with_truth", 1, "1 query with truth"),
        ("max_size_px", 1600, "max size: 1,600 px"),
        ("mean_reprojection_error_px", 0.74219, "mean reprojection error: 0.7422 px"),
        ("recall within 0.25 m and 2 deg percent", 87.5, "recall within 0.25 m and 2 deg: 87.5 %"),
    ],
)
def test_counts_read_as_english(name: str, value: float, text: str) -> None:
    assert describe(StageReport("a", "run", 0.04, {name: value}, "")) == f"a: {text}; 0.0 s"
    assert describe(StageReport("a", "run", 0.04, {}, "")) == "a: 0.0 s"
