"""The errors a user of the package can meet; all share one root."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path


class MeglocError(Exception):
    """Root of every error the package raises on purpose.

    The message is one line that says what is wrong, where, and what to do. The command line
    prints it and exits with 2; anything that is not a ``MeglocError`` is a defect of ours.
    """

    def lines(self) -> list[str]:
        """The message as the command line prints it: one line, or one for each of several."""
        return [" ".join(str(self).split())]


class DataError(MeglocError):
    """Data is missing, broken or inconsistent; names the file and, where it can, the line."""

    def __init__(
        self, message: str, *, path: Path | str | None = None, line: int | None = None
    ) -> None:
        where = "" if path is None else f"{path}: " if line is None else f"{path}:{line}: "
        super().__init__(where + message)
        self.message = message
        self.path = path
        self.line = line

    def __reduce__(self) -> tuple[object, ...]:
        # the keyword-only fields are lost by Exception's own pickling (process pools)
        return (_rebuild_data_error, (type(self), self.message, self.path, self.line))


def _rebuild_data_error(
    kind: type[DataError], message: str, path: Path | str | None, line: int | None
) -> DataError:
    return kind(message, path=path, line=line)


class OptionError(MeglocError):
    """An option or argument has a value that cannot be used; lists what would be valid."""


class OutputError(MeglocError):
    """The output cannot be written: not ours to overwrite, no space, no permission."""


class PluginError(MeglocError):
    """A plugin is unknown, cannot be loaded, or does not fulfil its protocol."""


def suggestion(name: str, known: Iterable[str], *, listed: str = "known: ") -> str:
    """What an error says behind a name that there is not: a like one that there is, and all."""
    names = list(known)
    near = get_close_matches(name, names, n=1)
    return f"{f'did you mean {near[0]!r}? ' if near else ''}{listed}{', '.join(names) or 'none'}"


# packages that an extra brings, and the extra
_EXTRAS = {
    "torch": "torch",
    "kornia": "kornia",
    "distributed": "cluster",
    "h5py": "megadepth",
    **dict.fromkeys(("fastapi", "python_multipart", "starlette", "uvicorn"), "serve"),
}


def missing_extra(error: BaseException) -> str | None:
    """What to install where an import failed for want of a package that an extra brings."""
    package = (getattr(error, "name", None) or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or package not in _EXTRAS:
        return None
    return f'{package} is not installed: pip install "megloc-kapture[{_EXTRAS[package]}]"'
