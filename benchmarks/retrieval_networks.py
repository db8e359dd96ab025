"""Global vectors of two small networks that were trained by day: GeM over their last feature maps.

SqueezeNet 1.1 from ImageNet (Keras' layout, read with h5py) and the encoder of ESPNetv2 from
Cityscapes (the module of the tests' plugin package). Neither was trained for retrieval. GeM is
Radenovic et al., "Fine-tuning CNN image retrieval with no human annotation", PAMI 2019, with its
usual exponent of 3.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional as F

from megloc_kapture.io.weights import FOLDER_VARIABLE, find_weights, read_weights
from megloc_kapture.nets.runtime import load_strictly

Describe = Callable[[NDArray[np.uint8]], NDArray[np.float32]]

SQUEEZENET = "squeezenet_v1.1_notop/squeezenet_weights_tf_dim_ordering_tf_kernels_notop.h5"
ESPNETV2 = "espnetv2_cityscapes/espnetv2_s_1.0_city_1024x512.pth"
_SEGMENTER = Path(__file__).resolve().parent.parent / "tests" / "outside_segmenter"
_LONG_SIDE_PX = 1024
_BGR_MEAN = (103.939, 116.779, 123.68)
_GEM_POWER = 3.0


class SqueezeNet(nn.Module):
    """SqueezeNet 1.1 without its classifier, from Keras' file."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        h5py = import_module("h5py")
        self.kernels: dict[str, torch.Tensor] = {}
        self.biases: dict[str, torch.Tensor] = {}

        def keep(name: str, item: object) -> None:
            if not isinstance(item, h5py.Dataset):
                return
            # conv1/NAME, fire2/squeeze1x1/NAME
            layer = "/".join(name.split("/")[: 1 if name.startswith("conv1") else 2])
            values = torch.from_numpy(item[()])
            if values.ndim == 1:
                self.biases[layer] = values
            else:  # height, width, in, out
                self.kernels[layer] = values.permute(3, 2, 0, 1).contiguous()

        with h5py.File(path) as file:
            file.visititems(keep)

    def _conv(self, x: torch.Tensor, layer: str, **how: int) -> torch.Tensor:
        return F.relu(F.conv2d(x, self.kernels[layer], self.biases[layer], **how))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Features (B, 512, h, w) of an RGB image (B, 3, H, W) in [0, 1]."""
        x = 255.0 * image.flip(1) - image.new_tensor(_BGR_MEAN)[:, None, None]
        x = F.max_pool2d(self._conv(x, "conv1", stride=2), 3, 2)
        for number in range(2, 10):
            fire = f"fire{number}"
            squeezed = self._conv(x, f"{fire}/squeeze1x1")
            x = torch.cat(
                [
                    self._conv(squeezed, f"{fire}/expand1x1"),
                    self._conv(squeezed, f"{fire}/expand3x3", padding=1),
                ],
                dim=1,
            )
            if number in (3, 5):
                x = F.max_pool2d(x, 3, 2)
        return x


def squeezenet() -> Describe:
    """GeM over SqueezeNet 1.1: 512 dimensions; raises where file or h5py are absent."""
    return _gem(SqueezeNet(find_weights(_place(SQUEEZENET)).path))


def espnetv2() -> Describe:
    """GeM over ESPNetv2's encoder: 256 dimensions; raises where the file is absent."""
    sys.path.append(str(_SEGMENTER))
    module = import_module("espnetv2_segmenter.network")
    found = find_weights(_place(ESPNETV2))
    whole = module.EspNetV2Network(20)
    load_strictly(whole, read_weights(found), str(found.path))
    whole.eval()
    mean, deviation = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)

    def features(image: torch.Tensor) -> torch.Tensor:
        shift = image.new_tensor(mean)[:, None, None]
        encoded: torch.Tensor = whole.base_net(
            (image - shift) / image.new_tensor(deviation)[:, None, None]
        )[-1]
        return encoded

    return _gem(features)


def _place(name: str) -> str:
    return str(Path(os.environ.get(FOLDER_VARIABLE, ".")) / name)


def _gem(features: Callable[[torch.Tensor], torch.Tensor]) -> Describe:
    def describe(image: NDArray[np.uint8]) -> NDArray[np.float32]:
        scale = min(1.0, _LONG_SIDE_PX / max(image.shape[:2]))
        # sides that the encoder can halve four times
        height, width = (max(32, round(side * scale / 32) * 32) for side in image.shape[:2])
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        with torch.inference_mode():
            found = features(torch.from_numpy(small).permute(2, 0, 1)[None].float() / 255.0)
            pooled = found.clamp_min(1e-6).pow(_GEM_POWER).mean((2, 3)).pow(1 / _GEM_POWER)[0]
        return np.asarray((pooled / pooled.norm()).numpy(), np.float32)

    return describe
