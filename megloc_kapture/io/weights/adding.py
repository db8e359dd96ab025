"""Downloading weights, or adding them from a file."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from megloc_kapture.errors import DataError, MeglocError, OptionError, OutputError, require
from megloc_kapture.io.files import atomic_write, output_error, write_bytes
from megloc_kapture.io.weights import (
    UNVERIFIED,
    PublishedFile,
    Weights,
    WeightsFile,
    by_file_name,
    by_sha256,
    describe,
    how_to_convert,
    lookup,
    read_weights,
    registry,
    sha256_of,
    weights_folder,
)

SOURCE_KEY = "source_sha256"  # in a converted file's metadata
_TIMEOUT_S = 60.0


class TransferError(MeglocError):
    """An unreachable server, a refusal, or a broken transfer."""


def fetch(url: str, path: Path, *, sha256: str | None = None, progress: Any = None) -> None:
    """Download a file, named once complete and verified; ``progress`` has tqdm's interface."""
    import pooch
    import requests

    known = None if sha256 is None else f"sha256:{sha256}"
    downloader = pooch.HTTPDownloader(progressbar=progress or False, timeout=_TIMEOUT_S)
    pooch.get_logger().setLevel("WARNING")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        pooch.core.stream_download(url, path, known, downloader)
    except requests.exceptions.HTTPError as error:
        raise TransferError(f"{url}: the server answers {error}") from error
    except requests.exceptions.RequestException as error:
        raise TransferError(f"{url}: the transfer broke: {error}") from error
    except ValueError as error:  # pooch: wrong sha256
        raise DataError(f"the download is not the published file: {error}", path=url) from error
    except OSError as error:
        raise output_error(path, error) from error


def add_weights(
    source: Path, *, name: str | None = None, force: bool = False, unverified: bool = False
) -> WeightsFile:
    """Copy a file into the folder of weights under its registered name.

    An ``unverified`` file may differ from the published one, and is used where that is missing.
    """
    require(source.is_file(), "no such file", path=source)
    found = describe(source.name, source)
    sha256 = sha256_of(found)
    weights, target = _recognised(source, sha256, name)
    expected = next((f for f in weights.files if f.name == target), None)
    if expected is not None and expected.convert:
        command = how_to_convert(weights, source)
        raise DataError(f"is not read as it is; convert it once: {command}", path=source)
    prove(found, None if unverified else expected, weights)
    path = weights_folder() / (f"{UNVERIFIED}/{target}" if unverified else target)
    if path.exists() and not force:
        if sha256_of(describe(weights.name, path)) == sha256:
            return describe(weights.name, path)
        raise OutputError(f"{path}: a different file exists; -f replaces it")
    with open(source, "rb") as content, atomic_write(path) as copy:
        shutil.copyfileobj(content, copy)
    return describe(weights.name, path)


def prove(file: WeightsFile, published: PublishedFile | None, weights: Weights) -> None:
    """Raise DataError unless a file loads and has the published sha256, where known."""
    if published and published.sha256 and sha256_of(file) != published.sha256:
        raise DataError(
            f"is not the published {published.name} of {weights.name}: "
            f"sha256 {sha256_of(file)} instead of {published.sha256}",
            path=file.path,
        )
    read_weights(file)


def convert_weights(source: Path, output: Path, *, force: bool = False) -> int:
    """Convert a checkpoint to safetensors with its sha256; return the number of tensors."""
    from safetensors.torch import save

    if output.suffix != ".safetensors":
        raise OptionError(f"{output}: the file to write must end in .safetensors")
    if output.exists() and not force:
        raise OutputError(f"{output}: exists; -f replaces it")
    require(source.is_file(), "no such file", path=source)
    file = describe(source.name, source)
    # views of shared memory are stored separately
    tensors = {name: tensor.contiguous().clone() for name, tensor in read_weights(file).items()}
    write_bytes(output, save(tensors, {SOURCE_KEY: sha256_of(file)}))
    return len(tensors)


def _recognised(source: Path, sha256: str, name: str | None) -> tuple[Weights, str]:
    if name is None:
        found = by_sha256(sha256) or by_file_name(source.name)
        if found is not None:
            return found[0], found[1].name
        if source.suffix == ".safetensors" and source.stem in registry():
            return registry()[source.stem], source.name
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
