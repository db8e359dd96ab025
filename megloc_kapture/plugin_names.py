"""Names of installed plugins, read without importing the plugins."""

from __future__ import annotations

import sys
from functools import cache
from importlib import metadata
from typing import Any

STAGES = "megloc_kapture.stages"


def entry_points(**of: str) -> Any:
    """Return the selected entry points on the search path, cached: reading takes 10 ms."""
    return _entry_points_on(tuple(sys.path)).select(**of)


@cache
def _entry_points_on(_search_path: tuple[str, ...]) -> Any:
    """Typed as Any: Python 3.11 and 3.12 return different classes with ``select``."""
    return metadata.entry_points()


def plugin_names(group: str) -> list[str]:
    return sorted({entry.name for entry in entry_points(group=group)})
