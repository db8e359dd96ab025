"""AP-GeM global features (Revaud et al., ICCV 2019), with the official checkpoints."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from megloc_kapture.features.global_network import GlobalNetwork
from megloc_kapture.features.image_size import sized_tensor
from megloc_kapture.io.weights import WeightsFile, read_weights
from megloc_kapture.nets.apgem import ApGemNet, Whitening, apgem_from, whitening_from
from megloc_kapture.nets.runtime import NetworkOptions, inference, pick_device


class ApGemOptions(NetworkOptions):
    """Options of AP-GeM."""

    weights: str = Field(
        default="apgem-resnet101-lm18",
        description="apgem-resnet101-lm18 (Google-Landmarks), apgem-resnet101, or a file",
    )
    whitening: str = Field(
        default="Landmarks_clean",
        pattern=r"^[\w-]*$",
        description="name of a PCA in the checkpoint, as the authors evaluate with it; empty: the "
        "network's vectors as they are, which is what their tool for kapture writes by default",
    )
    whitening_power: float = Field(
        default=0.25, ge=0, le=1, description="of the variances that components are divided by"
    )
    max_size_px: int | None = Field(
        default=1024,
        ge=32,
        description="longer side that the network sees, as hloc has it; none: the image's own, as "
        "the authors evaluate",
    )


class ApGem(GlobalNetwork):
    """AP-GeM vectors of unit length, float32 (2048,).

    The name tells the checkpoint and, with one, the whitening and its power: vectors of different
    ones do not compare.
    """

    name = "apgem"
    Options = ApGemOptions

    def __init__(self, options: ApGemOptions | None = None) -> None:
        self.options = options or ApGemOptions()
        super().__init__("apgem", self.options.weights)
        if self.options.whitening:
            self.name += f"-{self.options.whitening}-{self.options.whitening_power:g}"

    def describe_many(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """The vectors, float32 (B, 2048), of RGB images of one size, in their order."""
        options = self.options
        device = pick_device(options.device)
        net, whitening = _network(self._weights, device, options.whitening, options.whitening_power)
        batch = torch.cat([sized_tensor(image, options.max_size_px, device) for image in images])
        with inference(device, options.half_precision):
            vectors = net.describe(batch)
        if whitening is not None:
            with inference(device):
                vectors = whitening(vectors)
        return vectors.cpu().numpy()


@lru_cache(maxsize=2)
def _network(
    file: WeightsFile, device: torch.device, whitening: str, power: float
) -> tuple[ApGemNet, Whitening | None]:
    tensors, where = read_weights(file), str(file.path)
    net = apgem_from(tensors, where).to(device)
    if not whitening:
        return net, None
    return net, whitening_from(tensors, whitening, where, power=power).to(device)
