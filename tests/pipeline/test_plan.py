"""Stages run exactly when they have to; what a broken one leaves behind."""

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
    """A stage of nothing but what it is told."""

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
    """A plan of three stages, each writing what it read and one letter more."""

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


def test_everything_runs_once(kitchen: Kitchen) -> None:
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


DEEP = {"pair": (1, 2), "deep": {"x": 1, "y": [(0.5, None)]}}
CHANGES: dict[str, tuple[Callable[[Kitchen], Any], list[str]]] = {
    "an option": (
        lambda k: k.options["b"].update(extra="!"),
        ["", "options changed: extra", "b changed"],
    ),
    "some of the options": (
        lambda k: k.options["a"].update(deep={"x": 2, "y": [(0.5, None)]}, new=1),
        ["options changed: deep.x, new", "a changed", "a changed"],
    ),
    "an input": (
        lambda k: k.external.update(flour="2"),
        ["flour changed", "a changed", "a changed"],
    ),
    "no input": (lambda k: k.external.clear(), ["flour changed", "a changed", "a changed"]),
    "a version": (
        lambda k: setattr(k, "version", 2),
        ["a newer version of the stage", "a changed", "a changed"],
    ),
    "an output gone": (lambda k: k.workspace.path("a.txt").unlink(), ["a.txt is missing", "", ""]),
    # as of a run cut off before it was written
    "no manifest": (lambda k: k.workspace.manifest_path("b").unlink(), ["", "not done yet", ""]),
}


@pytest.mark.parametrize(("change", "why"), CHANGES.values(), ids=CHANGES)
def test_what_has_changed_runs_again(
    kitchen: Kitchen, change: Callable[[Kitchen], Any], why: list[str]
) -> None:
    kitchen.options["a"] = dict(DEEP)
    kitchen.cook()
    change(kitchen)
    reports = kitchen.cook()
    assert [report.why for report in reports] == why
    assert kitchen.log == [name for name, reason in zip("abc", why, strict=True) if reason]
    assert kitchen.meal() == f"ab{kitchen.options['b'].get('extra', '')}c"
    assert all_kept(kitchen.cook())


def test_an_output_a_stage_no_longer_writes_is_taken_away(kitchen: Kitchen) -> None:
    kitchen.options["b"] = {"csv": True}
    kitchen.cook()
    assert kitchen.workspace.path("b.csv").is_file()
    assert all_kept(kitchen.cook())
    kitchen.options["b"] = {}
    kitchen.cook()
    assert not kitchen.workspace.path("b.csv").exists()
    assert all_kept(kitchen.cook())


@dataclass
class Diner(Kitchen):
    """A soup that is served as it is, or seasoned first: then the plain one is another file."""

    seasoned: bool = False

    def stages(self) -> list[Stage]:
        plain = "plain.txt" if self.seasoned else "soup.txt"
        soup: list[Stage] = [Step("cook", (), (plain,), self.put(plain, "soup"))]
        if self.seasoned:
            salted = self.put("soup.txt", "soup, salted")
            soup.append(Step("season", (plain,), ("soup.txt",), salted))
        return soup

    def put(self, name: str, text: str) -> Callable[[Path], Mapping[str, float]]:
        def run(out: Path) -> Mapping[str, float]:
            self.log.append(name)
            (out / name).write_text(text)
            return {}

        return run


def test_an_output_that_another_stage_wrote_under_other_options_is_made_again(
    tmp_path: Path,
) -> None:
    diner = Diner(Workspace(tmp_path / "w"))
    soup, plain = (diner.workspace.path(name) for name in ("soup.txt", "plain.txt"))
    for seasoned in (False, True, False, True, True):
        kept = diner.seasoned and seasoned
        diner.seasoned = seasoned
        reports = diner.cook()
        assert all_kept(reports) == kept
        assert soup.read_text() == ("soup, salted" if seasoned else "soup")
        assert plain.exists() == seasoned
    assert diner.workspace.manifest_path("season").is_file()
    diner.seasoned = False
    assert diner.cook()[0].why == "plain.txt is no longer written"
    assert not diner.workspace.manifest_path("season").exists()


def test_a_stage_that_fails_leaves_the_old_output(kitchen: Kitchen) -> None:
    kitchen.cook()
    kitchen.options["b"] = {"extra": "!", "burns": True}
    with pytest.raises(DataError, match="burnt"):
        kitchen.cook()
    assert kitchen.workspace.path("b/b.txt").read_text() == "ab"
    assert list(kitchen.workspace.path(".partial").iterdir()) == []
    # its old output still belongs to its old options
    kitchen.options["b"] = {}
    assert all_kept(kitchen.cook())


def test_rests_of_killed_runs_and_workers_do_not_get_into_the_output(kitchen: Kitchen) -> None:
    rest = kitchen.workspace.path(".partial/b/b")
    rest.mkdir(parents=True)
    (rest / "rest.txt").write_text("half")
    dying = "from megloc_kapture.io.files import *; import os, sys\n"
    dying += "with atomic_write(sys.argv[1]) as file: file.write(b'half'); os._exit(9)"
    kitchen.options["b"]["killed"] = [sys.executable, "-c", dying]
    with ThreadPoolExecutor(1) as executor:
        kitchen.cook(work=Work(executor))
    assert [p.name for p in kitchen.workspace.path("b").iterdir()] == ["b.txt"]


def test_data_of_another_root_do_not_replace_those_of_a_workspace(tmp_path: Path) -> None:
    roots = [tmp_path / name / "scene" for name in "ab"]

    def import_from(root: Path, *, force: bool = False) -> str:
        workspace = Workspace(tmp_path / "workspace", force=force)

        def do(out: Path) -> Mapping[str, float]:
            (out / "a.txt").write_text(str(root))
            return {}

        stage = Step("import", (), ("a.txt",), do, outside={"root": str(root.resolve())})
        stage.root = root
        with workspace.lock():
            run_plan([stage], workspace)
        return workspace.path("a.txt").read_text()

    for root in roots:
        root.mkdir(parents=True)
    one, other = roots
    assert import_from(one) == import_from(one) == str(one)
    with pytest.raises(OptionError, match=f"was made from {one}; give another folder"):
        import_from(other)
    assert import_from(other, force=True) == str(other)
    other.rename(tmp_path / "moved")  # nothing else than these data can be meant
    assert import_from(tmp_path / "moved") == str(tmp_path / "moved")


def test_first_and_last(kitchen: Kitchen) -> None:
    with pytest.raises(OptionError, match="--from b needs stage a, which has not run"):
        kitchen.cook(first="b")
    assert [r.name for r in kitchen.cook(last="a")] == ["a"]
    reports = kitchen.cook(first="b")
    assert [(r.name, r.state) for r in reports] == [("a", "skipped"), ("b", "run"), ("c", "run")]
    assert [r.why for r in reports] == ["", "asked for", "follows b"]
    reports = kitchen.cook(first="b", last="b")
    assert [(r.state, r.why) for r in reports] == [("skipped", ""), ("run", "asked for")]
    # what follows was asked for as well, and is still to be done
    assert [r.why for r in kitchen.cook()] == ["", "", "not done yet"]
    with pytest.raises(OptionError, match="--until a comes before --from c"):
        kitchen.cook(first="c", last="a")
    with pytest.raises(OptionError, match="no stage 'd'; stages: a, b, c"):
        kitchen.cook(last="d")


def test_first_takes_earlier_stages_as_they_are(kitchen: Kitchen) -> None:
    kitchen.cook()
    kitchen.options["a"] = {"extra": "?"}
    kitchen.cook(first="c")
    assert kitchen.log == ["c"] and kitchen.meal() == "abc"
    kitchen.cook()
    assert kitchen.log == ["a", "b", "c"] and kitchen.meal() == "a?bc"
    # what does not read its output is left alone
    stages = kitchen.stages()
    stages[2].reads = ("a.txt",)
    run_plan(stages, kitchen.workspace)
    reports = run_plan(stages, kitchen.workspace, first="b")
    assert [r.state for r in reports] == ["skipped", "run", "kept"]


def test_a_dry_run_only_tells(kitchen: Kitchen) -> None:
    told: list[str] = []
    reports = kitchen.cook(dry_run=True, say=told.append)
    assert [r.state for r in reports] == ["pending"] * 3
    assert told == [f"{name}: would run (not done yet)" for name in "abc"]
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
        ("pairs_with_matches", 1, "1 pair with matches"),
        ("matches", 1, "1 match"),
        ("max_size_px", 1600, "max size: 1,600 px"),
        ("mean_reprojection_error_px", 0.74219, "mean reprojection error: 0.7422 px"),
        ("mean_track_length", 4.0, "mean track length: 4"),
        ("metres_per_unit", 33_485.21, "metres per unit: 33,485"),
        ("recall within 0.25 m and 2 deg percent", 87.5, "recall within 0.25 m and 2 deg: 87.5 %"),
    ],
)
def test_counts_read_as_english(name: str, value: float, text: str) -> None:
    assert describe(StageReport("a", "run", 0.04, {name: value}, "")) == f"a: {text}; 0.0 s"
    assert describe(StageReport("a", "run", 0.04, {}, "")) == "a: 0.0 s"
