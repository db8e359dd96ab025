"""Files and folders appear whole or not at all."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from megloc_kapture.errors import OutputError
from megloc_kapture.io.atomic import atomic_write, replace_directory, write_bytes


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
from megloc_kapture.io.kapture_store import FeatureConfig, FeatureWriter, write_points3d
from megloc_kapture.io.atomic import write_bytes
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
