"""Checkpoints whose authors publish more than a state dict, without running any of their code.

NetVLAD is a MATLAB struct: ``net`` of MatConvNet has ``layers``, a cell of structs; those with
weights are the 13 convolutions of VGG-16, NetVLAD's layer and the whitening (Arandjelovic et al.,
CVPR 2016, section 3 and the authors' addPCA.m). Its tensors get OpenIBL's names.

AP-GeM's files (naver/deep-image-retrieval) hold, beside the state dict, objects of scikit-learn's
PCA by name, the mean and deviation of the images, and the options of the network. An object in a
pickle is a class's name and a state; here every such name stands for a class of this module, which
keeps the state and does nothing. Arrays are made of their type, shape and bytes by this module too,
so that no bytes of the file reach numpy's own unpickling.

What is wrong is a DataError, to which the reader of the file adds its name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.mat_file import MatValue, read_mat

if TYPE_CHECKING:
    import torch

# ------------------------------------------------------------------------------------------ NetVLAD

AVERAGE_IMAGE = "average_image"
"""Name of the mean colour; it marks weights whose whitening takes MATLAB's order."""

# numbers of the convolutions in torchvision's VGG-16
_CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)


def read_matlab_netvlad(content: bytes) -> dict[str, torch.Tensor]:
    """NetVLAD's tensors by name, float32, sizes as the file has them.

    Returns
    -------
    dict : ``base_model.base.{i}.weight`` (out, in, 3, 3) and ``.bias``, ``net_vlad.conv.weight``
        (K, D, 1, 1), ``net_vlad.centroids`` (K, D), ``pca_layer.weight`` (out, D K, 1, 1) whose
        inputs lie with the cluster's number running fastest, ``pca_layer.bias``, and
        ``average_image`` (3,), RGB of 0 to 255.
    """
    import torch

    net = read_mat(content).get("net")
    layers = _field(net, "layers")
    if not isinstance(layers, list):
        raise _another("net.layers is no cell")
    found = [_layer_weights(layer, f"net.layers{{{k}}}") for k, layer in enumerate(layers, 1)]
    pairs = [pair for pair in found if pair is not None]
    if len(pairs) != len(_CONVOLUTIONS) + 2:
        raise _another(f"{len(pairs)} layers have weights")
    arrays: dict[str, NDArray[np.float32]] = {}
    for number, (weight, bias) in zip(_CONVOLUTIONS, pairs, strict=False):
        name = f"base_model.base.{number}"
        if weight.ndim != 4 or weight.shape[3] != bias.size:
            raise _another(f"convolution {number} is {weight.shape}")
        arrays[f"{name}.weight"] = weight.transpose(3, 2, 0, 1)
        arrays[f"{name}.bias"] = bias.reshape(-1)
    assignment, negated = (_matrix(value, "NetVLAD's layer") for value in pairs[-2])
    if assignment.shape != negated.shape:
        raise _another(f"NetVLAD's layer is {assignment.shape} and {negated.shape}")
    whitening, bias = _matrix(pairs[-1][0], "whitening"), pairs[-1][1]
    if whitening.shape != (assignment.size, bias.size):
        raise _another(f"the whitening is {whitening.shape} after {assignment.shape}")
    arrays["net_vlad.conv.weight"] = assignment.T[:, :, None, None]
    arrays["net_vlad.centroids"] = -negated.T  # the file adds what the paper subtracts
    arrays["pca_layer.weight"] = whitening.T[:, :, None, None]
    arrays["pca_layer.bias"] = bias.reshape(-1)
    arrays[AVERAGE_IMAGE] = _mean_colour(net)
    return {name: torch.from_numpy(np.require(a, None, "W")) for name, a in arrays.items()}


def _layer_weights(
    layer: MatValue, what: str
) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """The two arrays of a layer; None of one that has no weights."""
    found = layer.get("weights") if isinstance(layer, dict) else None
    if not isinstance(found, list) or not found:
        return None
    if len(found) != 2:
        raise _another(f"{what} has {len(found)} weights")
    first, second = (_floats(value, what) for value in found)
    return first, second


def _mean_colour(net: MatValue) -> NDArray[np.float32]:
    """RGB of the average image's first pixel, which is what the authors subtract everywhere."""
    what = "net.meta.normalization.averageImage"
    value = net
    for name in ("meta", "normalization", "averageImage"):
        value = _field(value, name)
    image = _floats(value, what)
    if image.size == 0 or image.shape[-1] != 3 or image.ndim > 3:
        raise _another(f"{what} is {image.shape}")
    return image.reshape(-1, 3, order="F")[0].copy()


def _field(value: MatValue, name: str) -> MatValue:
    if not isinstance(value, dict) or name not in value:
        raise _another(f"no {name} where it should be")
    return value[name]


def _floats(value: MatValue, what: str) -> NDArray[np.float32]:
    """Numbers as float32; the same memory where they are that already."""
    if not isinstance(value, np.ndarray):
        raise _another(f"{what} is no array of real numbers")
    return value.astype(np.float32, order="K", copy=False)


def _matrix(value: NDArray[np.float32], what: str) -> NDArray[np.float32]:
    """The last two axes of an array whose others have length 1."""
    if value.ndim < 2 or math.prod(value.shape[:-2]) != 1:
        raise _another(f"the {what} is {value.shape}")
    return value.reshape(value.shape[-2:], order="F")


def _another(found: str) -> DataError:
    return DataError(
        "not NetVLAD's struct net: expected are net.layers with weights of 13 convolutions, of "
        "NetVLAD's layer and of its whitening, and net.meta.normalization.averageImage; "
        f"{found}"
    )


# ------------------------------------------------------------------------------------------- AP-GeM

# scikit-learn renamed the module in version 0.22; the first of these is what the files say
_PCA_NAMES = ("sklearn.decomposition.pca.PCA", "sklearn.decomposition._pca.PCA")
_CORE_NAMES = ("numpy.core.multiarray", "numpy._core.multiarray")
_ARRAY_PARTS = ("mean", "components", "explained_variance")
_ARCHITECTURES = ("resnet50_rmac", "resnet101_rmac")
_NUMBERS = frozenset({"f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1"})


def holds_pca(content: bytes) -> bool:
    """True for a file of torch that names scikit-learn's PCA (its pickle is never compressed)."""
    return b"sklearn.decomposition" in content


def stand_ins(*, pca: bool) -> list[Any]:
    """Classes that torch's restricted reader may build for names in a file, none of which runs.

    Training scripts keep a score beside the weights (DeepLabV3+: ``best_score``), and a score of
    numpy is pickled as a call of numpy.core.multiarray.scalar on a numpy.dtype. Allowing those two
    would hand bytes of the file to numpy's C code; the score, which is no tensor, is left out.

    Parameters
    ----------
    pca : for AP-GeM's file, also the names that its objects and arrays have.
    """
    names: list[tuple[type, str]] = [(_DataType, "numpy.dtype")]
    names += [(_Dropped, f"{core}.scalar") for core in _CORE_NAMES]
    if pca:
        names += [(_Pca, name) for name in _PCA_NAMES]
        names += [(_Array, f"{core}._reconstruct") for core in _CORE_NAMES]
        names.append((_Dropped, "numpy.ndarray"))  # which a pickle names but never calls
    return names


def tensors_beside(found: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """Tensors that the network needs beside its weights, by names that no state dict has.

    ``pca.NAME.mean``, ``.components``, ``.explained_variance`` and ``.whiten`` for each PCA;
    ``preprocess.mean`` and ``preprocess.std``; ``model_options.norm_features``.

    Parameters
    ----------
    found : the checkpoint as torch read it with :func:`stand_ins`.

    Raises
    ------
    DataError : a part has another structure, or the options are those of a network that is not
        supported.
    """
    beside: dict[str, torch.Tensor] = {}
    whitenings = found.get("pca") or {}
    if not isinstance(whitenings, Mapping):
        raise DataError("its pca is no table of PCA objects by name")
    for name, pca in whitenings.items():
        if not isinstance(pca, _Pca) or not isinstance(name, str) or "." in name:
            raise DataError(f"its pca has {name!r}, which is no PCA object by a name")
        for part in _ARRAY_PARTS:
            values = _numbers(pca.state.get(f"{part}_"), f"pca {name} {part}_")
            beside[f"pca.{name}.{part}"] = _tensor(values)
        beside[f"pca.{name}.whiten"] = _tensor(np.array(bool(pca.state.get("whiten"))))
    preprocess = found.get("preprocess")
    if isinstance(preprocess, Mapping):
        for part in sorted({"mean", "std"} & set(preprocess)):
            values = _numbers(preprocess[part], f"preprocess {part}")
            beside[f"preprocess.{part}"] = _tensor(values)
    options = found.get("model_options")
    if isinstance(options, Mapping):
        _check_options(options)
        beside["model_options.norm_features"] = _tensor(
            np.array(bool(options.get("norm_features")))
        )
    return beside


def _check_options(options: Mapping[str, Any]) -> None:
    """Refuse a network that the keys of the weights alone would not tell apart from ours."""
    arch, pooling = options.get("arch"), options.get("pooling", "gem")
    wrong = [
        (arch not in _ARCHITECTURES, f"arch={arch!r}, not one of {', '.join(_ARCHITECTURES)}"),
        (not str(pooling).startswith("gem"), f"pooling={pooling!r}, not gem"),
        (bool(options.get("center_bias")), f"center_bias={options.get('center_bias')!r}, not 0"),
        (bool(options.get("without_fc")), "without_fc"),
    ]
    if told := [text for is_wrong, text in wrong if is_wrong]:
        raise DataError(f"its model_options are not supported: {'; '.join(told)}")


def _numbers(value: object, what: str) -> NDArray[Any]:
    if isinstance(value, _Array) and value.values is not None:
        return value.values
    if isinstance(value, (list, tuple)) and all(isinstance(v, (int, float)) for v in value):
        return np.array(value, dtype=np.float64)
    raise DataError(f"its {what} is no array of numbers")


def _tensor(values: NDArray[Any]) -> torch.Tensor:
    import torch

    return torch.from_numpy(np.array(values, dtype=values.dtype.newbyteorder("="), order="C"))


class _Pca:
    """Stands for a PCA object: its attributes by name."""

    state: Mapping[str, Any] = {}

    def __setstate__(self, state: object) -> None:
        if isinstance(state, Mapping):
            self.state = state


class _DataType:
    """Stands for a numpy.dtype: its code without byte order, and the byte order."""

    def __init__(self, code: object = "", *_: object) -> None:
        self.code, self.order = code, "|"

    def __setstate__(self, state: object) -> None:
        if isinstance(state, tuple) and len(state) > 1:
            self.order = state[1]


class _Dropped:
    """Stands for an object that is not needed: takes whatever it is built of, keeps nothing."""

    def __init__(self, *_: object) -> None:
        pass

    def __setstate__(self, _: object) -> None:
        pass


class _Array(_Dropped):
    """Stands for a numpy array; ``values`` is None where it is not one of plain numbers."""

    values: NDArray[Any] | None = None

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
