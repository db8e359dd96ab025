"""Global descriptors of convolutional trunks: NetVLAD, OpenIBL and AP-GeM.

NetVLAD (Arandjelovic et al., CVPR 2016) and OpenIBL (Ge et al., ECCV 2020) are one network on
VGG-16, trained in two ways. Both end in a whitening that is part of the weights; they differ in the
order of its inputs and in the colour that is subtracted. AP-GeM (Revaud et al., ICCV 2019) is a
ResNet, generalized-mean pooling with a learnt power, and a linear layer. All have the keys of the
authors' checkpoints; ``scripts/convert_weights.py`` adds what AP-GeM's and NetVLAD's hold beside
them under names of our own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal

import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.nets.runtime import batch_counters, load_strictly
from megloc_kapture.nets.trunks import (
    IMAGENET_DEVIATION,
    IMAGENET_MEAN,
    RESNET_DEPTHS,
    Depth,
    ResNet,
    Vgg16Features,
    generalized_mean,
)

Order = Literal["dk", "kd"]

STRIDE_PX = 16  # of the trunk: an image must have as many pixels a side
_CONV5_3 = 28  # the last layer that is used, without its ReLU: features have either sign
_CHANNELS = 512
_NUM_CLUSTERS, _OUTPUT_SIZE = 64, 4096  # of all published weights
# in converted files of NetVLAD's authors only; OpenIBL's have no such key
_AVERAGE_IMAGE = "average_image"
# 255 times the mean that OpenIBL subtracts of colours in [0, 1], before it divides by 1 / 255
_OPENIBL_MEAN_RGB = (123.68, 116.779, 103.939)
DESCRIPTOR_SIZE = 2048  # of AP-GeM, and the channels of a ResNet
# what a checkpoint may hold beside the state dict; the names of scikit-learn's attributes
PCA_PARTS = ("mean", "components", "explained_variance", "whiten")


class NetVladLayer(nn.Module):
    """NetVLAD's layer: sums of differences to centres, by soft assignment.

    With unit features x_i, assignment weights w_k and centres c_k (equations 3 and 4, without the
    bias, which the published weights have not)::

        V(d, k) = sum_i a_k(x_i) (x_i(d) - c_k(d)),   a_k(x) = exp(w_k . x) / sum_k' exp(w_k' . x)

    Each cluster's sum is brought to unit length, then the whole vector. ``order`` says how V
    becomes one: "dk": clusters run fastest, as in MATLAB's code; "kd": features, as in OpenIBL's.
    """

    def __init__(self, num_clusters: int, size: int, *, order: Order) -> None:
        super().__init__()
        self.order = order
        self.conv = nn.Conv2d(size, num_clusters, 1, bias=False)
        self.centroids = nn.Parameter(torch.rand(num_clusters, size))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Vectors (B, K D) of unit length, of features (B, D, h, w) of any length but zero."""
        unit = functional.normalize(features, dim=1)
        weights = self.conv(unit).flatten(2).softmax(dim=1)
        # the sum of the differences, without a (B, K, D, h w) array of them
        sums = weights @ unit.flatten(2).mT
        residuals = sums - weights.sum(dim=2)[:, :, None] * self.centroids
        residuals = functional.normalize(residuals, dim=2)
        if self.order == "dk":
            residuals = residuals.mT
        return functional.normalize(residuals.flatten(1), dim=1)


class VggNetVlad(nn.Module):
    """VGG-16 to conv5_3, NetVLAD's layer, and whitening; keys are those of OpenIBL.

    ``order``: of the whitening's inputs, see :class:`NetVladLayer`; ``mean_rgb``: colour of 0 to
    255 that is subtracted of every pixel.
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
        return functional.normalize(
            functional.linear(self.net_vlad(features), weight, self.pca_layer.bias), dim=1
        )


def netvlad(tensors: Mapping[str, torch.Tensor], where: str) -> VggNetVlad:
    """The network of weights of NetVLAD's authors, as they are read out of MATLAB's file."""
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
    """The network of weights of OpenIBL; raises DataError as :func:`netvlad`."""
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
    return load_strictly(module, tensors, where).eval()


def _length(tensors: Mapping[str, torch.Tensor], key: str, default: int) -> int:
    """Length of a tensor's first axis; the usual one where the weights will be refused anyway."""
    return tensors[key].shape[0] if key in tensors and tensors[key].ndim else default


class GeneralizedMean(nn.Module):
    """Generalized-mean pooling with a learnt power."""

    def __init__(self) -> None:
        super().__init__()
        self.p = nn.Parameter(torch.full((1,), 3.0))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return generalized_mean(features, self.p)


class ApGemNet(ResNet):
    """Image to a vector of unit length; 46,696,513 weights at depth 101.

    ``mean`` and ``deviation``: of the images it was trained on, RGB in [0, 1];
    ``normalised_features``: scale pooled features to unit length before the last layer.
    """

    mean: torch.Tensor
    deviation: torch.Tensor

    def __init__(
        self,
        depth: Depth = 101,
        *,
        mean: Iterable[float] = IMAGENET_MEAN,
        deviation: Iterable[float] = IMAGENET_DEVIATION,
        normalised_features: bool = False,
    ) -> None:
        super().__init__(depth)
        self.adpool = GeneralizedMean()
        self.fc = nn.Linear(DESCRIPTOR_SIZE, DESCRIPTOR_SIZE)
        self.normalised_features = normalised_features
        for name, values in (("mean", mean), ("deviation", deviation)):
            self.register_buffer(name, torch.tensor(list(values)).view(3, 1, 1), persistent=False)

    def describe(self, image: torch.Tensor) -> torch.Tensor:
        """Unit vectors, float32 (B, 2048), of RGB images (B, 3, H, W) in [0, 1]."""
        features = self((image - self.mean) / self.deviation)[-1]
        # in half precision the convolutions alone
        with torch.autocast(image.device.type, enabled=False):
            pooled = self.adpool(features)
            if self.normalised_features:
                pooled = functional.normalize(pooled)
            return functional.normalize(self.fc(pooled))


class Whitening(nn.Module):
    """Principal components, each scaled by a power of its variance, then unit length.

    Equal to scikit-learn's whitening at ``power`` 0.5; the authors evaluate at 0.25, and 0 keeps
    the components' scales. ``mean`` (D,), ``components`` (K, D) and ``variance`` (K,) are of the
    principal component analysis.
    """

    mean: torch.Tensor
    weight: torch.Tensor

    def __init__(
        self, mean: torch.Tensor, components: torch.Tensor, variance: torch.Tensor, *, power: float
    ) -> None:
        super().__init__()
        scale = variance.double().pow(-power)
        self.register_buffer("mean", mean.float())
        self.register_buffer("weight", (scale[:, None] * components.double()).float())

    def forward(self, vectors: torch.Tensor) -> torch.Tensor:
        """Whitened vectors of unit length, float32 (B, K), of vectors (B, D)."""
        return functional.normalize(functional.linear(vectors.float() - self.mean, self.weight))


def apgem_from(tensors: Mapping[str, torch.Tensor], where: str) -> ApGemNet:
    """The network of a checkpoint's tensors, ready for inference.

    ``tensors`` are as ``scripts/convert_weights.py`` writes them.
    """
    beside = ("preprocess.", "model_options.", "pca.")
    state = {key: value for key, value in tensors.items() if not key.startswith(beside)}
    blocks = {key.split(".")[1] for key in state if key.startswith("layer3.")}
    depth = RESNET_DEPTHS.get(len(blocks))
    if depth is None or "adpool.p" not in state:
        raise DataError(
            "no AP-GeM: keys layer3.* of ResNet-50 or ResNet-101 and adpool.p expected", path=where
        )
    net = ApGemNet(
        depth,
        mean=_three(tensors, "preprocess.mean", IMAGENET_MEAN, where),
        deviation=_three(tensors, "preprocess.std", IMAGENET_DEVIATION, where),
        normalised_features=bool(tensors.get("model_options.norm_features", False)),
    )
    return load_strictly(net, state, where, may_lack=batch_counters(net)).eval()


def whitening_from(
    tensors: Mapping[str, torch.Tensor], name: str, where: str, *, power: float
) -> Whitening:
    """The whitening that a checkpoint keeps under a name."""
    known = sorted({key.split(".")[1] for key in tensors if key.startswith("pca.")})
    if name not in known:
        raise OptionError(
            f"{where}: no whitening {name!r} in it; there is {', '.join(known) or 'none'} "
            "(an empty name takes the vectors as they are)"
        )
    parts = {part: tensors.get(f"pca.{name}.{part}") for part in PCA_PARTS}
    mean, components, variance, whiten = parts.values()
    if mean is None or components is None or variance is None or whiten is None:
        lost = ", ".join(part for part, value in parts.items() if value is None)
        raise DataError(f"the whitening {name} lacks {lost}", path=where)
    count = len(components)
    sizes = tuple(mean.shape), tuple(components.shape), tuple(variance.shape)
    if sizes != ((DESCRIPTOR_SIZE,), (count, DESCRIPTOR_SIZE), (count,)):
        raise DataError(
            f"the whitening {name} has mean, components and variances of shapes {sizes}", path=where
        )
    if whiten and not bool((variance > 0).all()):
        raise DataError(f"the whitening {name} has variances that are not positive", path=where)
    return Whitening(mean, components, variance, power=power if whiten else 0.0)


def _three(
    tensors: Mapping[str, torch.Tensor], key: str, default: Iterable[float], where: str
) -> list[float]:
    values = tensors[key].double().flatten().tolist() if key in tensors else list(default)
    if len(values) != 3:
        raise DataError(f"{key} has {len(values)} values, not one for each of R, G, B", path=where)
    return values
