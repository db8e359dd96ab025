"""Items that are taken over: whole, of the same content, and from below their folder alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.stages.work import KeptItems, Work


def kept_in(folder: Path, *sources: Path, settings: str = "s", **how: Any) -> KeptItems:
    folder.mkdir(exist_ok=True)
    places = [(source, source / ".items") for source in sources]
    return KeptItems(settings, folder, folder / ".items", places, lambda path: "", **how)


def same(name: str, digest: object) -> str:
    return name


@pytest.fixture
def before(tmp_path: Path) -> Path:
    """A folder with items that are files of one letter's name."""
    folder = tmp_path / "before"
    items = Work(kept=kept_in(folder)).items("letters", "abc", same)
    for name in "abc":
        (folder / name).write_text(name)
        items.add(name, [folder / name], [0])
    return folder


def test_what_is_made_of_the_same_is_taken_over(before: Path, tmp_path: Path) -> None:
    now = tmp_path / "now"
    kept = kept_in(now, before)
    items = Work(kept=kept).items("letters", ["a", "b", "d"], same)
    assert items.done == {"a": [0], "b": [0]} and items.label("it") == "it, 2 of 3 kept"
    assert (kept.num_kept, kept.num_items) == (2, 3)
    assert sorted(path.name for path in now.iterdir()) == [".items", "a", "b"]
    # the journal is that of a run of its own: the folder it came from may go
    for path in before.iterdir():
        path.unlink()
    again = kept_in(tmp_path / "again", now)
    assert set(Work(kept=again).items("letters", "ab", same).done) == {"a", "b"}


@pytest.mark.parametrize("change", ["settings", "kind", "inputs"])
def test_what_is_made_of_something_else_is_not(before: Path, tmp_path: Path, change: str) -> None:
    kept = kept_in(tmp_path / "now", before, settings="t" if change == "settings" else "s")
    kind = "numbers" if change == "kind" else "letters"
    extra = "!" if change == "inputs" else ""
    assert Work(kept=kept).items(kind, "abc", lambda name, digest: name + extra).done == {}


def test_spoilt_lines_cost_their_items_alone(before: Path, tmp_path: Path) -> None:
    a, b, c = (before / ".items").read_bytes().splitlines(keepends=True)
    spoilt = [b"[]\n", b"\xff\n", b"[1, 2, 3]\n", b'["k", {"a": [1]}, 0]\n', b"{}\n", b"null\n"]
    (before / ".items").write_bytes(b"".join([a, *spoilt, c, b[:-20]]))
    items = Work(kept=kept_in(tmp_path / "now", before)).items("letters", "abc", same)
    assert set(items.done) == {"a", "c"}


def test_no_path_leaves_its_folder(before: Path, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("a")
    lines = [json.loads(line) for line in (before / ".items").read_text().splitlines()]
    lines[0][1] = {"../secret": lines[0][1]["a"]}
    (before / ".items").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    items = Work(kept=kept_in(tmp_path / "now", before)).items("letters", "abc", same)
    assert set(items.done) == {"b", "c"}


def test_what_has_another_time_is_compared(before: Path, tmp_path: Path) -> None:
    for name, text in (("a", "a"), ("b", "B")):
        (before / name).unlink()
        (before / name).write_text(text)
    items = Work(kept=kept_in(tmp_path / "now", before)).items("letters", "abc", same)
    assert set(items.done) == {"a", "c"}


def test_without_a_workspace_nothing_is_kept(tmp_path: Path) -> None:
    def fail(name: str, digest: object) -> object:
        raise AssertionError("inputs are asked for where nothing can be kept")

    items = Work().items("letters", "ab", fail)
    items.add("a", [tmp_path / "a"], 1)
    assert items.done == {"a": 1} and Work().items("letters", "ab", fail).done == {}
