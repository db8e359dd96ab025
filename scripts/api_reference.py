"""Write the API reference, pages of the public modules' docstrings, into a folder.

`make docs` calls it: ``.venv/bin/python scripts/api_reference.py build/docs``.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pdoc
from pdoc import docstrings

import megloc_kapture

MODULES = tuple(f"megloc_kapture{part}" for part in ("", ".plugins", ".values", ".errors"))
_read_numpy = docstrings.numpy


def _read_described(docstring: str) -> str:
    """Return the Markdown of a numpy-style docstring with descriptions in place of types.

    The signature shows the types, so in ``name : text`` the text is a description; pdoc would
    treat it as a type.
    """
    described = re.sub(r"^(\w+(?:, \w+)*) : (.*)$", r"\1\n    \2", docstring, flags=re.MULTILINE)
    return _read_numpy(described)


def write(folder: Path) -> None:
    """Write the pages, of which ``index.html`` is the first."""
    # the package loads names lazily; pdoc sees only loaded names
    vars(megloc_kapture).update(
        {name: getattr(megloc_kapture, name) for name in megloc_kapture.__all__}
    )
    docstrings.numpy = _read_described
    pdoc.render.configure(docformat="numpy", show_source=False)
    pdoc.pdoc(*MODULES, output_directory=folder)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
