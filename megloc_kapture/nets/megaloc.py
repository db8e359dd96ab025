"""MegaLoc (Berton and Masone, CVPR Workshops 2025): DINOv2 ViT-B/14, SALAD, a linear layer.

The keys are those of the published ``model.safetensors``. The older ``megaloc.torch`` has the
trunk's under ``backbone.model``, and DINOv2's ``mask_token``; it is read too.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn
from torch.nn import functional

from megloc_kapture.nets.dinov2 import DinoV2
from megloc_kapture.nets.loading import load_strictly
from megloc_kapture.nets.resnet import imagenet_normalised
from megloc_kapture.nets.salad import Salad

_OLDER_TRUNK = "backbone.model."


class MegaLocNet(nn.Module):
    """An image to one vector of unit length.

    Parameters
    ----------
    backbone : None: ViT-B/14.
    clusters, cluster_size, token_size : of the aggregation.
    descriptor_size : components of the vector.
    """

    def __init__(
        self,
        backbone: DinoV2 | None = None,
        *,
        clusters: int = 64,
        cluster_size: int = 256,
        token_size: int = 256,
        descriptor_size: int = 8448,
    ) -> None:
        super().__init__()
        self.backbone = backbone or DinoV2()
        salad = Salad(
            self.backbone.channels,
            clusters=clusters,
            cluster_size=cluster_size,
            token_size=token_size,
        )
        linear = nn.Linear(clusters * cluster_size + token_size, descriptor_size)
        self.aggregator = nn.ModuleDict({"agg": salad, "linear": linear})

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Describe images.

        Parameters
        ----------
        image : (B, 3, H, W), RGB in [0, 1], both sides multiples of 14, of more
            patches than there are clusters.

        Returns
        -------
        float32 (B, D), D = 8448.
        """
        aggregated = self.aggregator["agg"](*self.backbone(imagenet_normalised(image)))
        return functional.normalize(self.aggregator["linear"](aggregated).float(), dim=1)


def squared(image: torch.Tensor, size_px: int) -> torch.Tensor:
    """Images (B, 3, H, W) of any size, made (B, 3, size, size).

    Bilinear with a filter against aliasing; width and height are scaled each by its own factor, as
    in the evaluation of the paper (section 4).
    """
    return functional.interpolate(
        image, size=(size_px, size_px), mode="bilinear", align_corners=False, antialias=True
    )


def megaloc_from(tensors: Mapping[str, torch.Tensor], where: str) -> MegaLocNet:
    """The network of a checkpoint, ready to describe.

    Parameters
    ----------
    where : the file, for messages.

    Raises
    ------
    DataError : the tensors are not MegaLoc's; names some that are missing, unexpected or of
        another shape.
    """
    renamed = {
        key.replace(_OLDER_TRUNK, "backbone.", 1) if key.startswith(_OLDER_TRUNK) else key: value
        for key, value in tensors.items()
        if key != _OLDER_TRUNK + "mask_token"
    }
    with torch.device("meta"):  # 229 million numbers are not drawn only to be overwritten
        network = MegaLocNet()
    network.to_empty(device="cpu")
    load_strictly(network, renamed, where)
    return network.eval()
