"""Fixtures that every test may use, those of megloc-twins too, and hypothesis' profiles."""

from __future__ import annotations

import copy
import fcntl
import hashlib
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from corner import write_scene
from hypothesis import settings

from megloc_kapture.io.colmap import load_pycolmap

# its import takes over the signals of a crash, and what it tells of one pytest captures; before
# pytest takes them, a crash is told with the lines of Python that led to it
load_pycolmap()

REPOSITORY = Path(__file__).resolve().parent

# no test depends on how fast the machine is. The quick tier draws the same few examples every time,
# `make test-all` many new ones (--hypothesis-profile=thorough).
settings.register_profile(
    "fast", deadline=None, print_blob=True, max_examples=20, derandomize=True, database=None
)
settings.register_profile("thorough", deadline=None, print_blob=True)
settings.load_profile("fast")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--time-budget-s", type=float, help="skip the tests that would begin after so many seconds"
    )


_BEGIN_S = time.monotonic()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    budget_s = item.config.getoption("--time-budget-s")
    if budget_s is not None and time.monotonic() - _BEGIN_S > budget_s:
        pytest.skip(f"left out, {budget_s:.0f} s are over: {item.nodeid}")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the shared test data; the test is skipped where it is absent."""
    place = os.environ.get("MEGLOC_SHARED_DATA")
    folder = Path(place) if place else REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no shared test data at {folder} (set MEGLOC_SHARED_DATA)")
    return folder


@pytest.fixture(scope="session")
def fountain(shared_data: Path) -> Path:
    """A real scene with surveyed poses: mapping/, query/ and query_gt/; read only."""
    return shared_data / "scenes" / "fountain_p11"


@pytest.fixture(scope="session")
def virtual_gallery(shared_data: Path) -> Path:
    """A real map of another tool: map/, query/ and query_gt/; read only."""
    return shared_data / "foreign_maps" / "virtual_gallery"


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A rendered scene: mapping/, query/ and query_gt/; not to be written into.

    Whole runs of it by the dozen extract the same features: this process does it once.
    """
    root = tmp_path_factory.mktemp("scene")
    write_scene(root)
    with pytest.MonkeyPatch.context() as patch:
        from megloc_kapture.features.rootsift import ColmapSift, RootSift

        for kind in (RootSift, ColmapSift):
            patch.setattr(kind, "extract", _remembered(kind.extract))
        yield root


def _remembered(extract: Any) -> Any:
    known: dict[Any, Any] = {}

    def remembered(self: Any, image: Any, mask: Any = None) -> Any:
        arrays = (array.tobytes() for array in (image, mask) if array is not None)
        key = (repr(self.options), image.shape, *(hashlib.sha256(each).digest() for each in arrays))
        if key not in known:
            known[key] = extract(self, image, mask)
        return copy.deepcopy(known[key])

    return remembered


@pytest.fixture(scope="session")
def written_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Function: the folder of a name, which one worker writes for all; not to be written into."""
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def folder(name: str, write: Callable[[Path], Any]) -> Path:
        done = base / f"{name}.done"
        with (base / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                write(base / name)
                done.touch()
        return base / name

    return folder


@pytest.fixture(scope="session")
def colmap_room(scene: Path, written_once: Callable[..., Path]) -> Path:
    """The scene's map as a COLMAP workspace, made by COLMAP; not to be written into."""
    from colmap_workspace import write_workspace

    def write(root: Path) -> None:
        # its images are links
        shutil.copytree(scene, root / "scene")
        write_workspace(root / "room", root / "scene")

    return written_once("colmap", write) / "room"


@pytest.fixture(scope="session", autouse=True)
def no_weights(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What the machine's user has of weights changes nothing; tests that need some say where."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MEGLOC_WEIGHTS", str(tmp_path_factory.mktemp("no-weights")))
        yield


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take minutes, so that none of them runs alone at the end."""
    longest = ("test_neural_field.py", "test_gpu_smoke.py", "test_whole_runs.py")
    items.sort(key=lambda item: item.path.name not in longest)
