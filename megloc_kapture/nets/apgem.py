"""AP-GeM (Revaud et al., ICCV 2019), under the keys of the authors' checkpoints.

A ResNet, generalized-mean pooling with a learnt power, a fully connected layer, unit length. What
comes beside the trunk and this head is read from the checkpoint where it is known there, under
names of our own, see :mod:`megloc_kapture.io.weights.authors`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.errors import DataError, OptionError
from megloc_kapture.nets.runtime import load_strictly
from megloc_kapture.nets.trunks import (
    IMAGENET_DEVIATION,
    IMAGENET_MEAN,
    Depth,
    ResNet,
    generalized_mean,
)

DESCRIPTOR_SIZE = 2048
# what a checkpoint may hold beside the state dict; the names of scikit-learn's attributes
PCA_PARTS = ("mean", "components", "explained_variance", "whiten")
_PCA, _MEAN, _DEVIATION, _NORMALISED = (
    "pca.",
    "preprocess.mean",
    "preprocess.std",
    "model_options.norm_features",
)
# blocks of the third stage
_DEPTHS: dict[int, Depth] = {6: 50, 23: 101}


class _Power(nn.Module):
    """The pooling's power, of one value."""

    def __init__(self) -> None:
        super().__init__()
        self.p = nn.Parameter(torch.full((1,), 3.0))


class ApGemNet(ResNet):
    """Image to a vector of unit length; 46,696,513 weights at depth 101.

    Parameters
    ----------
    mean, deviation : of the images it was trained on, RGB in [0, 1].
    normalised_features : scale pooled features to unit length before the last layer.
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
        self.adpool = _Power()
        self.fc = nn.Linear(2048, DESCRIPTOR_SIZE)
        self.normalised_features = normalised_features
        for name, values in (("mean", mean), ("deviation", deviation)):
            self.register_buffer(name, torch.tensor(list(values)).view(3, 1, 1), persistent=False)

    def describe(self, image: torch.Tensor) -> torch.Tensor:
        """Unit vectors, float32 (B, 2048), of RGB images (B, 3, H, W) in [0, 1]."""
        features = self((image - self.mean) / self.deviation)[-1]
        # in half precision the convolutions alone
        with torch.autocast(image.device.type, enabled=False):
            pooled = generalized_mean(features, self.adpool.p)
            if self.normalised_features:
                pooled = functional.normalize(pooled)
            return functional.normalize(self.fc(pooled))


class Whitening(nn.Module):
    """Principal components, each scaled by a power of its variance, then unit length.

    Equal to scikit-learn's whitening at ``power`` 0.5; the authors evaluate at 0.25.

    Parameters
    ----------
    mean, components, variance : (D,), (K, D) and (K,), of the principal component analysis.
    power : 0 keeps the components' scales.
    """

    mean: torch.Tensor
    weight: torch.Tensor

    def __init__(
        self,
        mean: torch.Tensor,
        components: torch.Tensor,
        variance: torch.Tensor,
        *,
        power: float,
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

    Parameters
    ----------
    tensors : as :func:`megloc_kapture.io.weights.containers.read_checkpoint` gives them.
    where : the file, for messages.

    Raises
    ------
    DataError : they are of another network; names the keys.
    """
    beside = ("preprocess.", "model_options.", _PCA)
    state = {key: value for key, value in tensors.items() if not key.startswith(beside)}
    net = ApGemNet(
        _depth(state, where),
        mean=_three(tensors, _MEAN, IMAGENET_MEAN, where),
        deviation=_three(tensors, _DEVIATION, IMAGENET_DEVIATION, where),
        normalised_features=bool(tensors.get(_NORMALISED, torch.tensor(False))),
    )
    # what only training needs, and torch before 0.4 did not keep
    counters = [key for key in net.state_dict() if key.endswith(".num_batches_tracked")]
    load_strictly(net, state, where, may_lack=counters)
    return net.eval()


def whitening_from(
    tensors: Mapping[str, torch.Tensor], name: str, where: str, *, power: float
) -> Whitening:
    """The whitening that a checkpoint keeps under a name.

    Raises
    ------
    OptionError : there is none of this name; says which there are.
    DataError : it is incomplete, or of other sizes than the network's vectors.
    """
    known = sorted({key.split(".")[1] for key in tensors if key.startswith(_PCA)})
    if name not in known:
        raise OptionError(
            f"{where}: no whitening {name!r} in it; there is {', '.join(known) or 'none'} "
            "(an empty name takes the vectors as they are)"
        )
    parts = {part: tensors.get(f"{_PCA}{name}.{part}") for part in PCA_PARTS}
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


def _depth(state: Mapping[str, torch.Tensor], where: str) -> Depth:
    blocks = {key.split(".")[1] for key in state if key.startswith("layer3.")}
    if len(blocks) not in _DEPTHS or "adpool.p" not in state:
        raise DataError(
            "no AP-GeM: keys layer3.* of ResNet-50 or ResNet-101 and adpool.p expected", path=where
        )
    return _DEPTHS[len(blocks)]


def _three(
    tensors: Mapping[str, torch.Tensor], key: str, default: Iterable[float], where: str
) -> list[float]:
    values = tensors[key].double().flatten().tolist() if key in tensors else list(default)
    if len(values) != 3:
        raise DataError(f"{key} has {len(values)} values, not one for each of R, G, B", path=where)
    return values
