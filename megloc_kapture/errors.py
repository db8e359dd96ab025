"""Errors of the package, with a common base class."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from functools import partial
from pathlib import Path


class MeglocError(Exception):
    """Base of every error raised on purpose.

    The message is one line with problem, location and remedy. The command line prints it and exits
    with 2; any other exception is an internal error.
    """

    def lines(self) -> list[str]:
        """Return the message lines as the command line prints them."""
        return [" ".join(str(self).split())]


class DataError(MeglocError):
    """Data is missing, broken or inconsistent; the message names file and line where known."""

    def __init__(
        self, message: str, *, path: Path | str | None = None, line: int | None = None
    ) -> None:
        location = "" if path is None else f"{path}: " if line is None else f"{path}:{line}: "
        super().__init__(location + message)
        self.message = message
        self.path = path
        self.line = line

    def __reduce__(self) -> tuple[object, ...]:
        # Exception's own pickling (process pools) loses the keyword-only fields
        return partial(type(self), path=self.path, line=self.line), (self.message,)


def require(
    condition: object, message: str, *, path: Path | str | None = None, line: int | None = None
) -> None:
    """Raise DataError if the condition is false; the message is formatted even if it is true."""
    if not condition:
        raise DataError(message, path=path, line=line)


class OptionError(MeglocError):
    """An invalid option or argument; a message about an unknown name lists the known names."""


def check_option(condition: object, message: str) -> None:
    """Raise OptionError if the condition is false; the message is formatted even if it is true."""
    if not condition:
        raise OptionError(message)


class OutputError(MeglocError):
    """The output cannot be written: existing files, no space, no permission."""


class PluginError(MeglocError):
    """A plugin is unknown, cannot be loaded, rejects its options, or violates its protocol."""


def suggestion(name: str, known: Iterable[str], *, listed: str = "known: ") -> str:
    """Return a hint with the most similar known name, if any, and all known names."""
    names = list(known)
    similar = get_close_matches(name, names, n=1)
    return (
        f"{f'did you mean {similar[0]!r}? ' if similar else ''}{listed}{', '.join(names) or 'none'}"
    )


# imported package -> extra that installs it
_EXTRAS = {
    "torch": "torch",
    "kornia": "torch",
    "distributed": "cluster",
    "h5py": "megadepth",
    **dict.fromkeys(("fastapi", "python_multipart", "starlette", "uvicorn"), "serve"),
}


def missing_extra(error: BaseException) -> str | None:
    """Return installation advice if an import failed because an extra is missing, else None."""
    package = (getattr(error, "name", None) or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or package not in _EXTRAS:
        return None
    return f'{package} is not installed: pip install "megloc-kapture[{_EXTRAS[package]}]"'
