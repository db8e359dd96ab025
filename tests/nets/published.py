"""Keys and shapes of the published checkpoints, as the files in ``keys`` have them."""

from __future__ import annotations

from pathlib import Path


def published_shapes(name: str) -> dict[str, tuple[int, ...]]:
    """Key -> shape."""
    rows = (Path(__file__).parent / "keys" / f"{name}.txt").read_text(encoding="utf-8").splitlines()
    pairs = (row.split() for row in rows)
    return {key: () if s == "scalar" else tuple(map(int, s.split("x"))) for key, s in pairs}
