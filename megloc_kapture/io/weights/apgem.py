"""AP-GeM's checkpoints: what they keep beside the weights, without running any of their code.

The authors' files (naver/deep-image-retrieval) hold, beside the state dict, objects of
scikit-learn's PCA by name, the mean and deviation of the images, and the options of the network.
An object in a pickle is a class's name and a state; here every such name stands for a class of
this module, which keeps the state and does nothing. Arrays are made of their type, shape and bytes
by this module too, so that no bytes of the file reach numpy's own unpickling.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError

if TYPE_CHECKING:
    import torch

# scikit-learn renamed the module in version 0.22; the first of these is what the files say
_PCA_NAMES = ("sklearn.decomposition.pca.PCA", "sklearn.decomposition._pca.PCA")
_CORE_NAMES = ("numpy.core.multiarray", "numpy._core.multiarray")
_ARRAY_PARTS = ("mean", "components", "explained_variance")
_ARCHITECTURES = ("resnet50_rmac", "resnet101_rmac")
_NUMBERS = frozenset({"f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1"})


def holds_pca(content: bytes) -> bool:
    """True for a file of torch that names scikit-learn's PCA (its pickle is never compressed)."""
    return b"sklearn.decomposition" in content


def stand_ins() -> list[Any]:
    """Classes that torch's restricted reader may build for the names of such a file."""
    names: list[tuple[type, str]] = [(_Pca, name) for name in _PCA_NAMES]
    names += [(_Array, f"{core}._reconstruct") for core in _CORE_NAMES]
    names += [(_Scalar, f"{core}.scalar") for core in _CORE_NAMES]
    return [*names, (_ArrayClass, "numpy.ndarray"), (_DataType, "numpy.dtype")]


def tensors_beside(found: Mapping[str, Any], where: str) -> dict[str, torch.Tensor]:
    """Tensors that the network needs beside its weights, by names that no state dict has.

    ``pca.NAME.mean``, ``.components``, ``.explained_variance`` and ``.whiten`` for each PCA;
    ``preprocess.mean`` and ``preprocess.std``; ``model_options.norm_features``.

    Parameters
    ----------
    found : the checkpoint as torch read it with :func:`stand_ins`.
    where : the file, for messages.

    Raises
    ------
    DataError : a part has another structure, or the options are those of a network that is not
        supported.
    """
    beside: dict[str, torch.Tensor] = {}
    whitenings = found.get("pca") or {}
    if not isinstance(whitenings, Mapping):
        raise DataError("its pca is no table of PCA objects by name", path=where)
    for name, pca in whitenings.items():
        if not isinstance(pca, _Pca) or not isinstance(name, str) or "." in name:
            raise DataError(f"its pca has {name!r}, which is no PCA object by a name", path=where)
        for part in _ARRAY_PARTS:
            values = _numbers(pca.state.get(f"{part}_"), f"pca {name} {part}_", where)
            beside[f"pca.{name}.{part}"] = _tensor(values)
        beside[f"pca.{name}.whiten"] = _tensor(np.array(bool(pca.state.get("whiten"))))
    preprocess = found.get("preprocess")
    if isinstance(preprocess, Mapping):
        for part in sorted({"mean", "std"} & set(preprocess)):
            values = _numbers(preprocess[part], f"preprocess {part}", where)
            beside[f"preprocess.{part}"] = _tensor(values)
    options = found.get("model_options")
    if isinstance(options, Mapping):
        _check_options(options, where)
        beside["model_options.norm_features"] = _tensor(
            np.array(bool(options.get("norm_features")))
        )
    return beside


def _check_options(options: Mapping[str, Any], where: str) -> None:
    """Refuse a network that the keys of the weights alone would not tell apart from ours."""
    arch, pooling = options.get("arch"), options.get("pooling", "gem")
    wrong = [
        (arch not in _ARCHITECTURES, f"arch={arch!r}, not one of {', '.join(_ARCHITECTURES)}"),
        (not str(pooling).startswith("gem"), f"pooling={pooling!r}, not gem"),
        (bool(options.get("center_bias")), f"center_bias={options.get('center_bias')!r}, not 0"),
        (bool(options.get("without_fc")), "without_fc"),
    ]
    if told := [text for is_wrong, text in wrong if is_wrong]:
        raise DataError(f"its model_options are not supported: {'; '.join(told)}", path=where)


def _numbers(value: object, what: str, where: str) -> NDArray[Any]:
    if isinstance(value, _Array) and value.values is not None:
        return value.values
    if isinstance(value, (list, tuple)) and all(isinstance(v, (int, float)) for v in value):
        return np.array(value, dtype=np.float64)
    raise DataError(f"its {what} is no array of numbers", path=where)


def _tensor(values: NDArray[Any]) -> torch.Tensor:
    import torch

    return torch.from_numpy(np.array(values, dtype=values.dtype.newbyteorder("="), order="C"))


class _Pca:
    """Stands for a PCA object: its attributes by name."""

    state: Mapping[str, Any] = {}

    def __setstate__(self, state: object) -> None:
        if isinstance(state, Mapping):
            self.state = state


class _ArrayClass:
    """Stands for the class numpy.ndarray, which a pickle names but never calls."""


class _DataType:
    """Stands for a numpy.dtype: its code without byte order, and the byte order."""

    def __init__(self, code: object = "", *_: object) -> None:
        self.code, self.order = code, "|"

    def __setstate__(self, state: object) -> None:
        if isinstance(state, tuple) and len(state) > 1:
            self.order = state[1]


class _Scalar:
    """Stands for a number of numpy, which no part of the network depends on."""

    def __init__(self, *_: object) -> None:
        pass


class _Array:
    """Stands for a numpy array; ``values`` is None where it is not one of plain numbers."""

    values: NDArray[Any] | None = None

    def __init__(self, *_: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        # ndarray.__reduce__: version, shape, dtype, whether in Fortran's order, bytes
        if not isinstance(state, tuple) or len(state) != 5:
            return
        _, shape, kind, fortran, content = state
        if (
            isinstance(kind, _DataType)
            and kind.code in _NUMBERS
            and kind.order in ("<", ">", "|")
            and isinstance(shape, tuple)
            and all(type(size) is int and size >= 0 for size in shape)
            and isinstance(content, bytes)
        ):
            dtype = np.dtype(f"{kind.order}{kind.code}")
            if len(content) == math.prod(shape) * dtype.itemsize:
                values = np.frombuffer(content, dtype)
                self.values = values.reshape(shape[::-1]).T if fortran else values.reshape(shape)
