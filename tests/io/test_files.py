"""Files: written whole or not at all, linked."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from megloc_kapture.errors import DataError, OutputError
from megloc_kapture.io.files import (
    atomic_write,
    check_component,
    check_no_escape,
    hard_link,
    link_file,
    link_images,
    safe_join,
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


# -------------------------------------------------------------------------------------------- paths


@pytest.mark.parametrize("name", ["a.jpg", "db/1 2.jpg", "..a/b..", "é/ü.png", "a/...b"])
def test_plain_names_are_joined(name: str) -> None:
    assert safe_join(Path("/root"), name) == Path("/root") / name


@pytest.mark.parametrize(
    "name",
    ["", "/a", "..", "../a", "a/../b", "a/..", ".", "./a", "a//b", "a/", "a\\b", "a\0b", "a\nb"],
)
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(DataError):
        safe_join(Path("/root"), name)


@given(st.text(alphabet=st.sampled_from("./\\a b\0\n\udc80,")))
def test_what_is_accepted_stays_below_the_root(name: str) -> None:
    try:
        path = safe_join(Path("/root"), name)
    except DataError:
        return
    assert path.is_relative_to("/root")
    assert path != Path("/root")
    assert str(path) == f"/root/{name}"  # one file, one name


@pytest.mark.parametrize("name", ["a/b", "a,b", " a", "a ", "..", ""])
def test_type_names_are_single_components(name: str) -> None:
    with pytest.raises(DataError):
        check_component(name)


def test_type_names_may_be_odd() -> None:
    assert check_component("r2d2 500+é(1)") == "r2d2 500+é(1)"


def test_links_may_not_leave_the_root(tmp_path: Path) -> None:
    root = tmp_path / "root"
    (root / "inner").mkdir(parents=True)
    (root / "inner" / "file").touch()
    (tmp_path / "outside").touch()
    (root / "good").symlink_to(root / "inner" / "file")
    (root / "bad").symlink_to(tmp_path / "outside")
    (root / "bad_folder").symlink_to(tmp_path)
    assert check_no_escape(root, root / "good") == root / "good"
    with pytest.raises(DataError, match="bad: .*leaves"):
        check_no_escape(root, root / "bad")
    with pytest.raises(DataError):
        check_no_escape(root, root / "bad_folder" / "outside")


def test_the_root_itself_may_be_a_link_and_share_a_prefix_with_others(tmp_path: Path) -> None:
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "file").touch()
    (tmp_path / "root2").mkdir()
    (tmp_path / "root2" / "file").touch()
    (tmp_path / "link").symlink_to(tmp_path / "root")
    check_no_escape(tmp_path / "link", tmp_path / "link" / "file")
    (tmp_path / "root" / "other").symlink_to(tmp_path / "root2" / "file")
    with pytest.raises(DataError):
        check_no_escape(tmp_path / "root", tmp_path / "root" / "other")


def test_a_name_of_a_thousand_folders_is_refused(tmp_path: Path) -> None:
    """Python makes the parents of a folder one within the other, and gives up."""
    with pytest.raises(DataError, match="path of 1000 folders: 'a/a/a"):
        safe_join(tmp_path, "a/" * 1000 + "x.jpg")
