"""A dataset that a test may change."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest


@pytest.fixture
def root(downloaded: Path, tmp_path: Path) -> Path:
    """A copy of the module's dataset, which is written once."""
    return Path(shutil.copytree(downloaded, tmp_path / "root", symlinks=True))
