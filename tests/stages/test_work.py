"""Work on executors: in order, bounded, and errors come through."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from megloc_kapture.errors import DataError
from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.stages.work import FolderSpec, KeptItems, Work, ordered_map


def test_results_come_in_order_whatever_finishes_first() -> None:
    first_may_end = threading.Event()

    def work(value: int) -> int:
        if value == 0:
            assert first_may_end.wait(timeout=30)
        if value == 5:
            first_may_end.set()
        return value

    with ThreadPoolExecutor(3) as executor:
        assert list(ordered_map(work, range(20), executor, window=8)) == list(range(20))
        assert list(ordered_map(work, [], executor)) == []
    # here they are made when they are asked for
    done: list[int] = []
    results = ordered_map(lambda value: done.append(value) or value, [3, 1, 2])
    assert done == []
    assert next(iter(results)) == 3
    assert done == [3]
    assert list(results) == [1, 2]


def test_at_most_a_window_of_items_is_taken_ahead() -> None:
    taken = 0

    def items() -> Iterator[int]:
        nonlocal taken
        for value in range(100):
            taken += 1
            yield value

    with ThreadPoolExecutor(2) as executor:
        results = ordered_map(int, items(), executor, window=5)
        for count, _ in enumerate(results, start=1):
            assert taken <= count + 5


def test_an_error_of_a_worker_comes_through_with_its_place() -> None:
    def fail_at_three(value: int) -> int:
        if value == 3:
            raise DataError("the third is broken", path="some/file", line=7)
        return value * value

    with ThreadPoolExecutor(2) as executor:
        seen = []
        with pytest.raises(DataError, match="some/file:7: the third is broken"):
            for value in ordered_map(fail_at_three, range(50), executor, window=4):
                seen.append(value)
    assert seen == [0, 1, 4]


def test_an_error_in_another_process_keeps_file_and_line(
    two_processes: Executor, tmp_path: Path
) -> None:
    (tmp_path / "sensors").mkdir()
    broken = tmp_path / "sensors" / "sensors.txt"
    broken.write_text("# kapture format: 1.1\ncam, , camera, PINHOLE, 640\n")
    (tmp_path / "sensors" / "records_camera.txt").write_text("# kapture format: 1.1\n")
    with pytest.raises(DataError) as here:
        KaptureFolder(tmp_path).read()
    with pytest.raises(DataError) as there:
        list(ordered_map(KaptureFolder.read, [KaptureFolder(tmp_path)], two_processes))
    assert str(there.value) == str(here.value)
    assert (there.value.path, there.value.line) == (here.value.path, here.value.line)


def test_a_folder_is_opened_once_per_run(world: Any) -> None:
    spec = FolderSpec(world.mapping())
    assert spec.open() is spec.open()
    # another run sees what was written since
    other = FolderSpec(world.mapping())
    assert other.open() is not spec.open()
    assert other.open().root == world.mapping().root
    assert other.open().features_dirs == (world.features_dir,)


# ------------------------------------------------------------------------------------- kept items


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
    os.link(before / "a", tmp_path / "secret")  # the same file, to all appearances
    lines = [json.loads(line) for line in (before / ".items").read_text().splitlines()]
    lines[0][1] = {"../secret": lines[0][1]["a"]}
    (before / ".items").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    deeper = tmp_path / "deeper"
    deeper.mkdir()
    items = Work(kept=kept_in(deeper / "now", before)).items("letters", "abc", same)
    assert set(items.done) == {"b", "c"}
    assert [path.name for path in deeper.iterdir()] == ["now"]


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
