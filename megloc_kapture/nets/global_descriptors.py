"""Global descriptors with convolutional backbones: NetVLAD, OpenIBL and AP-GeM.

NetVLAD (Arandjelovic et al., CVPR 2016) and OpenIBL (Ge et al., ECCV 2020) share a network: VGG-16,
NetVLAD's layer and whitening; the order of the whitening's inputs and the mean colour differ.
AP-GeM (Revaud et al., ICCV 2019) is a ResNet with generalized-mean pooling and a linear layer.
Parameters have the names of the authors' checkpoints, with additions by
``scripts/convert_weights.py``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
    generalized_mean,
    vgg16_features,
)

Order = Literal["dk", "kd"]

STRIDE_PX = 16  # stride of the backbone, which is also the smallest image side
_CONV5_3 = 28  # the last layer, without its ReLU: features have either sign
_CHANNELS = 512
_NUM_CLUSTERS, _OUTPUT_SIZE = 64, 4096
# only checkpoints converted from those of NetVLAD's authors have this key
_AVERAGE_IMAGE = "average_image"
# OpenIBL's mean for colours in [0, 1], times 255
_OPENIBL_MEAN_RGB = (123.68, 116.779, 103.939)
DESCRIPTOR_SIZE = 2048
# components of AP-GeM are divided by powers of their variances, as in the authors' evaluation
WHITENING_POWER = 0.25
# parts of an optional whitening in a checkpoint, under scikit-learn's names
PCA_PARTS = ("mean", "components", "explained_variance", "whiten")


class NetVladLayer(nn.Module):
    """NetVLAD's layer: residuals to cluster centres, summed by soft assignment.

    With unit-norm features x_i, assignment weights w_k and centres c_k (equations 3 and 4 without
    bias)::

        V(d, k) = sum_i a_k(x_i) (x_i(d) - c_k(d)),   a_k(x) = exp(w_k . x) / sum_k' exp(w_k' . x)

    Each cluster's vector is normalised, then the whole vector. In ``order`` "dk" the cluster index
    runs fastest, as in the authors' MATLAB code; in "kd" the channel index does, as in OpenIBL.
    """

    def __init__(self, num_clusters: int, size: int, *, order: Order) -> None:
        super().__init__()
        self.order = order
        self.conv = nn.Conv2d(size, num_clusters, 1, bias=False)
        self.centroids = nn.Parameter(torch.rand(num_clusters, size))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Aggregate non-zero features (B, D, h, w) into unit-norm vectors (B, K D)."""
        unit = functional.normalize(features, dim=1)
        weights = self.conv(unit).flatten(2).softmax(dim=1)
        # sum first, which avoids the (B, K, D, h w) array of residuals
        sums = weights @ unit.flatten(2).mT
        residuals = sums - weights.sum(dim=2)[:, :, None] * self.centroids
        residuals = functional.normalize(residuals, dim=2)
        if self.order == "dk":
            residuals = residuals.mT
        return functional.normalize(residuals.flatten(1), dim=1)


class VggNetVlad(nn.Module):
    """VGG-16 up to conv5_3, NetVLAD's layer (``order``) and whitening, with OpenIBL's keys."""

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
        self.base_model = nn.ModuleDict({"base": vgg16_features(last=_CONV5_3)})
        self.net_vlad = NetVladLayer(num_clusters, _CHANNELS, order=order)
        self.pca_layer = nn.Conv2d(num_clusters * _CHANNELS, output_size, 1)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return unit-norm vectors (B, output size) of RGB images (B, 3, H, W) in [0, 1]."""
        height, width = image.shape[-2:]
        if min(height, width) < STRIDE_PX:
            raise DataError(
                f"the network's input has {width}x{height} pixels, but needs at least "
                f"{STRIDE_PX} on each side"
            )
        device = image.device.type
        features, is_half = self.features(image).float(), torch.is_autocast_enabled(device)
        with torch.autocast(device, enabled=False):
            # in half precision, colours of 0 to 255 may overflow in this trunk
            if is_half and not bool(features.isfinite().all()):
                features = self.features(image)
            return self.vectors(features)

    def features(self, image: torch.Tensor) -> torch.Tensor:
        """Return features (B, 512, H // 16, W // 16) of RGB images (B, 3, H, W) in [0, 1]."""
        mean = image.new_tensor(self.mean_rgb)[:, None, None]
        activations: torch.Tensor = self.base_model["base"](255.0 * image - mean)
        return activations

    def vectors(self, features: torch.Tensor) -> torch.Tensor:
        # a convolution would first reorder half a gigabyte of weights
        weight = self.pca_layer.weight.flatten(1)
        return functional.normalize(
            functional.linear(self.net_vlad(features), weight, self.pca_layer.bias), dim=1
        )


def netvlad(tensors: Mapping[str, torch.Tensor], where: str) -> VggNetVlad:
    if _AVERAGE_IMAGE not in tensors:
        raise DataError(
            f"not the weights of NetVLAD's authors: the file lacks {_AVERAGE_IMAGE} (OpenIBL's "
            "weights are for the plugin openibl)",
            path=where,
        )
    rest = dict(tensors)
    red, green, blue = rest.pop(_AVERAGE_IMAGE).tolist()
    return _filled(rest, where, "dk", (red, green, blue))


def openibl(tensors: Mapping[str, torch.Tensor], where: str) -> VggNetVlad:
    if _AVERAGE_IMAGE in tensors:
        raise DataError(
            "these are the weights of NetVLAD's authors, for the plugin netvlad, not OpenIBL's",
            path=where,
        )
    return _filled(tensors, where, "kd", _OPENIBL_MEAN_RGB)


def _filled(
    tensors: Mapping[str, torch.Tensor],
    where: str,
    order: Order,
    mean_rgb: tuple[float, float, float],
) -> VggNetVlad:
    # skip the random initialisation of half a gigabyte
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
    return tensors[key].shape[0] if key in tensors and tensors[key].ndim else default


class ApGemNet(ResNet):
    """AP-GeM's network from image to unit-norm vector.

    ``mean`` and ``deviation`` describe the training images, RGB in [0, 1].
    ``normalised_features`` normalises pooled features before the last layer. ``whitening`` is set
    by :func:`apgem_from`.
    """

    mean: torch.Tensor
    deviation: torch.Tensor

    def __init__(
        self,
        depth: Depth = 101,
        *,
        mean: torch.Tensor | Sequence[float] = IMAGENET_MEAN,
        deviation: torch.Tensor | Sequence[float] = IMAGENET_DEVIATION,
        normalised_features: bool = False,
    ) -> None:
        super().__init__(depth)
        self.adpool = nn.ParameterDict({"p": torch.full((1,), 3.0)})
        self.fc = nn.Linear(DESCRIPTOR_SIZE, DESCRIPTOR_SIZE)
        self.normalised_features = normalised_features
        self.whitening: nn.Linear | None = None
        for name, values in (("mean", mean), ("deviation", deviation)):
            self.register_buffer(
                name, torch.as_tensor(values).float().view(3, 1, 1), persistent=False
            )

    def forward(self, image: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
        """Return unit-norm vectors float32 (B, 2048) of RGB images (B, 3, H, W) in [0, 1]."""
        features = super().forward((image - self.mean) / self.deviation)[-1]
        with torch.autocast(image.device.type, enabled=False):
            pooled = generalized_mean(features, self.adpool["p"])
            if self.normalised_features:
                pooled = functional.normalize(pooled)
            vectors = functional.normalize(self.fc(pooled))
            if self.whitening is None:
                return vectors
            return functional.normalize(self.whitening(vectors))


def apgem_from(tensors: Mapping[str, torch.Tensor], where: str, whitening: str = "") -> ApGemNet:
    """Build the network from the tensors of ``scripts/convert_weights.py``, for inference.

    ``whitening`` is a name in the checkpoint; an empty name means none.
    """
    settings = ("preprocess.", "model_options.", "pca.")
    state = {key: value for key, value in tensors.items() if not key.startswith(settings)}
    blocks = {key.split(".")[1] for key in state if key.startswith("layer3.")}
    depth = RESNET_DEPTHS.get(len(blocks))
    if depth is None or "adpool.p" not in state:
        raise DataError(
            "not AP-GeM: the file lacks adpool.p or layer3.* of ResNet-50 or ResNet-101", path=where
        )
    net = ApGemNet(
        depth,
        mean=tensors.get("preprocess.mean", IMAGENET_MEAN),
        deviation=tensors.get("preprocess.std", IMAGENET_DEVIATION),
        normalised_features=bool(tensors.get("model_options.norm_features", False)),
    )
    load_strictly(net, state, where, may_lack=batch_counters(net))
    if whitening:
        net.whitening = whitening_from(tensors, whitening, where)
    return net.eval()


def whitening_from(tensors: Mapping[str, torch.Tensor], name: str, where: str) -> nn.Linear:
    """Build a PCA whitening, for vectors that are normalised afterwards."""
    known = sorted({key.split(".")[1] for key in tensors if key.startswith("pca.")})
    if name not in known:
        raise OptionError(
            f"{where} has no whitening {name!r}; it has {', '.join(known) or 'none'} "
            "(an empty name means no whitening)"
        )
    mean, components, variance, whiten = (tensors[f"pca.{name}.{part}"] for part in PCA_PARTS)
    weight = components.double()
    if whiten:
        weight = variance.double().pow(-WHITENING_POWER)[:, None] * weight
    layer = nn.Linear(weight.shape[1], weight.shape[0])
    layer.weight.data, layer.bias.data = weight.float(), -(weight @ mean.double()).float()
    return layer
