"""NetVLAD (Arandjelovic et al., CVPR 2016) on VGG-16, for its authors' weights and OpenIBL's.

OpenIBL (Ge et al., ECCV 2020) trains the same network otherwise. Both end in a whitening that is
part of the weights; they differ in the order of its inputs and in the colour that is subtracted.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
from torch import nn
from torch.nn import functional as F

from megloc_kapture.errors import DataError
from megloc_kapture.nets.runtime import load_strictly
from megloc_kapture.nets.trunks import Vgg16Features

Order = Literal["dk", "kd"]

STRIDE_PX = 16  # of the trunk: an image must have as many pixels a side
_CONV5_3 = 28  # the last layer that is used, without its ReLU: features have either sign
_CHANNELS = 512
_NUM_CLUSTERS, _OUTPUT_SIZE = 64, 4096  # of all published weights
# what the reader of MATLAB's files adds to the keys; OpenIBL's files have no such key
_AVERAGE_IMAGE = "average_image"
# 255 times the mean that OpenIBL subtracts of colours in [0, 1], before it divides by 1 / 255
_OPENIBL_MEAN_RGB = (123.68, 116.779, 103.939)


class NetVladLayer(nn.Module):
    """NetVLAD's layer: sums of differences to centres, by soft assignment.

    With unit features x_i, assignment weights w_k and centres c_k (equations 3 and 4, without the
    bias, which the published weights have not)::

        V(d, k) = sum_i a_k(x_i) (x_i(d) - c_k(d)),   a_k(x) = exp(w_k . x) / sum_k' exp(w_k' . x)

    Each cluster's sum is brought to unit length, then the whole vector.

    Parameters
    ----------
    num_clusters, size : K, and D, the length of a feature.
    order : how V becomes a vector. "dk": clusters run fastest, as in MATLAB's code; "kd":
        features run fastest, as in OpenIBL's.
    """

    def __init__(self, num_clusters: int, size: int, *, order: Order) -> None:
        super().__init__()
        self.order = order
        self.conv = nn.Conv2d(size, num_clusters, 1, bias=False)
        self.centroids = nn.Parameter(torch.rand(num_clusters, size))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Vectors (B, K D) of unit length, of features (B, D, h, w) of any length but zero."""
        unit = F.normalize(features, dim=1)
        weights = self.conv(unit).flatten(2).softmax(dim=1)
        # the sum of the differences, without a (B, K, D, h w) array of them
        sums = weights @ unit.flatten(2).mT
        residuals = sums - weights.sum(dim=2)[:, :, None] * self.centroids
        residuals = F.normalize(residuals, dim=2)
        if self.order == "dk":
            residuals = residuals.mT
        return F.normalize(residuals.flatten(1), dim=1)


class VggNetVlad(nn.Module):
    """VGG-16 to conv5_3, NetVLAD's layer, and whitening; keys are those of OpenIBL.

    Parameters
    ----------
    order : of the whitening's inputs, see :class:`NetVladLayer`.
    mean_rgb : colour of 0 to 255 that is subtracted of every pixel.
    num_clusters, output_size : of the weights.
    """

    def __init__(
        self,
        *,
        order: Order,
        mean_rgb: tuple[float, float, float],
        num_clusters: int = _NUM_CLUSTERS,
        output_size: int = _OUTPUT_SIZE,
    ) -> None:
        super().__init__()
        self.mean_rgb = mean_rgb
        self.base_model = nn.ModuleDict({"base": Vgg16Features(last=_CONV5_3)})
        self.net_vlad = NetVladLayer(num_clusters, _CHANNELS, order=order)
        self.pca_layer = nn.Conv2d(num_clusters * _CHANNELS, output_size, 1)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Vectors (B, output size) of unit length, of RGB images (B, 3, H, W) in [0, 1]."""
        return self.vectors(self.features(image))

    def features(self, image: torch.Tensor) -> torch.Tensor:
        """Features (B, 512, H // 16, W // 16) of RGB images (B, 3, H, W) in [0, 1]."""
        mean = image.new_tensor(self.mean_rgb)[:, None, None]
        found: torch.Tensor = self.base_model["base"](255.0 * image - mean)
        return found

    def vectors(self, features: torch.Tensor) -> torch.Tensor:
        """Vectors (B, output size) of unit length, of what :meth:`features` found."""
        # as a product, not as the convolution the weights are stored for, which would first
        # bring half a gigabyte of them into another order
        weight = self.pca_layer.weight.flatten(1)
        return F.normalize(F.linear(self.net_vlad(features), weight, self.pca_layer.bias), dim=1)


def netvlad(tensors: Mapping[str, torch.Tensor], where: str) -> VggNetVlad:
    """The network with weights of NetVLAD's authors, as they are read out of MATLAB's file.

    Raises
    ------
    DataError : the weights do not fit; names ``where`` and the keys.
    """
    if _AVERAGE_IMAGE not in tensors:
        raise DataError(
            f"no weights of NetVLAD's authors: no {_AVERAGE_IMAGE} in it (OpenIBL's are for "
            "the plugin openibl)",
            path=where,
        )
    rest = dict(tensors)
    mean = rest.pop(_AVERAGE_IMAGE)
    if mean.shape != (3,):
        raise DataError(f"{_AVERAGE_IMAGE} is {tuple(mean.shape)}, not (3,)", path=where)
    red, green, blue = (float(value) for value in mean)
    return _filled(rest, where, "dk", (red, green, blue))


def openibl(tensors: Mapping[str, torch.Tensor], where: str) -> VggNetVlad:
    """The network with weights of OpenIBL.

    Raises
    ------
    DataError : the weights do not fit; names ``where`` and the keys.
    """
    if _AVERAGE_IMAGE in tensors:
        raise DataError(
            "weights of NetVLAD's authors, which are for the plugin netvlad, not OpenIBL's",
            path=where,
        )
    return _filled(tensors, where, "kd", _OPENIBL_MEAN_RGB)


def _filled(
    tensors: Mapping[str, torch.Tensor],
    where: str,
    order: Order,
    mean_rgb: tuple[float, float, float],
) -> VggNetVlad:
    # nothing is drawn at random: half a gigabyte of numbers would be thrown away
    with torch.device("meta"):
        module = VggNetVlad(
            order=order,
            mean_rgb=mean_rgb,
            num_clusters=_length(tensors, "net_vlad.centroids", _NUM_CLUSTERS),
            output_size=_length(tensors, "pca_layer.bias", _OUTPUT_SIZE),
        )
    module = module.to_empty(device="cpu")
    load_strictly(module, tensors, where)
    return module.eval()


def _length(tensors: Mapping[str, torch.Tensor], key: str, default: int) -> int:
    """Length of a tensor's first axis; the usual one where the weights will be refused anyway."""
    return tensors[key].shape[0] if key in tensors and tensors[key].ndim else default
