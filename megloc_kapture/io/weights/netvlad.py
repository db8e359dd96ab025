"""NetVLAD as its authors publish it, a MATLAB struct, as tensors under OpenIBL's names.

The struct ``net`` of MatConvNet has ``layers``, a cell of structs; those with weights are the 13
convolutions of VGG-16, NetVLAD's layer and the whitening (Arandjelovic et al., CVPR 2016, section
3 and the authors' addPCA.m).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from megloc_kapture.errors import DataError
from megloc_kapture.io.mat_file import MatValue, read_mat

if TYPE_CHECKING:
    import torch

AVERAGE_IMAGE = "average_image"
"""Name of the mean colour; it marks weights whose whitening takes MATLAB's order."""

# numbers of the convolutions in torchvision's VGG-16
_CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)


def read_matlab_netvlad(content: bytes, where: str) -> dict[str, torch.Tensor]:
    """NetVLAD's tensors by name, float32, sizes as the file has them.

    Returns
    -------
    dict : ``base_model.base.{i}.weight`` (out, in, 3, 3) and ``.bias``, ``net_vlad.conv.weight``
        (K, D, 1, 1), ``net_vlad.centroids`` (K, D), ``pca_layer.weight`` (out, D K, 1, 1) whose
        inputs lie with the cluster's number running fastest, ``pca_layer.bias``, and
        ``average_image`` (3,), RGB of 0 to 255.

    Raises
    ------
    DataError : no MAT file that can be read, or not this network; says what was expected.
    """
    import torch

    net = read_mat(content, where).get("net")
    layers = _field(net, "layers", where)
    if not isinstance(layers, list):
        raise _another(where, "net.layers is no cell")
    pairs = [
        pair
        for number, layer in enumerate(layers, 1)
        if (pair := _weights(layer, f"net.layers{{{number}}}", where)) is not None
    ]
    if len(pairs) != len(_CONVOLUTIONS) + 2:
        raise _another(where, f"{len(pairs)} layers have weights")
    arrays: dict[str, NDArray[np.float32]] = {}
    for number, (weight, bias) in zip(_CONVOLUTIONS, pairs, strict=False):
        name = f"base_model.base.{number}"
        if weight.ndim != 4 or weight.shape[3] != bias.size:
            raise _another(where, f"convolution {number} is {weight.shape}")
        arrays[f"{name}.weight"] = weight.transpose(3, 2, 0, 1)
        arrays[f"{name}.bias"] = bias.reshape(-1)
    assignment, negated = (_matrix(value, "NetVLAD's layer", where) for value in pairs[-2])
    if assignment.shape != negated.shape:
        raise _another(where, f"NetVLAD's layer is {assignment.shape} and {negated.shape}")
    whitening, bias = _matrix(pairs[-1][0], "whitening", where), pairs[-1][1]
    if whitening.shape != (assignment.size, bias.size):
        raise _another(where, f"the whitening is {whitening.shape} after {assignment.shape}")
    arrays["net_vlad.conv.weight"] = assignment.T[:, :, None, None]
    arrays["net_vlad.centroids"] = -negated.T  # the file adds what the paper subtracts
    arrays["pca_layer.weight"] = whitening.T[:, :, None, None]
    arrays["pca_layer.bias"] = bias.reshape(-1)
    arrays[AVERAGE_IMAGE] = _mean_colour(net, where)
    return {name: torch.from_numpy(np.require(a, None, "W")) for name, a in arrays.items()}


def _weights(
    layer: MatValue, what: str, where: str
) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """The two arrays of a layer; None of one that has no weights."""
    found = layer.get("weights") if isinstance(layer, dict) else None
    if not isinstance(found, list) or not found:
        return None
    if len(found) != 2:
        raise _another(where, f"{what} has {len(found)} weights")
    first, second = (_floats(value, what, where) for value in found)
    return first, second


def _mean_colour(net: MatValue, where: str) -> NDArray[np.float32]:
    """RGB of the average image's first pixel, which is what the authors subtract everywhere."""
    what = "net.meta.normalization.averageImage"
    value = net
    for name in ("meta", "normalization", "averageImage"):
        value = _field(value, name, where)
    image = _floats(value, what, where)
    if image.size == 0 or image.shape[-1] != 3 or image.ndim > 3:
        raise _another(where, f"{what} is {image.shape}")
    return image.reshape(-1, 3, order="F")[0].copy()


def _field(value: MatValue, name: str, where: str) -> MatValue:
    if not isinstance(value, dict) or name not in value:
        raise _another(where, f"no {name} where it should be")
    return value[name]


def _floats(value: MatValue, what: str, where: str) -> NDArray[np.float32]:
    """Numbers as float32; the same memory where they are that already."""
    if not isinstance(value, np.ndarray):
        raise _another(where, f"{what} is no array of real numbers")
    return value.astype(np.float32, order="K", copy=False)


def _matrix(value: NDArray[np.float32], what: str, where: str) -> NDArray[np.float32]:
    """The last two axes of an array whose others have length 1."""
    if value.ndim < 2 or math.prod(value.shape[:-2]) != 1:
        raise _another(where, f"the {what} is {value.shape}")
    return value.reshape(value.shape[-2:], order="F")


def _another(where: str, found: str) -> DataError:
    return DataError(
        "not NetVLAD's struct net: expected are net.layers with weights of 13 convolutions, of "
        "NetVLAD's layer and of its whitening, and net.meta.normalization.averageImage; "
        f"{found}",
        path=where,
    )
