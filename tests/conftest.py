"""Fixtures that every test may use, and hypothesis' settings."""

from __future__ import annotations

import os
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
