"""pycolmap and zlib: the order of imports that keeps the heap whole.

The wheels of pycolmap 4.1.1 to 4.2.1 corrupt the heap when they are imported before the first
``import zlib``; compression, numba and kapture then abort or hang. Importing the package first, or
importing pycolmap through it, must always be safe, whichever version is installed.
"""

from __future__ import annotations

import subprocess
import sys

import pytest

ROUNDS = """
import gzip, io, random, zlib
import numpy as np
data = random.Random(0).randbytes(300_000)
for level in (1, 6, 9):
    for _ in range(10):
        assert zlib.decompress(zlib.compress(data, level)) == data
        assert gzip.decompress(gzip.compress(data, level)) == data
archive = io.BytesIO()
np.savez_compressed(archive, a=np.arange(100_000))
assert np.load(io.BytesIO(archive.getvalue()))["a"][-1] == 99_999
print("whole")
"""


def run_python(code: str) -> subprocess.CompletedProcess[str]:
    # a time limit because the corrupted heap sometimes hangs instead of aborting
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )


def test_heap_is_whole_after_imports() -> None:
    done = run_python("import megloc_kapture, pycolmap, kapture.io.csv" + ROUNDS)
    assert (done.returncode, done.stdout) == (0, "whole\n"), done.stderr


# the packages of a fresh interpreter may hold zlib already: forget it, then write down what is
# asked for while the package is imported
FIRST_IMPORTS = """
import sys
sys.modules.pop("zlib", None)
asked = []
class Recorder:
    def find_spec(self, name, path=None, target=None):
        asked.append(name)
sys.meta_path.insert(0, Recorder())
import {module}
print(*asked)
"""


@pytest.mark.parametrize("module", ["megloc_kapture", "megloc_kapture.io.colmap"])
def test_package_imports_zlib_before_anything_else(module: str) -> None:
    done = run_python(FIRST_IMPORTS.format(module=module))
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[:2] == ["megloc_kapture", "zlib"]
