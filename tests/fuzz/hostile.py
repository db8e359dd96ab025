"""A pickle that would run code."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path


class Runs:
    """Pickled as a call; unpickled by pickle itself it makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str]]:
        return os.mkdir, (str(self.folder),)
