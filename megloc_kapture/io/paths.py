"""Paths named by data: checked as text, never trusted.

Image names, type names and the like come from files somebody else wrote. They may only ever lead
to something below the folder they belong to.
"""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path

from megloc_kapture.errors import DataError, OutputError

# the folder that something was found in, and others that links in it may lead to
Roots = Path | tuple[Path, ...]


_MAX_FOLDERS = 250  # Python makes a folder's parents one within the other


def has_control_characters(text: str) -> bool:
    """True for a text with characters that no name or line should have (NUL, tab, ...)."""
    if text.isprintable():
        return False
    return any(ord(c) < 32 or ord(c) == 127 or 0xD800 <= ord(c) <= 0xDFFF for c in text)


@lru_cache(maxsize=1 << 12)  # the text alone decides, and the same names come in a row
def check_relative(text: str) -> str:
    """Return ``text`` if it is a plain relative path (``a/b.jpg``), else raise.

    Raises DataError: empty, absolute, deeper than 250 folders, ``.`` or ``..`` or an empty
    component, a backslash, or a control character (NUL included) in it. A ``.`` or empty component
    is harmless, but would give one file two names, and names are identities in kapture.
    """
    if not text:
        raise DataError("empty path")
    if "\\" in text:
        raise DataError(f"backslash in path {text!r}")
    if has_control_characters(text):
        raise DataError(f"control character in path {text!r}")
    if text.count("/") > _MAX_FOLDERS:
        raise DataError(f"path of {text.count('/')} folders: {text[:20]!r}...")
    if text.startswith("/"):
        raise DataError(f"absolute path {text!r}; it must be relative to its folder")
    for component in text.split("/"):
        if component == "..":
            raise DataError(f"path {text!r} leads out of its folder ('..')")
        if component in ("", "."):
            raise DataError(f"path {text!r} has an empty or '.' component")
    return text


def check_component(text: str) -> str:
    """Return ``text`` if it can be the name of one folder and one CSV field, else raise.

    Used for type names (``r2d2_500``), which stand both in paths and in CSV files.

    Raises DataError: what :func:`check_relative` refuses, a slash, a comma, or a space at either
    end.
    """
    check_relative(text)
    if "/" in text or "," in text or text != text.strip():
        raise DataError(f"{text!r} cannot be a type name (slash, comma or space at the end)")
    return text


def safe_join(root: Path, relative_text: str) -> Path:
    """``root / relative_text`` where the text is a plain relative path.

    The check is on the text alone: links are not looked at, the file need not exist.

    Raises DataError: see :func:`check_relative`.
    """
    return Path(root) / check_relative(relative_text)


def check_no_escape(roots: Roots, path: Path) -> Path:
    """Return ``path`` if what it is after following links still lies in one of the ``roots``.

    Raises DataError: a link on the way leads out of them.
    """
    roots = (roots,) if isinstance(roots, Path) else roots
    real = os.path.realpath(path)
    for root in roots:
        real_root = os.path.realpath(root)
        if real == real_root or real.startswith(real_root.rstrip(os.sep) + os.sep):
            return path
    raise DataError(
        f"is or lies behind a link that leaves {roots[0]}, to {real}; images may be links to "
        "anywhere, anything else only to below a folder that --allow-links-below names",
        path=path,
    )


def check_output(root: Path, path: Path) -> Path:
    """Return ``path`` if writing there stays in ``root``: no link on the way leads out of it.

    Raises OutputError: one does; what it leads to is somebody else's.
    """
    try:
        return check_no_escape(root, path)
    except DataError as error:
        raise OutputError(f"{path}: not written: lies behind a link that leaves {root}") from error
