"""Fixtures that every test may use, and hypothesis' settings."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

REPOSITORY = Path(__file__).resolve().parent.parent

# no test depends on how fast the machine is
settings.register_profile("megloc", deadline=None, print_blob=True)
settings.load_profile("megloc")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the shared test data; the test is skipped where it is absent."""
    place = os.environ.get("MEGLOC_SHARED_DATA")
    folder = Path(place) if place else REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no shared test data at {folder} (set MEGLOC_SHARED_DATA)")
    return folder


@pytest.fixture(scope="session", autouse=True)
def no_weights(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What the machine's user has of weights changes nothing; tests that need some say where."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MEGLOC_WEIGHTS", str(tmp_path_factory.mktemp("no-weights")))
        yield
