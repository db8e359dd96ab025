"""Names of installed plugins, without the imports that loading one takes."""

from __future__ import annotations

import sys
from functools import cache
from importlib import metadata
from typing import Any

STAGES = "megloc_kapture.stages"


def entry_points(**of: str) -> metadata.EntryPoints:
    """Return the entry points on the search path, cached: reading takes 10 ms."""
    return _selected(tuple(sys.path), *sorted(of.items()))


@cache
def _selected(search_path: tuple[str, ...], *of: tuple[str, str]) -> Any:
    return _entry_points_on(search_path).select(**dict(of))


@cache
def _entry_points_on(_search_path: tuple[str, ...]) -> Any:
    """Any: Python 3.11 has another return type with the same selection."""
    return metadata.entry_points()


def plugin_names(group: str) -> list[str]:
    return sorted({entry.name for entry in entry_points(group=group)})
