"""EigenPlaces (Berton et al., ICCV 2023): ResNet, generalized mean, a linear layer.

Under the keys of the published checkpoints, which number the layers of both sequences. CosPlace's
(Berton et al., CVPR 2022) are the same network.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.errors import DataError
from megloc_kapture.nets.runtime import load_strictly
from megloc_kapture.nets.trunks import Depth, ResNet, generalized_mean, imagenet_normalised

_CHANNELS = 2048
_DEEPER = "backbone.6.22.conv1.weight"  # a block that only ResNet-101 has
_LINEAR = "aggregation.3.weight"


class GeneralizedMean(nn.Module):
    """Generalized-mean pooling with a learnt power."""

    def __init__(self) -> None:
        super().__init__()
        self.p = nn.Parameter(torch.full((1,), 3.0))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return generalized_mean(features, self.p)


class EigenPlacesNet(nn.Module):
    """An image to one vector of unit length.

    Parameters
    ----------
    depth : of the ResNet.
    descriptor_size : components of the vector.
    """

    def __init__(self, depth: Depth = 50, descriptor_size: int = 2048) -> None:
        super().__init__()
        trunk = ResNet(depth)
        self.backbone = nn.Sequential(
            trunk.conv1,
            trunk.bn1,
            nn.ReLU(inplace=True),
            nn.MaxPool2d(3, stride=2, padding=1),
            *(trunk.get_submodule(f"layer{number}") for number in range(1, 5)),
        )
        # the layers between these have no weights
        self.aggregation = nn.ModuleDict(
            {"1": GeneralizedMean(), "3": nn.Linear(_CHANNELS, descriptor_size)}
        )

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Describe images.

        Parameters
        ----------
        image : (B, 3, H, W), RGB in [0, 1], of any size.

        Returns
        -------
        float32 (B, D).
        """
        features = functional.normalize(self.backbone(imagenet_normalised(image)).float(), dim=1)
        pooled = self.aggregation["1"](features)
        return functional.normalize(self.aggregation["3"](pooled).float(), dim=1)


def eigenplaces_from(tensors: Mapping[str, torch.Tensor], where: str) -> EigenPlacesNet:
    """The network of a checkpoint of ResNet-50 or ResNet-101, ready to describe.

    Parameters
    ----------
    where : the file, for messages.

    Raises
    ------
    DataError : the tensors are no such network's; names what does not fit.
    """
    if _LINEAR not in tensors or tensors[_LINEAR].ndim != 2:
        raise DataError(f"no EigenPlaces: a matrix {_LINEAR} expected", path=where)
    network = EigenPlacesNet(101 if _DEEPER in tensors else 50, len(tensors[_LINEAR]))
    counters = {key for key in network.state_dict() if key.endswith("num_batches_tracked")}
    load_strictly(network, tensors, where, may_lack=counters)
    return network.eval()
