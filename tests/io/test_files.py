"""Files and folders: atomic writes, links, and output folders that keep the files of others."""

from __future__ import annotations

import resource
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.files import (
    atomic_write,
    link_file,
    link_images,
    reading,
    safe_join,
    write_bytes,
)
from megloc_kapture.io.kapture import FeatureConfig, FeatureWriter
from megloc_kapture.io.output_folders import (
    MARKER,
    check_new_file,
    claim_folder,
    files_below,
    staged_output,
)
from tests.worlds import folder_bytes


def test_a_file_is_written_with_its_folders_and_the_umask(tmp_path: Path) -> None:
    write_bytes(tmp_path / "a" / "b.bin", b"content")
    assert (tmp_path / "a" / "b.bin").read_bytes() == b"content"
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["b.bin"]
    (tmp_path / "plain").touch()
    assert (tmp_path / "a" / "b.bin").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_failing_block_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    place = tmp_path / "file"
    place.write_bytes(b"old")
    with pytest.raises(RuntimeError, match="stop"), atomic_write(place) as file:
        file.write(b"new")
        assert place.read_bytes() == b"old"
        raise RuntimeError("stop")
    assert place.read_bytes() == b"old"
    # an input file that is missing is not reported as an error of the output
    with pytest.raises(FileNotFoundError, match="missing"), atomic_write(tmp_path / "out") as file:
        file.write((tmp_path / "missing").read_bytes())
    assert list(tmp_path.iterdir()) == [place]


@pytest.fixture
def small_files() -> Iterator[None]:
    """The kernel refuses to write more than 100 kB into a file, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.usefixtures("small_files")
def test_a_full_disk_is_an_output_error_and_leaves_no_partial_file(tmp_path: Path) -> None:
    config = FeatureConfig("f", np.dtype("float32"), 128)
    writer = FeatureWriter(tmp_path, "keypoints", "t", config)
    for write, place in (
        (lambda: write_bytes(tmp_path / "file.bin", bytes(1_000_000)), "file.bin"),
        (lambda: writer.write("a.jpg", np.zeros((1000, 128))), "keypoints/t/a.jpg.kpt"),
    ):
        with pytest.raises(OutputError, match=f"{place}: .*File too large"):
            write()
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["keypoints.txt"]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    images = tmp_path / "source" / "sensors" / "records_data"
    images.mkdir(parents=True)
    (images / "a.jpg").write_bytes(b"image")
    return tmp_path / "source"


def test_images_and_masks_are_linked_to_their_original_place(source: Path, tmp_path: Path) -> None:
    (source / "sensors" / "masks").mkdir()
    link_images(source, tmp_path / "new")
    link_images(tmp_path / "new", tmp_path / "second")
    for name in ("records_data", "masks"):
        for root in ("new", "second"):
            link = tmp_path / root / "sensors" / name
            assert link.readlink() == source / "sensors" / name
    assert (tmp_path / "new/sensors/records_data/a.jpg").read_bytes() == b"image"
    link_images(tmp_path / "nothing", tmp_path / "third")
    assert not (tmp_path / "third").exists()


def test_a_link_replaces_an_older_link_and_never_a_folder(source: Path, tmp_path: Path) -> None:
    images = tmp_path / "new" / "sensors" / "records_data"
    images.mkdir(parents=True)
    (images / "b.jpg").write_bytes(b"mine")
    with pytest.raises(OutputError, match="records_data: cannot write: Is a directory"):
        link_images(source, tmp_path / "new")
    assert (images / "b.jpg").read_bytes() == b"mine"
    shutil.rmtree(images)
    images.symlink_to(tmp_path / "gone")
    link_images(source, tmp_path / "new")
    assert (images / "a.jpg").read_bytes() == b"image"


def test_a_linked_file_replaces_an_older_file(source: Path, tmp_path: Path) -> None:
    image = source / "sensors" / "records_data" / "a.jpg"
    place = tmp_path / "new" / "deep" / "a.jpg"
    place.parent.mkdir(parents=True)
    place.write_bytes(b"older")
    link_file(image, place)
    assert place.readlink() == image
    place.parent.joinpath("file").touch()
    with pytest.raises(OutputError, match="file/a.jpg"):
        link_file(image, place.parent / "file" / "a.jpg")


# -------------------------------------------------------------------------------------------- paths


def test_a_joined_path_is_refused_or_stays_below_the_root() -> None:
    for name in ("..a/b..", "é/ü 1.png", "a/...b", "a, b.jpg"):
        assert safe_join(Path("/root"), name) == Path("/root", name)
    above = ("", "/a", "..", "../a", "a/../b", "a/..", "./a", "a//b", "a/")
    for name in (*above, "a\\b", "a\0b", "a\nb", "\udc80"):
        with pytest.raises(DataError):
            safe_join(Path("/root"), name)


# ------------------------------------------------------------------------------- output folders


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """A folder with a file of the user."""
    place = tmp_path / "home"
    place.mkdir()
    (place / "thesis.txt").write_text("mine")
    return place


def test_an_existing_file_needs_force_and_a_folder_is_no_file(tmp_path: Path) -> None:
    check_new_file(tmp_path / "new" / "file", force=False)
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="file: exists; -f overwrites it"):
        check_new_file(tmp_path / "file", force=False)
    check_new_file(tmp_path / "file", force=True)
    for force in (False, True):
        with pytest.raises(OutputError, match="is a folder; give the name of a file"):
            check_new_file(tmp_path, force=force)


def test_a_new_or_empty_folder_is_claimed(tmp_path: Path) -> None:
    new, empty = tmp_path / "a" / "b", tmp_path / "empty"
    empty.mkdir()
    for place in (new, empty):
        claim_folder(place, kind="map")
        assert (place / MARKER).read_text() == "map\n"
        (place / "file").touch()
        claim_folder(place, kind="map")


def test_a_link_to_a_missing_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    for folder in (tmp_path / "link", tmp_path / "link" / "new"):
        with pytest.raises(OutputError, match="cannot write: .*; .*/link is a link to .*/disk, "):
            claim_folder(folder, kind="map")


def test_a_folder_of_other_files_is_refused_unless_forced(foreign: Path) -> None:
    before = folder_bytes(foreign)
    with pytest.raises(OutputError, match="not an earlier output of this kind .map.; .* -f"):
        claim_folder(foreign, kind="map")
    assert folder_bytes(foreign) == before
    claim_folder(foreign, kind="map", force=True)
    assert folder_bytes(foreign) == {**before, MARKER: b"map\n"}
    with pytest.raises(OutputError, match="not an earlier output of this kind .feature"):
        claim_folder(foreign, kind="feature")
    assert folder_bytes(foreign) == {**before, MARKER: b"map\n"}


def write_output(place: Path, *names: str, **options: Any) -> None:
    with staged_output(place, kind="map", **options) as out:
        for name in names:
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            (out / name).write_text(name)


def names_in(place: Path) -> set[str]:
    return set(folder_bytes(place)) - {MARKER}


@pytest.mark.parametrize("adds", [False, True])
def test_a_second_run_replaces_only_files_of_the_first(tmp_path: Path, adds: bool) -> None:
    place = tmp_path / "out"
    write_output(place, "sub/a", "sub/deep/b", "old/c", adds=adds)
    (place / "old" / "notes.txt").write_text("mine")
    write_output(place, "sub/a", "d", adds=adds)
    earlier = {"sub/deep/b", "old/c"} if adds else set()
    assert names_in(place) == {"sub/a", "d", "old/notes.txt"} | earlier
    assert (place / "sub" / "deep").exists() == adds


def test_files_of_another_kind_of_output_stay_when_forced(tmp_path: Path) -> None:
    place = tmp_path / "out"
    write_output(place, "e")
    with staged_output(place, kind="dataset", force=True) as out:
        (out / "f").touch()
    assert names_in(place) == {"e", "f"}


def test_an_output_that_is_an_input_is_refused_even_if_forced(tmp_path: Path) -> None:
    (tmp_path / "map").mkdir()
    (tmp_path / "link").symlink_to("map")
    for place in (tmp_path / "map", tmp_path / "link", tmp_path):
        with pytest.raises(OutputError, match=f"{place}: is or contains an input"):
            write_output(place, "a", force=True, inputs=(None, tmp_path / "map"))
    assert names_in(tmp_path / "map") == set()


def test_kapture_data_of_others_is_not_replaced_even_if_forced(tmp_path: Path) -> None:
    """For example the map, if it is given as the output, too."""
    place = tmp_path / "map"
    (place / "sensors").mkdir(parents=True)
    (place / "sensors" / "sensors.txt").write_text("theirs")
    before = folder_bytes(place)
    for force in (False, True):
        with pytest.raises(OutputError, match="map: holds other kapture data, which is never"):
            write_output(place, "sensors/sensors.txt", force=force)
    assert folder_bytes(place) == before


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (
            b"version https://git-lfs.github.com/spec/v1\noid s",
            "a Git LFS pointer; .*git lfs pull.",
        ),
        (b"\n<!DOCTYPE html><html>", "a web page; download the file itself"),
        (b"<html>\r\n<head>", "a web page; download the file itself"),
        (b"P6 1", "no header"),
    ],
)
def test_what_replaces_a_file_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "net.pth").write_bytes(content)
    with (
        pytest.raises(DataError, match=f"net.pth: not weights, or broken: {message}$"),
        reading(tmp_path / "net.pth", "weights"),
    ):
        raise ValueError("no header")


@pytest.mark.parametrize("error", [DataError("broken"), KeyboardInterrupt()])
def test_an_error_changes_no_folder(tmp_path: Path, foreign: Path, error: BaseException) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    before = folder_bytes(tmp_path)
    for place in (empty, foreign, tmp_path / "a" / "b"):
        with pytest.raises(type(error)), staged_output(place, kind="map", force=True) as out:
            (out / "thesis.txt").write_text("ours")
            raise error
    assert folder_bytes(tmp_path) == before and sorted(tmp_path.iterdir()) == [empty, foreign]


def test_input_files_follow_links_once_and_skip_archives_and_outputs(tmp_path: Path) -> None:
    root = tmp_path / "root"
    for name in ("a.txt", "deep/b.jpg", "images.zip", ".hidden", ".git/x", "runs/1/c.txt"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    claim_folder(root / "runs" / "1", kind="workspace", force=True)
    (root / "deep" / "around").symlink_to(root)
    (root / "deep" / "dangling").symlink_to(root / "nowhere")
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "d.mat").touch()
    (root / "linked").symlink_to(tmp_path / "linked")
    names = {str(path.relative_to(root)) for path in files_below(root, tmp_path / "absent")}
    assert names == {"a.txt", "deep/b.jpg", "linked/d.mat"}
