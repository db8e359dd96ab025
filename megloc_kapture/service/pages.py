"""The pages that the service shows: each one file that needs nothing else."""

from __future__ import annotations

from functools import cache
from pathlib import Path


@cache
def read(name: str) -> str:
    """A page of this folder."""
    return Path(__file__).with_name(name).read_text(encoding="utf-8")
