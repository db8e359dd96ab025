"""Folders that a command writes are ours, and whole or as they were."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.output_folders import MARKER, claim_folder, replace_directory, staged_output


def _folder(path: Path, content: str) -> Path:
    path.mkdir()
    (path / "file").write_text(content)
    return path


def test_a_folder_takes_the_place_of_another(tmp_path: Path) -> None:
    place = _folder(tmp_path / "place", "old")
    (place / "more").touch()
    replace_directory(_folder(tmp_path / "new", "new"), place)
    assert (place / "file").read_text() == "new"
    assert [p.name for p in tmp_path.rglob("*")] == ["place", "file"]


def test_a_folder_takes_an_empty_place(tmp_path: Path) -> None:
    replace_directory(_folder(tmp_path / "new", "new"), tmp_path / "deep" / "place")
    assert (tmp_path / "deep" / "place" / "file").read_text() == "new"
    assert not (tmp_path / "new").exists()


def test_links_and_files_are_not_replaced_by_a_folder(tmp_path: Path) -> None:
    new = _folder(tmp_path / "new", "new")
    users = _folder(tmp_path / "users", "precious")
    (tmp_path / "link").symlink_to(users)
    (tmp_path / "file").touch()
    for name in ("link", "file"):
        with pytest.raises(OutputError, match=name):
            replace_directory(new, tmp_path / name)
    assert (users / "file").read_text() == "precious"
    assert (new / "file").read_text() == "new"


def tree(root: Path) -> dict[str, bytes | None]:
    """Path -> content of files, None for folders."""
    return {
        str(path.relative_to(root)): None if path.is_dir() else path.read_bytes()
        for path in sorted(root.rglob("*"))
    }


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """A folder with something of somebody else in it."""
    place = tmp_path / "home"
    place.mkdir()
    (place / "thesis.txt").write_text("mine")
    return place


@pytest.mark.parametrize("made", [True, False])
def test_a_new_or_empty_folder_becomes_ours(tmp_path: Path, made: bool) -> None:
    place = tmp_path / "a" / "b"
    if made:
        place.mkdir(parents=True)
    claim_folder(place, kind="map")
    assert (place / MARKER).read_text() == "map\n"
    claim_folder(place, kind="map")
    (place / "file").touch()
    claim_folder(place, kind="map")


def test_a_folder_of_somebody_else_is_refused(foreign: Path) -> None:
    before = tree(foreign)
    with pytest.raises(OutputError, match=r"home: is not empty and not a map of megloc; .* -f"):
        claim_folder(foreign, kind="map")
    assert tree(foreign) == before
    claim_folder(foreign, kind="map", force=True)
    assert tree(foreign) == {**before, MARKER: b"map\n"}


def test_a_folder_of_another_kind_is_refused(tmp_path: Path) -> None:
    claim_folder(tmp_path / "x", kind="features")
    (tmp_path / "x" / "file").touch()
    with pytest.raises(OutputError, match="not a map of megloc"):
        claim_folder(tmp_path / "x", kind="map")
    assert (tmp_path / "x" / MARKER).read_text() == "features\n"


def test_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x").write_text("mine")
    with pytest.raises(OutputError, match="x: is a file, a folder is needed"):
        claim_folder(tmp_path / "x", kind="map", force=True)
    with pytest.raises(OutputError, match="x/y: cannot write"):
        claim_folder(tmp_path / "x" / "y", kind="map", force=True)
    assert (tmp_path / "x").read_text() == "mine"


def test_a_claim_is_undone(tmp_path: Path, foreign: Path) -> None:
    claim_folder(tmp_path / "a" / "b" / "c", kind="map").undo()
    assert not (tmp_path / "a").exists()
    before = tree(foreign)
    claim_folder(foreign, kind="map", force=True).undo()
    assert tree(foreign) == before
    claim_folder(foreign, kind="features", force=True)
    claim_folder(foreign, kind="map", force=True).undo()
    assert (foreign / MARKER).read_text() == "features\n"


def test_what_has_been_written_survives_the_undoing(tmp_path: Path) -> None:
    claim = claim_folder(tmp_path / "a" / "b", kind="map")
    (tmp_path / "a" / "b" / "file").write_text("kept")
    claim.undo()
    assert tree(tmp_path) == {"a": None, "a/b": None, "a/b/file": b"kept"}


def test_output_gets_to_its_place_at_the_end(tmp_path: Path) -> None:
    place = tmp_path / "out"
    with staged_output(place, kind="map") as out:
        (out / "sub").mkdir()
        (out / "sub" / "new.txt").write_text("new")
        assert not (place / "sub").exists()
    assert tree(place) == {MARKER: b"map\n", "sub": None, "sub/new.txt": b"new"}


def test_new_files_replace_old_ones_and_others_stay(tmp_path: Path) -> None:
    place = tmp_path / "out"
    for content, name in ((b"1", "a"), (b"2", "b"), (b"3", "a")):
        with staged_output(place, kind="map") as out:
            (out / "sub").mkdir()
            (out / "sub" / name).write_bytes(content)
    assert tree(place) == {MARKER: b"map\n", "sub": None, "sub/a": b"3", "sub/b": b"2"}


def test_a_link_is_replaced_and_not_followed(tmp_path: Path, foreign: Path) -> None:
    place = tmp_path / "out"
    for _ in range(2):
        with staged_output(place, kind="map") as out:
            (out / "images").symlink_to(foreign)
    assert (place / "images").readlink() == foreign
    with staged_output(place, kind="map") as out:
        (out / "images").mkdir()
        (out / "images" / "thesis.txt").write_text("ours")
    assert (foreign / "thesis.txt").read_text() == "mine"


@pytest.mark.parametrize("error", [DataError("broken"), KeyboardInterrupt(), ValueError("ours")])
def test_an_error_leaves_nothing(tmp_path: Path, error: BaseException) -> None:
    place = tmp_path / "a" / "b"
    with pytest.raises(type(error)), staged_output(place, kind="map") as out:
        (out / "file").touch()
        raise error
    assert tree(tmp_path) == {}


def test_an_error_leaves_a_folder_as_it_was(tmp_path: Path, foreign: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    before = tree(tmp_path)
    for place in (empty, foreign):
        with (
            pytest.raises(DataError),
            staged_output(place, kind="map", force=True) as out,
        ):
            (out / "thesis.txt").write_text("ours")
            raise DataError("broken")
    assert tree(tmp_path) == before


def test_an_error_of_the_system_is_told_with_the_folder(tmp_path: Path) -> None:
    place = tmp_path / "out"
    with (
        pytest.raises(OutputError, match="out: cannot write: No space left"),
        staged_output(place, kind="map"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with (
        pytest.raises(OutputError, match="out: cannot write: No such file"),
        staged_output(place, kind="map") as out,
    ):
        (out / "gone" / "file").write_text("x")
    # what was met while reading something else is not of the output
    with pytest.raises(FileNotFoundError), staged_output(place, kind="map"):
        (tmp_path / "elsewhere").read_text()
    assert tree(tmp_path) == {}
