"""A full disk: one line, exit status 2, nothing half-written, and room for another try."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[..., Path]]:
    """Function that makes a disk of a size, and changes it; needs the right to mount."""
    place = tmp_path / "disk"

    def make(size: str, *options: str) -> Path:
        place.mkdir(exist_ok=True)
        flags = ",".join([f"size={size}", *options])
        mount = ["mount", "-t", "tmpfs", "-o", flags, "tmpfs", str(place)]
        try:
            subprocess.run(mount, check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError) as error:
            pytest.skip(f"no right to mount a small disk: {error}")
        return place

    yield make
    # lazily: this process may still have a map's index mapped
    subprocess.run(["umount", "-l", str(place)], check=False, capture_output=True)


def test_eval_stops_cleanly_and_goes_on(
    megloc: Any, scene: Path, finished: Path, small_disk: Callable[..., Path]
) -> None:
    workspace = small_disk("1m") / "workspace"
    arguments = ["--root", scene, "--workspace", workspace, "--quiet", "--executor", "inline"]
    arguments += ["--set", "local_features.options.max_keypoints=800", "--until", "submission"]
    done = megloc("eval", "kapture", *arguments)
    done.refused(r"/workspace/\.partial/local_features/.*: cannot write: No space left on device")
    assert not (workspace / "local_features").exists()
    (left,) = (workspace / ".partial").iterdir()
    assert (left / ".fingerprint").is_file() and not any(left.rglob(".megloc-*"))
    assert (workspace / "stages" / "import.json").is_file()
    small_disk("100m", "remount")
    assert megloc("eval", "kapture", *arguments).status == 0
    name = "submissions/kapture_eval_megloc-classic.txt"
    assert (workspace / name).read_bytes() == (finished / name).read_bytes()


@pytest.mark.parametrize("pages", [1, 2, 4])
def test_localize_leaves_nothing(
    megloc: Any, foreign: Path, small_disk: Callable[..., Path], pages: int
) -> None:
    disk = small_disk(f"{4 * pages}k")
    places = ("-i", foreign / "map", "--query", foreign / "query", "-o", disk / "new" / "localized")
    done = megloc("localize", *places)
    done.refused(f"{disk}/.*: cannot write: No space left on device")
    assert list(disk.iterdir()) == []
