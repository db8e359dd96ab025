"""Files: written whole or not at all, linked, in folders that are ours."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.files import (
    MARKER,
    atomic_write,
    claim_folder,
    hard_link,
    link_file,
    link_images,
    replace_directory,
    staged_output,
    write_bytes,
)


def test_a_file_is_written_with_its_folders(tmp_path: Path) -> None:
    write_bytes(tmp_path / "a" / "b.bin", b"content")
    assert (tmp_path / "a" / "b.bin").read_bytes() == b"content"
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["b.bin"]


def test_permissions_follow_the_umask(tmp_path: Path) -> None:
    write_bytes(tmp_path / "atomic", b"")
    (tmp_path / "plain").touch()
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_failing_block_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    place = tmp_path / "file"
    place.write_bytes(b"old")
    with pytest.raises(RuntimeError, match="stop"), atomic_write(place) as file:
        file.write(b"new")
        assert place.read_bytes() == b"old"
        raise RuntimeError("stop")
    assert place.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [place]


def test_an_impossible_place_is_an_output_error_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="file/below"):
        write_bytes(tmp_path / "file" / "below", b"")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="folder: cannot write"):
        write_bytes(tmp_path / "folder", b"")
    with pytest.raises(OutputError):
        write_bytes(tmp_path / ("x" * 300), b"")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]


def test_other_files_errors_keep_their_own_name(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="missing"), atomic_write(tmp_path / "out") as file:
        file.write((tmp_path / "missing").read_bytes())
    assert list(tmp_path.iterdir()) == []


FULL_DISK = """
import resource, sys
from pathlib import Path
import numpy as np
from megloc_kapture.errors import OutputError
from megloc_kapture.io.kapture import FeatureConfig, FeatureWriter, write_points3d
from megloc_kapture.io.files import write_bytes
root = Path(sys.argv[1])
config = FeatureConfig("f", np.dtype("float32"), 128)
tar = FeatureWriter(root, "descriptors", "t", FeatureConfig("f", np.dtype("float32"), 128, "t"),
                    tar=True)
tar.write("small.jpg", np.zeros((10, 128), np.float32))
folder = FeatureWriter(root, "keypoints", "t", config)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
attempts = {
    "bytes": lambda: write_bytes(root / "file.bin", bytes(1_000_000)),
    "points": lambda: write_points3d(root, np.ones((100_000, 3))),
    "keypoints": lambda: folder.write("a.jpg", np.zeros((1000, 128))),
    "tar": lambda: tar.write("large.jpg", np.zeros((1000, 128))),
}
for name, attempt in attempts.items():
    try:
        attempt()
    except OutputError as error:
        print(name, "|", error)
    else:
        print(name, "| written")
tar.write("small2.jpg", np.ones((10, 128), np.float32))
tar.close()
"""


def test_a_full_disk_is_an_output_error_and_leaves_nothing_half_written(tmp_path: Path) -> None:
    # a limit on the size of files makes the kernel refuse the write, as a full disk does
    run = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
    )
    lines = dict(line.split(" | ", 1) for line in run.stdout.splitlines())
    reconstruction = tmp_path / "reconstruction"
    assert str(tmp_path / "file.bin") in lines["bytes"]
    assert str(reconstruction / "points3d.txt") in lines["points"]
    assert str(reconstruction / "keypoints/t/a.jpg.kpt") in lines["keypoints"]
    assert str(reconstruction / "descriptors/t/descriptors.tar") in lines["tar"]
    assert all("File too large" in line for line in lines.values())
    left = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file())
    assert left == [
        "reconstruction/descriptors/t/descriptors.tar",
        "reconstruction/descriptors/t/descriptors.txt",
        "reconstruction/keypoints/t/keypoints.txt",
    ]
    import tarfile

    with tarfile.open(reconstruction / "descriptors/t/descriptors.tar") as tar:
        assert tar.getnames() == ["small.jpg.desc", "small2.jpg.desc"]


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


@pytest.fixture
def source(tmp_path: Path) -> Path:
    images = tmp_path / "source" / "sensors" / "records_data"
    images.mkdir(parents=True)
    (images / "a.jpg").write_bytes(b"image")
    return tmp_path / "source"


def test_images_and_masks_are_linked(source: Path, tmp_path: Path) -> None:
    (source / "sensors" / "masks").mkdir()
    link_images(source, tmp_path / "new")
    place = tmp_path / "new" / "sensors"
    assert (place / "records_data").readlink() == source / "sensors" / "records_data"
    assert (place / "masks").readlink() == source / "sensors" / "masks"
    assert (place / "records_data" / "a.jpg").read_bytes() == b"image"


def test_what_is_not_there_is_not_linked(tmp_path: Path) -> None:
    (tmp_path / "empty" / "sensors").mkdir(parents=True)
    link_images(tmp_path / "empty", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_link_to_a_link_leads_to_the_end(source: Path, tmp_path: Path) -> None:
    link_images(source, tmp_path / "first")
    link_images(tmp_path / "first", tmp_path / "second")
    link = tmp_path / "second" / "sensors" / "records_data"
    assert link.readlink() == source / "sensors" / "records_data"


def test_a_relative_source_is_found_from_elsewhere(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(source.parent)
    link_images(Path("source"), tmp_path / "far" / "away")
    images = tmp_path / "far" / "away" / "sensors" / "records_data"
    assert (images / "a.jpg").read_bytes() == b"image"


def test_a_link_of_before_is_replaced(source: Path, tmp_path: Path) -> None:
    place = tmp_path / "new" / "sensors" / "records_data"
    place.parent.mkdir(parents=True)
    place.symlink_to(tmp_path / "gone")
    link_images(source, tmp_path / "new")
    assert place.readlink() == source / "sensors" / "records_data"


def test_a_folder_is_not_replaced(source: Path, tmp_path: Path) -> None:
    place = tmp_path / "new" / "sensors" / "records_data"
    place.mkdir(parents=True)
    (place / "b.jpg").write_bytes(b"mine")
    with pytest.raises(OutputError, match="records_data: cannot write: File exists"):
        link_images(source, tmp_path / "new")
    assert (place / "b.jpg").read_bytes() == b"mine"


def test_one_file_is_linked_in_the_place_of_an_older_one(source: Path, tmp_path: Path) -> None:
    image = source / "sensors" / "records_data" / "a.jpg"
    place = tmp_path / "new" / "deep" / "a.jpg"
    place.parent.mkdir(parents=True)
    place.write_bytes(b"older")
    link_file(image, place)
    assert place.readlink() == image
    place.parent.joinpath("file").touch()
    with pytest.raises(OutputError, match="file/a.jpg"):
        link_file(image, place.parent / "file" / "a.jpg")


def test_a_hard_link_is_the_same_file_and_replaces_what_was_there(tmp_path: Path) -> None:
    source, place = tmp_path / "source", tmp_path / "deep" / "place"
    source.write_bytes(b"new")
    for _ in range(2):
        hard_link(source, place)
        assert place.samefile(source)
    with pytest.raises(OutputError, match="below"):
        hard_link(source, source / "below")
