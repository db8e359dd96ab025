"""Weights of networks: checkpoints found, checked, read safely, shared, added and converted.

Their folder is MEGLOC_WEIGHTS, else ``megloc-kapture/weights`` in the user's cache. A file may lie
in it or in a folder of it, so that a collection sorted by network will do.

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
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from megloc_kapture.errors import DataError, OptionError, OutputError
from megloc_kapture.io.files import atomic_write, user_cache, write_bytes
from megloc_kapture.io.weights.containers import read_checkpoint
from megloc_kapture.io.weights.registry import (
    PublishedFile,
    Weights,
    by_file_name,
    by_sha256,
    lookup,
)
from megloc_kapture.io.weights.registry import registry as registered  # not to hide the module

if TYPE_CHECKING:
    import torch

FOLDER_VARIABLE = "MEGLOC_WEIGHTS"
SOURCE_KEY = "source_sha256"  # of a converted file's metadata
UNVERIFIED = "unverified"  # folder of files that a user has instead of the published ones
_shared_folder: Path | None = None


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
        known = registered().get(self.name)
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
    if name in registered():
        weights = registered()[name]
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
    with _reading(path):
        states = [part.stat() for part in _parts(path)]
    size = sum(state.st_size for state in states)
    return WeightsFile(name, path, size, max(state.st_mtime_ns for state in states))


@lru_cache(maxsize=256)
def sha256_of(file: WeightsFile) -> str:
    """sha256 of a checkpoint, hexadecimal; of a TensorFlow one, of its files one after another."""
    digest = hashlib.sha256()
    with _reading(file.path):
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
    with _reading(file.path):
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


def add_weights(
    source: Path, *, name: str | None = None, force: bool = False, unverified: bool = False
) -> WeightsFile:
    """Copy a file into the folder of weights under the name it is looked for by.

    Parameters
    ----------
    source : the file; never changed. Of a TensorFlow checkpoint its ``.index``.
    name : the network it is for; found out by the sha256 or the file's name unless given.
    force : replace a different file that stands there.
    unverified : take it though it is not the published file, e.g. one trained anew. It is kept in
        a folder of its own, ``unverified``, and is found where the published one is not there.

    Raises
    ------
    DataError : it cannot be read safely, or is not the published file.
    OptionError : what it is cannot be told.
    OutputError : a different file stands there, or it cannot be written.
    """
    if not source.is_file():
        raise DataError("no such file", path=source)
    found = describe(source.name, source)
    sha256 = sha256_of(found)
    weights, target = _recognised(source, sha256, name)
    expected = next((f for f in weights.files if f.name == target), None)
    prove(found, sha256, None if unverified else expected, weights)
    path = weights_folder() / (f"{UNVERIFIED}/{target}" if unverified else target)
    if path.exists() and not force:
        if sha256_of(describe(weights.name, path)) == sha256:
            return describe(weights.name, path)
        raise OutputError(f"{path}: a different file stands there; -f replaces it")
    # the index comes last: with it the checkpoint is there
    for part in reversed(found.parts()):
        ending = part.name.removeprefix(source.stem)
        beside = path if part == source else path.with_name(path.stem + ending)
        with open(part, "rb") as content, atomic_write(beside) as copy:
            shutil.copyfileobj(content, copy)
    return describe(weights.name, path)


def prove(
    file: WeightsFile, sha256: str, published: PublishedFile | None, weights: Weights
) -> None:
    """Raise DataError unless a file is what is published, or can be read safely.

    Parameters
    ----------
    sha256 : of the file.
    published : what it should be; None: converted, of which no checksum is known.
    """
    known = published and published.sha256
    if known and sha256 != known:
        raise DataError(
            f"is not the published {published.name if published else ''} of {weights.name}: "
            f"sha256 {sha256} instead of {known}",
            path=file.path,
        )
    read_weights(file)


def convert_weights(source: Path, output: Path, *, force: bool = False) -> int:
    """Write all tensors of a checkpoint, with its sha256, and return their number.

    The same file gives the same bytes.

    Parameters
    ----------
    source : the checkpoint; never changed. Names and layouts of its tensors are kept.
    output : the file to write, ``.safetensors``.
    force : replace a file that stands there.

    Raises
    ------
    DataError : it cannot be read safely.
    OptionError : the ending is another one.
    OutputError : a file stands there, or it cannot be written.
    """
    from safetensors.torch import save

    if output.suffix != ".safetensors":
        raise OptionError(f"{output}: the file to write must end in .safetensors")
    if output.exists() and not force:
        raise OutputError(f"{output}: stands there; -f replaces it")
    if not source.is_file():
        raise DataError("no such file", path=source)
    file = describe(source.name, source)
    # views of one memory are stored one by one
    tensors = {name: tensor.contiguous().clone() for name, tensor in read_weights(file).items()}
    # one key only: the library writes several in no fixed order
    write_bytes(output, save(tensors, {SOURCE_KEY: sha256_of(file)}))
    return len(tensors)


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise DataError(f"cannot read: {error.strerror or error}", path=path) from error


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


def _recognised(source: Path, sha256: str, name: str | None) -> tuple[Weights, str]:
    """The network, and the name the file gets."""
    if name is None:
        found = by_sha256(sha256) or by_file_name(source.name)
        if found is not None:
            return found[0], found[1].name
        if source.suffix == ".safetensors" and source.stem in registered():
            return registered()[source.stem], source.name
        raise OptionError(
            f"{source}: neither its sha256 nor its name is in the registry; say what it is with "
            "--name (megloc weights list)"
        )
    weights = lookup(name)
    if source.suffix == ".safetensors":
        return weights, weights.converted
    same = [file for file in weights.files if file.sha256 == sha256]
    named = [file for file in weights.files if source.name in file.names]
    alike = [file for file in weights.files if Path(file.name).suffix == source.suffix]
    for file in (*same, *named, *alike):
        return weights, file.name
    names = ", ".join(file.name for file in weights.files)
    raise OptionError(f"{source}: {name} is kept as {names} or {weights.converted}")
