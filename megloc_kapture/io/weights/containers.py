"""Tensors out of every container that checkpoints are published in; nothing of a file is ever run.

A pickle is a program. What torch saves is read by torch's restricted reader, which builds tensors
and plain containers and refuses everything else; ``pickle`` itself is used nowhere.
"""

from __future__ import annotations

import contextlib
import io
import re
import tarfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError, MeglocError, OptionError
from megloc_kapture.io.files import named

if TYPE_CHECKING:
    import torch

CONVERTER = "docs/weights.md, section 'Checkpoints with foreign objects'"
_INDEX = ".index"
_TAR_MAGIC = slice(257, 262)
# under these keys training scripts keep the state dict
_STATE_KEYS = ("state_dict", "model_state", "model")


def read_checkpoint(
    content: bytes, where: str, read_beside: Callable[[str], bytes]
) -> dict[str, torch.Tensor]:
    """All tensors of a checkpoint by name, on the processor.

    Names are without the prefix ``module.`` of parallel training.

    Parameters
    ----------
    content : the file's bytes: of torch (also with ``state_dict``, ``model_state`` or ``model`` in
        it), safetensors, npz, ONNX (initialisers), MATLAB's ``.mat`` of NetVLAD, TensorFlow's
        ``.index``, or a tar of the latter.
    where : the file; its ending says what it is, save for tars and torch's files.
    read_beside : content of the file beside it whose name ends otherwise than in
        ``.index``.

    Raises
    ------
    DataError : no container of these, broken, or holds objects that are never loaded; names the
        file.
    OptionError : an ONNX file, and the package onnx is not installed.
    """
    ending = PurePath(where).suffix.lower()
    with named(where):
        if ending == ".mat":
            from megloc_kapture.io.weights.authors import read_matlab_netvlad

            return read_matlab_netvlad(content)
        if ending == ".safetensors":
            return _state_dict(_safetensors(content))
        if ending == ".npz":
            return _of_arrays(_npz(content))
        if ending == ".onnx":
            return _of_arrays(_onnx(content, where))
        if ending == _INDEX:
            from megloc_kapture.io.weights.tensorflow import read_tensor_bundle

            return _of_arrays(read_tensor_bundle(content, read_beside, where))
        if content[_TAR_MAGIC] == b"ustar" or content[:2] == b"\x1f\x8b":
            return _of_arrays(_tar(content, where))
        return _torch(content)


@contextlib.contextmanager
def _readable(kind: str) -> Iterator[None]:
    """Make a DataError of whatever the libraries raise for broken bytes: each has its own."""
    try:
        yield
    except MeglocError:
        raise
    except Exception as error:
        problem = str(error).partition("\n")[0] or type(error).__name__
        raise DataError(f"not {kind} that can be read: {problem}") from error


def _check_unpacked(size: int, content: bytes) -> None:
    """Weights hardly shrink: refuse what says that it is very much larger when it is unpacked."""
    if size > 8 * len(content) + (1 << 26):
        raise DataError(f"{len(content)} bytes that unpack to {size} at least are no weights")


def _check_zip(content: bytes) -> None:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        _check_unpacked(sum(member.file_size for member in archive.infolist()), content)


def _torch(content: bytes) -> dict[str, torch.Tensor]:
    from pickle import UnpicklingError  # the error that torch raises

    import torch

    from megloc_kapture.io.weights.authors import holds_pca, stand_ins, tensors_beside

    is_apgem = holds_pca(content)
    try:
        if content.startswith(b"PK"):
            _check_zip(content)
        with torch.serialization.safe_globals(stand_ins(pca=is_apgem)):
            found = torch.load(io.BytesIO(content), weights_only=True, map_location="cpu")
    except DataError:
        raise
    except Exception as error:  # torch's reader raises what it likes for broken bytes
        foreign = sorted(set(re.findall(r"GLOBAL ([\w.]+)", str(error))))
        if isinstance(error, UnpicklingError) and foreign:
            raise DataError(
                f"holds objects that are never loaded ({', '.join(foreign)}), because loading "
                f"them runs code; convert it once, as {CONVERTER} says"
            ) from error
        raise DataError(
            "no file of weights that can be read (torch, safetensors, npz, ONNX, TensorFlow), "
            "or it is damaged"
        ) from error
    tensors = _state_dict(found)
    if is_apgem and isinstance(found, Mapping):
        tensors |= tensors_beside(found)
    return tensors


def _state_dict(found: Any) -> dict[str, torch.Tensor]:
    import torch

    for key in _STATE_KEYS:
        if isinstance(found, Mapping) and isinstance(found.get(key), Mapping):
            found = found[key]
    tensors: dict[str, torch.Tensor] = {}
    for key, value in found.items() if isinstance(found, Mapping) else ():
        if isinstance(value, torch.Tensor):
            name = str(key).removeprefix("module.")
            if name in tensors:
                raise DataError(f"{name} is in it twice, with and without 'module.'")
            tensors[name] = value.detach()
    if not tensors:
        raise DataError("holds no tensors by name")
    return tensors


def _safetensors(content: bytes) -> dict[str, torch.Tensor]:
    from safetensors.torch import load

    with _readable("a safetensors file"):
        return load(content)


def _npz(content: bytes) -> dict[str, NDArray[Any]]:
    with _readable("an npz file"):
        _check_zip(content)
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            found = {name: arrays[name] for name in arrays.files}
    # a member that is no array comes as its bytes
    return {name: array for name, array in found.items() if isinstance(array, np.ndarray)}


def _onnx(content: bytes, where: str) -> dict[str, NDArray[Any]]:
    """The initialisers of an ONNX model; bfloat16 becomes float32, which is exact."""
    try:
        from onnx import TensorProto, load_model_from_string, numpy_helper
    except ImportError as error:
        raise OptionError(
            f"{where}: to read ONNX files, install the package onnx: "
            "pip install 'megloc-kapture[convert]'"
        ) from error
    found: dict[str, NDArray[Any]] = {}
    with _readable("an ONNX file"):
        model = load_model_from_string(content)
        if not model.HasField("graph"):
            raise ValueError("no graph in it")
        if model.graph.sparse_initializer:
            raise ValueError("sparse initialisers are not supported")
        for tensor in model.graph.initializer:
            if tensor.data_location == TensorProto.EXTERNAL:
                raise ValueError(f"the weights {tensor.name!r} lie in another file")
            if tensor.name in found:
                raise ValueError(f"two initialisers {tensor.name!r}")
            if tensor.data_type in (TensorProto.UNDEFINED, TensorProto.STRING):
                raise ValueError(f"initialiser {tensor.name!r} is no array of numbers")
            if any(size < 0 for size in tensor.dims):  # numpy would guess the size
                raise ValueError(f"initialiser {tensor.name!r} of shape {list(tensor.dims)}")
            try:
                array = numpy_helper.to_array(tensor)
            except ValueError as error:
                raise ValueError(f"initialiser {tensor.name!r}: {error}") from error
            widened = tensor.data_type == TensorProto.BFLOAT16
            found[tensor.name] = array.astype(np.float32) if widened else array
    return found


def _tar(content: bytes, where: str) -> dict[str, NDArray[Any]]:
    """The TensorFlow checkpoint in a tar; its members are read in memory, nothing is unpacked."""
    from megloc_kapture.io.weights.tensorflow import read_tensor_bundle

    with (
        _readable("a tar file"),  # of gz, bz2 and xz, tarfile tells each
        tarfile.open(fileobj=io.BytesIO(content)) as archive,
    ):
        members = {}
        for member in archive:
            _check_unpacked(member.offset_data + member.size, content)
            if member.isreg():
                members[member.name] = member
        # a Mac adds ._NAME beside each NAME
        stems = [
            name.removesuffix(_INDEX)
            for name in sorted(members)
            if name.endswith(_INDEX) and not PurePath(name).name.startswith("._")
        ]
        if len(stems) != 1:
            some = f": {', '.join(stems)}" if stems else ""
            raise DataError(f"{len(stems)} TensorFlow checkpoints (X.index) in it, not one{some}")

        def read(ending: str) -> bytes:
            member = members.get(stems[0] + ending)
            file = None if member is None else archive.extractfile(member)
            if file is None:
                raise DataError(f"no {stems[0]}{ending} in it")
            return file.read()

        return read_tensor_bundle(read(_INDEX), read, f"{where}/{stems[0]}{_INDEX}")


def _of_arrays(arrays: Mapping[str, NDArray[Any]]) -> dict[str, torch.Tensor]:
    import torch

    try:
        # torch wants the machine's byte order, and memory that it may write to
        tensors = {
            name: torch.from_numpy(np.array(a, dtype=a.dtype.newbyteorder("="), order="C"))
            for name, a in arrays.items()
        }
    except TypeError as error:
        raise DataError(f"holds arrays that are no numbers: {error}") from error
    return _state_dict(tensors)
