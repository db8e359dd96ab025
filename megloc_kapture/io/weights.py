"""Weights of networks: where a checkpoint lies, its sha256, and its tensors, read safely.

The folder of weights is MEGLOC_WEIGHTS, else ``megloc-kapture/weights`` in the user's cache. A
file may lie in it or in a folder of it, so that a collection sorted by network will do.
"""

from __future__ import annotations

import glob
import hashlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from megloc_kapture.errors import DataError
from megloc_kapture.io.checkpoints import read_checkpoint
from megloc_kapture.io.weights_registry import PublishedFile, Weights, registry

if TYPE_CHECKING:
    import torch

FOLDER_VARIABLE = "MEGLOC_WEIGHTS"
UNVERIFIED = "unverified"  # folder of files that a user has instead of the published ones


class MissingWeightsError(DataError):
    """A checkpoint is not there; says where it is published and the command that adds it."""


@dataclass(frozen=True)
class WeightsFile:
    """Where a checkpoint lies; hashable, so that a module can be kept for it.

    Attributes
    ----------
    name : the network in the registry, or the file's name where it is a user's own.
    path : the file; of a TensorFlow checkpoint its ``.index``.
    size, mtime_ns : of all its files: bytes, and the last change.
    """

    name: str
    path: Path
    size: int
    mtime_ns: int

    @property
    def published(self) -> PublishedFile | None:
        """The registry's file that it should be; None for a user's own and for converted ones."""
        known = registry().get(self.name)
        if known is None or self.path.is_relative_to(weights_folder() / UNVERIFIED):
            return None
        path = self.path.as_posix()
        files = (file for file in known.files if any(path.endswith("/" + n) for n in file.names))
        return next(files, None)

    def parts(self) -> list[Path]:
        """Its files: the path, and the data of a TensorFlow checkpoint, which lie beside it."""
        return _parts(self.path)


def weights_folder() -> Path:
    """The folder of weights; it need not be there."""
    if place := os.environ.get(FOLDER_VARIABLE):
        return Path(os.path.abspath(Path(place).expanduser()))
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "megloc-kapture" / "weights"


def find_weights(name: str) -> WeightsFile:
    """The checkpoint of a network of the registry, or a user's own by its path.

    Raises
    ------
    MissingWeightsError : it is not there; names the file, its place and the command to add it.
    DataError : a link in the folder of weights leads out of it.
    """
    if name in registry():
        weights = registry()[name]
        path = next(places(weights), None)
        if path is None:
            raise MissingWeightsError(how_to_get(weights))
        return describe(weights.name, path)
    path = Path(name).expanduser()
    if not path.is_file():
        raise MissingWeightsError(
            f"{name!r} is neither a file nor a name in the registry (megloc weights list)"
        )
    return describe(path.name, path.absolute())


def find_all_weights(names: Sequence[str]) -> list[WeightsFile]:
    """The checkpoints of a network that needs several, in order.

    Raises
    ------
    MissingWeightsError : says of all that are not there how to get them, a line each.
    DataError : see :func:`find_weights`.
    """
    found, missing = [], []
    for name in names:
        try:
            found.append(find_weights(name))
        except MissingWeightsError as error:
            missing.append(str(error))
    if missing:
        raise MissingWeightsError("\n".join(missing))
    return found


def places(weights: Weights) -> Iterator[Path]:
    """Where files of a network lie in the folder of weights, the preferred one first."""
    folder = weights_folder()
    names = [name for file in weights.files for name in file.names]
    for name in (*names, weights.converted):
        inside = folder.glob(f"*/{glob.escape(name)}") if folder.is_dir() else ()
        for path in (folder / name, *sorted(inside)):
            if path.is_file():
                yield _in_folder(folder, path)


def how_to_get(weights: Weights) -> str:
    """What is missing and how a person gets it, in one line."""
    names = " or ".join(file.name for file in weights.files)
    fetch = f"megloc weights fetch {weights.name}"
    if weights.to_fetch is None:
        how = f"download it from {weights.page} and run: megloc weights add FILE"
    elif weights.commercial:
        how = f"published at {weights.page}; run: {fetch}"
    else:
        how = f"published at {weights.page} ({weights.terms}); run: {fetch} --accept-licence"
    return f"the weights {weights.name} are missing: no {names} in {weights_folder()}; {how}"


def describe(name: str, path: Path) -> WeightsFile:
    """What a checkpoint at a path is now."""
    try:
        states = [part.stat() for part in _parts(path)]
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror or error}", path=path) from error
    size = sum(state.st_size for state in states)
    return WeightsFile(name, path, size, max(state.st_mtime_ns for state in states))


@lru_cache(maxsize=256)
def sha256_of(file: WeightsFile) -> str:
    """sha256 of a checkpoint, hexadecimal; of a TensorFlow one, of its files one after another."""
    digest = hashlib.sha256()
    try:
        for part in file.parts():
            with open(part, "rb") as content:
                while block := content.read(1 << 20):
                    digest.update(block)
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror or error}", path=file.path) from error
    return digest.hexdigest()


def read_weights(file: WeightsFile) -> dict[str, torch.Tensor]:
    """All tensors of a checkpoint by name, on the processor; no code of the file is run.

    Every file is read once, and what is loaded is what the checksum was taken of.

    Raises
    ------
    DataError : it cannot be read, is damaged, holds objects that are never loaded, or its sha256
        is not the one that the registry knows; names the file.
    """
    try:
        contents = {part: part.read_bytes() for part in file.parts()}
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror or error}", path=file.path) from error
    digest = hashlib.sha256()
    for content in contents.values():
        digest.update(content)
    check_sha256(file, digest.hexdigest())

    def read_beside(ending: str) -> bytes:
        beside = file.path.with_name(file.path.stem + ending)
        if beside not in contents:
            raise DataError("no such file, though the index beside it names it", path=beside)
        return contents[beside]

    return read_checkpoint(contents[file.path], str(file.path), read_beside)


def check_sha256(file: WeightsFile, found: str) -> None:
    """Raise DataError, which names both, where the registry knows another checksum."""
    known = file.published and file.published.sha256
    if known and known != found:
        raise DataError(
            f"is not the published file of {file.name}: sha256 {found} instead of {known}; "
            "fetch or add it again, or give your own file by its path",
            path=file.path,
        )


def _parts(path: Path) -> list[Path]:
    if path.suffix != ".index":
        return [path]
    return [path, *sorted(path.parent.glob(f"{glob.escape(path.stem)}.data-*-of-*"))]


def _in_folder(folder: Path, path: Path) -> Path:
    real, root = os.path.realpath(path), os.path.realpath(folder)
    if not Path(real).is_relative_to(root):
        raise DataError(
            f"is or lies behind a link that leaves {folder}; give the file by its own path",
            path=path,
        )
    return path
