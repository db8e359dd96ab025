"""A pickle that would run code."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest


class _MakesFolder:
    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str]]:
        return os.mkdir, (str(self.folder),)


@pytest.fixture
def code(tmp_path: Path) -> object:
    """Object that creates the folder ``made`` where pickle itself loads it."""
    return _MakesFolder(tmp_path / "made")
