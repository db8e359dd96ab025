"""A file of weights from anywhere into the folder of weights: recognised, proven, copied."""

from __future__ import annotations

import shutil
from pathlib import Path

from megloc_kapture.errors import DataError, OptionError, OutputError
from megloc_kapture.io.atomic import atomic_write
from megloc_kapture.io.weights import (
    UNVERIFIED,
    WeightsFile,
    describe,
    read_weights,
    sha256_of,
    weights_folder,
)
from megloc_kapture.io.weights_registry import (
    PublishedFile,
    Weights,
    by_file_name,
    by_sha256,
    lookup,
    registry,
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
    place = weights_folder() / (f"{UNVERIFIED}/{target}" if unverified else target)
    if place.exists() and not force:
        if sha256_of(describe(weights.name, place)) == sha256:
            return describe(weights.name, place)
        raise OutputError(f"{place}: a different file stands there; -f replaces it")
    # the index comes last: with it the checkpoint is there
    for part in reversed(found.parts()):
        ending = part.name.removeprefix(source.stem)
        beside = place if part == source else place.with_name(place.stem + ending)
        with open(part, "rb") as content, atomic_write(beside) as copy:
            shutil.copyfileobj(content, copy)
    return describe(weights.name, place)


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


def _recognised(source: Path, sha256: str, name: str | None) -> tuple[Weights, str]:
    """The network, and the name the file gets."""
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
