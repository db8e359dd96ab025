"""Weights of networks: what is published, checkpoints found, checked, read safely and shared.

The registry, ``registry.toml`` beside this file, says of each network's published checkpoints the
file, page, licence and sha256. Checkpoints lie in the folder of MEGLOC_WEIGHTS, else
``megloc-kapture/weights`` in the user's cache, or in a folder of it, so that a collection sorted by
network will do.

Processes of a machine share what they read: the first of them writes the tensors into a folder of
the run; it and the others map that file into memory. What is mapped is the system's cache of the
file, which is there once, and is not counted against a process. Kept is what was read and checked,
so that a file of the user may change meanwhile.
"""

from __future__ import annotations

import fcntl
import glob
import hashlib
import os
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints

from megloc_kapture.errors import DataError, OptionError, OutputError, suggestion
from megloc_kapture.io.files import (
    atomic_write,
    check_component,
    check_relative,
    reading,
    user_cache,
)
from megloc_kapture.io.weights.containers import read_checkpoint

if TYPE_CHECKING:
    import torch

FOLDER_VARIABLE = "MEGLOC_WEIGHTS"
UNVERIFIED = "unverified"  # folder of files that a user has instead of the published ones
_shared_folder: Path | None = None
_REGISTRY = Path(__file__).with_name("registry.toml")
_Url = Annotated[str, StringConstraints(pattern=r"^https?://[\w.:-]+/\S*$")]
_Text = Annotated[str, StringConstraints(min_length=1)]
_FileName = Annotated[str, AfterValidator(check_relative)]


# ----------------------------------------------------------------------------------- registry


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class PublishedFile(_Entry):
    """One file that a network's weights are published in.

    Attributes
    ----------
    name : where it lies in the folder of weights.
    also : other names under which other tools keep the same file.
    url : where it can be fetched; None: only a person can, from the network's page.
    size : bytes; None: not known.
    sha256 : hexadecimal; None: not known.
    """

    name: _FileName
    also: tuple[_FileName, ...] = ()
    url: _Url | None = None
    size: Annotated[int, Field(gt=0)] | None = None
    sha256: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """All names that the file may have."""
        return (self.name, *self.also)


class Weights(_Entry):
    """The checkpoint of one network.

    Attributes
    ----------
    purpose : what the network does.
    page : where a person finds it.
    licence, terms : its short name, and what one may do in plain words.
    commercial : whether commercial use is plainly allowed.
    files : alternatives, preferred first; any one is enough.
    unverified : what nobody has confirmed on the original file; empty: nothing.
    """

    name: Annotated[str, AfterValidator(check_component)]
    purpose: _Text
    page: _Url
    licence: _Text
    terms: _Text
    commercial: bool
    files: Annotated[tuple[PublishedFile, ...], Field(min_length=1)]
    unverified: str = ""

    @property
    def converted(self) -> str:
        """Name of the file that ``megloc weights convert`` makes of any of them."""
        return f"{self.name}.safetensors"

    @property
    def to_fetch(self) -> PublishedFile | None:
        """The file that a program can fetch."""
        return next((file for file in self.files if file.url), None)


@lru_cache(maxsize=1)
def registry() -> Mapping[str, Weights]:
    """All networks by name, in the order they are listed in."""
    table = tomllib.loads(_REGISTRY.read_text(encoding="utf-8"))
    return MappingProxyType({name: Weights(name=name, **entry) for name, entry in table.items()})


def lookup(name: str) -> Weights:
    """The entry of a network; raises OptionError, which lists the names there are."""
    if name not in registry():
        told = suggestion(name, registry(), listed="there are ")
        raise OptionError(f"no weights {name!r} in the registry; {told}")
    return registry()[name]


def by_sha256(sha256: str) -> tuple[Weights, PublishedFile] | None:
    """The network and file of a checksum."""
    return next((found for found in _all_files() if found[1].sha256 == sha256), None)


def by_file_name(name: str) -> tuple[Weights, PublishedFile] | None:
    """The network and file of a name without folders."""
    for weights, file in _all_files():
        if name in [path.rpartition("/")[2] for path in file.names]:
            return weights, file
    return None


def _all_files() -> list[tuple[Weights, PublishedFile]]:
    return [(weights, file) for weights in registry().values() for file in weights.files]


# ------------------------------------------------------------------------------------ folder


class MissingWeightsError(DataError):
    """Checkpoints are not there; says where each is published and the command that adds it.

    Attributes
    ----------
    names : the networks in the registry.
    """

    def __init__(
        self,
        message: str,
        *,
        names: Sequence[str] = (),
        path: Path | str | None = None,
        line: int | None = None,
    ) -> None:
        super().__init__(message, path=path, line=line)
        self.names = tuple(names)

    def lines(self) -> list[str]:
        return str(self).splitlines()


@dataclass(frozen=True)
class WeightsFile:
    """A checkpoint on disk; hashable, so that a module can be kept for it.

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
    if folder := os.environ.get(FOLDER_VARIABLE):
        return Path(os.path.abspath(Path(folder).expanduser()))
    return user_cache() / "weights"


def find_weights(name: str) -> WeightsFile:
    """The checkpoint of a network of the registry, or a user's own by its path.

    Raises
    ------
    MissingWeightsError : it is not there; names the file, its folder and the command to add it.
    DataError : a link in the folder of weights leads out of it.
    """
    if name in registry():
        weights = registry()[name]
        path = next(files_of(weights), None)
        if path is None:
            raise MissingWeightsError(how_to_get(weights), names=[name])
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
            missing.append(error)
    if missing:
        raise all_missing(missing)
    return found


def all_missing(errors: Iterable[MissingWeightsError]) -> MissingWeightsError:
    """One error for several, each told once, a line each."""
    by_line = {line: None for error in errors for line in error.lines()}
    names = dict.fromkeys(name for error in errors for name in error.names)
    return MissingWeightsError("\n".join(by_line), names=list(names))


def files_of(weights: Weights) -> Iterator[Path]:
    """Files of a network in the folder of weights, the preferred one first."""
    folder = weights_folder()
    names = [name for file in weights.files for name in file.names]
    for name in (*names, weights.converted):
        inside = folder.glob(f"*/{glob.escape(name)}") if folder.is_dir() else ()
        for path in (folder / name, *sorted(inside)):
            if path.is_file():
                yield _in_folder(folder, path)


def how_to_get(weights: Weights) -> str:
    """One line for people: what is missing and how to get it."""
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
    """The checkpoint at a path, as it is now."""
    with reading(path):
        states = [part.stat() for part in _parts(path)]
    size = sum(state.st_size for state in states)
    return WeightsFile(name, path, size, max(state.st_mtime_ns for state in states))


@lru_cache(maxsize=256)
def sha256_of(file: WeightsFile) -> str:
    """sha256 of a checkpoint, hexadecimal; of a TensorFlow one, of its files one after another."""
    digest = hashlib.sha256()
    with reading(file.path):
        for part in file.parts():
            with open(part, "rb") as content:
                hashlib.file_digest(content, lambda: digest)
    return digest.hexdigest()


def read_weights(file: WeightsFile) -> dict[str, torch.Tensor]:
    """All tensors of a checkpoint by name, on the processor; no code of the file is run.

    Every file is read once, and what is loaded is what the checksum was taken of. Processes that
    :func:`share_weights` are the first of them to read it or have the tensors that the first read.

    Raises DataError: it cannot be read, is damaged, holds objects that are never loaded, or its
    sha256 is not the one that the registry knows; names the file.
    """
    return _shared_tensors(file, partial(_read, file))


def _read(file: WeightsFile) -> dict[str, torch.Tensor]:
    with reading(file.path):
        contents = {part: part.read_bytes() for part in file.parts()}
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


def share_weights(folder: Path | None) -> None:
    """Let this process share what it reads with the others that are told the same folder."""
    global _shared_folder
    _shared_folder = folder


def _shared_tensors(
    key: object, read: Callable[[], dict[str, torch.Tensor]]
) -> dict[str, torch.Tensor]:
    """Tensors by name, of a file that the first process wrote; without a folder what is read.

    ``key`` tells checkpoints apart; it is equal in all processes.
    """
    if _shared_folder is None:
        return read()
    import torch

    path = _shared_folder / f"weights-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}"
    found: dict[str, torch.Tensor] = {}
    try:
        with open(path.with_suffix(".lock"), "wb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # the others wait for the first
            if not path.is_file():
                found = read()
                with atomic_write(path) as file:
                    torch.save({name: _whole(tensor) for name, tensor in found.items()}, file)
    except (OSError, OutputError, RuntimeError):  # torch's, too, where there is no room
        with suppress(OSError):
            path.unlink()
        return found or read()
    found = torch.load(path, mmap=True, weights_only=True)
    for tensor in found.values():  # ``load_strictly`` takes the memory as it is
        tensor.is_shared_file = True  # type: ignore[attr-defined]
    return found


def _whole(tensor: torch.Tensor) -> torch.Tensor:
    """Not a view, which would be written with all that it is a part of."""
    if tensor.is_contiguous() and tensor.untyped_storage().nbytes() == tensor.nbytes:
        return tensor
    return tensor.contiguous().clone()


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
