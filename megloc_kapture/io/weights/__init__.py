"""Network weights: the registry of published checkpoints and the folder that holds them.

``registry.toml`` lists each checkpoint's file, page, licence and sha256. The environment variable
MEGLOC_WEIGHTS names the folder; the default is ``megloc-kapture/weights`` in the user's cache.
Files of torch (read with ``weights_only=True``) and safetensors are supported;
``scripts/convert_weights.py`` converts other formats.
"""

from __future__ import annotations

import glob
import hashlib
import os
import re
import shutil
import tomllib
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from megloc_kapture.errors import (
    DataError,
    MeglocError,
    OptionError,
    OutputError,
    check_option,
    require,
    suggestion,
)
from megloc_kapture.io.files import (
    atomic_write,
    output_error,
    reading,
    user_cache,
    write_bytes,
)
from megloc_kapture.values import Options

if TYPE_CHECKING:
    import torch

FOLDER_VARIABLE = "MEGLOC_WEIGHTS"
UNVERIFIED = "unverified"  # subfolder of user files, used if the published file is missing
_REGISTRY = Path(__file__).with_name("registry.toml")
# keys under which training scripts keep the state dict
_STATE_KEYS = ("state_dict", "model_state_dict", "model_state", "model", "net", "extractor")
# prefixes from DataParallel, Lightning and torch.compile
_PREFIXES = re.compile(r"^(module\.|model\.|_orig_mod\.)+")


# ----------------------------------------------------------------------------------- registry


class PublishedFile(Options):
    """One published file of a network's weights; None where a value is unknown."""

    name: str  # in the folder of weights
    also: tuple[str, ...] = ()  # alternative names
    url: str | None = None  # None: must be downloaded by hand from the network's page
    size: int | None = None  # bytes
    sha256: str | None = None
    convert: bool = False  # needs scripts/convert_weights.py

    @property
    def names(self) -> tuple[str, ...]:
        return (self.name, *self.also)


class Weights(Options):
    """The checkpoint of one network."""

    name: str
    purpose: str
    page: str
    licence: str  # short name
    terms: str  # licence terms in plain words
    commercial: bool  # commercial use is plainly allowed
    files: tuple[PublishedFile, ...]  # preferred first
    unverified: str = ""  # facts not confirmed on the original file

    @property
    def converted(self) -> str:
        return f"{self.name}.safetensors"

    @property
    def to_fetch(self) -> PublishedFile | None:
        """The file that can be downloaded automatically."""
        return next((file for file in self.files if file.url), None)


@lru_cache(maxsize=1)
def registry() -> Mapping[str, Weights]:
    """Return all networks by name, in the order of ``registry.toml``."""
    table = tomllib.loads(_REGISTRY.read_text(encoding="utf-8"))
    return {name: Weights(name=name, **entry) for name, entry in table.items()}


def lookup(name: str) -> Weights:
    if name not in registry():
        hint = suggestion(name, registry(), listed="there are ")
        raise OptionError(f"no weights {name!r} in the registry; {hint}")
    return registry()[name]


# ------------------------------------------------------------------------------------ folder


class MissingWeightsError(DataError):
    """Missing checkpoints; the message has a line for each, with source and command to add it."""

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
    """A checkpoint on disk; hashable, to serve as a cache key."""

    name: str  # of the network in the registry, or of a user's file
    path: Path
    size: int  # bytes
    mtime_ns: int
    published: PublishedFile | None = None  # this must equal it; None: a user's or converted file


def weights_folder() -> Path:
    if folder := os.environ.get(FOLDER_VARIABLE):
        return Path(os.path.abspath(Path(folder).expanduser()))
    return user_cache() / "weights"


def find_weights(name: str) -> WeightsFile:
    """Find the checkpoint of a registered network, or a user's file by path."""
    if name in registry():
        file = next(files_of(registry()[name]), None)
        if file is None:
            raise MissingWeightsError(how_to_get(registry()[name]), names=[name])
        return file
    path = Path(name).expanduser()
    if not path.is_file():
        raise MissingWeightsError(
            f"{name!r} is neither a file nor a name in the registry (megloc weights list)"
        )
    return describe(path.name, path.absolute())


def find_all_weights(names: Sequence[str]) -> list[WeightsFile]:
    """Find several checkpoints; one MissingWeightsError names all missing ones."""
    files, missing = [], []
    for name in names:
        try:
            files.append(find_weights(name))
        except MissingWeightsError as error:
            missing.append(error)
    if missing:
        raise all_missing(missing)
    return files


def all_missing(errors: Iterable[MissingWeightsError]) -> MissingWeightsError:
    by_line = {line: None for error in errors for line in error.lines()}
    names = dict.fromkeys(name for error in errors for name in error.names)
    return MissingWeightsError("\n".join(by_line), names=list(names))


def files_of(weights: Weights) -> Iterator[WeightsFile]:
    """Yield a network's readable files, the preferred one first."""
    for published in weights.files:
        for path in () if published.convert else _in_folder(published.names):
            is_users = path.is_relative_to(weights_folder() / UNVERIFIED)
            yield describe(weights.name, path, None if is_users else published)
    for path in _in_folder([weights.converted]):
        yield describe(weights.name, path)


def to_convert(weights: Weights) -> Path | None:
    """Find a published file that is present but needs conversion."""
    return next(_in_folder([n for file in weights.files if file.convert for n in file.names]), None)


def _in_folder(names: Iterable[str]) -> Iterator[Path]:
    folder = weights_folder()
    for name in names:
        inside = folder.glob(f"*/{glob.escape(name)}") if folder.is_dir() else ()
        yield from (path for path in (folder / name, *sorted(inside)) if path.is_file())


def how_to_get(weights: Weights) -> str:
    """Return a one-line message: the missing checkpoint and how to get it."""
    names = " or ".join(file.name for file in weights.files)
    fetch = f"megloc weights fetch {weights.name}"
    if original := to_convert(weights):
        convert = how_to_convert(weights, original)
        return f"the weights {weights.name} must be converted once: {convert}"
    if weights.to_fetch is None:
        then = "megloc weights add FILE"
        if all(file.convert for file in weights.files):
            then = how_to_convert(weights, "FILE")
        how = f"download it from {weights.page} and run: {then}"
    elif weights.commercial:
        how = f"published at {weights.page}; run: {fetch}"
    else:
        how = f"published at {weights.page} ({weights.terms}); run: {fetch} --accept-licence"
    return f"the weights {weights.name} are missing: no {names} in {weights_folder()}; {how}"


def how_to_convert(weights: Weights, path: Path | str) -> str:
    return f"python scripts/convert_weights.py {weights.name} {path}"


def describe(name: str, path: Path, published: PublishedFile | None = None) -> WeightsFile:
    with reading(path):
        state = path.stat()
    return WeightsFile(name, path, state.st_size, state.st_mtime_ns, published)


@lru_cache(maxsize=256)
def sha256_of(file: WeightsFile) -> str:
    with reading(file.path), open(file.path, "rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


# ----------------------------------------------------------------------------------- reading


def read_weights(file: WeightsFile) -> dict[str, torch.Tensor]:
    """Read the tensors of a checkpoint by name, without prefixes such as ``module.``.

    No code in the file is executed. Files of ``torch.save`` are memory-mapped, so that the workers
    of one machine share the memory; ``nets.runtime.load_strictly`` recognises such tensors by
    ``is_shared_file`` and does not copy them.
    """
    _check_sha256(file)
    if _is_safetensors(file.path):
        from safetensors.torch import load_file

        with reading(file.path, "a safetensors file"):
            return _state_dict(load_file(file.path), file.path)
    mapped = zipfile.is_zipfile(file.path)  # torch's format since 1.6
    tensors = _state_dict(_load_torch(file.path, mapped), file.path)
    for tensor in tensors.values():
        tensor.is_shared_file = mapped  # type: ignore[attr-defined]
    return tensors


def _is_safetensors(path: Path) -> bool:
    """Return whether a file begins with the length of a JSON header and the header."""
    with reading(path), open(path, "rb") as file:
        return file.read(9)[8:] == b"{"


def _check_sha256(file: WeightsFile) -> None:
    published = file.published
    if published and published.sha256 and sha256_of(file) != published.sha256:
        raise DataError(
            f"is not the published {published.name} of {file.name}: sha256 {sha256_of(file)} "
            f"instead of {published.sha256}; fetch or add it again, or give your own file by its "
            "path",
            path=file.path,
        )


def _load_torch(path: Path, mapped: bool) -> Any:
    import numpy as np
    import torch

    # some training scripts store a numpy scalar with the weights (DeepLabV3+: best_score)
    scalar = np._core.multiarray.scalar  # type: ignore[attr-defined]
    names = ("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar")
    of_scores: list[Any] = [np.dtype, type(np.dtype("f4")), type(np.dtype("f8"))]
    of_scores += [(scalar, name) for name in names]
    what = "weights that torch or safetensors reads without running code (see docs/weights.md)"
    with reading(path, what), torch.serialization.safe_globals(of_scores):
        return torch.load(path, weights_only=True, map_location="cpu", mmap=mapped)


def _state_dict(content: Any, path: Path) -> dict[str, torch.Tensor]:
    import torch

    for key in _STATE_KEYS:
        if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
            content = content[key]
    items = content.items() if isinstance(content, Mapping) else ()
    tensors = {
        _PREFIXES.sub("", str(key)): value.detach()
        for key, value in items
        if isinstance(value, torch.Tensor)
    }
    require(tensors, "the file has no named tensors", path=path)
    return tensors


SOURCE_KEY = "source_sha256"  # in a converted file's metadata
_TIMEOUT_S, _CHUNK = 60.0, 1_000_000


Track = Callable[[Iterable[bytes], int, str], Iterable[bytes]]


def fetch(url: str, path: Path, *, sha256: str | None = None, track: Track | None = None) -> None:
    """Download a file to ``path``, where it appears once it is complete and verified.

    ``track`` shows the progress in chunks of 1 MB.
    """
    import pooch
    import requests

    def download(url: str, output: str, _: object) -> None:
        with (
            requests.get(url, stream=True, timeout=_TIMEOUT_S) as answer,
            open(output, "wb") as file,
        ):
            answer.raise_for_status()
            chunks: Iterable[bytes] = answer.iter_content(_CHUNK)
            if track is not None:
                size = int(answer.headers.get("content-length", 0))
                chunks = track(chunks, -(-size // _CHUNK), path.name)
            file.writelines(chunks)

    known = None if sha256 is None else f"sha256:{sha256}"
    pooch.get_logger().setLevel("WARNING")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        pooch.core.stream_download(url, path, known, download)
    except requests.exceptions.HTTPError as error:
        raise MeglocError(f"{url}: the server answers {error}") from error
    except requests.exceptions.RequestException as error:
        raise MeglocError(
            f"{url}: the transfer failed: {error}; without a network, download the file elsewhere "
            "and run: megloc weights add FILE"
        ) from error
    except ValueError as error:  # pooch: wrong sha256
        raise DataError(f"the download is not the published file: {error}", path=url) from error
    except OSError as error:
        remedy = f"; {FOLDER_VARIABLE} sets another folder of weights"
        raise output_error(path, error, remedy=remedy) from error


def add_weights(
    source: Path, *, name: str | None = None, force: bool = False, unverified: bool = False
) -> WeightsFile:
    """Copy a file into the folder of weights under its registered name.

    An ``unverified`` file may differ from the published one and is used only if that is absent.
    """
    sha256 = sha256_of(describe(source.name, source))
    weights, target = _recognised(source, sha256, name)
    expected = next((f for f in weights.files if f.name == target), None)
    if expected is not None and expected.convert:
        command = how_to_convert(weights, source)
        raise DataError(f"cannot be read as is; convert it once: {command}", path=source)
    published = None if unverified else expected
    read_weights(describe(weights.name, source, published))
    path = weights_folder() / (f"{UNVERIFIED}/{target}" if unverified else target)
    if path.exists() and not force:
        if sha256_of(describe(weights.name, path)) != sha256:
            raise OutputError(f"{path}: a different file exists; -f replaces it")
    else:
        with open(source, "rb") as content, atomic_write(path) as copy:
            shutil.copyfileobj(content, copy)
    return describe(weights.name, path, published)


def convert_weights(source: Path, output: Path, *, force: bool = False) -> int:
    """Convert a checkpoint to safetensors, its sha256 in the metadata; return the tensor count."""
    from safetensors.torch import save

    check_option(
        output.suffix == ".safetensors", f"{output}: the file to write must end in .safetensors"
    )
    if output.exists() and not force:
        raise OutputError(f"{output}: exists; -f replaces it")
    file = describe(source.name, source)
    # safetensors rejects tensors that share memory, so each is copied
    tensors = {name: tensor.contiguous().clone() for name, tensor in read_weights(file).items()}
    write_bytes(output, save(tensors, {SOURCE_KEY: sha256_of(file)}))
    return len(tensors)


def _recognised(source: Path, sha256: str, name: str | None) -> tuple[Weights, str]:
    """Return the network of a file, and the name under which the file is kept."""
    among = list(registry().values()) if name is None else [lookup(name)]
    is_converted = source.suffix == ".safetensors"
    if name is not None and is_converted:
        return among[0], among[0].converted
    files = [(weights, file) for weights in among for file in weights.files]
    rules: list[Callable[[PublishedFile], bool]] = [
        lambda file: file.sha256 == sha256,
        lambda file: source.name in [Path(path).name for path in file.names],
        lambda file: name is not None and Path(file.name).suffix == source.suffix,
    ]
    for fits in rules:
        for weights, file in files:
            if fits(file):
                return weights, file.name
    if is_converted and source.stem in registry():
        return registry()[source.stem], source.name
    if name is None:
        raise OptionError(
            f"{source}: neither its sha256 nor its name is in the registry; say what it is with "
            "--name (megloc weights list)"
        )
    kept_as = ", ".join(file.name for _, file in files)
    raise OptionError(f"{source}: its suffix is not that of {kept_as} or {among[0].converted}")
