"""pycolmap and zlib: the order of imports that keeps the heap whole.

The wheels of pycolmap 4.1.1 to 4.2.1 corrupt the heap when they are imported before the first
``import zlib``; compression, numba and kapture then abort or hang. Importing the package first, or
importing pycolmap through it, must always be safe, whichever version is installed.
"""

from __future__ import annotations

import subprocess
import sys

import pytest

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
    code = FIRST_IMPORTS.format(module=module)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split()[:2] == ["megloc_kapture", "zlib"]
