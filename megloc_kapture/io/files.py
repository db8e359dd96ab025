"""File access: checked paths, atomic writes, links, JSON.

Files are written under a hidden temporary name and renamed, so that a killed run leaves either the
old file or the new one. They are not synced: fsync is too slow for thousands of small files.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import shutil
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from pydantic import BaseModel, ValidationError

from megloc_kapture.errors import DataError, MeglocError, OutputError, require

ModelT = TypeVar("ModelT", bound=BaseModel)


# ------------------------------------------------------------------------------------ reading


def read_content(path: Path | str) -> bytes:
    with reading(path):
        return Path(path).read_bytes()


def read_text(path: Path | str) -> str:
    """Return the text of a UTF-8 file without its byte order mark; line endings are kept."""
    content = read_content(path)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise DataError("not a text file in UTF-8", path=path, line=line) from error


@contextlib.contextmanager
def reading(path: Path | str | None, what: str = "") -> Iterator[None]:
    """Convert an error in the block to a DataError that names this file or folder.

    ``what`` is the expected content; without it, only an OSError is converted.
    """
    try:
        yield
    except FileNotFoundError as error:
        raise DataError("cannot read: the file is missing", path=path) from error
    except OSError as error:
        reason = "cannot read" if error.strerror or not what else f"not {what}, or broken"
        raise DataError(f"{reason}: {_text_of(error, path)}", path=path) from error
    except Exception as error:  # libraries raise many kinds of errors for broken files
        if not what or isinstance(error, MeglocError):
            raise
        raise DataError(f"not {what}, or broken: {_text_of(error, path)}", path=path) from error


def _text_of(error: Exception, path: Path | str | None) -> str:
    """Describe a failed download, or return an error's first sentence without object reprs."""
    if failed := failed_download(path or ""):
        return failed
    text = getattr(error, "strerror", None) or str(error)
    return " ".join(re.sub(r"<\S+ object at \S+>|[.;]\s.*", "", text, flags=re.S).split())


def failed_download(path: Path | str) -> str | None:
    """Describe an empty file, a Git LFS pointer or a web page in place of a file; else None."""
    with contextlib.suppress(OSError), open(path, "rb") as file:
        start = file.read(100).lstrip()
        if not start:
            return "the file is empty"
        if start.startswith(b"version https://git-lfs"):
            return "a Git LFS pointer; fetch the file with `git lfs pull`"
        if start.lower().startswith((b"<!doctype", b"<html")):
            return "a web page; download the file itself"
    return None


@contextlib.contextmanager
def named(
    path: Path | str | None = None, line: int | None = None, *, about: str = ""
) -> Iterator[None]:
    """Add file, line and subject to a DataError that names no file yet."""
    try:
        yield
    except DataError as error:
        if error.path is not None:
            raise
        message = f"{about}: {error.message}" if about else error.message
        raise DataError(message, path=path, line=line) from error.__cause__


# ------------------------------------------------------------------------------------ paths


def has_control_characters(text: str) -> bool:
    """Return whether a text has characters that are invalid in names and lines (NUL, tab, ...)."""
    return not text.isprintable() and any(
        ord(c) < 32 or ord(c) == 127 or 0xD800 <= ord(c) <= 0xDFFF for c in text
    )


@lru_cache(maxsize=1 << 12)
def check_relative(text: str) -> str:
    """Return ``text`` if it is a plain relative path (``a/b.jpg``); raise DataError if not."""
    require(text, "empty path")
    if "\\" in text or has_control_characters(text):
        raise DataError(f"backslash or control character in path {text!r}; separate folders by /")
    components = text.split("/")
    if text.startswith("/") or ".." in components:
        reason = "it begins with '/' or has '..'; names are relative to the folder of the images"
        raise DataError(f"path {text!r} leads out of its folder: {reason}")
    if "" in components or "." in components:
        raise DataError(f"path {text!r} has an empty or '.' component")
    return text


def check_component(text: str) -> str:
    """Return ``text`` if it is a valid type name: a single folder name and a single CSV field."""
    check_relative(text)
    if "/" in text or "," in text or text != text.strip():
        raise DataError(f"{text!r} cannot be a type name (slash, comma, leading or trailing space)")
    return text


def safe_join(root: Path, relative_text: str) -> Path:
    """Return ``root / relative_text`` after :func:`check_relative`."""
    return Path(root) / check_relative(relative_text)


# -------------------------------------------------------------------------------- temporary names


TEMPORARY = ".megloc-"  # prefix of temporary names, which all readers skip


def temporary_name() -> str:
    """Return an unused temporary name."""
    return f"{TEMPORARY}{secrets.token_hex(8)}.tmp"


def clear_temporary(folder: Path, *, nested: bool = True) -> None:
    """Remove unfinished files in a folder that nobody writes to and, if ``nested``, below it."""
    find = folder.rglob if nested else folder.glob
    for path in list(find(f"{TEMPORARY}*")):
        remove(path)


def remove(path: Path) -> None:
    """Remove a file, a link or a whole folder if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


# ------------------------------------------------------------------------------------ writing


def output_error(path: Path | str, error: OSError, *, remedy: str = "") -> OutputError:
    """Return the :class:`OutputError` for an ``OSError`` from writing ``path``."""
    reason = error.strerror or str(error) or type(error).__name__
    return OutputError(f"{path}: cannot write: {reason}{_broken_link(Path(path))}{remedy}")


@contextlib.contextmanager
def writing(path: Path | str) -> Iterator[None]:
    """Convert an ``OSError`` from writing ``path`` to an :class:`OutputError`."""
    try:
        yield
    except OSError as error:
        raise output_error(path, error) from error


@contextlib.contextmanager
def atomic_write(path: Path | str) -> Iterator[BinaryIO]:
    """Open a binary file that replaces ``path`` when the block succeeds; creates parent folders."""
    # no Path here: creating a Path takes as long as writing a small file
    folder = os.path.dirname(path)
    temporary = os.path.join(folder, temporary_name())
    try:
        if folder and not os.path.isdir(folder):
            os.makedirs(folder, exist_ok=True)
        try:
            # not mkstemp, whose files only their owner may read
            with open(temporary, "xb") as file:
                yield file
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
            raise
    except OSError as error:
        ours = {os.fspath(path), temporary, *map(os.fspath, Path(path).parents)}
        if error.filename is not None and os.fspath(error.filename) not in ours:
            raise  # the block failed to read another file
        raise output_error(path, error) from error


def write_bytes(path: Path | str, content: bytes) -> None:
    with atomic_write(path) as file:
        file.write(content)


# ------------------------------------------------------------------------------------ folders


def user_cache() -> Path:
    """Return the user's cache folder, which may not exist."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "megloc-kapture"


def find_near(root: Path, pattern: str) -> Iterator[Path]:
    """Find paths in ``root`` and in folders up to three levels below; ``root`` may be a disk."""
    for depth in range(4):
        yield from root.glob(f"{'*/' * depth}{pattern}")


# -------------------------------------------------------------------------------------- links


def link_as_text(path: Path) -> str:
    """Return a remark if ``path`` or a parent is a file in place of a folder, else ""."""
    file = next((folder for folder in (path, *path.parents) if folder.is_file()), None)
    if file is None:
        return ""
    return f"; {file} is a file, perhaps a link that git or zip stored as text: make it a folder"


def _broken_link(path: Path) -> str:
    with contextlib.suppress(OSError):
        for link in (path, *path.parents):
            if link.is_symlink() and not link.exists():
                return f"; {link} is a link to {os.readlink(link)}, which is missing"
    return ""


def similar_name(path: Path) -> str:
    """Return a remark on a missing file: a broken link, a folder, a similar name; or ""."""
    if broken := _broken_link(path):
        return broken

    def plain(name: str) -> str:
        return unicodedata.normalize("NFC", name).casefold()

    with contextlib.suppress(OSError):
        for name in os.listdir(path.parent):
            if name == path.name:
                return "; it is a folder" if path.is_dir() else ""
            if plain(name) == plain(path.name):
                return f"; {name!r} differs in case, or in how accents are encoded (macOS)"
    return ""


def link_images(
    source_root: Path,
    output_root: Path,
    folders: Sequence[str] = ("records_data", "masks"),
    *,
    below: str = "",
) -> None:
    """Link ``sensors/records_data`` and ``sensors/masks`` of the output to those of the source.

    With ``below``, the links have this name inside the output's two folders.
    """
    for name in folders:
        source = Path(source_root) / "sensors" / name
        if source.exists():
            link_file(source, Path(output_root) / "sensors" / name / below)


def link_records(output_root: Path, links: Mapping[str, Path]) -> None:
    """Link names below ``sensors/records_data`` (``""``: the folder itself) to their targets."""
    for name, target in links.items():
        link_file(target, Path(output_root) / "sensors" / "records_data" / name)


def link_file(source: Path, link: Path) -> None:
    """Link a file or folder in place of an older file or link."""
    with writing(link):
        link.parent.mkdir(parents=True, exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(Path(source).resolve())


def hard_link(source: Path, link: Path) -> None:
    """Hard-link a file, or copy it where the file system has no hard links."""
    with writing(link):
        link.parent.mkdir(parents=True, exist_ok=True)
        link.unlink(missing_ok=True)
        try:
            os.link(source, link)
        except OSError:  # another file system, or one without hard links
            shutil.copyfile(source, link)


# --------------------------------------------------------------------------------------- JSON


def read_json_model(path: Path | str, model: type[ModelT]) -> ModelT:
    """Read a JSON file as ``model``; errors name the field."""
    text = read_text(path)
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        raise DataError(first_problem(error), path=path) from error


def write_json_model(path: Path | str, model: BaseModel) -> None:
    """Write ``model`` as indented JSON, atomically and deterministically."""
    write_json(path, model.model_dump(mode="json"))


def write_json(path: Path | str, content: Any) -> None:
    """Write plain JSON data, indented, atomically; ValueError for NaN and infinity."""
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    write_bytes(path, f"{text}\n".encode())


def first_problem(error: ValidationError) -> str:
    """Return the first problem of a validation in one line: ``field: message``."""
    problem = error.errors(include_url=False)[0]
    field = ".".join(map(str, problem["loc"]))
    message = problem["msg"].removeprefix("Value error, ").replace("Input should", "it should")
    more = error.error_count() - 1
    return (f"{field}: " if field else "") + message + (f" (and {more} more)" if more else "")
