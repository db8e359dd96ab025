"""Any checkpoint that can be read into a safetensors file, which every other tool reads safely."""

from __future__ import annotations

from pathlib import Path

from megloc_kapture.errors import DataError, OptionError, OutputError
from megloc_kapture.io.atomic import write_bytes
from megloc_kapture.io.weights import describe, read_weights, sha256_of

SOURCE_KEY = "source_sha256"


def convert_weights(source: Path, place: Path, *, force: bool = False) -> int:
    """Write all tensors of a checkpoint, with its sha256; the same file gives the same bytes.

    Parameters
    ----------
    source : the checkpoint; never changed. Names and layouts of its tensors are kept.
    place : the file to write, ``.safetensors``.
    force : replace a file that stands there.

    Returns
    -------
    int : the number of tensors.

    Raises
    ------
    DataError : it cannot be read safely.
    OptionError : the ending is another one.
    OutputError : a file stands there, or it cannot be written.
    """
    from safetensors.torch import save

    if place.suffix != ".safetensors":
        raise OptionError(f"{place}: the file to write must end in .safetensors")
    if place.exists() and not force:
        raise OutputError(f"{place}: stands there; -f replaces it")
    if not source.is_file():
        raise DataError("no such file", path=source)
    file = describe(source.name, source)
    # views of one memory are stored one by one
    tensors = {name: tensor.contiguous().clone() for name, tensor in read_weights(file).items()}
    # one key only: the library writes several in no fixed order
    write_bytes(place, save(tensors, {SOURCE_KEY: sha256_of(file)}))
    return len(tensors)
