"""A compiled loop on disk is made anew when a loop of another file that it calls changes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

INNER = """
from megloc_kapture.compiling import compiled_loop

@compiled_loop
def inner(x):
    return x + {added}
"""
MIDDLE = """
from inner_loops import inner
from megloc_kapture.compiling import compiled_loop

@compiled_loop
def middle(x):
    return inner(x) * 10
"""
OUTER = """
from middle_loops import middle
from megloc_kapture.compiling import compiled_loop

@compiled_loop
def outer(x):
    return middle(x)
"""


def call(folder: Path) -> int:
    result = subprocess.run(
        [sys.executable, "-c", "from outer_loops import outer; print(outer(1))"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    return int(result.stdout)


def test_a_change_of_a_called_loop_is_seen(tmp_path: Path) -> None:
    (tmp_path / "outer_loops.py").write_text(OUTER)
    (tmp_path / "middle_loops.py").write_text(MIDDLE)
    (tmp_path / "inner_loops.py").write_text(INNER.format(added=1))
    assert call(tmp_path) == 20
    assert list(tmp_path.glob("__pycache__/*outer*.nbc"))  # it was kept
    # of another size: within a second Python itself takes a file of the same for unchanged
    (tmp_path / "inner_loops.py").write_text(INNER.format(added=50))
    assert call(tmp_path) == 510
