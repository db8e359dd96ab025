"""Many small binary files ("blobs"), by path below a folder, as files or in one tar."""

from __future__ import annotations

import os
import tarfile
from pathlib import Path
from typing import Self, TypeAlias

from megloc_kapture.errors import DataError
from megloc_kapture.io.files import check_relative, named, reading, safe_join, write_bytes


class FolderBlobs:
    """Blobs as files below ``folder`` with the given suffix."""

    def __init__(self, folder: Path, suffix: str) -> None:
        self._folder, self._suffix = folder, suffix

    def names(self) -> list[str]:
        found = []
        for folder, _, files in os.walk(self._folder):
            below = folder[len(str(self._folder)) :].lstrip("/")
            prefix = f"{below}/" if below else ""
            found += [prefix + name for name in files if name.endswith(self._suffix)]
        return sorted(found)

    def __contains__(self, name: str) -> bool:
        try:
            return os.path.isfile(f"{self._folder}/{check_relative(name)}")
        except DataError:
            return False

    def size(self, name: str) -> int:
        path = safe_join(self._folder, name)
        with reading(path):
            return path.stat().st_size

    def read(self, name: str) -> bytes:
        path = f"{self._folder}/{check_relative(name)}"  # much faster than a Path
        with reading(path), open(path, "rb", buffering=0) as file:
            return file.readall()

    def where(self, name: str) -> str:
        return str(self._folder / name)


class TarBlobs:
    """Blobs in an uncompressed tar, kapture's form for large sets; thread-safe."""

    def __init__(self, path: Path, suffix: str) -> None:
        self._path = path
        self._index: dict[str, tuple[int, int]] = {}
        if path.stat().st_size == 0:
            return  # kapture creates an empty tar by touch
        try:
            with named(path), tarfile.open(path, "r:") as tar:
                for member in tar:
                    if member.isreg() and member.name.endswith(suffix):
                        name = check_relative(member.name.removeprefix("./"))
                        self._index[name] = (member.offset_data, member.size)
        except (tarfile.TarError, OSError, ValueError) as error:
            raise DataError(f"not a readable uncompressed tar ({error})", path=path) from error

    def names(self) -> list[str]:
        return sorted(self._index)

    def __contains__(self, name: str) -> bool:
        return name in self._index

    def size(self, name: str) -> int:
        return self._index[name][1]

    def read(self, name: str) -> bytes:
        offset, size = self._index[name]
        with reading(self._path), open(self._path, "rb", buffering=0) as file:
            content = os.pread(file.fileno(), size, offset)
        if len(content) < size:
            raise DataError(f"truncated at member {name!r}", path=self._path)
        return content

    def where(self, name: str) -> str:
        return f"{self._path}[{name}]"


BlobSource: TypeAlias = FolderBlobs | TarBlobs


class BlobWriter:
    """Atomic writer of blobs below a folder; a context manager."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def has(self, name: str) -> bool:
        return safe_join(self._folder, name).is_file()

    def put(self, name: str, content: bytes) -> Path:
        path = safe_join(self._folder, name)
        write_bytes(path, content)
        return path

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass
